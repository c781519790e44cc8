"""The mesh of gateways and the tree in it: pure functions over who hears whom.

A network (bus, zenoh network, line) has no name of its own: it is the set of gateway ports that hear each other. Only
what both sides say counts.
"""

import struct
from collections import defaultdict, deque
from collections.abc import Iterable, Mapping
from hashlib import blake2b

import msgspec

from r2p.codecs.management import Mesh

Place = tuple[int, int]
"""A port: gateway, and the number of the port there."""

Hearing = tuple[int, int, int]
"""What a gateway hears: own port, other gateway, its port."""

Edge = tuple[Place, Place]

_EACH = 3  # hearings in a message
_HEARD = struct.Struct("<BIB")
_MOST_PARTS = 16

MOST_HEARD = _EACH * _MOST_PARTS
"""Hearings that a gateway can tell of; with more it can't agree with anybody, and is silent."""


def parts(gateway: int, serial: int, heard: Iterable[Hearing]) -> list[Mesh]:
    """The messages that tell whom a gateway hears."""
    told = sorted(heard)[:MOST_HEARD]
    pieces = [told[at : at + _EACH] for at in range(0, len(told), _EACH)] or [[]]
    last = len(pieces) - 1
    return [
        Mesh(gateway, serial, number << 4 | last, b"".join(_HEARD.pack(*each) for each in piece).ljust(18, b"\0"))
        for number, piece in enumerate(pieces)
    ]


class Assembly:
    """Puts the parts of MESH messages together."""

    def __init__(self) -> None:
        self._pieces: dict[tuple[int, int], dict[int, frozenset[Hearing]]] = {}

    def add(self, message: Mesh) -> frozenset[Hearing] | None:
        """What the gateway hears, once all parts of this serial are there."""
        number, last = message.part >> 4, message.part & 15
        key = (message.gateway, message.serial)
        pieces = self._pieces.setdefault(key, {})
        pieces[number] = frozenset(each for each in _HEARD.iter_unpack(message.heard) if each[1])
        if set(pieces) != set(range(last + 1)):
            self._bound()
            return None
        del self._pieces[key]
        return frozenset().union(*pieces.values())

    def _bound(self) -> None:
        while len(self._pieces) > 64:  # lies, or gateways that died in the middle
            del self._pieces[next(iter(self._pieces))]


def edges_from(gateway: int, heard: Mapping[int, Iterable[Hearing]]) -> frozenset[Edge]:
    """What both sides hear, as far as it is connected with `gateway`."""
    mutual: dict[int, list[Edge]] = defaultdict(list)
    for here, hearings in heard.items():
        for port, there, its_port in hearings:
            if (its_port, here, port) in heard.get(there, ()):
                mutual[here].append(((here, port), (there, its_port)))
    reached, todo = {gateway}, [gateway]
    while todo:
        for _, (there, _) in mutual[todo.pop()]:
            if there not in reached:
                reached.add(there)
                todo.append(there)
    return frozenset(edge for here in reached for edge in mutual[here])


def digest(*things: object) -> int:
    """32 bits that tell two values apart."""
    return int.from_bytes(blake2b(repr(things).encode(), digest_size=4).digest(), "little")


def tree(edges: Iterable[Edge]) -> frozenset[Place]:
    """The ports that forward: breadth first from the lowest gateway, each network and each gateway reached once."""
    networks = _networks(edges)
    ports: dict[int, list[Place]] = defaultdict(list)
    for place in sorted(networks):
        ports[place[0]].append(place)
    chosen: set[Place] = set()
    seen_networks: set[Place] = set()
    root = min(ports, default=None)
    seen, todo = {root}, deque([] if root is None else [root])
    while todo:
        for place in ports[todo.popleft()]:
            network = networks[place]
            if min(network) in seen_networks:
                continue
            seen_networks.add(min(network))
            chosen.add(place)
            for other in sorted(network):
                if other[0] not in seen:
                    seen.add(other[0])
                    chosen.add(other)
                    todo.append(other[0])
    return frozenset(chosen)


def _networks(edges: Iterable[Edge]) -> dict[Place, set[Place]]:
    """Each port with all the ports of its network."""
    networks: dict[Place, set[Place]] = {}
    for here, there in edges:
        joined = networks.get(here, {here}) | networks.get(there, {there})
        for place in joined:
            networks[place] = joined
    return networks


# What one gateway knows of its mesh: whom each gateway there hears, as it tells by MESH, and what follows.


MOST_RECORDS = 256
"""Gateways of which it is kept whom they hear."""
CHANGES = 100
"""Changes that one gateway may tell in a row ..."""
CHANGE_FORGIVEN = 5_000_000_000
"""... and ns until it may tell one more: one that tells another mesh each time would keep all from agreeing."""

