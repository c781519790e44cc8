"""The debug line over TCP: a client that reconnects, and a server for many clients, each on a link of its own.

Lines must not wait where nothing can be overtaken or discarded: asyncio's buffer holds only what the socket did not
take of the last piece, and the others wait in the link. A client without a place at the server gets the reason.
"""

import abc
import array
import asyncio
import contextlib
import errno
import ipaddress
import os
import re
import socket
import sys
from collections.abc import Callable, Sized
from typing import Any, cast

if sys.platform == "linux":
    import fcntl
    import termios

from r2p.clock import Backoff
from r2p.codecs import debug, management
from r2p.errors import TransportError
from r2p.names import MANAGEMENT, module_alias
from r2p.protocols.keys import LinkEnd
from r2p.transports.identify import ServerKind, identify_server
from r2p.transports.line import Connection, LineLink
from r2p.transports.link import Hub, Transport
from r2p.transports.url import Url, key_file, table_size, yes_or_no

PORT = 2323
"""The port where `tcp-listen:` listens, and `tcp:HOST` connects, unless the URL says otherwise."""

MAX_CLIENTS = 200
"""Connections that `tcp-listen:` serves at once, unless `max_clients=` says otherwise."""

_MANY = 16  # clients from which on one piece a turn for each is worth more than that the first line goes at once
_REFUSED_MAX = 8  # refused clients that are sent the reason at a time; others are cut off
_REFUSED_S = 0.5  # seconds for a refused client to read the reason and close
_CHUNK = 16 * 1024  # bytes read at once: what one turn of the loop can decode without making others wait long
_CONNECT_TIMEOUT_S = 5.0  # seconds; the kernel itself would try for two minutes where nothing answers
_STABLE_S = 3.0  # seconds; a connection that lived as long was a good one: the next is tried at once
_SILENT_S = 1.2  # seconds: r2p sends something at once, idle firmware each half or whole second
_DEAD_AFTER_S = 5  # seconds without an answer to the kernel until a peer counts as gone


class _TcpConnection(asyncio.BufferedProtocol, Connection):
    """One TCP connection."""

    flow_controlled = True

    def __init__(self) -> None:
        super().__init__()
        self.link: LineLink | None = None
        self._buffer = bytearray(_CHUNK)
        self._transport: asyncio.Transport | None = None
        self._paused = False

    @abc.abstractmethod
    def open_link(self, transport: asyncio.Transport, peer: str) -> LineLink | None:
        """Return the link of the new connection; None: the connection is refused."""

    # Carrier

    def send(self, data: bytes) -> None:
        if self._transport is not None:
            self._transport.write(data)

    def pause(self) -> None:
        if self._transport is not None and not self._paused:
            self._paused = True
            self._transport.pause_reading()

    def resume(self) -> None:
        if self._transport is not None and self._paused:
            self._paused = False
            self._transport.resume_reading()

    def close(self) -> None:
        if self._transport is not None:
            self._transport.close()
        else:
            self.ended.set()

    def abort(self) -> None:
        if self._transport is not None:
            self._transport.abort()
        else:
            self.ended.set()

    def mark_ended(self) -> None:
        """Count the connection as ended: it was given up early. The event loop closes it, and uvloop reports no end."""
        self._transport = None
        self.ended.set()

    # BufferedProtocol

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.Transport", transport)
        self._transport.set_write_buffer_limits(high=0)  # what can't be sent at once waits in the link
        peer, own = (self._transport.get_extra_info(name) for name in ("peername", "sockname"))
        if self.ended.is_set() or not peer or peer == own:  # given up, gone again, or connected to itself
            self._transport.abort()
            return
        _set_options(self._transport.get_extra_info("socket"))
        self.link = self.open_link(self._transport, f"tcp:{_address(peer[0], peer[1])}")
        if self.link is not None:
            self.link.connect(self)

    def get_buffer(self, sizehint: int) -> bytearray:
        return self._buffer

    def buffer_updated(self, nbytes: int) -> None:
        if self.link is not None:
            self.link.feed(memoryview(self._buffer)[:nbytes])

    def pause_writing(self) -> None:
        if self.link is not None:
            self.link.carrier_full()

    def resume_writing(self) -> None:
        if self.link is not None:
            self.link.carrier_ready()

    def connection_lost(self, exc: Exception | None) -> None:
        if self._transport is not None:
            self.unconfirmed = self._transport.get_write_buffer_size() + _unacknowledged(self._transport)
        self._transport = None
        if self.link is not None:
            self.link.disconnect(_explain(exc) if exc else "the other end closed the connection")
        self.ended.set()


