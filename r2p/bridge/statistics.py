"""What a gateway has done so far, for people and programs."""

import msgspec


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
