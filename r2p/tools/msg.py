"""`r2p msg`: the message types that this computer knows, for firmware as C headers, and to and from ROS."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import typer

import r2p
from r2p.codecs.services import REQUESTS
from r2p.messages import SIZE_MAX
from r2p.tools.c_header import c_header, header_path, with_nested
from r2p.tools.completion import beginning, complete_type, silence
from r2p.tools.options import Format
from r2p.tools.output import Output, notify
from r2p.tools.session import UsageError, group, settings, standalone
from r2p.tools.types import (
    Types,
    class_path,
    is_service,
    load_interface,
    load_service,
    put_sizes,
    size_text,
    standard_types,
    type_name,
)

app = group("Show message types, and exchange them with C and ROS.")

_BOUND = 1000  # of texts and arrays of ROS that have none: small enough for most links

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
    """Show a type: its size, fingerprint, sums in ROS, and fields.

    Of a service, std_srvs/SetBool or a class of your own: its sums in ROS, and the fields of request and response.
    """
    output = Output(format)
    if is_service(type):
        await output.put(_service(type))
        return
    cls = Types(settings()).load(type)
    shape = r2p.layout(cls)
    record = _row(cls) | {
        "fingerprint": shape.fingerprint.hex(),
        "ros1_md5": _of_ros(cls, "ros1_md5"),
        "ros2_hash": _of_ros(cls, "ros2_hash"),
        "fields": _fields(shape),
    }
    if output.format == "text":
        record["size"] = size_text(shape.size, varies=shape.varies)
    await output.put(record)


def _service(text: str) -> dict[str, Any]:
    """Return what `show` prints of a service. Raises UsageError."""
    from r2p.ros.service_types import service_shape, service_type

    known = load_service("service", text)
    sums: list[str | None] = []
    try:
        shape = service_shape(known.requests, known.responses)
        name = shape.name
        sums = [service_type(shape, version).checksum for version in (1, 2)]
    except r2p.MessageError:  # ROS can't define it, or has other fields in a type of that name
        name, sums = known.requests.name.removesuffix(REQUESTS).removesuffix("_Request"), [None, None]
    return {
        "type": name,
        "ros1_md5": sums[0],
        "ros2_hash": sums[1],
        "request_fields": _fields(known.request),
        "response_fields": _fields(known.response),
    }


def _fields(shape: r2p.Layout[Any]) -> dict[str, str]:
    """Return the kind of each field by its path."""
    return {path: kind for path, _, kind in (field.rpartition(":") for field in shape.schema.split())}


def _of_ros(cls: type[r2p.Message], what: str) -> str | None:
    """Return what ROS compares of a type; None for a type that it can't define, or defines in another way."""
    from r2p.ros import library

    try:
        text: str = getattr(library, what)(cls)
    except r2p.MessageError:
        return None
    return text


@app.command("export")
@standalone
async def export(
    types: TypeArguments = None,
    *,
    c: Annotated[
        Path | None, typer.Option("--c", metavar="DIR", help="Where to write C headers.", show_default=False)
    ] = None,
    ros1: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Where to write packages for ROS 1.", show_default=False)
    ] = None,
    ros2: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Where to write packages for ROS 2.", show_default=False)
    ] = None,
) -> None:
    """Write packed C structs of message types, or packages for ROS.

    With --c, each type gets a header, DIR/package/Name.h, in which the compiler checks its size and offsets. Types
    whose length varies have no struct, as firmware's messages have a fixed size.

    With --ros1 or --ros2, DIR/package is one to put into the src of a workspace, with .msg, .srv and .action files.
    Types of ROS's own packages are left out. Bytes and checks of types are those that r2p uses with ROS.
    """
    if c is None and ros1 is None and ros2 is None:
        raise UsageError("where to? give --c DIR for C headers, --ros1 DIR or --ros2 DIR for packages of ROS")
    known = Types(settings())
    interfaces = {text: found for text in types or () if (found := load_interface(text)) is not None}
    chosen = [known.load(text) for text in types or () if text not in interfaces]
    if c is not None:
        if interfaces:
            raise UsageError(f"{next(iter(interfaces))} has no C struct: give the types of its messages")
        _export_c(c, chosen, everything=not types)
    for version, folder in ((1, ros1), (2, ros2)):
        if folder is not None:
            _export_ros(folder, version, chosen if types else _known(), list(interfaces.values()))


def _export_c(folder: Path, classes: list[type[r2p.Message]], *, everything: bool) -> None:
    headers = _headers([cls for cls in _known() if r2p.layout(cls).exact_size] if everything else classes)
    for path, text in headers.items():
        _write(folder / path, text)
    left_out = [type_name(cls) for cls in _known() if r2p.layout(cls).varies]
    if everything and left_out:
        notify(f"left out, as their length varies: {', '.join(left_out)}")
    notify(f"{len(headers)} headers in {folder}: compile with -I {folder}")


def _export_ros(folder: Path, version: int, classes: list[type[r2p.Message]], interfaces: list[Any]) -> None:
    from r2p.ros.packages import packages  # later: commands that need no ROS start faster

    try:
        files = packages(classes, version, interfaces)
    except r2p.MessageError as error:
        raise UsageError(str(error)) from error
    if not files:
        raise UsageError(f"all of these types are in packages that come with ROS {version}")
    for path, text in files.items():
        _write(folder / path, text)
    written = sorted({path.partition("/")[0] for path in files})
    build = "catkin_make" if version == 1 else "colcon build"
    notify(f"{', '.join(written)} in {folder}: put it into the src of a workspace, and run {build}")


def _complete_ros_type(ctx: typer.Context, incomplete: str) -> list[str]:
    """Completions for a type that comes with ROS."""
    with silence():
        from r2p.ros.library import names_of_ros

        return beginning(incomplete, names_of_ros(1 if ctx.params.get("ros1") else 2))
    return []


@app.command("import")
@standalone
async def import_(
    type: Annotated[
        str,
        typer.Argument(
            metavar="TYPE",
            autocompletion=_complete_ros_type,
            show_default=False,
            help="sensor_msgs/Imu, or the path of a .msg, .srv or .action file.",
        ),
    ],
    *,
    ros1: Annotated[bool, typer.Option("--ros1", help="The type as ROS 1 has it; default: ROS 2.")] = False,
    bound: Annotated[
        int,
        typer.Option(
            "--max",
            metavar="N",
            min=1,
            max=SIZE_MAX,
            help="Bound of texts (bytes) and arrays (elements) that have none.",
        ),
    ] = _BOUND,
) -> None:
    """Print a type of ROS as Python classes for r2p.

    They have the bytes of ROS 1.
    Types that r2p.msg has are imported from there. Nested types are looked for beside the package of a file, then among
    those that come with ROS (pip install 'r2p[ros]').
    """
    from r2p.ros.classes import RosTypes
    from r2p.ros.library import DefinitionFile, definitions_of_ros
    from r2p.ros.source import PARTS, source, source_of_parts
    from r2p.ros.type_names import short_name

    version = 1 if ros1 else 2
    suffix = Path(type).suffix
    try:
        if suffix in (".msg", *PARTS):
            names, definitions = DefinitionFile(Path(type)).read(version)
        else:
            names, definitions = [short_name(type)], definitions_of_ros(type, version)
        types = RosTypes(version, definitions)
        classes = [types.load(name) for name in names]
        text = source_of_parts(suffix, classes, definitions, bound) if suffix in PARTS else ""
        typer.echo(text or source(classes, definitions, bound), nl=False)
    except r2p.MessageError as error:
        raise UsageError(str(error)) from error


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
