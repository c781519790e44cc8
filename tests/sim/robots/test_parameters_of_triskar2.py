"""The parameters of the robot: those that its page lists, and what they change while it drives."""

from __future__ import annotations

import asyncio
import re
from pathlib import Path
from typing import NamedTuple

import pytest

import r2p
from r2p.msg import Velocity3
from r2p.sim.modules.boards import ParameterOptions
from r2p.sim.robots.emulated import MOTORS, Triskar2

pytestmark = pytest.mark.virtual_time

PAGE = Path(__file__).parents[3] / "docs" / "robot.md"
VIA = "memory:robot"


def shown(value: float) -> str:
    return f"{value:g}"


async def test_the_page_lists_all_that_have_a_unit() -> None:
    async with Triskar2(VIA, modules=Triskar2.names) as robot:
        await asyncio.sleep(0.1)
        infos = [info for board in robot.modules.values() for info in board.parameters.infos() if info.unit]
    declared = {}
    for info in infos:
        assert isinstance(info.default, tuple | int | float)
        assert info.minimum is not None
        assert info.maximum is not None
        default = ", ".join(map(shown, info.default if isinstance(info.default, tuple) else (info.default,)))
        limits = f"{shown(info.minimum)}, {shown(info.maximum)}"
        declared[info.node, info.name] = (default, limits, info.unit)
    listed, node = {}, ""
    rows = r"^\| (?:`(\w+)`)? ?\| `(\w+)` \| ([^|]+) \| ([^|]+) \| ([^|]+) \|"
    for named, name, default, limits, unit in re.findall(rows, PAGE.read_text(encoding="utf-8"), re.MULTILINE):
        node = named or node
        listed[node, name] = (default, limits, unit)
    assert listed == declared


class Step(NamedTuple):
    """How the robot follows a step of its velocity."""

    rise: float
    """Seconds from 10 to 90 %."""
    overshoot: float
    """Share of the step."""
    end: float
    """Speed at the end, m/s."""


class Driver:
    """A node on a computer that drives the robot ahead at `speed`, m/s."""

    def __init__(self, robot: Triskar2) -> None:
        self.speed = 0.0
        self._robot = robot

    async def __call__(self, node: r2p.Node) -> None:
        commands = node.advertise("velocity_cmd", Velocity3, r2p.Sporadic(deadline=0.05))
        async for _ in node.every(0.02):
            await commands.publish(Velocity3(x=self.speed))

    async def step(self, to: float) -> Step:
        """Change the speed, and look for 0.6 s at the one that the robot really has."""
        start, self.speed = self.speed, to
        seen = []
        for _ in range(300):
            await asyncio.sleep(0.002)
            seen.append((self._robot.hardware.body.velocity[0] - start) / (to - start))
        ten, ninety = (next(i for i, share in enumerate(seen) if share >= limit) for limit in (0.1, 0.9))
        return Step((ninety - ten) * 0.002, max(seen) - 1, self._robot.hardware.body.velocity[0])


async def test_a_gain_that_is_tuned_while_it_drives_changes_its_step_response() -> None:
    """Set from a computer behind the gateway, for modules on the bus."""
    async with (
        Triskar2("sim:tuned", seed=1, outside=["memory:desk"]) as robot,
        r2p.Module("PC1", via="memory:desk") as pc,
    ):
        await robot.ready(10)
        driver = Driver(robot)
        pc.start(driver, name="drive")
        await driver.step(0.1)
        before = await driver.step(0.4)
        steady = []
        for kp in (0.5, 5.0):
            await asyncio.sleep(0.5)  # the step before has settled
            for motor in MOTORS:
                await pc.network.set_parameters(motor, {("motor", "kp"): kp})
            for _ in range(100):
                await asyncio.sleep(0.002)
                steady.append(robot.hardware.body.velocity[0])
            if kp == 0.5:
                await driver.step(0.1)
                soft = await driver.step(0.4)
        await driver.step(0.1)
        stiff = await driver.step(0.4)
        described = await pc.network.parameters("MOTOR2", "motor")
    assert [each.end for each in (before, soft, stiff)] == pytest.approx([0.4] * 3, rel=0.01)
    assert before.overshoot == pytest.approx(0.09, abs=0.02)
    assert soft.overshoot == pytest.approx(0.35, abs=0.05)
    assert abs(stiff.overshoot) < 0.01
    assert soft.rise > 1.1 * before.rise > 1.2 * stiff.rise > 0.03
    assert steady == pytest.approx([0.4] * 200, rel=0.01)  # new gains are no step of their own
    assert [(each.value, each.origin) for each in described if each.name == "kp"] == [(5.0, "run time")]


async def test_what_was_saved_counts_at_the_next_start(tmp_path: Path) -> None:
    """All its modules save to one file; what is given at the start wins."""
    file = tmp_path / "robot.toml"
    options = ParameterOptions(params_file=file)
    async with Triskar2(VIA, parameters=options) as robot, r2p.Module("PC1", via=VIA) as pc:
        await robot.ready(10)
        for number, motor in enumerate(MOTORS):
            await pc.network.set_parameters(motor, {("motor", "kp"): 2.0 + number})
        assert [await pc.network.save_parameters(motor) for motor in MOTORS] == [1, 1, 1]
    options = ParameterOptions(params_file=file, params={"MOTOR3": {"motor.kp": 7.0}})
    async with Triskar2(VIA, parameters=options, modules=MOTORS) as robot:
        await asyncio.sleep(0.1)
        ticks = robot.hardware.motors[0].spec.ticks_per_radian
        assert [drive.pid.gains.kp * ticks for drive in robot.hardware.drives] == pytest.approx([2.0, 3.0, 7.0])
