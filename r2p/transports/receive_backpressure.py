"""What becomes of a message from a link that finds a queue full.

A slow reader must not stop a line that others share, and a fast one should lose nothing. So a full queue gets
FULL_QUEUE_TURNS turns of the event loop to make room; one that does not is lossy, for this link, until it has plenty.
What a gateway passes on from an end with flow control gets LONGEST_STALL seconds, as what is published here does: so
backpressure reaches from end to end.
"""

import asyncio
import functools
from collections.abc import Callable
from typing import Protocol

from r2p.runtime.backpressure import INTERNAL_ERROR, PendingDelivery, Sink
from r2p.runtime.sample import Sample
from r2p.runtime.topic import RemoteSubscriber
from r2p.transports.stats import LinkStats

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


class BlockedMessage(PendingDelivery):
    """A message from a link that waits for room, in line with what this module publishes: first come, first served.

    `delivered` is called in a turn of the loop of its own when no sink lacks it any more, and `expired` when some still
    do so after FULL_QUEUE_TURNS turns.
    """

    __slots__ = ("_delivered", "_expired", "_holds", "_loop", "_turns")

    def __init__(
        self,
        sample: Sample,
        sinks: list[Sink],
        loop: asyncio.AbstractEventLoop,
        delivered: Callable[[], object],
        expired: Callable[["BlockedMessage"], object],
    ) -> None:
        self._loop = loop
        self._delivered = delivered
        self._expired = expired
        self._holds = False
        self._turns = FULL_QUEUE_TURNS
        super().__init__(sample, sinks)
        loop.call_soon(self._look)

    def hold(self) -> None:
        """Wait on, without a limit."""
        self._holds = True

    def leave(self, sink: Sink) -> None:
        """Wait no more for this sink."""
        sink.wait_queue().remove(sink, self)
        self.remaining.remove(sink)

    def completed(self, sink: Sink, refusal: str) -> None:
        if self._holds and not self.remaining:
            self._loop.call_soon(self._delivered)  # after the work of the reader that made room

    def _look(self) -> None:
        self._turns -= 1
        if not self.remaining:
            self._delivered()
        elif self._turns > 0:
            self._loop.call_soon(self._look)
        else:
            self._expired(self)


class ReceiveBackpressure:
    """How long one link waits for the sinks of the message that it delivers."""

    def __init__(self, link: ReceivingLink, loop: asyncio.AbstractEventLoop) -> None:
        self._link = link
        self._loop = loop
        self._lossy: set[Sink] = set()
        """Sinks that were waited for in vain, and have not had plenty of room since."""
        self._stalled: BlockedMessage | None = None
        """The message for which the line stands still."""
        self._stall: asyncio.TimerHandle | None = None
        self._in_vain_at = -LONGEST_STALL
        self._closed = False

    def wait(self, sample: Sample, blocked: list[Sink]) -> bool:
        """Wait for room in these sinks: `room_found` of the link follows. Returns False if none is worth it."""
        for sink in self._lossy.intersection(blocked):
            self._link.stats.lost.guard(sink.force, sample)
        waiting = [sink for sink in blocked if sink not in self._lossy]
        if waiting:
            BlockedMessage(sample, waiting, self._loop, self._delivered, self._expired)
        return bool(waiting)

    def close(self) -> None:
        """Let the line stand still no more."""
        self._closed = True
        if self._stalled is not None:
            self._stalled.withdraw()
            self._end_stall()

    def _delivered(self) -> None:
        self._end_stall()
        self._link.room_found()

    def _expired(self, message: BlockedMessage) -> None:
        # Only other links stall the line: a slow reader in this module loses messages, so that other topics go on.
        may_stall = self._link.flow_controlled and not self._closed
        rest = [sink for sink in message.remaining if not (may_stall and isinstance(sink, RemoteSubscriber))]
        for sink in rest:
            message.leave(sink)
        for sink in rest:
            self._link.stats.lost.guard(sink.force, message.sample)
            self._lossy.add(sink)
            sink.wait_queue().recoveries.append(functools.partial(self._lossy.discard, sink))
        if message.remaining:
            self._begin_stall(message)
        else:
            self._link.room_found()

    # Stall: the line stands still until the links that the message goes out by have room, or had none for too long

    def _begin_stall(self, message: BlockedMessage) -> None:
        message.hold()
        self._stalled = message
        longest = min(LONGEST_STALL, max(SHORTEST_STALL, self._loop.time() - self._in_vain_at))
        self._stall = self._loop.call_later(longest, self._give_up, message, f"no room for {longest:.2g} s")

    def _end_stall(self) -> None:
        self._stalled = None
        if self._stall is not None:
            self._stall.cancel()
            self._stall = None

    def _give_up(self, message: BlockedMessage, refusal: str) -> None:
        guard = self._link.stats.lost.guard
        for sink in list(message.remaining):
            guard(sink.refill)  # a last attempt
        for sink in list(message.remaining):
            if not guard(sink.become_lossy, refusal):
                sink.wait_queue().remove(sink, message)
                message.complete(sink, INTERNAL_ERROR)  # else the line would stand still for ever
            self._in_vain_at = self._loop.time()
