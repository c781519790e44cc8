"""`r2p sim`: what it measures, how it shows it, and the command itself."""

from __future__ import annotations

import asyncio
import functools
import io
import re
import signal
import subprocess
import sys
from typing import TYPE_CHECKING

import msgspec
import pytest
from rich.console import Console
from typer.testing import CliRunner

import r2p
from r2p import sim
from r2p.msg import Pose3
from r2p.runtime.publishers import PeriodicPublisher
from r2p.sim import can_bus
from r2p.sim.modules.boards import ParameterOptions
from r2p.sim.physics.world import World, box
from r2p.sim.robots.emulated import MODULES, MOTORS, Triskar2
from r2p.sim.robots.figures import (
    FiguresReader,
    OdometryFigures,
    RobotBusFigures,
    RobotFigures,
    RobotTopicFigures,
    WheelFigures,
)
from r2p.sim.robots.triskar2 import square
from r2p.tools.config import Settings
from r2p.tools.main import app
from r2p.tools.output import program
from r2p.tools.sim import screen
from r2p.tools.sim.display import odometry_accuracy
from r2p.tools.sim.parameters import parameter_sources
from r2p.tools.sim.run import default_links, simulate
from r2p.tools.sim.triskar2 import Triskar2Display, Triskar2Figures
from r2p.tools.sim.world_map import WorldMap
from tests.tools.rig import process

if TYPE_CHECKING:
    from pathlib import Path

    from r2p.bridge import BridgeOptions

VIA = "sim:reader"
DISPLAY = Triskar2Display("memory:robot", seed=0)


@pytest.mark.virtual_time
async def test_figures_of_a_drive() -> None:
    bus = can_bus("reader")
    display = Triskar2Display(VIA, seed=1)
    async with display.robot as robot, r2p.Module("PC1", via=VIA) as pc:
        await robot.ready(10)
        reader = FiguresReader(robot, bus, display.read, [pc])
        display.watch(pc)
        pc.start(square, 1.0, 0.4, name="square")
        await asyncio.sleep(2)
        reader.read(2.0)
        await asyncio.sleep(1)
        figures = reader.read(3.0)
        body = figures.body
        assert body.path == robot.hardware.body.path
    topics = {topic.topic: topic for topic in figures.topics}
    assert topics["velocity_cmd"].rate == pytest.approx(20, abs=1)
    assert topics["encoder1"].rate == pytest.approx(50, abs=2)
    assert topics["encoder1"].sent == pytest.approx(150, abs=4)  # not what was sent while the bus settled
    assert topics["encoder1"].real_time == "hard: in slots"
    assert topics["odometry"].real_time == "soft: by deadline"
    assert not {"log", "power", "current1"} & set(topics)
    assert figures.missed == 0
    assert (figures.late, figures.slow, figures.too_slow) == (0.0, 0.0, False)
    assert body.odometry is not None
    assert body.odometry.fresh
    assert body.odometry.off <= body.off_max < 0.02
    assert figures.bus is not None
    assert 0.05 < figures.bus.load < 0.5
    # At first more is announced.
    assert figures.bus.frames == pytest.approx(3 * figures.bus.rate, rel=0.3)
    assert figures.bus.mean == pytest.approx(figures.bus.load, rel=0.3)
    assert figures.bus.of == 60
    assert 2.0 < figures.bus.slots < 4.0  # five messages each 20 ms, in cycles of 10 ms
    assert [wheel.setpoint for wheel in body.wheels] == pytest.approx([4, 4, -8], abs=0.01)
    assert [wheel.speed for wheel in body.wheels] == pytest.approx([4, 4, -8], abs=0.3)


@pytest.mark.virtual_time
async def test_what_was_missed_before_does_not_count_and_what_is_off_says_so() -> None:
    display = Triskar2Display(VIA, seed=0)
    async with display.robot as robot:
        await asyncio.sleep(1)
        publisher = next(iter(robot.modules["PS"].nodes["battery"].node.publishers))
        publisher.missed += 5
        reader = FiguresReader(robot, None, display.read)
        publisher.missed += 2
        await robot.switch_off("MOTOR2")
        figures = reader.read(1.0)
    assert figures.missed == 2
    assert [wheel.on for wheel in figures.body.wheels] == [True, False, True]
    assert figures.body.odometry is None
    assert figures.bus is None
    text = "\n".join([*display.state(figures.body), *screen.bus_lines(figures.bus)])
    assert "MOTOR2    switched off" in text
    assert "a network in memory" in text


