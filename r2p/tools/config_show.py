"""`r2p config`: the settings of commands in this directory, and where each comes from."""

from pathlib import Path
from typing import Annotated

import typer

from r2p.tools.config import list_settings
from r2p.tools.options import Format, Via
from r2p.tools.output import Output
from r2p.tools.session import group, standalone

app = group("Show the settings, and where they come from.")

File = Annotated[
    Path | None,
    typer.Argument(metavar="FILE", help="Default: the file in R2P_CONFIG, or r2p.toml.", show_default=False),
]
"""A file like r2p.toml, as an argument of a command."""


@app.command("show")
@standalone
async def show(file: File = None, *, via: Via = None, format: Format = None) -> None:
    """Show each setting and its source.

    That is an option, an environment variable, the file, or a default.
    """
    rows = [{"key": each.key, "value": each.value, "source": each.source} for each in list_settings(via, file)]
    await Output(format).table(rows, ["key", "value", "source"])
