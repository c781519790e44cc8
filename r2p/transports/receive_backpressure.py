"""What becomes of a message from a link that finds a queue full.

A slow reader must not stop a line that others share, and a fast one should lose nothing. So a full queue gets
FULL_QUEUE_TURNS turns of the event loop to make room; one that does not is lossy, for this link, until it has plenty.
What a gateway passes on from an end with flow control gets LONGEST_STALL seconds, as what is published here does: so
backpressure reaches from end to end.
"""

import asyncio
import functools
from typing import TYPE_CHECKING, Protocol

from r2p.runtime.backpressure import INTERNAL_ERROR, PendingDelivery, Sink
from r2p.runtime.sample import Sample
from r2p.runtime.topic import RemoteSubscriber
from r2p.transports.stats import LinkStats

if TYPE_CHECKING:
    from collections.abc import Callable

FULL_QUEUE_TURNS = 4
"""Turns of the event loop that a link waits for a full queue before it goes on without it."""

LONGEST_STALL = 1.0
"""Seconds for which a line stands still, at most, as another link has no room."""

SHORTEST_STALL = 0.05
"""... and right after that was in vain: where many topics have no room, the line must not stand still once for each. It
grows with the time that has passed since."""


class ReceivingLink(Protocol):
    """The link whose messages are delivered. While one waits for room, the link delivers no other."""

    stats: LinkStats

    @property
    def flow_controlled(self) -> bool:
        """Whether the other end waits while nothing is read, and nothing is lost by that."""

    def room_found(self) -> None:
        """The message that had no room has been delivered, or given up: go on with those behind it."""


class _PendingArrival(PendingDelivery):
    """A message that came in, and waits in line with what this module publishes: first come, first served."""

    __slots__ = ("over",)

    def __init__(self, sample: Sample, sinks: list[Sink]) -> None:
        self.over: Callable[[], None] | None = None
        """Called when it is delivered; until that is set, each turn looks whether it is."""
        super().__init__(sample, sinks)

    def completed(self, sink: Sink, refusal: str) -> None:
        if not self.remaining and self.over is not None:
            self.over()


class ReceiveBackpressure:
    """How long one link waits for the sinks of the message that it delivers."""

    def __init__(self, link: ReceivingLink, loop: asyncio.AbstractEventLoop) -> None:
        self._link = link
        self._loop = loop
        self._lossy: set[Sink] = set()
        """Sinks that were waited for in vain, and have not had plenty of room since."""
        self._turns = 0
        self._stalled: _PendingArrival | None = None
        self._stall: asyncio.TimerHandle | None = None
        self._in_vain_at = -LONGEST_STALL
        self._closed = False

    def wait(self, sample: Sample, blocked: list[Sink]) -> bool:
        """Wait for room in these sinks: `room_found` of the link follows. Returns False if none is worth it."""
        guard = self._link.stats.lost.guard
        for sink in self._lossy.intersection(blocked):
            guard(sink.force, sample)
        waiting = [sink for sink in blocked if sink not in self._lossy]
        if not waiting:
            return False
        self._turns = FULL_QUEUE_TURNS
        self._loop.call_soon(self._look, _PendingArrival(sample, waiting))
        return True

    def close(self) -> None:
        """Wait no more."""
        self._closed = True
        if self._stalled is not None:
            self._stalled.withdraw()
            self._end_stall()

    def _look(self, pending: _PendingArrival) -> None:
        self._turns -= 1
        if pending.remaining and self._turns > 0 and not self._closed:
            self._loop.call_soon(self._look, pending)
            return
        may_stall = self._link.flow_controlled and not self._closed
        # Only other links stall the line: a slow reader in this module loses messages, and the topics of others go on.
        links: list[Sink] = [sink for sink in pending.remaining if may_stall and isinstance(sink, RemoteSubscriber)]
        for sink in pending.withdraw():
            if sink not in links:
                self._link.stats.lost.guard(sink.force, pending.sample)
                self._lossy.add(sink)
                sink.wait_queue().recoveries.append(functools.partial(self._lossy.discard, sink))
        if links:
            self._begin_stall(_PendingArrival(pending.sample, links))
        else:
            self._link.room_found()

    # Stall: the line stands still until the links that the message goes out by have room, or had none for too long

    def _begin_stall(self, pending: _PendingArrival) -> None:
        pending.over = self._stall_over
        self._stalled = pending
        longest = min(LONGEST_STALL, max(SHORTEST_STALL, self._loop.time() - self._in_vain_at))
        self._stall = self._loop.call_later(longest, self._give_up, pending, f"no room for {longest:.2g} s")

    def _stall_over(self) -> None:
        self._end_stall()
        self._loop.call_soon(self._link.room_found)  # after the work of the reader that made room

    def _end_stall(self) -> None:
        self._stalled = None
        if self._stall is not None:
            self._stall.cancel()
            self._stall = None

    def _give_up(self, pending: _PendingArrival, refusal: str) -> None:
        guard = self._link.stats.lost.guard
        for sink in list(pending.remaining):
            guard(sink.refill)  # a last attempt
        for sink in list(pending.remaining):
            if not guard(sink.become_lossy, refusal):
                sink.wait_queue().remove(sink, pending)
                pending.complete(sink, INTERNAL_ERROR)  # else the line would stand still for ever
            self._in_vain_at = self._loop.time()
