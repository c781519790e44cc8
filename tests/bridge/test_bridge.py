"""What a gateway does between two memory networks."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING
from unittest.mock import Mock

import msgspec
import pytest

import r2p
from r2p.bridge import BridgeOptions
from r2p.codecs import management
from r2p.msg import Float32, Led, Text
from r2p.protocols.discovery.events import Command
from r2p.runtime.events import LinkNotice
from r2p.testing.network import node_in
from r2p.transports.memory import Datagram, MemoryPort, network
from r2p.transports.rtcan.link import RtcanLink
from tests.transports.conversation import Script, manage

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

pytestmark = pytest.mark.virtual_time

CONVERGED = 1.0
"""Seconds after which a lone gateway forwards."""


@asynccontextmanager
async def gateway(
    options: BridgeOptions | bool = True, name: str = "GW", networks: str = "ab"
) -> AsyncIterator[r2p.Module]:
    async with r2p.Module(name, via=[f"memory:{each}" for each in networks], bridge=options) as module:
        await asyncio.sleep(CONVERGED)
        yield module


@asynccontextmanager
async def node(name: str, where: str) -> AsyncIterator[r2p.Node]:
    async with r2p.Module(name, via=f"memory:{where}") as module, node_in(module) as node:
        yield node


def drain(subscriber: r2p.Subscriber[Led]) -> list[int]:
    values = [Led.decode(sample.data).led for sample in subscriber.queue]
    subscriber.queue.clear()
    return values


def routes(module: r2p.Module, topic: str = "leds") -> dict[tuple[str, str], tuple[int, dict[str, int]]]:
    return {
        (each.source, each.target): (each.forwarded, each.dropped)
        for each in module.gateway_statistics().routes
        if each.topic == topic
    }


async def test_both_ways() -> None:
    async with gateway() as gw, node("A", "a") as a, node("B", "b") as b:
        there, back = a.advertise("leds", Led), b.advertise("back", Led)
        leds, backs = b.subscribe("leds", Led), a.subscribe("back", Led)
        await there.wait_subscriber()
        await back.wait_subscriber()
        for number in range(10):
            await there.publish(Led(led=number))
            await back.publish(Led(led=100 + number))
        await asyncio.sleep(0.1)
        assert drain(leds) == list(range(10))
        assert drain(backs) == list(range(100, 110))
        assert routes(gw)["memory:a", "memory:b"] == (10, {})


async def test_nothing_is_asked_for_that_nobody_wants() -> None:
    async with gateway() as gw, node("A", "a") as a, node("B", "b") as b:
        leds = a.advertise("leds", Led)
        await asyncio.sleep(1)
        assert not leds.subscribers
        subscriber = b.subscribe("leds", Led)
        await leds.wait_subscriber()
        subscriber.close()
        await asyncio.sleep(0.1)
        assert not leds.subscribers
        assert routes(gw)["memory:a", "memory:b"] == (0, {})


async def test_subscribers_on_the_same_side_get_it_once() -> None:
    async with gateway(), node("A", "a") as a, node("B", "a") as b, node("C", "b") as c:
        leds = a.advertise("leds", Led)
        near, far = b.subscribe("leds", Led), c.subscribe("leds", Led)
        await asyncio.sleep(1)
        await leds.publish(Led(led=1))
        await asyncio.sleep(0.1)
        assert (drain(near), drain(far)) == ([1], [1])


async def test_a_chain() -> None:
    """Subscriptions travel through all of it, and samples keep who published them, when, and as which."""
    async with (
        gateway(name="G1"),
        gateway(name="G2", networks="bc"),
        gateway(name="G3", networks="cd"),
        node("A", "a") as a,
        node("D", "d") as d,
    ):
        leds, far = a.advertise("leds", Led), d.subscribe("leds", Led)
        await leds.wait_subscriber()
        await asyncio.sleep(0.1)
        await leds.publish(Led(led=7))
        await asyncio.sleep(0.1)
        (sample,) = far.queue
        assert str(sample.source) == "A/test"
        assert (sample.sequence, sample.hops, sample.stamped) == (1, 3, True)


async def test_the_other_side_can_be_seen() -> None:
    async with gateway(), r2p.Module("B", via="memory:b") as b:
        async with r2p.Module("A", via="memory:a") as a, node_in(a) as one:
            leds = one.advertise("leds", Led)
            await asyncio.sleep(0.5)
            view = b.network.topics()["leds"]
            assert [(each.module, each.node) for each in view.publishers] == [("A", "test")]
            assert {view.name: view.state for view in b.network.modules()}["A"] == "running"
            await a.stop()
            await asyncio.sleep(0.5)
            assert {view.name: view.state for view in b.network.modules()}["A"] == "stopped"
            leds.close()
            await asyncio.sleep(0.5)
            assert not b.network.topics()["leds"].publishers
        await asyncio.sleep(0.5)
        assert "A" not in {view.name for view in b.network.modules()}


@pytest.mark.parametrize(
    ("options", "passes"),
    [
        (BridgeOptions(allow=("leds",)), True),
        (BridgeOptions(allow=("cmd*",)), False),
        (BridgeOptions(deny=("l*",)), False),
        (BridgeOptions(allow=("leds@memory:a",)), True),
        (BridgeOptions(allow=("leds@memory:b",)), False),
        (BridgeOptions(deny=("leds@memory:a>memory:b",)), False),
        (BridgeOptions(deny=("leds@memory:b>memory:a",)), True),
        (BridgeOptions(read_only=("memory:a",)), True),
        (BridgeOptions(read_only=("memory:b",)), False),
        (BridgeOptions(read_only=("memory",)), False),
    ],
)
async def test_what_may_pass(options: BridgeOptions, passes: bool) -> None:
    async with gateway(options), node("A", "a") as a, node("B", "b") as b:
        leds, far = a.advertise("leds", Led), b.subscribe("leds", Led)
        await asyncio.sleep(1)
        assert bool(leds.subscribers) is passes
        await leds.publish(Led(led=1))
        await asyncio.sleep(0.1)
        assert drain(far) == ([1] if passes else [])


async def test_rate_limit() -> None:
    async with gateway(BridgeOptions(rate_limit={"leds": 10.0})) as gw, node("A", "a") as a, node("B", "b") as b:
        leds, far = a.advertise("leds", Led), b.subscribe("leds", Led, queue=1000)
        await leds.wait_subscriber()
        await asyncio.sleep(0.1)
        for number in range(200):
            await leds.publish(Led(led=number))
            await asyncio.sleep(0.01)
        assert len(drain(far)) in range(19, 23)  # in 2 s
        forwarded, dropped = routes(gw)["memory:a", "memory:b"]
        assert dropped == {"rate limit": 200 - forwarded}


async def test_a_prefix() -> None:
    """On the network the robot's topics are called robot1/..., and others are not the robot's."""
    options = BridgeOptions(prefix="robot1/", prefix_on=("memory:b",))
    async with gateway(options), node("A", "a") as a, node("B", "b") as b:
        leds, far = a.advertise("leds", Led), b.subscribe("robot1/leds", Led)
        plain, cmd = b.subscribe("leds", Led), a.subscribe("cmd", Led)
        stranger, ours = b.advertise("cmd", Led), b.advertise("robot1/cmd", Led)
        await asyncio.sleep(1)
        await leds.publish(Led(led=1))
        await ours.publish(Led(led=2))
        await stranger.publish(Led(led=3))
        await asyncio.sleep(0.1)
        assert (drain(far), drain(plain), drain(cmd)) == ([1], [], [2])


@pytest.mark.parametrize("klass", [r2p.NonRealTime(), r2p.Sporadic(deadline=0.02)])
async def test_a_latched_value_reaches_who_joins_later(klass: r2p.NonRealTime | r2p.Sporadic) -> None:
    """That of an event, too, long after it was due."""
    async with gateway(), node("A", "a") as a:
        config = a.advertise("leds", Led, klass, latch=True)
        await config.publish(Led(led=5))
        await asyncio.sleep(0.5)
        for name in ("B", "C"):
            async with node(name, "b") as b:
                assert (await b.subscribe("leds", Led).fetch(timeout=1)).led == 5
            await asyncio.sleep(5)


async def test_a_late_message_is_dropped_if_its_publisher_said_when() -> None:
    async with gateway() as gw, node("A", "a") as a, node("B", "b") as b:
        leds = a.advertise("leds", Led, r2p.Sporadic(deadline=0.02))
        far = b.subscribe("leds", Led)
        await leds.wait_subscriber()
        await asyncio.sleep(0.1)
        await leds.publish(Led(led=0))  # shows how long a message takes
        await asyncio.sleep(0.1)
        network("a").delay = 0.05
        await leds.publish(Led(led=1))
        await asyncio.sleep(0.2)
        assert drain(far) == [0]
        assert routes(gw)["memory:a", "memory:b"] == (1, {"late": 1})


async def test_two_types_are_refused_across_the_gateway() -> None:
    async with gateway(), node("A", "a") as a, node("B", "b") as b:
        leds = a.advertise("leds", Led)
        far = b.subscribe("leds", Float32)
        await asyncio.sleep(2)
        await leds.publish(Led(led=1))
        await asyncio.sleep(0.1)
        assert not far.queue


async def test_another_type_elsewhere_does_not_end_what_flows() -> None:
    """A publisher or subscriber of another type is refused on its own link, and leaves nothing behind."""
    async with gateway(), node("A", "a") as a, node("B", "b") as b:
        publisher, subscriber = a.advertise("leds", Led), b.subscribe("leds", Led, queue=100)
        await publisher.wait_subscriber()
        for kind in ("publishes", "subscribes"):
            async with node("C", "b") as c:
                if kind == "publishes":
                    c.advertise("leds", Float32, latch=True)
                else:
                    c.subscribe("leds", Float32)
                await asyncio.sleep(4.0)
                await publisher.publish(Led(led=1))
            await asyncio.sleep(8.0)
            await publisher.publish(Led(led=2))
            await asyncio.sleep(0.1)
            assert drain(subscriber) == [1, 2]


async def test_own_nodes_of_a_gateway() -> None:
    async with gateway() as gw, node_in(gw, name="own") as own, node("A", "a") as a, node("B", "b") as b:
        text = own.advertise("text", Text)
        near, far = a.subscribe("text", Text), b.subscribe("text", Text)
        heard = own.subscribe("leds", Led)
        leds = a.advertise("leds", Led)
        await asyncio.sleep(1)
        await text.publish(Text(text="hello"))
        await leds.publish(Led(led=3))
        await asyncio.sleep(0.1)
        assert (len(near.queue), len(far.queue), drain(heard)) == (1, 1, [3])


# Orders


class Tap:
    """Hears management messages on a network, as firmware would, and speaks there."""

    def __init__(self, where: str) -> None:
        self.heard: list[management.Management] = []
        self._network = network(where)
        self._address = self._network.new_address()
        self._network.plug_in(self._address, MemoryPort(self._network, self._hear, lambda: None))

    def _hear(self, frame: Datagram) -> None:
        if frame.topic == b"R2P":
            self.heard.append(management.decode(frame.data))

    def say(self, message: management.Management) -> None:
        self._network.send(Datagram(self._address, b"R2P", management.encode(message)))

    def orders(self) -> list[management.Management]:
        kinds = (management.Stop, management.Reboot, management.Bootload)
        return [each for each in self.heard if isinstance(each, kinds)]


async def test_orders_pass() -> None:
    async with gateway():
        a, b = Tap("a"), Tap("b")
        orders: list[management.Management] = [
            management.Stop("IMU1"),
            management.Reboot("IMU1"),
            management.Bootload("IMU1"),
        ]
        for order in orders:
            a.say(order)
        await asyncio.sleep(0.1)
        assert b.orders() == orders
        assert a.orders() == []


async def test_an_order_that_is_delivered_is_not_refused(caplog: pytest.LogCaptureFixture) -> None:
    """Other links are read-only, but its module is not there."""
    async with gateway(BridgeOptions(read_only=("memory:c", "memory:d")), networks="abcd") as gw:
        a, b = Tap("a"), Tap("b")
        b.say(management.Alive("IMU1"))
        await asyncio.sleep(1.0)
        a.say(management.Stop("IMU1"))
        await asyncio.sleep(0.1)
        assert b.orders() == [management.Stop("IMU1")]
        assert all("order refused" not in link.losses for link in gw.links)
        assert "is refused" not in caplog.text


async def test_an_order_that_goes_nowhere_is_refused_once() -> None:
    async with gateway(BridgeOptions(read_only=("memory:b", "memory:c", "memory:d")), networks="abcd") as gw:
        a = Tap("a")
        a.say(management.Stop("IMU1"))
        await asyncio.sleep(0.1)
        assert gw.links[0].losses["order refused"] == 1
        Tap("d").say(management.Alive("IMU1"))
        await asyncio.sleep(0.5)
        a.say(management.Stop("IMU1"))
        await asyncio.sleep(0.1)
        assert gw.links[0].losses["order refused"] == 2
        assert [type(each) for each in a.heard if isinstance(each, management.Denied)] == [management.Denied]


async def test_an_order_without_a_prefix_does_not_ask_for_all_modules(monkeypatch: pytest.MonkeyPatch) -> None:
    async with gateway(networks="abcd") as gw:
        assert gw._link_manager is not None
        assert gw._link_manager.bridge is not None
        asked = Mock(return_value=[])
        monkeypatch.setattr(gw._link_manager.bridge.directory, "own_modules", asked)
        a, b = Tap("a"), Tap("b")
        a.say(management.Stop("IMU1"))
        await asyncio.sleep(0.1)
        assert b.orders() == [management.Stop("IMU1")]
        asked.assert_not_called()


async def test_control_from_ip_links_needs_permission(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("r2p.transports.url._IP", frozenset({"memory"}))
    for allowed in (False, True):
        async with gateway(BridgeOptions(allow_control=allowed)) as gw:
            a, b = Tap("a"), Tap("b")
            a.say(management.Stop("IMU1"))
            a.say(management.Reboot("IMU1"))
            a.say(management.SubscribeRequest("BOOT_IMU1", 31, 1))
            b.say(management.Advertise("BOOT_IMU1", 31))
            b.say(management.SubscribeRequest("BOOT_IMU1", 31, 1))
            a.say(management.Advertise("BOOT_IMU1", 31))
            await asyncio.sleep(0.1)
            kinds = [type(order) for order in b.orders()]
            assert kinds == ([management.Stop, management.Reboot] if allowed else [management.Stop])
            assert bool(routes(gw, "BOOT_IMU1")) is allowed


@pytest.mark.parametrize(
    ("options", "command", "missing"),
    [
        (BridgeOptions(), Command.REBOOT, "it lacks --allow-control"),
        (BridgeOptions(read_only=("memory:a",)), Command.STOP, "the link there is read-only"),
    ],
)
async def test_who_gives_an_order_that_does_not_pass_is_told(
    options: BridgeOptions, command: Command, missing: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Through another gateway, too; and no other module is."""
    monkeypatch.setattr("r2p.transports.url._IP", frozenset({"memory"}))
    async with (
        gateway(options),
        gateway(BridgeOptions(allow_control=True), name="G2", networks="bc"),
        node("A", "a"),
        r2p.Module("C", via="memory:c") as asks,
        r2p.Module("D", via="memory:c") as other,
    ):
        events, others = asks.events(), other.events()
        await asyncio.sleep(3)
        asks.command(command, "A")
        asks.command(command, "NOBODY")
        await asyncio.sleep(0.1)
    denied = [event async for event in events if isinstance(event, LinkNotice) and "denied" in event.kind]
    assert denied == [
        LinkNotice(
            "memory:c",
            f"{command.name} denied",
            f"gateway GW does not let {command.name} of A through: {missing}",
        )
    ]
    assert not [event async for event in others if isinstance(event, LinkNotice) and "denied" in event.kind]


