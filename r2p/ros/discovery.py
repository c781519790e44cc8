"""What a link to a ROS network knows of it: ROS nodes as modules, and their topics, from the graph of its middleware.

Links use it like `Discovery`, and get the same events; but nothing is sent, as the middleware registers what this
module has. For each topic that changes, `review` is called soon after, once for several changes.
"""

from collections import Counter
from collections.abc import Callable, Iterator

import msgspec

from r2p.codecs import management
from r2p.codecs.management import CLASS_LATCHES, NO_PARAMS, QUEUE, ROLE_GONE, ROLE_PUBLISHES, ROLE_SUBSCRIBES
from r2p.names import name_hash
from r2p.protocols.discovery.aliases import LinkNames
from r2p.protocols.discovery.announcer import LocalTopic, Relayed
from r2p.protocols.discovery.demand import Demand
from r2p.protocols.discovery.directory import FOR_EVER, TABLE_MAX, EndpointInfo, TopicInfo
from r2p.protocols.discovery.events import (
    Event,
    ModuleChanged,
    ModuleGone,
    ModuleInfo,
    PeerAddress,
    PublisherFound,
    PublisherGone,
    SubscriberJoined,
    SubscribersGone,
    TopicType,
)
from r2p.protocols.discovery.interface import DiscoveryProtocol
from r2p.ros.graph_names import GraphNames
from r2p.ros.middleware import RosGraph, RosPeerEndpoint
from r2p.units import SECOND

GATEWAYS = "/_r2p/gateways"
"""The topic on which gateways find each other, which is not shown; ROS hides names with such an underscore as well."""

TopicRole = tuple[str, int]
"""A topic, and ROLE_PUBLISHES or ROLE_SUBSCRIBES."""

_MARK_EVERY = SECOND // 2
"""Ns after which everything in the graph is marked as heard once more."""

_CLIENTS = "clients"
"""The source of demand by ROS nodes that call services."""


