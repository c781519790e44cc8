"""`r2p launch` with real processes: their output, their signals, and their end with the launcher."""

from __future__ import annotations

import asyncio
import io
import os
import select
import signal
import sys
import termios
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from typer.testing import CliRunner

from r2p.msg import Led
from r2p.tools.config import Settings, UsageError
from r2p.tools.launch import check_network, wait_once, wait_ready
from r2p.tools.launch.entries import Entry
from r2p.tools.launch.processes import LinePrinter
from r2p.tools.main import app
from r2p.tools.session import TimedOut
from tests.tools.rig import PATIENCE, VIA, process, robot

if TYPE_CHECKING:
    import r2p

NODES = """
import asyncio, os, subprocess, sys
import r2p
from r2p.msg import Led

async def motor(node: r2p.Node) -> None:
    leds = node.advertise("leds", Led)
    print("pid", os.getpid(), "half", end="")
    print(" a line", flush=True)
    try:
        await asyncio.Event().wait()
    finally:
        print("motor stopped", flush=True)

async def crash(node: r2p.Node) -> None:
    raise LookupError("no motor")

async def watch(node: r2p.Node) -> None:
    child = subprocess.Popen(["sleep", "60"])
    print("child", child.pid, flush=True)
    try:
        await asyncio.Event().wait()
    finally:
        print("watch stopped", flush=True)
"""

FILE = """
[launch.motor]
command = "run nodes.py:motor --module MOTOR --via tcp-listen:0 -q"

[launch.watch]
command = "run nodes.py:watch --module WATCH"
env = {R2P_VIA = ""}
"""


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.delenv("R2P_CONFIG", raising=False)
    (tmp_path / "nodes.py").write_text(NODES)
    (tmp_path / "robot.toml").write_text(FILE)
    return str(tmp_path / "robot.toml")


@pytest.mark.processes
@pytest.mark.skipif(sys.platform == "win32", reason="needs process groups")
def test_ctrl_c_stops_the_commands_in_reverse_order(file: str) -> None:
    with process("launch", file) as child:
        assert child.stdout is not None
        lines = sorted(child.stdout.readline() for _ in range(2))
        grandchild = os.pidfd_open(int(lines[1].split()[-1])) if sys.platform == "linux" else None
        child.send_signal(signal.SIGINT)
        out, err = child.communicate()
    assert child.returncode == 0
    assert lines[0].startswith("motor | pid ")
    assert lines[0].endswith(" half a line\n")
    assert out == "watch | watch stopped\nmotor | motor stopped\n"
    assert err.startswith("r2p: robot.toml: motor, watch; Ctrl-C stops them\n")
    assert "watch | r2p: module WATCH runs watch; links: none, local only" in err
    assert "r2p: SIGINT: stopping watch, motor\n" in err  # before or after what the commands say at their start
    if grandchild is not None:  # what a command has started ends with it
        assert select.select([grandchild], [], [], PATIENCE)[0]
        os.close(grandchild)


@pytest.mark.processes
@pytest.mark.skipif(sys.platform != "linux", reason="only Linux ends the children of a killed process")
def test_a_killed_launcher_takes_its_commands_along(file: str) -> None:
    Path(file).write_text("[launch.motor]\ncommand = 'run nodes.py:motor --via tcp-listen:0'")
    with process("launch", file) as child:
        assert child.stdout is not None
        motor = os.pidfd_open(int(child.stdout.readline().split()[3]))
        child.kill()
        assert select.select([motor], [], [], PATIENCE)[0]
        os.close(motor)


@pytest.mark.processes
def test_the_exit_code_is_that_of_the_first_failure(file: str, capfd: pytest.CaptureFixture[str]) -> None:
    Path(file).write_text("[launch.once]\ncommand = 'run nodes.py:crash'")
    assert CliRunner().invoke(app, ["launch", file]).exit_code == 1
    assert "once | LookupError: no motor\n" in capfd.readouterr().err


def test_errors_are_usage_errors(file: str) -> None:
    for arguments, problem in (
        ([f"{file}.x"], f"there is no file {file}.x"),
        ([file, "--ready", "x"], "--ready x: there"),
    ):
        result = CliRunner().invoke(app, ["launch", *arguments])
        assert result.exit_code == 2
        assert problem in result.stderr


