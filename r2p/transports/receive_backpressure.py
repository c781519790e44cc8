"""How a message that came by a link waits for room in a full queue.

A `BlockedMessage` waits for some turns of the event loop. Then its owner decides: `LinkBackpressure` on links with one
way in, and on zenoh the `Backlog` of the topic (`r2p.transports.zenoh.backlog`).

A slow reader must not stop a line that others share, and a fast one should lose nothing. So a full queue gets
FULL_QUEUE_TURNS turns of the event loop to make room. If it makes none, this link treats it as lossy (puts messages in
by force, which drops older ones) until it has plenty of room again. Where a gateway passes messages on to a link
without room, and the sender waits while nothing is read, the line stands still instead, for LONGEST_STALL seconds at
most: so backpressure reaches from end to end.
"""

import abc
import asyncio
import functools
from collections.abc import Callable

from r2p.runtime.backpressure import INTERNAL_ERROR, PendingDelivery, Sink
from r2p.runtime.sample import PublisherClass, Sample
from r2p.runtime.topic import RemoteSubscriber
from r2p.transports.stats import LoggedCounter

FULL_QUEUE_TURNS = 4
"""Turns of the event loop that a link waits for a full queue before it goes on without it."""

LONGEST_STALL = 1.0
"""Seconds that a line stands still, at most, while another link has no room."""

SHORTEST_STALL = 0.05
"""Seconds that it stands still, at most, right after a stall that has not helped.

Where many topics have no room, the line would otherwise stand still for LONGEST_STALL once for each of them. The limit
grows with the time since that stall, up to LONGEST_STALL. 0.05 is a choice: 20 blocked topics cost a second.
"""


class ReceiveBackpressure(abc.ABC):
    """The owner of a `BlockedMessage`: delivers what comes by a link in order, and decides how long a message waits."""

    def __init__(self, loop: asyncio.AbstractEventLoop, lost: LoggedCounter) -> None:
        self.loop = loop
        self.lost = lost

    @abc.abstractmethod
    def delivered(self) -> None:
        """Go on with the next message: every sink has this one or has given it up. Called in a turn of its own."""

    @abc.abstractmethod
    def expired(self, message: "BlockedMessage") -> None:
        """Decide about the sinks that have made no room within FULL_QUEUE_TURNS turns."""


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
        """Stop waiting for this sink."""
        sink.get_wait_queue().remove(sink, self)
        self.remaining.remove(sink)

    def on_completed(self, sink: Sink, reason: str) -> None:
        if self._holds and not self.remaining:
            self._owner.loop.call_soon(self._owner.delivered)  # after the work of the reader that made room

    def _retry(self) -> None:
        self.remaining = [sink for sink in self.remaining if not self._offer(sink)]
        for sink in self.remaining:
            sink.get_wait_queue().add(sink, self)
        self._look()

    def _offer(self, sink: Sink) -> bool:
        """Offer the message to a sink. Returns True if its wait is over: it has the message, or has raised."""
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
    """What waits for room on a link with one way in. While a message waits, the link delivers no other.

    `resume` is called when the message has been delivered or given up. `flow_controlled` says whether the other end
    waits while nothing is read, and nothing is lost by that.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        lost: LoggedCounter,
        resume: Callable[[], None],
        flow_controlled: Callable[[], bool],
    ) -> None:
        super().__init__(loop, lost)
        self._resume = resume
        self._flow_controlled = flow_controlled
        self._lossy: set[Sink] = set()
        """Sinks that were waited for in vain, and have not had plenty of room since."""
        self._stalled: BlockedMessage | None = None
        """The message for which the line stands still."""
        self._stall: asyncio.TimerHandle | None = None
        self._in_vain_at = -LONGEST_STALL
        self._closed = False

    def wait(self, sample: Sample, blocked: list[Sink]) -> bool:
        """Wait for room in these sinks: `resume` is called later. Returns False if none of them is worth a wait."""
        for sink in self._lossy.intersection(blocked):
            self.lost.guard(sink.force, sample)
        waiting = [sink for sink in blocked if sink not in self._lossy]
        if waiting:
            BlockedMessage(sample, waiting, self)
        return bool(waiting)

    def close(self) -> None:
        """End a stall, and begin no other."""
        self._closed = True
        if self._stalled is not None:
            self._stalled.withdraw()
            self._end_stall()

    def delivered(self) -> None:
        self._end_stall()
        self._resume()

    def expired(self, message: BlockedMessage) -> None:
        # Only other links stall the line: a slow reader in this module loses messages, so that other topics go on.
        may_stall = self._flow_controlled() and not self._closed
        slow = [sink for sink in message.remaining if not (may_stall and isinstance(sink, RemoteSubscriber))]
        # Events and periodic messages stall nothing: they would be stale. The other link is no less waited for later.
        stalls = message.sample.publisher_class == PublisherClass.NON_REAL_TIME
        rest = slow if stalls else list(message.remaining)
        for sink in rest:
            message.leave(sink)
        for sink in rest:
            self.lost.guard(sink.force, message.sample)
        for sink in slow:
            self._lossy.add(sink)
            sink.get_wait_queue().recoveries.append(functools.partial(self._lossy.discard, sink))
        if message.remaining:
            self._begin_stall(message)
        else:
            self._resume()

    # Stall: the line stands still until there is room on the links that the message goes out by, or the time is over

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

    def _give_up(self, message: BlockedMessage, reason: str) -> None:
        guard = self.lost.guard
        for sink in list(message.remaining):
            guard(sink.refill)  # a last attempt
        for sink in list(message.remaining):
            if not guard(sink.become_lossy, reason):
                sink.get_wait_queue().remove(sink, message)
                message.complete(sink, INTERNAL_ERROR)  # else the line would stand still for ever
            self._in_vain_at = self.loop.time()
