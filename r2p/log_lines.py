"""Lines of the log: short for people, safe with texts of other modules, limited in number.

Names and texts of other modules may hold anything, also control sequences of terminals. A log is read at a terminal: so
loggers made by `get_logger` show each character that would move the cursor as an escape. Tools do the same by
`printable`. Events that another module can cause any number of times a second are logged within a `LineLimit`.

A traceback ends at what the user wrote: `short_traceback` leaves out the frames of r2p and asyncio. Programs that don't
configure logging get `default_logging` from `r2p.run`; the commands use the same `LineFormatter`, and `last_resort` for
what is not r2p's.
"""

import asyncio
import contextlib
import logging
import os
import sys
import textwrap
import traceback
import unicodedata
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TextIO

from r2p.errors import Error
from r2p.units import SECOND


def printable(text: str, allowed: str = "") -> str:
    r"""Return the text with each character that shows nothing by itself as an escape: `\x1b`, `\n`, `\u202e`.

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
    """Return the logger for arguments that may come from outside: each record stays on its line."""
    logger = logging.getLogger(name)
    logger.addFilter(_ESCAPE_ARGUMENTS)  # a second time it has no effect
    return logger


class LineLimit:
    """At most `rate` lines of one kind in `period` ns; the first line after that says how many were left out."""

    def __init__(self, rate: int = 10, period: int = SECOND) -> None:
        self._rate = rate
        self._period = period
        self._lines: dict[str, list[int]] = {}
        """For each kind: the start of its period (ns), and how many lines there would have been since."""

    def suffix(self, kind: str, now: int, rate: int = 0) -> str | None:
        """Return the text to append to one more line at `now` (monotonic ns); None if the line is left out.

        `rate` is the limit of this kind, if it differs from the others'.
        """
        rate = rate or self._rate
        lines = self._lines.get(kind)
        if lines is not None and now - lines[0] < self._period:  # first, as this is so for most lines of a flood
            lines[1] += 1
            return "" if lines[1] <= rate else None
        left_out = lines[1] - rate if lines is not None else 0
        self._lines[kind] = [now, 1]
        return f" ({left_out} more since the last such line)" if left_out > 0 else ""


# Tracebacks

DEBUG = "R2P_DEBUG"
"""The environment variable that, set to anything, makes tracebacks complete and the default level DEBUG."""

_INTERNAL = (*(str(Path(file).parent) + os.sep for file in (__file__, asyncio.__file__)), "uvloop/")


def debugging() -> bool:
    """Return whether tracebacks are to be complete: by R2P_DEBUG, or by the level DEBUG of the logger `r2p`."""
    return bool(os.environ.get(DEBUG)) or logging.getLogger("r2p").isEnabledFor(logging.DEBUG)


def internal(filename: str) -> bool:
    """Return whether a frame of this file is one of r2p or asyncio, which users did not write."""
    return filename.startswith(_INTERNAL)


def short_traceback(error: BaseException) -> str:
    """Format an exception with its traceback, without frames of r2p and asyncio unless a bug leaves no others.

    While `debugging`, all frames stay.
    """
    report = traceback.TracebackException.from_exception(error)
    if not debugging():
        _shorten(report, error)
    return "".join(report.format()).rstrip("\n")


def _shorten(report: traceback.TracebackException | None, error: BaseException | None) -> None:
    """Shorten the report of an error, and of those that led to it."""
    if report is None or error is None:
        return
    own = [frame for frame in report.stack if not internal(frame.filename)]
    if own or isinstance(error, Error):  # those of r2p say what to do
        report.stack[:] = own
    if isinstance(error, TimeoutError) and isinstance(error.__cause__, asyncio.CancelledError):
        report.__cause__ = None  # how asyncio.timeout works inside
        report.__suppress_context__ = True
    _shorten(report.__cause__, error.__cause__)
    _shorten(report.__context__, error.__context__)
    if isinstance(error, BaseExceptionGroup):
        for part, each in zip(report.exceptions or (), error.exceptions, strict=False):
            _shorten(part, each)


class _ShortTracebacks(logging.Filter):
    """Gives records with an exception its short traceback, whatever formats them."""

    def filter(self, record: logging.LogRecord) -> bool:
        if record.exc_info and record.exc_info[1] is not None:
            record.exc_text = short_traceback(record.exc_info[1])  # formatters of `logging` use this where it is set
        return True


_SHORT_TRACEBACKS = _ShortTracebacks()


def node_logger(module: str, node: str) -> logging.Logger:
    """The logger `r2p.MODULE.NODE`, whose records have short tracebacks."""
    logger = logging.getLogger(f"r2p.{module}.{node}")
    logger.addFilter(_SHORT_TRACEBACKS)
    return logger


class NodeLogger(logging.LoggerAdapter[logging.Logger]):
    """A logger named `r2p.MODULE.NODE`; its records from `threshold` up also go to the module's `log` topic."""

    def __init__(self, logger: logging.Logger, publish: Callable[[int, str], None]) -> None:
        super().__init__(logger)
        self.threshold = logging.INFO
        """The level from which on records go to the topic."""
        self._publish = publish

    def log(self, level: int, msg: object, *args: object, **kwargs: Any) -> None:
        kwargs["stacklevel"] = kwargs.get("stacklevel", 1) + 1
        super().log(level, msg, *args, **kwargs)
        if level >= self.threshold:
            self._publish(level, _text(level, msg, args, kwargs.get("exc_info")))


