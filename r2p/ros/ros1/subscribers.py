"""Subscriptions: a connection to each remote publisher of a topic, made again until the master takes it off its list.

A topic is received once, however many of this side's nodes subscribe to it: the connections name the first one of them.
"""

import asyncio
import socket
from collections.abc import Iterable

from r2p.clock import Backoff, real_clock, real_time
from r2p.ros.middleware import RosArrival, RosEndpoint, RosType
from r2p.ros.ros1.connections import Ros1Context, TcprosConnection
from r2p.ros.ros1.slave import request_topic
from r2p.ros.ros1.tcpros import ANY, MESSAGE_MAX, Fields, encode_header, refuse_publisher, subscriber_header
from r2p.ros.ros1.xmlrpc import XmlRpcClient, XmlRpcError
from r2p.units import SECOND

CONNECT_S = 5.0
"""Seconds for a publisher to answer a request, or to accept a connection."""

RETRY_S = 5.0
"""The longest time between two attempts to connect to a publisher."""

REPORT_S = 2.0
"""Seconds for which a publisher can't be reached until that is counted and reported: one that ends closes its
connections before the master says so.
"""

_STABLE_S = 3.0  # seconds; a connection that lived as long was a good one: the next is tried at once


class PublisherConnection(TcprosConnection):
    """A connection to a remote publisher, and the messages that come from it."""

    def __init__(self, subscription: "Ros1Subscription", uri: str) -> None:
        super().__init__(subscription.context)
        self.uri = uri
        """The publisher's slave API."""
        self.node = ""
        """The publisher's node, as its header says."""
        self.open = False
        """True once messages are received."""
        self.received = 0
        self.bytes_received = 0
        self.topic = subscription.topic
        self._subscription = subscription
        self._key = subscription.topic.encode()
        self._gid = uri.encode()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        subscription = self._subscription
        if self.transport is not None and not self.transport.is_closing() and subscription.endpoints:
            header = subscriber_header(subscription.node, subscription.topic, subscription.type)
            self.transport.write(encode_header(header))

    def data_received(self, data: bytes) -> None:
        if not self.open:
            super().data_received(data)
            return
        # In one go, as this is done for each message.
        topic, node, gid = self._key, self.node, self._gid
        arrivals = [RosArrival(topic, each, node, 0, 0, gid) for each in self.reader.feed(data)]
        if arrivals:
            self.received += len(arrivals)
            self.bytes_received += len(data)
            self.context.user.received(arrivals)
        if self.reader.broken:
            self._break()
        elif self.context.paused and self.transport is not None:
            self.context.hold(self.transport)

    def on_header(self, fields: Fields) -> None:
        subscription = self._subscription
        refusal = refuse_publisher(fields, subscription.topic, subscription.type)
        if refusal:
            if "error" in fields:
                refusal = f"the publisher of [{subscription.topic}] at {self.uri} refuses this node: {refusal}"
            self.context.refuse(subscription.topic, refusal)
            self.close()
            return
        self.node = fields.get("callerid", "")
        self.open = True
        self.reader.limit = MESSAGE_MAX
        subscription.opened(self, fields)
        self.data_received(b"")

    def on_failure(self, reason: str) -> None:
        self.context.lost["bad connection header"] += 1

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        if self.open:
            self.open = False
            self._subscription.closed(self)

    def _break(self) -> None:
        self.context.lost["too long"] += 1
        text = f"{self.node or self.uri}: [{self._subscription.topic}]: a message is too long: {self.reader.broken}"
        self.context.user.notice(f"too long: {self._subscription.topic}", text, trouble=True)
        self.abort()


class DefinitionQuery(TcprosConnection):
    """A connection that is made for the definition of a publisher's type only."""

    def __init__(self, context: Ros1Context, node: str, topic: str) -> None:
        super().__init__(context)
        self.definition = ""
        """The definition; empty if the publisher did not give it."""
        self._header = subscriber_header(node, topic, RosType(ANY, ANY))

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        assert self.transport is not None
        self.transport.write(encode_header(self._header))

    def on_header(self, fields: Fields) -> None:
        self.definition = fields.get("message_definition", "")
        self.abort()


async def definition_of(context: Ros1Context, client: XmlRpcClient, uri: str, node: str, topic: str) -> str:
    """Ask the publisher with this slave URI for the definition of its type, as a node of this side.

    Raises XmlRpcError if it does not publish the topic, and OSError if it can't be reached.
    """
    host, port = await request_topic(client, uri, node, topic, CONNECT_S)
    query = DefinitionQuery(context, node, topic)
    try:
        async with asyncio.timeout(CONNECT_S):
            await asyncio.get_running_loop().create_connection(lambda: query, host, port)
            await query.ended
    finally:
        query.abort()
    return query.definition


