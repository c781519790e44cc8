"""Messages of r2p's own services on one link: a rate for those that go out, a limit for those that come in.

On a link with a key, a request that changes something goes out behind its seal, and counts only behind one.

They must not get in the way of data, so the longest of them counts as nine management messages, and the link sends as
many as its rate allows. What waits is bounded, and a message that is repeated while it waits is sent once.
"""

from collections import deque
from collections.abc import Hashable
from typing import Any, Protocol

from r2p.clock import Alarm
from r2p.codecs import call_parts, own_services
from r2p.codecs.own_services import MESSAGE_MAX
from r2p.runtime.topic import TopicSpace
from r2p.transports.guard import LinkGuard
from r2p.transports.stats import LinkStats
from r2p.units import SECOND

_UNLIMITED = 250.0  # management messages a second of a link that could carry many more
_FAST = 1000.0  # parts a second on such a link: 110 of the longest messages

_BURST = 0.1  # seconds of the rate that may go at once
_WAITING_MAX = 64  # messages that wait for their turn
_RECEIVED_MAX = 500  # messages a second that are looked at


class CallLink(Protocol):
    """A link as its channel for calls sees it."""

    up: bool
    stats: LinkStats
    guard: LinkGuard | None

    def write_call(self, data: bytes, to: Hashable) -> None:
        """Send a message, to this address at least."""


class CallHub(Protocol):
    """The module as the channel of a link sees it."""

    @property
    def space(self) -> TopicSpace: ...

    def call_received(self, link: Any, data: bytes, source: Hashable) -> None:
        """Handle a message from this address."""


class CallChannel:
    """The calls and answers of one link.

    `management_rate` is the number of management messages a second that the link carries; a part is as long as one.
    """

    def __init__(self, link: CallLink, hub: CallHub, management_rate: float) -> None:
        self.rate = rate = management_rate if management_rate < _UNLIMITED else _FAST
        """Parts (`r2p.codecs.call_parts`) a second, whether the link needs parts or not."""
        space = hub.space
        self._link = link
        self._hub = hub
        self._clock = space.clock
        self._lost = link.stats.lost
        self._alarm = Alarm(space.loop, self._serve, background=True)
        self._waiting: deque[tuple[bytes, Hashable]] = deque()
        self._credit = rate * _BURST
        self._credited_at = self._clock.monotonic()
        self._second = self._credited_at
        self._count = 0  # messages received in the second that began then

    @property
    def duration(self) -> float:
        """Seconds that a longest message takes at the link's rate."""
        return call_parts.count(MESSAGE_MAX) / self.rate

    @property
    def is_fast(self) -> bool:
        """Return whether the link carries many more messages than its rate."""
        return self.rate >= _FAST

    @property
    def full(self) -> bool:
        """Return whether as many messages wait as may."""
        return len(self._waiting) >= _WAITING_MAX

    def send(self, data: bytes, to: Hashable) -> None:
        """Send a message as soon as the rate allows."""
        if (data, to) in self._waiting:
            return
        if self.full:
            self._lost["calls, send buffer full"] += 1
            return
        self._waiting.append((data, to))
        self._serve()

    def receive(self, data: bytes, source: Hashable) -> None:
        """Pass a received message on, unless there are too many."""
        now = self._clock.monotonic()
        if now - self._second >= SECOND:
            self._second, self._count = now, 0
        self._count += 1
        if self._count > _RECEIVED_MAX:
            self._lost["too many calls"] += 1
        elif self._link.up and self._counts(data, source):
            self._hub.call_received(self._link, data, source)

    def _counts(self, data: bytes, source: Hashable) -> bool:
        """Return whether a message counts on this link: it may need a seal."""
        guard = self._link.guard
        return guard is None or not own_services.is_change(data) or guard.admits_call(data, source, self.duration)

    def clear(self) -> None:
        """Forget what waits: the link is down, and callers repeat what they still need."""
        self._waiting.clear()
        self._alarm.close()

    def _serve(self) -> None:
        now = self._clock.monotonic()
        self._credit = min(self.rate * _BURST, self._credit + (now - self._credited_at) * self.rate / SECOND)
        self._credited_at = now
        while self._waiting and self._credit > -1e-9:  # which goes below zero: what is cheap need not save up for that
            data, to = self._waiting.popleft()
            self._credit -= call_parts.count(len(data))
            self._lost.guard(self._write, data, to)
        if self._waiting:
            self._alarm.set(now + max(1, round(-self._credit * SECOND / self.rate)))

    def _write(self, data: bytes, to: Hashable) -> None:
        if self._link.guard is not None and own_services.is_change(data):
            self._link.guard.seal_call(data)
            self._credit -= 1
        self._link.write_call(data, to)
