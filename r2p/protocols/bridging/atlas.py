"""What one gateway knows of its mesh: whom each gateway there hears, as it tells by MESH, and what follows."""

import msgspec

from r2p.codecs.management import Mesh
from r2p.protocols.bridging.mesh import Assembly, Edge, Hearing, Place, digest, edges_from, parts, tree

_KEPT = 5_000_000_000  # ns for which a record lives on that nobody repeats, of a gateway that is not in the mesh


class _Record(msgspec.Struct):
    """Whom another gateway hears."""

    serial: int
    heard: frozenset[Hearing]
    at: int


class Atlas:
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
        self._records: dict[int, _Record] = {}
        self._assembly = Assembly()
        self._heard: frozenset[Hearing] = frozenset()
        self._serial = 0

    @property
    def others(self) -> list[int]:
        """Gateways that have told whom they hear."""
        return list(self._records)

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
        heard = self._assembly.add(message)
        if heard is None:
            return False
        self._records[message.gateway] = _Record(message.serial, heard, now)
        self._draw()
        return True

    def forget(self, now: int) -> None:
        """What was told long ago, by those who are not in the mesh."""
        for gateway in [gateway for gateway, record in self._records.items() if now - record.at >= _KEPT]:
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
        edges = edges_from(self._gateway, heard | {self._gateway: self._heard})
        if edges != self.edges:
            self.edges = edges
            self.members = {place[0] for edge in edges for place in edge}
            self.root = min(self.members, default=self._gateway)
            self.fingerprint = digest(sorted(edges))
            self._chosen = tree(edges)
