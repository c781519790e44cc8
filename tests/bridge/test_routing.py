"""What a gateway relays between links that do not carry the same: names, sizes, links that are called alike."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING

import pytest

import r2p
from r2p.bridge.routing import LONG_NAMES
from r2p.codecs import management
from r2p.msg import Led
from r2p.names import topic_alias
from r2p.sim.transport import SimCan, SimTransport
from r2p.testing.network import Network, node_in
from r2p.transports.memory import Datagram
from tests.bridge.test_bridge import CONVERGED, Tap, drain, gateway
from tests.transports.conversation import Script, line, manage

if TYPE_CHECKING:
    from collections.abc import Callable

    from r2p.transports.link import Transport

pytestmark = pytest.mark.virtual_time


async def test_a_message_too_long_for_the_next_link_is_counted_and_the_others_pass() -> None:
    """Its topic may be of a type that is not known."""
    script = Script()
    async with r2p.Module("GW", via=[script, "memory:b"], bridge=True):
        await asyncio.sleep(CONVERGED)
        tap = Tap("b")
        tap.say(management.Advertise("boom", 0))
        script.hear(manage(management.SubscribeRequest("boom", 0, 5)))
        await asyncio.sleep(0.5)
        tap.say(management.SubscribeResponse("boom", 0))
        await asyncio.sleep(0.5)
        for size in (1, 255, 256, 0, 300, 2):
            tap._network.send(Datagram(tap._address, b"boom", bytes(size)))
        await asyncio.sleep(0.1)
        assert [len(each) for each in script.topics("boom")] == [1, 255, 2]
        assert script.link.losses == {"too long": 2, "impossible message": 1}
        assert script.link.stats.sent == 3


@pytest.mark.parametrize("name", ["a//b", "/a", "a/", "a#b", "a*", "$*", "a-b"])
async def test_a_topic_that_no_other_link_can_name_is_not_relayed(name: str) -> None:
    script = Script()
    async with r2p.Module("GW", via=[script, "memory:b"], bridge=True) as module:
        await asyncio.sleep(CONVERGED)
        tap = Tap("b")
        script.hear(manage(management.Advertise(name, 5)))
        await asyncio.sleep(1.0)
        advertised = {each.topic for each in tap.heard if isinstance(each, management.Advertise)}
        assert advertised <= {"log"}
        assert name not in module.space.topics


def say(tap: Tap, *messages: management.Management) -> None:
    for message in messages:
        tap.say(message)


async def test_what_was_forwarded_as_an_alias_is_forwarded_by_its_name_once_that_is_known() -> None:
    name = "front_left/wheel/velocity_estimate"
    alias = topic_alias(name)
    async with gateway() as module:
        a, b = Tap("a"), Tap("b")
        say(a, management.Hello("A", 7), management.Advertise(alias, 5))
        await asyncio.sleep(0.5)
        assert alias in module.space.topics
        say(a, *management.long_name_messages(management.KIND_TOPIC, name))
        await asyncio.sleep(0.5)
        assert name in module.space.topics
        assert alias not in module.space.topics
        names = [each for each in b.heard if isinstance(each, management.LongName)]
        assert names[:2] == management.long_name_messages(management.KIND_TOPIC, name)
        b.heard.clear()
        say(a, management.Hello("A", 7), management.Advertise(alias, 5))
        await asyncio.sleep(2.0)
        assert alias in {each.topic for each in b.heard if isinstance(each, management.Advertise)}
        assert set(module.space.topics) == {name, "log"}


async def test_names_too_long_for_a_link_are_told_once_and_floods_of_them_once_a_second(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async with gateway() as module:
        routing = module._link_manager.bridge.routing  # type: ignore[union-attr]
        port = routing._ports["memory:a"]
        for number in range(2 * LONG_NAMES):
            for _ in range(2):
                assert not routing._carries(f"{'a' * 257}/{number}", port)
        warnings = [each for each in caplog.records if each.levelno == logging.WARNING]
        assert len(warnings) - 1 == len(routing._too_long) == LONG_NAMES
        await asyncio.sleep(1.0)
        assert not routing._carries(f"{'a' * 257}/more", port)
        assert len(caplog.records) == len(warnings) + 1
        assert caplog.messages[-1].endswith(f" ({LONG_NAMES - 1} more since the last such line)")


def _memory() -> Transport:
    return Network().transport()


def _sim() -> Transport:
    return SimTransport("lab", shared=SimCan())


@pytest.mark.parametrize("make", [_memory, _sim])
async def test_two_links_that_are_called_alike(make: Callable[[], Transport]) -> None:
    """Each is the source of what comes in by it."""
    one, other = make(), make()
    async with (
        r2p.Module("GW", via=[one, other], bridge=True) as gw,
        r2p.Module("A", via=_again(one)) as a,
        r2p.Module("B", via=_again(other)) as b,
        node_in(a) as alice,
        node_in(b) as bob,
        node_in(gw) as here,
    ):
        topics = [(alice, bob, "there"), (bob, alice, "back")]
        pairs = [(one.advertise(name, Led), two.subscribe(name, Led)) for one, two, name in topics]
        seen = [here.subscribe(name, Led) for _, _, name in topics]
        await asyncio.sleep(10.0)
        for publisher, _ in pairs:
            await publisher.publish(Led(1))
        await asyncio.sleep(0.5)
        assert [drain(subscriber) for _, subscriber in pairs] == [[1], [1]]
        names = [link.name for link in gw.links]
        assert names[1] == f"{names[0]}#2"
        assert [each.queue[0].source.link for each in seen] == names


def _again(transport: Transport) -> Transport:
    """Another place on the same network."""
    if isinstance(transport, SimTransport):
        return SimTransport("lab", shared=transport._shared)
    return transport


async def test_two_lines_that_are_called_alike() -> None:
    one, other = Script(), Script()
    async with r2p.Module("GW", via=[one, other], bridge=True):
        await asyncio.sleep(CONVERGED)
        other.hear(manage(management.Advertise("leds", 5)))
        one.hear(manage(management.SubscribeRequest("leds", 5, 5)))
        await asyncio.sleep(0.5)
        other.hear(manage(management.SubscribeResponse("leds", 5)))
        other.hear(line("leds", Led(1).encode()))
        await asyncio.sleep(0.1)
        assert one.topics("leds") == [Led(1).encode()]
        assert not other.topics("leds")
