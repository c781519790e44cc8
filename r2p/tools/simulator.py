"""`r2p sim`: an emulated robot on a simulated RTCAN bus, which other programs reach through its gateway.

`simulate` runs the robot (`r2p demo` does, too), drives it if asked to, and prints a summary. `SimulatorScreen` shows
its figures: live at a terminal, in 80 columns and 24 lines; otherwise as lines of plain text. A smaller terminal gets
less of them: first the map goes, then topics. The hints stay.
"""

import contextlib
import functools
import importlib.util
import math
import os
import shutil
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Literal, Self

import typer
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

import r2p
from r2p import sim
from r2p.bridge import BridgeOptions
from r2p.codecs.parameters import Origin
from r2p.msg import Odometry
from r2p.parameters.sources import ParameterSource, from_options, of_module, read_file
from r2p.sim.modules.boards import ParameterOptions
from r2p.sim.physics.world import Triple, Wall, World, box
from r2p.sim.robots.emulated import MODULES, Triskar2
from r2p.sim.robots.figures import (
    FiguresReader,
    OdometryFigures,
    RobotBusFigures,
    RobotFigures,
    RobotTopicFigures,
    WheelFigures,
)
from r2p.sim.robots.triskar2 import square
from r2p.tools.config import CONFIG, Settings, did_you_mean
from r2p.tools.options import Params, ParamsFile, Quiet, Verbose, Via, time_option
from r2p.tools.session import UsageError, check_urls, execute, moments, run_virtually, settings

DEBUG = "tcp-listen:0"
"""The debug line, on the loopback interface, at a free port."""
ZENOH = "zenoh:?listen=tcp/127.0.0.1:0&scouting=off"
"""On the loopback interface, too, and without scouting: two robots on one computer stay separate."""
SIDE, SPEED, WAIT = 2.0, 0.5, 1.0
"""The square: m, m/s, and seconds until it starts; one lap takes 18 s."""

_NAME = "triskar2"
_INSIDE = "memory:triskar2-pc"  # the network of PC1, outside the robot but in this process
_FAST = 60.0  # seconds
_READY = 6.0  # seconds that the robot's bus has to settle
_REFRESH = 0.25  # seconds, at a terminal
_LINES = 2.0  # seconds between two lines, without a terminal
_FAST_LINES = 10.0  # ... and under virtual time

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


_Speed = Annotated[
    float | None,
    typer.Option(metavar="N", min=0.1, max=100.0, help="N times as fast as real time; ROS nodes follow its /clock."),
]
_Square = Annotated[bool, typer.Option("--square", help="Let a PC drive it along squares; implied by --fast.")]
_Fast = Annotated[
    bool, typer.Option("--fast", help="As fast as possible, in virtual time; other programs can't connect.")
]


