"""The share of a core that `r2p top` takes, the whole process, with 1 000 topics at a terminal of 80 by 24."""

import fcntl
import os
import pty
import struct
import sys
import termios
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from benchmarks import zenoh
from benchmarks.monitoring import MODULES, TOPICS, run_robot
from benchmarks.processes import process
from benchmarks.table import Row

STARTING, SETTLING, SECONDS = 60.0, 25.0, 20.0
GOAL = 0.05
_TICKS = os.sysconf("SC_CLK_TCK")  # a second


class _Terminal:
    """A terminal that shows `r2p top`, and keeps what was written to it."""

    def __init__(self, pid: int, fd: int) -> None:
        self.pid = pid
        self.written = bytearray()
        fcntl.ioctl(fd, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
        self._fd = fd
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        try:
            while data := os.read(self._fd, 65536):
                self.written += data
        except OSError:  # the program has ended
            return

    def cpu(self) -> float:
        """Return the seconds of processor time of the program so far."""
        with open(f"/proc/{self.pid}/stat") as file:  # noqa: PTH123 - a file of the kernel
            fields = file.read().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / _TICKS

    def wait_for(self, text: bytes) -> bool:
        end = time.perf_counter() + STARTING
        while text not in self.written and time.perf_counter() < end:
            time.sleep(0.1)
        return text in self.written

    def close(self) -> None:
        os.write(self._fd, b"q")
        os.waitpid(self.pid, 0)
        os.close(self._fd)


@contextmanager
def _top(port: int) -> Iterator[_Terminal]:
    pid, fd = pty.fork()
    if not pid:
        os.environ |= {"TERM": "xterm-256color"}
        os.execv(sys.executable, [sys.executable, "-m", "r2p", "top", "--sort", "rate", "--via", zenoh.connect(port)])
    terminal = _Terminal(pid, fd)
    try:
        yield terminal
    finally:
        terminal.close()


def rows() -> Iterator[Row]:
    with process(run_robot) as pipe, _top(pipe.recv()) as terminal:
        shown = terminal.wait_for(b"1000 topics") or terminal.wait_for(b"1001 topics")
        time.sleep(SETTLING)
        began, used, written = time.perf_counter(), terminal.cpu(), len(terminal.written)
        time.sleep(SECONDS)
        share = (terminal.cpu() - used) / (time.perf_counter() - began)
        size = (len(terminal.written) - written) / SECONDS
    yield Row(
        f"r2p top with {MODULES * TOPICS} topics, once a second",
        f"{share:.1%} of a core",
        f"{size:.0f} bytes/s to the terminal",
        f"{GOAL:.0%} of a core",
        shown and share <= GOAL,
    )
