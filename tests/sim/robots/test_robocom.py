"""Robocom under virtual time: it follows commands, samples together, and stops when it must."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import itertools
import math
from typing import TYPE_CHECKING, TypeVar

import pytest

import r2p
from r2p import sim
from r2p.clock import clock_of
from r2p.msg import (
    Battery,
    Speed2,
    StampedEncoder,
    StampedGPS,
    StampedIMURaw9,
    StampedOdometry,
    Timestamp,
    Velocity3,
)
from r2p.sim.physics.gps import GeoOrigin, GpsSpec
from r2p.sim.robots.robocom import nodes
from r2p.sim.robots.robocom.robot import MOTORS, InterruptLatency, Robocom, SampleTaken
from r2p.testing.network import node_in
from r2p.tools.run import load
from r2p.transports.memory import network
from r2p.units import SECOND
from tests.sim.robots.rig import WAIT

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from r2p.transports.memory import Datagram

pytestmark = pytest.mark.virtual_time

VIA, BUS = "memory:robot", "sim:lab"
M = TypeVar("M", bound=r2p.Message)


async def drive(node: r2p.Node, x: float = 0.5, w: float = 0.0) -> None:
    """Drive for ever."""
    commands = node.advertise("velocity", Velocity3, r2p.Sporadic(deadline=0.05))
    async for _ in node.every(0.05):
        await commands.publish(Velocity3(x=x, w=w))


@contextlib.asynccontextmanager
async def driven(
    via: str = VIA, *, x: float = 0.5, w: float = 0.0, gps: GpsSpec | None = None
) -> AsyncIterator[tuple[Robocom, r2p.Module]]:
    """A robot that has been driving for some seconds."""
    async with Robocom(via, seed=1, gps=gps) as robot, r2p.Module("PC1", via=via) as pc:
        await robot.ready(10)
        pc.start(functools.partial(drive, x=x, w=w), name="drive")
        await asyncio.sleep(WAIT)
        yield robot, pc


async def until_at_rest(robot: Robocom, limit: float = 5.0) -> float:
    """Seconds until no wheel turns any more."""
    loop = asyncio.get_running_loop()
    start = loop.time()
    while any(abs(motor.speed) > 0.05 for motor in robot.hardware.motors):
        assert loop.time() - start < limit, "the robot does not stop"
        await asyncio.sleep(0.01)
    return loop.time() - start


async def newest(pc: r2p.Module, topic: str, type: type[M]) -> M:
    async with node_in(pc) as node:
        return await node.subscribe(topic, type, queue=1, lossy=True).fetch(2)


@pytest.mark.parametrize("via", [VIA, BUS])
async def test_it_drives_a_circle_and_knows_where_it_is(via: str) -> None:
    async with driven(via, x=0.6, w=0.3) as (robot, pc):
        await asyncio.sleep(10)
        v, w = robot.hardware.body.velocity
        assert v / w == pytest.approx(2.0, rel=0.05)
        told = await newest(pc, "odometry", StampedOdometry)
        x, y, heading = robot.pose
        assert heading > 3.0
        assert math.hypot(told.pose.x - x, told.pose.y - y) < 0.2
        assert (told.velocity.x, told.velocity.w) == pytest.approx((0.6, 0.3), abs=0.02)


async def test_it_gains_speed_at_its_ramp_without_a_jump() -> None:
    async with Robocom(VIA, seed=1) as robot, r2p.Module("PC1", via=VIA) as pc:
        await robot.ready(5)
        pc.start(drive)
        before, steepest = 0.0, 0.0
        for _ in range(150):
            await asyncio.sleep(0.02)
            speed = robot.hardware.body.velocity[0]
            steepest = max(steepest, (speed - before) / 0.02)
            before = speed
        assert before == pytest.approx(0.5, rel=0.01)
        assert 0.5 < steepest < 0.9


async def test_a_command_that_is_too_fast_keeps_its_curve() -> None:
    async with driven(x=2.0, w=1.0) as (robot, _pc):
        v, w = robot.hardware.body.velocity
        assert v / w == pytest.approx(2.0, rel=0.05)
        assert max(motor.speed for motor in robot.hardware.motors) * 0.12 == pytest.approx(1.0, rel=0.05)


async def test_without_commands_it_brakes_to_a_halt() -> None:
    async with driven() as (robot, pc):
        await pc.nodes["drive"].stop()
        x = robot.pose[0]
        assert 0.5 < await until_at_rest(robot) < 1.5
        assert robot.pose[0] - x < 0.5


async def test_without_the_inverse_kinematics_the_motors_stop_by_themselves() -> None:
    async with driven() as (robot, _pc):
        await robot.modules["MOTOR1"].nodes["invkin"].stop()
        assert await until_at_rest(robot) < 1.0


@pytest.mark.parametrize("silent", MOTORS)
async def test_when_a_motor_module_is_silent_the_other_wheel_stops_too_and_it_goes_on_after(silent: str) -> None:
    async with driven() as (robot, _pc):
        await robot.switch_off(silent)
        assert await until_at_rest(robot) < 1.0
        await robot.switch_on(silent)
        await asyncio.sleep(4)
        assert robot.hardware.body.velocity[0] == pytest.approx(0.5, rel=0.05)


def warnings(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.name == "r2p.IMU1.gps"]


async def test_a_silent_gps_is_said_once_and_the_robot_drives_on(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    async with driven() as (robot, pc):
        receiver = robot.hardware.receiver
        assert (await newest(pc, "gps", StampedGPS)).fix == 1
        receiver.connected = False
        await asyncio.sleep(4)
        with pytest.raises(TimeoutError):
            await newest(pc, "gps", StampedGPS)
        assert robot.hardware.body.velocity[0] == pytest.approx(0.5, rel=0.01)
        receiver.connected = True
        assert (await newest(pc, "gps", StampedGPS)).fix == 1
        assert warnings(caplog) == ["the GPS receiver is silent: is it plugged in?", "the GPS receiver is back"]


async def test_without_satellites_a_fix_is_none(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    async with driven() as (robot, pc):
        robot.hardware.receiver.has_sky = False
        await asyncio.sleep(1)
        assert (await newest(pc, "gps", StampedGPS)).fix == 0
        robot.hardware.receiver.has_sky = True
        await asyncio.sleep(1)
        assert (await newest(pc, "gps", StampedGPS)).fix == 1
        assert [text.split(":")[0] for text in warnings(caplog)] == [
            "the GPS receiver has no fix",
            "the GPS receiver has a fix again",
        ]


async def test_lines_that_are_no_sentences_are_counted_and_dropped(caplog: pytest.LogCaptureFixture) -> None:
    async with driven() as (robot, pc):
        deliver = robot.hardware.receiver.on_data
        for _ in range(3):
            deliver(b"$GPGGA,rubbish*00\r\n\xff\xfe\r\n")
            await asyncio.sleep(0.01)
        for _ in range(20):  # more than it can hold
            deliver(b"")
        await asyncio.sleep(11)
        assert (await newest(pc, "gps", StampedGPS)).fix == 1
        first, second = warnings(caplog)
        assert first.endswith("1 checksum, 1 garbage")
        assert "2 checksum" in second
        assert "12 too late" in second
        assert robot.modules["IMU1"].nodes["gps"].running


async def recorded(seed: int, monkeypatch: pytest.MonkeyPatch) -> list[Datagram]:
    """All that is on the network in some seconds of a drive."""
    frames: list[Datagram] = []
    send = network("robot").send

    def record(frame: Datagram) -> None:
        frames.append(frame)
        send(frame)

    monkeypatch.setattr(network("robot"), "send", record)
    async with Robocom(VIA, seed=seed), r2p.Module("PC1", via=VIA) as pc, node_in(pc) as node:
        node.subscribe("gps", StampedGPS, lossy=True)
        node.subscribe("imu_raw", StampedIMURaw9, lossy=True)
        pc.start(nodes.eight)
        await asyncio.sleep(4)
    return frames


def test_the_same_seed_gives_the_same_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    one, same, other = (sim.run(functools.partial(recorded, seed, monkeypatch), seed=7) for seed in (1, 1, 2))
    assert len(one) > 400
    assert one == same
    assert one != other


async def test_the_eight_closes() -> None:
    async with Robocom(VIA, seed=1) as robot, r2p.Module("PC1", via=VIA) as pc:
        await robot.ready(5)
        pc.start(functools.partial(nodes.eight, radius=1.0, rounds=1))
        far = 0.0
        for _ in range(30):
            await asyncio.sleep(1)
            far = max(far, abs(robot.pose[1]))
        assert far == pytest.approx(2.0, abs=0.15)
        assert math.hypot(*robot.pose[:2]) < 0.25
        assert robot.hardware.body.velocity == pytest.approx((0, 0), abs=1e-3)


async def collected(pc: r2p.Module, topic: str, type: type[M], seconds: float) -> list[r2p.Sample[M]]:
    """The samples of some seconds."""
    got: list[r2p.Sample[M]] = []
    async with node_in(pc, name=topic) as node:
        samples = node.subscribe(topic, type, queue=1000).samples()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                async for sample in samples:
                    got.append(sample)  # noqa: PERF401 - the time-out would lose a list that is not complete
    return got


async def test_modules_sample_at_the_same_syncs_within_the_jitter_of_their_interrupts() -> None:
    async with Robocom(BUS, seed=1, interrupts=InterruptLatency(5e-6, 3e-6)) as robot, r2p.Module("PC1", via=BUS) as pc:
        await robot.ready(10)
        taken: list[SampleTaken] = []
        robot.hardware.samples = taken
        left, right, imu = await asyncio.gather(
            collected(pc, "encoder_left", StampedEncoder, 3),
            collected(pc, "encoder_right", StampedEncoder, 3),
            collected(pc, "imu_raw", StampedIMURaw9, 3),
        )
        stamps = [{sample.message.timestamp for sample in each} for each in (left, right, imu)]
        assert len(stamps[0]) > 140
        assert all(len(one ^ other) <= 4 for one, other in itertools.pairwise(stamps))  # at both ends
        at = {module: [each.at for each in taken if each.module == module] for module in (*MOTORS, "IMU1")}
        apart = [max(three) - min(three) for three in zip(*(each[1:140] for each in at.values()), strict=True)]
        assert 0 < max(apart) <= 6000


async def test_stamps_are_the_true_instants_of_samples() -> None:
    """Turned to UTC at the PC, within 20 us: the jitter of master, module and PC, and the drift of their crystals."""
    async with Robocom(BUS, seed=1) as robot, r2p.Module("PC1", via=BUS) as pc:
        await robot.ready(10)
        await asyncio.sleep(5)
        taken: list[SampleTaken] = []
        robot.hardware.samples = taken
        samples = await collected(pc, "encoder_left", StampedEncoder, 2)
        clock = clock_of()
        true = sorted(each.at + clock.now() - clock.monotonic() for each in taken if each.module == "MOTOR1")
        off = []
        for sample in samples[5:]:
            assert sample.clock is not None
            utc = sample.clock.utc(sample.message.timestamp.ns)
            off.append(min((abs(each - utc), each - utc) for each in true)[1])
        assert max(map(abs, off)) < 20_000


async def test_a_fix_is_stamped_with_the_instant_of_its_measurement() -> None:
    """Within the receiver's jitter of 10 ms, and the 2 ms of the physics."""
    async with driven(BUS, gps=GpsSpec(noise=0.0, wander=0.0)) as (robot, pc):
        samples = await collected(pc, "gps", StampedGPS, 3)
        assert len(samples) > 10
        for sample in samples:
            assert sample.clock is not None
            late = (sample.clock.utc(sample.message.timestamp.ns) + SECOND // 10) % (SECOND // 5) - SECOND // 10
            assert abs(late) < 0.009 * SECOND
        fix = samples[-1].message
        x, y = GeoOrigin().local(fix.latitude, fix.longitude)
        assert robot.pose[0] - 0.3 < x < robot.pose[0]  # some 0.2 s ago, at 0.5 m/s
        assert y == pytest.approx(robot.pose[1], abs=0.05)
        assert fix.speed == pytest.approx(0.5, abs=0.2)


async def test_odometry_waits_for_both_encoders_of_an_instant() -> None:
    async with r2p.Module("PC1", via=VIA) as pc, node_in(pc) as node:
        pc.start(nodes.forward_kinematics)
        left, right = (node.advertise(topic, StampedEncoder) for topic in nodes.ENCODERS)
        odometry = node.subscribe("odometry", StampedOdometry)
        tick = 1000.0
        await asyncio.sleep(0.1)
        for number in range(1, 22):
            stamp = Timestamp.from_ns(number * SECOND // 50)
            await left.publish(StampedEncoder(stamp, tick))
            if number != 7:  # one got lost: its ticks come with the next one
                await right.publish(StampedEncoder(stamp, 2 * tick if number == 8 else tick))
            await asyncio.sleep(0.02)
        told = [await odometry.fetch(1) for _ in range(3)]
        assert all(each.pose.w == pytest.approx(0, abs=1e-6) for each in told)
        speed = 50 * tick / nodes.MOTOR.ticks_per_radian * nodes.BODY.wheel_radius
        assert [each.velocity.x for each in told] == pytest.approx([speed] * 3)
        assert told[-1].timestamp.ns > told[0].timestamp.ns


async def test_the_battery_is_the_large_one() -> None:
    async with driven() as (_robot, pc):
        battery = await newest(pc, "battery", Battery)
        assert battery.charge > 90
        assert 60 < battery.remaining < 60 * 21


@pytest.mark.parametrize("name", ["inverse_kinematics", "forward_kinematics", "eight"])
def test_its_nodes_run_anywhere(name: str) -> None:
    assert load([f"r2p.sim.robots.robocom.nodes:{name}"])


async def test_a_motor_stops_when_speeds_are_missing() -> None:
    """Also those of another node than its own."""
    async with Robocom(VIA, modules=["MOTOR2"]) as robot, r2p.Module("PC1", via=VIA) as pc, node_in(pc) as node:
        speeds = node.advertise("speed", Speed2)
        for _ in range(50):
            await speeds.publish(Speed2(value=(1.0, 3.0)))
            await asyncio.sleep(0.02)
        assert robot.hardware.motors[1].speed == pytest.approx(3.0, rel=0.05)
        await until_at_rest(robot, limit=1.0)
