"""The robot of 20 modules under virtual time: it stands up, walks as it is told, and stops when a joint is silent."""

from __future__ import annotations

import asyncio
import math
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import pytest

import r2p
from r2p import sim
from r2p.msg import Velocity3
from r2p.sim.robots.hexapod import nodes
from r2p.sim.robots.hexapod.robot import MODULES, MOTORS, Hexapod
from tests.sim.robots.rig import odometry_of

if TYPE_CHECKING:
    from r2p.sim.can import FrameRecord

pytestmark = pytest.mark.virtual_time
GAIT = nodes.GaitSpec()
STEP = 1 / GAIT.frequency


class Walker:
    """A node on a computer that tells the robot how to walk."""

    def __init__(self) -> None:
        self.velocity = Velocity3()

    async def __call__(self, node: r2p.Node) -> None:
        commands = node.advertise("velocity", Velocity3, r2p.Sporadic(deadline=0.05))
        async for _ in node.every(0.05):
            await commands.publish(self.velocity)


def test_it_has_as_many_modules_as_the_bus_is_made_for() -> None:
    assert len(MODULES) == 20
    assert len(set(MODULES)) == 20
    assert len(MOTORS) == 18


def test_a_foot_goes_back_evenly_on_the_ground_and_forward_in_the_air() -> None:
    phases = [number / 1000 for number in range(1001)]
    feet = [GAIT.foot(phase % 1.0) for phase in phases]
    assert feet[0] == (0.5, 0.0)
    assert GAIT.foot(GAIT.duty)[0] == pytest.approx(-0.5)
    for phase, (along, up) in zip(phases[:-1], feet, strict=False):
        if phase < GAIT.duty:
            assert along == pytest.approx(0.5 - phase / GAIT.duty)
            assert up == 0.0
        assert 0.0 <= up <= 1.0
        assert abs(along) <= 0.6
    assert max(abs(new[0] - old[0]) for old, new in pairwise(feet)) < 0.005  # no jumps
    assert max(abs(new[1] - old[1]) for old, new in pairwise(feet)) < 0.01


def test_three_feet_at_least_are_always_on_the_ground() -> None:
    for number in range(1000):
        on_ground = [nodes.phase_of(leg, number / 1000) < GAIT.duty for leg in range(6)]
        assert all(on_ground[leg] for leg in (0, 2, 4)) or all(on_ground[leg] for leg in (1, 3, 5))


def test_a_command_is_limited_by_the_fastest_foot_and_almost_nothing_is_none() -> None:
    homes = [nodes.BODY.on_body(leg, (0.0, nodes.BODY.reach, -nodes.BODY.height)) for leg in range(6)]
    assert nodes.limited(Velocity3(x=0.05), homes, 0.1) == Velocity3(x=0.05)
    assert nodes.limited(Velocity3(x=3.0, y=4.0), homes, 0.1) == pytest.approx(Velocity3(x=0.06, y=0.08))
    assert nodes.limited(Velocity3(x=0.0005), homes, 0.1) == Velocity3()
    farthest = max(math.hypot(x, y) for x, y, _ in homes)
    assert nodes.limited(Velocity3(w=10.0), homes, 0.1).w == pytest.approx(0.1 / farthest)


async def test_it_stands_up_and_walks_at_stride_times_frequency() -> None:
    walker = Walker()
    via = "memory:hexapod"
    async with Hexapod(via, seed=1) as robot, r2p.Module("PC1", via=via) as pc, odometry_of(pc) as odometry:
        body = robot.hardware.body
        assert body.lies
        pc.start(walker, name="walker")
        await asyncio.sleep(1.5)
        assert body.height == pytest.approx(nodes.BODY.height, abs=0.003)
        assert all(body.standing)

        stride = 0.08 * STEP  # m of the body in each step
        walker.velocity = Velocity3(x=0.08)
        await asyncio.sleep(2 * STEP)
        before, last = robot.pose, (await odometry.fetch(1)).pose
        await asyncio.sleep(3 * STEP)
        after, now = robot.pose, (await odometry.fetch(1)).pose
        assert after[0] - before[0] == pytest.approx(3 * stride, rel=0.08)  # its legs give way a little
        assert after[1] - before[1] == pytest.approx(0.0, abs=0.01)
        assert now.x - last.x == pytest.approx(after[0] - before[0], rel=0.1)
        assert 3 <= sum(body.standing) <= 6

        walker.velocity = Velocity3(w=0.3)
        await asyncio.sleep(2 * STEP)
        before = robot.pose
        await asyncio.sleep(2 * STEP)
        assert robot.pose[2] - before[2] == pytest.approx(2 * 0.3 * STEP, rel=0.08)

        walker.velocity = Velocity3(x=0.08)
        await robot.unplug("RM2")
        await asyncio.sleep(1.5)  # its odometry is too old, and the step ends
        before = robot.pose
        await asyncio.sleep(0.5)
        assert math.dist(robot.pose[:2], before[:2]) < 0.005
        await robot.switch_on("RM2")
        await asyncio.sleep(2.5)
        assert math.dist(robot.pose[:2], before[:2]) > stride


async def run(seed: int) -> list[Any]:
    """Some of its modules on a bus: what was on the bus, and where the joints are."""
    frames: list[FrameRecord] = []
    sim.can_bus("few", seed=seed).bus.observers.append(frames.append)
    async with Hexapod("sim:few", seed=seed, modules=["LM1", "LM2", "LM3", "RM1", "PS"]) as robot:
        await asyncio.sleep(2.0)
        return [*frames, *(motor.angle for motor in robot.hardware.motors)]


def test_the_same_seed_gives_the_same_bits() -> None:
    first = sim.run(lambda: run(3), seed=3)
    assert sim.run(lambda: run(3), seed=3) == first
    assert sim.run(lambda: run(4), seed=4) != first
