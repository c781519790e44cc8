"""The serialisation of ROS 2, CDR in its plain little-endian form, generated from r2p's message classes.

Numbers are aligned to their size, counted from behind a header of 4 bytes. So the bytes between two of them depend on
what comes before: fields of fixed size that follow each other are one `struct.Struct` for each of the 8 places where
they may begin. A text is a count with its terminator, the UTF-8, and a NUL; an array its count and the elements.

    text "ab", f64     03 00 00 00  61 62 00  pad: 1  f64
    f64[] of none      00 00 00 00                              (nothing is aligned for elements that are not there)
    a message without fields   00                               (one octet)

Differences between the class and the type of ROS 2 with its name: `seq` of a Header is not there any more (0 when it is
decoded), and a field marked `WIDE` is a wstring. What comes behind a message is ignored: ROS 2 pads at will.
"""

import functools
import struct
from array import array
from collections.abc import Callable
from typing import Any, TypeVar, get_args, get_type_hints

import msgspec

from r2p.errors import DecodeError, MessageError, TooLong
from r2p.messages import Layout, Message, layout
from r2p.messages.array import Array
from r2p.messages.parts import bytes_of, pack_chars, unpack_chars, view_of
from r2p.messages.shapes import Chars, FixedArray, Nested, Scalar, Shape, VariableArray, VariableText, show

M = TypeVar("M", bound=Message)

HEADER = b"\0\1\0\0"
"""In front of each message: plain CDR, little-endian, without options."""

WIDE = "r2p.ros.WIDE"
"""In `Annotated[str, ...]`: the text is a wstring in ROS 2."""

_START = len(HEADER)
_PLACES = range(8)
_COUNT_SIZE = 4
_INLINE_MAX = 1024  # bytes of an array whose elements are arguments of `pack`, one by one
_INLINE_ALL_MAX = 4096  # the same in elements of all such arrays of a class: Python takes 20 us to compile each
_STAMPED = "std_msgs/Header"

_MESSAGE = """
def encode(message):
    try:
        {write}
    except Exception:
        raise misfit(message) from None

def decode(data):
    size = len(data)
    try:
        if data[:2] != LITTLE_ENDIAN:
            raise bad_header(data)
        {read}
        return {value}
    except (StructError, TypeError, ValueError) as error:
        raise unreadable(error) from None
"""
_ELEMENT = """
def write(message, at, pieces):
    {write}
    return {at}

def read(data, at, size):
    {read}
    return {value}, {read_at}
"""


class CdrCodec(msgspec.Struct, frozen=True, eq=False):
    """The functions of one message class. `encode` raises MessageError, which names the field; `decode` DecodeError, or
    its subclass TooLong.
    """

    encode: Callable[[Any], bytes]
    decode: Callable[[bytes], Any]


@functools.lru_cache(maxsize=1024)
def cdr(cls: type[Message]) -> CdrCodec:
    """Return the codec of a message class, generated at first use. Raises MessageError for an invalid class."""
    shape = layout(cls)
    source = _CdrSource(_START)
    value = source.add_message(shape, "message")
    text = _MESSAGE.format(write=_lines(source.finish(), 8), read=_lines(source.reads, 8), value=value)

    def misfit(message: object) -> MessageError:
        return _misfit(shape, message)

    def unreadable(reason: object) -> DecodeError:
        kind = TooLong if isinstance(reason, TooLong) else DecodeError
        return kind(f"{cls.__name__}: {reason}")

    functions = source.compile(text, cls.__name__, misfit=misfit, unreadable=unreadable)
    return CdrCodec(functions["encode"], functions["decode"])


def packed_size(cls: type[Message]) -> int:
    """Return the size of messages whose CDR is HEADER and their packing, without padding; 0 for other classes."""
    shape = layout(cls)
    return shape.size if shape.exact_size and _end_if_aligned(Nested(shape), 0) == shape.size else 0


