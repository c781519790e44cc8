"""Publishers: the three classes of the thesis (5.3.6), and what each does when somebody has no room.

    non real-time   waits for room, at most `stall` seconds, then goes on without the slow one
    sporadic        never waits; what is not in every queue and on every link by its deadline is missed
    periodic        never waits; is asked for a message at every period, which is missed where there is no room in it

Each counts its misses, signals them by a callback of its class value, and logs them at most once a second. What waits
stands in line before the sinks that lack it (`r2p.room`); here is what becomes of it there.
"""

import asyncio
from collections import deque
from collections.abc import Sequence
from typing import Any, Generic, NoReturn, TypeVar

from r2p.classes import Missed, NonRealTime, Periodic, Signal, Sporadic
from r2p.clock import Alarm, Clock, Ticker
from r2p.errors import Closed, MessageError
from r2p.messages import Layout, Message
from r2p.room import LINK_DOWN, Claim, Sink
from r2p.sample import PublisherClass, Sample, Source
from r2p.topic import BURST, Owner, QueueSink, Topic, TopicSpace, pause

M = TypeVar("M", bound=Message)

_SECOND = 1_000_000_000
_NRT = PublisherClass.NON_REAL_TIME
_LATE_SHARE = 2  # a period is late when it is off by more than half of it
_REMEMBERED = 64  # messages that were missed last
_TOO_LATE = "no room by the deadline"


