"""One gateway's part in the forwarding tree: who may forward where, and until when.

`Tree` hears BRIDGE and MESH at each port and says its own; `Port.until` is the instant before which data may pass.
A gateway that was stopped for a while finds it in the past before it does anything else.

    LISTENING --LISTEN s--> ALONE                       nobody else is on this network: forwards
        |                     |
        +--another is heard---+--> CONVERGING --all agree--> BLOCKED          not in the tree
                                       |                        |
                                       +--all agree, SETTLE s--> FORWARDING   in the tree, by leases

The timings fit together: a gateway counts as dead (`DEAD`) only after what it was granted has run out (`LEASE`); a new
one listens (`LISTEN`) for longer than an old one can be stuck and still forward.

Modules that are no gateways may have several links, too (`homes`). Those that use links of several meshes say so, by
LEAF; and before a gateway forwards in another mesh than before (its root is another one), they know of it.
"""

import enum
import struct
from collections import deque

import msgspec

from r2p.codecs.management import Bridge, Leaf, Mesh
from r2p.protocols.bridging.atlas import Atlas
from r2p.protocols.bridging.mesh import Edge, Place, digest

_MS = 1_000_000

TICK = 80 * _MS
"""Ns between two BRIDGE where there are other gateways."""
TICK_ALONE = 200 * _MS
TICK_LISTENING = 50 * _MS
LEASE = 600 * _MS
"""How long an acknowledgement holds, from when what it acknowledges was sent."""
DEAD = 650 * _MS
"""A gateway that was silent for so long is gone."""
LISTEN = 800 * _MS
"""A new port is silent for so long, but for hellos."""
SETTLE = 300 * _MS
"""Between agreement and forwarding; no message may take longer from its publisher to the last gateway."""
PROBE = 2_000 * _MS
"""Between two probes for loops through gateways that know nothing of this."""
PROBE_MEMORY = 7_000 * _MS
PROBE_PROVEN = 300 * _MS
"""A gateway of which only a probe was heard for so long is not on this network itself."""

MOST_PORTS = 250

APART = 10 * _MS
"""Between two hellos at least, for those out of turn."""
_FOR_EVER = 1 << 62
ACK = struct.Struct("<IH")
_ACKS = 2
_LEAVES = 32  # on one network; more than these use one link only
_RECORDS_A_TICK = 16


class State(enum.Enum):
    """What a port does."""

    LISTENING = "listening"
    ALONE = "alone"
    CONVERGING = "converging"
    FORWARDING = "forwarding"
    BLOCKED = "blocked"
    LOOP = "loop"


class Say(msgspec.Struct, frozen=True):
    """Send this at the port."""

    port: int
    message: Bridge | Mesh


class Probe(msgspec.Struct, frozen=True):
    """Send a probe at the port: something that any gateway passes on."""

    port: int


class Changed(msgspec.Struct, frozen=True):
    """A port is in another state, or has another place in the tree."""

    port: int


Action = Say | Probe | Changed


class Neighbour(msgspec.Struct):
    """Another port on the same network; instants in monotonic ns."""

    heard_at: int
    count: int
    agreement: int
    acked_at: int


def is_late(count: int, last: int) -> bool:
    """Whether a message was overtaken by one with the number `last`."""
    return (count - last) & 0xFFFF >= 0x8000


def acknowledged(acks: bytes, sender: int, sent: deque[tuple[int, int]]) -> int:
    """When `sender` sent what these acks name; 0: nothing of its that still counts. `sent`: count, instant."""
    for name, count in ACK.iter_unpack(acks):
        if name == sender:
            return next((at for each, at in reversed(sent) if each == count), 0)
    return 0


def packed_acks(acks: list[tuple[int, int]], each: int) -> list[bytes]:
    """Senders and counts, `each` of them in a message."""
    starts = range(0, max(len(acks), 1), each)
    return [b"".join(ACK.pack(*ack) for ack in acks[at : at + each]).ljust(each * ACK.size, b"\0") for at in starts]


