"""A flat world: walls, the range finders that measure it, and a body that drives on three omni wheels.

The range finder is of Sharp's GP2Y series; `millimetres` is the proximity module's conversion of its voltage.

The body has its kinematics (thesis 8.1.1) and its dynamics; its wheels are 120 degrees apart. `wheel_speeds` is
equation 8.2. Equation 8.1 of the thesis is its transpose, not its inverse: its rows for x and y need a factor 2/3, the
one for the rotation 1/3; `body_velocity` has them. As in listing 8.1, x is forward and y to the left.
"""

import math
import random
from collections.abc import Iterable, Iterator, Sequence

import msgspec

from r2p.sim.physics.motor import Motor

Point = tuple[float, float]
Wall = tuple[Point, Point]
Triple = tuple[float, float, float]

NOTHING = 65535
"""The reading in mm when nothing is in range."""
ADC_MAX = 4095
"""Counts of the modules' A/D converters, 12 bits."""
ADC_REFERENCE = 3.3
"""Return the voltage of that many counts, V."""

_COS30, _COS60 = math.cos(math.pi / 6), 0.5


def adc_counts(voltage: float) -> int:
    """Return the counts that an A/D converter reads; voltages beyond its range saturate."""
    return max(0, min(ADC_MAX, round(voltage / ADC_REFERENCE * ADC_MAX)))


class World:
    """Walls (coordinates in m) that stop rays, but not the robot."""

    def __init__(self, walls: Iterable[Wall] = ()) -> None:
        self.walls = list(walls)
        self.temperature = 20.0
        """Of the air, degrees Celsius."""

    def add_box(self, x: float, y: float, width: float, depth: float) -> None:
        """Add a box by its centre, and its sides `width` (along x) and `depth` (along y), m."""
        self.walls += box(x, y, width, depth)

    def distance(self, x: float, y: float, angle: float) -> float:
        """Return the distance (m) to the first wall on a ray at `angle` (rad from the x axis), or infinity."""
        dx, dy = math.cos(angle), math.sin(angle)
        return min(self._hits(x, y, dx, dy), default=math.inf)

    def _hits(self, x: float, y: float, dx: float, dy: float) -> Iterator[float]:
        for (ax, ay), (bx, by) in self.walls:
            ex, ey = bx - ax, by - ay
            across = dx * ey - dy * ex
            if not across:  # parallel
                continue
            far = ((ax - x) * ey - (ay - y) * ex) / across
            along = ((ax - x) * dy - (ay - y) * dx) / across
            if far >= 0 and 0 <= along <= 1:
                yield far


def box(x: float, y: float, width: float, depth: float) -> list[Wall]:
    """Return the four walls of a box."""
    left, right, low, high = x - width / 2, x + width / 2, y - depth / 2, y + depth / 2
    corners = [(left, low), (right, low), (right, high), (left, high)]
    return list(zip(corners, corners[1:] + corners[:1], strict=True))


class RangeSpec(msgspec.Struct, frozen=True, kw_only=True):
    """Data sheet. Default: about a GP2Y0A21, 100 to 800 mm."""

    shortest: float = 100.0
    """mm."""
    longest: float = 800.0
    """mm."""
    scale: float = 339.0
    """Scale of the curve `scale / (distance + offset)`, V mm."""
    offset: float = 47.0
    """mm."""
    noise: float = 3.0
    """Noise of the voltage, one sigma, mV."""

    def voltage(self, distance: float) -> float:
        """Return the output (V) at a distance (mm); below the shortest distance it falls to 0 again."""
        peak = self.scale / (self.shortest + self.offset)
        if distance < self.shortest:
            return peak * distance / self.shortest
        return self.scale / (distance + self.offset)


class RangeCalibration(msgspec.Struct, frozen=True, kw_only=True):
    """The curve `scale / (distance + offset)` that firmware assumes for a sensor. Default: the data sheet's."""

    scale: float = RangeSpec().scale
    """V mm."""
    offset: float = RangeSpec().offset
    """mm."""
    longest: float = RangeSpec().longest
    """Readings beyond it are NOTHING, mm."""


class RangeFinder:
    """One sensor, its input of the A/D converter, and its calibration."""

    def __init__(self, spec: RangeSpec, noise: random.Random) -> None:
        self.spec = spec
        """The curve that this sensor really has; two of a kind differ by some percent."""
        self.calibration = RangeCalibration()
        """The curve that firmware converts its readings with."""
        self._noise = noise

    def read(self, distance: float) -> int:
        """Return the counts of the A/D converter for an object at a distance (mm, or infinity)."""
        voltage = self.spec.voltage(distance) + self._noise.gauss(0, self.spec.noise * 1e-3)
        return adc_counts(voltage)

    def millimetres(self, counts: int) -> int:
        """Return the distance (mm) that firmware computes from counts; NOTHING beyond the longest range."""
        voltage = counts * ADC_REFERENCE / ADC_MAX
        curve = self.calibration
        if voltage <= curve.scale / (curve.longest + curve.offset):
            return NOTHING
        return max(0, round(curve.scale / voltage - curve.offset))


