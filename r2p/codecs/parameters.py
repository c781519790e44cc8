"""What r2p's own services carry of parameters (PROTOCOL.md 9): descriptions, and the changes of a set.

A text is `u8 size` and its bytes in UTF-8. A value is `u8 kind`, and behind it

| kind | |
| --- | --- |
| 0 | nothing: there is no value; in a set: the value of the start again |
| 1 bool | `u8`, 0 or 1 |
| 2 int, 3 float | `i64`, `f64` |
| 4 str, 5 enum | a text: the value, the name of the member |
| 6 ints, 7 floats | `u8 count`, `i64` or `f64` each |
"""

import enum
import struct
from collections.abc import Callable, Iterable, Mapping

import msgspec

from r2p.errors import DecodeError, InvalidName, MessageError
from r2p.names import node_name, parameter_name

Plain = bool | int | float | str | tuple[int, ...] | tuple[float, ...]
"""A value outside of its node: a member of an enum is its name."""

Name = tuple[str, str]
"""The names of a node and of its parameter."""

VERSION = 1

_LIST = struct.Struct("<BIB")  # version, revision, whole
_RECORD = struct.Struct("<HBB")  # bytes of the record behind these two, flags, origin
_PART = struct.Struct("<II")
_COUNT = struct.Struct("<I")
_INT, _FLOAT = struct.Struct("<q"), struct.Struct("<d")
_READ_ONLY = 1
_TEXT_MAX = 255
_RECORD_MAX = (1 << 16) - 1


class ParameterKind(enum.IntEnum):
    """The kinds of parameters, and of values."""

    BOOL = 1
    INT = 2
    FLOAT = 3
    STR = 4
    ENUM = 5
    INTS = 6
    FLOATS = 7

    @property
    def text(self) -> str:
        """The kind as users read it: "bool", "int", "float", "str", "enum", "ints", "floats"."""
        return self.name.lower()


class Origin(enum.IntEnum):
    """Where a value comes from; up to RUN_TIME, a greater one wins."""

    CODE = 0
    SAVED = 1
    CONFIG = 2
    FILE = 3
    OPTION = 4
    ARGUMENT = 5
    RUN_TIME = 6
    PROGRAM = 7

    @property
    def text(self) -> str:
        """The origin as users read it."""
        return _ORIGINS[self]


_ORIGINS = ("code", "saved file", "r2p.toml", "--params", "--param", "params=", "run time", "program")


class ParameterRecord(msgspec.Struct, frozen=True, kw_only=True):
    """A parameter as its module describes it: `r2p.ParameterInfo` says what the attributes mean."""

    node: str
    name: str
    kind: str
    value: Plain
    default: Plain
    minimum: float | None = None
    maximum: float | None = None
    unit: str = ""
    doc: str = ""
    read_only: bool = False
    choices: tuple[str, ...] = ()
    origin: str = "code"
    saved: Plain | None = None
    problem: str = ""


class ParameterList(msgspec.Struct, frozen=True):
    """The parameters of a module at a revision: all of them (`whole`), or those that have changed."""

    revision: int
    whole: bool
    records: list[ParameterRecord]


