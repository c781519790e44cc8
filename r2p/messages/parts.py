"""Packing of the parts of a message that don't fit into one `struct.Struct`: texts and arrays of variable length.

`part` makes two functions for a shape: one packs it into pieces, the other reads it at an offset. They are put together
from those of the items, and called by the code that `packing` generates, which has the most frequent ones inlined. The
bytes are those of ROS 1: a count (u32), then the elements one after the other, without padding.

No number from the wire is believed: a count is compared with the bytes that are there before anything is allocated.
"""

import struct
from collections.abc import Callable, Iterable
from itertools import chain
from typing import Any

from r2p.errors import DecodeError, TooLong
from r2p.messages.array import Array, buffer_of, from_view
from r2p.messages.shapes import (
    COUNT_SIZE,
    Chars,
    Field,
    FixedArray,
    Nested,
    Read,
    Scalar,
    Shape,
    VariableArray,
    VariableText,
    Write,
)

_COUNT = struct.Struct("<I")
_pack_count = _COUNT.pack
_unpack_count = _COUNT.unpack_from


def part(shape: Shape) -> tuple[Write, Read]:
    """Make the functions that write and read a part of this shape."""
    match shape:
        case VariableText(limit):
            return _text(limit)
        case Nested(layout):
            return layout.packing.write, layout.packing.read
        case FixedArray(item, count, container):
            return _array(item, container, _exactly(count), _known_count(count, item.size_min))
        case VariableArray(item, limit, container):
            return _array(item, container, _at_most(limit), _read_count(limit, item.size_min))
        case Scalar() | Chars():
            return _fixed(shape)


# Counts: what is written before the elements, and what is read

_CountBytes = Callable[[int], bytes]
_ReadCount = Callable[[bytes, int], tuple[int, int]]


def _exactly(count: int) -> _CountBytes:
    def check(found: int) -> bytes:
        if found != count:
            raise ValueError
        return b""

    return check


def _known_count(count: int, item_size: int) -> _ReadCount:
    def read(data: bytes, at: int) -> tuple[int, int]:
        if count * item_size > len(data) - at:
            raise DecodeError(f"{len(data) - at} bytes for {count} elements at offset {at}")
        return count, at

    return read


def _at_most(limit: int) -> _CountBytes:
    def check(found: int) -> bytes:
        if found > limit:
            raise ValueError
        return _pack_count(found)

    return check


def _read_count(limit: int, item_size: int) -> _ReadCount:
    def read(data: bytes, at: int) -> tuple[int, int]:
        (count,) = _unpack_count(data, at)
        at += COUNT_SIZE
        if count > limit or count * item_size > len(data) - at:
            raise bad_count(count, limit, len(data) - at, item_size)
        return count, at

    return read


def bad_count(count: int, limit: int, rest: int, item_size: int) -> DecodeError:
    """Return the error of a count of elements that is more than a limit, or than fits into the rest of the bytes."""
    if count * item_size > rest:
        return DecodeError(f"a count of {count} with {rest} bytes behind it")
    return TooLong(f"{count} elements, and at most {limit} are accepted (r2p.Max)")


# Parts


def _text(limit: int) -> tuple[Write, Read]:
    read_count = _read_count(limit, 1)

    def write(value: str) -> Iterable[bytes]:
        data = value.encode()
        if len(data) > limit:
            raise ValueError
        return _pack_count(len(data)), data

    def read(data: bytes, at: int) -> tuple[str, int]:
        count, at = read_count(data, at)
        end = at + count
        return data[at:end].decode(), end

    return write, read


def _fixed(shape: Scalar | Chars) -> tuple[Write, Read]:
    """A single number or text, as an item of an array of arrays."""
    packed = struct.Struct("<" + shape.format)

    def write(value: Any) -> Iterable[bytes]:
        if isinstance(shape, Scalar) and not shape.holds(value):
            raise ValueError
        return (packed.pack(pack_chars(value, shape.length) if isinstance(shape, Chars) else value),)

    def read(data: bytes, at: int) -> tuple[Any, int]:
        (value,) = packed.unpack_from(data, at)
        return (unpack_chars(value) if isinstance(shape, Chars) else value), at + packed.size

    return write, read


def _array(item: Shape, container: str, count_of: _CountBytes, read_count: _ReadCount) -> tuple[Write, Read]:
    if not isinstance(item, Scalar):
        return _items(item, count_of, read_count)
    match container:
        case "tuple":
            return _numbers(item, count_of, read_count)
        case "bytes":
            return _bytes(count_of, read_count)
        case _:
            return _view(item, count_of, read_count)


