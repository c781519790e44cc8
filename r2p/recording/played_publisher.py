"""Publishers of a recording, as this module has them while it plays: the same class, and packed bytes as they were.

They never hold up what is played after them. A subscriber without room gets a message later, as long as its class says:
non real-time for a second, sporadic until the deadline, periodic until the next one; what it does not get is counted in
`missed`.
"""

import itertools
import math
from collections import Counter, deque

from r2p.clock import Alarm
from r2p.runtime.backpressure import GIVEN_UP, LINK_DOWN, NO_ROOM, PendingDelivery, Sink
from r2p.runtime.node import Node
from r2p.runtime.queues import EndpointOwner, SubscriberQueue
from r2p.runtime.sample import PublisherClass, Sample, Source
from r2p.runtime.topic import SlotPublisher, Topic, TopicSpace
from r2p.units import SECOND

_STALL = SECOND  # ns for which a non real-time message waits for room, as those of programs do
_PENDING_MAX = 256  # messages of one publisher that wait; one more gives up the oldest
_UNKNOWN_DEADLINE = SECOND // 20  # ns, as of firmware; for a sporadic message without one
_SLOT_QUEUE = 2  # messages that wait for their slots: those of the recording have another phase
_NRT, _PERIODIC = PublisherClass.NON_REAL_TIME, PublisherClass.PERIODIC


class PlayedPublisher:
    """One publisher of the recording, as a node of this module. A `PublisherHandle` of its topic."""

    def __init__(
        self, space: TopicSpace, node: Node, topic: Topic, publisher_class: PublisherClass, *, latch: bool
    ) -> None:
        """Publish a topic that is open; links announce it at once."""
        self.node: EndpointOwner = node
        self.source = Source(space.module, node.name)
        """The source of its messages."""
        self.publisher_class = publisher_class
        self.latch = latch
        self.sent = 0
        """Messages that were played; the sequence number of the last one."""
        self.missed: Counter[str] = Counter()
        """Messages that did not reach every subscriber, by reason."""
        self.topic = topic
        self._space = space
        self._clock = space.clock
        self._last: Sample | None = None
        self._pending: deque[_PlayedDelivery] = deque()
        self._alarm = Alarm(space.loop, self._overdue)
        self._closed = False
        topic.publishers.append(self)
        for queue in topic.queues:
            queue.publisher_joined()
        space.changed(topic)

    @property
    def waiting(self) -> bool:
        """Whether messages wait for room."""
        return bool(self._pending)

    def play(self, sample: Sample) -> None:
        """Publish a sample that has its number (`sent`) and its stamp."""
        if self.latch:
            self._last = sample
        if self.publisher_class is _PERIODIC:
            self._give_up_all(NO_ROOM)
        blocked = self._deliver(sample)
        if blocked is not None:
            self._deliver_later(sample, blocked)

    def close(self) -> None:
        """Stop publishing; the links inform their peers."""
        if not self._closed:
            self._closed = True
            self._give_up_all("the end of playing")
            self._alarm.close()
            self.topic.publishers.remove(self)
            self._space.release(self.topic)

    def _deliver(self, sample: Sample) -> list[Sink] | None:
        return self.topic.deliver(sample, self.node)

    # For the topic and its links

    def subscriber_joined(self, sink: Sink) -> None:
        """Send a latched value."""
        if self._last is not None:
            sink.offer_latched(self._last)

    def link_degraded(self, link: str, reason: str) -> None:
        """Ignore the loss of a link: the link logs it itself."""

    def link_missed(self, link: str, reason: str, late: float = 0.0, sequence: int = 0) -> None:
        """Count a message that a link gave up."""
        self.missed[reason] += 1

    def link_late(self, link: str, reason: str, late: float = 0.0) -> None:
        """Count a message that a link sent after its deadline."""
        self.missed[reason] += 1

    # Messages that wait for room

    def _deliver_later(self, sample: Sample, blocked: list[Sink]) -> None:
        waiting = [sink for sink in blocked if self._may_wait(sink)]
        lost = [sink for sink in blocked if sink not in waiting and self._loses(sink, sample)]
        if lost:
            self.missed[NO_ROOM if any(sink.reachable for sink in lost) else LINK_DOWN] += 1
        if waiting:
            self._pending.append(
                _PlayedDelivery(self, sample, waiting, self._clock.monotonic() + self._waiting_time(sample))
            )
            if len(self._pending) > _PENDING_MAX:
                self._expire(self._pending[0])
            self._arm()

    def _may_wait(self, sink: Sink) -> bool:
        if not sink.reachable or (self.publisher_class is _PERIODIC and isinstance(sink, SubscriberQueue)):
            return False
        return sink.blocks_publishers or self.publisher_class is not _NRT

    def _loses(self, sink: Sink, sample: Sample) -> bool:
        lost = sink.lost
        sink.force(sample)
        return sink.lost > lost

    def _waiting_time(self, sample: Sample) -> int:
        """Return for how long a message waits for room (ns)."""
        if self.publisher_class is _NRT:
            return _STALL
        return max(0, sample.due - self._clock.now()) if sample.deadline else _UNKNOWN_DEADLINE

    def delivery_completed(self, delivery: "_PlayedDelivery", reason: str) -> None:
        """Note that a sink has a waiting message, or has lost it for this reason."""
        if reason:
            self.missed[reason] += 1
        if not delivery.remaining and delivery in self._pending:
            self._pending.remove(delivery)
            self._arm()

    def _arm(self) -> None:
        self._alarm.set(min((each.until for each in self._pending), default=None))

    def _overdue(self) -> None:
        now = self._clock.monotonic()
        for each in [each for each in self._pending if each.until <= now]:
            self._expire(each)
        self._arm()

    def _expire(self, delivery: "_PlayedDelivery") -> None:
        """Give up a message; what does not expire goes into queues that lose an older one for it, as live."""
        if delivery not in self._pending:
            return
        if self.publisher_class is _NRT:
            for sink in list(delivery.remaining):
                sink.become_lossy(f"no room for {_STALL / SECOND:g} s")
        else:
            self._give_up(delivery, "no room by the deadline")

    def _give_up(self, delivery: "_PlayedDelivery", reason: str) -> None:
        self._pending.remove(delivery)
        if delivery.drop_remaining(GIVEN_UP):
            self.missed[reason] += 1

    def _give_up_all(self, reason: str) -> None:
        while self._pending:
            self._give_up(self._pending[0], reason)


