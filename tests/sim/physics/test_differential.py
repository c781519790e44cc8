"""The body on two wheels: kinematics there and back, Newton, energy, and its step response beside theory."""

import math
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from r2p.sim.physics.differential import DifferentialBody, DifferentialSpec
from r2p.sim.physics.motor import Drive, Motor, MotorSpec, speed_gains
from tests.sim.physics.theory import step_response

SPEC = DifferentialSpec(wear=0.0)
SMOOTH = MotorSpec(friction=0.0, damping=0.0)
OPEN = MotorSpec(friction=0.0, damping=0.0, resistance=1e12)
"""Its winding is not connected: it neither drives nor brakes."""
speeds = st.floats(-5, 5)


def body(spec: DifferentialSpec = SPEC, motor: MotorSpec = SMOOTH) -> DifferentialBody:
    return DifferentialBody(spec, [Motor(motor) for _ in range(2)], random.Random(1))


def rolling(x: float, w: float, spec: DifferentialSpec = SPEC) -> DifferentialBody:
    """A body that rolls at this velocity, with open windings."""
    robot = body(spec, OPEN)
    for motor, speed in zip(robot.motors, spec.wheel_speeds(x, w), strict=True):
        motor.speed = speed
    return robot


def energy(robot: DifferentialBody) -> float:
    """Of the body, from the velocities of its centre of mass, and of wheels and rotors."""
    spec, speeds = robot.spec, [motor.speed for motor in robot.motors]
    v, _, w = spec.body_velocity(*speeds)
    own = robot.motors[0].spec.inertia + spec.wheel_inertia
    body = spec.mass * (v**2 + (spec.behind * w) ** 2) + spec.inertia * w**2
    return (body + own * sum(speed**2 for speed in speeds)) / 2


@given(speeds, speeds)
def test_the_forward_kinematics_are_the_inverse_of_the_inverse(x: float, w: float) -> None:
    assert SPEC.body_velocity(*SPEC.wheel_speeds(x, w)) == pytest.approx((x, 0.0, w), abs=1e-9)


@given(speeds, speeds)
def test_and_the_other_way_round(left: float, right: float) -> None:
    x, _, w = SPEC.body_velocity(left, right)
    assert SPEC.wheel_speeds(x, w) == pytest.approx((left, right), abs=1e-9)


def test_a_turn_to_the_left_has_the_right_wheel_in_front() -> None:
    assert SPEC.wheel_speeds(0.6, 0.0) == pytest.approx((5, 5))
    assert SPEC.wheel_speeds(0.0, 0.48) == pytest.approx((-1, 1))


@pytest.mark.parametrize("volts", [(2, 2), (-1, 1), (3, -1), (0, 2)])
@pytest.mark.parametrize("velocity", [(0.0, 0.0), (0.8, 1.5), (-0.5, 2.0)])
def test_it_obeys_newton(volts: tuple[float, float], velocity: tuple[float, float]) -> None:
    """The forces at the ground accelerate the centre of mass, and their moment about it turns the body.

    The wheels can't move sideways, so the ground also pushes at the axle: by what the centre of mass needs for its
    sideways acceleration.
    """
    spec = DifferentialSpec(wear=0.0, wheel_inertia=0.0)
    robot = body(spec, MotorSpec(friction=0.0, damping=0.0, rotor_inertia=0.0))
    for motor, voltage, speed in zip(robot.motors, volts, spec.wheel_speeds(*velocity), strict=True):
        motor.voltage, motor.speed = voltage, speed
    left, right = (motor.torque() / spec.wheel_radius for motor in robot.motors)
    dt, d = 1e-7, spec.behind
    robot.step(dt)
    v, w = velocity
    after = spec.body_velocity(*(motor.speed for motor in robot.motors))
    dv, dw = (after[0] - v) / dt, (after[2] - w) / dt
    assert spec.mass * (dv + d * w**2) == pytest.approx(left + right, abs=1e-2)
    sideways = spec.mass * (v * w - d * dw)
    assert spec.inertia * dw == pytest.approx((right - left) * spec.track / 2 + sideways * d, abs=1e-2)


def test_energy_of_a_rolling_body_stays() -> None:
    """Open windings: what its turn loses, its speed gains, as the centre of mass swings out."""
    robot = rolling(0.4, 2.0)
    before = energy(robot)
    for _ in range(4000):
        robot.step(0.5e-3)
    assert energy(robot) == pytest.approx(before, rel=1e-3)
    assert robot.velocity != pytest.approx((0.4, 2.0), rel=0.1)


def test_with_its_mass_behind_a_free_body_turns_round() -> None:
    """Driving forward on is not stable: from a small turn it ends backwards, with the mass ahead."""
    robot = rolling(0.5, 0.01)
    for _ in range(30_000):
        robot.step(1e-3)
    assert robot.velocity[0] < -0.45
    backwards = rolling(-0.5, 0.1)
    for _ in range(10_000):
        backwards.step(1e-3)
    assert backwards.velocity[0] < -0.49
    assert abs(backwards.velocity[1]) < 0.01


@pytest.mark.parametrize(("left", "right"), [(4.0, 6.0), (6.0, 4.0), (1.0, -2.0), (5.0, 0.0)])
def test_held_wheels_drive_a_circle(left: float, right: float) -> None:
    """Its radius is track / 2 (right + left) / (right - left)."""
    robot = body(DifferentialSpec(wear=0.0, behind=0.0), OPEN)
    for motor, speed in zip(robot.motors, (left, right), strict=True):
        motor.speed = speed
    radius = SPEC.track / 2 * (right + left) / (right - left)
    for _ in range(1000):
        robot.step(2e-3)
        assert math.hypot(robot.x, robot.y - radius) == pytest.approx(abs(radius), abs=1e-6)
    assert robot.w == pytest.approx(2 * SPEC.wheel_radius * (right - left) / SPEC.track)
    assert robot.path == pytest.approx(abs(radius * robot.w))
    v, w = robot.velocity
    assert robot.acceleration == pytest.approx((0.0, v * w), abs=1e-9)


@pytest.mark.parametrize("turns", [False, True])
def test_the_step_response_is_that_of_theory(turns: bool) -> None:
    """Both wheels alike, or against each other: a first-order system with the inertia of that movement."""
    spec = DifferentialSpec(wear=0.0, behind=0.0)
    motor = MotorSpec(friction=0.0, damping=0.0, current_limit=1000.0, gear=74.0, resistance=0.3, torque_constant=30.2)
    robot = body(spec, motor)
    load = robot.turning if turns else robot.ahead
    gains = speed_gains(motor, load, frequency=20.0, damping=0.8)
    drives = [Drive(each, gains) for each in robot.motors]
    wanted = 3.0 * motor.ticks_per_radian
    drives[0].setpoint, drives[1].setpoint = (-wanted if turns else wanted), wanted
    dt, worst = 0.0005, 0.0
    for step in range(1, 1000):
        for drive in drives:
            drive.step(dt)
        robot.step(dt)
        worst = max(worst, abs(robot.motors[1].speed / 3.0 - step_response(motor, load, gains, step * dt)))
    assert worst < 0.02


def test_worn_wheels_drift() -> None:
    """By the difference of their radii over the track, for each radian that they turn."""
    robot = rolling(0.5, 0.0, DifferentialSpec(wear=1.0))
    for _ in range(1000):
        robot.step(1e-3)
    left, right = robot.radii
    turned = robot.motors[0].angle
    assert left != right
    assert robot.w == pytest.approx((right - left) / SPEC.track * turned, rel=0.02)
    assert robot.path == pytest.approx((left + right) / 2 * turned, rel=0.02)
