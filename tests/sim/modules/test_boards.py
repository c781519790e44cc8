"""The emulated hardware modules, each alone on a network: names, topics and defaults of thesis 7; and their `Plant`."""

from __future__ import annotations

import asyncio
import contextlib
import math
import random
import statistics
from typing import TYPE_CHECKING

import pytest

from r2p.msg import IMU, Battery, Encoder, Float32, IMURaw9, Led, Pressure, Proximity, Setpoint, TiltRate
from r2p.sim.modules.boards import (
    GatewayModule,
    IoModule,
    MotorConfig,
    MotorModule,
    Pins,
    Plant,
    PowerModule,
    leds,
    sample,
)
from r2p.sim.modules.sensors import ImuModule, InertialUnit, Motion, ProximityModule, RangeArray
from r2p.sim.physics.motor import Axle, Drive, Gains, LeadBattery, Motor, MotorSpec, speed_gains
from r2p.sim.physics.world import NOTHING
from tests.sim.physics.theory import step_response

if TYPE_CHECKING:
    import r2p
    from r2p.testing.network import Network

pytestmark = pytest.mark.virtual_time

SMOOTH = MotorSpec(friction=0.0)
LOAD = 0.03  # kg m^2 at the wheel


class Bench:
    """A motor with a load of its own, and its controller."""

    def __init__(self, spec: MotorSpec = SMOOTH, gains: Gains | None = None, mode: str = "speed") -> None:
        self.axle = Axle(Motor(spec), LOAD)
        self.motor = self.axle.motor
        self.gains = gains or speed_gains(spec, self.axle.inertia, frequency=20.0, damping=0.7)
        self.drive = Drive(self.motor, self.gains, mode="position" if mode == "position" else "speed")
        self.plant = Plant([self.drive, self.axle])

    def module(self, network: Network, config: MotorConfig | None = None) -> MotorModule:
        return MotorModule(drive=self.drive, config=config, via=network.transport())


async def command(node: r2p.Node, ticks: float, seconds: float) -> None:
    """Send setpoints for so long, and enough of them."""
    setpoints = node.advertise("setpoint", Setpoint)
    await setpoints.wait_subscriber()
    end = node.now() + round(seconds * 1e9)
    while node.now() < end:
        await setpoints.publish(Setpoint(ticks=round(ticks)))
        await asyncio.sleep(0.01)
    setpoints.close()


async def test_names_topics_and_rates_by_default(r2p_network: Network) -> None:
    boards = [
        Bench().module(r2p_network),
        ProximityModule(sensors=RangeArray(lambda _: math.inf, random.Random(1)), via=r2p_network.transport()),
        PowerModule(battery=LeadBattery(), via=r2p_network.transport()),
        ImuModule(unit=InertialUnit(Motion, random.Random(2)), via=r2p_network.transport()),
        IoModule(pins=Pins(), via=r2p_network.transport()),
        GatewayModule(via=r2p_network.transport()),
    ]
    async with contextlib.AsyncExitStack() as stack:
        for board in boards:
            await stack.enter_async_context(board)
        await asyncio.sleep(10)
        nodes = [(board.name, running.node) for board in boards for running in board.nodes.values()]
        rates = {f"{name} {each.topic}": each.sent / 10 for name, node in nodes for each in node.publishers}
        needs = [f"{name} {each.topic}" for name, node in nodes for each in node.subscribers]
    imu = {"IMU1 imu": 100, "IMU1 imu_raw": 100, "IMU1 tilt": 100, "IMU1 pressure": 25}
    others = {"MOTOR1 encoder": 50, "MOTOR1 current": 2, "PROX1 proximity": 20, "PS battery": 2, "PS power_event": 0}
    assert rates == pytest.approx(imu | others, rel=0.06)
    assert needs == ["MOTOR1 setpoint"]
    assert MotorConfig().timeout == 0.2


async def test_a_step_of_the_setpoint_goes_as_the_theory_says(r2p_network: Network) -> None:
    """With the encoder's ticks, the controller's period and the network in between: within 3 % of the step."""
    bench = Bench()
    speed = 2.0
    setpoint = Setpoint(ticks=round(speed * SMOOTH.ticks_per_radian))
    errors = []
    async with bench.plant, bench.module(r2p_network), r2p_network.node("PC1") as node:
        setpoints = node.advertise("setpoint", Setpoint)
        await setpoints.wait_subscriber()
        for i in range(800):
            if i % 20 == 0:
                await setpoints.publish(setpoint)
            theory = speed * step_response(SMOOTH, bench.axle.inertia, bench.gains, i * 1e-3)
            errors.append(abs(bench.motor.speed - theory) / speed)
            await asyncio.sleep(1e-3)
    assert max(errors) < 0.03
    assert statistics.mean(errors[400:]) < 0.005


