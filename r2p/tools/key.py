"""`r2p key`: make keys for the links of a robot."""

from pathlib import Path
from typing import Annotated

import typer

from r2p import keys
from r2p.tools.output import notify
from r2p.tools.session import group, standalone

app = group("Make a shared key for links.")


@app.command("new")
@standalone
async def new(file: Annotated[Path, typer.Argument(metavar="FILE", show_default=False)]) -> None:
    """Write a new key to a file that only you can read.

    The key is 32 random bytes; an existing file is never overwritten. Copy the file to each computer that is to have
    the key, and add ?key=FILE to the URLs of the links.
    """
    keys.create(file)
    notify(f"{file} has a new key: copy it to the robot's computers (scp -p), and add ?key={file} to the URLs of links")
