"""The values that parameters have: their kinds, what converts to them, and their limits of size.

A value is of the type of its parameter's default. Outside of its node (in files, options and on the wire) a member of
an enum is its name; all others are the same everywhere.
"""

import enum
import math
from collections.abc import Callable
from typing import Any

from r2p.codecs.parameters import ParameterKind, Plain
from r2p.errors import ParameterError

TEXT_MAX = 128
"""Bytes of a text value in UTF-8."""
NUMBERS_MAX = 16
"""Numbers of a tuple."""
CHOICES_MAX = 64
"""Members of an enum; the name of each has at most CHOICE_MAX bytes."""
CHOICE_MAX = 64

_INT_MIN, _INT_MAX = -(1 << 63), (1 << 63) - 1
_SHOWN_MAX = 40  # characters of a value that an error shows


def kind_of(default: object) -> ParameterKind:
    """Return the kind of parameter that has this default. Raises ParameterError, which says what is possible."""
    match default:
        case enum.Flag():
            pass
        case enum.Enum():  # before int and str, which its class may also be
            return ParameterKind.ENUM
        case bool():
            return ParameterKind.BOOL
        case int():
            return ParameterKind.INT
        case float():
            return ParameterKind.FLOAT
        case str():
            return ParameterKind.STR
        case tuple() if default:
            return _kind_of_tuple(default)
    hint = ": write a tuple" if isinstance(default, list) else ""
    raise ParameterError(
        f"a default of {shown(default)} has no type of parameter{hint}; possible are bool, int, float, str, members of "
        "an enum, and tuples of numbers"
    )


def _kind_of_tuple(default: tuple[object, ...]) -> ParameterKind:
    kinds = {type(each) for each in default}
    if kinds == {int}:
        return ParameterKind.INTS
    if kinds == {float}:
        return ParameterKind.FLOATS
    if kinds == {int, float}:
        raise ParameterError(f"a default of {shown(default)} mixes int and float: write all of its numbers as floats")
    raise ParameterError(f"a default of {shown(default)}: the elements of a tuple are all int or all float")


def convert(kind: ParameterKind, value: object, *, like: Any) -> Any:
    """Convert a value to the kind of a parameter whose default is `like`.

    An int converts to a float, a list to a tuple, and a name to the member of an enum. Raises ParameterError with the
    reason.
    """
    return _CONVERTERS[kind](value, like)


def plain(value: Any) -> Plain:
    """Return a value as it is outside of its node."""
    return value.name if isinstance(value, enum.Enum) else value


def outside(value: object) -> Any:
    """Return a value as another module can send it: a member of an enum as its name, a list as a tuple."""
    return tuple(value) if isinstance(value, list) else plain(value)


def parse(kind: ParameterKind, text: str) -> object:
    """Return what a text of the command line stands for: `0.7`, `true`, `1,2,3`, `AUTO`. Raises ParameterError."""
    match kind:
        case ParameterKind.BOOL:
            return _parse_bool(text)
        case ParameterKind.INT:
            return _parse_int(text)
        case ParameterKind.FLOAT:
            return _parse_float(text)
        case ParameterKind.INTS:
            return _parse_elements(_parse_int, text, "ints, such as 1,2")
        case ParameterKind.FLOATS:
            return _parse_elements(_parse_float, text, "floats, such as 0.5,2")
    return text


def shown(value: object) -> str:
    """Return a value as errors show it: not longer than a part of a line."""
    text = value.name if isinstance(value, enum.Enum) else repr(value)
    return text if len(text) <= _SHOWN_MAX else f"{text[:_SHOWN_MAX]}..."


def _bool(value: object, _like: object) -> bool:
    if not isinstance(value, bool):
        raise ParameterError(f"it takes true or false, not {_typed(value)}")
    return value


def _int(value: object, _like: object) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise ParameterError(f"it takes an int, not {_typed(value)}")
    if not _INT_MIN <= value <= _INT_MAX:
        raise ParameterError("it takes an int of 64 bits")
    return int(value)


def _float(value: object, _like: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ParameterError(f"it takes a float, not {_typed(value)}")
    try:
        number = float(value)
    except OverflowError:
        raise ParameterError("it takes a float of 64 bits") from None
    if math.isnan(number):
        raise ParameterError("it takes a number, not NaN")
    return number


def _text(value: object, _like: object) -> str:
    if not isinstance(value, str) or isinstance(value, enum.Enum):
        raise ParameterError(f"it takes a str, not {_typed(value)}")
    size = _utf8(value, "a text")
    if size > TEXT_MAX:
        raise ParameterError(f"it takes a text of {TEXT_MAX} bytes of UTF-8 at most, not {size}")
    return str(value)


def _member(value: object, like: enum.Enum) -> enum.Enum:
    cls = type(like)
    if isinstance(value, cls):
        return value
    member = cls.__members__.get(value) if isinstance(value, str) else None
    if member is None:
        raise ParameterError(f"it takes one of {', '.join(each.name for each in cls)}")
    return member


def _tuple_of(convert_one: Callable[[object, object], Any]) -> Callable[[object, Any], tuple[Any, ...]]:
    def convert_all(value: object, like: tuple[Any, ...]) -> tuple[Any, ...]:
        if not isinstance(value, tuple | list) or len(value) != len(like):
            has = f"{len(value)}" if isinstance(value, tuple | list) else _typed(value)
            raise ParameterError(f"it takes {len(like)} numbers, not {has}")
        return tuple(convert_one(each, None) for each in value)

    return convert_all


_CONVERTERS: dict[ParameterKind, Callable[[object, Any], Any]] = {
    ParameterKind.BOOL: _bool,
    ParameterKind.INT: _int,
    ParameterKind.FLOAT: _float,
    ParameterKind.STR: _text,
    ParameterKind.ENUM: _member,
    ParameterKind.INTS: _tuple_of(_int),
    ParameterKind.FLOATS: _tuple_of(_float),
}


def check_text(what: str, text: str, most: int) -> str:
    """Return a text of a definition. Raises ParameterError for more than `most` bytes of UTF-8."""
    size = _utf8(text, what)
    if size > most:
        raise ParameterError(f"{what} has {size} bytes of UTF-8, at most {most} are possible: shorten it")
    return text


def _utf8(text: str, what: str) -> int:
    try:
        return len(text.encode())
    except UnicodeEncodeError:
        raise ParameterError(f"{what} with a character that UTF-8 does not have") from None


def _typed(value: object) -> str:
    return f"a {type(value).__name__}"


_TRUE, _FALSE = ("true", "yes", "on", "1"), ("false", "no", "off", "0")


def _parse_bool(text: str) -> bool:
    lower = text.strip().lower()
    if lower not in _TRUE + _FALSE:
        raise ParameterError("it takes true or false")
    return lower in _TRUE


def _parse_int(text: str) -> int:
    try:
        return int(text, 0)
    except ValueError:
        raise ParameterError("it takes an int") from None


def _parse_float(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ParameterError("it takes a float") from None


def _parse_elements(parse_one: Callable[[str], object], text: str, what: str) -> tuple[object, ...]:
    try:
        return tuple(parse_one(each) for each in _elements(text))
    except ParameterError:
        raise ParameterError(f"it takes {what}") from None


def _elements(text: str) -> list[str]:
    inner = text.strip()
    for opening, closing in ("()", "[]"):
        if inner.startswith(opening) and inner.endswith(closing):
            inner = inner[1:-1]
    return inner.removesuffix(",").split(",")
