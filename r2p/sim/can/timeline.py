"""The order of events on a bus, and of the timers of its nodes: a heap of instants under one timer of the loop.

Turning asyncio's loop for each event would cost more than the event. So under virtual time the timeline moves the clock
on by itself, for as long as nothing else in the loop is due: the same events at the same instants, only faster. On an
ordinary loop it carries out what has become due; an event that the loop made late still has its own instant, `now()`.
"""

from __future__ import annotations

import heapq
import itertools
from typing import TYPE_CHECKING, Any, Final, Protocol, cast

from r2p.clock import Alarm, clock_of
from r2p.sim.loop import VirtualLoop

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable, Sized

    from r2p.sim.loop import VirtualClock

_SECOND: Final = 1_000_000_000
_HORIZON: Final = 2.0**22  # seconds; here virtual time ends, and the loop says so
_AT_A_TIME: Final = 1000  # events; then the loop has its turn, for signals and real file descriptors


class Timer:
    """One call in the future, which can be cancelled."""

    __slots__ = ("_args", "_callback")

    def __init__(self, callback: Callable[..., object], args: tuple[Any, ...]) -> None:
        self._callback: Callable[..., object] | None = callback
        self._args = args

    def cancel(self) -> None:
        """Let it not happen, unless it has."""
        self._callback = None

    def fire(self) -> None:
        """Call it now, once."""
        callback, self._callback = self._callback, None
        if callback is not None:
            callback(*self._args)


class Timeline:
    """Calls at instants of the loop's monotonic clock, in ns; those of one instant in the order they were made."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self.clock = clock_of(loop)
        self._heap: list[tuple[int, int, Callable[..., object], tuple[Any, ...]]] = []
        self._numbers = itertools.count()
        self._alarm = Alarm(loop, self._run)
        self._virtual = cast("_Inside", loop) if isinstance(loop, VirtualLoop) else None
        self._running = False
        self._now = 0

    def now(self) -> int:
        """The instant of the event that is being carried out; else what the clock says."""
        return self._now if self._running else self.clock.monotonic()

    def at(self, when: int, callback: Callable[..., object], *args: Any) -> None:
        """Call it at `when`, which is not over."""
        heapq.heappush(self._heap, (when, next(self._numbers), callback, args))
        if not self._running and self._heap[0][0] == when:
            self._alarm.set(when)

    def timer(self, when: int, callback: Callable[..., object], *args: Any) -> Timer:
        """As `at`, and can be cancelled. An instant that is over is now."""
        timer = Timer(callback, args)
        self.at(max(when, self.now()), timer.fire)
        return timer

    def close(self) -> None:
        """Nothing happens any more, until the next `at`."""
        self._heap.clear()
        self._alarm.close()

    def _run(self) -> None:
        self._now = self.clock.monotonic()
        self._running = True
        try:
            if self._virtual:
                self._run_ahead(self._virtual)
            else:
                self._run_due()
        finally:  # an event that raises goes to the loop's exception handler; the next one comes all the same
            self._running = False
            if self._heap:
                self._alarm.set(self._heap[0][0])

    def _run_due(self) -> None:
        heap, present = self._heap, self._now
        while heap and heap[0][0] <= present:
            self._now, _, callback, args = heapq.heappop(heap)
            callback(*args)

    def _run_ahead(self, loop: _Inside) -> None:
        """Go on while the loop would do nothing else up to the next event. Looks into it: a part of `r2p.sim`, too."""
        heap, ready, timers, clock = self._heap, loop._ready, loop._scheduled, loop.clock  # noqa: SLF001
        for _ in range(_AT_A_TIME):
            if not heap:
                return
            when = heap[0][0]
            if when > self._now:
                seconds = when / _SECOND
                if ready or (timers and timers[0].when() <= seconds) or loop._jobs or seconds >= _HORIZON:  # noqa: SLF001
                    return
                clock._elapsed, clock.seconds = when, seconds  # noqa: SLF001 - as `move_to`, in a third of the time
            self._now, _, callback, args = heapq.heappop(heap)
            callback(*args)


class _Inside(Protocol):
    """A `VirtualLoop`, with what it is about to do."""

    clock: VirtualClock
    _ready: Sized
    _scheduled: list[asyncio.TimerHandle]
    _jobs: int
