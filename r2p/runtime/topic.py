"""A topic: the place where publishers and queues of one module meet.

Delivery is one loop over the queues, highest priority first, and never waits: whoever has no room comes back to the
publisher, whose class decides what that means. Waking is separate from queueing: the nodes of the highest priority are
woken directly, the others one for each turn of the event loop, so that an important node waits for at most a few
handler steps of unimportant ones.
"""

import abc
import asyncio
import heapq
import itertools
import logging
import types
from collections import deque
from collections.abc import Callable, Generator, Hashable
from typing import Any, Protocol
from weakref import WeakValueDictionary

from r2p.clock import Clock
from r2p.errors import MessageError, TypeMismatch
from r2p.messages import Layout
from r2p.runtime.backpressure import NO_ROOM, Sink, WaitQueue
from r2p.runtime.duplicates import LastReceived
from r2p.runtime.sample import PublisherClass, Sample

YIELD_EVERY = 16
"""Messages that publish() or an iteration handles before it lets the event loop run once."""

_NRT = PublisherClass.NON_REAL_TIME


@types.coroutine
def checkpoint() -> Generator[None, None, None]:
    """Let the event loop run once."""
    yield


class EndpointOwner(Protocol):
    """The node that a publisher or a subscriber belongs to."""

    name: str
    priority: int

    @property
    def log(self) -> logging.LoggerAdapter[logging.Logger]: ...

    @property
    def ending(self) -> bool:
        """Whether functions that it gave away are not to be called any more."""

    def crash(self, error: Exception) -> None:
        """End the node with an error of a function that it gave away."""

    def forget(self, user: object) -> None:
        """A publisher or subscriber of the node was closed."""


