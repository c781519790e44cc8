"""MEMS sensors: what they make of the truth, in counts, at their own rate (thesis 7.4.1).

Each axis has a bias that it keeps, noise of the data sheet's density over the bandwidth of its rate, a resolution and a
full scale.
"""

import math
import random

import msgspec

Vector = tuple[float, float, float]
Counts = tuple[int, int, int]

GRAVITY = 9.80665
"""m/s^2."""


class MemsSpec(msgspec.Struct, frozen=True, kw_only=True):
    """Data sheet of a sensor of three axes; all values in one unit, which the constants below tell."""

    resolution: float
    """For each count."""
    full_scale: float
    rate: float
    """Samples each second, Hz."""
    density: float
    """Of its noise, for each root of Hz."""
    bias: float
    """One sigma from device to device."""

    @property
    def sigma(self) -> float:
        """Of the noise of one sample."""
        return self.density * math.sqrt(self.rate / 2)


ACCELEROMETER = MemsSpec(resolution=1.0, full_scale=2000.0, rate=400.0, density=0.22, bias=20.0)
"""LSM303DLHC, +-2 g, in mg."""
GYROSCOPE = MemsSpec(resolution=8.75, full_scale=250_000.0, rate=400.0, density=30.0, bias=500.0)
"""L3G4200D, 250 dps, in mdps."""
MAGNETOMETER = MemsSpec(resolution=0.9, full_scale=1300.0, rate=220.0, density=0.2, bias=5.0)
"""LSM303DLHC, +-1.3 gauss, in mgauss."""


class MemsSensor:
    """One device: it samples at its rate, and shows its last sample in between."""

    def __init__(self, spec: MemsSpec, noise: random.Random) -> None:
        self.spec = spec
        self.counts: Counts = (0, 0, 0)
        """Its last sample."""
        self.samples = 0
        """How many it has taken."""
        self._noise = noise
        self._bias = [noise.gauss(0, spec.bias) for _ in range(3)]
        self._elapsed = 0.0

    def step(self, truth: Vector, dt: float) -> bool:
        """Move on by `dt` seconds; says whether there is a new sample. `truth` is in the unit of the data sheet."""
        self._elapsed += dt * self.spec.rate
        if self._elapsed < 1.0 - 1e-9:
            return False
        self._elapsed -= 1.0
        x, y, z = (self._sample(value, bias) for value, bias in zip(truth, self._bias, strict=True))
        self.counts = (x, y, z)
        self.samples += 1
        return True

    @property
    def values(self) -> Vector:
        """Its last sample, in the unit of the data sheet."""
        x, y, z = self.counts
        return x * self.spec.resolution, y * self.spec.resolution, z * self.spec.resolution

    def _sample(self, value: float, bias: float) -> int:
        spec = self.spec
        reading = value + bias + self._noise.gauss(0, spec.sigma)
        return round(max(-spec.full_scale, min(spec.full_scale, reading)) / spec.resolution)


class Barometer:
    """LPS331AP: pressure with 2 Pa of noise, and what it means as an altitude."""

    def __init__(self, noise: random.Random) -> None:
        self._noise = noise

    def read(self, altitude: float) -> float:
        """Pressure (Pa) at this altitude (m) in the standard atmosphere."""
        return pressure_at(altitude) + self._noise.gauss(0, 2.0)


def pressure_at(altitude: float) -> float:
    """Pa in the standard atmosphere at so many m."""
    return 101_325.0 * math.pow(1 - altitude / 44_330.77, 5.255876)


def altitude_at(pressure: float) -> float:
    """m in the standard atmosphere at so many Pa."""
    return 44_330.77 * (1 - math.pow(pressure / 101_325.0, 1 / 5.255876))
