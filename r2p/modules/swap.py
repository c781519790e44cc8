"""The swap of a node: another one takes its place, and the publishers of both go on as one.

    settle    the new node starts; it subscribes, and its publishers on topics of the old one are held back
    commit    from here on the new node stays: what ends the swap before leaves the old one as it was
    drain     requests go to the servers of the new node; the old one ends those that it has begun
    end       the old node is cancelled and cleans up; as its publishers close, those of the new node take over
    measure   the first message of the new node on each topic ends its pause

If the new node crashes after `commit`, before it has taken over, the old one is started again. STOP, REBOOT and the end
of the module interrupt a swap at any step: they end both nodes.
"""

import asyncio
import contextlib
from collections.abc import Callable

import msgspec

from r2p.clock import check_seconds, clock_of
from r2p.errors import Error
from r2p.log_lines import get_logger
from r2p.modules.supervisor import Supervisor
from r2p.runtime.node import Node
from r2p.runtime.publishers import AnyPublisher, PeriodicPublisher
from r2p.runtime.publishers.held import ReplacedNode
from r2p.runtime.sample import PublisherClass
from r2p.runtime.subscriber import Subscriber
from r2p.services.server import ServiceServer
from r2p.transports.link import Link
from r2p.units import SECOND

logger = get_logger("r2p.module")

SETTLE = 5.0
"""Seconds for which a new node may take to advertise what the old one publishes, by default."""

CLEANUP = 5.0
"""Seconds for which the old node's handlers may run on, and for which it may clean up, by default."""

_TRIAL = 0.05  # seconds that a new node runs before it takes over, at least: many crash at once
_SUBSCRIBE = 0.5  # seconds for which a swap waits for subscriptions of the old node that the new one lacks
_FIRST = 0.5  # seconds for which it waits for the first message on each topic, or two periods
_POLL = 0.005  # seconds


class TopicPause(msgspec.Struct, frozen=True):
    """The pause in a topic of both nodes, in seconds: of a periodic publisher, from the old node's last message to the
    first one of the new node, which is one `period` if none is missing; of others, from the end of the old node.

    `pause` is None if the new node has published nothing within half a second, or two periods.
    """

    topic: str
    publisher_class: PublisherClass
    pause: float | None
    period: float | None = None


class SwapResult(msgspec.Struct, frozen=True):
    """What a swap has done. `cleaned_up`: the old node has ended; otherwise it hangs, without its publishers."""

    node: Node
    topics: list[TopicPause]
    cleaned_up: bool = True

    @property
    def pause(self) -> float:
        """The longest pause, in seconds; 0.0 if no topic is published by both nodes."""
        return max((each.pause for each in self.topics if each.pause is not None), default=0.0)


class SwapLimits(msgspec.Struct, frozen=True):
    """How long the new node may take to `settle`, and the old one for its `cleanup`, in seconds. `partial`: the new
    node may publish and serve less than the old one.
    """

    settle: float = SETTLE
    cleanup: float = CLEANUP
    partial: bool = False

    def check(self) -> None:
        """Raise MessageError unless both times are numbers of seconds."""
        check_seconds("settle of a swap", self.settle, least=0.0)
        check_seconds("cleanup of a swap", self.cleanup, least=0.0)


