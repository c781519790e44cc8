"""The only place, with `r2p.sim`, that knows where time comes from.

An event loop may bring its own clock and its own random numbers, as `loop.clock` and `loop.random`; `clock_of` and
`random_of` ask it, and fall back to the machine's. So the same code runs live and under virtual time. All instants are
integer nanoseconds.

`Alarm` is one timer that can be moved, for the shell around a protocol. `Ticker` is a period that never drifts: on
Linux a timerfd, because event loops count their timers in milliseconds. So is `ExactAlarm`.
"""

from __future__ import annotations

import asyncio
import functools
import logging
import os
import random
import sys
import time
from typing import TYPE_CHECKING, Any, Final, Protocol

if TYPE_CHECKING:
    from collections.abc import Callable

logger = logging.getLogger("r2p.clock")

_SECOND: Final = 1_000_000_000
_WORTH_TELLING: Final = _SECOND // 10  # ns by which UTC is set back
_SHORTEST_PERIOD: Final = 1_000
_NO_TIMERFD: Final = (OSError, AttributeError)  # AttributeError: a C library, or a Python, without it
_RETRY: Final = 1_000_000  # ns; uvloop's timers have whole milliseconds, and may go off half a one early


class Clock(Protocol):
    """What tells the time."""

    virtual: bool
    """True when time is simulated: it stands still while code runs, and only loop timers know it."""

    def now(self) -> int:
        """UTC in ns since 1970. Never jumps back, even when somebody sets the computer's clock."""
        ...

    def monotonic(self) -> int:
        """Ns since an arbitrary instant, never set by anybody: for deadlines and intervals."""
        ...


class SystemClock:
    """The computer's clock. When UTC is set back, `now()` goes on at half speed until UTC has caught up with it.

    That takes twice as long as UTC was set back by; the log says so. Meanwhile `now()` is ahead of other computers'.
    """

    virtual = False

    def __init__(self, utc: Callable[[], int] = time.time_ns, monotonic: Callable[[], int] = time.monotonic_ns) -> None:
        self.monotonic = monotonic
        self._utc = utc
        self._last = 0  # what now() said last
        self._slowed = -1  # ... and what it said last at half speed
        self._ahead = 0  # by how much it was ahead of UTC when the log last said so
        self._anchor = (0, 0)  # where half speed began: what now() had said, and the monotonic instant

    def now(self) -> int:
        utc = self._utc()
        if utc >= self._last:
            self._last = utc
            return utc
        return self._half_speed(utc)

    def _half_speed(self, utc: int) -> int:
        monotonic = self.monotonic()
        ahead = self._last - utc
        if self._last != self._slowed:  # full speed in between: UTC was set back again
            self._anchor = (self._last, monotonic)
            self._ahead = 0
        if ahead > self._ahead + _WORTH_TELLING:
            _tell_set_back(ahead)
            self._ahead = ahead
        began, at = self._anchor
        self._last = self._slowed = began + (monotonic - at) // 2
        return self._last


def _tell_set_back(ahead: int) -> None:
    logger.warning(
        "the computer's clock was set back by %.1f s: r2p's goes on at half speed for %.0f s, until both agree again; "
        "meanwhile what other computers stamp looks too old here (max_age= drops and counts it)",
        ahead / _SECOND,
        2 * ahead / _SECOND,
    )


_SYSTEM: Final = SystemClock()
_RANDOM: Final = random.Random()


def clock_of(loop: asyncio.AbstractEventLoop | None = None) -> Clock:
    """The clock of this loop (default: the running one): its attribute `clock`, else the computer's."""
    clock: Clock = getattr(loop or _running(), "clock", _SYSTEM)
    return clock


def random_of(loop: asyncio.AbstractEventLoop | None = None) -> random.Random:
    """The random numbers of this loop (default: the running one): its attribute `random`, else freely seeded ones."""
    numbers: random.Random = getattr(loop or _running(), "random", _RANDOM)
    return numbers


def _running() -> asyncio.AbstractEventLoop | None:
    try:
        return asyncio.get_running_loop()
    except RuntimeError:
        return None


