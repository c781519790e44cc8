"""What a change of demand costs a gateway with many clients, counted, and that joining subscribers miss nothing."""

from __future__ import annotations

import asyncio
import sys
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import pytest

import r2p
from r2p.bridge.forwarding import RelayedTopic
from r2p.codecs import management
from r2p.msg import Led
from r2p.testing.network import node_in
from tests.bridge.test_bridge import CONVERGED, node
from tests.bridge.test_clients import Client
from tests.transports.conversation import line, manage

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from types import FrameType

pytestmark = pytest.mark.virtual_time

ADVERTISE = manage(management.Advertise("leds", 5))
SUBSCRIBE = manage(management.SubscribeRequest("leds", 5, 5))
RESPONSE = manage(management.SubscribeResponse("leds", 5, 5))


@asynccontextmanager
async def clients(count: int, deny: tuple[str, ...] = ()) -> AsyncIterator[list[Client]]:
    """Those of a gateway."""
    clients = [Client() for _ in range(count)]
    options = r2p.BridgeOptions(deny=deny)
    async with r2p.Module("GW", via=["memory:a", *clients], bridge=options, watchdog=False):
        await asyncio.sleep(CONVERGED)
        yield clients


async def said(messages: list[tuple[Client, bytes]]) -> None:
    for client, message in messages:
        client.hear(message)
        await asyncio.sleep(0.05)


def calls(client: Client, message: bytes) -> int:
    """What the gateway calls in its own code and from there as it hears a message."""
    count = 0

    def profile(frame: FrameType, event: str, _: Any) -> None:
        nonlocal count
        count += event in ("call", "c_call") and "/bridge/" in frame.f_code.co_filename

    before = sys.getprofile()
    sys.setprofile(profile)
    try:
        client.hear(message)
    finally:
        sys.setprofile(before)
    return count


async def cost(count: int, deny: tuple[str, ...] = (), *, wanted: bool, offered: bool) -> int:
    """Calls for the last of these clients, all of which have said the same."""
    async with clients(count, deny) as all_of_them:
        messages = [SUBSCRIBE] * wanted + [ADVERTISE] * offered
        await said([(each, message) for each in all_of_them[:-1] for message in messages])
        await asyncio.sleep(1.0)
        return calls(all_of_them[-1], messages[-1])


@pytest.mark.parametrize(("wanted", "offered"), [(True, True), (False, True), (True, False)])
async def test_a_change_of_demand_costs_as_much_as_there_are_links(wanted: bool, offered: bool) -> None:
    """Not as many as there are pairs of links: four times the clients would make that sixteen times as much."""
    few = await cost(10, wanted=wanted, offered=offered)
    assert await cost(40, wanted=wanted, offered=offered) < 5 * few


@pytest.mark.parametrize(("wanted", "offered"), [(True, True), (False, True), (True, False)])
async def test_rules_between_clients_cost_no_more(wanted: bool, offered: bool) -> None:
    """The policy is asked for kinds of links: those that the same patterns match."""
    deny = ("*@script*>script*",)
    few = await cost(10, deny, wanted=wanted, offered=offered)
    assert await cost(40, deny, wanted=wanted, offered=offered) < 5 * few


async def test_ways_are_worked_out_once_for_each_change_however_many_links_join(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """By the first message that takes them."""
    routed: list[object] = []
    route: Any = RelayedTopic.active_from

    def counted(*args: object) -> object:
        routed.append(args)
        return route(*args)

    monkeypatch.setattr(RelayedTopic, "active_from", counted)
    async with clients(30) as all_of_them:
        await said([(each, SUBSCRIBE) for each in all_of_them])
        for number, each in enumerate(all_of_them[:5]):
            each.hear(ADVERTISE)
            await asyncio.sleep(1.0)
            assert len(routed) <= number
            each.hear(RESPONSE + line("leds", Led(1).encode()) * 2)
            await asyncio.sleep(0.1)
            assert len(routed) <= number + 1
        assert [len(each.topics("leds")) for each in all_of_them] == [8] * 5 + [10] * 25


@pytest.mark.parametrize("pause", [0.0, 0.1])
async def test_links_that_join_get_a_latched_value_once(pause: float) -> None:
    """Those that join as the first one does, and those that come when the gateway has the value."""
    async with clients(12) as all_of_them, node("A", "a") as a:
        config = a.advertise("leds", Led, latch=True)
        await config.publish(Led(5))
        await asyncio.sleep(1.0)
        for each in all_of_them:
            each.hear(SUBSCRIBE)
            await asyncio.sleep(pause)
        await asyncio.sleep(1.0)
        assert [each.topics("leds") for each in all_of_them] == [[Led(5).encode()]] * 12
        await config.publish(Led(6))
        await asyncio.sleep(0.1)
        assert [len(each.topics("leds")) for each in all_of_them] == [2] * 12


async def test_links_that_subscribed_first_get_a_latched_value_once() -> None:
    """They join while the gateway looks at what its publisher offers."""
    async with clients(12) as all_of_them, r2p.Module("A", via="memory:a") as module:
        await said([(each, SUBSCRIBE) for each in all_of_them])
        async with node_in(module) as a:
            await a.advertise("leds", Led, latch=True).publish(Led(5))
            await asyncio.sleep(1.0)
            assert [each.topics("leds") for each in all_of_them] == [[Led(5).encode()]] * 12
