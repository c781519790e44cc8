"""The figures of a network, compared with what a simulated bus and the modules themselves say."""

import asyncio
from collections.abc import Callable

import pytest

import r2p
from r2p.codecs import rtcan
from r2p.monitoring.monitor import NetworkMonitor
from r2p.monitoring.snapshot import NetworkSnapshot
from r2p.msg import Led
from tests.transports.rtcan.networks import CYCLE, Lab

pytestmark = pytest.mark.virtual_time

SECOND = 1_000_000_000


async def figures(monitor: NetworkMonitor, ready: Callable[[NetworkSnapshot], object]) -> NetworkSnapshot:
    """Wait for a snapshot that has what is wanted."""
    async with asyncio.timeout(60.0):
        while not ready(snapshot := await monitor.changed()):
            pass
    return snapshot


async def test_rates_loads_and_slots_are_those_of_the_exact_bus() -> None:
    bus = Lab()
    async with (
        bus.module("BOSS", options={"priority": 9}) as boss,
        bus.module("EYE", options={"priority": 0}) as eye,
        NetworkMonitor(bus.host("EYE")) as monitor,
    ):
        publisher = boss.advertise("encoder", Led, r2p.Periodic(0.01, Led))
        eye.subscribe("encoder", Led, lossy=True)
        await publisher.ready(timeout=10.0)
        await asyncio.sleep(5.0)
        loads = [(await figures(monitor, bool)).buses[0] for _ in range(20)]
        hrt = bus.hrt("BOSS")
        syncs = bus.sent(lambda each: each.laxity == rtcan.HRT and rtcan.high_byte(each.message_id) == 0)
        snapshot = monitor.snapshot
    encoder = next(each for each in snapshot.topics if each.name == "encoder")
    assert (encoder.rate_source, encoder.size, encoder.type) == ("counters", 5, "r2p_msgs/Led")
    assert encoder.rate == pytest.approx(SECOND / CYCLE, rel=2e-3)
    assert encoder.bandwidth == pytest.approx(5 * (encoder.rate or 0.0))
    assert encoder.laxity is None
    rows = [each for load in loads for each in load.topics if (each.kind, each.topic) == ("hrt", "encoder")]
    bits = hrt[-1].bits + 3  # with the intermission; all messages are equal
    assert [each.frames for each in rows] == pytest.approx([SECOND / CYCLE] * len(loads), abs=1.0)
    assert [each.share for each in rows] == pytest.approx([each.frames * bits * 1e-6 for each in rows], rel=1e-5)
    owners = {each.topic: (each.module, each.slots) for each in loads[-1].slots}
    began = max(each.start for each in syncs if each.start <= hrt[-1].start)
    assert owners == {"sync": ("BOSS", [0]), "encoder": ("BOSS", [round((hrt[-1].start - began) * 60 / CYCLE)])}
    assert (loads[-1].name, loads[-1].master, loads[-1].slots_in_cycle) == ("sim", "BOSS", 60)
    assert loads[-1].share == pytest.approx(sum(each.share for each in loads[-1].topics), rel=1e-5)
