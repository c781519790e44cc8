"""The inverted pendulum against mechanics: energy, momentum, poles, closed forms, and the thesis's equation."""

from __future__ import annotations

import itertools
import math

import msgspec
import numpy
import pytest

from r2p.sim.physics.inertial import GRAVITY
from r2p.sim.physics.motor import Motor, MotorSpec
from r2p.sim.physics.pendulum import (
    FLOOR,
    NXTWAY,
    NXTWAY_MOTOR,
    TILTONE,
    TILTONE_MOTOR,
    TORQUE_MOTOR,
    Pendulum,
    PendulumSpec,
    linearise,
)

DT = 1e-3
FREE = msgspec.structs.replace(TILTONE_MOTOR, damping=0.0)  # with the inertia of its rotor
BARE = msgspec.structs.replace(TILTONE, wheels_inertia=0.0)
PLANTS = [(TILTONE, TILTONE_MOTOR), (NXTWAY, NXTWAY_MOTOR)]


def pendulum(spec: PendulumSpec = TILTONE, motor: MotorSpec = FREE, *, tilt: float = 0.0) -> Pendulum:
    """Without any torque, but that of friction."""
    body = Pendulum(spec, Motor(motor), Motor(motor))
    body.left.regulated = body.right.regulated = 0.0
    body.tilt = tilt
    return body


def run(body: Pendulum, seconds: float, dt: float = DT) -> None:
    for _ in range(round(seconds / dt)):
        body.step(dt)


def kinetic(body: Pendulum, p: float, q: float, r: float) -> float:
    """Of wheels (p), tilt (q) and heading (r), from the velocities of its parts, J."""
    spec, motor = body.spec, body.left.spec
    along = spec.wheel_radius * p + spec.centre * q * math.cos(body.tilt)
    aside = spec.centre * math.sin(body.tilt) * r
    down = spec.centre * q * math.sin(body.tilt)
    arm = spec.track / 2 / spec.wheel_radius * r
    return 0.5 * (
        spec.mass * (along**2 + aside**2 + down**2)
        + spec.wheels_mass * (spec.wheel_radius * p) ** 2
        + spec.inertia * q**2
        + spec.yaw_inertia * r**2
        + sum(spec.wheels_inertia / 2 * (p + side) ** 2 for side in (-arm, arm))
        + sum(motor.inertia * (p + side - q) ** 2 for side in (-arm, arm))
    )


def energy(body: Pendulum) -> float:
    height = body.spec.centre * math.cos(body.tilt)
    return kinetic(body, body.wheel_rate, body.tilt_rate, body.turn_rate) + body.spec.mass * GRAVITY * height


@pytest.mark.parametrize("spec", [TILTONE, BARE, msgspec.structs.replace(TILTONE, payload=50.0)])
def test_without_friction_and_torque_energy_stays(spec: PendulumSpec) -> None:
    """Also while it turns and drives: what couples the three motions does no work."""
    body = pendulum(spec, tilt=0.1)
    body.wheel_rate, body.tilt_rate, body.turn_rate = 2.0, 0.2, 1.5
    before = energy(body)
    run(body, 0.4)
    assert 0.2 < body.tilt < 1.0
    assert body.turn_rate != pytest.approx(1.5, rel=0.05)
    assert energy(body) == pytest.approx(before, rel=1e-9)


def test_friction_takes_energy_and_a_torque_gives_it() -> None:
    body = pendulum(motor=TILTONE_MOTOR, tilt=0.05)
    body.wheel_rate = 2.0
    before = energy(body)
    run(body, 0.5)
    assert energy(body) < before - 0.1
    body = pendulum(tilt=0.05)
    body.left.regulated = body.right.regulated = 1.0  # A
    before, work = energy(body), 0.0
    for _ in range(500):
        angle = body.left.angle
        body.step(DT)
        work += 2 * body.left.spec.constant * (body.left.angle - angle)
    assert energy(body) - before == pytest.approx(work, rel=1e-5)


