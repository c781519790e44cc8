"""Time across links: how old a message of the bus is on a PC behind a gateway, to the bit, and how the PC knows."""

from __future__ import annotations

import asyncio

import pytest

import r2p
from r2p.clock import clock_of
from r2p.codecs import rtcan
from r2p.msg import Led
from r2p.testing.network import Network, node_in
from r2p.tools.topic.rates import _Delay
from r2p.transports.memory import MemoryNetwork
from tests.transports.rtcan.networks import Lab

pytestmark = pytest.mark.virtual_time

SECOND = 1_000_000_000
DELAY = 0.003
"""Seconds that a message takes from the gateway to the PC."""


async def test_a_delay_is_that_from_the_first_frame_to_the_tool() -> None:
    made = Lab()
    bus, lan = made.can.transport(), f"memory:lan?delay={DELAY}"
    meter, way = _Delay(100), []
    async with (
        made.module("SENSOR") as sensor,
        r2p.Module("GW", via=[bus, lan], bridge=True) as gateway,
        r2p.Module("PC", via=lan) as pc,
        node_in(pc) as laptop,
    ):
        times = sensor.advertise("times", r2p.Timestamp, r2p.Sporadic(deadline=0.05))
        subscriber = laptop.subscribe("times", r2p.Timestamp)
        await times.wait_subscriber()
        await asyncio.sleep(5)  # until there is a master
        for _ in range(20):
            made.clear()
            network_time, published = sensor.network_time(), sensor.now()
            assert network_time is not None
            await times.publish(r2p.Timestamp.from_ns(network_time))
            sample = await anext(subscriber.samples())
            meter.add(sample, laptop.now())
            (frame,) = made.sent(lambda found: rtcan.SRT_MIN <= found.laxity <= rtcan.SRT_MAX, "SENSOR")
            assert sample.stamp == frame.start + laptop.now() - clock_of().monotonic()
            way.append((frame.end - frame.start) / 1e9 + DELAY)
            assert sample.clock is not None
            told = sample.clock.utc(r2p.Timestamp.decode(sample.data).ns)
            assert abs(told - published) <= sample.clock.error
        measured = gateway.gateway_statistics().ports[0]
        assert measured.error is not None
        assert 0 < measured.error < 1_000_000
    report = meter.report(0)
    assert report is not None
    assert sample.clock is not None
    assert report[0]["from"] == "SENSOR/test's first frame on the bus"
    assert report[0]["mean"] == pytest.approx(sum(way) / len(way), abs=1e-6)
    assert report[0]["clock_error"] == pytest.approx(sample.clock.error / 1e9)


@pytest.mark.parametrize("ahead", [0, 1, -1, 3600, -3600])
async def test_a_publisher_whose_clock_is_wrong_loses_no_event(ahead: int) -> None:
    """Through two gateways, with deadlines shorter than the difference; a subscriber sees the publisher's own times."""
    networks = [Network() for _ in range(3)]
    async with (
        r2p.Module("GW1", via=[networks[0].transport("a"), networks[1].transport("b")], bridge=True) as gateway,
        r2p.Module("GW2", via=[networks[1].transport("b"), networks[2].transport("c")], bridge=True),
        networks[0].module("A") as sender,
        networks[2].module("B") as receiver,
        node_in(sender) as source,
        node_in(receiver) as drain,
    ):
        subscriber = drain.subscribe("bump", Led, queue=100)
        publisher = source.advertise("bump", Led, r2p.Sporadic(deadline=0.5))
        publisher._now = lambda: receiver.space.clock.now() + ahead * SECOND
        await asyncio.sleep(5)
        for number in range(20):
            await publisher.publish(Led(number))
            await asyncio.sleep(0.1)
        samples = list(subscriber.queue)
        assert [each.sequence for each in samples] == list(range(1, 21))
        assert {each.deadline - each.stamp for each in samples} == {SECOND // 2}
        assert all(0 < each.expires - each.stamp + ahead * SECOND <= 0.6 * SECOND for each in samples)
        assert not [route for route in gateway.gateway_statistics().routes if route.dropped]


async def test_an_event_that_was_held_up_is_late_whatever_its_publishers_clock_shows() -> None:
    """The network before the gateway stalls for a second."""
    left, right = MemoryNetwork(), MemoryNetwork()
    async with (
        r2p.Module("GW", via=[left.transport("l"), right.transport("r")], bridge=True) as gateway,
        r2p.Module("A", via=left.transport("l")) as sender,
        r2p.Module("B", via=right.transport("r")) as receiver,
        node_in(sender) as source,
        node_in(receiver) as drain,
    ):
        subscriber = drain.subscribe("bump", Led, queue=100)
        publisher = source.advertise("bump", Led, r2p.Sporadic(deadline=0.5))
        publisher._now = lambda: receiver.space.clock.now() - SECOND
        await asyncio.sleep(3)
        for delay in 0.0, 1.0, 0.0:
            left.delay = delay
            await publisher.publish(Led())
            left.delay = 0.0
            await asyncio.sleep(2)
        assert [each.sequence for each in subscriber.queue] == [1, 3]
        dropped = {route.topic: route.dropped for route in gateway.gateway_statistics().routes if route.dropped}
        assert dropped == {"bump": {"late": 1}}


@pytest.mark.parametrize("ahead", [1, -1])
async def test_what_comes_from_a_computer_with_another_clock_is_as_urgent_on_the_bus(ahead: int) -> None:
    made, network = Lab(), Network()
    async with (
        r2p.Module("GW", via=[network.transport("l"), made.can.transport()], bridge=True),
        network.module("A") as sender,
        made.module("C") as drain,
        node_in(sender) as source,
    ):
        event = source.advertise("event", Led, r2p.Sporadic(0.02))
        period = source.advertise("period", Led, r2p.Periodic(0.05, fill=lambda: Led(1)))
        for publisher in event, period:
            publisher._now = lambda: clock_of().now() + ahead * SECOND
        drain.subscribe("event", Led)
        drain.subscribe("period", Led)
        await asyncio.sleep(5)
        made.clear()
        await event.publish(Led(2))
        await asyncio.sleep(0.5)
        laxities = {
            each.frame.data: rtcan.decode_identifier(each.frame.id).laxity for each in made.sent(_is_soft, "GW")
        }
        assert (laxities[Led(1).encode()], laxities[Led(2).encode()]) == (49, 19)


def _is_soft(found: rtcan.Identifier) -> bool:
    return rtcan.SRT_MIN <= found.laxity <= rtcan.SRT_MAX
