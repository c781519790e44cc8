"""ROS 1 as the middleware of a link: the master and slave API on one side, TCPROS on the other.

    RosLink  ->  Ros1Middleware    ->  MasterSession            what nodes have, and what others have (XMLRPC)
                                   ->  Ros1Publication          messages out
                                   ->  Ros1Server, Ros1Callers  services
    RosLink  <-  Ros1Subscription  <-  PublisherConnection      messages in

Each of the link's nodes has a slave server and a TCPROS listener of its own, as a node in a process of its own has.
Connections go on while the master is gone: it only brings nodes together.
"""

import asyncio
import contextlib
from collections import Counter
from collections.abc import Callable, Iterable

from r2p.clock import Backoff
from r2p.errors import NoServer
from r2p.ros.middleware import (
    Middleware,
    MiddlewareUser,
    RosEndpoint,
    RosGraph,
    RosPeerEndpoint,
    RosServer,
    RosService,
)
from r2p.ros.ros1.connections import Ros1Context, TcprosConnection, TcprosListener
from r2p.ros.ros1.environment import RosAddress
from r2p.ros.ros1.master import MasterError
from r2p.ros.ros1.probes import PROBE_S, ServiceProbes
from r2p.ros.ros1.publishers import Ros1Publication, SubscriberConnection
from r2p.ros.ros1.registration import MasterSession
from r2p.ros.ros1.services import Ros1Callers, Ros1Server
from r2p.ros.ros1.slave import BusConnection
from r2p.ros.ros1.subscribers import PublisherConnection, Ros1Subscription, definition_of
from r2p.ros.ros1.tcpros import ANY
from r2p.ros.ros1.xmlrpc import XmlRpcError

CLOSE_S = 1.0
"""Seconds in which subscribers get what still waits for them when the middleware ends."""


