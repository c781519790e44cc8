"""`bus_load` and `bus_slots`: what a module of the bus publishes about it, compared with the exact bus."""

import asyncio
from collections import Counter
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

import r2p
from r2p.clock import clock_of
from r2p.codecs import rtcan
from r2p.codecs.can_bits import INTERMISSION
from r2p.messages import layout
from r2p.msg import BusSlots, BusTraffic, Led
from r2p.sim.transport import SimPort
from r2p.testing.network import node_in
from r2p.tools.topic.echo import echo
from r2p.units import SECOND
from tests.tools.rig import VIA, printed, tool
from tests.transports.rtcan.networks import CYCLE, SLOT, Lab, lab, until

pytestmark = pytest.mark.virtual_time

READ_AFTER = SECOND // 25
LINE_MAX = 255


@asynccontextmanager
async def encoder(bus: Lab, nodes: list[r2p.Node]) -> AsyncIterator[r2p.PeriodicPublisher[Led]]:
    """A periodic topic from the first module to the second, in slots."""
    publisher = nodes[0].advertise("encoder", Led, r2p.Periodic(0.01, Led))
    subscriber = nodes[1].subscribe("encoder", Led, queue=1, keep="newest", lossy=True)
    await publisher.ready(timeout=10.0)
    yield publisher
    subscriber.close()
    publisher.close()


@asynccontextmanager
async def behind_gateway(bus: Lab) -> AsyncIterator[r2p.Node]:
    """A node of a module behind a gateway of the bus."""
    gateway = r2p.Module("GATE", via=[bus.can.transport(), VIA], bridge=True, watchdog=False)
    async with gateway, r2p.Module("PC", via=VIA, watchdog=False) as pc, node_in(pc) as node:
        await asyncio.sleep(5.0)
        yield node


async def second_of(samples: AsyncIterator[r2p.Sample[BusTraffic]]) -> list[r2p.Sample[BusTraffic]]:
    """The messages of the next second, from its total on."""
    async for first in samples:
        if first.message.kind == "total":
            rows = [first]
            break
    seen = first.message.frames
    while seen > 0.01:
        rows.append(await anext(samples))
        seen -= rows[-1].message.frames
    return rows


def period_end(total: r2p.Sample[BusTraffic]) -> int:
    """The end of the second that was measured, in true time (ns)."""
    return total.stamp - (clock_of().now() - clock_of().monotonic()) - READ_AFTER


async def test_the_numbers_are_those_of_the_bus() -> None:
    async with lab("MOTOR", "EYE") as (bus, nodes), encoder(bus, nodes):
        samples = nodes[1].subscribe("bus_load", BusTraffic, queue=100).samples()
        await second_of(samples)
        rows = await second_of(samples)
        end = period_end(rows[0])
        exact, frames = Counter[str](), Counter[str]()
        for each in bus.frames:
            if end - SECOND <= each.end < end and each.error is None:
                is_sync = rtcan.is_sync(each.frame.id)
                name = "sync" if is_sync else ",".join(each.senders)
                exact[name] += each.bits + INTERMISSION
                frames[name] += 1
        total, *parts = [each.message for each in rows]
        assert total.share == pytest.approx(sum(exact.values()) / 1e6)
        assert total.frames == pytest.approx(sum(frames.values()))
        reported = Counter[str]()
        for part in parts:
            reported["sync" if part.kind == "sync" else part.module] += round(part.share * 1e6)
        assert reported == exact
        own = next(part for part in parts if part.topic == "encoder")
        assert (own.kind, own.module, own.bus) == ("hrt", "MOTOR", bus.link("EYE").title)
        assert own.frames == pytest.approx(SECOND / CYCLE, abs=1)
        assert total.reserved == pytest.approx(2 * SLOT / CYCLE, rel=0.02)


async def test_error_frames_are_counted() -> None:
    """Those of the module that watches, which its controller reports."""
    async with lab("MOTOR", "EYE") as (bus, nodes), encoder(bus, nodes):
        samples = nodes[0].subscribe("bus_load", BusTraffic, queue=100).samples()
        assert (await second_of(samples))[0].message.errors == 0
        bus.can.bus.disturb_next(count=3, sender="EYE")
        bus.can.bus.disturb_next(count=2, sender="MOTOR")
        rows = await second_of(samples)
        end = period_end(rows[0])
        failed = [each for each in bus.frames if each.error is not None and end - SECOND <= each.end < end]
        assert sorted(each.senders for each in failed) == [("EYE",)] * 3 + [("MOTOR",)] * 2
        assert rows[0].source.module == "EYE"
        assert rows[0].message.errors == 3


