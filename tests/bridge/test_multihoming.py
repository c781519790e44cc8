"""A module that is no gateway, with several links that gateways join, or do not."""

from __future__ import annotations

import asyncio
from collections import Counter
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING, Annotated, Any

import pytest

import r2p
from r2p.codecs import management
from r2p.msg import Led
from r2p.runtime.events import LinkNotice
from r2p.testing.network import node_in
from r2p.transports.line import Carrier, LineLink
from r2p.transports.link import Hub, Transport
from tests.bridge.test_bridge import Tap, drain, gateway, node
from tests.bridge.world import Numbered, TestNetwork
from tests.transports.cables import LineCable
from tests.transports.conversation import manage

if TYPE_CHECKING:
    from collections.abc import Callable

    from r2p.runtime.topic import Topic

pytestmark = pytest.mark.virtual_time

STABLE = 2.0


class Long(r2p.Message):
    """More than every link carries."""

    text: Annotated[str, r2p.Len(200)] = ""


class Lab:
    """Networks by letter, with or without origins of messages; gateways between them and nodes on them."""

    def __init__(self, *, anonymous: bool) -> None:
        self.anonymous = anonymous
        self.networks: dict[str, TestNetwork] = {}
        self.stack = AsyncExitStack()

    async def module(self, name: str, networks: str, *, bridge: bool = False) -> r2p.Module:
        made = [self.networks.setdefault(each, TestNetwork(anonymous=self.anonymous)) for each in networks]
        via = [network.transport(name) for name, network in zip(networks, made, strict=True)]
        return await self.stack.enter_async_context(r2p.Module(name, via=via, bridge=bridge))

    async def node(self, name: str, networks: str) -> r2p.Node:
        return await self.stack.enter_async_context(node_in(await self.module(name, networks)))


@pytest.mark.parametrize("anonymous", [False, True])
@pytest.mark.parametrize(
    ("gateways", "links"),
    [
        ((), "AB"),
        ((), "AA"),
        (("AB",), "AB"),
        (("AB", "AB"), "AB"),
        (("AC", "CB"), "AB"),
        (("AC", "BD"), "AB"),
        (("AC", "CD"), "AAD"),
    ],
    ids=str,
)
async def test_everybody_gets_it_once_and_so_does_the_module(
    gateways: tuple[str, ...], links: str, *, anonymous: bool
) -> None:
    lab = Lab(anonymous=anonymous)
    async with lab.stack:
        for number, networks in enumerate(gateways):
            await lab.module(f"G{number}", networks, bridge=True)
        module = await lab.node("M", links)
        others = [await lab.node(f"P{each}", each) for each in sorted({*links, *"".join(gateways)})]
        theirs = [other.subscribe("down", Numbered, queue=9) for other in others]
        ours = module.subscribe("up", Numbered, queue=9)
        speaks, answers = module.advertise("down", Numbered), [other.advertise("up", Numbered) for other in others]
        await asyncio.sleep(STABLE)
        speaks.publish_nowait(Numbered(number=1))
        for each in answers:
            each.publish_nowait(Numbered(number=2))
        await asyncio.sleep(0.1)
        assert [len(each.queue) for each in theirs] == [1] * len(others)
        assert len(ours.queue) == len(others)


async def test_the_log_says_which_link_stands_by_and_why(caplog: pytest.LogCaptureFixture) -> None:
    async with r2p.Module("M", via=["memory:a", "memory:b"]) as module:
        events = module.events()
        first, second = module.links
        await asyncio.sleep(STABLE)
        async with gateway():
            await asyncio.sleep(STABLE)
            assert first.stands_by == ""
            assert second.stands_by == "stands by: gateway GW joins its network to that of memory:a"
        await asyncio.sleep(STABLE)
        assert second.stands_by == ""
    notices = [(event.link, event.kind) async for event in events if isinstance(event, LinkNotice)]
    assert notices == [("memory:b", "stands by"), ("memory:b", "used")]
    assert "two modules carry the name" not in caplog.text
    assert "returns this module's own messages" not in caplog.text


async def test_two_links_to_one_network_are_reported(caplog: pytest.LogCaptureFixture) -> None:
    async with r2p.Module("M", via=["memory:a", "memory:a"]) as module:
        for _ in range(20):
            await asyncio.sleep(1)
            assert [link.stands_by for link in module.links] == [
                "",
                "stands by: it leads to the same network as memory:a",
            ]
    assert "two modules carry the name" not in caplog.text
    assert "returns this module's own messages" not in caplog.text


