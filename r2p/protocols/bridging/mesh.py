"""The mesh of gateways and the tree in it: pure functions over who hears whom.

A network (bus, zenoh network, line) has no name of its own: it is the set of gateway ports that hear each other. Only
what both sides say counts.
"""

import struct
from collections import defaultdict, deque
from collections.abc import Iterable, Mapping
from hashlib import blake2b

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
