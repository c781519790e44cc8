"""The clocks of virtual time: free, at a steady speed, or after another clock.

A free `VirtualClock` jumps to the next timer. A `PacedClock` goes no faster than so many times real time, so that other
programs take part: real sockets and devices work, and ROS nodes that follow its `/clock`. A `FollowingClock` does what
other programs do there: it shows the time that it is given, and stands still in between.
"""

from collections.abc import Callable
from typing import Final

from r2p.clock import SystemClock
from r2p.log_lines import LineLimit, get_logger
from r2p.units import SECOND

logger = get_logger("r2p.clock")

_SYSTEM: Final = SystemClock()
_EPOCH: Final = 1_356_998_400 * SECOND  # 2013-01-01T00:00:00Z
_LAG: Final = (
    SECOND // 10
)  # ns of real time by which a paced clock may be late, and makes up for it; what is more is lost
_LOOK_EVERY: Final = 0.5  # s of real time between two looks whether the clock that is followed is still there
_REORDERED: Final = SECOND // 2  # ns by which a time may be older than the one before, and is left out
_JUMP: Final = 10 * SECOND  # by which a clock may go on at once, with all timers until then; beyond it is set anew


class VirtualClock:
    """The clock of a `VirtualLoop`: an integer, moved by the loop. Satisfies `r2p.clock.Clock`."""

    virtual = True
    paced = False
    """True if time waits for real time, and so for other programs."""

    def __init__(self) -> None:
        self.elapsed = 0
        """Ns since the start; set by the loop."""
        self.epoch = _EPOCH
        """UTC at the start, ns."""

    def now(self) -> int:
        """Return UTC in ns; it starts at 2013-01-01."""
        return self.epoch + self.elapsed

    def monotonic(self) -> int:
        """Return the ns since the start."""
        return self.elapsed

    def limit(self) -> int:
        """Return how far time may have gone now (ns since the start)."""
        return self.elapsed

    def delay(self, instant: int) -> float:
        """Return the real seconds until time may have gone to an instant, or until it is to be asked again."""
        return 0.0

    def advance(self, latest: int) -> None:
        """Let time go on as far as it may have gone now, but not beyond `latest`."""


class PacedClock(VirtualClock):
    """Virtual time that goes `speed` times as fast as real time, and slower where the computer can't keep up."""

    paced = True

    def __init__(self, speed: float, real: Callable[[], int] = _SYSTEM.monotonic) -> None:
        super().__init__()
        self.speed = speed
        self._real = real
        self._anchor = (real(), 0)  # a real instant, and the virtual one that belongs to it

    def limit(self) -> int:
        real, elapsed = self._anchor
        return elapsed + round((self._real() - real) * self.speed)

    def delay(self, instant: int) -> float:
        return max(0, instant - self.limit()) / self.speed / SECOND

    def advance(self, latest: int) -> None:
        limit = self.limit()
        self.elapsed = max(self.elapsed, min(limit, latest))
        lag = round(_LAG * self.speed)
        if limit - self.elapsed > lag:
            self._anchor = self._real(), self.elapsed + lag


class FollowingClock(PacedClock):
    """A clock that follows another one, such as that of a ROS simulator. Without one, it shows real time.

    Between two readings it stands still. When the other clock jumps back, or far ahead, this one jumps with it: timers
    do not fire for the time that was skipped.
    """

    def __init__(self, real: Callable[[], int] = _SYSTEM.monotonic) -> None:
        super().__init__(1.0, real)
        self.epoch = _SYSTEM.now()
        self._followed: int | None = None
        self._alive: Callable[[], bool] = bool
        self._lines = LineLimit(1)

    def follow(self, utc: int, alive: Callable[[], bool]) -> None:
        """Go on to this time (ns since 1970); with real time as soon as `alive()` is false: the other clock is gone."""
        self._alive = alive
        step = utc - self.now()
        if self._followed is not None and -_REORDERED < step <= _JUMP:
            self._followed = max(self._followed, utc - self.epoch)
            return
        more = self._lines.suffix("jump", self._real())
        if more is not None:
            before = (
                f"goes from {self.now() / SECOND:.1f} s to" if self._followed is not None else "is followed: it is now"
            )
            logger.info("the time of /clock %s %.1f s%s", before, utc / SECOND, more)
        self.epoch, self._followed = utc - self.elapsed, self.elapsed

    def release(self) -> None:
        """Go on with real time."""
        self._followed = None
        self._anchor = self._real(), self.elapsed

    def limit(self) -> int:
        return super().limit() if self._followed is None else self._followed

    def delay(self, instant: int) -> float:
        if self._followed is not None and self._alive():
            return _LOOK_EVERY
        if self._followed is not None:
            logger.warning("/clock has no publisher any more: time goes on by the computer's clock until it has")
            self.release()
        return super().delay(instant)
