"""The page about the robot lists the parameters of its own nodes."""

from __future__ import annotations

import asyncio
import re
from pathlib import Path

import pytest

from r2p.sim.robots.tiltone.robot import TiltOne

PAGE = Path(__file__).parents[4] / "docs" / "robots" / "tiltone.md"


@pytest.mark.virtual_time
async def test_the_page_lists_the_parameters_of_both_controllers() -> None:
    async with TiltOne("memory:page", modules=["IMU1"]) as robot:
        await asyncio.sleep(0.1)
        infos = [info for info in robot.modules["IMU1"].parameters.infos() if info.node in ("velocity", "balance")]
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
