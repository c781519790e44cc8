"""Range finders and the world that they measure; kinematics there and back, and the dynamics of the body."""

import math
import random
import statistics

import pytest
from hypothesis import given
from hypothesis import strategies as st

from r2p.sim.physics.motor import Motor, MotorSpec
from r2p.sim.physics.world import NOTHING, OmniBody, OmniSpec, RangeCalibration, RangeFinder, RangeSpec, World

SPEC = OmniSpec(wear=0.0)
SMOOTH = MotorSpec(friction=0.0, damping=0.0)
speeds = st.floats(-5, 5)


@given(speeds, speeds, speeds)
def test_the_forward_kinematics_are_the_inverse_of_the_inverse(x: float, y: float, w: float) -> None:
    assert SPEC.body_velocity(*SPEC.wheel_speeds(x, y, w)) == pytest.approx((x, y, w), abs=1e-9)


@given(speeds, speeds, speeds)
def test_and_the_other_way_round(one: float, two: float, three: float) -> None:
    assert SPEC.wheel_speeds(*SPEC.body_velocity(one, two, three)) == pytest.approx((one, two, three), abs=1e-9)


def test_equation_8_1_of_the_thesis_is_not_the_inverse_of_8_2() -> None:
    """Its rows, as printed, give 3/2 of the translation and 3 times the rotation."""
    radius, arm = SPEC.wheel_radius, SPEC.arm
    one, two, three = SPEC.wheel_speeds(0.3, -0.2, 0.7)
    x = radius * math.cos(math.pi / 3) * (one + two) - radius * three
    y = radius * math.cos(math.pi / 6) * (two - one)
    w = -radius * (one + two + three) / arm
    assert (x, y, w) == pytest.approx((1.5 * 0.3, 1.5 * -0.2, 3 * 0.7))


def test_wheels_are_where_the_equations_put_them() -> None:
    """Forward needs all of wheel 3's speed, backwards, and half of the others'; a turn needs the same of each."""
    assert SPEC.wheel_speeds(0.5, 0, 0) == pytest.approx((5, 5, -10))
    assert SPEC.wheel_speeds(0, 0, 1) == pytest.approx((-4, -4, -4))
    assert SPEC.wheel_speeds(0, 0.5, 0) == pytest.approx((-8.660254, 8.660254, 0))


def body(spec: OmniSpec = SPEC, motor: MotorSpec = SMOOTH) -> OmniBody:
    return OmniBody(spec, [Motor(motor) for _ in range(3)], random.Random(1))


@pytest.mark.parametrize("volts", [(1, 1, -2), (-1, 1, 0), (2, 2, 2), (3, -1, 0.5)])
def test_it_obeys_newton(volts: tuple[float, float, float]) -> None:
    """From rest: the force of the wheels is mass times acceleration, their moment inertia times the turn's.

    With rotors that weigh nothing: what they hold back does not act on the body.
    """
    robot = body(motor=MotorSpec(friction=0.0, damping=0.0, rotor_inertia=0.0))
    for motor, voltage in zip(robot.motors, volts, strict=True):
        motor.voltage = voltage
    forces = [motor.torque() / SPEC.wheel_radius for motor in robot.motors]
    directions = [(0.5, -math.cos(math.pi / 6)), (0.5, math.cos(math.pi / 6)), (-1.0, 0.0)]
    dt = 1e-6
    robot.step(dt)
    x, y, w = (2 * speed / dt for speed in robot.velocity)  # the mean of the step is half of its end
    assert SPEC.mass * x == pytest.approx(sum(f * d[0] for f, d in zip(forces, directions, strict=True)), abs=1e-3)
    assert SPEC.mass * y == pytest.approx(sum(f * d[1] for f, d in zip(forces, directions, strict=True)), abs=1e-3)
    assert SPEC.inertia * w == pytest.approx(-SPEC.arm * sum(forces), abs=1e-3)


def test_energy_of_a_rolling_body_stays() -> None:
    """Nothing drives it, nothing brakes it (the winding is open): it rolls on, turning, for ever."""
    robot = body(motor=MotorSpec(friction=0.0, damping=0.0, resistance=1e12))
    for motor, speed in zip(robot.motors, SPEC.wheel_speeds(0.3, 0.1, 0.5), strict=True):
        motor.speed = speed
    for _ in range(1000):
        robot.step(1e-3)
    assert robot.velocity == pytest.approx((0.3, 0.1, 0.5))
    assert robot.w == pytest.approx(0.5)
    assert robot.path == pytest.approx(math.hypot(0.3, 0.1))


