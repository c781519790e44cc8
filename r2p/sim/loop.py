"""Virtual time: an event loop whose clock jumps to the next timer as soon as nothing else is left to do.

Time stands still while code runs, so what a program does depends on its timers alone, not on the computer. Everything
in asyncio that goes through the loop works unchanged. What virtual time can't see is the world outside, nor work:

- Jobs in threads (`asyncio.to_thread`, `loop.run_in_executor`) are counted: time stands still until they are done.
  Other threads are not seen, nor are subprocesses.
- A task that never waits, such as one that publishes in a loop, would stop the world, and so would a descriptor that
  is always ready: after 100 000 turns of the loop at one instant the next timer comes all the same.
- Real file descriptors are polled, but never waited for: time goes on without them. Keep sockets and devices out.
- `time.time`, `time.sleep`, `random` and the order of sets of strings are as real as ever: use `r2p.clock` for the
  first three.
"""

from __future__ import annotations

import asyncio
import itertools
import random
import selectors
from collections.abc import Callable, Coroutine
from heapq import heappush
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeAlias, TypeVar, TypeVarTuple, Unpack

from r2p.errors import Deadlock

if TYPE_CHECKING:
    import contextvars
    from collections.abc import Sized
    from concurrent.futures import Executor

T = TypeVar("T")
Ts = TypeVarTuple("Ts")

_SECOND: Final = 1_000_000_000
_EPOCH: Final = 1_356_998_400 * _SECOND  # 2013-01-01T00:00:00Z
_HORIZON: Final = float(2**22)  # seconds, 48 days: up to here there are two floats to each nanosecond
_BUSY: Final = 100_000  # turns of the loop at one instant
_END: Final = 2**22 * _SECOND  # the same in ns
_AHEAD: Final = 1000  # events; then the loop has its turn, for signals and real file descriptors
_OFTEN: Final = 64  # turns of the loop; so often it looks for signals
_RESOLUTION: Final = 0.4e-9  # seconds; tells nanoseconds apart, and is more than rounding error at the horizon


def run(main: Coroutine[Any, Any, T] | Callable[[], Coroutine[Any, Any, T]], *, seed: int = 0) -> T:
    """Run `main` (a coroutine, or a function that makes one) under virtual time, and return its result.

    Virtual time starts at 2013-01-01 UTC and lasts 48 days at most. `seed` goes to the loop's random numbers,
    `loop.random`. Tasks that `main` leaves behind are cancelled, as by `asyncio.run`. Raises what `main` raises, and
    `Deadlock` when it waits for something that can't happen any more; KeyboardInterrupt on Ctrl-C.
    """
    with asyncio.Runner(loop_factory=lambda: VirtualLoop(seed=seed)) as runner:
        return runner.run(main() if callable(main) else main)


Event: TypeAlias = tuple[int, int, Callable[..., object], tuple[Any, ...]]
"""When (ns since the start), its place among those of one instant, what to call, with what."""


class VirtualClock:
    """The clock of a `VirtualLoop`: an integer, moved by the loop. Satisfies `r2p.clock.Clock`."""

    virtual = True

    def __init__(self) -> None:
        self.elapsed = 0  # ns

    def now(self) -> int:
        """UTC in ns: 2013-01-01 at the start."""
        return _EPOCH + self.elapsed

    def monotonic(self) -> int:
        """Ns since the start."""
        return self.elapsed

    def move_to(self, instant: int) -> None:
        """Jump to this instant (ns since the start)."""
        self.elapsed = instant