class _ValueReader:
    """Reads values from bytes. Its methods raise DecodeError where there are too few."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    @property
    def left(self) -> int:
        return len(self._data) - self._at

    def bytes(self, size: int) -> bytes:
        if size > self.left:
            raise DecodeError(f"{size} bytes are announced, {self.left} are there")
        self._at += size
        return self._data[self._at - size : self._at]

    def unpack(self, form: struct.Struct) -> tuple[int, ...]:
        return form.unpack(self.bytes(form.size))

    def number(self, form: struct.Struct) -> int | float:
        (number,) = form.unpack(self.bytes(form.size))
        return number  # type: ignore[no-any-return]

    def byte(self) -> int:
        return self.bytes(1)[0]

    def text(self) -> str:
        try:
            return self.bytes(self.byte()).decode()
        except UnicodeDecodeError as error:
            raise DecodeError(f"a text that is not UTF-8: {error.reason}") from None

    def name(self, check: Callable[[str], str]) -> str:
        try:
            return check(self.text())
        except InvalidName as error:
            raise DecodeError(str(error)) from None

    def value(self) -> Plain | None:
        number = self.byte()
        if not number:
            return None
        try:
            kind = ParameterKind(number)
        except ValueError:
            raise DecodeError(f"values of kind {number} are unknown to this version of r2p") from None
        match kind:
            case ParameterKind.BOOL:
                return self._bool()
            case ParameterKind.INT:
                return self.number(_INT)
            case ParameterKind.FLOAT:
                return self.number(_FLOAT)
            case ParameterKind.STR | ParameterKind.ENUM:
                return self.text()
        form = _INT if kind is ParameterKind.INTS else _FLOAT
        numbers = struct.iter_unpack(form.format, self.bytes(self.byte() * form.size))
        return tuple(each for (each,) in numbers)

    def limit(self) -> float | None:
        value = self.value()
        if isinstance(value, bool | str | tuple):
            raise DecodeError(f"a limit of {value!r}")
        return value

    def kind(self) -> ParameterKind:
        """Return the kind of the value that comes next."""
        number = self._data[self._at] if self.left else 0
        if number not in list(ParameterKind):
            raise DecodeError(f"parameters of kind {number} are unknown to this version of r2p")
        return ParameterKind(number)

    def _bool(self) -> bool:
        number = self.byte()
        if number > 1:
            raise DecodeError(f"a bool of {number}")
        return number == 1


def encode_list(listed: ParameterList) -> bytes:
    """Encode the answer to PARAMETERS or PARAMETER_CHANGES. Raises MessageError for what a message can't carry."""
    head = _LIST.pack(VERSION, listed.revision & 0xFFFFFFFF, listed.whole)
    return head + b"".join(map(_encode_record, listed.records))


def decode_list(data: bytes) -> ParameterList:
    """Decode the answer to PARAMETERS or PARAMETER_CHANGES; what later versions add to a record is left out.

    Raises DecodeError, also for names that no node or parameter can have: tools offer them to shells.
    """
    reader = _ValueReader(data)
    version, revision, whole = reader.unpack(_LIST)
    if version != VERSION:
        raise DecodeError(f"a list of parameters of version {version}")
    records = []
    while reader.left:
        size, flags, origin = reader.unpack(_RECORD)
        records.append(_decode_record(_ValueReader(reader.bytes(size)), flags, origin))
    return ParameterList(revision, whole == 1, records)


def _encode_record(record: ParameterRecord) -> bytes:
    kind = ParameterKind[record.kind.upper()]
    body = b"".join(
        (
            encode_text(record.node),
            encode_text(record.name),
            encode_value(record.default, kind),
            encode_value(record.value, kind),
            encode_value(record.minimum),
            encode_value(record.maximum),
            encode_value(record.saved, kind),
            encode_text(record.unit),
            encode_text(record.doc),
            encode_text(record.problem.encode()[:_TEXT_MAX].decode(errors="ignore")),
            bytes((len(record.choices),)),
            *map(encode_text, record.choices),
        )
    )
    if len(body) > _RECORD_MAX:
        raise MessageError(f"the description of {record.node}.{record.name} has {len(body)} bytes")
    return _RECORD.pack(len(body), record.read_only * _READ_ONLY, _ORIGINS.index(record.origin)) + body


def _decode_record(reader: _ValueReader, flags: int, origin: int) -> ParameterRecord:
    node, name, kind = reader.name(node_name), reader.name(parameter_name), reader.kind()
    default, value = reader.value(), reader.value()
    if default is None or value is None:
        raise DecodeError(f"{node}.{name} has no value")
    return ParameterRecord(
        node=node,
        name=name,
        kind=kind.text,
        default=default,
        value=value,
        minimum=reader.limit(),
        maximum=reader.limit(),
        saved=reader.value(),
        unit=reader.text(),
        doc=reader.text(),
        problem=reader.text(),
        choices=tuple(reader.text() for _ in range(reader.byte())),
        read_only=bool(flags & _READ_ONLY),
        origin=_ORIGINS[origin] if origin < len(_ORIGINS) else f"origin {origin}",
    )


