"""Periodic: never waits; `fill` is called at every period, and the message is missed without room.

Reports of a miss, all by `_miss` or `_report` of the base:

    tick                 the period began late, or periods were skipped: the event loop was blocked (`on_late`)
    _deliver_later       a subscriber's queue is full (`on_missed`); a full link has until the next period
    _give_up             a link still had no room when that began (`on_missed`)
    delivery_completed   a link had room, but late in the period (`on_late`)
    link_missed          a link accepted the message, and could not send it in its slot (`on_missed`): an RTCAN slot,
                         from `SlottedTopics.completed` in r2p/transports/rtcan/tx.py
    link_degraded        a link, or its slots, are lost (`on_degraded`)
"""

from typing import Any, Generic

from r2p.clock import Ticker
from r2p.errors import MessageError
from r2p.messages import Layout
from r2p.runtime.backpressure import GIVEN_UP, NO_ROOM, PendingDelivery, Sink
from r2p.runtime.publishers.base import BasePublisher, M, where
from r2p.runtime.qos import Missed, Periodic, SignalKind
from r2p.runtime.queues import EndpointOwner, SubscriberQueue
from r2p.runtime.sample import PublisherClass, Sample
from r2p.runtime.topic import SlotPublisher, Topic, TopicSpace
from r2p.units import SECOND

_LATE_SHARE = 2  # a message is late by more than 1/2 of its period: it is nearer to the next one


class PeriodicPublisher(BasePublisher[M, Periodic[M]], SlotPublisher):
    """A time-triggered publisher: it has no `publish()`; the `fill` of its class is called at every period.

    Made by `Node.advertise` with `Periodic`.
    """

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
        super().__init__(space, node, topic, layout, klass, latch=latch)
        self.period = klass.period
        """Seconds; the period of the slots, while a link has slots for the topic."""
        self.skipped = 0
        """Periods that passed without a message because the event loop was blocked."""
        self.lead = klass.lead
        """Seconds before a slot at which `fill` is called."""
        self.due = 0
        """The instant for which the last message was made (monotonic ns); 0: none yet."""
        self.first_due = 0
        """... and the first one."""
        self._slot_link: object = None
        self._pending: _PeriodDelivery[M] | None = None
        self._ticker = Ticker(space.loop, round(klass.period * SECOND), self.tick, background=True)

    def start(self) -> None:
        """Start the clock: the first message is due one period from now."""
        self._ticker.start()

    def silence(self) -> None:
        """Stop the clock for good: the node ends."""
        self._ticker.close()

    def follow(self, other: BasePublisher[Any, Any]) -> None:
        """Go on where another publisher ends, on its phase."""
        super().follow(other)
        if not isinstance(other, PeriodicPublisher):
            self._ticker.start()
            return
        self._ticker.start(other.phase)
        self._pending = other.release_pending()
        if self._pending is not None:
            self._pending.publisher = self

    @property
    def phase(self) -> int:
        """An instant at which a message was due, or would have been (monotonic ns)."""
        return self.due or self._ticker.phase

    def release_pending(self) -> "_PeriodDelivery[Any] | None":
        """Return the message that waits for links, for another publisher to wait on."""
        pending, self._pending = self._pending, None
        return pending

    def close(self) -> None:
        self._ticker.close()
        self._slot_link = None
        super().close()
        self._give_up("publisher closed")

    def use_slot_clock(self, slot_link: object, period: float) -> bool:
        if self._slot_link not in (None, slot_link) or self not in self._topic.publishers:
            return False
        self._slot_link = slot_link
        self.period = period
        self._ticker.close()
        return True

    def use_own_clock(self, slot_link: object) -> None:
        if self._slot_link is slot_link:
            self._slot_link = None
            self.period = self._class.period
            if not self.node.ending:
                self._ticker.start()

    def tick(self, scheduled: int, late: int, skipped: int) -> Sample | None:
        """Publish the message of one period: due at `scheduled` (monotonic ns), `late` by ns, after `skipped` periods.

        Local queues and all other links get the message from here; the link of the slots gets the result. None: no
        message.
        """
        self._give_up(NO_ROOM)  # before `fill`: a link without room loses the old message, not the new one
        if self._encode == self._closed or self.node.ending:
            return None
        if skipped or late > self.period * SECOND / _LATE_SHARE:
            self.late += 1
            self.skipped += skipped
            reason = f"{skipped} period(s) skipped, the next one late" if skipped else "late"
            self._report(SignalKind.LATE, Missed(self.topic, reason, late=late / SECOND, count=skipped), self._on_late)
        try:
            message = self._class.fill()
            if message is None or self._encode == self._closed:  # fill may have closed it
                return None
            sample = self._sample(message)
        except Exception as error:  # noqa: BLE001 - the user's code: whatever it raises crashes its node
            self.close()
            self.node.crash(error)
            return None
        self.due = scheduled
        self.first_due = self.first_due or scheduled
        blocked = self._topic.deliver(sample, None, self._slot_link)
        if blocked is not None:
            self._deliver_later(sample, blocked)
        return sample

    def _deliver_later(self, sample: Sample, blocked: list[Sink]) -> None:
        """Let full queues drop one at once; a full link, which may be busy for a moment, has until the next period."""
        queues = [sink for sink in blocked if isinstance(sink, SubscriberQueue)]
        links = [sink for sink in blocked if sink not in queues and sink.reachable]
        down = [sink for sink in blocked if sink not in queues and sink not in links]
        if links:
            self._pending = _PeriodDelivery(self, sample, links, self._clock.monotonic())
        if queues:
            for sink in queues:
                sink.force(sample)
            self._miss(sample.sequence, NO_ROOM, queues)
        if down:
            self._miss_unreachable(sample, down)

    def delivery_completed(self, delivery: "_PeriodDelivery[M]", sink: Sink, reason: str) -> None:
        """Note that a link has a waiting sample, or has lost it for this reason."""
        late = self._clock.monotonic() - delivery.since
        if reason:
            self._miss(delivery.sample.sequence, reason, [sink])
        elif late > self.period * SECOND / _LATE_SHARE:
            self.late += 1
            self._report(SignalKind.LATE, Missed(self.topic, "sent late", where([sink]), late / SECOND), self._on_late)

    def _wrong_type(self, message: object) -> MessageError:
        error = super()._wrong_type(message)
        return MessageError(f"{error}: its fill has to return a {self.type.__name__}, or None to skip a period")

    def _give_up(self, reason: str) -> None:
        """Withdraw messages that still wait from the period before: they are stale."""
        delivery, self._pending = self._pending, None
        if delivery is not None and (without := delivery.drop_remaining(GIVEN_UP)):
            self._miss(delivery.sample.sequence, reason, without)


class _PeriodDelivery(PendingDelivery, Generic[M]):
    """A sample that waits for links until the next period; `since` is monotonic ns."""

    __slots__ = ("publisher", "since")

    def __init__(self, publisher: PeriodicPublisher[M], sample: Sample, sinks: list[Sink], since: int) -> None:
        self.publisher = publisher
        self.since = since
        super().__init__(sample, sinks)

    def on_completed(self, sink: Sink, reason: str) -> None:
        self.publisher.delivery_completed(self, sink, reason)
