"""The gateway of a module: its ports, the tree that they are part of, and what passes between them besides topics."""

import itertools
import operator
from collections.abc import Callable

import msgspec

from r2p.bridge.directory_relay import DirectoryRelay, ModuleNames
from r2p.bridge.forwarding import BridgedTopic, HeldMessages
from r2p.bridge.options import BridgeOptions, Policy
from r2p.bridge.port import BridgePort, GatewayStatistics, PortStatistics, WayStatistics
from r2p.bridge.routing import RoutingTable
from r2p.clock import Alarm
from r2p.codecs import UnknownType, management, probes
from r2p.codecs.management import ManagementType
from r2p.errors import DecodeError
from r2p.log_lines import get_logger
from r2p.names import module_alias
from r2p.protocols.bridge.base import MOST_PORTS, Action, Changed, PortState, Probe, Say, SayToClients, TreePort
from r2p.protocols.bridge.clients import FIRST
from r2p.protocols.bridge.tree import Tree
from r2p.runtime.sample import Source
from r2p.runtime.topic import Topic, TopicSpace, WakeScheduler
from r2p.transports.announcement import Announcement
from r2p.transports.link import Link, is_booting
from r2p.transports.stats import RETRY_AFTER_ERROR, count_internal_error

logger = get_logger("r2p.bridge")

_Order = management.Stop | management.Reboot | management.Bootload

_DENIED_ORDER = 15  # its place
_DENIED_APART = 200_000_000  # ns between two answers on one link to orders that do not pass
_REFUSALS = {
    management.DENIED_CONTROL: "see --allow-control",
    management.DENIED_READ_ONLY: "see --read-only",
    management.DENIED_BOOT: "the module is in boot mode, where a STOP hangs it",
}
_HELLO_FLAGS = 12  # its place
_NO_GATEWAY = "no gateway may be there: nothing passes; listen with ?gateways=yes where gateways are to join"
_WORDS = {
    PortState.ALONE: "forwards",
    PortState.FORWARDING: "forwards, in agreement with {gateways}",
    PortState.BLOCKED: "is blocked: its network is joined to our others by {gateways}",
    PortState.CONVERGING: "is silent until it agrees with {gateways}",
    PortState.LISTENING: "listens for other gateways",
    PortState.LOOP: "is blocked: what we send on another link comes back here, through a gateway that is not r2p's",
    PortState.REFUSED: _NO_GATEWAY,
}


