"""What the emulated hardware modules share: each is an `r2p.Module` that starts its nodes by itself when it is opened.

The nodes are ordinary ones, around a model of `r2p.sim.physics`; so a board runs on any transport, and can't be told
from a real one by its messages.
"""

from collections.abc import Iterable, Mapping
from typing import Self

import r2p
from r2p.bridge import BridgeOptions
from r2p.supervisor import NodeFunction
from r2p.transports.link import Transport

Via = str | Transport | Iterable[str | Transport] | None


class Board(r2p.Module):
    """A hardware module. `nodes`: its node functions by name; more can be started once it is open, as on any module."""

    def __init__(
        self,
        name: str,
        *,
        via: Via = None,
        remap: dict[str, str] | None = None,
        nodes: Mapping[str, NodeFunction] | None = None,
        bridge: bool | BridgeOptions = False,
    ) -> None:
        super().__init__(name, via=via, remap=remap, watchdog=False, bridge=bridge)
        self._programs = dict(nodes or {})

    async def __aenter__(self) -> Self:
        """Power on. Raises as `r2p.Module` does."""
        await super().__aenter__()
        for name, function in self._programs.items():
            self.start(function, name=name)
        return self
