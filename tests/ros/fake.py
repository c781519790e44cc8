"""An in-memory ROS network for tests: plain ROS nodes, and links of r2p modules, under virtual time.

    network = FakeRosNetwork(version=2)
    async with r2p.Module("PC1", via=network.transport(ns="/robot1")) as module: ...
    talker = network.node("/talker")
    talker.publish("/chatter", String(data="hello"))          advertises at the first message
    chatter = talker.subscribe("/chatter", String)            a list of what has arrived

It matches endpoints as ROS does: by topic, type and checksum, and by quality of service. Each publisher and subscriber
is an `Endpoint` of a participant, which is a ROS node or the middleware of a link.
"""

import asyncio
import itertools
from collections import Counter, deque
from collections.abc import Awaitable, Callable
from typing import Any

import msgspec

from r2p.errors import NoServer, ServiceError
from r2p.messages import Message, layout
from r2p.ros.cdr import cdr
from r2p.ros.classes import definitions_of
from r2p.ros.middleware import (
    Middleware,
    MiddlewareUser,
    Qos,
    RosArrival,
    RosEndpoint,
    RosGraph,
    RosPeerEndpoint,
    RosPeerServer,
    RosServer,
    RosService,
    RosType,
)
from r2p.ros.options import RosOptions
from r2p.ros.topics import ros_type
from r2p.ros.transport import RosTransport

QOS = Qos()


class Participant:
    """What takes part in the network: it gets arrivals of its subscribers, and calls of its servers."""

    def arrived(self, port: "Port", arrival: RosArrival) -> None: ...
    def matched(self, mine: "Port", other: "Port") -> None: ...
    def unmatched(self, mine: "Port", other: "Port") -> None: ...
    def graph_changed(self, graph: RosGraph) -> None: ...
    def requested(self, service: str, caller: str, request: bytes, answer: "asyncio.Future[bytes]") -> None: ...


class Port(msgspec.Struct, eq=False):
    """A registered publisher or subscriber."""

    owner: Any
    endpoint: RosEndpoint
    publishes: bool
    gid: bytes
    sent: int = 0
    kept: deque[RosArrival] = msgspec.field(default_factory=deque)
    held: deque[RosArrival] = msgspec.field(default_factory=deque)

    def fits(self, other: "Port") -> bool:
        """Return whether messages flow between the two."""
        publisher, subscriber = (self, other) if self.publishes else (other, self)
        offered, asked = publisher.endpoint.qos, subscriber.endpoint.qos
        mine, theirs = self.endpoint, other.endpoint
        return (
            publisher.publishes > subscriber.publishes
            and self.owner is not other.owner
            and (mine.topic, mine.type.name, mine.type.checksum)
            == (theirs.topic, theirs.type.name, theirs.type.checksum)
            and offered.reliable >= asked.reliable
            and offered.transient_local >= asked.transient_local
        )


