"""The ports of a gateway: those that take part in the spanning tree, and those of its clients, which do not.

`TreePort` is what is known at one link, `ClientPorts` runs the ports of clients; `tree` decides for all others.
Timings and acknowledgements are here, too: modules with several links (`link_selection`) share them with gateways.

An acknowledgement names a sender and the number of its last message. It proves that the link works in both directions,
and that the other end knows what that message said.
"""

import enum
from collections import Counter, deque
from collections.abc import Mapping

import msgspec

from r2p.codecs.management import (
    BRIDGE_ACKS,
    Bridge,
    Leaf,
    Mesh,
    decode_acks,
    encode_acks,
    is_newer_serial,
    next_serial,
)
from r2p.protocols.bridge.mesh import PortId
from r2p.units import LONG_AGO, MILLISECOND, NEVER

TICK = 80 * MILLISECOND
"""Ns between two BRIDGE where there are other gateways: seven fit into a lease, so some may be lost."""
TICK_ALONE = 200 * MILLISECOND
TICK_LISTENING = 50 * MILLISECOND
LEASE = 600 * MILLISECOND
"""How long an acknowledgement holds, from the instant at which the message that it acknowledges was sent."""
DEAD = 650 * MILLISECOND
"""A gateway that is silent for this long is gone. More than a lease: what it was granted has run out by then."""
LISTEN = 800 * MILLISECOND
"""A new port forwards nothing for this long. More than a lease: an old gateway that is stuck has stopped by then."""
SETTLE = 300 * MILLISECOND
"""Between agreement and forwarding; no message may take longer from its publisher to the last gateway."""
PROBE = 2_000 * MILLISECOND
"""Between two probes for loops through gateways that do not know this protocol."""
PROBE_MEMORY = 7_000 * MILLISECOND
"""A loop is believed in for this long after a probe showed it: two of three probes may be lost."""
PROBE_PROVEN = 300 * MILLISECOND
"""A gateway of which only a probe was heard for this long is not on this network itself."""
STRANGE_PROBES = 256
"""Probes of gateways outside the mesh that are kept for each port: they may be forged."""

MOST_PORTS = 250
"""Ports of a gateway that other gateways may use: the number has one byte on the wire."""

CLIENTS = 250
"""The port number that all clients share on the wire."""

FIRST_CLIENT = 1000
"""Clients are numbered from here on within the gateway."""

FLAPS = 8
"""Neighbours that may go before newcomers have to wait."""
FLAP_FORGIVEN = 10_000 * MILLISECOND
"""Ns after which one of those is forgotten."""

APART = 10 * MILLISECOND
"""Ns between two messages out of turn at least."""
MOST_LEAVES = 32  # on one network; all modules beyond these use one link only

_NO_ACKS = encode_acks((), BRIDGE_ACKS)


class PortState(enum.Enum):
    """What a port does; the values stand in the log and in statistics."""

    LISTENING = "listening"
    ALONE = "alone"
    CONVERGING = "converging"
    FORWARDING = "forwarding"
    BLOCKED = "blocked"
    LOOP = "loop"
    REFUSED = "refused"


_REFUSED = (PortState.REFUSED, PortState.LOOP)


# What the owner of the ports is to do


class SendToPort(msgspec.Struct, frozen=True):
    """Send this message at the port."""

    port: int
    message: Bridge | Mesh


class SendToClients(msgspec.Struct, frozen=True):
    """Send this message to all clients."""

    message: Bridge


class SendProbe(msgspec.Struct, frozen=True):
    """Send a probe at the port: something that any gateway passes on."""

    port: int


class PortChanged(msgspec.Struct, frozen=True):
    """The port has another state, or another place in the tree."""

    port: int


Action = SendToPort | SendToClients | SendProbe | PortChanged


# Acknowledgements


class Neighbour(msgspec.Struct):
    """A port or a module that was heard on the same network; instants in monotonic ns.

    `acked_at`: when the newest of our messages was sent that it has acknowledged.
    """

    heard_at: int
    count: int
    acked_at: int = 0
    agreement: int = 0
    root: int = 0


class SentMessages:
    """The messages of one sender: gives each a number, and remembers for a lease when it was sent."""

    def __init__(self, sender: int) -> None:
        self.count = 0
        """The number of the last one."""
        self._sender = sender
        self._sent: deque[tuple[int, int]] = deque()  # number, instant

    def next_number(self, now: int) -> int:
        """Number a message that is sent now."""
        self.count = next_serial(self.count)
        self._sent.append((self.count, now))
        while now - self._sent[0][1] > LEASE:
            self._sent.popleft()
        return self.count

    def acked_at(self, acks: bytes) -> int:
        """When the message was sent that `acks` acknowledge; 0 if they name none, or one older than a lease."""
        for sender, count in decode_acks(acks):
            if sender == self._sender:
                return next((at for each, at in reversed(self._sent) if each == count), 0)
        return 0


def is_late(count: int, last: int) -> bool:
    """Whether the message numbered `count` was overtaken by the one numbered `last`; parts of one message share it."""
    return count != last and not is_newer_serial(count, last)


