"""Clients of a gateway: many connections that share one port of the tree, and take part in no mesh."""

from __future__ import annotations

import asyncio
import gc
import logging
import struct
from typing import TYPE_CHECKING

import pytest

import r2p
from r2p.codecs import management
from r2p.msg import Led
from r2p.protocols.discovery.topic_batch import split_topics
from r2p.testing.network import node_in
from r2p.transports.line import LineLink
from tests.bridge.test_bridge import CONVERGED, Tap, drain, gateway, node
from tests.transports.conversation import Script, line, manage

if TYPE_CHECKING:
    from collections.abc import Callable

    from r2p.transports.link import Hub

pytestmark = pytest.mark.virtual_time


class Client(Script):
    """The line of a client; its other end is the test."""

    flow_controlled = True
    admits_gateways = False


class Peer(Script):
    """A line that gateways may join by."""

    flow_controlled = True


def state(module: r2p.Module, link: str) -> str:
    return next(each.state for each in module.gateway_statistics().ports if each.link == link)


def managed(script: Script) -> list[management.Management]:
    """The management messages that were said."""
    return [each.management for each in script.said if each.topic == "R2P"]


def fake(number: int, heard: int, port: int) -> bytes:
    """A made-up gateway, which says that it hears another one."""
    hearing = struct.pack("<BIB", 1, heard, port).ljust(18, b"\0")
    return manage(management.Bridge(number, 1, 1, 0, number, bytes(12))) + manage(
        management.Mesh(number, 1, 0, hearing)
    )


async def test_more_clients_than_ports() -> None:
    """All of them get what they want, and what the gateway's own nodes publish."""
    clients = [Client() for _ in range(300)]
    async with r2p.Module("GW", via=["memory:a", *clients], bridge=True) as gw, node_in(gw, name="own") as own:
        await asyncio.sleep(CONVERGED)
        leds = own.advertise("leds", Led)
        for each in (clients[0], clients[-1]):
            each.hear(manage(management.SubscribeRequest("leds", 5, 5)))
        await asyncio.sleep(0.1)
        await leds.publish(Led(led=7))
        own.log.info("hello")
        await asyncio.sleep(0.1)
        assert [each.topics("leds") for each in (clients[0], clients[-1])] == [[Led(led=7).encode()]] * 2
        assert len(gw.links) == 301


async def test_topics_of_the_gateway_itself_are_announced_to_clients_that_come_later() -> None:
    client = Client()
    async with r2p.Module("GW", via=["memory:a", client], bridge=True) as gw, node_in(gw, name="own") as own:
        own.advertise("leds", Led)
        await asyncio.sleep(CONVERGED)
        assert "leds" in [each.topic for each in managed(client) if isinstance(each, management.Advertise)]


class Visitors(Client):
    """Clients that come one after the other, each on a link with a name of its own."""

    async def run(self, hub: Hub, opened: Callable[[], object]) -> None:
        self.hub = hub
        opened()
        await asyncio.get_running_loop().create_future()

    def connect(self, number: int, *, admits_gateways: bool = False) -> Client:
        client = Client()
        client.link = link = LineLink(f"tcp:127.0.0.1:{number}", self.hub)
        link.admits_gateways = admits_gateways
        self.hub.attach(link)
        link.connect(client)
        return client

    async def visit(self, number: int) -> None:
        client = self.connect(number)
        client.hear(manage(management.SubscribeRequest("leds", 5, 5)))
        await asyncio.sleep(1)
        client.link.close()
        self.hub.detach(client.link)


async def test_a_client_that_left_leaves_nothing_behind(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.CRITICAL, "r2p")  # pytest keeps what is logged
    visitors = Visitors()

    async def objects_after(visits: range) -> int:
        for number in visits:
            await visitors.visit(number)
        await asyncio.sleep(60)
        split_topics.cache_clear()  # a bounded one
        gc.collect()
        return len(gc.get_objects())

    async with r2p.Module("GW", via=["memory:a", visitors], bridge=True) as gw, node("A", "a") as a:
        a.advertise("leds", Led)
        before = await objects_after(range(10_000, 10_100))
        after = await objects_after(range(10_100, 10_400))
        assert len(gw.links) == 1
    assert after - before < 150  # half an object each; none but for timers and what the interpreter caches


