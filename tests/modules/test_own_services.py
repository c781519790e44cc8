"""What modules ask each other without any topic of their own: on lossy networks, of strangers, with hostile peers."""

from __future__ import annotations

import asyncio
import random
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import pytest

import r2p
from r2p.codecs import call_parts, debug, management, own_services
from r2p.codecs.own_services import Operation, OwnCall
from r2p.codecs.services import Kind, ServiceHeader
from r2p.errors import ServiceError
from r2p.keys import SharedKey
from r2p.msg import Led
from r2p.sim.modules import FirmwareModule, Publishes
from r2p.testing.network import node_in
from r2p.transports.memory import Datagram, MemoryNetwork
from tests.sim.modules.test_firmware import Line
from tests.transports.rtcan.firmware import Firmware
from tests.transports.rtcan.networks import Lab, until
from tests.transports.test_keys import KeyedEnd

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from r2p.modules.own_services import OwnServices

pytestmark = pytest.mark.virtual_time


class Wide(r2p.Message, name="lab_msgs/Wide"):
    """A type of several pages that only one module has."""

    values: tuple[r2p.f64, r2p.f64] = (0.0, 0.0)
    a_name_that_is_quite_long_for_a_field_of_a_message: r2p.u32 = 0
    another_name_that_is_quite_long_for_a_field_of_a_message: r2p.u32 = 0
    one_more_name_that_is_quite_long_for_a_field_of_a_message: r2p.u32 = 0


WIDE = r2p.layout(Wide)


class Stranger:
    """A peer that sends what the test asks for, and keeps what others send."""

    def __init__(self, network: MemoryNetwork) -> None:
        self.heard: list[Datagram] = []
        self._network = network
        self._port = network.new_address()
        self._inner = MemoryNetwork.send
        network.send = self._send  # type: ignore[method-assign]

    def _send(self, datagram: Datagram) -> None:
        self.heard.append(datagram)
        self._inner(self._network, datagram)

    def say(self, topic: str, data: bytes) -> None:
        self._inner(self._network, Datagram(self._port, topic.encode(), data))

    def manage(self, *messages: management.Management) -> None:
        for message in messages:
            self.say("R2P", management.encode(message))

    def calls(self) -> list[OwnCall]:
        return [own_services.decode(each.data) for each in self.heard if each.topic in (b"R2P_CALL", b"R2P_REPLY")]


def services(module: r2p.Module) -> OwnServices:
    return module._opened.own_services


@asynccontextmanager
async def two(network: MemoryNetwork) -> AsyncIterator[tuple[r2p.Module, r2p.Module]]:
    """A module with a topic that only it knows the type of, and another one that has heard of it."""
    async with r2p.Module("A", via=network.transport()) as a, node_in(a) as node:
        node.advertise("wide", Wide)
        async with r2p.Module("B", via=network.transport()) as b:
            await until(lambda: knows_wide(b))
            yield a, b


def knows_wide(module: r2p.Module) -> bool:
    """Whether it knows who publishes the topic, and what it needs to ask for its type."""
    view = module.network.topics().get("wide")
    versions = {each.name: each.wire for each in module.network.modules()}
    return view is not None and view.fingerprint is not None and any(versions.get(e.module) for e in view.publishers)


async def test_a_lossy_network_repeats_and_answers_are_the_same() -> None:
    network = MemoryNetwork(loss=0.2, duplicate=0.3, reorder=0.3, delay=0.002, seed=1)
    stranger = Stranger(network)
    async with two(network) as (_, b):
        for _ in range(10):
            found = await b.network.message_type(WIDE.fingerprint)
            assert found is not None
            assert r2p.layout(found).schema == WIDE.schema
        answers: dict[int, set[bytes]] = {}
        for call in stranger.calls():
            if not call.is_request:
                answers.setdefault(call.header.number, set()).add(call.body)
        assert len(answers) >= 10
        assert {len(each) for each in answers.values()} == {1}
        assert not any(b"R2P_" in each.data for each in stranger.heard if each.topic == b"R2P")


