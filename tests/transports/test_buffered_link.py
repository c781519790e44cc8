"""What a link keeps: messages that come before what announces them, for a moment, and nothing of closed topics.

And who is named as the source of what comes in.
"""

from __future__ import annotations

import asyncio
from typing import Any

import msgspec
import pytest

import r2p
from r2p.codecs import management as m
from r2p.msg import Led
from r2p.names import MANAGEMENT
from r2p.protocols.discovery.session import Discovery
from r2p.runtime.sample import Source
from r2p.testing.network import Network, node_in
from r2p.transports.buffered_link import SenderLookup
from r2p.transports.memory import Datagram
from tests.bench import led, settle
from tests.protocols.discovery.wire import PC2, PEER, S, hear, run

pytestmark = pytest.mark.virtual_time


class SlowManagement(Network):
    """What is published overtakes what announces it, by `lead` seconds."""

    def __init__(self, lead: float) -> None:
        super().__init__()
        self.lead = lead

    def _schedule(self, delay: float, address: int, frame: Datagram) -> None:
        super()._schedule(self.lead if frame.topic == MANAGEMENT.encode() else delay, address, frame)


async def test_a_latched_value_may_overtake_the_answer_that_announces_it() -> None:
    net = SlowManagement(0.1)
    async with net.module("A") as a, net.module("B") as b, node_in(a) as one, node_in(b) as other:
        publishers = [one.advertise("leds", Led, latch=True), one.advertise("more", Led, latch=True)]
        for number, publisher in enumerate(publishers):
            await publisher.publish(led(number))
        await asyncio.sleep(10.0)
        leds, more = other.subscribe("leds", Led), other.subscribe("more", Led)
        assert [await each.fetch(1.0) for each in (leds, more)] == [led(0), led(1)]
        await publishers[0].publish(led(2))
        await settle(5.0)
        assert [sample.sequence for sample in leds.queue] == [2]
        assert b.links[0].losses == {}


async def test_what_came_long_before_is_stale() -> None:
    async with Network().module("B") as b, node_in(b) as other:
        leds = other.subscribe("leds", Led)
        link: Any = b.links[0]
        link.receive([frame(port, b"leds") for port in (1, 2)])
        assert link.losses == {"not subscribed": 2}
        await asyncio.sleep(0.9)
        link._publisher_found("leds", 5, 1)
        await asyncio.sleep(0.2)
        link._publisher_found("leds", 5, 2)
        assert len(leds.queue) == 1
        assert link.losses == {"not subscribed": 1}


