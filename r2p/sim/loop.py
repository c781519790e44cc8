"""Virtual time: an event loop whose clock jumps to the next timer as soon as nothing else is left to do.

Time stands still while code runs, so a program depends only on its timers, not on the speed of the computer. Everything
in asyncio that goes through the loop works unchanged. These things are outside virtual time:

- Jobs in threads (`asyncio.to_thread`, `loop.run_in_executor`) are counted: time stands still until they are done.
  Other threads, and subprocesses, are not seen.
- A task that never waits, such as one that publishes in a loop, would stop time, and so would a descriptor that is
  always ready: after 100 000 iterations of the loop at one instant the next timer runs anyway.
- Real file descriptors are polled, but not waited for: time goes on without them. Don't use sockets and devices.
  With a paced clock (`speed`, `follow`) they are waited for, and work: time goes no faster than other programs' time.
- `time.time`, `time.sleep`, `random` and the order of sets of strings stay real: use `r2p.clock` instead of the first
  three.
"""

from __future__ import annotations

import asyncio
import itertools
import random
import selectors
from collections.abc import Callable, Coroutine
from heapq import heapify, heappop, heappush
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NoReturn, TypeAlias, TypeVar, TypeVarTuple, Unpack

from r2p.clock import REAL_TIME, SystemClock, check_timeout
from r2p.errors import Deadlock, MessageError
from r2p.modules.unwinding import frames
from r2p.sim.clocks import FollowingClock, PacedClock, VirtualClock
from r2p.units import SECOND

if TYPE_CHECKING:
    import contextvars
    from collections import deque
    from concurrent.futures import Executor

T = TypeVar("T")
Ts = TypeVarTuple("Ts")

_HORIZON: Final = float(2**22)  # seconds, 48 days: up to here there are two floats for each nanosecond
_END: Final = 2**22 * SECOND  # the same in ns
_IDLE_MIN: Final = 20 * SECOND  # of virtual time with nothing but background timers, before a Deadlock...
_IDLE_REAL_MIN: Final = SECOND // 2  # ... which also takes this much real time...
_IDLE_MAX: Final = 300 * SECOND  # ... but never more virtual time than this
_IDLE_CHECK: Final = 5 * SECOND  # between two checks whether a task has been woken
_BUSY: Final = 100_000  # iterations of the loop at one instant, after which the next timer runs anyway
_AHEAD: Final = 1000  # events in one iteration of the loop: signals and real file descriptors wait for so long
_CANCELLED_MIN: Final = 50  # cancelled timers behind others are dropped when there are more, and half are
_POLL_EVERY: Final = 64  # iterations between two polls of asyncio's own descriptor, which signals wake
_SHORTEST_WAIT: Final = 0.001  # s: a real timer may ask for virtual time that stands still
_LONGEST_WAIT: Final = 3600.0  # s: no poll takes much longer ones
_SLOWEST, _FASTEST = 0.001, 10_000.0  # times real time
_REAL: Final = SystemClock()  # only measures the real time until a Deadlock


def run(
    main: Coroutine[Any, Any, T] | Callable[[], Coroutine[Any, Any, T]],
    *,
    seed: int = 0,
    limit: float | None = None,
    speed: float | None = None,
    follow: bool = False,
) -> T:
    """Run `main` (a coroutine, or a function that makes one) under virtual time, and return its result.

    Virtual time starts at 2013-01-01 UTC and lasts 48 days at most. `seed` goes to the loop's random numbers,
    `loop.random`. Tasks that `main` leaves behind are cancelled, as by `asyncio.run`. Raises what `main` raises, and
    `Deadlock` when it waits for something that can no longer happen, and KeyboardInterrupt on Ctrl-C.

    Timers that only repeat themselves (announcements, periodic publishers, time-outs that no task waits for) do not
    keep a program alive: Deadlock is raised when they have woken no task for half a second of real time and 20 seconds
    of virtual time. Where nodes exchange messages forever, `limit` raises it after this many seconds of virtual time.

    With a `speed`, virtual time goes that many times as fast as real time, so that other programs take part: links to
    other processes work, and those to ROS publish the time as `/clock`. With `follow` it is the other way round: the
    time is that of the `/clock` of ROS, and real time without one. Both wait for other programs, so there is no
    Deadlock but that of the limit.
    """
    check_timeout("the limit", limit)
    clock = clock_for(speed, follow=follow)
    with asyncio.Runner(loop_factory=lambda: VirtualLoop(seed=seed, limit=limit, clock=clock)) as runner:
        return runner.run(main() if callable(main) else main)