async def test_programs_cannot_use_the_names() -> None:
    async with r2p.Module("A") as a, node_in(a) as node:
        for name in ("R2P_CALL", "/R2P_REPLY"):
            with pytest.raises(r2p.InvalidName, match="is reserved for messages of r2p"):
                node.advertise(name, Led)


async def test_modules_of_before_are_not_asked() -> None:
    network = MemoryNetwork()
    stranger = Stranger(network)
    async with r2p.Module("B", via=network.transport()) as b:
        stranger.manage(
            management.Hello("OLD", 7, wire=1, release="0.1.0"),
            management.TypeInfo(management.ROLE_PUBLISHES, "wide", WIDE.fingerprint, WIDE.size),
            management.Advertise("wide", WIDE.size),
            management.Endpoint(management.ROLE_PUBLISHES, 7, "node", "wide", management.CLASS_NRT),
        )
        await until(lambda: b.network.topics().get("wide"))
        assert await b.network.message_type(WIDE.fingerprint) is None
        assert not stranger.calls()


async def test_a_gateway_of_before_passes_nothing_on_so_nothing_is_asked_through_it() -> None:
    network = MemoryNetwork()
    stranger = Stranger(network)
    async with r2p.Module("B", via=network.transport()) as b:
        stranger.manage(
            management.Hello("OLDGW", 6, management.HELLO_GATEWAY, wire=1),
            management.Hello("NEW", 7, hops=1, wire=2),
            management.TypeInfo(management.ROLE_PUBLISHES, "wide", WIDE.fingerprint, WIDE.size),
            management.Advertise("wide", WIDE.size),
        )
        await until(lambda: b.network.topics().get("wide"))
        assert await b.network.message_type(WIDE.fingerprint) is None
        assert not stranger.calls()
        stranger.manage(management.Hello("NEWGW", 8, management.HELLO_GATEWAY, wire=2))
        await until(lambda: any(view.name == "NEWGW" for view in b.network.modules()))
        assert await b.network.message_type(WIDE.fingerprint) is None
        assert {call.target for call in stranger.calls()} == {7, 8}


async def test_a_silent_module_a_lie_and_an_error() -> None:
    network = MemoryNetwork()
    stranger = Stranger(network)
    async with r2p.Module("B", via=network.transport()) as b:
        stranger.manage(
            management.Hello("EVE", 7, wire=2),
            management.TypeInfo(management.ROLE_PUBLISHES, "wide", WIDE.fingerprint, WIDE.size),
            management.Advertise("wide", WIDE.size),
        )
        await until(lambda: b.network.topics().get("wide"))
        loop = asyncio.get_running_loop()
        started = loop.time()
        assert await b.network.message_type(WIDE.fingerprint) is None
        assert loop.time() - started < 1.6
        asked = stranger.calls()
        assert len(asked) == 6, "it is repeated, more and more seldom"
        assert len({call.header.number for call in asked}) == 1

        async def answer(kind: Kind, body: bytes, pages: int = 1) -> None:
            stranger.heard.clear()
            task = asyncio.create_task(services(b).fetch(7, Operation.SCHEMA, WIDE.fingerprint))
            await until(stranger.calls)
            header = ServiceHeader(b.instance, stranger.calls()[0].header.number, kind, 7)
            stranger.say("R2P_REPLY", own_services.encode(OwnCall(header, Operation.SCHEMA, 0, pages, 1, body)))
            assert await task == body

        await answer(Kind.RESPONSE, b"anything")
        with pytest.raises(ServiceError, match="no such thing"):
            await answer(Kind.ERROR, b"no such thing")
        with pytest.raises(ServiceError, match="65535 pages, more than 1024"):
            await answer(Kind.RESPONSE, b"", pages=65535)


async def test_an_unknown_operation_and_an_unknown_type() -> None:
    async with two(MemoryNetwork()) as (a, b):
        with pytest.raises(ServiceError, match="no topic of this module has the type"):
            await services(b).fetch(a.instance, Operation.SCHEMA, b"nothing.")
        with pytest.raises(ServiceError, match="operation 99 is unknown to this version of r2p"):
            await services(b).fetch(a.instance, 99)  # type: ignore[arg-type]
        with pytest.raises(TimeoutError):
            await services(b).fetch(a.instance + 1, Operation.SCHEMA, WIDE.fingerprint)


