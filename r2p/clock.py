"""Time: clocks, timers, durations and back-off. Only this module and `r2p.sim` know where time comes from.

An event loop may bring its own clock and its own random numbers, as `loop.clock` and `loop.random`; `clock_of` and
`random_of` ask it, and fall back to the computer's. So the same code runs live and under virtual time. All instants are
integer nanoseconds; durations in programs are numbers of seconds, and texts such as "10ms" in URLs and options.

`Alarm` is one timer that can be moved, for drivers of protocols. `Ticker` is a period that never drifts, and
`ExactAlarm` an exact alarm: on Linux both use a timerfd, because event loops count in milliseconds.
"""

from __future__ import annotations

import asyncio
import contextlib
import contextvars
import functools
import logging
import math
import os
import random
import re
import sys
import time
from typing import TYPE_CHECKING, Any, Final, Protocol, TypeGuard, runtime_checkable

from r2p.errors import MessageError
from r2p.units import MILLISECOND, SECOND

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

logger = logging.getLogger("r2p.clock")

SHORTEST: Final = 1e-6
"""Seconds of the shortest period or deadline."""

LONGEST: Final = 1e9
"""Seconds of the longest one: 30 years, which fit a timer of any event loop."""

_SET_BACK_WARNING: Final = SECOND // 10  # ns that UTC may be set back before the log says so: less is daily work of NTP
_SHORTEST_PERIOD: Final = 1_000  # ns; SHORTEST as an integer
_NO_TIMERFD: Final = (OSError, AttributeError)  # AttributeError: a C library, or a Python, without it
_RETRY: Final = MILLISECOND  # ns; uvloop's timers have whole milliseconds, and may go off half a one early
_UNITS: Final = {"ns": 1e-9, "us": 1e-6, "ms": 1e-3, "s": 1.0, "": 1.0}


# Clocks


class Clock(Protocol):
    """A source of time."""

    virtual: bool
    """True if time is simulated: it stands still while code runs, and only loop timers know it."""

    def now(self) -> int:
        """UTC in ns since 1970. Never jumps back, even when the computer's clock is set back."""

    def monotonic(self) -> int:
        """Ns since an arbitrary instant; cannot be set: for deadlines and intervals."""


@runtime_checkable
class SteeredClock(Clock, Protocol):
    """A clock that goes on with the times that it is given, such as those of a simulator."""

    def follow(self, utc: int, alive: Callable[[], bool]) -> None:
        """Go on to this time (ns since 1970); with real time as soon as `alive()` is false: the other clock is gone."""


class SystemClock:
    """The computer's clock. When UTC is set back, `now()` goes on at half speed until UTC has caught up with it.

    Stamps must not repeat or run backwards: deadlines and the order of messages depend on them. Catching up takes twice
    the time by which UTC was set back, and the log says so. Meanwhile `now()` is ahead of other computers' clocks.
    """

    virtual = False

    def __init__(self, utc: Callable[[], int] = time.time_ns, monotonic: Callable[[], int] = time.monotonic_ns) -> None:
        self.monotonic = monotonic
        self._utc = utc
        self._last = 0  # the last result of now()
        self._slowed = -1  # ... and the last one at half speed
        self._ahead = 0  # of UTC, when the log last said so
        self._anchor = (0, 0)  # where half speed began: UTC as now() had it, and the monotonic instant

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
        if ahead > self._ahead + _SET_BACK_WARNING:
            _warn_set_back(ahead)
            self._ahead = ahead
        began, at = self._anchor
        self._last = self._slowed = began + (monotonic - at) // 2
        return self._last


def _warn_set_back(ahead: int) -> None:
    logger.warning(
        "the computer's clock was set back by %.1f s: r2p's goes on at half speed for %.0f s, until both agree again; "
        "meanwhile stamps of other computers look too old here (max_age= drops and counts their messages)",
        ahead / SECOND,
        2 * ahead / SECOND,
    )


_SYSTEM: Final = SystemClock()
_RANDOM: Final = random.Random()
if hasattr(os, "register_at_fork"):  # not on Windows
    # Two modules of one random number would be one to their network, and discard what the other one says.
    os.register_at_fork(after_in_child=_RANDOM.seed)


def clock_of(loop: asyncio.AbstractEventLoop | None = None) -> Clock:
    """Return the clock of a loop (default: the running one): its attribute `clock`, or else the computer's."""
    clock: Clock = getattr(loop or _running(), "clock", _SYSTEM)
    return clock


def random_of(loop: asyncio.AbstractEventLoop | None = None) -> random.Random:
    """Return the random numbers of a loop (default: the running one): its `random`, or else freely seeded ones."""
    numbers: random.Random = getattr(loop or _running(), "random", _RANDOM)
    return numbers


