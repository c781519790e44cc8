"""`r2p sim robocom`: what it measures of a drive, and how it looks."""

from __future__ import annotations

import asyncio
import math

import msgspec
import pytest
from rich.console import Console

import r2p
from r2p.sim import can_bus
from r2p.sim.robots.figures import FiguresReader, RobotFigures
from r2p.tools.sim import screen
from r2p.tools.sim.display import PICTURE_HEIGHT, PICTURE_WIDTH, STATE_WIDTH
from r2p.tools.sim.robocom import GpsFigures, RobocomDisplay, RobocomFigures

pytestmark = pytest.mark.virtual_time

VIA = "sim:reader"


async def drive(display: RobocomDisplay, seconds: float) -> RobotFigures[RobocomFigures]:
    """Let it drive, and return its figures."""
    bus = can_bus("reader")
    async with display.robot as robot, r2p.Module("PC1", via=VIA) as pc:
        await robot.ready(10)
        reader = FiguresReader(robot, bus, display.read, [pc])
        display.watch(pc)
        display.drive(pc, rounds=1)
        await asyncio.sleep(seconds)
        return reader.read(seconds)


async def test_figures_of_a_drive() -> None:
    display = RobocomDisplay(VIA, seed=1)
    figures = await drive(display, 5.0)
    body = figures.body
    assert body.path > 1.5
    assert body.odometry is not None
    assert body.odometry.off <= body.off_max < 0.1
    assert [wheel.speed for wheel in body.wheels] == pytest.approx([4.17, 5.83], abs=0.3)
    assert body.inertial[0] == pytest.approx(math.degrees(0.4), abs=3)
    assert body.gps is not None
    assert (body.gps.satellites, body.gps.fix) == (9, 1)
    assert 0.1 < body.gps_off < 3
    assert 4 <= len(body.fixes) <= 6
    assert figures.missed == 0
    assert figures.bus is not None
    assert 0.05 < figures.bus.load < 0.3
    topics = {topic.topic: topic.real_time for topic in figures.topics}
    assert topics["encoder_left"] == topics["imu_raw"] == "hard: in slots"
    lines = [*display.state(body), *display.summary(body), display.line(body)]
    assert all(len(line) <= STATE_WIDTH for line in display.state(body)), lines
    assert all(len(line) <= 80 for line in lines)
    assert "satellites" in "\n".join(lines)
    assert display.summary(body)[-1].startswith("GPS: off by ")
    picture = display.picture(body).plain.split("\n")
    assert len(picture) == PICTURE_HEIGHT
    assert all(len(line) == PICTURE_WIDTH for line in picture)
    assert "+" in "".join(picture)


async def test_it_says_when_the_gps_is_silent_or_sees_no_satellites() -> None:
    display = RobocomDisplay("memory:robot", seed=1)
    body = display.read()
    assert "GPS       nothing yet" in display.state(body)
    assert "odometry  nothing yet" in display.state(body)
    assert display.line(body).endswith("GPS no fix")
    assert len(display.summary(body)) == 1

    def of(fix: int, age: float) -> list[str]:
        return display.state(msgspec.structs.replace(body, gps=GpsFigures(0, fix, 0.0, age)))

    assert "GPS       no fix" in of(0, 0.1)
    assert "GPS       silent for 3 s" in of(1, 3.0)


async def test_it_fits_a_terminal_of_80_columns_and_24_lines() -> None:
    display = RobocomDisplay(VIA, seed=1)
    figures = await drive(display, 3.0)
    view = screen.SimulatorScreen(display)
    view.console = Console(width=80, height=24, force_terminal=True, legacy_windows=False)
    view.print_hints("In another terminal:", "  r2p topic echo odometry --via tcp:127.0.0.1:45123")
    with view.console.capture() as capture:
        view.console.print(view.draw(figures))
    assert len(capture.get().splitlines()) <= 24


async def test_hints_are_to_record_and_to_drive() -> None:
    display = RobocomDisplay("memory:robot", seed=1)
    assert display.hints("tcp:HOST:1", driven=True) == ["bag record -a -o drive.mcap --via tcp:HOST:1"]
    assert display.hints("tcp:HOST:1", driven=False)[0].startswith("topic pub velocity ")
