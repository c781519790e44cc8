"""What a gateway tells of the modules behind it, and when."""

from __future__ import annotations

import asyncio

import pytest

import r2p
from r2p.codecs import management
from r2p.msg import Led
from r2p.testing.network import node_in
from r2p.transports.memory import MemoryLink, MemoryTransport
from r2p.units import SECOND
from tests.bridge.test_bridge import Tap, gateway, node

pytestmark = pytest.mark.virtual_time

AT_ONCE = 0.05


async def test_whoever_is_new_gets_everything_at_once() -> None:
    async with gateway(), node("A", "a") as a:
        a.advertise("leds", Led)
        await asyncio.sleep(3.2)
        async with r2p.Module("B", via="memory:b") as b:
            await asyncio.sleep(AT_ONCE)
            assert [str(each.module) for each in b.network.topics()["leds"].publishers] == ["A"]


async def test_whoever_asks_gets_everything_at_once() -> None:
    async with gateway(), node("A", "a") as a, r2p.Module("B", via="memory:b") as b:
        a.advertise("leds", Led)
        await asyncio.sleep(3.2)
        (link,) = b.links
        before = link.discovery.modules["A"]
        b.query()
        await asyncio.sleep(AT_ONCE)
        assert link.discovery.modules["A"].last_heard > before.last_heard


async def test_who_asks_often_is_answered_now_and_then() -> None:
    async with gateway(), node("A", "a") as a, r2p.Module("B", via="memory:b") as b:
        a.advertise("leds", Led)
        await asyncio.sleep(3.2)
        tap = Tap("b")
        for _ in range(100):
            b.query()
            await asyncio.sleep(0.01)
        told = [message for message in tap.heard if isinstance(message, management.Hello) and message.module == "A"]
        assert 4 <= len(told) <= 8


async def test_firmware_that_was_heard_lately_is_told_and_not_one_that_is_silent() -> None:
    async with gateway():
        firmware = Tap("a")
        firmware.say(management.Alive("OLD"))
        await asyncio.sleep(3.0)
        firmware.say(management.Alive("IMU1"))
        await asyncio.sleep(1.0)
        async with r2p.Module("B", via="memory:b") as b:
            await asyncio.sleep(AT_ONCE)
            names = {view.name for view in b.network.modules()}
            assert "IMU1" in names
            assert "OLD" not in names


async def test_a_link_on_which_much_comes_and_goes_is_looked_at_now_and_then(monkeypatch: pytest.MonkeyPatch) -> None:
    """And each change is announced all the same."""
    async with gateway() as gw, r2p.Module("B", via="memory:b") as b:
        bridge = gw._link_manager.bridge if gw._link_manager is not None else None
        assert bridge is not None
        looks = []
        look = bridge.directory._look

        def count(now: int) -> None:
            looks.append(now)
            look(now)

        monkeypatch.setattr(bridge.directory, "_look", count)
        tap = Tap("a")
        tap.say(management.Hello("X", 99))
        for number in range(400):
            tap.say(management.Endpoint(1, 99, "n", f"t{number}", 1))
            await asyncio.sleep(0.005)
        assert len(looks) <= 5 * 3
        await asyncio.sleep(3.0)
        (link,) = b.links
        assert len([each for each in link.discovery.endpoints.values() if each.instance == 99]) == 400


async def test_what_changes_while_gateways_converge_is_told_afterwards() -> None:
    async with (
        gateway(),
        r2p.Module("B", via="memory:b") as b,
        r2p.Module("A", via="memory:a") as a,
        node_in(a) as there,
    ):
        await asyncio.sleep(2)
        async with gateway(name="G2"):
            await asyncio.sleep(0.05)
            there.advertise("leds", Led)
            await asyncio.sleep(3)
            assert [each.node for each in b.network.topics()["leds"].publishers] == ["test"]


async def test_nodes_of_a_network_that_a_gateway_joins_later_are_told() -> None:
    """Two gateways away, by a line that has to wait until they agree."""
    async with gateway(name="G1", networks="ab"), node("A", "a") as a:
        a.advertise("leds", Led)
        await asyncio.sleep(3)
        async with gateway(name="G2", networks="bc"), r2p.Module("C", via="memory:c") as c:
            await asyncio.sleep(3)
            assert [(each.module, each.node) for each in c.network.topics()["leds"].publishers] == [("A", "test")]


async def test_a_link_that_is_gone_may_be_looked_at_after_a_repetition() -> None:
    """A gateway that has much to do looks at its links later, and answers queries meanwhile."""
    async with gateway() as gw, node("A", "a"), r2p.Module("B", via="memory:b") as b:
        await asyncio.sleep(3.2)
        bridge = gw._link_manager.bridge if gw._link_manager is not None else None
        assert bridge is not None
        (first, _) = gw.links
        bridge.directory._next_round_at = bridge.directory._clock.monotonic() + 2 * SECOND
        bridge.detach(first)
        b.query()
        await asyncio.sleep(1.0)  # an internal error would fail the test
        assert "A" not in {view.name for view in b.network.modules()}
        bridge.attach(first)  # so that the module can end as usual


async def test_a_link_that_comes_later_is_told_what_was_known_before() -> None:
    late = MemoryTransport("c")
    async with r2p.Module("GW", via=["memory:a", late], bridge=True) as gw, node("A", "a"):
        (_, link) = gw.links
        assert isinstance(link, MemoryLink)
        link.disconnect()
        await asyncio.sleep(3)
        link.connect()
        async with r2p.Module("C", via="memory:c") as c:
            await asyncio.sleep(0.9)
            assert "A" in {view.name for view in c.network.modules()}
