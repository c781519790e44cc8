"""The XMLRPC client and server: with Python's own on the other side, and with whatever else may connect."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import threading
import xmlrpc.client
import xmlrpc.server
from collections import Counter
from typing import TYPE_CHECKING, Any

import pytest

from r2p.ros.ros1 import xmlrpc as module
from r2p.ros.ros1.xmlrpc import BODY_MAX, XmlRpcClient, XmlRpcError, XmlRpcServer
from r2p.ros.ros1.xmlrpc_codec import encode_call
from tests.ports import free_port

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator

pytestmark = pytest.mark.anyio

UNREADABLE = "XMLRPC requests that can't be read"


def answer(method: str, arguments: list[Any]) -> object:
    match method:
        case "echo":
            return arguments
        case "refuse":
            raise XmlRpcError("not today")
    raise ZeroDivisionError


@pytest.fixture
async def server() -> AsyncIterator[XmlRpcServer]:
    server = XmlRpcServer("127.0.0.1", answer, Counter())
    await server.start()
    yield server
    await server.close()


@pytest.fixture
async def client() -> AsyncIterator[XmlRpcClient]:
    client = XmlRpcClient()
    yield client
    client.close()


@pytest.fixture
def python_server() -> Iterator[str]:
    class Kept(xmlrpc.server.SimpleXMLRPCRequestHandler):
        protocol_version = "HTTP/1.1"

    with xmlrpc.server.SimpleXMLRPCServer(("127.0.0.1", 0), Kept, logRequests=False, use_builtin_types=True) as made:
        made.register_function(lambda *arguments: arguments, "echo")
        thread = threading.Thread(target=made.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield f"http://127.0.0.1:{made.server_address[1]}"
        made.shutdown()
        thread.join()


def uri(server: XmlRpcServer) -> str:
    return f"http://127.0.0.1:{server.port}/"


async def exchange(server: XmlRpcServer, *pieces: bytes) -> bytes:
    """What the server sends until it closes the connection."""
    reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
    for piece in pieces:
        writer.write(piece)
        await writer.drain()
    try:
        async with asyncio.timeout(30.0):
            return await reader.read()
    finally:
        writer.close()


async def test_pythons_client(server: XmlRpcServer) -> None:
    def ask() -> object:
        with xmlrpc.client.ServerProxy(uri(server)) as proxy:
            with pytest.raises(xmlrpc.client.Fault, match="not today"):
                proxy.refuse()
            return proxy.echo("grüße", 1.5, [True, {"a": -1}])

    assert await asyncio.to_thread(ask) == ["grüße", 1.5, [True, {"a": -1}]]


async def test_pythons_server(python_server: str, client: XmlRpcClient) -> None:
    long = "x" * 100_000
    assert await client.call(python_server, "echo", long, b"\x00", keep=True) == [long, b"\x00"]
    assert client.local_host(python_server) == "127.0.0.1"
    assert await client.call(python_server, "echo", keep=True) == []
    with pytest.raises(XmlRpcError, match=r'no of http://127.* "no" is not supported'):
        await client.call(python_server, "no", keep=True)
    client.close()  # it serves one connection after the other
    assert await client.call(python_server, "echo", 1) == [1]


async def test_many_calls_share_a_connection(server: XmlRpcServer, client: XmlRpcClient) -> None:
    calls = (client.call(uri(server), "echo", number, keep=True) for number in range(50))
    assert await asyncio.gather(*calls) == [[number] for number in range(50)]
    assert len(server._connections) == 1


async def test_a_server_that_has_closed_an_idle_connection(server: XmlRpcServer, client: XmlRpcClient) -> None:
    assert await client.call(uri(server), "echo", keep=True) == []
    for writer in [*server._connections.values()]:
        writer.transport.abort()
    assert await client.call(uri(server), "echo", 1, keep=True) == [1]


async def test_errors_name_the_call(server: XmlRpcServer, client: XmlRpcClient) -> None:
    with pytest.raises(XmlRpcError, match=rf"^refuse of {uri(server)}: not today$"):
        await client.call(uri(server), "refuse")
    with pytest.raises(XmlRpcError, match="cannot marshal"):
        await client.call(uri(server), "echo", object())
    long = f"http://{'a' * 64}:1/"
    for wrong in (
        "robot",
        "https://robot:1/",
        "http://robot/",
        "http://[::1",
        "http://robot:99999/",
        long,
        "http://\0:1/",
    ):
        with pytest.raises(XmlRpcError, match=r"is not the URI of a server: those look like http://host:11311/"):
            await client.call(wrong, "echo")
    with pytest.raises(OSError, match=r"Connect call failed|refused"):
        await client.call(f"http://127.0.0.1:{free_port()}/", "echo")


@pytest.mark.parametrize(
    ("sent", "error"),
    [
        (b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\n\r\n", "the server answered 'HTTP/1.1 404 Not Found'"),
        (b"SSH-2.0\r\n\r\n", "the server answered 'SSH-2.0'"),
        (b"HTTP/1.1 200 OK\r\n\r\n", "Content-Length is missing"),
        (b"HTTP/1.1 200 OK\r\nContent-Length: 9999999\r\n\r\n", "9999999 bytes are more than"),
        (b"HTTP/1.1 200 OK\r\nContent-Length: 4\r\n\r\n<a/>", "not an answer of XMLRPC|not XMLRPC"),
        (b"HTTP/1.1 200 OK\r\nContent-Length: 4\r\nContent-Encoding: gzip\r\n\r\nabcd", "send the XML as it is"),
        (b"x" * 100_000, "the header is too long"),
    ],
)
async def test_what_is_not_an_xmlrpc_server(client: XmlRpcClient, sent: bytes, error: str) -> None:
    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readuntil(b"\r\n\r\n")
        writer.write(sent)
        with contextlib.suppress(OSError):
            await writer.drain()
        writer.close()

    async with await asyncio.start_server(serve, "127.0.0.1", 0) as server:
        port = server.sockets[0].getsockname()[1]
        with pytest.raises(XmlRpcError, match=error):
            await client.call(f"http://127.0.0.1:{port}/", "echo")


async def test_a_server_that_closes_or_is_silent(client: XmlRpcClient) -> None:
    writers = []

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writers.append(writer)
        if b"close" in await reader.readuntil(b"</methodCall>\n"):
            writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    address = f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}/"
    with pytest.raises(ConnectionError, match="before its answer was complete"):
        await client.call(address, "close")
    with pytest.raises(TimeoutError):
        await client.call(address, "wait", timeout=0.02)
    for writer in writers:
        writer.close()
    server.close()


BODY = encode_call("echo", (1,))


def post(body: bytes, *lines: str, version: str = "1.1") -> bytes:
    head = [f"POST / HTTP/{version}", f"Content-Length: {len(body)}", *lines, "", ""]
    return "\r\n".join(head).encode() + body


@pytest.mark.parametrize(
    ("sent", "status"),
    [
        (b"GET / HTTP/1.1\r\n\r\n", b"405 Method Not Allowed"),
        (b"\r\n\r\n", b"405 Method Not Allowed"),
        (b"POST / HTTP/1.1\r\n\r\n", b"411 Length Required"),
        (b"POST / HTTP/1.1\r\nContent-Length: -1\r\n\r\n", b"411 Length Required"),
        ("POST / HTTP/1.1\r\nContent-Length: ²\r\n\r\n".encode("latin-1"), b"411 Length Required"),
        (b"POST / HTTP/1.1\r\nContent-Length: " + b"9" * 5000 + b"\r\n\r\n", b"411 Length Required"),
        (f"POST / HTTP/1.1\r\nContent-Length: {BODY_MAX + 1}\r\n\r\n".encode(), b"413 Content Too Large"),
        (post(BODY, "Transfer-Encoding: chunked"), b"415 Unsupported Media Type"),
        (post(b"<methodCall/>"), b"400 Bad Request"),
        (post(b"\x00" * 100), b"400 Bad Request"),
        (b"A: " * 20_000, b"431 Request Header Fields Too Large"),
    ],
)
async def test_requests_that_cannot_be_read(server: XmlRpcServer, sent: bytes, status: bytes) -> None:
    assert (await exchange(server, sent)).startswith(b"HTTP/1.1 " + status + b"\r\n")
    assert server._lost == {UNREADABLE: 1}


async def test_http_1_0_and_closing(server: XmlRpcServer) -> None:
    for request in (post(BODY, version="1.0"), post(BODY, "Connection: close")):
        assert (await exchange(server, request)).count(b"HTTP/1.1 200 OK") == 1
    both = post(BODY) + post(BODY, "Connection: close")
    assert (await exchange(server, *(both[i : i + 1] for i in range(len(both))))).count(b"HTTP/1.1 200 OK") == 2


async def test_a_handler_that_fails(server: XmlRpcServer, caplog: pytest.LogCaptureFixture) -> None:
    assert b"internal error" in await exchange(server, post(encode_call("bug", ()), "Connection: close"))
    assert "ZeroDivisionError" in caplog.text


async def test_connections_over_the_limit(server: XmlRpcServer, monkeypatch: pytest.MonkeyPatch) -> None:
    """The one that has been idle for longest makes room."""
    monkeypatch.setattr(module, "CONNECTIONS_MAX", 2)
    clients = [XmlRpcClient() for _ in range(3)]
    for each in (clients[0], clients[1], clients[0], clients[2]):
        await each.call(uri(server), "echo", keep=True)
    assert server._lost == {"XMLRPC connections over the limit": 1}
    left = [client.local_host(uri(server)) and client._kept[uri(server)]._streams for client in clients]
    ended = [streams[0].at_eof() for streams in left if streams]
    async with asyncio.timeout(30.0):
        while len(server._connections) > 2 or not any(ended):
            await asyncio.sleep(0)
            ended = [streams[0].at_eof() for streams in left if streams]
    assert ended == [False, True, False]
    for client in clients:
        client.close()


async def test_many_connections_at_once(server: XmlRpcServer) -> None:
    """More than the limit are not kept even if all of them come in one turn of the event loop."""
    with contextlib.ExitStack() as opened:
        for _ in range(3 * module.CONNECTIONS_MAX):
            raw = opened.enter_context(socket.socket())
            raw.setblocking(False)
            raw.connect_ex(("127.0.0.1", server.port))
        async with asyncio.timeout(30.0):
            while True:
                await asyncio.sleep(0)
                if server._lost["XMLRPC connections over the limit"] == 2 * module.CONNECTIONS_MAX:
                    break
        assert len(server._connections) == module.CONNECTIONS_MAX


@pytest.mark.parametrize("turns", range(6))
async def test_a_connection_that_comes_as_the_server_closes(turns: int) -> None:
    """It may have been accepted already, but nobody serves it yet."""
    server = XmlRpcServer("127.0.0.1", answer, Counter())
    await server.start()
    with socket.create_connection(("127.0.0.1", server.port)) as client:
        client.setblocking(False)
        for _ in range(turns):
            await asyncio.sleep(0)
        await server.close()
        async with asyncio.timeout(20):
            with contextlib.suppress(ConnectionError):
                assert await asyncio.get_running_loop().sock_recv(client, 1) == b""


async def test_a_server_that_closes_while_clients_do_not_read(server: XmlRpcServer) -> None:
    _, writer = await asyncio.open_connection("127.0.0.1", server.port)
    writer.write(post(BODY) * 100)
    await writer.drain()
    await server.close()
    writer.close()
