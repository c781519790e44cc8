"""Events about a module's links and its network, which programs and tools iterate over.

A listener is a bounded queue that lives as long as its iterator: an abandoned one is garbage-collected.
"""

import asyncio
import itertools
import weakref
from collections import deque
from collections.abc import AsyncIterator

import msgspec

from r2p.protocols.discovery.events import Mismatched, ModuleChanged, ModuleGone, NameConflict

EVENTS = 256
"""Events that a listener holds; one more drops the oldest."""


class LinkUp(msgspec.Struct, frozen=True):
    """A link is up: for the first time, or after `outage` seconds, in which `lost` messages were lost."""

    link: str
    outage: float
    lost: int


class LinkDown(msgspec.Struct, frozen=True):
    """A link is down; it is tried again for ever."""

    link: str
    reason: str


class LinkWaits(msgspec.Struct, frozen=True):
    """A link can't be set up yet; it is tried again for ever. One event for each new reason."""

    link: str
    reason: str


class LinkNotice(msgspec.Struct, frozen=True):
    """Something else about a link, such as another master on its bus: `kind` is for programs, `text` for people."""

    link: str
    kind: str
    text: str


class Listening(msgspec.Struct, frozen=True):
    """A transport accepts connections at this address."""

    url: str
    address: str


ModuleEvent = (
    LinkUp | LinkDown | LinkWaits | LinkNotice | Listening | Mismatched | ModuleChanged | ModuleGone | NameConflict
)


class EventHub:
    """Hands events to all listeners, until it is closed."""

    def __init__(self) -> None:
        # By number, not in a WeakSet: so listeners are woken in the same order in every run under virtual time.
        self._listeners: weakref.WeakValueDictionary[int, EventListener] = weakref.WeakValueDictionary()
        self._numbers = itertools.count()
        self._closed = False

    def listen(self) -> "EventListener":
        """Iterate over all events from this call on, until the hub is closed."""
        listener = EventListener()
        listener.closed = self._closed
        self._listeners[next(self._numbers)] = listener
        return listener

    def emit(self, event: ModuleEvent) -> None:
        if not self._listeners:  # as almost always
            return
        for listener in list(self._listeners.values()):
            listener.lost += len(listener.queue) == EVENTS
            listener.queue.append(event)
            listener.arrived.set()

    def close(self) -> None:
        """Let each listener end when it has read all its events."""
        self._closed = True
        for listener in list(self._listeners.values()):
            listener.closed = True
            listener.arrived.set()


class EventListener(AsyncIterator[ModuleEvent]):
    """Iterates over events; `lost` counts those that it was too slow for."""

    def __init__(self) -> None:
        self.lost = 0
        self.queue: deque[ModuleEvent] = deque(maxlen=EVENTS)
        self.arrived = asyncio.Event()
        self.closed = False

    async def __anext__(self) -> ModuleEvent:
        while not self.queue:
            if self.closed:
                raise StopAsyncIteration
            self.arrived.clear()
            await self.arrived.wait()
        return self.queue.popleft()
