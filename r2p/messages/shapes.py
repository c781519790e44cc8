"""Shapes of fields, and layouts of message classes.

Packing is generated from them, and tools use them to turn text into fields.

A field is a number, a text, an array of one shape, or a message. Each shape has its `kind` (as in schemas), the `size`
(bytes) that it packs to, at most, and the values that are `allowed`, in words. The bytes of a shape that `varies`, of
which there are at least `size_min`, begin with a count; all other shapes have a `format` of the struct module. A tool
walks the tree with

    match field.shape:
        case Scalar(kind): ...
        case Chars(length) | VariableText(length): ...
        case FixedArray(item, count) | VariableArray(item, count): ...
        case Nested(layout): ...
"""

import keyword
import struct
from collections.abc import Callable, Iterable
from typing import Annotated, Any, ClassVar, Generic, Literal, TypeAlias, TypeVar, get_args

import msgspec

UNFIT = (struct.error, ArithmeticError, AttributeError, TypeError, ValueError)
"""The errors that packing raises for a value that does not fit."""

SIZE_MAX = 64 << 20
"""Bytes of the longest message. Links have limits of their own: 1024 on RTCAN, 255 on a debug line."""

COUNT_SIZE = 4
"""Bytes of the count before the elements of an array, or the bytes of a text."""

Container: TypeAlias = Literal["tuple", "array", "bytes"]
"""What the elements of an array decode to: a tuple, an `r2p.Array`, or bytes."""


class Scalar(msgspec.Struct, frozen=True):
    """A number or a bool; `format` is its letter in the struct module."""

    varies: ClassVar[bool] = False

    kind: str
    format: str

    @property
    def size(self) -> int:
        return struct.calcsize("<" + self.format)

    @property
    def size_min(self) -> int:
        return self.size

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

    varies: ClassVar[bool] = False

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
    def size_min(self) -> int:
        return self.length

    @property
    def allowed(self) -> str:
        return f"at most {self.length} ASCII characters without a NUL"

    def holds(self, value: object) -> bool:
        """Return whether the value packs."""
        return isinstance(value, str) and value.isascii() and "\0" not in value and len(value) <= self.length


class VariableText(msgspec.Struct, frozen=True):
    """A text of at most `limit` bytes of UTF-8."""

    varies: ClassVar[bool] = True
    kind: ClassVar[str] = "str"
    size_min: ClassVar[int] = COUNT_SIZE

    limit: int

    @property
    def size(self) -> int:
        return COUNT_SIZE + self.limit

    @property
    def allowed(self) -> str:
        return f"a text of at most {self.limit} bytes in UTF-8"

    def holds(self, value: object) -> bool:
        """Return whether the value packs."""
        try:
            return isinstance(value, str) and len(value.encode()) <= self.limit
        except UnicodeEncodeError:
            return False


class FixedArray(msgspec.Struct, frozen=True):
    """Exactly `count` values of one shape."""

    item: "Shape"
    count: int
    container: Container = "tuple"

    @property
    def varies(self) -> bool:
        return self.item.varies

    @property
    def kind(self) -> str:
        return f"{self.item.kind}[{self.count}]"

    @property
    def format(self) -> str:
        item = format_of(self.item)
        return f"{self.count}{item}" if isinstance(self.item, Scalar) else item * self.count

    @property
    def size(self) -> int:
        return self.count * self.item.size

    @property
    def size_min(self) -> int:
        return self.count * self.item.size_min

    @property
    def allowed(self) -> str:
        return _array_of(self, f"{self.count}")


class VariableArray(msgspec.Struct, frozen=True):
    """At most `limit` values of one shape."""

    varies: ClassVar[bool] = True
    size_min: ClassVar[int] = COUNT_SIZE

    item: "Shape"
    limit: int
    container: Container = "tuple"

    @property
    def kind(self) -> str:
        return f"{self.item.kind}[]"

    @property
    def size(self) -> int:
        return min(COUNT_SIZE + self.limit * self.item.size, SIZE_MAX)

    @property
    def allowed(self) -> str:
        return _array_of(self, f"at most {self.limit}")


def _array_of(array: FixedArray | VariableArray, count: str) -> str:
    """Say which values an array takes."""
    match array.container:
        case "tuple":
            return f"a tuple of {count}"
        case "bytes":
            return f"{count} bytes"
        case _:
            return f"{count} values, each {array.item.allowed}, in a buffer of such or a sequence"