def test_a_constant_velocity_with_a_turn_is_a_circle() -> None:
    robot = body(motor=MotorSpec(friction=0.0, damping=0.0, resistance=1e12))
    for motor, speed in zip(robot.motors, SPEC.wheel_speeds(0.5, 0, 1.0), strict=True):
        motor.speed = speed
    for _ in range(200):
        robot.step(math.pi / 200)
    assert (robot.x, robot.y) == pytest.approx((0.0, 1.0), abs=1e-3)  # half a circle of radius 0.5 m


def test_worn_wheels_drift() -> None:
    robot = body(OmniSpec(wear=1.0), MotorSpec(friction=0.0, damping=0.0, resistance=1e12))
    for motor, speed in zip(robot.motors, SPEC.wheel_speeds(0.5, 0, 0), strict=True):
        motor.speed = speed
    for _ in range(1000):
        robot.step(1e-3)
    assert 0 < abs(robot.x - 0.5) < 0.02
    assert 0 < abs(robot.w) < 0.1


def finder(**spec: float) -> RangeFinder:
    return RangeFinder(RangeSpec(**spec), random.Random(3))


@pytest.mark.parametrize("distance", [100, 150, 250, 400, 700])
def test_without_noise_the_correction_gives_the_distance_back(distance: int) -> None:
    """As far as the A/D converter can tell: one count is less than a millimetre near by, more far away."""
    sensor = finder(noise=0.0)
    assert sensor.millimetres(sensor.read(distance)) == pytest.approx(distance, abs=2)


def test_a_sensor_of_another_curve_is_right_once_it_is_calibrated() -> None:
    sensor = finder(noise=0.0, scale=390.0, offset=40.0)
    assert [sensor.millimetres(sensor.read(mm)) for mm in (150.0, 400.0)] == pytest.approx([118, 335], abs=2)
    sensor.calibration = RangeCalibration(scale=390.0, offset=40.0, longest=300.0)
    assert [sensor.millimetres(sensor.read(mm)) for mm in (150.0, 250.0)] == pytest.approx([150, 250], abs=2)
    assert sensor.millimetres(sensor.read(400.0)) == NOTHING


def test_the_curve_is_not_linear() -> None:
    sensor = finder(noise=0.0)
    near, far = (sensor.read(d) - sensor.read(d + 50) for d in (150, 600))
    assert near > 5 * far > 0


def test_noise_grows_with_the_distance_as_the_curve_gets_flat() -> None:
    """A voltage's sigma times the slope of the curve, (distance + offset)^2 / scale."""
    sensor = finder()
    for distance in (200, 400, 600):
        readings = [sensor.millimetres(sensor.read(distance)) for _ in range(2000)]
        expected = 3e-3 * (distance + 47) ** 2 / 339
        assert statistics.stdev(readings) == pytest.approx(expected, rel=0.2)
        assert statistics.mean(readings) == pytest.approx(distance, rel=0.01)


def test_nothing_in_range_is_told_as_such() -> None:
    sensor = finder(noise=0.0)
    assert sensor.millimetres(sensor.read(math.inf)) == NOTHING
    assert sensor.millimetres(sensor.read(900)) == NOTHING


def test_too_near_looks_far() -> None:
    sensor = finder(noise=0.0)
    assert sensor.millimetres(sensor.read(20)) > 500


def test_rays_meet_the_nearest_wall() -> None:
    world = World([((-10.0, 5.0), (10.0, 5.0))])
    world.add_box(2.0, 0.0, 1.0, 1.0)
    assert world.distance(0, 0, 0) == pytest.approx(1.5)
    assert world.distance(0, 0, math.pi / 2) == pytest.approx(5.0)
    assert world.distance(2.0, 4.0, -math.pi / 2) == pytest.approx(3.5)
    assert world.distance(0, 0, math.atan2(0.49, 1.5)) == pytest.approx(math.hypot(0.49, 1.5))
    assert world.distance(0, 0, math.pi) == math.inf
    assert World().distance(0, 0, 0) == math.inf
