"""What happens to a module's links and on its network, for programs and tools that want to know.

A listener is a bounded queue that lives as long as somebody holds it: one that is never read, or given up, costs
nothing once it is forgotten.
"""

import asyncio
import itertools
import weakref
from collections import deque
from collections.abc import AsyncIterator

import msgspec

from r2p.protocols.discovery.events import Mismatched, ModuleChanged, ModuleGone, NameConflict

EVENTS = 256
"""Events that a listener holds before it loses the oldest."""


class LinkUp(msgspec.Struct, frozen=True):
    """A link works (again): after `outage` seconds, in which `lost` messages found it down."""

    link: str
    outage: float
    lost: int


class LinkDown(msgspec.Struct, frozen=True):
    """A link works no more."""

    link: str
    reason: str


class LinkWaits(msgspec.Struct, frozen=True):
    """A link can't be had yet; it is tried again and again."""

    link: str
    reason: str


class LinkNotice(msgspec.Struct, frozen=True):
    """Something on a link that is worth knowing, such as another master: `kind` for programs, `text` for people."""

    link: str
    kind: str
    text: str


class Listening(msgspec.Struct, frozen=True):
    """A transport takes connections."""

    url: str
    address: str


ModuleEvent = (
    LinkUp | LinkDown | LinkWaits | LinkNotice | Listening | Mismatched | ModuleChanged | ModuleGone | NameConflict
)


class EventHub:
    """Tells every listener what happens, until it is closed."""

    def __init__(self) -> None:
        self._listeners: weakref.WeakValueDictionary[int, _Listener] = weakref.WeakValueDictionary()
        self._numbers = itertools.count()
        self._closed = False

    def listen(self) -> AsyncIterator[ModuleEvent]:
        """All events from this call on, until the hub is closed."""
        listener = _Listener()
        listener.closed = self._closed
        self._listeners[next(self._numbers)] = listener
        return listener

    def emit(self, event: ModuleEvent) -> None:
        for listener in list(self._listeners.values()):
            listener.queue.append(event)
            listener.arrived.set()

    def close(self) -> None:
        """Nothing happens any more: listeners end when they have read what they hold."""
        self._closed = True
        for listener in list(self._listeners.values()):
            listener.closed = True
            listener.arrived.set()


class _Listener(AsyncIterator[ModuleEvent]):
    def __init__(self) -> None:
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
