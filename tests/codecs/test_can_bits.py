"""The bits of frames, against frames that are written down bit by bit."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from r2p.codecs.can_bits import (
    bits_until_lost,
    frame_bits,
    frame_bits_max,
    frame_bits_min,
    other_frame_bits,
    wire_bits,
)
from r2p.codecs.rtcan import Frame, OtherFrame, encode_sync
from r2p.errors import MessageError
from tests.can_reference import on_the_bus

identifiers = st.integers(0, (1 << 29) - 1)
frame_data = st.binary(max_size=8)
# bytes with long runs of equal bits, which plain random bytes seldom have
runs = st.lists(st.sampled_from([0x00, 0xFF, 0x0F, 0xF0, 0x1F, 0xE0, 0x83, 0x3C, 0x78, 0x87]), max_size=8).map(bytes)


@given(identifiers, frame_data | runs)
def test_length_of_extended_frames(identifier: int, data: bytes) -> None:
    assert frame_bits(identifier, data) == len(on_the_bus(identifier, data))


@given(identifiers, frame_data | runs)
def test_bits_on_the_wire(identifier: int, data: bytes) -> None:
    assert wire_bits(Frame(identifier, data)) == on_the_bus(identifier, data, acknowledged=False)


@given(st.integers(0, 0x7FF), frame_data | runs)
def test_length_of_standard_frames(identifier: int, data: bytes) -> None:
    assert frame_bits(identifier, data, extended=False) == len(on_the_bus(identifier, data, extended=False))
    assert other_frame_bits(OtherFrame(identifier, data)) == frame_bits(identifier, data, extended=False)


@given(st.integers(0, (1 << 29) - 1), st.booleans(), st.integers(0, 8))
def test_the_bits_of_remote_frames(identifier: int, extended: bool, length: int) -> None:
    identifier = identifier if extended else identifier >> 18
    expected = len(on_the_bus(identifier, b"", extended=extended, remote=length))
    assert other_frame_bits(OtherFrame(identifier, b"", extended, length)) == expected


def test_no_frame_has_room() -> None:
    for frame in (OtherFrame(1 << 11), OtherFrame(1 << 29, b"", True, 1), OtherFrame(1, b"", False, 16)):
        with pytest.raises(MessageError):
            other_frame_bits(frame)


@given(identifiers, runs)
def test_length_lies_within_its_bounds(identifier: int, data: bytes) -> None:
    assert frame_bits_min(len(data)) <= frame_bits(identifier, data) <= frame_bits_max(len(data))


def test_the_bounds_of_the_textbook() -> None:
    assert (frame_bits_min(0), frame_bits_max(0)) == (64, 77)
    assert (frame_bits_min(8), frame_bits_max(8)) == (128, 157)


@pytest.mark.parametrize(
    ("identifier", "data", "bits"),
    [
        # found by an exhaustive search over all identifiers, data and CRCs: no 8-byte frame is shorter or longer
        (0x0EC4A555, "aaaaaaaaaaaaaaaa", 128),
        (0x000C3C3C, "3c3c3fff0f0f0f0f", 155),
        # ... and no sync frame
        (0x00002100, "cdb5aaaaaaaaaaaa", 132),
        (0x00000000, "3c3c3c3c01e1f000", 153),
        (0x00000000, "0000000000000000", 147),
    ],
)
def test_extreme_frames(identifier: int, data: str, bits: int) -> None:
    assert frame_bits(identifier, bytes.fromhex(data)) == bits == len(on_the_bus(identifier, bytes.fromhex(data)))


@given(st.integers(0, 255), st.integers(0, (1 << 64) - 1))
def test_length_of_sync_frames(cycle: int, mask: int) -> None:
    frame = encode_sync(cycle, mask)
    assert 132 <= frame_bits(frame.id, frame.data) <= 153


@pytest.mark.parametrize(("identifier", "size", "extended"), [(1 << 29, 0, True), (0x800, 0, False), (0, 9, True)])
def test_what_no_frame_has_room_for(identifier: int, size: int, extended: bool) -> None:
    with pytest.raises(MessageError):
        frame_bits(identifier, bytes(size), extended=extended)


@given(identifiers, identifiers)
def test_arbitration_is_lost_in_the_first_bit_that_differs(first: int, second: int) -> None:
    if first == second:
        return
    winner, loser = sorted((first, second))
    bits = zip(on_the_bus(winner, b""), on_the_bus(loser, b""), strict=False)
    differ = next(i for i, (a, b) in enumerate(bits) if (a, b) == ("0", "1"))
    assert bits_until_lost(winner, loser) == differ + 1
