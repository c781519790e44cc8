"""Backpressure: publishers and links wait while a subscriber's queue or a link's send buffer is full.

A `Sink` accepts samples: the queue of a subscriber, or one topic on its way out by a link. A publisher or a link that
finds the sink full, and may wait, leaves a `PendingDelivery` in the sink's `WaitQueue`. A place that becomes free goes
to that queue at once. So while anything waits there is no free place, and nothing published later can overtake it.

Each wait queue has two lines, both first come, first served: samples that expire get a place before those that do not.
"""

import abc
from collections import deque
from typing import TYPE_CHECKING

from r2p.runtime.sample import PublisherClass, Sample

if TYPE_CHECKING:
    from collections.abc import Callable

# Why samples are lost: the reasons in `Missed` and in the counters of links.

NO_ROOM = "no room"
"""No room for a sample that does not wait, or no longer."""

LINK_DOWN = "link down"
"""A sample for a link came while the link was down; its publishers were informed when that began."""

CANCELLED = "publish cancelled"
"""The `publish()` of a sample was cancelled while it waited for room."""

GIVEN_UP = "given up by its publisher"
"""A publisher kept a sample for a link until it was stale, or too many waited, or the publisher was closed."""

INTERNAL_ERROR = "internal error"
"""The handling of a sample raised an unexpected exception."""


class Sink(abc.ABC):
    """Accepts samples: the queue of a subscriber, or one topic on its way out by a link."""

    __slots__ = ("blocks_publishers", "lost")

    def __init__(self) -> None:
        self.lost = 0
        self.blocks_publishers = True
        """True if publishers wait while the sink is full; False while it is considered lossy."""

    @property
    @abc.abstractmethod
    def owner(self) -> str:
        """The name of the sink's node or link."""

    @property
    def reachable(self) -> bool:
        """Return whether the sink can accept anything at all."""
        return True

    @abc.abstractmethod
    def offer(self, sample: Sample) -> bool:
        """Accept the sample, if there is room."""

    @abc.abstractmethod
    def force(self, sample: Sample) -> None:
        """Accept the sample even without room; then one sample is lost, and counted."""

    def count_lost(self, reason: str) -> None:
        """Count a sample whose wait was given up; links also count it by reason."""
        self.lost += 1

    @abc.abstractmethod
    def get_wait_queue(self) -> "WaitQueue":
        """Return the queue of deliveries that wait for room in the sink."""

    @abc.abstractmethod
    def refill(self) -> None:
        """Give free room to waiting deliveries."""

    def offer_in_order(self, sample: Sample) -> bool:
        """Accept the sample, if there is room and no earlier one waits for it."""
        return not self.get_wait_queue().line_of(sample) and self.offer(sample)

    def offer_latched(self, sample: Sample) -> None:
        """Accept a value that its publisher latches, as soon as there is room."""
        if not self.reachable:
            self.force(sample)
        elif not self.offer_in_order(sample):
            self.get_wait_queue().add_latched(self, sample)

    def become_lossy(self, reason: str) -> None:
        """Stop making publishers wait until there is plenty of room again, as the sink made none in time."""
        self.blocks_publishers = False
        self.get_wait_queue().reject(self, reason)
        self.get_wait_queue().recoveries.append(self._recover)

    def _recover(self) -> None:
        self.blocks_publishers = True


class PendingDelivery:
    """A sample that waits for room in some sinks."""

    __slots__ = ("remaining", "sample")

    def __init__(self, sample: Sample, sinks: list[Sink]) -> None:
        self.sample = sample
        self.remaining = sinks
        """The sinks that do not have the sample yet."""
        for sink in sinks:
            sink.get_wait_queue().add(sink, self)

    def on_completed(self, sink: Sink, reason: str) -> None:
        """Handle that the sink has the sample, or has lost and counted it for this reason."""

    def complete(self, sink: Sink, reason: str = "") -> None:
        """Take the sink off the list: it has the sample, or has lost it for this reason."""
        if sink in self.remaining:  # a callback of another sink may have withdrawn the delivery meanwhile
            self.remaining.remove(sink)
            self.on_completed(sink, reason)

    def withdraw(self) -> list[Sink]:
        """Stop waiting; return the sinks that do not have the sample."""
        without, self.remaining = self.remaining, []
        for sink in without:
            sink.get_wait_queue().remove(sink, self)
        return without

    def drop_remaining(self, loss: str) -> list[Sink]:
        """Stop waiting, and let the remaining sinks count the sample as lost for this reason; return these sinks."""
        without = self.withdraw()
        for sink in without:
            sink.count_lost(loss)
        return without


