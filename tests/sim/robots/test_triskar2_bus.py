"""The robot on a simulated RTCAN bus, bit by bit: what hard real-time is worth to it."""

from __future__ import annotations

import asyncio
import functools
import math
from typing import TYPE_CHECKING, NamedTuple

import pytest

import r2p
from r2p import sim
from r2p.codecs import rtcan
from r2p.msg import Velocity3
from r2p.sim.physics.world import World
from r2p.sim.robots import triskar2
from r2p.sim.robots.emulated import MOTORS, Triskar2
from r2p.sim.robots.shared_nodes import COMMANDS, FRESH, TIMEOUT, Traffic, sender
from r2p.sim.robots.triskar2 import square
from tests.sim.robots.rig import WAIT, odometry_of, until_at_rest, until_driving

if TYPE_CHECKING:
    from r2p.sim.can import FrameRecord
    from r2p.sim.physics.world import Triple

pytestmark = pytest.mark.virtual_time

SLOW = "sim:robot,bitrate=500000,slots=29"
"""A bus for a long robot, on which a few frames are a load."""
BUS = "sim:robot"
BLOBS = 2600
"""Frames a second of each class that fill the slow bus: with what the robot sends, over 150 %."""
FRAME = 131
"""Bits of a frame of 8 bytes, at least."""
SPEED = 0.4  # m/s
TURN = 0.5  # rad/s: of the direction


class Blob(r2p.Message):
    """What fills the bus."""

    data: r2p.u64 = 0


class Run(NamedTuple):
    """What a run showed."""

    starts: list[int]
    """Of the hard real-time frames, true ns."""
    pose: Triple
    error: float
    """Of the wheels' speeds, root mean square, rad/s."""
    load: float
    """Of the bus in the second half, 1.0: saturated."""


def wanted(elapsed: float) -> Velocity3:
    """All directions, smoothly: what is left as an error is the network's, not the motors'."""
    return Velocity3(x=SPEED * math.sin(TURN * elapsed), y=SPEED * (1 - math.cos(TURN * elapsed)) / 2)


async def dance(node: r2p.Node, traffic: Traffic) -> None:
    """Command it."""
    time = asyncio.get_running_loop().time
    send = sender(node, "velocity_cmd", Velocity3, lambda: wanted(time()), traffic=traffic, period=triskar2.PERIOD)
    async for _ in node.every(COMMANDS):
        send()


async def fill(node: r2p.Node, frames: float, traffic: Traffic) -> None:
    """So many frames each second."""
    klass = r2p.Sporadic(deadline=0.02, pending=100) if traffic == "srt" else r2p.NonRealTime()
    blobs = node.advertise(f"load_{traffic}", Blob, klass)
    await blobs.wait_subscriber()
    async for _ in node.every(10 / frames):
        for _ in range(10):
            blobs.publish_nowait(Blob())


async def sink(node: r2p.Node) -> None:
    """Somebody wants it."""
    for topic in ("load_srt", "load_nrt"):
        node.subscribe(topic, Blob, lossy=True)
    await asyncio.Event().wait()


async def run(traffic: Traffic, *, loaded: bool, seconds: float = 2.0) -> Run:
    """A drive, with the bus filled to 150 % from half of the time on."""
    starts: list[int] = []
    errors: list[float] = []

    def see(record: FrameRecord) -> None:
        if record.error is None and record.frame.id >> 23 == rtcan.HRT:
            starts.append(record.start)

    async with Triskar2(SLOW, seed=1, traffic=traffic) as robot, r2p.Module("PC1", via=SLOW) as pc:
        bus = sim.can_bus("robot").bus
        bus.observers.append(see)
        node = pc.start(dance, traffic)
        async with r2p.Module("LOAD1", via=SLOW) as one, r2p.Module("LOAD2", via=SLOW) as two:
            two.start(sink)
            await robot.ready(20)
            for publisher in node.publishers:
                await publisher.ready(20)
            await asyncio.sleep(seconds / 2)
            if loaded:
                for kind in ("srt", "nrt"):
                    one.start(functools.partial(fill, frames=BLOBS, traffic=kind), name=kind)
            before = bus.statistics.total.occupied
            for _ in range(round(seconds / 2 * 50)):
                await asyncio.sleep(0.02)
                now = asyncio.get_running_loop().time()
                ideal = triskar2.BODY.wheel_speeds(wanted(now).x, wanted(now).y, 0)
                errors += [motor.speed - speed for motor, speed in zip(robot.hardware.motors, ideal, strict=True)]
            rms = math.sqrt(sum(error * error for error in errors) / len(errors))
            share = (bus.statistics.total.occupied - before) * bus.bit / (seconds / 2 * 1e9)
            return Run(starts.copy(), robot.pose, rms, share)