def _numbers(item: Scalar, count_of: _CountBytes, read_count: _ReadCount) -> tuple[Write, Read]:
    """A tuple of numbers."""
    code, size, is_bool = item.format, item.size, item.kind == "bool"

    def write(value: Any) -> Iterable[bytes]:
        if not isinstance(value, tuple) or (is_bool and not {*map(type, value)} <= {bool}):
            raise TypeError
        count = len(value)
        return count_of(count), struct.pack(f"<{count}{code}", *value)

    def read(data: bytes, at: int) -> tuple[Any, int]:
        count, at = read_count(data, at)
        return struct.unpack_from(f"<{count}{code}", data, at), at + count * size

    return write, read


def _view(item: Scalar, count_of: _CountBytes, read_count: _ReadCount) -> tuple[Write, Read]:
    """An `r2p.Array`, or anything else with a buffer of such numbers, or a sequence of them."""
    code, size = item.format, item.size

    def write(value: Any) -> Iterable[Any]:
        view = view_of(value, code)
        return count_of(len(view)), view

    def read(data: bytes, at: int) -> tuple[Any, int]:
        count, at = read_count(data, at)
        end = at + count * size
        return from_view(memoryview(data)[at:end].cast(code), code), end  # type: ignore[call-overload]

    return write, read


def view_of(value: Any, code: str) -> memoryview:
    """Return the numbers of an array field in a row, with the format `code`. Raises one of UNFIT for anything else."""
    view: memoryview | None = buffer_of(value)
    if view is None or view.format != code:
        numbers = tuple(value)
        view = memoryview(struct.pack(f"<{len(numbers)}{code}", *numbers)).cast(code)  # type: ignore[call-overload]
    return view


def _bytes(count_of: _CountBytes, read_count: _ReadCount) -> tuple[Write, Read]:
    """Bytes, or anything else with a buffer."""

    def write(value: Any) -> Iterable[Any]:
        data = bytes_of(value)
        return count_of(len(data)), data

    def read(data: bytes, at: int) -> tuple[Any, int]:
        count, at = read_count(data, at)
        end = at + count
        return data[at:end], end

    return write, read


def bytes_of(value: Any) -> bytes | memoryview:
    """Return the bytes of a field of them. Raises one of UNFIT for anything without a buffer."""
    return value if value.__class__ is bytes else memoryview(value).cast("B")


def _items(item: Shape, count_of: _CountBytes, read_count: _ReadCount) -> tuple[Write, Read]:
    """A tuple of texts, arrays or messages."""
    write_item, read_item = part(item)

    def write(value: Any) -> Iterable[Any]:
        if not isinstance(value, tuple):
            raise TypeError
        return count_of(len(value)), *chain.from_iterable(map(write_item, value))

    def read(data: bytes, at: int) -> tuple[Any, int]:
        count, at = read_count(data, at)
        values = []
        for _ in range(count):
            value, at = read_item(data, at)
            values.append(value)
        return tuple(values), at

    return write, read


# Texts of fixed length


def pack_chars(value: Any, length: int) -> bytes:
    """Pack a text of at most `length` ASCII characters. Raises one of UNFIT for anything else."""
    data: bytes = value.encode("ascii")
    if len(data) > length or 0 in data:
        raise ValueError
    return data


def unpack_chars(data: bytes) -> str:
    """Unpack a text that is padded with NUL."""
    return data.partition(b"\0")[0].decode("ascii")


# What local subscribers may share


def sharing(shape: Shape) -> Callable[[Any], bool] | None:
    """Make the function that says whether a value may be shared, as in `Packing.shares`; None: it always may."""
    match shape:
        case FixedArray(_, _, "bytes") | VariableArray(_, _, "bytes"):
            return lambda value: value.__class__ is bytes
        case FixedArray(Scalar(_, code), _, "array") | VariableArray(Scalar(_, code), _, "array"):
            return lambda value: _is_decoded(value, code)
        case FixedArray(item) | VariableArray(item):
            each = sharing(item)
            return None if each is None else lambda value: all(map(each, value))
        case Nested(layout):
            return layout.packing.shares
        case _:
            return None


def _is_decoded(value: object, code: str) -> bool:
    """Return whether a value is what decoding makes: an Array of this format whose buffer is immutable bytes."""
    return isinstance(value, Array) and value.view.format == code and value.view.obj.__class__ is bytes


def sharing_of_fields(fields: Iterable[Field]) -> Callable[[Any], bool] | None:
    """Make that function for a message with these fields."""
    checks = [(field.name, check) for field in fields if (check := sharing(field.shape)) is not None]
    if not checks:
        return None
    return lambda message: all(check(getattr(message, name)) for name, check in checks)
