"""Motor and PID against the theory of what they are made of; and the battery."""

import math

import pytest

from r2p.sim.physics.motor import (
    Axle,
    BatterySpec,
    Drive,
    Gains,
    LeadBattery,
    Motor,
    MotorSpec,
    Pid,
    Threshold,
    speed_gains,
)
from tests.sim.physics.theory import step_response

DT = 1e-4
LOAD = 0.03  # kg m^2 at the wheel
SMOOTH = MotorSpec(friction=0.0)
STEP = 2.0  # rad/s: the current stays under its limit


def axle(spec: MotorSpec = SMOOTH) -> Axle:
    return Axle(Motor(spec), LOAD)


def run(load: Axle, seconds: float) -> None:
    for _ in range(round(seconds / DT)):
        load.step(DT)


def test_a_voltage_gives_its_speed_with_the_time_constant() -> None:
    load = axle()
    load.motor.voltage = 3.0
    run(load, SMOOTH.time_constant(load.inertia))
    assert load.motor.speed == pytest.approx(3.0 * SMOOTH.gain * (1 - math.exp(-1)), rel=1e-3)
    run(load, 5.0)
    assert load.motor.speed == pytest.approx(3.0 * SMOOTH.gain, rel=1e-6)


def test_at_24_v_the_robot_makes_its_2_m_per_s() -> None:
    load = axle(MotorSpec())
    load.motor.voltage = 24.0
    run(load, 5.0)
    assert 2.0 < load.motor.speed * 0.05 < 2.5


def test_the_current_is_chopped_at_the_limit_in_both_directions() -> None:
    load = axle()
    load.motor.voltage = 24.0
    load.step(DT)
    assert load.motor.current == 10.0
    run(load, 2.0)
    load.motor.voltage = -24.0
    load.step(DT)
    assert load.motor.current == -10.0


def test_power_in_is_power_out_and_heat() -> None:
    load = axle()
    load.motor.voltage, load.motor.speed = 6.0, 5.0
    out = load.motor.torque() * 5.0 + SMOOTH.damping * 1e-3 * 5.0**2
    assert 6.0 * load.motor.current == pytest.approx(out + load.motor.current**2 * SMOOTH.resistance)


def test_dry_friction_holds_what_is_too_weak_and_stops_what_rolls() -> None:
    load = axle(MotorSpec(friction=60.0))
    load.motor.voltage = 0.1  # makes 46 mNm
    run(load, 10.0)
    assert 0 <= load.motor.speed < 0.1
    load.motor.voltage, load.motor.speed = 0.0, 20.0
    run(load, 5.0)
    assert abs(load.motor.speed) < 1e-6


def test_the_encoder_counts_28000_ticks_a_turn_both_ways() -> None:
    motor = Motor(MotorSpec())
    motor.speed = math.tau
    motor.turn(math.tau, 1.0)
    assert motor.ticks in (27_999, 28_000)
    motor.speed = -math.tau
    motor.turn(-math.tau, 2.0)
    assert motor.ticks in (-28_001, -28_000)


def rise_and_overshoot(speeds: list[float], final: float) -> tuple[float, float]:
    """Seconds from 10 to 90 %, and by how much it goes over."""
    ten, ninety = (next(i for i, speed in enumerate(speeds) if speed >= share * final) for share in (0.1, 0.9))
    return (ninety - ten) * DT, max(speeds) / final - 1


@pytest.mark.parametrize("damping", [0.5, 0.7, 0.9])
@pytest.mark.parametrize("frequency", [15.0, 30.0])
def test_a_step_of_the_speed_goes_as_the_theory_says(frequency: float, damping: float) -> None:
    load = axle()
    gains = speed_gains(SMOOTH, load.inertia, frequency=frequency, damping=damping)
    pid, setpoint = Pid(gains), STEP * SMOOTH.ticks_per_radian
    speeds: list[float] = []
    for _ in range(round(1.0 / DT)):
        load.motor.voltage = pid.step(setpoint, load.motor.speed * SMOOTH.ticks_per_radian, DT)
        load.step(DT)
        speeds.append(load.motor.speed)
    theory = [STEP * step_response(SMOOTH, load.inertia, gains, i * DT) for i in range(1, len(speeds) + 1)]
    rise, overshoot = rise_and_overshoot(speeds, STEP)
    assert (rise, overshoot) == pytest.approx(rise_and_overshoot(theory, STEP), rel=0.02, abs=0.002)
    assert max(abs(one - other) for one, other in zip(speeds, theory, strict=True)) < 0.02
    assert speeds[-1] == pytest.approx(STEP, rel=1e-3)


