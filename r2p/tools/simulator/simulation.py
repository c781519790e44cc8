"""Runs an emulated robot: opens it, drives it if asked to, shows its figures, and prints a summary."""

import asyncio
import contextlib
import functools
import os
import shutil
import sys
from collections.abc import AsyncIterator
from pathlib import Path

import msgspec

import r2p
from r2p.bridge import BridgeOptions
from r2p.msg import Odometry
from r2p.sim import SimCan, can_bus
from r2p.sim.physics.world import World, box
from r2p.sim.robots.emulated import Triskar2
from r2p.sim.robots.figures import Figures, FiguresReader
from r2p.sim.robots.triskar2 import square
from r2p.tools.simulator.screen import SimulatorScreen

SIDE, SPEED, WAIT = 2.0, 0.5, 1.0
"""Of the square: m, m/s, and seconds until it starts; one lap takes 18 s."""

_NAME = "triskar2"
_INSIDE = "memory:triskar2-pc"  # the network of PC1, outside the robot but in this process
_READY = 6.0  # seconds that the robot's bus has to settle
_REFRESH = 0.25  # seconds, at a terminal
_LINES = 2.0  # seconds between two lines, without a terminal
_FAST_LINES = 10.0  # ... and under virtual time


class SimulationOptions(msgspec.Struct, frozen=True, kw_only=True):
    """How to run the robot. `duration` in s, None: until Ctrl-C. `outside`: URLs that the gateway opens.

    `laps`: of a square that a PC drives. `fast`: under virtual time. `bus`: print bus statistics at the end.
    `allow_control`: the gateway accepts REBOOT and BOOTLOAD.
    """

    duration: float | None = None
    seed: int = 0
    outside: tuple[str, ...] = ()
    laps: float = 0
    fast: bool = False
    bus: bool = False
    allow_control: bool = False


async def simulate(options: SimulationOptions) -> None:
    """Run the robot and show its figures."""
    world = World(box(SIDE / 2, SIDE / 2, 3.8, 3.8))
    screen = SimulatorScreen(world, live=not options.fast, duration=options.duration)
    bus = can_bus(_NAME, seed=options.seed)
    outside, bridge = [*options.outside, _INSIDE], BridgeOptions(allow_control=options.allow_control)
    robot = Triskar2(f"sim:{_NAME}", seed=options.seed, world=world, outside=outside, options=bridge)
    async with robot, r2p.Module("PC1", via=_INSIDE, watchdog=False) as pc:
        screen.print(f"Triskar2 starts: {len(robot.modules)} modules on a simulated RTCAN bus")
        with contextlib.suppress(TimeoutError):  # on a computer that is too slow: show the robot as it is
            await robot.ready(_READY)
        reader = FiguresReader(robot, bus, [pc])
        pc.start(functools.partial(_watch, reader=reader), name="watch")
        if options.laps:
            pc.start(functools.partial(square, side=SIDE, speed=SPEED, laps=options.laps, wait=WAIT), name="square")
        screen.print_hints(*_introduction(robot, driven=options.laps > 0))
        figures = reader.read(0.0)
        try:
            with screen:
                async for time in _moments(options.duration, _pace(options, screen)):
                    figures = reader.read(time)
                    screen.show(figures)
        finally:  # also after Ctrl-C
            print_summary(screen, figures, fast=options.fast)
            if options.bus:
                screen.print("", *bus_table(bus))


def _pace(options: SimulationOptions, screen: SimulatorScreen) -> float:
    """Return the seconds between two displays."""
    return _FAST_LINES if options.fast else _REFRESH if screen.live else _LINES


async def _watch(node: r2p.Node, reader: FiguresReader) -> None:
    node.subscribe("odometry", Odometry, reader.odometry_received, queue=1, lossy=True)
    while True:
        await node.spin()


async def _moments(duration: float | None, period: float) -> AsyncIterator[float]:
    """Yield the seconds since the start, once each period and at the end."""
    loop = asyncio.get_running_loop()
    start = loop.time()
    time = 0.0
    while duration is None or time < duration:
        left = period if duration is None else min(period, duration - time)
        await asyncio.sleep(left)
        time = loop.time() - start
        yield time


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


def print_summary(screen: SimulatorScreen, figures: Figures, *, fast: bool) -> None:
    """Print a summary. In real time, a busy computer can be the reason for missed deadlines."""
    x, y, _ = figures.pose
    screen.print("", f"{figures.time:.1f} s, {figures.path:.2f} m driven; the robot is at x {x:.3f}, y {y:.3f} m")
    if figures.off is not None:
        screen.print(f"odometry is off by {figures.off * 1000:.0f} mm: no two wheels have the same size")
    count = sum(topic.sent for topic in figures.topics)
    screen.print(f"{count} messages published, {figures.missed} missed a deadline")
    worst = max(figures.topics, key=lambda topic: topic.missed, default=None)
    if worst is not None and worst.missed:
        screen.print(f"  {worst.missed} of them of {worst.topic}{'' if fast else '; is this computer busy?'}")
    if figures.bus is not None:
        screen.print(f"bus: {figures.bus.frames} frames, {figures.bus.errors} errors; load {figures.bus.mean:.0%}")


def bus_table(bus: SimCan) -> list[str]:
    """Return lines about how much each node sent."""
    statistics = bus.bus.statistics
    total = statistics.total.occupied or 1
    rows = [f"{'NODE':8} {'FRAMES':>8} {'SHARE':>6} {'ERRORS':>7} {'ARBITRATIONS LOST':>18}"]
    for name, count in sorted(statistics.by_node.items()):
        rows.append(f"{name:8} {count.frames:8} {count.occupied / total:6.0%} {count.errors:7} {count.lost:18}")
    return rows
