"""The joystick, by a pipe in place of its device, under virtual time."""

from __future__ import annotations

import asyncio
import contextlib
import os
import struct
from typing import TYPE_CHECKING

import pytest

import r2p
from r2p.msg import Velocity3
from r2p.sim.robots.robocom.joystick import joystick
from r2p.testing.network import node_in

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from r2p.runtime.subscriber import Subscriber

pytestmark = pytest.mark.virtual_time

VIA = "memory:robot"
AXIS, BUTTON, INITIAL = 2, 1, 0x80
RIGHT, BACK = 0, 1


def event(value: int, number: int, kind: int = AXIS, time: int = 0) -> bytes:
    return struct.pack("<IhBB", time, value, kind, number)


CENTRED = event(0, RIGHT, AXIS | INITIAL) + event(0, BACK, AXIS | INITIAL)


class Stick:
    """The other end of the pipe."""

    def __init__(self, path: Path) -> None:
        self.path = path
        os.mkfifo(path)
        self._fd: int | None = None

    def plug(self, state: bytes = CENTRED) -> None:
        # With both directions it does not wait for a reader.
        self._fd = os.open(self.path, os.O_RDWR | os.O_NONBLOCK)
        self.move(state)

    def move(self, data: bytes) -> None:
        assert self._fd is not None
        os.write(self._fd, data)

    def pull(self) -> None:
        if self._fd is not None:
            os.close(self._fd)
        self._fd = None


@contextlib.asynccontextmanager
async def driving(device: Path) -> AsyncIterator[Subscriber[Velocity3]]:
    params = {"joystick.device": str(device)}
    async with r2p.Module("PC1", via=VIA, params=params) as pc, node_in(pc) as node:
        velocities = node.subscribe("velocity", Velocity3, queue=1, lossy=True)
        pc.start(joystick)
        yield velocities


async def newest(velocities: Subscriber[Velocity3]) -> tuple[float, float]:
    await asyncio.sleep(1)
    velocity = await velocities.fetch(0.2)
    assert velocity.y == 0.0
    return round(velocity.x, 3), round(velocity.w, 3)


async def silent(velocities: Subscriber[Velocity3]) -> bool:
    await asyncio.sleep(1)
    with contextlib.suppress(TimeoutError):
        await velocities.fetch(0.2)
    try:
        await velocities.fetch(0.5)
    except TimeoutError:
        return True
    return False


async def test_the_stick_moves_and_turns_the_robot(tmp_path: Path) -> None:
    stick = Stick(tmp_path / "js0")
    async with driving(stick.path) as velocities:
        stick.plug()
        assert await newest(velocities) == (0.0, 0.0)
        stick.move(event(-32767, BACK))
        assert await newest(velocities) == (0.6, 0.0)
        stick.move(event(-32768, RIGHT) + event(3000, BACK))  # the second one is in the dead zone
        assert await newest(velocities) == (0.0, 1.0)
        stick.move(event(1, 3, BUTTON) + event(32767, 5) + event(18022, RIGHT))
        assert await newest(velocities) == (0.0, -0.5)
        stick.move(event(-32767, BACK)[:3])  # a piece; a device has whole events only
        stick.move(event(-32767, BACK)[3:])
        assert await newest(velocities) == (0.6, -0.5)
        stick.pull()


async def test_unplugged_it_stops_the_robot_and_says_so_and_comes_back(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    stick = Stick(tmp_path / "js0")
    async with driving(stick.path) as velocities:
        stick.plug()
        assert await newest(velocities) == (0.0, 0.0)
        stick.move(event(-32767, BACK))
        assert await newest(velocities) == (0.6, 0.0)
        stick.pull()
        await asyncio.sleep(0.06)
        assert await velocities.fetch(0.2) == Velocity3()
        assert await silent(velocities)
        stick.plug(event(0, RIGHT) + event(-32767, BACK))  # held forward: it was not released yet
        assert await newest(velocities) == (0.0, 0.0)
        stick.move(event(0, BACK))
        await asyncio.sleep(0.2)
        stick.move(event(-32767, BACK))
        assert await newest(velocities) == (0.6, 0.0)
        stick.pull()
    lines = [record.getMessage() for record in caplog.records if record.name == "r2p.PC1.joystick"]
    there, gone = f"joystick {stick.path} is there", f"joystick {stick.path}: No such device"
    said = [line.split(": it")[0].split(": the")[0] for line in lines]
    assert said == [gone, there, gone, there] or said == [there, gone, there]


async def test_without_a_device_it_waits(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    async with driving(tmp_path / "js0") as velocities:
        assert await silent(velocities)
        await asyncio.sleep(30)
        (record,) = [each for each in caplog.records if each.name == "r2p.PC1.joystick"]
        assert "js0: No such file or directory: the robot stops until it is there" in record.getMessage()


async def test_a_recorded_file_is_played_at_its_times(tmp_path: Path) -> None:
    file = tmp_path / "drive.js"
    file.write_bytes(
        event(0, RIGHT, AXIS | INITIAL, 5000)
        + event(-32767, BACK, AXIS, 6000)
        + event(32767, BACK, AXIS, 9000)
        + event(0, BACK, AXIS, 12_000)
    )
    async with driving(file) as velocities:
        got = []
        for _ in range(3):
            await asyncio.sleep(1.8)
            got.append(await newest(velocities))
        assert got[:2] == [(0.6, 0.0), (-0.6, 0.0)]
