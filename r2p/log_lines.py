"""Lines of the log about what others send: their texts can't forge a line, and their number is limited.

Names and texts of other modules may hold anything, also control sequences of terminals. A log is read at a terminal: so
loggers made by `get_logger` show each character that would move the cursor as an escape. Tools do the same by
`printable`. Events that another module can cause any number of times a second are logged within a `LineLimit`.
"""

import logging
import unicodedata

from r2p.units import SECOND


def printable(text: str, allowed: str = "") -> str:
    r"""The text with each character that shows nothing by itself as an escape: `\x1b`, `\n`, `\u202e`.

    Spaces stay, and so do the characters in `allowed`.
    """
    return text if text.isprintable() else "".join(_escaped(each, allowed) for each in text)


def _escaped(character: str, allowed: str) -> str:
    if character.isprintable() or character in allowed or unicodedata.category(character) == "Zs":
        return character
    return character.encode("unicode_escape").decode("ascii")


class _EscapeArguments(logging.Filter):
    """Makes texts and exceptions among the arguments of a record printable; its format is the program's own."""

    def filter(self, record: logging.LogRecord) -> bool:
        if isinstance(record.args, tuple):
            record.args = tuple(
                printable(str(each)) if isinstance(each, str | BaseException) else each for each in record.args
            )
        return True


_ESCAPE_ARGUMENTS = _EscapeArguments()


def get_logger(name: str) -> logging.Logger:
    """The logger of that name, for arguments that may come from outside: each record stays on its line."""
    logger = logging.getLogger(name)
    logger.addFilter(_ESCAPE_ARGUMENTS)  # a second time it has no effect
    return logger


class LineLimit:
    """At most `rate` lines of one kind in `period` ns; the first line after that says how many were left out."""

    def __init__(self, rate: int = 10, period: int = SECOND) -> None:
        self._rate = rate
        self._period = period
        self._lines: dict[str, list[int]] = {}
        """Of each kind: the start of its period (ns), and how many lines there would have been since."""

    def suffix(self, kind: str, now: int, rate: int = 0) -> str | None:
        """The text to append to one more line at `now` (monotonic ns); None if the line is left out.

        `rate` is that of this kind, where it is not the same for all.
        """
        rate = rate or self._rate
        lines = self._lines.get(kind)
        if lines is not None and now - lines[0] < self._period:  # first, as this is so for most lines of a flood
            lines[1] += 1
            return "" if lines[1] <= rate else None
        left_out = lines[1] - rate if lines is not None else 0
        self._lines[kind] = [now, 1]
        return f" ({left_out} more since the last such line)" if left_out > 0 else ""