async def test_what_comes_unasked_is_kept_for_few_senders_and_for_no_other_topic(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("r2p.transports.buffered_link._EARLY_MAX", 2)
    net = Network()
    async with net.module("B") as b, node_in(b) as other:
        other.subscribe("leds", Led)
        link: Any = b.links[0]
        for port in range(5):
            for topic in (b"leds", b"other", b"\xff"):
                link.receive([frame(port, topic)])
        assert [sender for _, sender in link._early] == [3, 4]
        assert link.losses == {"not subscribed": 15}
        net.disconnect(b)
        assert not link._early


def frame(port: int, topic: bytes) -> Datagram:
    return Datagram(port, topic, Led().encode())


async def test_nothing_is_kept_of_topics_that_were_closed() -> None:
    net = Network()
    async with net.module("A") as a, net.module("B") as b, node_in(a) as one, node_in(b) as other:
        for number in range(50):
            publisher, leds = one.advertise(f"n{number}", Led), other.subscribe(f"n{number}", Led)
            await publisher.wait_subscriber()
            await publisher.publish(led(number))
            assert await leds.fetch(1.0) == led(number)
            publisher.close()
            leds.close()
        await asyncio.sleep(70.0)  # the longest lease, for which timers stay
        for module in (a, b):
            table = {"discovery.topics", "discovery._directory.topics"}  # one, which has a limit of its own
            assert grown(module, 50) == table


def grown(module: r2p.Module, size: int) -> set[str]:
    """The tables behind a module and its link that hold so many things."""
    found: set[str] = set()
    seen: set[int] = set()
    waiting: list[tuple[str, Any]] = [("", module.links[0]), ("space", module.space), ("module", module)]
    while waiting:
        path, owner = waiting.pop()
        for name, value in vars(owner).items():
            if isinstance(value, dict | set | list) and len(value) >= size:
                found.add(f"{path}.{name}".lstrip("."))
            elif type(value).__module__.startswith("r2p") and hasattr(value, "__dict__") and id(value) not in seen:
                seen.add(id(value))
                waiting.append((f"{path}.{name}", value))
    return found


def publisher(node: str, *, gone: bool = False) -> m.Endpoint:
    return m.Endpoint(m.ROLE_PUBLISHES | (m.ROLE_GONE if gone else 0), PEER, node, "leds", m.CLASS_NRT)


def test_a_publisher_that_is_replaced_by_another() -> None:
    discovery = Discovery("PC1", 1)
    discovery.link_up(0)
    sources = SenderLookup(discovery, "lab")
    assert sources.source("leds") == Source("", "", "lab")
    hear(discovery, S, PC2, publisher("blink"))
    assert sources.source("leds") == Source("PC2", "blink", "lab")
    hear(discovery, S, publisher("blink", gone=True), publisher("wink"))
    assert sources.source("leds") == Source("PC2", "wink", "lab")
    hear(discovery, S, publisher("blink"))
    assert sources.source("leds") == Source("PC2", "", "lab"), "one of two"
    for now in range(4 * S, 24 * S, 4 * S):
        assert sources.source("leds") == Source("PC2", "", "lab")
        hear(discovery, now, PC2, publisher("blink"))
        run(discovery, now, now + 4 * S)
    assert sources.source("leds") == Source("PC2", "blink", "lab"), "the other one was not repeated"


def test_what_is_only_repeated_is_not_worked_out_again() -> None:
    discovery = Discovery("PC1", 1)
    discovery.link_up(0)
    sources = SenderLookup(discovery, "lab")
    hear(discovery, S, PC2, publisher("blink"))
    found = sources.source("leds")
    hear(discovery, 2 * S, PC2, m.Alive("PC2"), publisher("blink"))
    assert sources.source("leds") is found


def test_behind_a_gateway_only_an_announced_publisher_has_a_name() -> None:
    discovery = Discovery("PC1", 1)
    discovery.link_up(0)
    sources, unknown = SenderLookup(discovery, "lab"), Source("", "", "lab")
    hear(discovery, S, m.Hello("GW", 5, m.HELLO_GATEWAY), m.Alive("GW"))
    assert [sources.source(topic) for topic in ("leds", "log")] == [unknown, unknown], "others are announced late"
    hear(discovery, S, m.Endpoint(m.ROLE_PUBLISHES, 5, "log", "log", m.CLASS_NRT))
    hear(discovery, S, m.Alive("IMU1"), msgspec.structs.replace(PC2, hops=1), publisher("blink"))
    assert sources.source("leds") == Source("PC2", "blink", "lab")
    assert [sources.source(topic) for topic in ("imu", "log")] == [unknown, unknown]


async def test_a_gateway_announces_itself_as_one() -> None:
    gateway = r2p.Module("GW", via=["memory:a", "memory:b"], bridge=True)
    async with gateway, r2p.Module("PC1", via="memory:a") as one, r2p.Module("PC2", via="memory:b") as two:
        await asyncio.sleep(10)
        for module, other in ((one, "PC2"), (two, "PC1")):
            known = module.links[0].discovery.modules
            assert (known["GW"].gateway, known[other].gateway) == (True, False)


def test_firmware_is_known_where_it_is_alone() -> None:
    discovery = Discovery("PC1", 1)
    discovery.link_up(0)
    sources = SenderLookup(discovery, "lab")
    hear(discovery, S, m.Alive("IMU1"))
    assert sources.source("leds") == Source("IMU1", "", "lab")
    hear(discovery, S, m.Alive("IMU2"))
    assert sources.source("leds") == Source("", "", "lab")
    discovery.link_down(2 * S)
    assert sources.source("leds") == Source("", "", "lab")