async def test_clients_reach_each_other_and_the_rest() -> None:
    one, other = Client(), Client()
    async with r2p.Module("GW", via=["memory:a", one, other], bridge=True), node("A", "a") as a:
        leds = a.subscribe("leds", Led)
        await asyncio.sleep(CONVERGED)
        other.hear(manage(management.SubscribeRequest("leds", 5, 5)))
        one.hear(manage(management.Advertise("leds", 5)))
        one.hear(manage(management.SubscribeResponse("leds", 5, 5)))
        await asyncio.sleep(0.1)
        one.hear(line("leds", Led(led=3).encode()))
        await asyncio.sleep(0.1)
        assert drain(leds) == [3]
        assert other.topics("leds") == [Led(led=3).encode()]
        assert one.topics("leds") == []


async def test_a_client_that_plays_gateways_stops_nobody_else(caplog: pytest.LogCaptureFixture) -> None:
    client = Client()
    async with (
        r2p.Module("G1", via=["memory:a", "memory:b", client], bridge=True) as gw,
        gateway(name="G2", networks="bc"),
        node("A", "a") as a,
        node("C", "c") as c,
    ):
        leds, far = a.advertise("leds", Led), c.subscribe("leds", Led, queue=1000)
        await leds.wait_subscriber()
        await asyncio.sleep(2)
        for number in range(50):
            client.hear(fake(1000 + number, gw.instance, 250))
            await leds.publish(Led(led=number))
            await asyncio.sleep(0.2)
        assert drain(far) == list(range(50))
        assert state(gw, "script") == "refused"
        assert client.link.losses["gateway refused"] == 100
        assert "?gateways=yes" in caplog.text


@pytest.mark.parametrize(
    ("flags", "hops", "passes"),
    [
        (management.HELLO_SOLE_LINK, 0, True),
        (management.HELLO_SOLE_LINK | management.HELLO_TOOL, 0, True),
        (management.HELLO_TOOL, 0, False),
        (management.HELLO_SOLE_LINK | management.HELLO_GATEWAY, 0, False),
        (management.HELLO_SOLE_LINK, 1, False),
    ],
)
@pytest.mark.parametrize("admits_gateways", [False, True])
async def test_a_module_at_a_line_that_has_no_other_link_need_not_wait(
    flags: int, hops: int, passes: bool, admits_gateways: bool
) -> None:
    visitors = Visitors()
    async with r2p.Module("GW", via=["memory:a", visitors], bridge=True) as gw, node("A", "a") as a:
        a.advertise("leds", Led)
        await asyncio.sleep(CONVERGED)
        client = visitors.connect(1000, admits_gateways=admits_gateways)
        client.hear(manage(management.Hello("PC", 7, flags | management.HELLO_QUERY, hops, 5000, 4, "")))
        await asyncio.sleep(0.1)
        told = "leds" in [each.topic for each in managed(client) if isinstance(each, management.TypeInfo)]
        assert (state(gw, client.link.name), told) == ("alone" if passes else "listening", passes)
        client.hear(fake(7, gw.instance, 250))
        await asyncio.sleep(0.01)
        waits = "converging" if passes else "listening"
        assert state(gw, client.link.name) == (waits if admits_gateways else "refused")


@pytest.mark.parametrize(("others", "said"), [([], True), (["memory:a"], False)])
async def test_a_module_says_that_a_line_is_its_only_link(others: list[str], said: bool) -> None:
    script = Script()
    async with r2p.Module("A", via=[script, *others]):
        await asyncio.sleep(0.1)
        hello = next(each for each in managed(script) if isinstance(each, management.Hello))
        assert bool(hello.flags & management.HELLO_SOLE_LINK) is said