class NodeSwap:
    """One swap. `replace` puts a node into the place of the first in the module's table, and starts it if it has ended.

    `run` it once, in a task of its own; the new node was started before.
    """

    def __init__(
        self,
        old: Supervisor,
        new: Supervisor,
        links: list[Link],
        limits: SwapLimits,
        replace: Callable[[Supervisor, Supervisor], object],
    ) -> None:
        self.old = old
        self.new = new
        self.interrupted = ""
        """The reason for which the module has ended both nodes."""
        self.committed = False
        self._woken = asyncio.Event()
        self._links = links
        self._limits = limits
        self._replace = replace
        self._loop = asyncio.get_running_loop()
        self._clock = clock_of(self._loop)
        self._replaced = new.node.replaced = ReplacedNode(
            list(old.node.publishers), [each.name for each in old.node.services if isinstance(each, ServiceServer)]
        )
        self._name = f"node {old.node.name} of module {old.node.module}"
        new.on_trial = True

    @property
    def names(self) -> set[str]:
        """The names of both nodes."""
        return {self.old.node.name, self.new.node.name}

    def interrupt(self, reason: str) -> None:
        """Note that the module ends both nodes; the new one is cancelled afterwards.

        An old node that is handing over may have left its motors running. Then the new one takes over at once, as what
        its clean-up publishes is to stop them; nothing that it has published before.
        """
        self.interrupted = reason
        if self.old.node.handing_over:
            for drop in self._replaced.drop_kept:
                drop(f"held back until the node before had ended, and {reason}")
            self.old.node.close()
        self._woken.set()

    async def run(self) -> SwapResult | Error:
        """Swap the nodes; return the error if the old one goes on instead."""
        try:
            await self._settle()
            self._check()
        except Error as error:
            await self.new.stop()
            return error
        except asyncio.CancelledError:
            await self.new.stop()
            return Error(f"the swap of {self._name} was cancelled: it goes on")
        self.committed = True
        self._replace(self.old, self.new)
        await self._drain()
        ended_at = self._clock.monotonic()
        cleaned_up = await self._end_old()
        if not (self.new.running or self.interrupted):
            return await self._start_old()
        self.new.on_trial = False
        if self.interrupted:
            return self._interruption()
        topics = await self._measure(ended_at)
        self._replaced.drop_kept.clear()
        self._replaced.followed.clear()  # else each node would keep all those before it in memory
        self.old.node.replaced = ReplacedNode()
        return SwapResult(self.new.node, topics, cleaned_up)

    async def _start_old(self) -> Error:
        """Start the old node again, as the new one has ended before it had taken over."""
        await self.old.stop()
        if self.interrupted:
            return self._interruption()
        self._replace(self.new, self.old)
        return Error(f"{self._new_ended()}; {self.old.node.name} was started again")

    # Settle

    async def _settle(self) -> None:
        """Wait until the new node can take over; one that waits to publish can, whatever it would do next."""
        start = self._loop.time()
        while self._goes_on(start + self._limits.settle) and not self.old.node.closed:
            if self._loop.time() >= start + _TRIAL and self._can_take_over(start):
                return
            await self._look_again()

    def _can_take_over(self, start: float) -> bool:
        if self._unanswered():
            return False
        if any(each.held_back for each in self.new.node.publishers):
            return True
        return not self._missing() and (self._loop.time() >= start + _SUBSCRIBE or not self._unsubscribed())

    def _missing(self) -> list[str]:
        """Return the topics and services of the old node that the new one lacks."""
        return [each.topic for each in self._replaced.publishers if each.is_open] + [
            name for name in self._replaced.services if name not in {each.name for each in self.new.node.services}
        ]

    def _unsubscribed(self) -> set[str]:
        return {each.topic for each in self.old.node.subscribers} - {each.topic for each in self.new.node.subscribers}

    def _unanswered(self) -> list[str]:
        """Return the topics of new subscriptions whose publishers on a link have not answered yet."""
        return [each.topic for each in self.new.node.subscribers if self._waits_for_publisher(each)]

    def _waits_for_publisher(self, subscriber: Subscriber[object]) -> bool:
        if subscriber.publishers:
            return False
        known = [link.discovery.topics.get(subscriber.topic) for link in self._links if link.up]
        return any(each is not None and each.advertised_at is not None and not each.mismatch for each in known)

    def _check(self) -> None:
        """Raise Error if the new node can't take over."""
        if self.interrupted:
            raise self._interruption()
        if not self.new.running:
            raise Error(f"{self._new_ended()}; {self.old.node.name} goes on")
        if self.old.node.closed or any(each.held_back for each in self.new.node.publishers):
            return
        goes_on, limit = f"{self.old.node.name} goes on", f"within {self._limits.settle:g} s"
        if self.new.never_ran:
            raise Error(f"the new node did not get to its first step {limit}: {goes_on}")
        if (missing := self._missing()) and not self._limits.partial:
            raise Error(
                f"the new node has not advertised or served {', '.join(missing)} {limit}, as the old one does: "
                f"{goes_on}; if it is meant to have less, swap with partial=True (--partial)"
            )
        if unanswered := self._unanswered():
            raise Error(f"no publisher of {', '.join(unanswered)} has answered the new node {limit}: {goes_on}")

    def _new_ended(self) -> str:
        error = self.new.error
        if error is None:
            return "the new node returned before it took over: it has to run on"
        return f"the new node crashed: {type(error).__name__}: {error}"

    def _interruption(self) -> Error:
        return Error(f"the swap of {self._name} was interrupted: {self.interrupted}")

    # Take over

    async def _drain(self) -> None:
        """Let the new node serve, and wait until the old one has ended the requests that it has begun."""
        old = [each for each in self.old.node.services if isinstance(each, ServiceServer)]
        for each in self.new.node.services:
            if isinstance(each, ServiceServer):
                each.take_over()
        end = self._loop.time() + self._limits.cleanup
        while any(each.busy for each in old) and self._goes_on(end):
            await self._look_again()

    async def _look_again(self) -> None:
        """Wait for the next look, or for an interruption."""
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self._woken.wait(), _POLL)

    def _goes_on(self, end: float) -> bool:
        return self.new.running and not self.interrupted and self._loop.time() < end

    async def _end_old(self) -> bool:
        """End the old node; return False if its clean-up hangs: then its publishers are closed all the same."""
        self._replaced.publishers = [each for each in self.old.node.publishers if each.hand_over is None]
        self.old.node.handing_over = not self.interrupted
        task = self.old.cancel()
        if task is None:
            return True
        end = self._loop.time() + self._limits.cleanup
        while not task.done() and self._goes_on(end):
            await asyncio.wait([task], timeout=_POLL)
        if task.done() or not self.new.running or self.interrupted:
            return task.done()
        logger.warning(
            "%s still cleans up after %g s: its publishers are closed, and the new node takes over",
            self._name,
            self._limits.cleanup,
        )
        self.old.node.close()
        return False

    # Measure

    async def _measure(self, ended_at: int) -> list[TopicPause]:
        """Wait for the first messages of the new node, and return the pauses."""
        start = self._loop.time()
        for _, new in self._replaced.followed:
            while not new.first_at and new.is_open and self._goes_on(start + _first_within(new)):
                await self._look_again()
        return [_pause(old, new, ended_at) for old, new in self._replaced.followed]


def _first_within(publisher: AnyPublisher) -> float:
    period = publisher.period if isinstance(publisher, PeriodicPublisher) else 0.0
    return max(_FIRST, 2 * period)


def _pause(old: AnyPublisher, new: AnyPublisher, ended_at: int) -> TopicPause:
    """Return the pause between two publishers of a topic; the old node's end began at `ended_at` (monotonic ns)."""
    pause, period = None, None
    if isinstance(new, PeriodicPublisher):
        period = new.period
    if new.first_at and isinstance(new, PeriodicPublisher) and isinstance(old, PeriodicPublisher) and old.due:
        pause = (new.first_due - old.due) / SECOND
    elif new.first_at:
        pause = max(0, new.first_at - ended_at) / SECOND
    return TopicPause(new.topic, new.publisher_class, pause, period)
