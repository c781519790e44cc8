"""The transport on any CAN port: one link, for as long as the port is open."""

import asyncio
from collections.abc import Callable

from r2p.transports.can.port import CanPort
from r2p.transports.link import Hub, Transport
from r2p.transports.rtcan.link import RtcanLink
from r2p.transports.rtcan.options import RtcanOptions

_DRAINING = 0.5  # seconds for the last messages to get through: their subscribers take nothing after the good-bye
_CLOSING = 0.5  # ... and for the good-bye


class RtcanTransport(Transport):
    """An RTCAN link called `name` on the port that `make_port` makes."""

    def __init__(self, name: str, make_port: Callable[[], CanPort], options: RtcanOptions) -> None:
        self._name = name
        self._make_port = make_port
        self._options = options

    async def run(self, hub: Hub, opened: Callable[[], object]) -> None:
        await run_link(self._name, hub, opened, self._make_port(), self._options)


async def run_link(name: str, hub: Hub, opened: Callable[[], object], port: CanPort, options: RtcanOptions) -> None:
    """Run a link on a port until cancelled; the port is closed after the link's last messages and its good-bye."""
    settings = options.settings(hub.random.getrandbits(64), port)
    link = RtcanLink(name, hub, port, settings, options.utc_error)
    hub.attach(link)
    running = asyncio.create_task(port.run(link.shell, opened), name=f"{name} port")
    try:
        await asyncio.wait([running])
        await running
    finally:
        try:
            if not running.done():
                await link.drained(_DRAINING)
            link.close()
            if not running.done():
                await link.shell.drained(_CLOSING)
        finally:
            link.close()
            running.cancel()
            await asyncio.wait([running])
            link.shell.close()
            hub.detach(link)