def _running() -> asyncio.AbstractEventLoop | None:
    try:
        return asyncio.get_running_loop()
    except RuntimeError:
        return None


# Timers

REAL_TIME: Final[contextvars.ContextVar[bool]] = contextvars.ContextVar("r2p.REAL_TIME", default=False)
"""True in code whose timers are for other programs, such as time-outs of connections, also under virtual time at a
speed: there they count real time.
"""


def real_clock() -> Clock:
    """Return the clock that timers with REAL_TIME follow: that of the running loop, unless it has a speed."""
    clock = clock_of()
    return _SYSTEM if getattr(clock, "paced", False) else clock


@contextlib.contextmanager
def real_time() -> Iterator[None]:
    """Let timers that are set in this block, and in tasks that it starts, count real time."""
    outer = REAL_TIME.set(True)
    try:
        yield
    finally:
        REAL_TIME.reset(outer)


def in_background(timer: asyncio.TimerHandle, background: bool | Callable[[], bool] = True) -> None:
    """Mark a timer that only repeats itself, always or while a function is true: it keeps no virtual time going."""
    if hasattr(timer, "background"):
        timer.background = background


async def sleep_in_background(seconds: float) -> None:
    """Sleep; under virtual time this keeps no program going."""
    loop = asyncio.get_running_loop()
    over = loop.create_future()
    timer = loop.call_later(seconds, _finish, over)
    in_background(timer)
    try:
        await over
    finally:
        timer.cancel()


def _finish(future: asyncio.Future[None]) -> None:
    if not future.done():  # it was cancelled at the same instant
        future.set_result(None)


class Alarm:
    """One timer that can be moved: calls `callback()` in the loop when the deadline is reached, never before.

    The call comes up to about a millisecond late on a real loop, and at the very nanosecond under virtual time.

    `background` is for timers that only repeat, such as announcements: under virtual time they keep no program going.
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
        self._call_at_instant: Callable[[int, Callable[[], object]], Any] | None = None
        if self._clock.virtual:  # the instant itself: a sum of floats may miss it by a nanosecond
            self._call_at_instant = getattr(loop, "call_at_instant", None)
        self._deadline: int | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._armed: int | None = None  # when the loop calls; earlier than the deadline, if that was put off

    def set(self, deadline: int | None) -> None:
        """Move the alarm to this instant of `Clock.monotonic()` in ns; the past means as soon as possible, None off."""
        self._deadline = deadline
        if self._armed is not None:
            if deadline is not None and self._armed <= deadline:
                return  # putting it off is frequent, so it costs nothing: `_fire` looks at the deadline again
            self._disarm()
        if deadline is not None:
            self._arm(deadline, max(0, deadline - self._clock.monotonic()))

    def close(self) -> None:
        """Switch the alarm off."""
        self.set(None)

    def _arm(self, deadline: int, delay: int) -> None:
        self._armed = deadline
        if self._call_at_instant is not None:
            outer = REAL_TIME.set(False) if REAL_TIME.get() else None  # whichever code moves it, and for what it calls
            self._timer = timer = self._call_at_instant(deadline, self._fire)
            timer.background = self._background
            if outer is not None:
                REAL_TIME.reset(outer)
        else:
            self._timer = self._loop.call_later(delay / SECOND, self._fire)

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
    """An alarm that is some ten microseconds late where the system has timerfds. Close it after use.

    With a `period` (ns) a timerfd goes off again by itself: `repeats`. That costs a quarter less than to set it anew.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        callback: Callable[[], object],
        *,
        period: int = 0,
        background: bool = False,
    ) -> None:
        super().__init__(loop, callback, background=background)
        self._period = period
        self._fd: int | None = None
        self._inexact = self._clock.virtual or sys.platform != "linux"

    @property
    def repeats(self) -> bool:
        """Return whether the alarm goes off again without being set."""
        return self._period > 0 and self._fd is not None

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
        _set_timerfd(self._fd, max(deadline, 1), self._period)  # an instant of 0 would switch it off

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
        if self._period:
            self._callback()
        elif self._armed is not None:
            self._fire()


