"""`r2p bag recover`: make a recording whole that was cut off or damaged."""

import asyncio
import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from r2p.errors import BagError
from r2p.tools.options import Format
from r2p.tools.output import Output, notify
from r2p.tools.session import UsageError

if TYPE_CHECKING:
    from r2p.recording.recovery import RecoveryReport


async def recover(
    file: Annotated[Path, typer.Argument(metavar="FILE", show_default=False, help="The recording.")],
    *,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FILE", help="Default: FILE-recovered.mcap beside it.")
    ] = None,
    format: Format = None,
) -> None:
    """Write what can be read of a damaged recording into a new file.

    For a recording whose recorder was killed, or whose computer lost power, and for damaged files of other programs.
    """
    from r2p.recording.recovery import RecoveryReport, recover_in_steps  # only here, as it takes a while

    path = output or file.with_name(f"{file.stem}-recovered.mcap")
    report = RecoveryReport()
    with _explained(path), contextlib.closing(recover_in_steps(file, path)) as steps:
        for report in steps:  # noqa: B007 - the last one counts
            await asyncio.sleep(0)  # Ctrl-C
    if report.complete:
        notify(f"{file} is complete: there is nothing to recover")
        return
    for text in _remarks(report):
        notify(f"{file}: {text}")
    found = {
        "file": str(path),
        "messages": report.messages,
        "channels": report.channels,
        "seconds": report.seconds,
        "attachments": report.attachments,
        "unreadable_bytes": report.unreadable,
        "damaged": report.damaged,
        "without_channel": report.without_channel,
    }
    text = f"{path} has {report.messages} messages of {report.channels} channels, over {report.seconds:.3f} s"
    await Output(format).put(found, text)


@contextlib.contextmanager
def _explained(path: Path) -> Iterator[None]:
    try:
        yield
    except FileExistsError as error:
        raise UsageError(f"{path} is there already, and is not overwritten: give another -o FILE") from error
    except OSError as error:
        raise BagError(f"can't write {path}: {error.strerror}") from error


def _remarks(report: "RecoveryReport") -> Iterator[str]:
    """Say what is not in the new file."""
    if report.unreadable:
        count = report.unreadable
        yield f"{count} byte{'s' * (count != 1)} could not be read, as it was cut off or is damaged"
    elif not report.damaged:
        yield "its end is missing; all messages that were in it are recovered"
    if report.damaged:
        yield "1 damaged part is left out" if report.damaged == 1 else f"{report.damaged} damaged parts are left out"
    if report.without_channel:
        count = report.without_channel
        what = "1 message is left out, as its" if count == 1 else f"{count} messages are left out, as their"
        yield f"{what} channel is missing in the file"