class FakeRosNetwork:
    """The network, and the ROS graph in it. `log` lists what participants have registered, in order."""

    def __init__(self, version: int = 2) -> None:
        self.version = version
        self.log: list[str] = []
        self.ports: list[Port] = []
        self.nodes: dict[str, Any] = {}
        self.servers: dict[str, tuple[Any, RosServer]] = {}
        self.participants: list[Any] = []
        self.is_up = True
        self._gids = itertools.count(1)
        self._reports = False

    def transport(self, **options: Any) -> RosTransport:
        """Return a place for `Module(via=...)`, with the options of `RosOptions`."""
        name = f"ros{self.version}:"
        return RosTransport(name, lambda _hub: FakeMiddleware(self), RosOptions(**options))

    def node(self, name: str) -> "RosNode":
        """Add a plain ROS node."""
        return RosNode(self, name)

    def set_up(self, up: bool, reason: str = "the master is gone") -> None:
        """Let the network fail, for the links, or come back."""
        self.is_up = up
        for each in [each for each in self.participants if isinstance(each, FakeMiddleware)]:
            each.network_changed(up, reason)

    # For participants

    def join(self, participant: Any) -> None:
        self.participants.append(participant)
        self.changed()

    def leave(self, participant: Any) -> None:
        for port in [port for port in self.ports if port.owner is participant]:
            self.remove(port.owner, port.endpoint, publishes=port.publishes)
        self.nodes = {name: owner for name, owner in self.nodes.items() if owner is not participant}
        self.servers = {name: entry for name, entry in self.servers.items() if entry[0] is not participant}
        self.participants.remove(participant)
        self.changed()

    def add(self, owner: Any, endpoint: RosEndpoint, *, publishes: bool) -> Port:
        port = Port(owner, endpoint, publishes, next(self._gids).to_bytes(16, "little"))
        self.log.append(f"{'+pub' if publishes else '+sub'} {endpoint.node} {endpoint.topic} {endpoint.type.name}")
        self.ports.append(port)
        for other in [other for other in self.ports if port.fits(other)]:
            self._match(port, other)
        self.changed()
        return port

    def remove(self, owner: Any, endpoint: RosEndpoint, *, publishes: bool) -> None:
        port = next(
            each for each in self.ports if (each.owner, each.endpoint, each.publishes) == (owner, endpoint, publishes)
        )
        self.log.append(f"{'-pub' if publishes else '-sub'} {endpoint.node} {endpoint.topic}")
        self.ports.remove(port)
        for other in [other for other in self.ports if port.fits(other)]:
            self._soon(port.owner.unmatched, port, other)
            self._soon(other.owner.unmatched, other, port)
        self.changed()

    def _match(self, port: Port, other: Port) -> None:
        self._soon(port.owner.matched, port, other)
        self._soon(other.owner.matched, other, port)
        publisher, subscriber = (port, other) if port.publishes else (other, port)
        if subscriber.endpoint.qos.transient_local or self.version == 1:
            for arrival in publisher.kept:
                self._soon(subscriber.owner.arrived, subscriber, arrival)

    def send(self, port: Port, data: bytes, stamp: int) -> None:
        """Send a message of a publisher to all its subscribers, which get it in the next turn of the loop."""
        port.sent += 1
        endpoint = port.endpoint
        sequence, gid = (port.sent, port.gid) if self.version == 2 else (0, b"")
        arrival = RosArrival(endpoint.topic.encode(), bytes(data), endpoint.node, sequence, stamp, gid)
        if endpoint.qos.transient_local:
            port.kept.append(arrival)
            while len(port.kept) > max(1, endpoint.qos.depth):
                port.kept.popleft()
        for other in self.ports:
            if port.fits(other):
                self._soon(other.owner.arrived, other, arrival)

    def room(self, port: Port) -> bool:
        """Return whether each subscriber of a publisher has room for a message."""
        return all(len(each.held) < (each.endpoint.qos.depth or 1 << 30) for each in self.ports if port.fits(each))

    def changed(self) -> None:
        """Report the graph to all participants, once for all changes of this turn."""
        if not self._reports:
            self._reports = True
            asyncio.get_running_loop().call_soon(self._report)

    def _report(self) -> None:
        self._reports = False
        for participant in list(self.participants):
            participant.graph_changed(self.graph(participant))

    def graph(self, participant: Any = None) -> RosGraph:
        """Return what all others than this participant have."""

        def seen(publishes: bool) -> frozenset[RosPeerEndpoint]:
            return frozenset(
                RosPeerEndpoint(
                    each.endpoint.node,
                    each.endpoint.topic,
                    each.endpoint.type.name,
                    each.endpoint.type.checksum,
                    each.endpoint.qos if self.version == 2 else None,
                    each.gid if self.version == 2 else b"",
                )
                for each in self.ports
                if each.owner is not participant and each.publishes == publishes
            )

        servers = frozenset(
            RosPeerServer(server.node, server.service, server.type.name, server.type.checksum)
            for owner, server in self.servers.values()
            if owner is not participant
        )
        nodes = frozenset(name for name, owner in self.nodes.items() if owner is not participant)
        return RosGraph(nodes, seen(True), seen(False), servers)

    def call(self, service: str, caller: str, request: bytes) -> "asyncio.Future[bytes]":
        answer: asyncio.Future[bytes] = asyncio.get_running_loop().create_future()
        if service not in self.servers:
            answer.set_exception(NoServer(f"no ROS node serves {service}"))
        else:
            self._soon(self.servers[service][0].requested, service, caller, request, answer)
        return answer

    def _soon(self, function: Callable[..., object], *args: Any) -> None:
        asyncio.get_running_loop().call_soon(function, *args)


