"""Messages of a fixed size: a packed body, then a type byte, as on the topics `R2P` and `BOOT_<module>`.

One table describes all of them: for each frozen struct its type byte and, attribute by attribute, the formats of the
`struct` module (`x` is a byte without an attribute). A `str` attribute is a name: padded with NUL, and without a
terminator when it fills its field.
"""

import struct
from typing import Generic, TypeVar

import msgspec

from r2p.codecs import UnknownType
from r2p.errors import DecodeError, MessageError

T = TypeVar("T", bound=msgspec.Struct)


class Record(Generic[T]):
    """The wire format of one struct, little-endian and without gaps: `Record(Alive, ManagementType.ALIVE, "7s x B")`.

    `version` is the body's first byte, for types that have one. `may_be_empty` lists the names that may be empty, and
    `may_be_damaged` those with any characters: one that is not printable ASCII is decoded as `?`.
    """

    def __init__(
        self,
        cls: type[T],
        code: int,
        kinds: str,
        *,
        version: int | None = None,
        may_be_empty: tuple[str, ...] = (),
        may_be_damaged: tuple[str, ...] = (),
    ) -> None:
        self.cls = cls
        self.code = code
        self.version = version
        self._may_be_empty = may_be_empty
        self._may_be_damaged = may_be_damaged
        self._format = struct.Struct("<" + kinds)
        formats = [kind for kind in kinds.split() if kind != "x"]
        fields = zip(msgspec.structs.fields(cls), formats, strict=True)
        self._fields = [(field.name, kind, field.type is str) for field, kind in fields]

    def pack(self, message: T) -> bytes:
        return self._format.pack(*(self._packable(message, name, kind) for name, kind, _ in self._fields))

    def unpack(self, body: bytes) -> T:
        values = zip(self._fields, self._format.unpack_from(body), strict=True)
        return self.cls(*(self._name(name, value) if is_name else value for (name, _, is_name), value in values))

    def _packable(self, message: T, name: str, kind: str) -> int | bytes:
        """Return the value of an attribute, checked: `struct` itself would cut and pad bytes without an error."""
        value: int | str | bytes = getattr(message, name)
        size = struct.calcsize(kind)
        if isinstance(value, int):
            try:
                struct.pack("<" + kind, value)
            except struct.error:
                raise self._error(name, value, f"takes {size} unsigned bytes") from None
            return value
        if isinstance(value, bytes):
            if len(value) != size:
                raise self._error(name, value, f"takes {size} bytes, not {len(value)}")
            return value
        if not (value or name in self._may_be_empty) or len(value) > size or not _is_plain(value):
            raise self._error(name, value, f"takes a name of 1 to {size} printable ASCII characters")
        return value.encode()

    def _error(self, name: str, value: int | str | bytes, what: str) -> MessageError:
        return MessageError(f"{self.cls.__name__}.{name} = {value!r}: {what}")

    def _name(self, name: str, field: bytes) -> str:
        text = field.partition(b"\0")[0].decode("latin-1")
        if name in self._may_be_damaged:
            text = "".join(each if _is_plain(each) else "?" for each in text)
        if not (text or name in self._may_be_empty) or not _is_plain(text):
            raise DecodeError(f"{self.cls.__name__}.{name}: {text!r} is not a valid name")
        return text


class Codec(Generic[T]):
    """Encodes and decodes a family of records of `size` bytes each, which differ in their last byte."""

    def __init__(self, size: int, *records: Record[T]) -> None:
        self._size = size
        self._by_class: dict[type[msgspec.Struct], Record[T]] = {record.cls: record for record in records}
        self._by_code = {record.code: record for record in records}

    def encode(self, message: T) -> bytes:
        record = self._by_class[type(message)]
        version = b"" if record.version is None else bytes((record.version,))
        return (version + record.pack(message)).ljust(self._size - 1, b"\0") + bytes((record.code,))

    def code_of(self, message: T) -> int:
        return self._by_class[type(message)].code

    def decode(self, data: bytes) -> T:
        if len(data) != self._size:
            raise DecodeError(f"{len(data)} bytes instead of {self._size}")
        record = self._by_code.get(data[-1])
        if record is None:
            raise UnknownType(f"unknown type 0x{data[-1]:02X}")
        if record.version is None:
            return record.unpack(data)
        if data[0] != record.version:
            raise UnknownType(f"version {data[0]} of {record.cls.__name__}")
        return record.unpack(data[1:])


def _is_plain(text: str) -> bool:
    return text.isascii() and text.isprintable()