def encode_changes(changes: Mapping[Name, Plain | None]) -> bytes:
    """Encode what a set stages: values by (node, name), None for that of the start. Raises MessageError."""
    return b"".join(
        encode_text(node) + encode_text(name) + encode_value(value) for (node, name), value in changes.items()
    )


def decode_changes(data: bytes) -> dict[Name, Plain | None]:
    """Decode what a set stages. Raises DecodeError, also for a parameter that is in it twice."""
    reader = _ValueReader(data)
    changes: dict[Name, Plain | None] = {}
    while reader.left:
        name = reader.text(), reader.text()
        if name in changes:
            raise DecodeError(f"{name[0]}.{name[1]} is set twice")
        changes[name] = reader.value()
    return changes


def encode_part(stage: int, offset: int, data: bytes = b"") -> bytes:
    """Encode the argument of PARAMETER_STAGE; and without data that of PARAMETER_COMMIT, `offset` being the size."""
    return _PART.pack(stage, offset) + data


def decode_part(argument: bytes) -> tuple[int, int, bytes]:
    """Decode an argument of PARAMETER_STAGE or PARAMETER_COMMIT. Raises DecodeError."""
    reader = _ValueReader(argument)
    stage, offset = reader.unpack(_PART)
    return stage, offset, reader.bytes(reader.left)


def encode_count(count: int) -> bytes:
    """Encode a number: of a stage, of parameters, or a revision."""
    return _COUNT.pack(count & 0xFFFFFFFF)


def decode_count(data: bytes) -> int:
    """Decode a number. Raises DecodeError; what later versions add is left out."""
    return _ValueReader(data).unpack(_COUNT)[0]


def encode_text(text: str) -> bytes:
    """Encode a text. Raises MessageError for one of more than 255 bytes, or that UTF-8 can't express."""
    try:
        data = text.encode()
    except UnicodeEncodeError:
        raise MessageError("a text with a character that UTF-8 does not have") from None
    return bytes((_fits(len(data), "bytes of UTF-8"),)) + data


def encode_value(value: Plain | None, kind: ParameterKind | None = None) -> bytes:
    """Encode a value, of this kind or that of its type. Raises MessageError for one that can't be a parameter's."""
    kind = _kind_of(value) if kind is None or value is None else kind
    return bytes((0 if kind is None else kind,)) + _encode_bare(value)


def _encode_bare(value: Plain | None) -> bytes:
    match value:
        case None:
            return b""
        case bool():
            return bytes((value,))
        case int():
            return _packed(_INT, value)
        case float():
            return _FLOAT.pack(value)
        case str():
            return encode_text(value)
    form = _INT if _kind_of(value) is ParameterKind.INTS else _FLOAT
    return bytes((_fits(len(value), "numbers"),)) + b"".join(_packed(form, each) for each in value)


def _packed(form: struct.Struct, value: float) -> bytes:
    try:
        return form.pack(value)
    except (struct.error, OverflowError):
        raise MessageError("a number of more than 64 bits") from None


def _kind_of(value: object) -> ParameterKind | None:
    match value:
        case None:
            return None
        case bool():
            return ParameterKind.BOOL
        case int():
            return ParameterKind.INT
        case float():
            return ParameterKind.FLOAT
        case str():
            return ParameterKind.STR
        case tuple() if _are(value, int):
            return ParameterKind.INTS
        case tuple() if _are(value, int | float):
            return ParameterKind.FLOATS
    raise MessageError(f"a {type(value).__name__} is not a value that a parameter can have")


def _are(values: Iterable[object], kind: object) -> bool:
    return all(isinstance(each, kind) and not isinstance(each, bool) for each in values)  # type: ignore[arg-type]


def _fits(count: int, what: str) -> int:
    if count > _TEXT_MAX:
        raise MessageError(f"{count} {what}, at most {_TEXT_MAX} are possible")
    return count