class WakeScheduler:
    """Wakes waiting subscribers: those of the highest priority at once, the rest one a turn, highest first."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._waiting: list[tuple[int, int, asyncio.Future[None]]] = []
        self._order = itertools.count()
        self._running = False
        self._priorities: dict[int, int] = {}
        self.top = 0

    def enter(self, priority: int) -> None:
        """A node of this priority starts."""
        self._priorities[priority] = self._priorities.get(priority, 0) + 1
        self.top = max(self._priorities)

    def leave(self, priority: int) -> None:
        """A node of this priority has ended."""
        self._priorities[priority] -= 1
        if not self._priorities[priority]:
            del self._priorities[priority]
        self.top = max(self._priorities, default=0)

    def wake(self, priority: int, waiter: asyncio.Future[None]) -> None:
        if priority < self.top:
            self.queue(priority, waiter)
        elif not waiter.done():
            waiter.set_result(None)

    def queue(self, priority: int, waiter: asyncio.Future[None]) -> None:
        """Wake when its turn comes."""
        heapq.heappush(self._waiting, (-priority, next(self._order), waiter))
        if not self._running:
            self._running = True
            self._loop.call_soon(self._turn)

    def _turn(self) -> None:
        while self._waiting:
            waiter = heapq.heappop(self._waiting)[2]
            if not waiter.done():
                waiter.set_result(None)
                self._loop.call_soon(self._turn)
                return
        self._running = False


class SubscriberQueue(Sink):
    """The bounded queue of one subscriber; the topic fills it, the subscriber empties it."""

    __slots__ = (
        "_wake_scheduler",
        "keep_oldest",
        "limit",
        "lossy",
        "matches",
        "node",
        "priority",
        "queue",
        "waiter",
        "waiting",
    )

    def __init__(
        self,
        wake_scheduler: WakeScheduler,
        node: EndpointOwner,
        limit: int,
        priority: int,
        *,
        lossy: bool,
        keep_oldest: bool,
    ) -> None:
        super().__init__()
        self._wake_scheduler = wake_scheduler
        self.node = node
        self.limit = limit
        self.priority = priority
        self.keep_oldest = keep_oldest
        self.lossy = lossy
        self.waits = not lossy
        self.queue: deque[Sample] = deque()
        self.waiter: asyncio.Future[None] | None = None
        """Its reader, while that waits for a message."""
        self.matches: list[asyncio.Future[None]] = []
        """Those who wait for a publisher."""
        self.waiting: WaitQueue | None = None
        """Only while somebody waits for room: whoever takes a message out then calls `refill`."""

    def offer(self, sample: Sample) -> bool:
        if len(self.queue) >= self.limit:
            return False
        self._put(sample)
        return True

    def waits_for(self, sample: Sample) -> bool:
        """Who made no room for what does not expire is lossy for that only: events wait until their deadline.

        A publisher of this module gets the queue back, too, and counts what is lost there.
        """
        return not self.lossy and (sample.publisher_class != _NRT or not sample.source.link)

    def force(self, sample: Sample) -> None:
        if self.offer(sample):
            return
        self.lost += 1
        if self.keep_oldest:
            return
        overtaken = [] if self.waiting is None else self.waiting.pop_earlier(self, sample)
        for earlier in (*(claim.sample for claim in overtaken), sample):
            self.queue.popleft()
            self._put(earlier)
        self.lost += len(overtaken)
        for claim in overtaken:  # after all are in: this may bring about that more is published
            claim.complete(self, NO_ROOM)

    def wait_queue(self) -> WaitQueue:
        if self.waiting is None:
            self.waiting = WaitQueue()
        return self.waiting

    def refill(self) -> None:
        if (room := self.waiting) is not None:
            room.serve()
            if len(self.queue) <= self.limit // 2:
                room.recover()
            if not room:
                self.waiting = None

    @property
    def owner(self) -> str:
        """The name of its node."""
        return self.node.name

    def publisher_joined(self) -> None:
        """The topic has one more publisher."""
        for waiter in self.matches:
            if not waiter.done():
                waiter.set_result(None)

    def _put(self, sample: Sample) -> None:
        self.queue.append(sample)
        if (waiter := self.waiter) is not None:
            self.waiter = None
            self._wake_scheduler.wake(self.priority, waiter)


class RemoteSubscriber(Sink):
    """A remote subscriber: one topic on its way out by one link."""

    __slots__ = ("link", "link_name", "waiting")

    def __init__(self, link_name: str, link: object, lines: WaitQueue) -> None:
        super().__init__()
        self.link_name = link_name
        self.waiting = lines
        self.link = link
        """The link itself; topics only tell one from another."""

    @property
    def owner(self) -> str:
        """The name of its link."""
        return self.link_name

    def wait_queue(self) -> WaitQueue:
        return self.waiting


class PublisherHandle(Protocol):
    """A publisher as its topic sees it."""

    node: EndpointOwner
    publisher_class: PublisherClass
    latch: bool

    def subscriber_joined(self, sink: Sink) -> None:
        """Somebody joined, or came back after a reboot."""

    def link_degraded(self, link: str, reason: str) -> None:
        """A link that carried the topic does not any more."""

    def link_missed(self, link: str, reason: str, late: float = 0.0, sequence: int = 0) -> None:
        """A link gave up a message that it had taken; `late` is in seconds."""

    def link_late(self, link: str, reason: str, late: float = 0.0) -> None:
        """A link sent a message after its deadline."""


class SlotPublisher(abc.ABC):
    """Fills the slots of a bus: a periodic publisher of this module, or of another link."""

    period: float
    """Seconds."""
    lead: float
    """Seconds before its slot in which a message is made."""

    @property
    @abc.abstractmethod
    def size(self) -> int:
        """Bytes of one message."""

    @abc.abstractmethod
    def use_slot_clock(self, slot_link: object, period: float) -> bool:
        """A link whose slots are the clock calls `tick` from now on, each `period` seconds; again: another period.

        False if another link does already, or the publisher is closed.
        """

    @abc.abstractmethod
    def use_own_clock(self, slot_link: object) -> None:
        """That link does not any more."""

    @abc.abstractmethod
    def tick(self, scheduled: int, late: int, skipped: int) -> Sample | None:
        """The message for the slot due at `scheduled` (monotonic ns), `late` by ns, after so many `skipped` ones."""

    @abc.abstractmethod
    def link_degraded(self, link: str, reason: str) -> None:
        """The link has no slots any more."""

    @abc.abstractmethod
    def link_missed(self, link: str, reason: str, late: float = 0.0, sequence: int = 0) -> None:
        """The link gave up a message that it had accepted; `late` is in seconds."""


class LatchedSource(Protocol):
    """A link that publishes a topic here, and remembers its last message."""

    def latched_value(self, topic: "Topic") -> Sample | None:
        """The last message, if the publisher latches it."""


class Topic:
    """One topic in one module."""

    def __init__(self, name: str, wake_scheduler: WakeScheduler) -> None:
        self.name = name
        self.layout: Layout[Any] | None = None
        self.publishers: list[PublisherHandle] = []
        self.queues: list[SubscriberQueue] = []
        self.remote_subscribers: list[RemoteSubscriber] = []
        self.remote_publishers = 0
        """Remote publishers."""
        self.latched_sources: list[LatchedSource] = []
        self.drop_filter: Callable[[str], bool] | None = None
        """Decides for each message, by the name of its link, whether it is dropped (`r2p.bridge.multihoming`)."""
        self._wake_scheduler = wake_scheduler
        self._last_received: WeakValueDictionary[Hashable, LastReceived] = WeakValueDictionary()

    def last_received(self, publisher: Hashable) -> LastReceived:
        """What all ways share by which messages of a remote publisher come in, so that doubles are recognised.

        It lasts as long as somebody keeps it.
        """
        heard = self._last_received.get(publisher)
        if heard is None:
            heard = self._last_received[publisher] = LastReceived()
        return heard

    def deliver(self, sample: Sample, own: object = None, slot_link: object = None) -> list[Sink] | None:
        """Queue the sample wherever there is room; the sinks that are worth waiting for come back.

        With what is published here those come back, too, that are not any more (`patient` is false): its publisher
        counts what they lose.
        `own` is the publishing node: its own queues never make it wait. `slot_link` is a link that gets it another way.
        """
        if self.drop_filter is not None and self.drop_filter(sample.source.link):
            return None
        wake_scheduler = self._wake_scheduler
        blocked: list[Sink] | None = None
        for sink in self.queues:
            queue = sink.queue
            if len(queue) >= sink.limit:
                if sink.node is not own and (sink.waits or sink.waits_for(sample)):
                    blocked = [sink] if blocked is None else [*blocked, sink]
                    continue
                if sink.waiting is not None or sink.keep_oldest:
                    sink.force(sample)
                    continue
                sink.lost += 1
                queue.popleft()
            queue.append(sample)
            if (waiter := sink.waiter) is not None:
                sink.waiter = None
                if sink.priority < wake_scheduler.top:
                    wake_scheduler.queue(sink.priority, waiter)
                elif not waiter.done():
                    waiter.set_result(None)
        if self.remote_subscribers and not sample.source.link:
            blocked = self._send(self.remote_subscribers, sample, blocked, slot_link)
        return blocked

    def _send(
        self, subscribers: list[RemoteSubscriber], sample: Sample, blocked: list[Sink] | None, slot_link: object
    ) -> list[Sink] | None:
        for outlet in subscribers:
            lines = outlet.waiting
            queues = (lines.events or lines.deliveries) and lines.queue_of(sample)
            if outlet.link is slot_link or (not queues and outlet.offer(sample)):
                continue
            if blocked is None:
                blocked = [outlet]
            else:
                blocked.append(outlet)
        return blocked

    def join(self, sink: SubscriberQueue | RemoteSubscriber) -> None:
        """A subscriber or a link joins; publishers that latch send it their last value."""
        if isinstance(sink, SubscriberQueue):
            self.queues.append(sink)
            self.queues.sort(key=lambda queue: -queue.priority)
            for value in self.latched_values():
                sink.offer_latched(value)
        elif sink not in self.remote_subscribers:
            self.remote_subscribers.append(sink)
        for publisher in self.publishers:
            publisher.subscriber_joined(sink)

    def resend_latched(self, sink: "SubscriberQueue | RemoteSubscriber") -> None:
        """One more subscriber at the other end of a link that has joined before, or the same one after a restart."""
        for publisher in self.publishers:
            publisher.subscriber_joined(sink)

    def leave(self, sink: SubscriberQueue | RemoteSubscriber) -> None:
        if isinstance(sink, SubscriberQueue):
            self.queues.remove(sink)
        else:
            self.remote_subscribers.remove(sink)
        sink.wait_queue().drop_sink(sink)

    def publisher_of(self, sample: Sample) -> "PublisherHandle | None":
        """Who published this sample here: for late news of it. None for one that came by a link."""
        if sample.source.link:
            return None
        for publisher in self.publishers:
            if publisher.node.name == sample.source.node and publisher.publisher_class == sample.publisher_class:
                return publisher
        return None

    @property
    def unused(self) -> bool:
        """Nobody in this module publishes or subscribes it."""
        return not (self.publishers or self.queues)

    @property
    def slot_publishers(self) -> list[SlotPublisher]:
        """The publishers that may fill the slots of a bus."""
        return [each for each in self.publishers if isinstance(each, SlotPublisher)]

    def latched_values(self) -> list[Sample]:
        """The last messages of remote publishers that latch them."""
        return [value for source in self.latched_sources if (value := source.latched_value(self)) is not None]

    @property
    def wanted(self) -> bool:
        """Whether what others publish is to be let in."""
        return bool(self.queues)

    @property
    def in_use(self) -> bool:
        """Whether links have to do with it."""
        return bool(self.remote_subscribers or self.remote_publishers)


class LinkView(Protocol):
    """A link as publishers see it."""

    @property
    def name(self) -> str: ...

    def guarantee(self, topic: str, publisher_class: PublisherClass) -> str:
        """What the class means on this link for the topic, in words."""

    def best_effort(self, publisher_class: PublisherClass) -> bool:
        """Whether the link gives less than the class asks for."""

    def refusal(self, size: int) -> str | None:
        """Why messages of `size` bytes can't be sent on this link."""

    def inadmissible(self, size: int, period: float) -> str | None:
        """Why there can never be slots for messages of `size` bytes each `period` seconds."""

    def network_time(self) -> int | None:
        """The time (ns) that all nodes of the link's network share. None: it has none, or it is not known."""

    async def admission(self, topic: str) -> None:
        """Wait until the link has admitted the topic."""


