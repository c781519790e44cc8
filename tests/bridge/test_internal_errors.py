"""What a gateway, or a module with several links, does when the handling of one thing raises: it goes on."""

from __future__ import annotations

import asyncio
import functools
from typing import TYPE_CHECKING

import pytest

import r2p
from r2p.bridge import MultihomedModule
from r2p.bridge.forwarding import HeldMessages
from r2p.codecs.management import Bridge, Endpoint, Hello
from r2p.msg import Led
from r2p.protocols.bridge.ports import SendToClients
from r2p.runtime.sample import Sample, Source
from tests.bridge.test_bridge import Tap, drain, gateway, node
from tests.faults import once

if TYPE_CHECKING:
    from r2p import bridge

pytestmark = [pytest.mark.virtual_time, pytest.mark.internal_errors]

SETTLED = 5.0


def bridge_of(module: r2p.Module) -> bridge.Bridge:
    hub = module._link_manager
    assert hub is not None
    assert hub.bridge is not None
    return hub.bridge


def errors(module: r2p.Module) -> list[int]:
    return [link.losses["internal error"] for link in module.links]


async def passes(topic: str = "leds") -> None:
    """Messages of modules that are new go through the gateway."""
    async with node("NEW1", "a") as alice, node("NEW2", "b") as bob:
        publisher, subscriber = alice.advertise(topic, Led), bob.subscribe(topic, Led)
        await asyncio.sleep(SETTLED)
        await publisher.publish(Led(1))
        await asyncio.sleep(0.1)
        assert drain(subscriber) == [1]


async def test_the_alarm_of_the_tree(monkeypatch: pytest.MonkeyPatch) -> None:
    async with gateway() as module:
        bridge = bridge_of(module)
        monkeypatch.setattr(bridge.tree, "poll", once(bridge.tree.poll))
        await asyncio.sleep(SETTLED)
        assert errors(module) == [1, 1]
        await passes()


async def test_what_the_tree_sends(monkeypatch: pytest.MonkeyPatch) -> None:
    async with gateway() as module:
        first, second = module.links
        monkeypatch.setattr(first, "write_management", once(first.write_management))
        sent = []
        monkeypatch.setattr(second, "write_management", lambda data, **_: sent.append(data))
        bridge_of(module)._act()
        await asyncio.sleep(1.0)
        assert (errors(module), bool(sent)) == ([1, 0], True)


@pytest.mark.parametrize("part", ["routing", "directory"])
async def test_what_follows_from_a_new_place_in_the_tree(part: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Topics and modules pass, though it raised where a link got its place; and the gateway is heard on."""
    async with r2p.Module("GW", via=["memory:a", "memory:b"], bridge=True) as module:
        target = getattr(bridge_of(module), part)
        method = {"routing": "port_changed", "directory": "changed"}[part]
        monkeypatch.setattr(target, method, once(getattr(target, method)))
        await asyncio.sleep(SETTLED)
        assert sum(errors(module)) == 1
        tap = Tap("a")
        await passes()
        assert any(isinstance(each, Bridge) for each in tap.heard)


async def test_what_is_said_to_clients(monkeypatch: pytest.MonkeyPatch) -> None:
    async with gateway() as module:
        bridge = bridge_of(module)
        send = once(bridge._send_to_clients)
        monkeypatch.setattr(bridge, "_send_to_clients", send)
        monkeypatch.setattr(bridge.tree, "pop_actions", lambda: [SendToClients(Bridge(7, 0, 1, 0, 7, bytes(12)))])
        bridge._act()
        monkeypatch.undo()
        assert errors(module) == [1, 1]
        await passes()


@pytest.mark.parametrize("kind", [Hello, Endpoint])
async def test_what_is_told_of_modules(kind: type[object], monkeypatch: pytest.MonkeyPatch) -> None:
    async with gateway() as module:
        link = module.links[1]
        monkeypatch.setattr(link, "relay", once(link.relay, lambda message: isinstance(message, kind)))
        async with node("A", "a") as alice, node("C", "a") as carol, r2p.Module("B", via="memory:b") as b:
            alice.advertise("leds", Led)
            carol.advertise("leds", Led)
            await asyncio.sleep(SETTLED)
            assert errors(module) == [0, 1]
            assert {each.name for each in b.network.modules()} == {"A", "B", "C", "GW"}
            publishers = b.network.topics()["leds"].publishers
            assert sorted(each.module for each in publishers) == ["A", "C"]


async def test_the_review_of_one_topic(monkeypatch: pytest.MonkeyPatch) -> None:
    async with gateway() as module, node("A", "a") as alice, node("B", "b") as bob:
        routing = bridge_of(module).routing
        monkeypatch.setattr(routing, "_review", once(routing._review))
        publishers = [alice.advertise(name, Led) for name in ("one", "two", "three")]
        subscribers = [bob.subscribe(name, Led) for name in ("one", "two", "three")]
        await asyncio.sleep(SETTLED)
        for publisher in publishers:
            await publisher.publish(Led(1))
        await asyncio.sleep(0.1)
        assert [drain(each) for each in subscribers] == [[1]] * 3
        assert errors(module) == [1, 1]


async def test_the_alarm_of_a_module_with_several_links(monkeypatch: pytest.MonkeyPatch) -> None:
    async with gateway(), r2p.Module("PC", via=["memory:a", "memory:b"]) as module:
        multihomed = module._link_manager and module._link_manager._bridging
        assert isinstance(multihomed, MultihomedModule)
        monkeypatch.setattr(multihomed.selection, "poll", once(multihomed.selection.poll))
        await asyncio.sleep(SETTLED)
        assert errors(module) == [1, 1]
        assert sum(bool(link.stands_by) for link in module.links) == 1


@pytest.mark.parametrize("step", ["_collect", "_meet", "_announce"])
async def test_what_is_read_of_modules(step: str, monkeypatch: pytest.MonkeyPatch) -> None:
    async with gateway() as module:
        directory = bridge_of(module).directory
        monkeypatch.setattr(directory, step, once(getattr(directory, step)))
        async with node("A", "a"), r2p.Module("B", via="memory:b") as b:
            await asyncio.sleep(SETTLED)
            assert sum(errors(module)) in (1, 2)
            assert "A" in {each.name for each in b.network.modules()}


async def test_what_is_kept_while_a_gateway_listens_anew() -> None:
    held, failed, taken = HeldMessages(), list[str](), list[int]()

    def go_on(number: int) -> None:
        taken.append(10 // number)

    for number in (1, 0, 2):
        assert held.hold(Sample(b"", Source(), 0), functools.partial(go_on, number))
    held.release(lambda error: failed.append(type(error).__name__))
    assert (taken, failed) == ([10, 5], ["ZeroDivisionError"])