class BasePublisher(Generic[M]):
    """What all publishers share. Made by `Node.advertise`."""

    publisher_class: PublisherClass

    def __init__(self, space: TopicSpace, node: Owner, topic: Topic, layout: Layout[M], *, latch: bool) -> None:
        self.topic = topic.name
        self.type = layout.cls
        self.node = node
        self.latch = latch
        self.sent = 0
        """Messages published; the sequence number of the last one."""
        self.missed = 0
        """Messages that somebody did not get in time."""
        self.late = 0
        """Messages that were published or sent after their time."""
        self._space = space
        self._topic = topic
        self._encode = layout.encode
        self._clock: Clock = space.clock
        self._now = space.clock.now
        self._source = Source(space.module, node.name)
        self._last: Sample | None = None
        self._credit = BURST
        self._logged = -_SECOND
        self._waiters: list[asyncio.Future[None]] = []
        self._missed_lately: deque[int] = deque(maxlen=_REMEMBERED)

    @property
    def size(self) -> int:
        """Bytes of one message."""
        return self._topic.layout.size if self._topic.layout else 0

    @property
    def subscribers(self) -> int:
        """Who would get a message now: local queues, and one for each link with subscribers behind it."""
        return len(self._topic.queues) + sum(outlet.reachable for outlet in self._topic.outlets)

    async def wait_subscriber(self) -> None:
        """Wait until somebody subscribes. Raises Closed if the publisher is closed before."""
        if not self.subscribers:
            waiter = self._space.loop.create_future()
            self._waiters.append(waiter)
            try:
                await waiter
            finally:
                self._waiters.remove(waiter)

    @property
    def guarantees(self) -> dict[str, str]:
        """What the publisher's class means on each link, by link name; "" is this module."""
        local = {
            PublisherClass.NON_REAL_TIME: "waits for room in every queue",
            PublisherClass.SPORADIC: "in every queue by the deadline, or signalled",
            PublisherClass.PERIODIC: "on absolute phase of the local clock; late periods are counted",
        }
        links = {link.name: link.guarantee(self.topic, self.publisher_class) for link in self._space.links}
        return {"": local[self.publisher_class]} | links

    async def ready(self, timeout: float | None = None) -> None:
        """Wait until every link that is up has admitted the topic.

        Raises TimeoutError after `timeout` seconds. Links that give best effort admit at once.
        """
        async with asyncio.timeout(timeout):
            for link in list(self._space.links):
                await link.admission(self.topic)

    def close(self) -> None:
        """Stop publishing; the links tell their peers."""
        if self in self._topic.publishers:
            self._topic.publishers.remove(self)
            self._encode = self._closed
            self._space.release(self._topic)
            self.node.forget(self)
            for waiter in self._waiters:
                if not waiter.done():
                    waiter.set_exception(self._is_closed())

    def _closed(self, message: M) -> NoReturn:
        raise self._is_closed()

    def _is_closed(self) -> Closed:
        return Closed(f"publisher of {self.topic} is closed: advertise it again")

    # Called by the topic and its links

    def joined(self, sink: Sink) -> None:
        """Somebody joined, or came back after a reboot: a latched value is sent again."""
        if self._last is not None:
            sink.force(self._last)
        for waiter in self._waiters:
            if not waiter.done():
                waiter.set_result(None)

    def degraded(self, link: str, reason: str) -> None:
        """A link that carried the topic does not any more."""
        self._signal(Missed(self.topic, reason, where=link, count=0), self._on_degraded)

    def link_missed(self, link: str, reason: str, late: float = 0.0, sequence: int = 0) -> None:
        """A link gave up a message that it had taken; `late` is in seconds.

        With its `sequence` a message that others missed, too, counts once.
        """
        self._miss(sequence, reason, link, late)

    def link_late(self, link: str, reason: str, late: float = 0.0) -> None:
        """A link sent a message after its deadline."""
        self.late += 1
        self._signal(Missed(self.topic, reason, link, late), self._on_late)

    # For the classes below

    _on_missed: Signal | None = None
    _on_late: Signal | None = None
    _on_degraded: Signal | None = None

    def _sample(self, message: M, deadline: int = 0) -> Sample:
        if message.__class__ is not self.type:
            raise self._wrong_type(message)
        data = self._encode(message)
        self.sent = sequence = self.sent + 1
        stamp = self._now()
        if deadline:
            deadline += stamp
        sample = Sample(data, self._source, stamp, deadline, sequence, self.publisher_class, message)
        if self.latch:
            self._last = sample
        return sample

    def _wrong_type(self, message: object) -> MessageError:
        return MessageError(f"topic {self.topic} takes {self.type.__name__}, not {type(message).__name__}")

    def _miss(self, sequence: int, reason: str, where: str, late: float = 0.0) -> None:
        """A message has not reached somebody; however many that are, it counts once."""
        is_news = sequence not in self._missed_lately
        self.missed += is_news
        if sequence:
            self._missed_lately.append(sequence)
        self._signal(Missed(self.topic, reason, where, late, int(is_news)), self._on_missed)

    def _unreachable(self, sample: Sample, sinks: list[Sink]) -> None:
        """Links that are down: who is behind them misses the sample."""
        for sink in sinks:
            sink.force(sample)
        self._miss(sample.sequence, LINK_DOWN, _where(sinks))

    def _signal(self, missed: Missed, callback: Signal | None) -> None:
        now = self._clock.monotonic()
        if now - self._logged >= _SECOND and missed.reason != LINK_DOWN:  # which was told when it went down
            self._logged = now
            self.node.log.warning("%s (missed %d, late %d so far)", missed, self.missed, self.late)
        if callback is not None:
            try:
                callback(missed)
            except Exception as error:  # noqa: BLE001 - the user's code: whatever it raises crashes its node
                # Later: a link may be at work in the node's own task, where a crash would raise through it.
                self._space.loop.call_soon(self.node.crash, error)


def _where(sinks: Sequence[Sink]) -> str:
    """The names of nodes and links, for a signal."""
    return ", ".join(dict.fromkeys(sink.owner for sink in sinks))


