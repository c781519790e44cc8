"""`r2p config`: the settings of commands in this directory, and where each comes from."""

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from r2p.parameters.sources import TABLE
from r2p.tools.config import Setting, list_settings
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
    output = Output(format)
    settings = list_settings(via, file)
    written = _as_in_file if output.format == "text" else _unchanged
    rows = [{"key": each.key, "value": written(each), "source": each.source} for each in settings]
    await output.table(rows, ["key", "value", "source"])


def _as_in_file(setting: Setting) -> Any:
    """Write a value as one would in the file: conditions that contain spaces stay apart, and times have their unit.

    The values of parameters have none.
    """
    match setting.value:
        case bool():
            return str(setting.value).lower()
        case float() if setting.key.startswith(f"{TABLE}."):
            return repr(setting.value)
        case float():
            return f"{setting.value:g}s"
        case list() | tuple() if any(" " in str(each) for each in setting.value):
            return ", ".join(json.dumps(str(each)) for each in setting.value)
    return setting.value


def _unchanged(setting: Setting) -> Any:
    return setting.value