@pytest.mark.virtual_time
async def test_a_computer_that_is_too_slow_is_told_by_late_messages() -> None:
    """And by those that were skipped; with the topics' rates it need not show."""
    async with Triskar2("memory:slow") as robot:
        await robot.ready(10)
        reader = FiguresReader(robot, None, lambda: None)
        await asyncio.sleep(1)
        assert reader.read(1.0).late == 0
        (encoder,) = (each for each in robot.modules["MOTOR1"].nodes["motor"].node.publishers)
        assert isinstance(encoder, PeriodicPublisher)
        encoder.late += 20
        encoder.skipped += 50
        await asyncio.sleep(1)
        slow = reader.read(2.0)
        await asyncio.sleep(2)
        again = reader.read(4.0)
    assert slow.late == pytest.approx((20 + 50) / (3 * 50 + 50), rel=0.1)
    assert (slow.too_slow, slow.slow) == (True, 1.0)
    assert (again.too_slow, again.late, again.slow) == (False, 0.0, 1.0)


def test_a_slow_computer_is_named_as_the_reason(capsys: pytest.CaptureFixture[str]) -> None:
    shown = screen.SimulatorScreen(DISPLAY, live=False, duration=20.0)
    shown.show(msgspec.structs.replace(moment(), late=0.62))
    shown.print_summary(msgspec.structs.replace(moment(), slow=2.5), fast=False)
    text = capsys.readouterr().out
    assert "PC too slow: 62% late\n" in text
    assert "this PC was too slow for 2.5 of 3.5 s: messages were late or skipped;" in text
    assert text.endswith("sim triskar2 --speed 1\n")
    assert max(map(len, text.splitlines())) <= 80


@pytest.mark.parametrize(
    ("age", "position", "odometry"),
    [(0.1, "x   0.31  y  -0.01 m", "off by 14 mm"), (2.0, "x   0.44  y   0.00 m", "2.0 s ago")],
)
def test_position_and_odometry_are_of_one_instant(age: float, position: str, odometry: str) -> None:
    """Else what the robot drove in the meantime would look like an error of the odometry."""
    last = OdometryFigures(Pose3(0.30), (0.31, -0.01, 0.0), age)
    lines = DISPLAY.state(msgspec.structs.replace(moment().body, pose=(0.44, 0.0, 0.0), odometry=last))
    assert position in lines[0]
    assert lines[1].startswith("odometry  x   0.30  y   0.00 m")
    assert lines[1].endswith(odometry)


@pytest.mark.parametrize(
    ("off", "most", "text"),
    [
        (0.0, 0.0004, "odometry: exact to the millimetre"),
        (0.041, 0.041, "odometry: off by 41 mm: no two wheels have the same size"),
        (0.0, 0.041, "odometry: off by 0 mm, earlier by 41 mm: no two wheels have the same size"),
    ],
)
def test_no_error_of_the_odometry_is_explained_that_is_not_there(off: float, most: float, text: str) -> None:
    assert odometry_accuracy(OdometryFigures(Pose3(off), (0.0, 0.0, 0.0), 0.0), most) == text


@pytest.mark.parametrize("allowed", [True, False])
def test_what_its_gateway_takes_from_outside(monkeypatch: pytest.MonkeyPatch, allowed: bool) -> None:
    def robot(_via: str, *, options: BridgeOptions, **_others: object) -> Triskar2:
        raise r2p.Error(f"control: {options.allow_control}")

    monkeypatch.setattr("r2p.tools.sim.triskar2.Triskar2", robot)
    result = CliRunner().invoke(app, ["sim", "--via", "memory:lab", *(["--allow-control"] if allowed else [])])
    assert (result.exit_code, result.stderr) == (1, f"r2p: control: {allowed}\n")


def test_the_map_shows_walls_way_and_robot() -> None:
    chart = WorldMap(World(box(0, 0, 4, 4)), 20, 10)
    chart.draw((-1.0, 0.0, 0.0))
    lines = chart.draw((1.0, 0.0, 1.6)).splitlines()
    assert len(lines) == 10
    assert {len(line) for line in lines} == {20}
    assert set("".join(lines)) == set(" #.^")
    row = next(line for line in lines if "^" in line)
    assert row.index(".") < row.index("^")
    assert row.strip().startswith("#")


def test_the_map_grows_with_the_way() -> None:
    chart = WorldMap(World(), 20, 10)
    for step in range(100):
        picture = chart.draw((step / 2, 0.0, 0.0))
    assert picture.count(">") == 1
    assert picture.count(".") == pytest.approx(18, abs=2)


