"""Keys at the terminal of a command."""

from __future__ import annotations

import os
import subprocess
import sys
import termios

import pytest

from r2p.tools.keyboard import on_key

COMMAND = """
import asyncio, os, sys

os.dup2(os.open(sys.argv[1], os.O_RDWR), 0)  # the terminal of this session, as it has none
from r2p.tools.keyboard import on_key


async def main():
    over = asyncio.Event()

    def handle(key):
        print(key, flush=True)
        if key == "q":
            over.set()

    with on_key(handle) as present:
        print(present, flush=True)
        await over.wait()


asyncio.run(main())
"""


def echoes(terminal: int) -> bool:
    return bool(termios.tcgetattr(terminal)[3] & termios.ECHO)


@pytest.mark.processes
def test_keys_arrive_without_enter_and_the_terminal_is_as_before() -> None:
    user, terminal = os.openpty()
    arguments = [sys.executable, "-c", COMMAND, os.ttyname(terminal)]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True, start_new_session=True) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == "True\n"
        assert not echoes(terminal)
        os.write(user, b"s")
        assert child.stdout.readline() == "s\n"
        os.write(user, b" q")
        assert child.stdout.read() == " \nq\n"
    assert echoes(terminal)
    os.close(user)
    os.close(terminal)


@pytest.mark.virtual_time
async def test_without_a_terminal_there_are_no_keys(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", None)
    with on_key(lambda key: pytest.fail(f"{key} was pressed")) as present:
        assert not present
