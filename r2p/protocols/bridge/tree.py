"""One gateway's part in the spanning tree: which of its ports may forward, and until when.

`SpanningTree` receives BRIDGE, MESH and LEAF at each port and sends its own; `TreePort.forwards_until` is the instant
before which data may pass. A gateway that was stopped for a while finds it in the past before it does anything else.

A port's state follows from what is known now, not from the state before. Of these the first one that applies counts:

    LOOP         a probe shows a loop through a gateway that sends no BRIDGE, and this port is the one that yields
    LISTENING    the port is open for less than LISTEN: other gateways may be there that were not heard yet
    CONVERGING   for less than SETTLE, all modules that send LEAF here know this gateway's root; or some do not yet
    ALONE        no other gateway is on this network                                  forwards
    CONVERGING   gateways on this network have not acknowledged the same mesh
    BLOCKED      they have, and the tree does not contain the port
    CONVERGING   they have, the tree contains the port, for less than SETTLE
    FORWARDING   they have, the tree contains the port, for SETTLE or longer          forwards until a lease runs out

So nearly any state can follow any other: a port that hears its first gateway goes from ALONE to CONVERGING, and back
when the last one is silent. After a time in which the program stood still, ports are LISTENING again. REFUSED is set by
the owner of the ports, for those beyond MOST_PORTS and for clients that turn out to be gateways (`ClientPorts`).

The timings fit together: a gateway counts as dead (`DEAD`) only after what it was granted has run out (`LEASE`); a new
one listens (`LISTEN`) for longer than an old one can be stuck and still forward.

Modules that are not gateways may have several links, too (`link_selection`). Those that use links of several meshes say
so by LEAF; and before a gateway forwards in another mesh than before (with another root), these modules know of it.
"""

from r2p.codecs.management import BRIDGE_ACKS, Bridge, Leaf, Mesh
from r2p.codecs.probes import PORT_MODULUS
from r2p.protocols.bridge.mesh import MOST_HEARD, Edge, MeshMap, digest
from r2p.protocols.bridge.ports import (
    DEAD,
    FLAP_FORGIVEN,
    FLAPS,
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
    ClientPorts,
    Neighbour,
    PortChanged,
    PortState,
    SendProbe,
    SendToPort,
    SentMessages,
    TreePort,
    is_late,
    pack_acks,
)
from r2p.units import NEVER

_RECORDS_A_TICK = 16  # records of other gateways that are repeated with each BRIDGE while there is no agreement


