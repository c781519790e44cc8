"""Draws `assets/screens/`: what commands print at a terminal of 80 columns, and the slots of a cycle.

Run it from the root of the project when a command prints something else: `python docs/draw_screens.py`. The commands
are the real ones. Those that look at a robot look at the emulated one, under virtual time and with a fixed seed, so
they print the same each time. `doctor` looks at the computer that is described here. A test compares pictures and code.
"""

import asyncio
import contextlib
import functools
import io
import math
import os
import platform
import re
import resource
import socket
import tempfile
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import NamedTuple
from unittest.mock import patch
from xml.sax.saxutils import escape

from rich.console import Console
from rich.segment import Segment
from rich.style import Style
from rich.text import Text

from r2p import sim
from r2p.monitoring.monitor import NetworkMonitor
from r2p.sim.robots.figures import RobotFigures
from r2p.tools import doctor
from r2p.tools.main import app
from r2p.tools.session import Settings, join
from r2p.tools.sim import run
from r2p.tools.sim.hexapod import HexapodDisplay
from r2p.tools.sim.robocom import RobocomDisplay
from r2p.tools.sim.run import simulate
from r2p.tools.sim.screen import SimulatorScreen
from r2p.tools.sim.tiltone import TiltOneDisplay
from r2p.tools.sim.triskar2 import Triskar2Display
from r2p.tools.top.app import TopApp
from r2p.tools.top.topic_screen import TopicScreen
from r2p.tools.topic.rates import hz
from r2p.transports.can.netlink import Interface

FOLDER = Path(__file__).parent / "assets" / "screens"
COLUMNS, NARROW = 80, 48
"""Of a terminal, and of one that fits a phone."""
MOMENT = 11.25
"""Seconds of the demo, in the picture."""
SHOVED = 12.25
"""Seconds of `r2p sim tiltone`, in the picture: just after the shove."""

WALKING = 2.0
"""Seconds of `r2p sim hexapod`, in the picture."""

_OUTSIDE = "memory:lab"  # where the emulated robot is looked at; the picture shows an address as users have it
_ADDRESS = "tcp:127.0.0.1:45123"
_PLAN = ("imu:18@200Hz", "encoder:8@1ms", "motor:12@5ms", "battery:8@25Hz")
_WIDE = 100  # columns for `doctor`
_UNWRAPPED = 1000  # columns of its terminal: paths are longer there than in the picture
_COLOURED = {"force_terminal": True, "color_system": "standard", "legacy_windows": False, "_environ": {}}

# Pictures of terminals

_CELL, _LINE, _SIZE, _PAD, _BAR = 8.4, 18, 14, 16, 30  # px: a character, a line, the font, the border, the title bar
_STYLE = """
    .window { fill: #14171d; stroke: #76808e; stroke-opacity: .5 }
    .button { fill: #4a5160 }
    .reverse { fill: #d7dce5 }
    text { fill: #d7dce5; white-space: pre }
    .prompt, .dim { fill: #8f99a8 }
    .bold { font-weight: 700 }
    .on-reverse { fill: #14171d }
    .cyan { fill: #5fd3e0 }
    .green { fill: #7fd88f }
    .yellow { fill: #f2cc60 }
    .red { fill: #ff8178 }
    .blue { fill: #7aa8ff }
    .magenta { fill: #d79bf0 }"""
_COLOURS = {1: "red", 2: "green", 3: "yellow", 4: "blue", 5: "magenta", 6: "cyan"}  # of ANSI
_CHUNK = re.compile(r"\S+(?: \S+)*")  # words with single blanks between them: each chunk has a position of its own


class Screen(NamedTuple):
    """A terminal after a command: what was typed, what was printed (with ANSI codes), and its width in characters."""

    command: str
    printed: str
    columns: int = COLUMNS