@pytest.mark.parametrize("seed", [1, 2])
async def test_two_lines_to_one_module(seed: int) -> None:
    """Either end may be the one that gives one of them up, and each has another one for its first."""
    loop: Any = asyncio.get_running_loop()
    loop.random.seed(seed)
    one, other = LineCable(), LineCable()
    async with (
        one,
        other,
        r2p.Module("M", via=[one.a(), other.a()]) as m,
        r2p.Module("S", via=[other.b(), one.b()]) as s,
        node_in(m) as here,
        node_in(s) as there,
    ):
        ups, downs = here.advertise("up", Led), there.advertise("down", Led)
        got = there.subscribe("up", Led), here.subscribe("down", Led)
        for number in range(100):
            ups.publish_nowait(Led(led=number))
            downs.publish_nowait(Led(led=number))
            await asyncio.sleep(0.01)
            for each in got:
                values = drain(each)
                assert values in ([], [number])
                assert values or number < 90
        assert (m.instance < s.instance) == (seed == 1)
        assert [bool(link.stands_by) for link in m.links] == [False, seed == 1]
        assert [bool(link.stands_by) for link in s.links] == [False, seed == 2]


async def test_a_gateway_of_firmware_that_passes_alive_on_is_found() -> None:
    """It gives everything to the other network; so what comes in there is ours."""
    async with r2p.Module("M", via=["memory:a", "memory:b"]) as module:
        await asyncio.sleep(STABLE)
        a, b = Tap("a"), Tap("b")
        for _ in range(100):
            await asyncio.sleep(0.1)
            for here, there in ((a, b), (b, a)):
                heard, here.heard = here.heard, []
                for message in heard:
                    if isinstance(message, management.Alive):
                        there.say(message)
                there.heard.clear()
        assert module.links[1].stands_by == "stands by: gateways join its network to that of memory:a"


async def test_nodes_are_seen_where_the_link_stands_by() -> None:
    """By what the gateway says; and what is published and subscribed there has one name, once."""
    async with gateway(), r2p.Module("M", via=["memory:a", "memory:b"]) as module, node_in(module) as one:
        one.advertise("leds", Led)
        async with r2p.Module("B", via="memory:b") as b:
            await asyncio.sleep(STABLE)
            assert [(each.module, each.node) for each in b.network.topics()["leds"].publishers] == [("M", "test")]


async def test_what_the_first_link_can_t_carry_takes_the_next_one(monkeypatch: pytest.MonkeyPatch) -> None:
    async with (
        gateway() as gw,
        r2p.Module("M", via=["memory:a", "memory:b"]) as module,
        node_in(module) as one,
        node("B", "b") as b,
    ):
        for each in (gw, module):
            monkeypatch.setattr(each.links[0], "max_payload", 100)
        texts, leds, answers = one.advertise("texts", Long), one.advertise("leds", Led), one.subscribe("answers", None)
        far = b.subscribe("texts", Long), b.subscribe("leds", Led)
        more = b.advertise("answers", Long)
        await asyncio.sleep(STABLE)
        assert module.links[1].stands_by
        texts.publish_nowait(Long(text="far"))
        leds.publish_nowait(Led(led=7))
        more.publish_nowait(Long(text="near"))
        await asyncio.sleep(0.1)
        assert [[sample.hops for sample in each.queue] for each in far] == [[0], [1]]
        assert [sample.source.link for sample in answers.queue] == ["memory:b"]


async def test_a_module_that_was_stopped_does_not_go_on_with_both_links() -> None:
    """Neither with what it publishes nor with what came in meanwhile, though no timer has gone off yet."""
    async with (
        gateway(name="G1", networks="ac"),
        gateway(name="G2", networks="bd"),
        r2p.Module("M", via=["memory:a", "memory:b"]) as module,
        node_in(module) as one,
        node("A", "a") as a,
        node("B", "b") as b,
    ):
        leds, ups = one.advertise("leds", Led), one.subscribe("ups", Led)
        near, far = a.subscribe("leds", Led), b.subscribe("leds", Led)
        up = b.advertise("ups", Led)
        await asyncio.sleep(STABLE)
        leds.publish_nowait(Led(led=1))
        await asyncio.sleep(0.1)
        assert (drain(near), drain(far)) == ([1], [1])
        clock: Any = module.space.clock
        up.publish_nowait(Led(led=3))
        clock.elapsed += 5_000_000_000
        leds.publish_nowait(Led(led=2))
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        assert (drain(near), drain(far)) == ([2], [])
        assert drain(ups) == []


