"""Legs with three joints each, and a body that they carry: kinematics, joints with motors, and what the feet do.

A leg's hip turns it about the vertical, its shoulder and its knee lift the foot. Angles are in rad from the home
posture, in which the robot stands; the frame is the body's: x forward, y to the left, z up.

Simplified: the body is level, at the height of its lowest feet, and has no inertia. It moves as those feet say
that stand on the ground: their mean motion, without slip if they agree. Each of them carries the same share of the
weight; if the legs are too weak or have no power, the body lies on its belly and rests. The thesis has no such robot:
all its figures are assumed.
"""

import math
from collections.abc import Sequence

import msgspec

from r2p.sim.physics.inertial import GRAVITY
from r2p.sim.physics.motor import Motor, MotorSpec
from r2p.sim.physics.world import Triple

JOINT_MOTOR = MotorSpec(
    resistance=3.0,
    torque_constant=25.0,
    rotor_inertia=33.0,
    gear=100.0,
    ticks_per_turn=400,
    friction=20.0,
    damping=50.0,
    current_limit=6.0,
)
"""A geared motor of a joint: 2.5 Nm/A."""


class LegSpec(msgspec.Struct, frozen=True, kw_only=True):
    """The legs, all alike, and the body."""

    links: Triple = (0.05, 0.10, 0.15)
    """From hip to shoulder, to knee, to foot, m."""
    reach: float = 0.16
    """Of the foot from the hip at home, m."""
    height: float = 0.10
    """Of the body above the feet at home, m."""
    link_inertia: float = 0.01
    """At each joint, without the rotor's, kg m^2."""
    mass: float = 8.0
    """Of all that the feet carry, kg."""
    leg_mass: float = 0.2
    """Of it in each leg, taken to be at the foot, kg."""
    belly: float = 0.03
    """Of the body above the ground when it lies there, m."""
    touching: float = 0.002
    """A foot stands on the ground if it is so many m above the lowest one, at most."""
    hips: tuple[Triple, ...] = (
        (0.15, 0.08, 0.25 * math.pi),
        (0.0, 0.10, 0.5 * math.pi),
        (-0.15, 0.08, 0.75 * math.pi),
        (0.15, -0.08, -0.25 * math.pi),
        (0.0, -0.10, -0.5 * math.pi),
        (-0.15, -0.08, -0.75 * math.pi),
    )
    """Where the legs are, m and m, and where they point at home, rad: left front, middle, rear; right."""

    @property
    def home(self) -> Triple:
        """The angles of hip, shoulder and knee at home, from a leg that is stretched out and level."""
        return self._reached(0.0, self.reach, -self.height)

    def foot(self, angles: Sequence[float]) -> tuple[float, float, float]:
        """Return where the foot is: angle about the hip, distance from it, and height above it."""
        hip, shoulder, knee = angles
        _, home_shoulder, home_knee = self.home
        return hip, *self._extended(home_shoulder + shoulder, home_knee + knee)

    def angles(self, turn: float, reach: float, z: float) -> Triple:
        """Return the angles for a foot there, or as near as it can be: the inverse of `foot`."""
        hip, shoulder, knee = self._reached(turn, reach, z)
        _, home_shoulder, home_knee = self.home
        return hip, shoulder - home_shoulder, knee - home_knee

    def on_body(self, leg: int, foot: Sequence[float]) -> Triple:
        """Return the position of a foot in the frame of the body, m."""
        x, y, ahead = self.hips[leg]
        turn, reach, z = foot
        return x + reach * math.cos(ahead + turn), y + reach * math.sin(ahead + turn), z

    def from_body(self, leg: int, x: float, y: float, z: float) -> Triple:
        """Return the angles that put the foot of a leg there, in the frame of the body."""
        at_x, at_y, ahead = self.hips[leg]
        turn = math.atan2(y - at_y, x - at_x) - ahead
        return self.angles(math.remainder(turn, 2 * math.pi), math.hypot(x - at_x, y - at_y), z)

    def _extended(self, shoulder: float, knee: float) -> tuple[float, float]:
        hip_link, thigh, shin = self.links
        reach = hip_link + thigh * math.cos(shoulder) + shin * math.cos(shoulder + knee)
        return reach, thigh * math.sin(shoulder) + shin * math.sin(shoulder + knee)

    def _reached(self, turn: float, reach: float, z: float) -> Triple:
        """Return the angles of a leg from where it is stretched out; the knee is above."""
        hip_link, thigh, shin = self.links
        out = reach - hip_link
        cosine = (out * out + z * z - thigh * thigh - shin * shin) / (2 * thigh * shin)
        knee = -math.acos(max(-1.0, min(1.0, cosine)))
        return turn, math.atan2(z, out) - math.atan2(shin * math.sin(knee), thigh + shin * math.cos(knee)), knee


