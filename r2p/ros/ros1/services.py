"""Services of ROS 1: the servers of this side's nodes, and calls of others.

A server handles the requests of one connection in turn, and those of several connections at the same time, as rospy
does. Calls ask for connections that persist, and keep them for KEEP_S for the next call of the same node: a connection
costs several times as much as a call. So calls at the same time have a connection each. Not longer, as rospy goes on
answering on a connection when the service has another handler or another node serves it.
"""

import asyncio
import functools
from collections import deque

from r2p.errors import NoServer, ServiceError
from r2p.ros.middleware import Cancel, RosServer, RosService, nothing_to_cancel
from r2p.ros.ros1.connections import Ros1Context, TcprosConnection, take_over
from r2p.ros.ros1.tcpros import (
    MESSAGE_MAX,
    Fields,
    ResponseReader,
    TcprosResponse,
    caller_header,
    encode_failure,
    encode_header,
    encode_response,
    frame,
    refuse_caller,
    refuse_server,
    server_header,
)

KEEP_S = 1.0
"""Seconds for which a connection to a server is kept after a call."""

REQUESTS_MAX = 16
"""Requests that wait on one connection, which is not read while there are as many."""

_GONE = "service [{}] is not served any more"


# Servers


class CallerConnection(TcprosConnection):
    """The connection of a remote caller: its requests, one after the other."""

    def __init__(self, server: "Ros1Server", fields: Fields) -> None:
        super().__init__(server.context)
        self.node = fields["callerid"]
        """The caller's node."""
        self._server = server
        self._persistent = fields.get("persistent") == "1"
        self._requests: deque[bytes] = deque()
        self._answering = 0  # the number of the request that is being handled; 0: none
        self._number = 0
        self._cancel: Cancel = nothing_to_cancel
        self._paused = False  # True while the caller does not read what was answered
        self._handing = False  # True while requests are handed over: one that is answered at once is not the end

    def begin(self, header: bytes, *, probe: bool) -> None:
        """Answer the caller's header, and read requests."""
        assert self.transport is not None
        self._server.connections.add(self)
        self.transport.write(header)
        if probe:
            self.close()
            return
        self.reader.limit = MESSAGE_MAX
        self.data_received(b"")

    def data_received(self, data: bytes) -> None:
        self._requests.extend(self.reader.feed(data))
        if self.reader.broken:
            self.context.lost["too long"] += 1
            self.abort()
            return
        if len(self._requests) >= REQUESTS_MAX and self.transport is not None:
            self.transport.pause_reading()
        self._next()

    def pause_writing(self) -> None:
        self._paused = True

    def resume_writing(self) -> None:
        self._paused = False
        self._next()

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self._requests.clear()
        self._server.connections.discard(self)
        if self._answering:
            self._answering = 0
            self.context.lost["ROS caller gone"] += 1
            self._cancel()

    def refuse(self) -> None:
        """Answer everything that waits with an error, and close the connection: the server is gone."""
        failure = encode_failure(_GONE.format(self._server.server.service))
        waiting = len(self._requests) if self._persistent else 0
        self._requests.clear()
        if self._answering:
            self._cancel()
            self._respond(self._answering, failure)
        if waiting and self.transport is not None:
            self.transport.write(failure * waiting)
        self.close()

    def _next(self) -> None:
        """Hand requests to the server, one at a time, as long as they are answered at once."""
        if self._handing:
            return
        self._handing = True
        try:
            while self._requests and not self._answering and not self._paused and self._is_open:
                self._hand_over(self._requests.popleft())
        finally:
            self._handing = False
        if self._is_open and len(self._requests) < REQUESTS_MAX and self.transport is not None:
            self.transport.resume_reading()

    @property
    def _is_open(self) -> bool:
        return self.transport is not None and not self.transport.is_closing()

    def _hand_over(self, request: bytes) -> None:
        self._number += 1
        number = self._answering = self._number
        service = self._server.server.service
        cancel = self.context.user.requested(
            service,
            self.node,
            request,
            lambda data: self._respond(number, encode_response(data)),
            lambda text: self._respond(number, encode_failure(text)),
        )
        if self._answering == number:
            self._cancel = cancel

    def _respond(self, number: int, response: bytes) -> None:
        if number != self._answering or self.transport is None:
            return  # it was answered before, or the caller is gone
        self._answering = 0
        self.transport.write(response)
        if not self._persistent:
            self.close()
            return
        self._next()


class Ros1Server:
    """A server of one of this side's nodes."""

    def __init__(self, server: RosServer, context: Ros1Context) -> None:
        self.server = server
        self.context = context
        self.connections: set[CallerConnection] = set()

    def accept(self, fields: Fields, connection: TcprosConnection) -> str:
        """Accept a caller; return why not, or an empty text."""
        node, service, kind = self.server.node, self.server.service, self.server.type
        refusal = refuse_caller(fields, node, service, kind)
        if not refusal:
            caller = CallerConnection(self, fields)
            header = encode_header(server_header(node, service, kind))
            probe = fields.get("probe") == "1"
            take_over(connection, caller, functools.partial(caller.begin, header, probe=probe))
        return refusal

    def close(self) -> None:
        """Refuse requests that wait, and close all connections."""
        for connection in list(self.connections):
            connection.refuse()


# Calls


