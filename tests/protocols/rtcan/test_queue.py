"""Who goes next: by hand, and against what the original queue did."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from r2p.codecs import rtcan
from r2p.errors import MessageError
from r2p.protocols.rtcan.queue import DISCOVERY, PRESENCE, REQUEST, LaxityQueue, QueuedMessage
from r2p.units import NEVER
from tests.can_vectors import CanCase, can_cases, payload

MS = 1_000_000
NOW = 1_000 * MS


def srt(message: int, remaining: float, size: int = 1, *, drop: bool = True) -> QueuedMessage:
    return QueuedMessage(message, bytes(size), NOW + int(remaining * MS), drop)


def nrt(message: int, size: int = 1) -> QueuedMessage:
    return QueuedMessage(message, bytes(size), drop=False)


def filled(*messages: QueuedMessage) -> LaxityQueue:
    queue = LaxityQueue()
    for message in messages:
        assert queue.put(message)
    return queue


def drain(queue: LaxityQueue, now: int = NOW, step: int = 0) -> list[tuple[int, int, int]]:
    """(message id, laxity, fragments left) of everything, in the order in which it goes."""
    order: list[tuple[int, int, int]] = []
    while True:
        queue.expire(now)
        message = queue.best(now)
        if message is None:
            return order
        identifier = rtcan.decode_identifier(queue.next_frame(message, now).id)
        order.append((identifier.message_id, identifier.laxity, identifier.left))
        queue.frame_sent(message)
        now += step


def test_the_least_laxity_goes_first() -> None:
    queue = filled(nrt(4), srt(1, 30), srt(2, 10), srt(3, 20))
    assert drain(queue) == [(2, 10, 0), (3, 20, 0), (1, 30, 0), (4, 63, 0)]


@pytest.mark.parametrize(
    ("remaining", "laxity"),
    [(0.0, 1), (0.9, 1), (1.99, 1), (2, 2), (20.999, 20), (62, 62), (63, 62), (64, 62), (1e6, 62)],
)
def test_laxity_is_in_whole_ms_and_never_that_of_another_class(remaining: float, laxity: int) -> None:
    assert drain(filled(srt(1, remaining, drop=False))) == [(1, laxity, 0)]


def test_management_goes_first_among_equals_and_has_room_of_its_own() -> None:
    queue = LaxityQueue(capacity=2)
    assert queue.put(srt(5, -3, drop=False))
    assert queue.put(srt(6, 1.5, drop=False))
    assert not queue.put(srt(7, 1))
    for remaining in (1.9, 1.9, 30):
        assert queue.put(srt(1, remaining, 16, drop=False), management=True)
    assert drain(queue) == [(1, 1, 1), (1, 1, 0), (1, 1, 1), (1, 1, 0), (5, 1, 0), (6, 1, 0), (1, 30, 1), (1, 30, 0)]


def test_first_come_first_served_among_equals() -> None:
    """Equal is what has the same laxity now, not the same deadline."""
    assert [m for m, _, _ in drain(filled(srt(1, 20.9), srt(2, 20.1), srt(3, 19.99)))] == [3, 1, 2]
    assert [m for m, _, _ in drain(filled(srt(1, 900), srt(2, 70), srt(3, 61.9)))] == [3, 1, 2]
    assert [m for m, _, _ in drain(filled(nrt(2), nrt(1), nrt(3)))] == [2, 1, 3]


def test_all_that_is_nearly_overdue_is_equal() -> None:
    queue = filled(srt(1, 1.9), srt(2, 0.2), srt(3, -5, drop=False))
    assert drain(queue) == [(1, 1, 0), (2, 1, 0), (3, 1, 0)]


def test_laxity_is_new_at_every_try() -> None:
    queue = filled(srt(1, 20, size=20))
    message = queue.best(NOW)
    assert message is not None
    assert queue.next_frame(message, NOW).id >> 23 == 20
    queue.put_back(message)
    assert queue.next_frame(message, NOW + 5 * MS).id >> 23 == 15
    queue.frame_sent(message)
    frame = queue.next_frame(message, NOW + 9 * MS)
    assert (frame.id >> 23, frame.id & 0x7F) == (11, 1)


def test_a_more_urgent_message_goes_between_the_fragments() -> None:
    queue = filled(srt(1, 30, size=17))
    message = queue.best(NOW)
    assert message is not None
    queue.next_frame(message, NOW)
    assert queue.put(srt(2, 5))
    queue.frame_sent(message)
    assert drain(queue) == [(2, 5, 0), (1, 30, 1), (1, 30, 0)]


def test_equals_do_not_interleave() -> None:
    queue = filled(srt(1, 20, size=16), srt(2, 20, size=16))
    assert drain(queue) == [(1, 20, 1), (1, 20, 0), (2, 20, 1), (2, 20, 0)]


def test_messages_of_one_topic_never_interleave_and_the_urgent_one_lends_its_urgency() -> None:
    queue = filled(srt(1, 40, size=16), srt(1, 10, size=9), srt(2, 20))
    assert drain(queue) == [(1, 10, 1), (1, 10, 0), (1, 10, 1), (1, 10, 0), (2, 20, 0)]
    queue = filled(nrt(1, size=9), srt(1, 10), srt(2, 20))
    assert drain(queue) == [(1, 10, 1), (1, 10, 0), (1, 10, 0), (2, 20, 0)]


def test_urgent_goes_to_the_front_of_its_topic_but_not_into_a_started_message() -> None:
    queue = filled(srt(1, 50, size=16), srt(1, 50))
    message = queue.best(NOW)
    assert message is not None
    queue.next_frame(message, NOW)
    assert queue.put(QueuedMessage(1, bytes(9), NOW + MS, drop=False), urgent=True)
    queue.frame_sent(message)
    assert drain(queue) == [(1, 1, 0), (1, 1, 1), (1, 1, 0), (1, 50, 0)]


def test_overdue_is_dropped_unless_it_has_started_or_shall_be_sent() -> None:
    queue = filled(srt(1, 2), srt(2, 2, drop=False), srt(3, 2, size=9), srt(4, 9))
    started = next(each for each in queue.messages() if each.message == 3)
    queue.next_frame(started, NOW)
    queue.frame_sent(started)
    assert queue.expire(NOW + 2 * MS - 1) == []
    assert [each.message for each in queue.expire(NOW + 2 * MS)] == [1]
    assert drain(queue, NOW + 3 * MS) == [(2, 1, 0), (3, 1, 0), (4, 6, 0)]


def test_overdue_in_the_mailbox_is_dropped_when_it_comes_back() -> None:
    queue = filled(srt(1, 2))
    message = queue.best(NOW)
    assert message is not None
    queue.next_frame(message, NOW)
    assert queue.expire(NOW + 5 * MS) == []
    queue.put_back(message)
    assert queue.next_expiry <= NOW + 5 * MS
    assert queue.expire(NOW + 5 * MS) == [message]
    assert queue.size == 0


def test_expiry_says_when_to_look() -> None:
    queue = filled(srt(1, 5), srt(2, 3), nrt(3), srt(4, 1, drop=False))
    assert queue.next_expiry == NOW + 3 * MS
    queue.expire(NOW + 3 * MS)
    assert queue.next_expiry == NOW + 5 * MS
    queue.expire(NOW + 5 * MS)
    assert queue.next_expiry == NEVER


def test_classes_apart() -> None:
    """Without slots, the port holds one frame of each class."""
    queue = filled(nrt(1), srt(2, 10), nrt(3))
    srt_message, nrt_message = queue.best(NOW, nrt=False), queue.best_nrt(NOW)
    assert srt_message is not None
    assert nrt_message is not None
    assert (srt_message.message, nrt_message.message) == (2, 1)
    queue.next_frame(srt_message, NOW)
    queue.next_frame(nrt_message, NOW)
    assert queue.best(NOW, nrt=False) is None
    other = queue.best_nrt(NOW)
    assert other is not None
    assert other.message == 3


def test_a_topic_is_held_after_an_error_and_others_go_on() -> None:
    queue = filled(srt(1, 10), srt(2, 20))
    message = queue.best(NOW)
    assert message is not None
    queue.next_frame(message, NOW)
    queue.put_back(message, NOW + MS)
    assert [each.message for now in (NOW, NOW + MS) if (each := queue.best(now))] == [2, 1]


def test_only_one_topic_may_send() -> None:
    queue = filled(srt(1, 10), nrt(2), nrt(3))
    queue.only = 3
    best = queue.best(NOW)
    assert best is not None
    assert best.message == 3
    assert queue.best_nrt(NOW) is None
    queue.only = 4
    assert queue.best(NOW) is None


def test_it_is_bounded() -> None:
    queue = LaxityQueue(capacity=3, depth=2)
    assert [queue.put(nrt(1)), queue.put(nrt(1)), queue.put(nrt(1))] == [True, True, False]
    assert queue.size == 2
    assert queue.put(nrt(2))
    assert queue.size == 3
    assert not queue.put(nrt(3))
    assert len(queue.clear()) == 3
    assert queue.size == 0
    assert queue.best(NOW) is None


@pytest.mark.parametrize("size", [0, 1025])
def test_what_rtcan_cannot_carry(size: int) -> None:
    with pytest.raises(MessageError, match="1 to 1024 bytes"):
        LaxityQueue().put(nrt(1, size))


@given(
    st.lists(
        st.tuples(st.integers(0, 5), st.one_of(st.none(), st.integers(-10, 100)), st.integers(1, 30), st.booleans()),
        max_size=30,
    ),
    st.integers(0, 3 * MS),
)
def test_whatever_waits(messages: list[tuple[int, int | None, int, bool]], step: int) -> None:
    """Everything comes out whole or is dropped whole; no two messages of a topic interleave; the best one goes."""
    queue = LaxityQueue()
    frames = 0
    for number, (topic, remaining, size, drop) in enumerate(messages):
        deadline = NEVER if remaining is None else NOW + remaining * MS
        data = bytes([number]) * size
        queue.put(QueuedMessage(topic, data, deadline, drop and remaining is not None))
        frames += rtcan.fragment_count(size)
    now, open_topics = NOW, dict[int, tuple[int, int]]()
    while True:
        dropped = queue.expire(now)
        frames -= sum(each.frames for each in dropped)
        best = queue.best(now)
        if best is None:
            break
        assert not any(each.sent for each in dropped)
        frame = queue.next_frame(best, now)
        identifier = rtcan.decode_identifier(frame.id)
        number, left = frame.data[0], identifier.left
        if identifier.message_id in open_topics:
            assert open_topics.pop(identifier.message_id) == (number, left + 1)
        else:
            assert left == best.frames - 1
        if left:
            open_topics[identifier.message_id] = (number, left)
        heads = {each.message: each for each in reversed(list(queue.messages()))}
        assert identifier.laxity == min(
            min(_laxity(each, now) for each in queue.messages() if each.message == topic) for topic in heads
        )
        queue.frame_sent(best)
        frames -= 1
        now += step
    assert frames == 0
    assert queue.size == 0


def _laxity(message: QueuedMessage, now: int) -> int:
    return rtcan.NRT if message.deadline == NEVER else rtcan.srt_laxity(message.deadline - now)


# The recordings

FIRST_COME = {
    # The original takes messages in the order in which they came, or came back after each fragment: neither the
    # deadline nor the message counts. Here the expected order of (message, fragments left).
    "queue_edf_order": "a0 c0 b0",
    "queue_deadline_wrap_bug": "x0 b0 a0",
    "queue_not_preempted_by_later": "a2 a1 a0 l0",
    "queue_equal_deadline_fragments_interleave": "a2 a1 a0 b2 b1 b0",
    "queue_equal_deadline_three_interleave": "a2 a1 a0 b1 b0 c2 c1 c0",
}
ERROR_ENDS_IT = {"queue_txerror_first"}  # the original gives a message up at its first bus error; we try again


class Replay:
    """The steps of a recording, on a queue with one mailbox."""

    def __init__(self) -> None:
        self.queue = LaxityQueue()
        self.now = 0
        self.messages: dict[str, tuple[int, bytes]] = {}
        self.pending: QueuedMessage | None = None
        self.frames: list[tuple[int, rtcan.Frame]] = []
        self.remaining: list[int] = []
        """Whole ms to the deadline, of each frame."""

    def run(self, case: CanCase) -> list[tuple[int, rtcan.Frame]]:
        for number, step in enumerate(case.steps):
            getattr(self, f"_{step.verb}")(*step.words)
            if self.pending is None:
                self._next(number)
        return self.frames

    def _next(self, step: int) -> None:
        self.pending = self.queue.best(self.now)
        if self.pending is not None:
            self.remaining.append((self.pending.deadline - self.now) // MS)
            self.frames.append((step, self.queue.next_frame(self.pending, self.now)))

    def _time(self, time: str) -> None:
        self.now = int(time, 0) * MS

    def _adv(self, time: str) -> None:
        self.now += int(time, 0) * MS

    def _msg(self, name: str, message: str, data: str, *_: str) -> None:
        self.messages[name] = int(message, 0), payload(data)

    def _tx(self, name: str, timeout: str) -> None:
        signed = (int(timeout) + (1 << 31)) % (1 << 32) - (1 << 31)
        message, data = self.messages[name]
        self.queue.put(QueuedMessage(message, data, self.now + signed * MS, drop=False))

    def _txok(self) -> None:
        assert self.pending is not None
        self.queue.frame_sent(self.pending)
        self.pending = None

    def _alst(self) -> None:
        assert self.pending is not None
        self.queue.put_back(self.pending)
        self.pending = None

    _terr = _alst

    def _init(self, *_: str) -> None:
        pass

    _start = _stat = _drv = _init


@pytest.mark.golden
@pytest.mark.parametrize("case", can_cases("srt", "srt-laxity", "srt-queue"), ids=str)
def test_recorded_queue(case: CanCase) -> None:
    replay = Replay()
    frames = replay.run(case)
    if case.name in FIRST_COME:
        names = {message: name for name, (message, _) in replay.messages.items()}
        parts = [rtcan.decode_identifier(frame.id) for _, frame in frames]
        assert " ".join(f"{names[each.message_id]}{each.left}" for each in parts) == FIRST_COME[case.name]
        assert sorted(frame.data for _, frame in frames) == sorted(sent.frame.data for sent in case.sent)
        return
    if case.name in ERROR_ENDS_IT:
        frames = frames[: len(case.sent)]
    assert [(step, frame.id & 0x7FFFFF, frame.data) for step, frame in frames] == [
        (sent.step, sent.frame.id & 0x7FFFFF, sent.frame.data) for sent in case.sent
    ]
    for (_, frame), remaining, sent in zip(frames, replay.remaining, case.sent, strict=False):
        recorded = sent.frame.id >> 23
        if 1 <= remaining <= 62:
            assert frame.id >> 23 == recorded == remaining
        else:  # the original's is that of HRT (64 and 0 ms left) or of NRT (overdue, and 63 ms or more)
            assert recorded in (rtcan.HRT, rtcan.NRT)
            assert frame.id >> 23 == min(max(remaining, 1), 62)


def discovery(remaining: float, size: int = 1, floor: int = DISCOVERY) -> QueuedMessage:
    return QueuedMessage(1, bytes(size), NOW + int(remaining * MS), drop=False, floor=floor)


def test_overdue_discovery_is_behind_what_is_nearly_overdue() -> None:
    queue = filled(srt(2, 3.9), srt(3, 4.5), srt(4, 5.5))
    assert queue.put(discovery(-3), management=True)
    assert drain(queue) == [(2, 3, 0), (1, 4, 0), (3, 4, 0), (4, 5, 0)]


def test_urgent_management_takes_discovery_before_it_along() -> None:
    queue = filled()
    assert queue.put(discovery(-3, size=16), management=True)
    started = queue.best(NOW)
    assert started is not None
    assert rtcan.laxity_of(queue.next_frame(started, NOW).id) == DISCOVERY
    queue.frame_sent(started)
    assert queue.put(QueuedMessage(1, bytes(1), NOW, drop=False), urgent=True, management=True)
    assert drain(queue) == [(1, 1, 0), (1, 1, 0)]
    assert queue.put(discovery(-3), management=True)
    assert drain(queue) == [(1, DISCOVERY, 0)]


def test_starved_discovery_gets_the_bus_from_events_that_are_not_dropped() -> None:
    queue = filled(srt(2, -2900, drop=False))
    assert queue.put(discovery(-1999), management=True)
    assert [message for message, _, _ in drain(queue)] == [2, 1]
    queue = filled(srt(2, -2900, drop=False))
    assert queue.put(discovery(-2001), management=True)
    assert drain(queue) == [(1, 1, 0), (2, 1, 0)]


def test_management_goes_by_its_least_laxity_before_its_deadline() -> None:
    """What was said long ago is overdue, but a request for slots is before it, and a presence between the two."""
    queue = filled()
    assert queue.put(discovery(-900, size=16), management=True)
    started = queue.best(NOW)
    assert started is not None
    queue.next_frame(started, NOW)
    assert queue.put(discovery(-800, size=2), management=True)
    assert queue.put(discovery(49, size=3, floor=PRESENCE), urgent=True, management=True)
    assert queue.put(discovery(9, size=4, floor=REQUEST), urgent=True, management=True)
    assert queue.put(discovery(9, size=5, floor=1), urgent=True, management=True)
    queue.frame_sent(started)
    assert [len(each.payload) for each in queue.messages()] == [16, 5, 4, 3, 2]


def test_starved_discovery_goes_before_others_no_faster_than_it_may() -> None:
    queue = filled()
    queue.starved_apart = 500 * MS
    for size in range(1, 5):
        assert queue.put(discovery(-2001, size), management=True)
    laxities = []
    for at in range(0, 1000, 250):
        message = queue.best(NOW + at * MS)
        assert message is not None
        laxities.append(rtcan.laxity_of(queue.next_frame(message, NOW + at * MS).id))
        queue.frame_sent(message)
    assert laxities == [1, DISCOVERY, 1, DISCOVERY]


def test_a_queue_full_of_discovery_has_room_for_what_is_urgent() -> None:
    queue = LaxityQueue(depth=2)
    assert [queue.put(discovery(50), management=True) for _ in range(3)] == [True, True, False]
    assert [queue.put(discovery(10, floor=1), urgent=True, management=True) for _ in range(3)] == [True, True, False]
