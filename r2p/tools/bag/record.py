"""`r2p bag record`: record topics into a file, until Ctrl-C."""

import asyncio
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from r2p.clock import local_time
from r2p.tools.completion import complete_topic
from r2p.tools.options import topic_pattern
from r2p.tools.output import notify
from r2p.tools.session import Session, Settings, UsageError
from r2p.tools.types import Types

if TYPE_CHECKING:
    import r2p


def check(settings: Settings, given: Mapping[str, Any]) -> None:
    """Raise UsageError for topics and options that make no sense."""
    if not given["topics"] and not given["all"]:
        raise UsageError("nothing to record: name topics, such as odometry or 'camera/*', or give -a for all")
    for each in given["topics"] or ():
        topic_pattern(each.removeprefix("/"), "TOPIC")
    for each in given["exclude"] or ():
        topic_pattern(each.removeprefix("/"), "--exclude")


async def record(
    session: Session,
    topics: Annotated[
        list[str] | None,
        typer.Argument(metavar="TOPIC", autocompletion=complete_topic, help="Names and patterns: 'camera/*'."),
    ] = None,
    *,
    all: Annotated[bool, typer.Option("--all", "-a", help="All topics, also those that appear later.")] = False,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FILE", help="Default: r2p-YYYYMMDD-HHMMSS.mcap here.")
    ] = None,
    exclude: Annotated[
        list[str] | None, typer.Option("--exclude", metavar="PATTERN", help="Leave these topics out (repeatable).")
    ] = None,
) -> None:
    """Record the messages of topics into a file, until Ctrl-C."""
    from r2p.recording.recorder import Recorder  # only here, as it takes a while

    path = output or _default_path(session.node.now())
    types = _stated_types(session.settings)
    recorder = Recorder(session.module, path, None if all else topics, exclude=exclude or (), types=types)
    try:
        async with recorder:
            notify(f"recording into {path}; Ctrl-C ends it")
            await asyncio.get_running_loop().create_future()
    except FileExistsError as error:
        raise UsageError(f"{path} is there already, and is not overwritten: give another -o FILE") from error
    finally:
        if recorder.messages:
            notify(f"{sum(recorder.messages.values())} messages in {path}")


def _default_path(now: int) -> Path:
    """Return the name of a recording that begins now (UTC, ns)."""
    return Path(local_time(now, "r2p-%Y%m%d-%H%M%S.mcap"))


def _stated_types(settings: Settings) -> "dict[str, type[r2p.Message]]":
    """Return the types of topics that r2p.toml states."""
    types = Types(settings)
    found = {topic: types.stated(topic, None) for topic in settings.types}
    return {topic: cls for topic, cls in found.items() if cls is not None}
