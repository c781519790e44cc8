"""What only TCP has: addresses, sockets that come and go by the thousand, peers that send anything."""

import asyncio
import gc
import os
import socket
from collections import Counter
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import cast

import pytest

import r2p
from r2p.clock import Backoff
from r2p.codecs import management as m
from r2p.codecs.debug import Reader
from r2p.errors import TransportError
from r2p.msg import Led
from r2p.protocols.discovery.session import Discovery
from r2p.runtime.events import ModuleEvent
from r2p.testing.network import node_in
from r2p.transports import tcp
from r2p.transports.line import LineLink
from r2p.transports.link import Hub, Transport
from r2p.transports.tcp import TcpListenTransport, TcpTransport
from r2p.transports.url import parse
from tests.transports.cables import GUARD
from tests.transports.conversation import line, manage
from tests.transports.test_conformance import until

pytestmark = pytest.mark.anyio

SOAK = int(os.environ.get("R2P_SOAK", "600"))
"""Connects and disconnects of a client."""
SUBSCRIBE = manage(m.SubscribeRequest("leds", 5, 1, m.UNANSWERED))


def listen() -> TcpListenTransport:
    return TcpListenTransport(parse("tcp-listen:127.0.0.1:0"))


async def dial(transport: TcpListenTransport) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    assert transport.port
    return await asyncio.open_connection("127.0.0.1", transport.port)


async def hear(reader: asyncio.StreamReader, topic: str) -> bytes:
    """The next line of a topic."""
    while True:
        heard = await reader.readline()
        assert heard
        if f"{topic}:".encode() in heard:
            return heard


async def test_garbage_of_every_kind_and_then_a_good_line() -> None:
    transport = listen()
    async with (
        asyncio.timeout(GUARD),
        r2p.Module("A", via=transport, watchdog=False) as module,
        node_in(module) as node,
    ):
        publisher = node.advertise("leds", Led)
        subscriber = node.subscribe("cmd", Led)
        for rubbish in (b"\0" * 10_000, b"@" * 10_000, b"x" * 10_000_000, bytes(range(256)) * 100, b"@00000000:03cm"):
            _, writer = await dial(transport)
            writer.write(rubbish)
            await writer.drain()
            writer.write(b"\r\n" + SUBSCRIBE + manage(m.SubscribeResponse("cmd", 5, 1)))
            writer.write(line("cmd", Led(led=len(rubbish)).encode()))
            assert await subscriber.fetch() == Led(led=len(rubbish))
            await until(lambda: publisher.subscribers == 1)
            (link,) = module.links
            assert isinstance(link, LineLink)
            assert len(link._reader._held) < 600
            assert sum(link.losses.values()) <= 10_000
            writer.close()
            await until(lambda: not module.links)
            assert not publisher.subscribers


async def test_a_peer_that_dies_in_the_middle_of_a_line_and_returns() -> None:
    transport = listen()
    message = line("cmd", Led(led=1).encode())
    opened = manage(m.SubscribeResponse("cmd", 5, 1))
    async with (
        asyncio.timeout(GUARD),
        r2p.Module("A", via=transport, watchdog=False) as module,
        node_in(module) as node,
    ):
        subscriber = node.subscribe("cmd", Led)
        for cut in range(1, len(message) - 2, 5):
            _, writer = await dial(transport)
            writer.write(opened + message[:cut])
            await until(lambda: subscriber.publishers)
            cast("asyncio.Transport", writer.transport).abort()
            await until(lambda: not module.links)
            _, writer = await dial(transport)
            writer.write(message[cut:] + opened + line("cmd", Led(led=cut).encode()))
            assert await subscriber.fetch() == Led(led=cut)
            writer.close()
            await until(lambda: not module.links)


