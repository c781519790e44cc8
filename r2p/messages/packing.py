"""The functions that pack and unpack one message class: generated source around `struct.Struct`.

Fields of fixed size that follow each other are one struct; between them, `parts` packs what varies in length. The
generated `encode` only detects that a value does not fit; a slow walk through the shapes finds the value.
"""

import struct
from collections.abc import Iterator
from typing import Any

from r2p.errors import DecodeError, MessageError, TooLong
from r2p.messages.array import Array, from_view
from r2p.messages.known_lengths import SHORT_TEXT, Elements, KnownLengths, StructsWithText
from r2p.messages.parts import bad_count, bytes_of, pack_chars, part, sharing_of_fields, unpack_chars, view_of
from r2p.messages.shapes import (
    Chars,
    Field,
    FixedArray,
    Nested,
    Packing,
    Scalar,
    Shape,
    VariableArray,
    VariableText,
    show,
)

_INLINE_MAX = 1024  # bytes of an array whose elements are arguments of `pack`, one by one
_SLOTS_MAX = 4096  # values of a class from which on arrays are no longer inlined: Python takes 6 us to compile each

# `encode` catches everything: users put objects of any kind into messages, and any exception when these are checked or
# packed (OverflowError, AttributeError, one of their own) means that they do not fit.
_FIXED = """
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

def write(message):
    return (encode(message),)

def read(data, at):
    end = at + {size}
    return decode(data[at:end]), end
"""
_VARIABLE = """
def write(message):
    {check}
    return {pieces}

def encode(message):
    try:
        {inner_check}
        return join({pieces})
    except Exception:
        raise misfit(message) from None

def read(data, at):
    size = len(data)
    {read}
    return {value}, at

def decode(data):
    size = len(data)
    try:
        {known}at = 0
        {inner_read}
        if at != size:
            raise ValueError(f"{{size - at}} bytes are left over")
{learn}        return {value}
    except (StructError, TypeError, ValueError) as error:
        raise unreadable(data, error) from None
"""


def functions(cls: type[Any], fields: tuple[Field, ...]) -> Packing:
    """Generate the functions of a message class with these fields."""
    source = _SourceCode()
    value = source.add_message(cls, fields, "message")
    text = source.finish(value)

    def misfit(message: object) -> MessageError:
        return _misfit(cls, fields, message)

    def unreadable(data: bytes, reason: object) -> DecodeError:
        kind = TooLong if isinstance(reason, TooLong) else DecodeError
        if not source.varies and len(data) != source.size:
            reason = f"takes {source.size} bytes, not {len(data)}"
        return kind(f"{cls.__name__}: {reason}")

    names = source.names | {"misfit": misfit, "unreadable": unreadable}
    names["__tracebackhide__"] = True  # pytest's: a frame without source is of no use
    file = f"{__file__}, {cls.__name__}"  # in this folder, as for all frames that short tracebacks leave out
    exec(compile(text, file, "exec"), names)  # noqa: S102 - holds nothing but checked names
    return Packing(names["encode"], names["decode"], names["write"], names["read"], sharing_of_fields(fields))


