"""Packed messages to CDR and back, bit for bit and without decoding them: generated code.

Both forms are little-endian and have the same numbers, so fields of fixed size are blocks of bytes; CDR has padding
between them, and a NUL behind each text. Nothing looks into a block: NaNs keep their bits, and so do bools that are
neither 0 nor 1, and texts that are not UTF-8.

    packed   u32 text's count  text            f64 f64
    CDR      u32 count + 1     text  NUL  pad  f64 f64

Bounds (`r2p.Max`) are not checked: nothing is allocated but the copy. A text is always a string, as in the schemas of
recordings, also where the field is marked `WIDE`. What comes behind a message of CDR is ignored.
"""

import functools
import struct
from collections.abc import Callable, Iterator
from itertools import chain, repeat
from typing import Any

import msgspec

from r2p.errors import DecodeError, MessageError
from r2p.messages import Layout, Message, layout
from r2p.messages.shapes import COUNT_SIZE, Chars, FixedArray, Nested, Scalar, Shape, VariableArray, VariableText
from r2p.ros.cdr import HEADER, bad_count, bad_header, packed_size

_START = len(HEADER)
_PLACES = range(8)
_BLOCKS_MAX = 64  # blocks of an element of which several are copied by one struct; larger ones are a loop
_LARGE = 4096  # bytes of an array from which on it is not copied twice
_STAMPED = "std_msgs/Header"
_SEQ = bytes(4)

_PLAIN = """
def to_cdr(data):
    if len(data) != {size}:
        raise unreadable(f"takes {size} bytes, not {{len(data)}}")
    return HEADER + data, b""

def from_cdr(data, rest):
    packed = data[{start}:{end}]
    if rest or len(packed) != {size} or data[:2] != LITTLE_ENDIAN:
        raise unreadable(bad_plain(data, rest, {size}))
    return packed
"""
_TO_CDR = """
def to_cdr(data):
    size = len(data)
    try:
        seqs = {seqs}
        {lines}
        if {at} != size: raise ValueError(f"{{size - {at}}} bytes are left over")
        return join({pieces}), {rest}
    except (StructError, ValueError) as error:
        raise unreadable(error) from None
"""
_FROM_CDR = """
def from_cdr(data, rest):
    size = len(data)
    try:
        if data[:2] != LITTLE_ENDIAN: raise bad_header(data)
        seqs = {seqs}
        {lines}
        if rest and {leftover}: raise bad_rest(rest)
        return join({pieces})
    except (StructError, ValueError, StopIteration) as error:
        raise unreadable(error) from None
"""
_ELEMENT = """
def copy(data, size, at, place, pieces, seqs):
    {lines}
    return {at}, {place}
"""


class Transcoder(msgspec.Struct, frozen=True, eq=False):
    """The functions of one message class.

    `to_cdr` returns a packed message as CDR, and the rest: what CDR can't hold of it (the `seq` of each Header), empty
    if that is zero. `from_cdr` takes both, and returns the same bytes as before. Both raise DecodeError.
    """

    to_cdr: Callable[[bytes], tuple[bytes, bytes]]
    from_cdr: Callable[[bytes, bytes], bytes]


@functools.lru_cache(maxsize=1024)
def transcoder(cls: type[Message]) -> Transcoder:
    """Return the transcoder of a message class, generated at first use.

    Raises MessageError for an invalid class, and for a Header whose `seq` is not an r2p.u32.
    """
    shape = layout(cls)

    def unreadable(reason: object) -> DecodeError:
        return DecodeError(f"{cls.__name__}: {reason}")

    if size := packed_size(cls):
        names = _compile(_PLAIN.format(size=size, start=_START, end=_START + size), cls, {"unreadable": unreadable})
        return Transcoder(names["to_cdr"], names["from_cdr"])
    functions = []
    for reads_cdr, template in ((False, _TO_CDR), (True, _FROM_CDR)):
        source = _CopySource(f"{_START}" if reads_cdr else "0", f"{_START}", reads_cdr=reads_cdr)
        source.add(Nested(shape))
        functions.append(_compile(source.finish(template), cls, source.names | {"unreadable": unreadable}))
    return Transcoder(functions[0]["to_cdr"], functions[1]["from_cdr"])


def _compile(text: str, cls: object, names: dict[str, Any]) -> dict[str, Any]:
    found = _NAMES | names | {"__tracebackhide__": True}  # pytest's: a frame without source
    exec(compile(text, f"{__file__}, {cls}", "exec"), found)  # noqa: S102 - holds nothing but numbers and own names
    return found


