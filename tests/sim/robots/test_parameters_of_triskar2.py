"""The parameters of the robot: those that its page lists, and what they change while it drives."""

from __future__ import annotations

import asyncio
import re
from pathlib import Path

import pytest

from r2p.sim.robots.emulated import Triskar2

pytestmark = pytest.mark.virtual_time

PAGE = Path(__file__).parents[3] / "docs" / "robot.md"
VIA = "memory:robot"


def shown(value: float) -> str:
    return f"{value:g}"


async def test_the_page_lists_all_of_them() -> None:
    async with Triskar2(VIA) as robot:
        await asyncio.sleep(0.1)
        infos = [info for board in robot.modules.values() for info in board.parameters.infos()]
    declared = {}
    for info in infos:
        assert isinstance(info.default, tuple | int | float)
        assert info.minimum is not None
        assert info.maximum is not None
        default = ", ".join(map(shown, info.default if isinstance(info.default, tuple) else (info.default,)))
        limits = f"{shown(info.minimum)}, {shown(info.maximum)}"
        declared[info.node, info.name] = (default, limits, info.unit)
    listed, node = {}, ""
    rows = r"^\| (?:`(\w+)`)? ?\| `(\w+)` \| ([^|]+) \| ([^|]+) \| ([^|]+) \|"
    for named, name, default, limits, unit in re.findall(rows, PAGE.read_text(encoding="utf-8"), re.MULTILINE):
        node = named or node
        listed[node, name] = (default, limits, unit)
    assert listed == declared