def test_an_impulse_changes_the_momenta_by_what_it_gives() -> None:
    body, impulse, height, step = pendulum(tilt=0.2), 5.0, 0.8, 1e-3

    def momenta() -> tuple[float, float]:
        p, q = body.wheel_rate, body.tilt_rate
        roll = kinetic(body, p + step, q, 0.0) - kinetic(body, p - step, q, 0.0)
        tip = kinetic(body, p, q + step, 0.0) - kinetic(body, p, q - step, 0.0)
        return roll / 2 / step, tip / 2 / step

    before = momenta()
    body.shove(impulse, height)
    roll, tip = (new - old for new, old in zip(momenta(), before, strict=True))
    assert roll == pytest.approx(impulse * TILTONE.wheel_radius, rel=1e-6)
    assert tip == pytest.approx(impulse * height * math.cos(0.2), rel=1e-6)
    assert body.left.speed == body.right.speed == pytest.approx(body.wheel_rate - body.tilt_rate)


def poles(spec: PendulumSpec, motor: MotorSpec, *, torque: bool = False) -> list[complex]:
    matrix, _ = linearise(spec, motor, torque=torque)
    return sorted(numpy.linalg.eigvals(numpy.array(matrix)).tolist(), key=lambda pole: complex(pole).real)


@pytest.mark.parametrize(
    ("spec", "motor", "torque", "pole"),
    [
        (TILTONE, TILTONE_MOTOR, False, 2.70),
        (TILTONE, TORQUE_MOTOR, True, 5.13),
        (NXTWAY, NXTWAY_MOTOR, False, 7.44),
    ],
)
def test_it_falls_as_fast_as_others_have_computed(
    spec: PendulumSpec, motor: MotorSpec, torque: bool, pole: float
) -> None:
    fastest = poles(spec, motor, torque=torque)[-1]
    assert fastest.imag == 0
    assert fastest.real == pytest.approx(pole, abs=0.006)


def test_the_published_gains_of_nxtway_stabilise_it_with_their_published_poles() -> None:
    matrix, inputs = linearise(NXTWAY, NXTWAY_MOTOR)
    gains = numpy.array([[-0.870303, -31.9978, -1.1566, -2.78873, -0.44721]])  # the last: of the integral of the angle
    a, b = numpy.zeros((5, 5)), numpy.zeros((5, 1))
    a[:4, :4], b[:4, 0], a[4, 0] = matrix, inputs, 1.0
    closed = sorted(numpy.linalg.eigvals(a - b @ gains).tolist(), key=lambda pole: complex(pole).real)
    assert [round(pole.real, 2) for pole in closed] == pytest.approx([-284.4, -10.9, -1.47, -1.30, -1.30], rel=0.01)
    assert abs(closed[-1].imag) == pytest.approx(0.73, abs=0.01)


@pytest.mark.parametrize("torque", [False, True])
@pytest.mark.parametrize(("spec", "motor"), PLANTS)
def test_the_matrices_are_the_derivatives_of_the_model(spec: PendulumSpec, motor: MotorSpec, torque: bool) -> None:
    a, b = linearise(spec, motor, torque=torque)
    small, dt = 1e-4, 1e-7

    def rates(tilt: float = 0.0, p: float = 0.0, q: float = 0.0, u: float = 0.0) -> tuple[float, float]:
        body = pendulum(spec, motor, tilt=tilt)
        body.wheel_rate, body.tilt_rate = p, q
        for each in (body.left, body.right):
            each.regulated = u / motor.constant if torque else None
            each.voltage = u
        body.step(dt)
        return (body.wheel_rate - p) / dt, (body.tilt_rate - q) / dt

    columns = [rates(tilt=small), rates(p=small), rates(q=small), rates(u=small)]
    for row, (by_state, by_input) in enumerate([(a[2], b[2]), (a[3], b[3])]):
        expected = [*by_state[1:], by_input]
        if torque:  # the model regulates the current at once, so back EMF does not brake
            assert expected[1] == -expected[2]
        assert [column[row] / small for column in columns] == pytest.approx(expected, rel=1e-3, abs=1e-3)