def pack_acks(heard: Mapping[PortId, Neighbour], places: int) -> list[bytes]:
    """Acknowledge the last message of each sender in `heard`: the `acks` of as many messages as are needed.

    One message has `places` for acknowledgements; there is always at least one message, even with none to send.
    """
    latest = sorted(heard.items(), key=lambda item: item[1].heard_at)  # of several ports of a sender the last one heard
    acks = list({sender: neighbour.count for (sender, _), neighbour in latest}.items())
    starts = range(0, max(len(acks), 1), places)
    return [encode_acks(acks[at : at + places], places) for at in starts]


# Ports


class TreePort(msgspec.Struct, eq=False):
    """A port of this gateway: what was heard at it, and what follows.

    `forwards_until`: data may pass before this instant (monotonic ns). `in_tree`: whether data passes, has passed until
    the gateways began to converge, or will pass when they agree for SETTLE; demand travels where it is True.
    `neighbours` and `leaves` are the gateways and the modules with several links that were heard on its network.
    `echoes`: its link gives back what this gateway sends. `leaves_ready_since`: since when all `leaves` know the root.
    `private`: a connection whose other end stays the same while it is up. No gateway can join it unheard, so it needs
    no lease while there is none. `resumes`: it was ALONE, and listens anew only because this program stood still.
    `flaps`: how many neighbours have gone, `flapped_at`: when that was counted. `lost` counts messages of other
    gateways that were ignored, by reason.
    """

    number: int
    opened_at: int
    forwards_until: int = 0
    state: PortState = PortState.LISTENING
    in_tree: bool = False
    neighbours: dict[PortId, Neighbour] = {}
    leaves: dict[PortId, Neighbour] = {}
    leaves_ready_since: int | None = 0
    probes: dict[PortId, tuple[int, int]] = {}
    view: object = None
    agreement: int = 0
    agreed_since: int | None = None
    sent_at: int = LONG_AGO
    send_at: int = 0
    probe_at: int = 0
    echoes: bool = False
    private: bool = False
    resumes: bool = False
    flaps: int = 0
    flapped_at: int = 0
    lost: Counter[str] = msgspec.field(default_factory=Counter)

    @property
    def gateways(self) -> set[int]:
        """The gateways that were heard on its network."""
        return {gateway for gateway, _ in self.neighbours}

    def hurry(self, now: int) -> None:
        """Send the next BRIDGE out of turn."""
        self.send_at = min(self.send_at, max(now, self.sent_at + APART))

    def receive_leaf(self, now: int, message: Leaf, gateway: int, acked_at: int, rooted_at: int) -> bool:
        """Enter a LEAF that came in at a port of this `gateway`; False: nothing changes.

        `acked_at` is when the message was sent that it acknowledges, `rooted_at` when this gateway's root last changed.
        The module is entered once it knows this root. It is answered at once: it waits for the gateway's consent.
        """
        leaf_id = (message.module, message.port)
        leaf = self.leaves.get(leaf_id)
        if leaf is None:
            self.hurry(now)
            # Without a current acknowledgement it may be an old message; it counts once it has heard our answer.
            if not acked_at or acked_at < rooted_at or len(self.leaves) >= MOST_LEAVES:
                return False
            self.leaves = self.leaves | {leaf_id: Neighbour(now, message.count, acked_at)}
        elif is_late(message.count, leaf.count):
            return False
        elif not _may_hear(message, gateway):
            self.leaves = {each: known for each, known in self.leaves.items() if each != leaf_id}
        else:
            leaf.heard_at, leaf.count, leaf.acked_at = now, message.count, max(leaf.acked_at, acked_at)
        return True

    def expire_leaves(self, now: int) -> None:
        """Forget modules that were silent for DEAD."""
        if any(now - each.heard_at >= DEAD for each in self.leaves.values()):
            self.leaves = {leaf_id: each for leaf_id, each in self.leaves.items() if now - each.heard_at < DEAD}

    def extend_leaves(self, now: int) -> None:
        """Keep the modules for longer: what they sent while this program stood still is yet to be read."""
        for leaf in self.leaves.values():
            leaf.heard_at = now

    def invalidate_leaves(self, at: int) -> None:
        """Let nothing pass until the modules have acknowledged the new root, or are gone; send it `at` that instant."""
        self.leaves_ready_since = None
        self.send_at = at

    def check_leaves(self, now: int, rooted_at: int) -> None:
        """Note the instant from which all modules know this gateway's root."""
        if self.leaves_ready_since is None and all(each.acked_at >= rooted_at for each in self.leaves.values()):
            self.leaves_ready_since = now


def _may_hear(message: Leaf, gateway: int) -> bool:
    """Whether the module may hear the gateway. One that does not has lost its consent, and need not be waited for."""
    names = [name for name, _ in decode_acks(message.acks)]
    return gateway in names or 0 not in names  # with no free entry it may be one of those that did not fit