class Ros1ServerConnection(TcprosConnection):
    """A connection to a remote server, for one call at a time."""

    def __init__(self, context: Ros1Context) -> None:
        super().__init__(context)
        loop = asyncio.get_running_loop()
        self.header: asyncio.Future[Fields] = loop.create_future()
        """The server's header; a ServiceError if none came."""
        self.expires: asyncio.TimerHandle | None = None
        """The timer that closes the connection while no call uses it."""
        self._responses = ResponseReader()
        self._response: asyncio.Future[TcprosResponse] | None = None

    async def request(self, data: bytes) -> bytes:
        """Return the response to a request. Raises ServiceError."""
        if self.transport is None:
            raise ServiceError("the server has closed the connection")
        self._response = asyncio.get_running_loop().create_future()
        self.transport.write(frame(data))
        try:
            response = await self._response
        finally:
            self._response = None
        if not response.ok:
            raise ServiceError(response.data.decode(errors="replace"))
        return response.data

    def on_header(self, fields: Fields) -> None:
        if not self.header.done():
            self.header.set_result(fields)

    def on_failure(self, reason: str) -> None:
        self._end(reason)

    def data_received(self, data: bytes) -> None:
        if not self.header.done():
            super().data_received(data)
            return
        for response in self._responses.feed(data):
            if self._response is None or self._response.done():
                self._unexpected()
                return
            self._response.set_result(response)
        if self._responses.broken:
            self._unexpected()

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self._end("the server closed the connection without an answer: it may have ended during the call")
        if self.expires is not None:
            self.expires.cancel()

    def _unexpected(self) -> None:
        self.context.lost["unexpected response"] += 1
        self.abort()

    def _end(self, reason: str) -> None:
        if not self.header.done():
            self.header.set_exception(ServiceError(reason))
            self.header.exception()  # a call that has given up does not fetch it
        elif self._response is not None and not self._response.done():
            self._response.set_exception(ServiceError(reason))


Address = tuple[str, int]
"""The host and port of a server."""

_Key = tuple[str, str, str, Address]
"""What a kept connection is for: a node of this side, a service, the checksum of its type, and its server."""


class Ros1Callers:
    """Calls of remote services, and the connections that are kept for further calls."""

    def __init__(self, context: Ros1Context) -> None:
        self._context = context
        self._idle: dict[_Key, list[Ros1ServerConnection]] = {}
        self._all: set[Ros1ServerConnection] = set()

    async def call(self, node: str, service: str, kind: RosService, address: Address, request: bytes) -> bytes:
        """Call the server at this address. Raises NoServer or ServiceError."""
        key = (node, service, kind.checksum, address)
        connection = self._pop_idle(key)
        if connection is None:
            connection = await self._connect(node, service, kind, address)
        try:
            response = await connection.request(request)
        except ServiceError:
            self._keep(key, connection)  # closed, or an answer of the server
            raise
        except BaseException:  # cancelled: its answer would be taken for that of the next call
            connection.abort()
            raise
        self._keep(key, connection)
        return response

    async def probe(self, node: str, service: str, address: Address) -> RosService:
        """Ask the server at this address for its type. Raises NoServer or ServiceError."""
        connection = await self._open(service, address, caller_header(node, service, RosService("", ""), probe=True))
        fields = await self._answer(connection, service)
        connection.close()
        return RosService(fields.get("type", ""), fields.get("md5sum", ""))

    def forget(self, service: str) -> None:
        """Close the idle connections to a service without a server."""
        for key in [key for key in self._idle if key[1] == service]:
            for connection in self._idle.pop(key):
                connection.close()

    def close(self) -> None:
        """Close all connections; calls that wait raise ServiceError."""
        for connection in list(self._all):
            connection.abort()

    async def _connect(self, node: str, service: str, kind: RosService, address: Address) -> Ros1ServerConnection:
        connection = await self._open(service, address, caller_header(node, service, kind, persistent=True))
        fields = await self._answer(connection, service)
        refusal = refuse_server(fields, service, kind)
        if refusal:
            connection.abort()
            raise ServiceError(refusal)
        return connection

    async def _open(self, service: str, address: Address, header: Fields) -> Ros1ServerConnection:
        connection = Ros1ServerConnection(self._context)
        try:
            await asyncio.get_running_loop().create_connection(lambda: connection, *address)
        except asyncio.CancelledError:
            connection.abort()
            raise
        except OSError as error:
            where = f"{address[0]}:{address[1]}"
            raise NoServer(
                f"service [{service}] is registered at {where}, where nothing answers ({error}): its node has died,"
                " or that address can't be reached from this computer"
            ) from error
        if connection.transport is not None:
            connection.transport.write(encode_header(header))
        self._all = {each for each in self._all if each.transport is not None} | {connection}
        return connection

    async def _answer(self, connection: Ros1ServerConnection, service: str) -> Fields:
        try:
            fields = await connection.header
        except BaseException:
            connection.abort()
            raise
        if "error" in fields:
            connection.abort()
            raise ServiceError(f"service [{service}]: {fields['error']}")
        return fields

    def _pop_idle(self, key: _Key) -> Ros1ServerConnection | None:
        for connection in self._idle.pop(key, []):
            if connection.expires is not None:
                connection.expires.cancel()
            if connection.transport is not None and not connection.transport.is_closing():
                return connection
        return None

    def _keep(self, key: _Key, connection: Ros1ServerConnection) -> None:
        if connection.transport is None:
            return
        self._idle.setdefault(key, []).append(connection)
        connection.expires = asyncio.get_running_loop().call_later(KEEP_S, self._expire, key, connection)

    def _expire(self, key: _Key, connection: Ros1ServerConnection) -> None:
        idle = self._idle.get(key, [])
        if connection in idle:
            idle.remove(connection)
        if not idle:
            self._idle.pop(key, None)
        connection.close()