def _unacknowledged(transport: asyncio.Transport) -> int:
    """Return the bytes that this kernel has accepted, and the other end's has not; 0 if it can't say."""
    if sys.platform != "linux":
        return 0
    answer = array.array("i", [0])
    try:
        fcntl.ioctl(transport.get_extra_info("socket").fileno(), termios.TIOCOUTQ, answer)
    except (OSError, ValueError, AttributeError):  # it is closed
        return 0
    return max(0, answer[0])


def _set_options(sock: socket.socket) -> None:
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # the link gathers lines itself
    # Let the kernel probe the peer: one whose cable is pulled sends nothing, not even an end.
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    if sys.platform == "linux":
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, 2)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, 1)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPCNT, _DEAD_AFTER_S - 2)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _DEAD_AFTER_S * 1000)


class TcpTransport(Transport):
    """`tcp:HOST:PORT`: connects, and reconnects."""

    def __init__(self, url: Url) -> None:
        known: dict[str, Callable[[str], Any]] = {"key": key_file, "topics": table_size}
        options = url.parsed(known)
        self._key, self._topics = options.get("key"), options.get("topics")
        self._host, self._port = _host_port(url)
        if not self._host:
            raise TransportError(f"{url}: give the other end's address: tcp:HOST:PORT")
        self._identified = False

    async def run(self, hub: Hub, opened: Callable[[], object]) -> None:
        link = LineLink(f"tcp:{_address(self._host, self._port)}", hub)
        link.use_key(self._key, LinkEnd.CLIENT)
        link.limit_tables(self._topics)
        link.lossless = True
        backoff = Backoff(hub.random)
        hub.attach(link)
        opened()
        try:
            while True:
                if await self._connect(link, hub) >= _STABLE_S:
                    backoff.reset()
                if link.denied:
                    backoff.slow_down()
                await asyncio.sleep(backoff.delay())
        finally:
            link.close()
            hub.detach(link)

    async def _connect(self, link: LineLink, hub: Hub) -> float:
        """Run one connection from beginning to end; return how many seconds it lasted."""
        loop = asyncio.get_running_loop()
        connection = _ClientConnection(link)
        try:
            try:
                async with asyncio.timeout(_CONNECT_TIMEOUT_S):
                    await loop.create_connection(lambda: connection, self._host, self._port)
            except BaseException:  # cancelled, too: the connection may be there by now
                connection.mark_ended()
                raise
            began = loop.time()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(_SILENT_S):
                    await connection.ended.wait()
            if not link.stats.bytes_received:
                await self._identify(link, hub)
            await connection.ended.wait()
            return loop.time() - began
        except OSError as error:
            link.unreachable(_explain(error))
            return 0.0
        except asyncio.CancelledError:
            link.close()  # while there is a connection to announce that on
            raise
        finally:
            await connection.aclose()

    async def _identify(self, link: LineLink, hub: Hub) -> None:
        """Report what the silent other end is if it is known, once: some adapters serve one connection at a time."""
        if self._identified:
            return
        self._identified = True
        with contextlib.suppress(OSError):
            async with asyncio.timeout(_CONNECT_TIMEOUT_S):
                server = await identify_server(self._host, self._port)
            if text := _NO_LINE.get(server.kind):
                address = _address(self._host, self._port)
                hub.link_notice(link, "no debug line", text.format(address), trouble=True)


_NO_LINE = {
    ServerKind.ZENOH: "{0} is zenoh, not a debug line: connect by zenoh:tcp/{0}",
    ServerKind.TLS: "{0} speaks TLS, not the debug line; if it is zenoh, connect by zenoh:tls/{0}",
}


