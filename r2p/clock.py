"""The only place, with `r2p.sim`, that knows where time comes from.

An event loop may bring its own clock and its own random numbers, as `loop.clock` and `loop.random`; `clock_of` and
`random_of` ask it, and fall back to the machine's. So the same code runs live and under virtual time. All instants are
integer nanoseconds.

`Alarm` is one timer that can be moved, for the shell around a protocol. `Ticker` is a period that never drifts: on
Linux a timerfd, because event loops count their timers in milliseconds.
"""

from __future__ import annotations

import asyncio
import os
import random
import sys
import time
from typing import TYPE_CHECKING, Final, Protocol

if TYPE_CHECKING:
    from collections.abc import Callable

_SECOND: Final = 1_000_000_000
_SHORTEST_PERIOD: Final = 1_000
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
    """The computer's clock. When UTC is set back, `now()` goes on at half speed until UTC has caught up with it."""

    virtual = False

    def __init__(self, utc: Callable[[], int] = time.time_ns, monotonic: Callable[[], int] = time.monotonic_ns) -> None:
        self.monotonic = monotonic
        self._utc = utc
        self._last = 0  # what now() said last
        self._slowed = -1  # ... and what it said last at half speed
        self._anchor = (0, 0)  # where half speed began: what now() had said, and the monotonic instant

    def now(self) -> int:
        utc = self._utc()
        if utc >= self._last:
            self._last = utc
            return utc
        return self._half_speed()

    def _half_speed(self) -> int:
        monotonic = self.monotonic()
        if self._last != self._slowed:  # full speed in between: UTC was set back again
            self._anchor = (self._last, monotonic)
        began, at = self._anchor
        self._last = self._slowed = began + (monotonic - at) // 2
        return self._last


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


class Alarm:
    """One timer that can be moved: calls `callback()` in the loop once the deadline is reached, never before it.

    It comes up to about a millisecond late on a real loop, and at the very nanosecond under virtual time.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, callback: Callable[[], object]) -> None:
        self._loop = loop
        self._clock = clock_of(loop)
        self._callback = callback
        self._deadline: int | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._armed = 0  # when the loop's timer goes off; may be before the deadline, when that was put off

    def set(self, deadline: int | None) -> None:
        """Move to this instant of `Clock.monotonic()`, in ns; in the past means as soon as possible. None: off."""
        self._deadline = deadline
        if self._timer is not None:
            if deadline is not None and self._armed <= deadline:
                return  # putting it off is frequent, and costs nothing: the timer looks again when it goes off
            self._timer.cancel()
            self._timer = None
        if deadline is not None:
            self._arm(deadline, max(0, deadline - self._clock.monotonic()))

    def close(self) -> None:
        """Switch it off."""
        self.set(None)

    def _arm(self, deadline: int, delay: int) -> None:
        self._armed = deadline
        if self._clock.virtual:  # the instant itself: a sum of floats may miss it by a nanosecond
            self._timer = self._loop.call_at(deadline / _SECOND, self._fire)
        else:
            self._timer = self._loop.call_later(delay / _SECOND, self._fire)

    def _fire(self) -> None:
        self._timer = None
        assert self._deadline is not None  # set(None) cancels the timer
        early = self._deadline - self._clock.monotonic()
        if early > 0:
            self._arm(self._deadline, max(early, _RETRY) if self._armed == self._deadline else early)
            return
        self._deadline = None
        self._callback()


class Ticker:
    """A period on absolute phase: tick k is due at start + k * period of the monotonic clock.

    `callback(scheduled, late, skipped)`: when the tick was due, by how much it is late (both ns), and how many ticks
    before it were lost because the loop was blocked; those are never made up for. What it raises goes to the loop's
    exception handler, and the ticker goes on.
    """

    def __init__(
        self, loop: asyncio.AbstractEventLoop, period: int, callback: Callable[[int, int, int], object]
    ) -> None:
        """`period` in ns, at least 1000. Raises ValueError below that."""
        if period < _SHORTEST_PERIOD:
            raise ValueError(f"a period of {period} ns is too short: the shortest is {_SHORTEST_PERIOD} ns")
        self._loop = loop
        self._period = period
        self._callback = callback
        self._clock = clock_of(loop)
        self._alarm = Alarm(loop, self._tick)
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
        except (OSError, AttributeError):  # AttributeError: a C library, or a Python, without it
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


if sys.version_info >= (3, 13):

    def _open_timerfd(first: int, period: int) -> int:
        """A descriptor that becomes readable at `first` and every `period` after it, in ns of the monotonic clock."""
        fd = os.timerfd_create(time.CLOCK_MONOTONIC, flags=os.TFD_NONBLOCK | os.TFD_CLOEXEC)
        os.timerfd_settime_ns(fd, flags=os.TFD_TIMER_ABSTIME, initial=first, interval=period)
        return fd

else:

    def _open_timerfd(first: int, period: int) -> int:
        """A descriptor that becomes readable at `first` and every `period` after it, in ns of the monotonic clock."""
        import ctypes

        libc = ctypes.CDLL(None, use_errno=True)
        fd: int = libc.timerfd_create(time.CLOCK_MONOTONIC, os.O_NONBLOCK | os.O_CLOEXEC)
        if fd < 0:
            raise OSError(ctypes.get_errno(), "timerfd_create")
        times = (ctypes.c_long * 4)(*divmod(period, _SECOND), *divmod(first, _SECOND))  # struct itimerspec
        libc.timerfd_settime(fd, 1, times, None)  # 1: TFD_TIMER_ABSTIME
        return fd
