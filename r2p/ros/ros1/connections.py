"""TCPROS connections on asyncio: what all roles share, and the listener of a node.

A node listens at one port. The header of each connection says what it is for: a subscriber's goes to the publication of
its topic, a caller's to the server of its service. The other side has HEADER_S seconds for that.
"""

import asyncio
import contextlib
import itertools
import socket
import sys
from collections import Counter
from collections.abc import Callable, Collection
from typing import Protocol, cast

from r2p.clock import random_of, real_time
from r2p.errors import DecodeError, TransportError
from r2p.ros.middleware import MiddlewareUser
from r2p.ros.ros1.tcpros import Fields, FrameReader, decode_header, encode_error
from r2p.runtime.backpressure import INTERNAL_ERROR
from r2p.transports.stats import LoggedCounter

HEADER_S = 5.0
"""Seconds for the header of the other side."""

CONNECTIONS_MAX = 1000
"""Connections that one node has at a time; and as many that have not sent their header: of those, another one takes the
place of the one that has waited for longest.
"""

_HEADER_MAX = (
    256 << 10
)  # bytes of the header of one that connects: the text of its type, at most, and there may be many

_IDLE_S = 10  # seconds without traffic until the kernel probes the other side: rospy waits 60
_INTERVAL_S = 2  # seconds between two of these probes
_PROBES = 5  # unanswered probes until the connection counts as lost
_numbers = itertools.count(1)
_ADMITTED = "connection not admitted"


class Ros1Context:
    """State shared by all connections of a middleware: its user, its counters, and the subscribers without room."""

    user: MiddlewareUser

    def __init__(self, lost: Counter[str]) -> None:
        self.lost = lost
        self.random = random_of()
        self.running = False
        """True once there is a user, and connections are made and accepted."""
        self.paused = False
        """True while messages of topics are not to be read. A connection stops reading when it gets the next ones: most
        pauses are over before that.
        """
        self._held: set[asyncio.Transport] = set()
        self.keepalive = True
        """True if the kernel is to probe silent peers, as the parameter /tcp_keepalive says."""
        self.without_room: set[object] = set()
        """The connections to subscribers that have no room now, and are likely to have some soon."""
        self._subscribers: Counter[str] = Counter()  # connected ones, by topic

    def begin(self, user: MiddlewareUser) -> None:
        """Report to this user from now on."""
        self.user = user
        self.running = True

    def hold(self, transport: asyncio.Transport) -> None:
        """Stop reading from a connection until `resume`."""
        if transport not in self._held and not transport.is_closing():
            self._held.add(transport)
            transport.pause_reading()

    def resume(self) -> None:
        """Go on reading from all connections."""
        self.paused = False
        held, self._held = self._held, set()
        for transport in held:
            if not transport.is_closing():
                transport.resume_reading()

    def joined(self, topic: str) -> None:
        """Note a connection to a subscriber of one of the nodes that publish a topic."""
        self._subscribers[topic] += 1
        self.user.subscriber_joined(topic)

    def left(self, topic: str) -> None:
        """Note the end of such a connection."""
        self._subscribers[topic] -= 1
        if not self._subscribers[topic]:
            del self._subscribers[topic]
            self.user.subscribers_gone(topic)

    def block(self, connection: object) -> None:
        """Note that a subscriber has no room."""
        self.without_room.add(connection)

    def unblock(self, connection: object) -> None:
        """Note that a subscriber has room again, or that publishers stop waiting for it."""
        if connection in self.without_room:
            self.without_room.remove(connection)
            if not self.without_room:
                self.user.made_room()

    def internal_error(self, error: Exception) -> None:
        """Count an error of r2p itself, and log it."""
        if isinstance(self.lost, LoggedCounter):
            self.lost.internal_error(error)
        else:
            self.lost[INTERNAL_ERROR] += 1

    def refuse(self, name: str, text: str) -> None:
        """Count a connection that is of no use, and report why, once for each topic or service of this side."""
        self.lost["connection refused"] += 1
        self.user.notice(f"connection refused: {name}", text, trouble=True)