async def test_a_gateway_may_join_where_it_is_allowed() -> None:
    """A hostile one is damped: what it says keeps the others silent now and then only."""
    peer = Peer()
    async with (
        r2p.Module("G1", via=["memory:a", "memory:b", peer], bridge=True) as gw,
        gateway(name="G2", networks="bc"),
        node("A", "a") as a,
        node("C", "c") as c,
    ):
        leds, far = a.advertise("leds", Led), c.subscribe("leds", Led, queue=1000)
        await leds.wait_subscriber()
        await asyncio.sleep(2)
        peer.hear(fake(1, gw.instance, 2))
        await asyncio.sleep(0.01)
        assert state(gw, "script") == "converging"
        for number in range(500):
            peer.hear(fake(1000 + number, gw.instance, 2))
            await leds.publish(Led(led=number))
            await asyncio.sleep(0.2)
        assert len(drain(far)) > 400
        assert peer.link.losses["gateways come and go"] > 400


async def test_a_client_by_which_a_probe_comes_back_is_a_gateway_of_firmware() -> None:
    client, other = Client(), Client()
    async with r2p.Module("GW", via=["memory:a", client, other], bridge=True) as gw:
        tap = Tap("a")
        await asyncio.sleep(2.5)
        for message in tap.heard:
            if isinstance(message, management.Alive) and message.module.startswith("_"):
                client.hear(manage(message))
        assert [state(gw, each) for each in ("memory:a", "script", "script#2")] == ["alone", "loop", "alone"]