def draw(screen: Screen) -> str:
    """Return a screen as SVG: dark on any page, as terminals are."""
    lines = _lines(screen)
    width = screen.columns * _CELL + 2 * _PAD
    height = _BAR + (len(lines) + 1) * _LINE + _PAD
    head = f'viewBox="0 0 {width:.0f} {height}" role="img" aria-labelledby="title" font-size="{_SIZE}"'
    fonts = "ui-monospace, SFMono-Regular, Menlo, Consolas, 'DejaVu Sans Mono', monospace"
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" {head} font-family="{fonts}">',
        f'  <title id="title">{escape(screen.command)}</title>',
        f"  <style>{_STYLE}\n  </style>",
        f'  <rect class="window" x=".5" y=".5" width="{width - 1:.0f}" height="{height - 1}" rx="9"/>',
        *(f'  <circle class="button" cx="{20 + 18 * i}" cy="17" r="5.5"/>' for i in range(3)),
        _chunk("prompt", 0, 0, "$"),
        _chunk("bold", 2, 0, screen.command),
    ]
    for row, line in enumerate(lines, start=1):
        parts += _row(row, line)
    return "\n".join([*parts, "</svg>\n"])


def _lines(screen: Screen) -> list[list[Segment]]:
    """What was printed, in lines as wide as the terminal."""
    console = Console(width=screen.columns, file=io.StringIO(), legacy_windows=False, _environ={})
    lines = Text.from_ansi(screen.printed.rstrip("\n")).split("\n", allow_blank=True)
    folded = (part for line in lines for part in (line.divide(_folds(line, screen.columns)) if line else [line]))
    return [list(line.render(console)) for line in folded]


def _folds(line: Text, columns: int) -> range:
    return range(columns, len(line), columns)


def _row(row: int, line: list[Segment]) -> Iterator[str]:
    column = 0
    for text, style, _ in line:
        classes = _classes(style)
        if "on-reverse" in classes:
            yield _bar(column, row, len(text))
        for chunk in _CHUNK.finditer(text):
            yield _chunk(classes, column + chunk.start(), row, chunk[0])
        column += len(text)


def _bar(column: int, row: int, length: int) -> str:
    """The background of inverted text."""
    x, y = _PAD + column * _CELL, _BAR + row * _LINE - 3
    return f'  <rect class="reverse" x="{x:.1f}" y="{y}" width="{length * _CELL:.1f}" height="{_LINE}"/>'


def _classes(style: Style | None) -> str:
    """The classes of a style. A KeyError for a colour that the picture does not have: add it."""
    if style is None:
        return ""
    names = {"bold": style.bold, "dim": style.dim, "on-reverse": style.reverse}
    number = None if style.color is None else style.color.number
    return " ".join(
        [*(name for name, wanted in names.items() if wanted), *([] if number is None else [_COLOURS[number]])]
    )


def _chunk(classes: str, column: int, row: int, text: str) -> str:
    """Text at a place; its length is given, so that columns are aligned in any font."""
    style = f' class="{classes}"' if classes else ""
    x, y = _PAD + column * _CELL, _BAR + row * _LINE + 11
    return f'  <text{style} x="{x:.1f}" y="{y}" textLength="{len(text) * _CELL:.1f}">{escape(text)}</text>'


# What the commands print


def pictures() -> dict[str, str]:
    """Return all pictures by their file names."""
    screens = _beside_the_robot() | _balancing() | _fusing() | _walking() | {"doctor": _doctor()}
    screens["admit"], slots = _admit()
    return {f"{name}.svg": draw(screen) for name, screen in screens.items()} | {"slots.svg": slots}


class _Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@contextlib.contextmanager
def _terminal(columns: int = COLUMNS) -> Iterator[_Terminal]:
    """Let commands in the block print at a terminal of their own."""
    terminal = _Terminal()
    settings = {"COLUMNS": str(columns), "LINES": "24", "TERM": "xterm", "USER": "robot"}
    with patch.dict(os.environ, settings), contextlib.redirect_stdout(terminal), contextlib.redirect_stderr(terminal):
        for name in ("R2P_VIA", "NO_COLOR", "FORCE_COLOR"):
            os.environ.pop(name, None)
        yield terminal


def _beside_the_robot() -> dict[str, Screen]:
    with _terminal(), patch.object(run, "addresses", lambda _robot: [_ADDRESS]):
        return sim.run(_robot, seed=1)