def command(
    robot: Annotated[
        Literal["triskar2"], typer.Argument(metavar="ROBOT", help="The omnidirectional robot of the thesis.")
    ] = "triskar2",
    fast: _Fast = False,
    speed: _Speed = None,
    duration: Annotated[
        float | None, time_option("--duration", "How long; default: until Ctrl-C; --fast: 60 s.")
    ] = None,
    seed: Annotated[int, typer.Option(metavar="N", help="Seed of all random numbers.")] = 0,
    square: _Square = False,
    bus: Annotated[bool, typer.Option("--bus", help="At the end, report how much each node sent on the bus.")] = False,
    allow_control: Annotated[
        bool, typer.Option("--allow-control", help="Let the gateway accept REBOOT, BOOTLOAD and changes from IP links.")
    ] = False,
    params_file: ParamsFile = None,
    params: Params = None,
    param: Annotated[
        list[str] | None,
        typer.Option(metavar="[MODULE/]NODE.NAME=VALUE", help="Start with this value of a parameter (repeatable)."),
    ] = None,
    via: Via = None,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Run an emulated robot: modules, motors, a body that moves, and a gateway for other programs.

    The gateway opens the links of --via; by default the debug line on TCP, and zenoh, for this computer only.
    """

    async def main() -> None:
        if fast and speed is not None:
            raise UsageError("--fast is as fast as possible: leave out either --fast or --speed")
        if fast and via:
            raise UsageError("--fast runs in virtual time, so other programs can't connect: leave out --via or --fast")
        check_urls(via or [])
        chosen = settings()
        sources = parameter_sources(chosen, params or (), param or ())
        parameters = ParameterOptions(params=sources, params_file=params_file or chosen.params_file)
        await simulate(
            duration=duration or (_FAST if fast else None),
            seed=seed,
            outside=() if fast else tuple(via or default_links()),
            laps=math.inf if square or fast else 0,
            fast=fast,
            bus=bus,
            allow_control=allow_control,
            parameters=parameters,
        )

    virtually = functools.partial(run_virtually, seed=seed, speed=None if fast else speed)
    # Only errors are logged: any other line would tear the display apart.
    endless = duration is None and not fast
    execute(
        main,
        verbose=verbose,
        quiet=quiet + 2,
        endless=endless,
        run=virtually if fast or speed is not None else None,
    )


def default_links() -> list[str]:
    """Return the links that the gateway opens by default: zenoh only if it is installed."""
    return [DEBUG, *([ZENOH] if importlib.util.find_spec("zenoh") else [])]


async def simulate(
    *,
    duration: float | None = None,
    seed: int = 0,
    outside: Iterable[str] = (),
    laps: float = 0,
    fast: bool = False,
    bus: bool = False,
    allow_control: bool = False,
    parameters: ParameterOptions | None = None,
) -> None:
    """Run the robot and show its figures, for `duration` seconds or until cancelled.

    `outside`: URLs that the gateway opens. `laps`: of a square that a PC drives. `fast`: under virtual time. `bus`:
    print bus statistics at the end. `allow_control`: the gateway accepts REBOOT, BOOTLOAD and changes. `parameters`:
    what those of the modules are at first. Raises UsageError for one that no module has, or a value that does not fit.
    """
    world = World(box(SIDE / 2, SIDE / 2, 3.8, 3.8))
    screen = SimulatorScreen(world, live=not fast, duration=duration)
    can = sim.can_bus(_NAME, seed=seed)
    bridge = BridgeOptions(allow_control=allow_control)
    robot = Triskar2(
        f"sim:{_NAME}", seed=seed, world=world, outside=[*outside, _INSIDE], options=bridge, parameters=parameters
    )
    async with robot, r2p.Module("PC1", via=_INSIDE, watchdog=False) as pc:
        _check_parameters(robot)
        screen.print(
            f"Triskar2 starts: {len(robot.modules)} modules on a simulated RTCAN bus",
            "  waiting about 2 s: they claim their ids, elect a master and reserve slots",
        )
        with contextlib.suppress(TimeoutError):  # on a computer that is too slow: show the robot as it is
            await robot.ready(_READY)
        reader = FiguresReader(robot, can, [pc])
        pc.start(functools.partial(_watch, reader=reader), name="watch")
        if laps:
            pc.start(functools.partial(square, side=SIDE, speed=SPEED, laps=laps, wait=WAIT), name="square")
        screen.print_hints(*_introduction(robot, driven=laps > 0))
        pace = _FAST_LINES if fast else _REFRESH if screen.live else _LINES
        figures = reader.read(0.0)
        try:
            with screen:
                async for time in moments(duration, pace):
                    figures = reader.read(time)
                    screen.show(figures)
        finally:  # also after Ctrl-C
            screen.print_summary(figures, fast=fast)
            if bus:
                screen.print("", *bus_table(can))


def parameter_sources(
    chosen: Settings, files: Iterable[Path], options: Iterable[str]
) -> dict[str, list[ParameterSource]]:
    """Return where values of parameters come from, for each module of the robot. Raises UsageError.

    Options without a module are for all that have the parameter. Of several files, the last one wins.
    """
    of_modules: dict[str, list[str]] = {name: [] for name in MODULES}
    of_all: list[str] = []
    for option in options:
        module, found, rest = option.partition("/")
        if not found and option.partition(".")[0] in of_modules:
            raise UsageError(f"--param {option}: write it as {option.replace('.', '/', 1)}")
        if not found or "=" in module:
            of_all.append(option)
        elif module in of_modules:
            of_modules[module].append(rest)
        else:
            hint = did_you_mean(module, MODULES, "modules")
            raise UsageError(f"--param {option}: the robot has no module {module}; {hint}")
    try:
        shared, tables = from_options(of_all), [_of_file(path) for path in reversed([*files])]
        return {
            name: [
                of_module(name, chosen.params, Origin.CONFIG, CONFIG),
                *(table[name] for table in tables),
                from_options(own),
                shared,
            ]
            for name, own in of_modules.items()
        }
    except r2p.ParameterError as error:
        raise UsageError(str(error)) from error


def _of_file(path: Path) -> dict[str, ParameterSource]:
    sources = {name: read_file(path, name) for name in MODULES}
    if not any(source.values for source in sources.values()):
        raise UsageError(f"{path} has no parameters of the robot's modules, {', '.join(MODULES)}")
    return sources


def _check_parameters(robot: Triskar2) -> None:
    """Raise UsageError for values that were given for no parameter, or that do not fit.

    All nodes have declared theirs: each runs its first step while the next module is opened.
    """
    unused: dict[str, list[str]] = {}
    for board in robot.modules.values():
        for supervisor in board.nodes.values():
            if isinstance(supervisor.error, r2p.ParameterError):
                raise UsageError(str(supervisor.error))
        for each in board.parameters.unused():
            unused.setdefault(each, []).append(board.name)
    for name, modules in unused.items():
        hint = next(filter(None, (robot.modules[each].parameters.similar(name) for each in modules)), "")
        raise UsageError(f"no node of {modules[0] if len(modules) == 1 else 'the robot'} has a parameter {name}{hint}")


async def _watch(node: r2p.Node, reader: FiguresReader) -> None:
    node.subscribe("odometry", Odometry, reader.odometry_received, queue=1, lossy=True)
    while True:
        await node.spin()


def addresses(robot: Triskar2) -> list[str]:
    """Return the URLs with which other programs reach the robot."""
    gateway = robot.modules["GW"]
    urls = [f"{url.partition(':')[0].removesuffix('-listen')}:{address}" for url, address in gateway.addresses]
    listening = {url.partition(":")[0] for url, _ in gateway.addresses}
    others = [str(url) for url in robot.outside if str(url).partition(":")[0] not in listening and url != _INSIDE]
    return [*urls, *others]


def program() -> str:
    """Return what to type for this program in another terminal in the same folder."""
    typed = sys.argv[0]
    if Path(typed).name == "__main__.py":
        return f"{sys.orig_argv[0]} -m r2p"
    if Path(typed).name != "r2p" or not os.access(typed, os.X_OK):  # not started as a command
        return "r2p"
    found = shutil.which("r2p")
    return "r2p" if found and Path(found).samefile(typed) else typed


def _introduction(robot: Triskar2, *, driven: bool) -> list[str]:
    """Return hints for what to do in another terminal meanwhile."""
    urls = addresses(robot)
    if not urls:
        return []
    hints = [f"topic echo odometry --via {url}" for url in urls]
    if not driven:
        hints.append(f"topic pub velocity_cmd x=0.2 -r 20 --via {urls[0]}")
    return ["In another terminal:", *(f"  {program()} {hint}" for hint in hints)]


def bus_table(bus: sim.SimCan) -> list[str]:
    """Return lines about how much each node sent."""
    statistics = bus.bus.statistics
    total = statistics.total.occupied or 1
    rows = [f"{'NODE':8} {'FRAMES':>8} {'SHARE':>6} {'ERRORS':>7} {'ARBITRATIONS LOST':>18}"]
    for name, count in sorted(statistics.by_node.items()):
        rows.append(f"{name:8} {count.frames:8} {count.occupied / total:6.0%} {count.errors:7} {count.lost:18}")
    return rows


class SimulatorScreen:
    """Standard output, for the time of a `with` block."""

    def __init__(self, world: World, *, live: bool = True, duration: float | None = None) -> None:
        """`duration` in s, if it is known."""
        self.console = Console(highlight=False)
        self.live = live and self.console.is_terminal and not self.console.is_dumb_terminal
        """True if the figures are drawn in place."""
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

    def show(self, figures: RobotFigures) -> None:
        """Draw the figures, or print a line about them."""
        if self.live:
            self._view.update(self.draw(figures), refresh=True)
        else:
            self.print(line(figures))
            if figures.too_slow:
                self.print(f"          {_too_slow(figures)}")

    def print_summary(self, figures: RobotFigures, *, fast: bool) -> None:
        """Print a summary; `fast`: of a run in virtual time, which no PC is too slow for."""
        x, y, _ = figures.pose
        self.print("", f"{figures.time:.1f} s, {figures.path:.2f} m driven; the robot is at x {x:.3f}, y {y:.3f} m")
        if figures.odometry is not None:
            self.print(_accuracy(figures.odometry, figures.off_max))
        count = sum(topic.sent for topic in figures.topics)
        self.print(f"{count} messages published, {figures.missed} missed a deadline")
        worst = max(figures.topics, key=lambda topic: topic.missed, default=None)
        if worst is not None and worst.missed:
            self.print(f"  {worst.missed} of them of {worst.topic}{'' if fast else '; is this PC busy?'}")
        if figures.bus is not None:
            self.print(f"bus: {figures.bus.frames} frames, {figures.bus.errors} errors; load {figures.bus.mean:.0%}")
        if figures.slow and not fast:
            self.print(
                f"this PC was too slow for {figures.slow:.1f} of {figures.time:.1f} s: messages were late or skipped;",
                f"  end other programs, or simulate in virtual time: {program()} sim --fast",
            )

    def draw(self, figures: RobotFigures) -> RenderableType:
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
        commands = (Text(hint, style="cyan" if hint.startswith(" ") else "bold") for hint in self._hints)
        return Group(*parts, *commands)


def _title(figures: RobotFigures, duration: float | None, width: int) -> Text:
    """Return the title line: how long, how far, and how many deadlines were missed, or that the PC is too slow."""
    until = f" of {duration:.0f}" if duration else ""
    late = f"{figures.missed or 'no'} deadline{'' if figures.missed == 1 else 's'} missed"
    if figures.too_slow:
        late = _too_slow(figures)
    text = f" Triskar2   {figures.time:.1f}{until} s   "
    driven = f"{figures.path:.2f} m driven  "
    text += driven if len(text + driven + late) <= width else ""
    return Text(f"{text:{max(0, width - len(late) - 1)}}{late} ", style="bold reverse", no_wrap=True)


def _too_slow(figures: RobotFigures) -> str:
    return f"PC too slow: {figures.late:.0%} late"


def state(figures: RobotFigures) -> list[str]:
    """Return nine lines of 48 characters about the robot and its bus."""
    # Position and odometry of one instant, so that they can be compared: in 0.1 s the robot drives 5 cm.
    x, y, w = figures.odometry.truth if figures.odometry and figures.odometry.fresh else figures.pose
    volts, amperes, charge = figures.battery
    return [
        f"position  x {x:z6.2f}  y {y:z6.2f} m  heading {math.degrees(w):z4.0f} deg",
        "odometry  nothing yet" if figures.odometry is None else _odometry(figures.odometry),
        "motors     wanted     speed (rad/s)    current",
        *(_wheel(wheel) for wheel in figures.wheels),
        f"battery   {volts:.1f} V  {amperes:.1f} A  {charge:.0%}",
        *bus_lines(figures.bus),
    ]


def _odometry(odometry: OdometryFigures) -> str:
    note = f"off by {odometry.off * 1000:.0f} mm" if odometry.fresh else f"{odometry.age:.1f} s ago"
    return f"odometry  x {odometry.pose.x:z6.2f}  y {odometry.pose.y:z6.2f} m  {note}"


def _accuracy(odometry: OdometryFigures, off_max: float) -> str:
    """Return a line about the odometry. On a square its errors cancel out: the one at the end says little."""
    now, most = round(odometry.off * 1000), round(off_max * 1000)
    if not most:
        return "odometry: exact to the millimetre"
    before = f", earlier by {most} mm" if most > now else ""
    return f"odometry: off by {now} mm{before}: no two wheels have the same size"


def bus_lines(bus: RobotBusFigures | None) -> list[str]:
    """Return two lines about the bus."""
    if bus is None:
        return ["CAN bus   none: a network in memory"]
    slots = f"{bus.of} in a cycle, {bus.slots:.1f} of them reserved" if bus.of else "none: no master yet"
    return [f"CAN bus   {bus.load:.0%} load  {bus.rate:.0f} frames/s  {bus.errors} errors", f"slots     {slots}"]


def line(figures: RobotFigures) -> str:
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


def _coloured(drawing: str) -> Text:
    text = Text(drawing, style="green")
    text.highlight_regex("#+", "dim default")
    text.highlight_regex(r"[<>^v]", "bold yellow")
    return text


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
