"""What tools tell people: on stderr, in short lines; nobody there to read them is no error."""

import contextlib
import logging
import sys
from collections.abc import Iterator
from typing import Any

from r2p.printable import printable


def say(text: str) -> None:
    """Tell the user, on stderr."""
    with contextlib.suppress(OSError):  # nobody reads it
        print(printable(f"r2p: {text}", "\n\t"), file=sys.stderr, flush=True)  # noqa: T201 - the one place


class _Short(logging.Formatter):
    """A log record as a line for people; nodes' records begin with `module/node`."""

    def format(self, record: logging.LogRecord) -> str:
        _, _, rest = record.name.partition(".")
        module, _, node = rest.partition(".")
        where = f"{module}/{node}: " if node else "r2p: "
        level = f"{record.levelname.lower()}: " if record.levelno >= logging.WARNING else ""
        text = where + level + record.getMessage()
        if record.exc_info:
            text += "\n" + self.formatException(record.exc_info)
        return printable(text, "\n\t")


class _Stderr(logging.StreamHandler[Any]):
    """Whatever stderr is when something is logged; nobody there to read it: silence."""

    def __init__(self) -> None:
        super().__init__(sys.stderr)

    def emit(self, record: logging.LogRecord) -> None:
        self.stream = sys.stderr
        super().emit(record)

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802 - logging's name
        if not isinstance(sys.exc_info()[1], OSError | ValueError):
            super().handleError(record)


_HANDLER = _Stderr()
_HANDLER.setFormatter(_Short())


@contextlib.contextmanager
def log_to_stderr(level: int) -> Iterator[None]:
    """In the block log records of r2p go to stderr: INFO and up, each -v or -q moves that by one level."""
    logger = logging.getLogger("r2p")
    propagate, before = logger.propagate, logger.level
    logger.addHandler(_HANDLER)
    logger.propagate = False
    logger.setLevel(max(logging.DEBUG, min(logging.INFO - 10 * level, logging.CRITICAL)))
    try:
        yield
    finally:
        logger.removeHandler(_HANDLER)
        logger.propagate = propagate
        logger.setLevel(before)