@functools.lru_cache(maxsize=1024)
def _element(shape: Shape, reads_cdr: bool) -> Callable[..., tuple[int, int]]:
    """Return the function that copies one element of an array, at any offset."""
    source = _CopySource("at", "place", reads_cdr=reads_cdr, is_element=True)
    source.add(shape)
    copy: Callable[..., tuple[int, int]] = _compile(source.finish(_ELEMENT), shape.kind, source.names)["copy"]
    return copy


class _CopiedBlock(msgspec.Struct, frozen=True):
    """Bytes of fixed size, which CDR aligns; without any, one octet that only CDR has."""

    size: int
    alignment: int = 1


class _CopySource:
    """The statements that copy one message, or one element of an array.

    `at` is the offset of the next byte that is read, `place` that in CDR, on which padding depends: the same where CDR
    is read. Each is a number as long as nothing before it varies, and then a variable.
    """

    def __init__(self, at: str, place: str, *, reads_cdr: bool, is_element: bool = False) -> None:
        self.names: dict[str, Any] = {}
        self._at = at
        self._place = place
        self._reads_cdr = reads_cdr
        self._is_element = is_element
        self._lines: list[str] = []
        self._pieces = [] if reads_cdr or is_element else ["HEADER"]
        self._has_list = is_element
        self._has_seq = False
        self._run: list[_CopiedBlock] = []
        self._count = 0

    @property
    def _aligned_at(self) -> str:
        return self._at if self._reads_cdr else self._place

    def finish(self, template: str) -> str:
        """End the last run, and return the source."""
        self._end_run()
        if self._has_list:
            self._flush()
        seqs = "[]" if not self._reads_cdr else "split(rest)"
        return template.format(
            at=self._at,
            place=self._aligned_at,
            lines=("\n    " if self._is_element else "\n        ").join(self._lines or ["pass"]),
            pieces="pieces" if self._has_list else f"({', '.join([*self._pieces, ''])})",
            seqs=seqs if self._has_seq else "()",
            rest="merge(seqs)" if self._has_seq else 'b""',
            leftover="next(seqs, None) is not None" if self._has_seq else "True",
        )

    def add(self, shape: Shape) -> None:
        """Add a field, or an element of one."""
        match shape:
            case Nested(inner):
                self._add_message(inner)
            case VariableText():
                self._add_counted(1, 1, is_text=True)
            case VariableArray(item) if block := _one_block(item):
                self._add_counted(block.size, block.alignment)
            case VariableArray(item):
                counter = self._end_run(is_counted=True)
                rest = f"size - {self._at}"  # each has one byte at least
                self._lines.append(f"if {counter} > {rest}: raise bad_count({counter}, {counter}, {rest})")
                self._add_elements(item, counter)
            case FixedArray(item, count) if not _blocks(shape):
                self._end_run()
                self._add_elements(item, f"{count}")
            case _:
                self._run += _blocks(shape)

    def _add_message(self, shape: Layout[Any]) -> None:
        for field in shape.fields:
            if _is_seq(shape, field.name):
                self._add_seq(field.shape)
            else:
                self.add(field.shape)
        if not shape.fields:
            self._run.append(_CopiedBlock(0))

    def _add_seq(self, shape: Shape) -> None:
        """Add the field that ROS 2 no longer has."""
        if shape.kind != "u32":
            raise MessageError(f"the seq of {_STAMPED} is {shape.kind} here, but u32 everywhere else")
        self._end_run()
        self._has_seq = True
        if self._reads_cdr:
            self._pieces.append(self._local("next(seqs)"))
        else:
            end = self._sum(self._at, f"{len(_SEQ)}")
            self._lines += [f"if {end} > size: raise ValueError('it is cut')", f"seqs.append(data[{self._at}:{end}])"]
            self._at = end

    def _add_counted(self, size: int, alignment: int, *, is_text: bool = False) -> None:
        """Add a text, or an array whose elements are one block in both forms."""
        count = self._end_run(is_counted=True, is_text=is_text)
        length = whole = self._local(f"{count} * {size}" if size > 1 else count)
        if is_text and self._reads_cdr:  # some send no terminator with an empty text
            length = self._local(f"{count} - ({count} > 0)")
        if alignment > COUNT_SIZE:
            self._align(count, alignment)
        begin, self._at = self._at, self._sum(self._at, whole)
        self._lines.append(f"if {self._at} > size: raise bad_count({count}, {count}, size - {begin})")
        end = self._at if length == whole else f"{begin} + {length}"
        self._pieces.append(f"(data if {length} < {_LARGE} else memoryview(data))[{begin} : {end}]")
        if not self._reads_cdr:
            self._place = self._sum(self._place, length)
            self._run += [_CopiedBlock(0)] * is_text

    def _align(self, count: str, alignment: int) -> None:
        """Align the elements of an array, if there are any."""
        pad = self._local(f"({_START} - {self._aligned_at}) % {alignment} if {count} else 0")
        if self._reads_cdr:
            self._at = self._sum(self._at, pad)
        else:
            self._pieces.append(f"NULS[{pad}]")
            self._place = self._sum(self._place, pad)

    def _add_elements(self, item: Shape, count: str) -> None:
        """Add elements that are copied one by one."""
        copy, at, place = self._name("copy"), self._name("at"), self._name("place")
        self.names[copy] = _element(item, self._reads_cdr)
        self._has_seq = self._has_seq or _has_seq(item)
        self._flush()
        self._lines += [
            f"{at}, {place} = {self._at}, {self._place}",
            f"for _ in range({count}): {at}, {place} = {copy}(data, size, {at}, {place}, pieces, seqs)",
        ]
        self._at, self._place = at, place

    def _end_run(self, *, is_counted: bool = False, is_text: bool = False) -> str:
        """Copy the blocks since the last other field, with the count behind them; return the variable of that."""
        run = [*self._run, *[_CopiedBlock(COUNT_SIZE, COUNT_SIZE)] * is_counted]
        self._run.clear()
        if not run:
            return ""
        if not self._reads_cdr and not any(block.size for block in run):  # behind a text
            self._pieces.append(repr(bytes(len(run))))
            self._place = self._sum(self._place, f"{len(run)}")
            return ""
        return self._copy(run, is_counted=is_counted, is_text=is_text)

    def _copy(self, run: list[_CopiedBlock], *, is_counted: bool, is_text: bool) -> str:
        """Copy blocks, and a count if it is the last one, from one struct into another."""
        place = self._aligned_at
        places = [int(place)] if place.isdigit() else list(_PLACES)
        pairs = [_structs((each - _START) % 8, run, is_counted=is_counted) for each in places]
        reads, writes = ([pair[side] for pair in pairs] for side in ((1, 0) if self._reads_cdr else (0, 1)))
        values, count = self._name("b"), self._name("n") if is_counted else ""
        names = f"*{values}, {count}" if is_counted else values
        self._lines.append(f"{names} = {self._method('unpack_from', reads, place)}(data, {self._at})")
        pack = self._method("pack", writes, place)
        if is_counted:
            other = f"{count} - ({count} > 0)" if self._reads_cdr else f"{count} + 1"
            self._pieces.append(f"{pack}(*{values}, {other if is_text else count})")
        else:
            self._pieces.append(f"*{values}" if self._reads_cdr else f"{pack}(*{values})")
        self._at = self._sum(self._at, self._size(reads, place))
        if not self._reads_cdr:
            self._place = self._sum(self._place, self._size(writes, place))
        return count

    def _method(self, method: str, structs: list[struct.Struct], place: str) -> str:
        """Return the expression of a method of the struct that belongs to an offset."""
        name = self._name("s")
        methods = [getattr(each, method) for each in structs]
        self.names[name] = methods if len(methods) > 1 else methods[0]
        return f"{name}[{place} & 7]" if len(methods) > 1 else name

    def _size(self, structs: list[struct.Struct], place: str) -> str:
        sizes = [each.size for each in structs]
        if len({*sizes}) == 1:
            return str(sizes[0])
        name = self._name("sizes")
        self.names[name] = sizes
        return f"{name}[{place} & 7]"

    def _flush(self) -> None:
        """Put the pieces up to now into the list."""
        pieces = f"({', '.join([*self._pieces, ''])})" if self._pieces else "()"
        self._lines.append(f"pieces += {pieces}" if self._has_list else f"pieces = [*{pieces}]")
        self._has_list = True
        self._pieces.clear()

    def _sum(self, at: str, size: str) -> str:
        return str(int(at) + int(size)) if at.isdigit() and size.isdigit() else self._local(f"{at} + {size}")

    def _local(self, value: str) -> str:
        if value.isidentifier():
            return value
        name = self._name("v")
        self._lines.append(f"{name} = {value}")
        return name

    def _name(self, kind: str) -> str:
        self._count += 1
        return f"{kind}{self._count}"


