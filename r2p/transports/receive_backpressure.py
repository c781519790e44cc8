"""Let a message from a link wait for room in a full queue.

A `BlockedMessage` waits FULL_QUEUE_TURNS turns of the event loop: most readers make room within them. Then its owner
decides. There are two owners, as a slow reader must not stop others, and a fast one should lose nothing:

`LinkBackpressure`, on a link whose topics share one way in. A queue that made no room is treated as lossy (it gets
messages by force, which drops older ones) until it has plenty of room again. Where a gateway passes messages on to a
link without room, and the sender waits while nothing is read, the link stops reading instead, for STALL_MAX_S seconds
at most: so backpressure is end to end.

`Backlog`, for one topic on zenoh, whose packets wait apart from those of other topics. A message that does not expire
waits without a limit, and its publisher gets no credit meanwhile. An event or a periodic message replaces an older one.
"""

import abc
import asyncio
import functools
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

from r2p.runtime.backpressure import INTERNAL_ERROR, PendingDelivery, Sink
from r2p.runtime.sample import PublisherClass, Sample
from r2p.runtime.topic import RemoteSubscriber
from r2p.transports.stats import LoggedCounter

P = TypeVar("P")  # what is known of a message's publisher; it is only passed on

FULL_QUEUE_TURNS = 4
"""Turns of the event loop for which a link waits for a full queue."""

STALL_MAX_S = 1.0
"""Seconds for which a link reads nothing, at most, while another link has no room."""

STALL_MIN_S = 0.05
"""Seconds for which it reads nothing, at most, right after a stall that has not helped.

Where many topics have no room, the link would otherwise stall for STALL_MAX_S once for each of them. The limit grows
with the time since that stall, up to STALL_MAX_S. 0.05 is a choice: 20 blocked topics cost a second.
"""

BACKLOG_MAX = 16_384
"""Messages that wait behind one that is blocked: what eight publishers may send meanwhile."""

BACKLOG_BYTES_MAX = 64 << 20
"""Bytes of those messages from which on no more are accepted."""


class ReceiveBackpressure(abc.ABC):
    """The owner of a `BlockedMessage`: delivers a link's messages in order, and decides how long each waits."""

    def __init__(self, loop: asyncio.AbstractEventLoop, lost: LoggedCounter) -> None:
        self.loop = loop
        self.lost = lost

    @abc.abstractmethod
    def on_delivered(self) -> None:
        """Go on with the next message: every sink has this one or has given it up. Called in a turn of its own."""

    @abc.abstractmethod
    def on_expired(self, message: "BlockedMessage") -> None:
        """Decide about the sinks that have made no room within FULL_QUEUE_TURNS turns."""


class BlockedMessage(PendingDelivery):
    """A message from a link that waits for room, in line with what this module publishes: first come, first served."""

    __slots__ = ("_holds", "_owner", "_turns")

    def __init__(self, sample: Sample, sinks: list[Sink], owner: ReceiveBackpressure) -> None:
        super().__init__(sample, [])
        self.remaining = sinks  # in their wait queues after a turn only: most make room within it, and queues cost time
        self._owner = owner
        self._holds = False
        self._turns = FULL_QUEUE_TURNS
        owner.loop.call_soon(self._retry)

    def hold(self) -> None:
        """Keep waiting, without a limit."""
        self._holds = True

    def leave(self, sink: Sink) -> None:
        """Stop waiting for this sink."""
        sink.get_wait_queue().remove(sink, self)
        self.remaining.remove(sink)

    def on_completed(self, sink: Sink, reason: str) -> None:
        if self._holds and not self.remaining:
            self._owner.loop.call_soon(self._owner.on_delivered)  # after the work of the reader that made room

    def _retry(self) -> None:
        self.remaining = [sink for sink in self.remaining if not self._offer(sink)]
        for sink in self.remaining:
            sink.get_wait_queue().add(sink, self)
        self._check_remaining()

    def _offer(self, sink: Sink) -> bool:
        """Offer the message to a sink. Return True if the wait is over: the sink has the message, or raised."""
        try:
            return sink.offer(self.sample)
        except Exception as error:  # noqa: BLE001 - counted and logged; the others follow
            self._owner.lost.internal_error(error)
            return True

    def _check_remaining(self) -> None:
        self._turns -= 1
        if not self.remaining:
            self._owner.on_delivered()
        elif self._turns > 0:
            self._owner.loop.call_soon(self._check_remaining)
        else:
            self._owner.on_expired(self)


