"""One port of a gateway: the neighbours there, and until when they let the port forward.

A port's state depends on present knowledge, not on the previous state. The first of these that applies counts:

    LOOP         a probe shows a loop through a gateway that sends no BRIDGE, and this port is the one that yields
    LISTENING    the port is open for less than LISTEN: other gateways may be there that were not heard yet
    CONVERGING   for less than SETTLE, all modules that send LEAF here know this gateway's root; or some do not yet
    ALONE        no other gateway is on this network                                  forwards
    CONVERGING   gateways on this network have not acknowledged the same mesh
    BLOCKED      they have, and the tree does not contain the port
    CONVERGING   they have, the tree contains the port, for less than SETTLE
    FORWARDING   they have, the tree contains the port, for SETTLE or longer          forwards until a lease runs out

So nearly any state can follow any other: a port that hears its first gateway goes from ALONE to CONVERGING, and back
when the last one is silent. After a time in which the program stood still, ports are LISTENING again. The owner of the
ports sets REFUSED, for ports beyond PORTS_MAX and for clients that turn out to be gateways.

Modules with several links (`link_selection`) share the timings with gateways, and the acknowledgements. An
acknowledgement names a sender and the number of its last message. It proves that the link works in both directions, and
that the other end has received that message.
"""

import enum
from collections import Counter, deque
from collections.abc import Mapping

import msgspec

from r2p.codecs.management import Bridge, Leaf, Mesh, decode_acks, encode_acks, is_newer_serial, next_serial
from r2p.codecs.probes import PORT_MODULUS
from r2p.protocols.bridge.mesh import MeshMap, PortId, digest
from r2p.units import LONG_AGO, MILLISECOND, NEVER, SECOND

TICK = 80 * MILLISECOND
"""Ns between two BRIDGE with other gateways present: seven fit into a lease, so some may be lost."""
TICK_ALONE = 200 * MILLISECOND
"""The same without other gateways: three fit into a lease."""
TICK_LISTENING = 50 * MILLISECOND
"""The same at a new port, so that several are sent, and answered, before it may forward."""
LEASE = 600 * MILLISECOND
"""Validity of an acknowledgement, from the instant at which the acknowledged message was sent."""
DEAD = 650 * MILLISECOND
"""A gateway that is silent for this long is gone. More than a lease: its permissions have expired by then."""
LISTEN = 800 * MILLISECOND
"""A new port forwards nothing for this long. More than a lease: an old gateway that is stuck has stopped by then."""
SETTLE = 300 * MILLISECOND
"""Between agreement and forwarding; no message may take longer from its publisher to the last gateway."""
PROBE = 2 * SECOND
"""Between two probes for loops through gateways that do not know this protocol."""
PROBE_MEMORY = 7 * SECOND
"""Duration of a loop after a probe showed it: two of three probes may be lost."""
PROBE_PROVEN = 300 * MILLISECOND
"""A gateway that sends probes for this long, but no BRIDGE, is not on this network itself."""
STRANGE_PROBES_MAX = 256
"""Probes of gateways outside the mesh that are kept for each port: they may be forged."""

PORTS_MAX = 250
"""Ports of a gateway that other gateways may use: the number has one byte on the wire."""

FLAPS_MAX = 8
"""Neighbours that may go before newcomers have to wait."""
FLAP_FORGIVEN = 10 * SECOND
"""Ns after which one of these departures is forgotten."""

APART = 10 * MILLISECOND
"""Ns between two messages out of turn at least."""
LEAVES_MAX = 32
"""Modules with several links on one network, at most; any more use one link only."""


class PortState(enum.Enum):
    """States of a port; the values stand in the log and in statistics."""

    LISTENING = "listening"
    ALONE = "alone"
    CONVERGING = "converging"
    FORWARDING = "forwarding"
    BLOCKED = "blocked"
    LOOP = "loop"
    REFUSED = "refused"


# Actions for the owner of the ports


class SendToPort(msgspec.Struct, frozen=True):
    """Send this message at the port."""

    port: int
    message: Bridge | Mesh


class SendToClients(msgspec.Struct, frozen=True):
    """Send this message to all clients."""

    message: Bridge


class SendProbe(msgspec.Struct, frozen=True):
    """Send a probe at the port, which any gateway passes on."""

    port: int


class PortChanged(msgspec.Struct, frozen=True):
    """The port has another state, or another place in the tree."""

    port: int