class _SourceCode:
    """The parts of the source: checks, then runs of fields of fixed size, and what varies in between.

    `values` are the arguments of the `pack` of the present run; `slots` the results of its `unpack`.
    """

    def __init__(self) -> None:
        self.names: dict[str, Any] = {
            "Array": Array,
            "StructError": struct.error,
            "bad_count": bad_count,
            "bytes_of": bytes_of,
            "chars": pack_chars,
            "new": object.__new__,
            "join": b"".join,
            "text": unpack_chars,
            "view_of": view_of,
        }
        self.checks: list[str] = []
        self.size = 0
        self.varies = False
        self._formats: list[str] = []
        self._values: list[str] = []
        self._slots: list[str] = []
        self._slot_count = 0
        self._pieces: list[str] = []
        self._reads: list[str] = []
        self._known = KnownLengths()
        self._last_run: tuple[str, list[str]] | None = None  # format and values, unless a text is packed with it
        self._short_text = ""  # the local with its length, if one is the last piece

    def finish(self, value: str) -> str:
        """Return the source; `value` is the expression that rebuilds the message from the slots."""
        if not self._pieces:  # one struct for everything, which is faster than an offset that grows
            packed = struct.Struct("<" + "".join(self._formats))
            self.size = packed.size
            self.names |= {"pack": packed.pack, "unpack": packed.unpack}
            slots = ", ".join(self._slots)
            flat = value == f"T({slots})"  # then the slots need no names, which is faster
            unpacked = f"{slots}, = unpack(data)" if slots else "unpack(data)"
            read = "return T(*unpack(data))" if flat else f"{unpacked}\n        return {value}"
            return _FIXED.format(
                check=_lines(self.checks, 8), values=", ".join(self._values), read=read, size=packed.size
            )
        self._end_run()
        fast, learn = self._known.source(value)
        self.names |= self._known.names
        return _VARIABLE.format(
            check=_lines(self.checks, 4),
            inner_check=_lines(self.checks, 8),
            pieces=f"({', '.join(self._pieces)},)",
            read=_lines(self._reads, 4),
            known="".join(f"{line}\n        " for line in fast),
            inner_read=_lines(self._reads, 8),
            learn="".join(f"        {line}\n" for line in learn),
            value=value,
        )

    def add(self, shape: Shape, value: str) -> str:
        """Add the packing of the expression `value`; return the expression that rebuilds it from slots."""
        match shape:
            case Nested(inner):
                return self.add_message(inner.cls, inner.fields, value)
            case FixedArray(item, count, "tuple") if not item.varies and self._may_inline(shape):
                return self.add_array(item, count, value)
            case Chars(length):
                return f"text({self._add_fixed(shape.format, f'chars({value}, {length})')})"
            case Scalar(kind):
                if kind == "bool":
                    value = self.local(value)
                    self.refuse(f"{value} is not True and {value} is not False")
                return self._add_fixed(shape.format, value)
            case VariableText(limit):
                return self._add_counted(f"{value}.encode()", limit, 1, ".decode()")
            case VariableArray(Scalar(), limit, "bytes"):
                return self._add_counted(f"bytes_of({value})", limit, 1)
            case VariableArray(Scalar() as item, limit, "array"):
                return self._add_view(item, limit, value)
            case _:
                return self._add_part(shape, value)

    def _may_inline(self, shape: Shape) -> bool:
        return shape.size <= _INLINE_MAX and self._slot_count < _SLOTS_MAX

    def add_array(self, item: Shape, count: int, value: str) -> str:
        local = self.local(value)
        self.refuse(f"not isinstance({local}, tuple) or len({local}) != {count}")
        if not isinstance(item, Scalar):
            return f"({', '.join([self.add(item, f'{local}[{i}]') for i in range(count)])},)"
        if item.kind == "bool":
            self.refuse(f"{{*map(type, {local})}} != {{bool}}")
        self._formats.append(f"{count}{item.format}")
        self._values.append(f"*{local}")
        return f"({', '.join([self._slot() for _ in range(count)])},)"

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

    def _add_fixed(self, format: str, value: str) -> str:
        self._formats.append(format)
        self._values.append(value)
        return self._slot()

    def _add_view(self, item: Scalar, limit: int, value: str) -> str:
        """Add an array field: mostly an Array, which is packed and made without a call of Python."""
        local, code = self.local(value), repr(item.format)
        is_array = f"{local}.__class__ is Array and {local}._code == {code}"
        packed = f"{local}._view if {is_array} else view_of({local}, {code})"
        empty = f"empty_{item.format if item.format != '?' else 'bool'}"
        self.names[empty] = from_view(memoryview(b"").cast(item.format), item.format)  # type: ignore[call-overload]
        return self._add_counted(packed, limit, item.size, read=_read_array(item.format, empty))

    def _add_counted(self, packed: str, limit: int, item_size: int, convert: str = "", read: str = "") -> str:
        """Add elements that are one piece, `packed`: their count is the last number of the run before them.

        `convert` and `read` are those of `Elements`.
        """
        self.varies = True
        local = self.local(packed)
        length = self.local(f"len({local})")
        self.checks.append(f"if {length} > {limit}: raise ValueError")
        count = self._add_fixed("I", length)
        size = self._end_run()
        self._pieces.append(local)
        slot = f"v{self._slot_count}"
        self._slot_count += 1
        self._short_text = length if convert and limit <= SHORT_TEXT and self._last_run else ""
        elements = Elements(count, slot, item_size, convert, read)
        self._known.add_elements(elements)
        self._reads[-1] = f"begin = at + {size}"  # instead of the sum that it ends with, which is slower
        self._reads += [
            f"at = begin + {count}" + f" * {item_size}" * (item_size > 1),
            f"if {count} > {limit} or at > size: raise bad_count({count}, {limit}, size - begin, {item_size})",
            *elements.lines("begin:at"),
        ]
        return slot

    def _add_part(self, shape: Shape, value: str) -> str:
        self._end_run()
        self._short_text = ""
        self._known.add_part()
        number = len(self.names)
        self.names[f"write{number}"], self.names[f"read{number}"] = part(shape)
        self.varies = self.varies or shape.varies
        self._pieces.append(f"*write{number}({value})")
        slot = self._slot()
        self._slots.clear()
        self._reads.append(f"{slot}, at = read{number}(data, at)")
        return slot

    def _end_run(self) -> int:
        """Pack the fields since the last part as one struct; return its bytes."""
        if not self._formats:
            return 0
        code = "".join(self._formats)
        self._add_packed(code, self._values)
        packed, unpack = struct.Struct("<" + code), f"unpack{len(self.names)}"
        self.names[unpack] = packed.unpack_from
        self._reads += [f"{', '.join(self._slots)}, = {unpack}(data, at)", f"at += {packed.size}"]
        self._known.add_run(self._formats, self._slots)
        for run in (self._formats, self._values, self._slots):
            run.clear()
        return packed.size

    def _add_packed(self, code: str, values: list[str]) -> None:
        """Add the piece of a run; if there is a short text before it, both are one struct with the run before that."""
        name = f"pack{len(self.names)}"
        if self._short_text and self._last_run:
            code_before, values_before = self._last_run
            self.names[name] = StructsWithText(code_before, code)
            arguments = [*values_before, self._pieces[-1], *values]
            self._pieces[-2:] = [f"{name}[{self._short_text}]({', '.join(arguments)})"]
            self._short_text, self._last_run = "", None
        else:
            self.names[name] = struct.Struct("<" + code).pack
            self._pieces.append(f"{name}({', '.join(values)})")
            self._last_run = code, values.copy()

    def _slot(self) -> str:
        self._slots.append(f"v{self._slot_count}")
        self._slot_count += 1
        return self._slots[-1]


