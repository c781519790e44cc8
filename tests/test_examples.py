"""The examples: short, complete programs that do what their docstring says.

They run under virtual time, on a network in memory; `serial_cable.py` at a pseudo terminal, in real time.
"""

import asyncio
import csv
import inspect
import io
import math
import re
import runpy
import socket
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import r2p
from r2p.msg import Led, Odometry, String, Text
from r2p.sim.modules import FirmwareModule, Powered, Subscribes
from r2p.sim.robots.emulated import Triskar2
from r2p.testing.network import node_in
from r2p.tools.run import load

EXAMPLES = sorted((Path(__file__).parents[1] / "examples").glob("*.py"))
LONGEST = {"fusion": 121}
"""Lines; of all others 60."""
WITHOUT_NODE = {"turtlesim", "fusion"}
"""Message types that others import, and a program that reads a recording."""


@pytest.fixture(autouse=True)
def _beside_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let examples import each other, as those that are run in their folder do."""
    monkeypatch.syspath_prepend(EXAMPLES[0].parent)


def _example(name: str) -> dict[str, Any]:
    return runpy.run_path(str(EXAMPLES[0].parent / f"{name}.py"))


async def _run_for(seconds: float, *functions: Any) -> None:
    async with r2p.Module("PC1") as module:
        for function in functions:
            module.start(function)
        await asyncio.sleep(seconds)


@pytest.mark.parametrize("file", EXAMPLES, ids=lambda file: file.stem)
def test_it_is_short_and_says_what_it_is_for(file: Path) -> None:
    text = file.read_text()
    assert text.startswith('"""')
    assert len(text.splitlines()) <= LONGEST.get(file.stem, 60)


@pytest.mark.parametrize("file", EXAMPLES, ids=lambda file: file.stem)
def test_the_command_runs_its_nodes(file: Path) -> None:
    """The functions with a node as their only parameter, and a valid name."""
    functions = inspect.getmembers(SimpleNamespace(**runpy.run_path(str(file))), inspect.iscoroutinefunction)
    nodes = [name for name, function in functions if list(inspect.signature(function).parameters) == ["node"]]
    assert bool(nodes) != (file.stem in WITHOUT_NODE)
    assert [program.name for program in load(f"{file}:{name}" for name in nodes)] == nodes


@pytest.mark.virtual_time
async def test_blink(capsys: pytest.CaptureFixture[str]) -> None:
    example = _example("blink")
    await _run_for(2.2, example["blink"], example["watch"])
    assert capsys.readouterr().out.splitlines() == [f"Led(led=3, value={value})" for value in (1, 0, 1, 0)]


@pytest.mark.virtual_time
async def test_watch_timeout(capsys: pytest.CaptureFixture[str]) -> None:
    example = _example("watch_timeout")
    await _run_for(5, example["joystick"], example["wheels"], example["motors"])
    printed = capsys.readouterr().out.splitlines()
    assert printed[:20] == ["PWM2(pwm1=500, pwm2=500)"] * 20
    assert printed[20:22] == ["no command for 0.3 s: stopped", "PWM2(pwm1=0, pwm2=0)"]


@pytest.mark.virtual_time
async def test_publishers(capsys: pytest.CaptureFixture[str]) -> None:
    example = _example("publishers")
    await _run_for(5, example["sensors"], example["reader"])
    printed = capsys.readouterr().out
    assert "missed: topic setpoint (reader): no room by the deadline" in printed
    assert "missed: topic notes" not in printed  # its publisher waits instead
    assert "lost: " in printed


@pytest.mark.virtual_time
async def test_custom_message(capsys: pytest.CaptureFixture[str]) -> None:
    example = _example("custom_message")
    assert r2p.layout(example["Marker"]).size == 45
    await _run_for(1, example["camera"], example["show"])
    printed = capsys.readouterr().out.splitlines()
    assert "refused: Marker.id (u8) takes an integer from 0 to 255, not 300" in printed
    assert "dock 7 (1.5, 0.0, 0.25)" in printed


@pytest.mark.virtual_time
async def test_logger_csv(capsys: pytest.CaptureFixture[str]) -> None:
    example = _example("logger_csv")
    await _run_for(1, example["imu_csv"], example["imu_demo"])
    rows = list(csv.DictReader(io.StringIO(capsys.readouterr().out)))
    assert len(rows) > 90
    assert rows[0]["source"] == "PC1/imu_demo"
    assert rows[0]["acc_z"] == "1000"