class _ClientConnection(_TcpConnection):
    """A connection of the client, for a link that outlasts it."""

    def __init__(self, link: LineLink) -> None:
        super().__init__()
        self._link = link

    def open_link(self, transport: asyncio.Transport, peer: str) -> LineLink:
        return self._link


class TcpListenTransport(Transport):
    """`tcp-listen:HOST:PORT`: serves up to `max_clients` clients at once; on loopback unless an address is given.

    With `gateways=yes`, gateways among them join the mesh of this gateway; otherwise they are refused.
    """

    def __init__(self, url: Url) -> None:
        known: dict[str, Callable[[str], Any]] = {
            "max_clients": _client_count,
            "gateways": yes_or_no,
            "key": key_file,
            "topics": table_size,
        }
        options = url.parsed(known)
        self.url = url
        self.max_clients = options.get("max_clients", MAX_CLIENTS)
        self.admits_gateways = bool(options.get("gateways", False))
        self.key = options.get("key")
        self.topics = options.get("topics")
        self.served: set[_ServerConnection] = set()
        self.refused: set[_ServerConnection] = set()
        """Refused connections that are being sent the reason, and have not closed yet."""
        self.closing = False
        host, self._port = _host_port(url)
        self._host = host or "127.0.0.1"
        self.port: int | None = None
        """The port, once the transport listens (port 0 in the URL: any free one)."""

    async def run(self, hub: Hub, opened: Callable[[], object]) -> None:
        loop = asyncio.get_running_loop()
        self.closing = False
        try:
            server = await loop.create_server(lambda: _ServerConnection(self, hub), self._host, self._port)
        except OSError as error:
            raise cannot_listen(str(self.url), error) from error
        try:
            self.port = server.sockets[0].getsockname()[1]
            hub.listening(str(self.url), _address(self._host, self.port))
            opened()
            await loop.create_future()
        finally:
            self.closing = True
            server.close()
            await asyncio.gather(*(client.leave() for client in [*self.served, *self.refused]))
            await server.wait_closed()


class _ClientLink(LineLink):
    """The link of a server to one client; `close` ends the connection of one without the key.

    `served` are all that the server has.
    """

    def __init__(self, peer: str, hub: Hub, close: Callable[[str], None], served: Sized) -> None:
        super().__init__(peer, hub)
        self._close_connection = close
        self._served = served

    @property
    def gathers(self) -> bool:
        return len(self._served) >= _MANY

    def refuse_key(self, reason: str) -> None:
        self._close_connection(reason)


class _ServerConnection(_TcpConnection):
    """A connection of the server, with a link of its own if it is served."""

    def __init__(self, server: TcpListenTransport, hub: Hub) -> None:
        super().__init__()
        self._server = server
        self._hub = hub

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        if self._server.closing:  # accepted just before the server was closed
            self.ended.set()
        super().connection_made(transport)

    def open_link(self, transport: asyncio.Transport, peer: str) -> LineLink | None:
        if len(self._server.served) >= self._server.max_clients:
            self._refuse(transport)
            return None
        link = _ClientLink(peer, self._hub, self._key_refused, self._server.served)
        link.use_key(self._server.key, LinkEnd.SERVER)
        link.limit_tables(self._server.topics)
        link.lossless = True
        link.transient = True
        link.admits_gateways = self._server.admits_gateways
        self._server.served.add(self)
        self._hub.attach(link)
        return link

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self._server.refused.discard(self)
        if self.link is not None:
            self._server.served.remove(self)
            self.link.close()
            self._hub.detach(self.link)
            self.link = None

    def _refuse(self, transport: asyncio.Transport) -> None:
        """Send an r2p client the reason (PROTOCOL.md 9), which then closes the connection."""
        server, name = self._server, module_alias(self._hub.space.module)
        self._hub.connection_refused(
            str(server.url), f"all {server.max_clients} connections are in use: see max_clients="
        )
        if len(server.refused) >= _REFUSED_MAX:
            transport.abort()
            return
        server.refused.add(self)
        denied = management.Denied(name, name, 0, management.DENIED_CLIENTS)
        transport.write(debug.encode(MANAGEMENT.encode(), management.encode(denied), 0))
        transport.write_eof()
        asyncio.get_running_loop().call_later(_REFUSED_S, self.abort)

    def _key_refused(self, text: str) -> None:
        """Close the connection, which holds the place of another client."""
        self._hub.connection_refused(str(self._server.url), text)
        loop = asyncio.get_running_loop()
        loop.call_soon(self.close)  # behind the reason, which may wait for the end of this turn
        loop.call_later(_REFUSED_S, self.abort)

    async def leave(self) -> None:
        """Close the link and the connection, as the server closes."""
        if self.link is not None:
            self.link.close()
        await self.aclose()


