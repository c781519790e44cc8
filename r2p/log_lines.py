"""Text from outside on its way to a person: what would move the cursor, or forge a line, is shown as an escape.

Names and texts of other modules may hold anything, sequences for terminals too. What people read goes through
`printable`; what this package logs goes through the filter of `get_logger`, since a log file is read at a terminal.
"""

import logging
import unicodedata


def printable(text: str, allowed: str = "") -> str:
    r"""The text with each character that shows nothing by itself as an escape: `\x1b`, `\n`, `\u202e`.

    Spaces stay, and so does what `allowed` holds.
    """
    return text if text.isprintable() else "".join(_shown(each, allowed) for each in text)


def _shown(character: str, allowed: str) -> str:
    if character.isprintable() or character in allowed or unicodedata.category(character) == "Zs":
        return character
    return character.encode("unicode_escape").decode("ascii")


class _Escape(logging.Filter):
    """Makes the texts that a record is about printable; its format is ours."""

    def filter(self, record: logging.LogRecord) -> bool:
        if isinstance(record.args, tuple):
            record.args = tuple(
                printable(str(each)) if isinstance(each, str | BaseException) else each for each in record.args
            )
        return True


_ESCAPE = _Escape()


def get_logger(name: str) -> logging.Logger:
    """The logger of that name, with arguments that may come from outside: each stays on its line."""
    logger = logging.getLogger(name)
    logger.addFilter(_ESCAPE)  # once, however often it is called
    return logger


# How many lines of the program's log others can make happen.


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
