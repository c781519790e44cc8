"""The page about Robocom lists the parameters of its own nodes."""

from __future__ import annotations

import asyncio
import re
from pathlib import Path

import pytest

from r2p.sim.robots.robocom.robot import Robocom

PAGE = Path(__file__).parents[3] / "docs" / "robots" / "robocom.md"
OWN = ("invkin", "encoder", "imu_raw", "gps")


@pytest.mark.virtual_time
async def test_the_page_lists_the_parameters_of_its_own_nodes() -> None:
    async with Robocom("memory:page", modules=["MOTOR1", "IMU1"]) as robot:
        await asyncio.sleep(0.1)
        infos = [info for board in robot.modules.values() for info in board.parameters.infos() if info.node in OWN]
    declared = {
        (info.node, info.name): (f"{info.default:g}", f"{info.minimum:g}, {info.maximum:g}", info.unit)
        for info in infos
    }
    listed, node = {}, ""
    rows = r"^\| (?:`(\w+)`)? ?\| `(\w+)` \| ([^|]+) \| ([^|]+, [^|]+) \| ([^|]+) \|"
    for named, name, default, limits, unit in re.findall(rows, PAGE.read_text(encoding="utf-8"), re.MULTILINE):
        node = named or node
        listed[node, name] = (default, limits, unit)
    assert listed == declared
