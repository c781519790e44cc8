"""A robot, `r2p gateway` and a PC as three processes, over TCP: typed messages both ways."""

from __future__ import annotations

import json
import signal
from typing import TYPE_CHECKING

import pytest

from tests.tools.rig import listening, process

if TYPE_CHECKING:
    import subprocess
    from collections.abc import Iterator

pytestmark = pytest.mark.processes

PUBLISH = ("topic", "pub", "leds", "led=3", "--type", "Led", "--rate", "50", "--via", "tcp-listen:0")


@pytest.fixture
def robot() -> Iterator[subprocess.Popen[str]]:
    with process(*PUBLISH) as child:
        yield child


@pytest.fixture
def gateway(robot: subprocess.Popen[str]) -> Iterator[subprocess.Popen[str]]:
    with process("gateway", "--via", listening(robot), "--via", "tcp-listen:0") as child:
        yield child


def test_from_the_robot_to_the_pc(gateway: subprocess.Popen[str]) -> None:
    with process("topic", "echo", "leds", "-n", "3", "--via", listening(gateway)) as echo:
        out, err = echo.communicate()
    assert [json.loads(line) for line in out.splitlines()] == [{"led": 3, "value": 0}] * 3
    assert (echo.returncode, err) == (0, "")


def test_rate(gateway: subprocess.Popen[str]) -> None:
    with process("topic", "hz", "leds", "--once", "--via", listening(gateway)) as hz:
        out, _ = hz.communicate()
    assert json.loads(out)["rate"] == pytest.approx(50, rel=0.5)


def test_from_the_pc_to_the_robot() -> None:
    with (
        process("topic", "echo", "cmd", "-n", "3", "--type", "Velocity3", "--via", "tcp-listen:0") as robot,
        process("gateway", "--via", listening(robot), "--via", "tcp-listen:0") as gateway,
    ):
        pub = ("topic", "pub", "cmd", "x=1.5", "--type", "Velocity3", "-r", "50", "-n", "3")
        with process(*pub, "--via", listening(gateway)) as pc:
            assert pc.wait() == 0
        out, _ = robot.communicate()
    assert [json.loads(line) for line in out.splitlines()] == [{"x": 1.5, "y": 0.0, "w": 0.0}] * 3


def test_what_is_known_behind_it(robot: subprocess.Popen[str]) -> None:
    with process("gateway", "--name", "BRIDGE", "--via", listening(robot), "--via", "tcp-listen:0") as gateway:
        url = listening(gateway)
        with process("topic", "list", "--via", url, "--wait", "4") as topics:
            out, _ = topics.communicate()
    assert "leds" in {json.loads(line)["topic"] for line in out.splitlines()}


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_well(gateway: subprocess.Popen[str], number: signal.Signals) -> None:
    listening(gateway)
    gateway.send_signal(number)
    _, err = gateway.communicate()
    assert gateway.returncode == 0
    assert "Traceback" not in err


def test_mistakes() -> None:
    for arguments, code, words in (
        (("--via", "tcp:127.0.0.1:1"), 2, "a gateway joins two links"),
        (("--via", "memory:a", "--via", "memory:b", "--allow", "@x"), 2, "write TOPIC, TOPIC@FROM or TOPIC@FROM>TO"),
        (("--via", "memory:a", "--via", "memory:b", "--rate-limit", "leds"), 2, "write it as TOPIC=HZ"),
        (("--via", "memory:a", "--via", "nonsense:b"), 1, "unknown transport"),
    ):
        with process("gateway", *arguments) as child:
            _, err = child.communicate()
        assert child.returncode == code
        assert words in " ".join(err.replace("│", "").split())
