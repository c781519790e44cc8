"""A flat world of walls and boxes, and rays through it."""

import math
from collections.abc import Iterable, Iterator

Point = tuple[float, float]
Wall = tuple[Point, Point]


class World:
    """Walls (m) that stop rays; nothing stops the robot but itself."""

    def __init__(self, walls: Iterable[Wall] = ()) -> None:
        self.walls = list(walls)

    def add_box(self, x: float, y: float, width: float, depth: float) -> None:
        """A box with its centre there and sides of `width` (along x) and `depth` (along y), m."""
        self.walls += box(x, y, width, depth)

    def distance(self, x: float, y: float, angle: float) -> float:
        """How far a ray from there (angle in rad from the x axis) goes before it meets a wall, m; inf: it does not."""
        dx, dy = math.cos(angle), math.sin(angle)
        return min(self._hits(x, y, dx, dy), default=math.inf)

    def clearance(self, x: float, y: float) -> float:
        """From there to the nearest wall, m."""
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
    """The four walls of a box."""
    left, right, low, high = x - width / 2, x + width / 2, y - depth / 2, y + depth / 2
    corners = [(left, low), (right, low), (right, high), (left, high)]
    return list(zip(corners, corners[1:] + corners[:1], strict=True))


def _to_wall(x: float, y: float, wall: Wall) -> float:
    (ax, ay), (bx, by) = wall
    ex, ey = bx - ax, by - ay
    along = ((x - ax) * ex + (y - ay) * ey) / ((ex * ex + ey * ey) or 1.0)
    along = max(0.0, min(1.0, along))
    return math.hypot(ax + along * ex - x, ay + along * ey - y)
