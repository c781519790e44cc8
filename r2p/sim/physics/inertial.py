"""Inertial sensors, and the attitude that a filter computes from them (thesis 7.4).

A MEMS sensor turns true values into counts at its own rate. Each axis has a constant bias, noise with the density of
the data sheet over the bandwidth of its rate, a resolution and a full scale. The filter is a non-linear complementary
filter (Mahony, Hamel and Pflimlin 2008).
"""

import enum
import math
import random

import msgspec

Vector = tuple[float, float, float]
Counts = tuple[int, int, int]
Matrix = tuple[float, float, float, float, float, float, float, float, float]
Quaternion = tuple[float, float, float, float]

GRAVITY = 9.80665
"""m/s^2."""
IDENTITY: Matrix = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
"""A matrix, row by row, that changes nothing."""


class MemsSpec(msgspec.Struct, frozen=True, kw_only=True):
    """Data sheet of a sensor with three axes; all values in one unit, see the constants below."""

    resolution: float
    """Per count."""
    full_scale: float
    rate: float
    """Samples per second, Hz."""
    density: float
    """Noise density, per root of Hz."""
    bias: float
    """One sigma from device to device."""
    scale: float = 0.0
    """Error of the scale of each axis, one sigma from device to device; 0.01 is 1 %."""
    misalignment: float = 0.0
    """Angle between where each axis should point and where it points, one sigma, rad: soldering, and the chip."""

    @property
    def sigma(self) -> float:
        """The noise of one sample, one sigma."""
        return self.density * math.sqrt(self.rate / 2)


ACCELEROMETER = MemsSpec(resolution=1.0, full_scale=2000.0, rate=400.0, density=0.22, bias=20.0)
"""LSM303DLHC, +-2 g, in mg."""
GYROSCOPE = MemsSpec(resolution=8.75, full_scale=250_000.0, rate=400.0, density=30.0, bias=500.0)
"""L3G4200D, 250 dps, in mdps."""
MAGNETOMETER = MemsSpec(resolution=0.9, full_scale=1300.0, rate=220.0, density=0.2, bias=5.0)
"""LSM303DLHC, +-1.3 gauss, in mgauss."""
AccelerometerRange = enum.Enum(
    "AccelerometerRange", {"2g": (2000.0, 1.0), "4g": (4000.0, 2.0), "8g": (8000.0, 4.0), "16g": (16_000.0, 12.0)}
)
"""The ranges of the LSM303DLHC: full scale and resolution, mg."""
GyroscopeRange = enum.Enum(
    "GyroscopeRange", {"250dps": (250_000.0, 8.75), "500dps": (500_000.0, 17.5), "2000dps": (2_000_000.0, 70.0)}
)
"""Those of the L3G4200D, mdps."""
MagnetometerRange = enum.Enum(
    "MagnetometerRange",
    {"1.3gauss": (1300.0, 0.9), "2.5gauss": (2500.0, 1.49), "4gauss": (4000.0, 2.22), "8.1gauss": (8100.0, 4.35)},
)
"""Some of those of the LSM303DLHC, mgauss."""
FILTER_GAIN, FILTER_BIAS_GAIN = 1.0, 0.2
"""Of the attitude filter, 1/s and 1/s^2."""
BAROMETER_NOISE = 2.0
"""LPS331AP, one sigma, Pa."""


class Calibration(msgspec.Struct, frozen=True, kw_only=True):
    """How firmware corrects three axes: `scale`, a matrix row by row, times (the reading - `offset`)."""

    offset: Vector = (0.0, 0.0, 0.0)
    """In the unit of the data sheet."""
    scale: Matrix = IDENTITY

    def correct(self, values: Vector) -> Vector:
        """Return corrected values."""
        if self.scale is IDENTITY and not any(self.offset):
            return values
        x, y, z = values[0] - self.offset[0], values[1] - self.offset[1], values[2] - self.offset[2]
        return _times(self.scale, (x, y, z))


class MemsSensor:
    """One device: it samples at its rate, and holds the last sample in between."""

    def __init__(self, spec: MemsSpec, noise: random.Random) -> None:
        self.spec = spec
        self.range = spec.full_scale, spec.resolution
        """The range that it was made with."""
        self.counts: Counts = (0, 0, 0)
        """The last sample, in counts."""
        self.samples = 0
        """The number of samples so far."""
        self._resolution = spec.resolution  # of the last sample
        self._noise = noise
        self.calibration = Calibration()
        """How `values` are corrected; the counts are not."""
        self.bias = [noise.gauss(0, spec.bias) for _ in range(3)]
        """The reading at 0 that this device really has, in the unit of the data sheet."""
        self.distortion = _distortion(spec, noise)
        """What this device multiplies the truth by; None: nothing."""
        self._elapsed = 0.0

    def set_range(self, full_scale: float, resolution: float) -> None:
        """Choose another full scale and its resolution, in the unit of the data sheet, from the next sample on."""
        self.spec = msgspec.structs.replace(self.spec, full_scale=full_scale, resolution=resolution)

    def step(self, truth: Vector, dt: float) -> bool:
        """Advance by `dt` seconds; return whether there is a new sample. `truth` is in the unit of the data sheet."""
        self._elapsed += dt * self.spec.rate
        if self._elapsed < 1.0 - 1e-9:
            return False
        self._elapsed -= 1.0
        self._resolution = self.spec.resolution
        if self.distortion is not None:
            truth = _times(self.distortion, truth)
        x, y, z = (self._sample(value, bias) for value, bias in zip(truth, self.bias, strict=True))
        self.counts = (x, y, z)
        self.samples += 1
        return True

    @property
    def values(self) -> Vector:
        """The last sample, corrected, in the unit of the data sheet."""
        x, y, z = self.counts
        return self.calibration.correct((x * self._resolution, y * self._resolution, z * self._resolution))

    def _sample(self, value: float, bias: float) -> int:
        spec = self.spec
        reading = value + bias + self._noise.gauss(0, spec.sigma)
        return round(max(-spec.full_scale, min(spec.full_scale, reading)) / spec.resolution)


