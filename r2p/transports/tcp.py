"""The debug line over TCP: a client that comes back, and a server for many clients, each a peer of its own."""

import asyncio
import socket
import sys
from collections.abc import Callable
from typing import cast

from r2p.errors import TransportError
from r2p.transports.backoff import Backoff
from r2p.transports.line import BUFFER, Carrier, LineLink
from r2p.transports.link import Hub, Transport
from r2p.transports.url import Url

PORT = 2323
"""Where `tcp-listen:` listens, and `tcp:HOST` connects, unless told otherwise."""

_CHUNK = 16 * 1024  # bytes read at once: what one turn of the loop can decode without making others wait long
_CONNECT_TIMEOUT = 5.0
_DEAD_AFTER = 5  # seconds


_CLOSING = 0.5  # seconds for the other end to take what is still buffered


class _Connection(asyncio.BufferedProtocol, Carrier):
    """One TCP connection; `open_link` gives the link that it carries once the other end's address is known."""

    def __init__(self, open_link: Callable[[str], LineLink]) -> None:
        self.link: LineLink | None = None
        self.closed: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        """Done when the connection is gone; says why."""
        self._open_link = open_link
        self._buffer = bytearray(_CHUNK)
        self._transport: asyncio.Transport | None = None
        self._paused = False

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

    # BufferedProtocol

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.Transport", transport)
        self._transport.set_write_buffer_limits(high=BUFFER)
        _find_dead_peers(self._transport.get_extra_info("socket"))
        host, port = self._transport.get_extra_info("peername")[:2]
        self.link = self._open_link(f"tcp:{host}:{port}")
        self.link.connected(self)

    def get_buffer(self, sizehint: int) -> bytearray:
        return self._buffer

    def buffer_updated(self, nbytes: int) -> None:
        if self.link is not None:
            self.link.fed(memoryview(self._buffer)[:nbytes])

    def pause_writing(self) -> None:
        if self.link is not None:
            self.link.carrier_full()

    def resume_writing(self) -> None:
        if self.link is not None:
            self.link.carrier_ready()

    def connection_lost(self, exc: Exception | None) -> None:
        self._transport = None
        reason = str(exc) if exc else "the other end closed the connection"
        if self.link is not None:
            self.link.disconnected(reason)
        if not self.closed.done():
            self.closed.set_result(reason)

    async def aclose(self) -> None:
        """Close, and wait until it is over; what the other end does not take soon is not sent."""
        self.close()
        await asyncio.wait([self.closed], timeout=_CLOSING)
        if self._transport is not None:
            self._transport.abort()
            await self.closed


def _find_dead_peers(sock: socket.socket) -> None:
    """A peer whose cable is pulled says nothing: let the kernel ask."""
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    if sys.platform == "linux":
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, 2)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, 1)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPCNT, _DEAD_AFTER - 2)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _DEAD_AFTER * 1000)


class TcpTransport(Transport):
    """`tcp:HOST:PORT`: connects, and connects again."""

    def __init__(self, url: Url) -> None:
        url.parsed({})
        self._host, self._port = _host_port(url)
        if not self._host:
            raise TransportError(f"{url}: give the other end's address: tcp:HOST:PORT")

    async def run(self, hub: Hub, opened: Callable[[], object]) -> None:
        loop = asyncio.get_running_loop()
        link = LineLink(f"tcp:{self._host}:{self._port}", hub)
        backoff = Backoff(hub.random)
        connection: _Connection | None = None
        hub.attach(link)
        opened()
        try:
            while True:
                try:
                    async with asyncio.timeout(_CONNECT_TIMEOUT):
                        _, connection = await loop.create_connection(
                            lambda: _Connection(lambda _peer: link), self._host, self._port
                        )
                except OSError as error:
                    link.unreachable(str(error) or "no answer")
                else:
                    await connection.closed
                    if link.stats.bytes_received:
                        backoff.reset()
                await asyncio.sleep(backoff.delay())
        finally:
            link.close()
            if connection is not None:
                await connection.aclose()
            hub.detach(link)


class TcpListenTransport(Transport):
    """`tcp-listen:HOST:PORT`: serves any number of clients; on loopback unless an address is given."""

    def __init__(self, url: Url) -> None:
        url.parsed({})
        host, self._port = _host_port(url)
        self._host = host or "127.0.0.1"
        self._url = url
        self.port: int | None = None
        """The port that it listens on, once it does (port 0 in the URL: any free one)."""

    async def run(self, hub: Hub, opened: Callable[[], object]) -> None:
        loop = asyncio.get_running_loop()
        clients: set[_Connection] = set()

        def accept() -> _Connection:
            connection = _Connection(lambda peer: _attached(LineLink(peer, hub), hub))
            clients.add(connection)
            connection.closed.add_done_callback(lambda _reason: leave(connection))
            return connection

        def leave(connection: _Connection) -> None:
            clients.discard(connection)
            if connection.link is not None:
                connection.link.close()
                hub.detach(connection.link)

        try:
            server = await loop.create_server(accept, self._host, self._port)
        except OSError as error:
            raise TransportError(f"{self._url}: can't listen: {error.strerror or error}; is it in use?") from error
        try:
            self.port = server.sockets[0].getsockname()[1]
            hub.listening(str(self._url), f"{self._host}:{self.port}")
            opened()
            await loop.create_future()
        finally:
            server.close()
            await asyncio.gather(*(connection.aclose() for connection in list(clients)))


def _attached(link: LineLink, hub: Hub) -> LineLink:
    hub.attach(link)
    return link


def _host_port(url: Url) -> tuple[str, int]:
    """The address's host (may be empty) and port."""
    if url.address.isdecimal():
        return "", int(url.address)
    host, colon, port = url.address.rpartition(":")
    if not colon or port.endswith("]"):
        host, port = url.address, str(PORT)
    if not port.isdecimal() or int(port) > 0xFFFF:
        raise TransportError(f"{url}: {port!r} is no port: give it as {url.scheme}:HOST:PORT")
    return host.strip("[]"), int(port)