async def _robot() -> dict[str, Screen]:
    """The demo, as wide as a terminal and as a phone; and its odometry, as `hz` measures it meanwhile."""
    screens: dict[str, Screen] = {}
    seen = asyncio.Event()

    def show(screen: SimulatorScreen, figures: RobotFigures) -> None:
        screen.draw(figures)  # its map remembers the path
        if not seen.is_set() and figures.time >= MOMENT - 0.01:
            seen.set()
            screens["demo"] = _frame(screen, figures, COLUMNS, 24)
            screens["demo-narrow"] = _frame(screen, figures, NARROW, 24)

    with patch.object(SimulatorScreen, "show", show):
        robot = asyncio.create_task(simulate(Triskar2Display, duration=20.0, outside=[_OUTSIDE], rounds=1))
        await asyncio.sleep(8.0)
        with _terminal() as terminal:
            async with join(Settings(via=[_OUTSIDE]), name="hz") as session:
                await hz(session, "odometry", count=3)
        screens["hz"] = Screen("r2p topic hz odometry -n 3", terminal.getvalue())
        screens |= await _top()
        await seen.wait()
        robot.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await robot
    return screens


def _balancing() -> dict[str, Screen]:
    with _terminal(), patch.object(run, "addresses", lambda _robot: [_ADDRESS]):
        return sim.run(_tiltone, seed=1)


async def _tiltone() -> dict[str, Screen]:
    """The balancing robot, when it was shoved."""
    screens: dict[str, Screen] = {}

    def show(screen: SimulatorScreen, figures: RobotFigures) -> None:
        if not screens and figures.time >= SHOVED - 0.01:
            screens["tiltone"] = _frame(screen, figures, COLUMNS, 24, "r2p sim tiltone --drive")
            seen.set()

    seen = asyncio.Event()
    with patch.object(SimulatorScreen, "show", show):
        robot = asyncio.create_task(simulate(TiltOneDisplay, outside=[_OUTSIDE], rounds=1))
        await seen.wait()
        robot.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await robot
    return screens


def _walking() -> dict[str, Screen]:
    with _terminal(), patch.object(run, "addresses", lambda _robot: [_ADDRESS]):
        return sim.run(_hexapod, seed=1)


async def _hexapod() -> dict[str, Screen]:
    """The robot of 20 modules, while three of its legs swing."""
    screens: dict[str, Screen] = {}

    def show(screen: SimulatorScreen, figures: RobotFigures) -> None:
        if not screens and figures.time >= WALKING - 0.01:
            screens["hexapod"] = _frame(screen, figures, COLUMNS, 24, "r2p sim hexapod --drive")
            seen.set()

    seen = asyncio.Event()
    with patch.object(SimulatorScreen, "show", show):
        robot = asyncio.create_task(simulate(HexapodDisplay, outside=[_OUTSIDE], rounds=1))
        await seen.wait()
        robot.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await robot
    return screens


def _fusing() -> dict[str, Screen]:
    with _terminal(), patch.object(run, "addresses", lambda _robot: [_ADDRESS]):
        return sim.run(_robocom, seed=1)


async def _robocom() -> dict[str, Screen]:
    """Robocom, on its figure of eight."""
    screens: dict[str, Screen] = {}

    def show(screen: SimulatorScreen, figures: RobotFigures) -> None:
        screens["robocom"] = _frame(screen, figures, COLUMNS, 24, "r2p sim robocom --drive")

    with patch.object(SimulatorScreen, "show", show):
        await simulate(RobocomDisplay, duration=12.0, outside=[_OUTSIDE], rounds=1)
    return screens


async def _top() -> dict[str, Screen]:
    """The tables of `r2p top`, and what opens from them."""
    screens, command = {}, f"r2p top --via {_ADDRESS}"
    async with join(Settings(via=[_OUTSIDE]), name="top") as session, NetworkMonitor(session.module) as monitor:
        for topic in ("odometry", "encoder1", "velocity"):
            monitor.measure(topic)
        app = TopApp(session, monitor)
        async with app.run_test(size=(COLUMNS, 24)) as pilot:
            await pilot.pause(2.1)
            screens["top"] = Screen(command, _ansi(app))
            # Without keys: after each of them the pilot waits until the process is idle, by the processor's clock.
            app.tables.action_view("buses")
            await pilot.pause(0.1)
            screens["top-bus"] = Screen(command, _ansi(app))
            await app.push_screen(TopicScreen(app.details, "odometry"))
            await pilot.pause(6.0)
            screens["top-topic"] = Screen(command, _ansi(app))
    return screens


