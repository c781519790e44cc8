"""Network time by the clock of one node: a line through its last syncs.

The stamp of one sync is off by the jitter of an interrupt, and the node's clock by its drift. A line through many
stamps has much less of the first, and knows the second: so it also goes on well while there are no syncs.

The line is that of least squares through the syncs so far, up to `WINDOW`; then older ones count less and less.
"""

from __future__ import annotations

WINDOW = 32
"""Syncs that the line goes through: it has a third of their jitter, and follows a change of drift in 0.3 s."""
_FEW = 3  # syncs that a new line is taken to go through, also with another master: two tell little about the drift
_RATE_MAX = 1e-3  # by which two clocks differ, at most: quartzes by 200 ppm, a master that catches up by 260 more
_STRAY = 10_000  # ns that a sync may be off the line besides its usual spread; a master's may leave later, for once
_STRAYS_MAX = 3  # syncs in a row that may be off before the line is taken to be wrong


class NetworkTimeFit:
    """The line of one node. Instants are ns of the node's clock, times are network time in ns."""

    def __init__(self) -> None:
        self._count = 0  # of the syncs that the line goes through
        self._at = 0  # the node's clock at the last one, and network time then
        self._time = 0
        self._rate = 0.0  # ns by which network time runs faster, per ns
        self._spread = 0.0  # ns by which syncs are off the line: the mean of the last ones
        self._strays = 0

    @property
    def known(self) -> bool:
        """Return whether there is a line."""
        return self._count > 0

    def time(self, at: int) -> int:
        """Return network time at an instant."""
        since = at - self._at
        return self._time + since + round(since * self._rate)

    def instant(self, time: int) -> int:
        """Return the first instant at which network time is `time` or more."""
        ahead = time - self._time
        at = self._at + ahead - round(ahead * self._rate / (1.0 + self._rate))
        while self.time(at) < time:
            at += 1
        while self.time(at - 1) >= time:
            at -= 1
        return at

    def begin(self, at: int, time: int) -> None:
        """Begin a new line with a sync."""
        self._count, self._strays = _FEW, 0
        self._at, self._time, self._rate, self._spread = at, time, 0.0, 0.0

    def add(self, at: int, time: int, *, changed: bool = False) -> None:
        """Correct the line by a sync. `changed`: by the first one of another master, or after a long time."""
        if at <= self._at:
            return
        expected = self.time(at)
        off = time - expected
        usual = _STRAY + 4 * self._spread
        stray = abs(off) > usual
        self._spread += (min(abs(off), usual) - self._spread) / 8
        self._strays = self._strays + 1 if stray else 0
        if changed or self._strays > _STRAYS_MAX:
            self._count = min(self._count, _FEW)
            if stray:
                self._at, self._time, self._strays = at, time, 0
                return
        elif stray:
            return
        n = self._count = min(self._count + 1, WINDOW)
        # The gains of recursive least squares: a line through n points at equal distances.
        self._time = expected + round(off * 2 * (2 * n - 1) / (n * (n + 1)))
        rate = self._rate + off * 6 / (n * (n + 1)) / (at - self._at)
        self._rate = min(max(rate, -_RATE_MAX), _RATE_MAX)
        self._at = at
