"""Time across links: how old a message of the bus is on a PC behind a gateway, to the bit, and how the PC knows."""

from __future__ import annotations

import asyncio

import pytest

import r2p
from r2p.clock import clock_of
from r2p.codecs import rtcan
from r2p.testing.network import node_in
from r2p.tools.topic_rates import _Delay
from tests.transports.rtcan.networks import Lab

pytestmark = pytest.mark.virtual_time

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
            meter.note(sample, laptop.now())
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
