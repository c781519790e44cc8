"""Commands of a group as processes: how they start, how their output is shown, and how they get signals.

Each command has a session of its own, so Ctrl-C at the terminal reaches only the launcher, which stops the commands in
order. A thread for each pipe shows its lines: while the launcher's own output is not read, the commands wait, as they
would in a shell, and the launcher still supervises them.
"""

import asyncio
import contextlib
import os
import select
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import BinaryIO

from r2p.log_lines import wrapped_at
from r2p.tools.config import CONFIG_VARIABLE, VIA_VARIABLE
from r2p.tools.launch.entries import Entry
from r2p.tools.launch.group import SIGNALLED, RunningCommand
from r2p.tools.main import LAUNCHER_VARIABLE

_STDOUT, _STDERR = 1, 2
_LONGEST = 1 << 16  # bytes of a line; what is longer is shown in several
_ATOMIC = 4096  # bytes that a writable pipe accepts without blocking (POSIX: at least 512)
_DRAIN = 1.0  # seconds in which the last lines of a command that has ended are shown
_BAR = " | "  # between the name of a command and its line
_COLOURS = (36, 33, 32, 35, 34)  # of names at a terminal; not red, as that means an error


class LinePrinter:
    """Shows the output of all commands, line by line, with the name of the command in front."""

    def __init__(self, names: Iterable[str], on_error: Callable[[], object]) -> None:
        """Call `on_error`, in another thread, once the output can't be written."""
        self.error: OSError | None = None
        """The error of the output, if it can't be written; BrokenPipeError: its reader has ended."""
        self._names = list(names)
        self._width = max(map(len, self._names), default=0)
        self._lock = threading.Lock()
        self._on_error = on_error

    def copy(self, name: str, source: BinaryIO, sink: int) -> None:
        """Show the lines of a command on the file descriptor `sink`, until the command closes its output."""
        prefix = self._prefix(name, coloured=os.isatty(sink))
        with source:
            for line in iter(lambda: source.readline(_LONGEST), b""):
                pieces = self._fitting(line.rstrip(b"\r\n"), sink)
                self._write(sink, b"".join(prefix + each + b"\n" for each in pieces))

    def _fitting(self, line: bytes, sink: int) -> list[bytes]:
        """Break a line between words where it is too long for a terminal, so that each piece gets the prefix."""
        width = _columns(sink) - self._width - len(_BAR)
        if not 0 < width < len(line) or b"\x1b" in line:  # an escape sequence is not as wide as it is long
            return [line]
        text = wrapped_at(line.decode(errors="surrogateescape"), width)
        return text.encode(errors="surrogateescape").split(b"\n")

    def _prefix(self, name: str, *, coloured: bool) -> bytes:
        text = name.ljust(self._width)
        if coloured and not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb":
            text = f"\x1b[{_COLOURS[self._names.index(name) % len(_COLOURS)]}m{text}\x1b[0m"
        return f"{text}{_BAR}".encode()

    def _write(self, sink: int, line: bytes) -> None:
        left = memoryview(line)
        with self._lock:
            while left and self.error is None:  # after an error, read on: a command that can't write would wait
                try:
                    select.select([], [sink], [])
                    left = left[os.write(sink, left[:_ATOMIC]) :]
                except OSError as error:
                    self.error = error
                    self._on_error()


def _columns(sink: int) -> int:
    """Return the columns of a terminal; 0 if it is not a terminal."""
    try:
        return os.get_terminal_size(sink).columns
    except OSError:
        return 0


def make_environment(path: Path, via: list[str] | None) -> dict[str, str]:
    """Return the environment of the commands of a file; `via` replaces what R2P_VIA and the file say."""
    ours = {CONFIG_VARIABLE: str(path), LAUNCHER_VARIABLE: str(os.getpid()), "PYTHONUNBUFFERED": "1"}
    return os.environ | ours | ({VIA_VARIABLE: " ".join(via)} if via else {})


def command_line(*arguments: str) -> list[str]:
    """Return how to call `r2p`. -P: files of the robot's directory never stand in for modules of Python itself."""
    return [sys.executable, "-P", "-m", "r2p", *arguments]


def start(entry: Entry, directory: Path, environment: Mapping[str, str], printer: LinePrinter) -> RunningCommand:
    """Start a command in `directory`. Raises OSError."""
    loop = asyncio.get_running_loop()
    child = subprocess.Popen(
        command_line(*entry.arguments),
        cwd=directory,
        env={**environment, **entry.environment},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )
    assert child.stdout is not None
    assert child.stderr is not None
    streams = ((child.stdout, _STDOUT), (child.stderr, _STDERR))
    copiers = [_in_thread(printer.copy, entry.name, source, sink) for source, sink in streams]
    ended: asyncio.Future[int] = loop.create_future()

    def report(code: int) -> None:
        if not ended.done():
            ended.set_result(code)

    def wait() -> None:
        code = child.wait()
        _signal_group(child.pid, signal.SIGKILL)  # what the command has started and left behind
        for copier in copiers:
            copier.join(_DRAIN)
        with contextlib.suppress(RuntimeError):  # the loop is closed
            loop.call_soon_threadsafe(report, code if code >= 0 else SIGNALLED - code)

    _in_thread(wait)
    return RunningCommand(ended, lambda number: _send(child, number))


def _send(child: subprocess.Popen[bytes], number: int) -> None:
    """Send a signal to a command; SIGKILL also to all that it has started."""
    if number == signal.SIGKILL and child.poll() is None:
        _signal_group(child.pid, number)
    else:
        child.send_signal(number)


def _signal_group(leader: int, number: int) -> None:
    with contextlib.suppress(ProcessLookupError, PermissionError):  # PermissionError: what macOS says of zombies
        os.killpg(leader, number)


def _in_thread(target: Callable[..., object], *arguments: object) -> threading.Thread:
    thread = threading.Thread(target=target, args=arguments, daemon=True)
    thread.start()
    return thread
