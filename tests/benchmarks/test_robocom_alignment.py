"""How far apart Robocom's samples are: what must be so, and what is left."""

from __future__ import annotations

import pytest

from benchmarks.robocom_alignment import alignment
from r2p.sim.robots.robocom.robot import InterruptLatency

pytestmark = pytest.mark.virtual_time


async def test_the_bus_itself_does_not_misalign_samples() -> None:
    """Without a delay of the modules' software, the end of the sync is one instant, and stamps are exact."""
    left, imu, stamp, ticks, arrival = await alignment(InterruptLatency(0.0, 0.0), seconds=2.0)
    assert max(left.most, imu.most, stamp.most, ticks.most) < 0.1
    assert 100 < arrival.mean < 25_000


async def test_what_is_left_is_the_jitter_of_interrupts() -> None:
    """That of the master, which sends the sync, and that of each module."""
    left, imu, stamp, ticks, arrival = await alignment(seconds=2.0)
    assert 1.0 < left.mean < left.most <= 6.0
    assert 1.0 < imu.mean < imu.most <= 6.0
    assert stamp.most <= 6.5
    assert ticks.most < 6.0
    assert str(left).startswith("left and right encoder ")
    assert arrival.most > 100
