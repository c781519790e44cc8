"""`r2p msg`: the message types that this computer knows, and C headers of them for firmware."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import typer

import r2p
from r2p.tools.c_header import c_header, header_path, with_nested
from r2p.tools.completion import complete_type
from r2p.tools.options import Format
from r2p.tools.output import Output, notify
from r2p.tools.session import UsageError, group, settings, standalone
from r2p.tools.types import Types, class_path, put_sizes, size_text, standard_types, type_name

app = group("Show message types, and export them to C.")

_COLUMNS = ["type", "size", "varies", "class"]

TypeArgument = Annotated[
    str,
    typer.Argument(
        metavar="TYPE",
        autocompletion=complete_type,
        show_default=False,
        help="sensor_msgs/LaserScan, a name in r2p.msg, package.module:Class or FILE.py:Class.",
    ),
]
TypeArguments = Annotated[
    list[str] | None,
    typer.Argument(metavar="TYPE", autocompletion=complete_type, show_default=False, help="Default: all known ones."),
]


@app.command("list")
@standalone
async def list_(*, format: Format = None) -> None:
    """List the types in r2p.msg and those that r2p.toml names."""
    output = Output(format)
    await put_sizes(output, sorted(map(_row, _known()), key=lambda row: str(row["type"])), _COLUMNS)


@app.command("show")
@standalone
async def show(type: TypeArgument, *, format: Format = None) -> None:
    """Show a type: its size, fingerprint and fields."""
    output = Output(format)
    cls = Types(settings()).load(type)
    shape = r2p.layout(cls)
    pairs = (field.rpartition(":") for field in shape.schema.split())
    record = _row(cls) | {
        "fingerprint": shape.fingerprint.hex(),
        "fields": {path: kind for path, _, kind in pairs},
    }
    if output.format == "text":
        record["size"] = size_text(shape.size, varies=shape.varies)
    await output.put(record)


@app.command("export")
@standalone
async def export(
    types: TypeArguments = None,
    *,
    c: Annotated[Path, typer.Option("--c", metavar="DIR", help="Where to write the C headers.", show_default=False)],
) -> None:
    """Write packed C structs of message types.

    Each gets a header, DIR/package/Name.h, in which the compiler checks its size and offsets. Types whose length varies
    have no struct, as firmware's messages have a fixed size.
    """
    known = Types(settings())
    classes = [known.load(text) for text in types or ()] or [cls for cls in _known() if r2p.layout(cls).exact_size]
    headers = _headers(classes)
    for path, text in headers.items():
        _write(c / path, text)
    left_out = [type_name(cls) for cls in _known() if r2p.layout(cls).varies]
    if not types and left_out:
        notify(f"left out, as their length varies: {', '.join(left_out)}")
    notify(f"{len(headers)} headers in {c}: compile with -I {c}")


def _write(path: Path, text: str) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    except OSError as error:
        raise r2p.Error(f"can't write {path}: {error.strerror}") from error


def _known() -> list[type[r2p.Message]]:
    return list(dict.fromkeys([*standard_types(), *Types(settings()).named]))


def _row(cls: type[r2p.Message]) -> dict[str, Any]:
    shape = r2p.layout(cls)
    return {"type": type_name(cls), "size": shape.size, "varies": shape.varies, "class": class_path(cls)}


def _headers(classes: Iterable[type[r2p.Message]]) -> dict[str, str]:
    """Return the headers of classes, and of what is nested in them, by path. Raises UsageError."""
    headers: dict[str, str] = {}
    for cls in classes:
        for shape in with_nested(r2p.layout(cls)):
            path, text = header_path(shape), _header(shape)
            if headers.setdefault(path, text) != text:
                raise UsageError(
                    f"two different types are named {shape.name}: give one another name, as in "
                    f'`class {shape.cls.__name__}(r2p.Message, name="my_msgs/{shape.cls.__name__}")`'
                )
    return headers


def _header(shape: Any) -> str:
    try:
        return c_header(shape)
    except r2p.MessageError as error:
        raise UsageError(str(error)) from error
