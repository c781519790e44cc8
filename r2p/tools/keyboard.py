"""Keys pressed at the terminal while a command runs."""

import asyncio
import contextlib
import os
import sys
import termios
import tty
from collections.abc import Callable, Iterator

_KEYS_MAX = 64  # bytes that are read at once


@contextlib.contextmanager
def on_key(handle: Callable[[str], object]) -> Iterator[bool]:
    """Call `handle` with each key pressed in the block, without Enter; yield whether there is a keyboard.

    There is none where stdin is not a terminal, and for a command in the background. Ctrl-C still is a signal.
    """
    fd = _terminal()
    if fd is None:
        yield False
        return
    before = termios.tcgetattr(fd)
    loop = asyncio.get_running_loop()

    def read() -> None:
        try:
            text = os.read(fd, _KEYS_MAX).decode(errors="replace")
        except OSError:
            text = ""
        if not text:  # the terminal was closed
            loop.remove_reader(fd)
        for key in text:
            handle(key)

    tty.setcbreak(fd, termios.TCSANOW)
    loop.add_reader(fd, read)
    try:
        yield True
    finally:
        loop.remove_reader(fd)
        with contextlib.suppress(termios.error):  # the terminal was closed
            termios.tcsetattr(fd, termios.TCSANOW, before)


def _terminal() -> int | None:
    """Return the descriptor of the terminal that this process reads from; None without one."""
    try:
        fd = sys.stdin.fileno()
        return fd if os.isatty(fd) and os.tcgetpgrp(fd) == os.getpgrp() else None
    except (AttributeError, OSError, ValueError):  # stdin is closed, or not a file
        return None
