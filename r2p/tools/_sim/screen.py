"""How the figures are shown: at a terminal all of them, live, in 80 columns and 24 lines; else lines of plain text."""

import math
from collections.abc import Iterable
from typing import Self

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from r2p.sim.physics.world import World
from r2p.sim.robots.figures import BusFigures, Figures, TopicFigures, WheelFigures
from r2p.tools._sim.chart import Chart

_WIDTH, _HEIGHT = 28, 10  # of the map
_TOPICS = 10  # lines


class Screen:
    """Standard output, for the time of a `with` block."""

    def __init__(self, world: World, *, live: bool = True) -> None:
        self.console = Console(highlight=False)
        self.live = live and self.console.is_terminal and not self.console.is_dumb_terminal
        """Whether the figures stay where they are."""
        self._chart = Chart(world, _WIDTH, _HEIGHT)
        self._view = Live(console=self.console, auto_refresh=False)
        self._hints: list[str] = []

    def __enter__(self) -> Self:
        if self.live:
            self._view.start()
        return self

    def __exit__(self, *_exception: object) -> None:
        self._view.stop()

    def say(self, *lines: str) -> None:
        """Print lines."""
        for line in lines:
            self.console.print(line, markup=False, soft_wrap=True)

    def introduce(self, *hints: str) -> None:
        """Say what can be done meanwhile; it stays on the screen."""
        self._hints = list(hints)
        if not self.live:
            self.say(*hints)

    def show(self, figures: Figures) -> None:
        """Draw the figures, or print a line of them."""
        if not self.live:
            self.say(line(figures))
            return
        upper = Table.grid(padding=(0, 2))
        upper.add_column(min_width=46)
        upper.add_column(min_width=_WIDTH)
        upper.add_row(Text("\n".join(state(figures))), Text(self._chart.draw(figures.pose), style="green"))
        self._view.update(Group(upper, _table(figures.topics), Text("\n".join(self._hints), style="dim")), refresh=True)


def state(figures: Figures) -> list[str]:
    """Ten lines of 46 characters: the robot and its bus."""
    x, y, w = figures.pose
    off = "" if figures.off is None else f"   off by {figures.off * 1000:.0f} mm"
    told = figures.odometry.pose if figures.odometry else None
    volts, amperes, charge = figures.battery
    return [
        f"Triskar2  {figures.time:.1f} s, {figures.path:.2f} m; {figures.missed} deadlines missed",
        f"pose      x {x:6.2f}  y {y:6.2f} m  w {math.degrees(w):6.1f} deg",
        f"odometry  x {told.x:6.2f}  y {told.y:6.2f} m{off}" if told else "odometry  nothing yet",
        "wheel     setpoint   speed (rad/s)   current",
        *(_wheel(wheel) for wheel in figures.wheels),
        f"battery   {volts:.1f} V  {amperes:.1f} A  {charge:.0%}",
        *bus_lines(figures.bus),
    ]


def bus_lines(bus: BusFigures | None) -> list[str]:
    """Two lines."""
    if bus is None:
        return ["bus       none: a network in memory"]
    slots = f"{bus.slots:.1f} of {bus.of} reserved in each cycle" if bus.of else "none: no master yet"
    return [f"bus       {bus.load:.0%} load, {bus.rate:.0f} frames/s, {bus.errors} errors", f"slots     {slots}"]


def line(figures: Figures) -> str:
    """One line of plain text, at most 80 characters."""
    x, y, w = figures.pose
    speeds = " ".join(f"{wheel.speed:6.2f}" for wheel in figures.wheels)
    bus = "" if figures.bus is None else f"  bus {figures.bus.load:4.0%}"
    return f"{figures.time:6.1f} s  at {x:5.2f} {y:5.2f} m {math.degrees(w):4.0f} deg  wheels {speeds}{bus}"


def _wheel(wheel: WheelFigures) -> str:
    if not wheel.on:
        return f"{wheel.name}    switched off"
    setpoint = "stopped" if wheel.setpoint is None else f"{wheel.setpoint:7.2f}"
    return f"{wheel.name}    {setpoint:>7}   {wheel.speed:7.2f}        {wheel.current:6.2f} A"


def _table(topics: Iterable[TopicFigures]) -> Table:
    table = Table(box=None, pad_edge=False, collapse_padding=True, header_style="bold")
    for name, width in (("TOPIC", 13), ("FROM", 8), ("SENT", 14)):
        table.add_column(name, min_width=width, no_wrap=True)
    for name in ("HZ", "COUNT", "MISSED"):
        table.add_column(name, justify="right", min_width=8, no_wrap=True)
    for each in list(topics)[:_TOPICS]:
        table.add_row(each.topic, each.source, each.how, f"{each.rate:.1f}", str(each.sent), str(each.missed))
    return table
