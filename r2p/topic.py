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
from collections.abc import Callable, Generator
from typing import Any, Protocol

from r2p.clock import Clock
from r2p.errors import TypeMismatch
from r2p.messages import Layout
from r2p.sample import PublisherClass, Sample

BURST = 16
"""Messages that publish() or an iteration handles before it lets the event loop run once."""

PATIENCE = 4
"""Turns of the event loop that a link waits for a full queue before it goes on without it."""


@types.coroutine
def pause() -> Generator[None, None, None]:
    """Let the event loop run once."""
    yield


class Owner(Protocol):
    """The node that a publisher or a subscriber belongs to."""

    name: str
    priority: int

    @property
    def log(self) -> logging.LoggerAdapter[logging.Logger]: ...

    def crash(self, error: Exception) -> None:
        """End the node with an error of a function that it gave away."""

    def forget(self, user: object) -> None:
        """A publisher or subscriber of the node was closed."""


class Waker:
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


class Sink(abc.ABC):
    """What takes samples: a subscriber's queue, or a link's send buffer."""

    __slots__ = ("_room", "_room_at", "lost", "patient")

    def __init__(self) -> None:
        self.lost = 0
        self.patient = True
        """Whether publishers and links wait for room in it; False while it is considered lossy."""
        self._room: list[Callable[[], None]] | None = None
        self._room_at = 0

    @abc.abstractmethod
    def offer(self, sample: Sample) -> bool:
        """Take the sample if there is room."""

    @abc.abstractmethod
    def force(self, sample: Sample) -> None:
        """Take the sample even without room, losing and counting one."""

    @abc.abstractmethod
    def when_room(self, callback: Callable[[], None], *, soon: bool = False) -> None:
        """Call back once when there is room again: at the first free place (`soon`), else when half is free."""

    def wait_no_more(self, callback: Callable[[], None]) -> None:
        """Undo `when_room`, if it was not called back yet."""
        if self._room is not None and callback in self._room:
            self._room.remove(callback)

    def give_up(self, sample: Sample) -> None:
        """It made no room in time: lossy until it has."""
        self.patient = False
        self.force(sample)
        self.when_room(self._recover)

    def _recover(self) -> None:
        self.patient = True

    def _made_room(self) -> None:
        callbacks, self._room, self._room_at = self._room, None, 0
        for callback in callbacks or ():
            callback()