def _end_if_aligned(shape: Shape, at: int) -> int:
    """Return the offset behind a value of fixed size; -1 if there is padding before or in it, or if it has no bytes."""
    match shape:
        case _ if at < 0 or not shape.size:
            return -1
        case Nested(inner) if inner.name == _STAMPED:  # its `seq` is not in CDR
            return -1
        case Nested(inner):
            return functools.reduce(lambda end, field: _end_if_aligned(field.shape, end), inner.fields, at)
        case FixedArray(item, count, "tuple"):
            return functools.reduce(lambda end, _: _end_if_aligned(item, end), range(count), at)
        case FixedArray(item) | (Scalar() as item):
            return at + shape.size if not at % item.size else -1
        case _:
            return at + shape.size


@functools.lru_cache(maxsize=1024)
def _element(shape: Shape, is_wide: bool) -> tuple[Callable[..., int], Callable[..., tuple[Any, int]]]:
    """Return the functions that write and read an element of an array, at any offset."""
    source = _CdrSource(None)
    value = source.add(shape, "message", is_wide=is_wide)
    write = source.finish()
    text = _ELEMENT.format(
        write=_lines(write, 4), at=source.at, read=_lines(source.reads, 4), value=value, read_at=source.read_at
    )
    functions = source.compile(text, shape.kind)
    return functions["write"], functions["read"]


