"""Commands as forks of one process that has imported r2p: most of what a command costs is the start of a Python.

A fork has its own terminal, session, directory, environment and arguments, then runs what the script `r2p` runs, or a
Python file, and ends as Python ends. What differs from a new process: the modules of all commands are imported already.

`python -m tests.fork_server FD` is the server. It takes one JSON object in a line for each command, with the file
descriptors of its terminal and of a pipe, into which it writes the number of the process, and at its end the exit code.
"""

import atexit
import contextlib
import gc
import importlib
import json
import os
import runpy
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from r2p.tools.main import COMMANDS, GROUPS, main

_ROOT = Path(__file__).parents[1]
_MORE = ("mcap.reader", "mcap.writer", "r2p.modules.runner", "r2p.recording.bag", "r2p.sim.robots.triskar2", "uvloop")
_LONGEST = 1 << 16


class ForkedCommand:
    """A command that runs on a terminal: the part of `subprocess.Popen` that a terminal needs.

    `arguments` are those of Python: a file, which is the script `r2p` or another one, and the file's.
    """

    def __init__(self, arguments: list[str], terminal: int, directory: Path, environment: Mapping[str, str]) -> None:
        self.returncode: int | None = None
        self._pipe, writer = os.pipe()
        try:
            order = json.dumps({"arguments": arguments, "directory": str(directory), "environment": {**environment}})
            socket.send_fds(_server(), [order.encode() + b"\n"], [terminal, writer])
        finally:
            os.close(writer)
        self.pid = int(self._read_number())

    def poll(self) -> int | None:
        """Return the exit code, or the negative number of the signal that ended it; None while it runs."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.wait(0.0)
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Wait for its end. Raises TimeoutExpired."""
        if self.returncode is None:
            if not select.select([self._pipe], [], [], timeout)[0]:
                raise subprocess.TimeoutExpired(f"process {self.pid}", timeout or 0.0)
            self.returncode = int(self._read_number())
            os.close(self._pipe)
        return self.returncode

    def kill(self) -> None:
        os.kill(self.pid, signal.SIGKILL)

    def _read_number(self) -> str:
        text = b""
        while not text.endswith(b"\n"):
            more = os.read(self._pipe, 1)
            if not more:
                raise EOFError("the server of forks has died: its error is above")
            text += more
        return text.decode()


@cache
def _server() -> socket.socket:
    """Start the server of this process, which ends with it."""
    ours, theirs = socket.socketpair()
    command = [sys.executable, "-m", "tests.fork_server", str(theirs.fileno())]
    environment = os.environ | {"LANG": "C.UTF-8"}
    started = subprocess.Popen(
        command,
        cwd=_ROOT,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        pass_fds=[theirs.fileno()],
    )
    theirs.close()

    def end() -> None:
        ours.close()
        started.wait()

    atexit.register(end)
    return ours


# In the server


def serve(control: socket.socket) -> dict[str, Any] | None:
    """Fork for each order until the socket is closed. Returns the order in the fork, and None in the server."""
    running: dict[int, int] = {}  # processes, and the pipe of each
    woken, wake = os.pipe()
    os.set_blocking(wake, False)
    signal.set_wakeup_fd(wake)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    while True:
        ready = select.select([control.fileno(), woken], [], [])[0]
        if woken in ready:
            os.read(woken, 4096)
            _report(running)
        if control.fileno() in ready:
            data, (terminal, pipe) = _receive(control)
            if not data:
                return None
            if not (pid := os.fork()):
                signal.set_wakeup_fd(-1)
                for fd in (woken, wake, pipe, *running.values()):
                    os.close(fd)
                control.close()
                return {**json.loads(data), "terminal": terminal}
            running[pid] = pipe
            os.write(pipe, f"{pid}\n".encode())
            os.close(terminal)


def _receive(control: socket.socket) -> tuple[bytes, list[int]]:
    data, fds, _, _ = socket.recv_fds(control, _LONGEST, 2)
    while data and not data.endswith(b"\n"):
        data += control.recv(_LONGEST)
    return data, fds or [-1, -1]


def _report(running: dict[int, int]) -> None:
    """Write the exit codes of the processes that have ended."""
    with contextlib.suppress(ChildProcessError):
        while (ended := os.waitpid(-1, os.WNOHANG))[0]:
            pipe = running.pop(ended[0])
            with contextlib.suppress(BrokenPipeError):  # nobody waits for it
                os.write(pipe, f"{os.waitstatus_to_exitcode(ended[1])}\n".encode())
            os.close(pipe)


def become(order: dict[str, Any]) -> None:
    """Take what a new process would have from its parent."""
    os.setsid()
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        os.dup2(order["terminal"], number)
        errors = "backslashreplace" if name == "stderr" else "strict"
        stream = open(number, "w" if number else "r", errors=errors, closefd=False)  # noqa: SIM115 - stays open
        setattr(sys, name, stream)
    os.close(order["terminal"])
    os.chdir(order["directory"])
    os.environ.clear()
    os.environ.update(order["environment"])
    sys.argv = list(order["arguments"])
    sys.orig_argv = [sys.executable, *order["arguments"]]
    sys.path[0] = str(Path(sys.argv[0]).absolute().parent)
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])


def _import_all() -> None:
    for name in (*(module for module, _ in (GROUPS | COMMANDS).values()), *_MORE):
        importlib.import_module(name)
    gc.collect()
    gc.freeze()


if __name__ == "__main__":
    _import_all()
    signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])  # Ctrl-C ends the tests, and their end ends this
    if (_order := serve(socket.socket(fileno=int(sys.argv[1])))) is not None:
        become(_order)
        if Path(sys.argv[0]).name == "r2p":
            main()
        else:
            runpy.run_path(sys.argv[0], run_name="__main__")
