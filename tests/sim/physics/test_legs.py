"""Legs: kinematics and their inverse, a joint's position loop against its equation, and how feet move a body."""

from __future__ import annotations

import math
import random

import pytest

from r2p.sim.physics.inertial import GRAVITY
from r2p.sim.physics.legs import JOINT_MOTOR, Joint, Legs, LegSpec, moved
from r2p.sim.physics.motor import Drive, Gains, Motor, MotorSpec

SPEC = LegSpec()
FRICTIONLESS = MotorSpec(
    **{name: getattr(JOINT_MOTOR, name) for name in JOINT_MOTOR.__struct_fields__} | {"friction": 0.0}
)
KP = 200.0  # V/rad


def test_the_inverse_kinematics_undoes_the_kinematics() -> None:
    assert SPEC.foot((0.0, 0.0, 0.0)) == pytest.approx((0.0, SPEC.reach, -SPEC.height))
    numbers = random.Random(1)
    for _ in range(50):
        angles = numbers.uniform(-0.5, 0.5), numbers.uniform(-0.4, 0.4), numbers.uniform(-0.4, 0.4)
        assert SPEC.angles(*SPEC.foot(angles)) == pytest.approx(angles)
        for leg in range(6):
            assert SPEC.from_body(leg, *SPEC.on_body(leg, SPEC.foot(angles))) == pytest.approx(angles)


def test_a_foot_out_of_reach_is_as_near_as_the_leg_is_long() -> None:
    _, reach, z = SPEC.foot(SPEC.angles(0.0, 1.0, 0.0))
    assert (reach, z) == pytest.approx((sum(SPEC.links), 0.0))


@pytest.mark.parametrize("dt", [0.0002, 0.005])
def test_a_step_of_a_joint_is_that_of_the_second_order_system(dt: float) -> None:
    """J a'' + (k^2/R + d) a' + kp k/R a = kp k/R setpoint; sampled each dt, with what that adds."""
    motor = Motor(FRICTIONLESS)
    joint = Joint(motor, SPEC.link_inertia)
    drive = Drive(motor, Gains(KP / FRICTIONLESS.ticks_per_radian), mode="position")
    drive.setpoint = 0.05 * FRICTIONLESS.ticks_per_radian
    k, r = FRICTIONLESS.constant, FRICTIONLESS.resistance
    stiffness, damping = KP * k / r, k * k / r + FRICTIONLESS.damping * 1e-3
    sampled, speed, time = 0.0, 0.0, 0.0
    frequency = math.sqrt(stiffness / joint.inertia)
    zeta = damping / 2 / math.sqrt(stiffness * joint.inertia)
    ringing = frequency * math.sqrt(1 - zeta * zeta)
    for _ in range(round(0.4 / dt)):
        drive.step(dt)
        joint.step(dt)
        time += dt
        torque = stiffness * (0.05 - sampled) - damping * speed
        sampled, speed = (
            sampled + (2 * speed + torque / joint.inertia * dt) / 2 * dt,
            speed + torque / joint.inertia * dt,
        )
        assert motor.angle == pytest.approx(sampled, abs=0.001)
        if dt < 0.001:
            decay = math.exp(-zeta * frequency * time)
            wave = math.cos(ringing * time) + zeta * frequency / ringing * math.sin(ringing * time)
            assert motor.angle == pytest.approx(0.05 * (1 - decay * wave), abs=0.001)
    assert motor.angle == pytest.approx(0.05, abs=0.001)


def test_a_joint_gives_way_by_its_load_over_its_stiffness() -> None:
    motor = Motor(FRICTIONLESS)
    joint = Joint(motor, SPEC.link_inertia)
    drive = Drive(motor, Gains(KP / FRICTIONLESS.ticks_per_radian), mode="position")
    drive.setpoint, joint.load = 0.0, 3.0
    for _ in range(200):
        drive.step(0.005)
        joint.step(0.005)
    stiffness = KP * FRICTIONLESS.constant / FRICTIONLESS.resistance
    assert motor.angle == pytest.approx(3.0 / stiffness, abs=1.5 / FRICTIONLESS.ticks_per_radian)


def standing(spec: LegSpec = SPEC) -> tuple[Legs, list[Joint]]:
    joints = [Joint(Motor(FRICTIONLESS), spec.link_inertia) for _ in range(18)]
    return Legs(spec, joints), joints


def test_the_loads_are_those_of_virtual_work() -> None:
    """A foot that carries F does the work F dz when a joint turns: the torque is F dz/da."""
    legs, joints = standing()
    legs.step(1e-6)
    assert all(legs.standing)
    legs.step(1e-6)
    force = SPEC.mass * GRAVITY / 6 - SPEC.leg_mass * GRAVITY
    for index in (1, 2):
        turned = [0.0, 0.0, 0.0]
        turned[index] = 1e-6
        rise = (SPEC.foot(turned)[2] - SPEC.foot((0.0, 0.0, 0.0))[2]) / 1e-6
        assert [joints[3 * leg + index].load for leg in range(6)] == pytest.approx([force * rise] * 6, rel=1e-4)


def test_without_power_the_body_sinks_to_its_belly() -> None:
    legs, _ = standing()
    for _ in range(1000):
        legs.step(0.005)
    assert legs.lies
    assert legs.height == SPEC.belly
    assert not any(legs.standing)


@pytest.mark.parametrize("feet", [3, 6])
def test_feet_that_stand_still_tell_exactly_how_a_body_moved(feet: int) -> None:
    numbers = random.Random(feet)
    x, y, w = 0.01, -0.02, 0.1
    ground = [(numbers.uniform(-1, 1), numbers.uniform(-1, 1)) for _ in range(feet)]
    # Half of the turn before the way, and half of it after: as the middle heading has it.
    pairs = []
    for at_x, at_y in ground:
        dx, dy = at_x - x / 2, at_y - y / 2  # seen from the middle of the way, at the middle heading
        old = turned(dx + x, dy + y, w / 2)
        new = turned(dx, dy, -w / 2)
        pairs.append(((*old, 0.0), (*new, 0.0)))
    found = moved(pairs)
    assert found[2] == pytest.approx(w, rel=0.003)  # 2 tan(w/2)
    assert found[:2] == pytest.approx((x, y), rel=0.01)


def turned(x: float, y: float, w: float) -> tuple[float, float]:
    return x * math.cos(w) - y * math.sin(w), x * math.sin(w) + y * math.cos(w)


def test_without_feet_nothing_moves() -> None:
    assert moved([]) == (0.0, 0.0, 0.0)
