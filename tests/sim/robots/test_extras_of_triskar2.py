"""The modules of Triskar2 that start only by name: inertial sensors, inputs and outputs, ultrasonic range finders."""

from __future__ import annotations

import asyncio
import functools
import math
import random
import statistics
from typing import TYPE_CHECKING, TypeVar

import pytest

import r2p
from r2p.msg import IMU, Float32, IMURaw9, Led, Proximity, TiltRate, Velocity3
from r2p.sim.modules.sensors import SonarArray
from r2p.sim.physics.inertial import GRAVITY
from r2p.sim.physics.motor import Motor, MotorSpec
from r2p.sim.physics.world import NOTHING, OmniBody, OmniSpec, World, box
from r2p.sim.robots.emulated import EXTRAS, MODULES, Hardware, Triskar2
from r2p.testing.network import node_in
from tests.sim.robots.rig import WAIT

if TYPE_CHECKING:
    from r2p.runtime.subscriber import Subscriber

VIA = "memory:robot"
M = TypeVar("M", bound=r2p.Message)


async def turn(node: r2p.Node, x: float = 0.0, w: float = 0.0, seconds: float = math.inf) -> None:
    commands = node.advertise("velocity_cmd", Velocity3, r2p.Sporadic(deadline=0.05))
    start = node.now()
    async for tick in node.every(0.05):
        if tick.due >= start + seconds * 1e9:
            break
        await commands.publish(Velocity3(x=x, w=w))


async def newest(subscriber: Subscriber[M]) -> M:
    """Return the next message."""
    message = await subscriber.fetch(2.0)
    assert message is not None
    return message


def test_the_body_on_a_circle_is_accelerated_to_its_centre() -> None:
    body = OmniBody(OmniSpec(wear=0.0), [Motor(MotorSpec()) for _ in range(3)], random.Random(1))
    speeds = body.spec.wheel_speeds(0.6, 0.0, 1.5)
    for _ in range(2):
        body._move(body.spec.body_velocity(*speeds), 0.002)
    assert body.acceleration == pytest.approx((0.0, 0.6 * 1.5, 0.0))


def test_the_acceleration_is_that_of_the_path() -> None:
    """The second difference of the true position, turned into the robot's frame, while it turns and slides."""
    dt = 1e-3
    body = OmniBody(OmniSpec(wear=0.0), [Motor(MotorSpec()) for _ in range(3)], random.Random(1))
    path: list[tuple[float, float]] = []
    felt = []
    for step in range(400):
        t = step * dt
        body._move((math.sin(3 * t), 0.5 * math.cos(2 * t), 1 + t), dt)
        path.append((body.x, body.y))
        felt.append((body.w, body.acceleration))
    for at in range(10, 400, 50):
        one, two, three = path[at - 2 : at + 1]
        x, y = ((one[axis] - 2 * two[axis] + three[axis]) / dt**2 for axis in (0, 1))
        cos, sin = math.cos(felt[at - 1][0]), math.sin(felt[at - 1][0])
        assert (x * cos + y * sin, y * cos - x * sin) == pytest.approx(felt[at][1][:2], abs=5e-3)


@pytest.mark.virtual_time
async def test_they_start_only_by_name() -> None:
    async with Triskar2(VIA) as robot:
        assert tuple(robot.modules) == MODULES
        steps = len(robot.plant.parts)
        for name in EXTRAS:
            await robot.switch_on(name)
            await robot.switch_off(name)
            await robot.switch_on(name)
        assert set(robot.modules) == {*MODULES, *EXTRAS}
        assert len(robot.plant.parts) == steps + 1, "the inertial sensors, once"


@pytest.mark.virtual_time
async def test_the_imu_measures_the_motion_of_the_body() -> None:
    async with Triskar2(VIA, seed=3, modules=[*MODULES, "IMU1"]) as robot, r2p.Module("PC1", via=VIA) as pc:
        async with node_in(pc) as node:
            imus = node.subscribe("imu", IMU, queue=1, lossy=True)
            raws = node.subscribe("imu_raw", IMURaw9, queue=1, lossy=True)
            await asyncio.sleep(WAIT)
            pc.start(functools.partial(turn, x=0.5, w=1.0), name="turn")
            await asyncio.sleep(4)
            rates, sideways = [], []
            for _ in range(200):
                imu, raw = await imus.fetch(1.0), await raws.fetch(1.0)
                assert imu is not None
                assert raw is not None
                rates.append(imu.yaw_rate)
                sideways.append(raw.acc_y * GRAVITY / 1000)
        w, velocity = robot.hardware.body.velocity[2], robot.hardware.body.velocity[0]
        sensor = robot.hardware.inertial.accelerometer
        assert sensor.distortion is not None
        leaning = (sensor.bias[1] + 1000 * sensor.distortion[5]) * GRAVITY / 1000
    assert statistics.mean(rates) == pytest.approx(w, abs=0.03)
    assert statistics.mean(sideways) - leaning == pytest.approx(velocity * w, abs=0.03)