class Ticker:
    """A period on absolute phase: tick k is due at start + k * period of the monotonic clock.

    `callback(scheduled, late, skipped)` gets the instant at which the tick was due, by how much it is late (both ns),
    and how many ticks before it were lost because the loop was blocked: those are not made up for. An exception of the
    callback goes to the loop's exception handler, and the ticker goes on.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        period: int,
        callback: Callable[[int, int, int], object],
        *,
        background: bool = False,
    ) -> None:
        """`period` is in ns, `background` as in `Alarm`. Raises ValueError for a period of less than 1000 ns."""
        if period < _SHORTEST_PERIOD:
            raise ValueError(f"a period of {period} ns is too short: the shortest is {_SHORTEST_PERIOD} ns")
        self._period = period
        self._callback = callback
        self._clock = clock_of(loop)
        self._alarm = ExactAlarm(loop, self._tick, period=period, background=background)
        self._start = 0
        self._next = 1

    def start(self, phase: int | None = None) -> None:
        """Start, or restart: the first tick is due one period from now, or as the next one of those whose `phase`
        (monotonic ns) is given.
        """
        self.close()
        now = self._clock.monotonic()
        self._start = now if phase is None else phase
        self._next = (now - self._start) // self._period + 1
        self._alarm.set(self._start + self._next * self._period)

    @property
    def phase(self) -> int:
        """The instant at which a tick was due last, or the start (monotonic ns)."""
        return self._start + (self._next - 1) * self._period

    def close(self) -> None:
        """Stop the ticks; there are no more calls of the callback."""
        self._alarm.close()

    def _tick(self) -> None:
        now = self._clock.monotonic()
        due = (now - self._start) // self._period
        skipped = due - self._next
        self._next = due + 1
        if not self._alarm.repeats:
            self._alarm.set(self._start + self._next * self._period)
        scheduled = self._start + due * self._period
        self._callback(scheduled, now - scheduled, skipped)  # last: the next tick is safe whatever it raises


if sys.version_info >= (3, 13):

    def _new_timerfd() -> int:
        return os.timerfd_create(time.CLOCK_MONOTONIC, flags=os.TFD_NONBLOCK | os.TFD_CLOEXEC)

    def _set_timerfd(fd: int, first: int, period: int) -> None:
        os.timerfd_settime_ns(fd, flags=os.TFD_TIMER_ABSTIME, initial=first, interval=period)

else:

    @functools.cache
    def _ctypes() -> tuple[Any, Any]:
        """Return `ctypes`, imported at the first use, and the C library."""
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
        times = (ctypes.c_long * 4)(*divmod(period, SECOND), *divmod(first, SECOND))  # struct itimerspec
        libc.timerfd_settime(fd, 1, times, None)  # 1: TFD_TIMER_ABSTIME


# Durations


def duration(text: str) -> float:
    """Return the seconds of "10ms", "20us", "1.5s" or "1.5". Raises ValueError for any other text."""
    match = re.fullmatch(r"([0-9.eE+-]+)\s*(ns|us|ms|s|)", text.strip())
    if match is None:
        raise ValueError(f"{text!r} is not a duration: use 10ms, 20us or seconds")
    value = float(match[1]) * _UNITS[match[2]]
    if not 0.0 <= value < math.inf:
        raise ValueError(f"{text!r} is not a duration: it can't be negative or endless")
    return value


def check_seconds(what: str, value: object, *, least: float) -> None:
    """Raise MessageError unless the value is a duration of at least `least` seconds that a clock can count."""
    if not _is_number(value) or not least <= value <= LONGEST:
        raise MessageError(f"{what} is in seconds, {least:g} to {LONGEST:g}, not {value!r}{_hint(value)}")


def check_timeout(what: str, value: object) -> None:
    """Raise MessageError for a time-out that is neither None (no limit) nor in seconds; 0 or less expires at once."""
    if value is not None and (not _is_number(value) or not value <= LONGEST):
        raise MessageError(f"{what} is in seconds, or None to wait for ever, not {value!r}{_hint(value)}")


def _is_number(value: object) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _hint(value: object) -> str:
    """Return a remedy for a text as in URLs: the number of seconds."""
    try:
        return f": write {duration(value):g}" if isinstance(value, str) else ""
    except ValueError:
        return ""


def local_time(now: int, form: str) -> str:
    """Return a UTC instant (ns) as the local time of this computer, in a format of `time.strftime`."""
    return time.strftime(form, time.localtime(now // SECOND))


class Backoff:
    """Delays between tries, from `first` to `longest` seconds, doubling.

    Each is shortened by up to a half at random, so that simultaneous failures are not retried at the same time.
    """

    def __init__(self, rng: random.Random, *, first: float = 0.1, longest: float = 2.0) -> None:
        self._rng = rng
        self._first = first
        self._longest = longest
        self._next = first

    def reset(self) -> None:
        """Start again with the first delay."""
        self._next = self._first

    def slow_down(self) -> None:
        """Go on with the longest delay."""
        self._next = self._longest

    def delay(self) -> float:
        """The seconds to wait before the next try."""
        delay, self._next = self._next, min(self._next * 2, self._longest)
        return delay * self._rng.uniform(0.5, 1.0)
