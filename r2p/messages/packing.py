"""The two functions that pack and unpack one message class: generated source around one `struct.Struct`.

The generated `encode` only detects that a value does not fit; a slow walk through the shapes finds the value.
"""

import struct
from collections.abc import Callable, Iterable
from typing import Any

from r2p.errors import DecodeError, MessageError
from r2p.messages.shapes import Array, Chars, Field, Nested, Scalar, Shape, show

# `encode` catches everything: users put objects of any kind into messages, and any exception when these are checked or
# packed (OverflowError, AttributeError, one of their own) means that they do not fit.
_SOURCE = """
def encode(message):
    try:
        {check}
        return pack({values})
    except Exception:
        raise misfit(message) from None

def decode(data):
    try:
        {read}
    except (StructError, TypeError, ValueError) as error:
        raise unreadable(data, error) from None
"""


def functions(cls: type[Any], fields: tuple[Field, ...]) -> tuple[Callable[[Any], bytes], Callable[[bytes], Any]]:
    """Generate the `encode` and the `decode` of a message class with these fields."""
    packed = struct.Struct("<" + "".join(field.shape.format for field in fields))
    source = _SourceCode()
    value, slots = source.add_message(cls, fields, "message"), ", ".join(source.slots)
    flat = value == f"T({slots})"  # then the slots need no names, which is faster
    text = _SOURCE.format(
        check="\n        ".join(source.checks),
        values=", ".join(source.values),
        read="return T(*unpack(data))" if flat else f"{slots}, = unpack(data)\n        return {value}",
    )

    def misfit(message: object) -> MessageError:
        return _misfit(cls, fields, message)

    def unreadable(data: bytes, error: Exception) -> DecodeError:
        reason = f"takes {packed.size} bytes, not {len(data)}" if len(data) != packed.size else str(error)
        return DecodeError(f"{cls.__name__}: {reason}")

    names = source.names | {
        "pack": packed.pack,
        "unpack": packed.unpack,
        "misfit": misfit,
        "unreadable": unreadable,
        "StructError": struct.error,
        "__tracebackhide__": True,  # pytest's: a frame without source is of no use
    }
    file = f"{__file__}, {cls.__name__}"  # in this folder, as for all frames that short tracebacks leave out
    exec(compile(text, file, "exec"), names)  # noqa: S102 - holds nothing but checked names
    return names["encode"], names["decode"]


class _SourceCode:
    """The parts of the source: checks, then the arguments of `pack`; the slots are the results of `unpack`."""

    def __init__(self) -> None:
        self.names: dict[str, Any] = {"chars": _chars, "text": _text}
        self.checks: list[str] = []
        self.values: list[str] = []
        self.slots: list[str] = []

    def add(self, shape: Shape, value: str) -> str:
        """Add the packing of the expression `value`; return the expression that rebuilds it from slots."""
        match shape:
            case Array(item, count):
                return self.add_array(item, count, value)
            case Nested(inner):
                return self.add_message(inner.cls, inner.fields, value)
            case Chars(length):
                self.values.append(f"chars({value}, {length})")
                return f"text({self.slot()})"
            case Scalar(kind):
                if kind == "bool":
                    self.refuse(f"{value} is not True and {value} is not False")
                self.values.append(value)
                return self.slot()

    def add_array(self, item: Shape, count: int, value: str) -> str:
        local = self.local(value)
        self.refuse(f"not isinstance({local}, tuple) or len({local}) != {count}")
        if isinstance(item, Scalar):
            if item.kind == "bool":
                self.refuse(f"{{*map(type, {local})}} != {{bool}}")
            self.values.append(f"*{local}")
            parts = [self.slot() for _ in range(count)]
        else:
            parts = [self.add(item, f"{local}[{i}]") for i in range(count)]
        return f"({', '.join(parts)},)"

    def add_message(self, cls: type[Any], fields: tuple[Field, ...], value: str) -> str:
        local = self.local(value)
        name = f"T{len(self.names)}" if "T" in self.names else "T"
        self.names[name] = cls
        self.refuse(f"{local}.__class__ is not {name}")  # a subclass would lose the fields that it adds
        parts = {field.name: self.add(field.shape, f"{local}.{field.name}") for field in fields}
        if tuple(parts) == cls.__match_args__:
            return f"{name}({', '.join(parts.values())})"
        return f"{name}({', '.join(f'{key}={part}' for key, part in parts.items())})"  # some are keyword-only

    def refuse(self, condition: str) -> None:
        self.checks.append(f"if {condition}: raise TypeError")

    def local(self, value: str) -> str:
        name = f"n{len(self.checks)}"
        self.checks.append(f"{name} = {value}")
        return name

    def slot(self) -> str:
        self.slots.append(f"v{len(self.slots)}")
        return self.slots[-1]


def _chars(value: Any, length: int) -> bytes:
    data: bytes = value.encode("ascii")
    if len(data) > length or 0 in data:
        raise ValueError
    return data


def _text(data: bytes) -> str:
    return data.partition(b"\0")[0].decode("ascii")


def _misfit(cls: type[Any], fields: tuple[Field, ...], message: object) -> MessageError:
    """Return the error that names the value that did not pack."""
    if type(message) is not cls:
        return MessageError(f"{show(message)} is not a {cls.__name__}")
    for field in fields:
        try:
            check(field.shape, getattr(message, field.name), f"{cls.__name__}.{field.name}")
        except MessageError as error:
            return error.with_traceback(None)
    return MessageError(f"{show(message)} can't be packed")


def check(shape: Shape, value: Any, path: str) -> None:
    """Raise MessageError for the first part that does not fit."""
    parts: Iterable[tuple[Shape, Any, str]] = ()
    match shape:
        case Array(item, count):
            fits = isinstance(value, tuple) and len(value) == count
            parts = ((item, value[i], f"{path}[{i}]") for i in range(count))
        case Nested(inner):
            fits = type(value) is inner.cls
            parts = ((field.shape, getattr(value, field.name), f"{path}.{field.name}") for field in inner.fields)
        case Scalar() | Chars():
            fits = shape.holds(value)
    if not fits:
        raise MessageError(f"{path} ({shape.kind}) takes {shape.allowed}, not {show(value)}")
    for part in parts:
        check(*part)