def clock_for(speed: float | None, *, follow: bool) -> VirtualClock:
    """Return the clock for a speed, and for following another one, as `run` has them. Raises MessageError."""
    if follow:
        if speed is not None:
            raise MessageError("either a speed or follow=True: a clock that follows another one has that one's speed")
        return FollowingClock()
    if speed is None:
        return VirtualClock()
    if not _SLOWEST <= speed <= _FASTEST:
        raise MessageError(f"the speed is how many times as fast as real time, {_SLOWEST} to {_FASTEST}, not {speed!r}")
    return PacedClock(speed)


Event: TypeAlias = tuple[int, int, Callable[..., object], tuple[Any, ...]]
"""Time (ns since the start), order within one instant, function and arguments of a call."""


class VirtualLoop(asyncio.SelectorEventLoop):
    """An asyncio event loop under virtual time. `r2p.clock` uses its `clock` and `random`."""

    _ready: deque[asyncio.Handle]  # what asyncio will call next
    _stopping: bool  # whether asyncio is to return from `run_forever`
    _selector: _Selector
    _timer_cancelled_count: int  # asyncio counts cancelled timers that are still in the heap
    _process_events: Callable[[list[Any]], None]

    def __init__(self, *, seed: int = 0, limit: float | None = None, clock: VirtualClock | None = None) -> None:
        self.clock = VirtualClock() if clock is None else clock
        super().__init__(_Selector(self._idle, self._turn, self._advance if self.clock.paced else None))
        self._end = _END if limit is None else min(_nanoseconds(min(limit, _HORIZON)), _END)
        self._checked = 0  # ns: the last check for tasks that were woken, or the last timer not in the background
        self._waited_for: dict[asyncio.Task[Any], object] | None = None  # what each task waited for at that check
        self._alive = self._alive_really = 0  # ns: since when no task has been woken; the same in real time
        self.random = random.Random(seed)
        self.task_numbers = itertools.count(1)
        self._timer_numbers = itertools.count()
        self._timers: list[tuple[int, int, _VirtualTimer]] = []
        """A heap of timers by their instant (ns) and number: tuples are compared without a call."""
        self._real_timers: list[tuple[float, int, _VirtualTimer]] = []
        """Timers in real time (s), of a paced clock."""
        self._jobs = 0
        self._limit = 0  # ns; up to here, not including, `run_ahead` may go
        self._turns = 0
        self._instant = 0
        self.set_task_factory(_Task.make)

    def time(self) -> float:
        """Return the virtual seconds since the start."""
        return self.clock.elapsed / SECOND

    def call_at(
        self,
        when: float,
        callback: Callable[[Unpack[Ts]], object],
        *args: *Ts,
        context: contextvars.Context | None = None,
    ) -> asyncio.TimerHandle:
        """Do as asyncio, at the nanosecond nearest to `when`; timers of one instant run in the order they were set.

        Rounding keeps long runs exact: the error of a sum of two floats is gone before it enters the next sum.
        """
        if self.is_closed():
            raise RuntimeError("Event loop is closed")
        if self.clock.paced and REAL_TIME.get():
            return self._call_at_real(max(when - self.time(), _SHORTEST_WAIT), callback, args, context)
        return self.call_at_instant(_nanoseconds(when) if when < _HORIZON else _END, callback, *args, context=context)

    def call_at_instant(
        self, instant: int, callback: Callable[..., object], *args: Any, context: contextvars.Context | None = None
    ) -> _VirtualTimer:
        """Do the same as `call_at`, in ns since the start, and always in virtual time: for `r2p.clock`."""
        if instant < self._limit:
            self._limit = instant
        number = next(self._timer_numbers)
        timer = _VirtualTimer(instant / SECOND, callback, args, self, context)
        heappush(self._timers, (instant, number, timer))
        return timer

    def _call_at_real(
        self, delay: float, callback: Any, args: Any, context: contextvars.Context | None
    ) -> asyncio.TimerHandle:
        when = _REAL.monotonic() / SECOND + delay
        timer = _VirtualTimer(when, callback, args, self, context)
        timer._scheduled = False  # noqa: SLF001 - in the heap of virtual timers, as far as asyncio cares
        heappush(self._real_timers, (when, next(self._timer_numbers), timer))
        return timer

    def _run_real_timers(self) -> None:
        """Call the real timers that are due."""
        now = _REAL.monotonic() / SECOND
        while self._real_timers and (self._real_timers[0][0] <= now or self._real_timers[0][2].cancelled()):
            timer = heappop(self._real_timers)[2]
            if not timer.cancelled():
                self._ready.append(timer)

    def _until_real_timer(self) -> float:
        """Return the real seconds until the next real timer."""
        if not self._real_timers:
            return _LONGEST_WAIT
        return max(0.0, self._real_timers[0][0] - _REAL.monotonic() / SECOND)

    def run_in_executor(
        self, executor: Executor | None, func: Callable[[Unpack[Ts]], T], *args: *Ts
    ) -> asyncio.Future[T]:
        """Do as asyncio; virtual time stands still until the job is done or cancelled."""
        future = super().run_in_executor(executor, func, *args)
        self._jobs += 1
        self._limit = 0
        future.add_done_callback(self._job_done)
        return future

    async def shutdown_default_executor(self, *args: Any, **kwargs: Any) -> None:
        """Do as asyncio."""
        self._jobs += 1  # asyncio does this in a thread of its own
        try:
            await super().shutdown_default_executor(*args, **kwargs)
        finally:
            self._jobs -= 1

    def run_ahead(self, events: list[Event]) -> None:
        """Run events of this sorted list, each at its instant, until something else is due.

        For code with many events, such as the CAN bus: an iteration of the loop for each would cost more than the event
        itself. An event in the past runs now. After 1000 events the loop continues, also if nothing else is due.
        """
        ready, clock = self._ready, self.clock
        if clock.paced:
            self._limit = min(self._next_timer(), clock.limit() + 1)
        else:
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

    def close(self) -> None:
        """Do as asyncio."""
        super().close()
        self._timers.clear()

    def _run_once(self) -> None:
        """Do one iteration as asyncio does, but with integers: between the events of a simulation, this is hot."""
        timers, ready = self._timers, self._ready
        if self._timer_cancelled_count:
            self._drop_cancelled()
        at_once = ready or self._stopping or (timers and timers[0][0] <= self.clock.elapsed)
        events = self._selector.select(0 if at_once else None)
        if events:
            self._process_events(events)
        elapsed = self.clock.elapsed
        while timers and timers[0][0] <= elapsed:
            timer = heappop(timers)[2]
            timer._scheduled = False  # noqa: SLF001 - asyncio's
            ready.append(timer)
        for _ in range(len(ready)):  # not what these add: that comes after the next look at timers and descriptors
            handle = ready.popleft()
            if not handle._cancelled:  # noqa: SLF001
                handle._run()  # noqa: SLF001

    def _drop_cancelled(self) -> None:
        """Drop cancelled timers at the head of the heap, or all if they are too many."""
        timers = self._timers
        if self._timer_cancelled_count > max(_CANCELLED_MIN, len(timers) // 2):
            timers[:] = [each for each in timers if not each[2].cancelled()]
            heapify(timers)
            self._timer_cancelled_count = 0
        while timers and timers[0][2].cancelled():
            heappop(timers)
            self._timer_cancelled_count -= 1

    def _next_timer(self) -> int:
        return self._timers[0][0] if self._timers else _END

    def _job_done(self, _future: asyncio.Future[Any]) -> None:
        self._jobs -= 1

    def _turn(self) -> None:
        """Count an iteration of the loop at this instant; after too many, jump to the next timer nevertheless."""
        if self._instant != self.clock.elapsed:
            self._instant, self._turns = self.clock.elapsed, 0
        self._turns += 1
        if self._turns >= _BUSY and not self._jobs and not self.clock.paced:
            instant = self._next_timer()
            if instant < _END:
                self.clock.elapsed = max(self.clock.elapsed, instant)

    def _advance(self) -> None:
        """Let the time of a paced clock pass, up to the next timer."""
        self.clock.advance(min(self._next_timer(), self._end))
        self._run_real_timers()

    def _idle(self) -> float | None:
        """Jump to the next timer, when this instant is done. Return the seconds to wait; None: until an event.

        With a free clock, only jobs in threads are waited for.
        """
        if self.clock.paced:
            return self._paced_idle()
        if self._jobs:
            return None
        instant = self._next_timer()
        if instant >= self._end:
            self._give_up(bool(self._timers))
        background = self._timers[0][2].background
        if background is False or (background is not True and not background()):
            self._checked, self._waited_for = instant, None
        elif instant - self._checked >= _IDLE_CHECK:
            self._check_progress(instant)
        self.clock.elapsed = instant
        return 0.0

    def _paced_idle(self) -> float:
        self._advance()
        instant, end = self._next_timer(), self._end
        if self.clock.elapsed >= end:
            self._give_up(True)
        if instant <= self.clock.elapsed or self._ready:
            return 0.0
        return min(self.clock.delay(min(instant, end)), self._until_real_timer(), _LONGEST_WAIT)

    def _give_up(self, later: bool) -> NoReturn:
        if not later:
            raise Deadlock(self._with_tasks("virtual time stands still: nothing is scheduled that could wake a task"))
        if self._end == _END:
            raise Deadlock(
                self._with_tasks("virtual time is over: the next timer is more than 48 days after the start")
            )
        text = f"virtual time is over: its limit of {self._end / SECOND:g} s is reached"
        self._end = min(self._end + _IDLE_MAX, _END)  # for clean-up
        raise Deadlock(self._with_tasks(text))

    def _check_progress(self, instant: int) -> None:
        """Raise Deadlock if background timers, which alone have run for a while, have woken no task for too long."""
        before, waits = self._waited_for, {task: _future_of(task) for task in asyncio.all_tasks(self)}
        self._checked, self._waited_for = instant, waits
        if before is None or not _same(before, waits) or not all(_in_background(each[2]) for each in self._timers):
            self._alive, self._alive_really = instant, _REAL.monotonic()
        elif instant - self._alive >= _IDLE_MAX or (
            instant - self._alive >= _IDLE_MIN and _REAL.monotonic() - self._alive_really >= _IDLE_REAL_MIN
        ):
            repeated = "only announcements and the like go on, and wake no task"
            raise Deadlock(self._with_tasks(f"virtual time leads nowhere: {repeated}"))

    def _with_tasks(self, why: str) -> str:
        tasks = sorted(asyncio.all_tasks(self), key=hash)
        waiting = [(task.get_name(), _where(task.get_coro())) for task in tasks]
        return "\n".join([why, *(f"  {name}: {place}" for name, place in waiting if not name.endswith(" guard"))])


def _future_of(task: asyncio.Task[Any]) -> object:
    """Return what the task waits for: a different object each time it has been woken."""
    return task._fut_waiter  # type: ignore[attr-defined]  # noqa: SLF001 - asyncio's own


def _same(before: dict[asyncio.Task[Any], object], now: dict[asyncio.Task[Any], object]) -> bool:
    return before.keys() == now.keys() and all(before[task] is waits for task, waits in now.items())


def _in_background(timer: _VirtualTimer) -> bool:
    """Return whether a timer only repeats itself, or is cancelled."""
    background = timer.background
    return bool(background() if callable(background) else background)


class _Selector(selectors.DefaultSelector):
    """A selector that does not wait while virtual time can go on instead; `advance` lets that of paced clocks pass."""

    def __init__(
        self, idle: Callable[[], float | None], turn: Callable[[], None], advance: Callable[[], None] | None
    ) -> None:
        super().__init__()
        self._idle = idle
        self._turn = turn
        self._advance = advance
        self._selects = itertools.count()
        self._descriptors = 0

    def register(self, fileobj: Any, events: int, data: Any = None) -> selectors.SelectorKey:
        key = super().register(fileobj, events, data)
        self._descriptors = len(self.get_map())
        return key

    def unregister(self, fileobj: Any) -> selectors.SelectorKey:
        key = super().unregister(fileobj)
        self._descriptors = len(self.get_map())
        return key

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        if self._advance is not None:
            return self._select_paced(timeout, self._advance)
        # A system call for each iteration would take most of the time; alone, asyncio's own descriptor can wait.
        if self._descriptors > 1 or not next(self._selects) % _POLL_EVERY:
            events = super().select(0)
            if events:
                self._turn()
                return events
        if timeout == 0:  # callbacks are ready
            self._turn()
            return []
        return super().select(None) if self._idle() is None else []

    def _select_paced(
        self, timeout: float | None, advance: Callable[[], None]
    ) -> list[tuple[selectors.SelectorKey, int]]:
        events = super().select(0 if timeout == 0 else self._idle())
        advance()
        self._turn()
        return events


class _VirtualTimer(asyncio.TimerHandle):
    """A timer of virtual time, or of real time beside it."""

    _cancelled: bool

    def __init__(self, when: float, callback: Any, args: Any, loop: VirtualLoop, context: Any) -> None:
        super().__init__(when, callback, args, loop, context)
        self.background: bool | Callable[[], bool] = False
        """True for a timer that does not keep the loop alive; set by `r2p.clock.in_background`."""
        self._scheduled = True  # asyncio's mark for timers in its heap

    def cancel(self) -> None:
        """Do as asyncio: a cancelled timer stays in the heap, but does not keep the program alive."""
        super().cancel()
        self.background = True


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
        """Do as asyncio; Python 3.13.0 calls this with None for a task without a name."""
        if value is not None:
            super().set_name(value)

    @classmethod
    def make(cls, loop: Any, coro: Any, **options: Any) -> _Task:
        """The loop's task factory."""
        return cls(coro, loop, **options)


def _nanoseconds(seconds: float) -> int:
    whole = int(seconds)  # separate from the fraction, which is exact, and small enough to be multiplied
    return whole * SECOND + round((seconds - whole) * SECOND)


def _where(awaitable: object) -> str:
    """Return the chain of calls in which a task waits, outermost first, and the topic it waits for.

    For example `blink (app.py:12) > Subscriber.fetch (subscriber.py:166), topic leds`.
    """
    steps: list[str] = []
    topic: object = ""
    for frame in frames(awaitable):
        code = frame.f_code
        steps.append(f"{code.co_qualname} ({Path(code.co_filename).name}:{frame.f_lineno})")
        topic = getattr(frame.f_locals.get("self"), "topic", topic)
    waits = " > ".join(steps) or "not started"
    return f"{waits}, topic {topic}" if isinstance(topic, str) and topic else waits