async def test_it_stops_when_no_setpoint_comes_for_the_configured_time(r2p_network: Network) -> None:
    bench = Bench()
    async with bench.plant, bench.module(r2p_network, MotorConfig(timeout=0.3)), r2p_network.node("PC1") as node:
        await command(node, 10_000, 1.0)
        assert bench.motor.speed == pytest.approx(10_000 / SMOOTH.ticks_per_radian, rel=0.05)
        await asyncio.sleep(0.25)
        assert bench.drive.setpoint == 10_000
        await asyncio.sleep(0.1)
        assert bench.drive.setpoint is None
        assert bench.motor.voltage == 0
        await asyncio.sleep(2)
        assert abs(bench.motor.speed) < 0.01
        await command(node, 10_000, 1.0)
        assert bench.motor.speed == pytest.approx(10_000 / SMOOTH.ticks_per_radian, rel=0.05)


async def test_a_module_that_ends_stops_its_motor(r2p_network: Network) -> None:
    bench = Bench()
    async with bench.plant, r2p_network.node("PC1") as node:
        async with bench.module(r2p_network):
            await command(node, 10_000, 0.5)
        assert bench.drive.setpoint is None
        assert bench.motor.voltage == 0


def test_a_motor_that_was_stopped_begins_anew() -> None:
    """What its controller had integrated is forgotten."""
    bench = Bench(MotorSpec(damping=50.0))
    bench.drive.setpoint = 10_000
    bench.plant.step(1000)
    bench.drive.stop()
    bench.plant.step(3000)
    bench.drive.setpoint = 0
    bench.plant.step(1)
    assert bench.motor.voltage == 0


async def test_the_encoder_tells_all_ticks(r2p_network: Network) -> None:
    bench = Bench()
    async with bench.plant, r2p_network.node("PC1") as node:
        encoder = node.subscribe("encoder", Encoder, queue=1000)
        async with bench.module(r2p_network):
            await command(node, -20_000, 1.0)
            await asyncio.sleep(3)
        told = sum([(await encoder.fetch()).delta for _ in range(len(encoder.queue))])
    assert told == pytest.approx(bench.motor.ticks, abs=1)
    assert told < -15_000


async def test_position_control_reaches_its_setpoint_and_holds_it(r2p_network: Network) -> None:
    bench = Bench(gains=Gains(kp=0.01, ki=0.0, kd=0.001), mode="position")
    async with bench.plant, bench.module(r2p_network), r2p_network.node("PC1") as node:
        await command(node, 28_000, 3.0)
        assert bench.motor.angle == pytest.approx(math.tau, rel=0.01)


async def test_the_current_is_told(r2p_network: Network) -> None:
    bench = Bench(MotorSpec(damping=200.0))
    async with bench.plant, bench.module(r2p_network), r2p_network.node("PC1") as node:
        current = node.subscribe("current", Float32, queue=1)
        await command(node, 20_000, 2.0)
        expected = 0.2 * 20_000 / SMOOTH.ticks_per_radian / SMOOTH.constant
        assert (await current.fetch(1)).data == pytest.approx(expected, rel=0.1)


async def test_the_proximity_module_tells_millimetres(r2p_network: Network) -> None:
    seen = [200.0, 450.0, math.inf, 2000.0]
    module = ProximityModule(
        sensors=RangeArray(lambda number: seen[number], random.Random(1)), via=r2p_network.transport()
    )
    async with r2p_network.node("PC1") as node, module:
        ranges = node.subscribe("proximity", Proximity)
        readings = [(await ranges.fetch(1)).ranges for _ in range(20)]
    assert [reading[2:] for reading in readings] == [(NOTHING, NOTHING)] * 20
    assert statistics.mean(reading[0] for reading in readings) == pytest.approx(200, abs=2)
    assert statistics.mean(reading[1] for reading in readings) == pytest.approx(450, abs=5)
    assert len({reading[1] for reading in readings}) > 5


async def test_the_power_supply_tells_voltage_and_current(r2p_network: Network) -> None:
    cells = LeadBattery(charge=0.5)
    cells.current = 2.0
    async with r2p_network.node("PC1") as node, PowerModule(battery=cells, via=r2p_network.transport()):
        reading = await node.subscribe("battery", Battery).fetch(2)
    assert reading.voltage == pytest.approx(24_280, abs=5)
    assert reading.current == pytest.approx(2000, abs=7)
    assert (reading.charge, reading.remaining) == (255, 65535)