async def test_who_leaves_or_hangs_is_gone_on_the_other_side_too(caplog: pytest.LogCaptureFixture) -> None:
    loop = asyncio.get_running_loop()
    async with gateway(), r2p.Module("PC", via="memory:b") as pc:
        events = pc.events()

        async def until_gone() -> None:
            async for event in events:
                if isinstance(event, r2p.ModuleGone) and event.info.name == "A":
                    return

        async with r2p.Module("A", via="memory:a"):
            await asyncio.sleep(3)
            assert "A" in {each.name for each in pc.network.modules()}
            left_at = loop.time()
        await until_gone()
        assert loop.time() - left_at < 0.01
        assert "gone: nothing heard" not in caplog.text
        async with r2p.Module("A", via="memory:a"):
            await asyncio.sleep(3)
            network("a").loss = 1.0  # it says no good-bye
            hangs_at = loop.time()
            await until_gone()
        assert loop.time() - hangs_at < 5.1
        assert "link memory:a: module A is gone: nothing heard of it for 5 s; does it hang?" in caplog.text
        assert "link memory:b: module A is gone: nothing" not in caplog.text


async def test_firmware_is_seen_with_its_age() -> None:
    async with gateway(), r2p.Module("B", via="memory:b") as module:
        firmware = Tap("a")
        firmware.say(management.Alive("IMU1"))
        await asyncio.sleep(10)
        (imu,) = [view for view in module.network.modules() if view.name == "IMU1"]
        assert imu.instance is None
        assert imu.age > 7
        firmware.say(management.Alive("IMU1"))
        await asyncio.sleep(2)
        (imu,) = [view for view in module.network.modules() if view.name == "IMU1"]
        assert imu.age < 2