def in_background(timer: asyncio.TimerHandle, background: bool | Callable[[], bool] = True) -> None:
    """Mark a timer that only repeats itself, or says so when it is asked: under virtual time it keeps nothing going."""
    if hasattr(timer, "background"):
        timer.background = background


class Alarm:
    """One timer that can be moved: calls `callback()` in the loop once the deadline is reached, never before it.

    It comes up to about a millisecond late on a real loop, and at the very nanosecond under virtual time.

    `background` is what only repeats itself, such as announcements: under virtual time it keeps no program going.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        callback: Callable[[], object],
        *,
        background: bool | Callable[[], bool] = False,
    ) -> None:
        self._loop = loop
        self._background = background
        self._clock = clock_of(loop)
        self._callback = callback
        self._deadline: int | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._armed: int | None = None  # when it looks; before the deadline, when that was put off

    def set(self, deadline: int | None) -> None:
        """Move to this instant of `Clock.monotonic()`, in ns; in the past means as soon as possible. None: off."""
        self._deadline = deadline
        if self._armed is not None:
            if deadline is not None and self._armed <= deadline:
                return  # putting it off is frequent, and costs nothing: the timer looks again when it goes off
            self._disarm()
        if deadline is not None:
            self._arm(deadline, max(0, deadline - self._clock.monotonic()))

    def close(self) -> None:
        """Switch it off."""
        self.set(None)

    def _arm(self, deadline: int, delay: int) -> None:
        self._armed = deadline
        if self._clock.virtual:  # the instant itself: a sum of floats may miss it by a nanosecond
            self._timer = self._loop.call_at(deadline / _SECOND, self._fire)
            in_background(self._timer, self._background)
        else:
            self._timer = self._loop.call_later(delay / _SECOND, self._fire)

    def _disarm(self) -> None:
        self._armed = None
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _fire(self) -> None:
        armed, self._armed, self._timer = self._armed, None, None
        assert self._deadline is not None  # set(None) cancels the timer
        early = self._deadline - self._clock.monotonic()
        if early > 0:
            self._arm(self._deadline, max(early, _RETRY) if armed == self._deadline else early)
            return
        self._deadline = None
        self._callback()


class ExactAlarm(Alarm):
    """An alarm that comes some ten microseconds late, where there is a timerfd to be had. Has to be closed."""

    def __init__(self, loop: asyncio.AbstractEventLoop, callback: Callable[[], object]) -> None:
        super().__init__(loop, callback)
        self._fd: int | None = None
        self._inexact = self._clock.virtual or sys.platform != "linux"

    def close(self) -> None:
        super().close()
        if self._fd is not None:
            self._loop.remove_reader(self._fd)
            os.close(self._fd)
            self._fd = None

    def _arm(self, deadline: int, delay: int) -> None:
        if not self._inexact and self._fd is None:
            self._open()
        if self._fd is None:
            super()._arm(deadline, delay)
            return
        self._armed = deadline
        _set_timerfd(self._fd, max(deadline, 1), 0)  # an instant of 0 would switch it off

    def _disarm(self) -> None:
        super()._disarm()
        if self._fd is not None:
            _set_timerfd(self._fd, 0, 0)

    def _open(self) -> None:
        try:
            self._fd = _new_timerfd()
        except _NO_TIMERFD:
            self._inexact = True
        else:
            self._loop.add_reader(self._fd, self._readable, self._fd)

    def _readable(self, fd: int) -> None:
        try:
            os.read(fd, 8)
        except BlockingIOError:  # moved since it went off
            return
        if self._armed is not None:
            self._fire()


class Ticker:
    """A period on absolute phase: tick k is due at start + k * period of the monotonic clock.

    `callback(scheduled, late, skipped)`: when the tick was due, by how much it is late (both ns), and how many ticks
    before it were lost because the loop was blocked; those are never made up for. What it raises goes to the loop's
    exception handler, and the ticker goes on.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        period: int,
        callback: Callable[[int, int, int], object],
        *,
        background: bool = False,
    ) -> None:
        """`period` in ns, at least 1000; `background` as of an Alarm. Raises ValueError for a shorter period."""
        if period < _SHORTEST_PERIOD:
            raise ValueError(f"a period of {period} ns is too short: the shortest is {_SHORTEST_PERIOD} ns")
        self._loop = loop
        self._period = period
        self._callback = callback
        self._clock = clock_of(loop)
        self._alarm = Alarm(loop, self._tick, background=background)
        self._fd: int | None = None
        self._start = 0
        self._next = 1

    def start(self) -> None:
        """Begin now: the first tick is due one period later. Begins anew when it was started already."""
        self.close()
        self._start = self._clock.monotonic()
        self._next = 1
        first = self._start + self._period
        if self._clock.virtual or not self._start_timerfd(first):
            self._alarm.set(first)

    def close(self) -> None:
        """Stop: no callback comes after this."""
        self._alarm.close()
        if self._fd is not None:
            self._loop.remove_reader(self._fd)
            os.close(self._fd)
            self._fd = None

    def _start_timerfd(self, first: int) -> bool:
        """Use a timerfd. False where there is none to be had (not Linux, no descriptors left): loop timers do it."""
        if sys.platform != "linux":
            return False
        try:
            fd = _open_timerfd(first, self._period)
        except _NO_TIMERFD:
            return False
        self._loop.add_reader(fd, self._readable, fd)
        self._fd = fd
        return True

    def _readable(self, fd: int) -> None:
        os.read(fd, 8)
        self._tick()

    def _tick(self) -> None:
        now = self._clock.monotonic()
        due = (now - self._start) // self._period
        skipped = due - self._next
        self._next = due + 1
        if self._fd is None:
            self._alarm.set(self._start + self._next * self._period)
        scheduled = self._start + due * self._period
        self._callback(scheduled, now - scheduled, skipped)  # last: the next tick is safe whatever it raises