async def test_the_imu_finds_its_attitude(r2p_network: Network) -> None:
    """Rolled by 30 degrees, at rest: the filter gets there from level, whatever the sensors' biases."""
    roll = math.radians(30)
    motion = Motion(
        force=(0.0, 9.81 * math.sin(roll), 9.81 * math.cos(roll)),
        field=(220.0, -400.0 * math.sin(roll), -400.0 * math.cos(roll)),
    )
    unit = InertialUnit(lambda: motion, random.Random(2))
    plant = Plant([unit], dt=0.0025)
    async with plant, r2p_network.node("PC1") as node, ImuModule(unit=unit, via=r2p_network.transport()):
        imus = node.subscribe("imu", IMU, queue=1)
        tilts = node.subscribe("tilt", TiltRate, queue=1)
        raws = node.subscribe("imu_raw", IMURaw9, queue=1)
        pressures = node.subscribe("pressure", Pressure, queue=1)
        await asyncio.sleep(15)
        imu, tilt, raw, pressure = [await each.fetch(1) for each in (imus, tilts, raws, pressures)]
    assert isinstance(imu, IMU)
    assert isinstance(tilt, TiltRate)
    assert isinstance(raw, IMURaw9)
    assert isinstance(pressure, Pressure)
    assert (imu.roll, imu.pitch, imu.yaw) == pytest.approx((roll, 0, 0), abs=0.06)
    assert (imu.roll_rate, imu.pitch_rate, imu.yaw_rate) == pytest.approx((0, 0, 0), abs=0.03)
    assert (tilt.angle, tilt.rate) == pytest.approx((imu.pitch, imu.pitch_rate), abs=0.01)
    assert raw.acc_y == pytest.approx(500, abs=80)
    assert pressure.altitude == pytest.approx(120, abs=1)


def test_the_rates_of_the_imu_are_without_the_gyroscopes_bias() -> None:
    unit = InertialUnit(Motion, random.Random(2))
    plant = Plant([unit], dt=0.0025)
    plant.step(8000)
    raw, filtered = [], []
    for _ in range(2000):
        plant.step()
        counts, imu = unit.raw(), unit.imu()
        raw.append([math.radians(each * 8.75e-3) for each in (counts.gyro_x, counts.gyro_y, counts.gyro_z)])
        filtered.append([imu.roll_rate, imu.pitch_rate, imu.yaw_rate])
    biases, rates = ([statistics.mean(axis) for axis in zip(*each, strict=True)] for each in (raw, filtered))
    assert max(abs(bias) for bias in biases) > 0.005
    assert rates == pytest.approx([0, 0, 0], abs=0.001)


async def test_the_imu_publishes_only_what_it_is_configured_for(r2p_network: Network) -> None:
    unit = InertialUnit(Motion, random.Random(2))
    async with ImuModule(unit=unit, topics=["tilt"], via=r2p_network.transport()) as module:
        assert set(module.nodes) == {"sensors", "tilt"}


async def test_the_io_module_runs_what_it_is_given(r2p_network: Network) -> None:
    pins = Pins()
    module = IoModule(pins=pins, nodes={"leds": leds, "sample": sample}, via=r2p_network.transport())
    async with r2p_network.node("PC1") as node, module:
        commands = node.advertise("leds", Led)
        await commands.wait_subscriber()
        for led in (Led(3, 1), Led(5, 1), Led(5, 0), Led(99, 1)):
            await commands.publish(led)
        pins.inputs[0] = 1.5
        voltages = node.subscribe("analog", Float32)
        assert (await voltages.fetch(1)).data == pytest.approx(1.5, abs=0.001)
        assert [number for number, on in enumerate(pins.digital) if on] == [3]


def test_the_io_modules_converters_have_12_bits() -> None:
    pins = Pins()
    pins.inputs[:3] = [3.3, 5.0, -1.0]
    assert [pins.read(channel) for channel in range(3)] == [4095, 4095, 0]
    pins.write(0, 2048)
    pins.write(1, 9999)
    assert pins.outputs == pytest.approx((1.65, 3.3), abs=1e-3)


class Count:
    """Adds up its steps."""

    def __init__(self) -> None:
        self.time = 0.0

    def step(self, dt: float) -> None:
        self.time += dt


async def test_the_plant_goes_as_the_loops_time_goes_and_ends_with_its_block() -> None:
    count = Count()
    async with Plant([count], dt=0.002) as plant:
        await asyncio.sleep(1.0005)
        assert plant.steps == 500
        assert count.time == pytest.approx(1.0)
    await asyncio.sleep(1)
    assert plant.steps == 500


def test_parts_step_in_their_order() -> None:
    order: list[str] = []

    class Named:
        def __init__(self, name: str) -> None:
            self._name = name

        def step(self, dt: float) -> None:
            order.append(self._name)

    Plant([Named("drive"), Named("body")]).step(2)
    assert order == ["drive", "body", "drive", "body"]


def test_what_a_blocked_loop_missed_is_made_up_for_within_reason() -> None:
    plant = Plant(dt=0.01)
    plant._tick(0, 0, 20)
    assert plant.steps == 21
    plant._tick(0, 0, 1_000_000)
    assert plant.steps == 21 + 101