def _read_array(code: str, empty: str) -> str:
    """Return the statements that make an Array without a call of Python, with fields as in `Elements.read`."""
    cast = "" if code == "B" else f".cast({code!r})"
    return f"""
if {{count}}:
    {{value}} = new(Array)
    {{value}}._code = {code!r}
    {{value}}._view = memoryview(data)[{{place}}]{cast}
else:
    {{value}} = {empty}
""".strip()


def _lines(lines: list[str], indent: int) -> str:
    return ("\n" + " " * indent).join(lines)


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
    if not _fits(shape, value):
        raise MessageError(f"{path} ({shape.kind}) takes {shape.allowed}, not {show(value)}")
    for inner in _parts(shape, value, path):
        check(*inner)


def _fits(shape: Shape, value: Any) -> bool:
    """Return whether a value fits, apart from its parts."""
    match shape:
        case FixedArray(_, count, "tuple"):
            return isinstance(value, tuple) and len(value) == count
        case VariableArray(_, limit, "tuple"):
            return isinstance(value, tuple) and len(value) <= limit
        case FixedArray() | VariableArray():
            return _packs(shape, value)
        case Nested(inner):
            return type(value) is inner.cls
        case Scalar() | Chars() | VariableText():
            return shape.holds(value)


def _parts(shape: Shape, value: Any, path: str) -> Iterator[tuple[Shape, Any, str]]:
    match shape:
        case FixedArray(item, _, "tuple") | VariableArray(item, _, "tuple"):
            for i, each in enumerate(value):
                yield item, each, f"{path}[{i}]"
        case Nested(inner):
            for field in inner.fields:
                yield field.shape, getattr(value, field.name), f"{path}.{field.name}"


def _packs(shape: Shape, value: Any) -> bool:
    write, _ = part(shape)
    try:
        list(write(value))
    except Exception:  # noqa: BLE001 - as in `encode`: any exception means that the value does not fit
        return False
    return True
