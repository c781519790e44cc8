"""Lines from stdin, without stopping the event loop: it reads only what is there."""

import asyncio
import os
import select
import sys
from collections.abc import AsyncIterator
from typing import TextIO

from r2p.errors import MessageError
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