async def test_a_dead_client_returns_to_a_server_that_died_in_a_line() -> None:
    """The client's reader forgets the half line; the server is what listens next on that port."""
    listener = socket.create_server(("127.0.0.1", 0))
    listener.setblocking(False)
    loop = asyncio.get_running_loop()
    port = listener.getsockname()[1]
    opened = manage(m.SubscribeResponse("cmd", 5, 1))
    message = line("cmd", Led(led=9).encode())
    async with (
        asyncio.timeout(GUARD),
        r2p.Module("A", via=f"tcp:127.0.0.1:{port}", watchdog=False) as module,
        node_in(module) as node,
    ):
        subscriber = node.subscribe("cmd", Led)
        connection, _ = await loop.sock_accept(listener)
        await loop.sock_sendall(connection, opened + message[:20])
        await until(lambda: subscriber.publishers)
        connection.close()
        connection, _ = await loop.sock_accept(listener)
        await loop.sock_sendall(connection, message[20:] + message)
        assert await subscriber.fetch() == Led(led=9)
        assert module.links[0].losses["garbage"] == 1
        connection.close()
        listener.close()


async def test_clients_come_and_go_without_a_trace() -> None:
    transport = listen()

    async def visit() -> None:
        reader, writer = await dial(transport)
        writer.write(SUBSCRIBE)
        await hear(reader, "leds")
        writer.close()
        await writer.wait_closed()

    async with (
        asyncio.timeout(GUARD + SOAK / 100),
        r2p.Module("A", via=transport, watchdog=False) as module,
        node_in(module) as node,
    ):
        publisher = node.advertise("leds", Led, latch=True)
        await publisher.publish(Led())
        traces = [traces_of_links()]
        for _ in range(2):
            for _ in range(SOAK // 2 // 20):
                await asyncio.gather(*(visit() for _ in range(20)))
            await until(lambda: not module.links)
            await until(lambda: len(asyncio.all_tasks()) <= 5)
            traces.append(traces_of_links())
            assert not publisher.subscribers
            assert not module.space.links
        for later in traces[1:]:  # fewer files: what another test has left is gone
            assert all(now <= before for now, before in zip(later, traces[0], strict=True)), traces


def traces_of_links() -> tuple[int, int, int]:
    """Objects of links that live, tasks, and open files."""
    gc.collect()
    kinds = Counter(map(type, gc.get_objects()))  # of millions of objects, after other tests
    objects = sum(kinds[kind] for kind in kinds if issubclass(kind, LineLink | Discovery | tcp._TcpConnection))
    return objects, len(asyncio.all_tasks()), len(list(Path("/proc/self/fd").iterdir()))


class Patient(Backoff):
    """Notes what is asked of it, and waits for nothing."""

    resets = 0
    delays = 0

    def reset(self) -> None:
        Patient.resets += 1

    def delay(self) -> float:
        Patient.delays += 1
        return 0.0


async def test_a_peer_that_accepts_and_closes_is_not_hammered(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only a connection that lived lets the next try follow at once."""
    monkeypatch.setattr(tcp, "Backoff", Patient)
    Patient.resets = Patient.delays = 0
    accepted = 0

    async def close(_reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonlocal accepted
        accepted += 1
        writer.write(b"welcome\r\n")
        writer.close()

    server = await asyncio.start_server(close, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    async with asyncio.timeout(GUARD), r2p.Module("A", via=f"tcp:127.0.0.1:{port}", watchdog=False):
        await until(lambda: accepted >= 10)
        assert Patient.resets == 0
        assert Patient.delays >= 9
        monkeypatch.setattr(tcp, "_STABLE_S", 0.0)
        await until(lambda: Patient.resets)
    server.close()
    await server.wait_closed()


async def test_why_there_is_no_connection_yet_is_told_once() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    module = r2p.Module("A", via=f"tcp:127.0.0.1:{port}", watchdog=False)
    events = module.events()
    async with asyncio.timeout(GUARD), module:
        reason = "Connection refused: nothing listens there: check the port, and that the program runs"
        assert await anext(events) == r2p.LinkWaits(f"tcp:127.0.0.1:{port}", reason)
        server = await asyncio.start_server(_ignore, "127.0.0.1", port)
        up = await anext(events)
        assert isinstance(up, r2p.LinkUp)
        assert up.lost == 0
    server.close()


async def _ignore(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    await reader.read()
    writer.close()


async def test_a_connection_to_itself_is_none() -> None:
    """A client that tries again and again on its own machine may be given the very port it asks for."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        itself = taken.getsockname()
    connection = tcp._ClientConnection(cast("LineLink", None))  # it must not come to use it
    async with asyncio.timeout(GUARD):
        await asyncio.get_running_loop().create_connection(lambda: connection, *itself, local_addr=itself)
        await connection.ended.wait()
    assert connection.link is None


async def test_a_name_without_an_address_is_reported_as_that() -> None:
    module = r2p.Module("A", via="tcp:nosuch.invalid:23", watchdog=False)
    events = module.events()
    async with asyncio.timeout(GUARD), module:
        waits = await anext(events)
    assert isinstance(waits, r2p.LinkWaits)
    assert waits.reason.endswith(": no computer of that name is known here")


async def test_an_address_in_use_is_an_error_that_says_so() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        url = f"tcp-listen:127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(TransportError, match=rf"{url}: can't listen: Address already in use: another program"):
            async with r2p.Module("A", via=url, watchdog=False):
                raise AssertionError("it is open")


async def test_an_unknown_host() -> None:
    with pytest.raises(TransportError, match=r"can't listen: .*(not known|resolution|address)"):
        async with r2p.Module("A", via="tcp-listen:no.such.host.invalid:0", watchdog=False):
            raise AssertionError("it is open")


async def test_a_client_too_many_is_told_why(caplog: pytest.LogCaptureFixture) -> None:
    """And served as soon as another one leaves."""
    transport = TcpListenTransport(parse("tcp-listen:127.0.0.1:0,max_clients=1"))
    async with asyncio.timeout(GUARD), r2p.Module("A", via=transport, watchdog=False) as server:
        _, first = await dial(transport)
        await until(lambda: server.links)
        reader, writer = await dial(transport)
        writer.write(SUBSCRIBE)
        assert _denials(await reader.read()) == [m.Denied("A", "A", 0, m.DENIED_CLIENTS)]
        writer.close()
        assert len(server.links) == 1
        assert server.closed_links.faults == {"connection refused": 1}
        assert "refuses a connection: all 1 connections are in use: see max_clients=" in caplog.text
        client = r2p.Module("B", via=f"tcp:127.0.0.1:{transport.port}", watchdog=False)
        events = client.events()
        async with client:
            notice = next_of(events, r2p.LinkNotice)
            text = "A has no connection left (max_clients= of its tcp-listen:); trying again"
            assert await notice == r2p.LinkNotice(f"tcp:127.0.0.1:{transport.port}", "connection refused", text)
            first.close()
            await until(lambda: "B" in [each for link in server.links for each in link.discovery.modules])


async def next_of(events: AsyncIterator[ModuleEvent], kind: type[ModuleEvent]) -> ModuleEvent:
    return await anext(each async for each in events if isinstance(each, kind))


def _denials(data: bytes) -> list[m.Management]:
    return [m.decode(each.data) for each in Reader().feed(data)]


async def test_a_flood_of_clients_too_many_is_bounded_and_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    transport = TcpListenTransport(parse("tcp-listen:127.0.0.1:0,max_clients=1"))
    async with asyncio.timeout(GUARD), r2p.Module("A", via=transport, watchdog=False) as server:
        kept = await dial(transport)
        await until(lambda: server.links)
        others = [await dial(transport) for _ in range(50)]
        heard = await asyncio.gather(*(reader.read() for reader, _ in others), return_exceptions=True)
        assert sum(isinstance(each, bytes) and bool(_denials(each)) for each in heard) >= 1
        await until(lambda: server.closed_links.faults == {"connection refused": 50})
        assert caplog.text.count("refuses a connection") == 1
        for _, writer in (kept, *others):
            writer.close()


async def test_clients_that_come_and_go_do_not_fill_the_log(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO", "r2p")
    transport = listen()
    async with asyncio.timeout(GUARD), r2p.Module("A", via=transport, watchdog=False) as module:
        for number in range(101):
            _, writer = await dial(transport)
            await until(lambda: module.links)
            if number:  # the first comes as a tool does, of which the log need not know
                writer.write(manage(m.Alive("IMU1")))
                await until(lambda: module.links[0].discovery.modules)
            else:
                assert "link tcp" not in caplog.text
            writer.close()
            await until(lambda: not module.links)
        assert module.closed_links.ups == 101
    seconds = 1 + round(caplog.records[-1].created - caplog.records[0].created)
    assert 0 < caplog.text.count("is up, with module IMU1") <= 10 * seconds
    assert 0 < caplog.text.count("is down") <= 10 * seconds


async def test_a_client_that_leaves_does_not_take_what_it_has_lost_with_it() -> None:
    transport = listen()
    async with (
        asyncio.timeout(GUARD),
        r2p.Module("A", via=transport, watchdog=False) as module,
        node_in(module) as node,
    ):
        publisher = node.advertise("leds", Led)
        for _ in range(2):
            reader, writer = await dial(transport)
            writer.write(SUBSCRIBE + b"garbage\r\n")
            await until(lambda: publisher.subscribers)
            await publisher.publish(Led())
            await hear(reader, "leds")
            writer.close()
            await until(lambda: not module.links)
        assert (module.closed_links.ups, module.closed_links.sent) == (2, 2)
        assert module.closed_links.lost["garbage"] == 2
        assert not publisher.subscribers


async def test_a_server_that_is_cancelled_twice_lets_go_of_its_clients() -> None:
    """The second time while it waits for a client that does not read."""
    transport = listen()
    links_left: list[int] = []

    class Apart(Transport):
        """Runs it in a task of its own."""

        async def run(self, hub: Hub, opened: Callable[[], object]) -> None:
            self.running = asyncio.create_task(transport.run(hub, opened))
            await asyncio.wait([self.running])
            links_left.append(len(hub.space.links))

    apart = Apart()
    async with asyncio.timeout(GUARD), r2p.Module("A", via=[apart], watchdog=False) as module, node_in(module) as node:
        publisher = node.advertise("leds", Led, r2p.NonRealTime(stall=0.01))
        _, writer = await dial(transport)
        writer.write(SUBSCRIBE)
        await publisher.wait_subscriber()
        while not publisher.missed:
            await publisher.publish(Led())
        (link,) = module.links
        apart.running.cancel()
        await until(lambda: link._closed)
        apart.running.cancel()
        await until(lambda: bool(links_left))
        assert apart.running.cancelled()
        assert links_left == [0]
        writer.close()


async def test_both_ends_say_good_bye() -> None:
    """Before the connection ends, which would tell the same."""
    heard: list[bytes] = []
    over = asyncio.Event()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        heard.append(await reader.read())
        writer.close()
        over.set()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    url = f"tcp:127.0.0.1:{server.sockets[0].getsockname()[1]}"
    transport = listen()
    async with asyncio.timeout(GUARD):
        async with r2p.Module("A", via=[url, transport], watchdog=False) as module:
            reader, writer = await dial(transport)
            await until(lambda: [link.up for link in module.links] == [True, True])
        heard.append(await reader.read())
        await over.wait()
    for each in heard:
        goodbye = m.decode(Reader().feed(each)[-1].data)
        assert isinstance(goodbye, m.Hello)
        assert goodbye.flags & m.HELLO_LEAVING
    writer.close()
    server.close()


@pytest.mark.parametrize(
    ("url", "address"),
    [
        ("tcp-listen:", ("127.0.0.1", 2323)),
        ("tcp-listen:7", ("127.0.0.1", 7)),
        ("tcp-listen:0.0.0.0", ("0.0.0.0", 2323)),
        ("tcp-listen:[::1]:7", ("::1", 7)),
        ("tcp-listen:[::1]", ("::1", 2323)),
        ("tcp-listen::7", ("127.0.0.1", 7)),
    ],
)
def test_where_it_listens(url: str, address: tuple[str, int]) -> None:
    transport = TcpListenTransport(parse(url))
    assert (transport._host, transport._port) == address


NO_ADDRESSES = [
    "host:http",
    "host:70000",
    "host:",
    "host,x=1",
    "[::1",
    "[::1]7",
    "[host]:7",
    "::1:7",
    "[::1]]:7",
    "x y:1",
]


@pytest.mark.parametrize("transport", [TcpTransport, TcpListenTransport])
@pytest.mark.parametrize("address", NO_ADDRESSES)
def test_addresses_that_are_none(transport: type[TcpTransport] | type[TcpListenTransport], address: str) -> None:
    with pytest.raises(TransportError, match=r"^tcp:"):
        transport(parse(f"tcp:{address}"))


@pytest.mark.parametrize("url", ["tcp:", "tcp:7"])
def test_a_client_needs_a_host(url: str) -> None:
    with pytest.raises(TransportError, match="give the other end's address"):
        TcpTransport(parse(url))


def test_an_ipv6_address_without_brackets_is_told_how_it_is_written() -> None:
    with pytest.raises(TransportError, match=r"an IPv6 address needs brackets: tcp:\[::1\]:2323"):
        TcpTransport(parse("tcp:::1:7"))


@pytest.mark.parametrize("count", ["0", "-1", "many", "1.5"])
def test_a_number_of_clients_that_is_none(count: str) -> None:
    with pytest.raises(TransportError, match="must be a number of connections, 1 or more"):
        TcpListenTransport(parse(f"tcp-listen:,max_clients={count}"))


@pytest.mark.skipif(not socket.has_dualstack_ipv6(), reason="this computer has no IPv6")
async def test_an_ipv6_address_is_told_as_it_is_written_in_a_url() -> None:
    transport = TcpListenTransport(parse("tcp-listen:[::1]:0"))
    async with asyncio.timeout(GUARD), r2p.Module("A", via=transport, watchdog=False) as server:
        assert server.addresses == [("tcp-listen:[::1]:0", f"[::1]:{transport.port}")]
        async with r2p.Module("B", via=f"tcp:{server.addresses[0][1]}", watchdog=False) as client:
            await until(lambda: server.links and client.links[0].up)
            assert client.links[0].name == f"tcp:[::1]:{transport.port}"
            assert server.links[0].name.startswith("tcp:[::1]:")


@pytest.mark.parametrize("transport", [TcpTransport, TcpListenTransport])
def test_slashes_are_no_part_of_it(transport: type[TcpTransport] | type[TcpListenTransport]) -> None:
    with pytest.raises(TransportError, match=r"leave out the //: tcp:127\.0\.0\.1:2323"):
        transport(parse("tcp://127.0.0.1:2323"))


@pytest.mark.parametrize("host", ["a..b", ".a", "a" * 64, "a\0b"])
@pytest.mark.parametrize("transport", [TcpTransport, TcpListenTransport])
def test_what_can_not_be_a_host_name_is_said_at_once(
    transport: type[TcpTransport] | type[TcpListenTransport], host: str
) -> None:
    with pytest.raises(TransportError, match="is not a valid host name"):
        transport(parse(f"tcp:{host}:23"))


@pytest.mark.parametrize(("option", "admits"), [("", False), ("?gateways=no", False), ("?gateways=yes", True)])
async def test_gateways_among_clients_are_let_in_on_demand_only(option: str, admits: bool) -> None:
    transport = TcpListenTransport(parse(f"tcp-listen:127.0.0.1:0{option}"))
    async with asyncio.timeout(GUARD), r2p.Module("A", via=transport, watchdog=False) as module:
        client = r2p.Module("B", via=f"tcp:127.0.0.1:{transport.port}", watchdog=False)
        async with client as other, node_in(module) as node, node_in(other) as there:
            there.advertise("leds", Led)
            await node.subscribe("leds", Led).wait_publisher()
            assert [each.admits_gateways for each in (*module.links, *other.links)] == [admits, True]


def test_gateways_is_yes_or_no() -> None:
    with pytest.raises(r2p.TransportError, match="write yes or no"):
        TcpListenTransport(parse("tcp-listen:0?gateways=maybe"))


async def test_nothing_is_kept_of_types_that_clients_had(caplog: pytest.LogCaptureFixture) -> None:
    transport = listen()
    async with (
        asyncio.timeout(GUARD),
        r2p.Module("A", via=transport, watchdog=False) as module,
        node_in(module) as node,
    ):
        node.advertise("leds", Led)
        for _ in range(3):
            _, writer = await dial(transport)
            writer.write(manage(m.TypeInfo(m.ROLE_SUBSCRIBES, "leds", b"abcdefgh", 9)))
            await until(lambda: "topic leds is refused" in caplog.text)
            caplog.clear()
            writer.close()
            await until(lambda: not module.links)
            assert not module._opened._limits