class Ros1Subscription:
    """A topic that nodes of this side subscribe to."""

    def __init__(self, context: Ros1Context, client: XmlRpcClient, topic: str) -> None:
        self.context = context
        self.topic = topic
        self.endpoints: list[RosEndpoint] = []
        """The subscribers of this side's nodes; the first one decides the type."""
        self.connections: dict[str, PublisherConnection] = {}
        """Connections that are open, by the publisher's slave URI."""
        self._client = client
        self._tasks: dict[str, asyncio.Task[None]] = {}

    @property
    def node(self) -> str:
        """The node in whose name connections are made."""
        return self.endpoints[0].node if self.endpoints else ""

    @property
    def type(self) -> RosType:
        """The type that is received."""
        return self.endpoints[0].type

    def update(self, publishers: Iterable[str]) -> None:
        """Connect to these publishers (slave URIs), and to no others."""
        wanted = set(publishers)
        for uri in self._tasks.keys() - wanted:
            self._drop(uri)
        with real_time():
            for uri in wanted - self._tasks.keys():
                self._tasks[uri] = asyncio.get_running_loop().create_task(self._follow(uri))

    def opened(self, connection: PublisherConnection, fields: Fields) -> None:
        """Note that messages come on a connection from now on."""
        self.connections[connection.uri] = connection
        kind, text = fields.get("type", ""), fields.get("message_definition", "")
        latched = fields.get("latching") == "1"
        self.context.user.publisher_found(self.topic, connection.node, kind, text, latched=latched)

    def closed(self, connection: PublisherConnection) -> None:
        """Note that a connection is gone."""
        if self.connections.get(connection.uri) is connection:
            del self.connections[connection.uri]
            if all(each.node != connection.node for each in self.connections.values()):
                self.context.user.publisher_gone(self.topic, connection.node)

    def reconnect(self) -> None:
        """Make all connections anew: this side's type is another one."""
        for connection in list(self.connections.values()):
            connection.abort()

    def close(self) -> None:
        """Close all connections, and make no more."""
        for uri in list(self._tasks):
            self._drop(uri)

    def _drop(self, uri: str) -> None:
        self._tasks.pop(uri).cancel()
        connection = self.connections.get(uri)
        if connection is not None:
            connection.abort()
            self.closed(connection)

    async def _follow(self, uri: str) -> None:
        """Connect to a publisher, again and again, until cancelled."""
        backoff = Backoff(self.context.random, longest=RETRY_S)
        now = real_clock().monotonic
        worked_at = now()
        while True:
            began = now()
            try:
                await self._receive_from(uri)
                worked_at = now()
            except (OSError, XmlRpcError) as error:
                if now() - worked_at >= REPORT_S * SECOND or isinstance(error, socket.gaierror):
                    self._report(uri, error)
            except Exception as error:  # noqa: BLE001 - counted and logged; the next attempt follows
                self.context.internal_error(error)
            if now() - began >= _STABLE_S * SECOND:
                backoff.reset()
            await asyncio.sleep(backoff.delay())

    async def _receive_from(self, uri: str) -> None:
        """Run one connection from beginning to end."""
        loop = asyncio.get_running_loop()
        host, port = await request_topic(self._client, uri, self.node, self.topic, CONNECT_S)
        connection = PublisherConnection(self, uri)
        try:
            async with asyncio.timeout(CONNECT_S):
                await loop.create_connection(lambda: connection, host, port)
            await connection.ended
        finally:
            connection.abort()

    def _report(self, uri: str, error: Exception) -> None:
        """Report why a publisher can't be received."""
        kind = f"no connection: {self.topic}"
        if isinstance(error, socket.gaierror):
            text = (
                f"[{self.topic}] has a publisher at {uri}, a name that this computer can't resolve: on its computer set"
                " ROS_IP to its address, or add the name to /etc/hosts here"
            )
        elif isinstance(error, TimeoutError):
            text = f"[{self.topic}]: the publisher at {uri} does not answer: is a firewall between the computers?"
        elif isinstance(error, OSError):
            text = f"[{self.topic}]: the publisher at {uri} is registered, but nothing answers there: its node has died"
            text += " (rosnode cleanup removes it), or it is on a computer that can't be reached from here"
        else:
            text = f"[{self.topic}]: {error}"
        self.context.lost["no connection to a publisher"] += 1
        self.context.user.notice(kind, text, trouble=not isinstance(error, ConnectionRefusedError))