async def test_orders_that_are_refused_are_logged_once_a_second(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("r2p.transports.url._IP", frozenset({"script"}))
    client = Client()
    caplog.set_level(logging.WARNING)
    async with r2p.Module("GW", via=["memory:a", client], bridge=True) as gw:
        await asyncio.sleep(CONVERGED)
        before = len(caplog.records)
        for _ in range(1000):
            client.hear(manage(management.Reboot("ZZ")) + manage(management.Bootload("GW")))
            await asyncio.sleep(0.001)
        assert len(caplog.records) - before <= 3
        assert client.link.losses["order refused"] == 2000
        assert not gw.refused


@pytest.mark.parametrize(("allowed", "obeys"), [(False, False), (True, True)])
async def test_a_gateway_obeys_what_it_lets_through(
    allowed: bool, obeys: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("r2p.transports.url._IP", frozenset({"script"}))
    client = Client()
    async with r2p.Module("GW", via=["memory:a", client], bridge=r2p.BridgeOptions(allow_control=allowed)) as gw:
        await asyncio.sleep(CONVERGED)
        client.hear(manage(management.Reboot("GW")))
        await asyncio.sleep(0.1)
        assert gw.rebooted is obeys
        denied = management.Denied("GW", "GW", 0x13, management.DENIED_CONTROL)
        assert (management.encode(denied) in client.topics("R2P")) is not obeys
        client.hear(manage(management.Stop("GW")))
        await asyncio.sleep(0.1)
        assert gw.stopped


async def test_orders_to_a_module_are_logged_once_a_second(caplog: pytest.LogCaptureFixture) -> None:
    script = Script()
    async with r2p.Module("A", via=script) as module:
        for _ in range(1000):
            script.hear(manage(management.Bootload("A")))
            await asyncio.sleep(0.001)
        assert module.refused == {"BOOTLOAD": 1000}
        assert len([each for each in caplog.records if each.name == "r2p.module"]) <= 6


# A gateway whose event loop stands still


async def test_nothing_is_lost_where_a_gateway_stood_still_and_is_alone() -> None:
    """Non real-time messages wait until it knows that no other has begun to forward; events would be stale."""
    async with gateway() as gw, node("A", "a") as a, node("B", "b") as b, node_in(gw, name="own") as own:
        leds, bumper, text = (
            a.advertise("leds", Led),
            a.advertise("bumper", Led, r2p.Sporadic(0.1)),
            own.advertise("own", Led),
        )
        far, bumps, owns = (b.subscribe(each, Led, queue=100) for each in ("leds", "bumper", "own"))
        for each in (leds, bumper, text):
            await each.wait_subscriber()
        await asyncio.sleep(0.1)
        stand_still(gw, 0.7)
        for number in range(10):
            await leds.publish(Led(led=number))
            await text.publish(Led(led=number))
            await bumper.publish(Led(led=number))
        await asyncio.sleep(CONVERGED)
        await leds.publish(Led(led=10))
        await asyncio.sleep(0.1)
        assert (drain(far), drain(owns), drain(bumps)) == (list(range(11)), list(range(10)), [])
        lost = {link.name: link.losses["converging"] for link in gw.links}
        assert lost == {"memory:a": 10, "memory:b": 0}
        assert {each.link: each.dropped for each in gw.gateway_statistics().ports} == {
            "memory:a": {"converging": 10},
            "memory:b": {},
        }


def stand_still(gateway: r2p.Module, seconds: float) -> None:
    """As if its event loop had not run for so long, in which no other module sent anything."""
    bridge = gateway._link_manager.bridge if gateway._link_manager is not None else None
    assert bridge is not None
    tree = bridge.tree
    tree._updated_at -= round(seconds * 1e9)
    for port in tree.ports.values():
        port.sent_at -= round(seconds * 1e9)
        port.forwards_until -= round(seconds * 1e9)


async def test_what_a_gateway_kept_is_dropped_where_another_one_forwards() -> None:
    """It was forwarded by that one."""
    async with gateway() as gw, node("A", "a") as a, node("B", "b") as b:
        leds, far = a.advertise("leds", Led), b.subscribe("leds", Led, queue=100)
        await leds.wait_subscriber()
        await asyncio.sleep(0.1)
        stand_still(gw, 0.7)
        await leds.publish(Led(led=1))
        await asyncio.sleep(0.01)
        tap = Tap("a")
        for count in range(30):
            tap.say(management.Bridge(7, 0, count, 0, 7, bytes(12)))
            await asyncio.sleep(0.08)
        assert drain(far) == []
        assert gw.links[0].losses["converging"] == 1


async def test_what_a_gateway_kept_of_a_link_that_is_gone_is_counted() -> None:
    async with gateway(networks="abc") as gw, node("A", "a") as a, node("B", "b") as b:
        leds, far = a.advertise("leds", Led), b.subscribe("leds", Led, queue=100)
        await leds.wait_subscriber()
        await asyncio.sleep(0.1)
        bridge = gw._link_manager.bridge if gw._link_manager is not None else None
        assert bridge is not None
        stand_still(gw, 0.7)
        await leds.publish(Led(led=1))
        await asyncio.sleep(0.01)
        first, *others = gw.links
        bridge.detach(first)
        await asyncio.sleep(CONVERGED)
        assert (drain(far), first.losses["converging"]) == ([], 1)
        assert [link.losses["internal error"] for link in others] == [0, 0]
        bridge.attach(first)  # the module itself detaches it at its end


async def test_a_line_without_a_gateway_goes_on_at_once() -> None:
    one, other = Peer(), Peer()
    async with r2p.Module("GW", via=[one, other], bridge=True) as gw:
        other.hear(manage(management.SubscribeRequest("leds", 5, 5)))
        one.hear(manage(management.Advertise("leds", 5)))
        await asyncio.sleep(CONVERGED)
        one.hear(manage(management.SubscribeResponse("leds", 5, 5)))
        bridge = gw._link_manager.bridge if gw._link_manager is not None else None
        assert bridge is not None
        bridge.tree._updated_at -= 5_000_000_000
        one.hear(line("leds", Led(led=3).encode()))
        await asyncio.sleep(0.3)
        one.hear(line("leds", Led(led=4).encode()))
        assert other.topics("leds") == [Led(led=3).encode(), Led(led=4).encode()]
        assert [state(gw, each) for each in ("script", "script#2")] == ["alone", "alone"]
