"""Messages as text, in both directions: `pub` accepts what `echo` prints.

A value gets its type from the field of the message, never from how it is written: all YAML scalars are read as texts.
So `1e-3` is a number, the key `on` is a text, and "nan" in quotes, as JSON needs it, is still not-a-number.
"""

import json
import math
import re
import struct
from collections.abc import Iterable, Mapping
from typing import Any, TypeVar

from r2p.errors import MessageError
from r2p.messages import Chars, FixedArray, Layout, Message, Nested, Scalar, Shape, layout, show

M = TypeVar("M", bound=Message)

META = "_"
"""The key of a message's context: its topic, stamp, source."""

DEPTH = 32
"""Levels of mappings and lists that are accepted; no message has as many."""

_EXCERPT = 80  # characters of a text in an error
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


def to_plain(message: Message) -> dict[str, Any]:
    """Return a message as values for JSON: NaN and infinities as texts, an f32 as its shortest decimal."""
    shape = layout(type(message))
    return {field.name: _plain(field.shape, getattr(message, field.name)) for field in shape.fields}


def pick(plain: Mapping[str, Any], path: str) -> Any:
    """Return the value at a path: `stamp.sec`, `value[0]`. Raises KeyError with the existing paths."""
    value: Any = plain
    for step in _STEP.findall(path):
        if isinstance(value, Mapping) and step in value:
            value = value[step]
        elif isinstance(value, list) and step.isdecimal() and int(step) < len(value):
            value = value[int(step)]
        else:
            raise KeyError(f"there is no field {path[:_EXCERPT]}; the fields are {', '.join(_names(plain))}")
    return value


def _names(plain: Mapping[str, Any]) -> list[str]:
    """Return the paths of all fields, for an error."""
    names: list[str] = []
    for name, value in plain.items():
        inner = _names(value) if isinstance(value, Mapping) else []
        names += [f"{name}.{each}" for each in inner] or [name]
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
        raise MessageError(f"{_excerpt(text)} is not valid {_problem(text, error)}") from error


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
    kind: Shape = Nested(shape)
    for name in path.split("."):
        fields = {field.name: field.shape for field in kind.layout.fields} if isinstance(kind, Nested) else {}
        if name not in fields:
            return False
        kind = fields[name]
    return isinstance(kind, Chars)


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
    fields = {field.name: field.shape for field in shape.fields}
    unknown = [name for name in plain if name not in fields]
    if unknown:
        raise MessageError(f"{path} has no field {', '.join(unknown)}: it has {', '.join(fields)}")
    given = {name: _value(fields[name], value, f"{path}.{name}") for name, value in plain.items()}
    zero = shape.zero
    rest = {name: getattr(zero, name) for name in fields if name not in given}
    return shape.cls(**given, **rest)


def _value(shape: Shape, plain: Any, path: str) -> Any:
    match shape:
        case Nested(inner) if isinstance(plain, Mapping):
            return _message(inner, plain, path)
        case FixedArray(item, count) if isinstance(plain, list) and len(plain) == count:
            return tuple(_value(item, each, f"{path}[{i}]") for i, each in enumerate(plain))
        case Chars():
            value: Any = plain if isinstance(plain, str) else _invalid
        case Scalar():
            value = _number(shape, plain)
        case _:
            value = _invalid
    if value is _invalid or (isinstance(shape, Scalar | Chars) and not shape.holds(value)):
        raise MessageError(f"{path} takes {_wanted(shape)}, not {_shown(plain)}")
    return value


_invalid = object()


def _wanted(shape: Shape) -> str:
    match shape:
        case Nested(inner):
            return "a mapping of " + ", ".join(field.name for field in inner.fields)
        case FixedArray(_, count):
            return f"a list of {count}"
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
    """Return the number or bool of a YAML text or a JSON value; `_invalid` if it is none."""
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


def _plain(shape: Shape, value: Any) -> Any:
    match shape:
        case Nested(inner):
            return {field.name: _plain(field.shape, getattr(value, field.name)) for field in inner.fields}
        case FixedArray(item, _):
            return [_plain(item, each) for each in value]
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
