"""A map of the world in characters, for a terminal."""

import math
from collections.abc import Iterable

from rich.text import Text

from r2p.sim.physics.world import Point, Triple, Wall, World

_ASPECT = 2.0  # a character is twice as high as wide
_MARGIN = 0.3  # m around walls and path
_EXTENT_MIN = 2.0  # m
_WALL, _PATH, _MARK = "#", ".", "+"
_ARROWS = ">^<v"


class WorldMap:
    """A map in characters: walls, the robot's path, and its pose. The y axis is up; the map grows with the path."""

    def __init__(self, world: World, width: int, height: int) -> None:
        self._world = world
        self._width = width
        self._height = height
        self._path: set[tuple[float, float]] = set()

    def draw(self, pose: Triple, marks: Iterable[Point] = ()) -> str:
        """Return the map with the robot at this pose, which is added to the path, and marks under the path."""
        x, y, heading = pose
        self._path.add((round(x, 1), round(y, 1)))
        points = [*self._path, *(point for wall in self._world.walls for point in wall)]
        left, right = min(p[0] for p in points) - _MARGIN, max(p[0] for p in points) + _MARGIN
        low, high = min(p[1] for p in points) - _MARGIN, max(p[1] for p in points) + _MARGIN
        across, up = max(_EXTENT_MIN, right - left), max(_EXTENT_MIN, high - low)
        scale = max(across / self._width, up / self._height / _ASPECT)  # m for each character's width
        cells = [[" "] * self._width for _ in range(self._height)]

        def put(px: float, py: float, sign: str) -> None:
            column = round((px - (left + right) / 2) / scale + (self._width - 1) / 2)
            row = round(((low + high) / 2 - py) / scale / _ASPECT + (self._height - 1) / 2)
            if 0 <= column < self._width and 0 <= row < self._height:
                cells[row][column] = sign

        for px, py in marks:
            put(px, py, _MARK)
        for px, py in self._path:
            put(px, py, _PATH)
        for wall in self._world.walls:
            for px, py in _along(wall, scale / 2):
                put(px, py, _WALL)
        put(x, y, _ARROWS[round(heading / (math.pi / 2)) % 4])
        return "\n".join("".join(line) for line in cells)


def _along(wall: Wall, step: float) -> list[tuple[float, float]]:
    (ax, ay), (bx, by) = wall
    count = max(1, math.ceil(math.dist((ax, ay), (bx, by)) / step))
    return [(ax + (bx - ax) * i / count, ay + (by - ay) * i / count) for i in range(count + 1)]


def coloured(drawing: str) -> Text:
    """Return a map in colours."""
    text = Text(drawing, style="green")
    text.highlight_regex("#+", "dim default")
    text.highlight_regex(r"\+", "cyan")
    text.highlight_regex(r"[<>^v]", "bold yellow")
    return text