def _text(level: int, msg: object, args: tuple[object, ...], exc_info: object) -> str:
    """Return a log record as `logging` would print it, traceback included."""
    try:
        text = logging.LogRecord("", level, "", 0, msg, args, None).getMessage()
    except (TypeError, ValueError):  # arguments that do not fit; logging itself says so on stderr
        text = f"{msg} {args}"
    if not exc_info:
        return text
    error = exc_info[1] if isinstance(exc_info, tuple) else exc_info
    if not isinstance(error, BaseException):  # True: the one that is being handled
        error = sys.exception()
    return text if error is None else f"{text}\n{short_traceback(error)}"


# Output

_HANGING = "  "  # before all lines but the first of a text that was wrapped


def wrapped(text: str, stream: TextIO) -> str:
    """Return text whose lines fit the terminal that `stream` is, broken between words; else return it as it is.

    A terminal would break them inside of words. Words that are longer than a line, such as URLs, stay whole.
    """
    return wrapped_at(text, _width(stream) if stream.isatty() else 0)


def wrapped_at(text: str, width: int) -> str:
    """Return text whose lines have at most `width` characters, broken between words; 0: as it is."""
    return "\n".join(_wrapped_line(line, width) if 0 < width < len(line) else line for line in text.split("\n"))


def _wrapped_line(line: str, width: int) -> str:
    indent = line[: len(line) - len(line.lstrip())] + _HANGING
    return textwrap.fill(line, width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)


def _width(stream: TextIO) -> int:
    """Return the columns of a terminal, or COLUMNS; 0: unknown."""
    try:
        return int(os.environ.get("COLUMNS", "0")) or os.get_terminal_size(stream.fileno()).columns
    except (OSError, ValueError):
        return 0


class LineFormatter(logging.Formatter):
    """Formats a record as a short line that begins with `MODULE/NODE`, with `r2p`, or with another logger's name.

    The level is shown from WARNING up. With `times` it is always shown, after the time.
    """

    def __init__(self, *, times: bool = False) -> None:
        super().__init__()
        self._times = times

    def format(self, record: logging.LogRecord) -> str:
        top, _, rest = record.name.partition(".")
        module, _, node = rest.partition(".")
        where = record.name if top != "r2p" else f"{module}/{node}" if node else "r2p"
        text = printable(_message(record), "\n\t")
        if not self._times:
            level = f"{record.levelname.lower()}: " if record.levelno >= logging.WARNING else ""
            line = wrapped(f"{where}: {level}{text}", sys.stderr)
        else:
            time = f"{self.formatTime(record, '%H:%M:%S')}.{int(record.msecs):03}"
            level = f"{record.levelname:<7}"
            line = wrapped(f"{time} {level} {where}: {text}", sys.stderr)
            line = line.replace(level, _coloured(level, record.levelno), 1)
        if record.exc_info:  # as it is: a traceback quotes code
            line += "\n" + printable(record.exc_text or self.formatException(record.exc_info), "\n\t")
        return line


