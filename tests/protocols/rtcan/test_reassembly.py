"""Frames to messages: what is delivered, what is counted, and what the original made of the same frames."""

from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from r2p.codecs import can_bits, rtcan
from r2p.codecs.rtcan import Frame
from r2p.errors import MessageError
from r2p.protocols.can_orders import Mailbox
from r2p.protocols.rtcan.events import Received
from r2p.protocols.rtcan.reassembly import TIMEOUT, Reassembly
from r2p.units import NEVER
from tests.can_vectors import CanCase, arriving, can_cases

A, B = 0x020A, 0x020B  # one topic, two sources
STAMP = 1_000_000_000


def frames(data: bytes, message: int = A, laxity: int = 10) -> list[Frame]:
    return [Frame(rtcan.encode_identifier(laxity, message, left), part) for left, part in rtcan.fragments(data)]


def payload(size: int, seed: int = 0) -> bytes:
    return bytes((i * 7 + seed) & 0xFF for i in range(size))


class Receiver:
    """Feeds frames 150 us apart."""

    def __init__(self, size: int, *messages: int) -> None:
        self.reassembly = Reassembly()
        self.now = STAMP
        for message in messages or (A,):
            self.reassembly.subscribe(message, size)

    def feed(self, *frames: Frame) -> list[bytes]:
        return [received.payload for frame in frames if (received := self._receive(frame)) is not None]

    def _receive(self, frame: Frame) -> Received | None:
        self.now += 150_000
        return self.reassembly.receive(frame, self.now)

    @property
    def losses(self) -> dict[int, dict[str, int]]:
        return {source: dict(counts) for source, counts in self.reassembly.losses.items()}


@pytest.mark.parametrize("size", [1, 7, 8, 9, 16, 17, 24, 1023, 1024])
def test_whole_messages(size: int) -> None:
    receiver = Receiver(size)
    assert receiver.feed(*frames(payload(size)), *frames(payload(size, 1))) == [payload(size), payload(size, 1)]
    assert receiver.losses == {}
    assert receiver.reassembly.due == NEVER


def test_what_a_message_tells() -> None:
    receiver = Receiver(20)
    first, second, third = frames(payload(20), laxity=33)
    results = [receiver.reassembly.receive(frame, STAMP + n) for n, frame in enumerate((first, second, third))]
    received = results[-1]
    assert results[:2] == [None, None]
    assert received == Received(first.id, payload(20), STAMP)
    assert (received.source, received.high, received.message, received.laxity) == (10, 2, A, 33)
    assert received.started(1_000) == STAMP - can_bits.frame_bits(first.id, first.data) * 1_000
    assert [Received(laxity << 23, b"", 0).mailbox for laxity in (0, 1, 62, 63)] == [
        Mailbox.HRT,
        Mailbox.SRT,
        Mailbox.SRT,
        Mailbox.NRT,
    ]


def test_sources_and_topics_interleave_freely() -> None:
    receiver = Receiver(17, A, B, 0x030A)
    woven = [
        frame for three in zip(*(frames(payload(17, m), m) for m in (A, B, 0x030A)), strict=True) for frame in three
    ]
    assert receiver.feed(*woven) == [payload(17, m) for m in (A, B, 0x030A)]
    assert receiver.losses == {}


def test_only_what_is_subscribed() -> None:
    receiver = Receiver(8, B)
    assert receiver.feed(*frames(payload(8), A)) == []
    assert receiver.feed(*frames(payload(8), B)) == [payload(8)]
    receiver.reassembly.unsubscribe(B)
    receiver.reassembly.unsubscribe(A)
    assert not receiver.reassembly.subscribed(B)
    assert receiver.feed(*frames(payload(8), B)) == []
    assert receiver.losses == {}


@pytest.mark.parametrize(("lost", "reason"), [(0, "no beginning"), (1, "gap"), (2, "gap")])
def test_a_lost_frame_costs_its_message_and_counts_once(lost: int, reason: str) -> None:
    receiver = Receiver(24, A, B)
    damaged = frames(payload(24))
    del damaged[lost]
    assert receiver.feed(*damaged, *frames(payload(24, 1)), *frames(payload(24, 2), B)) == [
        payload(24, 1),
        payload(24, 2),
    ]
    assert receiver.losses == {10: {reason: 1}}


def test_the_end_of_one_and_the_beginning_of_the_next_are_lost() -> None:
    receiver = Receiver(24)
    stream = [*frames(payload(24))[:2], *frames(payload(24, 1))[1:], *frames(payload(24, 2))]
    assert receiver.feed(*stream) == [payload(24, 2)]
    assert receiver.losses == {10: {"gap": 1, "no beginning": 1}}


