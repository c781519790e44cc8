"""An inverted pendulum on two wheels: the body of a balancing robot (thesis 8.3).

    (J_w + J_r + (M_R + M_T) R^2) theta'' + (M_T R L cos a - J_r) a'' = C + M_T R L sin a (a'^2 + phi'^2)
    (M_T R L cos a - J_r) theta'' + (J_T + M_T L^2 + J_r) a'' = -C + M_T L sin a (g + L cos a phi'^2)
    (J_phi + M_T L^2 sin^2 a) phi'' = b/2R (C_r - C_l) - M_T L sin a phi' (2 L cos a a' + R theta')

theta is the angle of the wheels against the vertical, a the tilt of the frame (forward is positive), phi the heading;
C = C_l + C_r is the torque of the motors on the wheels. Without turning (phi' is 0), this is equation 8.3 of the thesis
but for four corrections:

- The motors sit on the frame, so their torque acts on it as well, with the opposite sign. 8.3 has 0 there.
- The wheels have an inertia of their own, J_w, and the rotors one of n^2 J_m each, J_r of both: the gear makes it
  larger than that of the wheels. It takes part in the motion of the wheels against the frame, hence `- J_r`.
- The first row of 8.3 is a force and the second one a torque; here both are torques.
- `l` and `L` are the same length, from the axle to the frame's centre of mass.

With neither these inertias nor a torque, the two agree.

Wheels roll without slipping. A frame that has fallen over lies on the floor, at 80 degrees, until it is raised.
"""

import math
from typing import NamedTuple

import msgspec

from r2p.sim.physics.inertial import GRAVITY
from r2p.sim.physics.motor import Motor, MotorSpec
from r2p.sim.physics.world import Triple

Matrix = list[list[float]]

FLOOR = math.radians(80)
"""The tilt of a frame that lies on the floor, rad."""


class PendulumSpec(msgspec.Struct, frozen=True, kw_only=True):
    """Data sheet of the body. Default: like tiltOne, as far as the thesis describes it (8.3); the rest is assumed."""

    frame_mass: float = 20.0
    """M_T, kg; of all that tilts, without the payload."""
    height: float = 0.5
    """L, from the axle to the centre of that mass, m."""
    frame_inertia: float = 2.4
    """J_T, about its own centre of mass, kg m^2."""
    wheels_mass: float = 4.0
    """M_R, of both wheels, kg."""
    wheels_inertia: float = 0.2
    """J_w, of both wheels about their axle, kg m^2."""
    wheel_radius: float = 0.25
    """R, m."""
    track: float = 0.5
    """b, from wheel to wheel, m."""
    yaw_inertia: float = 0.8
    """Of frame and wheels about the vertical, upright, without what turns the wheels, kg m^2."""
    payload: float = 0.0
    """kg; up to 50 (thesis 8.3.1)."""
    payload_height: float = 0.7
    """Above the axle, m."""

    def body_velocity(self, left: float, right: float) -> Triple:
        """Return the velocity of the body (m/s, m/s, rad/s) for these speeds of the wheels, rad/s."""
        return self.wheel_radius * (left + right) / 2, 0.0, self.wheel_radius * (right - left) / self.track

    @property
    def mass(self) -> float:
        """M_T with the payload, kg."""
        return self.frame_mass + self.payload

    @property
    def centre(self) -> float:
        """L with the payload, m."""
        return (self.frame_mass * self.height + self.payload * self.payload_height) / self.mass

    @property
    def inertia(self) -> float:
        """J_T with the payload, a point: about the common centre of mass, kg m^2."""
        frame = self.frame_mass * (self.centre - self.height) ** 2
        return self.frame_inertia + frame + self.payload * (self.payload_height - self.centre) ** 2


TILTONE = PendulumSpec()
"""Like tiltOne: two bicycle wheels, an aluminium frame. All masses and lengths are assumed: the thesis gives none."""
NXTWAY = PendulumSpec(
    frame_mass=0.6,
    height=0.072,
    frame_inertia=0.6 * 0.072**2 / 3,
    wheels_mass=0.06,
    wheels_inertia=0.06 * 0.04**2 / 2,
    wheel_radius=0.04,
    track=0.14,
    yaw_inertia=0.6 * (0.14**2 + 0.05**2) / 12,
)
"""NXTway-GS, a balancing robot of LEGO Mindstorms: 14 cm wide, 5 cm deep, 14.4 cm high."""

