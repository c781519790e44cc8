"""`r2p bag convert`: a recording in another format."""

import asyncio
import functools
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import r2p
from r2p.tools.bag.times import End, Start, span
from r2p.tools.completion import beginning
from r2p.tools.options import Format, topic_pairs, topic_pattern
from r2p.tools.output import Output
from r2p.tools.session import settings
from r2p.tools.types import Types

if TYPE_CHECKING:
    from r2p.recording.convert.formats import ConversionResult


def _complete_format(incomplete: str) -> list[str]:
    from r2p.recording.convert.formats import writable_formats

    return beginning(incomplete, writable_formats())


async def convert(
    source: Annotated[Path, typer.Argument(metavar="IN", help="A file, or a folder; its suffix says what it is.")],
    target: Annotated[Path, typer.Argument(metavar="OUT", help="A file, or a folder, which is rosbag2 without --to.")],
    *,
    to: Annotated[
        str | None,
        typer.Option("--to", metavar="FORMAT", autocompletion=_complete_format, help="The format of OUT."),
    ] = None,
    topics: Annotated[
        list[str] | None,
        typer.Option("--topics", metavar="TOPIC", help="Only these: names, patterns such as 'camera/*' (repeatable)."),
    ] = None,
    type: Annotated[
        list[str] | None,
        typer.Option("--type", metavar="TOPIC=TYPE", help="The type that messages have, or become (repeatable)."),
    ] = None,
    ros: Annotated[
        bool, typer.Option("--ros", help="Standard messages as ROS has them: Odometry as nav_msgs/Odometry.")
    ] = False,
    start: Start = None,
    end: End = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace OUT if it exists.")] = False,
    format: Format = None,
) -> None:
    """Convert a recording into another format.

    The suffix says which: .mcap, .bag (ROS 1), .csv, .parquet, or for CAN frames .log, .blf and .asc; a folder is
    rosbag2, or a table for each topic with --to csv or --to parquet. What the other format has no place for is
    counted and printed.
    """
    from r2p.recording.convert import formats  # only here, as it takes a while
    from r2p.recording.convert.stream import ConversionOptions

    output, types = Output(format), Types(settings())
    extent = formats.extent(source) if start is not None or end is not None else (0, 0)
    first, last = span(extent, start, end) if start is not None or end is not None else (None, None)
    options = ConversionOptions(
        topics=tuple(topic_pattern(each.removeprefix("/"), "--topics") for each in topics or ()),
        start=first,
        end=last,
        types={topic: types.load(text) for topic, text in topic_pairs(type, "--type", "TOPIC=TYPE")},
        known_types=types.stated_topics(),
        ros=ros,
    )
    run = functools.partial(formats.convert, source, target, options, to=to, overwrite=overwrite)
    try:
        result = await _in_thread(run)
    except OSError as error:
        raise r2p.Error(f"can't write {target}: {error.strerror or error}") from error
    await output.put(_record(source, target, result), _text(target, result, formats.lost_in_words(result.losses)))


async def _in_thread(run: Any) -> "ConversionResult":
    """Convert in a thread, so that Ctrl-C ends it at once; what is unfinished is removed."""
    stop = threading.Event()
    try:
        result: ConversionResult = await asyncio.to_thread(run, stopped=stop.is_set)
        return result
    finally:
        stop.set()


def _record(source: Path, target: Path, result: "ConversionResult") -> dict[str, Any]:
    return {
        "in": str(source),
        "out": str(target),
        "format": result.target_format,
        "messages": result.messages,
        "lost": dict(result.losses),
    }


def _text(target: Path, result: "ConversionResult", lost: list[str]) -> str:
    count, topics = sum(result.messages.values()), len(result.messages)
    text = f"{target}: {count} message{'s' * (count != 1)} of {topics} topic{'s' * (topics != 1)}"
    return "\n".join([text, *(["lost:"] if lost else []), *(f"  {each}" for each in lost)])