_KEPT = 5_000_000_000  # ns for which a record lives on that nobody repeats, of a gateway that is not in the mesh


class _GatewayRecord(msgspec.Struct):
    """Whom another gateway hears."""

    serial: int
    heard: frozenset[Hearing]
    at: int
    changes: int = 0
    changed_at: int = 0


class MeshMap:
    """The mesh that `gateway` is part of."""

    def __init__(self, gateway: int) -> None:
        self.edges: frozenset[Edge] = frozenset()
        self.members: set[int] = set()
        self.root = gateway
        """The lowest gateway."""
        self.fingerprint = digest(self.edges)
        """Of the edges: gateways agree where it is the same."""
        self._gateway = gateway
        self._chosen: frozenset[Place] = frozenset()
        self._records: dict[int, _GatewayRecord] = {}
        self._audible: set[int] = set()
        self._assembly = Assembly()
        self._heard: frozenset[Hearing] = frozenset()
        self._serial = 0
        self._forget_at = 0

    def others(self, turn: int, most: int) -> list[int]:
        """Gateways of the mesh that have told whom they hear: `most` of them, others each turn."""
        known = [gateway for gateway in self._records if self.concerns(gateway)]
        start = turn * most % len(known) if len(known) > most else 0
        return [*known[start:], *known[:start]][:most]

    def concerns(self, gateway: int) -> bool:
        """Whether it is in the mesh, or a gateway there says that it hears it: others may be in no mesh of ours."""
        return gateway in self.members or gateway in self._audible

    def chosen(self, place: Place) -> bool:
        """Whether the port is one of those that forward."""
        return place in self._chosen

    def hear(self, heard: frozenset[Hearing]) -> bool:
        """Whom this gateway hears now; says whether that is news."""
        if heard == self._heard:
            return False
        self._heard = heard
        self._serial = (self._serial + 1) & 0xFFFF
        self._draw()
        return True

    def learn(self, now: int, message: Mesh) -> bool:
        """What another gateway tells; says whether that is news, and complete."""
        known = self._records.get(message.gateway)
        if known is not None and not 0 < (message.serial - known.serial) & 0xFFFF < 0x8000:
            known.at = now
            return False
        record = self._record(now, message.gateway, known)
        heard = self._assembly.add(message) if record is not None else None
        if record is None or heard is None:
            return False
        record.serial, record.heard, record.at = message.serial, heard, now
        record.changes += 1
        self._records[message.gateway] = record
        if self.concerns(message.gateway):
            self._draw()
        return True

    def _record(self, now: int, gateway: int, known: _GatewayRecord | None) -> _GatewayRecord | None:
        """The entry in which to write what a gateway tells; None: not now."""
        if known is None:
            if len(self._records) >= MOST_RECORDS and not self._make_room(gateway):
                return None
            return _GatewayRecord(0, frozenset(), now, changed_at=now)
        forgiven = min(known.changes, (now - known.changed_at) // CHANGE_FORGIVEN)
        known.changes -= forgiven
        known.changed_at = known.changed_at + forgiven * CHANGE_FORGIVEN if known.changes else now
        return known if known.changes < CHANGES else None

    def _make_room(self, gateway: int) -> bool:
        """Forget what does not concern us, for a gateway that does."""
        if not self.concerns(gateway):
            return False
        idle = next((each for each in self._records if not self.concerns(each)), None)
        if idle is not None:
            del self._records[idle]
        return idle is not None

    def forget(self, now: int) -> None:
        """What was told long ago, by those who are not in the mesh."""
        late = now - _KEPT
        if now >= self._forget_at:
            self._forget_at = now + _KEPT // 8
            for gateway in [each for each, record in self._records.items() if record.at <= late]:
                if gateway not in self.members:
                    del self._records[gateway]

    def told(self, gateway: int) -> list[Mesh]:
        """The messages that tell whom a gateway hears: this one, or one of the others."""
        if gateway == self._gateway:
            return parts(gateway, self._serial, self._heard)
        record = self._records[gateway]
        return parts(gateway, record.serial, record.heard)

    def _draw(self) -> None:
        heard = {gateway: record.heard for gateway, record in self._records.items()}
        heard[self._gateway] = self._heard
        edges = edges_from(self._gateway, heard)
        members = {place[0] for edge in edges for place in edge} | {self._gateway}
        self._audible = {there for here in members for _, there, _ in heard.get(here, ())}
        if edges != self.edges:
            self.edges = edges
            self.members = {place[0] for edge in edges for place in edge}
            self.root = min(self.members, default=self._gateway)
            self.fingerprint = digest(sorted(edges))
            self._chosen = tree(edges)