class Joint:
    """A motor that turns a link, and the torque on it from outside."""

    def __init__(self, motor: Motor, link_inertia: float) -> None:
        self.motor = motor
        self.inertia = link_inertia + motor.spec.inertia
        """Rotor included, kg m^2."""
        self.load = 0.0
        """The torque from outside, Nm."""

    def step(self, dt: float) -> None:
        """Advance by `dt` seconds, which must be short against the motor's time constant."""
        motor = self.motor
        motor.turn(motor.speed + (motor.torque() + self.load) / self.inertia * dt, dt)


class Legs:
    """The legs and the body on them; `joints` of each leg in order: hip, shoulder, knee."""

    def __init__(self, spec: LegSpec, joints: Sequence[Joint]) -> None:
        self.spec = spec
        self.joints = list(joints)
        self.x = self.y = self.w = 0.0
        """The pose of the body: m and rad."""
        self.path = 0.0
        """Length of the way of the body's middle, m."""
        self.standing = [False] * len(spec.hips)
        """The feet that are on the ground."""
        _, self._shoulder, self._knee = spec.home
        self._feet = self._positions()

    @property
    def feet(self) -> list[Triple]:
        """The positions of the feet in the frame of the body, m."""
        return self._feet

    @property
    def height(self) -> float:
        """Of the body above the ground, m."""
        return max(self.spec.belly, -min(foot[2] for foot in self._feet))

    @property
    def lies(self) -> bool:
        """Whether the body lies on its belly."""
        return self.height <= self.spec.belly

    def step(self, dt: float) -> None:
        """Load the joints, turn them, and move the body by the feet that stand."""
        self._load()
        for joint in self.joints:
            joint.step(dt)
        before, self._feet = self._feet, self._positions()
        ground = min(foot[2] for foot in self._feet) + self.spec.touching
        self.standing = [foot[2] <= ground and not self.lies for foot in self._feet]
        pairs = zip(before, self._feet, self.standing, strict=True)
        x, y, w = moved([(old, new) for old, new, stands in pairs if stands])
        heading = self.w + w / 2
        self.x += x * math.cos(heading) - y * math.sin(heading)
        self.y += x * math.sin(heading) + y * math.cos(heading)
        self.w += w
        self.path += math.hypot(x, y)

    def _load(self) -> None:
        """Let each foot on the ground carry its share of the weight, and each leg its own."""
        spec, (hip_link, thigh, _) = self.spec, self.spec.links
        share = spec.mass * GRAVITY / max(1, sum(self.standing))
        for leg, stands in enumerate(self.standing):
            force = (share if stands else 0.0) - spec.leg_mass * GRAVITY
            _, shoulder, knee = self.joints[3 * leg : 3 * leg + 3]
            x, y, _ = spec.hips[leg]
            foot = self._feet[leg]
            out = math.hypot(foot[0] - x, foot[1] - y) - hip_link
            shoulder.load = force * out
            knee.load = force * (out - thigh * math.cos(self._shoulder + shoulder.motor.angle))

    def _positions(self) -> list[Triple]:
        spec, joints = self.spec, self.joints
        home_shoulder, home_knee, (hip_link, thigh, shin) = self._shoulder, self._knee, spec.links
        feet = []
        for leg, (x, y, ahead) in enumerate(spec.hips):
            turn = ahead + joints[3 * leg].motor.angle
            shoulder = home_shoulder + joints[3 * leg + 1].motor.angle
            bent = shoulder + home_knee + joints[3 * leg + 2].motor.angle
            reach = hip_link + thigh * math.cos(shoulder) + shin * math.cos(bent)
            height = thigh * math.sin(shoulder) + shin * math.sin(bent)
            feet.append((x + reach * math.cos(turn), y + reach * math.sin(turn), height))
        return feet


def moved(feet: Sequence[tuple[Triple, Triple]]) -> Triple:
    """Return how a body moved (m, m, rad) whose feet stand still: from the old and the new position of each in its
    frame, by least squares.
    """
    if not feet:
        return 0.0, 0.0, 0.0
    count = len(feet)
    # The ground moves by -(x, y) and turns by -w under the body: new - old = -(x - w y', y + w x').
    middle_x = sum(old[0] + new[0] for old, new in feet) / (2 * count)
    middle_y = sum(old[1] + new[1] for old, new in feet) / (2 * count)
    shift_x = sum(new[0] - old[0] for old, new in feet) / count
    shift_y = sum(new[1] - old[1] for old, new in feet) / count
    turned = spread = 0.0
    for old, new in feet:
        x, y = (old[0] + new[0]) / 2 - middle_x, (old[1] + new[1]) / 2 - middle_y
        turned += x * (new[1] - old[1] - shift_y) - y * (new[0] - old[0] - shift_x)
        spread += x * x + y * y
    w = -turned / spread if spread > 1e-9 else 0.0
    return -shift_x + w * middle_y, -shift_y - w * middle_x, w