class LinkBackpressure(ReceiveBackpressure):
    """Backpressure of a link with one way in. While a message waits for room, the link delivers no other.

    `resume` is called when the message has been delivered or given up. `flow_controlled` says whether the other end
    waits while nothing is read, without losing anything.
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
        self._lossy: set[Sink] = set()  # those that were waited for in vain, and have not had plenty of room since
        self._stalled: BlockedMessage | None = None  # the message for which the link reads nothing
        self._stall_timer: asyncio.TimerHandle | None = None
        self._in_vain_at = -STALL_MAX_S  # when the last stall ended that has not helped (s)
        self._closed = False

    def wait(self, sample: Sample, blocked: list[Sink]) -> bool:
        """Wait for room in these sinks: `resume` is called later. Return False if none of them is worth a wait."""
        for sink in self._lossy.intersection(blocked):
            self.lost.guard(sink.force, sample)
        worth_a_wait = [sink for sink in blocked if sink not in self._lossy]
        if worth_a_wait:
            BlockedMessage(sample, worth_a_wait, self)
        return bool(worth_a_wait)

    def close(self) -> None:
        """End a stall, and begin no other."""
        self._closed = True
        if self._stalled is not None:
            self._stalled.withdraw()
            self._end_stall()

    def on_delivered(self) -> None:
        self._end_stall()
        self._resume()

    def on_expired(self, message: BlockedMessage) -> None:
        # Only other links stall this one: a slow reader in this module loses messages, so that other topics go on.
        may_stall = self._flow_controlled() and not self._closed
        slow = [sink for sink in message.remaining if not (may_stall and isinstance(sink, RemoteSubscriber))]
        # Events and periodic messages stall nothing: they would be stale. The other link is still waited for later.
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

    # Stall: nothing is read until there is room on the message's outgoing links, or the time is over

    def _begin_stall(self, message: BlockedMessage) -> None:
        message.hold()
        self._stalled = message
        longest = min(STALL_MAX_S, max(STALL_MIN_S, self.loop.time() - self._in_vain_at))
        self._stall_timer = self.loop.call_later(longest, self._give_up, message, f"no room for {longest:.2g} s")

    def _end_stall(self) -> None:
        self._stalled = None
        if self._stall_timer is not None:
            self._stall_timer.cancel()
            self._stall_timer = None

    def _give_up(self, message: BlockedMessage, reason: str) -> None:
        guard = self.lost.guard
        for sink in list(message.remaining):
            guard(sink.refill)  # a last attempt
        if message.remaining:
            self._in_vain_at = self.loop.time()
        for sink in list(message.remaining):
            if not guard(sink.become_lossy, reason):
                sink.get_wait_queue().remove(sink, message)
                message.complete(sink, INTERNAL_ERROR)  # else the link would stand still for ever


class Backlog(ReceiveBackpressure, Generic[P]):
    """Messages that wait for room on one topic: the blocked one, and those behind it.

    `deliver` gets messages of one publisher that came together in their turn, with the serial of the first; and None
    for the blocked one when every sink has it. Several are short, as long ones come alone, and their bytes are not
    counted. `resume` is called when reading may go on.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        lost: LoggedCounter,
        deliver: Callable[[P, int, list[Sample] | None], None],
        resume: Callable[[], None],
    ) -> None:
        super().__init__(loop, lost)
        self.blocked: BlockedMessage | None = None
        self.holds = False
        """True if the blocked message waits without a limit; reading goes on, and events overtake it."""
        self._deliver = deliver
        self._resume = resume
        self._blocked_serial: tuple[P, int]  # whose message is blocked, and its serial
        self._queue: deque[tuple[P, int, list[Sample] | None]] = deque()
        self._messages = self._bytes = 0

    def block(self, publisher: P, serial: int, samples: list[Sample], sinks: list[Sink]) -> None:
        """Wait for room in these sinks for the first of the messages; the others wait behind it, ahead of the rest."""
        self._blocked_serial = publisher, serial
        self.blocked = BlockedMessage(samples[0], sinks, self)
        if len(samples) > 1:
            self._queue.appendleft((publisher, serial + 1, samples[1:]))
            self._count(samples[1:], 1)

    def append(self, publisher: P, serial: int, samples: list[Sample] | None) -> bool:
        """Append messages. Return False if there is no room for them.

        `samples` is None for a single message that only has to be acknowledged in its turn.
        """
        if self._messages >= BACKLOG_MAX or self._bytes >= BACKLOG_BYTES_MAX:
            return False
        self._queue.append((publisher, serial, samples))
        self._count(samples, 1)
        return True

    def _count(self, samples: list[Sample] | None, sign: int) -> None:
        """Count messages that come to the queue (1) or leave it (-1)."""
        self._messages += sign * (1 if samples is None else len(samples))
        if samples is not None and len(samples) == 1:
            self._bytes += sign * len(samples[0].data)

    def clear(self) -> int:
        """Drop everything; return how many messages waited behind the blocked one."""
        count = sum(len(samples or ()) for _, _, samples in self._queue)
        self._queue.clear()
        self._messages = self._bytes = 0
        blocked, self.blocked = self.blocked, None
        if blocked is not None:
            blocked.withdraw()
        return count

    def on_expired(self, message: BlockedMessage) -> None:
        if message.sample.publisher_class == PublisherClass.NON_REAL_TIME:
            message.hold()
            self.holds = True
            self._resume()
        else:
            for sink in message.withdraw():
                self.lost.guard(sink.force, message.sample)
            self.on_delivered()

    def on_delivered(self) -> None:
        if self.blocked is None:
            return  # all was dropped meanwhile
        self.blocked = None
        self._deliver(*self._blocked_serial, None)
        while self._queue and self.blocked is None:
            publisher, serial, samples = self._queue.popleft()
            self._count(samples, -1)
            self._deliver(publisher, serial, samples)
        if self.blocked is None:
            self.holds = False
            self._resume()
