"""Messages: frozen values that are packed without gaps, little-endian (PROTOCOL.md 2).

A message class is plain annotations. The first `layout(T)` turns them into a small tree of shapes, and the tree into
Python functions around `struct.Struct`, so that packing costs little more than the struct itself.

    class Wheel(r2p.Message):
        speed: r2p.f32 = 0.0                                    # a number: u8 .. u64, i8 .. i64, f32, f64; or a bool
        currents: tuple[r2p.f32, r2p.f32] = (0.0, 0.0)          # an array of numbers, texts, arrays or messages
        serial: Annotated[tuple[r2p.u8, ...], r2p.Len(16)]      # a longer one; no default: required
        name: Annotated[str, r2p.Len(8)] = ""                   # ASCII, padded with NUL
        stamp: r2p.Timestamp = r2p.Timestamp()                  # a message in the message
        remark: Annotated[str, r2p.Max(256)] = ""               # UTF-8, at most 256 bytes: the length varies
        raw: Annotated[bytes, r2p.Max(2_000_000)] = b""
        points: Annotated[tuple[Point, ...], r2p.Max(100)] = ()
        ranges: Annotated[r2p.Array[r2p.f32], r2p.Max(1000)] = r2p.Array()

The order on the wire is the order of definition, base classes first; a field that is defined again keeps its place. In
front of what varies in length is its count (u32): the bytes are those that ROS 1 gives the same message.

A value is packed exactly or refused with a MessageError: no number is wrapped or cut, no text is shortened. The struct
module decides what is a number: a bool, or an object with `__index__`, is an integer, and an integer is a float; an f32
is rounded to its 24 bits; NaN and infinities pass. A bool has to be a bool, an array a tuple (an `r2p.Array`: any
buffer or sequence of numbers), and a nested message an instance of exactly its class. When a message is unpacked, any
byte but 0 is True, and a text of fixed length ends at its first NUL: firmware leaves garbage after it.

`shapes` has the parts of layouts and fields, `packing` generates the functions, with `parts` for what varies in length,
`array` has `r2p.Array`, `definition` explains class statements that fail, `layouts` has the classes and compiles them,
and `schemas` builds a class from its schema.
"""

from r2p.messages.array import Array
from r2p.messages.layouts import ClockOffset, Duration, Message, Timestamp, layout
from r2p.messages.schemas import message_type
from r2p.messages.shapes import (
    SIZE_MAX,
    Chars,
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
    f32,
    f64,
    i8,
    i16,
    i32,
    i64,
    show,
    u8,
    u16,
    u32,
    u64,
)

__all__ = [
    "SIZE_MAX",
    "Array",
    "Chars",
    "ClockOffset",
    "Duration",
    "Field",
    "FixedArray",
    "Layout",
    "Len",
    "Max",
    "Message",
    "Nested",
    "Scalar",
    "Shape",
    "Timestamp",
    "VariableArray",
    "VariableText",
    "f32",
    "f64",
    "i8",
    "i16",
    "i32",
    "i64",
    "layout",
    "message_type",
    "show",
    "u8",
    "u16",
    "u32",
    "u64",
]
