"""Publishers: the three classes of the thesis (5.3.6), and what each does when somebody has no room.

    non real-time   waits for room, at most `stall` seconds, then goes on without the slow one
    sporadic        never waits; what is not in every queue by its deadline is missed
    periodic        never waits; is asked for a message at every period, and drops it where there is no room

Each counts its misses, signals them by a callback of its class value, and logs them at most once a second.
"""

import asyncio
import functools
from collections import deque
from collections.abc import Callable
from typing import Any, ClassVar, Generic, Literal, NoReturn, TypeVar

import msgspec

from r2p.clock import Alarm, Clock, Ticker
from r2p.errors import Closed, MessageError
from r2p.messages import Layout, Message
from r2p.sample import PublisherClass, Sample, Source
from r2p.topic import BURST, Outlet, Owner, QueueSink, Sink, Topic, TopicSpace, pause

M = TypeVar("M", bound=Message)

_SECOND = 1_000_000_000
_NRT = PublisherClass.NON_REAL_TIME
_LATE_SHARE = 2  # a period is late when it is off by more than half of it


class Missed(msgspec.Struct, frozen=True):
    """A message that did not reach everybody in time, or the news that it may not from now on.

    `where` names the subscriber's node or the link; `late` is in seconds (0: unknown); `count` is how many messages.
    """

    topic: str
    reason: str
    where: str = ""
    late: float = 0.0
    count: int = 1

    def __str__(self) -> str:
        where = f" ({self.where})" if self.where else ""
        late = f" by {self.late * 1e3:.1f} ms" if self.late else ""
        return f"topic {self.topic}{where}: {self.reason}{late}"


Signal = Callable[[Missed], object]


class NonRealTime(msgspec.Struct, frozen=True, kw_only=True):
    """Class of a publisher whose messages do not expire: `publish` waits for room up to `stall` seconds."""

    publisher_class: ClassVar = PublisherClass.NON_REAL_TIME
    stall: float = 1.0
    on_missed: Signal | None = None
    on_degraded: Signal | None = None


class Sporadic(msgspec.Struct, frozen=True):
    """Class of an event-triggered publisher: messages must be in every queue `deadline` seconds after `publish`.

    At most `pending` messages wait for room, in order. One that is overdue is given up (`late="drop"`) or still sent
    (`late="send"`); it is counted and signalled either way.
    """

    publisher_class: ClassVar = PublisherClass.SPORADIC
    deadline: float
    pending: int = 8
    late: Literal["drop", "send"] = "drop"
    on_missed: Signal | None = None
    on_late: Signal | None = None
    on_degraded: Signal | None = None


class Periodic(msgspec.Struct, Generic[M], frozen=True):
    """Class of a time-triggered publisher: `fill()` gives the message of each period (seconds); None skips one."""

    publisher_class: ClassVar = PublisherClass.PERIODIC
    period: float
    fill: Callable[[], M | None]
    on_missed: Signal | None = None
    on_late: Signal | None = None
    on_degraded: Signal | None = None


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
        links = {link.name: link.guarantee(self.publisher_class) for link in self._space.links}
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
        if self._last is not None and not sink.offer(self._last):
            sink.force(self._last)
        for waiter in self._waiters:
            if not waiter.done():
                waiter.set_result(None)

    def left(self, sink: Sink) -> None:
        """Somebody left."""

    def degraded(self, link: str, reason: str) -> None:
        """A link that carried the topic does not any more."""
        self._signal(Missed(self.topic, reason, where=link, count=0), self._on_degraded)

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

    def _miss(self, reason: str, sink: Sink | None = None, *, late: float = 0.0, count: int = 1) -> None:
        self.missed += count
        self._signal(Missed(self.topic, reason, _where(sink), late, count), self._on_missed)

    def _signal(self, missed: Missed, callback: Signal | None) -> None:
        now = self._clock.monotonic()
        if now - self._logged >= _SECOND:
            self._logged = now
            self.node.log.warning("%s (missed %d, late %d so far)", missed, self.missed, self.late)
        if callback is not None:
            try:
                callback(missed)
            except Exception as error:  # noqa: BLE001 - the user's code: whatever it raises crashes its node
                self.node.crash(error)


def _where(sink: Sink | None) -> str:
    if isinstance(sink, QueueSink):
        return sink.owner
    return sink.link if isinstance(sink, Outlet) else ""


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
        for sink in blocked or ():
            sink.force(sample)
            self._miss("no room", sink)
        return blocked is None

    async def _wait_for_room(self, sample: Sample, blocked: list[Sink]) -> None:
        try:
            async with asyncio.timeout(self._stall):
                while blocked:
                    await _room_in(blocked, self._space.loop)
                    blocked = [sink for sink in blocked if not sink.offer(sample)]
        except TimeoutError:
            for sink in blocked:
                if not sink.offer(sample):
                    sink.give_up(sample)
                    self._miss(f"no room for {self._stall} s", sink)
        except asyncio.CancelledError:
            for sink in blocked:
                sink.lost += 1
            raise


async def _room_in(sinks: list[Sink], loop: asyncio.AbstractEventLoop) -> None:
    """Wait until one of them has room."""
    room: asyncio.Future[None] = loop.create_future()

    def wake() -> None:
        if not room.done():
            room.set_result(None)

    for sink in sinks:
        sink.when_room(wake)
    try:
        await room
    finally:
        for sink in sinks:
            sink.wait_no_more(wake)


class _Pending(msgspec.Struct, eq=False):
    """An event that waits for room in `sinks`; `due` is monotonic ns."""

    sample: Sample
    sinks: list[Sink]
    due: int
    overdue: bool = False


