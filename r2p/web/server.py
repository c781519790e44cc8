"""The listener of pages and protocols: files by HTTP, messages by WebSocket, from one port of this process.

Safe by default: it listens on loopback, and elsewhere only with a token that each WebSocket has to name. A browser may
connect only from a page of this server, or of an origin that is allowed: no other page that the user has open can read
the robot's network. Files are no secret, so they need no token.

What strangers cost is bounded. At most 128 connections are open, and 32 of them are clients. When one more comes, the
oldest that has not become a client yet is closed: so thousands of sockets that send nothing keep no browser out. A
request has 16 KiB and ten seconds; a client's messages wait in the socket when four of them are unread, and one that
sends pings and does not read is disconnected.
"""

import asyncio
import contextlib
import errno
import functools
import hmac
import http
import ipaddress
import logging
import os
import secrets
import socket
from collections import Counter
from collections.abc import Awaitable, Callable, Iterable, Mapping
from types import TracebackType
from typing import Any, Self, cast
from urllib.parse import parse_qs, quote, urlsplit

import msgspec
from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.datastructures import Headers
from websockets.frames import Frame, Opcode
from websockets.http11 import Request, Response
from websockets.typing import Subprotocol

from r2p.clock import real_time
from r2p.errors import WebError
from r2p.log_lines import get_logger
from r2p.web.client import WebClient

logger = get_logger("r2p.web")

LOOPBACK = "127.0.0.1"

CONNECTIONS_MAX = 128
"""Open connections, of clients and of others."""
CLIENTS_MAX = 32
"""Connections that speak WebSocket."""
MESSAGE_MAX = 1 << 20
"""Bytes of a message from a client."""

_MESSAGES_MAX = 4  # of a client that wait for their handler
_REQUEST_MAX = 1 << 14  # bytes of a request with its headers
_REQUEST_TIME = 10.0  # seconds for a request and its answer
_ORIGINS_MAX = 16  # refused pages whose names are kept
_BACKLOG = 16  # connections that are accepted in one turn of the event loop
_WRITE_BUFFER = 256 << 10  # bytes of a connection beyond which its client's own queue fills
_FRAGMENTS_MAX = 1024  # of a message; empty ones cost memory, and not every release of websockets limits them
_PONGS_MAX = 1 << 16  # bytes of answers to pings beyond that, which would pass by the client's queue
_PORT_ERRORS = (errno.EADDRINUSE, errno.EACCES)
_CSP = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_HEADERS = {
    "Content-Security-Policy": _CSP,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-cache",
}


class WebFile(msgspec.Struct, frozen=True):
    """A file that is served: its media type, and its bytes."""

    media_type: str
    data: bytes


class WebEndpoint(msgspec.Struct, frozen=True):
    """Speaks WebSocket at a path. `subprotocols`: those that it accepts, the first one of the client's; empty: any.

    `handle` runs for each client until it returns or the client leaves.
    """

    handle: Callable[[WebClient], Awaitable[None]]
    subprotocols: tuple[str, ...] = ()


class WebOptions(msgspec.Struct, frozen=True, kw_only=True):
    """Where a server listens, and who may connect. `port` 0 takes a free one.

    `token`: what clients must name; None or empty: a random one where the address is not loopback. `origins`: pages of
    other servers that may connect, as `https://app.foxglove.dev`.
    """

    host: str = LOOPBACK
    port: int = 0
    token: str | None = None
    origins: tuple[str, ...] = ()


