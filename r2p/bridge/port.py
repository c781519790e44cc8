"""One link of a gateway with its place in the tree, and what gateways count."""

from collections import Counter
from collections.abc import Callable

import msgspec

from r2p.log_lines import LineLimit
from r2p.protocols.bridge.ports import PortState, TreePort
from r2p.transports.link import Link
from r2p.units import LONG_AGO

_REFUSAL_LINES = 1  # of the log in a second on one link about orders that do not pass


class BridgePort:
    """A link and its place in the tree (one that forwards nothing while the link is down).

    `kind` is that of `Policy.kind`, `now` gives UTC in ns.
    """

    def __init__(self, link: Link, number: int, kind: tuple[bool, ...], now: Callable[[], int]) -> None:
        self.link = link
        self.number = number
        self.kind = kind
        self.now = now
        self.is_client = not link.admits_gateways
        """Whether no gateway may be at the link's other end."""
        self.tree_port = TreePort(number, 0)
        self.state = PortState.LISTENING
        """As it was reported last."""
        self.dropped: Counter[str] = Counter()
        """Messages that came in, or were published here, while nothing was forwarded."""
        self.demand = link.discovery.demand()
        self.denied_at = LONG_AGO
        """When it was answered last that an order does not pass (monotonic ns)."""
        self.refusal_lines = LineLimit(_REFUSAL_LINES)
        """For the lines of the log that say so."""

    @property
    def name(self) -> str:
        return self.link.name

    @property
    def in_tree(self) -> bool:
        return self.tree_port.in_tree

    @property
    def resumes(self) -> bool:
        """Whether it forwards nothing just because this program stood still, and is likely to go on."""
        return self.tree_port.resumes or self.tree_port.state is PortState.ALONE

    def count_dropped(self, reason: str) -> None:
        """Count a message that does not pass."""
        self.dropped[reason] += 1
        self.link.stats.lost[reason] += 1


PortsByKind = list[list[BridgePort]]


def by_kind(ports: list[BridgePort]) -> PortsByKind:
    """The ports in groups between which the policy makes no difference."""
    groups: dict[tuple[bool, ...], list[BridgePort]] = {}
    for port in ports:
        groups.setdefault(port.kind, []).append(port)
    return list(groups.values())


# What gateways count, for people and programs


class RouteStatistics(msgspec.Struct, frozen=True):
    """One topic from one link to another; `dropped` by reason, all since the route exists."""

    topic: str
    source: str
    target: str
    forwarded: int
    dropped: dict[str, int]


class PortStatistics(msgspec.Struct, frozen=True):
    """One link of a gateway: its state in the tree, and how many other gateways are on its network.

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
    """What a gateway has forwarded and dropped so far, on all links and topics."""

    ports: list[PortStatistics]
    routes: list[RouteStatistics]
