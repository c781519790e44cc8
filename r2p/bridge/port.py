"""One link of a gateway: where its hellos come in, and where what it wants for other links is told."""

from collections import Counter
from collections.abc import Callable
from typing import TYPE_CHECKING

from r2p.protocols.bridging.tree import Port, State
from r2p.topic import Topic
from r2p.transports.announce import Told
from r2p.transports.link import Link

if TYPE_CHECKING:
    from r2p.bridge.bridge import Bridge


class BridgePort:
    """A link and its place in the tree (one that forwards nothing while the link is down)."""

    def __init__(self, bridge: "Bridge", link: Link, number: int, now: Callable[[], int]) -> None:
        self.link = link
        self.number = number
        self.place = Port(number, 0)
        self.now = now
        """UTC in ns."""
        self.state = State.LISTENING
        """As it was told last."""
        self.dropped: Counter[str] = Counter()
        """What came in, or was published here, while nothing was forwarded."""
        self.demand = link.discovery.demand()
        self._bridge = bridge
        self._generation = -1

    @property
    def name(self) -> str:
        return self.link.name

    @property
    def in_tree(self) -> bool:
        return self.place.in_tree

    # Gate

    def heard(self, data: bytes) -> bool:
        return self._bridge.heard(self, data)

    def wish(self, topic: Topic, own: Told) -> Told:
        return self._bridge.relays.wish(self, topic, own)

    @property
    def speaks(self) -> bool:
        return self.place.in_tree or self._bridge.tree.gateway not in self.place.gateways

    @property
    def shares(self) -> bool:
        return bool(self.place.neighbours)

    def looked(self) -> None:
        changed = self.demand.changed()
        if changed:
            self._bridge.relays.changed(changed, self)
        if self.link.discovery.generation != self._generation:
            self._generation = self.link.discovery.generation
            self._bridge.presences.changed()
