"""The listener, and the strangers that connect to it: counts and limits, by real sockets."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING

import pytest
from websockets.asyncio.client import connect
from websockets.exceptions import InvalidStatus

from r2p.errors import WebError
from r2p.web.dash.session import page
from r2p.web.server import CLIENTS_MAX, CONNECTIONS_MAX, WebEndpoint, WebOptions, WebServer
from tests.transports.rtcan.networks import until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from r2p.web.client import WebClient

pytestmark = pytest.mark.anyio

_TOKEN = "a-token-of-this-test"


async def _echo(client: WebClient) -> None:
    async for message in client:
        client.send(message)


@contextlib.asynccontextmanager
async def serving(token: str | None = None) -> AsyncIterator[WebServer]:
    async with WebServer(WebOptions(token=token), {"/echo": WebEndpoint(_echo)}, page()) as server:
        yield server


async def request(server: WebServer, head: str) -> str:
    """Send a request, and return all that is answered until the server closes."""
    reader, writer = await asyncio.open_connection(*server.address)
    try:
        writer.write(head.replace("\n", "\r\n").encode("latin-1"))
        with contextlib.suppress(ConnectionError):
            return (await reader.read()).decode("latin-1")
        return ""
    finally:
        writer.close()


def websocket_url(server: WebServer, query: str = "") -> str:
    return f"ws://127.0.0.1:{server.address[1]}/echo{query}"


async def says_hello(server: WebServer, query: str = "") -> bool:
    """Return whether a client is served."""
    async with connect(websocket_url(server, query), proxy=None) as client:
        await client.send("hello")
        return await client.recv() == "hello"


async def test_files_are_those_of_the_page_with_headers_that_keep_a_browser_safe() -> None:
    async with serving() as server:
        answer = await request(server, "GET / HTTP/1.1\nHost: localhost\n\n")
        script = await request(server, "GET /main.js HTTP/1.1\nHost: 127.0.0.1\n\n")
    head, _, body = answer.partition("\r\n\r\n")
    assert head.startswith("HTTP/1.1 200 OK")
    assert "<!doctype html>" in body.lower()
    assert "default-src 'none'; script-src 'self'; style-src 'self'" in head
    assert "unsafe" not in head
    assert "X-Content-Type-Options: nosniff" in head
    assert "text/javascript" in script


@pytest.mark.parametrize(
    ("line", "headers", "status", "reason"),
    [
        ("GET /../server.py", "Host: localhost\n", 404, "unknown path"),
        ("GET /../../../../etc/passwd", "Host: localhost\n", 404, "unknown path"),
        ("GET /%2e%2e/server.py", "Host: localhost\n", 404, "unknown path"),
        ("GET //etc/passwd", "Host: localhost\n", 404, "unknown path"),
        ("GET /page/../main.js", "Host: localhost\n", 404, "unknown path"),
        ("GET /", "Host: robot.attacker.example\n", 403, "unknown host"),
        ("GET /", "", 403, "unknown host"),
        ("GET /", "Host: [::1\n", 400, "malformed request"),
        ("GET /", "Host: localhost\nHost: attacker.example\n", 400, "malformed request"),
        ("GET //[", "Host: localhost\n", 400, "malformed request"),
        ("GET /echo", "Host: attacker.example\nUpgrade: websocket\n", 403, "unknown host"),
        ("GET /echo", "Host: localhost\nUpgrade: websocket\nOrigin: http://attacker.example\n", 403, "origin"),
        ("GET /echo", "Host: localhost\nUpgrade: websocket\nOrigin: null\n", 403, "origin"),
        ("GET /echo", "Host: localhost:1\nUpgrade: websocket\nOrigin: http://localhost:2\n", 403, "origin"),
        ("GET /main.js", "Host: localhost\nUpgrade: websocket\n", 404, "unknown path"),
    ],
)
async def test_what_is_refused_is_counted(line: str, headers: str, status: int, reason: str) -> None:
    async with serving() as server:
        answer = await request(server, f"{line} HTTP/1.1\n{headers}\n")
        assert answer.startswith(f"HTTP/1.1 {status} ")
        assert server.refused[reason] == 1


@pytest.mark.parametrize("query", ["", "?token=", "?token=wrong", f"?token={_TOKEN}x", "?token=%ff%fe", f"?t={_TOKEN}"])
async def test_without_the_token_nothing_opens(query: str) -> None:
    async with serving(_TOKEN) as server:
        with pytest.raises(InvalidStatus, match="401"):
            await says_hello(server, query)
        assert server.refused["token"] == 1
        assert await says_hello(server, f"?token={_TOKEN}")


async def test_guesses_at_the_token_keep_no_client_waiting() -> None:
    async with serving(_TOKEN) as server, connect(websocket_url(server, f"?token={_TOKEN}"), proxy=None) as client:
        guess = "GET /echo?token={} HTTP/1.1\nHost: localhost\nUpgrade: websocket\n\n"
        async with asyncio.TaskGroup() as tasks:
            for number in range(30):
                tasks.create_task(request(server, guess.format(number)))
            await client.send("still here")
            assert await client.recv() == "still here"
        assert server.refused["token"] == 30


async def test_sockets_that_send_nothing_keep_no_browser_out() -> None:
    async with serving() as server:
        silent = [await asyncio.open_connection(*server.address) for _ in range(2 * CONNECTIONS_MAX)]
        assert await says_hello(server)
        assert server.refused["too many connections"] >= CONNECTIONS_MAX
        assert len(server._others) <= CONNECTIONS_MAX
        for _, writer in silent:
            writer.close()
        await until(lambda: not server._others)


async def test_only_so_many_clients_at_once() -> None:
    async with serving() as server, contextlib.AsyncExitStack() as stack:
        for _ in range(CLIENTS_MAX):
            await stack.enter_async_context(connect(websocket_url(server), proxy=None))
        await until(lambda: len(server.clients) == CLIENTS_MAX)
        with pytest.raises(InvalidStatus, match="503"):
            await says_hello(server)
        assert server.refused["too many clients"] == 1


async def test_a_request_that_never_ends_is_cut_off() -> None:
    async with serving() as server:
        endless = "GET / HTTP/1.1\n" + "".join(f"X-{number}: {'x' * 1000}\n" for number in range(20))
        assert await request(server, endless) == ""
        assert server.refused["request too long"] == 1


@pytest.mark.parametrize("garbage", ["\0\1\2\n\n", "POST / HTTP/1.1\nHost: localhost\n\n", "GET / HTTP/9\n\n", "\n\n"])
async def test_what_is_no_request_ends_its_connection_alone(garbage: str) -> None:
    async with serving() as server:
        answer = await request(server, garbage)
        assert not answer.startswith("HTTP/1.1 200")
        assert await says_hello(server)


async def test_a_message_that_is_too_long_ends_its_client_alone() -> None:
    async with serving() as server, connect(websocket_url(server), proxy=None) as other:
        async with connect(websocket_url(server), proxy=None) as client:
            with contextlib.suppress(ConnectionError):
                await client.send("x" * (1 << 21))
            await client.wait_closed()
            assert client.close_code == 1009
        await other.send("hello")
        assert await other.recv() == "hello"


async def open_raw(server: WebServer) -> asyncio.StreamWriter:
    """Return what writes to a WebSocket, which nothing reads any more."""
    reader, writer = await asyncio.open_connection(*server.address)
    key = "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13"
    head = f"GET /echo HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n{key}\r\n\r\n"
    writer.write(head.encode())
    await reader.readuntil(b"\r\n\r\n")
    return writer


async def test_a_message_of_endless_empty_fragments_ends_its_client_alone() -> None:
    async with serving() as server:
        async with connect(websocket_url(server), proxy=None) as client:
            await client.send(["frag", "ments"])
            assert await client.recv() == "fragments"
        writer = await open_raw(server)
        writer.write(b"\x01\x80\0\0\0\0" + 2000 * b"\x00\x80\0\0\0\0")
        await until(lambda: server.refused["message in too many fragments"] == 1)
        writer.close()
        assert await says_hello(server)


async def test_pings_of_a_client_that_does_not_read_end_it_alone() -> None:
    async with serving() as server:
        writer = await open_raw(server)
        ping = b"\x89\xfd" + bytes(4 + 125)
        with contextlib.suppress(ConnectionError):
            while not server.refused:
                writer.write(1000 * ping)
                await writer.drain()
        assert server.refused == {"pings of a client that does not read": 1}
        writer.close()
        assert await says_hello(server)


async def test_a_client_counts_until_its_connection_is_closed() -> None:
    async with serving() as server:
        async with connect(websocket_url(server), proxy=None):
            await until(lambda: server.clients)
            assert not server._others
        await until(lambda: not server.clients)
        await until(lambda: not server._others)


async def test_an_error_of_ours_is_in_the_log_and_ends_its_client_alone(caplog: pytest.LogCaptureFixture) -> None:
    async def fail(_client: WebClient) -> None:
        raise ZeroDivisionError

    endpoints = {"/fail": WebEndpoint(fail), "/echo": WebEndpoint(_echo)}
    async with WebServer(WebOptions(), endpoints) as server:
        async with connect(websocket_url(server).replace("/echo", "/fail"), proxy=None) as client:
            await client.wait_closed()
            assert client.close_code == 1011
        assert await says_hello(server)
    assert "ZeroDivisionError" in caplog.text


async def test_the_link_of_a_view_has_the_token_where_no_server_sees_it() -> None:
    async with serving(_TOKEN) as server:
        assert server.link("/plots/leds.led") == f"http://127.0.0.1:{server.address[1]}/#token={_TOKEN}/plots/leds.led"
    async with serving() as server:
        assert server.link("/plots/leds.led") == f"http://127.0.0.1:{server.address[1]}/#/plots/leds.led"
        assert server.url == f"http://127.0.0.1:{server.address[1]}/"


async def test_with_a_token_the_robot_may_have_any_name() -> None:
    async with serving(_TOKEN) as server:
        assert (await request(server, "GET / HTTP/1.1\nHost: robot.local\n\n")).startswith("HTTP/1.1 200 OK")
        upgrade = "GET /echo HTTP/1.1\nHost: robot.local\nUpgrade: websocket\n\n"
        assert (await request(server, upgrade)).startswith("HTTP/1.1 401 ")


async def test_an_address_that_can_not_be_used_is_an_error_with_advice() -> None:
    async with serving() as server:
        with pytest.raises(WebError, match="Address already in use; choose another --port"):
            async with WebServer(WebOptions(port=server.address[1]), {}):
                pass
    with pytest.raises(WebError, match="--host takes an address of this computer"):
        async with WebServer(WebOptions(host="192.0.2.1"), {}):
            pass


async def test_the_link_of_a_server_on_all_addresses_has_one_that_others_can_open() -> None:
    async with WebServer(WebOptions(host="0.0.0.0"), {}) as server:
        assert "//0.0.0.0" not in server.url
        assert f"#token={server.token}" in server.url


def test_an_empty_token_is_none() -> None:
    assert WebServer(WebOptions(token=""), {}).token is None
    assert WebServer(WebOptions(token="", host="0.0.0.0"), {}).token


async def test_only_loopback_goes_without_a_token() -> None:
    tokens = {host: WebServer(WebOptions(host=host), {}).token for host in ("0.0.0.0", "::", "127.0.0.1", "localhost")}
    assert tokens["127.0.0.1"] is None
    assert tokens["localhost"] is None
    assert len(tokens["0.0.0.0"] or "") >= 20
    assert tokens["0.0.0.0"] != tokens["::"]
