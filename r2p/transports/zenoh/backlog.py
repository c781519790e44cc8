"""Messages that came in from zenoh on one topic and have no room: the one that is blocked, and those behind it.

A message is offered again in the next turns of the event loop, as most readers make room within one. After that events
and periodic messages replace older ones. A message that does not expire gets in line at its sinks, for as long as it
takes: its publisher learns that from the credit that does not come.

Links whose topics share one line have `ReceiveBackpressure` instead (r2p.transports.receive_backpressure): there no
message may wait without a limit, and a reader that made no room once is not waited for again.
"""

import asyncio
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

import msgspec

from r2p.runtime.backpressure import PendingDelivery, Sink
from r2p.runtime.sample import PublisherClass, Sample
from r2p.transports.receive_backpressure import FULL_QUEUE_TURNS
from r2p.transports.stats import LoggedCounter

P = TypeVar("P")  # what is known of a message's publisher; it is only passed on

BACKLOG_MAX = 16_384
"""Messages that wait behind one that is blocked: what eight publishers may send meanwhile."""


class _HeldDelivery(PendingDelivery):
    """The blocked message, in line for room."""

    __slots__ = ("_placed",)

    def __init__(self, sample: Sample, sinks: list[Sink], placed: Callable[[], None]) -> None:
        self._placed = placed
        super().__init__(sample, sinks)

    def completed(self, sink: Sink, refusal: str) -> None:
        if not self.remaining:
            self._placed()


class _BlockedSample(msgspec.Struct, Generic[P]):
    """The message that has no room in `sinks`; for `turns` of the loop it is just offered again."""

    publisher: P
    serial: int
    sample: Sample
    sinks: list[Sink]
    turns: int = FULL_QUEUE_TURNS
    held: _HeldDelivery | None = None


class Backlog(Generic[P]):
    """What waits for room on one topic.

    `deliver` gets each message when it has its turn, and None for the blocked one when that was placed; `resume` is
    called when reading may go on.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        lost: LoggedCounter,
        deliver: Callable[[P, int, Sample | None], None],
        resume: Callable[[], None],
    ) -> None:
        self.blocked: _BlockedSample[P] | None = None
        self.holds = False
        """Whether the blocked message waits without a limit; reading goes on, and events overtake it."""
        self._loop = loop
        self._lost = lost
        self._deliver = deliver
        self._resume = resume
        self._waiting: deque[tuple[P, int, Sample | None]] = deque()

    def block(self, publisher: P, serial: int, sample: Sample, sinks: list[Sink]) -> None:
        """Wait for room in these sinks."""
        self.blocked = _BlockedSample(publisher, serial, sample, sinks)
        self._loop.call_soon(self._retry, self.blocked)

    def append(self, publisher: P, serial: int, sample: Sample | None) -> bool:
        """Put a message behind the others, or None in place of one that is only acknowledged. False if it is full."""
        if len(self._waiting) >= BACKLOG_MAX:
            return False
        self._waiting.append((publisher, serial, sample))
        return True

    def clear(self) -> int:
        """Drop everything; return how many messages waited behind the blocked one."""
        count = sum(sample is not None for _, _, sample in self._waiting)
        self._waiting.clear()
        blocked, self.blocked = self.blocked, None
        if blocked is not None and blocked.held is not None:
            blocked.held.withdraw()
        return count

    def _retry(self, blocked: _BlockedSample[P]) -> None:
        if blocked is not self.blocked:
            return
        sample = blocked.sample
        blocked.sinks = [sink for sink in blocked.sinks if not self._offer(sink, sample)]
        blocked.turns -= 1
        if not blocked.sinks:
            self._release()
        elif blocked.turns:
            self._loop.call_soon(self._retry, blocked)
        elif sample.publisher_class != PublisherClass.NON_REAL_TIME:
            for sink in blocked.sinks:
                self._lost.guard(sink.force, sample)
            self._release()
        else:
            blocked.held = _HeldDelivery(sample, blocked.sinks, self._release_soon)
            self.holds = True
            self._resume()

    def _offer(self, sink: Sink, sample: Sample) -> bool:
        """Whether the sink is not waited for any more: it has the message, or has raised."""
        try:
            return sink.offer(sample)
        except Exception as error:  # noqa: BLE001 - counted and logged; the others follow
            self._lost.internal_error(error)
            return True

    def _release_soon(self) -> None:
        """The message was placed, maybe in the middle of the reader's work: go on after that."""
        self._loop.call_soon(self._release)

    def _release(self) -> None:
        """Deliver what waits, until a message has no room again."""
        blocked, self.blocked = self.blocked, None
        if blocked is not None:
            self._deliver(blocked.publisher, blocked.serial, None)
        waiting = self._waiting
        while waiting and self.blocked is None:
            self._deliver(*waiting.popleft())
        if self.blocked is None:
            self.holds = False
            self._resume()
