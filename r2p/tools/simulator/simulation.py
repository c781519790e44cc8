"""An emulated robot as a program: opened, perhaps driven, shown, and summed up."""

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
from r2p.sim.robots.figures import Figures, Gauge
from r2p.sim.robots.square import square
from r2p.tools.simulator.screen import SimulatorScreen

SIDE, SPEED, WAIT = 2.0, 0.5, 1.0
"""Of the square: m, m/s, and seconds until it begins; one lap takes 18 s."""

_NAME = "triskar2"
_INSIDE = "memory:triskar2-pc"  # where PC1 is, outside of the robot but in this process
_PATIENCE = 6.0  # seconds that its bus gets to settle
_REFRESH = 0.25  # seconds, at a terminal
_LINES = 2.0  # seconds between lines where there is none
_FAST_LINES = 10.0  # ... and under virtual time


class Play(msgspec.Struct, frozen=True, kw_only=True):
    """What to play. `duration` in s, None: until it is ended. `outside`: where the gateway lets others in.

    `laps` of a square that a PC drives. `fast`: under virtual time. `bus`: its statistics at the end. `allow_control`:
    the gateway lets REBOOT and BOOTLOAD in.
    """

    duration: float | None = None
    seed: int = 0
    outside: tuple[str, ...] = ()
    laps: float = 0
    fast: bool = False
    bus: bool = False
    allow_control: bool = False


async def play(wish: Play) -> None:
    """Run the robot and show it."""
    world = World(box(SIDE / 2, SIDE / 2, 3.8, 3.8))
    screen = SimulatorScreen(world, live=not wish.fast, duration=wish.duration)
    bus = can_bus(_NAME, seed=wish.seed)
    outside, options = [*wish.outside, _INSIDE], BridgeOptions(allow_control=wish.allow_control)
    robot = Triskar2(f"sim:{_NAME}", seed=wish.seed, world=world, outside=outside, options=options)
    async with robot, r2p.Module("PC1", via=_INSIDE, watchdog=False) as pc:
        screen.say(f"Triskar2 starts: {len(robot.modules)} modules on a simulated RTCAN bus")
        with contextlib.suppress(TimeoutError):  # a computer that is too slow for it: show what there is
            await robot.ready(_PATIENCE)
        gauge = Gauge(robot, bus, [pc])
        pc.start(functools.partial(_watch, gauge=gauge), name="watch")
        if wish.laps:
            pc.start(functools.partial(square, side=SIDE, speed=SPEED, laps=wish.laps, wait=WAIT), name="square")
        screen.introduce(*_introduction(robot, driven=wish.laps > 0))
        figures = gauge.read(0.0)
        try:
            with screen:
                async for time in _moments(wish.duration, _pace(wish, screen)):
                    figures = gauge.read(time)
                    screen.show(figures)
        finally:  # also when Ctrl-C ends it
            conclude(screen, figures, fast=wish.fast)
            if wish.bus:
                screen.say("", *bus_table(bus))


def _pace(wish: Play, screen: SimulatorScreen) -> float:
    """Seconds between two looks."""
    return _FAST_LINES if wish.fast else _REFRESH if screen.live else _LINES


async def _watch(node: r2p.Node, gauge: Gauge) -> None:
    node.subscribe("odometry", Odometry, gauge.told, queue=1, lossy=True)
    while True:
        await node.spin()


async def _moments(duration: float | None, period: float) -> AsyncIterator[float]:
    """Seconds since now: once each period, and at the end."""
    loop = asyncio.get_running_loop()
    start = loop.time()
    time = 0.0
    while duration is None or time < duration:
        left = period if duration is None else min(period, duration - time)
        await asyncio.sleep(left)
        time = loop.time() - start
        yield time


def addresses(robot: Triskar2) -> list[str]:
    """URLs by which other programs reach the robot."""
    gateway = robot.modules["GW"]
    urls = [f"{url.partition(':')[0].removesuffix('-listen')}:{address}" for url, address in gateway.addresses]
    listening = {url.partition(":")[0] for url, _ in gateway.addresses}
    others = [str(url) for url in robot.outside if str(url).partition(":")[0] not in listening and url != _INSIDE]
    return [*urls, *others]


def program() -> str:
    """What to type for this program in another terminal of the same folder."""
    typed = sys.argv[0]
    if Path(typed).name != "r2p" or not os.access(typed, os.X_OK):  # not started as a command
        return "r2p"
    found = shutil.which("r2p")
    return "r2p" if found and Path(found).samefile(typed) else typed


def _introduction(robot: Triskar2, *, driven: bool) -> list[str]:
    """What to do in another terminal meanwhile."""
    urls = addresses(robot)
    if not urls:
        return []
    hints = [f"topic echo odometry --via {url}" for url in urls]
    if not driven:
        hints.append(f"topic pub velocity_cmd x=0.2 -r 20 --via {urls[0]}")
    return ["In another terminal:", *(f"  {program()} {hint}" for hint in hints)]


def conclude(screen: SimulatorScreen, figures: Figures, *, fast: bool) -> None:
    """Sum up. In real time, the computer may be why something was late."""
    x, y, _ = figures.pose
    screen.say("", f"{figures.time:.1f} s, {figures.path:.2f} m driven; the robot is at x {x:.3f}, y {y:.3f} m")
    if figures.off is not None:
        screen.say(f"odometry is off by {figures.off * 1000:.0f} mm: wheels are never all of one size")
    count = sum(topic.sent for topic in figures.topics)
    screen.say(f"{count} messages published, {figures.missed} missed a deadline")
    worst = max(figures.topics, key=lambda topic: topic.missed, default=None)
    if worst is not None and worst.missed:
        screen.say(f"  most of them of {worst.topic}: {worst.missed}{'' if fast else '; is this computer busy?'}")
    if figures.bus is not None:
        screen.say(f"bus: {figures.bus.frames} frames, {figures.bus.errors} errors; load {figures.bus.mean:.0%}")


def bus_table(bus: SimCan) -> list[str]:
    """Who sent how much."""
    statistics = bus.bus.statistics
    total = statistics.total.occupied or 1
    rows = [f"{'NODE':8} {'FRAMES':>8} {'SHARE':>6} {'ERRORS':>7} {'ARBITRATIONS LOST':>18}"]
    for name, count in sorted(statistics.by_node.items()):
        rows.append(f"{name:8} {count.frames:8} {count.occupied / total:6.0%} {count.errors:7} {count.lost:18}")
    return rows
