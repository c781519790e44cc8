"""Gateways with a bus on one side: nothing is lost between the moment a publisher sees a subscriber and the answer on
the bus that tells this subscriber what to receive.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from contextlib import AsyncExitStack, asynccontextmanager
from typing import TYPE_CHECKING

import pytest

import r2p
from r2p.codecs.can_bits import Frame
from r2p.msg import Led, Text
from r2p.sim import SimCan
from r2p.sim.can import CanNode
from r2p.testing.network import node_in
from r2p.transports.memory import MemoryNetwork

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

pytestmark = pytest.mark.virtual_time

CLASSES = [r2p.NonRealTime(), r2p.Sporadic(deadline=0.1)]
_AGREED = 3.0  # s: gateways have their tree, and nodes of a bus their ids
_SEEN = 0.5  # s: what was announced is known everywhere


class Lab:
    """Modules A on a memory network, and B on the bus, or (`further`) on another memory network behind it."""

    def __init__(self) -> None:
        self.can = SimCan(seed=1)
        self.near = MemoryNetwork()
        self.gateways: list[r2p.Module] = []

    @asynccontextmanager
    async def modules(self, *, further: bool) -> AsyncIterator[tuple[r2p.Module, r2p.Module]]:
        """Open the modules and their gateways, and wait until these agree."""
        near, far = self.near, MemoryNetwork()
        gateways = [[near.transport(), self.can.transport()], [far.transport(), self.can.transport()]]
        async with AsyncExitStack() as stack:
            for number, via in enumerate(gateways if further else gateways[:1]):
                made = r2p.Module(f"GW{number}", via=via, bridge=True, watchdog=False)
                self.gateways.append(await stack.enter_async_context(made))
            a = await stack.enter_async_context(r2p.Module("A", via=near.transport()))
            there = far.transport() if further else self.can.transport()
            b = await stack.enter_async_context(r2p.Module("B", via=there))
            await asyncio.sleep(_AGREED)
            yield a, b

    def lost(self) -> dict[str, int]:
        """What the gateways lost on their links, or did not pass on from them."""
        links = [link.losses for each in self.gateways for link in each.links]
        ports = [port.dropped for each in self.gateways for port in each.gateway_statistics().ports]
        return dict(sum(map(Counter, (*links, *ports)), Counter[str]()))


@pytest.mark.parametrize("further", [False, True], ids=["module on the bus", "gateway on the bus"])
@pytest.mark.parametrize("publisher_class", CLASSES, ids=["non real-time", "sporadic"])
@pytest.mark.parametrize("first", ["publisher", "subscriber"])
async def test_what_follows_wait_subscriber_arrives(
    first: str, publisher_class: r2p.NonRealTime | r2p.Sporadic, further: bool
) -> None:
    lab = Lab()
    async with lab.modules(further=further) as (a, b), node_in(a) as near, node_in(b) as far:
        if first == "subscriber":
            subscriber = far.subscribe("leds", Led, queue=10)
            await asyncio.sleep(_SEEN)
            publisher = near.advertise("leds", Led, publisher_class)
        else:
            publisher = near.advertise("leds", Led, publisher_class)
            await asyncio.sleep(_SEEN)
            subscriber = far.subscribe("leds", Led, queue=10)
        await publisher.wait_subscriber()
        for number in range(3):
            await publisher.publish(Led(led=number))
        assert [(await subscriber.fetch(timeout=1.0)).led for _ in range(3)] == [0, 1, 2]
        assert not lab.lost()


@pytest.mark.parametrize("kind", [Led, Text], ids=["fixed", "variable"])
@pytest.mark.parametrize("first", ["publisher", "subscriber"])
async def test_what_a_program_publishes_before_it_ends_arrives(first: str, kind: type[r2p.Message]) -> None:
    lab = Lab()
    async with lab.modules(further=False) as (_, b), node_in(b) as far:
        if first == "subscriber":
            subscriber = far.subscribe("topic", kind, queue=10)
            await asyncio.sleep(_SEEN)
        async with r2p.Module("C", via=lab.near.transport()) as c, node_in(c) as near:
            publisher = near.advertise("topic", kind)
            if first == "publisher":
                await asyncio.sleep(_SEEN)
                subscriber = far.subscribe("topic", kind, queue=10)
            await publisher.wait_subscriber()
            for _ in range(3):
                await publisher.publish(kind())
        await asyncio.sleep(_AGREED)
        assert len(subscriber.queue) == 3
        assert not lab.lost()
        assert not b.links[0].losses


async def test_what_waits_for_an_answer_that_does_not_get_through_is_counted() -> None:
    lab = Lab()
    async with lab.modules(further=False) as (a, b), node_in(a) as near, node_in(b) as far:
        publisher = near.advertise("leds", Led)
        await asyncio.sleep(_SEEN)
        subscriber = far.subscribe("leds", Led, queue=10)
        await publisher.wait_subscriber()
        broken = lab.can.bus.attach(CanNode("broken"))
        broken.babble(Frame(0, bytes(8)))  # before all others, without a pause
        for number in range(3):
            await publisher.publish(Led(led=number))
        await asyncio.sleep(0.9)
        assert not lab.lost()
        await asyncio.sleep(0.2)
        assert lab.lost() == {"not subscribed": 3}
        lab.can.bus.detach(broken)
        await asyncio.sleep(_AGREED)
        await publisher.publish(Led(led=3))
        assert (await subscriber.fetch(timeout=1.0)).led == 3


@pytest.mark.parametrize("latch", [False, True])
async def test_each_arrives_once_also_if_the_last_one_is_latched(latch: bool) -> None:
    lab = Lab()
    async with lab.modules(further=False) as (a, b), node_in(a) as near, node_in(b) as far:
        publisher = near.advertise("leds", Led, latch=latch)
        await asyncio.sleep(_SEEN)
        subscriber = far.subscribe("leds", Led, queue=10)
        await publisher.wait_subscriber()
        for number in range(3):
            await publisher.publish(Led(led=number))
        await asyncio.sleep(_SEEN)
        assert [Led.decode(each.data).led for each in subscriber.queue] == [0, 1, 2]
        assert not lab.lost()


async def test_a_latched_event_reaches_who_comes_after_its_deadline() -> None:
    lab = Lab()
    async with lab.modules(further=False) as (a, b), node_in(a) as near, node_in(b) as far:
        await near.advertise("leds", Led, r2p.Sporadic(deadline=0.1), latch=True).publish(Led(led=7))
        for _ in range(2):
            await asyncio.sleep(_AGREED)
            subscriber = far.subscribe("leds", Led)
            assert (await subscriber.fetch(timeout=1.0)).led == 7
            subscriber.close()
        assert not lab.lost()


async def test_a_type_that_goes_with_its_last_publisher_is_no_loss_at_the_next_gateway() -> None:
    lab = Lab()
    async with lab.modules(further=True) as (a, b), node_in(b) as far:
        subscriber = far.subscribe("leds", Led)
        for number in range(2):
            async with node_in(a) as near:
                publisher = near.advertise("leds", Led)
                await publisher.wait_subscriber()
                await publisher.publish(Led(led=number))
                assert (await subscriber.fetch(timeout=1.0)).led == number
            await asyncio.sleep(_AGREED)
        assert not lab.lost()