async def test_a_line_with_a_gateway_at_its_other_end_is_read_whoever_has_no_room() -> None:
    """Hellos that wait behind messages would part the tree."""

    class Line(Script):
        flow_controlled = True

    line = Line()
    async with r2p.Module("GW", via=[line, "memory:b"], bridge=True):
        await asyncio.sleep(CONVERGED)
        assert line.link.flow_controlled
        for count in range(5):
            line.hear(manage(management.Bridge(7, 0, count, 0, 7, bytes(12))))
            await asyncio.sleep(0.08)
            assert not line.link.flow_controlled
        await asyncio.sleep(CONVERGED)  # it is gone
        assert line.link.flow_controlled


class FirmwareGateway:
    """Joins two networks as firmware does: passes on what firmware knows, and what it knows not of it drops."""

    def __init__(self, one: str, other: str) -> None:
        self._networks = network(one), network(other)
        self._ports = [each.new_address() for each in self._networks]
        for here, there in ((0, 1), (1, 0)):
            self._plug_in(here, there)

    def _plug_in(self, here: int, there: int) -> None:
        def hear(frame: Datagram) -> None:
            if frame.topic != b"R2P" or frame.data[-1] < 0x40:
                frame = msgspec.structs.replace(frame, port=self._ports[there])
                self._networks[there].send(frame)

        self._networks[here].plug_in(self._ports[here], MemoryPort(self._networks[here], hear, lambda: None))

    def cut(self) -> None:
        for each, port in zip(self._networks, self._ports, strict=True):
            each.unplug(port)