class Words(r2p.Message):
    text: Annotated[str, r2p.Max(200)] = ""


@pytest.mark.parametrize(("limits", "hops"), [((100, 1000), 0), ((100, 100), 1), ((60, 100), 0), ((1000, 100), 1)])
async def test_messages_of_variable_length_take_the_link_that_carries_the_longest_or_longer_ones_than_the_others(
    monkeypatch: pytest.MonkeyPatch, limits: tuple[int, int], hops: int
) -> None:
    async with (
        gateway(),
        r2p.Module("M", via=["memory:a", "memory:b"]) as module,
        node_in(module) as one,
        node("B", "b") as b,
    ):
        for link, limit in zip(module.links, limits, strict=True):
            monkeypatch.setattr(link, "max_payload", limit)
        words, answers = one.advertise("words", Words), one.subscribe("answers", Words)
        far, more = b.subscribe("words", Words), b.advertise("answers", Words)
        await asyncio.sleep(STABLE)
        words.publish_nowait(Words(text="far"))
        more.publish_nowait(Words(text="near"))
        await asyncio.sleep(0.1)
        assert [sample.hops for sample in far.queue] == [hops]
        assert [sample.hops for sample in answers.queue] == [hops]


async def test_a_bus_that_comes_first_keeps_its_slots() -> None:
    """The other network gets what is periodic there by the gateway, once."""
    async with (
        r2p.Module("GW", via=["sim:bus,slots=20,cycle=20ms,priority=1", "memory:b"], bridge=True),
        r2p.Module("M", via=["sim:bus,slots=20,cycle=20ms", "memory:b"]) as module,
        node_in(module) as one,
        r2p.Module("IMU1", via="sim:bus,slots=20,cycle=20ms") as imu,
        node_in(imu) as there,
        node("B", "b") as b,
    ):
        values = iter(range(10**6))
        near, far = there.subscribe("leds", Led, queue=10**4), b.subscribe("leds", Led, queue=10**4)
        one.advertise("leds", Led, r2p.Periodic(0.02, lambda: Led(led=next(values))))
        await asyncio.sleep(8)
        assert module.links[1].stands_by
        assert {sample.publisher_class for sample in list(near.queue)[-100:]} == {r2p.PublisherClass.PERIODIC}
        late = drain(far)[-200:]
        assert late == list(range(late[0], late[0] + 200))
        assert drain(near)[-200:] == late


class Clients(Transport):
    """So many lines, one after the other, each to another module; each change of a topic that one announces counts."""

    def __init__(self, count: int) -> None:
        self.count = count
        self.announced: Counter[str] = Counter()

    async def run(self, hub: Hub, opened: Callable[[], object]) -> None:
        links = [Counting(self, hub, f"client{n}") for n in range(self.count)]
        opened()
        try:
            for number, link in enumerate(links):
                hub.attach(link)
                link.connect(Nowhere())
                await asyncio.sleep(0.01)
                link.feed(manage(management.Hello(f"C{number}", 1000 + number, 0, 0, 60_000)))
            await asyncio.get_running_loop().create_future()
        finally:
            for link in links:
                link.close()
                hub.detach(link)


class Counting(LineLink):
    def __init__(self, clients: Clients, hub: Hub, name: str) -> None:
        super().__init__(name, hub)
        self.clients = clients

    def topic_changed(self, topic: Topic) -> None:
        self.clients.announced[topic.name] += 1
        super().topic_changed(topic)


class Nowhere(Carrier):
    """Takes all."""

    def send(self, data: bytes) -> None:
        pass

    def pause(self) -> None:
        pass

    def resume(self) -> None:
        pass

    def close(self) -> None:
        pass


async def test_a_client_more_costs_as_much_as_the_first_one() -> None:
    clients = Clients(100)
    async with r2p.Module("PC1", via=clients) as module, node_in(module) as sender:
        sender.advertise("leds", Led)
        await asyncio.sleep(2)
        assert sum("C" in name for link in module.links for name in link.discovery.modules) == 100
        assert clients.announced["leds"] <= 2 * 100 + 2
