"""`r2p topic plot`: plot fields of topics in a browser, in the page of `r2p dash`."""

from typing import Annotated

import typer

import r2p
from r2p.monitoring.fields import FieldExtractor
from r2p.names import topic_name
from r2p.tools.completion import complete_topic
from r2p.tools.session import Session, UsageError
from r2p.tools.types import find

Fields = Annotated[
    list[str],
    typer.Argument(
        metavar="TOPIC.FIELD...",
        autocompletion=complete_topic,
        help="odometry.pose.x, ranges.value[3]: numbers of topics, all in one plot.",
        show_default=False,
    ),
]


async def plot(
    session: Session,
    fields: Fields,
    *,
    port: Annotated[int, typer.Option(min=0, max=65535, help="That of the page; 0: a free one.")] = 0,
    open: Annotated[bool, typer.Option("--open/--no-open", help="Open the page in a browser of this computer.")] = True,
) -> None:
    """Plot fields of topics, in the page of r2p dash.

    The page is served by this command, only to this computer, until Ctrl-C. Its address is printed.
    """
    from r2p.tools import dash  # only here: the extra `web` may not be installed, and other commands do not need it
    from r2p.web.server import WebOptions

    for topic, paths in _by_topic(fields).items():
        cls = await find(session, topic, None)
        try:
            FieldExtractor(cls, paths)
        except r2p.MessageError as error:
            raise UsageError(f"{topic}: {error}") from error
    async with dash.live_source(session) as source:
        await dash.serve(session, source, WebOptions(port=port), view=f"/plots/{','.join(fields)}", open=open)


def _by_topic(fields: list[str]) -> dict[str, list[str]]:
    """Return the paths of each topic. Raises UsageError."""
    found: dict[str, list[str]] = {}
    for field in fields:
        topic, _, path = field.partition(".")
        if not path:
            raise UsageError(f"{field} names no field: write {topic or 'TOPIC'}.FIELD; r2p topic info shows the fields")
        found.setdefault(topic_name(topic), []).append(path)
    return found
