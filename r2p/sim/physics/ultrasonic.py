"""Ultrasonic range finders: echoes in a flat world, and a sensor that reports their time of flight as a pulse.

To a wavelength of 8 mm a wall is a mirror. Its echo returns to where the sound came from only from the point that
faces the sensor: a wall at a shallow angle is silent, however near it is. An edge scatters a little in all directions.
A sensor also hears the sound of another one that was fired at the same time, over whatever mirrors it there.
"""

import math
import random
from collections.abc import Iterator

import msgspec

from r2p.sim.physics.world import Point, Wall, World

_TOLERANCE = 1e-6  # m: a wall does not hide the point on itself
_CAPTURE = 1e-6  # s: a count of the timer that captures the pulse


def speed_of_sound(temperature: float) -> float:
    """Return the speed of sound in dry air, m/s, at a temperature in degrees Celsius."""
    return 331.3 * math.sqrt(1 + temperature / 273.15)


class Beam(msgspec.Struct, frozen=True):
    """Where a sensor is, and what is in its cone."""

    x: float
    y: float
    """m."""
    angle: float
    """Direction, rad from the x axis."""
    half_angle: float
    """Of the cone, rad."""

    def contains(self, point: Point) -> bool:
        """Return whether a point is in the cone, at any distance."""
        off = math.atan2(point[1] - self.y, point[0] - self.x) - self.angle
        return abs(math.remainder(off, math.tau)) <= self.half_angle

    def sees(self, point: Point, world: World) -> bool:
        """Return whether a point is in the cone, and no wall is before it."""
        if not self.contains(point):
            return False
        dx, dy = point[0] - self.x, point[1] - self.y
        return world.distance(self.x, self.y, math.atan2(dy, dx)) >= math.hypot(dx, dy) - _TOLERANCE


def echo(world: World, source: Beam, receiver: Beam, edges: float = 1.0) -> float:
    """Return half the length (m) of the shortest way of sound from one beam to another, or the same; or infinity.

    `edges`: half the longest way (m) over an edge that still gives an echo.
    """
    mirrored = ((point, length) for wall in world.walls for point, length in _reflections(wall, source, receiver))
    scattered = (
        (point, length)
        for point in {point for wall in world.walls for point in wall}
        if (length := (_distance(source, point) + _distance(receiver, point)) / 2) <= edges
    )
    ways = sorted([*mirrored, *scattered], key=lambda way: way[1])
    heard = (length for point, length in ways if source.sees(point, world) and receiver.sees(point, world))
    return next(heard, math.inf)


def _reflections(wall: Wall, source: Beam, receiver: Beam) -> Iterator[tuple[Point, float]]:
    """Return the point at which a wall mirrors the sound, and half the length of its way, if it does."""
    (ax, ay), (bx, by) = wall
    length = math.hypot(bx - ax, by - ay)
    if not length:
        return
    ex, ey = (bx - ax) / length, (by - ay) / length
    along, above = _beside(source, ax, ay, ex, ey)
    other, height = _beside(receiver, ax, ay, ex, ey)
    if above * height <= 0:  # on both sides of it
        return
    at = along + (other - along) * above / (above + height)
    if 0 <= at <= length:
        yield (ax + at * ex, ay + at * ey), math.hypot(other - along, above + height) / 2


def _beside(beam: Beam, x: float, y: float, ex: float, ey: float) -> tuple[float, float]:
    """Return how far along a wall a sensor is, and how far from it; m."""
    dx, dy = beam.x - x, beam.y - y
    return dx * ex + dy * ey, dy * ex - dx * ey


def _distance(beam: Beam, point: Point) -> float:
    return math.hypot(point[0] - beam.x, point[1] - beam.y)


class SonarSpec(msgspec.Struct, frozen=True, kw_only=True):
    """Data sheet. Default: about a MaxBotix LV-MaxSonar-EZ1, whose pulse is as long as the sound's flight."""

    shortest: float = 0.152
    """A nearer object reads as if it was there, because the sensor still rings, m."""
    step: float = 147e-6
    """Resolution of the pulse, s: an inch."""
    silent: float = 37.5e-3
    """The pulse without an echo, s: the sensor waits no longer."""
    half_angle: float = math.radians(20)
    """rad."""
    noise: float = 30e-6
    """Of the time of flight, one sigma, s."""


class Sonar:
    """One sensor."""

    def __init__(self, spec: SonarSpec, noise: random.Random) -> None:
        self.spec = spec
        self._noise = noise

    def pulse(self, distance: float, temperature: float) -> float:
        """Return the length of the pulse (s) for an echo from a distance (m, or infinity), at degrees Celsius."""
        spec, sound = self.spec, speed_of_sound(temperature)
        if distance == math.inf:
            return spec.silent
        flight = 2 * max(spec.shortest, distance) / sound + self._noise.gauss(0, spec.noise)
        return min(spec.silent, round(flight / spec.step) * spec.step)


def captured(pulse: float) -> int:
    """Return the counts of the timer that captures a pulse: microseconds."""
    return round(pulse / _CAPTURE)
