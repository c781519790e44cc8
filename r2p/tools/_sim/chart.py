"""A small map of the world in characters: walls, where the robot was, and where it is."""

import math

from r2p.sim.physics.omni import Triple
from r2p.sim.physics.world import Wall, World

_ASPECT = 2.0  # a character is twice as high as wide
_MARGIN = 0.3  # m
_LEAST = 2.0  # m: no map shows less
_WALL, _TRACE = "#", "."
_ARROWS = ">^<v"


class Chart:
    """A map of so many characters; north, the y axis, is up. It grows with the way that the robot goes."""

    def __init__(self, world: World, width: int, height: int) -> None:
        self._world = world
        self._width = width
        self._height = height
        self._trace: set[tuple[float, float]] = set()

    def draw(self, pose: Triple) -> str:
        """The map, with the robot there."""
        x, y, heading = pose
        self._trace.add((round(x, 1), round(y, 1)))
        points = [*self._trace, *(point for wall in self._world.walls for point in wall)]
        left, right = min(p[0] for p in points) - _MARGIN, max(p[0] for p in points) + _MARGIN
        low, high = min(p[1] for p in points) - _MARGIN, max(p[1] for p in points) + _MARGIN
        across, up = max(_LEAST, right - left), max(_LEAST, high - low)
        scale = max(across / self._width, up / self._height / _ASPECT)  # m for each character's width
        cells = [[" "] * self._width for _ in range(self._height)]

        def put(px: float, py: float, sign: str) -> None:
            column = round((px - (left + right) / 2) / scale + (self._width - 1) / 2)
            row = round(((low + high) / 2 - py) / scale / _ASPECT + (self._height - 1) / 2)
            if 0 <= column < self._width and 0 <= row < self._height:
                cells[row][column] = sign

        for px, py in self._trace:
            put(px, py, _TRACE)
        for wall in self._world.walls:
            for px, py in _along(wall, scale / 2):
                put(px, py, _WALL)
        put(x, y, _ARROWS[round(heading / (math.pi / 2)) % 4])
        return "\n".join("".join(line) for line in cells)


def _along(wall: Wall, step: float) -> list[tuple[float, float]]:
    (ax, ay), (bx, by) = wall
    count = max(1, math.ceil(math.dist((ax, ay), (bx, by)) / step))
    return [(ax + (bx - ax) * i / count, ay + (by - ay) * i / count) for i in range(count + 1)]
