"""Events: from when on a listener gets them, and for how long."""

from __future__ import annotations

import asyncio

import pytest

import r2p
from r2p.runtime.events import EVENTS, EventHub
from tests.bench import collect, joined, settle

CUT = r2p.LinkDown("lab", "cut")


@pytest.mark.virtual_time
async def test_a_listener_without_references_is_forgotten() -> None:
    hub = EventHub()
    for _ in range(1000):
        hub.listen()
    unread = hub.listen()
    hub.emit(CUT)
    assert len(hub._listeners) == 1
    assert await anext(unread) == CUT


@pytest.mark.virtual_time
async def test_a_reader_that_is_cancelled_leaves_nothing_behind() -> None:
    hub = EventHub()
    reading = asyncio.create_task(collect(hub.listen(), []))
    await settle()
    assert len(hub._listeners) == 1
    reading.cancel()
    await asyncio.wait([reading])
    del reading
    assert len(hub._listeners) == 0


@pytest.mark.virtual_time
async def test_the_oldest_of_too_many_events_are_lost() -> None:
    hub = EventHub()
    events = hub.listen()
    for number in range(EVENTS + 1):
        hub.emit(r2p.LinkDown("lab", str(number)))
    hub.close()
    assert [event.reason async for event in events if isinstance(event, r2p.LinkDown)] == [
        str(number) for number in range(1, EVENTS + 1)
    ]
    assert [event async for event in hub.listen()] == []


@pytest.mark.virtual_time
async def test_one_may_listen_before_the_module_is_open() -> None:
    module = joined("A")
    got: list[r2p.ModuleEvent] = []
    listening = asyncio.create_task(collect(module.events(), got))
    await settle(1.0)
    async with module:
        await settle(1.0)
    await listening
    assert [type(event) for event in got] == [r2p.LinkUp]


@pytest.mark.virtual_time
async def test_a_node_hears_of_its_modules_links() -> None:
    got: list[r2p.ModuleEvent] = []

    async def watch(node: r2p.Node) -> None:
        async for event in node.events():
            got.append(event)
            return

    async with joined("A") as module:
        module.start(watch)
        await settle(1.0)
        module.links[0].on_down("cut")
        await module.wait()
    assert got == [r2p.LinkDown("memory:lab", "cut")]
