"""`r2p demo`: in a pipe, at a terminal, and what it counts."""

from __future__ import annotations

import asyncio
import os
import re
import signal
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest

from r2p.msg import Led, StampedIMURaw9, StampedVelocity3
from r2p.tools.demo import Robot, TopicCounter, _value
from tests.tools.rig import process

if TYPE_CHECKING:
    from r2p.messages import Message

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="no pseudo terminals")

TOPICS = {"imu_raw", "led_cmd", "leds", "encoder", "velocity_cmd", "velocity"}
SECOND = 1_000_000_000


def test_a_tally_counts() -> None:
    counter = TopicCounter("leds", "tcp in")
    assert (counter.rate(0), counter.median, counter.slowest) == (0.0, None, None)
    for number in range(40):
        counter.add(number * SECOND // 10, Led(led=number), latency=number * 1_000_000)
    assert counter.received == 40
    assert counter.last == Led(led=39)
    assert counter.rate(39 * SECOND // 10) == pytest.approx(10.0)
    assert counter.rate(9 * SECOND) == 0.0
    assert counter.median == 19.5
    assert counter.slowest == pytest.approx(38.6, abs=0.1)


@pytest.mark.parametrize(
    ("message", "text"),
    [
        (None, "nothing yet"),
        (Led(led=3), "led=3 value=0"),
        (StampedVelocity3(x=0.5, w=-0.25), "x=0.5 y=0 w=-0.25"),
        (StampedIMURaw9(acc_x=-12, acc_z=999), "acc_x=-12 acc_z=999"),
    ],
)
def test_values_fit_their_column(message: Message | None, text: str) -> None:
    assert _value(message) == text


@pytest.mark.anyio
async def test_everything_flows_and_nothing_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    enough = asyncio.Event()
    take = TopicCounter.add

    def count(counter: TopicCounter, now: int, message: Message, latency: int | None = None) -> None:
        take(counter, now, message, latency)
        if all(each.received >= 3 for each in robot.counters.values()):
            enough.set()

    monkeypatch.setattr(TopicCounter, "add", count)
    async with Robot() as robot:
        await enough.wait()
        await robot.finish()
        counters = {counter.topic: counter for counter in robot.updated_counters()}
        assert set(counters) == TOPICS
        assert [counter.sent - counter.received for counter in counters.values()] == [0] * 6
        assert all(
            counter.median is not None and counter.median > 0
            for counter in counters.values()
            if counter.topic != "encoder"
        )
        assert counters["leds"].received == counters["led_cmd"].received


def rows(text: str) -> dict[str, list[str]]:
    """The last row of each topic."""
    found = [line.split() for line in text.splitlines() if line.split(" ")[0] in TOPICS]
    return {row[0]: row for row in found}


@pytest.mark.processes
def test_in_a_pipe_it_prints_plain_text() -> None:
    with process("demo", "line", "--duration", "1") as child:
        out, err = child.communicate()
    assert (child.returncode, err) == (0, "")
    assert out.isprintable() or set(re.findall(r"[^ -~]", out)) == {"\n"}
    assert rows(out).keys() == TOPICS
    assert max(len(line) for line in out.splitlines()) <= 80
    assert re.search(r"^tcp:127\.0\.0\.1:\d+: \d+ messages sent, \d+ received, 0 lost$", out, re.MULTILINE)
    assert re.search(r"^serial:/dev/\S+: \d+ messages sent, \d+ received, 0 lost$", out, re.MULTILINE)
    assert "Try next" in out


@pytest.mark.processes
def test_at_a_terminal_it_draws_a_table_that_lives() -> None:
    master, slave = os.openpty()
    command = [sys.executable, "-c", "from r2p.tools.main import main; main()", "demo", "line", "--duration", "1"]
    environment = os.environ | {"TERM": "xterm", "COLUMNS": "80", "LINES": "24"}
    with subprocess.Popen(command, stdin=slave, stdout=slave, stderr=slave, env=environment) as child:
        os.close(slave)
        text = b""
        while chunk := _read(master):
            text += chunk
    os.close(master)
    assert child.returncode == 0
    assert text.count(b"LAST VALUE") >= 3
    assert text.count(b"\x1b[?25l") == text.count(b"\x1b[?25h") == 1  # the cursor comes back
    assert b"Try next" in text


def _read(terminal: int) -> bytes:
    try:
        return os.read(terminal, 4096)
    except OSError:  # the other side is closed
        return b""


@pytest.mark.processes
def test_a_signal_ends_it_well() -> None:
    with process("demo", "line", "--duration", "60") as child:
        assert child.stdout is not None
        child.stdout.readline()
        child.send_signal(signal.SIGINT)
        _, err = child.communicate()
    assert (child.returncode, err) == (130, "")


@pytest.mark.processes
def test_a_closed_pipe_ends_it_quietly() -> None:
    with process("demo", "line", "--duration", "60") as child:
        assert child.stdout is not None
        child.stdout.readline()
        child.stdout.close()
        child.wait()
        assert child.stderr is not None
        assert (child.returncode, child.stderr.read()) == (0, "")


@pytest.mark.processes
def test_the_robot_drives_and_is_summed_up() -> None:
    with process("demo", "--duration", "3") as child:
        out, err = child.communicate()
    assert (child.returncode, err) == (0, "")
    assert re.search(r"r2p topic echo odometry --via tcp:127\.0\.0\.1:\d+", out)
    assert re.search(r"^3\.\d s, [\d.]+ m driven", out, re.MULTILINE)
    assert max(len(line) for line in out.splitlines()) <= 80
    assert "Try next" in out
