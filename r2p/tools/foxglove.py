"""`r2p foxglove`: the network for Foxglove, Lichtblick and PlotJuggler."""

import asyncio
import contextlib
import functools
from collections.abc import AsyncIterator
from typing import Annotated
from urllib.parse import quote, urlsplit

import typer

import r2p
from r2p.log_lines import printable
from r2p.ros.clock import ros_time
from r2p.ros.library import names_of_ros
from r2p.tools.output import notify
from r2p.tools.session import Run, Session, UsageError, joined, run_virtually
from r2p.tools.types import Types
from r2p.web.foxglove.network import FoxgloveOptions
from r2p.web.foxglove.server import ORIGINS, FoxgloveServer
from r2p.web.server import LOOPBACK, WebFile, WebOptions, WebServer

PORT = 8765
"""Where Foxglove looks by default."""

_LOOK = 1.0  # seconds

_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>r2p foxglove</title></head>
<body><h1>r2p foxglove</h1>
<p>This is a server for Foxglove, Lichtblick and PlotJuggler: open a Foxglove WebSocket connection there,
to the <code>ws:</code> address that <code>r2p foxglove</code> printed.</p>
<p>A page for browsers is served by <code>r2p dash</code>.</p></body></html>
"""


def _loop(*, sim_time: bool, **_others: object) -> Run | None:
    return functools.partial(run_virtually, follow=True) if sim_time else None


async def foxglove(
    session: Session,
    *,
    host: Annotated[
        str, typer.Option(help="The address to listen on; all but loopback need the token of the printed link.")
    ] = LOOPBACK,
    port: Annotated[int, typer.Option(min=0, max=65535, help="0: a free one.")] = PORT,
    allow_publish: Annotated[
        bool, typer.Option("--allow-publish", help="Let viewers publish and call services.")
    ] = False,
    allow_control: Annotated[bool, typer.Option("--allow-control", help="Let viewers set parameters.")] = False,
    origin: Annotated[
        list[str] | None,
        typer.Option(metavar="URL", help="A page that may connect, as https://lichtblick.example (repeatable)."),
    ] = None,
    sim_time: Annotated[
        bool, typer.Option("--sim-time", help="Follow /clock, such as a simulator's (use_sim_time).")
    ] = False,
) -> None:
    """Serve the network to Foxglove, Lichtblick and PlotJuggler.

    Topics have ROS 2 types there: r2p's standard ones those of ROS, all others their own.
    """
    network = FoxgloveOptions(
        name=f"r2p on {session.network_name}",
        allow_publish=allow_publish,
        allow_control=allow_control,
        types=Types(session.settings).stated_topics(),
    )
    origins = (*ORIGINS, *map(_checked_origin, origin or ()))
    options = WebOptions(host=host, port=port, origins=origins)
    files = {"/index.html": WebFile("text/html; charset=utf-8", _PAGE.encode())}
    _check_rosbags()
    async with (
        _following_clock(session, sim_time=sim_time),
        FoxgloveServer(session.module, network) as server,
        WebServer(options, {"/": server.endpoint}, files) as web,
    ):
        notify(f"connect Foxglove, Lichtblick or PlotJuggler to {_socket_url(web)}; Ctrl-C ends")
        try:
            await _report_pages(web)
        finally:
            _report(server, web, verbose=session.verbose)


command = joined(foxglove, endless=lambda _: True, loop=_loop)


@contextlib.asynccontextmanager
async def _following_clock(session: Session, *, sim_time: bool) -> AsyncIterator[None]:
    """Follow /clock over links that are not to ROS; those to ROS follow it themselves."""
    if sim_time:
        async with ros_time(session.module.space):
            yield
    else:
        yield


def _socket_url(web: WebServer) -> str:
    """Return the address for clients, with the token if they need it."""
    address = urlsplit(web.url)
    return f"ws://{address.netloc}/" + (f"?token={quote(web.token, safe='')}" if web.token else "")


def _checked_origin(text: str) -> str:
    parts = urlsplit(text)
    if not (parts.scheme and parts.netloc) or parts.path.strip("/") or parts.query or parts.fragment:
        raise UsageError(f"--origin {text}: write scheme and host of the page, as https://lichtblick.example:8080")
    return f"{parts.scheme}://{parts.netloc}"


def _check_rosbags() -> None:
    """Report that the standard types can't be those of ROS, whose definitions are in rosbags."""
    try:
        names_of_ros(2)
    except r2p.MessageError as error:
        notify(f"odometry, log and others have types of r2p, which 3D and Log panels do not know: {error}")


async def _report_pages(web: WebServer) -> None:
    """Report refused pages: these show no reason themselves."""
    reported: set[str] = set()
    while True:
        await asyncio.sleep(_LOOK)
        for page in sorted(web.foreign_origins - reported):
            reported.add(page)
            notify(f"a page of {printable(page)} was refused: --origin {printable(page)} lets it in")


def _report(server: FoxgloveServer, web: WebServer, *, verbose: int) -> None:
    """Report what viewers lost, and with -v what they were refused."""
    for name, count in sorted(server.lost.items()):
        notify(f"{count} messages of {name} lost: a viewer was too slow")
    if verbose:
        for reason, count in sorted({**web.refused, **server.refused}.items()):
            notify(f"{count} refused: {reason}")