def test_a_loss_that_can_not_be_seen() -> None:
    """Frames carry no number of their message: a tail that fits is taken."""
    receiver = Receiver(24)
    assert receiver.feed(*frames(payload(24))[:1], *frames(payload(24, 1))[1:]) == [payload(8) + payload(24, 1)[8:]]
    assert receiver.losses == {}


def test_a_repeat_of_the_last_frame_is_ignored_and_counted() -> None:
    receiver = Receiver(24)
    first, second, third = frames(payload(24))
    assert receiver.feed(first, first, second, second, second, third, third) == [payload(24)]
    assert receiver.losses == {10: {"repeat": 4}}
    assert receiver.feed(*frames(payload(24, 5))) == [payload(24, 5)]


def test_the_same_fragment_with_other_bytes_is_a_new_message() -> None:
    receiver = Receiver(16)
    first, _ = frames(payload(16))
    assert receiver.feed(first, *frames(payload(16, 3))) == [payload(16, 3)]
    assert receiver.losses == {10: {"gap": 1}}


def test_equal_messages_of_one_frame_are_all_delivered() -> None:
    receiver = Receiver(4)
    assert receiver.feed(*frames(payload(4)), *frames(payload(4))) == [payload(4)] * 2


def test_an_unfinished_message_is_given_up_after_100_ms() -> None:
    receiver = Receiver(16, A, B)
    first, second = frames(payload(16))
    receiver.feed(first)
    assert receiver.reassembly.due == receiver.now + TIMEOUT
    receiver.feed(*frames(payload(16), B)[:1])
    receiver.reassembly.poll(receiver.now + TIMEOUT - 1)
    assert receiver.losses == {10: {"time-out": 1}}
    receiver.reassembly.poll(receiver.now + TIMEOUT)
    assert receiver.losses == {10: {"time-out": 1}, 11: {"time-out": 1}}
    assert receiver.reassembly.due == NEVER
    receiver.now += TIMEOUT
    assert receiver.feed(second, first, second) == [payload(16)]


def test_the_time_out_counts_from_the_last_frame_whether_polled_or_not() -> None:
    receiver = Receiver(24)
    first, second, third = frames(payload(24))
    receiver.feed(first)
    receiver.now += TIMEOUT - 150_000
    receiver.feed(second)
    receiver.now += TIMEOUT - 150_000
    assert receiver.feed(third) == [payload(24)]
    receiver.feed(first)
    receiver.now += TIMEOUT
    assert receiver.feed(second, third) == []
    assert receiver.losses[10]["time-out"] == 1


@pytest.mark.parametrize("size", [9, 23, 25, 40, 8])
def test_messages_of_another_size_are_never_delivered(size: int) -> None:
    receiver = Receiver(24)
    assert receiver.feed(*frames(payload(size)), *frames(payload(size))) == []
    assert sum(receiver.losses[10].values()) == 2
    assert receiver.feed(*frames(payload(24, 1))) == [payload(24, 1)]


def test_a_longer_message_is_not_taken_for_a_short_one() -> None:
    """The original takes its last frame."""
    receiver = Receiver(8)
    assert receiver.feed(*frames(payload(24)), *frames(payload(8))) == [payload(8)]
    assert receiver.losses == {10: {"too long": 1}}


def test_a_short_frame_in_the_middle() -> None:
    receiver = Receiver(24)
    first, second, third = frames(payload(24))
    assert receiver.feed(first, Frame(second.id, second.data[:5]), third, *frames(payload(24))) == [payload(24)]
    assert receiver.losses == {10: {"wrong length": 1}}


def test_another_size_starts_anew() -> None:
    receiver = Receiver(24)
    receiver.feed(frames(payload(24))[0])
    receiver.reassembly.subscribe(A, 24)
    assert receiver.reassembly.due < NEVER
    receiver.reassembly.subscribe(A, 8)
    assert receiver.reassembly.due == NEVER
    assert receiver.feed(*frames(payload(8))) == [payload(8)]
    with pytest.raises(MessageError, match="1 to 1024 bytes"):
        receiver.reassembly.subscribe(A, 1025)


def test_a_message_that_is_not_wanted_any_more_in_its_middle_is_counted() -> None:
    receiver = Receiver(20)
    receiver.feed(*frames(payload(20))[:2])
    receiver.reassembly.subscribe(A, 30)
    receiver.feed(*frames(payload(30))[:2])
    receiver.reassembly.unsubscribe(A)
    receiver.reassembly.unsubscribe(A)
    assert receiver.losses == {10: {"interrupted": 2}}
    assert receiver.reassembly.due == NEVER


