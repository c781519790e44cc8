"""One gateway's part in the spanning tree: its ports, and until when each may forward.

`SpanningTree` receives BRIDGE, MESH and LEAF at each port and sends its own; `TreePort.forwards_until` is the instant
before which data may pass. A gateway that was stopped for a while finds it in the past before it does anything else.
`ClientPorts` are those of clients, which take part in no tree.

The timings fit together: a gateway counts as dead (`DEAD`) only after its permissions have expired (`LEASE`); a new
one listens (`LISTEN`) for longer than an old one can be stuck and still forward.

Modules that are not gateways may have several links, too (`link_selection`). Those that use links of several meshes say
so by LEAF; and before a gateway forwards in another mesh than before (with another root), these modules know of it.
"""

from collections import deque

from r2p.codecs.management import BRIDGE_ACKS, Bridge, Leaf, Mesh, encode_acks
from r2p.codecs.probes import PORT_MODULUS
from r2p.protocols.bridge.mesh import HEARD_MAX, MeshMap
from r2p.protocols.bridge.ports import (
    FLAPS_MAX,
    LEASE,
    LISTEN,
    PROBE,
    SETTLE,
    TICK,
    TICK_ALONE,
    Action,
    PortChanged,
    PortState,
    SendProbe,
    SendToClients,
    SendToPort,
    SentMessages,
    TreePort,
    pack_acks,
)
from r2p.units import NEVER

CLIENTS = 250
"""The port number that all clients share on the wire."""

FIRST_CLIENT = 1000
"""Clients are numbered from here on within the gateway."""

_RECORDS_A_TICK = 16  # records of other gateways that are repeated with each BRIDGE while there is no agreement
_REFUSED = (PortState.REFUSED, PortState.LOOP)
_NO_ACKS = encode_acks((), BRIDGE_ACKS)