def _distortion(spec: MemsSpec, noise: random.Random) -> Matrix | None:
    """Return the errors of a device's scale and axes; without any, no random number is drawn."""
    if not spec.scale and not spec.misalignment:
        return None
    a, b, c, d, e, f, g, h, i = (
        noise.gauss(1.0, spec.scale) if index % 4 == 0 else noise.gauss(0.0, spec.misalignment) for index in range(9)
    )
    return a, b, c, d, e, f, g, h, i


def _times(m: Matrix, v: Vector) -> Vector:
    x, y, z = v
    return m[0] * x + m[1] * y + m[2] * z, m[3] * x + m[4] * y + m[5] * z, m[6] * x + m[7] * y + m[8] * z


def pressure_at(altitude: float) -> float:
    """Return the pressure (Pa) of the standard atmosphere at an altitude (m)."""
    return 101_325.0 * math.pow(1 - altitude / 44_330.77, 5.255876)


def altitude_at(pressure: float) -> float:
    """Return the altitude (m) of a pressure (Pa) in the standard atmosphere."""
    return 44_330.77 * (1 - math.pow(pressure / 101_325.0, 1 / 5.255876))


class ComplementaryFilter:
    """The attitude filter; `quaternion` rotates vectors of the body into the world (x north, y west, z up)."""

    def __init__(self, *, gain: float = FILTER_GAIN, bias_gain: float = FILTER_BIAS_GAIN) -> None:
        self.quaternion: Quaternion = (1.0, 0.0, 0.0, 0.0)
        self.bias: Vector = (0.0, 0.0, 0.0)
        """Bias of the gyroscope, rad/s."""
        self.gains = gain, bias_gain
        """Those that it was made with."""
        self.gain = gain
        """How fast gravity and field win, 1/s."""
        self.bias_gain = bias_gain
        """How fast the bias is learnt, 1/s^2."""

    def step(self, gyro: Vector, acc: Vector, mag: Vector, dt: float) -> None:
        """Advance by `dt` seconds. `gyro` in rad/s; `acc` (up, at rest) and `mag` in any unit."""
        errors = self._correction(_unit(acc), _unit(mag))
        x, y, z = (bias - self.bias_gain * error * dt for bias, error in zip(self.bias, errors, strict=True))
        self.bias = (x, y, z)
        rates = [rate - bias + self.gain * error for rate, bias, error in zip(gyro, self.bias, errors, strict=True)]
        self.quaternion = _turned(self.quaternion, (rates[0], rates[1], rates[2]), dt)

    @property
    def angles(self) -> Vector:
        """Roll, pitch and yaw, rad."""
        w, x, y, z = self.quaternion
        roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
        return roll, pitch, math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))

    def _correction(self, up: Vector, field: Vector) -> Vector:
        """Return the rotation (rad, in the body) from the expected directions to the measured ones."""
        ex, ey, ez = _cross(up, to_body(self.quaternion, (0.0, 0.0, 1.0)))
        x, y, _ = to_world(self.quaternion, field)
        heading = -math.atan2(y, x)  # only the field's horizontal part counts: roll and pitch are gravity's
        hx, hy, hz = to_body(self.quaternion, (0.0, 0.0, heading))
        return ex + hx, ey + hy, ez + hz


def to_world(q: Quaternion, v: Vector) -> Vector:
    """Rotate a vector from the body's frame into the world's."""
    w, x, y, z = q
    tx, ty, tz = 2 * (y * v[2] - z * v[1]), 2 * (z * v[0] - x * v[2]), 2 * (x * v[1] - y * v[0])
    return v[0] + w * tx + y * tz - z * ty, v[1] + w * ty + z * tx - x * tz, v[2] + w * tz + x * ty - y * tx


def to_body(q: Quaternion, v: Vector) -> Vector:
    """Rotate a vector from the world's frame into the body's."""
    w, x, y, z = q
    return to_world((w, -x, -y, -z), v)


def _turned(q: Quaternion, rates: Vector, dt: float) -> Quaternion:
    w, x, y, z = q
    a, b, c = (rate * dt / 2 for rate in rates)
    turned = (
        w - a * x - b * y - c * z,
        x + a * w + c * y - b * z,
        y + b * w - c * x + a * z,
        z + c * w + b * x - a * y,
    )
    length = math.sqrt(sum(part * part for part in turned))
    w, x, y, z = (part / length for part in turned)
    return w, x, y, z


def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _unit(v: Vector) -> Vector:
    length = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]) or 1.0
    return v[0] / length, v[1] / length, v[2] / length
