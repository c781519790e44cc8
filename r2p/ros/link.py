"""A link to a ROS network: the topics of this module, or of a gateway's other links, among those of ROS nodes.

    publisher  ->  BufferedSubscriber.offer  ->  RosLink.write    ->  Middleware.publish
    Middleware ->  RosLink.received          ->  RosLink.sample   ->  Topic.deliver

`RosDiscovery` has what other ROS nodes publish and subscribe to, and calls `_review` for each topic that changes. With
its class known (`TopicClasses`), and so how it travels (`RosTopic`), it is registered at the middleware
(`Registrations`), as that of ROS nodes.
"""

import functools
from collections.abc import Callable, Hashable, Iterable, Sequence
from typing import Any, ClassVar

import msgspec

from r2p.clock import REAL_TIME
from r2p.codecs.management import ANY_TYPE, ROLE_PUBLISHES, ROLE_SUBSCRIBES
from r2p.errors import DecodeError, MessageError
from r2p.log_lines import LineLimit
from r2p.messages import SIZE_MAX, Message, layout
from r2p.names import LOG, SERVICE_SUFFIXES
from r2p.protocols.discovery.directory import TABLE_MAX
from r2p.protocols.discovery.events import TopicType
from r2p.ros import type_descriptions
from r2p.ros.background import BackgroundResults
from r2p.ros.discovery import GATEWAYS, RosDiscovery
from r2p.ros.gateways import GatewayExchange, sender_of
from r2p.ros.graph_names import GraphNames
from r2p.ros.middleware import (
    Answer,
    Cancel,
    Middleware,
    MiddlewareUser,
    Refuse,
    RosArrival,
    RosEndpoint,
    RosGraph,
    RosPeerEndpoint,
)
from r2p.ros.options import RosOptions, lookup
from r2p.ros.qos import publisher_qos, subscriber_qos
from r2p.ros.registrations import TYPE_UNKNOWN, NotOnRos, Registrations
from r2p.ros.services import RosServices, ServiceArrival
from r2p.ros.topic_classes import TopicClasses
from r2p.ros.topics import RosTopic, TopicTypes, is_of_action, is_own
from r2p.runtime.sample import PublisherClass, Sample, Source
from r2p.runtime.topic import Topic
from r2p.transports.buffered_link import BufferedLink
from r2p.transports.link import Hub, unique_name
from r2p.transports.stats import LoggedCounter

_GATEWAYS_KEY = GATEWAYS.encode()
_NOTHING = TopicType(), TopicType()
_NOTICES_KEPT = 256  # texts that are not repeated
_NOTICE_MAX = 2000  # characters of a notice, which may be another program's text
_ROLES = (ROLE_PUBLISHES, ROLE_SUBSCRIBES)


class _Published(msgspec.Struct, frozen=True, eq=False):
    """A topic that is registered as published.

    `nodes` has the ROS nodes that publish it, by module and node, `node` is that of all others.
    """

    name: str
    encode: Callable[[Sample], Sequence[bytes]]
    node: str
    nodes: dict[tuple[str, str], str]