class SpanningTree:
    """The tree as one gateway knows it. Methods take `now` (monotonic ns); `pop_actions` returns what to do.

    `gateway` is the number of this start of it; 0 is not a valid one.
    """

    def __init__(self, gateway: int) -> None:
        self.gateway = gateway or 1
        self.ports: dict[int, TreePort] = {}
        self.root = self.gateway
        """The lowest gateway of the mesh, as this one announces it."""
        self._rooted_at = 0
        self._mesh = MeshMap(self.gateway)
        self._sent = SentMessages(self.gateway)
        self._updated_at = 0
        self._actions: list[Action] = []
        self.clients = ClientPorts(self.gateway, self._actions)

    @property
    def edges(self) -> frozenset[Edge]:
        """The mesh of gateways that this one is part of."""
        return self._mesh.edges

    def knows(self, gateway: int) -> bool:
        """Whether it is this gateway, or one in its mesh."""
        return gateway == self.gateway or gateway in self._mesh.members

    # Ports

    def open(self, now: int, number: int, *, private: bool = False) -> None:
        """Add a port for a link that came up; `private`: see `TreePort`."""
        self.ports[number] = TreePort(number, now, send_at=now, probe_at=now, private=private)
        self._update(now)

    def close(self, now: int, number: int) -> None:
        """Remove the port of a link that went down."""
        port = self.ports.pop(number, None)
        if port is not None:
            port.forwards_until = 0
        self._update(now)

    def pop_actions(self) -> list[Action]:
        """Return what is to be done, and forget it."""
        actions = self._actions.copy()
        self._actions.clear()  # the list itself is shared with `clients`
        return actions

    def next_deadline(self) -> int | None:
        """When to call `poll`."""
        due = min((self._due(port) for port in self.ports.values()), default=NEVER)
        due = min(due, self.clients.next_deadline())
        return due if due < NEVER else None

    def poll(self, now: int) -> None:
        """Send what is due, and forget neighbours that were silent for DEAD."""
        self._update(now)
        for port in self.ports.values():
            if port.send_at <= now:
                self._send_bridge(now, port)
            if port.probe_at <= now:
                self._send_probe(now, port)
        self.clients.poll(now)

    def _due(self, port: TreePort) -> int:
        due = min(port.send_at, port.probe_at)
        if port.state is PortState.LISTENING:
            due = min(due, port.opened_at + LISTEN)
        agreed, ready = port.agreed_since, port.leaves_ready_since
        if port.state is PortState.CONVERGING and agreed is not None and ready is not None:
            due = min(due, max(agreed, ready) + SETTLE)
        return due

    # What comes in

    def receive_bridge(self, now: int, number: int, message: Bridge) -> None:
        """Enter a BRIDGE that came in at a port: its sender is a gateway on the port's network."""
        port = self.ports.get(number)
        sender = (message.gateway, message.port)
        if port is None or not message.gateway:
            return
        if sender == (self.gateway, number):
            port.echoes = True
            return
        neighbour = port.neighbours.get(sender)  # may be another port of ours on the same network
        if neighbour is None:
            if not self._admit_neighbour(now, port):
                return
            neighbour = Neighbour(now, message.count, agreement=message.agreement)
            # It is on this network itself: its probes came straight, not through a loop of firmware.
            port.probes = {each: at for each, at in port.probes.items() if each[0] != message.gateway}
            port.neighbours = port.neighbours | {sender: neighbour}
        elif is_late(message.count, neighbour.count):
            return
        if neighbour.agreement != message.agreement:
            neighbour.acked_at = 0  # it consented to another mesh
            port.hurry(now)
        neighbour.heard_at, neighbour.count, neighbour.agreement = now, message.count, message.agreement
        neighbour.acked_at = max(neighbour.acked_at, self._sent.acked_at(message.acks))
        self._update(now, port)

    def _admit_neighbour(self, now: int, port: TreePort) -> bool:
        """Decide whether to enter one more gateway as a neighbour; if not, count it as lost.

        A gateway that is not entered forwards nothing: it hears this one, which does not acknowledge it. Were each one
        entered at once, gateways that come and go would keep all others from agreeing, and so from forwarding.
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

    def receive_leaf(self, now: int, number: int, message: Leaf) -> None:
        """Enter a LEAF that came in at a port: its sender is a module with several links."""
        port = self.ports.get(number)
        if port is None or not message.module:
            return
        if port.receive_leaf(now, message, self.gateway, self._sent.acked_at(message.acks), self._rooted_at):
            self._update(now, port)

    def receive_mesh(self, now: int, number: int, message: Mesh) -> None:
        """Enter a MESH that came in at a port, and pass it on at the other ports if it is new."""
        if message.gateway in (0, self.gateway) or number not in self.ports:
            return
        if not self._mesh.receive(now, message):
            return
        self._update_root(now)
        for port in self.ports.values():
            if port.neighbours and port.number != number and self._mesh.concerns(message.gateway):
                self._send_mesh(port, message.gateway)
        self._update(now)

    def receive_probe(self, now: int, number: int, gateway: int, its_port: int) -> None:
        """Enter a probe that came in at a port; `gateway` sent it at its port `its_port` (modulo PORT_MODULUS)."""
        port = self.ports.get(number)
        sender = gateway, its_port
        if port is not None and sender != (self.gateway, number % PORT_MODULUS) and gateway not in port.gateways:
            if sender not in port.probes and not self._admits_probe(port, gateway):
                port.lost["too many probes"] += 1
                return
            port.probes = port.probes | {sender: (port.probes.get(sender, (now, now))[0], now)}
            self._update(now)

    def _admits_probe(self, port: TreePort, gateway: int) -> bool:
        """Whether there is room to keep a probe of `gateway`.

        Always, if it is in the mesh. Others may be forged, or join later: STRANGE_PROBES of theirs are kept.
        """
        members = {self.gateway, *self._mesh.members}
        return gateway in members or sum(each not in members for each, _ in port.probes) < STRANGE_PROBES

    # What follows

    def _update(self, now: int, changed: TreePort | None = None) -> None:
        """Work out all that follows from what was heard, and from the time.

        With `changed`, only for this port, unless the mesh changes, too.
        """
        if now - self._updated_at > LEASE:
            self._start_over(now)
        self._updated_at = now
        mesh = self._mesh.fingerprint
        if changed is None:  # not for each message: with many neighbours it would cost most, and `poll` comes soon
            self._expire(now)
        heard = frozenset((port.number, *neighbour) for port in self.ports.values() for neighbour in port.neighbours)
        if self._mesh.set_heard(heard):
            self._update_root(now)
            for port in self.ports.values():
                if port.neighbours:
                    self._send_mesh(port, self.gateway)
        ports = list(self.ports.values()) if changed is None or mesh != self._mesh.fingerprint else [changed]
        for port in ports:
            self._update_port(now, port)

    def _start_over(self, now: int) -> None:
        """Listen anew at each port: this program stood still for so long that others may have given this gateway up."""
        for port in self.ports.values():
            port.send_at = now
            if port.private and not port.neighbours:  # no gateway can have come meanwhile
                port.extend_leaves(now)
                continue
            port.resumes = port.resumes or port.state is PortState.ALONE
            port.opened_at = now
            port.neighbours = {}
            port.leaves = {}
            port.agreed_since = None

    def _expire(self, now: int) -> None:
        for port in self.ports.values():
            if any(now - each.heard_at >= DEAD for each in port.neighbours.values()):
                before = port.gateways
                fresh = {sender: each for sender, each in port.neighbours.items() if now - each.heard_at < DEAD}
                port.neighbours = fresh
                self._count_flaps(now, port, len(before - port.gateways - {self.gateway}))
            port.expire_leaves(now)
            if any(now - last >= PROBE_MEMORY for _, last in port.probes.values()):
                port.probes = {sender: at for sender, at in port.probes.items() if now - at[1] < PROBE_MEMORY}
        self._mesh.expire(now)

    def _count_flaps(self, now: int, port: TreePort, gone: int) -> None:
        if not port.flaps:
            port.flapped_at = now
        port.flaps = min(port.flaps + gone, FLAPS)

    def _update_root(self, now: int) -> None:
        if self._mesh.root == self.root:
            return
        self.root = self._mesh.root
        self._rooted_at = now + 1  # what was sent in this very instant still named the old one
        self.clients.set_root(self._rooted_at, self.root)
        for port in self.ports.values():
            if port.leaves:
                port.invalidate_leaves(self._rooted_at)

    def _update_port(self, now: int, port: TreePort) -> None:
        view = (self._mesh.fingerprint, frozenset(port.neighbours))
        if view != port.view:
            port.view = view
            members = sorted([(self.gateway, port.number), *port.neighbours])
            port.agreement = digest(self._mesh.fingerprint, members)
            port.agreed_since = None
            port.hurry(now)
        if not self._is_agreed(now, port):
            port.agreed_since = None
        elif port.agreed_since is None:
            port.agreed_since = now
        port.check_leaves(now, self._rooted_at)
        state = self._state(now, port)
        in_tree = self._in_tree(port, state)
        port.forwards_until = self._forwards_until(port, state)
        if state is not PortState.LISTENING or port.neighbours:
            port.resumes = False  # listening is over, or the port will not be alone: hold no more samples for it
        if (state, in_tree) != (port.state, port.in_tree):
            port.state, port.in_tree = state, in_tree
            self._actions.append(PortChanged(port.number))

    def _is_agreed(self, now: int, port: TreePort) -> bool:
        """Whether all gateways there have acknowledged the very same mesh within a lease."""
        return all(  # other ports of this gateway agree anyway
            each.agreement == port.agreement and now < each.acked_at + LEASE
            for (gateway, _), each in port.neighbours.items()
            if gateway != self.gateway
        )

    def _state(self, now: int, port: TreePort) -> PortState:
        if self._loops(now, port):  # first of all: agreement says nothing about gateways that do not take part
            return PortState.LOOP
        if now < port.opened_at + LISTEN:
            return PortState.LISTENING
        if port.leaves_ready_since is None or now < port.leaves_ready_since + SETTLE:
            return PortState.CONVERGING
        if not port.neighbours:
            return PortState.ALONE
        if port.agreed_since is None:
            return PortState.CONVERGING
        if not self._is_chosen(port):
            return PortState.BLOCKED
        return PortState.FORWARDING if now >= port.agreed_since + SETTLE else PortState.CONVERGING

    def _in_tree(self, port: TreePort, state: PortState) -> bool:
        """Whether the port is in the tree, also at times when nothing may pass yet."""
        if state in (PortState.ALONE, PortState.FORWARDING):
            return True
        if state in (PortState.BLOCKED, PortState.LOOP):
            return False
        if port.neighbours and port.agreed_since is not None:
            return self._is_chosen(port)  # before SETTLE is over: demand travels first, then data
        return port.in_tree  # not agreed yet: the next tree may be the same, and then demand need not move

    def _forwards_until(self, port: TreePort, state: PortState) -> int:
        if state is PortState.ALONE:
            # Another gateway that comes listens for longer than a lease: by then it has heard us, or we are stuck.
            return NEVER if port.private else port.sent_at + LEASE
        if state is not PortState.FORWARDING:
            return 0
        acked = [each.acked_at for (gateway, _), each in port.neighbours.items() if gateway != self.gateway]
        return min([port.sent_at, *acked]) + LEASE

    def _is_chosen(self, port: TreePort) -> bool:
        return self._mesh.forwards((self.gateway, port.number))

    def _loops(self, now: int, port: TreePort) -> bool:
        """Whether the port is part of a loop through a gateway that sends no BRIDGE, and is the end that yields.

        A probe that came in proves the loop. Of two ports of one gateway the one with the higher number (modulo
        PORT_MODULUS) yields, of two gateways the one with the higher number.
        """
        for (gateway, its_port), (first, _) in port.probes.items():
            if now - first < PROBE_PROVEN or gateway in port.gateways:
                continue
            if gateway == self.gateway and its_port < port.number % PORT_MODULUS:
                return True
            if gateway in self._mesh.members and gateway < self.gateway:
                return True
        return False

    # What goes out

    def _send_bridge(self, now: int, port: TreePort) -> None:
        count = self._sent.next_number(now)
        for packed in pack_acks(port.neighbours | port.leaves, BRIDGE_ACKS):
            bridge = Bridge(self.gateway, port.number, count, port.agreement, self.root, packed)
            self._actions.append(SendToPort(port.number, bridge))
        if port.neighbours and not self._is_agreed(now, port):  # MESH is not acknowledged: some may have been lost
            for gateway in [self.gateway, *self._mesh.others(count, _RECORDS_A_TICK)]:
                self._send_mesh(port, gateway)
        port.sent_at = now
        port.send_at = now + self._tick(port)
        port.forwards_until = self._forwards_until(port, port.state)

    def _tick(self, port: TreePort) -> int:
        if port.state is PortState.LISTENING:
            return TICK_LISTENING
        return TICK if port.neighbours or port.leaves else TICK_ALONE

    def _send_mesh(self, port: TreePort, gateway: int) -> None:
        self._actions.extend(SendToPort(port.number, each) for each in self._mesh.messages(gateway))

    def _send_probe(self, now: int, port: TreePort) -> None:
        listening = port.state is PortState.LISTENING
        port.probe_at = now + (LISTEN // 2 if listening else PROBE)  # a loop has to show before the port forwards
        if listening or port.in_tree:
            self._actions.append(SendProbe(port.number))
