"""RTCAN on the wire: identifiers, fragments and the sync frame (PROTOCOL.md 6).

    bits 28..23 laxity | 22..15 high byte: the topic | 14..7 id8: the module | 6..0 fragments left
                       | 22..7 message id                                    |

This module alone knows the layout of an identifier: hot paths elsewhere shift and mask with the constants below.

The messages of a topic are all of one size, or their length varies: then each begins with its length and a checksum, as
frames say only how many of them follow.

r2p's management, of 32 bytes each, travels without most of its zeros, and the first frame of such a message is marked.
"""

import re
import struct
from binascii import crc_hqx

import msgspec

from r2p.codecs.can_bits import FRAME_MAX as FRAME_MAX  # `as`: programs find frames here, too
from r2p.codecs.can_bits import IDENTIFIER_BITS as IDENTIFIER_BITS
from r2p.codecs.can_bits import Frame as Frame
from r2p.codecs.can_bits import OtherFrame as OtherFrame
from r2p.errors import DecodeError, MessageError
from r2p.units import MILLISECOND

PAYLOAD_MAX = 1024  # bytes in a message: 128 fragments
HEADER_SIZE = 4  # bytes in front of a message whose length varies, within those
VARIABLE_MAX = PAYLOAD_MAX - HEADER_SIZE  # bytes in such a message
VARIABLE_MIN = 4  # ... unless all messages of its topic are empty: each has a count
SLOTS_MAX = 64  # in a cycle: bits in the reservation mask

HRT = 0  # laxity of hard real-time and sync
SRT_MIN = 1
SRT_MAX = 62
NRT = 63

SYNC = 0x00  # high bytes of message ids that are not topics
MANAGEMENT = 0x01
FIRST_TOPIC = 0x02
FIRMWARE_MANAGEMENT = 0x0000  # the message id of management of every module of 2014

LAXITY_SHIFT = 23
HIGH_SHIFT = 15
MESSAGE_SHIFT = 7  # also of the id8, the low byte of the message id
HIGH_MAX = ID8_MAX = 0xFF  # all ones: also the masks of these fields after shifting
MESSAGE_MAX = 0xFFFF
LEFT_MASK = 0x7F
HIGH_MASK = HIGH_MAX << HIGH_SHIFT  # filters look at these bits of the identifier
ID8_MASK = ID8_MAX << MESSAGE_SHIFT
MESSAGE_MASK = MESSAGE_MAX << MESSAGE_SHIFT
NOT_SYNC = ~ID8_MASK  # a sync frame has none of these bits: it has the cycle counter in place of an id8
CYCLE_MASK = 0xFF  # a sync frame carries these bits of the cycle counter

FIRST_MARK = 0x40  # in the fragments left of a message without its zeros: this is its first frame

_ZEROS = re.compile(rb"\0+")
_PACKED_ZEROS = re.compile(rb"\0(.)", re.DOTALL)
_ALL_SLOTS = (1 << SLOTS_MAX) - 1
_HEADER = struct.Struct("<HH")  # length and checksum
_CRC_START = 0xFFFF  # CRC-16/CCITT-FALSE: polynomial 0x1021, not reflected, no final XOR


class Identifier(msgspec.Struct, frozen=True, gc=False):
    """The parts of an identifier: laxity 0..63, message id 0..0xFFFF, fragments after this one 0..127."""

    laxity: int
    message_id: int
    left: int


class Sync(msgspec.Struct, frozen=True, gc=False):
    """The frame that starts a cycle: its counter mod 256, and a mask; bit i: slot i is reserved."""

    cycle: int
    mask: int


def encode_identifier(laxity: int, message: int, left: int = 0) -> int:
    """Return the identifier of a frame. Raises `MessageError` if a part does not fit its field."""
    if not (0 <= laxity <= NRT and 0 <= message <= MESSAGE_MAX and 0 <= left <= LEFT_MASK):
        parts = f"laxity {laxity} (0..{NRT}), message id {message:#x} (0..{MESSAGE_MAX:#x})"
        raise MessageError(f"does not fit the identifier: {parts}, {left} fragments left (0..{LEFT_MASK})")
    return laxity << LAXITY_SHIFT | message << MESSAGE_SHIFT | left


def decode_identifier(identifier: int) -> Identifier:
    """Return the parts of an identifier. Raises `DecodeError` for more than 29 bits."""
    if identifier >> IDENTIFIER_BITS:
        raise DecodeError(f"{identifier:#x} has more than 29 bits")
    return Identifier(laxity_of(identifier), message_of(identifier), identifier & LEFT_MASK)


def laxity_of(identifier: int) -> int:
    """Return the laxity in an identifier."""
    return identifier >> LAXITY_SHIFT


def message_of(identifier: int) -> int:
    """Return the message id in an identifier."""
    return identifier >> MESSAGE_SHIFT & MESSAGE_MAX


def high_filter(high: int) -> tuple[int, int]:
    """Return the identifier and the mask of a filter for all messages with this high byte."""
    return high << HIGH_SHIFT, HIGH_MASK


def id8_filter(id8: int) -> tuple[int, int]:
    """Return the identifier and the mask of a filter for all messages of the module `id8`."""
    return id8 << MESSAGE_SHIFT, ID8_MASK


def message_filter(message: int) -> tuple[int, int]:
    """Return the identifier and the mask of a filter for one message id."""
    return message << MESSAGE_SHIFT, MESSAGE_MASK