TILTONE_MOTOR = MotorSpec(
    voltage=24.0,
    resistance=0.30,
    torque_constant=30.2,
    rotor_inertia=142.0,
    gear=104.0,
    ticks_per_turn=2000,
    friction=0.0,
    damping=200.0,
    current_limit=20.0,
)
"""150 W, gear 26:1, belt 4:1, 2000 ticks/turn, 20 A of the motor module (thesis 7.3.1, 8.3.1); the rest is assumed."""
TORQUE_MOTOR = msgspec.structs.replace(TILTONE_MOTOR, rotor_inertia=0.0, damping=0.0)
"""An ideal one of the same torque, for a plant that falls faster: without friction and without inertia of the rotor."""
NXTWAY_MOTOR = MotorSpec(
    voltage=8.0,
    resistance=6.69,
    torque_constant=317.0,
    rotor_inertia=100.0,
    gear=1.0,
    ticks_per_turn=360,
    friction=0.0,
    damping=2.2 + 1000 * 0.317 * (0.468 - 0.317) / 6.69,
    current_limit=1.2,
)
"""The motor of NXTway-GS. Its back EMF (0.468 V s/rad) is more than its torque (0.317 Nm/A): a loss, here damping."""


class _Masses(NamedTuple):
    """What the equations are made of: the parts of their mass matrix, and the weight's moment."""

    rolling: float
    """J_w + J_r + (M_R + M_T) R^2."""
    coupling: float
    """M_T R L."""
    rotors: float
    """J_r."""
    tilting: float
    """J_T + M_T L^2 + J_r."""
    turning: float
    """J_phi, with what turns the wheels."""
    square: float
    """M_T L^2."""
    weight: float
    """M_T g L."""
    arm: float
    """b/2R, the turn of a wheel per turn of the body."""


def _masses(spec: PendulumSpec, motor: MotorSpec) -> _Masses:
    mass, centre, radius = spec.mass, spec.centre, spec.wheel_radius
    rotors, arm, square = 2 * motor.inertia, spec.track / 2 / radius, mass * centre**2
    wheels = spec.wheels_inertia + rotors
    return _Masses(
        rolling=wheels + (spec.wheels_mass + mass) * radius**2,
        coupling=mass * radius * centre,
        rotors=rotors,
        tilting=spec.inertia + square + rotors,
        turning=spec.yaw_inertia + wheels * arm**2,
        square=square,
        weight=mass * GRAVITY * centre,
        arm=arm,
    )