class TcprosConnection(asyncio.Protocol):
    """One connection: it sets the socket's options, and waits for the header of the other side."""

    def __init__(self, context: Ros1Context) -> None:
        self.context = context
        self.number = next(_numbers)
        """The number of the connection, as the slave API reports it."""
        self.ended: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        """Done when the connection is closed."""
        self.reader = FrameReader()
        self.peer = ""
        """The address of the other side."""
        self.transport: asyncio.Transport | None = None
        self._given_up = False  # True if it was to be closed before it was there
        self._deadline: asyncio.TimerHandle | None = None

    def on_header(self, fields: Fields) -> None:
        """Handle the header of the other side."""

    def on_failure(self, reason: str) -> None:
        """Handle that no header came, or none that can be read; the connection is closed."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast("asyncio.Transport", transport)
        if self._given_up:
            self.transport.abort()
            return
        self.transport.set_write_buffer_limits(high=0)  # what the socket does not take waits where it can be dropped
        address = self.transport.get_extra_info("peername") or ("?", 0)
        self.peer = f"{address[0]}:{address[1]}"
        sock = self.transport.get_extra_info("socket")
        if sock is not None:
            with contextlib.suppress(OSError):  # the other side is gone again
                set_options(sock, keepalive=self.context.keepalive)
        self._deadline = asyncio.get_running_loop().call_later(HEADER_S, self._too_late)

    def data_received(self, data: bytes) -> None:
        block = self.reader.first(data)
        if block is None:
            if self.reader.broken:
                self._fail(f"its header is not one of TCPROS: {self.reader.broken}")
            return
        self.end_wait()
        try:
            fields = decode_header(block)
        except DecodeError as error:
            self._fail(str(error))
            return
        self.on_header(fields)

    def connection_lost(self, exc: Exception | None) -> None:
        waited = self._deadline is not None
        self.end_wait()
        self.transport = None
        if not self.ended.done():
            self.ended.set_result(None)
        if waited:
            self.on_failure("the connection was closed before its header")

    def end_wait(self) -> None:
        """Cancel the time-out for the header."""
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None

    def close(self) -> None:
        """Close the connection, after what was written."""
        self.end_wait()
        if self.transport is not None:
            self.transport.close()

    def abort(self) -> None:
        """Close the connection at once, or as soon as it is there."""
        self._given_up = True
        self.end_wait()
        if self.transport is not None:
            self.transport.abort()

    def _too_late(self) -> None:
        self._fail(f"no header came within {HEADER_S:g} s")

    def _fail(self, reason: str) -> None:
        self.on_failure(reason)
        self.close()


class Acceptor(Protocol):
    """What a node offers to those that connect: a publication, or a server."""

    @property
    def connections(self) -> Collection[TcprosConnection]:
        """Return the connections that it has."""

    def accept(self, fields: Fields, connection: TcprosConnection) -> str:
        """Hand a connection with this header to its new protocol; return why it is refused, or an empty text."""


class _IncomingConnection(TcprosConnection):
    """A connection whose header decides what it is for."""

    def __init__(self, listener: "TcprosListener") -> None:
        super().__init__(listener.context)
        self.reader.limit = _HEADER_MAX
        self._listener = listener

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        if not self._listener.admit(self):
            self.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        self._listener.pending.pop(self, None)
        super().connection_lost(exc)

    def on_header(self, fields: Fields) -> None:
        self._listener.pending.pop(self, None)
        refusal = self._listener.accept(fields, self)
        if refusal and self.transport is not None:
            self.context.refuse(self._listener.known_name(fields), refusal)
            self.transport.write(encode_error(refusal))
            self.close()

    def on_failure(self, reason: str) -> None:
        self.context.lost["bad connection header"] += 1
        if self.transport is not None:
            self.transport.write(encode_error(reason))


class TcprosListener:
    """Accepts the connections of other nodes for one node: subscribers of its topics, and callers of its services."""

    def __init__(self, node: str, bind: str, context: Ros1Context) -> None:
        """Bind a free port of this address. Raises TransportError."""
        self.node = node
        self.context = context
        self.topics: dict[str, Acceptor] = {}
        self.services: dict[str, Acceptor] = {}
        self.pending: dict[TcprosConnection, None] = {}
        """Connections without a header yet, the oldest first."""
        try:
            family = socket.AF_INET6 if ":" in bind else socket.AF_INET
            self._socket = socket.create_server((bind, 0), family=family)
        except OSError as error:
            raise TransportError(f"ros1: can't listen at {bind}: {error}") from error
        self.port: int = self._socket.getsockname()[1]
        self._starting: asyncio.Task[asyncio.Server] | None = None
        self.closed = False

    def start(self) -> None:
        """Accept connections."""
        loop = asyncio.get_running_loop()
        with real_time():
            self._starting = loop.create_task(loop.create_server(self.protocol, sock=self._socket))

    def protocol(self) -> asyncio.Protocol:
        """Return the protocol of a new connection."""
        return _IncomingConnection(self)

    def close(self) -> None:
        """Stop listening. Connections that were handed on stay."""
        self.closed = True
        if self._starting is None:
            self._socket.close()
        else:
            self._starting.add_done_callback(_close_server)
        for each in list(self.pending):
            each.abort()

    def admit(self, connection: TcprosConnection) -> bool:
        """Wait for the header of one more connection; return False if the listener is closed."""
        if self.closed:
            self.context.lost[_ADMITTED] += 1
            return False
        self.pending[connection] = None
        if len(self.pending) > CONNECTIONS_MAX:
            self.context.lost[_ADMITTED] += 1
            oldest = next(iter(self.pending))
            del self.pending[oldest]
            oldest.abort()
        return True

    def accept(self, fields: Fields, connection: TcprosConnection) -> str:
        """Hand a connection to what its header asks for; return why it is refused, or an empty text."""
        name, offered, verb = fields.get("topic"), self.topics, "publishes"
        if "service" in fields:
            name, offered, verb = fields["service"], self.services, "serves"
        if name is None:
            return "the header of the connection has neither a topic nor a service"
        found = offered.get(name)
        if found is None:
            return f"[{self.node}] {verb} no [{name}]"
        if sum(len(each.connections) for each in (*self.topics.values(), *self.services.values())) >= CONNECTIONS_MAX:
            self.context.lost[_ADMITTED] += 1
            return f"[{self.node}] has {CONNECTIONS_MAX} connections, and accepts no more"
        return found.accept(fields, connection)

    def known_name(self, fields: Fields) -> str:
        """Return the topic or service of this node that a header asks for, or an empty text."""
        name = fields.get("service", fields.get("topic", ""))
        return name if name in self.services or name in self.topics else ""


def _close_server(started: asyncio.Task[asyncio.Server]) -> None:
    if not started.cancelled() and started.exception() is None:
        started.result().close()


def take_over(connection: TcprosConnection, successor: TcprosConnection, start: Callable[[], None]) -> None:
    """Replace the protocol of a connection whose header was accepted; `start` runs when it is in place."""
    transport = connection.transport
    if transport is None:
        return
    successor.transport, connection.transport = transport, None
    successor.reader, successor.peer = connection.reader, connection.peer
    transport.set_protocol(successor)
    start()


def set_options(sock: socket.socket, *, keepalive: bool) -> None:
    """Send small messages at once, and let the kernel notice a peer that is gone without a word."""
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    if not keepalive:
        return
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    if sys.platform == "linux":
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, _IDLE_S)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, _INTERVAL_S)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPCNT, _PROBES)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, (_IDLE_S + _INTERVAL_S * _PROBES) * 1000)