Action = SendToPort | SendToClients | SendProbe | PortChanged


# Acknowledgements


class Neighbour(msgspec.Struct):
    """A port or a module that was heard on the same network; instants in monotonic ns.

    `acked_at`: when the newest message that it has acknowledged was sent.
    """

    heard_at: int
    count: int
    acked_at: int = 0
    agreement: int = 0
    root: int = 0


class SentMessages:
    """The messages of one sender: numbers them, and keeps the time of sending for a lease."""

    def __init__(self, sender: int) -> None:
        self._count = 0
        self._sender = sender
        self._sent: deque[tuple[int, int]] = deque()  # number, instant

    def next_number(self, now: int) -> int:
        """Number a message that is sent now."""
        self._count = next_serial(self._count)
        self._sent.append((self._count, now))
        while now - self._sent[0][1] > LEASE:
            self._sent.popleft()
        return self._count

    def acked_at(self, acks: bytes) -> int:
        """Return when the message that `acks` acknowledge was sent; 0 if they name none, or one older than a lease."""
        for sender, count in decode_acks(acks):
            if sender == self._sender:
                return next((at for each, at in reversed(self._sent) if each == count), 0)
        return 0


def is_late(count: int, last: int) -> bool:
    """Return whether message `last` has overtaken message `count`; parts of one message share their number."""
    return count != last and not is_newer_serial(count, last)


def pack_acks(heard: Mapping[PortId, Neighbour], places: int) -> list[bytes]:
    """Acknowledge the last message of each sender in `heard`: the `acks` of as many messages as are needed.

    One message has `places` for acknowledgements; there is always at least one message, even with none to send.
    """
    latest = sorted(heard.items(), key=lambda item: item[1].heard_at)  # of several ports of a sender the last one heard
    acks = list({sender: neighbour.count for (sender, _), neighbour in latest}.items())
    starts = range(0, max(len(acks), 1), places)
    return [encode_acks(acks[at : at + places], places) for at in starts]


