"""Messages that real ROS 1 and ROS 2 programs have serialised (tests/golden/ros; `about` in each file says how)."""

import functools
import json
import re
from pathlib import Path
from typing import Annotated, Any

import r2p
from r2p.messages import SIZE_MAX, Duration, Timestamp
from r2p.messages.shapes import FixedArray, Nested, Scalar, Shape, VariableArray
from r2p.ros.classes import RosTypes
from r2p.ros.definitions import MessageDefinition, parse, parse_action, parse_service
from r2p.ros.type_names import short_name

GOLDEN = Path(__file__).parents[1] / "golden" / "ros"

_IDL = {"boolean": "bool", "octet": "byte", "float": "float32", "double": "float64"}
"""Names that generated Python classes of ROS 2 have for types of .msg files."""


@functools.cache
def recorded(version: int) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((GOLDEN / f"ros{version}_messages.json").read_text())
    return found


@functools.cache
def definitions(version: int) -> dict[str, MessageDefinition]:
    """All definitions in the file, also those of parts of services and actions."""
    data = recorded(version)
    found: dict[str, MessageDefinition] = {}
    if version == 1:
        for name, entry in data["types"].items():
            found |= parse(name, entry["definition"])
        return found
    for name, entry in data["types"].items():
        found |= _from_fields(name, entry["fields"])
    for name, entry in data["nested_definitions"].items():
        found |= parse(name, entry["definition"])
    for entry in [*data["message_hashes"], *({"type": name, **each} for name, each in data["types"].items())]:
        if entry.get("definition") is not None and "/msg/" in entry["type"]:
            found |= parse(entry["type"], entry["definition"])
    for entry in data["service_hashes"]:
        found |= {part.name: part for part in parse_service(entry["type"], entry["definition"])}
    for entry in data["action_hashes"]:
        found |= {part.name: part for part in parse_action(entry["type"], entry["definition"])}
    return found


def _from_fields(name: str, fields: list[list[str]]) -> dict[str, MessageDefinition]:
    """The definition of a type of which there are only the fields of its class, as in `sequence<int32, 3>`."""
    lines = []
    for field, text in fields:
        sequence = re.fullmatch(r"sequence<(.+?)(?:, ([0-9]+))?>", text)
        base, bound = (sequence[1], f"[<={sequence[2]}]" if sequence[2] else "[]") if sequence else (text, "")
        base = re.sub(r"(w?string)<([0-9]+)>", r"\1<=\2", base)
        array = re.fullmatch(r"(.+)(\[[0-9]+\])", base)
        base, bound = (array[1], array[2]) if array else (base, bound)
        lines.append(f"{_IDL.get(base, base)}{bound} {field}")
    return parse(name, "\n".join(lines))


@functools.cache
def types(version: int) -> RosTypes:
    """The types, without those of r2p.msg, whose bounds are narrower than ROS's."""
    return RosTypes(version, definitions(version), known={"std_msgs/Header": Header})


def class_of(version: int, name: str) -> type[r2p.Message]:
    return types(version).load(short_name(name))


class Header(r2p.Message, name="std_msgs/Header"):
    """As that of r2p.msg, with a frame id of any length."""

    seq: r2p.u32 = 0
    stamp: Timestamp = Timestamp()
    frame_id: Annotated[str, r2p.Max(SIZE_MAX)] = ""


def message(cls: type[r2p.Message], value: dict[str, Any]) -> r2p.Message:
    """The message of a recorded value."""
    made: r2p.Message = _convert(value, Nested(r2p.layout(cls)))
    return made


def _convert(value: Any, shape: Shape) -> Any:
    match shape:
        case Nested(inner) if inner.cls in (Timestamp, Duration):
            return _time(inner.cls, *value.values())
        case Nested(inner):
            fields = {field.name: field for field in inner.fields if field.wire_name in value}
            return inner.cls(**{key: _convert(value[each.wire_name], each.shape) for key, each in fields.items()})
        case Scalar(kind) if kind.startswith("f"):
            return float.fromhex(value)
        case FixedArray(item, _, container) | VariableArray(item, _, container):
            items = bytes.fromhex(value["hex"]) if isinstance(value, dict) else [_convert(each, item) for each in value]
            return bytes(items) if container == "bytes" else tuple(items)
        case _:
            return value


def _time(cls: Any, sec: int, nsec: int) -> r2p.Message:
    """A time; those of ROS 2 have signed seconds, and unsigned nanoseconds also in a duration."""
    if cls is Timestamp:
        return Timestamp(sec=sec % 2**32, nsec=nsec)
    return Duration(sec=sec, nsec=(nsec + 2**31) % 2**32 - 2**31)
