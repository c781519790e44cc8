"""The topic commands as processes of their own, over TCP: what virtual time can't show."""

from __future__ import annotations

import json
import signal
from typing import TYPE_CHECKING

import pytest

from tests.tools.rig import PUBLISH, listening, process

if TYPE_CHECKING:
    import subprocess
    from collections.abc import Iterator

pytestmark = pytest.mark.processes


@pytest.fixture
def publisher() -> Iterator[subprocess.Popen[str]]:
    with process(*PUBLISH) as child:
        yield child


def line_of(child: subprocess.Popen[str]) -> str:
    assert child.stdout is not None
    return child.stdout.readline()


def test_two_processes(publisher: subprocess.Popen[str]) -> None:
    with process("topic", "echo", "leds", "-n", "3", "--via", listening(publisher)) as echo:
        out, err = echo.communicate()
    assert [json.loads(line) for line in out.splitlines()] == [{"led": 3, "value": 0}] * 3
    assert err == ""
    assert echo.returncode == 0


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_well(publisher: subprocess.Popen[str], number: signal.Signals) -> None:
    with process("topic", "echo", "leds", "--via", listening(publisher)) as echo:
        assert json.loads(line_of(echo)) == {"led": 3, "value": 0}
        echo.send_signal(number)
        _, err = echo.communicate()
    publisher.send_signal(number)
    _, told = publisher.communicate()
    assert (echo.returncode, publisher.returncode) == (0, 0)
    assert "Traceback" not in err + told


@pytest.mark.parametrize("command", ["echo", "hz"])
def test_a_closed_pipe_ends_it_quietly(publisher: subprocess.Popen[str], command: str) -> None:
    with process("topic", command, "leds", "--via", listening(publisher)) as child:
        line_of(child)
        assert child.stdout is not None
        child.stdout.close()
        assert child.stderr is not None
        assert child.stderr.read() == ""
        assert child.wait() == 0


def test_a_closed_pipe_ends_it_also_while_it_waits(publisher: subprocess.Popen[str]) -> None:
    with process("topic", "echo", "nothing", "--via", listening(publisher)) as child:
        assert child.stdout is not None
        child.stdout.close()
        assert child.wait() == 0


def test_a_killed_peer_is_told_and_awaited(publisher: subprocess.Popen[str]) -> None:
    url = listening(publisher)
    port = url.rpartition(":")[2]
    with process("topic", "echo", "leds", "--via", url) as echo:
        line_of(echo)
        publisher.kill()
        assert echo.stderr is not None
        assert "is down" in echo.stderr.readline()
        with process(*PUBLISH[:-1], f"tcp-listen:{port}"):
            while "is up, after" not in echo.stderr.readline():
                pass
            echo.send_signal(signal.SIGINT)
            assert echo.wait() == 0


def test_lines_from_a_pipe_to_a_pipe(publisher: subprocess.Popen[str]) -> None:
    """`pub` accepts what `echo` prints."""
    with process("topic", "echo", "copy", "-n", "3", "--via", "tcp-listen:0") as sink:
        url = listening(sink)
        with (
            process("topic", "echo", "leds", "--meta", "--via", listening(publisher)) as source,
            process("topic", "pub", "copy", "-", "--type", "Led", "-n", "3", "--via", url, stdin=source.stdout) as pub,
        ):
            assert pub.wait() == 0
        out, _ = sink.communicate()
    assert [json.loads(line) for line in out.splitlines()] == [{"led": 3, "value": 0}] * 3


def test_time_out() -> None:
    with process("topic", "echo", "leds", "--timeout", "10ms") as child:
        out, err = child.communicate()
    assert (child.returncode, out) == (3, "")
    assert "no network" in err
    assert "nothing received on leds for 0.01 s" in err


def test_an_address_in_use(publisher: subprocess.Popen[str]) -> None:
    port = listening(publisher).rpartition(":")[2]
    with process("topic", "list", "--via", f"tcp-listen:{port}") as child:
        _, err = child.communicate()
    assert child.returncode == 1
    assert "in use" in err
    assert "Traceback" not in err


def test_a_mistake_while_the_link_comes_up(publisher: subprocess.Popen[str]) -> None:
    with process("topic", "pub", "cmd", "x=1", "--type", "Led", "--via", listening(publisher)) as child:
        _, err = child.communicate()
    assert child.returncode == 2
    assert "Led has no field x: it has led, value" in err