def test_the_theory_is_that_of_a_second_order_system() -> None:
    """Known numbers: critical frequencies and damping put the poles where they are asked for."""
    gains = speed_gains(SMOOTH, LOAD, frequency=20.0, damping=0.7)
    gain, tau = SMOOTH.gain * SMOOTH.ticks_per_radian, SMOOTH.time_constant(LOAD)
    assert math.sqrt(gain * gains.ki / tau) == pytest.approx(20.0)
    assert (1 + gain * gains.kp) / (2 * math.sqrt(gain * gains.ki * tau)) == pytest.approx(0.7)
    slope = step_response(SMOOTH, LOAD, gains, 1e-6) / 1e-6
    assert slope == pytest.approx(gain * gains.kp / tau, rel=1e-3)


def test_the_output_saturates_and_the_integral_waits() -> None:
    pid = Pid(Gains(kp=0.0, ki=1.0, limit=24.0))
    for _ in range(1000):
        assert abs(pid.step(100.0, 0.0, 0.1)) <= 24.0
    assert pid.step(100.0, 110.0, 0.1) < 24.0  # at once: nothing has been wound up


def test_the_integral_of_a_saturated_controller_may_go_back() -> None:
    """Saturated by what is not the error, it integrates the error that leads out of saturation."""
    pid = Pid(Gains(kp=1.0, ki=1.0, kd=100.0, limit=5.0))
    assert pid.step(0.0, 10.0, 1.0) == -5.0
    assert pid.step(0.0, 1.0, 1.0) == 5.0  # by the derivative; the error is -1
    assert pid.step(1.0, 1.0, 1.0) == -1.0


def test_a_step_of_the_setpoint_gives_no_kick_of_the_derivative() -> None:
    pid = Pid(Gains(kp=0.0, kd=1.0))
    pid.step(0.0, 1.0, 0.1)
    assert pid.step(100.0, 1.0, 0.1) == 0.0
    assert pid.step(100.0, 1.5, 0.1) == pytest.approx(-5.0)


def test_reset_forgets() -> None:
    pid = Pid(Gains(kp=0.0, ki=1.0, kd=1.0))
    pid.step(1.0, 0.0, 1.0)
    pid.reset()
    assert pid.step(0.0, 5.0, 1.0) == -5.0  # the new error's own integral, no slope


CHANGES = [Gains(3.0, 0.5), Gains(0.1, 20.0, 0.3), Gains(0.0, 0.5), Gains(1.0, 0.5, 0.1, limit=6.0)]


@pytest.mark.parametrize("gains", CHANGES)
def test_new_gains_do_not_make_the_output_jump(gains: Gains) -> None:
    """In the middle of a transient: neither error nor slope nor integral is 0."""
    pid = Pid(Gains(1.0, 2.0, 0.1))
    pid.step(2.0, 0.0, 0.01)
    before = pid.step(2.0, 0.5, 0.01)
    pid.gains = gains
    after = pid.step(2.0, 0.5 + 50e-6, 1e-6)  # at the same slope
    assert after == pytest.approx(before, abs=1e-3)
    assert -6.0 < before < -3.0


def test_new_gains_of_a_saturated_controller_wind_nothing_up() -> None:
    pid = Pid(Gains(1.0, 1.0, limit=5.0))
    pid.step(100.0, 0.0, 0.01)
    pid.gains = Gains(2.0, 1.0, limit=5.0)  # still saturated
    assert pid.step(1.0, 0.0, 0.01) == pytest.approx(2.01)
    pid.gains = Gains(0.0, 1.0, limit=1.5)
    assert pid.step(0.0, 0.1, 0.01) < 1.5


