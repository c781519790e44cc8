"""The classes of topics that a module has learnt from others."""

import asyncio

import pytest

import r2p
from r2p.monitoring.topic_types import TypeFinder
from r2p.msg import Led, Log
from r2p.testing.network import Network, node_in
from tests.transports.rtcan.networks import until

pytestmark = pytest.mark.virtual_time


class Reading(r2p.Message, name="lab/Reading"):
    """A type that only its publisher knows."""

    depth: r2p.f32 = 0.0


async def test_a_type_is_declared_standard_learnt_or_stated() -> None:
    network = Network()
    async with network.node("SUB") as node, network.module("PC", observer=True) as pc:
        node.advertise("depth", Reading)
        node.advertise("leds", Led)
        types = TypeFinder(pc)
        await until(lambda: {"depth", "leds"} <= pc.network.topics().keys())
        assert types.known("leds") is Led
        assert types.known("depth") is None
        found = await types.find("depth")
        assert found is not None
        assert r2p.layout(found).name == "lab/Reading"
        assert types.known("depth") is found
        assert types.known("log") is Log
        assert await types.find("nowhere") is None
        assert TypeFinder(pc, {"leds": Reading}).known("leds") is Reading
        async with node_in(pc) as own:
            own.subscribe("depth", Reading)
            assert types.known("depth") is Reading


async def test_a_type_that_nobody_gives_is_asked_for_once_in_ten_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    network = Network()
    async with network.node("SUB") as node, network.module("PC", observer=True) as pc:
        node.advertise("depth", Reading)
        types = TypeFinder(pc)
        await until(lambda: "depth" in pc.network.topics())
        asked: list[tuple[bytes, str]] = []

        async def message_type(fingerprint: bytes, topic: str) -> None:
            asked.append((fingerprint, topic))

        monkeypatch.setattr(pc.network, "message_type", message_type)
        assert [await types.find("depth") for _ in range(3)] == [None, None, None]
        assert asked == [(r2p.layout(Reading).fingerprint, "depth")]
        await asyncio.sleep(10.0)
        assert await types.find("depth") is None
        assert len(asked) == 2
        types.close()
