"""Messages whose lengths are those of the messages before them take the fast way, with the same result."""

import random
import struct
import sys
import threading
from typing import Annotated

import pytest
from hypothesis import given
from hypothesis import strategies as st

import r2p
from r2p.messages.known_lengths import SHORT_TEXT


class KnownLengthScan(r2p.Message):
    frame: Annotated[str, r2p.Max(SHORT_TEXT)]
    angle: r2p.f32
    ranges: Annotated[r2p.Array[r2p.f32], r2p.Max(8)]
    note: Annotated[str, r2p.Max(8)]
    raw: Annotated[bytes, r2p.Max(8)]
    good: bool


LAYOUT = r2p.layout(KnownLengthScan)

SCANS = st.builds(
    KnownLengthScan,
    frame=st.text("aé", max_size=3),
    angle=st.sampled_from((0.0, 1.5)),
    ranges=st.lists(st.sampled_from((0.5, 2.0)), max_size=3).map(r2p.Array),
    note=st.text("xyz", max_size=2),
    raw=st.binary(max_size=3),
    good=st.booleans(),
)


def by_fields(scan: KnownLengthScan) -> bytes:
    """The bytes as PROTOCOL.md says: each count before its elements."""
    frame, note, ranges = scan.frame.encode(), scan.note.encode(), tuple(scan.ranges)
    return struct.pack(
        f"<I{len(frame)}sfI{len(ranges)}fI{len(note)}sI{len(scan.raw)}s?",
        *(len(frame), frame, scan.angle, len(ranges), *ranges, len(note), note, len(scan.raw), scan.raw, scan.good),
    )


@given(st.lists(st.tuples(SCANS, st.integers(1, 4)), max_size=40))
def test_messages_of_any_lengths_in_any_order_keep_their_bytes(scans: list[tuple[KnownLengthScan, int]]) -> None:
    for scan, times in scans:
        for _ in range(times):
            data = LAYOUT.encode(scan)
            assert data == by_fields(scan)
            assert LAYOUT.decode(data) == scan


def test_a_message_of_a_known_size_with_other_counts_is_not_taken_for_a_known_one() -> None:
    one = KnownLengthScan("ab", 1.0, r2p.Array([1.0]), "", b"wxyz", good=True)
    other = KnownLengthScan("ab", 1.0, r2p.Array([]), "efgh", b"wxyz", good=True)
    data = LAYOUT.encode(one)
    assert len(data) == len(LAYOUT.encode(other))
    for _ in range(4):
        assert LAYOUT.decode(data) == one
    assert LAYOUT.decode(LAYOUT.encode(other)) == other
    assert LAYOUT.decode(data) == one


def test_threads_that_decode_the_same_class_do_not_disturb_each_other() -> None:
    scans = [LAYOUT.encode(KnownLengthScan("a" * size, 1.0, r2p.Array(), "", b"", good=True)) for size in range(40)]
    errors: list[BaseException] = []

    def decode(number: int) -> None:
        chosen = random.Random(number)
        try:
            for _ in range(3000):
                data = chosen.choice(scans)
                assert [LAYOUT.encode(LAYOUT.decode(data)) for _ in range(3)] == [data] * 3
        except BaseException as error:  # noqa: BLE001 - a thread's errors are lost
            errors.append(error)

    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        threads = [threading.Thread(target=decode, args=(number,)) for number in range(3)]
        for each in threads:
            each.start()
        for each in threads:
            each.join()
    finally:
        sys.setswitchinterval(interval)
    assert not errors


@pytest.mark.parametrize("count", [0, 1, 3, 9, 0xFFFFFFFF])
def test_a_wrong_count_in_a_message_of_known_size_is_undecodable(count: int) -> None:
    data = LAYOUT.encode(KnownLengthScan("ab", 1.0, r2p.Array([1.0, 2.0]), "c", b"d", good=True))
    for _ in range(3):
        LAYOUT.decode(data)
    at = 4 + 2 + 4
    wrong = data[:at] + count.to_bytes(4, "little") + data[at + 4 :]
    with pytest.raises(r2p.DecodeError):
        LAYOUT.decode(wrong)


def test_texts_that_are_no_unicode_are_undecodable_in_messages_of_known_size() -> None:
    data = LAYOUT.encode(KnownLengthScan("ab", 1.0, r2p.Array([1.0]), "c", b"d", good=True))
    for _ in range(3):
        LAYOUT.decode(data)
    with pytest.raises(r2p.DecodeError, match="utf-8"):
        LAYOUT.decode(data.replace(b"ab", b"\xff\xff"))


@pytest.mark.parametrize("length", [0, 1, 255, 256])
def test_short_texts_of_each_length_are_packed_with_their_neighbours(length: int) -> None:
    scan = KnownLengthScan("x" * length, 1.0, r2p.Array([1.0]), "c", b"d", good=True)
    assert LAYOUT.encode(scan) == by_fields(scan)
    with pytest.raises(r2p.MessageError, match="frame"):
        LAYOUT.encode(KnownLengthScan("x" * 257, 1.0, r2p.Array([1.0]), "c", b"d", good=True))
