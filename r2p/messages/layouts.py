"""Message classes, and the layouts compiled from their annotations at first use.

A layout is kept in its class, not in a table: so a class built from a schema can be garbage-collected, with its layout.
"""

import re
import sys
from collections.abc import Iterator
from enum import Enum
from hashlib import blake2b
from types import UnionType
from typing import (
    Annotated,
    Any,
    ClassVar,
    Self,
    TypeVar,
    Union,
    dataclass_transform,
    get_args,
    get_origin,
    get_type_hints,
)

import msgspec

from r2p.errors import DecodeError, MessageError
from r2p.messages.array import Array, enable_buffers
from r2p.messages.definition import MessageMeta
from r2p.messages.packing import check, functions
from r2p.messages.shapes import (
    BOOL,
    SIZE_MAX,
    Chars,
    Container,
    Field,
    FixedArray,
    Layout,
    Len,
    Max,
    Nested,
    Scalar,
    Shape,
    VariableArray,
    VariableText,
    i32,
    is_reserved,
    show,
    u8,
    u32,
)
from r2p.units import SECOND

_FIELD_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_PACKAGE = "r2p_msgs"  # the first part of the names of r2p's own types
_CONTAINERS: tuple[tuple[type, Container], ...] = ((tuple, "tuple"), (Array, "array"), (bytes, "bytes"))
_KINDS: dict[type, str] = {bool: "bool", int: "r2p.i32", float: "r2p.f32"}  # what to write for a type of Python
_MUTABLE = (list, dict, set, bytearray)  # an empty one as a default becomes a factory


@dataclass_transform(frozen_default=True, field_specifiers=(msgspec.field,))
class Message(msgspec.Struct, metaclass=MessageMeta, frozen=True, gc=False):
    """The base of all messages: subclass it, and annotate the fields.

    `class Scan(r2p.Message, name="sensor_msgs/LaserScan")` gives a type another name than that of package and class.
    """

    # gc=False: values of this kind form no cycles, and garbage collection need not look at each message in a queue.

    _layout: ClassVar[Any] = None
    _name: ClassVar[str] = ""

    def encode(self) -> bytes:
        """Pack the message; raises MessageError."""
        try:
            return layout(type(self)).encode(self)
        except MessageError as error:
            raise error.with_traceback(None) from None  # without frames that have no source

    @classmethod
    def decode(cls, data: bytes) -> Self:
        """Unpack a message; raises DecodeError."""
        try:
            return layout(cls).decode(data)
        except DecodeError as error:
            raise error.with_traceback(None) from None


M = TypeVar("M", bound=Message)


def layout(cls: type[M]) -> Layout[M]:
    """Return the layout of a message class, compiled at first use.

    Raises MessageError, which says what to write instead, for a class with a field that can't be packed.
    """
    return _find_or_compile(cls, ())


def fingerprint_of(schema: str) -> bytes:
    """Return the fingerprint of a layout, the BLAKE2b-64 of its schema (8 bytes)."""
    return blake2b(schema.encode(), digest_size=8).digest()


def fingerprint_of_class(cls: type[Message]) -> bytes:
    """Return the fingerprint of a class without compiling its layout: a third of the work, to find one among many."""
    found = vars(cls).get("_layout")
    return found.fingerprint if isinstance(found, Layout) else fingerprint_of(_schema(_fields(cls, ())))


# Not in `r2p.msg`: its place is below the codecs, and `schemas` makes each nested `sec nsec` one of these.
class Timestamp(Message):
    """A time stamp in a message: seconds and nanoseconds since 1970, up to 2106 (PROTOCOL.md 2)."""

    sec: u32 = 0
    nsec: u32 = 0

    @property
    def ns(self) -> int:
        """Nanoseconds since 1970."""
        return self.sec * SECOND + self.nsec

    @classmethod
    def from_ns(cls, ns: int) -> Self:
        """Return the time stamp of an instant in ns since 1970. Raises MessageError outside of 1970 to 2106."""
        sec, nsec = divmod(ns, SECOND)
        if not 0 <= sec < 1 << 32:
            raise MessageError(f"{show(ns)} ns is not between 1970 and 2106, the years of a Timestamp")
        return cls(sec, nsec)


