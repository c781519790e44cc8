"""Periodic: never waits; is asked for a message at every period, which is missed where there is no room in it."""

from typing import Generic

from r2p.clock import Ticker
from r2p.messages import Layout
from r2p.runtime.backpressure import GIVEN_UP, NO_ROOM, PendingDelivery, Sink
from r2p.runtime.publishers.base import BasePublisher, M, where
from r2p.runtime.qos import Missed, Periodic
from r2p.runtime.sample import PublisherClass, Sample
from r2p.runtime.topic import EndpointOwner, SlotPublisher, SubscriberQueue, Topic, TopicSpace

_SECOND = 1_000_000_000
_LATE_SHARE = 2  # a period is late when it is off by more than half of it


class PeriodicPublisher(BasePublisher[M], SlotPublisher):
    """A time-triggered publisher: it has no publish(), its class's `fill` is asked at every period."""

    publisher_class = PublisherClass.PERIODIC

    def __init__(
        self,
        space: TopicSpace,
        node: EndpointOwner,
        topic: Topic,
        layout: Layout[M],
        klass: Periodic[M],
        *,
        latch: bool,
    ) -> None:
        super().__init__(space, node, topic, layout, latch=latch)
        self.period = klass.period
        self.skipped = 0
        """Periods that passed without a message because the loop was busy."""
        self.lead = klass.lead
        self._fill = klass.fill
        self._on_missed = klass.on_missed
        self._on_late = klass.on_late
        self._on_degraded = klass.on_degraded
        self._own_period = klass.period
        self._slot_link: object = None
        self._waiting: _PeriodDelivery[M] | None = None
        self._ticker = Ticker(space.loop, round(klass.period * _SECOND), self.tick, background=True)

    def start(self) -> None:
        """Start the clock: the first message follows one period later."""
        self._ticker.start()

    def silence(self) -> None:
        """Ask for no message any more: the node ends."""
        self._ticker.close()

    def close(self) -> None:
        self._ticker.close()
        self._slot_link = None
        super().close()
        self._give_up("publisher closed")

    def use_slot_clock(self, slot_link: object, period: float) -> bool:
        """A link whose slots are the clock calls `tick` from now on, each `period` seconds; again: another period.

        False if another link does already, or the publisher is closed.
        """
        if self._slot_link not in (None, slot_link) or self not in self._topic.publishers:
            return False
        self._slot_link = slot_link
        self.period = period
        self._ticker.close()
        return True

    def use_own_clock(self, slot_link: object) -> None:
        """That link does not any more: the publisher's own clock goes on, at the period that was asked for."""
        if self._slot_link is slot_link:
            self._slot_link = None
            self.period = self._own_period
            if not self.node.ending:
                self._ticker.start()

    def tick(self, scheduled: int, late: int, skipped: int) -> Sample | None:
        """One period: due at `scheduled` (monotonic ns), `late` by ns, after so many `skipped` ones.

        Local queues and all other links get the message from here; the link of the slots gets it as the result. None:
        there is no message.
        """
        self._give_up(NO_ROOM)
        if self._encode == self._closed or self.node.ending:
            return None
        if skipped or late > self.period * _SECOND / _LATE_SHARE:
            self.late += 1
            self.skipped += skipped
            reason = f"{skipped} period(s) skipped, the next one late" if skipped else "late"
            self._signal(Missed(self.topic, reason, late=late / _SECOND, count=skipped), self._on_late)
        try:
            message = self._fill()
            if message is None or self._encode == self._closed:  # fill may have closed it
                return None
            sample = self._sample(message)
        except Exception as error:  # noqa: BLE001 - the user's code: whatever it raises crashes its node
            self.close()
            self.node.crash(error)
            return None
        blocked = self._topic.deliver(sample, None, self._slot_link)
        if blocked is not None:
            self._not_yet(sample, blocked)
        return sample

    def _not_yet(self, sample: Sample, blocked: list[Sink]) -> None:
        """Queues drop one at once; a link, which may be busy for a moment, has until the next period."""
        queues = [sink for sink in blocked if isinstance(sink, SubscriberQueue)]
        waiting = [sink for sink in blocked if sink not in queues and sink.reachable]
        down = [sink for sink in blocked if sink not in queues and sink not in waiting]
        if waiting:
            self._waiting = _PeriodDelivery(self, sample, waiting, self._clock.monotonic())
        if queues:
            for sink in queues:
                sink.force(sample)
            self._miss(sample.sequence, NO_ROOM, queues)
        if down:
            self._unreachable(sample, down)

    def delivery_completed(self, waited: "_PeriodDelivery[M]", sink: Sink, refusal: str) -> None:
        """A link has got a sample that waited, or lost it."""
        late = self._clock.monotonic() - waited.since
        if refusal:
            self._miss(waited.sample.sequence, refusal, [sink])
        elif late > self.period * _SECOND / _LATE_SHARE:
            self.late += 1
            self._signal(Missed(self.topic, "sent late", where([sink]), late / _SECOND), self._on_late)

    def _give_up(self, reason: str) -> None:
        """What still waits is stale."""
        waited, self._waiting = self._waiting, None
        without = waited.withdraw() if waited is not None else []
        if waited is not None and without:
            for sink in without:
                sink.count_lost(GIVEN_UP)
            self._miss(waited.sample.sequence, reason, without)


class _PeriodDelivery(PendingDelivery, Generic[M]):
    """A sample that waits for links until the next period; `since` is monotonic ns."""

    __slots__ = ("publisher", "since")

    def __init__(self, publisher: PeriodicPublisher[M], sample: Sample, sinks: list[Sink], since: int) -> None:
        self.publisher = publisher
        self.since = since
        super().__init__(sample, sinks)

    def completed(self, sink: Sink, refusal: str) -> None:
        self.publisher.delivery_completed(self, sink, refusal)