# Conditions


def waits_for(**conditions: object) -> Entry:
    return Entry(name="imu", arguments=("sim",), **conditions)  # type: ignore[arg-type]


@pytest.mark.virtual_time
async def test_conditions_on_the_network() -> None:
    async def blink(node: r2p.Node) -> None:
        await asyncio.sleep(3)
        node.advertise("leds", Led)
        await asyncio.Event().wait()

    entry = waits_for(seen=(("topic", "leds"), ("node", "BOT/blink"), ("module", "BOT")), ready_timeout=5.0)
    loop = asyncio.get_running_loop()
    async with robot(blink):
        await wait_once([entry], "imu", Settings(via=[VIA]))
        assert 3.0 <= loop.time() < 4.0
    with pytest.raises(TimedOut, match=r"imu is not ready after 5 s: topic leds, node BOT/blink, module BOT"):
        await wait_once([entry], "imu", Settings(via=[VIA]))
    with pytest.raises(UsageError, match=r"--ready ium: there is no such entry; did you mean imu\?"):
        await wait_once([entry], "ium", Settings(via=[VIA]))


@pytest.mark.anyio
async def test_a_port_that_accepts_connections() -> None:
    connected = asyncio.Event()

    async def accept(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.read()
        writer.close()
        await writer.wait_closed()
        connected.set()

    server = await asyncio.start_server(accept, "127.0.0.1", 0)
    async with server:
        await wait_ready(waits_for(ports=(server.sockets[0].getsockname(),)), Settings())
        await connected.wait()


def test_a_condition_on_the_network_needs_a_network() -> None:
    entry = waits_for(seen=(("topic", "leds"),))
    with pytest.raises(UsageError, match=r"\[launch.imu\] ready: no network to look for topic leds on; set via"):
        check_network(Path("robot.toml"), [entry], Settings())


# Output


def test_lines_are_whole_and_have_the_name_in_front(tmp_path: Path) -> None:
    printer = LinePrinter(["imu", "gateway"], lambda: None)
    with (tmp_path / "out").open("w") as sink:
        printer.copy("imu", io.BytesIO(b"one\r\n\ntwo\xff\nthe end"), sink.fileno())
    assert (tmp_path / "out").read_bytes() == b"imu     | one\nimu     | \nimu     | two\xff\nimu     | the end\n"


@pytest.mark.parametrize(("variables", "coloured"), [({}, True), ({"NO_COLOR": "1"}, False), ({"TERM": "dumb"}, False)])
def test_names_have_colours_at_a_terminal(
    variables: dict[str, str], monkeypatch: pytest.MonkeyPatch, *, coloured: bool
) -> None:
    for name, value in ({"TERM": "xterm", "NO_COLOR": ""} | variables).items():
        monkeypatch.setenv(name, value)
    terminal, sink = os.openpty()
    LinePrinter(["imu"], lambda: None).copy("imu", io.BytesIO(b"x\n"), sink)
    assert os.read(terminal, 100) == (b"\x1b[36mimu\x1b[0m | x\r\n" if coloured else b"imu | x\r\n")
    os.close(terminal)
    os.close(sink)


def test_long_lines_break_between_words_at_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NO_COLOR", "1")
    terminal, sink = os.openpty()
    termios.tcsetwinsize(sink, (24, 30))
    LinePrinter(["imu"], lambda: None).copy("imu", io.BytesIO(b"a warning that is too long for\xff it\n"), sink)
    assert os.read(terminal, 200) == b"imu | a warning that is too\r\nimu |   long for\xff it\r\n"
    os.close(terminal)
    os.close(sink)


def test_a_closed_output_is_reported_once_and_commands_are_read_on() -> None:
    reader, writer = os.pipe()
    os.close(reader)
    reports: list[str] = []
    printer = LinePrinter(["imu"], lambda: reports.append("closed"))
    source = io.BytesIO(b"one\ntwo\n")
    printer.copy("imu", source, writer)
    os.close(writer)
    assert source.closed
    assert reports == ["closed"]
    assert isinstance(printer.error, BrokenPipeError)
