"""Sporadic: never waits; a message that is not in every queue and on every link by its deadline is missed."""

from typing import Any, Generic

from r2p.clock import Alarm
from r2p.messages import Layout
from r2p.runtime.backpressure import GIVEN_UP, PendingDelivery, Sink
from r2p.runtime.publishers.base import BasePublisher, M, where
from r2p.runtime.qos import Missed, SignalKind, Sporadic
from r2p.runtime.queues import YIELD_EVERY, EndpointOwner, checkpoint
from r2p.runtime.sample import PublisherClass, Sample
from r2p.runtime.topic import Topic, TopicSpace
from r2p.units import SECOND

_TOO_LATE = "no room by the deadline"


class SporadicPublisher(BasePublisher[M, Sporadic]):
    """A publisher of events that are due by a deadline: `publish()` never waits.

    Made by `Node.advertise` with `Sporadic`.
    """

    publisher_class = PublisherClass.SPORADIC

    def __init__(
        self, space: TopicSpace, node: EndpointOwner, topic: Topic, layout: Layout[M], klass: Sporadic, *, latch: bool
    ) -> None:
        super().__init__(space, node, topic, layout, klass, latch=latch)
        self._deadline = round(klass.deadline * SECOND)
        self._pending: list[_EventDelivery[M]] = []
        self._alarm = Alarm(space.loop, self._overdue)

    @property
    def lifespan(self) -> int:
        """Ns after which a message that has not gone is dropped; 0: it goes late."""
        return self._deadline if self._class.late == "drop" else 0

    async def publish(self, message: M) -> None:
        """Publish an event; return at once, also while a queue has no room for it.

        Raises MessageError for a message that does not fit the type, and Closed once the publisher is closed.
        """
        self.publish_nowait(message)
        self._until_yield -= 1
        if self._until_yield <= 0:
            self._until_yield = YIELD_EVERY
            await checkpoint()

    def publish_nowait(self, message: M) -> bool:
        """Publish an event, also from a callback. Return False if it waits for room somewhere, or a link is down.

        Raises MessageError for a message that does not fit the type, and Closed once the publisher is closed.
        """
        sample = self._sample(message, self._deadline)
        sample.drop_late = self._class.late == "drop"
        blocked = self._topic.deliver(sample)
        if blocked is None:
            return True
        self._deliver_later(sample, blocked, self._deadline)
        return False

    def close(self) -> None:
        super().close()
        while self._pending:
            self._give_up(self._pending[0], "publisher closed")
        self._alarm.close()

    def follow(self, other: BasePublisher[Any, Any]) -> None:
        """Go on where another publisher ends, also with the events that wait for room."""
        super().follow(other)
        if isinstance(other, SporadicPublisher):
            self._pending = [*other.release_pending(), *self._pending]
            for event in self._pending:
                event.publisher = self
            self._arm()

    def release_pending(self) -> "list[_EventDelivery[Any]]":
        """Return the events that wait for room, for another publisher to wait on."""
        pending, self._pending = self._pending, []
        return pending

    def _deliver_later(self, sample: Sample, blocked: list[Sink], lifetime: int) -> None:
        """Let the sample wait for room for `lifetime` (ns); what is behind links that are down misses it."""
        reachable = [sink for sink in blocked if sink.reachable]
        if reachable:
            self._wait(_EventDelivery(self, sample, reachable, self._clock.monotonic() + lifetime))
        if len(reachable) < len(blocked):
            self._miss_unreachable(sample, [sink for sink in blocked if sink not in reachable])

    def _wait(self, event: "_EventDelivery[M]") -> None:
        self._pending.append(event)
        if len(self._pending) > self._class.pending:
            self._give_up(self._pending[0], "too many wait")  # the oldest: it is due first, and worth least
        self._arm()

    def delivery_completed(self, event: "_EventDelivery[M]", sink: Sink, reason: str) -> None:
        """Note that a sink has a waiting event, or has lost it for this reason."""
        if not event.remaining:
            self._pending.remove(event)
            self._arm()
        if reason:
            self._miss(event.sample.sequence, reason, [sink])

    def _arm(self) -> None:
        self._alarm.set(next((event.due for event in self._pending if not event.overdue), None))

    def _overdue(self) -> None:
        now = self._clock.monotonic()
        for event in [event for event in self._pending if event.due <= now and not event.overdue]:
            if self._class.late == "send":
                event.overdue = True
                self.late += 1
                late = (now - event.due) / SECOND
                self._report(
                    SignalKind.LATE, Missed(self.topic, _TOO_LATE, where(event.remaining), late), self._on_late
                )
            else:
                self._give_up(event, _TOO_LATE)
        self._arm()

    def _give_up(self, event: "_EventDelivery[M]", reason: str) -> None:
        if event in self._pending:  # a callback for an event before it may have closed the publisher
            self._pending.remove(event)
            late = max(0, self._clock.monotonic() - event.due) / SECOND
            self._miss(event.sample.sequence, reason, event.drop_remaining(GIVEN_UP), late)


class _EventDelivery(PendingDelivery, Generic[M]):
    """An event that waits for room; `due` is monotonic ns."""

    __slots__ = ("due", "overdue", "publisher")

    def __init__(self, publisher: SporadicPublisher[M], sample: Sample, sinks: list[Sink], due: int) -> None:
        self.publisher = publisher
        self.due = due
        self.overdue = False
        super().__init__(sample, sinks)

    def on_completed(self, sink: Sink, reason: str) -> None:
        self.publisher.delivery_completed(self, sink, reason)