class RosDiscovery(DiscoveryProtocol):
    """The discovery of one module on a ROS network; `review(topic)` is called after changes of its own topics.

    `is_taken(name, instance)` says whether another module has the name of a ROS node on another link: such a node is
    not shown as a module, as no two may have one name.
    """

    def __init__(
        self,
        module: str,
        instance: int,
        names: GraphNames,
        review: Callable[[str], None],
        is_taken: Callable[[str, int], bool],
        counts: Counter[str],
    ) -> None:
        super().__init__(module, instance, counts, LinkNames())
        self.modules: dict[str, ModuleInfo] = {}
        self.topics: dict[str, TopicInfo] = {}
        self.endpoints: dict[tuple[int, str, str, int], EndpointInfo] = {}
        self.peers: dict[TopicRole, list[RosPeerEndpoint]] = {}
        """What other ROS nodes publish and subscribe to, by topic and role."""
        self.own: dict[TopicRole, LocalTopic] = {}
        self.own_nodes: dict[TopicRole, dict[str, int]] = {}
        """This module's nodes by what they publish and subscribe to, with their publisher classes (CLASS_...)."""
        self._relayed: dict[TopicRole, dict[tuple[int, str], int]] = {}
        """The same of modules behind this gateway; keys are the module's instance and the node."""
        self._relayed_modules: dict[int, str] = {}
        self._names = names
        self._review = review
        self._is_taken = is_taken
        self._named: dict[str, tuple[str, str]] = {}
        """The names of module and node of each ROS node."""
        self.hears_gateways = False
        """True on a link that takes part in what gateways say to each other."""
        self._gateways: set[str] = set()
        """The ROS nodes that are r2p modules with several links."""
        self._instances: dict[str, int] = {}
        """Their instances, as far as known."""
        self._dirty: dict[str, None] = {}
        self._generation = 0
        self._demand = Demand()
        self._joined: set[str] = set()
        self._found: set[str] = set()
        self._not_carried: set[str] = set()
        self._mark_at: int | None = None

    @property
    def generation(self) -> int:
        return self._generation

    # What this module has

    def set_flags(self, now: int, flags: int) -> list[Event]:
        self.flags = flags
        return []

    def _set_topic(self, now: int, topic: str, role: int, own: LocalTopic) -> list[Event]:
        if self.own.get((topic, role)) != own:
            self.own[topic, role] = own
            self._dirty[topic] = None
        return []

    def _remove_topic(self, now: int, topic: str, role: int) -> list[Event]:
        if self.own.pop((topic, role), None) is not None:
            self._dirty[topic] = None
            (self._joined if role == ROLE_PUBLISHES else self._found).discard(topic)
        return []

    def add_endpoint(self, now: int, node: str, topic: str, role: int, publisher_class: int = 0) -> list[Event]:
        self.own_nodes.setdefault((topic, role), {})[node] = publisher_class
        self._dirty[topic] = None
        return []

    def remove_endpoint(self, now: int, node: str, topic: str, role: int) -> list[Event]:
        nodes = self.own_nodes.get((topic, role), {})
        nodes.pop(node, None)
        if not nodes:
            self.own_nodes.pop((topic, role), None)
        self._dirty[topic] = None
        return []

    def touch(self, topic: str) -> None:
        """Review a topic, soon."""
        self._dirty[topic] = None

    def review_all(self) -> None:
        """Review all topics of this module, soon."""
        self._dirty |= dict.fromkeys(topic for topic, _ in [*self.own, *self.peers])

    # For gateways

    def demand(self) -> Demand:
        return self._demand

    def relay(self, now: int, message: Relayed) -> list[Event]:
        """Note which nodes behind this gateway have which topics."""
        match message:
            case management.Hello(_, instance, flags) if flags & management.HELLO_LEAVING:
                self._relayed_modules.pop(instance, None)
                for key in self._relayed_by(instance):
                    nodes = self._relayed[key]
                    self._set_relayed(key, {each: nodes[each] for each in nodes if each[0] != instance})
            case management.Hello(name, instance):
                if self._relayed_modules.get(instance) != name:
                    self._relayed_modules[instance] = name
                    self._dirty |= dict.fromkeys(topic for topic, _ in self._relayed_by(instance))
            case management.Endpoint(role, instance, node, topic, publisher_class):
                key = topic, role & ~ROLE_GONE
                nodes = dict(self._relayed.get(key, {}))
                nodes.pop((instance, node), None)
                if not role & ROLE_GONE:
                    nodes[instance, node] = publisher_class
                self._set_relayed(key, nodes)
        return []

    def nodes_behind(self, topic: str, role: int) -> Iterator[tuple[str, str]]:
        """Yield the module and the node of each publisher or subscriber of a topic behind this gateway."""
        for instance, node in self._relayed.get((topic, role), {}):
            if node and (module := self._relayed_modules.get(instance)) is not None:
                yield module, node

    def _relayed_by(self, instance: int) -> list[TopicRole]:
        return [key for key, nodes in self._relayed.items() if any(each[0] == instance for each in nodes)]

    def _set_relayed(self, key: TopicRole, nodes: dict[tuple[int, str], int]) -> None:
        if nodes != self._relayed.get(key, {}):
            self._dirty[key[0]] = None
        if nodes:
            self._relayed[key] = nodes
        else:
            self._relayed.pop(key, None)

    def query(self, now: int) -> list[Event]:
        """Do nothing: the graph shows everything."""
        return []

    def report_conflict(self, now: int, module: str, instance_a: int, instance_b: int) -> list[Event]:
        return []

    # What flows

    def publishes_latched(self, topic: str) -> bool:
        """Return whether a publisher of this module, or behind this gateway, latches the topic."""
        key = topic, ROLE_PUBLISHES
        classes = [*self.own_nodes.get(key, {}).values(), *self._relayed.get(key, {}).values()]
        return any(each & CLASS_LATCHES for each in classes)

    def set_subscribed(self, topic: str, *, subscribed: bool) -> list[Event]:
        """Set whether a ROS subscriber receives what this module publishes on a topic."""
        if subscribed == (topic in self._joined) or (subscribed and (topic, ROLE_PUBLISHES) not in self.own):
            return []
        if subscribed:
            self._joined.add(topic)
            return [SubscriberJoined(topic, NO_PARAMS, QUEUE)]
        self._joined.remove(topic)
        return [SubscribersGone(topic)]

    def set_published(self, topic: str, *, published: bool) -> list[Event]:
        """Note whether messages of ROS publishers arrive on the topic."""
        if published == (topic in self._found) or (published and (topic, ROLE_SUBSCRIBES) not in self.own):
            return []
        if published:
            self._found.add(topic)
            return [PublisherFound(topic, None, NO_PARAMS, 0)]
        self._found.remove(topic)
        return [PublisherGone(topic, None)]

    def set_demand(self, topic: str, role: int, *, wanted: bool) -> None:
        """Note that ROS nodes may publish or subscribe to a topic, though the graph does not show it: clients."""
        if wanted:
            self._demand.add(topic, role, _CLIENTS)
        else:
            self._demand.remove(topic, role, _CLIENTS)

    def peers_of(self, topic: str) -> list[RosPeerEndpoint]:
        """Return the publishers and subscribers of other ROS nodes."""
        return [*self.peers.get((topic, ROLE_PUBLISHES), ()), *self.peers.get((topic, ROLE_SUBSCRIBES), ())]

    def set_type(self, topic: str, known: TopicType | None) -> None:
        """Enter the type here of a topic that ROS nodes have."""
        info = self.topics.get(topic)
        if info is not None:
            for role in (ROLE_PUBLISHES, ROLE_SUBSCRIBES):
                info.set_type(role, known if (topic, role) in self.peers else None)

    def publisher_type(self, topic: str, module: str) -> TopicType:
        info = self.topics.get(topic)
        return (info.publisher_type if info is not None else None) or TopicType()

    # The link

    def link_up(self, now: int) -> list[Event]:
        self._outbox.up = True
        self.review_all()
        return []

    def link_down(self, now: int) -> list[Event]:
        """Forget the graph, which is reported again."""
        self._outbox.up = False
        events = self.graph_changed(now, RosGraph())
        events += [event for topic in sorted(self._joined) for event in self.set_subscribed(topic, subscribed=False)]
        return events + [event for topic in sorted(self._found) for event in self.set_published(topic, published=False)]

    def leave(self, now: int) -> list[Event]:
        self._outbox.up = False
        return []

    def next_deadline(self) -> int | None:
        return 0 if self._dirty else self._mark_at

    def poll(self, now: int) -> list[Event]:
        """Review what has changed; mark everything in the graph as heard."""
        dirty, self._dirty = self._dirty, {}
        for topic in dirty:
            self._review(topic)
        if self._mark_at is not None and self._mark_at <= now:
            self._mark_at = now + _MARK_EVERY
            for name, info in self.modules.items():
                self.modules[name] = msgspec.structs.replace(info, last_heard=now)
            for topic, role in self.peers:
                self.topics[topic].set_heard(role, now)
            return self._show_modules(now)
        return []

    def receive(self, now: int, data: bytes, source: PeerAddress = None) -> list[Event]:
        return []

    # The graph

    def graph_changed(self, now: int, graph: RosGraph) -> list[Event]:
        """Enter what other ROS nodes have now; of a table that is full, the rest is counted."""
        before = self.peers
        self.peers = {}
        for role, endpoints in ((ROLE_PUBLISHES, graph.publishers), (ROLE_SUBSCRIBES, graph.subscribers)):
            for endpoint in sorted(endpoints, key=_order):
                self._enter(now, role, endpoint)
        for topic, role in before.keys() - self.peers.keys():
            self._demand.remove(topic, role, None)
            self.topics[topic].set_heard(role, None)
            self.topics[topic].set_type(role, None)
        carried = {topic for topic, _ in self.peers}
        for topic in self.topics.keys() - carried:
            del self.topics[topic]
        for topic, info in self.topics.items():
            info.type_name = next((each.type for each in self.peers_of(topic) if "/" in each.type), "")
        changed = (key for key in before.keys() | self.peers.keys() if before.get(key) != self.peers.get(key))
        self._dirty |= dict.fromkeys(sorted({topic for topic, _ in changed}))
        self._mark_at = now + _MARK_EVERY if graph.nodes or self.peers else None
        self._named = {node: self._names.module(node) for node in sorted(graph.nodes)[:TABLE_MAX]}
        self._gateways = {each.node for each in graph.publishers if each.topic == GATEWAYS}
        self._instances = {node: known for node, known in self._instances.items() if node in self._gateways}
        events = self._show_modules(now)
        self._set_endpoints()
        return events

    def set_instance(self, now: int, node: str, instance: int) -> list[Event]:
        """Note which r2p module a ROS node is: it is on other networks, too, and must not look like another one."""
        if node not in self._gateways or self._instances.get(node) == instance:
            return []
        self._instances[node] = instance
        return self._show_modules(now)

    def _enter(self, now: int, role: int, endpoint: RosPeerEndpoint) -> None:
        if endpoint.topic == GATEWAYS:
            return
        topic = self._names.from_ros(endpoint.topic)
        if topic is None:
            is_new = endpoint.topic not in self._not_carried and len(self._not_carried) < TABLE_MAX
            if is_new and self._names.is_inside(endpoint.topic):
                self._not_carried.add(endpoint.topic)
                self.counts["name not carried"] += 1
            return
        if topic not in self.topics:
            if len(self.topics) >= TABLE_MAX:
                self.counts["topics forgotten"] += 1
                return
            self.topics[topic] = TopicInfo(topic)
        self.peers.setdefault((topic, role), []).append(endpoint)
        self.topics[topic].set_heard(role, now)
        self._demand.add(topic, role, None)

    def _show_modules(self, now: int) -> list[Event]:
        """Show the ROS nodes as modules, if anything about that has changed."""
        modules = {info.name: info for info in self._modules(now)}
        gone = [info for name, info in self.modules.items() if name not in modules]
        new = [info for name, info in modules.items() if self._instance_of(name) != info.instance]
        if gone or new:
            self.modules.clear()
            self.modules.update(modules)
            self._generation += 1
            self._set_endpoints()
        return [*map(ModuleGone, gone), *map(ModuleChanged, new)]

    def _instance_of(self, module: str) -> int | None:
        known = self.modules.get(module)
        return None if known is None else known.instance

    def _modules(self, now: int) -> Iterator[ModuleInfo]:
        for node, (module, _) in reversed(self._named.items()):  # of several with one name the first counts
            if self.hears_gateways and node in self._gateways and node not in self._instances:
                continue  # its first message says which module it is
            instance = self._instances.get(node, name_hash(node) & 0xFFFFFFFF)
            if not self._is_taken(module, instance):
                yield ModuleInfo(module, 0, now, instance, self._names.is_tool(node), FOR_EVER, source=node)

    def _set_endpoints(self) -> None:
        before = dict(self.endpoints)
        self.endpoints.clear()
        for (topic, role), peers in self.peers.items():
            for peer in peers:
                module, node = self._named.get(peer.node, ("", ""))
                instance = self._instance_of(module)
                if instance is None or len(self.endpoints) >= TABLE_MAX:
                    continue
                latches = CLASS_LATCHES if peer.qos is not None and peer.qos.transient_local else 0
                key = instance, node, topic, role
                self.endpoints[key] = EndpointInfo(module, *key, latches if role == ROLE_PUBLISHES else 0)
        self._generation += 1 if before != self.endpoints else 0


def _order(endpoint: RosPeerEndpoint) -> tuple[str, str, str, bytes]:
    return endpoint.topic, endpoint.node, endpoint.type, endpoint.gid
