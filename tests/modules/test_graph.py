"""The views of the network: what a module knows of topics, nodes and modules, and from whom."""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec
import pytest

import r2p
from r2p.codecs import management
from r2p.codecs.management import ROLE_PUBLISHES, ROLE_SUBSCRIBES, WIRE_VERSION
from r2p.messages import layout
from r2p.modules.graph import Endpoint, ModuleView, TopicLooks, TopicView
from r2p.msg import Led
from r2p.protocols.discovery.events import Mismatched, TopicType
from tests.bench import hold, joined, local, settle

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

NRT, SPORADIC = r2p.PublisherClass.NON_REAL_TIME, r2p.PublisherClass.SPORADIC
LAB = "memory:lab"


@pytest.mark.virtual_time
async def test_a_module_alone_knows_itself() -> None:
    async with local() as module:
        node = module.start(hold)
        node.advertise("leds", Led, r2p.Sporadic(1.0))
        node.subscribe("leds", Led)
        assert module.network.modules() == [
            ModuleView("PC1", "running", False, 0.0, "", module.instance, WIRE_VERSION, r2p.__version__)
        ]
        view = module.network.topics()["leds"]
        assert (view.size, view.fingerprint, view.age) == (5, layout(Led).fingerprint, 0.0)
        assert view.publishers == [Endpoint("PC1", "hold", SPORADIC)]
        assert view.subscribers == [Endpoint("PC1", "hold")]
        assert (view.published_on, view.subscribed_on) == ([""], [""])
        await module.stop()
        assert module.network.modules()[0].state == "stopped"
        assert list(module.network.topics()) == ["log"]


@pytest.mark.virtual_time
async def test_what_a_link_tells() -> None:
    async with joined("A") as a, joined("B") as b, r2p.Module("_tool1", via=LAB, observer=True) as tool:
        node = a.start(hold, name="drive")
        node.advertise("leds", Led)
        two = node.advertise("leds", Led, r2p.Sporadic(1.0), latch=True)
        b.start(hold, name="show").subscribe("leds", Led)
        await settle(3.0)
        view = tool.network.topics()["leds"]
        assert view.publishers == [Endpoint("A", "drive", SPORADIC, LAB)]
        assert view.subscribers == [Endpoint("B", "show", None, LAB)]
        assert (view.published_on, view.subscribed_on) == ([LAB], [LAB])
        assert (view.size, view.fingerprint, view.layout, view.mismatch) == (5, layout(Led).fingerprint, None, False)
        assert view.age is not None
        assert 0.0 <= view.age <= 3.0
        assert [(each.name, each.state, each.link) for each in tool.network.modules()] == [
            ("_tool1", "observer", ""),
            ("A", "running", LAB),
            ("B", "running", LAB),
        ]
        two.close()  # the other publisher of the node is still there, and not latched
        await settle(1.0)
        assert tool.network.topics()["leds"].publishers == [Endpoint("A", "drive", NRT, LAB)]
        await a.stop()
        await settle(1.0)
        assert tool.network.topics()["leds"].publishers == []
        assert {each.name: each.state for each in tool.network.modules()}["A"] == "stopped"
        assert tool.network.nodes() == {
            ("A", "log"): (["log"], []),
            ("B", "log"): (["log"], []),
            ("B", "show"): ([], ["leds"]),
        }


@pytest.mark.virtual_time
async def test_looks_have_the_same_views_until_more_than_ages_changes() -> None:
    async with joined("A") as a, joined("B") as b, r2p.Module("_tool1", via=LAB, observer=True) as tool:
        looks = TopicLooks(tool.network, tool.space)
        steps: list[Callable[[], object]] = [
            lambda: a.start(hold, name="drive").advertise("leds", Led),
            lambda: b.start(hold, name="show").subscribe("leds", Led),
            lambda: tool.start(hold, name="look").subscribe("leds", Led, lossy=True),
            lambda: a.start(hold, name="more").advertise("leds", Led),
        ]
        for step in steps:
            before = looks.look()
            step()
            await settle(3.0)
            views = looks.look()
            assert views is not before
            assert views == tool.network.topics()
            await settle(10.0)
            assert looks.look() is views
            assert in_order(views) == in_order(tool.network.topics())  # with the ages of now
        tool.links[0].discovery.topics["leds"].mismatch = True
        assert looks.look()["leds"].mismatch


