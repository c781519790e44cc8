"""The gateway of a module: its ports, the tree that they are part of, and what passes between them besides topics."""

from collections.abc import Callable

from r2p.bridge import probes
from r2p.bridge.options import BridgeOptions, Policy
from r2p.bridge.port import BridgePort
from r2p.bridge.presences import Presences
from r2p.bridge.relay import BridgedTopic
from r2p.bridge.relays import Relays
from r2p.bridge.statistics import GatewayStatistics, PortStatistics, WayStatistics
from r2p.clock import Alarm
from r2p.codecs import UnknownType, management
from r2p.errors import DecodeError
from r2p.printable import get_logger
from r2p.protocols.bridging.tree import MOST_PORTS, Changed, Port, Probe, Say, State, Tree
from r2p.topic import Topic, TopicSpace, Waker
from r2p.transports.announce import Told
from r2p.transports.link import Link, is_booting
from r2p.transports.losses import TRY_AGAIN, internal_error_of

logger = get_logger("r2p.bridge")

_ORDERS = (0x12, 0x13, 0x14)
_DENIED = 0x55
_DENIED_ORDER = 15  # its place
_DENIED_APART = 200_000_000  # ns between two answers on one link to orders that do not pass
_REFUSALS = {
    management.DENIED_CONTROL: "see --allow-control",
    management.DENIED_READ_ONLY: "see --read-only",
    management.DENIED_BOOT: "the module is in boot mode, where a STOP hangs it",
}
_ALIVE = 0x11
_HELLO = 0x50
_HELLO_FLAGS = 12  # its place
_TREE = (0x60, 0x61, 0x62)
_WORDS = {
    State.ALONE: "forwards",
    State.FORWARDING: "forwards, in agreement with {gateways}",
    State.BLOCKED: "is blocked: its network is joined to our others by {gateways}",
    State.CONVERGING: "is silent until it agrees with {gateways}",
    State.LISTENING: "listens for other gateways",
    State.LOOP: "is blocked: what we send on another link comes back here, through a gateway that is not one of r2p",
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
        self.relays = Relays(self.ports, space, self._policy)
        self.presences = Presences(self.name, instance, self.ports, space, self._policy, self.relays.retyped)
        self._space = space
        self._clock = space.clock
        self._told = told
        self._by_number: dict[int, BridgePort] = {}
        self._alarm = Alarm(space.loop, self._poll, background=True)

    def make_topic(self, name: str, waker: Waker) -> Topic:
        """For the module's topic space."""
        return BridgedTopic(name, waker, self.ports, self._clock.monotonic)

    # Links

    def attach(self, link: Link) -> None:
        """The module has a link, up or not yet."""
        number = next((each for each in range(MOST_PORTS) if each not in self._by_number), None)
        if number is None:
            self._told(link, "too many links", f"a gateway joins {MOST_PORTS} links: this one is not", True)
            return
        port = self.ports[link.name] = self._by_number[number] = BridgePort(self, link, number, self._clock.now)
        link.gate = port

    def detach(self, link: Link) -> None:
        """It does not have it any more."""
        port = self.ports.pop(link.name, None)
        if port is not None:
            del self._by_number[port.number]
            self.tree.shut(self._clock.monotonic(), port.number)
            self.presences.forget(port)
            self.relays.all_changed()
            self._act()

    def link_changed(self, link: Link) -> None:
        """It went up or down."""
        port = self.ports.get(link.name)
        if port is None:
            return
        now = self._clock.monotonic()
        if link.up:
            self.tree.open(now, port.number)
            port.place = self.tree.ports[port.number]
        else:
            self.tree.shut(now, port.number)
            port.place = Port(port.number, now)
            self.presences.forget(port)
        self.relays.all_changed()
        self._act()

    def close(self) -> None:
        self._alarm.close()
        self.presences.close()

    @property
    def gateway(self) -> int:
        return self.tree.gateway

    def wish(self, port: BridgePort, topic: Topic, own: Told) -> Told:
        """What a link is to be told of a topic."""
        return self.relays.wish(port, topic, own)

    def demand_changed(self, port: BridgePort, topics: set[str]) -> None:
        self.relays.changed(topics, port)

    def modules_changed(self) -> None:
        self.presences.changed()

    # What comes in

    def heard(self, port: BridgePort, data: bytes) -> bool:
        """A management message; True if discovery need not see it."""
        kind = data[-1] if len(data) == management.SIZE else 0
        if kind in _TREE:
            self._heard_gateway(port, data)
            return True
        if kind in _ORDERS:
            self._pass_order(port, data)
        if kind == _DENIED and data[_DENIED_ORDER]:
            self._pass_on(port, data)
        if kind in (_ALIVE, _HELLO) and self._is_our_own(port, data):
            return True
        if kind == _HELLO and data[_HELLO_FLAGS] & management.HELLO_QUERY:
            self.presences.asked(port)
        if kind == _ALIVE and (probe := probes.decode(data)) is not None:
            self.tree.probed(self._clock.monotonic(), port.number, *probe)
            self._act()
            return True
        return False

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
        if isinstance(message, management.Bridge):
            self.tree.bridge(now, port.number, message)
        elif isinstance(message, management.Mesh):
            self.tree.mesh(now, port.number, message)
        elif isinstance(message, management.Leaf):
            self.tree.leaf(now, port.number, message)
        self._act()

    def _open_from(self, port: BridgePort) -> list[BridgePort]:
        """Where what came in here may go on to now."""
        now = self._clock.monotonic()
        if now >= port.place.until:
            port.dropped["converging"] += 1
            return []
        others = [each for each in self.ports.values() if each is not port and each.link.up]
        return [each for each in others if now < each.place.until]

    def _pass_on(self, port: BridgePort, data: bytes) -> None:
        for other in self._open_from(port):
            other.link.write_management(data)

    def _pass_order(self, port: BridgePort, data: bytes) -> None:
        """STOP, REBOOT or BOOTLOAD for a module that may be anywhere."""
        try:
            order = management.decode(data)
        except (DecodeError, UnknownType):
            return
        if not isinstance(order, management.Stop | management.Reboot | management.Bootload):
            return
        for other in self._open_from(port):
            reason = self._order_denied(port, other, order)
            if not reason:
                other.link.write_management(data, urgent=True)
                continue
            port.dropped["order refused"] += 1
            logger.warning("%s from %s is refused: %s", type(order).__name__.upper(), port.name, _REFUSALS[reason])
            if order.module in other.link.discovery.modules:
                self._deny(port, management.Denied(self.name, order.module, data[-1], reason))

    def _order_denied(
        self, port: BridgePort, other: BridgePort, order: management.Stop | management.Reboot | management.Bootload
    ) -> int:
        """Why an order may not go from one link to the other (DENIED_..., 0: it may)."""
        stops = isinstance(order, management.Stop)
        if stops and is_booting(other.link, order.module):
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
        except Exception as error:  # noqa: BLE001 - counted and logged
            internal_error_of((port.link.stats.lost for port in self.ports.values()), error)
            self._alarm.set(now + TRY_AGAIN)
        else:
            self._act()

    def _act(self) -> None:
        changed: set[int] = set()
        for action in self.tree.take():
            port = self._by_number.get(action.port)
            if port is None or not port.link.up:
                continue
            if isinstance(action, Changed):
                changed.add(action.port)
            else:
                port.link.stats.lost.guard(self._send, port, action)
        for number in changed:
            port = self._by_number[number]
            port.link.stats.lost.guard(self._state_changed, port)
        if changed:
            self.relays.all_changed()
            self.presences.changed()
        self._alarm.set(self.tree.next_deadline())

    def _send(self, port: BridgePort, action: Say | Probe) -> None:
        if isinstance(action, Say):
            port.link.write_management(management.encode(action.message), urgent=True)
        elif port.link.passes_probes:
            port.link.write_management(probes.encode(self.tree.gateway, port.number))

    def _state_changed(self, port: BridgePort) -> None:
        state = port.place.state
        if state is port.state:
            return
        forwarded = port.state in (State.ALONE, State.FORWARDING)
        port.state = state
        if forwarded:
            port.link.stats.lost["converging"] += port.link.discard()
        count = len(port.place.gateways)
        gateways = "another gateway" if count == 1 else f"{count} other gateways" if count else "modules there"
        self._told(port.link, state.value, _WORDS[state].format(gateways=gateways), state is State.LOOP)
        if state in (State.ALONE, State.FORWARDING):
            port.link.query()

    # For people

    def statistics(self) -> GatewayStatistics:
        """What it has done so far."""
        ports = [_port_statistics(port) for port in self.ports.values()]
        ways = [
            WayStatistics(topic, source, target, way.forwarded, dict(way.dropped))
            for topic, relay in sorted(self.relays.by_name.items())
            for (source, target), way in sorted(relay.ways.items())
        ]
        return GatewayStatistics(ports, ways)


def _port_statistics(port: BridgePort) -> PortStatistics:
    state = port.place.state.value if port.link.up else "down"
    clock = port.link.translation()
    offset, error = (None, None) if clock is None else (clock.offset, clock.error)
    return PortStatistics(port.name, state, len(port.place.gateways), dict(port.dropped), offset, error)
