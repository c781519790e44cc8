"""CAN frames, and their length in bits: controllers stamp the end of a frame, so its start follows.

A frame's length in bits depends on its content: after five equal bits the controller stuffs in a sixth, opposite one,
also in the CRC. Bits are counted a byte at a time: a table has for each state of the stuffing (the last bit, how often)
and each byte the next state and the number of stuffed bits.
"""

from functools import lru_cache
from typing import TypeAlias

import msgspec

from r2p.errors import MessageError

FRAME_MAX = 8  # bytes in a frame
IDENTIFIER_BITS = 29
INTERMISSION = 3  # bits between two frames
TAIL = 10  # bits after the CRC, never stuffed: CRC delimiter, ACK slot, ACK delimiter, end of frame

EXTENDED, REMOTE, ERROR = 1 << 31, 1 << 30, 1 << 29
"""Flags above the 29 bits of an identifier, as in SocketCAN and in candump's logs: 29 bits, a remote frame, an error
frame.
"""

IDENTIFIER_MASK = (1 << IDENTIFIER_BITS) - 1
LOCAL = 0x4
"""Flag MSG_DONTROUTE of SocketCAN's messages: a program of this computer sent the frame."""

WireFrame: TypeAlias = tuple[int, bytes, int, int]
"""A frame of any kind, as observers of a bus get it: its identifier with the flags above; its data, of a remote frame
as many zeros as bytes that it asks for; flags such as LOCAL; and the instant of its end (ns).
"""


class Frame(msgspec.Struct, frozen=True, gc=False):
    """A data frame of CAN 2.0B: its 29-bit identifier and 0 to 8 bytes."""

    id: int
    data: bytes


class OtherFrame(msgspec.Struct, frozen=True):
    """A frame of another kind: with an 11-bit identifier, or a remote frame, which asks for `remote` bytes."""

    id: int
    data: bytes = b""
    extended: bool = False
    remote: int | None = None


def frame_bits_min(size: int) -> int:
    """Return the bits of the shortest frame with `size` bytes of data: no stuff bits. Without intermission."""
    return _HEADER + 8 * size + _CRC + TAIL


def frame_bits_max(size: int) -> int:
    """Return the bits of the longest frame with `size` bytes of data: after the first bit, one stuffed in per four."""
    return frame_bits_min(size) + (_HEADER + 8 * size + _CRC - 1) // 4


@lru_cache(maxsize=64)  # all that deal with one frame ask at about the same time
def frame_bits(identifier: int, data: bytes, *, extended: bool = True) -> int:
    """Return the bits of a data frame from its start to its end, stuff bits included, without intermission.

    `extended=False` is for frames with 11-bit identifiers, which RTCAN does not send. Raises `MessageError` if the
    identifier or the data are too long.
    """
    row, crc, bits = _header(identifier, len(data), extended)
    if len(data) == FRAME_MAX:  # most frames of a busy bus; the loop takes twice as long
        a, b, c, d, e, f, g, h = data
        row, bits1 = row[a]
        row, bits2 = row[b]
        row, bits3 = row[c]
        row, bits4 = row[d]
        row, bits5 = row[e]
        row, bits6 = row[f]
        row, bits7 = row[g]
        row, bits8 = row[h]
        bits += bits1 + bits2 + bits3 + bits4 + bits5 + bits6 + bits7 + bits8
        crc ^= _1ST[a] ^ _2ND[b] ^ _3RD[c] ^ _4TH[d] ^ _5TH[e] ^ _6TH[f] ^ _7TH[g] ^ _8TH[h]
    else:
        for byte, remainders in zip(data, _REMAINDERS[len(data)], strict=True):
            row, sent = row[byte]
            bits += sent
            crc ^= remainders[byte]
    row, high = row[crc >> 7]
    return bits + high + row[_SEVEN | crc & 0x7F][1] + TAIL


def start_of_frame(frame: Frame, end: int, bit: int) -> int:
    """Return when a frame that ended at `end` began, exact to the stuff bits. All in ns, also the bit time `bit`."""
    return end - frame_bits(frame.id, frame.data) * bit


def other_frame_bits(frame: OtherFrame) -> int:
    """Return the bits of a frame that RTCAN does not use. Counts and raises as `frame_bits` does."""
    if frame.remote is None:
        return frame_bits(frame.id, frame.data, extended=frame.extended)
    if frame.id >> (IDENTIFIER_BITS if frame.extended else 11) or not 0 <= frame.remote <= 0xF:
        raise MessageError(f"does not fit a frame: identifier {frame.id:#x}, {frame.remote} bytes asked for (0..15)")
    bits = (_arbitration(frame.id) if frame.extended else frame.id) << 7 | _REMOTE | frame.remote
    count = (_HEADER if frame.extended else _STANDARD_HEADER) + _CRC
    return count + (_stuff(_START, bits << _CRC | _crc(bits.to_bytes(5, "big")), count) >> 3) + TAIL