class VirtualLoop(asyncio.SelectorEventLoop):
    """An asyncio event loop under virtual time. `clock` and `random` are what `r2p.clock` finds here."""

    _ready: Sized  # what asyncio will call next
    _scheduled: list[asyncio.TimerHandle]  # asyncio's heap of timers; when it polls, the first one is not cancelled
    _clock_resolution: float  # asyncio runs timers that are due this much later, too

    def __init__(self, *, seed: int = 0) -> None:
        super().__init__(_Selector(self._idle, self._turn))
        self.clock = VirtualClock()
        self.random = random.Random(seed)
        self.task_numbers = itertools.count(1)
        self._timer_numbers = itertools.count()
        self._jobs = 0
        self._limit = 0  # ns; up to here, not including, `run_ahead` may go
        self._turns = 0
        self._instant = 0
        self._clock_resolution = _RESOLUTION
        self.set_task_factory(_Task.make)

    def time(self) -> float:
        """Virtual seconds since the start."""
        return self.clock.elapsed / _SECOND

    def call_at(
        self,
        when: float,
        callback: Callable[[Unpack[Ts]], object],
        *args: *Ts,
        context: contextvars.Context | None = None,
    ) -> asyncio.TimerHandle:
        """As in asyncio, at the nanosecond nearest to `when`; timers of one instant go off in the order they were set.

        Rounding is what keeps long runs exact: the error of adding two floats is gone before it can be added to the
        next one.
        """
        if self.is_closed():
            raise RuntimeError("Event loop is closed")
        if when < _HORIZON:
            instant = _nanoseconds(when)
            when = instant / _SECOND
            if instant < self._limit:
                self._limit = instant
        timer = _Timer(when, next(self._timer_numbers), callback, args, self, context)
        heappush(self._scheduled, timer)
        return timer

    def run_in_executor(
        self, executor: Executor | None, func: Callable[[Unpack[Ts]], T], *args: *Ts
    ) -> asyncio.Future[T]:
        """As in asyncio; virtual time stands still until the job is done, or nobody waits for it any more."""
        future = super().run_in_executor(executor, func, *args)
        self._jobs += 1
        self._limit = 0
        future.add_done_callback(self._job_done)
        return future

    async def shutdown_default_executor(self, *args: Any, **kwargs: Any) -> None:
        """As in asyncio."""
        self._jobs += 1  # asyncio does this in a thread of its own
        try:
            await super().shutdown_default_executor(*args, **kwargs)
        finally:
            self._jobs -= 1

    def run_ahead(self, events: list[Event]) -> None:
        """Carry out events of this sorted list, each at its instant, for as long as nothing else is due in between.

        For whoever has many events, and keeps them in order himself: a turn of the loop for each would cost more than
        the event. What is over is now. After some events, the loop has its turn all the same.
        """
        ready, clock = self._ready, self.clock
        self._limit = 0 if self._jobs else self._next_timer()
        for _ in range(_AHEAD):
            if not events:
                return
            when, _, callback, args = events[0]
            if when > clock.elapsed:
                if when >= self._limit or ready:
                    return
                clock.elapsed = when
            del events[0]
            callback(*args)

    def _next_timer(self) -> int:
        return _nanoseconds(min(self._scheduled[0].when(), _HORIZON)) if self._scheduled else _END

    def _job_done(self, _future: asyncio.Future[Any]) -> None:
        self._jobs -= 1

    def _turn(self) -> None:
        """There is more to do at this instant. Who never waits takes time, too: in the end the next timer comes."""
        if self._instant != self.clock.elapsed:
            self._instant, self._turns = self.clock.elapsed, 0
        self._turns += 1
        if self._turns >= _BUSY and self._scheduled and not self._jobs:
            when = self._scheduled[0].when()
            if when < _HORIZON:
                self.clock.move_to(max(self.clock.elapsed, _nanoseconds(when)))

    def _idle(self) -> bool:
        """Nothing is left to do at this instant: go on to the next timer, or say True: wait for a job in a thread."""
        if self._jobs:
            return True
        when = self._scheduled[0].when() if self._scheduled else _HORIZON
        if when >= _HORIZON:
            raise Deadlock(self._who_waits())
        self.clock.move_to(_nanoseconds(when))
        return False

    def _who_waits(self) -> str:
        lines = ["virtual time stands still: nothing is scheduled that could wake a task"]
        if self._scheduled:
            lines = ["virtual time is over: the next timer is more than 48 days after the start"]
        tasks = sorted(asyncio.all_tasks(self), key=hash)
        lines += [f"  {task.get_name()}: {_where(task.get_coro())}" for task in tasks]
        return "\n".join(lines)


class _Selector(selectors.DefaultSelector):
    """Never waits while virtual time can go on instead."""

    def __init__(self, idle: Callable[[], bool], turn: Callable[[], None]) -> None:
        super().__init__()
        self._idle = idle
        self._turn = turn
        self._looked = itertools.count()

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        if len(self.get_map()) > 1 or not next(self._looked) % _OFTEN:  # asyncio's own descriptor is the first one
            events = super().select(0)
            if events:
                self._turn()
                return events
        if timeout == 0:  # what asyncio says when callbacks are ready
            self._turn()
            return []
        return super().select(None) if self._idle() else []


class _Timer(asyncio.TimerHandle):
    """A timer that has its place behind those set earlier for the same instant: a heap alone forgets that."""

    def __init__(self, when: float, number: int, callback: Any, args: Any, loop: VirtualLoop, context: Any) -> None:
        super().__init__(when, callback, args, loop, context)
        self.order = (when, number)
        self._scheduled = True  # how asyncio marks what is in its heap

    def __lt__(self, other: object) -> bool:
        return isinstance(other, _Timer) and self.order < other.order


class _Task(asyncio.Task[Any]):
    """A task that hashes to its number, so that sets of tasks have the same order in each run.

    asyncio keeps sets of tasks: a task group that fails cancels its children in the order of one. By default that is
    the order of their addresses.
    """

    def __init__(self, coro: Any, loop: VirtualLoop, **options: Any) -> None:
        self._number = next(loop.task_numbers)
        options["name"] = options.get("name") or f"Task-{self._number}"
        super().__init__(coro, loop=loop, **options)

    def __hash__(self) -> int:
        return self._number

    def set_name(self, value: object) -> None:
        """As in asyncio; Python 3.13.0 calls it with None for a task without a name."""
        if value is not None:
            super().set_name(value)

    @classmethod
    def make(cls, loop: Any, coro: Any, **options: Any) -> _Task:
        """The loop's task factory."""
        return cls(coro, loop, **options)


def _nanoseconds(seconds: float) -> int:
    whole = int(seconds)  # apart from the fraction: which is exact, and small enough to be multiplied
    return whole * _SECOND + round((seconds - whole) * _SECOND)


def _where(awaitable: object) -> str:
    """The chain of calls in which a task waits, outermost first: `blink (app.py:12) > Queue.get (queues.py:158)`."""
    steps = []
    while isinstance(awaitable, Coroutine):
        frame = getattr(awaitable, "cr_frame", None)
        if frame is not None:
            code = frame.f_code
            steps.append(f"{code.co_qualname} ({Path(code.co_filename).name}:{frame.f_lineno})")
        awaitable = getattr(awaitable, "cr_await", None)
    return " > ".join(steps) or "not started"