def number(topic: str, option: str, value: object) -> None:
    """Raise MessageError for what is no number of messages."""
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise MessageError(f"topic {topic}: {option} is a number of messages, 1 or more, not {value!r}")


class TopicSpace:
    """All topics of one module, by name. The module listens to changes and tells its links."""

    def __init__(self, module: str, loop: asyncio.AbstractEventLoop, clock: Clock) -> None:
        self.module = module
        self.loop = loop
        self.clock = clock
        self.wake_scheduler = WakeScheduler(loop)
        self.topics: dict[str, Topic] = {}
        self.links: list[LinkView] = []
        self.make_topic: Callable[[str, WakeScheduler], Topic] = Topic
        """Makes the topics; a gateway has a kind of its own."""
        self.changed: Callable[[Topic], None] = lambda _topic: None
        """Called after a publisher or a subscriber of this module has come or gone."""

    def open(self, name: str, layout: Layout[Any] | None) -> Topic:
        """The topic of that name; raises TypeMismatch if it has another layout here (`None` fits any)."""
        topic = self.topics.get(name)
        if topic is None:
            topic = self.topics[name] = self.make_topic(name, self.wake_scheduler)
        if layout is not None:
            if topic.layout is None:
                topic.layout = layout
            elif topic.layout.fingerprint != layout.fingerprint:
                raise TypeMismatch(
                    f"topic {name} is {topic.layout.cls.__name__} ({topic.layout.schema}) in module {self.module}, "
                    f"not {layout.cls.__name__} ({layout.schema}): a changed layout needs a topic of its own"
                )
        return topic

    def release(self, topic: Topic) -> None:
        """Tell of a change, and forget the topic's type with its last user."""
        self.changed(topic)
        if topic.unused:
            topic.layout = None
            if not topic.in_use:
                self.topics.pop(topic.name, None)
