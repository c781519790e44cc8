"""What Robocom is for: samples that belong together, and a recording of them that a sensor-fusion program reads."""

from __future__ import annotations

import asyncio
import runpy
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

import r2p
from r2p.sim.robots.robocom.nodes import eight
from r2p.sim.robots.robocom.robot import Robocom

if TYPE_CHECKING:
    from collections.abc import Callable

pytestmark = pytest.mark.virtual_time

FUSION = Path(__file__).parents[3] / "examples" / "fusion.py"
VIA = "memory:robot"


async def test_joined_estimates_are_better_than_each_alone(tmp_path: Path) -> None:
    pytest.importorskip("mcap")
    async with Robocom(VIA, seed=2, truth=True) as robot, r2p.Module("PC1", via=VIA) as pc:
        await robot.ready(10)
        async with r2p.Recorder(pc, tmp_path / "drive.mcap"):
            await asyncio.sleep(2)
            pc.start(eight)
            await asyncio.sleep(60)
        assert robot.hardware.body.path > 30
    fuse: Callable[[str], dict[str, float]] = runpy.run_path(str(FUSION))["fuse"]
    error = fuse(str(tmp_path / "drive.mcap"))
    assert error["all three"] < 0.8 * min(error["encoders"], error["GPS"])
    assert error["all three"] < error["encoders and gyroscope"] + 0.3
    assert 0.5 < error["GPS"] < 1.5


async def test_a_recording_of_a_robot_that_drives_already_begins_at_its_pose(tmp_path: Path) -> None:
    pytest.importorskip("mcap")
    async with Robocom(VIA, seed=2, truth=True) as robot, r2p.Module("PC1", via=VIA) as pc:
        await robot.ready(10)
        pc.start(eight)
        await asyncio.sleep(10)
        async with r2p.Recorder(pc, tmp_path / "drive.mcap"):
            await asyncio.sleep(5)
    fuse: Callable[[str], dict[str, float]] = runpy.run_path(str(FUSION))["fuse"]
    error = fuse(str(tmp_path / "drive.mcap"))
    assert error["all three"] < 0.2 < error["GPS"]