class ClientPorts:
    """The clients of a gateway: any number of connections, which take part in no mesh, and share one port of the tree.

    A client is a module or a tool at the other end of a connection of its own, not a gateway. So nothing that a client
    says changes what other links forward. One that sends BRIDGE or MESH, or by whose connection one of our probes comes
    back, is a gateway: it is refused for as long as its connection lasts. Each client is given LISTEN to show that
    before its port forwards. Modules with several links send LEAF here, too: each is waited for on its own connection.

    Every method takes `now` (monotonic ns); what is to be done goes to `actions`. The work that the time brings does
    not grow with the number of clients, apart from what is sent to all of them.
    """

    def __init__(self, gateway: int, actions: list[Action]) -> None:
        self.ports: dict[int, TreePort] = {}
        self._gateway = gateway
        self._actions = actions
        self._root = gateway
        self._rooted_at = 0
        self._sent = SentMessages(gateway)
        self._send_at = 0
        self._polled_at = 0
        self._listening: deque[TreePort] = deque()
        self._with_leaves: dict[int, TreePort] = {}

    def open(self, now: int, number: int) -> TreePort:
        """Add a port for a client that connected; `number` is FIRST_CLIENT or more."""
        port = TreePort(number, now, private=True)
        if not self.ports:  # nothing was due while there were no clients
            self._send_at = now + TICK_ALONE
        self.ports[port.number] = port
        self._listening.append(port)
        self._send_bridge(now, port)
        return port

    def close(self, number: int) -> None:
        """Remove the port of a client whose connection ended."""
        port = self.ports.pop(number, None)
        if port is None:
            return
        self._with_leaves.pop(port.number, None)
        if port in self._listening:
            self._listening.remove(port)
        port.forwards_until = 0

    def refuse(self, port: TreePort, state: PortState) -> None:
        """Let nothing pass for a client that is a gateway. `state` is REFUSED, or LOOP for a gateway of firmware."""
        if port.state not in _REFUSED:
            self._with_leaves.pop(port.number, None)
            port.leaves = {}
            self._set_state(port, state)

    def receive_leaf(self, now: int, port: TreePort, message: Leaf) -> None:
        """Enter a LEAF that came in from a client."""
        if not message.module or port.state in _REFUSED:
            return
        self._with_leaves[port.number] = port
        port.receive_leaf(now, message, self._gateway, self._sent.acked_at(message.acks), self._rooted_at)
        self._update(now, port)

    def set_root(self, at: int, root: int) -> None:
        """Announce another root from `at` on: nothing passes to modules with several links before they know it."""
        self._root, self._rooted_at = root, at
        for port in self._with_leaves.values():
            if port.leaves:
                port.invalidate_leaves(at)
                self._update(at, port)

    def poll(self, now: int) -> None:
        """Send what is due, and forget modules that were silent for DEAD."""
        stood_still = now - self._polled_at > LEASE
        self._polled_at = now
        while self._listening and now >= self._listening[0].opened_at + LISTEN:
            self._update(now, self._listening.popleft())
        for port in list(self._with_leaves.values()):
            if stood_still:
                port.extend_leaves(now)
            port.expire_leaves(now)
            self._update(now, port)
            if port.send_at <= now:
                self._send_bridge(now, port)
            if not port.leaves and port.state is PortState.ALONE:  # nothing there depends on the time any more
                del self._with_leaves[port.number]
        if self.ports and self._send_at <= now:
            self._send_at = now + TICK_ALONE
            self._actions.append(SendToClients(self._bridge(now, _NO_ACKS)))

    def next_deadline(self) -> int:
        """When to call `poll`."""
        if not self.ports:
            return NEVER
        dues = [self._send_at]
        if self._listening:
            dues.append(self._listening[0].opened_at + LISTEN)
        for port in self._with_leaves.values():
            dues.append(port.send_at)
            if port.state is PortState.CONVERGING and port.leaves_ready_since is not None:
                dues.append(port.leaves_ready_since + SETTLE)
        return min(dues)

    def _update(self, now: int, port: TreePort) -> None:
        port.check_leaves(now, self._rooted_at)
        if port.state in _REFUSED:
            return
        if now < port.opened_at + LISTEN:
            state = PortState.LISTENING
        elif port.leaves_ready_since is None or now < port.leaves_ready_since + SETTLE:
            state = PortState.CONVERGING
        else:
            state = PortState.ALONE
        self._set_state(port, state)

    def _set_state(self, port: TreePort, state: PortState) -> None:
        port.forwards_until = NEVER if state is PortState.ALONE else 0
        if state is not port.state:
            port.state = state
            port.in_tree = state not in _REFUSED and (port.in_tree or state is PortState.ALONE)
            self._actions.append(PortChanged(port.number))

    def _send_bridge(self, now: int, port: TreePort) -> None:
        """Send BRIDGE to one client, with acknowledgements for its modules."""
        for packed in pack_acks(port.leaves, BRIDGE_ACKS):
            self._actions.append(SendToPort(port.number, self._bridge(now, packed)))
        port.sent_at = now
        port.send_at = now + TICK

    def _bridge(self, now: int, acks: bytes) -> Bridge:
        return Bridge(self._gateway, CLIENTS, self._sent.next_number(now), 0, self._root, acks)
