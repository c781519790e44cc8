"""The bits of frames, against frames that are written down bit by bit."""

import itertools
from collections import Counter
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from r2p.codecs.can_bits import (
    EXTENDED,
    IDENTIFIER_MASK,
    REMOTE,
    AnyFrame,
    FrameField,
    arbitration_field,
    bits_until_lost,
    check_frame,
    field_at,
    frame_bits,
    frame_bits_max,
    frame_bits_min,
    from_wire,
    other_frame_bits,
    to_wire,
    wire_bits,
    wire_identifier,
)
from r2p.codecs.rtcan import Frame, OtherFrame, encode_sync
from r2p.errors import MessageError
from tests.can_reference import crc15, on_the_bus, wire

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


def names_of_11_or_29_bits() -> st.SearchStrategy[tuple[int, bool]]:
    """Identifiers, with whether they have 29 bits: any, and many of a few base identifiers that differ in one bit."""
    bases = st.sampled_from([0x000, 0x7FF, 0x2AA, 0x2AB])
    near = st.tuples(bases, st.integers(0, 10)).map(lambda each: each[0] ^ 1 << each[1]) | bases
    low = st.sampled_from([0, 0x3FFFF, 0x15555]) | st.integers(0, 17).map(lambda bit: 1 << bit)
    extended = st.tuples(near, low).map(lambda each: (each[0] << 18 | each[1], True))
    return extended | st.tuples(identifiers, st.just(True)) | st.tuples(near, st.just(False))


@st.composite
def any_frames(draw: st.DrawFn) -> AnyFrame:
    """Frames of all kinds."""
    identifier, extended = draw(names_of_11_or_29_bits())
    kind = draw(st.sampled_from(["data", "data", "remote", "long"]))
    if kind == "remote":
        return OtherFrame(identifier, b"", extended, draw(st.integers(0, 15)))
    if kind == "long":
        return OtherFrame(identifier, draw(st.binary(min_size=8, max_size=8)), extended, None, draw(st.integers(9, 15)))
    data = draw(frame_data | runs)
    return Frame(identifier, data) if extended else OtherFrame(identifier, data)


@given(any_frames())
def test_every_kind_of_frame_on_the_wire(frame: AnyFrame) -> None:
    bits = wire(frame, acknowledged=False)
    assert wire_bits(frame) == bits
    assert other_frame_bits(frame) == len(bits)


def test_the_check_value_of_the_crc() -> None:
    """CRC-15/CAN in the catalogue of parametrised CRC algorithms: that of the digits 1 to 9 is 0x059E."""
    assert int(crc15("".join(f"{byte:08b}" for byte in b"123456789")), 2) == 0x059E


@given(any_frames())
def test_lengths_as_data_sheets_have_them(frame: AnyFrame) -> None:
    """44 + 8 N bits or 64 + 8 N, without stuff bits, of which there is one in four at most (Davis et al., 2007)."""
    size = 8 * len(frame.data)
    plain = (64 if frame.extended else 44) + size
    assert plain <= other_frame_bits(frame) <= plain + ((54 if frame.extended else 34) + size - 1) // 4


@given(any_frames(), any_frames())
def test_the_bus_decides_as_wired_and_does(first: AnyFrame, second: AnyFrame) -> None:
    """The frame with the first dominant bit where the other is recessive wins; the other gives up after that bit."""
    fields = arbitration_field(first), arbitration_field(second)
    one, two = ((each.id, each.extended, each.remote is None) for each in (first, second))
    assert (fields[0] == fields[1]) == (one == two)
    if one == two:
        return
    bits = zip(wire(first), wire(second), strict=False)
    differ = next(i for i, (a, b) in enumerate(bits) if a != b)
    assert (wire(first)[differ] == "0") == (fields[0] < fields[1])
    assert bits_until_lost(min(fields), max(fields)) == differ + 1


