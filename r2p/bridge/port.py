"""One link of a gateway: where its hellos come in, and where what it wants for other links is told."""

from collections import Counter
from collections.abc import Callable
from typing import Protocol

from r2p.line_limit import LineLimit
from r2p.protocols.bridging.base import Port, State
from r2p.sample import Source
from r2p.topic import Topic
from r2p.transports.announce import Told
from r2p.transports.link import Link

_REFUSAL_LINES = 1  # of the log in a second on one link about orders that do not pass


class Owner(Protocol):
    """The gateway, as its ports see it."""

    @property
    def gateway(self) -> int:
        """Its number in the tree."""

    def heard(self, port: "BridgePort", data: bytes) -> bool:
        """A management message; True if discovery need not see it."""

    def wish(self, port: "BridgePort", topic: Topic, own: Told) -> Told:
        """What the link is to be told of a topic that this module itself has as `own`."""

    def demand_changed(self, port: "BridgePort", topics: set[str]) -> None:
        """Others offer or want these topics there, or don't any more."""

    def source_name(self, port: "BridgePort", source: Source) -> str:
        """What the module that published a message is called there."""

    def modules_changed(self, port: "BridgePort") -> None:
        """Modules or nodes came or went there."""


class BridgePort:
    """A link and its place in the tree (one that forwards nothing while the link is down)."""

    def __init__(self, owner: Owner, link: Link, number: int, now: Callable[[], int]) -> None:
        self.link = link
        self.number = number
        self.place = Port(number, 0)
        self.client = not link.admits_gateways
        """Whether it is a client's: no gateway may be at its other end."""
        self.now = now
        """UTC in ns."""
        self.state = State.LISTENING
        """As it was told last."""
        self.dropped: Counter[str] = Counter()
        """What came in, or was published here, while nothing was forwarded."""
        self.demand = link.discovery.demand()
        self.denied_at = -(1 << 62)
        """When it was told last that an order does not pass (monotonic ns)."""
        self.refusals = LineLimit(_REFUSAL_LINES)
        """For the lines of the log that say so."""
        self._owner = owner
        self._generation = -1

    @property
    def name(self) -> str:
        return self.link.name

    @property
    def in_tree(self) -> bool:
        return self.place.in_tree

    @property
    def resumes(self) -> bool:
        """Whether it forwards nothing just because this program stood still, and is likely to go on."""
        return self.place.resumes or self.place.state is State.ALONE

    def lose(self, reason: str) -> None:
        """Count a message that does not pass."""
        self.dropped[reason] += 1
        self.link.stats.lost[reason] += 1

    # Gate

    def heard(self, data: bytes) -> bool:
        return self._owner.heard(self, data)

    def wish(self, topic: Topic, own: Told) -> Told:
        return self._owner.wish(self, topic, own)

    @property
    def speaks(self) -> bool:
        return self.place.in_tree or self._owner.gateway not in self.place.gateways

    @property
    def shares(self) -> bool:
        return bool(self.place.neighbours)

    def source_name(self, source: Source) -> str:
        return self._owner.source_name(self, source)

    def looked(self) -> None:
        changed = self.demand.changed()
        if changed:
            self._owner.demand_changed(self, changed)
        if self.link.discovery.generation != self._generation:
            self._generation = self.link.discovery.generation
            self._owner.modules_changed(self)