@pytest.mark.virtual_time
async def test_teleop(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Keys drive the robot, and its end stops it."""
    example = _example("teleop")
    keys = iter("wwa")
    monkeypatch.setitem(example["keys"].__globals__, "typed", lambda: next(keys, ""))
    async with Triskar2("memory:teleop") as robot, r2p.Module("PC1", via="memory:teleop") as pc:
        node = pc.start(example["keys"])
        await asyncio.sleep(3)
        assert robot.pose[1] > 0.5
        await pc.nodes[node.name].stop()
        await asyncio.sleep(1)
        before = robot.pose
        await asyncio.sleep(1)
        assert robot.pose == pytest.approx(before, abs=1e-3)
    printed = capsys.readouterr().out
    assert printed.startswith("w, a, s, d: move    q, e: turn    any other key: stop\n")
    assert re.search(r"\rx +0\.\d\d m   y +0\.[5-9]\d m   heading +-?0\.\d\d rad \n\Z", printed)


@pytest.mark.virtual_time
async def test_square() -> None:
    """By odometry: each corner is where it should be."""
    example = _example("square")
    nearest = dict.fromkeys(example["CORNERS"], math.inf)
    async with Triskar2("memory:square", seed=4) as robot, r2p.Module("PC1", via="memory:square") as pc:
        pc.start(example["square"])
        for _ in range(150):
            await asyncio.sleep(0.1)
            for corner in nearest:
                nearest[corner] = min(nearest[corner], math.dist(corner, robot.pose[:2]))
    assert max(nearest.values()) < 0.06


@pytest.mark.virtual_time
async def test_a_turtle_draws_a_star(capsys: pytest.CaptureFixture[str]) -> None:
    """A second time it finds its turtle there."""
    async with r2p.Module("PC1") as module:
        module.start(_example("turtles")["turtlesim"])
        for name in ("first", "second"):
            module.start(_example("turtle_client")["star"], name=name)
            await asyncio.sleep(30.0)
            assert not module.nodes[name].running
    rows = capsys.readouterr().out.splitlines()
    drawn = [row for row in rows if "*" in row]
    assert 20 < len(drawn) < 30
    assert drawn[0].strip() == "*"  # the topmost corner
    assert max(map(len, drawn)) > 50  # the two at the sides
    assert len(drawn[-1].split()) == 2  # the two at the bottom


@pytest.mark.virtual_time
async def test_throughput(capsys: pytest.CaptureFixture[str]) -> None:
    example = _example("throughput")
    async with r2p.Module("PC1") as module, node_in(module) as node:
        module.start(example["receive"])
        publisher = node.advertise("benchmark", String)
        for tick in range(30):
            await publisher.publish(String("x" * 1000 * tick))
            await asyncio.sleep(0.1)
    assert "10 messages/s, 0.1 MB/s, lost 0" in capsys.readouterr().out.splitlines()
    async with r2p.Module("PC2") as module, node_in(module) as node:
        texts = node.subscribe("benchmark", String, queue=10)
        module.start(example["transmit"])
        assert len((await texts.fetch()).data) == 60
        await asyncio.sleep(0)
        module.parameters.set({("transmit", "size"): 500})
        while len((await texts.fetch()).data) == 60:
            pass


@pytest.mark.virtual_time
async def test_gateway(capsys: pytest.CaptureFixture[str]) -> None:
    """The robot's topics reach the PC, except the log; and a low battery is reported."""
    gateway = asyncio.create_task(_example("gateway")["main"]("memory:robot", "memory:lan"))
    async with Triskar2("memory:robot") as robot, r2p.Module("PC1", via="memory:lan") as pc:
        robot.hardware.battery.charge = 0.1
        async with node_in(pc) as node:
            told = node.subscribe("odometry", Odometry)
            assert (await told.fetch(10)).pose.x == pytest.approx(0, abs=1e-3)
            await asyncio.sleep(12)
    gateway.cancel()
    await asyncio.gather(gateway, return_exceptions=True)
    printed = capsys.readouterr().out
    assert re.search(r"^battery: \d+ %, 23\.\d V$", printed, re.MULTILINE)
    assert re.search(r"^odometry: \d+ from memory:robot to memory:lan", printed, re.MULTILINE)
    assert "log: " not in printed


@pytest.mark.anyio
async def test_own_transport(capsys: pytest.CaptureFixture[str]) -> None:
    example = _example("own_transport")
    with socket.socket(type=socket.SOCK_DGRAM) as one, socket.socket(type=socket.SOCK_DGRAM) as other:
        for each in (one, other):
            each.bind(("127.0.0.1", 0))
        here, there = one.getsockname()[1], other.getsockname()[1]
    async with (
        asyncio.timeout(20),
        r2p.Module("UDP1", via=example["Udp"](here, there)) as first,
        r2p.Module("UDP2", via=example["Udp"](there, here)) as second,
        node_in(first) as node,
    ):
        texts = node.subscribe("hello", Text)
        for module in (first, second):
            module.start(example["hello"])
        heard = {(await texts.fetch()).text}
        while len(heard) < 2:
            heard.add((await texts.fetch()).text)
    assert heard == {"hello from UDP1", "hello from UDP2"}
    assert "hello from UDP1" in capsys.readouterr().out


@pytest.mark.processes
def test_test_robot(tmp_path: Path) -> None:
    file = EXAMPLES[0].parent / "test_robot.py"
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--rootdir", str(tmp_path), str(file)]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert "1 passed" in ended.stdout


@pytest.mark.anyio
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo terminals")
async def test_serial_cable(capsys: pytest.CaptureFixture[str]) -> None:
    blinked = asyncio.Event()
    board = FirmwareModule("LED1", subscribers=[Subscribes("leds", Led, answer=lambda _led: blinked.set())])
    async with asyncio.timeout(20), Powered(board) as power:
        device = power.open_pty()
        robot = asyncio.create_task(_example("serial_cable")["main"](device))
        await blinked.wait()
        robot.cancel()
        await asyncio.gather(robot, return_exceptions=True)
    assert f"serial:{device} is up" in capsys.readouterr().out
