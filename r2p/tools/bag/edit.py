"""`r2p bag cut` and `r2p bag merge`: new recordings from old ones."""

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from r2p.clock import duration
from r2p.tools.bag.files import Exclude, File, Files, Topics, opened, run_steps, selection, size_text
from r2p.tools.bag.times import End, Start, iso, length, shown, span
from r2p.tools.options import Format
from r2p.tools.output import Output, notify
from r2p.tools.session import UsageError
from r2p.units import SECOND

if TYPE_CHECKING:
    from r2p.recording.editing import Edited

OutputFile = Annotated[Path | None, typer.Option("--output", "-o", metavar="FILE", help="The file to write.")]


async def cut(
    file: File,
    *,
    output: OutputFile = None,
    start: Start = None,
    end: End = None,
    topics: Topics = None,
    exclude: Exclude = None,
    latched: Annotated[
        bool, typer.Option("--latched", help="Begin with the last messages of latched topics before the start.")
    ] = False,
    format: Format = None,
) -> None:
    """Write a part of a recording into a new file.

    For example r2p bag cut drive.mcap --start 14:03 --end 14:04 -o crash.mcap. Without -o the new file is
    FILE-cut.mcap. A message that was received at the very instant of --end is not in it.
    """
    from r2p.recording.editing import cut as steps

    path = output or file.with_name(f"{file.stem or 'recording'}-cut.mcap")
    _check_new(path)
    with opened(file) as bag:
        wanted = selection([bag], topics, exclude)
        first, last = span((bag.start, bag.end), start, end)
        if latched and not bag.latched:
            notify("the recording has no latched topics, so --latched adds nothing")
        done = await run_steps(steps(bag, path, start=first, end=last, wanted=wanted, keep_latched=latched))
    await _report(path, done, format)


async def merge(
    files: Files,
    *,
    output: OutputFile = None,
    offset: Annotated[
        list[str] | None,
        typer.Option(
            "--offset",
            metavar="FILE=TIME",
            help="Add this to all times of a file, whose clock was wrong: laptop.mcap=-2.5 (repeatable).",
        ),
    ] = None,
    topics: Topics = None,
    exclude: Exclude = None,
    format: Format = None,
) -> None:
    """Write several recordings into one, in the order of time.

    For example r2p bag merge robot.mcap laptop.mcap -o all.mcap --offset laptop.mcap=-2.5. With --offset, stamps and
    deadlines move as log times do; times inside of messages stay.
    """
    from r2p.recording.editing import merge as steps

    if output is None:
        raise UsageError("merge needs a new file: -o all.mcap")
    if len(files) < 2:
        raise UsageError("merge needs two recordings or more; r2p bag cut makes one file of the parts of one")
    _check_new(output)
    offsets = _offsets(offset, files)
    with contextlib.ExitStack() as stack:
        bags = [stack.enter_context(opened(each)) for each in files]
        wanted = selection(bags, topics, exclude)
        done = await run_steps(steps([(bag, offsets[i]) for i, bag in enumerate(bags)], output, wanted=wanted))
    await _report(output, done, format)


def _check_new(path: Path) -> None:
    if path.exists():
        raise UsageError(f"{path} is there already, and is not overwritten: give another -o FILE")


def _offsets(given: list[str] | None, files: list[Path]) -> list[int]:
    """Return the offset of each file (ns). Raises UsageError."""
    offsets = [0] * len(files)
    for text in given or ():
        name, _, value = text.rpartition("=")
        if Path(name) not in files:
            raise UsageError(f"--offset {text}: write FILE=TIME, with one of the files: {files[0]}=-2.5")
        offsets[files.index(Path(name))] = _nanoseconds(value, text)
    return offsets


def _nanoseconds(value: str, text: str) -> int:
    """Return a duration that may be negative in ns. Raises UsageError."""
    sign, digits = (-1, value[1:]) if value.startswith("-") else (1, value.removeprefix("+"))
    try:
        return sign * round(duration(digits) * SECOND)
    except ValueError:
        raise UsageError(f"--offset {text}: write the time as 2.5, -2.5 or 300ms") from None


async def _report(path: Path, done: "Edited | None", format: Any) -> None:
    """Print what is in the new file."""
    with opened(path) as bag:
        size = sum(each.file.size for each in bag.files)
        record = {
            "file": str(path),
            "size": size,
            "start": iso(bag.start) if bag.start else None,
            "duration": (bag.end - bag.start) / SECOND,
            "topics": len(bag.topics),
            "messages": sum(bag.topics.values()),
        }
        when = f"{length(bag.end - bag.start)} from {shown(bag.start)}" if bag.start else "empty"
    if done is not None and done.unreadable:
        count = done.unreadable
        what = "1 chunk could not be read, and is" if count == 1 else f"{count} chunks could not be read, and are"
        notify(f"{what} missing in {path}")
    topics = f"{record['topics']} topic{'' if record['topics'] == 1 else 's'}"
    text = f"{path} has {record['messages']} messages of {topics}, {when}: {size_text(size)}"
    await Output(format).put(record, text)