class RosNode(Participant):
    """A plain ROS node, which the test publishes and subscribes with. `received` has all arrivals by topic."""

    def __init__(self, network: FakeRosNetwork, name: str) -> None:
        self.name = name
        self.network = network
        self.classes: dict[str, type[Message]] = {}
        """The classes of its topics, whose definitions it gives to others."""
        self._publishers: dict[str, Port] = {}
        self._subscribers: dict[int, tuple[type[Message] | None, list[Any]]] = {}
        self._handlers: dict[str, Callable[[bytes], Awaitable[bytes]]] = {}
        network.nodes[name] = self
        network.join(self)

    def advertise(self, topic: str, cls: type[Message], qos: Qos = QOS, type: RosType | None = None) -> None:
        """Begin to publish a topic."""
        self.classes[topic] = cls
        endpoint = RosEndpoint(self.name, topic, type or ros_type(cls, self.network.version), qos)
        self._publishers[topic] = self.network.add(self, endpoint, publishes=True)

    def publish(self, topic: str, message: Message | bytes, qos: Qos = QOS) -> None:
        """Publish a message, or these bytes of one that was advertised."""
        if topic not in self._publishers and isinstance(message, Message):
            self.advertise(topic, type(message), qos)
        data = message if isinstance(message, bytes) else _encode(message, self.network.version)
        self.network.send(self._publishers[topic], data, 0)

    def subscribe(
        self, topic: str, cls: type[Message], qos: Qos = QOS, type: RosType | None = None, *, raw: bool = False
    ) -> list[Any]:
        """Subscribe to a topic; the list grows with each message. `raw`: with each `RosArrival`."""
        endpoint = RosEndpoint(self.name, topic, type or ros_type(cls, self.network.version), qos)
        received: list[Any] = []
        port = self.network.add(self, endpoint, publishes=False)
        self._subscribers[id(port)] = None if raw else cls, received
        return received

    def serve(self, service: str, type: RosService, handler: Callable[[bytes], Awaitable[bytes]]) -> None:
        """Serve a service; what the handler raises is the error of the call, whose end cancels it."""
        self._handlers[service] = handler
        self.network.servers[service] = self, RosServer(self.name, service, type)
        self.network.changed()

    def call(self, service: str, request: bytes) -> Awaitable[bytes]:
        """Call a service."""
        return self.network.call(service, self.name, request)

    def close(self) -> None:
        """End the node."""
        self.network.leave(self)

    def arrived(self, port: Port, arrival: RosArrival) -> None:
        cls, received = self._subscribers[id(port)]
        received.append(arrival if cls is None else _decode(cls, arrival.data, self.network.version))

    def requested(self, service: str, caller: str, request: bytes, answer: "asyncio.Future[bytes]") -> None:
        task = asyncio.create_task(self._handle(service, request, answer))
        answer.add_done_callback(lambda _: task.cancel())

    async def _handle(self, service: str, request: bytes, answer: "asyncio.Future[bytes]") -> None:
        try:
            data = await self._handlers[service](request)
        except Exception as error:  # noqa: BLE001 - the caller gets it
            answer.set_exception(ServiceError(str(error)))
        else:
            answer.set_result(data)