def test_a_small_tilt_grows_as_a_hyperbolic_cosine_and_the_wheels_go_back() -> None:
    """No outer force acts along the way, so the wheels' angle is a constant share of the tilt."""
    body, start, time = pendulum(motor=TORQUE_MOTOR, tilt=1e-5), 1e-5, 1.0
    roll = TILTONE.wheels_inertia + (TILTONE.mass + TILTONE.wheels_mass) * TILTONE.wheel_radius**2
    coupling = TILTONE.mass * TILTONE.wheel_radius * TILTONE.centre
    tip = TILTONE.inertia + TILTONE.mass * TILTONE.centre**2
    pole = math.sqrt(roll * TILTONE.mass * GRAVITY * TILTONE.centre / (roll * tip - coupling**2))
    run(body, time)
    assert body.tilt == pytest.approx(start * math.cosh(pole * time), rel=1e-6)
    assert body.tilt_rate == pytest.approx(start * pole * math.sinh(pole * time), rel=1e-6)
    assert body.x / TILTONE.wheel_radius == pytest.approx(-coupling / roll * (body.tilt - start), rel=1e-6)


def test_opposite_torques_turn_it_on_the_spot() -> None:
    body, amperes = pendulum(motor=TORQUE_MOTOR), 0.5
    body.left.regulated, body.right.regulated = -amperes, amperes
    run(body, 2.0)
    arm = TILTONE.track / 2 / TILTONE.wheel_radius
    inertia = TILTONE.yaw_inertia + TILTONE.wheels_inertia * arm**2
    rate = arm * 2 * amperes * TORQUE_MOTOR.constant / inertia * 2.0
    assert body.turn_rate == pytest.approx(rate)
    assert body.w == pytest.approx(rate * 2.0 / 2)
    assert (body.x, body.y, body.tilt) == (0.0, 0.0, 0.0)
    assert body.right.speed == -body.left.speed == pytest.approx(arm * rate)


def test_with_neither_inertia_of_wheels_nor_torque_it_is_equation_8_3() -> None:
    body = pendulum(BARE, TORQUE_MOTOR, tilt=0.4)
    body.wheel_rate, body.tilt_rate = 1.0, 0.7
    body.step(1e-9)
    m_r, m_t, length, radius, j_t = BARE.wheels_mass, BARE.mass, BARE.centre, BARE.wheel_radius, BARE.inertia
    sin, cos, q = math.sin(0.4), math.cos(0.4), 0.7
    theta, alpha = body.wheel_acceleration, body.tilt_acceleration
    first = (m_r + m_t) * theta * radius - m_t * length * q**2 * sin + m_t * length * alpha * cos
    second = (j_t + m_t * length**2) * alpha - m_t * GRAVITY * length * sin + m_t * radius * theta * length * cos
    assert (first, second) == pytest.approx((0.0, 0.0), abs=1e-9)


def test_a_torque_acts_on_the_frame_too_which_8_3_leaves_out() -> None:
    """It pushes the wheels forward and the frame backward: that is how the robot balances."""
    body = pendulum()
    body.left.regulated = body.right.regulated = 1.0
    body.step(DT)
    assert body.wheel_rate > 0 > body.tilt_rate


def test_half_a_step_has_a_sixteenth_of_the_error() -> None:
    def end(dt: float) -> numpy.typing.NDArray[numpy.float64]:
        body = pendulum(motor=TILTONE_MOTOR, tilt=0.2)
        body.wheel_rate, body.turn_rate = 3.0, 1.0
        body.left.regulated, body.right.regulated = 1.0, -2.0
        run(body, 0.4, dt)
        return numpy.array([body.wheel_rate, body.tilt, body.tilt_rate, body.turn_rate, body.w])

    exact = end(1e-4)
    errors = [float(numpy.linalg.norm(end(dt) - exact)) for dt in (0.04, 0.02, 0.01)]
    assert [one / other for one, other in itertools.pairwise(errors)] == pytest.approx([16, 16], rel=0.25)


