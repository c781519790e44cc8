"""The clients of a gateway: any number of connections, which take part in no mesh, and share one port of the tree.

A client is a module or a tool at the other end of a connection of its own, and no gateway. So nothing that a client
says changes what other links forward. One that says BRIDGE or MESH, or by whose connection one of our probes comes
back, is a gateway: it is refused for as long as its connection lasts. It has to say so for LISTEN before it forwards.

Modules with several links say LEAF here, too: each is waited for on its own connection only.
"""

from collections import deque

from r2p.codecs.management import Bridge, Leaf
from r2p.protocols.bridge.base import (
    BRIDGE_ACKS,
    CLIENTS,
    FOR_EVER,
    LEASE,
    LISTEN,
    SETTLE,
    TICK,
    TICK_ALONE,
    Action,
    Changed,
    PortState,
    Say,
    SayToClients,
    TreePort,
    acknowledged,
    bury_leaves,
    hear_leaf,
    packed_acks,
    put_off_leaves,
    see_heeded,
)

FIRST = 1000
"""Clients are numbered from here on; on the wire all of them are CLIENTS."""

_REFUSED = (PortState.REFUSED, PortState.LOOP)
_NO_ACKS = bytes(12)


class ClientPorts:
    """Every method takes `now` (monotonic ns); what is to be done goes to `actions`. The work that the time brings does
    not grow with the number of clients, apart from what is said to all of them.
    """

    def __init__(self, gateway: int, actions: list[Action]) -> None:
        self.ports: dict[int, TreePort] = {}
        self._gateway = gateway
        self._actions = actions
        self._root = gateway
        self._rooted_at = 0
        self._count = 0
        self._sent: deque[tuple[int, int]] = deque()  # count, instant
        self._say_at = 0
        self._polled_at = 0
        self._listening: deque[TreePort] = deque()
        self._leafy: dict[int, TreePort] = {}

    def open(self, now: int, number: int) -> TreePort:
        """A client is there; `number` is FIRST or more."""
        port = TreePort(number, now, private=True)
        if not self.ports:
            self._say_at = now + TICK_ALONE
        self.ports[port.number] = port
        self._listening.append(port)
        self._say(now, port)
        return port

    def shut(self, number: int) -> None:
        """It is gone."""
        port = self.ports.pop(number, None)
        if port is None:
            return
        self._leafy.pop(port.number, None)
        if port in self._listening:
            self._listening.remove(port)
        port.until = 0

    def refuse(self, port: TreePort, state: PortState) -> None:
        """It is a gateway: nothing passes. `state` is REFUSED, or LOOP for one of firmware."""
        if port.state not in _REFUSED:
            self._leafy.pop(port.number, None)
            port.leaves = {}
            self._become(port, state)

    def leaf(self, now: int, port: TreePort, message: Leaf) -> None:
        """A LEAF was heard."""
        if not message.module or port.state in _REFUSED:
            return
        self._leafy[port.number] = port
        acked_at = acknowledged(message.acks, self._gateway, self._sent)
        hear_leaf(port, now, message, self._gateway, acked_at, self._rooted_at)
        self._judge(now, port)

    def root_changed(self, at: int, root: int) -> None:
        """What clients know of us is wrong from `at` on: where there are modules with several links nothing passes
        before they know better, or are gone.
        """
        self._root, self._rooted_at = root, at
        for port in self._leafy.values():
            if port.leaves:
                port.heeded_since = None
                port.say_at = at
                self._judge(at, port)

    def poll(self, now: int) -> None:
        """Say what is due, and see who has fallen silent."""
        stood = now - self._polled_at > LEASE
        self._polled_at = now
        while self._listening and now >= self._listening[0].opened_at + LISTEN:
            self._judge(now, self._listening.popleft())
        for port in list(self._leafy.values()):
            if stood:
                put_off_leaves(port, now)
            bury_leaves(port, now)
            self._judge(now, port)
            if port.say_at <= now:
                self._say(now, port)
            if not port.leaves and port.state is PortState.ALONE:
                del self._leafy[port.number]
        if self.ports and self._say_at <= now:
            self._say_at = now + TICK_ALONE
            self._actions.append(SayToClients(self._bridge(now, _NO_ACKS)))

    def next_deadline(self) -> int:
        """When to call `poll`."""
        if not self.ports:
            return FOR_EVER
        dues = [self._say_at]
        if self._listening:
            dues.append(self._listening[0].opened_at + LISTEN)
        for port in self._leafy.values():
            dues.append(port.say_at)
            if port.state is PortState.CONVERGING and port.heeded_since is not None:
                dues.append(port.heeded_since + SETTLE)
        return min(dues)

    def _judge(self, now: int, port: TreePort) -> None:
        see_heeded(port, now, self._rooted_at)
        if port.state in _REFUSED:
            return
        if now < port.opened_at + LISTEN:
            state = PortState.LISTENING
        elif port.heeded_since is None or now < port.heeded_since + SETTLE:
            state = PortState.CONVERGING
        else:
            state = PortState.ALONE
        self._become(port, state)

    def _become(self, port: TreePort, state: PortState) -> None:
        port.until = FOR_EVER if state is PortState.ALONE else 0
        if state is not port.state:
            port.state = state
            port.in_tree = state not in _REFUSED and (port.in_tree or state is PortState.ALONE)
            self._actions.append(Changed(port.number))

    def _say(self, now: int, port: TreePort) -> None:
        """Say BRIDGE to one client, with what its modules are to know."""
        latest = sorted(port.leaves.items(), key=lambda item: item[1].heard_at)
        acks = list({sender: each.count for (sender, _), each in latest}.items())
        for packed in packed_acks(acks, BRIDGE_ACKS):
            self._actions.append(Say(port.number, self._bridge(now, packed)))
        port.said_at = now
        port.say_at = now + TICK

    def _bridge(self, now: int, acks: bytes) -> Bridge:
        self._count = (self._count + 1) & 0xFFFF
        self._sent.append((self._count, now))
        while now - self._sent[0][1] > LEASE:
            self._sent.popleft()
        return Bridge(self._gateway, CLIENTS, self._count, 0, self._root, acks)
