"""Inertial sensors by their data sheets, and the filter that makes an attitude of them."""

import math
import random
import statistics

import pytest

from r2p.sim.physics.inertial import (
    ACCELEROMETER,
    BAROMETER_NOISE,
    GYROSCOPE,
    MAGNETOMETER,
    AccelerometerRange,
    ComplementaryFilter,
    MemsSensor,
    MemsSpec,
    Vector,
    altitude_at,
    pressure_at,
    to_body,
    to_world,
)

DT = 1e-3
FIELD: Vector = (220.0, 0.0, -400.0)  # mgauss: north and down


def samples(spec: MemsSpec, count: int, truth: Vector = (0.0, 0.0, 0.0)) -> list[Vector]:
    sensor = MemsSensor(spec, random.Random(5))
    seen: list[Vector] = []
    while len(seen) < count:
        if sensor.step(truth, DT):
            seen.append(sensor.values)
    return seen


@pytest.mark.parametrize("spec", [ACCELEROMETER, GYROSCOPE, MAGNETOMETER])
def test_it_samples_at_its_rate_with_the_noise_of_its_density(spec: MemsSpec) -> None:
    sensor = MemsSensor(spec, random.Random(5))
    readings = [sensor.values[0] for _ in range(10_000) if sensor.step((0.0, 0.0, 0.0), DT)]
    assert sensor.samples == pytest.approx(10 * spec.rate, abs=1)
    quantum = spec.resolution / math.sqrt(12)
    assert statistics.stdev(readings) == pytest.approx(
        math.hypot(spec.density * math.sqrt(spec.rate / 2), quantum), rel=0.05
    )


def test_each_axis_has_a_bias_that_it_keeps() -> None:
    """Far more than what is left of the noise: some 10 mdps."""
    readings = samples(GYROSCOPE, 4000)
    before, after = (
        [statistics.mean(part) for part in zip(*half, strict=True)] for half in (readings[:2000], readings[2000:])
    )
    assert before == pytest.approx(after, abs=50)
    assert all(50 < abs(mean) < 4 * GYROSCOPE.bias for mean in before)
    assert statistics.stdev(before) > 100


def test_values_are_counts_of_the_resolution_within_the_full_scale() -> None:
    spec = MemsSpec(resolution=1.0, full_scale=2000.0, rate=1000.0, density=0.0, bias=0.0)
    sensor = MemsSensor(spec, random.Random(5))
    sensor.step((999.6, -5000.0, 5000.0), DT)
    assert sensor.counts == (1000, -2000, 2000)


def test_another_range_applies_from_the_next_sample_on() -> None:
    sensor = MemsSensor(
        MemsSpec(resolution=1.0, full_scale=2000.0, rate=500.0, density=0.0, bias=0.0), random.Random(5)
    )
    steps = [sensor.step((5000.0, 0.0, -30.0), DT) for _ in range(2)]
    sensor.set_range(*AccelerometerRange["16g"].value)
    assert steps == [False, True]
    assert sensor.values == (2000.0, 0.0, -30.0)
    sensor.step((5000.0, 0.0, -30.0), 2 * DT)
    assert sensor.counts == (417, 0, -2)
    assert sensor.values == (5004.0, 0.0, -24.0)


def test_air_pressure_and_altitude_are_one_another() -> None:
    assert pressure_at(0) == 101_325
    assert altitude_at(pressure_at(120.0)) == pytest.approx(120.0)
    noise = random.Random(1)
    heights = [altitude_at(pressure_at(120.0) + noise.gauss(0, BAROMETER_NOISE)) for _ in range(500)]
    assert statistics.stdev(heights) == pytest.approx(0.17, abs=0.03)  # under 20 cm, thesis 7.4.1


@pytest.mark.parametrize("axis", range(3))
def test_the_gyroscope_alone_turns_the_attitude(axis: int) -> None:
    attitude = ComplementaryFilter(gain=0.0, bias_gain=0.0)
    rates: Vector = (0.5 * (axis == 0), 0.5 * (axis == 1), 0.5 * (axis == 2))
    for _ in range(1000):
        attitude.step(rates, (0, 0, 1), FIELD, DT)
    assert attitude.angles[axis] == pytest.approx(0.5, abs=1e-4)


@pytest.mark.parametrize("truth", [(0.3, 0.0, 0.0), (0.0, -0.4, 0.0), (0.0, 0.0, 2.0), (0.2, 0.3, -1.0)])
def test_at_rest_the_directions_win_and_the_bias_is_learnt(truth: Vector) -> None:
    """Whatever it believed first, and however wrong the gyroscope is."""
    tilted = ComplementaryFilter()
    roll, pitch, yaw = (angle / 2 for angle in truth)
    cr, sr, cp, sp, cy, sy = (f(a) for a in (roll, pitch, yaw) for f in (math.cos, math.sin))
    q = (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )
    up, field = to_body(q, (0, 0, 1)), to_body(q, FIELD)
    for _ in range(20_000):
        tilted.step((0.01, -0.02, 0.03), up, field, 4 * DT)
    assert tilted.angles == pytest.approx(truth, abs=1e-3)
    assert tilted.bias == pytest.approx((0.01, -0.02, 0.03), abs=1e-3)


def test_world_and_body_are_inverse() -> None:
    q = (0.5, 0.5, -0.5, 0.5)
    assert to_body(q, to_world(q, (1.0, 2.0, 3.0))) == pytest.approx((1.0, 2.0, 3.0))
    assert to_world(q, (1.0, 0.0, 0.0)) != pytest.approx((1.0, 0.0, 0.0))
