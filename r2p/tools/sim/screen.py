"""What `r2p sim` shows: live at a terminal, in 80 columns and 24 lines; otherwise as lines of plain text.

A smaller terminal gets less: first the picture goes, then topics. The hints stay.
"""

import math
from collections.abc import Iterable
from typing import Any, Generic, Self, TypeVar

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from r2p import sim
from r2p.sim.robots.figures import RobotBusFigures, RobotFigures, RobotTopicFigures
from r2p.tools.output import program
from r2p.tools.sim.display import PICTURE_HEIGHT, PICTURE_WIDTH, STATE_WIDTH, RobotDisplay

B = TypeVar("B")

_LABEL = 10  # columns
_WIDE = 72  # columns of the whole table
_FULL = STATE_WIDTH + 2 + PICTURE_WIDTH  # ... of state and picture


class SimulatorScreen(Generic[B]):
    """Standard output, for the time of a `with` block."""

    def __init__(self, display: RobotDisplay[B], *, live: bool = True, duration: float | None = None) -> None:
        """`duration` in s, if it is known."""
        self.console = Console(highlight=False)
        self.live = live and self.console.is_terminal and not self.console.is_dumb_terminal
        """True if the figures are drawn in place."""
        self._duration = duration
        self._display = display
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

    def show(self, figures: RobotFigures[B]) -> None:
        """Draw the figures, or print a line about them."""
        if self.live:
            self._view.update(self.draw(figures), refresh=True)
        else:
            self.print(self._line(figures))
            if figures.too_slow:
                self.print(f"          {_too_slow(figures)}")

    def print_summary(self, figures: RobotFigures[B], *, fast: bool) -> None:
        """Print a summary; `fast`: of a run in virtual time, which no PC is too slow for."""
        first, *others = self._display.summary(figures.body)
        self.print("", f"{figures.time:.1f} s, {first}", *others)
        count = sum(topic.sent for topic in figures.topics)
        self.print(f"{count} messages published, {figures.missed} missed a deadline")
        worst = max(figures.topics, key=lambda topic: topic.missed, default=None)
        if worst is not None and worst.missed:
            self.print(f"  {worst.missed} of them of {worst.topic}{'' if fast else '; is this PC busy?'}")
        if figures.bus is not None:
            self.print(f"bus: {figures.bus.frames} frames, {figures.bus.errors} errors; load {figures.bus.mean:.0%}")
        if figures.slow and not fast:
            robot = self._display.robot_class.title.lower()
            self.print(
                f"this PC was too slow for {figures.slow:.1f} of {figures.time:.1f} s: messages were late or skipped;",
                f"  end other programs, or let simulated time wait: {program()} sim {robot} --speed 1",
            )

    def draw(self, figures: RobotFigures[B]) -> RenderableType:
        """Return the figures, as many as fit the terminal."""
        width, height = self.console.size
        display = self._display
        lines = [*display.state(figures.body), *bus_lines(figures.bus)]
        upper = Table.grid(padding=(0, 2))
        upper.add_column(width=min(STATE_WIDTH, width), no_wrap=True)
        if width >= _FULL:
            upper.add_row(_labelled(lines), display.picture(figures.body))
        else:
            upper.add_row(_labelled(lines))
        hints = sum(math.ceil(len(hint) / width) for hint in self._hints)
        rows = height - 1 - max(len(lines), PICTURE_HEIGHT) - 1 - hints  # without the title, and the head of the table
        parts: list[RenderableType] = [self._title(figures, min(width, _FULL)), upper]
        if rows > 0:
            parts.append(_table(figures.topics[:rows], names_only=width < _WIDE))
        commands = (Text(hint, style="cyan" if hint.startswith(" ") else "bold") for hint in self._hints)
        return Group(*parts, *commands)

    def _title(self, figures: RobotFigures[B], width: int) -> Text:
        """Return the title line: how long, how far, and how many deadlines were missed, or that the PC is too slow."""
        until = f" of {self._duration:.0f}" if self._duration else ""
        late = f"{figures.missed or 'no'} deadline{'' if figures.missed == 1 else 's'} missed"
        if figures.too_slow:
            late = _too_slow(figures)
        text = f" {self._display.robot_class.title}   {figures.time:.1f}{until} s   "
        progress = f"{self._display.progress(figures.body)}  "
        text += progress if len(text + progress + late) <= width else ""
        return Text(f"{text:{max(0, width - len(late) - 1)}}{late} ", style="bold reverse", no_wrap=True)

    def _line(self, figures: RobotFigures[B]) -> str:
        """Return one line of plain text, at most 80 characters."""
        bus = "" if figures.bus is None else f"  bus {figures.bus.load:4.0%}"
        return f"{figures.time:6.1f} s  {self._display.line(figures.body)}{bus}"


def _too_slow(figures: RobotFigures[Any]) -> str:
    return f"PC too slow: {figures.late:.0%} late"


def bus_lines(bus: RobotBusFigures | None) -> list[str]:
    """Return two lines about the bus."""
    if bus is None:
        return ["CAN bus   none: a network in memory"]
    slots = f"{bus.of} in a cycle, {bus.slots:.1f} of them reserved" if bus.of else "none: no master yet"
    return [f"CAN bus   {bus.load:.0%} load  {bus.rate:.0f} frames/s  {bus.errors} errors", f"slots     {slots}"]


def _table(topics: Iterable[RobotTopicFigures], *, names_only: bool) -> Table:
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
    return Text("\n").join(Text.assemble((each[:_LABEL], "bold"), each[_LABEL:]) for each in lines)


def bus_table(bus: sim.SimCan) -> list[str]:
    """Return lines about how much each node sent."""
    statistics = bus.bus.statistics
    total = statistics.total.occupied or 1
    rows = [f"{'NODE':8} {'FRAMES':>8} {'SHARE':>6} {'ERRORS':>7} {'ARBITRATIONS LOST':>18}"]
    for name, count in sorted(statistics.by_node.items()):
        rows.append(f"{name:8} {count.frames:8} {count.occupied / total:6.0%} {count.errors:7} {count.lost:18}")
    return rows
