"""Echoes by the geometry of mirrors, and the pulse of a sensor by the time of flight."""

import math
import random
import statistics

import pytest

from r2p.sim.physics.ultrasonic import Beam, Sonar, SonarSpec, captured, echo, speed_of_sound
from r2p.sim.physics.world import World

CONE = math.radians(20)
AHEAD = Beam(0.0, 0.0, 0.0, CONE)
EXACT = SonarSpec(noise=0.0)


def wall(distance: float, angle: float, half: float = 5.0) -> World:
    """A wall across the x axis, turned by `angle` degrees against what faces the sensor."""
    x, y = -math.sin(math.radians(angle)) * half, math.cos(math.radians(angle)) * half
    return World([((distance + x, y), (distance - x, -y))])


def test_a_wall_that_faces_the_sensor_is_as_far_as_it_is() -> None:
    assert echo(wall(2.0, 0.0), AHEAD, AHEAD) == pytest.approx(2.0)


@pytest.mark.parametrize("angle", [5.0, 10.0, 19.0, -19.0])
def test_of_a_wall_at_an_angle_it_hears_the_point_that_faces_it(angle: float) -> None:
    assert echo(wall(2.0, angle), AHEAD, AHEAD) == pytest.approx(2.0 * math.cos(math.radians(angle)))


@pytest.mark.parametrize("angle", [21.0, -21.0, 45.0, 80.0])
def test_a_wall_at_a_shallow_angle_is_silent(angle: float) -> None:
    assert echo(wall(0.5, angle), AHEAD, AHEAD) == math.inf


def test_what_is_behind_the_sensor_or_hidden_is_silent() -> None:
    world = wall(-1.0, 0.0)
    assert echo(world, AHEAD, AHEAD) == math.inf
    world.walls += [*wall(1.0, 30.0).walls, *wall(2.0, 0.0).walls]
    assert echo(world, AHEAD, AHEAD) == math.inf, "the wall at an angle hides the one that faces the sensor"


def test_an_edge_is_heard_when_it_is_near() -> None:
    near, far = World([((0.6, 0.0), (3.0, 0.3))]), World([((1.5, 0.0), (3.0, 0.3))])
    assert echo(near, AHEAD, AHEAD) == pytest.approx(0.6)
    assert echo(far, AHEAD, AHEAD) == math.inf


def test_a_sensor_hears_another_one_by_the_law_of_reflection() -> None:
    """From the image of the source behind the wall: sqrt(d^2 + (s/2)^2) for two that are s apart, d before a wall."""
    one, other = Beam(0.0, 0.2, 0.0, CONE), Beam(0.0, -0.2, 0.0, CONE)
    assert echo(wall(1.0, 0.0), one, other) == pytest.approx(math.hypot(1.0, 0.2))
    assert echo(wall(0.4, 0.0), one, other) == math.inf, "too near: the point between them is beyond both cones"
    facing = Beam(2.0, 0.0, math.pi, CONE)
    assert echo(wall(1.0, 0.0), AHEAD, facing) == math.inf, "the wall is between them"


def test_the_speed_of_sound() -> None:
    assert speed_of_sound(20.0) == pytest.approx(343.2, abs=0.1)
    assert speed_of_sound(0.0) == pytest.approx(331.3)


@pytest.mark.parametrize(("distance", "temperature"), [(0.5, 20.0), (2.0, 0.0), (5.0, 35.0)])
def test_the_pulse_is_the_time_of_flight_to_half_an_inch(distance: float, temperature: float) -> None:
    pulse = Sonar(EXACT, random.Random(1)).pulse(distance, temperature)
    assert pulse == pytest.approx(2 * distance / speed_of_sound(temperature), abs=EXACT.step / 2)
    assert captured(pulse) == round(pulse * 1e6)


def test_too_near_and_too_far() -> None:
    sensor = Sonar(EXACT, random.Random(1))
    assert sensor.pulse(0.01, 20.0) == sensor.pulse(EXACT.shortest, 20.0)
    assert sensor.pulse(math.inf, 20.0) == sensor.pulse(7.0, 20.0) == EXACT.silent


def test_noise_and_resolution_spread_the_pulse_as_they_should() -> None:
    """Noise and a uniform rounding error of one step add their squares."""
    spec = SonarSpec(noise=200e-6)
    sensor = Sonar(spec, random.Random(1))
    spread = statistics.stdev(sensor.pulse(2.0, 20.0) for _ in range(2000))
    assert spread == pytest.approx(math.hypot(spec.noise, spec.step / math.sqrt(12)), rel=0.1)