class RosLink(BufferedLink, MiddlewareUser):
    """One module on one ROS network."""

    max_payload: ClassVar[int] = SIZE_MAX
    passes_probes: ClassVar[bool] = False
    foreign: ClassVar[str] = "ROS"

    def __init__(self, name: str, hub: Hub, middleware: Middleware, options: RosOptions) -> None:
        self.options = options
        self.middleware = middleware
        self.names = GraphNames(options, hub.space.module if hub.observer else "")
        name = unique_name(name, hub)
        counts = LoggedCounter(name, hub.space.clock)
        review, taken = self._review_safely, self._is_taken
        self._ros = RosDiscovery(hub.space.module, hub.instance, self.names, review, taken, counts)
        super().__init__(name, hub, discovery=self._ros)
        middleware.lost = self.stats.lost
        self._not_on_ros = NotOnRos("", hub.space.loop, self.stats.lost, self.notice)
        self._types = TopicTypes(middleware.version, options, hub.space.module, self.stats.lost)
        self._background = BackgroundResults(hub.space.loop, self._touch)
        self._classes = TopicClasses(hub, self._types, self._background, self._describe, self._touch)
        module_node = self.names.own_node(hub.space.module, hub.space.module)
        self.registrations = Registrations(
            middleware, module_node, hub.space.loop, lambda: self._touch(LOG), at_once=hub.observer
        )
        self.services = RosServices(self, hub, self._ros, self.registrations)
        self.own_servers: dict[str, Callable[[bytes, Answer, Refuse], Cancel]] = {}
        """What handles requests for services that ROS's nodes have and r2p's have not, by their names in ROS."""
        self._published: dict[str, _Published] = {}
        self._travels: dict[str, RosTopic] = {}
        self._subscribed: dict[str, RosTopic] = {}
        self._by_ros_name: dict[str, str] = {}
        self._found: dict[str, set[str]] = {}
        """The ROS nodes whose messages of a topic arrive."""
        self._latched: set[str] = set()
        """Topics that a ROS node latches."""
        self._sources: dict[str, Source] = {}
        self._notices: set[str] = set()
        """The kinds of notices."""
        self._noticed: set[tuple[str, str]] = set()
        """Notices that are not repeated, by kind and text."""
        self._notice_limit = LineLimit()
        self._received_at = 0  # UTC in ns, of the last messages
        self._gateways = GatewayExchange(middleware, self.registrations, hub.space.clock)

    # Own topics

    def topic_changed(self, topic: Topic) -> None:
        super().topic_changed(topic)
        self._touch(topic.name)  # its types on other links, or its queues, may have changed

    def _touch(self, topic: str) -> None:
        if not self._closed:
            self._ros.touch(topic)
            self._apply(())

    def _review_safely(self, topic: str) -> None:
        self.stats.lost.guard(self._review, topic)
        if topic != LOG and self._log_node() != self.registrations.node_of(LOG):
            self._ros.touch(LOG)

    def _review(self, topic: str) -> None:
        """Register a topic as it is now used, or remove it."""
        if self._ros.is_gateway or len(self._space.links) > 1:
            self._ros.hears_gateways = True
            self._gateways.join()
        if self._is_service(topic):
            self._apply(self.services.review(topic))
            return
        own = self._ros.own
        publishes, subscribes = (topic, ROLE_PUBLISHES) in own, (topic, ROLE_SUBSCRIBES) in own
        name = self.names.to_ros(topic)
        travel, reason = self._travel(topic, name) if publishes or subscribes else (None, "")
        self._not_on_ros.note(topic, reason)
        if travel is None and not reason and (publishes or subscribes) and self._background.is_pending(topic):
            return  # until it is known, it stays as it is: other nodes are connected
        if travel is None or name is None:
            self._remove(topic)
            self._learn_type(topic)
            return
        self._by_ros_name[name] = topic
        self._travels[topic] = travel
        self._publish(topic, name, travel if publishes else None)
        self._subscribe(topic, name, travel if subscribes else None)
        self._ros.set_type(topic, _topic_type(travel))

    def _is_service(self, topic: str) -> bool:
        """Return whether a topic is one of the two of a service: also `wheel_r` may be a topic as any other."""
        if not topic.endswith(SERVICE_SUFFIXES):
            return False
        if topic in self.services:
            return True
        known = self._space.topics.get(topic)
        if known is not None and known.layout is not None:
            return known.layout.name.endswith(topic[-2:])
        other = next(topic[:-2] + each for each in SERVICE_SUFFIXES if each != topic[-2:])
        return any((other, role) in table for table in (self._ros.own, self._ros.peers) for role in _ROLES)

    def _travel(self, topic: str, name: str | None) -> tuple[RosTopic | None, str]:
        """Return how a topic travels on ROS, or why it does not. The reason is empty for r2p's own topics."""
        asked = lookup(self.options.types, topic) or lookup(self.options.ros_types, topic)
        if is_own(topic) and not asked:
            return None, ""
        if self.middleware.version == 1 and is_of_action(topic):
            return None, ""  # reported once for the action, with its service
        if name is None:
            return None, "ROS has no such names: parts begin with a letter, and all have at most 240 characters"
        peers = self._ros.peers_of(topic)
        cls = self.class_of(topic, peers)
        if cls is None:
            is_waiting = not peers and self._elsewhere(topic) == _NOTHING  # for a publisher: nothing is wrong yet
            return None, "" if is_waiting else TYPE_UNKNOWN
        if misfit := self._misfit(topic, cls):
            return None, misfit
        types = frozenset(each.type for each in peers if each.type)
        try:
            find = functools.partial(self._types.find, topic, cls, types)
            found = self._background.get(topic, (topic, cls, types), find)
        except MessageError as error:
            return None, str(error)
        if found is None:  # not yet: until then as before, if it is registered, so that nothing is lost
            last = self._travels.get(topic)
            found = last if last is not None and last.shape.cls is cls else None
        return found, ""

    def _misfit(self, topic: str, cls: type[Message]) -> str:
        """Return how a class differs from the messages on a gateway's other links; empty if it does not.

        Publishers there count, or firmware that subscribes: r2p's subscribers see for themselves that a type differs.
        """
        published, asked = self._elsewhere(topic)
        theirs, ours = published, _class_type(cls)
        if published == TopicType() and asked.fingerprint == ANY_TYPE:
            theirs = asked
        if ours.fits(theirs):
            return ""
        sizes = f" has {ours.size} bytes, messages of others {theirs.size}" if ours.size != theirs.size else " differs"
        return f"{layout(cls).name}{sizes}: give another type"

    def class_of(self, topic: str, peers: Sequence[RosPeerEndpoint] = ()) -> type[Message] | None:
        """Return the class of a topic that has these publishers and subscribers in other ROS nodes; None if unknown."""
        return self._classes.find(topic, self._elsewhere(topic), peers)

    def _elsewhere(self, topic: str) -> tuple[TopicType, TopicType]:
        """Return the types in which a topic is published, and subscribed, on a gateway's other links."""
        return _NOTHING if self.gateway_hooks is None else self.gateway_hooks.types_elsewhere(topic)

    def _learn_type(self, topic: str) -> None:
        """Find out the type of a topic that ROS nodes have, and this side does not, or does not know."""
        peers = self._ros.peers_of(topic)
        if not peers:
            return
        cls = self._classes.of_peers(topic, peers)
        self._ros.set_type(topic, None if cls is None else _class_type(cls))

    def _remove(self, topic: str) -> None:
        self._travels.pop(topic, None)
        self._published.pop(topic, None)
        self._subscribed.pop(topic, None)
        for role in _ROLES:
            self.registrations.declare(topic, role, set())
        if (name := self.names.to_ros(topic)) is not None and self._by_ros_name.pop(name, None) is not None:
            self._found.pop(topic, None)
            self._latched.discard(topic)
        self._apply(self._ros.set_subscribed(topic, subscribed=False))
        self._apply(self._ros.set_published(topic, published=False))

    def _publish(self, topic: str, name: str, travel: RosTopic | None) -> None:
        if travel is None:
            self._published.pop(topic, None)
            self.registrations.declare(topic, ROLE_PUBLISHES, set())
            return
        nodes = self._nodes(topic, ROLE_PUBLISHES)
        shown = sorted(set(nodes.values()))
        default = shown[0] if len(shown) == 1 else self.registrations.module_node
        if topic == LOG and default == self.registrations.module_node and not self.registrations.shows_module_node:
            self.registrations.declare(topic, ROLE_PUBLISHES, set())  # until one of its nodes is shown, or itself is
            self._apply(self._ros.set_subscribed(topic, subscribed=False))
            return
        self._published[topic] = _Published(name, travel.encode, default, nodes)
        latched = self._ros.publishes_latched(topic)
        qos = publisher_qos(self._space.topics.get(topic), latched=latched, change=lookup(self.options.qos, topic))
        endpoints = {RosEndpoint(node, name, travel.type, qos) for node in shown or [default]}
        self.registrations.declare(topic, ROLE_PUBLISHES, endpoints)
        # The middleware keeps the values for later subscribers, so it has to get each; but logs would load each bus.
        if qos.transient_local and topic != LOG:
            self._apply(self._ros.set_subscribed(topic, subscribed=True))

    def _subscribe(self, topic: str, name: str, travel: RosTopic | None) -> None:
        if travel is None:
            self._subscribed.pop(topic, None)
            self._found.pop(topic, None)
            self.registrations.declare(topic, ROLE_SUBSCRIBES, set())
            return
        self._subscribed[topic] = travel
        shown = set(self._nodes(topic, ROLE_SUBSCRIBES).values()) or {self.registrations.module_node}
        publishers = self._ros.peers.get((topic, ROLE_PUBLISHES), [])
        qos = subscriber_qos(self._space.topics.get(topic), publishers, lookup(self.options.qos, topic))
        self.registrations.declare(
            topic, ROLE_SUBSCRIBES, {RosEndpoint(node, name, travel.type, qos) for node in shown}
        )

    def _nodes(self, topic: str, role: int) -> dict[tuple[str, str], str]:
        """Return the ROS nodes that have a topic, by module and node; none: the module itself has it."""
        if topic == LOG:
            return {("", LOG): self._log_node()}
        own = self._ros.own_nodes.get((topic, role), {})
        found = {("", node): self.names.own_node(node, self._space.module) for node in own if node}
        if self.options.ros_nodes:
            for module, node in self._ros.nodes_behind(topic, role):
                found[module, node] = self.names.node(module, node)
        return found

    def _log_node(self) -> str:
        """Return the ROS node that publishes the log, which is that of all nodes of the module."""
        if self._ros.is_gateway:
            return self.registrations.module_node
        return next(iter(self.registrations.nodes_besides(LOG)), self.registrations.module_node)

    # What is reported

    def guarantee(self, topic: str, publisher_class: PublisherClass) -> str:
        waits = ", waits for room" if publisher_class is PublisherClass.NON_REAL_TIME else ""
        return f"reliable to ROS nodes that keep up, in order{waits}"

    def not_carried(self) -> dict[str, str]:
        return self._not_on_ros.reasons | self.services.not_on_ros.reasons

    async def _describe(self, peer: RosPeerEndpoint) -> str:
        """Return the definition of another node's type: of the middleware, else of the node itself."""
        found, middleware = await self.middleware.describe(peer), self.middleware
        if found or middleware.version == 1 or not middleware.has_services or not self.registrations.nodes:
            return found
        return await type_descriptions.ask(middleware, min(self.registrations.nodes), peer)

    def known_types(self) -> Iterable[type[Message]]:
        return self._classes.known

    @property
    def makes_types(self) -> bool:
        return self._background.is_busy

    async def message_type(self, fingerprint: bytes) -> type[Message] | None:
        known = (cls for cls in self._classes.known if layout(cls).fingerprint == fingerprint)
        return next(known, None) or self.services.message_type(fingerprint)

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
            messages = published.encode(sample)
        except (DecodeError, MessageError):
            self.count_unsendable(topic, sample, "not convertible")
            return
        node = published.node
        if len(published.nodes) > 1:
            source = sample.source
            node = published.nodes.get((source.module if source.link else "", source.node), node)
        for data in messages:
            self.stats.sent += 1
            self.stats.bytes_sent += len(data)
            self.middleware.publish(node, published.name, data, sample.stamp)

    def write_management(self, data: bytes, *, urgent: bool = False) -> None:
        self._gateways.send(data)

    def write_call(self, data: bytes, to: Hashable) -> None:
        """Do nothing: ROS nodes have no use for it."""

    def receive_other(self, arrival: Any) -> None:
        if arrival.topic != _GATEWAYS_KEY:
            if not (isinstance(arrival, RosArrival) and self._deliver_unannounced(arrival)):
                super().receive_other(arrival)
            return
        data = self._gateways.decode(arrival.data)
        if (instance := sender_of(data)) is not None:
            self._apply(self._ros.set_instance(self._clock.monotonic(), arrival.node, instance))
        self.manage(data, arrival.node)

    def _deliver_unannounced(self, arrival: RosArrival) -> bool:
        """Deliver a message that came before the graph has shown its publisher; return whether it is subscribed."""
        name = self._by_ros_name.get(arrival.topic.decode(errors="replace"), "")
        topic = self._space.topics.get(name)
        if topic is None or not topic.wanted or name not in self._subscribed:
            return False
        self.stats.received += 1
        sample = self.sample(name, arrival)
        for sink in topic.deliver(sample) or ():
            sink.force(sample)
        return True

    def _is_taken(self, name: str, instance: int) -> bool:
        """Return whether another module has this name on another link."""
        others = (each.discovery.modules.get(name) for each in self._space.links if each.name != self.name)
        return any(info is not None and info.instance != instance for info in others)

    # In

    def key(self, topic: str) -> bytes:
        return (self.names.to_ros(topic) or "").encode()

    def add_publisher(self, topic: Topic, size: int, source: Hashable) -> None:
        super().add_publisher(topic, 0, source)  # the size here is another one than in ROS

    def sample(self, topic: str, arrival: RosArrival | ServiceArrival) -> Sample:
        if isinstance(arrival, ServiceArrival):
            return self.services.sample(arrival)
        data, message, stamp = self._subscribed[topic].decode(arrival.data)
        self.stats.bytes_received += len(arrival.data)
        stamp = stamp or arrival.stamp
        source = self._sources.get(arrival.node) or self._source(arrival.node)
        at, kind = stamp or self._received_at, PublisherClass.NON_REAL_TIME
        return Sample(data, source, at, 0, arrival.sequence, kind, message, stamp > 0)  # by place: faster

    def _source(self, node: str) -> Source:
        source = self._sources.get(node)
        if source is None:
            if len(self._sources) >= TABLE_MAX:
                self._sources.clear()
            names = self.names.module(node) if node else ("", "")
            source = self._sources[node] = Source(*names, self.name)
        return source

    def latched(self, topic: str) -> bool:
        return topic in self._latched or super().latched(topic)

    def pause(self) -> None:
        self.middleware.pause()

    def resume(self) -> None:
        self.middleware.resume()

    def close(self) -> None:
        self._not_on_ros.close()
        self.registrations.close()
        self.services.close()
        self._classes.close()
        self._background.close()
        super().close()

    # For the middleware

    def middleware_up(self) -> None:
        if not self.up and not self._closed:
            self.on_up()

    def middleware_down(self, reason: str) -> None:
        self.services.graph_with_services(RosGraph())
        self._found.clear()
        self._latched.clear()
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
        name = self._by_ros_name.get(topic)
        if name is None:
            return
        self._classes.add_definition(type_name, "", definition)
        self._found.setdefault(name, set()).add(node)
        if latched:
            self._latched.add(name)
        self._apply(self._ros.set_published(name, published=True))

    def publisher_gone(self, topic: str, node: str) -> None:
        name = self._by_ros_name.get(topic)
        found = None if name is None else self._found.get(name)
        if name is None or found is None or node not in found:
            return
        found.remove(node)
        if not found:
            del self._found[name]
            self._latched.discard(name)
            self._apply(self._ros.set_published(name, published=False))

    def received(self, messages: list[RosArrival]) -> None:
        self._received_at = self._clock.now()
        middleware_time = REAL_TIME.set(False)  # what subscribers begin is of this program
        try:
            self.receive(messages)
        finally:
            REAL_TIME.reset(middleware_time)

    def requested(self, service: str, caller: str, request: bytes, answer: Answer, refuse: Refuse) -> Cancel:
        handle = self.own_servers.get(service) or functools.partial(self.services.requested, service)
        middleware_time = REAL_TIME.set(False)  # as above, for its handler
        try:
            return handle(request, answer, refuse)
        finally:
            REAL_TIME.reset(middleware_time)

    def notice(self, kind: str, text: str, *, trouble: bool) -> None:
        text = text[:_NOTICE_MAX]
        if (kind, text) in self._noticed:  # such as that of a connection which is tried again and again
            return
        if len(self._noticed) >= _NOTICES_KEPT:
            self._noticed.clear()
        self._noticed.add((kind, text))
        known = kind if kind in self._notices or len(self._notices) < TABLE_MAX else ""
        self._notices.add(known)
        suffix = self._notice_limit.suffix(known, self._clock.monotonic())
        if suffix is not None:
            self._hub.link_notice(self, kind, text + suffix, trouble=trouble)

    def shut_down(self, node: str, reason: str) -> None:
        self.registrations.forget_node(node)
        self.notice("ROS node ended", f"{node} is no longer a ROS node here: {reason}", trouble=True)


def _topic_type(travel: RosTopic) -> TopicType:
    return TopicType(travel.shape.size, travel.shape.fingerprint, travel.shape.varies)


def _class_type(cls: type[Message]) -> TopicType:
    shape = layout(cls)
    return TopicType(shape.size, shape.fingerprint, shape.varies)
