"""The services of r2p on a ROS network, in both roles: each is two topics here, NAME_q and NAME_r, and `/NAME` there.

    client here               its message on NAME_q, for the link to write  ->  RosCalls  ->  a server of a ROS node
    server of this module     a request of a ROS node  ->  RosRequests  ->  ServiceServer.submit
    server behind a gateway   the same  ->  RosRequests  ->  NAME_q; its answer on NAME_r is for the link to write

For modules here, a server of a ROS node is one that subscribes to NAME_q and publishes NAME_r: so discovery shows it,
clients find it, and gateways pass its service on. Services that each node of ROS has, for its parameters and its log,
are left out, except for those that have a client here.
"""

import functools
from typing import Any, Protocol, cast

import msgspec

from r2p.codecs import services
from r2p.codecs.management import ROLE_PUBLISHES, ROLE_SUBSCRIBES
from r2p.codecs.services import HEADER_SIZE, REQUESTS, RESPONSES, ServiceHeader
from r2p.errors import DecodeError, MessageError
from r2p.messages import Layout, Message, layout
from r2p.names import SERVICE_SUFFIXES
from r2p.protocols.discovery.events import Event, TopicType
from r2p.ros import std_srvs
from r2p.ros.action_types import SEND_GOAL, CancelGoal
from r2p.ros.discovery import RosDiscovery
from r2p.ros.graph_names import GraphNames
from r2p.ros.middleware import (
    Answer,
    Cancel,
    Middleware,
    Refuse,
    RosGraph,
    RosPeerEndpoint,
    RosPeerServer,
    RosServer,
    nothing_to_cancel,
)
from r2p.ros.options import RosOptions, lookup
from r2p.ros.registrations import CALLS, SERVES, TYPE_UNKNOWN, NotOnRos, Registrations, RosClient
from r2p.ros.service_calls import UNKNOWN_LIFETIME, CarriedService, RosCalls, RosRequests
from r2p.ros.service_types import RosServiceCodec, ServiceShape, service_codec, service_shape, service_type
from r2p.ros.topics import is_of_action
from r2p.runtime.sample import PublisherClass, Sample, Source
from r2p.services.definition import Definition, define
from r2p.services.server import server_of
from r2p.services.servers import KnownServers
from r2p.transports.link import Hub
from r2p.units import MILLISECOND

_OF_EACH_NODE = frozenset({"rcl_interfaces", "type_description_interfaces", "roscpp"})
"""Packages of the services that each node has."""


class ServiceArrival(msgspec.Struct, frozen=True, gc=False):
    """A message on NAME_q or NAME_r, on its way to this module; `lifetime` in ns, 0: unknown."""

    topic: bytes
    data: bytes
    lifetime: int


class ServiceLink(Protocol):
    """The link, as its services see it."""

    name: str
    middleware: Middleware
    names: GraphNames
    options: RosOptions

    def class_of(self, topic: str) -> type[Message] | None:
        """Return the class of a topic, which other modules may be asked for; None until it is known."""

    def key(self, topic: str) -> bytes:
        """Return what names a topic in an arrival."""

    def receive(self, arrivals: list[ServiceArrival]) -> None:
        """Deliver messages."""

    def notice(self, kind: str, text: str, *, trouble: bool) -> None:
        """Report something to the user."""


