"""Parts of messages of r2p's own services, as management messages: for buses and lines of 32 bytes (PROTOCOL.md 9).

A message is cut into pieces of 23 bytes, each in a CALL_PART: `u8 version; u32 sender; u8 serial; u8 part; u8 length;
u8 piece[23]`, and the type byte. Firmware ignores the type, as do modules of before. `sender` is the instance of the
module that puts the message on this link, `serial` counts its messages, `length` is that of the whole message.
"""

import struct

import msgspec

from r2p.codecs import UnknownType
from r2p.codecs.management import SIZE, ManagementType
from r2p.codecs.own_services import MESSAGE_MAX
from r2p.errors import DecodeError

SERIALS = 256
"""Values of `serial`."""

_VERSION = 1
_PIECE = 23
_FORMAT = struct.Struct(f"<BIBBB{_PIECE}sB")


class CallPart(msgspec.Struct, frozen=True, gc=False):
    """One part. `part` is its number, from 0; `piece` has no padding."""

    sender: int
    serial: int
    part: int
    length: int
    piece: bytes


def count(length: int) -> int:
    """Return the number of parts of a message of so many bytes."""
    return -(-length // _PIECE)


def encode(sender: int, serial: int, data: bytes) -> list[bytes]:
    """Encode the parts of a message of 1 to 200 bytes, in order."""
    size = len(data)
    pieces = [data[at : at + _PIECE] for at in range(0, size, _PIECE)]
    code = ManagementType.CALL_PART
    return [_FORMAT.pack(_VERSION, sender, serial, part, size, piece, code) for part, piece in enumerate(pieces)]


def decode(data: bytes) -> CallPart:
    """Decode a part. Raises UnknownType for one of another version, DecodeError for an impossible one."""
    if len(data) != SIZE or data[-1] != ManagementType.CALL_PART:
        raise DecodeError("not a part of a call")
    version, sender, serial, part, length, piece, _ = _FORMAT.unpack(data)
    if version != _VERSION:
        raise UnknownType(f"version {version} of a part of a call")
    if not (1 <= length <= MESSAGE_MAX and part < count(length)):
        raise DecodeError(f"part {part} of a message of {length} bytes")
    return CallPart(sender, serial, part, length, piece[: length - part * _PIECE])
