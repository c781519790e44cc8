"""The gateway module (thesis 7.7): joins the robot's bus to the computers outside, by TCP, serial line or zenoh."""

from collections.abc import Iterable

from r2p.bridge import BridgeOptions
from r2p.sim.modules.board import Board
from r2p.transports.link import Transport


class GatewayModule(Board):
    """The module. `outside`: where computers connect; without any it is a module like others."""

    def __init__(
        self,
        name: str = "GW",
        *,
        via: str | Transport,
        outside: Iterable[str | Transport] = (),
        options: BridgeOptions | None = None,
    ) -> None:
        """Raises as `r2p.Module` does; `options`: what it lets through, by default everything but commands."""
        links = [via, *outside]
        super().__init__(name, via=links, bridge=False if len(links) == 1 else options or True)
