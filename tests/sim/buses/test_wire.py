"""The wire format between a served bus and its clients: pairs of functions, and garbage."""

from __future__ import annotations

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from r2p.codecs.can_bits import Frame, OtherFrame
from r2p.errors import DecodeError
from r2p.sim.buses import wire
from r2p.sim.buses.attachment import BusFilter, BusFrame
from r2p.sim.can import ControllerState, ErrorKind

DATA = st.binary(max_size=8)
FRAMES = st.one_of(
    st.builds(Frame, st.integers(0, 0x1FFFFFFF), DATA),
    st.builds(OtherFrame, st.integers(0, 0x7FF), DATA),
    st.builds(OtherFrame, st.integers(0, 0x1FFFFFFF), st.just(b""), extended=st.just(True), remote=st.integers(0, 15)),
    st.builds(OtherFrame, st.integers(0, 0x7FF), st.just(b""), remote=st.integers(0, 15)),
)
NS = st.integers(-(1 << 62), 1 << 62)
COUNTERS = st.integers(0, 0xFFFF)
EVENTS = st.one_of(
    st.builds(BusFrame, FRAMES, NS, NS, st.booleans()),
    st.builds(
        BusFrame,
        st.none(),
        NS,
        NS,
        st.booleans(),
        st.sampled_from(ErrorKind),
        st.integers(0, 0xFF),
        st.none(),
        COUNTERS,
        COUNTERS,
    ),
    st.builds(
        BusFrame,
        st.none(),
        NS,
        NS,
        st.just(False),
        st.none(),
        st.just(0),
        st.sampled_from(ControllerState),
        COUNTERS,
        COUNTERS,
    ),
)
STATUS = wire.Status(7, 1 << 40, ControllerState.PASSIVE, 128, 3)


@given(st.lists(FRAMES))
def test_frames(frames: list[Frame | OtherFrame]) -> None:
    assert wire.decode_frames(wire.encode_frames(frames)) == frames


@given(st.lists(EVENTS))
def test_events(events: list[BusFrame]) -> None:
    body = wire.encode_status(STATUS) + b"".join(map(wire.encode_event, events))
    assert wire.decode_status(body) == STATUS
    assert [wire.decode_event(each) for each in wire.event_records(body)] == events


@pytest.mark.parametrize("extended", [None, True, False])
def test_filters(extended: bool | None) -> None:
    filters = [BusFilter(0x123, 0x7FF, extended), BusFilter(0, 0)]
    assert wire.decode_filters(wire.encode_filters(filters)) == filters


def test_error_counters_of_more_than_16_bits_are_the_highest() -> None:
    event = BusFrame(None, 0, 0, error=ErrorKind.BIT, tx_errors=1 << 16, rx_errors=1 << 40)
    body = wire.encode_status(wire.Status(0, 0, ControllerState.ACTIVE, 0, 0)) + wire.encode_event(event)
    decoded = wire.decode_event(next(wire.event_records(body)))
    assert (decoded.tx_errors, decoded.rx_errors) == (0xFFFF, 0xFFFF)


def test_greetings() -> None:
    proof = bytes(range(wire.PROOF_SIZE))
    greeting = wire.encode_greeting(proof, b"hello")
    head = wire.decode_greeting(greeting[: wire.GREETING_SIZE])
    assert head == wire.Greeting(wire.VERSION, proof, 5)
    assert greeting[wire.GREETING_SIZE :] == b"hello"


@given(st.binary(max_size=200))
def test_garbage_is_a_decode_error_or_something_valid(data: bytes) -> None:
    for decode in (wire.decode_frames, wire.decode_filters, wire.decode_status):
        with contextlib.suppress(DecodeError):
            decode(data)
    if len(data) >= wire.GREETING_SIZE:
        with pytest.raises(DecodeError):
            wire.decode_greeting(data[: wire.GREETING_SIZE])


@pytest.mark.parametrize(
    "identifier",
    [0x0000_0800, 0x2000_0001, 0xA000_0001],
    ids=["12 bits", "an error frame", "an error frame with 29 bits"],
)
def test_identifiers_that_are_not(identifier: int) -> None:
    with pytest.raises(DecodeError, match="not the identifier of a frame"):
        wire.decode_frames(identifier.to_bytes(4, "little") + bytes(9))


def test_sizes_that_are_not() -> None:
    with pytest.raises(DecodeError, match="9 bytes, of 8"):
        wire.decode_frames(bytes(4) + b"\x09" + bytes(8))
    with pytest.raises(DecodeError, match="of 524288 at most"):
        wire.decode_head(b"\x05\xff\xff\xff\xff")
    with pytest.raises(DecodeError, match="unknown state"):
        wire.decode_status(bytes(wire.STATUS_SIZE))


def test_a_message_of_the_largest_size_is_accepted() -> None:
    events = wire.EVENTS_MAX * wire.EVENT_SIZE
    body = wire.encode_status(STATUS) + bytes(events)
    assert wire.decode_head(wire.encode_message(wire.MessageType.EVENTS, body)) == (wire.MessageType.EVENTS, len(body))
