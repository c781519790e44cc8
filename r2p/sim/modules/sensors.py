"""The sensor modules of the thesis (7.4, 7.5), emulated: range finders and inertial measurement unit.

They are boards as those of `r2p.sim.modules.boards`.
"""

import asyncio
import functools
import math
import random
from collections.abc import Callable, Iterable, Sequence

import msgspec

import r2p
from r2p.msg import IMU, IMURaw9, Pressure, Proximity, TiltRate
from r2p.sim.modules.boards import Board, ParameterOptions, Via, paced, quantity, reopens
from r2p.sim.physics.inertial import (
    ACCELEROMETER,
    BAROMETER_NOISE,
    GRAVITY,
    GYROSCOPE,
    IDENTITY,
    MAGNETOMETER,
    AccelerometerRange,
    Calibration,
    ComplementaryFilter,
    GyroscopeRange,
    MagnetometerRange,
    MemsSensor,
    MemsSpec,
    Vector,
    altitude_at,
    pressure_at,
)
from r2p.sim.physics.ultrasonic import Sonar, SonarSpec, captured, speed_of_sound
from r2p.sim.physics.world import NOTHING, RangeCalibration, RangeFinder, RangeSpec

DistanceTo = Callable[[int], float]
"""A function that returns the distance in mm to the object before sensor 0 to 3, or infinity."""

_MDPS = math.degrees(1.0) * 1000  # mdps in one rad/s
_MG = 1000 / GRAVITY  # mg in one m/s^2
_BARO = 0.04  # seconds: the barometer makes 25 measurements a second
_REACTION = 0.02  # s; a robot of 2 m/s drives 4 cm meanwhile


class RangeArray:
    """Four sensors of the same kind, and their inputs of the A/D converter."""

    def __init__(
        self, distance_to: DistanceTo, noise: random.Random, specs: Sequence[RangeSpec] = (RangeSpec(),) * 4
    ) -> None:
        """`specs`: the curve that each of the sensors really has."""
        self.sensors = [RangeFinder(spec, noise) for spec in specs]
        self._distance_to = distance_to

    def read(self) -> Proximity:
        """Read all four, corrected, in mm."""
        one, two, three, four = (
            sensor.millimetres(sensor.read(self._distance_to(number))) for number, sensor in enumerate(self.sensors)
        )
        return Proximity(ranges=(one, two, three, four))


async def proximity(node: r2p.Node, sensors: RangeArray, topic: str, period: float) -> None:
    """Publish the distances: event-triggered, because an obstacle needs an immediate reaction."""
    calibrate(node, sensors)
    each = quantity(node, "period", period, (0.04, 0.25), "s", "Period of the measurements")
    ranges = node.advertise(topic, Proximity, r2p.Sporadic(deadline=_REACTION))
    async for _ in paced(node, each):
        await ranges.publish(sensors.read())


def calibrate(node: r2p.Node, sensors: RangeArray) -> None:
    """Let the parameters of a node calibrate the four sensors."""
    curve = RangeCalibration()

    def change(_value: object) -> None:
        for sensor, one, other in zip(sensors.sensors, scale.value, offset.value, strict=True):
            sensor.calibration = RangeCalibration(scale=one, offset=other, longest=longest.value)

    scale = node.parameter(
        "scale",
        (curve.scale,) * 4,
        min=1.0,
        max=10_000.0,
        unit="V mm",
        doc="For each sensor: its voltage is scale / (distance in mm + offset)",
        on_change=change,
    )
    offset = node.parameter(
        "offset",
        (curve.offset,) * 4,
        min=0.0,
        max=1000.0,
        unit="mm",
        doc="For each sensor: see scale",
        on_change=change,
    )
    doc = "Longest distance that the sensors measure: beyond it there is nothing"
    longest = quantity(node, "longest", curve.longest, (1.0, 10_000.0), "mm", doc, change)
    change(None)


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
        parameters: ParameterOptions | None = None,
    ) -> None:
        """`period` in seconds: the sensors need 40 ms for a measurement."""
        node = functools.partial(proximity, sensors=sensors, topic=topic, period=period)
        super().__init__(name, via=via, remap=remap, parameters=parameters, nodes={"prox": node})


