"""A body on two driven wheels, with a caster that carries the rest: its kinematics and its dynamics.

x is forward, y to the left, and the body turns about the middle of the axle. Its centre of mass is `behind` that point.
With the force F and the moment M of the wheels at the ground (d: `behind`):

    mass (v' + d w^2) = F          (inertia + mass d^2) w' - mass d v w = M

The two terms with both velocities take no energy: one gets what the other gives. Because of them a body that drives
with its centre of mass behind the axle would turn ever faster, if its motors did not hold the wheels.
"""

import math
import random
from collections.abc import Sequence

import msgspec

from r2p.sim.physics.motor import Motor
from r2p.sim.physics.world import Triple

Pair = tuple[float, float]


class DifferentialSpec(msgspec.Struct, frozen=True, kw_only=True):
    """Data sheet of the body. Default: Robocom, with wheels of 24 cm (thesis 8.2.1); all others are assumptions."""

    wheel_radius: float = 0.12
    """m."""
    track: float = 0.50
    """Distance of the wheels, m."""
    mass: float = 60.0
    """With batteries and computer, without a payload of up to 80 kg, kg."""
    inertia: float = 3.0
    """About the vertical axis through the centre of mass, kg m^2."""
    behind: float = 0.10
    """From the axle back to the centre of mass, m."""
    wheel_inertia: float = 0.01
    """Of one wheel with its belt, kg m^2."""
    wear: float = 0.3
    """Spread of the wheels' radii, one sigma, %."""

    def wheel_speeds(self, x: float, w: float) -> Pair:
        """Return the speeds of the left and the right wheel (rad/s) for a velocity of the body (m/s, rad/s)."""
        turn = self.track / 2 * w
        return (x - turn) / self.wheel_radius, (x + turn) / self.wheel_radius

    def body_velocity(self, left: float, right: float) -> Triple:
        """Return the velocity of the body (m/s, m/s, rad/s) for these speeds of the wheels (rad/s)."""
        radius = self.wheel_radius
        return radius * (left + right) / 2, 0.0, radius * (right - left) / self.track


class DifferentialBody:
    """The body, driven by the torques of two motors, left and right.

    Wheels do not slip, but their radii differ a little: that is why odometry drifts.
    """

    def __init__(self, spec: DifferentialSpec, motors: Sequence[Motor], noise: random.Random) -> None:
        self.spec = spec
        self.motors = left, right = tuple(motors)
        self.x = self.y = self.w = 0.0
        """Pose of the middle of the axle, without errors: m, m, rad (not wrapped)."""
        self.velocity: Pair = (0.0, 0.0)
        """Velocity without errors: forward (m/s), and the rate of turn (rad/s)."""
        self.acceleration: Pair = (0.0, 0.0)
        """Of the middle of the axle, in the robot's frame (forward, to the left), m/s^2."""
        self.path = 0.0
        """Length of the path so far, m."""
        self.radii: Pair = (self._worn(noise), self._worn(noise))
        """Those that the wheels really have, m."""
        assert left.spec == right.spec, "two different motors"
        own = left.spec.inertia + spec.wheel_inertia
        around = spec.inertia + spec.mass * spec.behind**2
        self.ahead = own + spec.mass * spec.wheel_radius**2 / 2
        """Inertia at each wheel while both turn alike, kg m^2."""
        self.turning = own + 2 * around * (spec.wheel_radius / spec.track) ** 2
        """... and while they turn against each other."""
        self._coupling = spec.mass * spec.behind * spec.wheel_radius

    def step(self, dt: float) -> None:
        """Advance by `dt` seconds."""
        left, right = self.motors
        v, _, w = self.spec.body_velocity(left.speed, right.speed)
        one, other = left.torque(), right.torque()
        both = (one + other - self._coupling * w * w) / self.ahead
        against = (other - one + self._coupling * v * w * 2 / self.spec.track) / self.turning
        rolled = left.speed, right.speed
        left.turn(left.speed + (both - against) / 2 * dt, dt)
        right.turn(right.speed + (both + against) / 2 * dt, dt)
        self._move((rolled[0] + left.speed) / 2, (rolled[1] + right.speed) / 2, dt)

    def _move(self, left: float, right: float, dt: float) -> None:
        """Roll for `dt` seconds, the wheels at these speeds."""
        before = self.velocity[0]
        one, other = self.radii
        v, w = self.velocity = (left * one + right * other) / 2, (right * other - left * one) / self.spec.track
        self.acceleration = (v - before) / dt, v * w
        heading = self.w + w * dt / 2
        self.x += v * math.cos(heading) * dt
        self.y += v * math.sin(heading) * dt
        self.w += w * dt
        self.path += abs(v) * dt

    def _worn(self, noise: random.Random) -> float:
        return self.spec.wheel_radius * noise.gauss(1.0, self.spec.wear / 100)