def test_load_does_not_move_hard_real_time_by_a_nanosecond_and_does_move_the_rest() -> None:
    quiet = sim.run(functools.partial(run, "hrt", loaded=False))
    loaded = sim.run(functools.partial(run, "hrt", loaded=True))
    without = sim.run(functools.partial(run, "nrt", loaded=True))
    assert quiet.load + 2 * BLOBS * FRAME / 500_000 > 1.5
    assert loaded.load > 0.75  # what is lost by arbitration is not sent again at once
    assert len(quiet.starts) > 500
    assert loaded.starts == quiet.starts
    assert math.dist(loaded.pose[:2], quiet.pose[:2]) < 1e-3
    assert without.error >= 5 * loaded.error


MANAGEMENT = 75
"""The most frames per second with which the robot and a PC stay known to each other, once they have met."""
START = 1900
"""The most in the first five seconds, in which they meet."""


def management_frames() -> int:
    """Those that the bus has carried so far."""
    carried = sim.can_bus("robot").bus.statistics.by_message
    return sum(count.frames for message, count in carried.items() if message >> 8 == rtcan.MANAGEMENT)


async def test_a_lap_of_the_square() -> None:
    """As on the network in memory, where it drives three; all hops but the PC's are sent as the nodes choose."""
    async with Triskar2(BUS, seed=1) as robot, r2p.Module("PC1", via=BUS) as pc, odometry_of(pc) as odometry:
        pc.start(functools.partial(square, side=1.5, speed=0.4, laps=1, wait=WAIT), name="square")
        await asyncio.sleep(5)
        start = management_frames()
        await asyncio.sleep(18)
        assert start < START
        assert (management_frames() - start) / 18 < MANAGEMENT
        told = (await odometry.fetch(1)).pose
        x, y, _ = robot.pose
        path = robot.hardware.body.path
        assert path == pytest.approx(6, rel=0.03)
        assert math.hypot(told.x - x, told.y - y) < 0.02 * path
        assert math.hypot(x, y) < 0.03 * path


async def recorded(seed: int) -> list[FrameRecord]:
    """All frames of the start of a drive, with their times."""
    frames: list[FrameRecord] = []
    bus = sim.can_bus("robot")  # it lives as long as it is held
    bus.bus.observers.append(frames.append)
    world = World([((0.6, -5.0), (0.6, 5.0)), ((-0.6, -5.0), (-0.6, 5.0))])  # something to see
    async with Triskar2(BUS, seed=seed, world=world), r2p.Module("PC1", via=BUS) as pc:
        pc.start(square)
        await asyncio.sleep(2.5)
    return frames


def test_the_same_seed_gives_the_same_bits_at_the_same_nanoseconds() -> None:
    one, same, other = (sim.run(functools.partial(recorded, seed), seed=7) for seed in (1, 1, 2))
    assert len(one) > 1000
    assert one == same
    assert [record.frame for record in one] != [record.frame for record in other]


@pytest.mark.parametrize("name", MOTORS)
async def test_a_motor_module_off_the_bus(name: str) -> None:
    """In mid-drive, without a good-bye: the others stop in time, and so does its own."""
    async with Triskar2(BUS) as robot, r2p.Module("PC1", via=BUS) as pc:
        pc.start(square)
        await until_driving(robot)
        port = sim.can_bus("robot").port(name)
        port.power_off()
        await asyncio.sleep(TIMEOUT + 0.02)
        drives = zip(MOTORS, robot.hardware.drives, strict=True)
        assert all(drive.setpoint in (None, 0.0) for motor, drive in drives if motor != name)
        await until_at_rest(robot)
        await asyncio.sleep(2)
        assert await until_at_rest(robot) == 0.0
        port.power_on()
        await until_driving(robot)


async def test_the_gateway_without_power_for_3_s() -> None:
    outside = "memory:lan"
    async with Triskar2(BUS, outside=[outside]) as robot, r2p.Module("PC1", via=outside) as pc:
        pc.start(square)
        await until_driving(robot)
        port = sim.can_bus("robot").port("GW")
        port.power_off()
        await asyncio.sleep(FRESH + TIMEOUT + 0.1)
        assert all(drive.setpoint is None for drive in robot.hardware.drives)
        await until_at_rest(robot)
        await asyncio.sleep(2.5)
        port.power_on()
        await until_driving(robot)