class QueueSink(Sink):
    """The bounded queue of one subscriber; the topic fills it, the subscriber empties it."""

    __slots__ = ("_waker", "keep_oldest", "limit", "node", "priority", "queue", "waiter")

    def __init__(self, waker: Waker, node: Owner, limit: int, priority: int, *, lossy: bool, keep_oldest: bool) -> None:
        super().__init__()
        self._waker = waker
        self.node = node
        self.limit = limit
        self.priority = priority
        self.keep_oldest = keep_oldest
        self.patient = not lossy
        self.queue: deque[Sample] = deque()
        self.waiter: asyncio.Future[None] | None = None

    def offer(self, sample: Sample) -> bool:
        if len(self.queue) >= self.limit:
            return False
        self._put(sample)
        return True

    def force(self, sample: Sample) -> None:
        if self.offer(sample):
            return
        self.lost += 1
        if not self.keep_oldest:
            self.queue.popleft()
            self._put(sample)

    def when_room(self, callback: Callable[[], None], *, soon: bool = False) -> None:
        if self._room is None:
            self._room = []
        self._room.append(callback)
        self._room_at = max(self._room_at, self.limit - 1 if soon else self.limit // 2)

    @property
    def owner(self) -> str:
        """The name of its node."""
        return self.node.name

    def publisher_joined(self) -> None:
        """The topic has one more publisher."""

    def _put(self, sample: Sample) -> None:
        self.queue.append(sample)
        if (waiter := self.waiter) is not None:
            self.waiter = None
            self._waker.wake(self.priority, waiter)


class Outlet(Sink):
    """A remote subscriber: one topic on its way out by one link."""

    __slots__ = ("link",)

    def __init__(self, link: str) -> None:
        super().__init__()
        self.link = link

    @property
    def reachable(self) -> bool:
        """Whether its link is up."""
        return True


class Advertised(Protocol):
    """A publisher as its topic sees it."""

    node: Owner
    publisher_class: PublisherClass
    latch: bool

    def joined(self, sink: Sink) -> None:
        """Somebody joined, or came back after a reboot."""

    def left(self, sink: Sink) -> None:
        """Somebody left."""

    def degraded(self, link: str, reason: str) -> None:
        """A link that carried the topic does not any more."""


class Memory(Protocol):
    """A link that publishes a topic here, and remembers its last message."""

    def remind(self, topic: "Topic", sink: QueueSink) -> None:
        """Send the last message to a new subscriber, if the publisher latches it."""


class Topic:
    """One topic in one module."""

    def __init__(self, name: str, waker: Waker) -> None:
        self.name = name
        self.layout: Layout[Any] | None = None
        self.publishers: list[Advertised] = []
        self.queues: list[QueueSink] = []
        self.outlets: list[Outlet] = []
        self.inlets = 0
        """Remote publishers."""
        self.memories: list[Memory] = []
        self._waker = waker

    def deliver(self, sample: Sample, own: object = None) -> list[Sink] | None:
        """Queue the sample wherever there is room; the sinks that are worth waiting for come back.

        `own` is the publishing node: its own queues never make it wait.
        """
        waker = self._waker
        blocked: list[Sink] | None = None
        for sink in self.queues:
            queue = sink.queue
            if len(queue) >= sink.limit:
                if sink.patient and sink.node is not own:
                    if blocked is None:
                        blocked = [sink]
                    else:
                        blocked.append(sink)
                    continue
                sink.lost += 1
                if sink.keep_oldest:
                    continue
                queue.popleft()
            queue.append(sample)
            if (waiter := sink.waiter) is not None:
                sink.waiter = None
                if sink.priority < waker.top:
                    waker.queue(sink.priority, waiter)
                elif not waiter.done():
                    waiter.set_result(None)
        if self.outlets and not sample.source.link:
            blocked = self._send(sample, blocked)
        return blocked

    def _send(self, sample: Sample, blocked: list[Sink] | None) -> list[Sink] | None:
        for outlet in self.outlets:
            if outlet.offer(sample):
                continue
            if not outlet.patient:
                outlet.force(sample)
            elif blocked is None:
                blocked = [outlet]
            else:
                blocked.append(outlet)
        return blocked

    def join(self, sink: QueueSink | Outlet) -> None:
        """A subscriber or a link joins; publishers that latch send it their last value."""
        if isinstance(sink, QueueSink):
            self.queues.append(sink)
            self.queues.sort(key=lambda queue: -queue.priority)
            for memory in self.memories:
                memory.remind(self, sink)
        elif sink not in self.outlets:
            self.outlets.append(sink)
        for publisher in self.publishers:
            publisher.joined(sink)

    def leave(self, sink: QueueSink | Outlet) -> None:
        if isinstance(sink, QueueSink):
            self.queues.remove(sink)
        else:
            self.outlets.remove(sink)
        for publisher in self.publishers:
            publisher.left(sink)

    @property
    def idle(self) -> bool:
        """Nobody in this module publishes or subscribes it."""
        return not (self.publishers or self.queues)


class LinkView(Protocol):
    """A link as publishers see it."""

    @property
    def name(self) -> str: ...

    def guarantee(self, publisher_class: PublisherClass) -> str:
        """What the class means on this link, in words."""

    def best_effort(self, publisher_class: PublisherClass) -> bool:
        """Whether the link gives less than the class asks for."""

    def refusal(self, size: int) -> str | None:
        """Why messages of `size` bytes can't be sent on this link."""

    async def admission(self, topic: str) -> None:
        """Wait until the link has admitted the topic."""


class TopicSpace:
    """All topics of one module, by name. The module listens to changes and tells its links."""

    def __init__(self, module: str, loop: asyncio.AbstractEventLoop, clock: Clock) -> None:
        self.module = module
        self.loop = loop
        self.clock = clock
        self.waker = Waker(loop)
        self.topics: dict[str, Topic] = {}
        self.links: list[LinkView] = []
        self.changed: Callable[[Topic], None] = lambda _topic: None
        """Called after a publisher or a subscriber of this module has come or gone."""

    def open(self, name: str, layout: Layout[Any] | None) -> Topic:
        """The topic of that name; raises TypeMismatch if it has another layout here (`None` fits any)."""
        topic = self.topics.get(name)
        if topic is None:
            topic = self.topics[name] = Topic(name, self.waker)
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
        if topic.idle:
            topic.layout = None
            if not topic.outlets and not topic.inlets:
                self.topics.pop(topic.name, None)