class SpanningTree:
    """The tree as one gateway knows it. Methods take `now` (monotonic ns); `pop_actions` returns the actions.

    `gateway` is the random number of its start, not 0.
    """

    def __init__(self, gateway: int) -> None:
        self.gateway = gateway or 1
        self.ports: dict[int, TreePort] = {}
        self.mesh = MeshMap(self.gateway)
        self.clients = ClientPorts(self.mesh)
        self._sent = SentMessages(self.gateway)
        self._updated_at = 0
        self._root = self.gateway
        """The root known to the ports."""
        self._actions: list[Action] = []

    # Ports

    def open(self, now: int, number: int, *, private: bool = False) -> TreePort:
        """Add a port for a link that came up; `private`: see `TreePort`."""
        port = self.ports[number] = TreePort(number, now, send_at=now, probe_at=now, private=private)
        self._update(now)
        return port

    def close(self, now: int, number: int) -> None:
        """Remove the port of a link that went down."""
        port = self.ports.pop(number, None)
        if port is not None:
            port.forwards_until = 0
        self._update(now)

    def admit(self, now: int, port: TreePort) -> None:
        """Forward from now on, as the module at the other end of a private link is not a gateway."""
        port.stop_listening(now)
        self._update(now, port)

    def pop_actions(self) -> list[Action]:
        """Return and forget the actions."""
        actions = self._actions + self.clients.actions
        self._actions, self.clients.actions = [], []
        return actions

    def next_deadline(self) -> int | None:
        """Return when to call `poll`."""
        due = min((port.next_deadline() for port in self.ports.values()), default=NEVER)
        due = min(due, self.clients.next_deadline())
        return due if due < NEVER else None

    def poll(self, now: int) -> None:
        """Send due messages, and forget neighbours that were silent for DEAD."""
        self._update(now)
        for port in self.ports.values():
            if port.send_at <= now:
                self._send_bridge(now, port)
            if port.probe_at <= now:
                self._send_probe(now, port)
        self.clients.poll(now)

    # What comes in

    def receive_bridge(self, now: int, number: int, message: Bridge) -> None:
        """Enter a BRIDGE from a port: its sender is a gateway on the port's network."""
        port = self.ports.get(number)
        sender = (message.gateway, message.port)
        if port is None or not message.gateway:
            return
        if sender == (self.gateway, number):
            port.echoes = True
            return
        # The sender may be another port of this gateway, on the same network.
        if sender not in port.neighbours and not self._admit_neighbour(now, port):
            return
        if port.receive_bridge(now, message, self._sent.acked_at(message.acks)):
            self._update(now, port)

    def _admit_neighbour(self, now: int, port: TreePort) -> bool:
        """Decide whether to enter one more gateway as a neighbour; if not, count it as lost.

        A gateway that is not entered forwards nothing: it hears this one, which does not acknowledge it. If each were
        entered at once, gateways that keep joining and leaving would stop all others.
        """
        if sum(len(each.neighbours) for each in self.ports.values()) >= HEARD_MAX:
            port.lost["too many gateways"] += 1
            return False
        port.forgive_flaps(now)
        if port.flaps >= FLAPS_MAX:
            port.lost["gateways come and go"] += 1
            return False
        return True

    def receive_leaf(self, now: int, number: int, message: Leaf) -> None:
        """Enter a LEAF from a port: its sender is a module with several links."""
        port = self.ports.get(number)
        if port is None or not message.module:
            return
        if port.receive_leaf(now, message, self.mesh, self._sent.acked_at(message.acks)):
            self._update(now, port)

    def receive_mesh(self, now: int, number: int, message: Mesh) -> None:
        """Enter a MESH from a port, and pass it on at the other ports if it is new."""
        if message.gateway in (0, self.gateway) or number not in self.ports:
            return
        if not self.mesh.receive(now, message):
            return
        for port in self.ports.values():
            if port.neighbours and port.number != number and self.mesh.concerns(message.gateway):
                self._send_mesh(port, message.gateway)
        self._update(now)

    def receive_probe(self, now: int, number: int, gateway: int, its_port: int) -> None:
        """Enter a probe from a port; `gateway` sent it at its port `its_port` (modulo PORT_MODULUS)."""
        port = self.ports.get(number)
        sender = gateway, its_port
        if port is None or sender == (self.gateway, number % PORT_MODULUS) or gateway in port.gateways:
            return
        if port.receive_probe(now, sender, self.mesh):
            self._update(now)

    # What follows

    def _update(self, now: int, changed: TreePort | None = None) -> None:
        """Work out the consequences of messages and time.

        With `changed`, only for this port, unless the mesh changes, too.
        """
        if now - self._updated_at > LEASE:
            for port in self.ports.values():
                port.start_over(now)
        self._updated_at = now
        mesh = self.mesh.fingerprint
        if changed is None:  # not for each message: with many neighbours it would cost most, and `poll` comes soon
            self._expire(now)
        heard = frozenset((port.number, *neighbour) for port in self.ports.values() for neighbour in port.neighbours)
        if self.mesh.set_heard(now, heard):
            for port in self.ports.values():
                if port.neighbours:
                    self._send_mesh(port, self.gateway)
        if self._root != self.mesh.root:
            self._root_changed()
        ports = list(self.ports.values()) if changed is None or mesh != self.mesh.fingerprint else [changed]
        for port in ports:
            if port.update(now, self.mesh):
                self._actions.append(PortChanged(port.number))

    def _expire(self, now: int) -> None:
        for port in self.ports.values():
            port.expire(now, self.mesh)
        self.mesh.expire(now)

    def _root_changed(self) -> None:
        self._root = self.mesh.root
        for port in self.ports.values():
            port.root_changed(self.mesh)
        self.clients.root_changed()

    # What goes out

    def _send_bridge(self, now: int, port: TreePort) -> None:
        count = self._sent.next_number(now)
        for packed in pack_acks(port.neighbours | port.leaves, BRIDGE_ACKS):
            bridge = Bridge(self.gateway, port.number, count, port.agreement, self.mesh.root, packed)
            self._actions.append(SendToPort(port.number, bridge))
        if not port.is_agreed(now, self.mesh):  # MESH is not acknowledged: some may have been lost
            for gateway in [self.gateway, *self.mesh.others(count, _RECORDS_A_TICK)]:
                self._send_mesh(port, gateway)
        port.note_sent(now, self.mesh)

    def _send_mesh(self, port: TreePort, gateway: int) -> None:
        self._actions.extend(SendToPort(port.number, each) for each in self.mesh.messages(gateway))

    def _send_probe(self, now: int, port: TreePort) -> None:
        listening = port.state is PortState.LISTENING
        port.probe_at = now + (LISTEN // 2 if listening else PROBE)  # a loop has to show before the port forwards
        if listening or port.in_tree:
            self._actions.append(SendProbe(port.number))


class ClientPorts:
    """The clients of a gateway: any number of connections, which take part in no mesh, and share one port of the tree.

    A client is a module or a tool at the other end of a connection of its own, not a gateway. So nothing that a client
    says changes what other links forward. One that sends BRIDGE or MESH, or by whose connection a probe of this gateway
    comes back, is a gateway: it is refused for as long as its connection lasts. Each client is given LISTEN to show
    that before its port forwards, unless it says that it has no other link (`admit`). Modules with several links
    send LEAF here, too: each is waited for on its own connection.

    Every method takes `now` (monotonic ns) and appends to `actions`. Periodic work does not grow with the number of
    clients, except for messages to all of them.
    """

    def __init__(self, mesh: MeshMap) -> None:
        self.ports: dict[int, TreePort] = {}
        self.actions: list[Action] = []
        self._mesh = mesh
        self._sent = SentMessages(mesh.gateway)
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

    def admit(self, now: int, port: TreePort) -> None:
        """Forward from now on, as the client is not a gateway."""
        self._listening.remove(port)
        port.stop_listening(now)
        self._update(now, port)

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
            port.state, port.in_tree, port.forwards_until = state, False, 0
            self.actions.append(PortChanged(port.number))

    def receive_leaf(self, now: int, port: TreePort, message: Leaf) -> None:
        """Enter a LEAF from a client."""
        if not message.module or port.state in _REFUSED:
            return
        self._with_leaves[port.number] = port
        port.receive_leaf(now, message, self._mesh, self._sent.acked_at(message.acks))
        self._update(now, port)

    def root_changed(self) -> None:
        """Let nothing pass to modules with several links before they know the mesh's new root."""
        for port in self._with_leaves.values():
            port.root_changed(self._mesh)
            self._update(self._mesh.rooted_at, port)

    def poll(self, now: int) -> None:
        """Send due messages, and forget modules that were silent for DEAD."""
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
            if not port.leaves and port.state is PortState.ALONE:  # nothing there depends on the time now
                del self._with_leaves[port.number]
        if self.ports and self._send_at <= now:
            self._send_at = now + TICK_ALONE
            self.actions.append(SendToClients(self._bridge(now, _NO_ACKS)))

    def next_deadline(self) -> int:
        """Return when to call `poll`."""
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
        if port.state not in _REFUSED and port.update_state(now, self._mesh):
            self.actions.append(PortChanged(port.number))

    def _send_bridge(self, now: int, port: TreePort) -> None:
        """Send BRIDGE to one client, with acknowledgements for its modules."""
        for packed in pack_acks(port.leaves, BRIDGE_ACKS):
            self.actions.append(SendToPort(port.number, self._bridge(now, packed)))
        port.sent_at = now
        port.send_at = now + TICK

    def _bridge(self, now: int, acks: bytes) -> Bridge:
        return Bridge(self._mesh.gateway, CLIENTS, self._sent.next_number(now), 0, self._mesh.root, acks)
