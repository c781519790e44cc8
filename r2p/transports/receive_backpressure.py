"""What becomes of a message from a link that finds a queue full.

A `BlockedMessage` waits for room for some turns of the event loop. What happens then is up to the kind of link: to
`LinkBackpressure` for links with one way in, and on zenoh to each topic (`r2p.transports.zenoh.backlog`).

A slow reader must not stop a line that others share, and a fast one should lose nothing. So a full queue gets
FULL_QUEUE_TURNS turns of the event loop to make room; one that does not is lossy, for this link, until it has plenty.
What a gateway passes on from an end with flow control gets LONGEST_STALL seconds, as what is published here does: so
backpressure reaches from end to end.
"""

import abc
import asyncio
import functools
from typing import Protocol

from r2p.runtime.backpressure import INTERNAL_ERROR, PendingDelivery, Sink
from r2p.runtime.sample import Sample
from r2p.runtime.topic import RemoteSubscriber
from r2p.transports.stats import LinkStats, LoggedCounter

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


class ReceiveBackpressure(abc.ABC):
    """What delivers messages from a link one after the other, and waits for room when one finds none."""

    def __init__(self, loop: asyncio.AbstractEventLoop, lost: LoggedCounter) -> None:
        self.loop = loop
        self.lost = lost

    @abc.abstractmethod
    def delivered(self) -> None:
        """No sink lacks the message any more; called in a turn of the loop of its own."""

    @abc.abstractmethod
    def expired(self, message: "BlockedMessage") -> None:
        """Some sinks have made no room within FULL_QUEUE_TURNS turns."""


class BlockedMessage(PendingDelivery):
    """A message from a link that waits for room, in line with what this module publishes: first come, first served."""

    __slots__ = ("_holds", "_owner", "_turns")

    def __init__(self, sample: Sample, sinks: list[Sink], owner: ReceiveBackpressure) -> None:
        super().__init__(sample, [])
        self.remaining = sinks  # in line only after a turn: most readers make room within it, and lines cost time
        self._owner = owner
        self._holds = False
        self._turns = FULL_QUEUE_TURNS
        owner.loop.call_soon(self._retry)

    def hold(self) -> None:
        """Wait on, without a limit."""
        self._holds = True

    def leave(self, sink: Sink) -> None:
        """Wait no more for this sink."""
        sink.wait_queue().remove(sink, self)
        self.remaining.remove(sink)

    def completed(self, sink: Sink, refusal: str) -> None:
        if self._holds and not self.remaining:
            self._owner.loop.call_soon(self._owner.delivered)  # after the work of the reader that made room

    def _retry(self) -> None:
        self.remaining = [sink for sink in self.remaining if not self._offer(sink)]
        for sink in self.remaining:
            sink.wait_queue().add(sink, self)
        self._look()

    def _offer(self, sink: Sink) -> bool:
        """Whether the sink is not waited for any more: it has the message, or has raised."""
        try:
            return sink.offer(self.sample)
        except Exception as error:  # noqa: BLE001 - counted and logged; the others follow
            self._owner.lost.internal_error(error)
            return True

    def _look(self) -> None:
        self._turns -= 1
        if not self.remaining:
            self._owner.delivered()
        elif self._turns > 0:
            self._owner.loop.call_soon(self._look)
        else:
            self._owner.expired(self)


class LinkBackpressure(ReceiveBackpressure):
    """How long one link waits for the sinks of the message that it delivers."""

    def __init__(self, link: ReceivingLink, loop: asyncio.AbstractEventLoop) -> None:
        super().__init__(loop, link.stats.lost)
        self._link = link
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
            self.lost.guard(sink.force, sample)
        waiting = [sink for sink in blocked if sink not in self._lossy]
        if waiting:
            BlockedMessage(sample, waiting, self)
        return bool(waiting)

    def close(self) -> None:
        """Let the line stand still no more."""
        self._closed = True
        if self._stalled is not None:
            self._stalled.withdraw()
            self._end_stall()

    def delivered(self) -> None:
        self._end_stall()
        self._link.room_found()

    def expired(self, message: BlockedMessage) -> None:
        # Only other links stall the line: a slow reader in this module loses messages, so that other topics go on.
        may_stall = self._link.flow_controlled and not self._closed
        rest = [sink for sink in message.remaining if not (may_stall and isinstance(sink, RemoteSubscriber))]
        for sink in rest:
            message.leave(sink)
        for sink in rest:
            self.lost.guard(sink.force, message.sample)
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
        longest = min(LONGEST_STALL, max(SHORTEST_STALL, self.loop.time() - self._in_vain_at))
        self._stall = self.loop.call_later(longest, self._give_up, message, f"no room for {longest:.2g} s")

    def _end_stall(self) -> None:
        self._stalled = None
        if self._stall is not None:
            self._stall.cancel()
            self._stall = None

    def _give_up(self, message: BlockedMessage, refusal: str) -> None:
        guard = self.lost.guard
        for sink in list(message.remaining):
            guard(sink.refill)  # a last attempt
        for sink in list(message.remaining):
            if not guard(sink.become_lossy, refusal):
                sink.wait_queue().remove(sink, message)
                message.complete(sink, INTERNAL_ERROR)  # else the line would stand still for ever
            self._in_vain_at = self.loop.time()