def _message(record: logging.LogRecord) -> str:
    """Return the text of a record, also if its arguments do not fit: `logging` would print 40 lines about that."""
    try:
        return record.getMessage()
    except (TypeError, ValueError, KeyError) as error:
        place = f"{record.filename}, line {record.lineno}"
        return f"{record.msg} {record.args} (these arguments do not fit the format: {error}; {place})"


def _coloured(text: str, level: int) -> str:
    """Return the text in yellow for WARNING and in red from ERROR up, where stderr is a terminal that has colours."""
    plain = os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb" or not sys.stderr.isatty()
    if level < logging.WARNING or plain:
        return text
    return f"\x1b[{33 if level < logging.ERROR else 31}m{text}\x1b[0m"


class StderrHandler(logging.StreamHandler[Any]):
    """Writes to the `sys.stderr` of the moment, and is silent if that is closed."""

    def __init__(self, *, times: bool = False) -> None:
        super().__init__(sys.stderr)
        self.setFormatter(LineFormatter(times=times))

    def emit(self, record: logging.LogRecord) -> None:
        self.stream = sys.stderr
        super().emit(record)

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802 - logging's name
        if not isinstance(sys.exc_info()[1], OSError | ValueError):
            super().handleError(record)


@contextlib.contextmanager
def last_resort(handler: logging.Handler) -> Iterator[None]:
    """Write the records that no handler takes by this one in the block, whichever library they are from.

    The root logger gets no handler, so a program can still call `logging.basicConfig` in the block. `logging.warning`
    and its like call that by themselves: what it sets up then gets the format of `handler`.
    """
    root, before = logging.getLogger(), logging.lastResort
    adopt = _AdoptImplicit(handler)
    if before is not None:  # else the program does not want them
        logging.lastResort = handler
    root.addFilter(adopt)
    handler.addFilter(adopt)
    try:
        yield
    finally:
        logging.lastResort = before
        root.removeFilter(adopt)
        handler.removeFilter(adopt)


class _AdoptImplicit(logging.Filter):
    """Gives the root logger's handler from `logging.warning(...)` a format; of records it lets all pass."""

    def __init__(self, handler: logging.Handler) -> None:
        super().__init__()
        self._formatter = handler.formatter

    def filter(self, _record: logging.LogRecord) -> bool:
        root = logging.getLogger()
        for each in root.handlers if root.level == logging.WARNING else ():  # as Python starts
            format_ = getattr(each.formatter, "_fmt", None)  # the formatter's own; there is no other way to see it
            if type(each) is logging.StreamHandler and format_ == logging.BASIC_FORMAT:
                each.setFormatter(self._formatter)
        return True


@contextlib.contextmanager
def default_logging() -> Iterator[None]:
    """Log to stderr in the block, unless the root logger or `r2p` has handlers: of `r2p` from INFO up.

    Of other loggers come the records that Python would print bare: from WARNING up, or from the level of the logger. A
    level that the program has set stays as it is; R2P_DEBUG makes the default of `r2p` DEBUG.
    """
    logger, root = logging.getLogger("r2p"), logging.getLogger()
    if logger.handlers or root.handlers:
        yield
        return
    handler = StderrHandler(times=True)
    level = logger.level
    if level == logging.NOTSET and root.level == logging.WARNING:  # as Python starts
        logger.setLevel(logging.DEBUG if os.environ.get(DEBUG) else logging.INFO)
    with last_resort(handler):  # first its filter, then this one
        handler.addFilter(lambda _record: not root.handlers)  # else a node that configures logging gets each line twice
        logger.addHandler(handler)
        try:
            yield
        finally:
            logger.removeHandler(handler)
            logger.setLevel(level)
