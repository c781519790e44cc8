"""The mesh of gateways and its spanning tree, from the records of which gateway hears which.

A network (bus, zenoh network, line) has no name of its own: it is the set of gateway ports that hear each other. An
edge counts only if both sides report it. The functions here are pure; `MeshMap` keeps one gateway's knowledge from the
MESH of others, and its consequences.
"""

from collections import defaultdict, deque
from collections.abc import Iterable, Mapping
from hashlib import blake2b

import msgspec

from r2p.codecs.management import (
    MESH_HEARD,
    PARTS_MAX,
    Mesh,
    decode_heard,
    encode_heard,
    is_newer_serial,
    make_part,
    next_serial,
    split_part,
)
from r2p.units import SECOND

PortId = tuple[int, int]
"""A port: gateway, and the number of the port there."""

Adjacency = tuple[int, int, int]
"""A gateway that another one hears: own port, other gateway, its port."""

Edge = tuple[PortId, PortId]

_UNFINISHED_MAX = 64  # records of which parts are missing: forged, or of gateways that died in the middle

HEARD_MAX = MESH_HEARD * PARTS_MAX
"""Adjacencies that a gateway can announce. One with more could not agree with any other, and would not forward."""

RECORDS_MAX = 256
"""Gateways with a record of their neighbours, at most."""
CHANGES = 100
"""Changes that one gateway may announce in a row ..."""
CHANGE_FORGIVEN = 5 * SECOND
"""... and ns until it may announce one more. One that always changes would keep all others from agreeing."""

_KEPT = 5 * SECOND  # ns for which the record of a gateway outside the mesh is kept without being repeated


# MESH messages


def mesh_messages(gateway: int, serial: int, heard: Iterable[Adjacency]) -> list[Mesh]:
    """Make the messages that announce a gateway's neighbours."""
    adjacencies = sorted(heard)[:HEARD_MAX]
    pieces = [adjacencies[at : at + MESH_HEARD] for at in range(0, len(adjacencies), MESH_HEARD)] or [[]]
    last = len(pieces) - 1
    return [Mesh(gateway, serial, make_part(number, last), encode_heard(piece)) for number, piece in enumerate(pieces)]


class MeshAssembler:
    """The parts of MESH messages that are not complete yet."""

    def __init__(self) -> None:
        self._pieces: dict[tuple[int, int], dict[int, frozenset[Adjacency]]] = {}

    def add(self, message: Mesh) -> frozenset[Adjacency] | None:
        """Enter a part; return the gateway's neighbours once all parts with this serial are there."""
        key = (message.gateway, message.serial)
        pieces = self._pieces.setdefault(key, {})
        number, last = split_part(message.part)
        pieces[number] = frozenset(decode_heard(message.heard))
        if set(pieces) != set(range(last + 1)):
            while len(self._pieces) > _UNFINISHED_MAX:
                del self._pieces[next(iter(self._pieces))]
            return None
        del self._pieces[key]
        return frozenset().union(*pieces.values())


# The tree


def edges_from(gateway: int, heard: Mapping[int, Iterable[Adjacency]]) -> frozenset[Edge]:
    """The pairs of ports that hear each other, in the part of the network that `gateway` is connected with."""
    mutual: dict[int, list[Edge]] = defaultdict(list)
    for here, adjacencies in heard.items():
        for port, there, its_port in adjacencies:
            if (its_port, here, port) in heard.get(there, ()):
                mutual[here].append(((here, port), (there, its_port)))
    reached, todo = {gateway}, [gateway]
    while todo:
        for _, (there, _) in mutual[todo.pop()]:
            if there not in reached:
                reached.add(there)
                todo.append(there)
    return frozenset(edge for here in reached for edge in mutual[here])


def spanning_tree(edges: Iterable[Edge]) -> frozenset[PortId]:
    """The ports that forward: a breadth-first search from the lowest gateway reaches each network and gateway once."""
    networks = _networks(edges)
    ports: dict[int, list[PortId]] = defaultdict(list)
    for port in sorted(networks):  # every gateway must come to the same tree: nothing may depend on the order of a set
        ports[port[0]].append(port)
    chosen: set[PortId] = set()
    seen_networks: set[PortId] = set()
    root = min(ports, default=None)
    seen, todo = {root}, deque([] if root is None else [root])
    while todo:
        for port in ports[todo.popleft()]:
            network = networks[port]
            if min(network) in seen_networks:
                continue
            seen_networks.add(min(network))
            chosen.add(port)
            for other in sorted(network):
                if other[0] not in seen:
                    seen.add(other[0])
                    chosen.add(other)
                    todo.append(other[0])
    return frozenset(chosen)


def _networks(edges: Iterable[Edge]) -> dict[PortId, set[PortId]]:
    """Each port with all the ports of its network."""
    networks: dict[PortId, set[PortId]] = {}
    for here, there in edges:
        joined = networks.get(here, {here}) | networks.get(there, {there})
        for port in joined:
            networks[port] = joined
    return networks