def bits_until_lost(winner: int, loser: int) -> int:
    """Return the bits from the start of frame to the end of the bit where `loser` gives up: the first that differs.

    Both are 29-bit identifiers, `winner` the lower one.
    """
    bit = (winner ^ loser).bit_length() - 1
    before = IDENTIFIER_BITS - bit
    if bit <= 17:
        before += 2  # SRR and IDE are sent between bits 18 and 17
    return before + _stuffed(_arbitration(winner) >> 32 - before, before) + 1


def wire_bits(frame: Frame) -> str:
    """Return the bits of a frame as sent, `0` dominant, with stuff bits. Slow: for error frames."""
    count = _HEADER + 8 * len(frame.data)
    bits = (_arbitration(frame.id) << 7 | len(frame.data)) << 8 * len(frame.data) | int.from_bytes(frame.data, "big")
    bits, count = bits << _CRC | _crc(bits.to_bytes(13, "big")), count + _CRC
    sent = ""
    state = _START
    for bit in f"{bits:0{count}b}":
        step = _stuff(state, int(bit), 1)
        state = step & 7
        sent += bit + str(state >> 2) * (step >> 3)
    return sent + "1" * TAIL


# Counting bits. The state of the stuffing is (the last bit) << 2 | (its run length) - 1.

_HEADER = 39  # bits: start of frame, 11 of the identifier, SRR, IDE, 18 of the identifier, RTR, 2 reserved, 4 of length
_STANDARD_HEADER = _HEADER - 20  # with an identifier of 11 bits, one of the reserved bits, and no SRR
_REMOTE = 1 << 6  # RTR, with what follows it of the header
_CRC = 15
_START = 1 << 2  # before a frame the bus is recessive; the start of frame is dominant, so how long does not matter
_Row: TypeAlias = "list[tuple[_Row, int]]"
"""A state of the stuffing: for each byte, and then for each 7 bits, the next state and the number of bits sent."""


def _arbitration(identifier: int) -> int:
    """Return the 32 bits from the start of frame to the end of the identifier."""
    return identifier >> 18 << 20 | 0b11 << 18 | identifier & 0x3FFFF


@lru_cache(maxsize=4096)
def _stuffed(bits: int, count: int) -> int:
    """Return how many bits are stuffed into the first `count` of a frame."""
    return _stuff(_START, bits, count) >> 3


@lru_cache(maxsize=4096)
def _header(identifier: int, size: int, extended: bool) -> tuple[_Row, int, int]:
    """Return the state after the bits before the data: stuffing, CRC as if all data were 0, bits so far."""
    width = IDENTIFIER_BITS if extended else 11
    if identifier >> width or size > FRAME_MAX:
        parts = f"identifier {identifier:#x} ({width} bits), {size} bytes (0..{FRAME_MAX})"
        raise MessageError(f"does not fit a frame: {parts}")
    bits = _arbitration(identifier) << 7 | size if extended else identifier << 7 | size
    count = _HEADER if extended else _STANDARD_HEADER
    step = _stuff(_START, bits, count)
    return _ROWS[step & 7], _crc(bits.to_bytes(5, "big") + bytes(size)), count + (step >> 3)


def _crc(data: bytes) -> int:
    """Return the CRC-15. Zeros in front leave it unchanged."""
    crc = 0
    for byte in data:
        crc = (crc << 8 ^ _REMAINDER[crc >> 7 ^ byte]) & 0x7FFF
    return crc


def _stuff(state: int, bits: int, count: int) -> int:
    """Send `count` bits: return (number of stuff bits) << 3 | the state after them."""
    stuffed = 0
    for shift in range(count - 1, -1, -1):
        bit = bits >> shift & 1
        if bit != state >> 2:
            state = bit << 2
        elif state & 3 == 3:
            stuffed += 1
            state = (bit ^ 1) << 2
        else:
            state += 1
    return stuffed << 3 | state


def _remainder(byte: int) -> int:
    """Return the CRC-15 of one byte."""
    crc = byte << 7
    for _ in range(8):
        crc = crc << 1 ^ (0x4599 if crc & 0x4000 else 0)
    return crc & 0x7FFF


_SEVEN = 1 << 8  # where the 7 bits begin
_ROWS: list[_Row] = [[] for _ in range(8)]
_ENDS = [[(_row, sent) for sent in range(11)] for _row in _ROWS]  # shared: few different ones stay in the CPU's cache
for _state, _row in enumerate(_ROWS):
    for _count in 8, 7:
        for _step in [_stuff(_state, bits, _count) for bits in range(1 << _count)]:
            _row.append(_ENDS[_step & 7][_count + (_step >> 3)])

_REMAINDER = tuple(_remainder(byte) for byte in range(256))
_PLACES = [tuple(_crc(bytes((byte, *bytes(after)))) for byte in range(256)) for after in range(FRAME_MAX)]
_REMAINDERS = [_PLACES[:size][::-1] for size in range(FRAME_MAX + 1)]
"""CRC-15 is linear: the sum of those of single bytes. By size of the data, place of the byte, and its value."""
_1ST, _2ND, _3RD, _4TH, _5TH, _6TH, _7TH, _8TH = _REMAINDERS[FRAME_MAX]
