"""Shapes of fields, and layouts of message classes.

Packing is generated from them, and tools use them to turn text into fields.

A field is a number, a text, an array of one shape, or a message. Each shape has its `kind` (as in schemas), the
`format` and `size` (bytes) that it packs to, and the values that are `allowed`, in words. A tool walks the tree with

    match field.shape:
        case Scalar(kind): ...
        case Chars(length): ...
        case Array(item, count): ...
        case Nested(layout): ...
"""

import struct
from collections.abc import Callable
from typing import Annotated, Any, Generic, TypeAlias, TypeVar, get_args

import msgspec

UNFIT = (struct.error, ArithmeticError, AttributeError, TypeError, ValueError)
"""The errors that packing raises for a value that does not fit."""


class Scalar(msgspec.Struct, frozen=True):
    """A number or a bool; `format` is its letter in the struct module."""

    kind: str
    format: str

    @property
    def size(self) -> int:
        return struct.calcsize("<" + self.format)

    @property
    def limits(self) -> tuple[int, int]:
        """The least and the greatest value of an integer."""
        bits = 8 * self.size
        return (-(1 << bits - 1), (1 << bits - 1) - 1) if self.kind.startswith("i") else (0, (1 << bits) - 1)

    @property
    def allowed(self) -> str:
        other = {"bool": "True or False", "f32": "a number up to ±3.402823e38", "f64": "a number up to ±1.797693e308"}
        return other.get(self.kind) or "an integer from {} to {}".format(*self.limits)

    def holds(self, value: object) -> bool:
        """Return whether the value packs."""
        if self.kind == "bool":
            return value is True or value is False
        try:
            struct.pack("<" + self.format, value)
        except UNFIT:
            return False
        return True


class Chars(msgspec.Struct, frozen=True):
    """A text of at most `length` ASCII characters, padded with NUL; without a terminator when it fills the field."""

    length: int

    @property
    def kind(self) -> str:
        return f"char[{self.length}]"

    @property
    def format(self) -> str:
        return f"{self.length}s"

    @property
    def size(self) -> int:
        return self.length

    @property
    def allowed(self) -> str:
        return f"at most {self.length} ASCII characters without a NUL"

    def holds(self, value: object) -> bool:
        """Return whether the value packs."""
        return isinstance(value, str) and value.isascii() and "\0" not in value and len(value) <= self.length


class Array(msgspec.Struct, frozen=True):
    """A tuple of exactly `count` values of one shape."""

    item: "Shape"
    count: int

    @property
    def kind(self) -> str:
        return f"{self.item.kind}[{self.count}]"

    @property
    def format(self) -> str:
        return f"{self.count}{self.item.format}" if isinstance(self.item, Scalar) else self.item.format * self.count

    @property
    def size(self) -> int:
        return self.count * self.item.size

    @property
    def allowed(self) -> str:
        return f"a tuple of {self.count}"


class Nested(msgspec.Struct, frozen=True):
    """A message in a message."""

    layout: "Layout[Any]"

    @property
    def kind(self) -> str:
        return self.layout.cls.__name__

    @property
    def format(self) -> str:
        return "".join(field.shape.format for field in self.layout.fields)

    @property
    def size(self) -> int:
        return self.layout.size

    @property
    def allowed(self) -> str:
        return f"a {self.kind}"


Shape: TypeAlias = Scalar | Chars | Array | Nested


class Field(msgspec.Struct, frozen=True):
    """One field of a message class."""

    name: str
    shape: Shape


S = TypeVar("S", bound=msgspec.Struct)  # a message class; these are defined on top of this file


class Layout(msgspec.Struct, Generic[S], frozen=True, eq=False):
    """The layout of the messages of one class in bytes.

    `size` is in bytes. `schema` is `name:kind` of all leaves in wire order ("led:u32 value:u8"), with their path where
    they are nested ("stamp.sec:u32", "wheels[0].speed:f32"), and `fingerprint` is its BLAKE2b-64 (8 bytes). `encode`
    raises MessageError, which names the field; `decode` raises DecodeError.
    """

    cls: type[S]
    fields: tuple[Field, ...]
    size: int
    schema: str
    fingerprint: bytes
    encode: Callable[[S], bytes]
    decode: Callable[[bytes], S]

    @property
    def zero(self) -> S:
        """The message of zero bytes, made anew: a class with an instance of itself would never be garbage-collected."""
        return self.decode(bytes(self.size))

    def __repr__(self) -> str:
        return f"<Layout of {self.cls.__name__}, {self.size} bytes: {self.schema}>"


class Len(msgspec.Struct, frozen=True):
    """In `Annotated`: the elements of an array, or the characters (bytes) of a text."""

    count: int


u8 = Annotated[int, Scalar("u8", "B")]
"""An integer of 1 byte: 0 to 255."""
u16 = Annotated[int, Scalar("u16", "H")]
"""An integer of 2 bytes: 0 to 65 535."""
u32 = Annotated[int, Scalar("u32", "I")]
"""An integer of 4 bytes: 0 to 4 294 967 295."""
u64 = Annotated[int, Scalar("u64", "Q")]
"""An integer of 8 bytes: 0 to 2**64 - 1."""
i8 = Annotated[int, Scalar("i8", "b")]
"""An integer of 1 byte: -128 to 127."""
i16 = Annotated[int, Scalar("i16", "h")]
"""An integer of 2 bytes: -32 768 to 32 767."""
i32 = Annotated[int, Scalar("i32", "i")]
"""An integer of 4 bytes: -2**31 to 2**31 - 1."""
i64 = Annotated[int, Scalar("i64", "q")]
"""An integer of 8 bytes: -2**63 to 2**63 - 1."""
f32 = Annotated[float, Scalar("f32", "f")]
"""A float of 4 bytes: 24 bits of precision, up to 3.4e38; rounded when it is packed."""
f64 = Annotated[float, Scalar("f64", "d")]
"""A float of 8 bytes: the same as a Python float."""

BOOL = Scalar("bool", "?")
HINTS: dict[str, Any] = {
    "bool": bool,
    **{get_args(hint)[1].kind: hint for hint in (u8, u16, u32, u64, i8, i16, i32, i64, f32, f64)},
}
"""The annotation of each scalar kind."""


def show(value: object) -> str:
    """Format a value for an error text. It may be anything, so the result is cut at 80 characters."""
    try:
        text = repr(value)
    except ValueError:  # an integer of more digits than Python prints
        text = object.__repr__(value)
    return text if len(text) <= 80 else f"{text[:76]} ..."