class _LatchedDelivery(PendingDelivery):
    """A latched value on its way to a new subscriber; the publisher does not wait for it."""

    __slots__ = ()


_Line = deque[tuple[Sink, PendingDelivery]]


class WaitQueue:
    """The deliveries that wait for places in one or several sinks."""

    __slots__ = ("non_real_time", "real_time", "recoveries")

    def __init__(self) -> None:
        self.real_time: _Line = deque()
        self.non_real_time: _Line = deque()
        self.recoveries: list[Callable[[], None]] = []
        """Callbacks for publishers that went on without waiting, until there is plenty of room."""

    def __bool__(self) -> bool:
        return bool(self.real_time or self.non_real_time or self.recoveries)

    def line_of(self, sample: Sample) -> _Line:
        """Return the line in which such a sample waits."""
        return self.non_real_time if sample.publisher_class == PublisherClass.NON_REAL_TIME else self.real_time

    def add(self, sink: Sink, delivery: PendingDelivery) -> None:
        self.line_of(delivery.sample).append((sink, delivery))

    def add_latched(self, sink: Sink, sample: Sample) -> None:
        """Let a latched value wait, too; only the last one of each publisher."""
        for each, delivery in self.line_of(sample):
            if each is sink and isinstance(delivery, _LatchedDelivery) and delivery.sample.source == sample.source:
                delivery.sample = sample  # at its place in the line
                return
        _LatchedDelivery(sample, [sink])

    def remove(self, sink: Sink, delivery: PendingDelivery) -> None:
        line = self.line_of(delivery.sample)
        if (sink, delivery) in line:
            line.remove((sink, delivery))

    def serve(self) -> None:
        """Hand out free room, in order."""
        for line in (self.real_time, self.non_real_time):  # what expires comes first
            while line:
                first = line.popleft()
                sink, delivery = first
                try:
                    accepted = sink.offer(delivery.sample)
                except Exception:  # raised again: the link, or the reader, that serves counts it
                    delivery.complete(sink, INTERNAL_ERROR)  # nothing else would ever end the wait
                    raise
                if not accepted:
                    line.appendleft(first)
                    break
                delivery.complete(sink)

    def recover(self) -> None:
        """Inform publishers that went on without waiting that there is plenty of room."""
        recoveries, self.recoveries = self.recoveries, []  # first: a callback may bring about that one registers again
        for callback in recoveries:
            callback()

    def drop_sink(self, sink: Sink) -> None:
        """Complete all deliveries to this sink without a loss: there are no subscribers behind it now."""
        for line in (self.real_time, self.non_real_time):
            for delivery in _pop(line, sink):
                delivery.complete(sink)

    def reject(self, sink: Sink, reason: str) -> None:
        """Force samples that do not expire into this sink, which loses these, or older ones, for this reason."""
        for delivery in _pop(self.non_real_time, sink):
            sink.force(delivery.sample)
            delivery.complete(sink, reason)

    def reject_all(self, reason: str) -> None:
        """Force all samples into their sinks, which lose some for this reason."""
        for line in (self.real_time, self.non_real_time):
            while line:  # one by one: a completion may make its publisher publish, and that is rejected, too
                sink, delivery = line.popleft()
                sink.force(delivery.sample)
                delivery.complete(sink, reason)

    def pop_earlier(self, sink: Sink, sample: Sample) -> list[PendingDelivery]:
        """Remove and return the publisher's earlier samples that wait for this sink."""
        line = self.line_of(sample)
        earlier = [
            delivery
            for each, delivery in line
            if each is sink and delivery.sample.source is sample.source and delivery.sample.sequence < sample.sequence
        ]
        for delivery in earlier:
            line.remove((sink, delivery))
        return earlier


def _pop(line: _Line, sink: Sink) -> list[PendingDelivery]:
    """Remove and return the deliveries in the line that wait for this sink."""
    popped = [delivery for each, delivery in line if each is sink]
    if popped:
        rest = [entry for entry in line if entry[0] is not sink]
        line.clear()  # in place: `serve` may be in the middle of this line
        line.extend(rest)
    return popped
