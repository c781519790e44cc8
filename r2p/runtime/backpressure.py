"""Room: what takes samples, who waits for a free place in it, and in which order they get one.

Two lines before each place, both first come first served: events and periods get a free place before messages that do
not expire. Whoever has places serves the lines as soon as one is free; so while somebody waits there is none, and
nobody can slip in.
"""

import abc
from collections import deque
from typing import TYPE_CHECKING

from r2p.runtime.sample import PublisherClass, Sample

if TYPE_CHECKING:
    from collections.abc import Callable


LINK_DOWN = "link down"
"""Why samples for a link are lost while it is down: its publishers were told when that began."""

INTERNAL_ERROR = "internal error"
"""Why something is lost whose handling raised what it never should."""


NO_ROOM = "no room"
"""Why a sample is lost that does not wait, or waits no longer."""

CANCELLED = "publish cancelled"
"""Why a sample is lost whose `publish()` was cancelled while it waited for room."""

GIVEN_UP = "given up by its publisher"
"""Why a link lacks a sample that its publisher kept until it was stale, or too many waited, or it was closed."""


class Sink(abc.ABC):
    """What takes samples: a subscriber's queue, or a link's send buffer."""

    __slots__ = ("lost", "waits")

    def __init__(self) -> None:
        self.lost = 0
        self.waits = True
        """Whether publishers wait for room in it; False while it is considered lossy."""

    @property
    @abc.abstractmethod
    def owner(self) -> str:
        """The name of its node or link."""

    @property
    def reachable(self) -> bool:
        """Whether it can take anything at all."""
        return True

    @abc.abstractmethod
    def offer(self, sample: Sample) -> bool:
        """Take the sample if there is room."""

    @abc.abstractmethod
    def force(self, sample: Sample) -> None:
        """Take the sample even without room, losing and counting one."""

    def count_lost(self, reason: str) -> None:
        """Count a sample that waited for room and does not any more; links count it by reason, too."""
        self.lost += 1

    @abc.abstractmethod
    def wait_queue(self) -> "WaitQueue":
        """Those who wait for room in it."""

    @abc.abstractmethod
    def refill(self) -> None:
        """Give them what room there is."""

    def offer_latched(self, sample: Sample) -> None:
        """Take a value that its publisher latches: as soon as there is room."""
        room = self.wait_queue()
        if not self.reachable:
            self.force(sample)
        elif room.queue_of(sample) or not self.offer(sample):
            room.enqueue_latched(self, sample)

    def become_lossy(self, refusal: str) -> None:
        """It made no room in time: lossy until it has."""
        self.waits = False
        self.wait_queue().reject(self, refusal)
        self.wait_queue().recoveries.append(self._recover)

    def _recover(self) -> None:
        self.waits = True


class PendingDelivery(abc.ABC):
    """A sample that waits for room in some sinks."""

    __slots__ = ("remaining", "sample")

    def __init__(self, sample: Sample, sinks: list[Sink]) -> None:
        self.sample = sample
        self.remaining = sinks
        """Who has not got it yet."""
        for sink in sinks:
            sink.wait_queue().add(sink, self)

    @abc.abstractmethod
    def completed(self, sink: Sink, refusal: str) -> None:
        """The sink has got it, or lost it (counted there) for the reason `refusal`."""

    def complete(self, sink: Sink, refusal: str = "") -> None:
        """The sink has got it or lost it."""
        if sink in self.remaining:  # else somebody who was told of another one has withdrawn it
            self.remaining.remove(sink)
            self.completed(sink, refusal)

    def withdraw(self) -> list[Sink]:
        """Wait no more; says who has not got it."""
        without, self.remaining = self.remaining, []
        for sink in without:
            sink.wait_queue().remove(sink, self)
        return without


class _LatchedDelivery(PendingDelivery):
    """A latched value on its way to somebody who has joined."""

    __slots__ = ()

    def completed(self, sink: Sink, refusal: str) -> None:
        """Nobody waits for it."""


_Line = deque[tuple[Sink, PendingDelivery]]


class WaitQueue:
    """The lines before one place; several sinks may share it."""

    __slots__ = ("deliveries", "events", "recoveries")

    def __init__(self) -> None:
        self.events: _Line = deque()
        self.deliveries: _Line = deque()
        self.recoveries: list[Callable[[], None]] = []
        """What to call when there is plenty of room: from those who went on without waiting."""

    def __bool__(self) -> bool:
        return bool(self.events or self.deliveries or self.recoveries)

    def queue_of(self, sample: Sample) -> _Line:
        """The line in which such a sample waits."""
        return self.deliveries if sample.publisher_class == PublisherClass.NON_REAL_TIME else self.events

    def add(self, sink: Sink, claim: PendingDelivery) -> None:
        self.queue_of(claim.sample).append((sink, claim))

    def enqueue_latched(self, sink: Sink, sample: Sample) -> None:
        """A latched value waits, too; of one publisher only the last."""
        for each, claim in self.queue_of(sample):
            if each is sink and isinstance(claim, _LatchedDelivery) and claim.sample.source == sample.source:
                claim.sample = sample
                return
        _LatchedDelivery(sample, [sink])

    def remove(self, sink: Sink, claim: PendingDelivery) -> None:
        line = self.queue_of(claim.sample)
        if (sink, claim) in line:
            line.remove((sink, claim))

    def serve(self) -> None:
        """There may be room for some."""
        for line in (self.events, self.deliveries):
            while line:
                first = line.popleft()
                sink, claim = first
                try:
                    taken = sink.offer(claim.sample)
                except Exception:
                    claim.complete(sink, INTERNAL_ERROR)  # nothing else would ever end the wait
                    raise
                if not taken:
                    line.appendleft(first)
                    break
                claim.complete(sink)

    def recover(self) -> None:
        """There is plenty of room."""
        recoveries, self.recoveries = self.recoveries, []
        for callback in recoveries:
            callback()

    def drop_sink(self, sink: Sink) -> None:
        """Nobody is behind this sink any more: nobody lacks what waits for it."""
        for line in (self.events, self.deliveries):
            for claim in _take(line, sink):
                claim.complete(sink)

    def reject(self, sink: Sink, refusal: str) -> None:
        """No room in this sink for messages that do not expire: it loses those that wait, or older ones."""
        for claim in _take(self.deliveries, sink):
            sink.force(claim.sample)
            claim.complete(sink, refusal)

    def pop_earlier(self, sink: Sink, sample: Sample) -> list[PendingDelivery]:
        """Take out what waits for this sink, and its publisher has published before this sample."""
        line = self.queue_of(sample)
        earlier = [
            claim
            for each, claim in line
            if each is sink and claim.sample.source is sample.source and claim.sample.sequence < sample.sequence
        ]
        for claim in earlier:
            line.remove((sink, claim))
        return earlier

    def reject_all(self, refusal: str) -> None:
        """No room for anything."""
        for line in (self.events, self.deliveries):
            while line:
                sink, claim = line.popleft()
                sink.force(claim.sample)
                claim.complete(sink, refusal)


def _take(line: _Line, sink: Sink) -> list[PendingDelivery]:
    """Take out of the line what waits for this sink."""
    taken = [claim for each, claim in line if each is sink]
    if taken:
        rest = [entry for entry in line if entry[0] is not sink]
        line.clear()
        line.extend(rest)
    return taken