def _open_timerfd(first: int, period: int) -> int:
    """A descriptor that becomes readable at `first` and every `period` after it, in ns of the monotonic clock."""
    fd = _new_timerfd()
    _set_timerfd(fd, first, period)
    return fd


if sys.version_info >= (3, 13):

    def _new_timerfd() -> int:
        return os.timerfd_create(time.CLOCK_MONOTONIC, flags=os.TFD_NONBLOCK | os.TFD_CLOEXEC)

    def _set_timerfd(fd: int, first: int, period: int) -> None:
        os.timerfd_settime_ns(fd, flags=os.TFD_TIMER_ABSTIME, initial=first, interval=period)

else:

    @functools.cache
    def _ctypes() -> tuple[Any, Any]:
        """The module, loaded by whoever needs it first, and the C library."""
        import ctypes

        return ctypes, ctypes.CDLL(None, use_errno=True)

    def _new_timerfd() -> int:
        ctypes, libc = _ctypes()
        fd: int = libc.timerfd_create(time.CLOCK_MONOTONIC, os.O_NONBLOCK | os.O_CLOEXEC)
        if fd < 0:
            raise OSError(ctypes.get_errno(), "timerfd_create")
        return fd

    def _set_timerfd(fd: int, first: int, period: int) -> None:
        ctypes, libc = _ctypes()
        times = (ctypes.c_long * 4)(*divmod(period, _SECOND), *divmod(first, _SECOND))  # struct itimerspec
        libc.timerfd_settime(fd, 1, times, None)  # 1: TFD_TIMER_ABSTIME


# How long to wait before the next try: longer each time, never the same for two who failed together.


class Backoff:
    """Delays from `first` to `longest` seconds, doubling, each shortened by up to a half at random."""

    def __init__(self, rng: random.Random, *, first: float = 0.1, longest: float = 2.0) -> None:
        self._rng = rng
        self._first = first
        self._longest = longest
        self._next = first

    def reset(self) -> None:
        self._next = self._first

    def slow_down(self) -> None:
        """Take the longest delay next."""
        self._next = self._longest

    def delay(self) -> float:
        """Seconds to wait now."""
        delay, self._next = self._next, min(self._next * 2, self._longest)
        return delay * self._rng.uniform(0.5, 1.0)
