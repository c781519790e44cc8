"""The messages of a service (PROTOCOL.md 9): a header of 12 bytes, then the packed request or response.

A service NAME is a pair of topics, `NAME_q` for requests and `NAME_r` for responses. Both begin with the same header:

| bytes | content |
| --- | --- |
| 0..3 | `u32 instance` of the caller's module |
| 4..5 | `u16 number` of the call, counted by the caller |
| 6 | `u8 kind`: 0 request, 1 cancel, 2 response, 3 error, 4 busy; 5 working, of r2p's own services only |
| 7 | `u8 version`, 1 |
| 8..11 | `u32 server`: the instance of the server's module; 0: any server, or one without an instance |

The messages of a topic of fixed size all have that size: behind a cancel and a busy follow zeros, behind an error its
text, as much as fits (if that is 16 bytes or more), and zeros. Where the length varies, there are no zeros.
"""

import enum
import struct
from collections.abc import Collection

import msgspec

from r2p.codecs import UnknownType
from r2p.errors import DecodeError

HEADER_SIZE = 12
"""Bytes before each request and response."""

VERSION = 1

NUMBERS = 1 << 16
"""Numbers of calls: after the last one follows 0."""

TEXT_MIN = 16
"""Bytes of an error's text for which there has to be room."""

REQUESTS, RESPONSES = "_q", "_r"
"""The ends of the names of a service's two topics."""

_CUT = b"..."
_HEADER = struct.Struct("<IHBBI")


class Kind(enum.IntEnum):
    """The kinds of messages on the two topics: REQUEST and CANCEL from the caller, the others from the server.

    WORKING, that the request has arrived and is being worked on, is of r2p's own services only.
    """

    REQUEST = 0
    CANCEL = 1
    RESPONSE = 2
    ERROR = 3
    BUSY = 4
    WORKING = 5


_KINDS = {int(kind): kind for kind in Kind}


class ServiceHeader(msgspec.Struct, frozen=True, gc=False):
    """The header of a message; `server` 0: any."""

    instance: int
    number: int
    kind: Kind
    server: int = 0


def encode(header: ServiceHeader, body: bytes = b"", size: int = 0) -> bytes:
    """Encode a message; with `size`, the topic's fixed size in bytes, cut off or filled with zeros."""
    return pack(header.instance, header.number, header.kind, header.server, body, size)


def pack(instance: int, number: int, kind: Kind, server: int, body: bytes, size: int) -> bytes:
    """Encode a message, as `encode` does, of the parts of its header: without an object for each call."""
    data = _HEADER.pack(instance, number, kind, VERSION, server) + body
    return data if not size or len(data) == size else data[:size].ljust(size, b"\0")


def decode(data: bytes) -> ServiceHeader:
    """Decode the header of a message. Raises DecodeError, UnknownType for one of another kind or version."""
    if len(data) < HEADER_SIZE:
        raise DecodeError(f"a message of a service has {HEADER_SIZE} bytes or more, not {len(data)}")
    instance, number, kind, version, server = _HEADER.unpack_from(data)
    if version != VERSION or kind not in _KINDS:
        raise UnknownType(f"kind {kind} of version {version}")
    return ServiceHeader(instance, number, _KINDS[kind], server)


def encode_text(text: str, room: int) -> bytes:
    """Encode the text of an error in at most `room` bytes of UTF-8; a text that is cut off ends with `...`.

    With less than `TEXT_MIN` bytes it would be of no use: then the text is empty.
    """
    if room < TEXT_MIN:
        return b""
    data = text.replace("\0", "?").encode(errors="replace")
    if len(data) <= room:
        return data
    return data[: room - len(_CUT)].decode(errors="ignore").encode() + _CUT


def decode_text(body: bytes) -> str:
    """Decode the text of an error, up to its first NUL; bytes that are not UTF-8 become U+FFFD."""
    return body.partition(b"\0")[0].decode(errors="replace")


def is_of_service(name: str, topics: Collection[str]) -> bool:
    """Return whether a topic is one of the pair of a service, by its name and that of the other one."""
    base, end = name[: -len(REQUESTS)], name[-len(REQUESTS) :]
    other = {REQUESTS: RESPONSES, RESPONSES: REQUESTS}.get(end)
    return other is not None and base + other in topics
