"""A link to a ROS network: the topics of this module, or of a gateway's other links, among those of ROS nodes.

    publisher  ->  BufferedSubscriber.offer  ->  RosLink.write    ->  Middleware.publish
    Middleware ->  RosLink.received          ->  RosLink.sample   ->  Topic.deliver

`RosDiscovery` has what other ROS nodes publish and subscribe to, and calls `_review` for each topic of this module that
changes; with its class known, it is registered at the middleware (`Registrations`), as that of ROS nodes. `RosTopic`
converts messages.
"""

from collections.abc import Callable, Hashable
from typing import ClassVar

import msgspec

from r2p.codecs.management import ROLE_PUBLISHES, ROLE_SUBSCRIBES
from r2p.errors import DecodeError, MessageError
from r2p.messages import SIZE_MAX
from r2p.protocols.discovery.directory import TABLE_MAX
from r2p.protocols.discovery.events import TopicType
from r2p.ros.discovery import RosDiscovery
from r2p.ros.middleware import (
    Answer,
    Cancel,
    Middleware,
    MiddlewareUser,
    Qos,
    Refuse,
    RosArrival,
    RosEndpoint,
    RosGraph,
)
from r2p.ros.options import RosOptions, lookup
from r2p.ros.registrations import Registrations
from r2p.ros.services import RosServices, ServiceArrival
from r2p.ros.topics import GraphNames, RosTopic, TopicTypes, is_own, is_service
from r2p.runtime.sample import Sample, Source
from r2p.runtime.topic import Topic
from r2p.transports.buffered_link import BufferedLink
from r2p.transports.link import Hub, Transport, unique_name
from r2p.transports.stats import LoggedCounter


class _Published(msgspec.Struct, frozen=True, eq=False):
    """A topic that is registered as published.

    `nodes` has the ROS nodes that publish it, by module and node, `node` is that of all others.
    """

    name: str
    travel: RosTopic
    node: str
    nodes: dict[tuple[str, str], str]