class Publisher(BasePublisher[M]):
    """A non real-time publisher."""

    publisher_class = PublisherClass.NON_REAL_TIME

    def __init__(
        self, space: TopicSpace, node: Owner, topic: Topic, layout: Layout[M], klass: NonRealTime, *, latch: bool
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
            self._credit = BURST
            await pause()

    def publish_nowait(self, message: M) -> bool:
        """Publish without waiting: for callbacks. False if somebody had no room and lost a message (counted)."""
        sample = self._sample(message)
        blocked = self._topic.deliver(sample, self.node)
        if blocked is not None:
            for sink in blocked:
                sink.force(sample)
            self._miss(sample.sequence, "no room", _where(blocked))
        return blocked is None

    async def _wait_for_room(self, sample: Sample, blocked: list[Sink]) -> None:
        loop = self._space.loop
        wait = _Wait(sample, blocked, loop.create_future())
        timer = loop.call_later(self._stall, wait.expire, f"no room for {self._stall} s")
        try:
            await wait.over
        finally:
            timer.cancel()
            for sink in wait.withdraw():  # cancelled
                sink.lost += 1
            if wait.refused:
                self._miss(sample.sequence, wait.refusal, _where(wait.refused))


class _Wait(Claim):
    """A `publish()` that waits for room."""

    __slots__ = ("over", "refusal", "refused")

    def __init__(self, sample: Sample, sinks: list[Sink], over: asyncio.Future[None]) -> None:
        self.over = over
        self.refused: list[Sink] = []
        self.refusal = ""
        super().__init__(sample, sinks)

    def settled(self, sink: Sink, refusal: str) -> None:
        if refusal:
            self.refused.append(sink)
            self.refusal = refusal
        if not self.lacking and not self.over.done():
            self.over.set_result(None)

    def expire(self, refusal: str) -> None:
        """The time is up: whoever has no room is lossy from now on."""
        for sink in list(self.lacking):
            sink.refill()
        for sink in list(self.lacking):
            sink.give_up(refusal)


class SporadicPublisher(BasePublisher[M]):
    """An event-triggered publisher."""

    publisher_class = PublisherClass.SPORADIC

    def __init__(
        self, space: TopicSpace, node: Owner, topic: Topic, layout: Layout[M], klass: Sporadic, *, latch: bool
    ) -> None:
        super().__init__(space, node, topic, layout, latch=latch)
        self._deadline = round(klass.deadline * _SECOND)
        self._limit = klass.pending
        self._send_late = klass.late == "send"
        self._on_missed = klass.on_missed
        self._on_late = klass.on_late
        self._on_degraded = klass.on_degraded
        self._pending: list[_Event[M]] = []
        self._alarm = Alarm(space.loop, self._overdue)

    async def publish(self, message: M) -> None:
        """Publish an event; returns at once, also where somebody has no room yet.

        Raises MessageError if the message does not fit its type.
        """
        self.publish_nowait(message)
        self._credit -= 1
        if self._credit <= 0:
            self._credit = BURST
            await pause()

    def publish_nowait(self, message: M) -> bool:
        """Publish an event; False if it has to wait for room somewhere, or can't reach somebody."""
        sample = self._sample(message, self._deadline)
        sample.drop_late = not self._send_late
        blocked = self._topic.deliver(sample)
        if blocked is None:
            return True
        waiting = [sink for sink in blocked if sink.reachable]
        if waiting:
            self._wait(_Event(self, sample, waiting, self._clock.monotonic() + self._deadline))
        if len(waiting) < len(blocked):
            self._unreachable(sample, [sink for sink in blocked if sink not in waiting])
        return False

    def close(self) -> None:
        super().close()
        while self._pending:
            self._give_up(self._pending[0], "publisher closed")
        self._alarm.close()

    def _wait(self, event: "_Event[M]") -> None:
        self._pending.append(event)
        if len(self._pending) > self._limit:
            self._give_up(self._pending[0], "too many wait")
        self._arm()

    def settled(self, event: "_Event[M]", sink: Sink, refusal: str) -> None:
        """A sink has got an event that waited, or lost it."""
        if not event.lacking:
            self._pending.remove(event)
            self._arm()
        if refusal:
            self._miss(event.sample.sequence, refusal, _where([sink]))

    def _arm(self) -> None:
        self._alarm.set(next((event.due for event in self._pending if not event.overdue), None))

    def _overdue(self) -> None:
        now = self._clock.monotonic()
        for event in [event for event in self._pending if event.due <= now and not event.overdue]:
            if self._send_late:
                event.overdue = True
                self.late += 1
                late = (now - event.due) / _SECOND
                self._signal(Missed(self.topic, _TOO_LATE, _where(event.lacking), late), self._on_late)
            else:
                self._give_up(event, _TOO_LATE)
        self._arm()

    def _give_up(self, event: "_Event[M]", reason: str) -> None:
        if event in self._pending:  # a signal before this one may have closed the publisher
            self._pending.remove(event)
            without = event.withdraw()
            for sink in without:
                sink.lost += 1
            late = max(0, self._clock.monotonic() - event.due) / _SECOND
            self._miss(event.sample.sequence, reason, _where(without), late)


class _Event(Claim, Generic[M]):
    """An event that waits for room; `due` is monotonic ns."""

    __slots__ = ("due", "overdue", "publisher")

    def __init__(self, publisher: SporadicPublisher[M], sample: Sample, sinks: list[Sink], due: int) -> None:
        self.publisher = publisher
        self.due = due
        self.overdue = False
        super().__init__(sample, sinks)

    def settled(self, sink: Sink, refusal: str) -> None:
        self.publisher.settled(self, sink, refusal)


class PeriodicPublisher(BasePublisher[M]):
    """A time-triggered publisher: it has no publish(), its class's `fill` is asked at every period."""

    publisher_class = PublisherClass.PERIODIC

    def __init__(
        self, space: TopicSpace, node: Owner, topic: Topic, layout: Layout[M], klass: Periodic[M], *, latch: bool
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
        self._driver: object = None
        self._waiting: _Period[M] | None = None
        self._ticker = Ticker(space.loop, round(klass.period * _SECOND), self.tick)

    def start(self) -> None:
        """Start the clock: the first message follows one period later."""
        self._ticker.start()

    def close(self) -> None:
        self._ticker.close()
        self._driver = None
        super().close()
        self._give_up("publisher closed")

    def drive(self, driver: object, period: float) -> bool:
        """A link whose slots are the clock calls `tick` from now on, each `period` seconds; again: another period.

        False if another link does already, or the publisher is closed.
        """
        if self._driver not in (None, driver) or self not in self._topic.publishers:
            return False
        self._driver = driver
        self.period = period
        self._ticker.close()
        return True

    def undrive(self, driver: object) -> None:
        """That link does not any more: the publisher's own clock goes on, at the period that was asked for."""
        if self._driver is driver:
            self._driver = None
            self.period = self._own_period
            self._ticker.start()

    def tick(self, scheduled: int, late: int, skipped: int) -> Sample | None:
        """One period: due at `scheduled` (monotonic ns), `late` by ns, after so many `skipped` ones.

        Local queues and all other links get the message, the driver gets it from here; None if there is none.
        """
        self._give_up("no room")
        if self._encode == self._closed:
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
        blocked = self._topic.deliver(sample, None, self._driver)
        if blocked is not None:
            self._not_yet(sample, blocked)
        return sample

    def _not_yet(self, sample: Sample, blocked: list[Sink]) -> None:
        """Queues drop one at once; a link, which may be busy for a moment, has until the next period."""
        queues = [sink for sink in blocked if isinstance(sink, QueueSink)]
        waiting = [sink for sink in blocked if sink not in queues and sink.reachable]
        down = [sink for sink in blocked if sink not in queues and sink not in waiting]
        if waiting:
            self._waiting = _Period(self, sample, waiting, self._clock.monotonic())
        if queues:
            for sink in queues:
                sink.force(sample)
            self._miss(sample.sequence, "no room", _where(queues))
        if down:
            self._unreachable(sample, down)

    def settled(self, waited: "_Period[M]", sink: Sink, refusal: str) -> None:
        """A link has got a sample that waited, or lost it."""
        late = self._clock.monotonic() - waited.since
        if refusal:
            self._miss(waited.sample.sequence, refusal, _where([sink]))
        elif late > self.period * _SECOND / _LATE_SHARE:
            self.late += 1
            self._signal(Missed(self.topic, "sent late", _where([sink]), late / _SECOND), self._on_late)

    def _give_up(self, reason: str) -> None:
        """What still waits is stale."""
        waited, self._waiting = self._waiting, None
        without = waited.withdraw() if waited is not None else []
        if waited is not None and without:
            for sink in without:
                sink.lost += 1
            self._miss(waited.sample.sequence, reason, _where(without))


class _Period(Claim, Generic[M]):
    """A sample that waits for links until the next period; `since` is monotonic ns."""

    __slots__ = ("publisher", "since")

    def __init__(self, publisher: PeriodicPublisher[M], sample: Sample, sinks: list[Sink], since: int) -> None:
        self.publisher = publisher
        self.since = since
        super().__init__(sample, sinks)

    def settled(self, sink: Sink, refusal: str) -> None:
        self.publisher.settled(self, sink, refusal)


AnyPublisher = Publisher[Any] | SporadicPublisher[Any] | PeriodicPublisher[Any]
