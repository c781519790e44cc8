"""Shows the figures of a robot: live at a terminal, in 80 columns and 24 lines; otherwise as lines of plain text.

A smaller terminal gets less of them: first the map goes, then topics. The hints stay.
"""

import math
from collections.abc import Iterable
from typing import Self

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from r2p.sim.physics.omni import Triple
from r2p.sim.physics.world import Wall, World
from r2p.sim.robots.figures import BusFigures, Figures, TopicFigures, WheelFigures

_STATE = 48  # columns of the figures beside the map
_WIDTH, _HEIGHT = 28, 9  # of the map
_LABEL = 10  # columns
_WIDE = 72  # ... of the whole table
_FULL = _STATE + 2 + _WIDTH  # ... of figures and map

_ASPECT = 2.0  # a character is twice as high as wide
_MARGIN = 0.3  # m around walls and path
_EXTENT_MIN = 2.0  # m
_WALL, _PATH = "#", "."
_ARROWS = ">^<v"


class SimulatorScreen:
    """Standard output, for the time of a `with` block."""

    def __init__(self, world: World, *, live: bool = True, duration: float | None = None) -> None:
        """`duration` in s, if it is known."""
        self.console = Console(highlight=False)
        self.live = live and self.console.is_terminal and not self.console.is_dumb_terminal
        """Whether the figures are drawn in place."""
        self._duration = duration
        self._map = Map(world, _WIDTH, _HEIGHT)
        self._view = Live(console=self.console, auto_refresh=False)
        self._hints: list[str] = []

    def __enter__(self) -> Self:
        if self.live:
            self._view.start()
        return self

    def __exit__(self, *_exception: object) -> None:
        self._view.stop()

    def print(self, *lines: str) -> None:
        """Print lines."""
        for line in lines:
            self.console.print(line, markup=False, soft_wrap=True)

    def print_hints(self, *hints: str) -> None:
        """Show hints for what to do meanwhile; they stay on the screen."""
        self._hints = list(hints)
        if not self.live:
            self.print(*hints)

    def show(self, figures: Figures) -> None:
        """Draw the figures, or print a line about them."""
        if self.live:
            self._view.update(self.draw(figures), refresh=True)
        else:
            self.print(line(figures))

    def draw(self, figures: Figures) -> RenderableType:
        """Return the figures, as many as fit the terminal."""
        width, height = self.console.size
        lines = state(figures)
        upper = Table.grid(padding=(0, 2))
        upper.add_column(width=min(_STATE, width), no_wrap=True)
        if width >= _FULL:
            upper.add_row(_labelled(lines), _coloured(self._map.draw(figures.pose)))
        else:
            upper.add_row(_labelled(lines))
        hints = sum(math.ceil(len(hint) / width) for hint in self._hints)
        rows = height - 1 - max(len(lines), _HEIGHT) - 1 - hints  # without the title, and the head of the table
        parts: list[RenderableType] = [_title(figures, self._duration, min(width, _FULL)), upper]
        if rows > 0:
            parts.append(_table(figures.topics[:rows], names_only=width < _WIDE))
        return Group(*parts, *map(_hint, self._hints))


def _title(figures: Figures, duration: float | None, width: int) -> Text:
    """Return the title line: how long, how far, and how many deadlines were missed."""
    until = f" of {duration:.0f}" if duration else ""
    late = f"{figures.missed or 'no'} deadline{'' if figures.missed == 1 else 's'} missed"
    text = f" Triskar2   {figures.time:.1f}{until} s   {figures.path:.2f} m driven  "
    return Text(f"{text:{max(0, width - len(late) - 1)}}{late} ", style="bold reverse", no_wrap=True)


def state(figures: Figures) -> list[str]:
    """Return nine lines of 48 characters about the robot and its bus."""
    x, y, w = figures.pose
    off = "" if figures.off is None else f"  off by {figures.off * 1000:.0f} mm"
    odometry = figures.odometry.pose if figures.odometry else None
    volts, amperes, charge = figures.battery
    return [
        f"position  x {x:z6.2f}  y {y:z6.2f} m  heading {math.degrees(w):z4.0f} deg",
        f"odometry  x {odometry.x:z6.2f}  y {odometry.y:z6.2f} m{off}" if odometry else "odometry  nothing yet",
        "motors     wanted     speed (rad/s)    current",
        *(_wheel(wheel) for wheel in figures.wheels),
        f"battery   {volts:.1f} V  {amperes:.1f} A  {charge:.0%}",
        *bus_lines(figures.bus),
    ]


def bus_lines(bus: BusFigures | None) -> list[str]:
    """Return two lines about the bus."""
    if bus is None:
        return ["CAN bus   none: a network in memory"]
    slots = f"{bus.of} in a cycle, {bus.slots:.1f} of them reserved" if bus.of else "none: no master yet"
    return [f"CAN bus   {bus.load:.0%} load  {bus.rate:.0f} frames/s  {bus.errors} errors", f"slots     {slots}"]


def line(figures: Figures) -> str:
    """Return one line of plain text, at most 80 characters."""
    x, y, w = figures.pose
    speeds = " ".join(f"{wheel.speed:z6.2f}" for wheel in figures.wheels)
    bus = "" if figures.bus is None else f"  bus {figures.bus.load:4.0%}"
    return f"{figures.time:6.1f} s  at {x:z5.2f} {y:z5.2f} m {math.degrees(w):z4.0f} deg  wheels {speeds}{bus}"


def _wheel(wheel: WheelFigures) -> str:
    if not wheel.on:
        return f"{wheel.name}    switched off"
    wanted = "stopped" if wheel.setpoint is None else f"{wheel.setpoint:z7.2f}"
    return f"{wheel.name}    {wanted:>7}   {wheel.speed:z7.2f}          {wheel.current:z6.2f} A"


def _table(topics: Iterable[TopicFigures], *, names_only: bool) -> Table:
    table = Table(box=None, pad_edge=False, collapse_padding=True, header_style="bold")
    table.add_column("TOPIC", min_width=13, no_wrap=True)
    for name, width in () if names_only else (("FROM", 8), ("REAL TIME", 17)):
        table.add_column(name, min_width=width, no_wrap=True)
    for name in ("HZ", "COUNT", "MISSED"):
        table.add_column(name, justify="right", min_width=8, no_wrap=True)
    for each in topics:
        details = () if names_only else (each.source, each.real_time)
        missed = Text(str(each.missed), style="bold red" if each.missed else "")
        table.add_row(each.topic, *details, f"{each.rate:.1f}", str(each.sent), missed)
    return table


def _labelled(lines: list[str]) -> Text:
    text = Text("\n".join(lines))
    start = 0
    for each in lines:
        text.stylize("bold", start, start + _LABEL)
        start += len(each) + 1
    return text


def _coloured(drawing: str) -> Text:
    text = Text(drawing, style="green")
    text.highlight_regex("#+", "dim default")
    text.highlight_regex(r"[<>^v]", "bold yellow")
    return text


def _hint(hint: str) -> Text:
    """Return a hint in its style; commands are indented."""
    return Text(hint, style="cyan" if hint.startswith(" ") else "bold")


class Map:
    """A map in characters: walls, the robot's path, and its pose. The y axis is up; the map grows with the path."""

    def __init__(self, world: World, width: int, height: int) -> None:
        self._world = world
        self._width = width
        self._height = height
        self._path: set[tuple[float, float]] = set()

    def draw(self, pose: Triple) -> str:
        """Return the map with the robot at this pose, which is added to the path."""
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