def in_order(views: Mapping[str, TopicView]) -> dict[str, TopicView]:
    """The views with their ends in order: an endpoint that is announced again becomes the last one."""

    def ordered(ends: list[Endpoint]) -> list[Endpoint]:
        return sorted(ends, key=repr)

    return {
        name: msgspec.structs.replace(view, publishers=ordered(view.publishers), subscribers=ordered(view.subscribers))
        for name, view in views.items()
    }


@pytest.mark.virtual_time
async def test_any_byte_from_outside_makes_a_view() -> None:
    async with joined("A") as a:
        link = a.links[0]
        link.discovery.receive(0, management.encode(management.Hello("X", 7)), 9)
        for publisher_class in range(256):
            endpoint = management.Endpoint(ROLE_PUBLISHES, 7, f"n{publisher_class}", "leds", publisher_class)
            link.discovery.receive(0, management.encode(endpoint), 9)
        for role in range(128):
            endpoint = management.Endpoint(role, 7, f"r{role}", "leds")
            link.discovery.receive(0, management.encode(endpoint), 9)
        link.discovery.receive(0, management.encode(management.Alive("Y", 0xFF)), 9)
        view = a.network.topics()["leds"]
        assert len(view.publishers) == 256 + 1
        assert {each.publisher_class for each in view.publishers} == set(r2p.PublisherClass)
        assert {each.name: each.state for each in a.network.modules()}["Y"] == "boot"


@pytest.mark.virtual_time
async def test_an_endpoint_without_a_module_is_hidden_by_the_same_of_a_module() -> None:
    async with joined("A") as a:
        link = a.links[0]
        for message in (
            management.Endpoint(ROLE_PUBLISHES, 7, "drive", "leds", 1),
            management.Endpoint(ROLE_PUBLISHES, 7, "blink", "leds", 1),
            management.Endpoint(ROLE_PUBLISHES, 8, "drive", "leds", 1),
            management.Hello("X", 8),
        ):
            link.discovery.receive(0, management.encode(message), 9)
        publishers = a.network.topics()["leds"].publishers
        assert {(each.module, each.node) for each in publishers} == {("X", "drive"), ("", "blink")}


@pytest.mark.virtual_time
async def test_another_wire_version_is_reported_once(caplog: pytest.LogCaptureFixture) -> None:
    async with joined("A") as a:
        for flags in (0, 1, 0):
            for message in (management.Hello("X", 8, wire=9, release="9.9"), management.Alive("X", flags)):
                a.links[0].manage(management.encode(message), 9)
            await settle(1.5)
        view = next(each for each in a.network.modules() if each.name == "X")
    assert (view.wire, view.release) == (9, "9.9")
    (line,) = [each.getMessage() for each in caplog.records if "wire version" in each.getMessage()]
    assert f"module X has wire version 9 (r2p 9.9), this one {management.WIRE_VERSION}" in line
    assert "install the same release on both" in line


def test_a_mismatch_is_described_with_what_to_do() -> None:
    ours, longer, other = TopicType(5, b"12345678"), TopicType(9), TopicType(5, b"abcdefgh")
    by_size = Mismatched("leds", None, ROLE_PUBLISHES, ours, longer).describe()
    assert by_size.startswith("others publish messages of 9 bytes, here they have 5; use one message type")
    by_type = Mismatched("leds", None, ROLE_SUBSCRIBES, ours, other).describe()
    assert by_type.startswith("others subscribe to another layout of the same 5 bytes")
