"""Recordings are played on buses, in slots, and on lines."""

import asyncio
from pathlib import Path

import pytest

import r2p
from r2p.msg import Led
from r2p.recording.bag import Bag
from r2p.recording.player import Player
from r2p.units import MILLISECOND
from tests.recording.test_player import PERIODIC, SPORADIC, led, write


@pytest.mark.virtual_time
async def test_periodic_messages_get_slots_of_the_bus(tmp_path: Path) -> None:
    records = [led(i) for i in range(200)]
    for _, sample, _, _ in records:
        sample.publisher_class = PERIODIC
    path = write(tmp_path / "a.mcap", records)
    seen: list[r2p.Sample] = []

    async def listen(node: r2p.Node) -> None:
        async for sample in node.subscribe("leds", Led, queue=100).samples():
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
                (link,) = source.links
                assert link.guarantee("leds", PERIODIC).startswith("a slot every")
                await player.run()
                await asyncio.sleep(0.1)
                assert player.missed == {}
    assert [each.data for each in seen] == [sample.data for _, sample, _, _ in records]


@pytest.mark.virtual_time
async def test_events_and_untyped_messages_pass_a_bus_in_time(tmp_path: Path) -> None:
    records = [led(i) for i in range(20)]
    for i, (_, sample, _, _) in enumerate(records):
        sample.publisher_class, sample.deadline = SPORADIC, sample.stamp + 20 * MILLISECOND
        sample.data = bytes([i] * 12)
    path = write(tmp_path / "a.mcap", [("raw", sample, None, at) for _, sample, _, at in records])
    seen: list[r2p.Sample] = []

    async def listen(node: r2p.Node) -> None:
        async for sample in node.subscribe("raw", None, queue=100).samples():
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
                await player.run()
                await asyncio.sleep(0.1)
                assert player.missed == {}
    assert [each.data for each in seen] == [sample.data for _, sample, _, _ in records]
    assert all(0 < each.deadline - each.stamp <= 21 * MILLISECOND for each in seen)
