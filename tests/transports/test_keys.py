"""Links with a shared key: who is believed on each of them, and what those learn who are not."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import r2p
from r2p import keys
from r2p.codecs import debug, management
from r2p.codecs.debug import Reader
from r2p.keys import SharedKey
from r2p.msg import Led
from r2p.protocols.keys import PROOF_VALID, LinkEnd
from r2p.sim import run
from r2p.testing.network import node_in
from r2p.transports.memory import Datagram, MemoryNetwork, MemoryTransport, network
from r2p.transports.tcp import TcpListenTransport
from r2p.transports.url import parse
from r2p.units import SECOND
from tests.transports.cables import GUARD, LineEnd
from tests.transports.conversation import manage
from tests.transports.zenoh.cable import Net, guarded, module

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable
    from pathlib import Path

    from r2p.runtime.events import ModuleEvent
    from r2p.transports.line import LineLink

SOON = 0.05
"""Seconds in which a keyed order is obeyed, its challenge included."""
BUSES = pytest.mark.parametrize("bus", ["memory:lab", "sim:lab"])


@pytest.fixture
def key(tmp_path: Path) -> str:
    return new_key(tmp_path / "robot.key")


@pytest.fixture
def other_key(tmp_path: Path) -> str:
    return new_key(tmp_path / "other.key")


async def until(condition: Callable[[], object]) -> None:
    async with asyncio.timeout(GUARD):
        while not condition():  # noqa: ASYNC110 - there is no event
            await asyncio.sleep(0.001)


def new_key(path: Path) -> str:
    keys.create(path)
    return f"?key={path}"


async def notice(events: AsyncIterator[ModuleEvent], kind: str) -> str:
    async with asyncio.timeout(GUARD):
        async for event in events:
            if isinstance(event, r2p.LinkNotice) and event.kind == kind:
                return event.text
    raise AssertionError("the module is closed")


async def refused(bot: r2p.Module, pc: r2p.Module) -> str:
    """What PC learns of an order that BOT does not obey."""
    events = pc.events()
    pc.command(r2p.Command.STOP, "BOT")
    async with asyncio.timeout(SOON):
        text = await notice(events, "STOP denied")
    assert not bot.stopped
    return text


# Buses and networks


@pytest.mark.virtual_time
@BUSES
async def test_an_order_with_the_key_is_obeyed_at_once_and_once(bus: str, key: str) -> None:
    async with r2p.Module("BOT", via=bus + key) as bot, r2p.Module("PC", via=bus + key) as pc:
        await asyncio.sleep(5)
        for _ in range(2):
            pc.command(r2p.Command.BOOTLOAD, "BOT")
        await asyncio.sleep(SOON)
        assert bot.refused == {"BOOTLOAD": 2}
        assert not bot.links[0].losses


@pytest.mark.virtual_time
@BUSES
async def test_an_order_without_the_key_is_refused_and_its_sender_learns_why(
    bus: str, key: str, other_key: str, caplog: pytest.LogCaptureFixture
) -> None:
    async with (
        r2p.Module("BOT", via=bus + key) as bot,
        r2p.Module("PC", via=bus) as pc,
        r2p.Module("PC2", via=bus + other_key) as pc2,
    ):
        await asyncio.sleep(5)
        text = await refused(bot, pc)
        assert text == "BOT refuses STOP: the order lacks the key of the link: add ?key=FILE to the URL"
        await asyncio.sleep(1)
        text = await refused(bot, pc2)
        assert text == "BOT refuses STOP: the link has another key than this URL: give both ends copies of one file"
        losses = bot.links[0].losses
        assert losses["without key"] == losses["other key"] == 1
    lines = [each.message for each in caplog.records if "STOP refused" in each.message]
    assert lines == [f"link {bus}: STOP refused: the sender lacks the link's key (?key= of its URL)"]


@pytest.mark.virtual_time
@BUSES
async def test_data_flows_with_modules_that_have_no_key_and_these_obey_those_that_have_one(bus: str, key: str) -> None:
    async with (
        r2p.Module("BOT", via=bus + key) as bot,
        r2p.Module("OLD", via=bus) as old,
        node_in(bot) as bob,
        node_in(old) as olga,
    ):
        publisher, subscriber = olga.advertise("leds", Led), bob.subscribe("leds", Led)
        await publisher.wait_subscriber()
        await publisher.publish(Led(led=3))
        assert await subscriber.fetch() == Led(led=3)
        bot.command(r2p.Command.STOP, "OLD")
        await until(lambda: old.stopped)


@pytest.mark.virtual_time
async def test_orders_among_firmware_of_2014_where_all_modules_share_one_id(key: str) -> None:
    bus = "sim:lab,profile=firmware-2014"
    async with (
        r2p.Module("BOT", via=bus + key) as bot,
        r2p.Module("PC", via=bus) as pc,
        r2p.Module("PC2", via=bus + key) as holder,
    ):
        await asyncio.sleep(10)
        events = pc.events()
        pc.command(r2p.Command.STOP, "BOT")
        assert "BOT refuses STOP" in await notice(events, "STOP denied")
        holder.command(r2p.Command.STOP, "BOT")
        async with asyncio.timeout(1):
            await until(lambda: bot.stopped)


def record(lab: MemoryNetwork) -> list[Datagram]:
    """All that is sent from now on, until it is sent again."""
    heard: list[Datagram] = []
    send = lab.send

    def recording(datagram: Datagram) -> None:
        if datagram.topic == b"R2P":
            heard.append(datagram)
        send(datagram)

    lab.send = recording  # type: ignore[method-assign]
    return heard


@pytest.mark.virtual_time
async def test_a_recorded_order_is_not_obeyed_again_whoever_is_restarted(key: str) -> None:
    via, lab = "memory:lab" + key, network("lab")
    async with r2p.Module("PC", via=via) as pc:
        async with r2p.Module("BOT", via=via) as bot:
            heard = record(lab)
            await asyncio.sleep(1)
            pc.command(r2p.Command.STOP, "BOT")
            await until(lambda: bot.stopped)
            await bot.reboot()
            recorded = list(heard)
            for each in recorded:
                lab.send(each)
            await asyncio.sleep(1)
            assert not bot.stopped
            assert bot.links[0].losses["recorded"]
        async with r2p.Module("BOT", via=via) as bot:
            await asyncio.sleep(1)
            for each in recorded:
                lab.send(each)
            await asyncio.sleep(1)
            assert not bot.stopped
    async with r2p.Module("BOT", via=via) as bot:
        await asyncio.sleep(1)
        for each in recorded:
            lab.send(each)
        await asyncio.sleep(1)
        assert not bot.stopped


@pytest.mark.virtual_time
async def test_an_order_that_is_held_back_does_not_count_for_ever(key: str) -> None:
    via, lab = "memory:lab" + key, network("lab")
    async with r2p.Module("PC", via=via) as pc, r2p.Module("BOT", via=via) as bot:
        await asyncio.sleep(1)
        pc.command(r2p.Command.BOOTLOAD, "BOT")
        await until(lambda: bot.refused)
        heard = record(lab)
        lab.loss = 1.0
        pc.command(r2p.Command.STOP, "BOT")
        held = list(heard)
        await asyncio.sleep(PROOF_VALID / SECOND)
        lab.loss = 0.0
        for each in held * 2:  # the first time, the session is challenged anew
            lab.send(each)
            await asyncio.sleep(0.1)
        assert not bot.stopped


# Gateways


@pytest.mark.virtual_time
async def test_gateways_pass_orders_on_under_the_key_of_the_next_link(key: str, other_key: str) -> None:
    gateway = r2p.Module("GW", via=["memory:a" + key, "memory:b" + other_key], bridge=True)
    async with (
        gateway,
        r2p.Module("BOT", via="memory:b" + other_key) as bot,
        r2p.Module("OLD", via="memory:b") as old,
        r2p.Module("PC", via="memory:a" + key) as pc,
    ):
        await asyncio.sleep(5)
        for each in (bot, old):
            pc.command(r2p.Command.STOP, each.name)
        async with asyncio.timeout(SOON):
            await until(lambda: bot.stopped and old.stopped)


@pytest.mark.virtual_time
async def test_a_gateway_lends_its_key_to_nobody(key: str) -> None:
    gateway = r2p.Module("GW", via=["memory:a", "memory:b" + key], bridge=True)
    async with gateway, r2p.Module("BOT", via="memory:b" + key) as bot, r2p.Module("PC", via="memory:a") as pc:
        await asyncio.sleep(5)
        text = await refused(bot, pc)
        why = "the link there has a key, and the order came by one without: give that one a key, too"
        assert text == f"gateway GW does not let STOP of BOT through: {why}"


@pytest.mark.virtual_time
async def test_an_order_for_a_module_behind_a_gateway_is_refused_by_the_gateway(key: str) -> None:
    gateway = r2p.Module("GW", via=["memory:a" + key, "memory:b"], bridge=True)
    async with gateway as gw, r2p.Module("BOT", via="memory:b") as bot, r2p.Module("PC", via="memory:a") as pc:
        await asyncio.sleep(5)
        assert "does not let STOP of BOT through: the order lacks the key" in await refused(bot, pc)
        assert gw.links[0].losses["without key"] == 1
        await asyncio.sleep(1)
        events = pc.events()
        pc.command(r2p.Command.STOP, "GW")
        async with asyncio.timeout(SOON):
            assert "GW refuses STOP" in await notice(events, "STOP denied")
        assert not gw.stopped


@pytest.mark.virtual_time
async def test_a_gateway_without_the_key_does_not_take_part(key: str, caplog: pytest.LogCaptureFixture) -> None:
    pair = [r2p.Module(name, via=["memory:a" + key, "memory:b" + key], bridge=True) for name in ("GW1", "GW2")]
    stranger = r2p.Module("GW3", via=["memory:a", "memory:b"], bridge=True)
    async with pair[0] as one, pair[1] as two, stranger as three:
        await asyncio.sleep(5)
        states = [{port.state for port in each.gateway_statistics().ports} for each in (one, two, three)]
        assert {"forwarding"} in states[:2]
        assert {"forwarding", "blocked"} in states[:2]
        assert states[2] == {"converging"}
        assert {port.gateways for port in one.gateway_statistics().ports} == {1}
    assert "link memory:a: messages of gateways are ignored: the sender lacks the link's key" in caplog.text


@pytest.mark.virtual_time
async def test_gateways_agree_where_seals_are_lost_doubled_and_overtaken(key: str) -> None:
    for name in ("a", "b"):
        vars(network(name)).update(loss=0.1, duplicate=0.3, jitter=0.01)
    via = [f"memory:{name}{key}" for name in ("a", "b")]
    async with r2p.Module("GW1", via=via, bridge=True) as one, r2p.Module("GW2", via=via, bridge=True) as two:
        await asyncio.sleep(3)
        for _ in range(20):
            await asyncio.sleep(0.1)
            states = sorted(port.state for each in (one, two) for port in each.gateway_statistics().ports)
            assert states == ["blocked", "forwarding", "forwarding", "forwarding"]


# Lines


class KeyedEnd(LineEnd):
    """One end of a line, with a key."""

    def __init__(self, arrived: object, key: SharedKey | None, end: LinkEnd = LinkEnd.SERIAL) -> None:
        super().__init__(arrived)  # type: ignore[arg-type]
        self._key = key
        self._end = end

    def prepare(self, link: LineLink) -> None:
        link.use_key(self._key, self._end)


def line(*given: SharedKey | None) -> tuple[KeyedEnd, KeyedEnd]:
    """A line whose ends have these keys."""
    ends: list[KeyedEnd] = []

    def carry(data: bytes, to: int) -> None:
        asyncio.get_running_loop().call_soon(ends[to].arrive, data)

    ends += [KeyedEnd(lambda data, to=1 - at: carry(data, to), each) for at, each in enumerate(given)]
    return ends[0], ends[1]


KEY, OTHER = SharedKey(bytes(32)), SharedKey(bytes(range(32)))


@pytest.mark.virtual_time
async def test_a_line_comes_up_when_both_ends_have_proven_the_key() -> None:
    a, b = line(KEY, KEY)
    async with r2p.Module("A", via=a) as alice, r2p.Module("B", via=b) as bob:
        async with asyncio.timeout(0.5):
            await until(lambda: alice.links[0].up and bob.links[0].up)
        alice.command(r2p.Command.STOP, "B")
        await until(lambda: bob.stopped)
        assert not alice.links[0].losses
        assert not bob.links[0].losses


@pytest.mark.virtual_time
@pytest.mark.parametrize(
    ("given", "texts"),
    [
        ((KEY, None), ("the other end has no key", "the other end wants a key")),
        ((KEY, OTHER), ("the other end has another key", "the other end has another key")),
    ],
)
async def test_both_ends_of_a_line_learn_within_a_second_why_it_stays_down(
    given: tuple[SharedKey, SharedKey | None], texts: tuple[str, str]
) -> None:
    a, b = line(*given)
    async with r2p.Module("A", via=a) as alice, r2p.Module("B", via=b) as bob:
        heard = [alice.events(), bob.events()]
        async with asyncio.timeout(0.9), node_in(bob) as node:
            node.advertise("leds", Led)
            for events, text in zip(heard, texts, strict=True):
                assert text in await notice(events, "key refused")
        assert not alice.links[0].up
        assert not alice.network.topics()["leds"].published_on if "leds" in alice.network.topics() else True


@pytest.mark.virtual_time
async def test_an_echo_of_a_line_proves_nothing() -> None:
    end: KeyedEnd
    end = KeyedEnd(lambda data: asyncio.get_running_loop().call_soon(end.arrive, data), KEY)
    async with r2p.Module("A", via=end) as alice:
        events = alice.events()
        assert "does not answer the challenge" in await notice(events, "key refused")
        assert not alice.links[0].up


# zenoh


@pytest.mark.anyio
@guarded
async def test_orders_over_zenoh(tmp_path: Path) -> None:
    key, net = new_key(tmp_path / "robot.key").replace("?", "&"), Net()
    async with (
        module("BOT", net.listen + key) as bot,
        module("PC", net.join) as pc,
        module("PC2", net.join + key) as holder,
    ):
        await until(lambda: all(sees_bot(each) for each in (pc, holder)))
        events = pc.events()
        pc.command(r2p.Command.STOP, "BOT")
        assert "BOT refuses STOP" in await notice(events, "STOP denied")
        assert not bot.stopped
        holder.command(r2p.Command.STOP, "BOT")
        await until(lambda: bot.stopped)


def sees_bot(module: r2p.Module) -> bool:
    return any(view.name == "BOT" and view.link for view in module.network.modules())


# TCP


@pytest.mark.anyio
async def test_a_server_serves_clients_with_its_key_and_tells_all_others_why_not(key: str, other_key: str) -> None:
    server = TcpListenTransport(parse("tcp-listen:127.0.0.1:0" + key))
    async with r2p.Module("BOT", via=server, watchdog=False) as bot:
        url = f"tcp:127.0.0.1:{server.port}"
        async with r2p.Module("PC", via=url + key, watchdog=False) as pc:
            await until(lambda: sees_bot(pc))
            pc.command(r2p.Command.STOP, "BOT")
            await until(lambda: bot.stopped)
        for options, text in (("", "the other end wants a key"), (other_key, "the other end has another key")):
            async with r2p.Module("PC", via=url + options, watchdog=False) as pc:
                await until(lambda: pc.links[0].key_refused)
                assert text in pc.links[0].unreachable_reason
                assert not sees_bot(pc)
        assert bot.closed_links.faults["connection refused"] >= 2


@pytest.mark.anyio
async def test_a_client_does_not_believe_a_server_without_its_key(key: str) -> None:
    server = TcpListenTransport(parse("tcp-listen:127.0.0.1:0"))
    via = "tcp:127.0.0.1:{}" + key
    async with (
        r2p.Module("BOT", via=server, watchdog=False),
        r2p.Module("PC", via=via.format(server.port), watchdog=False) as pc,
    ):
        await until(lambda: pc.links[0].key_refused)
        assert "the other end has no key" in pc.links[0].unreachable_reason
        assert not pc.links[0].up


@pytest.mark.anyio
async def test_the_proof_of_one_connection_opens_no_other_one(key: str) -> None:
    """A stranger has the server itself answer its challenge, on a second connection."""
    server = TcpListenTransport(parse("tcp-listen:127.0.0.1:0" + key))
    async with asyncio.timeout(GUARD), r2p.Module("BOT", via=server, watchdog=False):
        one, to_one = await asyncio.open_connection("127.0.0.1", server.port)
        two, to_two = await asyncio.open_connection("127.0.0.1", server.port)
        to_two.write(await line_with(one, management.Challenge))
        to_one.write(await line_with(two, management.Proof))
        denied = await line_with(one, management.Denied)
        assert management.decode(payload(denied)) == management.Denied("BOT", "BOT", 0, management.DENIED_OTHER_KEY)
        assert not await one.read()
        to_two.write(manage(management.Stop("BOT")))
        denied = await line_with(two, management.Denied)
        assert management.decode(payload(denied)) == management.Denied("BOT", "BOT", 0, management.DENIED_NO_KEY)
        for each in (to_one, to_two):
            each.close()
            await each.wait_closed()


async def line_with(reader: asyncio.StreamReader, kind: type) -> bytes:
    """The next line with such a message."""
    while True:
        heard = await reader.readline()
        assert heard
        if heard.startswith(b"@") and isinstance(management.decode(payload(heard)), kind):
            return heard


def payload(line: bytes) -> bytes:
    (read,) = Reader().feed(line)
    return read.data


# Strangers

STRANGE = st.one_of(
    st.binary(min_size=32, max_size=32),
    st.builds(
        lambda body, kind: b"\1" + body + bytes((kind,)),
        st.binary(min_size=30, max_size=30),
        st.sampled_from([*management.ManagementType]),
    ),
    st.sampled_from([management.encode(management.Stop("A")), management.encode(management.Hello("B", 7))]),
)


@settings(max_examples=30, deadline=None)
@given(st.lists(STRANGE, max_size=30))
def test_whatever_a_stranger_says_a_line_stays_closed_and_a_bus_obeys_nothing(messages: list[bytes]) -> None:
    async def scenario() -> None:
        lab, (a, _) = MemoryNetwork(), line(KEY, KEY)
        async with r2p.Module("A", via=[a, MemoryTransport("lab", lab, None, KEY)]) as alice:
            for data in messages:
                a.arrive(debug.encode(b"R2P", data, 0))
                lab.send(Datagram(99, b"R2P", data))
                await asyncio.sleep(0.05)
            assert not alice.links[0].up
            assert not alice.stopped | alice.rebooted | bool(alice.refused)

    run(scenario)