class _CdrSource:
    """The statements that write and read one message, or one element of an array.

    Each offset in the bytes has a variable of its own, or is a number as long as nothing before it varies: `at` where
    the next field is written, `read_at` where it is read. Fields of fixed size are collected in a run, and written as
    soon as something else follows.
    """

    def __init__(self, start: int | None) -> None:
        """`start`: the offset of the first byte, None if it varies."""
        self.at = self.read_at = "at" if start is None else str(start)
        self.reads: list[str] = []
        self._names: dict[str, Any] = {}
        self._writes: list[str] = []
        self._pieces: list[str] = [] if start is None else ["HEADER"]
        self._is_element = start is None
        self._has_list = start is None
        self._run: list[tuple[str, int]] = []  # format of an element, and the number of elements
        self._values: list[str] = []
        self._slots: list[str] = []
        self._inlined = 0  # elements of arrays that are in `_values` and `_slots` one by one
        self._has_nul = False  # behind the text that was written last
        self._count = 0

    def finish(self) -> list[str]:
        """End the last run, and return the statements that write."""
        self._end_run()
        self._end_text()
        if not self._has_list:
            return [*self._writes, f"return join(({', '.join(self._pieces)},))"]
        self._flush()
        return self._writes if self._is_element else [*self._writes, "return join(pieces)"]

    def compile(self, text: str, name: str, **more: object) -> dict[str, Any]:
        """Return the functions of a source."""
        names = _NAMES | self._names | more | {"__tracebackhide__": True}  # pytest's: a frame without source
        exec(compile(text, f"{__file__}, {name}", "exec"), names)  # noqa: S102 - holds nothing but checked names
        return names

    def add_message(self, shape: Layout[Any], value: str) -> str:
        """Add the fields of a message, the expression `value`; return the expression that makes it of what was read."""
        cls, name = shape.cls, self._name("T")
        local = self._local(value)
        self._names[name] = cls
        self._writes.append(f"if {local}.__class__ is not {name}: raise TypeError")
        hints = get_type_hints(cls, include_extras=True)
        parts: dict[str, str] = {}
        for field in shape.fields:
            if field.name == "seq" and shape.name == _STAMPED:
                parts[field.name] = "0"
            else:
                is_wide = _is_wide(hints[field.name])
                parts[field.name] = self.add(field.shape, f"{local}.{field.name}", is_wide=is_wide)
        if not shape.fields:
            self._add_fixed("B", "0")
        if tuple(parts) == cls.__match_args__:  # nearly always: faster than by name
            return f"{name}({', '.join(parts.values())})"
        return f"{name}({', '.join(f'{key}={part}' for key, part in parts.items())})"

    def add(self, shape: Shape, value: str, *, is_wide: bool = False) -> str:
        """Add a field, or an element of one; return the expression that makes it of what was read."""
        match shape:
            case Nested(inner):
                return self.add_message(inner, value)
            case Scalar():
                return self._add_fixed(shape.format, value)
            case Chars(length):
                return f"text({self._add_fixed(f'{length}s', f'chars({value}, {length})')})"
            case VariableText(limit):
                return self._add_wide(value, limit) if is_wide else self._add_text(value, limit)
            case FixedArray(Scalar() as item, count, "tuple") if self._may_inline(shape):
                self._inlined += count
                local = self._local(value)
                self._writes.append(f"if len({local}) != {count}: raise ValueError")
                self._run.append((item.format, count))
                self._values.append(f"*{local}")
                return f"({', '.join([self._slot() for _ in range(count)])},)"
            case FixedArray(Scalar() as item) | VariableArray(Scalar() as item):
                return self._add_numbers(shape, item, value)
            case FixedArray(item) | VariableArray(item):
                return self._add_elements(shape, item, value, is_wide=is_wide)

    def _may_inline(self, shape: FixedArray) -> bool:
        return shape.size <= _INLINE_MAX and self._inlined + shape.count <= _INLINE_ALL_MAX

    def _add_fixed(self, format: str, value: str) -> str:
        self._run.append((format, 1))
        self._values.append(value)
        return self._slot()

    def _add_text(self, value: str, limit: int) -> str:
        local = self._local(f"{value}.encode()")
        length = self._local(f"len({local})")
        count = self._add_count(f"{length} + 1", length, limit)
        self._pieces.append(local)
        self._has_nul = True
        self._move(length)
        begin = self._read_bytes(count, 1, limit + 1)
        slot = self._name("v")  # some send no terminator with an empty text
        self.reads.append(f"{slot} = data[{begin} : {self.read_at} - 1].decode() if {count} else ''")
        return slot

    def _add_wide(self, value: str, limit: int) -> str:
        """Add a wstring: its count is that of UTF-16 units, each in 4 bytes, without a terminator."""
        local = self._local(f"wide_units({value})")
        length = self._local(f"len({local})")
        count = self._add_count(f"{length} // 4", f"{length} // 4", limit)
        self._pieces.append(local)
        self._move(length)
        begin = self._read_bytes(count, 4, limit)
        slot = self._name("v")
        self.reads.append(f"{slot} = wide_text(data[{begin}:{self.read_at}])")
        return slot

    def _add_numbers(self, shape: FixedArray | VariableArray, item: Scalar, value: str) -> str:
        """Add an array of numbers, which is one piece."""
        code, local = repr(item.format), self._local(value)
        if shape.container == "bytes":
            local = self._local(f"bytes_of({local})")
        else:
            is_array = f"{local}.__class__ is Array and {local}._code == {code}"
            local = self._local(f"{local}._view if {is_array} else view_of({local}, {code})")
        length = self._local(f"len({local})")
        count, limit = self._add_length(shape, length)
        if isinstance(shape, FixedArray) or item.size > _COUNT_SIZE:
            self._align(item.size, length, count)
        self._pieces.append(local)
        self._move(f"{length} * {item.size}")
        begin = self._read_bytes(count, item.size, limit)
        slot, part = self._name("v"), f"memoryview(data)[{begin}:{self.read_at}].cast({code})"
        if shape.container == "array":
            self.reads += [f"{slot} = new(Array)", f"{slot}._code = {code}", f"{slot}._view = {part}"]
        else:
            bare = f"data[{begin}:{self.read_at}]"
            self.reads.append(f"{slot} = {bare if shape.container == 'bytes' else f'tuple({part})'}")
        return slot

    def _add_elements(self, shape: FixedArray | VariableArray, item: Shape, value: str, *, is_wide: bool) -> str:
        """Add a tuple of texts or messages, which are written and read one by one."""
        local, write, read, each = self._local(value), self._name("write"), self._name("read"), self._name("v")
        count, limit = self._add_length(shape, self._local(f"len({local})"))
        self._names[write], self._names[read] = _element(item, is_wide)
        self._flush()
        at, self.at = self.at, self._name("a")
        self._writes += [
            f"{self.at} = {at}",
            f"for {each} in {local}:",
            f"    {self.at} = {write}({each}, {self.at}, pieces)",
        ]
        at, self.read_at, slot = self.read_at, self._name("r"), self._name("v")
        self.reads += [
            f"if {count} > {limit} or {count} > size - {at}: raise bad_count({count}, {limit}, size - {at})",
            f"{slot}, {self.read_at} = [], {at}",
            f"for _ in range({count}):",
            f"    {each}, {self.read_at} = {read}(data, {self.read_at}, size)",
            f"    {slot}.append({each})",
        ]
        return f"tuple({slot})"

    def _add_length(self, shape: FixedArray | VariableArray, length: str) -> tuple[str, int]:
        """Add the count of an array whose length varies; return the count as it is read, and its limit."""
        if isinstance(shape, VariableArray):
            return self._add_count(length, length, shape.limit), shape.limit
        self._writes.append(f"if {length} != {shape.count}: raise ValueError")
        self._end_run()
        self._end_text()
        return str(shape.count), shape.count

    def _add_count(self, value: str, length: str, limit: int) -> str:
        """Add the count before elements, and end the run with it."""
        self._writes.append(f"if {length} > {limit}: raise ValueError")
        slot = self._add_fixed("I", value)
        self._end_run()
        return slot

    def _align(self, size: int, length: str, count: str) -> None:
        """Align the elements of an array, if there are any."""
        pad = self._local(f"(-{self.at} + {_START}) % {size} if {length} else 0")
        self._pieces.append(f"NULS[{pad}]")
        self._move(pad)
        at, self.read_at = self.read_at, self._name("r")
        self.reads.append(f"{self.read_at} = {at} + ((-{at} + {_START}) % {size} if {count} else 0)")

    def _read_bytes(self, count: str, item_size: int, limit: int) -> str:
        """Move behind the bytes of so many elements; return the offset at which they begin."""
        begin, self.read_at = self.read_at, self._name("r")
        self.reads += [
            f"{self.read_at} = {begin} + {count}" + f" * {item_size}" * (item_size > 1),
            f"if {count} > {limit} or {self.read_at} > size: raise bad_count({count}, {limit}, size - {begin})",
        ]
        return begin

    def _end_run(self) -> None:
        """Write and read the fields of fixed size since the last other one."""
        if not self._run:
            return
        run, values = self._run.copy(), ", ".join(self._values)
        written = [("x", 1), *run] if self._has_nul else run
        self._has_nul = False
        pack, size = self._structs(written, self.at, "pack")
        self._pieces.append(f"{pack}({values})")
        self._move(size)
        unpack, size = self._structs(run, self.read_at, "unpack_from")
        self.reads.append(f"{', '.join(self._slots)}, = {unpack}(data, {self.read_at})")
        self.read_at = self._sum(self.read_at, size, self.reads, "r")
        for each in (self._run, self._values, self._slots):
            each.clear()

    def _structs(self, run: list[tuple[str, int]], at: str, method: str) -> tuple[str, str]:
        """Return the expressions for a method of the struct of a run that is at an offset, and for its size."""
        name = self._name("s")
        if at.isdigit():
            found = _struct_at((int(at) - _START) % 8, run)
            self._names[name] = getattr(found, method)
            return name, str(found.size)
        structs = [_struct_at((place - _START) % 8, run) for place in _PLACES]
        self._names[name] = tuple(getattr(each, method) for each in structs)
        self._names[f"sizes_{name}"] = tuple(each.size for each in structs)
        return f"{name}[{at} & 7]", f"sizes_{name}[{at} & 7]"

    def _end_text(self) -> None:
        """Write the terminator of a text behind which no run follows."""
        if self._has_nul:
            self._has_nul = False
            self._pieces.append("NUL")
            self._move("1")

    def _move(self, size: str) -> None:
        """Note that the last piece has this size."""
        self.at = self._sum(self.at, size, self._writes, "a")

    def _sum(self, at: str, size: str, lines: list[str], kind: str) -> str:
        if at.isdigit() and size.isdigit():
            return str(int(at) + int(size))
        name = self._name(kind)
        lines.append(f"{name} = {at} + {size}")
        return name

    def _flush(self) -> None:
        """Put the pieces up to now into the list."""
        pieces = f"({', '.join(self._pieces)},)" if self._pieces else "()"
        self._writes.append(f"pieces += {pieces}" if self._has_list else f"pieces = [*{pieces}]")
        self._has_list = True
        self._pieces.clear()

    def _local(self, value: str) -> str:
        name = self._name("n")
        self._writes.append(f"{name} = {value}")
        return name

    def _slot(self) -> str:
        self._slots.append(self._name("v"))
        return self._slots[-1]

    def _name(self, kind: str) -> str:
        self._count += 1
        return f"{kind}{self._count}"