class FakeMiddleware(Middleware, Participant):
    """The middleware of one link on the network."""

    def __init__(self, network: FakeRosNetwork) -> None:
        self.version = network.version
        self.lost = Counter()
        self.network = network
        self.user: MiddlewareUser | None = None
        self._publishers: dict[tuple[str, str], Port] = {}
        self._matches: Counter[tuple[str, bool]] = Counter()
        self._is_paused = False
        self._held: deque[RosArrival] = deque()
        self._was_full = False
        self._to_register: list[tuple[RosEndpoint, bool]] = []
        self._registered: list[tuple[RosEndpoint, bool]] = []

    async def run(self, user: MiddlewareUser, opened: Callable[[], object]) -> None:
        self.user = user
        self.network.join(self)
        self.network_changed(self.network.is_up, "the master does not answer")
        opened()
        try:
            await asyncio.get_running_loop().create_future()
        finally:
            self.user = None
            self.network.leave(self)

    def network_changed(self, up: bool, reason: str) -> None:
        assert self.user is not None
        if up:
            self.user.middleware_up()
            waiting, self._to_register = self._to_register, []
            for endpoint, publishes in waiting:
                self._add(endpoint, publishes=publishes)
            self.network.changed()
            return
        self.user.middleware_waits(reason)
        self.user.middleware_down(reason)
        for endpoint, publishes in list(self._registered):
            self._remove(endpoint, publishes=publishes)
            self._to_register.append((endpoint, publishes))
        self._matches.clear()

    async def describe(self, endpoint: RosPeerEndpoint) -> str:
        """Ask the node for the definition of its type; a few milliseconds later it has answered."""
        await asyncio.sleep(0.005)
        owner = self.network.nodes.get(endpoint.node)
        cls = owner.classes.get(endpoint.topic) if isinstance(owner, RosNode) else None
        if cls is None:
            return ""
        first, *others = definitions_of(cls, self.version).values()
        return "".join([first.text, *(f"{'=' * 80}\nMSG: {each.name}\n{each.text}" for each in others)])

    # Registrations

    def add_node(self, node: str) -> None:
        assert node not in self.network.nodes, node
        self.network.nodes[node] = self
        self.network.log.append(f"+node {node}")
        self.network.changed()

    def remove_node(self, node: str) -> None:
        assert self.network.nodes.pop(node) is self
        self.network.log.append(f"-node {node}")
        self.network.changed()

    def advertise(self, endpoint: RosEndpoint) -> None:
        self._register(endpoint, publishes=True)

    def withdraw(self, endpoint: RosEndpoint) -> None:
        self._unregister(endpoint, publishes=True)

    def subscribe(self, endpoint: RosEndpoint) -> None:
        self._register(endpoint, publishes=False)

    def unsubscribe(self, endpoint: RosEndpoint) -> None:
        self._unregister(endpoint, publishes=False)

    def _register(self, endpoint: RosEndpoint, *, publishes: bool) -> None:
        assert endpoint.node in self.network.nodes, "a node is added before what it has"
        if self.user is not None and self.network.is_up:
            self._add(endpoint, publishes=publishes)
        else:
            self._to_register.append((endpoint, publishes))

    def _unregister(self, endpoint: RosEndpoint, *, publishes: bool) -> None:
        if (endpoint, publishes) in self._to_register:
            self._to_register.remove((endpoint, publishes))
        elif self.user is not None:
            self._remove(endpoint, publishes=publishes)

    def _add(self, endpoint: RosEndpoint, *, publishes: bool) -> None:
        port = self.network.add(self, endpoint, publishes=publishes)
        self._registered.append((endpoint, publishes))
        if publishes:
            self._publishers[endpoint.node, endpoint.topic] = port

    def _remove(self, endpoint: RosEndpoint, *, publishes: bool) -> None:
        self.network.remove(self, endpoint, publishes=publishes)
        self._registered.remove((endpoint, publishes))
        if publishes:
            self._publishers.pop((endpoint.node, endpoint.topic), None)

    # Messages

    def publish(self, node: str, topic: str, data: bytes, stamp: int) -> None:
        port = self._publishers.get((node, topic))
        if port is None:
            self.lost["not advertised"] += 1
            return
        self.network.send(port, data, stamp)

    @property
    def full(self) -> bool:
        self._was_full = not all(map(self.network.room, self._publishers.values()))
        return self._was_full

    def pause(self) -> None:
        self._is_paused = True

    def resume(self) -> None:
        self._is_paused = False
        held, self._held = list(self._held), deque()
        if held and self.user is not None:
            self.user.received(held)

    def arrived(self, port: Port, arrival: RosArrival) -> None:
        first = next(each for each in self.network.ports if each.owner is self and _same(each, port))
        if port is not first:  # several nodes subscribe: it arrives once
            return
        if self._is_paused:
            self._held.append(arrival)
        elif self.user is not None:
            self.user.received([arrival])

    # The graph

    def matched(self, mine: Port, other: Port) -> None:
        key = mine.endpoint.topic, mine.publishes
        self._matches[key] += 1
        if self.user is None:
            return
        if mine.publishes:
            self.user.subscriber_joined(mine.endpoint.topic)
        else:
            kind = other.endpoint.type
            definition = kind.definition if self.version == 1 else ""
            latched = other.endpoint.qos.transient_local
            self.user.publisher_found(mine.endpoint.topic, other.endpoint.node, kind.name, definition, latched=latched)

    def unmatched(self, mine: Port, other: Port) -> None:
        key = mine.endpoint.topic, mine.publishes
        self._matches[key] -= 1
        if self.user is None:
            return
        if not mine.publishes:
            others = [each for each in self.network.ports if each.fits(mine)]
            if other.endpoint.node not in {each.endpoint.node for each in others}:
                self.user.publisher_gone(mine.endpoint.topic, other.endpoint.node)
        elif self._matches[key] <= 0:
            self.user.subscribers_gone(mine.endpoint.topic)

    def graph_changed(self, graph: RosGraph) -> None:
        if self.user is not None and self.network.is_up:
            self.user.graph_changed(graph)

    # Services

    def serve(self, server: RosServer) -> None:
        assert server.service not in self.network.servers, f"two servers of {server.service}"
        self.network.servers[server.service] = self, server
        self.network.changed()

    def unserve(self, server: RosServer) -> None:
        self.network.servers.pop(server.service, None)
        self.network.changed()

    def call(self, node: str, service: str, type: RosService, request: bytes, timeout: float) -> Awaitable[bytes]:
        return asyncio.wait_for(self.network.call(service, node, request), timeout)

    def requested(self, service: str, caller: str, request: bytes, answer: "asyncio.Future[bytes]") -> None:
        def succeed(data: bytes) -> None:
            if not answer.done():
                answer.set_result(data)

        def fail(text: str) -> None:
            if not answer.done():
                answer.set_exception(ServiceError(text))

        if self.user is not None:
            cancel = self.user.requested(service, caller, request, succeed, fail)
            answer.add_done_callback(lambda done: cancel() if done.cancelled() else None)


def _same(one: Port, other: Port) -> bool:
    return (one.publishes, one.endpoint.topic) == (other.publishes, other.endpoint.topic)


def _encode(message: Message, version: int) -> bytes:
    return message.encode() if version == 1 else cdr(type(message)).encode(message)


def _decode(cls: type[Message], data: bytes, version: int) -> Message:
    return layout(cls).decode(data) if version == 1 else cdr(cls).decode(data)