@pytest.mark.parametrize("payload", [0.0, 10.0, 30.0, 50.0])
def test_a_payload_moves_the_centre_of_mass_and_slows_the_fall(payload: float) -> None:
    spec = msgspec.structs.replace(TILTONE, payload=payload)
    assert spec.mass * spec.centre == pytest.approx(20 * 0.5 + payload * 0.7)
    about_axle = 2.4 + 20 * 0.5**2 + payload * 0.7**2
    assert spec.inertia + spec.mass * spec.centre**2 == pytest.approx(about_axle)
    assert 2.0 < poles(spec, TILTONE_MOTOR)[-1].real < 6.0


@pytest.mark.parametrize("payload", [0.0, 10.0, 50.0])
def test_the_nested_controllers_of_the_thesis_hold_it(payload: float) -> None:
    """A start at 5 degrees, then 0.5 m/s: with one set of gains, whatever it carries."""
    body = Pendulum(msgspec.structs.replace(TILTONE, payload=payload), Motor(TILTONE_MOTOR), Motor(TILTONE_MOTOR))
    body.tilt = math.radians(5)
    setpoint = integral = away = 0.0
    peak = volts = 0.0
    for tick in range(2000):  # 20 s
        speed = 0.5 if tick >= 800 else 0.0
        if tick % 5 == 0:
            away += (speed - body.velocity) * 0.05
            setpoint = max(-0.14, min(0.14, 0.15 * (speed - body.velocity) + 0.003 * away))
        error = body.tilt - setpoint
        integral += error * 0.01
        volt = 120 * error + 200 * integral + 8 * body.tilt_rate
        body.left.voltage = body.right.voltage = volt
        run(body, 0.01)
        peak, volts = max(peak, abs(body.tilt)), max(volts, abs(volt))
        if tick == 799:
            assert abs(body.velocity) < 0.05
    assert math.degrees(peak) < 8.0
    assert volts < 24
    assert body.velocity == pytest.approx(0.5, abs=0.05)


def test_it_falls_onto_the_floor_and_stays_there_until_it_is_raised() -> None:
    body = pendulum(motor=TILTONE_MOTOR, tilt=-0.1)
    run(body, 5.0)
    assert body.fallen
    assert body.tilt == -FLOOR
    run(body, 1.0)
    assert (body.tilt, body.tilt_rate) == (-FLOOR, 0.0)
    body.held = True
    for _ in range(100):
        body.raise_by(FLOOR / 100, DT)
        assert body.tilt_rate == pytest.approx(FLOOR / 100 / DT)
    assert body.tilt == pytest.approx(0.0)
    assert not body.fallen
    run(body, 1.0)
    assert (body.tilt_rate, body.wheel_rate, body.left.speed) == (0.0, 0.0, 0.0)


def test_held_it_stands_still_whatever_the_motors_do() -> None:
    body = pendulum(motor=TILTONE_MOTOR, tilt=0.1)
    body.held, body.left.regulated, body.left.voltage = True, None, 3.0
    run(body, 0.1)
    assert (body.tilt, body.x, body.left.angle) == (0.1, 0.0, 0.0)
    assert body.left.current == pytest.approx(10.0)


def test_two_runs_are_the_same_to_the_bit() -> None:
    bodies = [pendulum(motor=TILTONE_MOTOR, tilt=0.1) for _ in range(2)]
    for body in bodies:
        body.turn_rate = 1.0
        run(body, 1.0)
    one, other = ((body.tilt, body.wheel_rate, body.x, body.y, body.w, body.left.ticks) for body in bodies)
    assert one == other