def test_fast_prints_a_line_each_ten_seconds_and_sums_up(capsys: pytest.CaptureFixture[str]) -> None:
    sim.run(simulate(Triskar2Display, duration=20.0, seed=4, rounds=1, fast=True, bus_report=True), seed=4)
    fast = capsys.readouterr().out
    lines = fast.splitlines()
    assert max(len(line) for line in lines) <= 80
    assert [line.split()[0] for line in lines if " at " in line and "wheels" in line] == ["10.0", "20.0"]
    found = re.search(r"^20.0 s, ([\d.]+) m driven; the robot is at x (-?[\d.]+), y (-?[\d.]+) m$", fast, re.MULTILINE)
    assert found
    driven, x, y = map(float, found.groups())
    assert driven == pytest.approx(8.0, rel=0.03)
    assert abs(x) + abs(y) < 0.1
    assert re.search(r"messages published, \d+ missed a deadline$", fast, re.MULTILINE)
    assert not re.search(r"of them of (encoder|speed)", fast)  # which have slots of their own
    assert re.search(r"^MOTOR1 +\d+ +\d+% +0 +\d+$", fast, re.MULTILINE)


def test_the_state_fits_beside_the_map() -> None:
    wheels = [WheelFigures(f"MOTOR{n}", True, -10.0, -10.12, -10.0) for n in (1, 2, 3)]
    bus = RobotBusFigures(1.0, 7654.3, 999_999, 99, 10.5, 60)
    odometry = OdometryFigures(Pose3(-10.5, -10.5, -3.0), (-10.5, -10.377, -3.0), 0.1)
    figures = Triskar2Figures((-10.5, -10.5, -3.0), 999.99, odometry, wheels, (25.6, 10.0, 1.0))
    lines = [*DISPLAY.state(figures), *screen.bus_lines(bus)]
    assert len(lines) == 9
    assert max(len(line) for line in lines) <= 48


def moment() -> RobotFigures[Triskar2Figures]:
    """Figures of a robot at rest, with ten topics."""
    wheels = [WheelFigures(f"MOTOR{n}", True, -10.0, -10.12, -10.0) for n in (1, 2, 3)]
    bus = RobotBusFigures(0.5, 1000.0, 9999, 0, 2.5, 60)
    rows = [RobotTopicFigures(f"topic{n}", "MOTOR1", "soft: by deadline", 50.0, 1000, 1) for n in range(10)]
    return RobotFigures(3.5, Triskar2Figures((0.0, 0.0, 0.0), 1.0, None, wheels, (25.6, 10.0, 1.0)), rows, bus)


@pytest.mark.parametrize(
    ("width", "height", "topics", "chart"),
    [(80, 24, 10, True), (120, 40, 10, True), (60, 20, 7, False), (80, 12, 0, True)],
)
def test_it_fits_the_terminal_and_always_says_what_to_do(
    monkeypatch: pytest.MonkeyPatch, width: int, height: int, topics: int, chart: bool
) -> None:
    """A small one has no map, then fewer topics."""
    text = io.StringIO()
    monkeypatch.setattr(screen, "Console", functools.partial(Console, file=text, width=width, height=height))
    shown = screen.SimulatorScreen(DISPLAY, duration=20.0)
    shown.print_hints("Try:", "  r2p topic list")
    assert text.getvalue() == "Try:\n  r2p topic list\n"
    shown.console.print(shown.draw(moment()))
    lines = text.getvalue().splitlines()[2:]
    assert len(lines) <= height
    assert max(len(line) for line in lines) <= width
    assert lines[0].split() == ["Triskar2", "3.5", "of", "20", "s", "1.00", "m", "driven", "10", "deadlines", "missed"]
    assert sum(line.startswith("topic") for line in lines) == topics
    assert ("#" in "".join(lines)) == chart
    assert [line.rstrip() for line in lines[-2:]] == ["Try:", "  r2p topic list"]


def test_at_a_terminal_the_figures_stay_where_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    text = io.StringIO()
    console = functools.partial(
        Console, file=text, width=80, height=24, force_terminal=True, _environ={"TERM": "xterm"}
    )
    monkeypatch.setattr(screen, "Console", console)
    with screen.SimulatorScreen(DISPLAY) as shown:
        shown.print_hints("Try:", "  r2p topic list")
        for _ in range(3):
            shown.show(moment())
    drawn = text.getvalue()
    assert drawn.count("deadlines missed") == drawn.count("  r2p topic list") >= 3
    assert drawn.count("\x1b[?25l") == drawn.count("\x1b[?25h") == 1  # the cursor comes back


def test_hints_name_python_as_it_was_called(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["/lib/r2p/__main__.py", "demo"])
    monkeypatch.setattr(sys, "orig_argv", [".venv/bin/python", "-m", "r2p", "demo"])
    assert program() == ".venv/bin/python -m r2p"