@functools.lru_cache(maxsize=4096)
def _blocks(shape: Shape) -> tuple[_CopiedBlock, ...]:
    """Return the blocks of a shape of fixed size; none for other ones, and for arrays of too many."""
    match shape:
        case Scalar() | Chars():
            return (_CopiedBlock(shape.size, shape.size if isinstance(shape, Scalar) else 1),)
        case Nested(inner):
            parts = [() if _is_seq(inner, field.name) else _blocks(field.shape) for field in inner.fields]
            return tuple(chain.from_iterable(parts)) if all(parts) else ()
        case FixedArray(item, count) if block := _one_block(item):
            return (_CopiedBlock(block.size * count, block.alignment),)
        case FixedArray(item, count) if len(_blocks(item)) * count <= _BLOCKS_MAX:
            return _blocks(item) * count
        case _:
            return ()


@functools.lru_cache(maxsize=4096)
def _one_block(shape: Shape) -> _CopiedBlock | None:
    """Return the block that one element of an array is in both forms, whatever is before it; None if it is not one."""
    blocks, end = _blocks(shape), 0
    alignment = max((each.alignment for each in blocks), default=0)
    if not alignment or blocks[0].alignment != alignment:
        return None
    for each in blocks:
        if not each.size or end % each.alignment:
            return None
        end += each.size
    return None if end % alignment else _CopiedBlock(end, alignment)