def _is_wide(hint: Any) -> bool:
    """Return whether a field is a wstring, or an array of them."""
    return hint == WIDE or any(map(_is_wide, get_args(hint)))


def _struct_at(place: int, run: list[tuple[str, int]]) -> struct.Struct:
    """Return the struct of fields that begin at this place (0 to 7)."""
    formats, at = ["<"], place
    for code, count in run:
        size = 1 if code[-1] in "sx" else struct.calcsize("<" + code)
        padding = -at % size
        formats.append(f"{padding}x" * bool(padding) + (code if count == 1 else f"{count}{code}"))
        at += padding + count * struct.calcsize("<" + code)
    return struct.Struct("".join(formats))


def _lines(lines: list[str], indent: int) -> str:
    return ("\n" + " " * indent).join(lines or ["pass"])


def _misfit(shape: Layout[Any], message: Any) -> MessageError:
    """Return the error that names the value that can't be packed: the one that r2p's own packing finds."""
    if type(message) is shape.cls:
        try:
            shape.encode(message)
        except MessageError as error:
            return error.with_traceback(None)
    return MessageError(f"{show(message)} is not a {shape.cls.__name__} that CDR can carry")


def bad_count(count: int, limit: int, rest: int) -> DecodeError:
    """Return the error of a count of elements that is more than a limit, or than fits into the rest of the bytes."""
    if count > limit:
        return TooLong(f"{count} elements, and at most {limit} are accepted (r2p.Max)")
    return DecodeError(f"a count of {count} with {max(0, rest)} bytes behind it")


