"""Messages as text, in both directions: `pub` accepts what `echo` prints.

A value gets its type from the field of the message, never from how it is written: all YAML scalars are read as texts.
So `1e-3` is a number, the key `on` is a text, and "nan" in quotes, as JSON needs it, is still not-a-number. Bytes whose
number varies, such as those of an image, are a text in base64; a list of numbers is accepted, too.
"""

import base64
import binascii
import json
import math
import re
import struct
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal, TypeAlias, TypeVar

from r2p.errors import MessageError
from r2p.messages import (
    Array,
    Chars,
    Field,
    FixedArray,
    Layout,
    Message,
    Nested,
    Scalar,
    Shape,
    VariableArray,
    VariableText,
    layout,
    show,
)
from r2p.messages.parts import view_of

M = TypeVar("M", bound=Message)

Form: TypeAlias = Literal["whole", "short", "cells"]
"""How much of a message is converted, for whom: all of it for programs; for people only the first elements of long
arrays; and for the cells of a table, in which an array of variable length is one text, as JSON has it."""

META = "_"
"""The key of a message's context: its topic, stamp, source."""

DEPTH = 32
"""Levels of mappings and lists that are accepted; no message has as many."""

_EXCERPT = 80  # characters of a text in an error
_LONG = 16  # elements of an array that are all shown; of a longer one:
_FIRST = 8
_LONG_TEXT = 1000  # characters of a text that are all shown; of a longer one:
_FIRST_TEXT = 200
_INDEX_DIGITS = 9
_PAIR = re.compile(r"([A-Za-z_][\w.]*)=(.*)", re.DOTALL)
_STEP = re.compile(r"[^.\[\]]+")
_TRUE = {"true", "yes", "on", "1"}
_FALSE = {"false", "no", "off", "0"}
_SMALLEST_NORMAL = 2.0**-126


def parse(cls: type[M], texts: Iterable[str]) -> M:
    """Parse YAML or JSON mappings and `x=1.5` pairs to a message; later ones win, and missing fields are zero.

    The name of a pair may be a path into a nested message (`stamp.sec=5`). Raises MessageError, also for YAML aliases,
    with which a short text could take all memory.
    """
    plain: dict[str, Any] = {}
    shape = layout(cls)
    for text in texts:
        pair = _PAIR.fullmatch(text.strip())
        if pair is None:
            _merge(plain, _mapping(text))
        else:
            path, value = pair.groups()
            _merge(plain, {path: value if _is_text(shape, path) else _yaml(value)})
    return from_plain(cls, plain)


def parse_line(cls: type[M], line: str) -> M:
    """Parse one line of a stream: JSON as `echo` prints it, otherwise as in `parse`. Raises MessageError."""
    if line.lstrip().startswith("{"):
        try:
            plain = json.loads(line)
        except (ValueError, RecursionError):
            return parse(cls, [line])
        return from_plain(cls, plain)
    return parse(cls, [line])


def from_plain(cls: type[M], plain: Mapping[str, Any]) -> M:
    """Return the message of a mapping of plain values; a key may be a path (`stamp.sec`). Raises MessageError."""
    nested: dict[str, Any] = {}
    _merge(nested, {name: value for name, value in plain.items() if name != META})
    message: M = _message(layout(cls), nested, cls.__name__)
    return message


def to_plain(message: Message, form: Form = "whole") -> dict[str, Any]:
    """Return a message as values for JSON: NaN and infinities as texts, an f32 as its shortest decimal."""
    plain: dict[str, Any] = _plain(Nested(layout(type(message))), message, form)
    return plain