class Pendulum:
    """The body on its wheels, driven by two motors. They count angles and speeds of the wheels against the frame."""

    def __init__(self, spec: PendulumSpec, left: Motor, right: Motor) -> None:
        self.left, self.right = left, right
        self.tilt = self.tilt_rate = self.tilt_acceleration = 0.0
        """rad, rad/s, rad/s^2; forward is positive."""
        self.wheel_rate = self.wheel_acceleration = 0.0
        """Of the wheels against the vertical, their mean, rad/s and rad/s^2."""
        self.x = self.y = self.w = self.turn_rate = 0.0
        """Pose of the axle's centre, m and rad (not wrapped), and rad/s."""
        self.path = 0.0
        """Length of the path so far, m."""
        self.held = False
        """True while hands hold the robot: nothing moves."""
        self.load(spec)

    def load(self, spec: PendulumSpec) -> None:
        """Change the data sheet, for example the payload, while it stands."""
        self.spec = spec
        self._masses = _masses(spec, self.left.spec)

    @property
    def velocity(self) -> float:
        """Forward, m/s."""
        return self.wheel_rate * self.spec.wheel_radius

    @property
    def fallen(self) -> bool:
        """Return whether it lies on the floor."""
        return abs(self.tilt) >= FLOOR

    def shove(self, impulse: float, height: float = 1.0) -> None:
        """Hit the frame, forward or (negative) backward: an impulse in Ns, so many m along the frame from the axle."""
        roll, tip = impulse * self.spec.wheel_radius, impulse * height * math.cos(self.tilt)
        wheels, frame = _solved(self._masses, math.cos(self.tilt), roll, tip)
        self.wheel_rate += wheels
        self.tilt_rate += frame
        self._turn_motors(0.0)

    def raise_by(self, angle: float, dt: float) -> None:
        """Turn the frame by hand, in `dt` seconds, while `held`; the wheels stand still on the floor."""
        self.tilt += angle
        self.tilt_rate = angle / dt
        self.wheel_rate = self.turn_rate = 0.0
        self._turn_motors(dt)

    def step(self, dt: float) -> None:
        """Advance by `dt` seconds: a Runge-Kutta step of order 4, of the motors' torques too."""
        if self.held:
            self._rest(dt)
            return
        tilt, p, q, r = self.tilt, self.wheel_rate, self.tilt_rate, self.turn_rate
        half, rates = dt / 2, self._rates
        p1, q1, r1 = rates(tilt, p, q, r)
        pa, qa, ra = p + p1 * half, q + q1 * half, r + r1 * half
        p2, q2, r2 = rates(tilt + q * half, pa, qa, ra)
        pb, qb, rb = p + p2 * half, q + q2 * half, r + r2 * half
        p3, q3, r3 = rates(tilt + qa * half, pb, qb, rb)
        pc, qc, rc = p + p3 * dt, q + q3 * dt, r + r3 * dt
        p4, q4, r4 = rates(tilt + qb * dt, pc, qc, rc)
        sixth = dt / 6
        self.wheel_acceleration, self.tilt_acceleration = p1, q1
        self.wheel_rate = p + (p1 + 2 * (p2 + p3) + p4) * sixth
        self.tilt_rate = q + (q1 + 2 * (q2 + q3) + q4) * sixth
        self.turn_rate = r + (r1 + 2 * (r2 + r3) + r4) * sixth
        self.tilt = tilt + (q + 2 * (qa + qb) + qc) * sixth
        self._move((p + 2 * (pa + pb) + pc) * sixth, (r + 2 * (ra + rb) + rc) * sixth)
        if abs(self.tilt) >= FLOOR:
            self._lie_down()
        self._turn_motors(dt)

    def _rates(self, tilt: float, p: float, q: float, r: float) -> tuple[float, float, float]:
        """Return the derivatives of the rates of wheels (p), tilt (q) and heading (r)."""
        m11, coupling, rotors, m22, turning, square, weight, arm = self._masses
        relative, side = p - q, arm * r
        left, right = self.left.torque_at(relative - side), self.right.torque_at(relative + side)
        torque = left + right
        sin, cos = math.sin(tilt), math.cos(tilt)
        m12 = coupling * cos - rotors
        roll = torque + coupling * sin * (q * q + r * r)
        tip = (weight + square * cos * r * r) * sin - torque
        turn = arm * (right - left) - (2 * square * cos * q + coupling * p) * sin * r
        determinant = m11 * m22 - m12 * m12  # _solved() in line: this is the loop of the whole simulation
        return (
            (roll * m22 - tip * m12) / determinant,
            (tip * m11 - roll * m12) / determinant,
            turn / (turning + square * sin * sin),
        )

    def _move(self, rolled: float, turned: float) -> None:
        """Move the axle's centre along the arc of a circle."""
        forward, heading = rolled * self.spec.wheel_radius, self.w + turned / 2
        self.x += forward * math.cos(heading)
        self.y += forward * math.sin(heading)
        self.w += turned
        self.path += abs(forward)

    def _lie_down(self) -> None:
        self.tilt = math.copysign(FLOOR, self.tilt)
        if self.tilt_rate * self.tilt > 0:
            self.tilt_rate = 0.0

    def _rest(self, dt: float) -> None:
        self.wheel_rate = self.tilt_rate = self.turn_rate = self.wheel_acceleration = self.tilt_acceleration = 0.0
        for motor in (self.left, self.right):
            motor.torque_at(0.0)  # which takes a current
        self._turn_motors(dt)

    def _turn_motors(self, dt: float) -> None:
        relative, arm = self.wheel_rate - self.tilt_rate, self._masses.arm * self.turn_rate
        self.left.turn(relative - arm, dt)
        self.right.turn(relative + arm, dt)


def _solved(masses: _Masses, cos: float, roll: float, tip: float) -> tuple[float, float]:
    """Return the accelerations of wheels and tilt by moments on them; or by moments' impulses, what the rates jump."""
    m11, m12, m22 = masses.rolling, masses.coupling * cos - masses.rotors, masses.tilting
    determinant = m11 * m22 - m12 * m12
    return (roll * m22 - tip * m12) / determinant, (tip * m11 - roll * m12) / determinant


def linearise(spec: PendulumSpec, motor: MotorSpec, *, torque: bool = False) -> tuple[Matrix, list[float]]:
    """Return A and B of x' = A x + B u near upright: x is wheel angle, tilt and their rates.

    u is the voltage of both motors, or with `torque` the torque of each of them at its wheel, Nm. Dry friction and
    limits are left out.
    """
    masses = _masses(spec, motor)
    gain, damping = 1.0, motor.damping * 1e-3
    if not torque:
        gain = motor.constant / motor.resistance
        damping += motor.constant * gain
    wheels_by_tilt, tilt_by_tilt = _solved(masses, 1.0, 0.0, masses.weight)
    wheels_by_rate, tilt_by_rate = _solved(masses, 1.0, -2 * damping, 2 * damping)
    wheels_by_input, tilt_by_input = _solved(masses, 1.0, 2 * gain, -2 * gain)
    return [
        [0.0, 0.0, 1.0, 0.0],
        [0.0, 0.0, 0.0, 1.0],
        [0.0, wheels_by_tilt, wheels_by_rate, -wheels_by_rate],
        [0.0, tilt_by_tilt, tilt_by_rate, -tilt_by_rate],
    ], [0.0, 0.0, wheels_by_input, tilt_by_input]