def _structs(place: int, run: list[_CopiedBlock], *, is_counted: bool) -> tuple[struct.Struct, struct.Struct]:
    """Return the structs that a run has packed, and in CDR where it begins at this place (0 to 7).

    Blocks without padding between them are one. A count behind them is a number.
    """
    packed, aligned, size, at = "<", "<", 0, place
    for block in run[: len(run) - is_counted]:
        padding = -at % block.alignment if block.size else 1
        if padding:
            packed += f"{size}s" * bool(size)
            aligned += f"{size}s" * bool(size) + f"{padding}x"
            size = 0
        size += block.size
        at += padding + block.size
    last, count = f"{size}s" * bool(size), f"{-at % COUNT_SIZE}xI"
    return struct.Struct(packed + last + "I" * is_counted), struct.Struct(aligned + last + count * is_counted)


def _is_seq(shape: Layout[Any], field: str) -> bool:
    """Return whether a field is one that ROS 2 no longer has."""
    return shape.name == _STAMPED and field == "seq"


def _has_seq(shape: Shape) -> bool:
    match shape:
        case Nested(inner):
            return any(_is_seq(inner, field.name) or _has_seq(field.shape) for field in inner.fields)
        case FixedArray(item) | VariableArray(item):
            return _has_seq(item)
        case _:
            return False


def merge(seqs: list[bytes]) -> bytes:
    """Return the bytes of all `seq`; empty if they are zero."""
    rest = b"".join(seqs)
    return rest if any(rest) else b""


def split(rest: bytes) -> Iterator[bytes]:
    """Return each `seq`. Raises DecodeError."""
    if len(rest) % len(_SEQ):
        raise bad_rest(rest)
    return iter([rest[at : at + len(_SEQ)] for at in range(0, len(rest), len(_SEQ))]) if rest else repeat(_SEQ)


def bad_rest(rest: bytes) -> DecodeError:
    """Return the error of a rest that belongs to another message."""
    return DecodeError(f"{len(rest)} bytes are not what CDR could not hold of it")


def bad_plain(data: bytes, rest: bytes, size: int) -> DecodeError:
    """Return the error of a message without padding."""
    if data[:2] != HEADER[:2]:
        return bad_header(data)
    return bad_rest(rest) if rest else DecodeError(f"takes {_START + size} bytes, not {len(data)}")


_NAMES: dict[str, Any] = {
    "HEADER": HEADER,
    "LITTLE_ENDIAN": HEADER[:2],
    "NULS": [bytes(count) for count in range(8)],
    "StructError": struct.error,
    "bad_count": bad_count,
    "bad_header": bad_header,
    "bad_plain": bad_plain,
    "bad_rest": bad_rest,
    "join": b"".join,
    "merge": merge,
    "split": split,
}