def test_without_an_integral_part_nothing_is_left_of_what_was_integrated() -> None:
    pid = Pid(Gains(1.0, 10.0))
    assert pid.step(2.0, 0.0, 0.1) == 4.0
    pid.gains = Gains(3.0)
    assert pid.step(2.0, 0.0, 0.1) == 6.0
    assert pid.step(0.0, 0.0, 0.1) == 0.0


def test_a_lower_limit_of_the_current_makes_less_torque() -> None:
    load = axle()
    load.motor.voltage, load.motor.current_limit = 24.0, 4.0
    load.step(DT)
    assert load.motor.current == 4.0
    assert load.motor.speed == pytest.approx(4.0 * SMOOTH.constant / load.inertia * DT)


def test_a_threshold_has_a_hysteresis_on_both_sides() -> None:
    low, high = Threshold("below", 23.0, 0.5), Threshold("above", 23.0, 0.5)
    values = [23.0, 22.9, 23.4, 23.5, 23.1, 22.5, 22.4]
    assert [low.update(each) for each in values] == [False, True, False, True, False, True, False]
    assert [high.update(each) for each in values] == [False, False, True, False, False, True, False]
    assert (low.exceeded, high.exceeded) == (True, False)


def test_a_battery_empties_with_the_charge_that_it_gives() -> None:
    battery = LeadBattery()
    battery.current = 7.2
    for _ in range(1800):
        battery.step(1.0)
    assert battery.charge == pytest.approx(0.5)
    assert battery.voltage == pytest.approx(24.4 - 7.2 * 0.06)
    for _ in range(2000):
        battery.step(1.0)
    assert battery.charge == 0.0


def test_a_charger_fills_it_and_no_more() -> None:
    battery = LeadBattery(charge=0.9)
    battery.current = -7.2
    assert battery.voltage > BatterySpec().full
    for _ in range(1000):
        battery.step(1.0)
    assert battery.charge == 1.0


def test_a_regulated_current_gives_its_torque_at_any_speed_that_the_supply_reaches() -> None:
    motor = Motor(SMOOTH)
    motor.regulated = 2.0
    free = [motor.torque_at(speed) + SMOOTH.damping * 1e-3 * speed for speed in (0.0, 10.0, -10.0)]
    assert free == pytest.approx([2.0 * SMOOTH.constant] * 3)
    assert motor.voltage == pytest.approx(2.0 * SMOOTH.resistance - 10.0 * SMOOTH.constant)
    top = SMOOTH.voltage / SMOOTH.constant  # rad/s: all of the supply is back EMF
    assert motor.torque_at(top) + SMOOTH.damping * 1e-3 * top == pytest.approx(0.0, abs=1e-9)
    assert motor.voltage == SMOOTH.voltage
    motor.regulated = 50.0
    motor.torque_at(0.0)
    assert motor.current == motor.current_limit


def test_a_drive_sets_a_voltage_or_a_torque_and_brakes_without_one() -> None:
    load = axle()
    drive = Drive(load.motor, Gains(0.0, limit=5.0), mode="voltage")
    drive.step(DT)
    assert load.motor.voltage == 0.0
    drive.setpoint = 9.0
    drive.step(DT)
    assert load.motor.voltage == 5.0
    drive = Drive(load.motor, mode="torque")
    drive.setpoint = 0.5  # Nm
    drive.step(DT)
    load.step(DT)
    assert load.motor.speed == pytest.approx(0.5 / load.inertia * DT)
    drive.stop()
    drive.step(DT)
    load.step(DT)
    assert (load.motor.voltage, load.motor.regulated) == (0.0, None)
    assert load.motor.current < 0.0  # it brakes


def test_a_measured_slope_takes_the_place_of_the_difference() -> None:
    pid = Pid(Gains(kp=0.0, kd=2.0))
    assert pid.step(0.0, 1.0, 0.1, 3.0) == -6.0
    assert pid.step(0.0, 5.0, 0.1, 0.0) == 0.0
    assert pid.step(0.0, 6.0, 0.1) == pytest.approx(-20.0)
