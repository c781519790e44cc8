"""The log lines that the page on trouble explains are the ones that are logged: here they are provoked."""

import asyncio
import re
from typing import Annotated

import pytest

import r2p
from r2p.codecs import management
from r2p.modules import watchdog
from r2p.msg import Led
from r2p.sim.modules import FirmwareModule, Powered
from r2p.testing.network import Network, node_in
from tests.docs.blocks import ROOT

PAGE = (ROOT / "docs" / "how-to" / "troubleshooting.md").read_text()


class Marker(r2p.Message):
    raw: Annotated[tuple[r2p.u8, ...], r2p.Len(45)] = (0,) * 45


class NewMarker(r2p.Message):
    raw: Annotated[tuple[r2p.u8, ...], r2p.Len(46)] = (0,) * 46


class Big(r2p.Message):
    raw: Annotated[tuple[r2p.u8, ...], r2p.Len(300)] = (0,) * 300


def _told(log: str) -> bool:
    """Whether the page shows this line, with another link's name."""
    line = re.sub(r"^link \S+: ", "", log)
    return line in PAGE


@pytest.mark.virtual_time
async def test_one_topic_two_types(r2p_network: Network, caplog: pytest.LogCaptureFixture) -> None:
    async with r2p_network.node("A") as a, r2p_network.node("B") as b:
        a.advertise("markers", NewMarker)
        b.subscribe("markers", Marker)
        await asyncio.sleep(5)
    refused = [text for text in caplog.messages if "is refused" in text and "subscribe" not in text]
    assert refused
    assert all(map(_told, refused))


@pytest.mark.virtual_time
async def test_two_modules_with_one_name(r2p_network: Network, caplog: pytest.LogCaptureFixture) -> None:
    async with r2p_network.module("PC1"), r2p_network.module("PC1"):
        await asyncio.sleep(5)
    conflicts = [text for text in caplog.messages if "carry the name" in text]
    assert conflicts
    assert all(map(_told, conflicts))


@pytest.mark.virtual_time
async def test_two_versions_of_r2p(r2p_network: Network, caplog: pytest.LogCaptureFixture) -> None:
    newer = management.Hello("MOTOR2", 7, wire=management.WIRE_VERSION + 1, release="0.9.0")
    async with r2p_network.module("PC1") as pc1:
        pc1.links[0].manage(management.encode(newer), 9)
    (warning,) = [text for text in caplog.messages if "wire version" in text]
    assert _told(warning)


@pytest.mark.virtual_time
async def test_a_module_is_stopped(r2p_network: Network, caplog: pytest.LogCaptureFixture) -> None:
    async with r2p_network.module("PC1"), r2p_network.module("PC2") as pc2:
        await asyncio.sleep(1)
        pc2.command(r2p.Command.STOP, "PC1")
        await asyncio.sleep(1)
    assert "module PC1: STOP from the network" in caplog.messages
    assert _told("module PC1: STOP from the network")


def test_the_computer_is_busy_or_was_stopped() -> None:
    assert watchdog.NOT_RUNNING % 100 in PAGE
    assert (watchdog.BLOCKED % ("task PC1/plan", 100, "", "")).rstrip() in PAGE
    assert watchdog.AGAIN % ("task PC1/plan", 100, " (7 more since the last such line)", "...") in PAGE
    assert watchdog.STOPPED % 8 in PAGE


def test_the_event_loop_is_late() -> None:
    """Virtual time never is: so this is how a publisher writes it."""
    late = r2p.Missed("encoder", "late", late=0.006)
    assert _told(f"{late} (missed 0, late 3 so far)")
    skipped = r2p.Missed("encoder", "2 period(s) skipped, the next one late", late=0.02, count=2)
    assert _told(str(skipped).replace("20.0 ms", "..."))


@pytest.mark.virtual_time
async def test_a_link_comes_back(r2p_network: Network, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    async with r2p_network.module("A") as a, r2p_network.module("B") as b, node_in(a) as alice, node_in(b) as bob:
        publisher = alice.advertise("leds", Led)
        bob.subscribe("leds", Led)
        await publisher.wait_subscriber()
        link = a.links[0]
        link.on_down("unplugged")
        for _ in range(31):
            await publisher.publish(Led())
            await asyncio.sleep(0.1)
        link.on_up()
    logged = next(text for text in caplog.messages if "messages lost meanwhile" in text)
    assert _told(logged.removeprefix(f"link {link.title} "))


@pytest.mark.virtual_time
async def test_a_message_is_too_long_for_a_link(caplog: pytest.LogCaptureFixture) -> None:
    async def big(node: r2p.Node) -> None:
        node.advertise("big", Big)

    async with Powered(FirmwareModule("IMU1")) as power, r2p.Module("PC1", via=power.wire()) as pc:
        pc.start(big)
        await pc.wait()
    assert _told(caplog.messages[-1].replace("big", "...", 1).replace("wire:IMU1", "..."))


@pytest.mark.virtual_time
async def test_callbacks_without_spin_and_a_fetch_without_a_publisher(caplog: pytest.LogCaptureFixture) -> None:
    async def odo(node: r2p.Node) -> None:
        with pytest.raises(TimeoutError) as caught:
            await node.subscribe("encoder", Led).fetch(timeout=2)
        assert f"TimeoutError: {caught.value}" in PAGE
        node.subscribe("encoder", Led, print)
        await node.advertise("encoder", Led).publish(Led())
        await asyncio.sleep(5.0)

    async with r2p.Module("PC1", via=[]) as module:
        module.start(odo)
        await module.wait()
    (text,) = [each.getMessage() for each in caplog.records if each.name == "r2p.PC1.odo"]
    assert text.partition(";")[0] in PAGE