@pytest.fixture(params=[1, 8], ids=["page by page", "many at once"])
def length(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    """Bytes of six answers: of one page each, as on every link, or of as many as a memory network carries."""
    monkeypatch.setattr("r2p.modules.own_services._pages_at_once", lambda _link: request.param)
    return 5 * 180 * int(request.param) + 100


async def test_a_content_that_changes_while_it_is_fetched_comes_from_one_edition(length: int) -> None:
    async with two(MemoryNetwork(delay=0.001)) as (a, b):
        made = 0

        def content(argument: bytes) -> bytes:
            nonlocal made
            made += 1
            return bytes((made,)) * length

        services(a).serve(Operation.STATISTICS, content)
        asyncio.get_running_loop().call_later(0.005, services(a)._contents.clear)  # it had to forget them
        callers = [services(b).fetch(a.instance, Operation.STATISTICS, b"%d" % number) for number in range(20)]
        answers = await asyncio.gather(*callers)
        assert {len(each) for each in answers} == {length}
        assert {len(set(each)) for each in answers} == {1}
        assert 20 < made <= 40


async def test_two_fetches_of_one_content_do_not_disturb_each_other(length: int) -> None:
    async with two(MemoryNetwork(delay=0.001)) as (a, b):
        services(a).serve(Operation.STATISTICS, lambda _argument: bytes(length))

        async def fetch(delay: float) -> bytes:
            await asyncio.sleep(delay)
            return await services(b).fetch(a.instance, Operation.STATISTICS)

        assert await asyncio.gather(*(fetch(0.003 * number) for number in range(10))) == [bytes(length)] * 10


async def test_an_answer_has_as_many_pages_as_the_request_and_the_link_take() -> None:
    network = MemoryNetwork()
    stranger = Stranger(network)
    async with two(network) as (a, b):
        services(a).serve(Operation.STATISTICS, lambda _argument: bytes(10 * 180))
        assert await services(b).fetch(a.instance, Operation.STATISTICS) == bytes(10 * 180)
        asked = [(each.page, each.pages) for each in stranger.calls() if each.is_request]
        assert asked == [(0, 8), (8, 8)]
        answers = [(each.page, each.pages, len(each.body)) for each in stranger.calls() if not each.is_request]
        assert answers == [(0, 10, 8 * 180), (8, 10, 2 * 180)]
        header = ServiceHeader(b.instance, 7, Kind.REQUEST, a.instance)  # of a module of before
        stranger.say("R2P_CALL", own_services.encode(OwnCall(header, Operation.STATISTICS)))
        await asyncio.sleep(0.1)
        assert len(stranger.calls()[-1].body) == 180


async def test_an_empty_answer_is_a_page_so_no_lie_asks_for_ever() -> None:
    network = MemoryNetwork()
    stranger = Stranger(network)
    async with two(network) as (a, b):
        services(a).serve(Operation.STATISTICS, lambda _argument: b"")
        fetching = asyncio.create_task(services(b).fetch(a.instance, Operation.STATISTICS, b"x"))
        await asyncio.sleep(0)
        (call,) = (each for each in stranger.calls() if each.is_request)
        header = ServiceHeader(b.instance, call.header.number, Kind.RESPONSE, a.instance)
        stranger.say("R2P_REPLY", own_services.encode(OwnCall(header, Operation.STATISTICS, 0, 2, 1)))
        assert await fetching == b""  # its second page is not there, so it is fetched anew


@pytest.mark.parametrize("seed", range(5))
async def test_hostile_messages(seed: int) -> None:
    """Nothing of them raises, is kept without a limit, or is answered more often than the limit allows."""
    chance = random.Random(seed)
    network = MemoryNetwork()
    stranger = Stranger(network)
    async with two(network) as (a, b):
        for _ in range(3000):
            call = OwnCall(
                ServiceHeader(
                    chance.choice([0, 7, b.instance]), chance.randrange(65536), chance.choice(list(Kind)), a.instance
                ),
                chance.choice([0, 1, 1, 2, 128, 255]),
                chance.choice([0, 0, 1, 65535]),
                chance.randrange(65536),
                chance.randrange(65536),
                chance.choice([b"", WIDE.fingerprint, chance.randbytes(180)]),
            )
            data = own_services.encode(call)
            if chance.random() < 0.3:
                data = data[: chance.randrange(len(data))] + chance.randbytes(chance.choice([0, 1, 300]))
            if 0 < len(data) <= 200 and chance.random() < 0.3:
                for part in call_parts.encode(chance.randrange(200), chance.randrange(256), data):
                    stranger.say("R2P", part)
            else:
                stranger.say(chance.choice(["R2P_CALL", "R2P_REPLY"]), data)
            if chance.random() < 0.02:
                await asyncio.sleep(0.01)
        await asyncio.sleep(2.0)
        lost = a.links[0].losses
        assert lost["internal error"] == 0
        assert lost["too many calls"] > 0
        assert len(services(a)._contents) <= 64
        assert await b.network.message_type(WIDE.fingerprint) is not None


@pytest.mark.parametrize("given", [None, SharedKey(bytes(32))])
async def test_a_line_with_a_key_answers_nothing_until_it_is_proven(given: SharedKey | None) -> None:
    sent: list[bytes] = []
    end = KeyedEnd(sent.append, given)
    async with r2p.Module("A", via=end) as a, node_in(a) as node:
        node.advertise("wide", Wide)
        header = ServiceHeader(7, 1, Kind.REQUEST, a.instance)
        request = own_services.encode(OwnCall(header, Operation.SCHEMA, body=WIDE.fingerprint))
        end.arrive(debug.encode(b"R2P_CALL", request, 0))
        for part in call_parts.encode(7, 1, request):
            end.arrive(debug.encode(b"R2P", part, 0))
        await asyncio.sleep(1.0)
        assert (b"R2P_REPLY" in b"".join(sent)) == (given is None)


async def test_firmware_on_a_line_ignores_calls() -> None:
    request = own_services.encode(OwnCall(ServiceHeader(1, 2, Kind.REQUEST, 3), Operation.SCHEMA, body=bytes(180)))
    undisturbed, called = emulated(), emulated()
    for at in range(100, 5000, 100):
        undisturbed.until(at)
        called.until(at)
        called.send(debug.encode(b"R2P_CALL", request, 0))
        called.send(debug.encode(b"R2P_REPLY", request, 0))
    assert called.heard == undisturbed.heard
    assert not called.module.fault


async def test_firmware_ignores_parts_of_calls() -> None:
    """They only take time on its line, as all management does."""
    undisturbed, called = emulated(), emulated()
    for at in range(100, 5000, 100):
        undisturbed.until(at)
        called.until(at)
        for part in call_parts.encode(1, at % 256, bytes(200)):
            called.send(debug.encode(b"R2P", part, 0))
    said, expected = called.received(), undisturbed.received()
    assert len(said) >= 9
    assert said == expected[: len(said)]
    assert not called.module.fault


def emulated() -> Line:
    """A module of 2014, which does what was recorded from one."""
    return Line(FirmwareModule("IMU1", publishers=[Publishes("leds", Led, 0.5, lambda _time: Led())]))


async def test_a_bus_with_firmware_carries_calls_and_the_firmware_works_on() -> None:
    """All share one message id there, and each message waits for silence."""
    made = Lab()
    async with Firmware(made.can) as firmware, made.module("PC1") as alice, made.module("PC2") as bob:
        alice.advertise("wide", Wide)
        leds = bob.subscribe("leds", r2p.msg.Led)
        module = made.host("PC2")
        await until(lambda: knows_wide(module))
        heard = len(firmware.received)
        found = await module.network.message_type(WIDE.fingerprint)
        assert found is not None
        assert r2p.layout(found).name == "lab_msgs/Wide"
        for _ in range(5):
            assert (await leds.fetch(timeout=2.0)).led == 2
        known = (management.Alive, management.Advertise, management.SubscribeRequest, management.SubscribeResponse)
        assert len(firmware.received) > heard
        assert any(isinstance(each, known) for each in firmware.received[heard:])
        assert not made.link("PC1").losses
