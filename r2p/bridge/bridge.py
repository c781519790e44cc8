"""The gateway of a module: its ports, their tree, and everything but topics that passes between them.

`Bridge` feeds the tree with messages of gateways, and carries out its actions. `routing` handles topics,
`directory_relay` modules and nodes, `orders` orders.
"""

import itertools
import operator
from collections.abc import Callable

import msgspec

from r2p.bridge.calls import CallRelay
from r2p.bridge.directory_relay import DirectoryRelay
from r2p.bridge.forwarding import BridgedTopic, BridgePort, HeldMessages
from r2p.bridge.options import BridgeOptions, Policy
from r2p.bridge.orders import ModuleNames, OrderRelay
from r2p.bridge.routing import RoutingTable
from r2p.clock import Alarm
from r2p.codecs import UnknownType, management, probes
from r2p.codecs.management import ManagementType
from r2p.errors import DecodeError
from r2p.names import module_alias
from r2p.protocols.bridge.ports import (
    PORTS_MAX,
    Action,
    PortChanged,
    PortState,
    SendProbe,
    SendToClients,
    SendToPort,
    TreePort,
)
from r2p.protocols.bridge.tree import FIRST_CLIENT, SpanningTree
from r2p.protocols.discovery.events import TopicType
from r2p.runtime.queues import WakeScheduler
from r2p.runtime.sample import Source
from r2p.runtime.topic import Topic, TopicSpace
from r2p.transports.announcement import Announcement, GatewayHooks
from r2p.transports.link import Link
from r2p.transports.stats import RETRY_AFTER_ERROR, count_internal_error

_FORWARDS = (PortState.ALONE, PortState.FORWARDING)
_TROUBLE = (PortState.LOOP, PortState.REFUSED)
_TEXTS = {
    PortState.ALONE: "forwards",
    PortState.FORWARDING: "forwards, in agreement with {gateways}",
    PortState.BLOCKED: "is blocked: its network is joined to the others by {gateways}",
    PortState.CONVERGING: "is silent until it agrees with {gateways}",
    PortState.LISTENING: "listens for other gateways",
    PortState.LOOP: "is blocked: messages sent on another link come back here, through a gateway that is not r2p's",
    PortState.REFUSED: "no gateway may be there: nothing passes; listen with ?gateways=yes where gateways are to join",
}

_HANDLED = {
    ManagementType.ALIVE,
    ManagementType.HELLO,
    ManagementType.DENIED,
    *management.ORDER_TYPES,
    *management.GATEWAY_TYPES,
}


class RouteStatistics(msgspec.Struct, frozen=True):
    """One topic from one link to another; `dropped` by reason, since the route was added."""

    topic: str
    source: str
    target: str
    forwarded: int
    dropped: dict[str, int]


class PortStatistics(msgspec.Struct, frozen=True):
    """One link of a gateway: its state in the tree, and how many other gateways are on its network.

    `dropped` counts messages that arrived while nothing was forwarded. `offset` (ns) is UTC less the time of the link's
    network, where that has one, known to +-`error` (ns).
    """

    link: str
    state: str
    gateways: int
    dropped: dict[str, int]
    offset: int | None = None
    error: int | None = None
    not_carried: dict[str, str] = {}


class GatewayStatistics(msgspec.Struct, frozen=True):
    """Totals of what a gateway has forwarded and dropped, on all links and topics."""

    ports: list[PortStatistics]
    routes: list[RouteStatistics]