class SporadicPublisher(BasePublisher[M]):
    """An event-triggered publisher."""

    publisher_class = PublisherClass.SPORADIC

    def __init__(
        self, space: TopicSpace, node: Owner, topic: Topic, layout: Layout[M], klass: Sporadic, *, latch: bool
    ) -> None:
        super().__init__(space, node, topic, layout, latch=latch)
        if klass.deadline <= 0 or klass.pending < 1:
            raise MessageError(f"topic {self.topic}: a sporadic publisher needs deadline > 0 s and pending >= 1")
        self._deadline = round(klass.deadline * _SECOND)
        self._limit = klass.pending
        self._send_late = klass.late == "send"
        self._on_missed = klass.on_missed
        self._on_late = klass.on_late
        self._on_degraded = klass.on_degraded
        self._pending: deque[_Pending] = deque()
        self._watched: dict[Sink, Callable[[], None]] = {}
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
        """Publish an event; False if it has to wait for room somewhere."""
        sample = self._sample(message, self._deadline)
        blocked = self._topic.deliver(sample)
        if blocked is None:
            return True
        if len(self._pending) >= self._limit:
            self._give_up(self._pending.popleft(), "too many wait")
        self._pending.append(_Pending(sample, blocked, self._clock.monotonic() + self._deadline))
        for sink in blocked:
            self._watch(sink)
        self._arm()
        return False

    def close(self) -> None:
        super().close()
        while self._pending:
            self._give_up(self._pending.popleft(), "publisher closed")
        for sink in list(self._watched):
            self._forget(sink)
        self._alarm.close()

    def left(self, sink: Sink) -> None:
        self._forget(sink)

    def _watch(self, sink: Sink) -> None:
        # Called back at the first free place: so whoever has an event waiting has no room for a younger one.
        if sink not in self._watched:
            self._watched[sink] = refill = functools.partial(self._refill, sink)
            sink.when_room(refill, soon=True)

    def _refill(self, sink: Sink) -> None:
        self._watched.pop(sink, None)
        for entry in self._pending:
            if sink in entry.sinks:
                if not sink.offer(entry.sample):
                    self._watch(sink)
                    break
                entry.sinks.remove(sink)
        self._prune()

    def _forget(self, sink: Sink) -> None:
        for entry in self._pending:
            if sink in entry.sinks:
                entry.sinks.remove(sink)
        refill = self._watched.pop(sink, None)
        if refill is not None:
            sink.wait_no_more(refill)
        self._prune()

    def _prune(self) -> None:
        if not all(entry.sinks for entry in self._pending):
            self._pending = deque(entry for entry in self._pending if entry.sinks)
        self._arm()

    def _arm(self) -> None:
        self._alarm.set(next((entry.due for entry in self._pending if not entry.overdue), None))

    def _overdue(self) -> None:
        now = self._clock.monotonic()
        for entry in [entry for entry in self._pending if entry.due <= now and not entry.overdue]:
            if self._send_late:
                entry.overdue = True
                self.late += 1
                missed = Missed(
                    self.topic, "no room by the deadline", _where(entry.sinks[0]), (now - entry.due) / _SECOND
                )
                self._signal(missed, self._on_late)
            elif entry in self._pending:  # a signal before this one may have closed the publisher
                self._pending.remove(entry)
                self._give_up(entry, "no room by the deadline")
        self._arm()

    def _give_up(self, entry: _Pending, reason: str) -> None:
        for sink in entry.sinks:
            sink.lost += 1
        self._miss(reason, entry.sinks[0], late=max(0, self._clock.monotonic() - entry.due) / _SECOND)


class PeriodicPublisher(BasePublisher[M]):
    """A time-triggered publisher: it has no publish(), its class's `fill` is asked at every period."""

    publisher_class = PublisherClass.PERIODIC

    def __init__(
        self, space: TopicSpace, node: Owner, topic: Topic, layout: Layout[M], klass: Periodic[M], *, latch: bool
    ) -> None:
        super().__init__(space, node, topic, layout, latch=latch)
        if klass.period <= 0:
            raise MessageError(f"topic {self.topic}: a period is in seconds and more than 0, not {klass.period}")
        self.period = klass.period
        self.skipped = 0
        """Periods that passed without a message because the loop was busy."""
        self._fill = klass.fill
        self._on_missed = klass.on_missed
        self._on_late = klass.on_late
        self._on_degraded = klass.on_degraded
        self._ticker = Ticker(space.loop, round(klass.period * _SECOND), self._tick)

    def start(self) -> None:
        """Start the clock: the first message follows one period later."""
        self._ticker.start()

    def close(self) -> None:
        self._ticker.close()
        super().close()

    def _tick(self, scheduled: int, late: int, skipped: int) -> None:
        if skipped or late > self.period * _SECOND / _LATE_SHARE:
            self.late += 1
            self.skipped += skipped
            reason = f"{skipped} period(s) skipped, the next one late" if skipped else "late"
            self._signal(Missed(self.topic, reason, late=late / _SECOND, count=skipped), self._on_late)
        try:
            message = self._fill()
            if message is None or self._encode == self._closed:  # fill may have closed it
                return
            sample = self._sample(message)
        except Exception as error:  # noqa: BLE001 - the user's code: whatever it raises crashes its node
            self.close()
            self.node.crash(error)
            return
        for sink in self._topic.deliver(sample) or ():
            sink.force(sample)
            self._miss("no room", sink)


AnyPublisher = Publisher[Any] | SporadicPublisher[Any] | PeriodicPublisher[Any]