class TreePort(msgspec.Struct, eq=False):
    """A port of this gateway: its neighbours, and its state.

    `forwards_until`: data may pass before this instant (monotonic ns). `in_tree`: whether data passes, has passed until
    the gateways began to converge, or will pass when they agree for SETTLE; demand travels where it is True.
    `neighbours` and `leaves` are the gateways and the modules with several links that were heard on its network.
    `echoes`: its link returns this gateway's own messages. `leaves_ready_since`: since when all `leaves` know the root.
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
    leaves_ready_since: int | None = LONG_AGO
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

    def next_deadline(self) -> int:
        """Return when to send or to update, if nothing else happens."""
        due = min(self.send_at, self.probe_at)
        if self.state is PortState.LISTENING:
            due = min(due, self.opened_at + LISTEN)
        agreed, ready = self.agreed_since, self.leaves_ready_since
        if self.state is PortState.CONVERGING and agreed is not None and ready is not None:
            due = min(due, max(agreed, ready) + SETTLE)
        return due

    def stop_listening(self, now: int) -> None:
        """Let the time for other gateways to show be over: none can be there."""
        self.opened_at = now - LISTEN

    # What comes in

    def forgive_flaps(self, now: int) -> None:
        """Forget neighbours that went long ago: with FLAPS_MAX of them a gateway that is new here has to wait."""
        if self.flaps:
            forgiven = min(self.flaps, (now - self.flapped_at) // FLAP_FORGIVEN)
            self.flaps -= forgiven
            self.flapped_at += forgiven * FLAP_FORGIVEN

    def receive_bridge(self, now: int, message: Bridge, acked_at: int) -> bool:
        """Enter a BRIDGE of a neighbour, old or new; return False if it is late. `acked_at`: see `Neighbour`."""
        sender = (message.gateway, message.port)
        neighbour = self.neighbours.get(sender)
        if neighbour is None:
            neighbour = Neighbour(now, message.count, agreement=message.agreement)
            # The gateway is on this network itself: its probes came directly, not through a loop of firmware.
            self.probes = {each: at for each, at in self.probes.items() if each[0] != message.gateway}
            self.neighbours = self.neighbours | {sender: neighbour}
        elif is_late(message.count, neighbour.count):
            return False
        if neighbour.agreement != message.agreement:
            neighbour.acked_at = 0  # it consented to another mesh
            self.hurry(now)
        neighbour.heard_at, neighbour.count, neighbour.agreement = now, message.count, message.agreement
        neighbour.acked_at = max(neighbour.acked_at, acked_at)
        return True

    def receive_leaf(self, now: int, message: Leaf, mesh: MeshMap, acked_at: int) -> bool:
        """Enter a LEAF; return False if nothing changes. `acked_at` is when the acknowledged message was sent.

        The module is entered once it knows this root. It is answered at once: it waits for the gateway's consent.
        """
        leaf_id = (message.module, message.port)
        leaf = self.leaves.get(leaf_id)
        if leaf is None:
            self.hurry(now)
            # Without a current acknowledgement it may be an old message; it counts once it has heard the answer.
            if not acked_at or acked_at < mesh.rooted_at or len(self.leaves) >= LEAVES_MAX:
                return False
            self.leaves = self.leaves | {leaf_id: Neighbour(now, message.count, acked_at)}
        elif is_late(message.count, leaf.count):
            return False
        elif not _may_hear(message, mesh.gateway):
            self.leaves = {each: known for each, known in self.leaves.items() if each != leaf_id}
        else:
            leaf.heard_at, leaf.count, leaf.acked_at = now, message.count, max(leaf.acked_at, acked_at)
        return True

    def receive_probe(self, now: int, sender: PortId, mesh: MeshMap) -> bool:
        """Record a probe of a gateway that is on another network; return False if the table is full.

        Probes of the mesh's gateways always fit. Others may be forged, or come from a gateway that joins later: at most
        STRANGE_PROBES_MAX of them are kept.
        """
        known = sender in self.probes or sender[0] in mesh.members
        if not known and sum(each not in mesh.members for each, _ in self.probes) >= STRANGE_PROBES_MAX:
            self.lost["too many probes"] += 1
            return False
        self.probes = self.probes | {sender: (self.probes.get(sender, (now, now))[0], now)}
        return True

    # Time

    def expire(self, now: int, mesh: MeshMap) -> None:
        """Forget gateways and modules that were silent for DEAD, and old probes."""
        if any(now - each.heard_at >= DEAD for each in self.neighbours.values()):
            before = self.gateways
            self.neighbours = _fresh(now, self.neighbours)
            if not self.flaps:
                self.flapped_at = now
            gone = len(before - self.gateways - {mesh.gateway})
            self.flaps = min(self.flaps + gone, FLAPS_MAX)
        self.expire_leaves(now)
        if any(now - last >= PROBE_MEMORY for _, last in self.probes.values()):
            self.probes = {sender: at for sender, at in self.probes.items() if now - at[1] < PROBE_MEMORY}

    def expire_leaves(self, now: int) -> None:
        """Forget modules that were silent for DEAD."""
        if any(now - each.heard_at >= DEAD for each in self.leaves.values()):
            self.leaves = _fresh(now, self.leaves)

    def extend_leaves(self, now: int) -> None:
        """Keep the modules for longer: their messages while this program stood still are yet to be read."""
        for leaf in self.leaves.values():
            leaf.heard_at = now

    def start_over(self, now: int) -> None:
        """Listen anew: this program stood still for so long that others may have given this gateway up."""
        self.send_at = now
        if self.private and not self.neighbours:  # no gateway can have come meanwhile
            self.extend_leaves(now)
            return
        self.resumes = self.resumes or self.state is PortState.ALONE
        self.opened_at = now
        self.neighbours = {}
        self.leaves = {}
        self.agreed_since = None

    # Sent

    def hurry(self, now: int) -> None:
        """Send the next BRIDGE out of turn."""
        self.send_at = min(self.send_at, max(now, self.sent_at + APART))

    def note_sent(self, now: int, mesh: MeshMap) -> None:
        """Note that BRIDGE was sent: plan the next one, and forward for longer if no consent is needed."""
        listening, others = self.state is PortState.LISTENING, self.neighbours or self.leaves
        self.sent_at = now
        self.send_at = now + (TICK_LISTENING if listening else TICK if others else TICK_ALONE)
        self.forwards_until = self._forwards_until(mesh)

    # What follows

    def root_changed(self, mesh: MeshMap) -> None:
        """Let nothing pass until the modules here have acknowledged the new root, or are gone."""
        if self.leaves:
            self.leaves_ready_since = None
            self.send_at = mesh.rooted_at

    def update(self, now: int, mesh: MeshMap) -> bool:
        """Work out whether the gateways here agree, and the state; return whether that, or the place in the tree, is
        another one.
        """
        view = (mesh.fingerprint, frozenset(self.neighbours))
        if view != self.view:
            self.view = view
            self.agreement = digest(mesh.fingerprint, sorted([(mesh.gateway, self.number), *self.neighbours]))
            self.agreed_since = None
            self.hurry(now)
        if not self.is_agreed(now, mesh):
            self.agreed_since = None
        elif self.agreed_since is None:
            self.agreed_since = now
        return self.update_state(now, mesh)

    def update_state(self, now: int, mesh: MeshMap) -> bool:
        """Do the same for a port that can't have another gateway."""
        if self.leaves_ready_since is None and all(each.acked_at >= mesh.rooted_at for each in self.leaves.values()):
            self.leaves_ready_since = now
        before = self.state, self.in_tree
        self.state = self._state(now, mesh)
        self.in_tree = self._is_in_tree(mesh)
        self.forwards_until = self._forwards_until(mesh)
        if self.state is not PortState.LISTENING or self.neighbours:
            self.resumes = False  # listening is over, or the port will not be alone: hold no more samples for it
        return (self.state, self.in_tree) != before

    def is_agreed(self, now: int, mesh: MeshMap) -> bool:
        """Return whether all gateways there have acknowledged this very mesh within a lease."""
        return all(  # other ports of this gateway agree anyway
            each.agreement == self.agreement and now < each.acked_at + LEASE
            for (gateway, _), each in self.neighbours.items()
            if gateway != mesh.gateway
        )

    def _state(self, now: int, mesh: MeshMap) -> PortState:
        if self._loops(now, mesh):  # first of all: agreement says nothing about gateways that do not take part
            return PortState.LOOP
        if now < self.opened_at + LISTEN:
            return PortState.LISTENING
        if self.leaves_ready_since is None or now < self.leaves_ready_since + SETTLE:
            return PortState.CONVERGING
        if not self.neighbours:
            return PortState.ALONE
        if self.agreed_since is None:
            return PortState.CONVERGING
        if not mesh.forwards(self.number):
            return PortState.BLOCKED
        return PortState.FORWARDING if now >= self.agreed_since + SETTLE else PortState.CONVERGING

    def _is_in_tree(self, mesh: MeshMap) -> bool:
        """Return whether the port is in the tree, also at times when nothing may pass yet."""
        if self.state in (PortState.ALONE, PortState.FORWARDING):
            return True
        if self.state in (PortState.BLOCKED, PortState.LOOP):
            return False
        if self.neighbours and self.agreed_since is not None:
            return mesh.forwards(self.number)  # before SETTLE is over: demand travels first, then data
        return self.in_tree  # not agreed yet: the next tree may be the same, and then demand need not move

    def _forwards_until(self, mesh: MeshMap) -> int:
        if self.state is PortState.ALONE:
            # Another gateway that comes listens for longer than a lease: by then it has heard this one, or this program
            # is stuck.
            return NEVER if self.private else self.sent_at + LEASE
        if self.state is not PortState.FORWARDING:
            return 0
        acked = [each.acked_at for (gateway, _), each in self.neighbours.items() if gateway != mesh.gateway]
        return min([self.sent_at, *acked]) + LEASE

    def _loops(self, now: int, mesh: MeshMap) -> bool:
        """Return whether the port is in a loop through a gateway that sends no BRIDGE, and is the end that yields.

        A received probe proves the loop. Of two ports of one gateway the one with the higher number (modulo
        PORT_MODULUS) yields, of two gateways the one with the higher number.
        """
        for (gateway, its_port), (first, _) in self.probes.items():
            if now - first < PROBE_PROVEN or gateway in self.gateways:
                continue
            if gateway == mesh.gateway and its_port < self.number % PORT_MODULUS:
                return True
            if gateway in mesh.members and gateway < mesh.gateway:
                return True
        return False


def _fresh(now: int, heard: dict[PortId, Neighbour]) -> dict[PortId, Neighbour]:
    return {sender: each for sender, each in heard.items() if now - each.heard_at < DEAD}


def _may_hear(message: Leaf, gateway: int) -> bool:
    """Return whether the module may hear the gateway. One that does not has lost its consent: don't wait for it."""
    names = [name for name, _ in decode_acks(message.acks)]
    return gateway in names or 0 not in names  # with no free entry it may be one of those that did not fit
