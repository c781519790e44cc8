"""The hardware modules of the thesis (chapter 7), emulated: motor, proximity, IMU, input/output, power and gateway.

Each is a `Board`, an `r2p.Module` that starts its nodes by itself when it is opened. The nodes are ordinary ones around
a model of `r2p.sim.physics`, so a board runs on any transport, and sends the same messages as a real one. A `Plant`
advances the models.
"""

import asyncio
import functools
import math
import random
from collections.abc import Awaitable, Callable, Iterable, Mapping
from typing import Any, Protocol, Self

import msgspec

import r2p
from r2p.bridge import BridgeOptions
from r2p.clock import Ticker
from r2p.modules.supervisor import NodeFunction
from r2p.msg import IMU, Battery, Encoder, Float32, IMURaw9, Led, Pressure, Proximity, Setpoint, Tilt
from r2p.sim.physics.inertial import (
    ACCELEROMETER,
    BAROMETER_NOISE,
    GRAVITY,
    GYROSCOPE,
    MAGNETOMETER,
    ComplementaryFilter,
    MemsSensor,
    Vector,
    altitude_at,
    pressure_at,
)
from r2p.sim.physics.motor import Drive, LeadBattery
from r2p.sim.physics.world import ADC_MAX, ADC_REFERENCE, RangeFinder, RangeSpec, adc_counts
from r2p.transports.link import Transport
from r2p.units import SECOND

Via = str | Transport | Iterable[str | Transport] | None
DistanceTo = Callable[[int], float]
"""A function that returns the distance in mm to the object before sensor 0 to 3, or infinity."""

_CATCH_UP = 1.0  # s of physics to make up for after the loop was blocked; more would hang after a long sleep
_VOLTAGE_COUNT = 36_000 / ADC_MAX  # mV per count: a divider turns 36 V into 3.3 V
_CURRENT_COUNT = 50_000 / ADC_MAX  # mA per count
_MDPS = math.degrees(1.0) * 1000  # mdps in one rad/s
_MG = 1000 / GRAVITY  # mg in one m/s^2
_BARO = 0.04  # seconds: the barometer makes 25 measurements a second
_REACTION = 0.02  # s; a robot of 2 m/s drives 4 cm meanwhile


class Part(Protocol):
    """Something that changes with time."""

    def step(self, dt: float) -> object:
        """Advance by `dt` seconds."""


class Plant:
    """The clock of the physics: steps its parts in order, every `dt` seconds of the loop's clock, in `async with`."""

    def __init__(self, parts: Iterable[Part] = (), *, dt: float = 0.001) -> None:
        self.parts = list(parts)
        self.dt = dt
        self.steps = 0
        """The number of steps so far."""
        self._ticker: Ticker | None = None

    async def __aenter__(self) -> Self:
        self._ticker = Ticker(asyncio.get_running_loop(), round(self.dt * SECOND), self._tick, background=True)
        self._ticker.start()
        return self

    async def __aexit__(self, *_exception: object) -> None:
        if self._ticker is not None:
            self._ticker.close()

    def step(self, count: int = 1) -> None:
        """Do `count` steps at once."""
        dt, parts = self.dt, self.parts
        for _ in range(count):
            for part in parts:
                part.step(dt)
        self.steps += count

    def _tick(self, _scheduled: int, _late: int, skipped: int) -> None:
        self.step(1 + min(skipped, round(_CATCH_UP / self.dt)))


class Board(r2p.Module):
    """A hardware module with its node functions by name; more can be started once it is open, as on any module."""

    def __init__(
        self,
        name: str,
        *,
        via: Via = None,
        remap: dict[str, str] | None = None,
        nodes: Mapping[str, NodeFunction] | None = None,
        bridge: bool | BridgeOptions = False,
    ) -> None:
        super().__init__(name, via=via, remap=remap, watchdog=False, bridge=bridge)
        self._programs = dict(nodes or {})

    async def __aenter__(self) -> Self:
        """Open the module and start its nodes. Raises as `r2p.Module` does."""
        await super().__aenter__()
        for name, function in self._programs.items():
            self.start(function, name=name)
        return self