def cannot_listen(where: str, error: OSError) -> TransportError:
    """Return an error that says why a server does not listen, and a remedy if there is a known one."""
    return TransportError(f"{where}: can't listen: {_explain(error)}")


def _explain(error: Exception) -> str:
    """Return what went wrong, and a remedy if there is a known one."""
    if isinstance(error, TimeoutError) and not error.errno:
        return "no answer"
    if isinstance(error, socket.gaierror):
        return f"{error.strerror}: no computer of that name is known here"
    if not isinstance(error, OSError) or not error.errno:
        return getattr(error, "strerror", None) or str(error)
    text = os.strerror(error.errno)
    hint = _HINTS.get(error.errno)
    return f"{text}: {hint}" if hint else text


_HINTS = {
    errno.ECONNREFUSED: "nothing listens there: check the port, and that the program runs",
    errno.EHOSTUNREACH: "is the computer on, is it on this network?",
    errno.ENETUNREACH: "is this computer on that network?",
    errno.EADDRINUSE: "another program listens there (ss -ltnp names it): end it, or use another port",
    errno.EADDRNOTAVAIL: "this machine does not have that address",
    errno.EACCES: "ports below 1024 are for root; use another",
}


def _client_count(text: str) -> int:
    if not text.isdecimal() or not int(text):
        raise ValueError("must be a number of connections, 1 or more")
    return int(text)


def _address(host: str, port: int) -> str:
    """Return the address as in URLs."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


_ADDRESS = re.compile(r"(?P<host>\[[^\]]*\]|[^:\[\]]*)(:(?P<port>[^:]*))?")
_NAME = re.compile(rb"[A-Za-z0-9_-]{1,63}(\.[A-Za-z0-9_-]{1,63})*\.?")


def _host_port(url: Url) -> tuple[str, int]:
    """Return the host (may be empty) and the port of an address."""
    if url.address.startswith("//"):
        raise TransportError(f"{url}: leave out the //: {url.scheme}:{url.address.lstrip('/')}")
    if url.address.isdecimal():
        host, port = "", url.address
    elif (parts := _ADDRESS.fullmatch(url.address)) is not None:
        host, port = parts["host"], parts["port"] if parts["port"] is not None else str(PORT)
    else:
        brackets = f"{url.scheme}:[::1]:{PORT}"
        raise TransportError(f"{url}: give it as {url.scheme}:HOST:PORT; an IPv6 address needs brackets: {brackets}")
    if not (port.isascii() and port.isdecimal()) or int(port) > 0xFFFF:
        raise TransportError(f"{url}: {port!r} is not a valid port: give it as {url.scheme}:HOST:PORT")
    return _checked_host(url, host), int(port)


def _checked_host(url: Url, host: str) -> str:
    if host.startswith("["):
        try:
            return str(ipaddress.IPv6Address(host[1:-1]))
        except ValueError as error:
            raise TransportError(f"{url}: {host} is not a valid IPv6 address") from error
    try:
        is_name = not host or _NAME.fullmatch(host.encode("idna")) is not None
    except UnicodeError:
        is_name = False
    if not is_name:
        raise TransportError(
            f"{url}: {host!r} is not a valid host name: between its dots are 1 to 63 letters, digits or hyphens"
        )
    return host