class PlayedPeriodic(PlayedPublisher, SlotPublisher):
    """A periodic publisher of the recording: on a bus with slots, its messages wait for those; `period` in seconds.

    The slots are those of this bus, and not those of the recording: a message is up to a period later.
    """

    lead = 0.0005

    def __init__(self, space: TopicSpace, node: Node, topic: Topic, *, latch: bool, period: float) -> None:
        self.period = period
        self._slot_link: object = None
        self._for_slots: deque[Sample] = deque()
        super().__init__(space, node, topic, _PERIODIC, latch=latch)

    @property
    def size(self) -> int:
        return self.topic.unnamed_type.size if self.topic.layout is None else self.topic.layout.size

    @property
    def varies(self) -> bool:
        return self.topic.unnamed_type.varies if self.topic.layout is None else self.topic.layout.varies

    def use_slot_clock(self, slot_link: object, period: float) -> bool:
        if self._slot_link not in (None, slot_link) or self._closed:
            return False
        self._slot_link = slot_link
        return True

    def use_own_clock(self, slot_link: object) -> None:
        if self._slot_link is slot_link:
            self._slot_link = None
            self._for_slots.clear()

    def tick(self, scheduled: int, late: int, skipped: int) -> Sample | None:
        return self._for_slots.popleft() if self._for_slots else None

    def _deliver(self, sample: Sample) -> list[Sink] | None:
        if self._slot_link is not None:
            if len(self._for_slots) >= _SLOT_QUEUE:
                self._for_slots.popleft()
                self.missed["no slot"] += 1
            self._for_slots.append(sample)
        return self.topic.deliver(sample, self.node, self._slot_link)


class _PlayedDelivery(PendingDelivery):
    """A message that waits for room; `until` is monotonic ns."""

    __slots__ = ("publisher", "until")

    def __init__(self, publisher: PlayedPublisher, sample: Sample, sinks: list[Sink], until: int) -> None:
        self.publisher = publisher
        self.until = until
        super().__init__(sample, sinks)

    def on_completed(self, sink: Sink, reason: str) -> None:
        self.publisher.delivery_completed(self, reason)


def period_of(times: list[int]) -> float:
    """Return the period of messages that were recorded at these times (ns), in seconds; 0.0 if it is unknown.

    The median: some may be lost, and others late.
    """
    between = sorted(after - before for before, after in itertools.pairwise(times))
    period = between[len(between) // 2] / SECOND if between else 0.0
    return period if math.isfinite(period) and period > 0 else 0.0
