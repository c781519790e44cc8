"""The messages of r2p's own services, whole and in parts."""

from __future__ import annotations

import contextlib
from collections import Counter

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from r2p.codecs import UnknownType, call_parts, debug, management, own_services
from r2p.codecs.call_parts import CallPart
from r2p.codecs.own_services import ANSWER_MAX, MESSAGE_MAX, PAGE_MAX, Operation, OwnCall
from r2p.codecs.services import Kind, ServiceHeader
from r2p.errors import DecodeError, MessageError
from r2p.protocols.call_parts import CallAssembler

U32, U16, U8 = st.integers(0, 2**32 - 1), st.integers(0, 2**16 - 1), st.integers(0, 255)
HEADERS = st.builds(ServiceHeader, U32, U16, st.sampled_from(Kind), U32)
CALLS = st.builds(OwnCall, HEADERS, U8, U16, U16, U16, st.binary(max_size=PAGE_MAX), U8)
QUESTION = OwnCall(ServiceHeader(1, 2, Kind.REQUEST, 3), Operation.SCHEMA, body=b"8 bytes!")


@given(CALLS, U8)
def test_a_message_is_read_back_and_fits_every_line(call: OwnCall, hops: int) -> None:
    data = own_services.encode(call)
    assert own_services.decode(data) == call
    assert own_services.decode(own_services.with_hops(data, hops)).hops == hops
    assert debug.encode(own_services.topic_of(data), data, 0)


def test_a_request_goes_to_the_server_and_the_rest_to_the_caller() -> None:
    assert (QUESTION.target, own_services.topic_of(own_services.encode(QUESTION))) == (3, b"R2P_CALL")
    answer = OwnCall(ServiceHeader(1, 2, Kind.RESPONSE, 3), Operation.SCHEMA)
    assert (answer.target, own_services.topic_of(own_services.encode(answer))) == (1, b"R2P_REPLY")


@given(CALLS, st.text(max_size=300))
def test_a_refusal_is_an_error_in_the_place_of_the_module(call: OwnCall, text: str) -> None:
    answer = own_services.decode(own_services.refusal(call, text))
    assert answer.header == ServiceHeader(call.header.instance, call.header.number, Kind.ERROR, call.header.server)
    assert (answer.operation, answer.page) == (call.operation, call.page)
    assert len(answer.body) <= PAGE_MAX


@given(st.binary(max_size=2 * MESSAGE_MAX) | CALLS.map(own_services.encode))
def test_whatever_may_change_something_needs_a_seal(data: bytes) -> None:
    try:
        call = own_services.decode(data)
    except DecodeError:
        own_services.is_change(data)
    else:
        assert own_services.is_change(data) == (call.changes and call.is_request)


def test_a_message_that_does_not_fit() -> None:
    with pytest.raises(MessageError, match="carries 180 bytes, not 181"):
        own_services.encode(OwnCall(QUESTION.header, 1, body=bytes(181)))
    response = OwnCall(ServiceHeader(1, 2, Kind.RESPONSE, 3), 1, body=bytes(8 * PAGE_MAX))
    assert own_services.decode(own_services.encode(response)) == response
    assert len(own_services.encode(response)) == ANSWER_MAX
    with pytest.raises(MessageError, match="carries 1440 bytes, not 1441"):
        own_services.encode(OwnCall(response.header, 1, body=bytes(1441)))
    with pytest.raises(DecodeError, match="20 to 200 bytes, not 1460"):
        own_services.decode(own_services.encode(response)[:6] + bytes((Kind.ERROR,)) + bytes(ANSWER_MAX - 7))


@given(st.binary(max_size=2 * MESSAGE_MAX))
def test_any_bytes_are_a_message_or_a_decode_error(data: bytes) -> None:
    with contextlib.suppress(DecodeError):
        assert own_services.encode(own_services.decode(data)) == data


@given(st.data(), st.lists(st.binary(min_size=1, max_size=MESSAGE_MAX), min_size=1, max_size=5))
@settings(max_examples=50)
def test_parts_that_are_repeated_or_swapped_give_each_message_once(data: st.DataObject, messages: list[bytes]) -> None:
    lost: Counter[str] = Counter()
    assembler = CallAssembler(lost)
    for serial, message in enumerate(messages):
        parts = call_parts.encode(7, serial, message)
        assert {len(part) for part in parts} == {management.SIZE}
        sent = data.draw(st.permutations(parts + data.draw(st.lists(st.sampled_from(parts), max_size=3))))
        got = [assembler.receive(0, call_parts.decode(part)) for part in sent]
        assert [each for each in got if each is not None] == [message]
    assert not lost


@given(st.lists(st.builds(CallPart, st.integers(0, 3), U8, st.integers(0, 8), st.integers(1, 200), st.just(b""))))
def test_lost_parts_are_counted_and_parts_of_two_messages_are_never_mixed(parts: list[CallPart]) -> None:
    lost: Counter[str] = Counter()
    assembler = CallAssembler(lost)
    message = bytes(range(100))
    whole = [call_parts.decode(each) for each in call_parts.encode(9, 1, message)]
    assert [assembler.receive(0, part) for part in whole[:-1]] == [None] * (len(whole) - 1)
    for part in parts:
        piece = b"x" * min(23, max(0, part.length - 23 * part.part))
        if part.part < call_parts.count(part.length):
            assembler.receive(0, CallPart(part.sender, part.serial, part.part, part.length, piece))
    assert assembler.receive(0, CallPart(9, 1, whole[-1].part, 99, b"")) is None
    assert assembler.receive(0, whole[-1]) == message
    assembler.receive(0, call_parts.decode(call_parts.encode(9, 2, message)[0]))
    before = lost["call incomplete"]
    assert assembler.receive(6 * 10**9, call_parts.decode(call_parts.encode(9, 2, message)[1])) is None
    assert lost["call incomplete"] == before + 1


@given(st.binary(min_size=31, max_size=31))
def test_any_part_is_one_or_a_decode_error(body: bytes) -> None:
    try:
        part = call_parts.decode(body + bytes((management.ManagementType.CALL_PART,)))
    except DecodeError:
        return
    CallAssembler(Counter()).receive(0, part)


def test_modules_of_before_ignore_parts_by_their_type() -> None:
    """They decode management in the same way: firmware and they ignore what they do not know."""
    (part, *_) = call_parts.encode(1, 1, own_services.encode(QUESTION))
    with pytest.raises(UnknownType):
        management.decode(part)
