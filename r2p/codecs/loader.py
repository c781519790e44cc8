"""The messages of a module's loader, topic `BOOT_<module>`: a 30-byte body and a type byte (PROTOCOL.md 5).

Addresses are in the module's memory, lengths in bytes; both are unsigned 32-bit numbers. Fields of raw bytes have their
full size in both directions: the used part depends on earlier messages.
"""

from typing import dataclass_transform

import msgspec

from r2p.codecs._records import Codec, Record

SIZE = 31
"""Bytes of a message."""

# Nack.reason
REASON_UNKNOWN = 0
REASON_NO_MEMORY = 1
REASON_ZERO_LENGTH = 2
REASON_OUT_OF_RANGE = 3

# Nack.kind, the meaning of Nack.value
VALUE_NONE = 0
VALUE_TEXT = 1
VALUE_INT = 2
VALUE_UINT = 3
VALUE_ADDRESS = 4
VALUE_LENGTH = 5
VALUE_CHUNK = 6

FLAG_ENABLED = 1  # LinkingSetup.flags
FLAGS_WORD = 0xFFFFFFFF  # ParamRequest.offset of the app's flags, a u16
CHUNK = 16  # bytes of an IhexRecord or a ParamChunk


@dataclass_transform(frozen_default=True, field_specifiers=(msgspec.field,))
class Loader(msgspec.Struct, frozen=True, gc=False):
    """A message of a loader, or to one."""


class Nack(Loader):
    """Refuse. `line` is the line of the firmware's source that refused: the only field that firmware fills."""

    line: int = 0
    reason: int = REASON_UNKNOWN
    kind: int = VALUE_NONE
    value: bytes = bytes(24)


class Ack(Loader):
    """Accept, and ask for the next message."""


class BeginLoader(Loader):
    """Open a session that loads or removes apps."""


class EndLoader(Loader):
    """Close the session."""


class LinkingSetup(Loader):
    """The lengths of an app's sections and stack, its name (8 characters), and FLAG_ENABLED or 0.

    A name that the module's flash does not hold whole, after a power cut, has `?` in place of what is not printable.
    """

    pgmlen: int
    bsslen: int
    datalen: int
    stacklen: int
    name: str
    flags: int = 0


class LinkingAddresses(Loader):
    """The addresses for linking an app."""

    infoadr: int
    pgmadr: int
    bssadr: int
    dataadr: int
    datapgmadr: int
    nextadr: int


class LinkingOutcome(Loader):
    """The addresses and lengths after linking."""

    mainadr: int
    cfgadr: int
    cfglen: int
    ctorsadr: int
    ctorslen: int
    dtorsadr: int
    dtorslen: int


class IhexRecord(Loader):
    """One record of an Intel hex file: `kind` is its record type, `checksum` its own, `data` 16 bytes.

    The record's bytes are the first `count` of `data`; a faulty peer may say more than 16.
    """

    count: int
    offset: int
    kind: int
    data: bytes
    checksum: int


class RemoveLast(Loader):
    """Remove the last loaded app."""


class RemoveAll(Loader):
    """Remove all apps."""


class BeginAppinfo(Loader):
    """Open a listing of the apps."""


class EndAppinfo(Loader):
    """Close the listing."""


class AppinfoSummary(Loader):
    """The number of installed apps, and the bounds of the memory for apps."""

    numapps: int
    freeadr: int
    pgmstartadr: int
    pgmendadr: int
    ramstartadr: int
    ramendadr: int


class BeginSetparam(Loader):
    """Open the setting of a parameter."""


class EndSetparam(Loader):
    """Close the setting."""


class BeginGetparam(Loader):
    """Open the reading of a parameter."""


class EndGetparam(Loader):
    """Close the reading."""


class ParamRequest(Loader):
    """Select a parameter: `length` bytes at `offset` in the configuration of an app, or its flags (FLAGS_WORD)."""

    offset: int
    appname: str
    length: int


class ParamChunk(Loader):
    """The next 16 bytes of a parameter."""

    data: bytes


_CODEC = Codec[Loader](
    SIZE,
    Record(Nack, 0, "H B B 24s"),
    Record(Ack, 1, ""),
    Record(BeginLoader, 2, ""),
    Record(EndLoader, 3, ""),
    Record(LinkingSetup, 4, "I I I I 8s H", may_be_empty=("name",), may_be_damaged=("name",)),
    Record(LinkingAddresses, 5, "I I I I I I"),
    Record(LinkingOutcome, 6, "I I I I I I I"),
    Record(IhexRecord, 7, "B H B 16s B"),
    Record(RemoveLast, 8, ""),
    Record(RemoveAll, 9, ""),
    Record(BeginAppinfo, 10, ""),
    Record(EndAppinfo, 11, ""),
    Record(AppinfoSummary, 12, "I I I I I I"),
    Record(BeginSetparam, 13, ""),
    Record(EndSetparam, 14, ""),
    Record(BeginGetparam, 15, ""),
    Record(EndGetparam, 16, ""),
    Record(ParamRequest, 17, "I 8s B", may_be_empty=("appname",)),
    Record(ParamChunk, 18, "16s"),
)


def encode(message: Loader) -> bytes:
    """Encode a message to 31 bytes. Raises `MessageError`, which names the field, for a value that does not fit."""
    return _CODEC.encode(message)


def decode(data: bytes) -> Loader:
    """Decode 31 bytes. Raises `UnknownType` for a type to ignore, else `DecodeError`."""
    return _CODEC.decode(data)