class Ros1Middleware(Middleware):
    """A connection of a link to a ROS 1 network."""

    version = 1

    def __init__(self, address: RosAddress, lost: Counter[str] | None = None) -> None:
        self._context = Ros1Context(Counter() if lost is None else lost)
        self._address = address
        self.session = MasterSession(address, self, self._context.lost)
        """What talks to the master."""
        self._listeners: dict[str, TcprosListener] = {}
        self._publications: dict[tuple[str, str], Ros1Publication] = {}
        self._subscriptions: dict[str, Ros1Subscription] = {}
        self._publishers: dict[tuple[str, str], list[str]] = {}
        """The slave URIs of each topic's publishers, by what the master has last reported to which node and topic."""
        self._servers: dict[tuple[str, str], Ros1Server] = {}
        self._callers = Ros1Callers(self._context)
        self._probes = ServiceProbes(self._context, self._probe, lambda: self.session.poll_soon())
        self._closing: set[TcprosConnection] = set()

    @property
    def lost(self) -> Counter[str]:
        """The link's counter of losses, by reason."""
        return self._context.lost

    @lost.setter
    def lost(self, lost: Counter[str]) -> None:
        self._context.lost = self.session.lost = lost

    async def run(self, user: MiddlewareUser, opened: Callable[[], object]) -> None:
        self._context.begin(user)
        for listener in self._listeners.values():
            listener.start()
        asked = asyncio.get_running_loop().create_task(self._ask_keepalive())
        try:
            await self.session.run(user, opened)
        finally:
            asked.cancel()
            self._probes.close()
            await self._close()

    def set_sim_time(self) -> None:
        self.session.hold_parameter("/use_sim_time", True)

    # Nodes

    def add_node(self, node: str) -> None:
        if node not in self._listeners:
            self._listeners[node] = listener = TcprosListener(node, self._address.bind, self._context)
            if self._context.running:
                listener.start()
        self.session.add_node(node)

    def remove_node(self, node: str) -> None:
        for publication in [each for each in self._publications.values() if each.endpoint.node == node]:
            self.withdraw(publication.endpoint)
        for subscription in list(self._subscriptions.values()):
            for endpoint in [each for each in subscription.endpoints if each.node == node]:
                self.unsubscribe(endpoint)
        for server in [each for each in self._servers.values() if each.server.node == node]:
            self.unserve(server.server)
        self.session.remove_node(node)
        listener = self._listeners.pop(node, None)
        if listener is not None:
            listener.close()

    # Topics out

    def advertise(self, endpoint: RosEndpoint) -> None:
        node, topic = endpoint.node, endpoint.topic
        before = self._publications.get((node, topic))
        if before is not None and before.endpoint.type == endpoint.type:
            before.change(endpoint)
            return
        if before is not None:
            self._end(before)
        publication = self._publications[node, topic] = Ros1Publication(endpoint, self._context)
        self._listeners[node].topics[topic] = publication
        self.session.advertise(node, topic, endpoint.type.name)

    def withdraw(self, endpoint: RosEndpoint) -> None:
        node, topic = endpoint.node, endpoint.topic
        publication = self._publications.get((node, topic))
        if publication is None or publication.endpoint != endpoint:
            return  # another one has replaced it
        del self._publications[node, topic], self._listeners[node].topics[topic]
        self.session.withdraw(node, topic)
        self._end(publication)

    def publish(self, node: str, topic: str, data: bytes, stamp: int) -> None:
        publication = self._publications.get((node, topic))
        if publication is not None:
            publication.publish(data)

    @property
    def full(self) -> bool:
        return bool(self._context.without_room)

    # Topics in

    def subscribe(self, endpoint: RosEndpoint) -> None:
        subscription = self._subscriptions.get(endpoint.topic)
        if subscription is None:
            subscription = Ros1Subscription(self._context, self.session.client, endpoint.topic)
            self._subscriptions[endpoint.topic] = subscription
        subscription.endpoints.append(endpoint)
        self.session.subscribe(endpoint.node, endpoint.topic, endpoint.type.name or ANY)

    def unsubscribe(self, endpoint: RosEndpoint) -> None:
        node, topic = endpoint.node, endpoint.topic
        subscription = self._subscriptions.get(topic)
        if subscription is None or endpoint not in subscription.endpoints:
            return
        before = subscription.type
        subscription.endpoints.remove(endpoint)
        if all(each.node != node for each in subscription.endpoints):
            self.session.unsubscribe(node, topic)
            self._publishers.pop((node, topic), None)
        if not subscription.endpoints:
            del self._subscriptions[topic]
            subscription.close()
        else:
            if subscription.type != before:
                subscription.reconnect()
            self._connect(subscription)

    async def describe(self, endpoint: RosPeerEndpoint) -> str:
        session, node = self.session, self._any_node()
        try:
            uri = await session.master.lookup_node(node, endpoint.node)
            return await definition_of(self._context, session.client, uri, node, endpoint.topic)
        except (OSError, XmlRpcError, MasterError):  # a subscriber, or a node that has just ended
            return ""

    def pause(self) -> None:
        self._context.paused = True

    def resume(self) -> None:
        self._context.resume()

    # Services

    def serve(self, server: RosServer) -> None:
        node, service = server.node, server.service
        before = self._servers.get((node, service))
        if before is not None:
            before.close()
        listener = self._listeners[node]
        self._servers[node, service] = listener.services[service] = Ros1Server(server, self._context)
        self.session.serve(node, service, listener.port)

    def unserve(self, server: RosServer) -> None:
        node, service = server.node, server.service
        known = self._servers.get((node, service))
        if known is None or known.server != server:
            return
        del self._servers[node, service], self._listeners[node].services[service]
        self.session.unserve(node, service)
        known.close()

    async def call(self, node: str, service: str, type: RosService, request: bytes, timeout: float) -> bytes:
        async with asyncio.timeout(timeout):
            try:
                address = await self.session.find_service(node, service, timeout)
            except NoServer:
                self._callers.forget(service)
                raise
            return await self._callers.call(node, service, type, address, request)

    # For the slave API

    def publishers_changed(self, node: str, topic: str, publishers: list[str]) -> None:
        """Connect to these publishers, as reported to the first of the nodes that subscribe to the topic."""
        subscription = self._subscriptions.get(topic)
        if subscription is not None:
            self._publishers[node, topic] = publishers
            self._connect(subscription)

    def tcpros_port(self, node: str, topic: str) -> int | None:
        """Return the port where the node's publisher of a topic accepts connections; None: it has none."""
        return self._listeners[node].port if (node, topic) in self._publications else None

    def connections(self, node: str) -> Iterable[BusConnection]:
        """Return all connections of topics that a node has."""
        for publication in self._publications.values():
            if publication.endpoint.node == node:
                yield from map(_outgoing, publication.connections)
        for subscription in self._subscriptions.values():
            if any(each.node == node for each in subscription.endpoints):
                yield from map(_incoming, subscription.connections.values())

    def complete_graph(self, graph: RosGraph) -> RosGraph:
        """Return the graph with the types of services, which the master does not know."""
        return self._probes.complete(graph)

    async def _probe(self, service: str) -> RosService:
        node = self._any_node()
        address = await self.session.find_service(node, service, PROBE_S)
        return await self._callers.probe(node, service, address)

    def _connect(self, subscription: Ros1Subscription) -> None:
        """Connect to the publishers of a topic."""
        publishers = self._publishers.get((subscription.node, subscription.topic))
        if publishers is not None:
            subscription.update(publishers)

    async def _ask_keepalive(self) -> None:
        """Disable keep-alive on new connections if the parameter /tcp_keepalive is false."""
        backoff = Backoff(self._context.random)
        while True:
            try:
                value = await self.session.master.get_param(self._any_node(), "/tcp_keepalive")
                self._context.keepalive = bool(value)
            except MasterError:  # it is not set
                return
            except (OSError, XmlRpcError):  # the session says what is wrong with the master
                await asyncio.sleep(backoff.delay())
            else:
                return

    def _any_node(self) -> str:
        """Return a node in whose name something is asked."""
        return next(iter(self._listeners), "/r2p")

    # The end

    def _end(self, publication: Ros1Publication) -> None:
        """Close the connections of a publication when what waits is sent."""
        self._closing.difference_update([each for each in self._closing if each.transport is None])
        self._closing.update(publication.connections)
        publication.close()

    async def _close(self) -> None:
        """Close everything, and wait a little until subscribers have what was published."""
        for listener in self._listeners.values():
            listener.close()
        for subscription in self._subscriptions.values():
            subscription.close()
        for server in self._servers.values():
            server.close()
        self._callers.close()
        for publication in self._publications.values():
            self._end(publication)
        try:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(CLOSE_S):
                    await asyncio.gather(*(each.ended for each in self._closing if each.transport is not None))
        finally:
            for connection in self._closing:
                connection.abort()


def _outgoing(connection: SubscriberConnection) -> BusConnection:
    lost = f", {connection.dropped} messages dropped" if connection.dropped else ""
    topic, text = connection.topic, f"TCPROS connection to {connection.peer}{lost}"
    sent = connection.bytes_sent, connection.sent
    return BusConnection(connection.number, topic, connection.node, "o", True, *sent, text)


def _incoming(connection: PublisherConnection) -> BusConnection:
    topic, text = connection.topic, f"TCPROS connection to {connection.peer}"
    received = connection.bytes_received, connection.received
    return BusConnection(connection.number, topic, connection.uri, "i", True, *received, text)
