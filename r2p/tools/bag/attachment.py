"""`r2p bag attachment`: the files in a recording, such as `r2p.toml` and `parameters.toml` as they were then."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import r2p
from r2p.tools.bag.files import File, opened
from r2p.tools.bag.times import iso
from r2p.tools.options import Format
from r2p.tools.output import Output, notify
from r2p.tools.session import UsageError

if TYPE_CHECKING:
    from r2p.recording.bag_file import Attachment

_COLUMNS = ["name", "type", "size", "time"]


async def attachment(
    file: File,
    name: Annotated[
        str | None, typer.Argument(metavar="NAME", help="The file in it; default: list them.", show_default=False)
    ] = None,
    *,
    target: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="OUT", help="Write it there, byte for byte.")
    ] = None,
    format: Format = None,
) -> None:
    """List the files in a recording, or print one of them.

    `r2p run --params` reads the parameters.toml of a recording.
    """
    if target is not None and (name is None or target.exists()):
        reason = "name the file to write" if name is None else f"{target} exists, and is not overwritten"
        raise UsageError(f"-o: {reason}")
    with opened(file) as bag:
        found = {each.name: each for each in bag.attachments()}  # of those with one name, the last
    if name is None:
        await Output(format).table(map(_row, found.values()), _COLUMNS)
        if not found:
            notify(f"{file} has no attachments")
        return
    if name not in found:
        raise UsageError(f"{file} has no attachment {name}; it has {', '.join(found) or 'none'}")
    if target is not None:
        try:
            target.write_bytes(found[name].data)
        except OSError as error:
            raise r2p.Error(f"can't write {target}: {error.strerror}") from error
        return
    await _print(found[name])


async def _print(attachment: "Attachment") -> None:
    try:
        text = attachment.data.decode()
    except UnicodeDecodeError:
        raise UsageError(f"{attachment.name} is not text: write it to a file with -o OUT") from None
    output = Output()
    output.format = "text"  # in a pipe, too: it is a file
    await output.put({}, text.rstrip("\n"))


def _row(attachment: "Attachment") -> dict[str, object]:
    return {
        "name": attachment.name,
        "type": attachment.media_type,
        "size": len(attachment.data),
        "time": iso(attachment.time),
    }
