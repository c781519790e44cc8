"""`r2p dash`: the network in a browser."""

import asyncio
import webbrowser
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from r2p.monitoring.monitor import NetworkMonitor
from r2p.monitoring.topic_types import TypeFinder
from r2p.tools.output import notify
from r2p.tools.session import Session, UsageError, joined
from r2p.tools.types import Types
from r2p.web.dash.live import LiveSource
from r2p.web.dash.session import PATH, endpoint, page
from r2p.web.dash.source import DashSource
from r2p.web.server import LOOPBACK, WebOptions, WebServer

PORT = 8080

_OPENING = 0.3  # s in which files open that end as they should; others are read through while pages can connect

Host = Annotated[
    str, typer.Option(help="The address to listen on; all but loopback need the token of the printed link.")
]
Port = Annotated[int, typer.Option(min=0, max=65535, help="0: a free one.")]


async def dash(
    session: Session,
    files: Annotated[
        list[Path] | None, typer.Argument(metavar="FILE...", help="Recordings to show instead of the network.")
    ] = None,
    *,
    host: Host = LOOPBACK,
    port: Port = PORT,
    open: Annotated[bool, typer.Option("--open", help="Open the page in a browser of this computer.")] = False,
    allow_publish: Annotated[
        bool, typer.Option("--allow-publish", help="Let pages publish and call services.")
    ] = False,
    allow_control: Annotated[
        bool, typer.Option("--allow-control", help="Let pages set parameters, and stop and start nodes and modules.")
    ] = False,
) -> None:
    """Show the network, or a recording, in a browser, on a page that this command serves.

    The address is printed. Pages only look, unless an option allows more. Ctrl-C ends it.
    """
    if files:
        await _show_recording(session, files, WebOptions(host=host, port=port), open=open)
        return
    async with live_source(session, allow_publish=allow_publish, allow_control=allow_control) as source:
        await serve(session, source, WebOptions(host=host, port=port), open=open)


def _check(_settings: object, given: Mapping[str, Any]) -> None:
    """Refuse options that make no sense for a recording. Raises UsageError."""
    if given["files"] and (given["allow_publish"] or given["allow_control"]):
        raise UsageError("a recording can only be looked at: leave out --allow-publish and --allow-control")


async def _show_recording(session: Session, files: list[Path], options: WebOptions, *, open: bool) -> None:
    """Serve pages with a recording. Raises BagError if it can't be read."""
    from r2p.recording.bag_file import bag_paths  # only here: a running network needs no MCAP
    from r2p.web.dash.recorded.source import RecordedSource

    async with RecordedSource(bag_paths(files)) as source:
        opening = asyncio.create_task(source.opened())
        await asyncio.wait([opening], timeout=_OPENING)
        serving = asyncio.create_task(serve(session, source, options, open=open))
        try:
            await opening
            await serving
        finally:
            serving.cancel()
            await asyncio.wait([serving])


@asynccontextmanager
async def live_source(
    session: Session, *, allow_publish: bool = False, allow_control: bool = False
) -> AsyncIterator[LiveSource]:
    """Watch the network of a command."""
    finder = TypeFinder(session.module, Types(session.settings).stated_topics())
    async with (
        NetworkMonitor(session.module) as monitor,
        LiveSource(session.module, monitor, finder, allow_publish=allow_publish, allow_control=allow_control) as source,
    ):
        yield source


async def serve(session: Session, source: DashSource, options: WebOptions, *, view: str = "", open: bool) -> None:
    """Serve pages until the command is ended; `view` is the part of the address that says what is shown first."""
    async with WebServer(options, {PATH: endpoint(source)}, page()) as server:
        url = server.link(view)
        notify(f"open {url} in a browser; Ctrl-C ends")
        if open and not await asyncio.to_thread(webbrowser.open, url):
            notify("no browser was found on this computer: open the address elsewhere, or by hand")
        try:
            await asyncio.get_running_loop().create_future()
        finally:
            if session.verbose:
                _report_refused(server.refused | source.refused)


def _report_refused(refused: dict[str, int]) -> None:
    for reason, count in sorted(refused.items()):
        notify(f"{count} refused: {reason}")


# A robot that is switched off is shown as soon as it is there: the page is served meanwhile.
command = joined(dash, endless=lambda _: True, keep_trying=True, check=_check, joins=lambda given: not given["files"])
