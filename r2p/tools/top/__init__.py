"""`r2p top`: what happens on the network, once a second: on a screen of its own, or as a plain table.

`tables` has the columns, of both. `app` is the screen, for which Textual is needed (the extra `ui`); `plain` prints.
"""

import gc
import importlib.util
import sys
from typing import Annotated, Literal

import typer

from r2p.monitoring.monitor import NetworkMonitor
from r2p.tools.completion import complete_topic
from r2p.tools.options import Count, Once, time_option
from r2p.tools.output import Output, notify
from r2p.tools.session import Session, UsageError, joined
from r2p.tools.top.plain import PlainTop
from r2p.tools.top.tables import VIEWS, View

PERIOD = 1.0
"""Seconds between two looks."""

_INSTALL = "a screen needs textual: pip install 'r2p[ui]'; without it, tables are printed"


async def top(
    session: Session,
    view: Annotated[
        Literal["topics", "modules", "nodes", "links", "buses", "services"],
        typer.Argument(help="The first table.", show_default=True),
    ] = "topics",
    *,
    sort: Annotated[
        str, typer.Option("--sort", "-s", metavar="COLUMN", help="Sort by this column: rate, missed, p99, ...")
    ] = "",
    filter: Annotated[str, typer.Option("--filter", metavar="TEXT", help="Only rows that contain this text.")] = "",
    measure: Annotated[
        list[str] | None,
        typer.Option(
            "--measure",
            "-m",
            metavar="TOPIC",
            autocompletion=complete_topic,
            help="Subscribe to this topic, for its latency and losses (repeatable).",
        ),
    ] = None,
    period: Annotated[float | None, time_option("--period", "Between two looks; default: 1.")] = None,
    allow_control: Annotated[
        bool, typer.Option("--allow-control", help="Let parameters of nodes be set on the screen.")
    ] = False,
    count: Count = None,
    once: Once = False,
    format: Annotated[
        Literal["text", "yaml", "json", "csv"] | None,
        typer.Option("--format", help="Print tables in this format, without a screen."),
    ] = None,
) -> None:
    """Show networks, modules, topics and buses, with their figures, once a second.

    At a terminal on a screen: ? explains its keys, and q quits. In a pipe, with --format, -n or --once, or without the
    package textual, tables are printed. What is not known is "-". Latency is known of topics that are measured.
    """
    chosen = VIEWS[view]
    _check_sort(chosen, sort)
    async with NetworkMonitor(session.module, period=period or PERIOD) as monitor:
        for topic in measure or ():
            monitor.measure(topic)
        if _wants_screen(count=1 if once else count, format=format):
            from r2p.tools.top.app import TopApp  # only here: it takes a third of a second

            gc.freeze()  # what is loaded stays: looking for garbage in it takes 20 ms, again and again
            await TopApp(
                session, monitor, view=chosen, sorted_by=sort, wanted=filter, allow_control=allow_control
            ).run_async()
        else:
            await session.settle()
            await PlainTop(Output(format), chosen, sorted_by=sort, wanted=filter).run(monitor, 1 if once else count)


def _check_sort(view: View, column: str) -> None:
    """Raise UsageError for a column that the table does not have."""
    names = [each.name for each in view.columns]
    if column and column not in names:
        raise UsageError(f"--sort {column}: the columns of {view.name} are {', '.join(names)}")


def _wants_screen(*, count: int | None, format: str | None) -> bool:
    """Return whether to draw on a terminal: there is one, and no option asks for tables."""
    if count is not None or format is not None or not (sys.stdin.isatty() and sys.stdout.isatty()):
        return False
    if importlib.util.find_spec("textual") is None:
        notify(_INSTALL)
        return False
    return True


command = joined(top)
