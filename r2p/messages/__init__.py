"""Messages: frozen values with a fixed layout, little-endian and packed (PROTOCOL.md 2).

A message class is plain annotations. The first `layout(T)` turns them into a small tree of shapes, and the tree into
two Python functions around one `struct.Struct`, so that packing costs little more than the struct itself.

    class Wheel(r2p.Message):
        speed: r2p.f32 = 0.0                                    # a number: u8 .. u64, i8 .. i64, f32, f64; or a bool
        currents: tuple[r2p.f32, r2p.f32] = (0.0, 0.0)          # an array of numbers, texts, arrays or messages
        serial: Annotated[tuple[r2p.u8, ...], r2p.Len(16)]      # a longer one; no default: required
        name: Annotated[str, r2p.Len(8)] = ""                   # ASCII, padded with NUL
        stamp: r2p.Timestamp = r2p.Timestamp()                  # a message in the message

The order on the wire is the order of definition, base classes first; a field that is defined again keeps its place.

A value is packed exactly or refused with a MessageError: no number is wrapped or cut, no text is shortened. The struct
module decides what is a number: a bool, or an object with `__index__`, is an integer, and an integer is a float; an f32
is rounded to its 24 bits; NaN and infinities pass. A bool has to be a bool, an array a tuple, and a nested message an
instance of exactly its class. When a message is unpacked, any byte but 0 is True, and a text ends at its first NUL:
firmware leaves garbage after it.

`shapes` has the parts of layouts and fields, `packing` generates the functions, `definition` explains class statements
that fail, `layouts` has the classes and compiles them, and `schemas` builds a class from its schema.
"""

from r2p.messages.layouts import SIZE_MAX, ClockOffset, Message, Timestamp, layout
from r2p.messages.schemas import message_type
from r2p.messages.shapes import (
    Array,
    Chars,
    Field,
    Layout,
    Len,
    Nested,
    Scalar,
    Shape,
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
    "Field",
    "Layout",
    "Len",
    "Message",
    "Nested",
    "Scalar",
    "Shape",
    "Timestamp",
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