def _ansi(app: TopApp) -> str:
    """What the terminal of an app shows."""
    console = Console(file=io.StringIO(), width=COLUMNS, **_COLOURED)
    strips = app.screen._compositor.render_strips()  # noqa: SLF001 - Textual's own export is a picture, not a text
    return "\n".join(strip.render(console) for strip in strips)


def _frame(
    screen: SimulatorScreen, figures: RobotFigures, columns: int, lines: int, command: str = "r2p demo"
) -> Screen:
    """One frame of a robot, on a terminal of this size."""
    output = io.StringIO()
    size = {"width": columns, "height": lines}
    screen.console = Console(file=output, **size, **_COLOURED)
    screen.console.print(screen.draw(figures))
    return Screen(command, output.getvalue(), columns)


def _admit() -> tuple[Screen, str]:
    """A plan and its slots."""
    with tempfile.TemporaryDirectory() as folder, _terminal() as terminal:
        file = Path(folder) / "slots.svg"
        app(["bus", "admit", *_PLAN, "--svg", str(file)], standalone_mode=False)
        return Screen(f"r2p bus admit {' '.join(_PLAN)}", terminal.getvalue()), file.read_text(encoding="utf-8")


_PLATFORM = {
    "system": "Linux",
    "release": "6.1.0-rt5",
    "machine": "aarch64",
    "python_implementation": "CPython",
    "python_version": "3.11.2",
}
_INSTALLED = {"uvloop": "0.22.1", "pyserial": "3.5", "eclipse-zenoh": "1.10.2"}
_CAN0 = Interface("can0", "can", up=True, state="error-active", bitrate=1_000_000, modes=frozenset({"one-shot"}))


def _doctor() -> Screen:
    """A computer on a robot that is nearly ready: no package for CAN adapters, and a clock rate that changes."""
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as computer, _terminal(_UNWRAPPED) as terminal:
        root = Path(folder)
        _write(root, {"dev/ttyUSB0": "", "sys/devices/system/cpu/cpu0/cpufreq/scaling_governor": "ondemand"})
        for name, kind in (("lo", 772), ("eth0", 1), ("wlan0", 1), ("can0", 280)):
            _write(root, {f"sys/class/net/{name}/type": str(kind), f"sys/class/net/{name}/flags": "0x1003"})
        for each in _computer(root):
            computer.enter_context(each)
        app(["doctor"], standalone_mode=False)
        return Screen("r2p doctor", terminal.getvalue().replace(folder, ""), _WIDE)


def _write(root: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text, encoding="ascii")


def _computer(root: Path) -> Iterator[contextlib.AbstractContextManager[object]]:
    """What `doctor` asks the system for, answered for this computer."""
    yield contextlib.chdir(root)
    yield patch.object(doctor, "checks", functools.partial(doctor.checks, root))
    yield patch.object(doctor, "_from_kernel", lambda: {"can0": _CAN0})
    yield patch.object(doctor, "measure", _measured)
    yield patch.object(metadata, "version", _version)
    yield patch.object(socket, "gethostname", lambda: "robot")
    yield patch.object(os, "geteuid", lambda: 1000)
    yield patch.object(resource, "getrlimit", lambda _which: (0, 0))
    for name, value in _PLATFORM.items():
        yield patch.object(platform, name, functools.partial(str, value))


async def _measured() -> list[int]:
    """How late ticks are, in ns: a rough exponential, as on a small computer."""
    return [round(60_000 * -math.log(1 - i / 200)) for i in range(200)]


def _version(package: str) -> str:
    if package not in _INSTALLED:
        raise metadata.PackageNotFoundError(package)
    return _INSTALLED[package]


if __name__ == "__main__":
    FOLDER.mkdir(parents=True, exist_ok=True)
    for file, picture in pictures().items():
        (FOLDER / file).write_text(picture, encoding="utf-8")