class Nested(msgspec.Struct, frozen=True):
    """A message in a message."""

    layout: "Layout[Any]"

    @property
    def varies(self) -> bool:
        return any(field.shape.varies for field in self.layout.fields)

    @property
    def kind(self) -> str:
        return self.layout.cls.__name__

    @property
    def format(self) -> str:
        return "".join(format_of(field.shape) for field in self.layout.fields)

    @property
    def size(self) -> int:
        return self.layout.size

    @property
    def size_min(self) -> int:
        return self.layout.size_min

    @property
    def allowed(self) -> str:
        return f"a {self.kind}"


Shape: TypeAlias = Scalar | Chars | VariableText | FixedArray | VariableArray | Nested


def format_of(shape: Shape) -> str:
    """Return the format of a shape that does not vary."""
    if isinstance(shape, VariableText | VariableArray):
        raise TypeError(f"the size of {shape.kind} varies")
    return shape.format


class Field(msgspec.Struct, frozen=True):
    """One field of a message class."""

    name: str
    shape: Shape

    @property
    def wire_name(self) -> str:
        """The name in schemas and in other languages: without the `_` that a keyword of Python gets in the class."""
        return self.name[:-1] if self.name.endswith("_") and is_reserved(self.name[:-1]) else self.name


def is_reserved(name: str) -> bool:
    """Return whether a field of a class can't have this name: a keyword, or one that would hide a method."""
    return keyword.iskeyword(name) or name in {"encode", "decode"}


S = TypeVar("S", bound=msgspec.Struct)  # a message class; these are defined on top of this file


class Layout(msgspec.Struct, Generic[S], frozen=True, eq=False):
    """The layout of the messages of one class in bytes.

    `name` is the full name of the type, `package/Name`. A message has `size` bytes; at most that, and at least
    `size_min`, if the length `varies`, which is also said of messages without any bytes. `schema` is `name:kind` of all
    leaves in wire order ("led:u32 value:u8"), with their path where they are nested ("stamp.sec:u32",
    "wheels[0].speed:f32", "points[].x:f32"), and `fingerprint` is its BLAKE2b-64 (8 bytes). `encode` raises
    MessageError, which names the field; `decode` raises DecodeError, or its subclass TooLong.
    """

    cls: type[S]
    name: str
    fields: tuple[Field, ...]
    size: int
    size_min: int
    varies: bool
    schema: str
    fingerprint: bytes
    packing: "Packing"

    @property
    def exact_size(self) -> int:
        """Bytes of each message; 0 if the length varies."""
        return 0 if self.varies else self.size

    @property
    def encode(self) -> Callable[[S], bytes]:
        """Pack a message; raises MessageError."""
        return self.packing.encode

    @property
    def decode(self) -> Callable[[bytes], S]:
        """Unpack a message; raises DecodeError."""
        return self.packing.decode

    @property
    def zero(self) -> S:
        """The message of zero bytes, made anew: a class with an instance of itself would never be garbage-collected."""
        return self.decode(bytes(self.size_min))

    def __repr__(self) -> str:
        size = f"{self.size_min} to {self.size}" if self.varies else f"{self.size}"
        return f"<Layout of {self.cls.__name__}, {size} bytes: {self.schema}>"


class Packing(msgspec.Struct, frozen=True, eq=False):
    """The functions that pack and unpack the messages of one class."""

    encode: Callable[[Any], bytes]
    decode: Callable[[bytes], Any]
    write: "Write"
    """Pack a message into pieces."""
    read: "Read"
    """Unpack the message that begins at an offset; return it and the offset of its end."""
    shares: Callable[[Any], bool] | None = None
    """Says whether local subscribers may share a message: whether decoding would give an equal one of the same types,
    and all its buffers are immutable. None: always.
    """


Write: TypeAlias = Callable[[Any], Iterable[Any]]
Read: TypeAlias = Callable[[bytes, int], tuple[Any, int]]


class Len(msgspec.Struct, frozen=True):
    """In `Annotated`: the elements of an array, or the characters (bytes) of a text, always so many."""

    count: int


class Max(msgspec.Struct, frozen=True):
    """In `Annotated`: the elements of an array, or the bytes of a text, at most so many.

    It bounds what a receiver allocates, and decides which links can carry the message. It is not a part of the type:
    publisher and subscriber may differ in it.
    """

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