class MotorConfig(msgspec.Struct, frozen=True, kw_only=True):
    """The configuration of the motor module, which firmware has in its flash memory."""

    setpoint: str = "setpoint"
    """Topic of the setpoints."""
    message: type[r2p.Message] = Setpoint
    """Their type."""
    ticks: Callable[[Any], float] = lambda message: message.ticks
    """Converts such a message to ticks or ticks/s."""
    timeout: float = 0.2
    """Seconds without a setpoint after which the motor stops."""
    encoder: str = "encoder"
    """Topic of the movement in ticks since the previous message."""
    period: float = 0.02
    """Period of `encoder`, time-triggered, s."""
    current: str = "current"
    """Topic of the motor's current in A."""
    current_period: float = 0.5
    """s."""


async def motor(node: r2p.Node, drive: Drive, config: MotorConfig) -> None:
    """Control the motor: the node of the DC motor controller module."""

    def command(message: r2p.Message) -> None:
        drive.setpoint = config.ticks(message)

    def moved() -> Encoder:
        return Encoder(delta=float(drive.take_ticks()))

    # Only the newest setpoint counts: a late one must not delay it.
    node.subscribe(
        config.setpoint, config.message, command, queue=1, lossy=True, timeout=config.timeout, on_timeout=drive.stop
    )
    node.advertise(config.encoder, Encoder, r2p.Periodic(config.period, moved))
    try:
        while True:
            await node.spin()
    finally:
        drive.stop()


async def monitor(node: r2p.Node, drive: Drive, config: MotorConfig) -> None:
    """Publish the motor's current."""
    current = node.advertise(config.current, Float32)
    async for _ in node.every(config.current_period):
        await current.publish(Float32(data=drive.motor.current))


class MotorModule(Board):
    """The DC motor controller module (thesis 7.3): subscribes `setpoint`, publishes `encoder` and `current`.

    `drive` is its hardware, which the caller steps in a `Plant`.
    """

    def __init__(
        self,
        name: str = "MOTOR1",
        *,
        drive: Drive,
        config: MotorConfig | None = None,
        via: Via = None,
        remap: dict[str, str] | None = None,
    ) -> None:
        config = config or MotorConfig()
        nodes = {
            "motor": functools.partial(motor, drive=drive, config=config),
            "monitor": functools.partial(monitor, drive=drive, config=config),
        }
        super().__init__(name, via=via, remap=remap, nodes=nodes)


class RangeArray:
    """Four sensors of the same kind, and their inputs of the A/D converter."""

    def __init__(self, distance_to: DistanceTo, noise: random.Random) -> None:
        self._distance_to = distance_to
        self._sensors = [RangeFinder(RangeSpec(), noise) for _ in range(4)]

    def read(self) -> Proximity:
        """Read all four, corrected, in mm."""
        one, two, three, four = (
            sensor.millimetres(sensor.read(self._distance_to(number))) for number, sensor in enumerate(self._sensors)
        )
        return Proximity(ranges=(one, two, three, four))


async def proximity(node: r2p.Node, sensors: RangeArray, topic: str, period: float) -> None:
    """Publish the distances: event-triggered, because an obstacle needs an immediate reaction."""
    ranges = node.advertise(topic, Proximity, r2p.Sporadic(deadline=_REACTION))
    async for _ in node.every(period):
        await ranges.publish(sensors.read())


class ProximityModule(Board):
    """The proximity module (thesis 7.5): four range finders, published in millimetres on `proximity`."""

    def __init__(
        self,
        name: str = "PROX1",
        *,
        sensors: RangeArray,
        topic: str = "proximity",
        period: float = 0.05,
        via: Via = None,
        remap: dict[str, str] | None = None,
    ) -> None:
        """`period` in seconds: the sensors need 40 ms for a measurement."""
        node = functools.partial(proximity, sensors=sensors, topic=topic, period=period)
        super().__init__(name, via=via, remap=remap, nodes={"prox": node})