async def test_a_loop_through_firmware_is_blocked_and_told() -> None:
    joined = FirmwareGateway("a", "b")
    async with gateway() as gw, node("A", "a") as a, node("B", "b") as b:
        leds, far = a.advertise("leds", Led), b.subscribe("leds", Led)
        await asyncio.sleep(2)
        states = {each.link: each.state for each in gw.gateway_statistics().ports}
        assert states == {"memory:a": "alone", "memory:b": "loop"}
        await leds.publish(Led(led=1))
        await asyncio.sleep(0.5)
        assert drain(far) == [1]
        joined.cut()
        await asyncio.sleep(10)
        states = {each.link: each.state for each in gw.gateway_statistics().ports}
        assert states == {"memory:a": "alone", "memory:b": "alone"}


async def test_two_gateways_whose_networks_firmware_joins() -> None:
    """Each hears the other only on the network that both are on; the loop goes through firmware."""
    joined = FirmwareGateway("a", "b")
    async with (
        gateway(name="G1", networks="ac") as one,
        gateway(name="G2", networks="bc") as two,
        node("A", "a") as a,
        node("C", "c") as c,
    ):
        leds, far = a.advertise("leds", Led), c.subscribe("leds", Led)
        await asyncio.sleep(2)
        states = [port.state for each in (one, two) for port in each.gateway_statistics().ports]
        assert sorted(states) == ["alone", "forwarding", "forwarding", "loop"]
        for number in range(5):
            await leds.publish(Led(led=number))
            await asyncio.sleep(0.1)
        assert drain(far) == [0, 1, 2, 3, 4]
        joined.cut()


