"""Battery, range finders and the world that they measure."""

import math
import random
import statistics

import pytest

from r2p.sim.physics.motor import Battery, BatterySpec
from r2p.sim.physics.world import NOTHING, RangeFinder, RangeSpec, World


def test_a_battery_empties_with_the_charge_that_it_gives() -> None:
    battery = Battery()
    battery.current = 7.2
    for _ in range(1800):
        battery.step(1.0)
    assert battery.charge == pytest.approx(0.5)
    assert battery.voltage == pytest.approx(24.4 - 7.2 * 0.06)
    for _ in range(2000):
        battery.step(1.0)
    assert battery.charge == 0.0


def test_a_charger_fills_it_and_no_more() -> None:
    battery = Battery(charge=0.9)
    battery.current = -7.2
    assert battery.voltage > BatterySpec().full
    for _ in range(1000):
        battery.step(1.0)
    assert battery.charge == 1.0


def finder(**spec: float) -> RangeFinder:
    return RangeFinder(RangeSpec(**spec), random.Random(3))


@pytest.mark.parametrize("distance", [100, 150, 250, 400, 700])
def test_without_noise_the_correction_gives_the_distance_back(distance: int) -> None:
    """As far as the A/D converter can tell: one count is less than a millimetre near by, more far away."""
    sensor = finder(noise=0.0)
    assert sensor.millimetres(sensor.read(distance)) == pytest.approx(distance, abs=2)


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


def test_clearance_is_to_the_nearest_point_of_a_wall() -> None:
    world = World()
    assert world.clearance(0, 0) == math.inf
    world.add_box(2.0, 0.0, 1.0, 1.0)
    assert world.clearance(0, 0) == pytest.approx(1.5)
    assert world.clearance(0.5, 1.5) == pytest.approx(math.hypot(1.0, 1.0))