class Bridge:
    """The gateway of a module. `notify(link, kind, text, trouble)` is called with news for the user."""

    def __init__(
        self, space: TopicSpace, instance: int, options: BridgeOptions, notify: Callable[[Link, str, str, bool], None]
    ) -> None:
        self.ports: dict[str, BridgePort] = {}
        """Ports by the name of the link."""
        self.tree = SpanningTree(instance)
        self.policy = Policy(options)
        self.routing = RoutingTable(self.ports, space, self.policy)
        self.directory = DirectoryRelay(instance, self.ports, space, self.policy, self.routing.check_types)
        self.names = ModuleNames(self.policy, self.directory)
        self.calls = CallRelay(space.module, self.ports, self.policy, space.clock)
        self._name = space.module
        self._alias = module_alias(space.module)
        self._instance = instance
        self._clock = space.clock
        self._notify = notify
        self._orders = OrderRelay(self._name, self._clock, self.ports, self.policy, self.names)
        self._by_number: dict[int, BridgePort] = {}
        self._client_numbers = itertools.count(FIRST_CLIENT)
        self._held = HeldMessages()
        self._changed: set[int] = set()
        """Ports with a new place in the tree, not yet passed on to routing and directory."""
        self._alarm = Alarm(space.loop, self._poll, background=True)

    def make_topic(self, name: str, wake_scheduler: WakeScheduler) -> Topic:
        """Make a topic for the module's topic space."""
        return BridgedTopic(name, wake_scheduler, self.ports, self._clock.monotonic, self._held)

    # Links

    def attach(self, link: Link) -> None:
        """Add a link, up or not yet."""
        number = next((each for each in range(PORTS_MAX) if each not in self._by_number), None)
        if not link.admits_gateways or number is None:
            number = next(self._client_numbers)
        port = BridgePort(link, number, self.policy.kind(link.name), self._clock.now)
        self.ports[link.name] = self._by_number[number] = port
        link.gateway_hooks = _PortHooks(self, port)
        link.discovery.announce_gateway()
        if link.admits_gateways and number >= FIRST_CLIENT:
            port.state = port.tree_port.state = PortState.REFUSED
            self._notify(link, "too many links", f"a gateway joins {PORTS_MAX} links: this one is not", True)

    def detach(self, link: Link) -> None:
        """Remove a link that the module no longer has."""
        port = self.ports.pop(link.name)
        del self._by_number[port.number]
        self.calls.detach(link.name)
        self._close(port)
        self._port_changed(port)

    def link_changed(self, link: Link) -> None:
        """Follow a link that went up or down."""
        port = self.ports[link.name]
        if link.up:
            self._open(port)
        else:
            self._close(port)
        self._port_changed(port)

    def _open(self, port: BridgePort) -> None:
        now = self._clock.monotonic()
        if port.is_client:
            port.tree_port = self.tree.clients.open(now, port.number)
        elif port.number < FIRST_CLIENT:
            port.tree_port = self.tree.open(now, port.number, private=port.link.fixed_peer)
        port.tree_port.lost = port.link.stats.lost

    def _close(self, port: BridgePort) -> None:
        now = self._clock.monotonic()
        if port.is_client:
            self.tree.clients.close(port.number)
            port.tree_port = TreePort(port.number, now)
        elif port.number < FIRST_CLIENT:
            self.tree.close(now, port.number)
            port.tree_port = TreePort(port.number, now)
        self.directory.forget(port)

    def _port_changed(self, port: BridgePort) -> None:
        if not port.link.stats.lost.guard(self.routing.port_changed, port):
            self._changed.add(port.number)
        self._act()

    def close(self) -> None:
        """Stop, as the module ends."""
        self._alarm.close()
        self.directory.close()

    # Received

    def handle_management(self, port: BridgePort, data: bytes) -> bool:
        """Handle a management message; return True if discovery need not see it."""
        if management.type_of(data) not in _HANDLED:
            return False
        try:
            message = management.decode(data)
        except (DecodeError, UnknownType):
            return False  # discovery counts it
        if isinstance(message, management.Bridge | management.Mesh | management.Leaf):
            self._receive_gateway(port, message)
            return True
        if isinstance(message, management.Order):
            return self._orders.forward(port, message)
        if isinstance(message, management.Denied):
            self._orders.forward_denial(port, message)
            return False
        return self._is_own(port, message) or self._receive_presence(port, message, data)

    def modules_changed(self, port: BridgePort) -> None:
        """Pass on what discovery has learnt on a link, and forward at once to a module that has no other link."""
        if port.tree_port.private and port.tree_port.state is PortState.LISTENING:
            modules = port.link.discovery.modules.values()
            if any(info.sole_link and not (info.hops or info.gateway) for info in modules):
                ports = self.tree.clients if port.is_client else self.tree
                ports.admit(self._clock.monotonic(), port.tree_port)
                self._act()
        self.directory.changed(port)

    def order_refused(self, link: Link, order: management.Order, reason: int) -> None:
        """Refuse an order that came without the link's key (DENIED_...)."""
        self._orders.refuse(self.ports[link.name], order, reason)

    def _receive_presence(self, port: BridgePort, message: management.Management, data: bytes) -> bool:
        """Handle an ALIVE, which may be a probe, or a HELLO; return True if discovery need not see it."""
        if isinstance(message, management.Hello):
            if message.flags & management.HELLO_QUERY:
                self.directory.query(port)
            return False
        probe = probes.decode(data)
        if probe is not None:
            self._receive_probe(port, *probe)
        return probe is not None

    def _is_own(self, port: BridgePort, message: management.Management) -> bool:
        """Return whether another link of this module on the same network sent it; discovery finds own echoes."""
        if port.tree_port.echoes:
            return False
        if isinstance(message, management.Hello):
            return message.instance == self._instance and message.hops == 0
        return isinstance(message, management.Alive) and message.module == self._alias

    def _receive_probe(self, port: BridgePort, gateway: int, its_port: int) -> None:
        if not port.is_client:
            self.tree.receive_probe(self._clock.monotonic(), port.number, gateway, its_port)
        elif gateway in self.tree.mesh.members:
            self.tree.clients.refuse(port.tree_port, PortState.LOOP)
        self._act()

    def _receive_gateway(
        self, port: BridgePort, message: management.Bridge | management.Mesh | management.Leaf
    ) -> None:
        now = self._clock.monotonic()
        if port.is_client and isinstance(message, management.Leaf):
            self.tree.clients.receive_leaf(now, port.tree_port, message)
        elif port.is_client:
            port.link.stats.lost["gateway refused"] += 1
            self.tree.clients.refuse(port.tree_port, PortState.REFUSED)
        elif isinstance(message, management.Bridge):
            self.tree.receive_bridge(now, port.number, message)
        elif isinstance(message, management.Mesh):
            self.tree.receive_mesh(now, port.number, message)
        else:
            self.tree.receive_leaf(now, port.number, message)
        self._act()

    # The tree

    def _poll(self) -> None:
        now = self._clock.monotonic()
        try:
            self.tree.poll(now)
            self._act()
        except Exception as error:  # noqa: BLE001 - counted and logged
            self._failed(error)
            self._alarm.set(now + RETRY_AFTER_ERROR)

    def _failed(self, error: Exception) -> None:
        count_internal_error((port.link.stats.lost for port in self.ports.values()), error)

    def _act(self) -> None:
        """Carry out the tree's actions. If one raises, count that and carry out the rest."""
        try:
            for action in self.tree.pop_actions():
                self._do(action)
            for port in [port for number in self._changed if (port := self._by_number.get(number)) is not None]:
                self._apply_place(port)
            self._changed.intersection_update(self._by_number)
            if self._held and not any(port.tree_port.resumes for port in self.ports.values()):
                self._held.release(self._failed)
        finally:
            again = self._clock.monotonic() + RETRY_AFTER_ERROR if self._changed else None
            dues = [due for due in (self.tree.next_deadline(), again) if due is not None]
            self._alarm.set(min(dues, default=None))

    def _do(self, action: Action) -> None:
        if isinstance(action, SendToClients):
            try:
                self._send_to_clients(management.encode(action.message))
            except Exception as error:  # noqa: BLE001 - counted and logged; the next action follows
                self._failed(error)
            return
        port = self._by_number.get(action.port)
        if port is None or not port.link.up:
            return
        if isinstance(action, PortChanged):
            self._changed.add(action.port)
        else:
            port.link.stats.lost.guard(self._send, port, action)

    def _apply_place(self, port: BridgePort) -> None:
        """Pass on a new place in the tree; if routing raises, try again, or topics would not pass."""
        lost = port.link.stats.lost
        lost.guard(self._report_state, port)
        if lost.guard(self.routing.port_changed, port):
            self._changed.discard(port.number)
        lost.guard(self.directory.changed, port)

    def _send(self, port: BridgePort, action: SendToPort | SendProbe) -> None:
        if isinstance(action, SendToPort):
            port.link.send_management(management.encode(action.message), urgent=True)
        elif port.link.passes_probes:
            port.link.write_management(probes.encode(self.tree.gateway, port.number))

    def _send_to_clients(self, data: bytes) -> None:
        for port in self.ports.values():
            if port.is_client and port.link.up:
                port.link.stats.lost.guard(port.link.send_management, data, urgent=True)

    def _report_state(self, port: BridgePort) -> None:
        state = port.tree_port.state
        if state is port.state:
            return
        forwarded = port.state in _FORWARDS
        port.state = state
        if forwarded:
            port.link.stats.lost["converging"] += port.link.discard()  # it must not go out under another tree
        count = len(port.tree_port.gateways)
        gateways = "another gateway" if count == 1 else f"{count} other gateways" if count else "modules there"
        self._notify(port.link, state.value, _TEXTS[state].format(gateways=gateways), state in _TROUBLE)
        if state in _FORWARDS:
            port.link.query()
        if state is PortState.REFUSED:
            denied = management.Denied(self._alias, self._alias, 0, management.DENIED_GATEWAYS)
            port.link.write_management(management.encode(denied))

    # For users

    def statistics(self) -> GatewayStatistics:
        """Return the gateway's statistics so far."""
        ports = [_port_statistics(port) for port in self.ports.values()]
        routes = [
            RouteStatistics(topic, source, target, route.forwarded, dict(route.dropped))
            for topic, relayed in sorted(self.routing.by_name.items())
            for (source, target), route in sorted(relayed.routes, key=operator.itemgetter(0))
        ]
        return GatewayStatistics(ports, routes)