def test_interrupted() -> None:
    receiver = Receiver(24)
    first, second, third = frames(payload(24))
    receiver.feed(first)
    receiver.reassembly.reset()
    assert receiver.losses == {10: {"interrupted": 1}}
    assert receiver.feed(second, third, first, second, third) == [payload(24)]


@given(
    st.integers(1, 40),
    st.lists(st.tuples(st.sampled_from([A, B]), st.integers(0, 255)), max_size=12),
    st.data(),
)
def test_whatever_is_lost_or_repeated(size: int, messages: list[tuple[int, int]], data: st.DataObject) -> None:
    """Of each source exactly those messages are delivered whose frames came one after the other, repeats aside."""
    receiver = Receiver(size, A, B)
    stream = [frame for message, seed in messages for frame in frames(payload(size, seed), message)]
    times = data.draw(st.lists(st.sampled_from([0, 1, 1, 1, 1, 2]), min_size=len(stream), max_size=len(stream)))
    came = [frame for frame, count in zip(stream, times, strict=True) for _ in range(count)]
    for message in A, B:
        mine = [frame for frame in came if frame.id >> 7 & 0xFFFF == message]
        if size > 8:
            mine = [frame for frame, before in zip(mine, [None, *mine], strict=False) if frame != before]
        count = rtcan.fragment_count(size)
        runs = [mine[i : i + count] for i in range(len(mine))]
        whole = [run for run in runs if [frame.id & 0x7F for frame in run] == list(range(count - 1, -1, -1))]
        receiver = Receiver(size, message)
        assert receiver.feed(*came) == [b"".join(frame.data for frame in run) for run in whole]
    if set(times) <= {1}:
        assert receiver.losses == {}


# The recordings

OURS = {
    # Where the original loses or invents something, what we make of the same frames: (payloads, losses).
    "rx_lost_last": (2, {"gap": 1}),  # the next message is not lost too
    "rx_duplicate_fragment": (2, {"repeat": 1}),  # it is no gap
    "rx_first_fragment_repeated_restart": (2, {"gap": 1}),
    "rx_short_dlc_last": (0, {"wrong length": 1}),  # the rest would be old memory
    "rx_short_dlc_first": (0, {"wrong length": 1}),
    "rx_long_dlc_last": (0, {"wrong length": 1}),  # written beyond the end of the buffer
    "rx_larger_message_than_expected": (0, {"too long": 1}),
    "rx_hrt_style_multiple_of_8": (0, {"too long": 1}),  # the empty extra frame of the original's own sender
}
OTHER_FILTER = {"rx_wrong_source_in_the_middle", "rx_source_check_low_byte_only"}  # ours is always all 16 bits


@pytest.mark.golden
@pytest.mark.parametrize("case", [case for case in can_cases("rx") if case.name not in OTHER_FILTER], ids=str)
def test_recorded_receiver(case: CanCase) -> None:
    reassembly = Reassembly()
    now = STAMP
    delivered: list[bytes] = []
    for step in case.steps:
        now += 150_000
        if step.verb == "rx":
            reassembly.subscribe(int(step.words[1], 0), int(step.words[2]))
        elif step.verb == "frame":
            received = reassembly.receive(arriving(step), now)
            delivered += [received.payload] if received is not None else []
    losses = sum(reassembly.losses.values(), Counter[str]())
    if case.name in OURS:
        count, reasons = OURS[case.name]
        assert (len(delivered), losses) == (count, reasons)
        return
    recorded = [bytes.fromhex(event.fields["data"]) for event in case.of("rx_callback")]
    if case.name == "rx_no_callback":  # its message object is for one message
        recorded = [bytes.fromhex("01020304"), bytes.fromhex("05060708")]
    assert delivered == recorded
    assert bool(losses) == (case.name == "rx_lost_first")


@pytest.mark.golden
@pytest.mark.parametrize("case", [case for case in can_cases("rx") if case.name in OTHER_FILTER], ids=str)
def test_recorded_sources(case: CanCase) -> None:
    """The original listens to a whole topic, and confuses its sources; here each source has its own place."""
    reassembly = Reassembly()
    steps = [arriving(step) for step in case.steps if step.verb == "frame"]
    for frame in steps:
        reassembly.subscribe(frame.id >> 7 & 0xFFFF, 24)
    delivered = [each for n, frame in enumerate(steps) if (each := reassembly.receive(frame, STAMP + n)) is not None]
    whole = 3 if case.name == "rx_wrong_source_in_the_middle" else 0
    assert len(delivered) == whole
    assert [each.source for each in delivered] == [0x34, 0x35, 0x35][:whole]
