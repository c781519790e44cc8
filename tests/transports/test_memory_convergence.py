"""Networks in memory without faults, where everything is said once: all modules know what there is, and go on to."""

from __future__ import annotations

import asyncio
import random
from contextlib import AsyncExitStack
from typing import Any

import pytest

import r2p
from r2p.keys import SharedKey
from r2p.messages import layout
from r2p.msg import Float32, Led, Text
from r2p.testing.network import Network, node_in
from r2p.transports.memory import MemoryLink, MemoryNetwork, MemoryTransport

pytestmark = pytest.mark.virtual_time

LONG_NODE = "a_node_with_a_long_name"
TOPICS: dict[str, type[r2p.Message]] = {"a": Led, "arm/left/joint_states": Float32, "b": Text}
NODES = ("one", LONG_NODE)
End = tuple[str, str, str, bool]
"""Module, node, topic, and whether it publishes."""


class Robot:
    """Modules that come, go and change at random, and what there is of them."""

    def __init__(self, seed: int) -> None:
        self.chance = random.Random(seed)
        self.network = Network()
        self.modules: dict[str, tuple[r2p.Module, dict[str, r2p.Node], AsyncExitStack]] = {}
        self.ends: dict[End, Any] = {}

    async def start(self) -> None:
        name = self.chance.choice(["A", "B", "C", "D", "a_module_with_a_long_name"])
        if name in self.modules:
            return
        stack = AsyncExitStack()
        module = await stack.enter_async_context(self.network.module(name))
        nodes = {each: await stack.enter_async_context(node_in(module, name=each)) for each in NODES}
        self.modules[name] = module, nodes, stack

    async def stop(self) -> None:
        self.plug_all()
        name = self.chance.choice(list(self.modules))
        self.ends = {end: each for end, each in self.ends.items() if end[0] != name}
        await self.modules.pop(name)[2].aclose()

    def begin(self) -> None:
        name, node, topic = (self.chance.choice(list(each)) for each in (self.modules, NODES, TOPICS))
        end = name, node, topic, self.chance.random() < 0.5
        if end not in self.ends:
            here, message = self.modules[name][1][node], TOPICS[topic]
            self.ends[end] = here.advertise(topic, message) if end[3] else here.subscribe(topic, message)

    def end(self) -> None:
        if self.ends:
            self.ends.pop(self.chance.choice(list(self.ends))).close()

    def unplug(self) -> None:
        for link in self.modules[self.chance.choice(list(self.modules))][0].links:
            assert isinstance(link, MemoryLink)
            (link.disconnect if link.up else link.connect)()

    def plug_all(self) -> None:
        for module, _, _ in self.modules.values():
            for link in module.links:
                assert isinstance(link, MemoryLink)
                if not link.up:
                    link.connect()

    async def change(self) -> None:
        if not self.modules:
            await self.start()
        for each in self.chance.choices([self.start, self.stop, self.begin, self.end, self.unplug], [5, 1, 12, 4, 2]):
            made = each()
            if made is not None:
                await made

    def check(self) -> None:
        for name, (module, _, _) in self.modules.items():
            views = module.network.topics()
            views.pop("log", None)
            assert {each.name for each in module.network.modules()} == self.modules.keys()
            known = {(each.module, each.node, view.name, True) for view in views.values() for each in view.publishers}
            known |= {
                (each.module, each.node, view.name, False) for view in views.values() for each in view.subscribers
            }
            assert known == self.ends.keys(), name
            for _, _, topic, publishes in self.ends:
                if publishes:
                    assert views[topic].fingerprint == layout(TOPICS[topic]).fingerprint
            for end, each in self.ends.items():
                if end[0] == name and end[3]:
                    subscribers = [other for other in self.ends if other[2] == end[2] and not other[3]]
                    here = [other for other in subscribers if other[0] == name]
                    assert each.subscribers == len(here) + (len(here) < len(subscribers))


@pytest.mark.parametrize("seed", range(7))
async def test_all_know_what_there_is(seed: int) -> None:
    robot = Robot(seed)
    pause = robot.chance.choice([0.0, 0.1, 10.0])
    for _ in range(2):
        for _ in range(20):
            await robot.change()
            await asyncio.sleep(pause * robot.chance.random())
        robot.plug_all()
        await asyncio.sleep(3)
        robot.check()
        await asyncio.sleep(45)
        robot.check()
    for _, _, stack in robot.modules.values():
        await stack.aclose()


@pytest.mark.parametrize("key", [None, SharedKey(bytes(32))], ids=["without a key", "with a key"])
async def test_what_ends_while_a_link_is_down_is_said_when_it_is_up(key: SharedKey | None) -> None:
    network = MemoryNetwork()
    async with (
        r2p.Module("A", via=MemoryTransport("lab", network, key=key)) as a,
        r2p.Module("B", via=MemoryTransport("lab", network, key=key)) as b,
        node_in(a) as here,
        node_in(b) as there,
    ):
        publisher = there.advertise("leds", Led)
        subscriber, ended = here.subscribe("leds", Led), here.advertise("other", Led)
        await asyncio.sleep(1)
        (link,) = a.links
        assert isinstance(link, MemoryLink)
        link.disconnect()
        subscriber.close()
        ended.close()
        link.connect()
        await asyncio.sleep(1)
        assert publisher.subscribers == 0
        assert [b.network.topics()[name].subscribers for name in ("leds", "other")] == [[], []]
        assert b.network.topics()["other"].publishers == []


async def test_a_long_name_of_two_modules_is_known_when_one_of_them_has_ended_it() -> None:
    network = Network()
    async with network.module("A") as a, network.module("B") as b, node_in(b, name=LONG_NODE) as there:
        async with node_in(a, name=LONG_NODE) as here:
            here.advertise("ends", Led)
            publisher = there.advertise("leds", Led)
            await asyncio.sleep(1)
        there.advertise("more", Led)
        publisher.close()
        await asyncio.sleep(0.1)
        views = a.network.topics()
        assert [each.node for each in views["more"].publishers] == [LONG_NODE]
        assert views["leds"].publishers == []


async def test_a_type_ends_with_its_last_publisher() -> None:
    """What comes next says its type once, and soon: the one of before is not still believed for its lease."""
    network = Network()
    async with network.module("A", observer=True) as a, network.module("B") as b:
        for message in (Led, Float32):
            async with node_in(b) as node:
                node.advertise("a/topic/of/a/long/name", message)
                await asyncio.sleep(0.1)
                assert a.network.topics()["a/topic/of/a/long/name"].fingerprint == layout(message).fingerprint


async def test_a_subscriber_of_another_type_does_not_hide_that_of_the_publisher() -> None:
    network = Network()
    async with network.module("A", observer=True) as a, network.node("B") as b, network.node("C") as c:
        b.advertise("leds", Led)
        await asyncio.sleep(8)
        c.subscribe("leds", Float32)
        await asyncio.sleep(0.1)
        assert a.network.topics()["leds"].fingerprint == layout(Led).fingerprint


async def test_a_module_of_many_is_said_to_be_gone_after_the_time_in_which_it_was_silent(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Rounds have grown since its HELLO, which said 5 s."""
    async with AsyncExitStack() as stack:
        modules = [await stack.enter_async_context(r2p.Module(f"M{n}", via="memory:many")) for n in range(40)]
        await asyncio.sleep(1.0)
        (link,) = modules[-1].links
        assert isinstance(link, MemoryLink)
        link.disconnect()
        await asyncio.sleep(10.0)
        assert len(modules[0].network.modules()) == 39
    assert "link memory:many: module M39 is gone: nothing heard of it for 9 s" in caplog.text
