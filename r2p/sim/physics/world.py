"""A flat world of walls and boxes, and the range finders that measure it.

The range finder is of Sharp's GP2Y series; `millimetres` is what the proximity module computes from its voltage.
"""

import math
import random
from collections.abc import Iterable, Iterator

import msgspec

Point = tuple[float, float]
Wall = tuple[Point, Point]

NOTHING = 65535
"""The reading in mm when nothing is in range."""

_ADC = 4095  # counts of 12 bits
_REFERENCE = 3.3  # V


class World:
    """Walls (coordinates in m) that stop rays, but not the robot."""

    def __init__(self, walls: Iterable[Wall] = ()) -> None:
        self.walls = list(walls)

    def add_box(self, x: float, y: float, width: float, depth: float) -> None:
        """Add a box by its centre, and its sides `width` (along x) and `depth` (along y), m."""
        self.walls += box(x, y, width, depth)

    def distance(self, x: float, y: float, angle: float) -> float:
        """Return the distance (m) to the first wall on a ray at `angle` (rad from the x axis), or infinity."""
        dx, dy = math.cos(angle), math.sin(angle)
        return min(self._hits(x, y, dx, dy), default=math.inf)

    def clearance(self, x: float, y: float) -> float:
        """Return the distance to the nearest wall, m."""
        return min((_to_wall(x, y, wall) for wall in self.walls), default=math.inf)

    def _hits(self, x: float, y: float, dx: float, dy: float) -> Iterator[float]:
        for (ax, ay), (bx, by) in self.walls:
            ex, ey = bx - ax, by - ay
            across = dx * ey - dy * ex
            if not across:  # parallel
                continue
            far = ((ax - x) * ey - (ay - y) * ex) / across
            along = ((ax - x) * dy - (ay - y) * dx) / across
            if far >= 0 and 0 <= along <= 1:
                yield far


def box(x: float, y: float, width: float, depth: float) -> list[Wall]:
    """Return the four walls of a box."""
    left, right, low, high = x - width / 2, x + width / 2, y - depth / 2, y + depth / 2
    corners = [(left, low), (right, low), (right, high), (left, high)]
    return list(zip(corners, corners[1:] + corners[:1], strict=True))


def _to_wall(x: float, y: float, wall: Wall) -> float:
    (ax, ay), (bx, by) = wall
    ex, ey = bx - ax, by - ay
    along = ((x - ax) * ex + (y - ay) * ey) / ((ex * ex + ey * ey) or 1.0)
    along = max(0.0, min(1.0, along))
    return math.hypot(ax + along * ex - x, ay + along * ey - y)


class RangeSpec(msgspec.Struct, frozen=True, kw_only=True):
    """Data sheet. Default: about a GP2Y0A21, 100 to 800 mm."""

    shortest: float = 100.0
    """mm."""
    longest: float = 800.0
    """mm."""
    scale: float = 339.0
    """Of the curve `scale / (distance + offset)`, V mm."""
    offset: float = 47.0
    """mm."""
    noise: float = 3.0
    """Of the voltage, one sigma, mV."""

    def voltage(self, distance: float) -> float:
        """Return the output (V) at a distance (mm); below the shortest distance it falls to 0 again."""
        peak = self.scale / (self.shortest + self.offset)
        if distance < self.shortest:
            return peak * distance / self.shortest
        return self.scale / (distance + self.offset)


class RangeFinder:
    """One sensor, and its input of the A/D converter."""

    def __init__(self, spec: RangeSpec, noise: random.Random) -> None:
        self.spec = spec
        self._noise = noise

    def read(self, distance: float) -> int:
        """Return the counts of the A/D converter for an object at a distance (mm, or infinity)."""
        voltage = self.spec.voltage(distance) + self._noise.gauss(0, self.spec.noise * 1e-3)
        return max(0, min(_ADC, round(voltage / _REFERENCE * _ADC)))

    def millimetres(self, counts: int) -> int:
        """Return the distance (mm) that firmware computes from counts; NOTHING beyond the longest range."""
        voltage = counts * _REFERENCE / _ADC
        spec = self.spec
        if voltage <= spec.scale / (spec.longest + spec.offset):
            return NOTHING
        return max(0, round(spec.scale / voltage - spec.offset))
