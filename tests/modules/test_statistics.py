"""What a module has counted, as itself and as others fetch it."""

from __future__ import annotations

import asyncio
import math
import zlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

import r2p
from r2p.codecs import management
from r2p.errors import DecodeError
from r2p.modules import statistics
from r2p.msg import Led
from r2p.testing.network import node_in
from r2p.transports.memory import MemoryNetwork
from tests.modules.test_own_services import Stranger
from tests.services.common import Add, add
from tests.transports.rtcan.networks import Lab, until

virtual = pytest.mark.virtual_time


@virtual
async def test_counters_by_node_topic_and_link_and_the_least_laxity_on_a_bus() -> None:
    made = Lab()
    async with made.module("PC1") as alice, made.module("PC2") as bob:
        events = alice.advertise("events", Led, r2p.Sporadic(0.030))
        leds = alice.advertise("leds", Led)
        own = alice.subscribe("own", Led, queue=1, lossy=True)
        alice.serve("add", Add, add)
        for number in range(2):
            await bob.client("add", Add).call(Add.Request(a=number), timeout=5.0)
        others = [bob.subscribe("events", Led), bob.subscribe("leds", Led)]
        for publisher in (events, leds):
            await publisher.wait_subscriber()
        for _ in range(3):
            await events.publish(Led())
            await leds.publish(Led())
        for subscriber in others:
            await subscriber.fetch()
        far = alice_as_seen_by_bob = await made.host("PC2").network.statistics("PC1")
        near = await made.host("PC1").network.statistics("PC1")
        assert far.publishers == near.publishers == made.host("PC1").statistics().publishers
        assert [(p.topic, p.node, p.publisher_class, p.sent, p.missed) for p in far.publishers] == [
            ("events", alice.name, 2, 3, 0),
            ("leds", alice.name, 1, 3, 0),
            ("log", "log", 1, 0, 0),  # the module's own
        ]
        assert [(s.topic, s.waiting, s.lost) for s in far.subscribers] == [("own", len(own.queue), own.lost)]
        assert [(s.service, s.node, s.handled, s.failed) for s in far.services] == [("add", alice.name, 2, 0)]
        (link,) = far.links
        assert (link.link, link.up, link.ups, link.sent) == ("sim:", True, 1, 6 + 2)
        laxities = {each.topic: each.least_laxity for each in alice_as_seen_by_bob.topics}
        assert 20 < laxities["events"] < 30
        assert math.isnan(laxities["leds"])
        assert [(each.node, each.running, each.restarts) for each in far.nodes] == [(alice.name, True, 0)]
        assert far.uptime > 0
        assert math.isnan(far.cpu)  # under virtual time


@virtual
async def test_restarts_losses_and_what_a_gateway_forwards_on_several_pages() -> None:
    robot, lab = MemoryNetwork(), MemoryNetwork()
    crashes = 0

    async def crash_twice(node: r2p.Node) -> None:
        nonlocal crashes
        crashes += 1
        if crashes <= 2:
            raise RuntimeError
        publishers = [node.advertise(f"topic{number}", Led) for number in range(30)]
        for publisher in publishers:
            await publisher.wait_subscriber()
            await publisher.publish(Led())
        await asyncio.Event().wait()

    gateway = r2p.Module("GW", via=[robot.transport("robot"), lab.transport("lab")], bridge=True)
    async with r2p.Module("A", via=robot.transport()) as a, gateway, r2p.Module("B", via=lab.transport()) as b:
        a.start(crash_twice, name="worker", restart=True)
        async with node_in(b) as node:
            for subscriber in [node.subscribe(f"topic{number}", Led) for number in range(30)]:
                await subscriber.fetch()
            await until(lambda: any(view.wire for view in b.network.modules() if view.name == "A"))
            far = await b.network.statistics("A")
            assert [(each.node, each.restarts) for each in far.nodes] == [("worker", 2)]
            assert {each.sent for each in far.publishers if each.topic != "log"} == {1}
            assert len(far.publishers) == 30 + 1
            forwarded = (await b.network.statistics("GW")).forwarded
            ways = {(each.source, each.target, each.forwarded) for each in forwarded if each.topic.startswith("topic")}
            assert ("memory:robot", "memory:lab", 1) in ways
            assert len(statistics.encode(far)) > 1000


@virtual
async def test_modules_without_statistics() -> None:
    network = MemoryNetwork()
    stranger = Stranger(network)
    async with r2p.Module("B", via=network.transport()) as b:
        stranger.manage(
            management.Alive("IMU1"), management.Hello("OLD", 7, wire=1), management.Hello("EVE", 8, wire=2)
        )
        await until(lambda: len(b.network.modules()) == 4)
        with pytest.raises(r2p.Error, match="IMU1 is firmware"):
            await b.network.statistics("IMU1")
        with pytest.raises(r2p.Error, match="OLD has wire version 1, statistics need 2: update r2p there"):
            await b.network.statistics("OLD")
        with pytest.raises(r2p.Error, match="no module NOBODY"):
            await b.network.statistics("NOBODY")
        with pytest.raises(TimeoutError, match="EVE does not answer"):
            await b.network.statistics("EVE")


@given(st.binary(max_size=300), st.booleans())
def test_any_bytes_are_statistics_or_a_decode_error(data: bytes, compressed: bool) -> None:
    try:
        statistics.decode(zlib.compress(data) if compressed else data)
    except DecodeError:
        return


GOLDEN = bytes.fromhex("78da63b46280811ff630162310b302714a5166592a2313036e000091ee0396")
"""What a module answers that has run for 1.5 s, compressed."""


def test_compressed_answers_of_other_programs_are_read() -> None:
    known = r2p.ModuleStatistics(uptime=1.5, nodes=(r2p.NodeStatistics("drive", running=True, restarts=2),))
    assert statistics.decode(GOLDEN) == known
    assert zlib.decompress(GOLDEN) == statistics.encode(known)


def test_compressed_answers_are_short_and_bounded() -> None:
    publishers = tuple(r2p.PublisherStatistics(f"arm/joint{number}", "arm", 1, number) for number in range(100))
    known = r2p.ModuleStatistics(publishers=publishers)
    data = statistics.encode(known, statistics.COMPRESSED)
    assert len(data) < len(statistics.encode(known, b"another argument")) / 4
    assert statistics.decode(data) == known
    for wrong in (data[:-1], b"\x78", b"\x78\x01 no zlib", zlib.compress(bytes(1 << 24))):
        with pytest.raises(DecodeError):
            statistics.decode(wrong)


def test_a_later_version_is_read_as_far_as_it_is_known() -> None:
    known = r2p.ModuleStatistics(uptime=1.5, links=(r2p.LinkStatistics("can0", lost=(r2p.ReasonCount("gap", 3),)),))
    data = statistics.encode(known)
    assert statistics.decode(bytes((7,)) + data[1:] + b"what comes later") == known
    with pytest.raises(DecodeError):
        statistics.decode(data[:-1])