def test_the_order_of_one_base_identifier() -> None:
    base = 0x123
    order: list[AnyFrame] = [
        OtherFrame(base, b"11 bits"),
        OtherFrame(base, b"", False, 0),
        Frame(base << 18, b"29 bits"),
        OtherFrame(base << 18, b"", True, 0),
        Frame(base << 18 | 1, b""),
        OtherFrame(base + 1),
    ]
    fields = [arbitration_field(each) for each in order]
    assert fields == sorted(set(fields))


@pytest.mark.parametrize(
    ("frame", "wrong"),
    [
        (Frame(1 << 29, b""), "0x20000000 has more than 29 bits"),
        (Frame(-1, b""), "more than 29 bits"),
        (Frame(0, bytes(9)), "9 bytes of data"),
        (OtherFrame(0x800), "0x800 has more than 11 bits"),
        (OtherFrame(1 << 29, b"", True, 1), "more than 29 bits"),
        (OtherFrame(1, b"", False, 16), "asks for 0..15 bytes, not 0 and 16"),
        (OtherFrame(1, b"x", False, 1), "has no data"),
        (OtherFrame(1, b"", False, 1, 9), "has no data"),
        (OtherFrame(1, bytes(7), False, None, 9), "7 bytes of data with length code 9"),
        (OtherFrame(1, bytes(8), False, None, 8), "with length code 8"),
        (OtherFrame(1, bytes(8), True), "is a Frame, not an OtherFrame"),
    ],
)
def test_what_is_no_frame(frame: AnyFrame, wrong: str) -> None:
    with pytest.raises(MessageError, match=wrong):
        check_frame(frame)


@given(any_frames())
def test_an_identifier_with_its_flags(frame: AnyFrame) -> None:
    check_frame(frame)
    flagged = wire_identifier(frame)
    assert flagged & IDENTIFIER_MASK == frame.id
    assert (bool(flagged & EXTENDED), bool(flagged & REMOTE)) == (frame.extended, frame.remote is not None)


@given(any_frames())
def test_frames_as_observers_get_them(frame: AnyFrame) -> None:
    """What a kernel does not pass on is lost: length codes over 8."""
    seen = to_wire(frame, 4, 5)
    assert seen[0] == wire_identifier(frame)
    assert seen[2:] == (4, 5)
    remote = None if frame.remote is None else min(frame.remote, 8)
    assert len(seen[1]) == (len(frame.data) if remote is None else remote)
    back = from_wire(seen)
    assert (back.id, back.data, back.extended, back.remote) == (frame.id, frame.data, frame.extended, remote)
    check_frame(back)


@given(any_frames())
def test_fields_of_a_frame(frame: AnyFrame) -> None:
    """The widths of all fields, stuff bits taken out by hand."""
    bits = wire(frame)
    widths = Counter(
        field_at(frame, number)
        for number, stuff in enumerate(stuff_bits(bits), start=1)
        if not stuff or len(bits) - number < 10  # after the CRC there are none
    )
    data = 0 if frame.remote is not None else 8 * len(frame.data)
    expected = {FrameField.START: 1, FrameField.ID_28_TO_21: 8, FrameField.ID_20_TO_18: 3, FrameField.DATA: data}
    expected |= {FrameField.SUBSTITUTE_REMOTE: 1, FrameField.EXTENSION: 1, FrameField.RESERVED_0: 1}
    expected |= {FrameField.LENGTH: 4, FrameField.CRC: 15, FrameField.CRC_DELIMITER: 1, FrameField.ACK_SLOT: 1}
    expected |= {FrameField.ACK_DELIMITER: 1, FrameField.END: 7}
    if frame.extended:
        expected |= {FrameField.ID_17_TO_13: 5, FrameField.ID_12_TO_5: 8, FrameField.ID_4_TO_0: 5}
        expected |= {FrameField.REMOTE: 1, FrameField.RESERVED_1: 1}
    assert widths == Counter(expected)
    assert field_at(frame, len(bits) + 1) is FrameField.INTERMISSION


def stuff_bits(bits: str) -> Iterator[bool]:
    """Whether each bit is one that a receiver takes out, up to the CRC."""
    run = 0
    for before, bit in itertools.pairwise(" " + bits):
        yield run == 5
        run = run + 1 if bit == before else 1
