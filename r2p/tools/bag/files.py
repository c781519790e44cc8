"""What the commands on recordings share: the file as an argument, patterns of topics, sizes, and steps of long work."""

import asyncio
import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

from r2p.tools.session import UsageError

if TYPE_CHECKING:
    from collections.abc import Generator, Iterator

    from r2p.recording.bag import Bag
    from r2p.recording.editing import ChannelSelection

T = TypeVar("T")

File = Annotated[
    Path,
    typer.Argument(
        metavar="FILE", help="A recording, a directory of its parts, or a pattern: 'drive-*.mcap'.", show_default=False
    ),
]
Files = Annotated[list[Path], typer.Argument(metavar="FILE", help="Recordings, two or more.", show_default=False)]
Topics = Annotated[
    list[str] | None,
    typer.Option("--topics", metavar="PATTERN", help="Only these: odometry, 'camera/*', /can0/frames (repeatable)."),
]
Exclude = Annotated[
    list[str] | None, typer.Option("--exclude", metavar="PATTERN", help="Leave these out (repeatable).")
]


@contextlib.contextmanager
def opened(path: Path) -> "Iterator[Bag]":
    """Open a recording. Raises r2p.BagError."""
    import r2p

    with r2p.Bag(path) as bag:
        yield bag


def selection(bags: "list[Bag]", topics: list[str] | None, exclude: list[str] | None) -> "ChannelSelection":
    """Return the channels that the options choose. Raises UsageError for a name or pattern that matches none."""
    from r2p.recording.editing import ChannelSelection

    chosen = ChannelSelection(topics or None, exclude or ())
    channels = [channel for bag in bags for channel in bag.channels]
    for each in chosen.unmatched(channels):
        names = ", ".join(sorted({name for bag in bags for name in bag.topics})[:20]) or "none"
        raise UsageError(f"{each} is neither a topic nor a channel of the recording; its topics: {names}")
    return chosen


async def run_steps(steps: "Generator[T, None, None]") -> T | None:
    """Do all steps of long work, with a look at the event loop after each, and return the last result.

    Ctrl-C ends it between two steps.
    """
    result: T | None = None
    with contextlib.closing(steps):
        for each in steps:
            result = each
            await asyncio.sleep(0)
    return result


def size_text(size: int) -> str:
    """Return bytes in words: 312 B, 4.2 kB, 1.0 GB."""
    value = float(size)
    for unit in ("B", "kB", "MB", "GB"):
        if value < 1000 or unit == "GB":
            break
        value /= 1000
    return f"{size} B" if unit == "B" else f"{value:.3g} {unit}" if value < 1000 else f"{value:.0f} {unit}"
