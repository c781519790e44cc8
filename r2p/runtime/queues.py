"""The bounded queues of subscribers: a full one drops its oldest message, and a new message wakes the reader.

    Topic.deliver   -> there is room: append the message
                    -> the queue is full: the publisher waits, where it may (`backpressure`)
                    -> ... or `SubscriberQueue.drop_oldest` makes room, counted in `lost`

Waking is separate from queueing. The nodes of the highest priority are woken directly, the others one for each turn of
the event loop: so an important node waits at most for a few steps of less important ones.
"""

import asyncio
import heapq
import itertools
import logging
import types
from collections import deque
from collections.abc import Generator
from typing import Protocol

from r2p.messages import SIZE_MAX
from r2p.runtime.backpressure import NO_ROOM, Sink, WaitQueue
from r2p.runtime.sample import PublisherClass, Sample

YIELD_EVERY = 16
"""Messages that publish() or an iteration handles before it lets the event loop run once.

A turn of the loop takes as long as a few messages, so not after each one; other tasks wait for so many at most.
"""

QUEUE_BYTES = 64 << 20
"""Bytes of the messages in a subscriber's queue, by default: it is full from there on."""

_NRT = PublisherClass.NON_REAL_TIME


@types.coroutine
def checkpoint() -> Generator[None, None, None]:
    """Let the event loop run once: `asyncio.sleep(0)` without the calls around it."""
    yield


class Pulse:
    """Wakes the tasks that wait for it now; those that come later wait for the next pulse.

    Every publisher and subscriber has one: an `asyncio.Event` in its place would take 800 bytes of each.
    """

    __slots__ = ("_waiters",)

    def __init__(self) -> None:
        self._waiters: list[asyncio.Future[None]] = []

    async def wait(self) -> None:
        waiter = asyncio.get_running_loop().create_future()
        self._waiters.append(waiter)
        try:
            await waiter
        finally:
            self._waiters.remove(waiter)

    def emit(self) -> None:
        for waiter in self._waiters:
            if not waiter.done():
                waiter.set_result(None)


class EndpointOwner(Protocol):
    """The node that a publisher or a subscriber belongs to."""

    name: str
    priority: int

    @property
    def log(self) -> logging.LoggerAdapter[logging.Logger]: ...

    @property
    def ending(self) -> bool:
        """Return whether the node's callbacks must no longer be called."""

    def crash(self, error: Exception) -> None:
        """End the node with an error of one of its callbacks."""

    def forget(self, endpoint: object) -> None:
        """Drop a closed publisher or subscriber of the node."""


class WakeScheduler:
    """Wakes waiting subscribers: those of the highest priority at once, the others one a turn, highest first."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._readers: list[tuple[int, int, asyncio.Future[None]]] = []
        """A heap of readers to wake: negated priority, a running number, the reader's future."""
        self._order = itertools.count()
        self._running = False
        self._priorities: dict[int, int] = {}
        self.top = 0
        """The highest priority of all nodes that run."""

    def node_started(self, priority: int) -> None:
        self._priorities[priority] = self._priorities.get(priority, 0) + 1
        self.top = max(self._priorities)

    def node_ended(self, priority: int) -> None:
        self._priorities[priority] -= 1
        if not self._priorities[priority]:
            del self._priorities[priority]
        self.top = max(self._priorities, default=0)

    def wake(self, priority: int, waiter: asyncio.Future[None]) -> None:
        """Wake a reader of the highest priority now, any other in its turn."""
        if priority < self.top:
            self.wake_later(priority, waiter)
        elif not waiter.done():
            waiter.set_result(None)

    def wake_later(self, priority: int, waiter: asyncio.Future[None]) -> None:
        """Wake the reader in its turn."""
        # The number keeps the order within a priority, and futures from being compared.
        heapq.heappush(self._readers, (-priority, next(self._order), waiter))
        if not self._running:
            self._running = True
            self._loop.call_soon(self._turn)

    def _turn(self) -> None:
        while self._readers:
            waiter = heapq.heappop(self._readers)[2]
            if not waiter.done():  # else its task was cancelled meanwhile
                waiter.set_result(None)
                self._loop.call_soon(self._turn)  # the next one a turn later: important nodes come in between
                return
        self._running = False