def flatten(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return the leaves of a record by path: "stamp.sec", "value[0]"."""
    leaves: dict[str, Any] = {}

    def visit(path: str, value: Any) -> None:
        if isinstance(value, Mapping):
            for name, inner in value.items():
                visit(f"{path}.{name}" if path else name, inner)
        elif isinstance(value, list | tuple):
            for i, inner in enumerate(value):
                visit(f"{path}[{i}]", inner)
        else:
            leaves[path] = value

    visit("", record)
    return leaves


def pick(message: Message, path: str, form: Form = "whole") -> Any:
    """Return the value at a path: `stamp.sec`, `value[0]`. None for an element that an array of this length lacks.

    Raises KeyError with the existing paths.
    """
    shape, value = _at(Nested(layout(type(message))), message, _STEP.findall(path))
    if shape is None:
        names = ", ".join(_names(layout(type(message))))
        each = ", one --field for each" if "," in path else ""
        raise KeyError(f"there is no field {path[:_EXCERPT]}; the fields are {names}{each}")
    return None if value is None else _plain(shape, value, form)


def _at(shape: Shape, value: Any, steps: list[str]) -> tuple[Shape | None, Any]:
    """Return the shape and the value that these steps lead to; no shape for a place that does not exist."""
    for step in steps:
        index = int(step) if step.isdecimal() and len(step) <= _INDEX_DIGITS else -1
        match shape:
            case Nested(inner) if (field := find_field(inner, step)) is not None:
                shape, value = field.shape, None if value is None else getattr(value, field.name)
            case FixedArray(item, count) | VariableArray(item, count) if 0 <= index < count:
                shape, value = item, None if value is None or index >= len(value) else value[index]
            case _:
                return None, None
    return shape, value


def find_field(shape: Layout[Any], name: str) -> Field | None:
    """Return the field of this name: that of the class, or the one on the wire."""
    return next((field for field in shape.fields if name in (field.wire_name, field.name)), None)


def _names(shape: Layout[Any]) -> list[str]:
    """Return the paths of all fields, for an error."""
    names: list[str] = []
    for field in shape.fields:
        inner = _names(field.shape.layout) if isinstance(field.shape, Nested) else []
        names += [f"{field.wire_name}.{each}" for each in inner] or [field.wire_name]
    return names


# Text to values


def _yaml(text: str) -> Any:
    """Parse YAML with all scalars as texts. Its events are checked first: building it could exhaust memory or stack."""
    import yaml

    loader: Any = getattr(yaml, "CBaseLoader", yaml.BaseLoader)
    depth = 0
    try:
        for event in yaml.parse(text, Loader=loader):
            if isinstance(event, yaml.AliasEvent):
                raise MessageError(f"{_excerpt(text)} has an alias, *{event.anchor}: write out what it stands for")
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > DEPTH:
                raise _too_deep(text)
        return yaml.load(text, Loader=loader)
    except (yaml.YAMLError, UnicodeError) as error:
        if (plain := _json(text)) is not None:
            return plain
        if "nesting depth" in str(error):  # newer libyaml looks ahead, and has a limit of its own
            raise _too_deep(text) from error
        raise MessageError(f"{_excerpt(text)} is not valid {_problem(text, error)}") from error


def _json(text: str) -> Any:
    """Return the mapping of a JSON text; None for others. YAML does not read JSON with a pair of surrogates."""
    try:
        return json.loads(text) if text.lstrip().startswith("{") else None
    except (ValueError, RecursionError):
        return None


def _problem(text: str, error: Exception) -> str:
    """Say what is wrong with a text that is neither YAML nor JSON, and where."""
    if text.lstrip().startswith('{"'):  # as JSON is written
        try:
            json.loads(text)
        except json.JSONDecodeError as problem:
            return f"JSON: {problem.msg[:1].lower()}{problem.msg[1:]}{_place(text, problem.pos)}"
        except RecursionError:
            pass
    mark = getattr(error, "problem_mark", None)
    place = "" if mark is None else _place(text, mark.index)
    return f"YAML: {getattr(error, 'problem', None) or error}{place}"


def _place(text: str, index: int) -> str:
    """Return the place of a character in a text, for the end of an error."""
    if index >= len(text.rstrip()):
        return " at its end"
    before = text[:index].split("\n")
    line = f" in line {len(before)}" if "\n" in text.strip() else ""
    return f" at character {len(before[-1]) + 1}{line}"


def _excerpt(text: str) -> str:
    """Return the start of a text, for an error."""
    return repr(text if len(text) <= _EXCERPT else f"{text[:_EXCERPT]}...")


def _too_deep(text: str) -> MessageError:
    return MessageError(f"{_excerpt(text)} is nested more than {DEPTH} levels deep: no message is")


def _mapping(text: str) -> dict[str, Any]:
    value = _yaml(text)
    if not isinstance(value, dict) or not all(isinstance(key, str) for key in value):
        raise MessageError(f"{_excerpt(text)} is not a message: write '{{x: 1.5, w: 0.25}}' or x=1.5 w=0.25")
    return value


def _is_text(shape: Layout[Any], path: str) -> bool:
    """Return whether the path is that of a text field, whose value is used as it is."""
    found, _ = _at(Nested(shape), None, path.split("."))
    return isinstance(found, Chars | VariableText)


def _merge(into: dict[str, Any], plain: Mapping[str, Any], depth: int = 0) -> None:
    """Add values to `into`, with keys that are paths split; `depth` is that of `into`."""
    for path, value in plain.items():
        *parents, name = path.split(".")
        inside = depth + len(parents) + 1
        if inside > DEPTH:
            raise _too_deep(path)
        place = into
        for parent in parents:
            inner = place.setdefault(parent, {})
            if not isinstance(inner, dict):
                raise MessageError(f"{path}: {parent} already has a value")
            place = inner
        if isinstance(value, Mapping) and isinstance(place.get(name, {}), dict):
            _merge(place.setdefault(name, {}), value, inside)
        else:
            place[name] = value


def _message(shape: Layout[Any], plain: Mapping[str, Any], path: str) -> Any:
    fields = {name: find_field(shape, name) for name in plain}
    unknown = [name for name, field in fields.items() if field is None]
    if unknown:
        names = ", ".join(field.wire_name for field in shape.fields) or "none at all"
        raise MessageError(f"{path} has no field {', '.join(unknown)}: it has {names}")
    given = {
        field.name: _value(field.shape, plain[name], f"{path}.{name}")
        for name, field in fields.items()
        if field is not None
    }
    zero = shape.zero
    rest = {field.name: getattr(zero, field.name) for field in shape.fields if field.name not in given}
    return shape.cls(**given, **rest)


def _value(shape: Shape, plain: Any, path: str) -> Any:
    match shape:
        case Nested(inner) if isinstance(plain, Mapping):
            return _message(inner, plain, path)
        case FixedArray() | VariableArray():
            value = _elements(shape, _bytes(plain) if is_octets(shape) and isinstance(plain, str) else plain, path)
        case Chars() | VariableText():
            value = plain if isinstance(plain, str) else _invalid
        case Scalar():
            value = _number(shape, plain)
        case _:
            value = _invalid
    if value is _invalid or (isinstance(shape, Scalar | Chars | VariableText) and not shape.holds(value)):
        raise MessageError(f"{path} takes {_wanted(shape)}, not {_shown(plain)}")
    return value


def _elements(shape: FixedArray | VariableArray, plain: Any, path: str) -> Any:
    """Return the value of an array; `_invalid` for what is neither a list nor bytes, or has another length."""
    least, most = (shape.count, shape.count) if isinstance(shape, FixedArray) else (0, shape.limit)
    if not isinstance(plain, list | bytes) or not least <= len(plain) <= most:
        return _invalid
    values: Sequence[Any] = plain
    if isinstance(plain, list):
        values = tuple(_value(shape.item, each, f"{path}[{i}]") for i, each in enumerate(plain))
    match shape.container, shape.item:
        case "bytes", _:
            return bytes(values)
        case "array", Scalar(_, code):
            return Array(view_of(values, code))
        case _:
            return tuple(values)


def is_octets(shape: Shape) -> bool:
    """Return whether a field is an array of u8, such as the bytes of an image."""
    return isinstance(shape, FixedArray | VariableArray) and shape.item == _BYTE


def _bytes(text: str) -> Any:
    """Return the bytes of a text in base64; `_invalid` for any other text."""
    try:
        return base64.b64decode("".join(text.split()), validate=True)
    except (binascii.Error, ValueError):
        return _invalid


_BYTE = Scalar("u8", "B")
_invalid = object()


def _wanted(shape: Shape) -> str:
    match shape:
        case Nested(inner):
            return "a mapping of " + ", ".join(field.wire_name for field in inner.fields)
        case FixedArray(_, count):
            return f"a list of {count}"
        case VariableArray(_, limit):
            return f"a list of at most {limit}{', or their base64' if is_octets(shape) else ''}"
        case Scalar("bool"):
            return "true or false"
        case _:
            return shape.allowed


def _shown(plain: Any) -> str:
    if isinstance(plain, list):
        return f"a list of {len(plain)}"
    if isinstance(plain, Mapping):
        return "a mapping"
    return "nothing" if plain is None else show(plain)


def _number(shape: Scalar, plain: Any) -> Any:
    """Return the number or bool of a YAML text or a JSON value; `_invalid` for any other text."""
    if shape.kind == "bool":
        text = str(plain).lower()
        return True if text in _TRUE else False if text in _FALSE else _invalid
    if isinstance(plain, bool) or not isinstance(plain, int | float | str):
        return _invalid
    try:
        return _float(plain) if shape.kind in {"f32", "f64"} else _integer(plain)
    except (ValueError, OverflowError):
        return _invalid


def _float(plain: float | str) -> float:
    if isinstance(plain, str):
        plain = re.sub(r"^([+-]?)\.(?=[a-z])", r"\1", plain.strip().lower())  # YAML's .nan and .inf
    return float(plain)


def _integer(plain: float | str) -> int:
    """Parse 5, 0x1f, 5.0 and 1e3. Raises ValueError for anything else."""
    if isinstance(plain, str):
        text = plain.strip()
        for base in (10, 0):
            try:
                return int(text, base)
            except ValueError:
                continue
        plain = float(text)
    if not math.isfinite(plain) or plain != int(plain):
        raise ValueError
    return int(plain)


# Values to text


def _plain(shape: Shape, value: Any, form: Form) -> Any:
    match shape:
        case Nested(inner):
            return {field.wire_name: _plain(field.shape, getattr(value, field.name), form) for field in inner.fields}
        case VariableArray() if is_octets(shape) and (form != "short" or len(value) > _LONG):
            return f"<bytes {len(value)}>" if form == "short" else base64.b64encode(bytes(value)).decode()
        case VariableArray(item) if form == "cells":
            return json.dumps([_plain(item, each, "whole") for each in value])
        case FixedArray(item) | VariableArray(item):
            shown = _FIRST if form == "short" and len(value) > _LONG else len(value)
            more = [f"and {len(value) - shown} more"] if shown < len(value) else []
            return [_plain(item, each, form) for each in value[:shown]] + more
        case VariableText() if form == "short" and len(value) > _LONG_TEXT:
            return f"{value[:_FIRST_TEXT]}... ({len(value)} characters)"
        case Scalar("f32" | "f64" as kind):
            if not math.isfinite(value):
                return str(float(value))
            return shortest_f32(value) if kind == "f32" else float(value)
        case _:
            return value


def shortest_f32(value: float) -> float:
    """Return the float with the shortest decimal text that packs to the same four bytes."""
    packed = struct.pack("<f", value)
    exact = struct.unpack("<f", packed)[0]
    for digits in range(6 if abs(exact) >= _SMALLEST_NORMAL else 1, 9):
        for candidate in _decimals(exact, digits):
            if struct.pack("<f", candidate) == packed:
                return candidate
    return float(f"{exact:.9g}")


def _decimals(value: float, digits: int) -> Iterable[float]:
    """Yield the nearest decimal with this many digits, and its neighbours at a power of two.

    Below a power of two floats are denser, so the nearest decimal need not be the one that packs to the same bytes.
    """
    nearest = f"{value:.{digits - 1}e}"
    yield float(nearest)
    if abs(math.frexp(value)[0]) == 0.5:
        mantissa, exponent = nearest.split("e")
        unit = int(mantissa.replace(".", ""))
        for neighbour in (unit - 1, unit + 1):
            yield float(f"{neighbour}e{int(exponent) - digits + 1}")