class RosServices:
    """The services of one link."""

    def __init__(self, link: ServiceLink, hub: Hub, discovery: RosDiscovery, registrations: Registrations) -> None:
        self._link = link
        self._space = hub.space
        self._discovery = discovery
        self._registrations = registrations
        loop, lost = hub.space.loop, discovery.counts
        self.not_on_ros = NotOnRos("service ", loop, lost, link.notice)
        self._calls = RosCalls(link.middleware, loop, self._deliver, self._report, lost)
        self._requests = RosRequests(hub.random.getrandbits(32) | 1, loop, self._deliver, lost)
        self._carried: dict[str, CarriedService] = {}
        self._by_ros_name: dict[str, CarriedService] = {}
        self._graph = RosGraph()
        self._source = Source(link=link.name)
        self._sequence = 0
        self._instances: frozenset[int | None] = frozenset()
        self._generation = -1

    def close(self) -> None:
        """End all calls."""
        self.not_on_ros.close()
        self._calls.close()
        self._requests.close()

    # What is on the network

    def graph_with_services(self, graph: RosGraph) -> RosGraph:
        """Return a graph in which servers of ROS nodes have the two topics of their service."""
        self._graph = graph
        shown = [each for each in graph.servers if not _is_of_each_node(each) or self._has_client(each)]
        return msgspec.structs.replace(
            graph,
            publishers=graph.publishers | {_as_endpoint(each, RESPONSES) for each in shown},
            subscribers=graph.subscribers | {_as_endpoint(each, REQUESTS) for each in shown},
        )

    def _has_client(self, server: RosPeerServer) -> bool:
        name = self._link.names.from_ros(server.service)
        return name is not None and self._is_called(name)

    def _is_called(self, name: str) -> bool:
        own = self._discovery.own
        return (name + REQUESTS, ROLE_PUBLISHES) in own and (name + RESPONSES, ROLE_SUBSCRIBES) in own

    def _is_served(self, name: str) -> bool:
        own = self._discovery.own
        return (name + REQUESTS, ROLE_SUBSCRIBES) in own and (name + RESPONSES, ROLE_PUBLISHES) in own

    def review(self, topic: str) -> list[Event]:
        """Register the service of one of its two topics as it is now used, or remove it; return what follows."""
        name = topic[: -len(REQUESTS)]
        ros_name = self._link.names.to_ros(name)
        called, served = self._is_called(name), self._is_served(name)
        codec = self._codec(name) if ros_name is not None and (called or served) else None
        if codec is None or ros_name is None:
            self._forget(name)
            self._show_type(name)
            return self._connect(name, called=False, served=False)
        service = self._carried.get(name)
        if service is None or service.codec is not codec:
            known = KnownServers(self._space, codec.shape.definition(name))
            service = CarriedService(name, ros_name, codec, known)
            self._carried[name] = self._by_ros_name[ros_name] = service
        elif service.serves and not served:
            self._requests.end(name, f"{ros_name} is not served any more")
        service.calls, service.serves = called, served
        self._register(service)
        events = self._connect(name, called=called and self._has_fitting_server(service), served=served)
        if called and any(each.service == ros_name and _is_of_each_node(each) for each in self._graph.servers):
            events += self._discovery.graph_changed(
                self._space.clock.monotonic(), self.graph_with_services(self._graph)
            )
        return events

    def _forget(self, name: str) -> None:
        service = self._carried.pop(name, None)
        if service is not None:
            del self._by_ros_name[service.ros_name]
            self._requests.end(name, f"{service.ros_name} is not served any more")
        self._registrations.declare(name, SERVES, set())
        self._registrations.declare(name, CALLS, set())

    def _register(self, service: CarriedService) -> None:
        """Register the server, and the nodes of the clients."""
        name, ros_name = service.name, service.ros_name
        servers = self._nodes(name + REQUESTS, ROLE_SUBSCRIBES) if service.serves else []
        callers = self._nodes(name + REQUESTS, ROLE_PUBLISHES) if service.calls else []
        kind = service.codec.type
        self._registrations.declare(name, SERVES, {RosServer(node, ros_name, kind) for node in servers[:1]})
        self._registrations.declare(name, CALLS, {RosClient(node, ros_name) for node in callers})
        service.node = callers[0] if callers else ""

    def _nodes(self, topic: str, role: int) -> list[str]:
        """Return the ROS nodes of this module, or behind this gateway, that have a topic."""
        names, options = self._link.names, self._link.options
        found = {names.node(node) for node in self._discovery.own_nodes.get((topic, role), {}) if node}
        if options.ros_nodes:
            found |= {names.node(*each) for each in self._discovery.nodes_behind(topic, role)}
        return sorted(found) or [self._registrations.module_node]

    def _connect(self, name: str, *, called: bool, served: bool) -> list[Event]:
        """Let messages flow on the two topics, and gateways know that ROS nodes may call."""
        discovery, requests, responses = self._discovery, name + REQUESTS, name + RESPONSES
        discovery.set_demand(requests, ROLE_PUBLISHES, wanted=served)
        discovery.set_demand(responses, ROLE_SUBSCRIBES, wanted=served)
        return [
            *discovery.set_published(responses, published=called),
            *discovery.set_subscribed(requests, subscribed=called),
            *discovery.set_subscribed(responses, subscribed=served),
            *discovery.set_published(requests, published=served),
        ]

    def _has_fitting_server(self, service: CarriedService) -> bool:
        """Return whether a ROS node serves the service with its type; one of another type is reported."""
        servers = self._discovery.peers.get((service.name + REQUESTS, ROLE_SUBSCRIBES), [])
        fitting = [each for each in servers if each.checksum in ("", service.codec.type.checksum)]
        for server in servers if not fitting else []:
            self._report_type(service, server)
        return bool(fitting)

    def _report_type(self, service: CarriedService, server: RosPeerEndpoint) -> None:
        mine = service.codec.type
        differs = f"{server.type}, here it is {mine.name}" if server.type != mine.name else f"another {mine.name}"
        self._link.notice(
            "type of a service",
            f"service {service.name} of ROS node {server.node} is {differs} ({server.checksum} there, {mine.checksum} "
            "here): calls do not go there until both have the same fields and names",
            trouble=True,
        )

    def _target(self, service: CarriedService) -> int:
        """Return the instance of the nearest other module with a server, for a request of a ROS node; 0: any."""
        here = self._ros_instances()
        return next((each.instance for each, _ in service.servers.find() if each.instance not in here), 0)

    def _ros_instances(self) -> frozenset[int | None]:
        """Return the instances under which ROS nodes are known here."""
        if self._generation != self._discovery.generation:
            self._generation = self._discovery.generation
            self._instances = frozenset(info.instance for info in self._discovery.modules.values())
        return self._instances

    # Types

    def _codec(self, name: str) -> RosServiceCodec | None:
        """Return how a service travels; None without its types, or if ROS can't have them: then why is reported."""
        version = self._link.middleware.version
        if version == 1 and is_of_action(name):
            self.not_on_ros.note(name, "actions are those of ROS 2, ROS 1 has none" if name.endswith(SEND_GOAL) else "")
            return None
        try:
            layouts = self._layouts(name)
            codec = None if layouts is None else _codec_of(*layouts, version)
            reason = TYPE_UNKNOWN if layouts is None else ""
        except MessageError as error:
            codec, reason = None, str(error)
        self.not_on_ros.note(name, reason)
        return codec

    def _layouts(self, name: str) -> tuple[Layout[Any], Layout[Any]] | None:
        """Return the layouts of both topics: those of this module's node, else from the options."""
        requests, responses = (self._space.topics.get(name + end) for end in SERVICE_SUFFIXES)
        if requests is not None and responses is not None and requests.layout and responses.layout:
            return requests.layout, responses.layout
        given = lookup(self._link.options.types, name)
        if given is not None:
            definition = define(name, given)
            return definition.requests, definition.responses
        if (known := self._shape_of_ros(name)) is not None:
            definition = known.definition(name)
            return definition.requests, definition.responses
        learnt = [self._link.class_of(name + end) for end in SERVICE_SUFFIXES]
        return None if learnt[0] is None or learnt[1] is None else (layout(learnt[0]), layout(learnt[1]))

    def _shape_of_ros(self, name: str) -> ServiceShape | None:
        """Return the types of a service that a ROS node serves, if it is one of every ROS."""
        peers = self._discovery.peers.get((name + REQUESTS, ROLE_SUBSCRIBES), ())
        known = _services_of_ros(self._link.middleware.version)
        return next((known[each.type, each.checksum] for each in peers if (each.type, each.checksum) in known), None)

    def _show_type(self, name: str) -> None:
        """Enter the type of a service of a ROS node that no node here uses, for tools, if it is one of every ROS."""
        known = self._shape_of_ros(name)
        if known is not None:
            for topic, shape in known.definition(name).topics:
                self._discovery.set_type(topic, TopicType(shape.size, shape.fingerprint, shape.varies))

    def message_type(self, fingerprint: bytes) -> type[Message] | None:
        """Return the class of the topics of a service of every ROS that has this fingerprint."""
        for shape in _services_of_ros(self._link.middleware.version).values():
            for each in (shape.requests, shape.responses):
                if each.fingerprint == fingerprint:
                    return cast("type[Message]", each.cls)
        return None

    # Messages

    def __contains__(self, topic: str) -> bool:
        return topic.endswith(SERVICE_SUFFIXES) and topic[: -len(REQUESTS)] in self._carried

    def write(self, topic: str, sample: Sample) -> None:
        """Handle a message of a client or server of r2p."""
        service = self._carried[topic[: -len(REQUESTS)]]
        try:
            header = services.decode(sample.data)
        except DecodeError:
            self._discovery.counts["undecodable"] += 1
            return
        body = sample.data[HEADER_SIZE:]
        if topic.endswith(RESPONSES):
            self._requests.receive(service, header, body)
        elif service.calls and self._is_for_ros(header):
            given, left = self._lifetime(sample)
            self._calls.receive(service, header, body, given, left)

    def _is_for_ros(self, header: ServiceHeader) -> bool:
        """Return whether a request is for any server, or for that of a ROS node."""
        return not header.server or header.server in self._ros_instances()

    def requested(self, ros_name: str, request: bytes, answer: Answer, refuse: Refuse) -> Cancel:
        """Handle a request of a ROS node."""
        service = self._by_ros_name.get(ros_name)
        if service is None or not service.serves:
            refuse(f"{ros_name} is not served here any more")
            return nothing_to_cancel
        topic = self._space.topics.get(service.name + REQUESTS)
        server = None if topic is None else server_of(topic.queues)
        if server is None:
            service.target = self._target(service)
        return self._requests.begin(service, request, answer, refuse, server)

    def sample(self, arrival: ServiceArrival) -> Sample:
        """Return the sample of a message that goes to this module."""
        now = self._space.clock.now()
        self._sequence += 1
        if not arrival.lifetime:
            return Sample(arrival.data, self._source, now, sequence=self._sequence)
        deadline = now + arrival.lifetime
        return Sample(arrival.data, self._source, now, deadline, self._sequence, PublisherClass.SPORADIC)

    def _lifetime(self, sample: Sample) -> tuple[int, int]:
        """Return the caller's time-out and what is left of it (ns), at least a moment."""
        if not (sample.deadline and sample.sequence):
            return UNKNOWN_LIFETIME, UNKNOWN_LIFETIME
        left = sample.due - self._space.clock.now()
        return max(MILLISECOND, sample.deadline - sample.stamp), max(MILLISECOND, left)

    def _deliver(self, topic: str, data: bytes, lifetime: int) -> None:
        self._link.receive([ServiceArrival(self._link.key(topic), data, lifetime)])

    def _report(self, service: CarriedService, text: str) -> None:
        """Report an error whose text does not reach the caller: an answer of its fixed length has no room for it."""
        self._link.notice("call failed", f"service {service.name} of a ROS node: {text}", trouble=True)


@functools.cache
def _services_of_ros(version: int) -> dict[tuple[str, str], ServiceShape]:
    """Return the services that every ROS has, by the name and the checksum of their types."""
    found: dict[tuple[str, str], ServiceShape] = {}
    for each in (std_srvs.Empty, std_srvs.SetBool, std_srvs.Trigger, CancelGoal):
        definition: Definition[Any, Any] = define("name", each)
        shape = service_shape(definition.requests, definition.responses)
        found[shape.name, service_type(shape, version).checksum] = shape
    return found


@functools.lru_cache(maxsize=1024)
def _codec_of(requests: Layout[Any], responses: Layout[Any], version: int) -> RosServiceCodec:
    return service_codec(service_shape(requests, responses), version)


def _is_of_each_node(server: RosPeerServer) -> bool:
    """Return whether this is one of the services that each node of ROS has for itself."""
    return server.type.partition("/")[0] in _OF_EACH_NODE


def _as_endpoint(server: RosPeerServer, end: str) -> RosPeerEndpoint:
    return RosPeerEndpoint(server.node, server.service + end, server.type, server.checksum)
