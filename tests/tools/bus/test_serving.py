"""`r2p bus serve` and `r2p sim --bus`: programs of other processes on one bus."""

from __future__ import annotations

import contextlib
import json
import signal
import subprocess
import sys
import threading
from typing import TYPE_CHECKING

import pytest
from typer.testing import CliRunner

from r2p.codecs.can_bits import Frame, OtherFrame
from r2p.errors import TransportError
from r2p.sim.buses import rendezvous
from r2p.sim.buses.attachment import AttachmentOptions
from r2p.sim.buses.served import ServedAttachment, connect
from r2p.tools.bus import app
from r2p.tools.bus.serving import hints
from r2p.tools.main import app as r2p
from r2p.transports.url import open_transport
from tests.tools.rig import process

if TYPE_CHECKING:
    from pathlib import Path

PATIENCE = 30.0  # seconds
FORKING = """
import os
from r2p.codecs.can_bits import Frame, OtherFrame
from r2p.sim.buses import attach
a, b = attach("lab"), attach("lab")
if not (child := os.fork()):
    try:
        a.send(Frame(1, b""))
    except Exception as error:
        print(error, flush=True)
    a.close()
    os._exit(0)
os.waitpid(child, 0)
a.send(Frame(1, b""))
print(b.receive(30.0).frame)
a.close()
b.close()
"""


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))


def wait_until_served(child: subprocess.Popen[str], line: str) -> None:
    stream = child.stderr if line == "runs" else child.stdout
    assert stream is not None
    for text in stream:
        if line in text:
            return
    raise AssertionError("the process serves no bus")


def attached() -> ServedAttachment:
    attachment = connect("lab", AttachmentOptions())
    assert attachment is not None
    return attachment


def read_to_the_end(attachment: ServedAttachment) -> None:
    while attachment.receive(PATIENCE) is not None:
        pass


@pytest.mark.processes
def test_programs_meet_on_a_bus_until_it_is_killed() -> None:
    with process("bus", "serve", "lab") as child:
        wait_until_served(child, "runs")
        a, b = attached(), attached()
        with process("bus", "serve", "lab") as second:
            _, err = second.communicate()
        assert second.returncode == 1
        assert f"the bus lab is served by process {child.pid}" in err
        with process("bus", "dump", "-n", "1", "--via", "rtcan:r2psim:lab") as dump:
            assert dump.stderr is not None
            assert "is up" in dump.stderr.readline()
            while dump.poll() is None:  # it is up a moment before it looks
                a.send(Frame(0x0AB00180, b"hello"))
                b.receive(0.05)
            out, _ = dump.communicate()
        assert json.loads(out)["data"] == b"hello".hex()
        assert a.lost == b.lost == 0
        child.kill()
        child.wait()
        with pytest.raises(TransportError, match=rf"has ended \(process {child.pid}\): start it again"):
            read_to_the_end(b)
        a.close()
        b.close()
        assert connect("lab", AttachmentOptions()) is None
    with process("bus", "serve", "lab", "--bitrate", "500000") as child:
        wait_until_served(child, "runs")
        [served] = rendezvous.served_buses()
        assert (served.pid, served.bitrate) == (child.pid, 500_000)
        child.send_signal(signal.SIGINT)
        _, err = child.communicate()
        assert child.returncode == 0
        assert "Traceback" not in err
    assert rendezvous.find("lab") is None


@pytest.mark.processes
def test_a_program_that_forks_has_a_bus_in_the_parent_only() -> None:
    with process("bus", "serve", "lab") as child:
        wait_until_served(child, "runs")
        done = subprocess.run([sys.executable, "-c", FORKING], capture_output=True, text=True, check=True)
    child_said, parent_received = done.stdout.splitlines()
    assert "this process was forked from the one that opened the bus: open buses after the fork" in child_said
    assert parent_received == "Frame(id=1, data=b'')"


@pytest.mark.processes
def test_python_can_s_own_logger_joins() -> None:
    command = [sys.executable, "-u", "-m", "can.logger", "-i", "r2psim", "-c", "lab"]
    with process("bus", "serve", "lab") as child:
        wait_until_served(child, "runs")
        with (
            contextlib.closing(attached()) as a,
            subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as logger,
        ):
            limit = threading.Timer(PATIENCE, logger.kill)
            limit.start()
            a.send(OtherFrame(0x123, b"hello"))  # sent again and again, until it is acknowledged
            assert logger.stdout is not None
            assert any("68 65 6c 6c 6f" in line for line in logger.stdout)
            limit.cancel()
            logger.kill()


@pytest.mark.processes
def test_an_emulated_robot_lets_others_join_its_bus() -> None:
    with process("sim", "triskar2", "--bus", "lab", "--via", "memory:nowhere") as robot:
        wait_until_served(robot, "rtcan:r2psim:lab")
        with process("bus", "schedule", "-n", "5", "--via", "rtcan:r2psim:lab", "--format", "json") as schedule:
            out, _ = schedule.communicate()
        assert schedule.returncode == 0
        assert json.loads(out.splitlines()[0])["owner"] == "sync"


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["a/b"], "a bus can't be served as 'a/b'"),
        ([".."], "a bus can't be served as '..'"),
        (["lab", "--bitrate", "300000"], "at 300000 bit/s a bit does not take whole nanoseconds: take"),
        (["lab", "--noise", "2"], "0.0<=x<=1.0"),
    ],
)
def test_mistakes(arguments: list[str], text: str) -> None:
    result = CliRunner().invoke(app, ["serve", *arguments])
    assert result.exit_code == 2
    assert text in " ".join(result.stderr.replace("│", "").split())


@pytest.mark.parametrize(
    ("arguments", "text"), [(["--fast", "--bus", "lab"], "leave out --bus or --fast"), (["--bus", "a/b"], "can't be")]
)
def test_mistakes_of_a_robot_s_bus(arguments: list[str], text: str) -> None:
    result = CliRunner().invoke(r2p, ["sim", *arguments])
    assert result.exit_code == 2
    assert text in result.stderr


def test_commands_of_a_bus_name_those_that_are_served() -> None:
    with rendezvous.publish("lab", 1, bitrate=1_000_000):
        result = CliRunner().invoke(app, ["dump"])
    assert result.exit_code == 2
    assert "as in --via rtcan:can0; programs serve rtcan:r2psim:lab" in " ".join(result.stderr.split())


@pytest.mark.parametrize("bitrate", [1_000_000, 500_000, 125_000, 20_000, 10_000])
def test_the_urls_that_it_prints_are_valid(bitrate: int) -> None:
    for hint in hints("lab", bitrate)[:2]:
        open_transport(hint.partition("--via ")[2])