class RosLink(BufferedLink, MiddlewareUser):
    """One module on one ROS network."""

    max_payload: ClassVar[int] = SIZE_MAX
    passes_probes: ClassVar[bool] = False

    def __init__(self, name: str, hub: Hub, middleware: Middleware, options: RosOptions) -> None:
        self.options = options
        self.middleware = middleware
        self.names = GraphNames(options)
        self.types = TopicTypes(middleware.version, options)
        name = unique_name(name, hub)
        counts = LoggedCounter(name, hub.space.clock)
        self._ros = RosDiscovery(hub.space.module, hub.instance, self.names, self._review, counts)
        super().__init__(name, hub, discovery=self._ros)
        middleware.lost = self.stats.lost
        self.off_ros: dict[str, str] = {}
        """The topics that are not on the ROS network, and why."""
        self._registrations = Registrations(middleware, self.names.node(hub.space.module))
        self.services = RosServices(self, hub, self._ros, self._registrations)
        self._published: dict[str, _Published] = {}
        self._subscribed: dict[str, RosTopic] = {}
        self._by_ros_name: dict[str, str] = {}
        self._sources: dict[str, Source] = {}

    # Own topics

    def _review(self, topic: str) -> None:
        """Register a topic as it is now used, or remove it."""
        if self._is_service(topic):
            self._apply(self.services.review(topic))
            return
        name, travel, reason = self.names.to_ros(topic), None, ""
        publishes, subscribes = (topic, ROLE_PUBLISHES) in self._ros.own, (topic, ROLE_SUBSCRIBES) in self._ros.own
        if publishes or subscribes:
            travel, reason = self._travel(topic, name)
        if reason:
            self._keep_off(topic, reason)
        else:
            self.off_ros.pop(topic, None)
        if travel is None or name is None:
            self._remove(topic)
            return
        self._by_ros_name[name] = topic
        self._publish(topic, name, travel if publishes else None)
        self._subscribe(topic, name, travel if subscribes else None)
        shape = travel.shape
        self._ros.set_type(topic, TopicType(shape.size, shape.fingerprint, shape.varies))

    def _is_service(self, topic: str) -> bool:
        known = self._space.topics.get(topic)
        return is_service(topic, None if known is None else known.layout)

    def _travel(self, topic: str, name: str | None) -> tuple[RosTopic | None, str]:
        """Return how a topic travels, or why it does not; it need not be said of r2p's own topics."""
        known = self._space.topics.get(topic)
        shape = None if known is None else known.layout
        asked = lookup(self.options.types, topic) or lookup(self.options.ros_types, topic)
        if is_own(topic) and not asked:
            return None, ""
        if name is None:
            return None, "ROS has no such names: each part begins with a letter, and all have at most 240 characters"
        try:
            travel = self.types.find(topic, shape)
        except MessageError as error:
            return None, str(error)
        return travel, "" if travel is not None else "type unknown"

    def _keep_off(self, topic: str, reason: str) -> None:
        if self.off_ros.get(topic) != reason:
            self.off_ros[topic] = reason
            self.stats.lost["not on ROS"] += 1

    def _remove(self, topic: str) -> None:
        self._published.pop(topic, None)
        self._subscribed.pop(topic, None)
        self._registrations.declare(topic, ROLE_PUBLISHES, set())
        self._registrations.declare(topic, ROLE_SUBSCRIBES, set())
        for name in [name for name, each in self._by_ros_name.items() if each == topic]:
            del self._by_ros_name[name]
        self._apply(self._ros.set_subscribed(topic, subscribed=False))
        self._apply(self._ros.set_published(topic, published=False))

    def _publish(self, topic: str, name: str, travel: RosTopic | None) -> None:
        if travel is None:
            self._published.pop(topic, None)
            self._registrations.declare(topic, ROLE_PUBLISHES, set())
            return
        nodes = self._nodes(topic, ROLE_PUBLISHES)
        default = self._registrations.module_node if len(set(nodes.values())) != 1 else next(iter(nodes.values()))
        self._published[topic] = _Published(name, travel, default, nodes)
        latched = self._ros.publishes_latched(topic)
        qos = self._qos(topic, Qos(transient_local=latched, depth=1 if latched else 10))
        shown = set(nodes.values()) or {default}
        self._registrations.declare(
            topic, ROLE_PUBLISHES, {RosEndpoint(node, name, travel.type, qos) for node in shown}
        )
        if latched:  # the middleware keeps the values for later subscribers, so it has to get each
            self._apply(self._ros.set_subscribed(topic, subscribed=True))

    def _subscribe(self, topic: str, name: str, travel: RosTopic | None) -> None:
        if travel is None:
            self._subscribed.pop(topic, None)
            self._registrations.declare(topic, ROLE_SUBSCRIBES, set())
            return
        self._subscribed[topic] = travel
        nodes = set(self._nodes(topic, ROLE_SUBSCRIBES).values()) or {self._registrations.module_node}
        qos = self._qos(topic, Qos())
        self._registrations.declare(
            topic, ROLE_SUBSCRIBES, {RosEndpoint(node, name, travel.type, qos) for node in nodes}
        )

    def _nodes(self, topic: str, role: int) -> dict[tuple[str, str], str]:
        """Return the ROS nodes that have a topic, by module and node."""
        own = self._ros.own_nodes.get((topic, role), {})
        found = {("", node): self.names.node(node) for node in own if node}
        if self.options.ros_nodes:
            for module, node in self._ros.relayed_nodes.get((topic, role), {}):
                if module and node:
                    found[module, node] = self.names.node(module, node)
        return found

    def _qos(self, topic: str, qos: Qos) -> Qos:
        change = lookup(self.options.qos, topic)
        return qos if change is None else change.apply(qos)

    # Out

    @property
    def full(self) -> bool:
        return self.middleware.full

    def write(self, topic: str, sample: Sample) -> None:
        published = self._published.get(topic)
        if published is None:
            if topic in self.services:
                self.services.write(topic, sample)
                return
            self.stats.lost["not on ROS"] += 1
            return
        try:
            data = published.travel.encode(sample)
        except (DecodeError, MessageError):
            self.count_unsendable(topic, sample, "not convertible")
            return
        source, node = sample.source, published.node
        if len(published.nodes) > 1:
            node = published.nodes.get((source.module if source.link else "", source.node), node)
        self.stats.sent += 1
        self.stats.bytes_sent += len(data)
        self.middleware.publish(node, published.name, data, sample.stamp)

    def close(self) -> None:
        self.services.close()
        super().close()

    def write_management(self, data: bytes, *, urgent: bool = False) -> None:
        """Do nothing: ROS nodes have no use for it."""

    def write_call(self, data: bytes, to: Hashable) -> None:
        """Do nothing: ROS nodes have no use for it."""

    # In

    def key(self, topic: str) -> bytes:
        return (self.names.to_ros(topic) or "").encode()

    def add_publisher(self, topic: Topic, size: int, source: Hashable) -> None:
        super().add_publisher(topic, 0, source)  # the size here is another one than in ROS

    def sample(self, topic: str, arrival: RosArrival | ServiceArrival) -> Sample:
        if isinstance(arrival, ServiceArrival):
            return self.services.sample(arrival)
        data, message = self._subscribed[topic].decode(arrival.data)
        self.stats.bytes_received += len(arrival.data)
        stamp = arrival.stamp
        return Sample(
            data,
            self._source(arrival.node),
            stamp or self._clock.now(),
            sequence=arrival.sequence,
            message=message,
            stamped=bool(stamp),
        )

    def _source(self, node: str) -> Source:
        source = self._sources.get(node)
        if source is None:
            if len(self._sources) >= TABLE_MAX:
                self._sources.clear()
            names = self.names.module(node) if node else ("", "")
            source = self._sources[node] = Source(*names, self.name)
        return source

    def pause(self) -> None:
        self.middleware.pause()

    def resume(self) -> None:
        self.middleware.resume()

    # For the middleware

    def middleware_up(self) -> None:
        if not self.up and not self._closed:
            self.on_up()

    def middleware_down(self, reason: str) -> None:
        self.services.graph_with_services(RosGraph())
        self.on_down(reason)

    def middleware_waits(self, reason: str) -> None:
        self.unreachable(reason)

    def graph_changed(self, graph: RosGraph) -> None:
        if self.up:
            shown = self.services.graph_with_services(graph)
            self._apply(self._ros.graph_changed(self._clock.monotonic(), shown))

    def subscriber_joined(self, topic: str) -> None:
        if (name := self._by_ros_name.get(topic)) is not None:
            self._apply(self._ros.set_subscribed(name, subscribed=True))

    def subscribers_gone(self, topic: str) -> None:
        name = self._by_ros_name.get(topic)
        if name is not None and not self._ros.publishes_latched(name):
            self._apply(self._ros.set_subscribed(name, subscribed=False))

    def publisher_found(self, topic: str, node: str, type_name: str, definition: str, *, latched: bool = False) -> None:
        if (name := self._by_ros_name.get(topic)) is not None:
            self._apply(self._ros.set_published(name, published=True))

    def publisher_gone(self, topic: str, node: str) -> None:
        if (name := self._by_ros_name.get(topic)) is not None:
            self._apply(self._ros.set_published(name, published=False))

    def received(self, messages: list[RosArrival]) -> None:
        self.receive(messages)

    def requested(self, service: str, caller: str, request: bytes, answer: Answer, refuse: Refuse) -> Cancel:
        return self.services.requested(service, request, answer, refuse)

    def parameter_changed(self, key: str, value: object) -> None:
        """Do nothing yet."""

    def notice(self, kind: str, text: str, *, trouble: bool) -> None:
        self._hub.link_notice(self, kind, text, trouble=trouble)

    def shut_down(self, node: str, reason: str) -> None:
        self._registrations.forget_node(node)
        self.notice("ROS node ended", f"{node} is no longer a ROS node here: {reason}", trouble=True)


MakeMiddleware = Callable[[Hub], Middleware]


class RosTransport(Transport):
    """Makes the middleware of a ROS network, and one link with this `name`, such as `ros2:`."""

    def __init__(self, name: str, make_middleware: MakeMiddleware, options: RosOptions | None = None) -> None:
        self.options = options or RosOptions()
        self._name = name
        self._make_middleware = make_middleware

    async def run(self, hub: Hub, opened: Callable[[], object]) -> None:
        middleware = self._make_middleware(hub)
        link = RosLink(self._name, hub, middleware, self.options)
        hub.attach(link)
        try:
            await middleware.run(link, opened)
        finally:
            link.close()
            hub.detach(link)
