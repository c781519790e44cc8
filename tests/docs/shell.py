"""A terminal for the commands of a page: each runs on a pseudo terminal, and its output is awaited, never slept for.

A plain `r2p ...` or `python FILE` is forked from a process that has imported r2p. Whatever needs a shell starts the
script `r2p` itself, or Python.
"""

import os
import re
import select
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import msgspec

from tests.fork_server import ForkedCommand

PATIENCE = 120.0
"""Seconds after which a command that has not printed what it should has failed, on however busy a machine."""

_ESCAPES = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]|\r")
_SHELL = re.compile(r"[|;&<>$]")
_FORKED = re.compile(r"(r2p|python \w+\.py)( [^|;&<>$`*~#\\]+)?")


class Command(msgspec.Struct, frozen=True):
    """One command of a block, what it prints, and whether the block ends it by Ctrl-C."""

    text: str
    shown: str
    interrupted: bool


def commands(block: str) -> tuple[str, list[Command]]:
    """What a block shows before its first command (of one that still runs), and its commands."""
    first, *rest = re.split(r"^\$ ", block, flags=re.MULTILINE)
    return first, [_command(each) for each in rest]


def _command(text: str) -> Command:
    line, _, shown = text.partition("\n")
    while line.endswith("\\"):
        more, _, shown = shown.partition("\n")
        line = line[:-1] + more.strip()
    shown, ctrl_c, _ = shown.partition("^C\n")
    return Command(line, shown, bool(ctrl_c))


def _start(
    command: str, terminal: int, directory: Path, environment: dict[str, str]
) -> subprocess.Popen[bytes] | ForkedCommand:
    if _FORKED.fullmatch(command):
        program, *arguments = shlex.split(command)
        script = [str(Path(sys.executable).with_name(program))] if program == "r2p" else []
        return ForkedCommand([*script, *arguments], terminal, directory, environment)
    direct = command if _SHELL.search(command) else f"exec {command}"
    return subprocess.Popen(
        ["/bin/sh", "-c", direct],
        cwd=directory,
        env=environment,
        stdin=terminal,
        stdout=terminal,
        stderr=terminal,
        start_new_session=True,
    )


class Process:
    """A command on a terminal of its own."""

    def __init__(self, command: str, directory: Path, environment: dict[str, str]) -> None:
        self.command = command
        self.printed = ""
        self._terminal, slave = os.openpty()
        self._process = _start(command, slave, directory, environment)
        os.close(slave)

    def expect(self, shown: re.Pattern[str]) -> None:
        """Wait until it has printed this; what came so far does not count again."""
        deadline = time.monotonic() + PATIENCE
        while not (found := shown.match(self.printed)):
            if not self._read(deadline):
                raise AssertionError(f"{self} is shown to print\n{shown.pattern}")
        self.printed = self.printed[found.end() :]

    def type(self, keys: str) -> None:
        """Press keys."""
        os.write(self._terminal, keys.encode())

    def interrupt(self) -> None:
        """Ctrl-C."""
        os.kill(self._process.pid, signal.SIGINT)

    def finish(self, code: int, shown: re.Pattern[str] | None = None) -> None:
        """Wait for its end, and check its exit code and, if it is given, all that it has printed."""
        deadline = time.monotonic() + PATIENCE
        while self._read(deadline):
            pass
        try:
            ended = self._process.wait(max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            raise AssertionError(f"{self} does not end") from None
        assert ended == code, f"{self} ends with exit code {ended}, not {code}"
        assert shown is None or shown.fullmatch(self.printed), f"{self} is shown to print\n{shown.pattern}"

    def __str__(self) -> str:
        return f"$ {self.command}\n{self.printed}"

    def close(self) -> None:
        """End it, whatever it does."""
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait()
        os.close(self._terminal)

    def _read(self, deadline: float) -> bool:
        """Read more of what it prints; False at the end, or when patience is."""
        if not select.select([self._terminal], [], [], max(0.0, deadline - time.monotonic()))[0]:
            return False
        try:
            data = os.read(self._terminal, 65536)
        except OSError:  # EIO: nobody has the terminal open any more
            return False
        self.printed += _ESCAPES.sub("", data.decode(errors="replace"))
        return bool(data)
