"""`r2p bag record`."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest

from r2p.msg import Led
from r2p.recording.bag import Bag
from r2p.tools.bag.record import record
from tests.tools.rig import robot, tool

if TYPE_CHECKING:
    from pathlib import Path

    import r2p


async def leds(node: r2p.Node) -> None:
    publisher = node.advertise("leds", Led)
    async for _ in node.every(0.1):
        await publisher.publish(Led(led=publisher.sent, value=1))


@pytest.mark.virtual_time
async def test_all_topics_are_recorded_until_a_signal(tmp_path: Path) -> None:
    path = tmp_path / "one.mcap"
    async with robot(leds), tool() as session:
        task = asyncio.create_task(record(session, all=True, output=path))
        await asyncio.sleep(2.0)
        task.cancel()
        await asyncio.wait([task])
    with Bag(path) as bag:
        values = [sample.message.led for sample in bag.samples("leds")]
    assert values == list(range(values[0], values[0] + len(values)))
    assert len(values) >= 15
