"""Non real-time: waits for room, at most `stall` seconds, then goes on without the slow subscribers."""

import asyncio

from r2p.runtime.backpressure import CANCELLED, NO_ROOM, PendingDelivery, Sink
from r2p.runtime.publishers.base import BasePublisher, M
from r2p.runtime.qos import NonRealTime
from r2p.runtime.queues import YIELD_EVERY, checkpoint
from r2p.runtime.sample import PublisherClass, Sample

_NRT = PublisherClass.NON_REAL_TIME


class Publisher(BasePublisher[M, NonRealTime]):
    """A publisher of messages that do not expire: `publish()` waits for slow subscribers, up to the stall time.

    Made by `Node.advertise` with `NonRealTime`, its default.
    """

    publisher_class = PublisherClass.NON_REAL_TIME

    async def publish(self, message: M) -> None:
        """Publish a message, and wait until all queues and links that keep up have accepted it.

        Queues and links with room get it at once. A full send buffer or queue (but not a lossy one, nor one of this
        node) is waited for, at most `stall` seconds; from then on it loses messages, counted in `missed`, until it has
        room. Raises MessageError for a message that does not fit the type, and Closed once the publisher is closed.
        """
        # `_sample`, inlined: this is the path of every message.
        if message.__class__ is not self.type:
            raise self._wrong_type(message)
        data = self._encode(message)
        self.sent = sequence = self.sent + 1
        shared = message if self._shares is None or self._shares(message) else self._decode(data)
        sample = Sample(data, self._source, self._now(), 0, sequence, _NRT, shared)
        if self.latch:
            self._last = sample
        blocked = self._topic.deliver(sample, self.node)
        if blocked is not None:
            await self._wait_for_room(sample, blocked)
        self._until_yield -= 1
        if self._until_yield <= 0:
            self._until_yield = YIELD_EVERY
            await checkpoint()

    def publish_nowait(self, message: M) -> bool:
        """Publish without waiting, as callbacks must. Return False if a full queue or link lost a message, counted.

        Raises MessageError for a message that does not fit the type, and Closed once the publisher is closed.
        """
        sample = self._sample(message)
        blocked = self._topic.deliver(sample, self.node)
        return blocked is None or self._force(sample, blocked)

    def _force(self, sample: Sample, sinks: list[Sink]) -> bool:
        """Force the sample into full sinks without waiting; return False if any of them loses a message."""
        without = []
        for sink in sinks:
            lost = sink.lost
            sink.force(sample)
            if sink.lost > lost:
                without.append(sink)
        if without:
            self._miss(sample.sequence, NO_ROOM, without)
        return not without

    async def _wait_for_room(self, sample: Sample, blocked: list[Sink]) -> None:
        lossy = [sink for sink in blocked if not sink.blocks_publishers]
        if lossy:
            self._force(sample, lossy)
            # `_force` may call the user's code, which may make more sinks lossy, or these wait again.
            blocked = [sink for sink in blocked if sink.blocks_publishers and sink not in lossy]
            if not blocked:
                return
        loop = self._space.loop
        delivery = _WaitingDelivery(sample, blocked, loop.create_future())
        stall = self._class.stall
        timer = loop.call_later(stall, delivery.expire, f"no room for {stall} s")
        try:
            await delivery.over
        finally:
            timer.cancel()
            # Only if this task was cancelled: then the message is lost, unless another node takes over meanwhile.
            if self.hand_over is None and (without := delivery.drop_remaining(CANCELLED)):
                self._miss(sample.sequence, CANCELLED, without)
            if delivery.failed:
                self._miss(sample.sequence, delivery.reason, delivery.failed)


class _WaitingDelivery(PendingDelivery):
    """A `publish()` that waits for room."""

    __slots__ = ("failed", "over", "reason")

    def __init__(self, sample: Sample, sinks: list[Sink], over: asyncio.Future[None]) -> None:
        self.over = over
        self.failed: list[Sink] = []
        """The sinks that lost the message."""
        self.reason = ""
        super().__init__(sample, sinks)

    def on_completed(self, sink: Sink, reason: str) -> None:
        if reason:
            self.failed.append(sink)
            self.reason = reason
        if not self.remaining and not self.over.done():
            self.over.set_result(None)

    def expire(self, reason: str) -> None:
        """End the wait: sinks that have no room now are lossy from here on."""
        for sink in list(self.remaining):
            sink.refill()  # a link may have room that it was not asked about
        for sink in list(self.remaining):
            sink.become_lossy(reason)
