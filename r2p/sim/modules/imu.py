"""The inertial measurement unit (thesis 7.4): publishes `imu`, `imu_raw`, `tilt` and `pressure`.

The sensors return counts at their own rates; a complementary filter computes roll, pitch, yaw and their rates.
"""

import asyncio
import functools
import math
import random
from collections.abc import Callable, Iterable

import msgspec

import r2p
from r2p.modules.supervisor import NodeFunction
from r2p.msg import IMU, IMURaw9, Pressure, Tilt
from r2p.sim.modules.boards import Board, Via
from r2p.sim.physics.inertial import (
    ACCELEROMETER,
    GRAVITY,
    GYROSCOPE,
    MAGNETOMETER,
    Barometer,
    ComplementaryFilter,
    MemsSensor,
    Vector,
    altitude_at,
)

_MDPS = math.degrees(1.0) * 1000  # mdps in one rad/s
_MG = 1000 / GRAVITY  # mg in one m/s^2
_BARO = 0.04  # seconds: the barometer makes 25 measurements a second


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
    """The sensors and the filter; it is a part of a `Plant`."""

    def __init__(self, motion: Callable[[], Motion], noise: random.Random) -> None:
        self.attitude = ComplementaryFilter()
        self._motion = motion
        self._acc = MemsSensor(ACCELEROMETER, noise)
        self._gyro = MemsSensor(GYROSCOPE, noise)
        self._mag = MemsSensor(MAGNETOMETER, noise)
        self._barometer = Barometer(noise)

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
        """Return the pitch: what a robot that balances on two wheels needs."""
        return Tilt(angle=self.attitude.angles[1])

    def pressure(self) -> Pressure:
        """Return the air pressure, and its altitude."""
        pressure = self._barometer.read(self._motion().altitude)
        return Pressure(pressure=pressure, altitude=altitude_at(pressure))

    def _rates(self) -> Vector:
        x, y, z = self._gyro.values
        return x / _MDPS, y / _MDPS, z / _MDPS


async def publish(
    node: r2p.Node, topic: str, type: type[r2p.Message], fill: Callable[[], r2p.Message], period: float
) -> None:
    """Publish readings, time-triggered."""
    node.advertise(topic, type, r2p.Periodic(period, fill))
    await asyncio.Event().wait()


class ImuModule(Board):
    """The inertial measurement unit. `unit` is its hardware, which the caller steps in a `Plant`."""

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
        self.unit = unit
        streams: dict[str, tuple[type[r2p.Message], Callable[[], r2p.Message], float]] = {
            "imu": (IMU, unit.imu, period),
            "imu_raw": (IMURaw9, unit.raw, period),
            "tilt": (Tilt, unit.tilt, period),
            "pressure": (Pressure, unit.pressure, _BARO),
        }
        nodes = {topic: _stream(topic, *streams[topic]) for topic in topics}
        super().__init__(name, via=via, remap=remap, nodes=nodes)


def _stream(topic: str, type: type[r2p.Message], fill: Callable[[], r2p.Message], period: float) -> NodeFunction:
    return functools.partial(publish, topic=topic, type=type, fill=fill, period=period)
