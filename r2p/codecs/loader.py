"""The messages of a module's loader, topic `BOOT_<module>`: a 30-byte body and a type byte (PROTOCOL.md 5).

Addresses are in the module's memory, lengths in bytes; both are unsigned 32-bit numbers. Fields of raw bytes have their
full size in both directions: how much of them is used depends on the messages before.
"""

import msgspec

from r2p.codecs._records import Codec, Record

SIZE = 31
"""Bytes of a message."""

# Nack.reason
REASON_UNKNOWN = 0
REASON_NO_MEMORY = 1
REASON_ZERO_LENGTH = 2
REASON_OUT_OF_RANGE = 3

# Nack.kind, what Nack.value holds
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


class Nack(msgspec.Struct, frozen=True, gc=False):
    """Refuse. `line` is the line of the firmware's source that refused: the only field that firmware fills."""

    line: int = 0
    reason: int = REASON_UNKNOWN
    kind: int = VALUE_NONE
    value: bytes = bytes(24)


class Ack(msgspec.Struct, frozen=True, gc=False):
    """Accept, and ask for the next message."""


class BeginLoader(msgspec.Struct, frozen=True, gc=False):
    """Open a session that loads or removes apps."""


class EndLoader(msgspec.Struct, frozen=True, gc=False):
    """Close the session."""


class LinkingSetup(msgspec.Struct, frozen=True, gc=False):
    """The lengths of an app's sections and stack, its name (8 characters), and FLAG_ENABLED or 0."""

    pgmlen: int
    bsslen: int
    datalen: int
    stacklen: int
    name: str
    flags: int = 0


class LinkingAddresses(msgspec.Struct, frozen=True, gc=False):
    """The addresses that an app is to be linked to."""

    infoadr: int
    pgmadr: int
    bssadr: int
    dataadr: int
    datapgmadr: int
    nextadr: int


class LinkingOutcome(msgspec.Struct, frozen=True, gc=False):
    """The addresses and lengths that came out of linking."""

    mainadr: int
    cfgadr: int
    cfglen: int
    ctorsadr: int
    ctorslen: int
    dtorsadr: int
    dtorslen: int


class IhexRecord(msgspec.Struct, frozen=True, gc=False):
    """One record of an Intel hex file: `kind` is its record type, `checksum` its own, `data` 16 bytes.

    The record's bytes are the first `count` of `data`; a faulty peer may say more than 16.
    """

    count: int
    offset: int
    kind: int
    data: bytes
    checksum: int


class RemoveLast(msgspec.Struct, frozen=True, gc=False):
    """Remove the app that was loaded last."""


class RemoveAll(msgspec.Struct, frozen=True, gc=False):
    """Remove all apps."""


class BeginAppinfo(msgspec.Struct, frozen=True, gc=False):
    """Open a listing of the apps."""


class EndAppinfo(msgspec.Struct, frozen=True, gc=False):
    """Close the listing."""


class AppinfoSummary(msgspec.Struct, frozen=True, gc=False):
    """The number of installed apps, and the bounds of the memory for apps."""

    numapps: int
    freeadr: int
    pgmstartadr: int
    pgmendadr: int
    ramstartadr: int
    ramendadr: int


class BeginSetparam(msgspec.Struct, frozen=True, gc=False):
    """Open the setting of a parameter."""


class EndSetparam(msgspec.Struct, frozen=True, gc=False):
    """Close the setting."""


class BeginGetparam(msgspec.Struct, frozen=True, gc=False):
    """Open the reading of a parameter."""


class EndGetparam(msgspec.Struct, frozen=True, gc=False):
    """Close the reading."""


class ParamRequest(msgspec.Struct, frozen=True, gc=False):
    """Select a parameter: `length` bytes at `offset` in the configuration of an app, or its flags (FLAGS_WORD)."""

    offset: int
    appname: str
    length: int


class ParamChunk(msgspec.Struct, frozen=True, gc=False):
    """The next 16 bytes of a parameter."""

    data: bytes


Loader = (
    Nack
    | Ack
    | BeginLoader
    | EndLoader
    | LinkingSetup
    | LinkingAddresses
    | LinkingOutcome
    | IhexRecord
    | RemoveLast
    | RemoveAll
    | BeginAppinfo
    | EndAppinfo
    | AppinfoSummary
    | BeginSetparam
    | EndSetparam
    | BeginGetparam
    | EndGetparam
    | ParamRequest
    | ParamChunk
)

_CODEC = Codec[Loader](
    SIZE,
    Record(Nack, 0, "H B B 24s"),
    Record(Ack, 1, ""),
    Record(BeginLoader, 2, ""),
    Record(EndLoader, 3, ""),
    Record(LinkingSetup, 4, "I I I I 8s H", may_be_empty=("name",)),
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
