"""Commands in the pages: each page is run from its first command to its last, and prints what it shows.

What a page can't have is replaced in all that is run and compared: its fixed ports by free ones, the robot's address
and the serial port by those of an emulated module.
"""

import contextlib
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType

import pytest

from tests.docs import ros1
from tests.docs.blocks import ROOT, Block, of_page, pages, pattern
from tests.docs.shell import Command, Process, commands
from tests.ports import free_port

PORTS = ("2323", "2324", "2325", "2326", "8080", "8765")
ROBOT = "192.168.0.10:23"
DEVICE = "/dev/ttyUSB0"

_RUN = {"console", "toml", "csv", "python", "hex"}


@contextlib.contextmanager
def emulated_board() -> Iterator[dict[str, str]]:
    """What stands for the robot's address and its serial port."""
    command = [sys.executable, "-m", "tests.docs.board"]
    with subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as board:
        assert board.stdin is not None
        assert board.stdout is not None
        addresses = json.loads(board.stdout.readline())
        try:
            yield {ROBOT: addresses["tcp"], DEVICE: addresses["pty"]}
        finally:
            board.stdin.close()


class Session:
    """One page: its directory, its environment, and the commands that still run."""

    def __init__(
        self, directory: Path, replacements: dict[str, str], environment: Mapping[str, str] = MappingProxyType({})
    ) -> None:
        binaries = Path(sys.executable).parent
        self._directory = directory
        self._replacements = replacements
        self._environment = {
            **{name: value for name, value in os.environ.items() if name == "PYTHONPATH"},  # of a git worktree
            **environment,
            "PATH": f"{environment.get('PATH', '')}{binaries}:{os.environ['PATH']}",
            "HOME": str(directory),
            "TERM": "dumb",
            "COLUMNS": "200",
            "LANG": "C.UTF-8",
        }
        self._running: dict[str, Process] = {}

    def play(self, block: Block) -> None:
        """Write the file that a block is, or run its commands."""
        text = self._replaced(block.text)
        if block.language == "console":
            self._run(block, text)
        elif block.title:
            (self._directory / block.title).write_text(text)

    def end(self) -> None:
        """Ctrl-C in every terminal, the last one first."""
        for process in reversed(self._running.values()):
            process.interrupt()
            process.finish(0)

    def close(self) -> None:
        for process in self._running.values():
            process.close()

    def _run(self, block: Block, text: str) -> None:
        more, todo = commands(text)
        if more.strip():
            self._running[block.title].expect(pattern(more))
        for command in todo:
            goes_on = "keeps running" in block.notes and command is todo[-1]
            name, _, value = command.text.removeprefix("export ").partition("=")
            if command.text.startswith("export "):
                self._environment[name] = value.strip("'\"")
            elif command.text.startswith("cd "):
                continue
            else:
                self._execute(block, command, goes_on=goes_on)

    def _execute(self, block: Block, command: Command, *, goes_on: bool) -> None:
        process = Process(command.text, self._directory, self._environment)
        with contextlib.ExitStack() as stack:
            stack.callback(process.close)
            if goes_on:
                process.expect(pattern(command.shown))
                self._running[block.title] = process
                stack.pop_all()
            elif command.interrupted:
                process.expect(pattern(command.shown))
                process.interrupt()
                process.finish(0)
            else:
                process.finish(int(block.notes.get("exits", 0)), pattern(command.shown))

    def _replaced(self, text: str) -> str:
        """All at once: what one replacement has put in is not searched for the next one."""
        shown = "|".join(map(re.escape, self._replacements))
        return re.sub(rf"(?<![0-9])(?:{shown})(?![0-9])", lambda found: self._replacements[found[0]], text)


def _blocks(page: Path) -> list[Block]:
    return [block for block in of_page(page) if block.language in _RUN and "not run" not in block.notes]


_PAGES = [page for page in pages() if any(block.language == "console" for block in _blocks(page))]


@pytest.mark.processes
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo terminals")
@pytest.mark.parametrize("page", _PAGES, ids=lambda page: page.stem)
def test_the_commands_print_what_the_page_shows(page: Path, tmp_path: Path) -> None:
    todo = _blocks(page)
    replacements = {port: str(free_port()) for port in PORTS}
    with contextlib.ExitStack() as stack:
        if any(known in block.text for block in todo for known in (ROBOT, DEVICE)):
            replacements |= stack.enter_context(emulated_board())
        environment = stack.enter_context(ros1.network(tmp_path / "ros1")) if ros1.is_needed(todo) else {}
        for example in (ROOT / "examples").glob("*.py"):
            (tmp_path / example.name).write_text(example.read_text())
        session = Session(tmp_path, replacements, environment)
        stack.callback(session.close)
        for block in todo:
            session.play(block)
        session.end()


def test_a_port_that_was_put_in_is_not_replaced_again(tmp_path: Path) -> None:
    """Nor one that is a part of a longer number."""
    block = Block(tmp_path, 1, "toml", "ports", {}, "2323 2324 23230 tcp:127.0.0.1:2324")
    Session(tmp_path, {"2323": "23243", "2324": "29418"}).play(block)
    assert (tmp_path / "ports").read_text() == "23243 29418 23230 tcp:127.0.0.1:29418"
