"""How many lines of the program's log others can make happen."""

_SECOND = 1_000_000_000


class LineLimit:
    """At most `rate` lines of one kind in `period` ns; the next one after them says how many were left out."""

    def __init__(self, rate: int = 10, period: int = _SECOND) -> None:
        self._rate = rate
        self._period = period
        self._seconds: dict[str, tuple[int, int]] = {}  # when it began, and how many lines there would have been

    def suffix(self, kind: str, now: int) -> str | None:
        """What to append to one more line (monotonic `now` in ns); None: leave it out."""
        began, count = self._seconds.get(kind, (now - self._period, 0))
        if now - began >= self._period:
            self._seconds[kind] = now, 1
            return f" ({count - self._rate} more since the last such line)" if count > self._rate else ""
        self._seconds[kind] = began, count + 1
        return "" if count < self._rate else None