class Duration(Message):
    """A length of time in a message, or a difference of two instants: seconds and nanoseconds, up to 68 years."""

    sec: i32 = 0
    nsec: i32 = 0
    """0 to 999 999 999, also where `sec` is negative."""

    @property
    def ns(self) -> int:
        """Nanoseconds."""
        return self.sec * SECOND + self.nsec

    @classmethod
    def from_ns(cls, ns: int) -> Self:
        """Return a number of ns as a Duration. Raises MessageError for more than 68 years."""
        sec, nsec = divmod(ns, SECOND)
        if not -1 << 31 <= sec < 1 << 31:
            raise MessageError(f"{show(ns)} ns is longer than 68 years, the longest Duration")
        return cls(sec, nsec)


class ClockOffset(msgspec.Struct, frozen=True, gc=False):
    """The translation of a stamp to UTC from another clock, that of the RTCAN network `epoch`.

    UTC = that clock + `offset` (ns), known to +-`error` (ns).
    """

    epoch: int
    offset: int
    error: int

    def utc(self, time: int) -> int:
        """Translate an instant (ns) of that clock, such as one in a payload, to UTC (ns), known to +-`error`."""
        return time + self.offset


def check_field_name(path: str, name: str) -> None:
    """Raise MessageError for a name that a field can't have."""
    if not _FIELD_NAME.fullmatch(name) or is_reserved(name):
        raise MessageError(
            f"{path}: a field name has letters, digits and _ of ASCII, begins with a letter, and is neither a Python "
            "keyword nor encode or decode: put a _ behind such a name"
        )


def full_name(cls: type) -> str:
    """Return the name that was given, else package and class; of a program that is run as a file, the file's name."""
    if own := vars(cls).get("_name"):
        return str(own)
    package = cls.__module__.partition(".")[0]
    if package == "__main__":
        package = str(getattr(sys.modules[package], "__file__", "") or "main").rpartition("/")[2].removesuffix(".py")
    package = _PACKAGE if package == "r2p" else re.sub(r"\W", "_", package, flags=re.ASCII)
    return f"{package}/{cls.__name__}"


def _find_or_compile(cls: Any, outer: tuple[type, ...]) -> Layout[Any]:
    """Compile the layout of a class; `outer` are the classes that contain it, to find one that contains itself."""
    found: Layout[Any] | None = vars(cls).get("_layout") if isinstance(cls, type) else None  # not a base class's
    if not isinstance(found, Layout):
        if not (isinstance(cls, type) and issubclass(cls, Message)) or cls is Message:
            raise MessageError(_not_a_class(cls))
        cls._layout = found = _compile(cls, outer)
    return found


def _compile(cls: type[M], outer: tuple[type, ...]) -> Layout[M]:
    fields = _fields(cls, outer)
    size_min = sum(field.shape.size_min for field in fields)
    _check_size(cls.__name__, size_min)
    _check_defaults(cls, {field.name: field.shape for field in fields})
    size = min(sum(field.shape.size for field in fields), SIZE_MAX)
    varies = not size or any(field.shape.varies for field in fields)
    packing = functions(cls, fields)
    try:
        packing.decode(bytes(size_min))
    except DecodeError as error:
        raise MessageError(
            f"{cls.__name__} can't be all zero, which any module may send: {error}; accept it in __post_init__"
        ) from error
    schema = _schema(fields)
    return Layout(cls, full_name(cls), fields, size, size_min, varies, schema, fingerprint_of(schema), packing)


def _fields(cls: type[Message], outer: tuple[type, ...]) -> tuple[Field, ...]:
    """Return the fields in wire order, from the annotations."""
    if cls in outer:
        raise MessageError(f"{cls.__name__} contains itself: a message has a bounded size")
    if not cls.__struct_config__.frozen:
        raise MessageError(f"{cls.__name__} is not frozen, but subscribers share one object: remove frozen=False")
    hints = _hints(cls)
    _check_constants(cls, hints)
    fields = tuple(_field(cls, name, hint, outer) for name, hint in hints.items() if name in cls.__struct_fields__)
    if not fields and (example := _example(cls)):
        raise MessageError(f"{cls.__name__} has no fields: annotate them, as in `{example}`")
    return fields


def _schema(fields: tuple[Field, ...]) -> str:
    return " ".join(leaf for field in fields for leaf in _leaves(field.shape, field.wire_name))


def _hints(cls: type[Message]) -> dict[str, Any]:
    """Return names and annotations in wire order: `get_type_hints` begins with the base classes."""
    try:
        return get_type_hints(cls, include_extras=True)
    except (NameError, AttributeError, SyntaxError, TypeError) as error:
        unknown = (
            ": import the names in its annotations at run time, not under TYPE_CHECKING; "
            "under `from __future__ import annotations` they must be names of its module, not of a function"
        )
        raise MessageError(f"{cls.__name__}: {error}{unknown if isinstance(error, NameError) else ''}") from error


