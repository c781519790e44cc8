"""Two processes, and what is really between them: a TCP connection; a pair of pseudo terminals made by socat."""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from tests.transports.exchange import EVERY

pytestmark = pytest.mark.processes

CHECKOUT = Path(__file__).parents[2]
GUARD = 30.0


@contextmanager
def program(*arguments: str, errors: int | None = None) -> Iterator["subprocess.Popen[str]"]:
    """A process that ends with its input, or at the latest with this block."""
    process = subprocess.Popen(
        arguments, cwd=CHECKOUT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors, text=True
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def exchange(name: str, peer: str, url: str) -> tuple[str, ...]:
    return (sys.executable, "-m", "tests.transports.exchange", name, peer, url)


def line_of(process: "subprocess.Popen[str]") -> str:
    assert process.stdout
    return process.stdout.readline().strip()


def finish(*processes: "subprocess.Popen[str]") -> None:
    """Both have heard everything, and end in order."""
    assert [line_of(process) for process in processes] == [f"exchanged {len(EVERY)}"] * len(processes)
    for process in processes:
        process.communicate(timeout=GUARD)
    assert [process.returncode for process in processes] == [0] * len(processes)


def test_every_type_over_tcp() -> None:
    with ExitStack() as stack:
        server = stack.enter_context(program(*exchange("A", "B", "tcp-listen:127.0.0.1:0")))
        address = line_of(server)
        client = stack.enter_context(program(*exchange("B", "A", f"tcp:{address}")))
        finish(server, client)


def test_every_type_over_a_serial_cable(tmp_path: Path) -> None:
    if shutil.which("socat") is None:
        missing = "socat is missing: apt install socat"
        pytest.fail(missing) if os.environ.get("CI") else pytest.skip(missing)
    ends = [tmp_path / "a", tmp_path / "b"]
    with ExitStack() as stack:
        cable = ("socat", "-d", "-d", *(f"pty,raw,echo=0,link={end}" for end in ends))
        socat = stack.enter_context(program(*cable, errors=subprocess.PIPE))
        assert socat.stderr
        while "starting data transfer loop" not in socat.stderr.readline():
            assert socat.poll() is None
        finish(
            stack.enter_context(program(*exchange("A", "B", f"serial:{ends[0]}"))),
            stack.enter_context(program(*exchange("B", "A", f"serial:{ends[1]}"))),
        )
