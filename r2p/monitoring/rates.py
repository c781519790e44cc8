"""Rates of counters that are read about once a second.

A counter of whole messages that is read once a second says 9, 10 or 11 of a topic with 10 Hz. So a rate is the average
over up to 20 s for as long as the counter grows steadily, to one message; after a change it is that of the last step
alone.
"""

import math

_STEP_MIN = 1e-3  # s: two readings closer to each other say nothing
_STEADY = 1.0 + 1e-6  # messages by which a step may differ from the average
_SILENT = 2.0  # messages that are overdue: the counter has stopped
_SPAN = 10.0  # s after which the beginning of the average moves on


class CounterRate:
    """The rate of one counter. `rate` is known from the second reading on, before that None."""

    __slots__ = ("_count", "_grown_at", "_middle", "_middle_count", "_start", "_start_count", "_time", "rate")

    def __init__(self, time: float, count: int) -> None:
        """Begin with a reading; `time` in seconds of any clock."""
        self.rate: float | None = None
        self._time, self._count, self._grown_at = time, count, time
        self._start = self._middle = time
        self._start_count = self._middle_count = count

    def add(self, time: float, count: int) -> float | None:
        """Enter a reading, and return the rate per second.

        A counter that went back was closed and opened anew: it has counted from 0.
        """
        last = self._time
        step = time - last
        if not _STEP_MIN <= step < math.inf:  # also not a number: it comes from another module
            return self.rate
        grown = count - self._count
        if grown < 0:
            self._count, grown = 0, count
            self._begin()
        elif (rate := self.rate) is not None and (
            not -_STEADY <= grown - rate * step <= _STEADY or (not grown and rate * (time - self._grown_at) >= _SILENT)
        ):
            self._begin()
        if grown:
            self._grown_at = time
        if time - self._middle >= _SPAN:
            self._start, self._start_count = self._middle, self._middle_count
            self._middle, self._middle_count = last, self._count
        self._time, self._count = time, count
        self.rate = rate = (count - self._start_count) / (time - self._start)
        return rate

    def _begin(self) -> None:
        """Begin the average with the last reading."""
        self._start = self._middle = self._time
        self._start_count = self._middle_count = self._count