def _field(cls: type[Message], name: str, hint: Any, outer: tuple[type, ...]) -> Field:
    check_field_name(f"{cls.__name__}.{name}", name)
    return Field(name, _shape(hint, f"{cls.__name__}.{name}", (*outer, cls)))


def _check_constants(cls: type[Message], hints: dict[str, Any]) -> None:
    """Refuse a field without its annotation, which is a constant to Python, and hides a field of a base class."""
    fields = cls.__struct_fields__
    for name, value in vars(cls).items():
        constant = name.startswith("_") or name.isupper() or (name in hints and name not in fields)
        if type(value) in _KINDS and not constant and fields:
            raise MessageError(
                f"{cls.__name__}.{name} has no annotation: write `{_annotated(name, value)}` for a field, or "
                f"`{name}: ClassVar = {show(value)}` for a constant"
            )


def _check_defaults(cls: type[Message], shapes: dict[str, Shape]) -> None:
    """Refuse a default that no message could be packed with."""
    for each in msgspec.structs.fields(cls):
        default = each.default_factory() if each.default_factory in _MUTABLE else each.default
        if default is not msgspec.NODEFAULT:
            try:
                check(shapes[each.name], default, f"{cls.__name__}.{each.name}")
            except MessageError as error:
                raise MessageError(f"{error}: change the default") from None


def _shape(hint: Any, path: str, outer: tuple[type, ...]) -> Shape:
    base, *marks = get_args(hint) if get_origin(hint) is Annotated else (hint,)
    bound = next((mark for mark in marks if isinstance(mark, Len | Max)), None)
    if bound is not None:
        _check_count(bound, path)
    container = next((found for kind, found in _CONTAINERS if kind is (get_origin(base) or base)), None)
    if container is not None and (bound is not None or container == "tuple"):
        items = (u8, ...) if container == "bytes" else get_args(base)
        return _array(items, bound, container, path, outer)
    if base is str and bound is not None:
        return Chars(bound.count) if isinstance(bound, Len) else VariableText(bound.count)
    scalar = next((mark for mark in marks if isinstance(mark, Scalar)), BOOL if base is bool else None)
    if scalar and bound is None:
        return scalar
    if isinstance(base, type) and issubclass(base, Message) and bound is None:
        return Nested(_find_or_compile(base, outer))
    raise MessageError(f"{path}: {_spell(hint)} has no bound for its size, use {_instead(base)}")


def _check_count(bound: Len | Max, path: str) -> None:
    count: object = bound.count
    if not (isinstance(count, int) and 1 <= count <= SIZE_MAX):
        raise MessageError(f"{path}: {type(bound).__name__} takes an integer from 1 to {SIZE_MAX}, not {show(count)}")


def _array(
    items: tuple[Any, ...], bound: Len | Max | None, container: Container, path: str, outer: tuple[type, ...]
) -> Shape:
    if container == "array":
        items = (*items, ...)
    open_ended = items[1:] == (...,)
    count = bound.count if open_ended and bound is not None else len(items)
    if (
        not items
        or (open_ended and bound is None)
        or (bound is not None and bound.count != count)
        or not (open_ended or (all(item == items[0] for item in items) and not isinstance(bound, Max)))
    ):
        raise MessageError(
            f"{path}: an array has one type and a length, as tuple[r2p.f32, r2p.f32] or "
            "Annotated[tuple[r2p.f32, ...], r2p.Len(16)], or a bound for it: r2p.Max(1000) instead of r2p.Len; for "
            "different types nest a Message"
        )
    item = _shape(items[0], f"{path}[]", outer)
    if container == "array" and not isinstance(item, Scalar):
        raise MessageError(f"{path}: the elements of an r2p.Array are numbers; use a tuple of {_spell(items[0])}")
    if not item.size:
        raise MessageError(f"{path}: {_spell(items[0])} has no bytes, so an array of it says nothing: send its length")
    if container == "array":
        enable_buffers()
    if isinstance(bound, Max):
        return VariableArray(item, count, container)
    array = FixedArray(item, count, container)
    _check_size(path, array.size_min)
    return array


def _check_size(path: str, size: int) -> None:
    if size > SIZE_MAX:
        raise MessageError(f"{path} has {size} bytes: a message has at most {SIZE_MAX}")