async def test_it_reaches_a_subscriber_behind_a_gateway_and_costs_the_bus_nothing() -> None:
    async with lab("MOTOR", "EYE") as (bus, nodes), encoder(bus, nodes), behind_gateway(bus) as node:
        samples = node.subscribe("bus_load", BusTraffic).samples()
        rows = await second_of(samples)
        await second_of(samples)
        assert {each.source.module for each in rows} == {"GATE"}
        sent = {bus.link(name).discovery.alias("bus_load") for name in ("MOTOR", "EYE")}
        assert sent == {"bus_load"}
        for name in ("MOTOR", "EYE"):
            assert "bus_load" not in bus.host(name).space.topics
        assert "bus_load" not in {each.message.topic for each in rows}


async def test_without_a_subscriber_nothing_is_advertised_and_frames_are_filtered() -> None:
    async with lab("MOTOR", "EYE") as (bus, nodes), encoder(bus, nodes):
        port = bus.link("EYE").driver.port  # of both, the first by name publishes
        assert isinstance(port, SimPort)
        await until(lambda: len(port.controller.filters) == 4)  # three that are always there, and the encoder's
        filters = port.controller.filters
        subscriber = nodes[0].subscribe("bus_load", BusTraffic)
        await second_of(subscriber.samples())
        assert bus.host("MOTOR").network.topics()["bus_load"].publishers
        assert "bus_slots" not in bus.host("MOTOR").network.topics()
        assert port.controller.filters == [(0, 0)]
        subscriber.close()
        await asyncio.sleep(1.0)
        assert port.controller.filters == filters
        assert not bus.host("MOTOR").network.topics()["bus_load"].publishers


async def test_one_module_of_a_bus_publishes_and_another_takes_over() -> None:
    async with lab("A", "B") as (bus, nodes), encoder(bus, nodes):
        samples = nodes[1].subscribe("bus_load", BusTraffic, queue=500).samples()
        async with bus.module("0"):
            await asyncio.sleep(5.0)
            while (await second_of(samples))[0].source.module != "0":
                pass
            for _ in range(3):
                assert {each.source.module for each in await second_of(samples)} == {"0"}
        while (await second_of(samples))[0].source.module != "A":
            pass
        for _ in range(3):
            assert {each.source.module for each in await second_of(samples)} == {"A"}


async def received(subscriber: r2p.Subscriber[BusSlots]) -> list[BusSlots]:
    """The messages of the next seconds."""
    await asyncio.sleep(5.0)
    return [await subscriber.fetch() for _ in range(len(subscriber.queue))]


async def test_all_slots_go_to_each_new_subscriber_then_only_changes() -> None:
    async with lab("MOTOR", "EYE") as (bus, nodes), encoder(bus, nodes) as publisher:
        first = nodes[0].subscribe("bus_slots", BusSlots, queue=100)
        rows = await received(first)
        assert {(each.topic, each.module) for each in rows} == {("sync", "EYE"), ("encoder", "MOTOR")}
        slots = {each.topic: each for each in rows}
        assert slots["sync"].slots == (0,)
        assert slots["encoder"].slots_in_cycle == 60
        assert slots["encoder"].cycle == pytest.approx(CYCLE / SECOND)
        assert f"phase {slots['encoder'].slots[0]}" in publisher.guarantees[bus.link("MOTOR").name]
        assert await received(first) == []
        other = nodes[1].subscribe("bus_slots", BusSlots, queue=100)
        assert {each.topic for each in await received(other)} == {"sync", "encoder"}
        await received(first)
        publisher.close()
        gone = await received(first)
        assert [(each.topic, each.module, each.slots) for each in gone] == [("encoder", "MOTOR", ())]


async def test_a_tool_prints_it_without_a_type(capsys: pytest.CaptureFixture[str]) -> None:
    async with lab("MOTOR", "EYE") as (bus, nodes), encoder(bus, nodes), behind_gateway(bus):
        async with tool() as session:
            await echo(session, ["bus_load"], once=True)
        (total,) = printed(capsys)
        assert total["kind"] == "total"
        assert 0.03 < total["share"] < 0.2


async def test_a_topic_of_another_type_with_the_name_is_left_alone(caplog: pytest.LogCaptureFixture) -> None:
    async with lab("MOTOR", "EYE", "ANY") as (_, nodes):
        subscriber = nodes[0].subscribe("bus_load", Led)
        publisher = nodes[1].advertise("bus_load", Led)
        await asyncio.sleep(5.0)
        await publisher.publish(Led(led=7))
        assert (await subscriber.fetch()).led == 7
        assert "bus_load" not in caplog.text


def test_the_messages_fit_a_debug_line() -> None:
    assert layout(BusTraffic).size <= LINE_MAX
    assert layout(BusSlots).size <= LINE_MAX