class OmniSpec(msgspec.Struct, frozen=True, kw_only=True):
    """Data sheet of the body. Default: Triskar2, about 20 kg and 2 m/s (thesis 8.1.1)."""

    wheel_radius: float = 0.05
    """m."""
    arm: float = 0.20
    """From the centre to each wheel, m."""
    radius: float = 0.22
    """Radius of the outline, m."""
    mass: float = 20.0
    """kg."""
    inertia: float = 0.4
    """About the vertical axis, kg m^2."""
    wear: float = 0.2
    """Spread of the wheels' radii, one sigma, %."""

    def wheel_speeds(self, x: float, y: float, w: float) -> Triple:
        """Return the speeds of the wheels (rad/s) for a velocity of the body (m/s, m/s, rad/s): equation 8.2."""
        turn = self.arm * w
        ahead, aside = _COS60 * x, _COS30 * y
        radius = self.wheel_radius
        return (ahead - aside - turn) / radius, (ahead + aside - turn) / radius, (-x - turn) / radius

    def body_velocity(self, one: float, two: float, three: float) -> Triple:
        """Return the velocity of the body for these speeds of the wheels: equation 8.1 with the missing factors."""
        radius = self.wheel_radius
        return (
            2 / 3 * radius * (_COS60 * (one + two) - three),
            2 / 3 * radius * _COS30 * (two - one),
            -1 / 3 * radius / self.arm * (one + two + three),
        )


class OmniBody:
    """The body, driven by the torques of three motors, which are coupled through it.

    In the coordinates of wheel speeds, the mass matrix is `own` on the diagonal plus `shared` everywhere, which has a
    closed inverse. Wheels do not slip, but their radii differ a little: that is why odometry drifts.
    """

    def __init__(self, spec: OmniSpec, motors: Sequence[Motor], noise: random.Random) -> None:
        self.spec = spec
        self.motors = tuple(motors)
        self.x = self.y = self.w = 0.0
        """Pose without errors: m, m, rad (not wrapped)."""
        self.velocity: Triple = (0.0, 0.0, 0.0)
        """Velocity without errors, in the robot's frame."""
        self.acceleration: Triple = (0.0, 0.0, 0.0)
        """Of the centre, as its inertia feels it, in the robot's frame: m/s^2, m/s^2, rad/s^2."""
        self.path = 0.0
        """Length of the path so far, m."""
        self._wear = [noise.gauss(1.0, spec.wear / 100) for _ in range(3)]
        square = spec.wheel_radius**2
        self.own = self.motors[0].spec.inertia + 2 / 3 * spec.mass * square
        """Inertia at each wheel, kg m^2."""
        self.shared = spec.inertia * square / (9 * spec.arm**2) - 2 / 9 * spec.mass * square
        """Inertia that couples two wheels, kg m^2."""

    def step(self, dt: float) -> None:
        """Advance by `dt` seconds."""
        torques = [motor.torque() for motor in self.motors]
        common = self.shared / (self.own + 3 * self.shared) * sum(torques)
        before = [motor.speed for motor in self.motors]
        for motor, torque in zip(self.motors, torques, strict=True):
            motor.turn(motor.speed + (torque - common) / self.own * dt, dt)
        rolled = [
            (old + motor.speed) / 2 * wear for old, motor, wear in zip(before, self.motors, self._wear, strict=True)
        ]
        self._move(self.spec.body_velocity(*rolled), dt)

    def _move(self, velocity: Triple, dt: float) -> None:
        x, y, w = velocity
        before, self.velocity = self.velocity, velocity
        turn = (before[2] + w) / 2  # the frame turns, too: on a circle, what points to its centre does not change
        self.acceleration = (
            (x - before[0]) / dt - turn * (before[1] + y) / 2,
            (y - before[1]) / dt + turn * (before[0] + x) / 2,
            (w - before[2]) / dt,
        )
        heading = self.w + w * dt / 2
        cos, sin = math.cos(heading), math.sin(heading)
        self.x += (x * cos - y * sin) * dt
        self.y += (x * sin + y * cos) * dt
        self.w += w * dt
        self.path += math.hypot(x, y) * dt