def _spell(hint: Any) -> str:
    """Write an annotation as in a program, `list[r2p.f32]`: without what the types of r2p are made of."""
    base, *marks = get_args(hint) if get_origin(hint) is Annotated else (hint,)
    origin, items = get_origin(base), get_args(base)
    if scalar := next((mark for mark in marks if isinstance(mark, Scalar)), None):
        text = f"r2p.{scalar.kind}"
    elif base is ...:
        text = "..."
    elif isinstance(base, tuple | list):  # as in `x: (r2p.u8, r2p.u8)`
        text = ("({})" if isinstance(base, tuple) else "[{}]").format(", ".join(map(_spell, base)))
    elif origin in (Union, UnionType):
        text = " | ".join(map(_spell, items)).replace("NoneType", "None")
    elif isinstance(origin, type):
        prefix = "r2p." if origin is Array else ""
        text = f"{prefix}{origin.__name__}[{', '.join(map(_spell, items))}]"
    else:
        text = base.__name__ if isinstance(base, type) else show(base)
    bound = next((mark for mark in marks if isinstance(mark, Len | Max)), None)
    return f"Annotated[{text}, r2p.{type(bound).__name__}({show(bound.count)})]" if bound else text


def _example(cls: type[Message]) -> str:
    """A field as it is to be written: the first of the class that lacks only its annotation; empty without one."""
    for name, value in vars(cls).items():
        if type(value) in _KINDS and not name.startswith("_"):
            return _annotated(name, value)
    return ""


def _annotated(name: str, value: object) -> str:
    return f"{name}: {_KINDS[type(value)]} = {show(value)}"


def _not_a_class(value: object) -> str:
    """Return what to pass instead of a value that is not a message class."""
    if isinstance(value, Message):
        return f"{show(value)} is a message, not its class: pass {type(value).__name__}"
    if isinstance(value, type) and get_origin(value) is None:
        return f"{value.__name__} is not a message class: write `class {value.__name__}(r2p.Message)`"
    if isinstance(value, str):
        return f"{show(value)} is not a message class: the topic comes first, then its class"
    return f"{show(value)} is not a message class: subclass r2p.Message"


def _instead(base: Any) -> str:
    item = _item(base)
    array = f"tuple[{item}, {item}], Annotated[tuple[{item}, ...], r2p.Len(16)], or r2p.Max(1000) for at most so many"
    optional = f"{item}, and a bool beside it that says whether it is set"
    texts = {
        int: "one of r2p.u8 .. r2p.u64, r2p.i8 .. r2p.i64",
        float: "r2p.f32 or r2p.f64",
        str: "Annotated[str, r2p.Max(256)], or r2p.Len(16) for a field of 16 bytes",
        bytes: "Annotated[bytes, r2p.Max(1000)], or r2p.Len(16) for just 16",
        Array: f"Annotated[r2p.Array[{item}], r2p.Max(1000)]",
        list: array,
        tuple: array,
        dict: "a Message with a field for each key",
        Union: optional,
        UnionType: optional,
    }
    if isinstance(base, tuple | list):
        return array
    if isinstance(base, type) and issubclass(base, Enum):
        return "r2p.u8, which takes the members of an IntEnum"
    others = "r2p.u8 .. r2p.f64, bool, a Message, a tuple of one of these, or Annotated[str, r2p.Max(256)]"
    return next((text for kind, text in texts.items() if kind is (get_origin(base) or base)), others)


def _item(base: Any) -> str:
    """The type of the items of an array, as it is to be written: what `base` has, or the nearest to it."""
    item = next(iter(base if isinstance(base, tuple | list) else get_args(base)), float)
    scalar = get_origin(item) is Annotated and any(isinstance(mark, Scalar) for mark in get_args(item))
    if scalar or (isinstance(item, type) and issubclass(item, Message)):
        return _spell(item)
    return _KINDS.get(item, "r2p.f32") if isinstance(item, type) else "r2p.f32"


def _leaves(shape: Shape, path: str) -> Iterator[str]:
    """Yield the schema's `path:kind` of each leaf of a field."""
    match shape:
        case Nested(inner):
            for field in inner.fields:
                yield from _leaves(field.shape, f"{path}.{field.wire_name}")
        case FixedArray(item, count) if not isinstance(item, Scalar):
            for i in range(count):
                yield from _leaves(item, f"{path}[{i}]")
        case VariableArray(item) if not isinstance(item, Scalar):
            yield from _leaves(item, f"{path}[]")
        case _:
            yield f"{path}:{shape.kind}"
