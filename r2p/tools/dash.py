"""`r2p dash`: the network in a browser."""

import asyncio
from typing import Annotated

import typer

from r2p.monitoring.monitor import NetworkMonitor
from r2p.tools.output import notify
from r2p.tools.session import Session, joined
from r2p.web.dash.assets import page
from r2p.web.dash.live import LiveSource
from r2p.web.dash.session import PATH, endpoint
from r2p.web.server import LOOPBACK, WebOptions, WebServer

PORT = 8080


async def dash(
    session: Session,
    *,
    host: Annotated[
        str, typer.Option(help="The address to listen on; all but loopback need the token of the printed link.")
    ] = LOOPBACK,
    port: Annotated[int, typer.Option(min=0, max=65535, help="0: a free one.")] = PORT,
    allow_publish: Annotated[
        bool, typer.Option("--allow-publish", help="Let pages publish and call services.")
    ] = False,
    allow_control: Annotated[
        bool, typer.Option("--allow-control", help="Let pages set parameters, and stop and start nodes and modules.")
    ] = False,
) -> None:
    """Show the network in a browser, on a page that this command serves."""
    async with NetworkMonitor(session.module) as monitor:
        source = LiveSource(session.module, monitor, allow_publish=allow_publish, allow_control=allow_control)
        async with WebServer(WebOptions(host=host, port=port), {PATH: endpoint(source)}, page()) as server:
            notify(f"open {server.url} in a browser; Ctrl-C ends")
            await asyncio.get_running_loop().create_future()


command = joined(dash, endless=lambda _: True)