class Bridge:
    """Joins the links of a module. `told(link, kind, text, trouble)` is called with news for the user."""

    def __init__(
        self, space: TopicSpace, instance: int, options: BridgeOptions, told: Callable[[Link, str, str, bool], None]
    ) -> None:
        self.name = space.module
        self.instance = instance
        self.ports: dict[str, BridgePort] = {}
        """By the name of the link."""
        self.tree = Tree(instance)
        self._policy = Policy(options)
        self.relays = RoutingTable(self.ports, space, self._policy)
        self.presences = DirectoryRelay(self.name, instance, self.ports, space, self._policy, self.relays.retyped)
        self.names = ModuleNames(self._policy, self.presences.modules, self.presences.foreign)
        self._space = space
        self._clock = space.clock
        self._told = told
        self._by_number: dict[int, BridgePort] = {}
        self._numbers = itertools.count(FIRST)
        self._held = HeldMessages()
        self._changed: set[int] = set()
        """Ports whose place in the tree is another one, which is yet to be told to the rest."""
        self._alarm = Alarm(space.loop, self._poll, background=True)

    def make_topic(self, name: str, wake_scheduler: WakeScheduler) -> Topic:
        """For the module's topic space."""
        return BridgedTopic(name, wake_scheduler, self.ports, self._clock.monotonic, self._held)

    # Links

    def attach(self, link: Link) -> None:
        """The module has a link, up or not yet."""
        number = next((each for each in range(MOST_PORTS) if each not in self._by_number), None)
        if not link.admits_gateways or number is None:
            number = next(self._numbers)
        port = self.ports[link.name] = self._by_number[number] = BridgePort(self, link, number, self._clock.now)
        link.gateway_hooks = port
        if link.admits_gateways and number >= FIRST:
            port.state = port.place.state = PortState.REFUSED
            self._told(link, "too many links", f"a gateway joins {MOST_PORTS} links: this one is not", True)

    def detach(self, link: Link) -> None:
        """It does not have it any more."""
        port = self.ports.pop(link.name)
        del self._by_number[port.number]
        self._shut(port)
        self._port_changed(port)

    def link_changed(self, link: Link) -> None:
        """It went up or down."""
        port = self.ports[link.name]
        if link.up:
            self._open(port)
        else:
            self._shut(port)
        self._port_changed(port)

    def _open(self, port: BridgePort) -> None:
        now = self._clock.monotonic()
        if port.client:
            port.place = self.tree.clients.open(now, port.number)
        elif port.number < FIRST:
            self.tree.open(now, port.number, private=port.link.fixed_peer)
            port.place = self.tree.ports[port.number]
        port.place.lost = port.link.stats.lost

    def _shut(self, port: BridgePort) -> None:
        now = self._clock.monotonic()
        if port.client:
            self.tree.clients.shut(port.number)
            port.place = TreePort(port.number, now)
        elif port.number < FIRST:
            self.tree.shut(now, port.number)
            port.place = TreePort(port.number, now)
        self.presences.forget(port)

    def _port_changed(self, port: BridgePort) -> None:
        if not port.link.stats.lost.guard(self.relays.port_changed, port):
            self._changed.add(port.number)
        self._act()

    def close(self) -> None:
        self._alarm.close()
        self.presences.close()

    @property
    def gateway(self) -> int:
        return self.tree.gateway

    def desired_state(self, port: BridgePort, topic: Topic, own: Announcement) -> Announcement:
        """What a link is to be told of a topic."""
        return self.relays.desired_state(port, topic, own)

    def demand_changed(self, port: BridgePort, topics: set[str]) -> None:
        self.relays.changed(topics, port)

    def source_name(self, port: BridgePort, source: Source) -> str:
        """What the module that published a message is called on a link."""
        return self._policy.source_called(source.module, source.link, port.name) if source.link else source.module

    def modules_changed(self, port: BridgePort) -> None:
        self.presences.changed(port)

    # What comes in

    def handle_management(self, port: BridgePort, data: bytes) -> bool:
        """A management message; True if discovery need not see it."""
        kind = management.type_of(data)
        if kind in management.GATEWAY_TYPES:
            self._heard_gateway(port, data)
            return True
        if kind in management.ORDER_TYPES and self._pass_order(port, data):
            return True
        if kind == ManagementType.DENIED and data[_DENIED_ORDER]:
            self._pass_denial(port, data)
        if kind in (ManagementType.ALIVE, ManagementType.HELLO) and self._is_our_own(port, data):
            return True
        if kind == ManagementType.HELLO and data[_HELLO_FLAGS] & management.HELLO_QUERY:
            self.presences.asked(port)
        if kind == ManagementType.ALIVE and (probe := probes.decode(data)) is not None:
            self._probed(port, *probe)
            return True
        return False

    def _probed(self, port: BridgePort, gateway: int, its_port: int) -> None:
        if not port.client:
            self.tree.probed(self._clock.monotonic(), port.number, gateway, its_port)
        elif self.tree.knows(gateway):
            self.tree.clients.refuse(port.place, PortState.LOOP)
        self._act()

    def _is_our_own(self, port: BridgePort, data: bytes) -> bool:
        """Whether one of our other links said it, on the same network; an echo of this one is for discovery to find."""
        if port.place.echoes:
            return False
        try:
            message = management.decode(data)
        except (DecodeError, UnknownType):
            return False
        if isinstance(message, management.Hello):
            return message.instance == self.instance and message.hops == 0
        return isinstance(message, management.Alive) and message.module == self.name

    def _heard_gateway(self, port: BridgePort, data: bytes) -> None:
        try:
            message = management.decode(data)
        except (DecodeError, UnknownType):
            port.link.stats.lost["undecodable"] += 1
            return
        now = self._clock.monotonic()
        if port.client:
            self._heard_client(now, port, message)
        elif isinstance(message, management.Bridge):
            self.tree.bridge(now, port.number, message)
        elif isinstance(message, management.Mesh):
            self.tree.mesh(now, port.number, message)
        elif isinstance(message, management.Leaf):
            self.tree.leaf(now, port.number, message)
        self._act()

    def _heard_client(self, now: int, port: BridgePort, message: management.Management) -> None:
        if isinstance(message, management.Leaf):
            self.tree.clients.leaf(now, port.place, message)
        else:
            port.link.stats.lost["gateway refused"] += 1
            self.tree.clients.refuse(port.place, PortState.REFUSED)

    def _open_from(self, port: BridgePort) -> list[BridgePort]:
        """Where what came in here may go on to now."""
        now = self._clock.monotonic()
        if now >= port.place.until:
            port.lose("converging")
            return []
        others = [each for each in self.ports.values() if each is not port and each.link.up]
        return [each for each in others if now < each.place.until]

    def _pass_denial(self, port: BridgePort, data: bytes) -> None:
        """To whoever gave the order, which may be anywhere."""
        try:
            denied = management.decode(data)
        except (DecodeError, UnknownType):
            return
        name = self.names.meant(denied.module, port.name) if isinstance(denied, management.Denied) else None
        if name is None:
            return
        for other in self._open_from(port):
            wire = self.names.wire(name, other.name)
            if wire is not None:
                other.link.write_management(management.encode(msgspec.structs.replace(denied, module=wire)))

    def _pass_order(self, port: BridgePort, data: bytes) -> bool:
        """STOP, REBOOT or BOOTLOAD for a module that may be anywhere; True: for this one, which does not obey."""
        try:
            order = management.decode(data)
        except (DecodeError, UnknownType):
            return False
        if not isinstance(order, management.Stop | management.Reboot | management.Bootload):
            return False
        if order.module == self.name and (
            reason := self._policy.own_order_denied(port.name, harmless=isinstance(order, management.Stop))
        ):
            self._refuse_order(port, order, data[-1], reason, known=True)
            return True
        name = self.names.meant(order.module, port.name)
        if name is None:
            return False
        passed, refused, known = False, 0, False
        for other in self._open_from(port):
            called = self.names.called(name, other.name)
            if called is None:
                continue
            reason = self._order_denied(port, other, order, called)
            if not reason:
                passed = True
                named = msgspec.structs.replace(order, module=module_alias(called))
                other.link.write_management(management.encode(named), urgent=True)
            elif not known:
                known = called in other.link.discovery.modules
                refused = reason if known else refused or reason
        if refused and (known or not passed):
            self._refuse_order(port, order, data[-1], refused, known=known)
        return False

    def _refuse_order(self, port: BridgePort, order: _Order, kind: int, reason: int, *, known: bool) -> None:
        """Count it, log it once in a while, and answer if it is for a module that is `known`."""
        port.lose("order refused")
        more = port.refusals.suffix("", self._clock.monotonic())
        if more is not None:
            logger.warning(
                "%s from %s is refused: %s (%d orders refused so far)%s",
                type(order).__name__.upper(),
                port.name,
                _REFUSALS[reason],
                port.dropped["order refused"],
                more,
            )
        if known:
            self._deny(port, management.Denied(self.name, order.module, kind, reason))

    def _order_denied(self, port: BridgePort, other: BridgePort, order: _Order, called: str) -> int:
        """Why an order may not go to another link, where its module is `called` so (DENIED_..., 0: it may)."""
        stops = isinstance(order, management.Stop)
        if stops and is_booting(other.link, called):
            return management.DENIED_BOOT
        return self._policy.order_denied(port.name, other.name, harmless=stops)

    def _deny(self, port: BridgePort, message: management.Denied) -> None:
        """Tell who gave the order, if not just done."""
        now = self._clock.monotonic()
        if now >= port.denied_at + _DENIED_APART:
            port.denied_at = now
            port.link.write_management(management.encode(message))

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
        """Do what the tree says. Where something raises, that is counted and the rest is done."""
        try:
            for action in self.tree.take():
                self._do(action)
            for port in [port for number in self._changed if (port := self._by_number.get(number)) is not None]:
                self._see_changed(port)
            self._changed.intersection_update(self._by_number)
            if self._held and not any(port.place.resumes for port in self.ports.values()):
                self._held.release(self._failed)
        finally:
            again = self._clock.monotonic() + RETRY_AFTER_ERROR if self._changed else None
            dues = [due for due in (self.tree.next_deadline(), again) if due is not None]
            self._alarm.set(min(dues, default=None))

    def _do(self, action: Action) -> None:
        if isinstance(action, SayToClients):
            try:
                self._say_to_clients(management.encode(action.message))
            except Exception as error:  # noqa: BLE001 - counted and logged; the next action follows
                self._failed(error)
            return
        port = self._by_number.get(action.port)
        if port is None or not port.link.up:
            return
        if isinstance(action, Changed):
            self._changed.add(action.port)
        else:
            port.link.stats.lost.guard(self._send, port, action)

    def _see_changed(self, port: BridgePort) -> None:
        """Its place in the tree is another one; where that can't be told to the rest, it is tried again."""
        lost = port.link.stats.lost
        lost.guard(self._state_changed, port)
        if lost.guard(self.relays.port_changed, port):
            self._changed.discard(port.number)
        lost.guard(self.presences.changed, port)

    def _send(self, port: BridgePort, action: Say | Probe) -> None:
        if isinstance(action, Say):
            port.link.write_management(management.encode(action.message), urgent=True)
        elif port.link.passes_probes:
            port.link.write_management(probes.encode(self.tree.gateway, port.number))

    def _say_to_clients(self, data: bytes) -> None:
        for port in self.ports.values():
            if port.client and port.link.up:
                port.link.stats.lost.guard(port.link.write_management, data, urgent=True)

    def _state_changed(self, port: BridgePort) -> None:
        state = port.place.state
        if state is port.state:
            return
        forwarded = port.state in (PortState.ALONE, PortState.FORWARDING)
        port.state = state
        if forwarded:
            port.link.stats.lost["converging"] += port.link.discard()
        count = len(port.place.gateways)
        gateways = "another gateway" if count == 1 else f"{count} other gateways" if count else "modules there"
        self._told(
            port.link,
            state.value,
            _WORDS[state].format(gateways=gateways),
            state in (PortState.LOOP, PortState.REFUSED),
        )
        if state in (PortState.ALONE, PortState.FORWARDING):
            port.link.query()
        if state is PortState.REFUSED:
            denied = management.Denied(self.name, self.name, 0, management.DENIED_GATEWAYS)
            port.link.write_management(management.encode(denied))

    # For people

    def statistics(self) -> GatewayStatistics:
        """What it has done so far."""
        ports = [_port_statistics(port) for port in self.ports.values()]
        ways = [
            WayStatistics(topic, source, target, way.forwarded, dict(way.dropped))
            for topic, relay in sorted(self.relays.by_name.items())
            for (source, target), way in sorted(relay.ways, key=operator.itemgetter(0))
        ]
        return GatewayStatistics(ports, ways)


def _port_statistics(port: BridgePort) -> PortStatistics:
    state = port.place.state.value if port.link.up else "down"
    clock = port.link.translation()
    offset, error = (None, None) if clock is None else (clock.offset, clock.error)
    return PortStatistics(port.name, state, len(port.place.gateways), dict(port.dropped), offset, error)
