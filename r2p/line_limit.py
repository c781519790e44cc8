"""How many lines of the program's log others can make happen."""

_SECOND = 1_000_000_000


class LineLimit:
    """At most `rate` lines of one kind in `period` ns; the next one after them says how many were left out."""

    def __init__(self, rate: int = 10, period: int = _SECOND) -> None:
        self._rate = rate
        self._period = period
        self._lines: dict[str, list[int]] = {}
        """Of each kind: since when (ns), and how many there would have been since then."""

    def suffix(self, kind: str, now: int) -> str | None:
        """What to append to one more line (monotonic `now` in ns); None: leave it out."""
        lines = self._lines.get(kind)
        if lines is not None and now - lines[0] < self._period:  # first: it is so for most lines of a flood
            lines[1] += 1
            return "" if lines[1] <= self._rate else None
        left_out = lines[1] - self._rate if lines is not None else 0
        self._lines[kind] = [now, 1]
        return f" ({left_out} more since the last such line)" if left_out > 0 else ""