class Port(msgspec.Struct, eq=False):
    """A port of this gateway.

    `until`: data may pass before this instant (monotonic ns). `in_tree`: whether it does, has done, or will soon do so;
    what others want is known by that. `gateways` are those heard on its network. `echoes`: it gives back what we say.
    `heeded_since`: since when all `leaves` there know our root.
    """

    number: int
    opened_at: int
    until: int = 0
    state: State = State.LISTENING
    in_tree: bool = False
    neighbours: dict[Place, Neighbour] = {}
    leaves: dict[Place, Neighbour] = {}
    heeded_since: int | None = 0
    probes: dict[Place, tuple[int, int]] = {}
    view: object = None
    agreement: int = 0
    agreed_since: int | None = None
    said_at: int = -_FOR_EVER
    say_at: int = 0
    probe_at: int = 0
    echoes: bool = False

    @property
    def gateways(self) -> set[int]:
        return {gateway for gateway, _ in self.neighbours}


class Tree:
    """The tree as one gateway knows it. Every method takes `now` (monotonic ns); `take` gives what to do about it.

    `gateway` is its number, that of this start of it; 0 can't be one.
    """

    def __init__(self, gateway: int) -> None:
        self.gateway = gateway or 1
        self.ports: dict[int, Port] = {}
        self.root = self.gateway
        """The lowest gateway of the mesh, as this one tells it."""
        self._rooted_at = 0
        self._atlas = Atlas(self.gateway)
        self._count = 0
        self._sent: deque[tuple[int, int]] = deque()  # count, instant
        self._looked_at = 0
        self._actions: list[Action] = []

    @property
    def edges(self) -> frozenset[Edge]:
        """The mesh of gateways that this one is part of."""
        return self._atlas.edges

    # Ports

    def open(self, now: int, number: int) -> None:
        """A link is up."""
        self.ports[number] = Port(number, now, say_at=now, probe_at=now)
        self._look(now)

    def shut(self, now: int, number: int) -> None:
        """It is down."""
        port = self.ports.pop(number, None)
        if port is not None:
            port.until = 0
        self._look(now)

    def take(self) -> list[Action]:
        actions, self._actions = self._actions, []
        return actions

    def next_deadline(self) -> int | None:
        """When to call `poll`."""
        return min((self._due(port) for port in self.ports.values()), default=None)

    def poll(self, now: int) -> None:
        """Say what is due, and see who has fallen silent."""
        self._look(now)
        for port in self.ports.values():
            if port.say_at <= now:
                self._say(now, port)
            if port.probe_at <= now:
                self._probe(now, port)

    def _begin_anew(self, now: int) -> None:
        """We were stopped for so long that others may think we are gone."""
        for port in self.ports.values():
            port.opened_at = port.say_at = now
            port.neighbours = {}
            port.leaves = {}
            port.agreed_since = None

    def _due(self, port: Port) -> int:
        due = min(port.say_at, port.probe_at)
        if port.state is State.LISTENING:
            due = min(due, port.opened_at + LISTEN)
        if port.state is State.CONVERGING and port.agreed_since is not None and port.heeded_since is not None:
            due = min(due, max(port.agreed_since, port.heeded_since) + SETTLE)
        return due

    # What comes in

    def bridge(self, now: int, number: int, message: Bridge) -> None:
        """A BRIDGE was heard."""
        port = self.ports.get(number)
        place = (message.gateway, message.port)
        if port is None or not message.gateway:
            return
        if place == (self.gateway, number):
            port.echoes = True
            return
        neighbour = port.neighbours.get(place)
        if neighbour is None:
            neighbour = Neighbour(now, message.count, message.agreement, 0)
            port.probes = {each: at for each, at in port.probes.items() if each[0] != message.gateway}
            port.neighbours = port.neighbours | {place: neighbour}
        elif is_late(message.count, neighbour.count):
            return
        if neighbour.agreement != message.agreement:
            neighbour.acked_at = 0
            port.say_at = min(port.say_at, max(now, port.said_at + APART))
        neighbour.heard_at, neighbour.count, neighbour.agreement = now, message.count, message.agreement
        neighbour.acked_at = max(neighbour.acked_at, acknowledged(message.acks, self.gateway, self._sent))
        self._look(now, port)

    def leaf(self, now: int, number: int, message: Leaf) -> None:
        """A LEAF was heard: it counts from when it knows our root, and has an answer at once."""
        port = self.ports.get(number)
        if port is None or not message.module:
            return
        place = (message.module, message.port)
        acked_at = acknowledged(message.acks, self.gateway, self._sent)
        leaf = port.leaves.get(place)
        if leaf is None:
            port.say_at = min(port.say_at, max(now, port.said_at + APART))
            if not acked_at or acked_at < self._rooted_at or len(port.leaves) >= _LEAVES:
                return
            port.leaves = port.leaves | {place: Neighbour(now, message.count, 0, acked_at)}
        elif is_late(message.count, leaf.count):
            return
        elif not self._is_heard_by(message):
            port.leaves = {each: known for each, known in port.leaves.items() if each != place}
        else:
            leaf.heard_at, leaf.count, leaf.acked_at = now, message.count, max(leaf.acked_at, acked_at)
        self._look(now, port)

    def mesh(self, now: int, number: int, message: Mesh) -> None:
        """A MESH was heard: new things are passed on at once."""
        if message.gateway in (0, self.gateway) or number not in self.ports:
            return
        if not self._atlas.learn(now, message):
            return
        self._take_root(now)
        for port in self.ports.values():
            if port.neighbours and port.number != number:
                self._say_record(port, message.gateway)
        self._look(now)

    def probed(self, now: int, number: int, gateway: int, its_port: int) -> None:
        """A probe was heard, that this gateway or another one sent at that port (its number modulo 13)."""
        port = self.ports.get(number)
        place = gateway, its_port
        if port is not None and place != (self.gateway, number % 13) and gateway not in port.gateways:
            port.probes = port.probes | {place: (port.probes.get(place, (now, now))[0], now)}
            self._look(now)

    def _is_heard_by(self, message: Leaf) -> bool:
        """Whether it may hear us: who does not has no consent of ours any more."""
        names = [name for name, _ in ACK.iter_unpack(message.acks)]
        return self.gateway in names or 0 not in names

    # What follows from it

    def _look(self, now: int, changed: Port | None = None) -> None:
        """Work out everything that follows from what was heard, and from the time; at one port only if the mesh is
        as it was.
        """
        if now - self._looked_at > LEASE:
            self._begin_anew(now)
        self._looked_at = now
        mesh = self._atlas.fingerprint
        if changed is None:
            self._bury(now)
        heard = frozenset((port.number, *place) for port in self.ports.values() for place in port.neighbours)
        if self._atlas.hear(heard):
            self._take_root(now)
            for port in self.ports.values():
                if port.neighbours:
                    self._say_record(port, self.gateway)
        everywhere = changed is None or mesh != self._atlas.fingerprint
        for port in list(self.ports.values()) if everywhere or changed is None else [changed]:
            self._judge(now, port)

    def _bury(self, now: int) -> None:
        for port in self.ports.values():
            if any(now - each.heard_at >= DEAD for each in port.neighbours.values()):
                port.neighbours = {place: each for place, each in port.neighbours.items() if now - each.heard_at < DEAD}
            if any(now - each.heard_at >= DEAD for each in port.leaves.values()):
                port.leaves = {place: each for place, each in port.leaves.items() if now - each.heard_at < DEAD}
            if any(now - last >= PROBE_MEMORY for _, last in port.probes.values()):
                port.probes = {place: at for place, at in port.probes.items() if now - at[1] < PROBE_MEMORY}
        self._atlas.forget(now)

    def _take_root(self, now: int) -> None:
        """The mesh may have another root now."""
        if self._atlas.root != self.root:
            self.root = self._atlas.root
            self._tell_leaves(now + 1)  # what was said in this very instant is older

    def _tell_leaves(self, at: int) -> None:
        """What they know of us is wrong: nothing passes before they know better, or are gone."""
        self._rooted_at = at
        for port in self.ports.values():
            if port.leaves:
                port.heeded_since = None
                port.say_at = at

    def _judge(self, now: int, port: Port) -> None:
        view = (self._atlas.fingerprint, frozenset(port.neighbours))
        if view != port.view:
            port.view = view
            agreement = digest(self._atlas.fingerprint, sorted([(self.gateway, port.number), *port.neighbours]))
            port.agreement = agreement
            port.agreed_since = None
            port.say_at = min(port.say_at, max(now, port.said_at + APART))
        if not self._agreed(now, port):
            port.agreed_since = None
        elif port.agreed_since is None:
            port.agreed_since = now
        if port.heeded_since is None and all(each.acked_at >= self._rooted_at for each in port.leaves.values()):
            port.heeded_since = now
        state = self._state(now, port)
        in_tree = self._in_tree(port, state)
        port.until = self._until(port, state)
        if (state, in_tree) != (port.state, port.in_tree):
            port.state, port.in_tree = state, in_tree
            self._actions.append(Changed(port.number))

    def _agreed(self, now: int, port: Port) -> bool:
        return all(
            each.agreement == port.agreement and now < each.acked_at + LEASE
            for (gateway, _), each in port.neighbours.items()
            if gateway != self.gateway
        )

    def _state(self, now: int, port: Port) -> State:
        if self._loops(now, port):
            return State.LOOP
        if now < port.opened_at + LISTEN:
            return State.LISTENING
        if port.heeded_since is None or now < port.heeded_since + SETTLE:
            return State.CONVERGING
        if not port.neighbours:
            return State.ALONE
        if port.agreed_since is None:
            return State.CONVERGING
        if not self._is_chosen(port):
            return State.BLOCKED
        return State.FORWARDING if now >= port.agreed_since + SETTLE else State.CONVERGING

    def _in_tree(self, port: Port, state: State) -> bool:
        """Other than the state, the place stays while the gateways converge, and is known before data may pass."""
        if state in (State.ALONE, State.FORWARDING):
            return True
        if state in (State.BLOCKED, State.LOOP):
            return False
        if port.neighbours and port.agreed_since is not None:
            return self._is_chosen(port)
        return port.in_tree

    def _until(self, port: Port, state: State) -> int:
        if state is State.ALONE:
            return port.said_at + LEASE
        if state is not State.FORWARDING:
            return 0
        acked = [each.acked_at for (gateway, _), each in port.neighbours.items() if gateway != self.gateway]
        return min([port.said_at, *acked]) + LEASE

    def _is_chosen(self, port: Port) -> bool:
        return self._atlas.chosen((self.gateway, port.number))

    def _loops(self, now: int, port: Port) -> bool:
        """Whether a gateway that says no BRIDGE joins this network to another one of ours, and we are to keep off."""
        for (gateway, its_port), (first, _) in port.probes.items():
            if now - first < PROBE_PROVEN or gateway in port.gateways:
                continue
            if gateway == self.gateway and its_port < port.number % 13:
                return True
            if gateway in self._atlas.members and gateway < self.gateway:
                return True
        return False

    # What goes out

    def _say(self, now: int, port: Port) -> None:
        self._count = (self._count + 1) & 0xFFFF
        self._sent.append((self._count, now))
        latest = sorted([*port.neighbours.items(), *port.leaves.items()], key=lambda item: item[1].heard_at)
        acks = list({sender: each.count for (sender, _), each in latest}.items())
        for packed in packed_acks(acks, _ACKS):
            bridge = Bridge(self.gateway, port.number, self._count, port.agreement, self.root, packed)
            self._actions.append(Say(port.number, bridge))
        while now - self._sent[0][1] > LEASE:
            self._sent.popleft()
        if port.neighbours and not self._agreed(now, port):
            for gateway in [self.gateway, *self._atlas.others[:_RECORDS_A_TICK]]:
                self._say_record(port, gateway)
        port.said_at = now
        port.say_at = now + self._tick(port)
        port.until = self._until(port, port.state)

    def _tick(self, port: Port) -> int:
        if port.state is State.LISTENING:
            return TICK_LISTENING
        return TICK if port.neighbours or port.leaves else TICK_ALONE

    def _say_record(self, port: Port, gateway: int) -> None:
        self._actions.extend(Say(port.number, each) for each in self._atlas.told(gateway))

    def _probe(self, now: int, port: Port) -> None:
        listening = port.state is State.LISTENING
        port.probe_at = now + (LISTEN // 2 if listening else PROBE)
        if listening or port.in_tree:
            self._actions.append(Probe(port.number))