@pytest.mark.virtual_time
async def test_its_yaw_is_that_of_the_robot() -> None:
    """To 0.12 rad: uncalibrated, gravity is off by 0.03 rad, and the field is steep; its own bias adds 0.02 rad."""
    async with Triskar2(VIA, seed=3, modules=[*MODULES, "IMU1"]) as robot, r2p.Module("PC1", via=VIA) as pc:
        async with node_in(pc) as node:
            imus = node.subscribe("imu", IMU, queue=1, lossy=True)
            await asyncio.sleep(WAIT)
            pc.start(functools.partial(turn, w=0.5, seconds=3.0), name="turn")
            await asyncio.sleep(33)
            imu = await imus.fetch(1.0)
            assert imu is not None
        heading = robot.pose[2]
    assert heading > 1.0
    assert math.remainder(imu.yaw - heading, math.tau) == pytest.approx(0, abs=0.12)


@pytest.mark.virtual_time
async def test_tilt_has_a_period_of_its_own() -> None:
    async with (
        Triskar2(VIA, modules=["IMU1"]) as robot,
        r2p.Module("PC1", via=VIA) as pc,
        node_in(pc) as node,
    ):
        await asyncio.sleep(1)
        robot.modules["IMU1"].parameters.set({("tilt", "period"): 0.1})
        tilts = node.subscribe("tilt", TiltRate)
        await tilts.fetch(1.0)
        start = node.now()
        for _ in range(50):
            await tilts.fetch(1.0)
        assert (node.now() - start) / 1e9 == pytest.approx(5.0, abs=0.15)


@pytest.mark.virtual_time
async def test_the_io_module_has_leds_and_a_thermometer() -> None:
    world = World()
    world.temperature = 31.0
    async with (
        Triskar2(VIA, world=world, modules=["IO1"]) as robot,
        r2p.Module("PC1", via=VIA) as pc,
        node_in(pc) as node,
    ):
        leds = node.advertise("leds", Led)
        volts = node.subscribe("analog", Float32, queue=1, lossy=True)
        await leds.wait_subscriber()
        await leds.publish(Led(led=3, value=1))
        reading = await newest(volts)
        await asyncio.sleep(0.5)
        reading = await newest(volts)
        assert (reading.data - 0.5) * 100 == pytest.approx(31.0, abs=0.1)
        assert [number for number, on in enumerate(robot.hardware.pins.digital) if on] == [3]


@pytest.mark.virtual_time
async def test_the_ultrasonic_range_finders_measure_a_room() -> None:
    """At another temperature, firmware is wrong until its parameter says so; a pulse is exact to an inch, or 2 %."""
    world = World(box(0.5, 0.0, 4.0, 3.0))
    world.temperature = 0.0
    async with (
        Triskar2(VIA, seed=1, world=world, modules=["PROX3"]) as robot,
        r2p.Module("PC1", via=VIA) as pc,
        node_in(pc) as node,
    ):
        sonar = node.subscribe("sonar", Proximity, queue=1, lossy=True)
        await asyncio.sleep(2)
        warm = await newest(sonar)
        robot.modules["PROX3"].parameters.set({("sonar", "temperature"): 0.0})
        await asyncio.sleep(2)
        await newest(sonar)
        cold = await newest(sonar)
    true = (2300, 1300, 1300, 1300)
    assert cold.ranges == pytest.approx(true, abs=16)
    assert [one / other for one, other in zip(warm.ranges, cold.ranges, strict=True)] == pytest.approx(
        [math.sqrt(293.15 / 273.15)] * 4, abs=0.021
    )


def test_at_45_degrees_no_wall_of_a_room_faces_a_range_finder() -> None:
    hardware = Hardware(1, World(box(0.0, 0.0, 2.0, 2.0)))
    assert [hardware.echo(each, each) for each in range(4)] == pytest.approx([0.8] * 4)
    hardware.body.w = math.radians(30)
    assert hardware.echo(0, 0) == math.inf


def test_fired_at_once_each_takes_the_first_echo_for_its_own() -> None:
    """Sensor 1 has nothing before it; when 0 is fired with it, it hears the wall before that one."""
    distances = {(0, 0): 1.0, (0, 1): 1.2, (1, 1): math.inf}
    sensors = SonarArray(lambda source, receiver: distances.get((source, receiver), math.inf), random.Random(1))
    for number in range(4):
        sensors.fire([number])
    assert list(sensors.read(20.0).ranges) == pytest.approx([1000, NOTHING, NOTHING, NOTHING], abs=16)
    sensors.fire(range(4))
    assert list(sensors.read(20.0).ranges) == pytest.approx([1000, 1200, NOTHING, NOTHING], abs=16)
