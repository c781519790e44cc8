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

from collections import deque

from r2p.codecs.management import Bridge, Leaf, Mesh
from r2p.protocols.bridge.base import (
    APART,
    BRIDGE_ACKS,
    DEAD,
    FLAP_FORGIVEN,
    FLAPS,
    FOR_EVER,
    LEASE,
    LISTEN,
    PROBE,
    PROBE_MEMORY,
    PROBE_PROVEN,
    SETTLE,
    STRANGE_PROBES,
    TICK,
    TICK_ALONE,
    TICK_LISTENING,
    Action,
    Changed,
    Neighbour,
    PortState,
    Probe,
    Say,
    TreePort,
    acknowledged,
    bury_leaves,
    hear_leaf,
    is_late,
    packed_acks,
    put_off_leaves,
    see_heeded,
)
from r2p.protocols.bridge.clients import ClientPorts
from r2p.protocols.bridge.mesh import MOST_HEARD, Edge, MeshMap, digest

_RECORDS_A_TICK = 16


class Tree:
    """The tree as one gateway knows it. Every method takes `now` (monotonic ns); `take` gives what to do about it.

    `gateway` is its number, that of this start of it; 0 can't be one.
    """

    def __init__(self, gateway: int) -> None:
        self.gateway = gateway or 1
        self.ports: dict[int, TreePort] = {}
        self.root = self.gateway
        """The lowest gateway of the mesh, as this one tells it."""
        self._rooted_at = 0
        self._atlas = MeshMap(self.gateway)
        self._count = 0
        self._sent: deque[tuple[int, int]] = deque()  # count, instant
        self._looked_at = 0
        self._actions: list[Action] = []
        self.clients = ClientPorts(self.gateway, self._actions)

    @property
    def edges(self) -> frozenset[Edge]:
        """The mesh of gateways that this one is part of."""
        return self._atlas.edges

    def knows(self, gateway: int) -> bool:
        """Whether it is this gateway, or one in its mesh."""
        return gateway == self.gateway or gateway in self._atlas.members

    # Ports

    def open(self, now: int, number: int, *, private: bool = False) -> None:
        """A link is up."""
        self.ports[number] = TreePort(number, now, say_at=now, probe_at=now, private=private)
        self._look(now)

    def shut(self, now: int, number: int) -> None:
        """It is down."""
        port = self.ports.pop(number, None)
        if port is not None:
            port.until = 0
        self._look(now)

    def take(self) -> list[Action]:
        actions = self._actions.copy()
        self._actions.clear()
        return actions

    def next_deadline(self) -> int | None:
        """When to call `poll`."""
        due = min((self._due(port) for port in self.ports.values()), default=FOR_EVER)
        due = min(due, self.clients.next_deadline())
        return due if due < FOR_EVER else None

    def poll(self, now: int) -> None:
        """Say what is due, and see who has fallen silent."""
        self._look(now)
        for port in self.ports.values():
            if port.say_at <= now:
                self._say(now, port)
            if port.probe_at <= now:
                self._probe(now, port)
        self.clients.poll(now)

    def _begin_anew(self, now: int) -> None:
        """We were stopped for so long that others may think we are gone."""
        for port in self.ports.values():
            port.say_at = now
            if port.private and not port.neighbours:
                put_off_leaves(port, now)
                continue
            port.resumes = port.resumes or port.state is PortState.ALONE
            port.opened_at = now
            port.neighbours = {}
            port.leaves = {}
            port.agreed_since = None

    def _due(self, port: TreePort) -> int:
        due = min(port.say_at, port.probe_at)
        if port.state is PortState.LISTENING:
            due = min(due, port.opened_at + LISTEN)
        if port.state is PortState.CONVERGING and port.agreed_since is not None and port.heeded_since is not None:
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
            if not self._admits(now, port):
                return
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

    def _admits(self, now: int, port: TreePort) -> bool:
        """Whether one more gateway may be heard there. While it is not, it hears us and lacks our consent, so it does
        not forward; gateways that come and go would keep all others from it.
        """
        if sum(len(each.neighbours) for each in self.ports.values()) >= MOST_HEARD:
            port.lost["too many gateways"] += 1
            return False
        if port.flaps:
            forgiven = min(port.flaps, (now - port.flapped_at) // FLAP_FORGIVEN)
            port.flaps -= forgiven
            port.flapped_at += forgiven * FLAP_FORGIVEN
        if port.flaps >= FLAPS:
            port.lost["gateways come and go"] += 1
            return False
        return True

    def leaf(self, now: int, number: int, message: Leaf) -> None:
        """A LEAF was heard: it counts from when it knows our root, and has an answer at once."""
        port = self.ports.get(number)
        if port is None or not message.module:
            return
        acked_at = acknowledged(message.acks, self.gateway, self._sent)
        if hear_leaf(port, now, message, self.gateway, acked_at, self._rooted_at):
            self._look(now, port)

    def mesh(self, now: int, number: int, message: Mesh) -> None:
        """A MESH was heard: new things are passed on at once."""
        if message.gateway in (0, self.gateway) or number not in self.ports:
            return
        if not self._atlas.learn(now, message):
            return
        self._take_root(now)
        for port in self.ports.values():
            if port.neighbours and port.number != number and self._atlas.concerns(message.gateway):
                self._say_record(port, message.gateway)
        self._look(now)

    def probed(self, now: int, number: int, gateway: int, its_port: int) -> None:
        """A probe was heard, that this gateway or another one sent at that port (its number modulo 13)."""
        port = self.ports.get(number)
        place = gateway, its_port
        if port is not None and place != (self.gateway, number % 13) and gateway not in port.gateways:
            if place not in port.probes and not self._has_room(port, gateway):
                port.lost["too many probes"] += 1
                return
            port.probes = port.probes | {place: (port.probes.get(place, (now, now))[0], now)}
            self._look(now)

    def _has_room(self, port: TreePort, gateway: int) -> bool:
        """Whether a probe of this gateway can be kept: of those that are in no mesh of ours, which may be forged, only
        some are, should they turn up later.
        """
        members = {self.gateway, *self._atlas.members}
        return gateway in members or sum(each not in members for each, _ in port.probes) < STRANGE_PROBES

    # What follows from it

    def _look(self, now: int, changed: TreePort | None = None) -> None:
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
                before = port.gateways
                port.neighbours = {place: each for place, each in port.neighbours.items() if now - each.heard_at < DEAD}
                self._count_flaps(now, port, len(before - port.gateways - {self.gateway}))
            bury_leaves(port, now)
            if any(now - last >= PROBE_MEMORY for _, last in port.probes.values()):
                port.probes = {place: at for place, at in port.probes.items() if now - at[1] < PROBE_MEMORY}
        self._atlas.forget(now)

    def _count_flaps(self, now: int, port: TreePort, gone: int) -> None:
        if not port.flaps:
            port.flapped_at = now
        port.flaps = min(port.flaps + gone, FLAPS)

    def _take_root(self, now: int) -> None:
        """The mesh may have another root now."""
        if self._atlas.root != self.root:
            self.root = self._atlas.root
            self._tell_leaves(now + 1)  # what was said in this very instant is older

    def _tell_leaves(self, at: int) -> None:
        """What they know of us is wrong: nothing passes before they know better, or are gone."""
        self._rooted_at = at
        self.clients.root_changed(at, self.root)
        for port in self.ports.values():
            if port.leaves:
                port.heeded_since = None
                port.say_at = at

    def _judge(self, now: int, port: TreePort) -> None:
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
        see_heeded(port, now, self._rooted_at)
        state = self._state(now, port)
        in_tree = self._in_tree(port, state)
        port.until = self._until(port, state)
        if state is not PortState.LISTENING or port.neighbours:
            port.resumes = False
        if (state, in_tree) != (port.state, port.in_tree):
            port.state, port.in_tree = state, in_tree
            self._actions.append(Changed(port.number))

    def _agreed(self, now: int, port: TreePort) -> bool:
        return all(
            each.agreement == port.agreement and now < each.acked_at + LEASE
            for (gateway, _), each in port.neighbours.items()
            if gateway != self.gateway
        )

    def _state(self, now: int, port: TreePort) -> PortState:
        if self._loops(now, port):
            return PortState.LOOP
        if now < port.opened_at + LISTEN:
            return PortState.LISTENING
        if port.heeded_since is None or now < port.heeded_since + SETTLE:
            return PortState.CONVERGING
        if not port.neighbours:
            return PortState.ALONE
        if port.agreed_since is None:
            return PortState.CONVERGING
        if not self._is_chosen(port):
            return PortState.BLOCKED
        return PortState.FORWARDING if now >= port.agreed_since + SETTLE else PortState.CONVERGING

    def _in_tree(self, port: TreePort, state: PortState) -> bool:
        """Other than the state, the place stays while the gateways converge, and is known before data may pass."""
        if state in (PortState.ALONE, PortState.FORWARDING):
            return True
        if state in (PortState.BLOCKED, PortState.LOOP):
            return False
        if port.neighbours and port.agreed_since is not None:
            return self._is_chosen(port)
        return port.in_tree

    def _until(self, port: TreePort, state: PortState) -> int:
        if state is PortState.ALONE:
            return FOR_EVER if port.private else port.said_at + LEASE
        if state is not PortState.FORWARDING:
            return 0
        acked = [each.acked_at for (gateway, _), each in port.neighbours.items() if gateway != self.gateway]
        return min([port.said_at, *acked]) + LEASE

    def _is_chosen(self, port: TreePort) -> bool:
        return self._atlas.chosen((self.gateway, port.number))

    def _loops(self, now: int, port: TreePort) -> bool:
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

    def _say(self, now: int, port: TreePort) -> None:
        self._count = (self._count + 1) & 0xFFFF
        self._sent.append((self._count, now))
        latest = sorted([*port.neighbours.items(), *port.leaves.items()], key=lambda item: item[1].heard_at)
        acks = list({sender: each.count for (sender, _), each in latest}.items())
        for packed in packed_acks(acks, BRIDGE_ACKS):
            bridge = Bridge(self.gateway, port.number, self._count, port.agreement, self.root, packed)
            self._actions.append(Say(port.number, bridge))
        while now - self._sent[0][1] > LEASE:
            self._sent.popleft()
        if port.neighbours and not self._agreed(now, port):
            for gateway in [self.gateway, *self._atlas.others(self._count, _RECORDS_A_TICK)]:
                self._say_record(port, gateway)
        port.said_at = now
        port.say_at = now + self._tick(port)
        port.until = self._until(port, port.state)

    def _tick(self, port: TreePort) -> int:
        if port.state is PortState.LISTENING:
            return TICK_LISTENING
        return TICK if port.neighbours or port.leaves else TICK_ALONE

    def _say_record(self, port: TreePort, gateway: int) -> None:
        self._actions.extend(Say(port.number, each) for each in self._atlas.told(gateway))

    def _probe(self, now: int, port: TreePort) -> None:
        listening = port.state is PortState.LISTENING
        port.probe_at = now + (LISTEN // 2 if listening else PROBE)
        if listening or port.in_tree:
            self._actions.append(Probe(port.number))
