"""Management without its zeros on an RTCAN bus: what it takes there, and what receivers make of lost frames."""

from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from r2p.codecs import management, rtcan
from r2p.codecs.management import SIZE, Advertise, Alive, Claim, Renew
from r2p.codecs.rtcan import FIRST_MARK, Frame, pack_management, unpack_management
from r2p.errors import DecodeError
from r2p.protocols.rtcan.queue import LaxityQueue, QueuedMessage
from r2p.protocols.rtcan.reassembly import Reassembly
from tests.protocols.rtcan.bus import MS

MESSAGE = rtcan.message_id(rtcan.MANAGEMENT, 0x21)
RENEW = management.encode(Renew(8, bytes([0x42, 0x43]).ljust(24, b"\0")))
CLAIM = management.encode(Claim(0x21, 0x1122334455667788))
ADVERTISE = management.encode(Advertise("odometry", 33, 4))
FULL = bytes(range(1, SIZE + 1))

messages = st.one_of(
    st.binary(min_size=SIZE, max_size=SIZE),
    st.lists(st.sampled_from([0, 0, 0, 1, 255]), min_size=SIZE, max_size=SIZE).map(bytes),
)


def frames(data: bytes) -> list[Frame]:
    """Return the frames of a message as a node sends them."""
    packed = pack_management(data)
    queue, queued = LaxityQueue(), QueuedMessage(MESSAGE, packed, 50 * MS, drop=False, marked=len(packed) < SIZE)
    queue.put(queued)
    sent = []
    while queue.size:
        sent.append(queue.next_frame(queued, 0))
        queue.frame_sent(queued)
    return sent


def received(*sent: Frame) -> tuple[list[bytes], Counter[str]]:
    """Return what is delivered of these frames, 150 us apart, and what is counted."""
    reassembly = Reassembly()
    reassembly.subscribe(MESSAGE, SIZE, packed=True)
    delivered = [reassembly.receive(frame, number * 150_000) for number, frame in enumerate(sent)]
    return [each.payload for each in delivered if each is not None], reassembly.losses[0x21]


@given(messages)
def test_every_message_is_as_it_was_and_never_longer(data: bytes) -> None:
    packed = pack_management(data)
    assert len(packed) <= SIZE
    assert packed[-1] == data[-1], "the type stays the last byte"
    assert unpack_management(packed, SIZE) == data


@given(st.binary(max_size=SIZE))
def test_any_bytes_are_a_message_or_refused(packed: bytes) -> None:
    try:
        assert len(unpack_management(packed, SIZE)) == SIZE
    except DecodeError:
        assert not packed or b"\0" in packed


@pytest.mark.parametrize("packed", [b"", b"\0\x20\x11", b"\0\x10\0\x10\x11"])
def test_bytes_for_more_than_a_message_are_refused(packed: bytes) -> None:
    with pytest.raises(DecodeError, match=r"no management message of 32 bytes"):
        unpack_management(packed, SIZE)


@pytest.mark.parametrize(
    ("data", "lefts"),
    [
        (management.encode(Alive("IMU")), [FIRST_MARK]),
        (RENEW, [FIRST_MARK]),
        (CLAIM, [FIRST_MARK | 1, 0]),
        (ADVERTISE, [FIRST_MARK | 1, 0]),
        (FULL, [3, 2, 1, 0]),  # nothing to leave out: as firmware sends it
    ],
)
def test_a_message_takes_as_many_frames_as_it_needs(data: bytes, lefts: list[int]) -> None:
    assert [frame.id & rtcan.LEFT_MASK for frame in frames(data)] == lefts
    assert received(*frames(data)) == ([data], {})


def test_messages_with_all_their_zeros_are_understood() -> None:
    """As programs send them that do not know better, and r2p did before."""
    whole = [Frame(rtcan.encode_identifier(40, MESSAGE, left), part) for left, part in rtcan.fragments(RENEW)]
    assert received(*whole, *frames(CLAIM), *whole, *whole) == ([RENEW, CLAIM, RENEW, RENEW], {})


@pytest.mark.parametrize(("lost", "reason"), [(0, "no beginning"), (1, "gap"), (2, "gap")])
def test_a_lost_frame_costs_its_message_and_counts_once(lost: int, reason: str) -> None:
    long = management.encode(Advertise("name", 33, 4, b"\1\2\3\4\5\6\7\1\2\3"))
    damaged = frames(long)
    assert len(damaged) == 3
    del damaged[lost]
    assert received(*damaged, *frames(CLAIM), *frames(RENEW)) == ([CLAIM, RENEW], {reason: 1})


def test_a_repeated_frame_is_ignored_and_counted() -> None:
    first, last = frames(CLAIM)
    assert received(first, first, last, *frames(RENEW)) == ([CLAIM, RENEW], {"repeat": 1})
    assert received(first, last, last, *frames(RENEW)) == ([CLAIM, RENEW], {"repeat": 1})


def test_what_no_node_sends_is_counted() -> None:
    def marked(left: int, data: bytes) -> Frame:
        return Frame(rtcan.encode_identifier(40, MESSAGE, FIRST_MARK | left), data)

    for wrong, reason in (
        (marked(4, bytes(8)), "too long"),
        (marked(1, bytes(7)), "wrong length"),
        (marked(0, b"\0\xff\x11"), "damaged"),
        (marked(0, b""), "damaged"),
    ):
        assert received(wrong, *frames(CLAIM)) == ([CLAIM], {reason: 1})


@given(st.lists(st.tuples(st.sampled_from([RENEW, CLAIM, ADVERTISE, FULL]), st.integers(0, 4)), max_size=8))
def test_of_messages_of_which_one_frame_is_lost_the_others_arrive(said: list[tuple[bytes, int]]) -> None:
    sent: list[Frame] = []
    whole: list[bytes] = []
    for data, lost in said:
        parts = frames(data)
        if lost >= len(parts):
            whole.append(data)
        sent += parts[:lost] + parts[lost + 1 :]
        sent += frames(RENEW)  # else the rest of two may look like one
        whole.append(RENEW)
    assert received(*sent)[0] == whole
