"""A module of wire version 1, recorded before there were long names, talks with one of now."""

from __future__ import annotations

import asyncio
import json

import pytest

import r2p
from r2p.codecs import management
from r2p.codecs.management import WIRE_VERSION, ManagementType
from r2p.msg import Float32, Led, Velocity3
from r2p.protocols.discovery.events import ModuleGone
from r2p.testing.network import node_in
from tests.docs.blocks import ROOT
from tests.transports.conversation import Script

RECORDED = json.loads((ROOT / "tests" / "golden" / "wire1.json").read_text())["sent"]
NAME = "front_left/wheel/velocity_estimate"
"""The recorded module uses its alias as a name, as firmware does."""


@pytest.mark.virtual_time
async def test_they_understand_each_other_and_say_that_their_versions_differ(caplog: pytest.LogCaptureFixture) -> None:
    script = Script()
    loop = asyncio.get_running_loop()
    async with r2p.Module("PC2", via=script, watchdog=False) as module, node_in(module, name="watcher_of_it") as node:
        events = module.events()
        leds, velocity = node.subscribe("leds", Led, queue=50), node.subscribe(NAME, Float32, queue=50)
        commands = node.advertise("cmd", Velocity3)
        for ms, text in RECORDED:
            loop.call_at(loop.time() + ms / 1000, script.hear, text.encode())
        await commands.wait_subscriber()
        await commands.publish(Velocity3(x=1.0))
        await asyncio.sleep(3.0)
        assert [sample.data for sample in leds.queue] == [Led(led=number).encode() for number in range(20)]
        assert [sample.data for sample in velocity.queue][-1] == Float32(data=19.0).encode()
        for subscriber in (leds, velocity):
            assert [sample.source for sample in subscriber.queue][-1] == r2p.Source("OLD", "blinker", "script")
        assert script.topics("cmd") == [Velocity3(x=1.0).encode()]
        assert not module.links[0].losses
        assert (await anext(event async for event in events if isinstance(event, ModuleGone))).info.wire == 1
    (warning,) = [text for text in caplog.messages if "wire version" in text]
    assert f"module OLD has wire version 1 (r2p 0.1.0), this one {WIRE_VERSION}" in warning


@pytest.mark.virtual_time
async def test_what_a_module_of_now_says_is_known_to_the_old_one_but_for_long_names() -> None:
    script = Script()
    async with r2p.Module("PC2", via=script, watchdog=False) as module, node_in(module, name="watcher") as node:
        node.subscribe(NAME, Float32)
        for _, text in RECORDED[:20]:
            script.hear(text.encode())
        await asyncio.sleep(3.0)
    said = {management.type_of(data) for data in script.topics("R2P")}
    assert said - set(ManagementType) == set()
    assert {each for each in said if each > ManagementType.NAME and each < ManagementType.BRIDGE} == {
        ManagementType.LONG_NAME
    }