def digest(*things: object) -> int:
    """A hash of 32 bits."""
    return int.from_bytes(blake2b(repr(things).encode(), digest_size=4).digest(), "little")


# What one gateway knows


class _GatewayRecord(msgspec.Struct):
    """The gateways that another gateway hears."""

    serial: int
    heard: frozenset[Adjacency]
    updated_at: int
    changes: int = 0
    changed_at: int = 0


class MeshMap:
    """The mesh that `gateway` is part of."""

    def __init__(self, gateway: int) -> None:
        self.gateway = gateway
        self.members = {gateway}
        self.root = gateway
        """The lowest gateway of the mesh."""
        self.rooted_at = 0
        """The instant from which messages of this gateway name the root."""
        self._edges: frozenset[Edge] = frozenset()
        self.fingerprint = digest(self._edges)
        """A digest of the edges: gateways agree where it is the same."""
        self._forwarding: frozenset[PortId] = frozenset()
        self._records: dict[int, _GatewayRecord] = {}
        self._heard_by_members: set[int] = set()
        self._assembler = MeshAssembler()
        self._heard: frozenset[Adjacency] = frozenset()
        self._serial = 0
        self._expire_at = 0

    def others(self, turn: int, most: int) -> list[int]:
        """Return up to `most` gateways of the mesh with a record; other ones each `turn`."""
        known = [gateway for gateway in self._records if self.concerns(gateway)]
        start = turn * most % len(known) if len(known) > most else 0
        return [*known[start:], *known[:start]][:most]

    def concerns(self, gateway: int) -> bool:
        """Return whether a gateway is in the mesh, or a member hears it. Any other may be forged."""
        return gateway in self.members or gateway in self._heard_by_members

    def forwards(self, number: int) -> bool:
        """Return whether the tree contains this gateway's port of this number."""
        return (self.gateway, number) in self._forwarding

    def set_heard(self, now: int, heard: frozenset[Adjacency]) -> bool:
        """Enter this gateway's neighbours; return whether they have changed."""
        if heard == self._heard:
            return False
        self._heard = heard
        self._serial = next_serial(self._serial)
        self._recompute(now)
        return True

    def receive(self, now: int, message: Mesh) -> bool:
        """Enter another gateway's announcement; return whether it is new, and complete."""
        known = self._records.get(message.gateway)
        if known is not None and not is_newer_serial(message.serial, known.serial):
            known.updated_at = now
            return False
        record = self._record(now, message.gateway, known)
        heard = self._assembler.add(message) if record is not None else None
        if record is None or heard is None:
            return False
        record.serial, record.heard, record.updated_at = message.serial, heard, now
        record.changes += 1
        self._records[message.gateway] = record
        if self.concerns(message.gateway):
            self._recompute(now)
        return True

    def _record(self, now: int, gateway: int, known: _GatewayRecord | None) -> _GatewayRecord | None:
        """Return the record of a gateway that announces a change; None without room, or if it changes too often."""
        if known is None:
            if len(self._records) >= RECORDS_MAX and not self._make_room(gateway):
                return None
            return _GatewayRecord(0, frozenset(), now, changed_at=now)
        forgiven = min(known.changes, (now - known.changed_at) // CHANGE_FORGIVEN)
        known.changes -= forgiven
        known.changed_at = known.changed_at + forgiven * CHANGE_FORGIVEN if known.changes else now
        return known if known.changes < CHANGES else None

    def _make_room(self, gateway: int) -> bool:
        """Forget an irrelevant gateway in favor of a relevant one; return False if none can be forgotten."""
        if not self.concerns(gateway):
            return False
        idle = next((each for each in self._records if not self.concerns(each)), None)
        if idle is not None:
            del self._records[idle]
        return idle is not None

    def expire(self, now: int) -> None:
        """Forget old records of gateways that are not in the mesh."""
        if now >= self._expire_at:
            self._expire_at = now + _KEPT // 8
            for gateway in [each for each, record in self._records.items() if record.updated_at <= now - _KEPT]:
                if gateway not in self.members:
                    del self._records[gateway]

    def messages(self, gateway: int) -> list[Mesh]:
        """Make the messages that announce the neighbours of this gateway, or of another one with a record."""
        if gateway == self.gateway:
            return mesh_messages(gateway, self._serial, self._heard)
        record = self._records[gateway]
        return mesh_messages(gateway, record.serial, record.heard)

    def _recompute(self, now: int) -> None:
        heard = {gateway: record.heard for gateway, record in self._records.items()}
        heard[self.gateway] = self._heard
        edges = edges_from(self.gateway, heard)
        members = {port[0] for edge in edges for port in edge} | {self.gateway}
        self._heard_by_members = {there for here in members for _, there, _ in heard.get(here, ())}
        if edges != self._edges:
            self._edges, self.members = edges, members
            self.fingerprint = digest(sorted(edges))
            self._forwarding = spanning_tree(edges)
            if min(members) != self.root:
                self.root = min(members)
                self.rooted_at = now + 1  # what was sent in this very instant still named the old one