class SonarArray:
    """Four ultrasonic range finders, and the inputs of the timer that captures their pulses."""

    def __init__(
        self,
        echo: Callable[[int, int], float],
        noise: random.Random,
        *,
        temperature: Callable[[], float] = lambda: 20.0,
        spec: SonarSpec | None = None,
    ) -> None:
        """`echo`: the distance (m) from which sensor `receiver` hears `source`; `temperature` of the air, Celsius."""
        self.sensors = [Sonar(spec or SonarSpec(), noise) for _ in range(4)]
        self.pulses = [captured(sensor.spec.silent) for sensor in self.sensors]
        """The last pulse of each sensor, microseconds."""
        self._echo = echo
        self._temperature = temperature

    def fire(self, numbers: Sequence[int]) -> None:
        """Let these sensors measure at the same time: each takes the first echo that it hears for its own."""
        for receiver in numbers:
            nearest = min(self._echo(source, receiver) for source in numbers)
            self.pulses[receiver] = captured(self.sensors[receiver].pulse(nearest, self._temperature()))

    def read(self, temperature: float) -> Proximity:
        """Return the last distances in mm, at the speed of sound at a temperature."""
        half = speed_of_sound(temperature) / 2 / 1000  # mm per microsecond
        one, two, three, four = (
            NOTHING if pulse >= captured(sensor.spec.silent) else round(pulse * half)
            for sensor, pulse in zip(self.sensors, self.pulses, strict=True)
        )
        return Proximity(ranges=(one, two, three, four))


async def sonar(node: r2p.Node, sensors: SonarArray, topic: str) -> None:
    """Fire the sensors in turn, or all at once, and publish the distances after each measurement."""
    each = quantity(node, "period", 0.05, (0.05, 1.0), "s", "Period of the measurements: an echo needs up to 37.5 ms")
    doc = "Of the air, for the speed of sound: 6 degrees are 1 % of the distance"
    temperature = quantity(node, "temperature", 20.0, (-40.0, 85.0), "degC", doc)
    doc = "Fire all sensors at once: four times as often, but each hears the others"
    together = node.parameter("together", False, doc=doc)
    ranges = node.advertise(topic, Proximity, r2p.Sporadic(deadline=_REACTION))
    number = 0
    async for _ in paced(node, each):
        sensors.fire(range(4) if together.value else (number,))
        number = (number + 1) % 4
        await ranges.publish(sensors.read(temperature.value))


class SonarModule(Board):
    """The proximity module (thesis 7.5) with four ultrasonic range finders, on `sonar` in millimetres."""

    def __init__(
        self,
        name: str = "PROX3",
        *,
        sensors: SonarArray,
        topic: str = "sonar",
        via: Via = None,
        remap: dict[str, str] | None = None,
        parameters: ParameterOptions | None = None,
    ) -> None:
        node = functools.partial(sonar, sensors=sensors, topic=topic)
        super().__init__(name, via=via, remap=remap, parameters=parameters, nodes={"sonar": node})


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

    def __init__(
        self,
        motion: Callable[[], Motion],
        noise: random.Random,
        *,
        accelerometer: MemsSpec = ACCELEROMETER,
        gyroscope: MemsSpec = GYROSCOPE,
        attitude: ComplementaryFilter | None = None,
    ) -> None:
        self.attitude = attitude or ComplementaryFilter()
        self._motion = motion
        self.accelerometer = MemsSensor(accelerometer, noise)
        self.gyroscope = MemsSensor(gyroscope, noise)
        self.magnetometer = MemsSensor(MAGNETOMETER, noise)
        self._noise = noise

    def step(self, dt: float) -> None:
        """Advance by `dt` seconds; the filter advances at each sample of the gyroscope."""
        motion = self._motion()
        fx, fy, fz = motion.force
        gx, gy, gz = motion.rates
        self.accelerometer.step((fx * _MG, fy * _MG, fz * _MG), dt)
        self.magnetometer.step(motion.field, dt)
        if self.gyroscope.step((gx * _MDPS, gy * _MDPS, gz * _MDPS), dt) and self.magnetometer.samples:
            self.attitude.step(self._rates(), self.accelerometer.values, self.magnetometer.values, 1 / GYROSCOPE.rate)

    def imu(self) -> IMU:
        """Return attitude and rates, filtered."""
        roll, pitch, yaw = self.attitude.angles
        x, y, z = (rate - bias for rate, bias in zip(self._rates(), self.attitude.bias, strict=True))
        return IMU(roll=roll, pitch=pitch, yaw=yaw, roll_rate=x, pitch_rate=y, yaw_rate=z)

    def raw(self) -> IMURaw9:
        """Return the counts of the sensors."""
        return IMURaw9(*self.accelerometer.counts, *self.gyroscope.counts, *self.magnetometer.counts)

    def tilt(self) -> TiltRate:
        """Return the pitch and its rate, for a robot that balances on two wheels."""
        return TiltRate(angle=self.attitude.angles[1], rate=self._rates()[1] - self.attitude.bias[1])

    def pressure(self) -> Pressure:
        """Return the air pressure, and its altitude."""
        pressure = pressure_at(self._motion().altitude) + self._noise.gauss(0, BAROMETER_NOISE)
        return Pressure(pressure=pressure, altitude=altitude_at(pressure))

    def _rates(self) -> Vector:
        x, y, z = self.gyroscope.values
        return x / _MDPS, y / _MDPS, z / _MDPS