class SampleQueue(deque[Sample]):
    """Unread messages whose bytes are counted: with `most` of them the queue is full, however few messages they are.

    It has room for one message at least, so its bytes exceed `most` by less than one message. Small messages of fixed
    length can't be so many, and have a `deque` instead: counting takes time.
    """

    def __init__(self, sink: "SubscriberQueue", most: int) -> None:
        super().__init__()
        self._sink = sink
        self._most = most
        self._bytes = 0

    def append(self, sample: Sample) -> None:
        super().append(sample)
        self._count(len(sample.data))

    def popleft(self) -> Sample:
        sample = super().popleft()
        self._count(-len(sample.data))
        return sample

    def clear(self) -> None:
        super().clear()
        self._count(-self._bytes)

    def _count(self, change: int) -> None:
        self._bytes += change
        sink = self._sink
        sink.limit = sink.places if self._bytes < self._most else min(len(self), sink.places)


class SubscriberQueue(Sink):
    """The bounded queue of one subscriber: its topic fills it, the subscriber empties it.

    `limit` is the number of messages at which it is full now: fewer than `places`, while they have too many bytes.
    """

    __slots__ = (
        "_wake_scheduler",
        "keep_oldest",
        "limit",
        "lossy",
        "node",
        "places",
        "priority",
        "publisher_came",
        "queue",
        "size_max",
        "too_long",
        "typed",
        "wait_queue",
        "waiter",
    )

    def __init__(
        self, wake_scheduler: WakeScheduler, node: EndpointOwner, limit: int, *, lossy: bool, keep_oldest: bool
    ) -> None:
        super().__init__()
        self._wake_scheduler = wake_scheduler
        self.node = node
        self.limit = self.places = limit
        self.priority = node.priority
        self.keep_oldest = keep_oldest
        self.lossy = lossy
        self.blocks_publishers = not lossy
        self.queue: deque[Sample] = deque()
        """Unread messages. A link or a publisher appends to it itself, after a look at `limit`."""
        self.size_max = SIZE_MAX
        """Bytes of the longest message that the subscriber's type allows."""
        self.typed = True
        """False for a subscriber of any type, which gets packed messages."""
        self.too_long = 0
        """Messages longer than the subscriber's type allows."""
        self.waiter: asyncio.Future[None] | None = None
        """The reader's future, while it waits for a message."""
        self.publisher_came = Pulse()
        """Pulsed, never left set: wakes tasks that wait for a publisher."""
        self.wait_queue: WaitQueue | None = None
        """Deliveries that wait for room; while there are any, each reader that pops a message has to call `refill`."""

    @property
    def owner(self) -> str:
        return self.node.name

    def offer(self, sample: Sample) -> bool:
        if len(self.queue) >= self.limit:
            return False
        self._append(sample)
        return True

    def drop_oldest(self) -> bool:
        """Drop the oldest message of the full queue for a new one. False with `keep_oldest`: the new one is dropped."""
        self.lost += 1
        if self.keep_oldest:
            return False
        self.queue.popleft()
        while len(self.queue) >= self.limit:  # by its bytes: a long message takes the place of many
            self.queue.popleft()
            self.lost += 1
        return True

    def force(self, sample: Sample) -> None:
        if self.offer(sample):
            return
        # Earlier messages of the same publisher that still wait go in first: its messages keep their order.
        overtaken = [] if self.wait_queue is None or self.keep_oldest else self.wait_queue.pop_earlier(self, sample)
        for each in (*(delivery.sample for delivery in overtaken), sample):
            if self.drop_oldest():
                self._append(each)
        for delivery in overtaken:  # last, with all samples in place: this may make the publisher publish more
            delivery.complete(self, NO_ROOM)

    def waits_for(self, sample: Sample) -> bool:
        """Return whether a full queue that became lossy still comes back to the sender of this sample.

        It is lossy only for samples that do not expire: events wait until their deadline as before. A publisher of this
        module gets its sample back, too, and counts the loss.
        """
        return not self.lossy and (sample.publisher_class != _NRT or not sample.source.link)

    def get_wait_queue(self) -> WaitQueue:
        if self.wait_queue is None:
            self.wait_queue = WaitQueue()
        return self.wait_queue

    def refill(self) -> None:
        if (wait_queue := self.wait_queue) is not None:
            wait_queue.serve()
            if len(self.queue) <= self.limit // 2:  # plenty: with one place it would be lossy again at once
                wait_queue.recover()
            if not wait_queue:
                self.wait_queue = None

    def publisher_joined(self) -> None:
        """Wake the tasks that wait for a publisher."""
        self.publisher_came.emit()

    def _append(self, sample: Sample) -> None:
        # `Topic.deliver` has a copy of this: change both.
        self.queue.append(sample)
        self.wake_reader()

    def wake_reader(self) -> None:
        """Wake the reader, if it waits for a message."""
        if (waiter := self.waiter) is not None:  # woken once: messages that follow find the reader awake
            self.waiter = None
            self._wake_scheduler.wake(self.priority, waiter)
