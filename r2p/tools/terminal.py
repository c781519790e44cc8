"""Lines from stdin, without stopping the event loop: it reads only what is there."""

import asyncio
import contextlib
import logging
import os
import select
import sys
from collections.abc import AsyncIterator, Iterator
from typing import Any, TextIO

from r2p.errors import MessageError
from r2p.log_lines import printable
from r2p.tools.output import waitable

_CHUNK = 65536  # bytes
_LONGEST = 1 << 20  # bytes of one line


async def lines(stream: TextIO | None = None) -> AsyncIterator[str]:
    """The lines of stdin (or another stream), to its end. Raises MessageError for a line of over 1 MB."""
    stream = stream or sys.stdin
    fd = waitable(stream)
    if fd is None:
        for line in stream:
            yield line
        return
    rest = b""
    while data := await _read(fd):
        *complete, rest = (rest + data).split(b"\n")
        for each in complete:
            yield each.decode(errors="replace")
        if len(rest) > _LONGEST:
            raise MessageError("a line on stdin is longer than 1 MB")
    if rest:
        yield rest.decode(errors="replace")


async def _read(fd: int) -> bytes:
    if not select.select([fd], [], [], 0)[0]:
        loop = asyncio.get_running_loop()
        arrived = asyncio.Event()
        loop.add_reader(fd, arrived.set)
        try:
            await arrived.wait()
        finally:
            loop.remove_reader(fd)
    return os.read(fd, _CHUNK)


# What tools tell people: on stderr, in short lines; nobody there to read them is no error.


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
