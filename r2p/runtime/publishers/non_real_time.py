"""Non real-time: waits for room, at most `stall` seconds, then goes on without the slow one."""

import asyncio

from r2p.messages import Layout
from r2p.runtime.backpressure import CANCELLED, NO_ROOM, PendingDelivery, Sink
from r2p.runtime.publishers.base import BasePublisher, M
from r2p.runtime.qos import NonRealTime
from r2p.runtime.sample import PublisherClass, Sample
from r2p.runtime.topic import YIELD_EVERY, EndpointOwner, Topic, TopicSpace, checkpoint

_NRT = PublisherClass.NON_REAL_TIME


class Publisher(BasePublisher[M]):
    """A non real-time publisher."""

    publisher_class = PublisherClass.NON_REAL_TIME

    def __init__(
        self,
        space: TopicSpace,
        node: EndpointOwner,
        topic: Topic,
        layout: Layout[M],
        klass: NonRealTime,
        *,
        latch: bool,
    ) -> None:
        super().__init__(space, node, topic, layout, latch=latch)
        self._stall = klass.stall
        self._on_missed = klass.on_missed
        self._on_degraded = klass.on_degraded

    async def publish(self, message: M) -> None:
        """Publish, and wait until everybody who can keep up has it.

        Queues with room get it at once. A full queue (not a lossy one, nor one of this node) or send buffer is waited
        for, at most `stall` seconds; then it loses messages, counted, until it has room again.
        Raises MessageError if the message does not fit its type.
        """
        if message.__class__ is not self.type:
            raise self._wrong_type(message)
        data = self._encode(message)
        self.sent = sequence = self.sent + 1
        sample = Sample(data, self._source, self._now(), 0, sequence, _NRT, message)
        if self.latch:
            self._last = sample
        blocked = self._topic.deliver(sample, self.node)
        if blocked is not None:
            await self._wait_for_room(sample, blocked)
        self._credit -= 1
        if self._credit <= 0:
            self._credit = YIELD_EVERY
            await checkpoint()

    def publish_nowait(self, message: M) -> bool:
        """Publish without waiting: for callbacks. False if somebody had no room and lost a message (counted)."""
        sample = self._sample(message)
        blocked = self._topic.deliver(sample, self.node)
        return blocked is None or self._force(sample, blocked)

    def _force(self, sample: Sample, sinks: list[Sink]) -> bool:
        """Give it to those for whom nobody waits; False if any of them loses a message by that."""
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
        given_up = [sink for sink in blocked if not sink.waits]
        if given_up:
            self._force(sample, given_up)
            blocked = [sink for sink in blocked if sink.waits and sink not in given_up]
            if not blocked:
                return
        loop = self._space.loop
        wait = _WaitingDelivery(sample, blocked, loop.create_future())
        timer = loop.call_later(self._stall, wait.expire, f"no room for {self._stall} s")
        try:
            await wait.over
        finally:
            timer.cancel()
            without = wait.withdraw()
            for sink in without:
                sink.count_lost(CANCELLED)
            if without:
                self._miss(sample.sequence, CANCELLED, without)
            if wait.refused:
                self._miss(sample.sequence, wait.refusal, wait.refused)


class _WaitingDelivery(PendingDelivery):
    """A `publish()` that waits for room."""

    __slots__ = ("over", "refusal", "refused")

    def __init__(self, sample: Sample, sinks: list[Sink], over: asyncio.Future[None]) -> None:
        self.over = over
        self.refused: list[Sink] = []
        self.refusal = ""
        super().__init__(sample, sinks)

    def completed(self, sink: Sink, refusal: str) -> None:
        if refusal:
            self.refused.append(sink)
            self.refusal = refusal
        if not self.remaining and not self.over.done():
            self.over.set_result(None)

    def expire(self, refusal: str) -> None:
        """The time is up: whoever has no room is lossy from now on."""
        for sink in list(self.remaining):
            sink.refill()
        for sink in list(self.remaining):
            sink.become_lossy(refusal)
