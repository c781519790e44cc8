"""Messages of variable length through a gateway, which knows no types: what the next link carries passes, as it was."""

from __future__ import annotations

import asyncio
from collections import Counter
from contextlib import AsyncExitStack
from typing import Annotated, Any
from unittest.mock import Mock

import pytest

import r2p
from r2p.bridge import BridgeOptions
from r2p.bridge.forwarding import HeldMessages
from r2p.testing.network import node_in
from r2p.transports.rtcan.link import RtcanLink
from tests.transports.cables import LineCable

pytestmark = pytest.mark.virtual_time

HEADER = 4
"""Bytes of the count in front of a text."""


class Note(r2p.Message):
    text: Annotated[str, r2p.Max(100_000)] = ""


class Tag(r2p.Message):
    text: Annotated[str, r2p.Max(16)] = ""


def bus_of(gateway: r2p.Module) -> RtcanLink:
    (bus,) = [link for link in gateway.links if isinstance(link, RtcanLink)]
    return bus


def route(gateway: r2p.Module, source: int, target: int) -> tuple[int, dict[str, int]]:
    """The messages that passed from one link to another, and what was lost."""
    names = gateway.links[source].name, gateway.links[target].name
    (found,) = [
        each
        for each in gateway.gateway_statistics().routes
        if each.topic == "notes" and (each.source, each.target) == names
    ]
    return found.forwarded, found.dropped


async def nodes(stack: AsyncExitStack, options: BridgeOptions | bool = True) -> tuple[r2p.Module, list[r2p.Node]]:
    """A gateway, and a node on each of its links: memory, a bus and a line."""
    cable = LineCable()
    gateway = await stack.enter_async_context(
        r2p.Module("GW", via=["memory:a", "sim:bus", cable.a()], bridge=options, watchdog=False)
    )
    found = []
    vias: tuple[Any, ...] = ("memory:a", "sim:bus", cable.b())
    for name, via in zip("ABC", vias, strict=True):
        module = await stack.enter_async_context(r2p.Module(name, via=via, watchdog=False))
        found.append(await stack.enter_async_context(node_in(module)))
    return gateway, found


@pytest.mark.parametrize("speaker", [0, 1, 2])
async def test_what_fits_the_next_link_passes_and_the_rest_is_counted(speaker: int) -> None:
    sizes = [0, 1, 4, 5, 100, 255 - HEADER, 256 - HEADER, 500, 1020 - HEADER, 1021 - HEADER, 5000, 99_999]
    most = [100_000, 1020 - HEADER, 255 - HEADER]
    async with AsyncExitStack() as stack:
        gateway, found = await nodes(stack)
        publisher = found[speaker].advertise("notes", Note)
        subscribers = {each: found[each].subscribe("notes", Note, queue=99) for each in range(3) if each != speaker}
        await asyncio.sleep(8.0)
        for size in sizes:
            await publisher.publish(Note(text="x" * size))
            await asyncio.sleep(0.1)
        lengths = {
            each: [len((await subscriber.fetch(1.0)).text) for _ in range(len(subscriber.queue))]
            for each, subscriber in subscribers.items()
        }
        for each, received in lengths.items():
            assert received == [size for size in sizes if size <= min(most[each], most[speaker])]
            lost = sum(most[each] < size <= most[speaker] for size in sizes)
            assert gateway.links[each].losses["too long"] == lost
            assert (len(received), +Counter({"too long": lost})) == route(gateway, speaker, each)
            assert subscribers[each].undecodable == 0
        assert publisher.missed == sum(size > most[speaker] for size in sizes)


async def test_slots_for_the_bound_and_periods_of_messages_whose_length_changes() -> None:
    values = iter(range(10**6))
    async with AsyncExitStack() as stack:
        gateway, (alice, bob, _) = await nodes(stack, BridgeOptions(reserve=("tags",)))
        far = bob.subscribe("tags", Tag, queue=10**4)
        alice.advertise("tags", Tag, r2p.Periodic(0.05, lambda: Tag(text="x" * (next(values) % 17))))
        await asyncio.sleep(10.0)
        (slotted,) = bus_of(gateway).slots.values()
        assert slotted.describe().startswith("3 slots every 300 slots")  # for 4 + 4 + 16 bytes
        last = list(far.queue)[-50:]
        assert {sample.publisher_class for sample in last} == {r2p.PublisherClass.PERIODIC}
        sizes = [len(sample.data) - HEADER for sample in last]
        assert [(size + 1) % 17 for size in sizes[:-1]] == sizes[1:]


async def test_a_bound_for_which_there_are_never_slots() -> None:
    """It says so, and what the bus carries goes as a soft real-time message."""
    async with AsyncExitStack() as stack:
        gateway, (alice, bob, _) = await nodes(stack, BridgeOptions(reserve=("notes",)))
        far = bob.subscribe("notes", Note)
        alice.advertise("notes", Note, r2p.Periodic(0.1, lambda: Note(text="short")))
        own = bob.advertise("own", Note, r2p.Periodic(0.1, Note))
        await asyncio.sleep(10.0)
        assert (await far.fetch(1.0)).text == "short"
        (slotted,) = bus_of(gateway).slots.values()
        assert slotted.describe().startswith("refused: ")
        assert own.guarantees["sim:bus"].startswith("refused: ")
        with pytest.raises(r2p.TransportError, match="up to 100004 bytes, and it carries at most 1020"):
            bob.advertise("strict", Note, r2p.Periodic(0.1, Note), strict=True)
        assert {sample.publisher_class for sample in far.queue} == {r2p.PublisherClass.SPORADIC}


def test_messages_that_wait_for_the_gateway_are_limited_in_bytes_too() -> None:
    held, long = HeldMessages(), r2p.Sample(bytes(32 << 20), r2p.Source(), 0)
    assert [held.hold(long, list) for _ in range(3)] == [True, True, False]
    held.release(Mock())
    assert held.hold(long, list)