def message_id(high: int, id8: int) -> int:
    """Return the id of a topic (or SYNC, MANAGEMENT) at the module `id8`. Raises `MessageError` beyond a byte each."""
    if not (0 <= high <= HIGH_MAX and 0 <= id8 <= ID8_MAX):
        raise MessageError(f"high byte {high}, id8 {id8}: each is a byte")
    return high << 8 | id8


def high_byte(message: int) -> int:
    """Return the high byte of a message id: the topic."""
    return message >> 8


def id8_of(message: int) -> int:
    """Return the low byte of a message id: the module."""
    return message & ID8_MAX


def srt_laxity(remaining: int) -> int:
    """Return the laxity of a soft real-time message, 1..62, with `remaining` ns to its deadline, which may be over."""
    laxity = remaining // MILLISECOND
    if laxity < SRT_MIN:
        return SRT_MIN
    if laxity > SRT_MAX:
        return SRT_MAX
    return laxity


def fragment_count(size: int) -> int:
    """Return how many frames carry `size` bytes. Raises `MessageError` beyond 1..1024."""
    if not 1 <= size <= PAYLOAD_MAX:
        raise MessageError(f"RTCAN carries 1 to {PAYLOAD_MAX} bytes in a message, not {size}")
    return (size + FRAME_MAX - 1) // FRAME_MAX


def fragments(payload: bytes) -> list[tuple[int, bytes]]:
    """Return a message's frames in order, as (fragments left, data). Raises `MessageError` beyond 1..1024 bytes."""
    count = fragment_count(len(payload))
    if count == 1:
        return [(0, payload)]
    return [(count - 1 - i, payload[FRAME_MAX * i : FRAME_MAX * (i + 1)]) for i in range(count)]


def size_on_bus(size: int, *, varies: bool = False) -> int:
    """Return the bytes that a message takes in frames; if its length varies, at most: longer ones are never sent."""
    return min(size, VARIABLE_MAX) + HEADER_SIZE if varies else size


def encode_variable(payload: bytes) -> bytes:
    """Return a message whose length varies with its header. Raises `MessageError` beyond 1020 bytes."""
    size = len(payload)
    if size > VARIABLE_MAX:
        raise MessageError(f"RTCAN carries up to {VARIABLE_MAX} bytes in a message of variable length, not {size}")
    return _HEADER.pack(size, crc_hqx(payload, _CRC_START)) + payload


def decode_variable(data: bytes) -> bytes:
    """Return the payload behind a header. Raises `DecodeError` for a wrong length or checksum."""
    payload = data[HEADER_SIZE:]
    if len(data) < HEADER_SIZE or _HEADER.unpack_from(data) != (len(payload), crc_hqx(payload, _CRC_START)):
        raise DecodeError(f"{len(data)} bytes with another length or checksum than their header says")
    return payload


def pack_management(data: bytes) -> bytes:
    """Return a management message as it travels between r2p modules: each run of zeros as a zero and its length, and
    none in front of the type byte. One that this would not make shorter stays as it is.
    """
    packed = _ZEROS.sub(lambda run: bytes((0, len(run[0]))), data[:-1].rstrip(b"\0")) + data[-1:]
    return packed if len(packed) < len(data) else data


def unpack_management(packed: bytes, size: int) -> bytes:
    """Return a management message of `size` bytes with its zeros. Raises `DecodeError` if it would be longer."""
    if len(packed) == size:
        return packed
    body = _PACKED_ZEROS.sub(lambda run: bytes(run[1][0]), packed[:-1])
    if not packed or len(body) >= size:
        raise DecodeError(f"{len(packed)} bytes are no management message of {size} bytes without its zeros")
    return body.ljust(size - 1, b"\0") + packed[-1:]


def beginning_of(data: bytes, left: int, *, empty: bool = False) -> int:
    """Return the bytes, header included, of the message of variable length that a frame begins; 0 if it begins none.

    `left` is its number of fragments left. `empty`: all messages of the topic are; else none is.
    """
    if len(data) < HEADER_SIZE:
        return 0
    length, _ = _HEADER.unpack_from(data)
    size: int = length + HEADER_SIZE
    whole = size <= PAYLOAD_MAX and left + 1 == fragment_count(size) and len(data) == min(size, FRAME_MAX)
    return size if whole and (not length if empty else length >= VARIABLE_MIN) else 0


def encode_sync(cycle: int, mask: int) -> Frame:
    """Return the sync frame, with the lowest 8 bits of the counter. Raises `MessageError` for a slot beyond 63."""
    if mask & ~_ALL_SLOTS:
        raise MessageError(f"reservation mask {mask:#x}: a cycle has at most {SLOTS_MAX} slots")
    return Frame((cycle & CYCLE_MASK) << MESSAGE_SHIFT, mask.to_bytes(FRAME_MAX, "little"))


def decode_sync(frame: Frame) -> Sync:
    """Return the master's cycle and slots. Raises `DecodeError` for any other frame than a sync."""
    if not is_sync(frame.id) or len(frame.data) != FRAME_MAX:
        raise DecodeError(f"{frame.id:#010x} with {len(frame.data)} bytes is not a sync frame")
    return Sync(message_of(frame.id), int.from_bytes(frame.data, "little"))


def is_sync(identifier: int) -> bool:
    """Return whether a frame is a sync: laxity 0, high byte 0, no fragments left. Firmware may send such management."""
    return not identifier & NOT_SYNC