async def readings(
    node: r2p.Node, topic: str, type: type[r2p.Message], fill: Callable[[], r2p.Message], period: float
) -> None:
    """Publish readings, time-triggered."""
    measure = reopens(lambda seconds: node.advertise(topic, type, r2p.Periodic(seconds, fill)))
    measure(quantity(node, "period", period, (0.0025, 10.0), "s", "Period of the readings", measure).value)
    await asyncio.Event().wait()


async def sensors(node: r2p.Node, unit: InertialUnit) -> None:
    """Configure the sensors and the filter."""

    def rescale(_value: object) -> None:
        unit.accelerometer.set_range(*acc.value.value)
        unit.gyroscope.set_range(*gyro.value.value)
        unit.magnetometer.set_range(*mag.value.value)

    def refilter(_value: float) -> None:
        unit.attitude.gain, unit.attitude.bias_gain = gain.value, bias_gain.value

    acc_range = AccelerometerRange(unit.accelerometer.range)
    gyro_range = GyroscopeRange(unit.gyroscope.range)
    mag_range = MagnetometerRange(unit.magnetometer.range)
    acc = node.parameter("acc_range", acc_range, doc="Range of the accelerometer", on_change=rescale)
    gyro = node.parameter("gyro_range", gyro_range, doc="Range of the gyroscope", on_change=rescale)
    mag = node.parameter("mag_range", mag_range, doc="Range of the magnetometer", on_change=rescale)
    doc = "How fast gravity and magnetic field correct the attitude"
    usual, usual_bias = unit.attitude.gains
    gain = quantity(node, "filter_gain", usual, (0.0, 100.0), "1/s", doc, refilter)
    doc = "How fast they correct the bias of the gyroscope"
    bias_gain = quantity(node, "filter_bias_gain", usual_bias, (0.0, 100.0), "1/s^2", doc, refilter)
    rescale(None)
    refilter(gain.value)
    calibrated(node, unit.accelerometer, "acc", "mg")
    calibrated(node, unit.gyroscope, "gyro", "mdps")
    calibrated(node, unit.magnetometer, "mag", "mgauss")
    await asyncio.Event().wait()


def calibrated(node: r2p.Node, sensor: MemsSensor, name: str, unit: str) -> None:
    """Let the parameters of a node correct the readings of a sensor."""

    def change(_value: object) -> None:
        sensor.calibration = Calibration(offset=offset.value, scale=scale.value)

    most = sensor.spec.full_scale
    doc = "What each axis reads at 0, which is subtracted"
    offset = node.parameter(f"{name}_offset", (0.0,) * 3, min=-most, max=most, unit=unit, doc=doc, on_change=change)
    doc = "Matrix, row by row, that the difference is multiplied by: scale and direction of the axes"
    scale = node.parameter(f"{name}_scale", IDENTITY, min=-2.0, max=2.0, doc=doc, on_change=change)
    change(None)


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
        parameters: ParameterOptions | None = None,
    ) -> None:
        """`period` in seconds, of all topics but `pressure`, which has 25 Hz; `topics`: those to publish."""
        streams: dict[str, tuple[type[r2p.Message], Callable[[], r2p.Message], float]] = {
            "imu": (IMU, unit.imu, period),
            "imu_raw": (IMURaw9, unit.raw, period),
            "tilt": (TiltRate, unit.tilt, period),
            "pressure": (Pressure, unit.pressure, _BARO),
        }
        nodes: dict[str, r2p.NodeFunction] = {"sensors": functools.partial(sensors, unit=unit)}
        for topic in topics:
            message, fill, each = streams[topic]
            nodes[topic] = functools.partial(readings, topic=topic, type=message, fill=fill, period=each)
        super().__init__(name, via=via, remap=remap, parameters=parameters, nodes=nodes)
