"""Runs an emulated robot on a simulated RTCAN bus, and shows it; `r2p demo` does, too."""

import contextlib
import importlib.util
from collections.abc import Iterable
from typing import Any

import r2p
from r2p import sim
from r2p.bridge import BridgeOptions
from r2p.sim.buses.server import serve_bus
from r2p.sim.modules.boards import ParameterOptions
from r2p.sim.robots.base import EmulatedRobot
from r2p.sim.robots.figures import FiguresReader
from r2p.tools.bus.serving import SERVED
from r2p.tools.output import program
from r2p.tools.session import moments
from r2p.tools.sim.display import RobotDisplay
from r2p.tools.sim.parameters import check_parameters
from r2p.tools.sim.screen import SimulatorScreen, bus_table

DEBUG = "tcp-listen:0"
"""The debug line, on the loopback interface, at a free port."""
ZENOH = "zenoh:?listen=tcp/127.0.0.1:0&scouting=off"
"""On the loopback interface, too, and without scouting: two robots on one computer stay separate."""

_INSIDE = "memory:robot-pc"  # the network of PC1, outside the robot but in this process
_READY = 6.0  # seconds that the robot's bus has to settle
_REFRESH = 0.25  # seconds, at a terminal
_LINES = 2.0  # seconds between two lines, without a terminal
_FAST_LINES = 10.0  # ... and under virtual time


def default_links() -> list[str]:
    """Return the links that the gateway opens by default: zenoh only if it is installed."""
    return [DEBUG, *([ZENOH] if importlib.util.find_spec("zenoh") else [])]


async def simulate(
    kind: type[RobotDisplay[Any]],
    *,
    duration: float | None = None,
    seed: int = 0,
    modules: Iterable[str] | None = None,
    outside: Iterable[str] = (),
    rounds: float = 0,
    fast: bool = False,
    bus: str | None = None,
    bus_report: bool = False,
    allow_control: bool = False,
    parameters: ParameterOptions | None = None,
) -> None:
    """Run a robot and show its figures, for `duration` seconds or until cancelled.

    `modules`: those to start; default: all but the extras. `outside`: URLs that the gateway opens. `rounds`: how often
    a PC drives what there is to see. `fast`: under virtual time. `bus`: under which name other programs can join the
    robot's bus. `bus_report`: print statistics of the bus at the end. `allow_control`: the gateway accepts REBOOT,
    BOOTLOAD and changes. `parameters`: what those of the modules are at first. Raises UsageError for one that no module
    has, or a value that does not fit.
    """
    name = kind.robot_class.title.lower()
    bridge = BridgeOptions(allow_control=allow_control)
    can = sim.can_bus(name, seed=seed)
    links = [*outside, _INSIDE]
    display = kind(f"sim:{name}", seed=seed, modules=modules, outside=links, options=bridge, parameters=parameters)
    robot = display.robot
    screen = SimulatorScreen(display, live=not fast, duration=duration)
    async with _served(can, bus), robot, r2p.Module("PC1", via=_INSIDE, watchdog=False) as pc:
        check_parameters(robot)
        screen.print(
            f"{robot.title} starts: {len(robot.modules)} modules on a simulated RTCAN bus",
            "  waiting about 2 s: they claim their ids, elect a master and reserve slots",
        )
        with contextlib.suppress(TimeoutError):  # on a computer that is too slow: show the robot as it is
            await robot.ready(_READY)
        reader = FiguresReader(robot, can, display.read, [pc])
        display.watch(pc)
        if rounds:
            display.drive(pc, rounds=rounds)
        screen.print_hints(*_introduction(display, bus, driven=rounds > 0))
        pace = _FAST_LINES if fast else _REFRESH if screen.live else _LINES
        figures = reader.read(0.0)
        try:
            with screen:
                async for time in moments(duration, pace):
                    figures = reader.read(time)
                    screen.show(figures)
        finally:  # also after Ctrl-C
            screen.print_summary(figures, fast=fast)
            if bus_report:
                screen.print("", *bus_table(can))


def _served(can: sim.SimCan, name: str | None) -> contextlib.AbstractAsyncContextManager[object]:
    """Let other programs join the bus, if it has a name for them."""
    return contextlib.nullcontext() if name is None else serve_bus(can, name)


def addresses(robot: EmulatedRobot) -> list[str]:
    """Return the URLs with which other programs reach the robot."""
    gateway = robot.modules["GW"]
    urls = [f"{url.partition(':')[0].removesuffix('-listen')}:{address}" for url, address in gateway.addresses]
    listening = {url.partition(":")[0] for url, _ in gateway.addresses}
    others = [str(url) for url in robot.outside if str(url).partition(":")[0] not in listening and url != _INSIDE]
    return [*urls, *others]


def _introduction(display: RobotDisplay[Any], bus: str | None, *, driven: bool) -> list[str]:
    """Return hints for what to do in another terminal meanwhile."""
    urls = addresses(display.robot)
    hints = [f"topic echo odometry --via {url}" for url in urls]
    if urls:
        hints += display.hints(urls[0], driven=driven)
    if bus is not None:
        hints.append(f"bus load --via {SERVED}{bus}")
    return ["In another terminal:", *(f"  {program()} {hint}" for hint in hints)] if hints else []