class Motion(msgspec.Struct, frozen=True):
    """The true values that the sensors measure, in the frame of the module (x forward, y to the left, z up)."""

    force: Vector = (0.0, 0.0, GRAVITY)
    """Specific force (acceleration minus gravity), upwards at rest, m/s^2."""
    rates: Vector = (0.0, 0.0, 0.0)
    """rad/s."""
    field: Vector = (220.0, 0.0, -400.0)
    """Magnetic field, mgauss; by default x points north."""
    altitude: float = 120.0
    """m."""


class InertialUnit:
    """The inertial sensors, which return counts at their own rates, and the filter; it is a part of a `Plant`."""

    def __init__(self, motion: Callable[[], Motion], noise: random.Random) -> None:
        self.attitude = ComplementaryFilter()
        self._motion = motion
        self._acc = MemsSensor(ACCELEROMETER, noise)
        self._gyro = MemsSensor(GYROSCOPE, noise)
        self._mag = MemsSensor(MAGNETOMETER, noise)
        self._noise = noise

    def step(self, dt: float) -> None:
        """Advance by `dt` seconds; the filter advances at each sample of the gyroscope."""
        motion = self._motion()
        fx, fy, fz = motion.force
        gx, gy, gz = motion.rates
        self._acc.step((fx * _MG, fy * _MG, fz * _MG), dt)
        self._mag.step(motion.field, dt)
        if self._gyro.step((gx * _MDPS, gy * _MDPS, gz * _MDPS), dt) and self._mag.samples:
            self.attitude.step(self._rates(), self._acc.values, self._mag.values, 1 / GYROSCOPE.rate)

    def imu(self) -> IMU:
        """Return attitude and rates, filtered."""
        roll, pitch, yaw = self.attitude.angles
        x, y, z = (rate - bias for rate, bias in zip(self._rates(), self.attitude.bias, strict=True))
        return IMU(roll=roll, pitch=pitch, yaw=yaw, roll_rate=x, pitch_rate=y, yaw_rate=z)

    def raw(self) -> IMURaw9:
        """Return the counts of the sensors."""
        return IMURaw9(*self._acc.counts, *self._gyro.counts, *self._mag.counts)

    def tilt(self) -> Tilt:
        """Return the pitch, for a robot that balances on two wheels."""
        return Tilt(angle=self.attitude.angles[1])

    def pressure(self) -> Pressure:
        """Return the air pressure, and its altitude."""
        pressure = pressure_at(self._motion().altitude) + self._noise.gauss(0, BAROMETER_NOISE)
        return Pressure(pressure=pressure, altitude=altitude_at(pressure))

    def _rates(self) -> Vector:
        x, y, z = self._gyro.values
        return x / _MDPS, y / _MDPS, z / _MDPS


async def readings(
    node: r2p.Node, topic: str, type: type[r2p.Message], fill: Callable[[], r2p.Message], period: float
) -> None:
    """Publish readings, time-triggered."""
    node.advertise(topic, type, r2p.Periodic(period, fill))
    await asyncio.Event().wait()


class ImuModule(Board):
    """The inertial measurement unit (thesis 7.4): publishes `imu`, `imu_raw`, `tilt` and `pressure`.

    `unit` is its hardware, which the caller steps in a `Plant`.
    """

    def __init__(
        self,
        name: str = "IMU1",
        *,
        unit: InertialUnit,
        period: float = 0.01,
        topics: Iterable[str] = ("imu", "imu_raw", "tilt", "pressure"),
        via: Via = None,
        remap: dict[str, str] | None = None,
    ) -> None:
        """`period` in seconds, of all topics but `pressure`, which has 25 Hz; `topics`: those to publish."""
        streams: dict[str, tuple[type[r2p.Message], Callable[[], r2p.Message], float]] = {
            "imu": (IMU, unit.imu, period),
            "imu_raw": (IMURaw9, unit.raw, period),
            "tilt": (Tilt, unit.tilt, period),
            "pressure": (Pressure, unit.pressure, _BARO),
        }
        nodes: dict[str, NodeFunction] = {}
        for topic in topics:
            message, fill, each = streams[topic]
            nodes[topic] = functools.partial(readings, topic=topic, type=message, fill=fill, period=each)
        super().__init__(name, via=via, remap=remap, nodes=nodes)