@pytest.mark.parametrize("found", [True, False])
def test_hints_can_be_pasted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, found: bool) -> None:
    """As a command that the shell finds, or as the file that was started."""
    (tmp_path / "r2p").touch(mode=0o755)
    monkeypatch.setenv("PATH", str(tmp_path) if found else "")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["./r2p", "demo"])
    assert program() == ("r2p" if found else "./r2p")
    monkeypatch.setattr(sys, "argv", ["pytest"])
    assert program() == "r2p"


@pytest.mark.processes
def test_others_reach_it_through_its_gateway() -> None:
    """By the debug line and by zenoh, in real time, from other processes."""
    with process("sim", "triskar2", "--drive") as robot:
        assert robot.stdout is not None
        found = (re.search(r"topic echo odometry --via (\S+)", line) for line in robot.stdout)
        urls = [next(match[1] for match in found if match) for _ in default_links()]
        assert [url.partition(":")[0] for url in urls] == ["tcp", "zenoh"][: len(urls)]
        for url in urls:
            with process("topic", "echo", "odometry", "--via", url, "--type", "Odometry", "--once") as echo:
                out, err = echo.communicate()
            assert echo.returncode == 0, err
            assert '"velocity"' in out
        robot.send_signal(signal.SIGINT)
        out, err = robot.communicate()
    assert (robot.returncode, err) == (0, "")
    assert "m driven" in out


@pytest.mark.processes
def test_fast_and_a_link_to_the_outside_do_not_go_together() -> None:
    command = [
        sys.executable,
        "-c",
        "from r2p.tools.main import main; main()",
        "sim",
        "--fast",
        "--via",
        "tcp-listen:0",
    ]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 2
    assert "--fast runs in virtual time" in ended.stderr


@pytest.mark.parametrize(
    ("options", "reason"),
    [(["--speed", "0"], "a number from 0.1"), (["--fast", "--speed", "2"], "leave out either --fast or --speed")],
)
def test_speeds_that_can_not_be(options: list[str], reason: str) -> None:
    result = CliRunner().invoke(app, ["sim", *options])
    assert result.exit_code == 2
    assert reason in result.output


def test_parameters_come_from_files_and_options(tmp_path: Path) -> None:
    """The last file wins, and options win over files; one with a module is for this module only."""
    one, two = tmp_path / "one.toml", tmp_path / "two.toml"
    one.write_text("[params.MOTOR1.motor]\nkp = 3\nki = 3\nkd = 3\n[params.MOTOR2.motor]\nkp = 3\n")
    two.write_text("[params.MOTOR1.motor]\nki = 2\n[params.OTHER.motor]\nki = 9\n")
    chosen = Settings(params={"MOTOR1": {("motor", "kd"): 1.0, ("motor", "timeout"): 1.0}})
    options = ["motor.kp=4", "MOTOR3/motor.kp=5", "limits.low_voltage=2"]
    given = parameter_sources(chosen, MODULES, [one, two], options)

    async def values() -> dict[str, dict[str, float]]:
        async with Triskar2("memory:given", modules=MOTORS, parameters=ParameterOptions(params=given)) as robot:
            await asyncio.sleep(0.1)
            boards = robot.modules.items()
            return {name: {each.name: each.value for each in board.parameters.values()} for name, board in boards}

    found = sim.run(values)
    assert {name: [each[key] for key in ("kp", "ki", "kd", "timeout")] for name, each in found.items()} == {
        "MOTOR1": [4.0, 2.0, 3.0, 1.0],
        "MOTOR2": [4.0, 30.0, 0.0, 0.2],
        "MOTOR3": [5.0, 30.0, 0.0, 0.2],
    }


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["--param", "motor.kq=1"], "parameter motor.kq (--param); did you mean motor.kp?"),
        (["--param", "MOTOR1.motor.kp=1"], "write it as MOTOR1/motor.kp=1"),
        (["--param", "PS/motor.kp=1"], "no node of PS has a parameter motor.kp (--param)"),
        (["--param", "motor.kp=-1"], "it takes 0.0 V/(rad/s) or more (from --param)"),
        (["--param", "MOTR1/motor.kp=1"], "the robot has no module MOTR1; did you mean MOTOR1?"),
        (["--param", "motor.kp"], "write it as"),
        (["--params", "missing.toml"], "there is no file missing.toml"),
        (["--params", "other.toml"], "other.toml has no parameters of the robot's modules"),
    ],
)
def test_parameters_that_the_robot_does_not_have_are_refused(
    arguments: list[str], reason: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "other.toml").write_text("[params.ARM.motor]\nkp = 3\n")
    result = CliRunner().invoke(app, ["sim", "--fast", "--duration", "1", *arguments])
    assert result.exit_code == 2
    assert reason in " ".join(result.output.replace("│", " ").split())