class _PortHooks(GatewayHooks):
    """Decisions of the gateway about one of its links."""

    def __init__(self, bridge: Bridge, port: BridgePort) -> None:
        self._bridge = bridge
        self._port = port
        self._generation = -1

    def handle_management(self, data: bytes) -> bool:
        return self._bridge.handle_management(self._port, data)

    def desired_state(self, topic: Topic, own: Announcement) -> Announcement:
        return self._bridge.routing.desired_state(self._port, topic, own)

    def types_elsewhere(self, topic: str) -> tuple[TopicType, TopicType]:
        return self._bridge.routing.types_elsewhere(self._port, topic)

    @property
    def may_announce(self) -> bool:
        tree_port = self._port.tree_port
        return tree_port.in_tree or self._bridge.tree.gateway not in tree_port.gateways

    @property
    def has_other_gateways(self) -> bool:
        return bool(self._port.tree_port.neighbours)

    def source_name(self, source: Source) -> str:
        if not source.link:
            return source.module
        return self._bridge.policy.source_name(source.module, source.link, self._port.name)

    def discovery_changed(self) -> None:
        changed = self._port.demand.pop_changed()
        if changed:
            self._bridge.routing.demand_changed(changed, self._port)
        generation = self._port.link.discovery.generation
        if generation != self._generation:
            self._generation = generation
            self._bridge.modules_changed(self._port)


def _port_statistics(port: BridgePort) -> PortStatistics:
    state = port.tree_port.state.value if port.link.up else "down"
    clock = port.link.translation()
    offset, error = (None, None) if clock is None else (clock.offset, clock.error)
    gateways, not_carried = len(port.tree_port.gateways), port.link.not_carried()
    return PortStatistics(port.name, state, gateways, dict(port.dropped), offset, error, not_carried)
