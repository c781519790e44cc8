"""Recordings are played on buses, in slots, and on lines."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

import r2p
from r2p.msg import Led
from r2p.recording.bag import Bag
from r2p.recording.player import Player
from r2p.units import MILLISECOND
from tests.recording.test_player import PERIODIC, SPORADIC, led, write


@asynccontextmanager
async def played_on_bus(
    path: Path, topic: str, cls: type[Led] | None
) -> AsyncIterator[tuple[r2p.Module, list[r2p.Sample]]]:
    """The module that plays a recording on a bus at the end of the block, and what another module receives there."""
    seen: list[r2p.Sample] = []

    async def listen(node: r2p.Node) -> None:
        subscriber: r2p.Subscriber[Any] = node.subscribe(topic, cls, queue=100)
        async for sample in subscriber.samples():
            seen.append(sample)  # noqa: PERF401 - it goes on for ever

    async with (
        r2p.Module("PC1", via="sim:lab", watchdog=False) as pc,
        r2p.Module("play", via="sim:lab", watchdog=False) as source,
    ):
        pc.start(listen)
        await asyncio.sleep(3)
        with Bag(path) as bag:
            async with Player(source, bag) as player:
                await asyncio.sleep(3)
                yield source, seen
                await player.run()
                await asyncio.sleep(0.1)
                assert player.missed == {}


@pytest.mark.virtual_time
async def test_periodic_messages_get_slots_of_the_bus(tmp_path: Path) -> None:
    records = [led(i) for i in range(200)]
    for _, sample, _, _ in records:
        sample.publisher_class = PERIODIC
    path = write(tmp_path / "a.mcap", records)
    async with played_on_bus(path, "leds", Led) as (source, seen):
        (link,) = source.links
        assert link.guarantee("leds", PERIODIC).startswith("a slot every")
    assert [each.data for each in seen] == [sample.data for _, sample, _, _ in records]


@pytest.mark.virtual_time
async def test_events_and_untyped_messages_pass_a_bus_in_time(tmp_path: Path) -> None:
    records = [led(i) for i in range(20)]
    for i, (_, sample, _, _) in enumerate(records):
        sample.publisher_class, sample.deadline = SPORADIC, sample.stamp + 20 * MILLISECOND
        sample.data = bytes([i] * 12)
    path = write(tmp_path / "a.mcap", [("raw", sample, None, at) for _, sample, _, at in records])
    async with played_on_bus(path, "raw", None) as (_, seen):
        pass
    assert [each.data for each in seen] == [sample.data for _, sample, _, _ in records]
    assert all(0 < each.deadline - each.stamp <= 21 * MILLISECOND for each in seen)