def bad_header(data: bytes) -> DecodeError:
    """Return the error of a message with another header."""
    return DecodeError(f"the message begins with {data[:4].hex(' ')}, not with {HEADER.hex(' ')} (little-endian CDR)")


def wide_units(text: str) -> bytes:
    """Return the UTF-16 units of a text, each in 4 bytes."""
    units = memoryview(text.encode("utf-16-le")).cast("H")
    return struct.pack(f"<{len(units)}I", *units)


def wide_text(data: bytes) -> str:
    """Return the text of UTF-16 units of 4 bytes each. Raises ValueError."""
    try:
        units = array("H", memoryview(data).cast("I"))  # without a Python object for each of them
    except OverflowError:
        raise ValueError("a unit of a wstring has more than 16 bits") from None
    return units.tobytes().decode("utf-16-le")


_NAMES: dict[str, Any] = {
    "Array": Array,
    "HEADER": HEADER,
    "LITTLE_ENDIAN": HEADER[:2],
    "NUL": b"\0",
    "NULS": [bytes(count) for count in range(8)],
    "StructError": struct.error,
    "bad_count": bad_count,
    "bad_header": bad_header,
    "bytes_of": bytes_of,
    "chars": pack_chars,
    "join": b"".join,
    "new": object.__new__,
    "text": unpack_chars,
    "view_of": view_of,
    "wide_text": wide_text,
    "wide_units": wide_units,
}