# A bus


@pytest.mark.parametrize("reserve", [False, True])
async def test_periodic_messages_towards_a_bus(reserve: bool) -> None:
    """They are due within their period; in slots of their own only if that is asked for."""
    options = BridgeOptions(reserve=("leds",) if reserve else ())
    async with (
        r2p.Module("GW", via=["memory:a", "sim:bus"], bridge=options) as gw,
        node("A", "a") as a,
        r2p.Module("IMU1", via="sim:bus") as imu,
        node_in(imu) as there,
    ):
        values = iter(range(10**6))
        far = there.subscribe("leds", Led, queue=10**4)
        a.advertise("leds", Led, r2p.Periodic(0.01, lambda: Led(led=next(values))))
        await asyncio.sleep(8)
        classes = {sample.publisher_class for sample in list(far.queue)[-100:]}
        assert classes == {r2p.PublisherClass.PERIODIC if reserve else r2p.PublisherClass.SPORADIC}
        got = drain(far)
        assert got == sorted(set(got))
        assert len(got) > 300
        assert routes(gw)["memory:a", "sim:bus"][1] == {}


def always(message: r2p.Message) -> Callable[[], r2p.Message]:
    return lambda: message


async def test_a_publisher_with_slots_comes_back_with_another_size() -> None:
    """A new version of a module has a new version of its type: the slots are reserved anew, for the new size."""
    versions = (Led(led=1), Float32(data=1.0), Led(led=2))
    async with (
        r2p.Module("GW", via=["memory:a", "sim:bus"], bridge=BridgeOptions(reserve=("data",))) as gw,
        r2p.Module("IMU1", via="sim:bus") as imu,
        node_in(imu) as there,
    ):
        far = there.subscribe("data", None, queue=10**4)
        for message in versions:
            far.queue.clear()
            async with node("A", "a") as a:
                a.advertise("data", type(message), r2p.Periodic(0.05, always(message)))
                async with asyncio.timeout(30):
                    async for sample in far.samples():
                        if sample.publisher_class is r2p.PublisherClass.PERIODIC:
                            break
                assert sample.data == message.encode()
                bus = gw.links[1]
                assert isinstance(bus, RtcanLink)
                assert [each.publisher.size for each in bus.slots.values()] == [len(sample.data)]