class _WebConnection(ServerConnection):
    """A connection, which is `admitted` when it is made and `forgotten` when it is lost."""

    def __init__(self, listener: "WebServer", *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.lost = False
        self._listener = listener
        self._received = 0
        self._pongs = 0
        self._fragments = 0

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        self._listener.admit(self)

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self.lost = True
        self._listener.forget(self)

    def data_received(self, data: bytes) -> None:
        if self.request is None:
            self._received += len(data)
            if self._received > _REQUEST_MAX:
                self._listener.refused["request too long"] += 1
                self.transport.abort()
                return
        waiting = self.transport.get_write_buffer_size()
        super().data_received(data)
        if waiting > _WRITE_BUFFER:
            self._limit_pongs(self.transport.get_write_buffer_size() - waiting)
        else:
            self._pongs = 0

    def process_event(self, event: Any) -> None:
        if isinstance(event, Frame):
            if not event.fin:
                self._fragments += 1
                if self._fragments > _FRAGMENTS_MAX:
                    self._listener.refused["message in too many fragments"] += self._fragments == _FRAGMENTS_MAX + 1
                    self.transport.abort()
                    return
            elif event.opcode is Opcode.CONT:
                self._fragments = 0
        super().process_event(event)

    def _limit_pongs(self, size: int) -> None:
        """End the connection of a client that sends pings and does not read: their answers have no other limit."""
        self._pongs += max(0, size)
        if self._pongs > _PONGS_MAX:
            self._listener.refused["pings of a client that does not read"] += 1
            self.transport.abort()


class WebServer:
    """Serves `files` by path, and `endpoints` by path, while its block is open."""

    def __init__(
        self, options: WebOptions, endpoints: Mapping[str, WebEndpoint], files: Mapping[str, WebFile] | None = None
    ) -> None:
        self.refused: Counter[str] = Counter()
        """Connections and requests that were refused, by reason."""
        self.foreign_origins: set[str] = set()
        """Pages that were refused, a few of them."""
        self.clients: list[WebClient] = []
        self._others: dict[_WebConnection, None] = {}
        """Connections that are not those of clients, the oldest first (the values mean nothing)."""
        self._options = options
        self._endpoints = endpoints
        self._files = files or {}
        random = None if is_loopback(options.host) else secrets.token_urlsafe(16)
        self.token = options.token or random
        """What each WebSocket has to name as `?token=`; None: nothing."""

    @property
    def address(self) -> tuple[str, int]:
        """Where the server listens: host and port."""
        host, port, *_ = next(iter(self._server.sockets)).getsockname()
        return host, port

    @property
    def url(self) -> str:
        """The address of the page; with the token behind #, where it stays in the browser."""
        return self.link()

    def link(self, view: str = "") -> str:
        """Return the address that opens a view of the page, as "/plots/odometry.x"."""
        host, port = self.address
        host = _own_address(host) if ipaddress.ip_address(host).is_unspecified else host
        shown = f"[{host}]" if ":" in host else host
        fragment = view if self.token is None else f"token={quote(self.token, safe='')}{view}"
        return f"http://{shown}:{port}/" + (f"#{fragment}" if fragment else "")

    async def __aenter__(self) -> Self:
        """Begin to listen. Raises WebError if the address can't be used."""
        try:
            with real_time():  # time-outs of clients, which have nothing to do with the time of a simulation
                self._server = await self._listen()
        except OSError as error:
            raise WebError(self._not_listening(error)) from error
        return self

    async def _listen(self) -> Server:
        return await serve(
            self._handle,
            self._options.host,
            self._options.port,
            process_request=self._answer,
            select_subprotocol=self._select_subprotocol,
            compression=None,
            create_connection=functools.partial(_WebConnection, self),  # type: ignore[arg-type]  # it is called
            open_timeout=_REQUEST_TIME,
            backlog=_BACKLOG,
            max_size=MESSAGE_MAX,
            max_queue=_MESSAGES_MAX,
            write_limit=_WRITE_BUFFER,
            server_header=None,
            logger=_quiet,
        )

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop listening, and close all connections."""
        self._server.close()
        await self._server.wait_closed()

    def _not_listening(self, error: OSError) -> str:
        """Say why the server can't listen, and what to do."""
        number = error.errno or 0  # below 0 where a name is not known
        reason = os.strerror(number) if number > 0 else error.strerror or str(error)
        if number in _PORT_ERRORS:
            advice = "choose another --port, or 0 for a free one"
        else:
            advice = "--host takes an address of this computer, or 0.0.0.0 for all of them"
        return f"can't listen on {self._options.host}:{self._options.port}: {reason}; {advice}"

    # Connections

    def admit(self, connection: _WebConnection) -> None:
        """Note a new connection; beyond the limit, close the oldest one that is not a client's."""
        self._others[connection] = None
        if len(self._others) + len(self.clients) > CONNECTIONS_MAX:
            oldest = next(iter(self._others))
            del self._others[oldest]
            self.refused["too many connections"] += 1
            oldest.transport.abort()

    def forget(self, connection: _WebConnection) -> None:
        """Note the end of a connection."""
        self._others.pop(connection, None)
        if connection.response is None:
            self.refused["no request"] += 1

    # A request

    def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """Return the answer to a request; None for a WebSocket that may open."""
        if getattr(request, "method", "GET") != "GET":  # websockets before 16 refuses others itself
            return self._refuse(http.HTTPStatus.METHOD_NOT_ALLOWED, "not GET")
        try:
            return self._refusal(request) if "Upgrade" in request.headers else self._page(request)
        except (ValueError, LookupError):  # an address that is none, or a header that is there twice
            return self._refuse(http.HTTPStatus.BAD_REQUEST, "malformed request")

    def _page(self, request: Request) -> Response:
        if not self._is_own_host(request.headers):
            return self._refuse(http.HTTPStatus.FORBIDDEN, "unknown host")
        return self._file(urlsplit(request.path).path)

    def _refusal(self, request: Request) -> Response | None:
        """Return the reason to refuse a WebSocket; None for one that may open."""
        if not self._is_own_host(request.headers):
            return self._refuse(http.HTTPStatus.FORBIDDEN, "unknown host")
        if urlsplit(request.path).path not in self._endpoints:
            return self._refuse(http.HTTPStatus.NOT_FOUND, "unknown path")
        if foreign := self._foreign_origins(request.headers):
            self.foreign_origins.update(foreign[: _ORIGINS_MAX - len(self.foreign_origins)])
            return self._refuse(http.HTTPStatus.FORBIDDEN, "origin")
        if not self._has_token(request):
            return self._refuse(http.HTTPStatus.UNAUTHORIZED, "token")
        if len(self.clients) >= CLIENTS_MAX:
            return self._refuse(http.HTTPStatus.SERVICE_UNAVAILABLE, "too many clients")
        return None

    def _file(self, path: str) -> Response:
        file = self._files.get("/index.html" if path == "/" else path)
        if file is None:
            return self._refuse(http.HTTPStatus.NOT_FOUND, "unknown path")
        return _response(http.HTTPStatus.OK, file)

    def _refuse(self, status: http.HTTPStatus, reason: str) -> Response:
        self.refused[reason] += 1
        return _response(status, WebFile("text/plain", f"{status.phrase}: {reason}\n".encode()))

    def _is_own_host(self, headers: Headers) -> bool:
        """Return whether a request names an address of this computer, not a name that a stranger's DNS gives it.

        With a token any name will do, as that of the robot: a page of a stranger does not have the token.
        """
        host = urlsplit(f"//{headers.get('Host', '')}").hostname or ""
        return bool(self.token and host) or host in ("localhost", self._options.host) or _is_address(host)

    def _foreign_origins(self, headers: Headers) -> list[str]:
        """Return the pages that a request comes from, if it is neither this server's nor one that is allowed."""
        own = "", f"http://{headers.get('Host', '')}"  # programs that are not a browser send none, or an empty one
        return [each for each in headers.get_all("Origin") if each not in own and each not in self._options.origins]

    def _has_token(self, request: Request) -> bool:
        if self.token is None:
            return True
        given = parse_qs(urlsplit(request.path).query).get("token", [""])[0]
        return hmac.compare_digest(given.encode(), self.token.encode())

    def _select_subprotocol(self, connection: ServerConnection, offered: Iterable[Subprotocol]) -> Subprotocol | None:
        assert connection.request is not None
        accepted = self._endpoints[urlsplit(connection.request.path).path].subprotocols
        return next((each for each in offered if each in accepted), None)

    # A client

    async def _handle(self, connection: ServerConnection) -> None:
        assert connection.request is not None
        endpoint = self._endpoints[urlsplit(connection.request.path).path]
        if endpoint.subprotocols and connection.subprotocol is None:
            await connection.close(1002, f"offer a subprotocol: {' or '.join(endpoint.subprotocols)}")
            return
        own = cast("_WebConnection", connection)
        async with WebClient(connection) as client:
            self.clients.append(client)
            self._others.pop(own, None)
            try:
                await endpoint.handle(client)
            except Exception:
                logger.exception("internal error: the connection of a client ends")
                await connection.close(1011, "internal error: see the log")
            finally:
                self.clients.remove(client)
                if not own.lost:  # until it is closed, it counts as a connection
                    self._others[own] = None


def is_loopback(host: str) -> bool:
    """Return whether only programs of this computer reach an address."""
    return host == "localhost" or (_is_address(host) and ipaddress.ip_address(host).is_loopback)


def _own_address(wildcard: str) -> str:
    """Return the address of this computer in its network, for links that others open, without sending anything."""
    family, outside = (socket.AF_INET6, "2001:db8::1") if ":" in wildcard else (socket.AF_INET, "192.0.2.1")
    with contextlib.suppress(OSError), socket.socket(family, socket.SOCK_DGRAM) as probe:
        probe.connect((outside, 9))
        address: str = probe.getsockname()[0]
        return address
    return socket.gethostname()


def _is_address(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


def _response(status: http.HTTPStatus, file: WebFile) -> Response:
    headers = Headers(
        {**_HEADERS, "Content-Type": file.media_type, "Content-Length": str(len(file.data)), "Connection": "close"}
    )
    return Response(status, status.phrase, headers, file.data)


_quiet = logging.Logger("r2p.web.connections", logging.CRITICAL)  # errors of clients are not errors of this program