class Pins:
    """The module's connectors: external hardware sets the inputs and reads the outputs."""

    def __init__(self) -> None:
        self.digital = [False] * 16
        """Inputs and outputs."""
        self.inputs = [0.0] * 8
        """Voltages at the analog inputs, V."""
        self._outputs = [0, 0]

    @property
    def outputs(self) -> tuple[float, float]:
        """Voltages at the analog outputs, V."""
        one, two = (counts * ADC_REFERENCE / ADC_MAX for counts in self._outputs)
        return one, two

    def read(self, channel: int) -> int:
        """Return the counts of the A/D converter, 12 bits for 3.3 V."""
        return adc_counts(self.inputs[channel])

    def write(self, channel: int, counts: int) -> None:
        """Set the counts of the D/A converter, 12 bits for 3.3 V."""
        self._outputs[channel] = max(0, min(ADC_MAX, counts))


async def leds(node: r2p.Node, pins: Pins) -> None:
    """Switch the digital outputs as commanded on `leds`."""

    def switch(led: Led) -> None:
        if led.led < len(pins.digital):
            pins.digital[led.led] = bool(led.value)

    node.subscribe("leds", Led, switch)
    while True:
        await node.spin()


async def sample(node: r2p.Node, pins: Pins, channel: int = 0, topic: str = "analog", period: float = 0.1) -> None:
    """Publish the voltage at an analog input every `period` seconds."""
    voltages = node.advertise(topic, Float32)
    async for _ in node.every(period):
        await voltages.publish(Float32(data=pins.read(channel) * ADC_REFERENCE / ADC_MAX))


class IoModule(Board):
    """The input/output module (thesis 7.6): 16 digital inputs and outputs, 8 analog inputs, 2 analog outputs.

    `nodes`: functions of `(node, pins)` by name; by default it has none.
    """

    def __init__(
        self,
        name: str = "IO1",
        *,
        pins: Pins,
        nodes: Mapping[str, Callable[..., Awaitable[object]]] | None = None,
        via: Via = None,
        remap: dict[str, str] | None = None,
    ) -> None:
        programs = {each: functools.partial(function, pins=pins) for each, function in (nodes or {}).items()}
        super().__init__(name, via=via, remap=remap, nodes=programs)


def measured(battery: LeadBattery) -> Battery:
    """Return the readings of the A/D converter, with a resolution of 9 mV and 12 mA; the charge is not calibrated."""
    return Battery(
        voltage=round(round(battery.voltage * 1000 / _VOLTAGE_COUNT) * _VOLTAGE_COUNT),
        current=max(-32768, min(32767, round(round(battery.current * 1000 / _CURRENT_COUNT) * _CURRENT_COUNT))),
        charge=255,
        remaining=65535,
    )


async def power(node: r2p.Node, battery: LeadBattery, topic: str, period: float) -> None:
    """Publish the measurements."""
    measurements = node.advertise(topic, Battery)
    async for _ in node.every(period):
        await measurements.publish(measured(battery))


class PowerModule(Board):
    """The power supply module (thesis 7.2): measures voltage and current of the battery, and publishes `battery`.

    The caller steps `battery` in a `Plant`.
    """

    def __init__(
        self,
        name: str = "PS",
        *,
        battery: LeadBattery,
        topic: str = "battery",
        period: float = 0.5,
        via: Via = None,
        remap: dict[str, str] | None = None,
    ) -> None:
        """`period` in seconds."""
        node = functools.partial(power, battery=battery, topic=topic, period=period)
        super().__init__(name, via=via, remap=remap, nodes={"power": node})


class GatewayModule(Board):
    """The gateway module (thesis 7.7): joins the robot's bus to computers by TCP, serial line or zenoh.

    `outside`: the links for computers; without any it is an ordinary module.
    """

    def __init__(
        self,
        name: str = "GW",
        *,
        via: str | Transport,
        outside: Iterable[str | Transport] = (),
        options: BridgeOptions | None = None,
    ) -> None:
        """`options`: rules for forwarding, by default everything but commands. Raises as `r2p.Module` does."""
        links = [via, *outside]
        super().__init__(name, via=links, bridge=False if len(links) == 1 else options or True)
