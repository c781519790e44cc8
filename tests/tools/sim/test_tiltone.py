"""`r2p sim tiltone`: its demonstration, what its screen shows, and hands that help it up."""

from __future__ import annotations

import asyncio
import math

import msgspec
import pytest
from typer.testing import CliRunner

import r2p
from r2p.msg import Float32, Pose3, Velocity3
from r2p.sim.robots.figures import OdometryFigures, WheelFigures
from r2p.testing.network import node_in
from r2p.tools.main import app
from r2p.tools.sim.display import PICTURE_HEIGHT, PICTURE_WIDTH, STATE_WIDTH
from r2p.tools.sim.tiltone import TiltOneDisplay, TiltOneFigures, side_view, velocity_at

DISPLAY = TiltOneDisplay("memory:tiltone", seed=0)
MOMENT = TiltOneFigures(
    "balancing",
    math.radians(-12.5),
    math.radians(-8.0),
    -1.25,
    -0.75,
    Velocity3(x=-1.0, w=-0.5),
    OdometryFigures(Pose3(x=-10.31, y=-10.5), (-10.3, -10.6, 1.0), 0.05),
    [WheelFigures("MOTOR1", True, -24.0, -12.5, -20.0), WheelFigures("MOTOR2", True, None, 0.0, 0.0)],
    "Nm",
    (23.25, -12.5, 1.0),
    0.0125,
    123.5,
    3.25,
)


def shown(figures: TiltOneFigures) -> str:
    return "\n".join(DISPLAY.state(figures))


def test_its_lines_fit_whatever_happens() -> None:
    unknown = msgspec.structs.replace(MOMENT, wanted_tilt=None, command=None, odometry=None)
    off = msgspec.structs.replace(MOMENT, wheels=[WheelFigures("MOTOR1", False, None, 0.0, 0.0)] * 2)
    for figures in (MOMENT, unknown, off):
        assert max(map(len, DISPLAY.state(figures))) <= STATE_WIDTH
        assert len(DISPLAY.line(figures)) <= 60
        assert max(map(len, DISPLAY.summary(figures))) <= 80
    assert "tilt      -12.50 deg    wanted -8.00  balancing" in shown(MOMENT)
    assert "speed      -1.25 m/s    wanted -1.00" in shown(MOMENT)
    assert "MOTOR1    -24.00 Nm  -12.50 rad/s -20.00 A" in shown(MOMENT)
    assert "MOTOR2    stopped" in shown(MOMENT)
    assert "wanted     none" in shown(unknown)
    assert "odometry  nothing yet" in shown(unknown)
    assert "MOTOR1    switched off" in shown(off)
    assert "it never fell; leant by up to 0.0 deg" in DISPLAY.summary(MOMENT)[0]
    assert "fell 1 time;" in DISPLAY.summary(msgspec.structs.replace(MOMENT, falls=1))[0]


def view(degrees: float, *, wanted: float | None = None, travelled: float = 0.0, shoved: float = 0.0) -> list[str]:
    tilt = None if wanted is None else math.radians(wanted)
    figures = msgspec.structs.replace(
        MOMENT, tilt=math.radians(degrees), wanted_tilt=tilt, travelled=travelled, shoved=shoved
    )
    lines = side_view(figures).split("\n")
    assert [len(line) for line in lines] == [PICTURE_WIDTH] * PICTURE_HEIGHT
    return lines


def test_upright_it_is_a_line_and_leaning_it_is_a_slope() -> None:
    upright = view(0.0)
    assert [line.strip() for line in upright[:-1]] == ["O", *["|"] * 6, "(|)"]
    assert upright[-1] == "----+---------+---------+---"
    assert {line[14] for line in upright[1:-2]} == {"|"}
    assert view(8.0)[0].strip() == ""
    assert "/" in "".join(view(5.0))
    assert "\\" in "".join(view(-5.0))
    lying = view(80.0)
    assert "_" * 6 in lying[6] + lying[5]
    assert not "".join(lying[:5]).strip()


def test_the_picture_has_what_is_wanted_the_way_and_a_shove() -> None:
    assert view(0.0, wanted=0.0) == view(0.0)  # hidden behind the robot
    assert view(0.0, wanted=5.0)[3].strip().endswith(".")
    assert view(0.0, travelled=0.1)[-1] == "--+---------+---------+-----"
    assert view(0.0, travelled=0.5)[-1] == view(0.0)[-1]
    assert view(0.0, shoved=8.0)[1].startswith("==>")
    assert view(0.0, shoved=-8.0)[1].endswith("<==")


def test_a_round_stands_drives_turns_and_stops() -> None:
    seen = [velocity_at(time) for time in (1.0, 5.0, 10.0, 14.0, 18.0)]
    assert [each.x for each in seen] == pytest.approx([0.0, 0.5, 0.5, 0.5, 0.0])
    assert [each.w for each in seen] == pytest.approx([0.0, 0.0, 0.6, 0.0, 0.0])


@pytest.mark.virtual_time
async def test_a_shove_from_outside_and_hands_that_set_it_upright() -> None:
    via = "memory:tiltone-shoved"
    display = TiltOneDisplay(via, seed=1)
    async with display.robot as robot, r2p.Module("PC1", via=via) as pc, r2p.Module("PC2", via=via) as other:
        display.watch(pc)
        assert display.read().status == "held"
        await asyncio.sleep(3)
        assert display.read().status == "balancing"
        async with node_in(other) as node:
            shoves = node.advertise("shove", Float32)
            await shoves.wait_subscriber()
            await shoves.publish(Float32(data=-60.0))
            await asyncio.sleep(0.05)
            assert display.read().shoved == -60.0
            await asyncio.sleep(2)
        lying = display.read()
        assert (lying.status, lying.falls, lying.shoved) == ("fallen", 1, 0.0)
        await asyncio.sleep(12)
        again = display.read()
        assert (again.status, again.falls) == ("balancing", 1)
        assert 0.3 < again.worst < math.radians(40)  # as long as it balanced
        assert again.wanted_tilt is not None
        await robot.switch_off("IMU1")
        await asyncio.sleep(1)
        assert display.read().status == "falling"


def test_the_command_runs_a_round_and_says_how_it_went() -> None:
    result = CliRunner().invoke(app, ["sim", "tiltone", "--fast", "--duration", "14", "--seed", "1"])
    assert result.exit_code == 0
    assert "tiltOne starts: 5 modules on a simulated RTCAN bus" in result.stdout
    assert "  10.0 s  balancing " in result.stdout
    assert "it never fell; leant by up to " in result.stdout
    assert "from a tilt to the motors' efforts: 1." in result.stdout
    assert ", 0 missed a deadline" in result.stdout
    assert max(map(len, result.stdout.splitlines())) <= 80
