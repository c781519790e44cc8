"""How much modules say when they start, counted on an in-memory network."""

from __future__ import annotations

import asyncio
import contextlib

import pytest

import r2p
from r2p.msg import Led
from r2p.names import MANAGEMENT
from r2p.testing.network import node_in
from r2p.transports.memory import Datagram, network

pytestmark = pytest.mark.virtual_time


async def messages_of_a_start(monkeypatch: pytest.MonkeyPatch, modules: int, topics: int, *, apart: float) -> int:
    """Management messages until all receive from all: each module publishes and subscribes the same topics."""
    said = 0
    lab = network("lab")
    send = lab.send

    def count(frame: Datagram) -> None:
        nonlocal said
        said += frame.topic == MANAGEMENT.encode()
        send(frame)

    monkeypatch.setattr(lab, "send", count)
    async with contextlib.AsyncExitStack() as stack:
        subscribers: list[r2p.Subscriber[Led]] = []
        for number in range(modules):
            module = await stack.enter_async_context(r2p.Module(f"M{number}", via="memory:lab", watchdog=False))
            node = await stack.enter_async_context(node_in(module))
            for topic in range(topics):
                node.advertise(f"t{topic}", Led)
                subscribers.append(node.subscribe(f"t{topic}", Led))
            await asyncio.sleep(apart)
        await asyncio.sleep(1.5)
        until_now = said
        assert {each.publishers for each in subscribers} == {modules}
    return until_now


@pytest.mark.parametrize("apart", [0.0, 0.03])
async def test_a_start_costs_messages_in_proportion_to_modules(monkeypatch: pytest.MonkeyPatch, apart: float) -> None:
    """Whether they start at one instant or one after the other."""
    few, many = [await messages_of_a_start(monkeypatch, count, 1, apart=apart) for count in (8, 24)]
    assert few < 8 * 85
    assert many < 3.5 * few


async def test_a_start_costs_messages_in_proportion_to_topics(monkeypatch: pytest.MonkeyPatch) -> None:
    one, six = [await messages_of_a_start(monkeypatch, 8, topics, apart=0.0) for topics in (1, 6)]
    assert six < 6 * one


async def test_a_newcomer_knows_all_nodes_soon() -> None:
    """However many modules there are, and though another one has just been answered."""
    async with contextlib.AsyncExitStack() as stack:
        for number in range(12):
            module = await stack.enter_async_context(r2p.Module(f"M{number}", via="memory:lab", watchdog=False))
            (await stack.enter_async_context(node_in(module))).advertise(f"t{number}", Led)
        await asyncio.sleep(10)
        newcomers = [r2p.Module(f"L{number}", via="memory:lab", watchdog=False) for number in range(3)]
        late = [await stack.enter_async_context(module) for module in newcomers]
        await asyncio.sleep(1)
        for module in late:
            topics = module.network.topics()
            assert all(topics[f"t{number}"].publishers for number in range(12))
