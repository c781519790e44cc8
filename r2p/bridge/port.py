"""One link of a gateway: where its hellos come in, and where what it wants for other links is told."""

from collections import Counter
from collections.abc import Callable
from typing import Protocol

import msgspec

from r2p.log_lines import LineLimit
from r2p.protocols.bridge.base import PortState, TreePort
from r2p.runtime.sample import Source
from r2p.runtime.topic import Topic
from r2p.transports.announcement import Announcement
from r2p.transports.link import Link

_REFUSAL_LINES = 1  # of the log in a second on one link about orders that do not pass


class PortOwner(Protocol):
    """The gateway, as its ports see it."""

    @property
    def gateway(self) -> int:
        """Its number in the tree."""

    def handle_management(self, port: "BridgePort", data: bytes) -> bool:
        """A management message; True if discovery need not see it."""

    def desired_state(self, port: "BridgePort", topic: Topic, own: Announcement) -> Announcement:
        """What the link is to be told of a topic that this module itself has as `own`."""

    def demand_changed(self, port: "BridgePort", topics: set[str]) -> None:
        """Others offer or want these topics there, or don't any more."""

    def source_name(self, port: "BridgePort", source: Source) -> str:
        """What the module that published a message is called there."""

    def modules_changed(self, port: "BridgePort") -> None:
        """Modules or nodes came or went there."""


class BridgePort:
    """A link and its place in the tree (one that forwards nothing while the link is down)."""

    def __init__(self, owner: PortOwner, link: Link, number: int, now: Callable[[], int]) -> None:
        self.link = link
        self.number = number
        self.place = TreePort(number, 0)
        self.client = not link.admits_gateways
        """Whether it is a client's: no gateway may be at its other end."""
        self.now = now
        """UTC in ns."""
        self.state = PortState.LISTENING
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
        return self.place.resumes or self.place.state is PortState.ALONE

    def lose(self, reason: str) -> None:
        """Count a message that does not pass."""
        self.dropped[reason] += 1
        self.link.stats.lost[reason] += 1

    # Gate

    def handle_management(self, data: bytes) -> bool:
        return self._owner.handle_management(self, data)

    def desired_state(self, topic: Topic, own: Announcement) -> Announcement:
        return self._owner.desired_state(self, topic, own)

    @property
    def may_announce(self) -> bool:
        return self.place.in_tree or self._owner.gateway not in self.place.gateways

    @property
    def has_other_gateways(self) -> bool:
        return bool(self.place.neighbours)

    def source_name(self, source: Source) -> str:
        return self._owner.source_name(self, source)

    def discovery_changed(self) -> None:
        changed = self.demand.pop_changed()
        if changed:
            self._owner.demand_changed(self, changed)
        if self.link.discovery.generation != self._generation:
            self._generation = self.link.discovery.generation
            self._owner.modules_changed(self)


# What a gateway has done so far, for people and programs.


class WayStatistics(msgspec.Struct, frozen=True):
    """One topic from one link to another; `dropped` by reason, all since the way exists."""

    topic: str
    source: str
    target: str
    forwarded: int
    dropped: dict[str, int]


class PortStatistics(msgspec.Struct, frozen=True):
    """One link of a gateway: what it does in the tree, and how many other gateways are on its network.

    `dropped` counts what came in while nothing was forwarded. `offset` (ns) is UTC less the time of the link's network,
    where that has one, known to +-`error` (ns).
    """

    link: str
    state: str
    gateways: int
    dropped: dict[str, int]
    offset: int | None = None
    error: int | None = None


class GatewayStatistics(msgspec.Struct, frozen=True):
    """All of it."""

    ports: list[PortStatistics]
    ways: list[WayStatistics]
