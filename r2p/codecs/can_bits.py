"""CAN frames, and their bits: which frame wins an arbitration and when the others give up, how long a frame takes.

`Frame` is what RTCAN sends; `OtherFrame` is every other kind of CAN 2.0. Controllers stamp the end of a frame, so its
start follows from its length. That depends on the content: after five equal bits the controller stuffs in a sixth,
opposite one, also in the CRC. Bits are counted a byte at a time: a table has for each state of the stuffing (the last
bit, how often) and each byte the next state and the number of stuffed bits.
"""

from enum import IntEnum
from functools import lru_cache
from typing import ClassVar, TypeAlias

import msgspec

from r2p.errors import MessageError

FRAME_MAX = 8  # bytes in a frame
LENGTH_CODE_MAX = 15  # codes from 9 on mean 8 bytes, too
IDENTIFIER_BITS = 29
STANDARD_BITS = 11
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

    extended: ClassVar[bool] = True
    remote: ClassVar[None] = None
    length_code: ClassVar[None] = None


class OtherFrame(msgspec.Struct, frozen=True):
    """A frame of another kind: with an 11-bit identifier; or a remote frame, which asks for `remote` bytes.

    `remote` is the length code that a remote frame carries, 0 to 15. `length_code`: that of a data frame which has 8
    bytes and says so with a code from 9 to 15, as CAN allows; None is the number of bytes.
    """

    id: int
    data: bytes = b""
    extended: bool = False
    remote: int | None = None
    length_code: int | None = None


AnyFrame: TypeAlias = Frame | OtherFrame


class FrameField(IntEnum):
    """The fields of a frame, with the numbers that SocketCAN's error frames have for them (`CAN_ERR_PROT_LOC_...`)."""

    START = 0x03
    ID_28_TO_21 = 0x02  # of 11 bits: 10 to 3
    ID_20_TO_18 = 0x06  # ... 2 to 0
    SUBSTITUTE_REMOTE = 0x04  # with an 11-bit identifier: the RTR bit
    EXTENSION = 0x05  # the IDE bit
    ID_17_TO_13 = 0x07
    ID_12_TO_5 = 0x0F
    ID_4_TO_0 = 0x0E
    REMOTE = 0x0C  # the RTR bit
    RESERVED_1 = 0x0D
    RESERVED_0 = 0x09
    LENGTH = 0x0B
    DATA = 0x0A
    CRC = 0x08
    CRC_DELIMITER = 0x18
    ACK_SLOT = 0x19
    ACK_DELIMITER = 0x1B
    END = 0x1A
    INTERMISSION = 0x12


ARBITRATION_FIELDS = {*list(FrameField)[1:4], FrameField.ID_17_TO_13, FrameField.ID_12_TO_5, FrameField.ID_4_TO_0}
ARBITRATION_FIELDS |= {FrameField.EXTENSION, FrameField.REMOTE}
"""Where a controller that sends a recessive bit and sees a dominant one loses the arbitration."""


def frame_bits_min(size: int, *, extended: bool = True) -> int:
    """Return the bits of the shortest frame with `size` bytes of data: no stuff bits. Without intermission."""
    return (_HEADER if extended else _STANDARD_HEADER) + 8 * size + _CRC + TAIL


def frame_bits_max(size: int, *, extended: bool = True) -> int:
    """Return the bits of the longest frame with `size` bytes of data: after the first bit, one stuffed in per four.

    Both are of a data frame with a 29-bit identifier, or an 11-bit one if it is not `extended`.
    """
    shortest = frame_bits_min(size, extended=extended)
    return shortest + (shortest - TAIL - 1) // 4


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


def other_frame_bits(frame: AnyFrame) -> int:
    """Return the bits of a frame of any kind. Counts and raises as `frame_bits` does."""
    check_frame(frame)
    if frame.remote is None and frame.length_code is None:
        return frame_bits(frame.id, frame.data, extended=frame.extended)
    bits, count = _up_to_crc(frame)
    return count + (_stuff(_START, bits, count) >> 3) + TAIL


def check_frame(frame: AnyFrame) -> None:
    """Raise `MessageError` unless CAN has such a frame. Every frame has one form: 29-bit data frames are a `Frame`."""
    size, remote, code = len(frame.data), frame.remote, frame.length_code
    width = IDENTIFIER_BITS if frame.extended else STANDARD_BITS
    wrong = None
    if frame.id >> width:
        wrong = f"the identifier {frame.id:#x} has more than {width} bits"
    elif size > FRAME_MAX:
        wrong = f"{size} bytes of data (0..{FRAME_MAX})"
    elif remote is not None and (size or code is not None or not 0 <= remote <= LENGTH_CODE_MAX):
        wrong = f"a remote frame has no data and asks for 0..{LENGTH_CODE_MAX} bytes, not {size} and {remote}"
    elif code is not None and not (size == FRAME_MAX < code <= LENGTH_CODE_MAX):
        wrong = f"{size} bytes of data with length code {code} ({FRAME_MAX + 1}..{LENGTH_CODE_MAX}, with {FRAME_MAX})"
    elif isinstance(frame, OtherFrame) and frame.extended and remote is None and code is None:
        wrong = "a data frame with a 29-bit identifier is a Frame, not an OtherFrame"
    if wrong:
        raise MessageError(f"does not fit a frame: {wrong}")


def wire_identifier(frame: AnyFrame) -> int:
    """Return the identifier with its flags: `EXTENDED` for 29 bits, `REMOTE` for a remote frame."""
    return frame.id | (EXTENDED if frame.extended else 0) | (0 if frame.remote is None else REMOTE)


def to_wire(frame: AnyFrame, flags: int, end: int) -> WireFrame:
    """Return a frame as observers of a bus get it, with its flags such as `LOCAL` and the instant of its end."""
    asked = 0 if frame.remote is None else min(frame.remote, FRAME_MAX)
    return wire_identifier(frame), frame.data or bytes(asked), flags, end


def from_wire(frame: WireFrame) -> AnyFrame:
    """Return the data frame or remote frame that an observer got."""
    flagged, data, _, _ = frame
    identifier, extended = flagged & IDENTIFIER_MASK, flagged & EXTENDED != 0
    if flagged & REMOTE:
        return OtherFrame(identifier, b"", extended, len(data))
    return Frame(identifier, data) if extended else OtherFrame(identifier, data)


def arbitration_field(frame: AnyFrame) -> int:
    """Return the 32 bits after the start of frame that decide the arbitration, as a number: the lowest wins.

    29 bits are sent as 11 bits, a recessive SRR and IDE, 18 bits, RTR; 11 bits with RTR and a dominant IDE, after which
    the arbitration is over. So of one base identifier a data frame with 11 bits comes before a remote one, and both
    before 29 bits.
    """
    identifier = frame.id
    if frame.__class__ is Frame:  # most
        return identifier >> 18 << 21 | 0b11 << 19 | (identifier & 0x3FFFF) << 1
    remote = frame.remote is not None
    if frame.extended:
        return _arbitration(identifier) << 1 | remote
    return identifier << 21 | remote << 20


def bits_until_lost(winner: int, loser: int) -> int:
    """Return the bits from the start of frame to the end of the bit where `loser` gives up: the first that differs.

    Both are from `arbitration_field`, `winner` the lower one.
    """
    after = (winner ^ loser).bit_length()
    before = _ARBITRATION - after  # all of them are the same in both frames
    return before + _stuffed(winner >> after, before) + 1


@lru_cache(maxsize=64)  # a frame that fails is sent again and again
def wire_bits(frame: AnyFrame) -> str:
    """Return the bits of a frame as sent, `0` dominant, with stuff bits. Slow: for error frames."""
    bits, count = _up_to_crc(frame)
    sent = ""
    state = _START
    for bit in f"{bits:0{count}b}":
        step = _stuff(state, int(bit), 1)
        state = step & 7
        sent += bit + str(state >> 2) * (step >> 3)
    return sent + "1" * TAIL


def field_at(frame: AnyFrame, bit: int) -> FrameField:
    """Return the field in which a bit lies, counted from 1 with stuff bits; these belong to the bit before. Slow."""
    wire = wire_bits(frame)
    after = bit - (len(wire) - TAIL)
    if after > 0:
        return next((field for field, last in _TAIL_FIELDS if after <= last), FrameField.INTERMISSION)
    size = 0 if frame.remote is not None else 8 * len(frame.data)
    fields = [*(_EXTENDED_FIELDS if frame.extended else _STANDARD_FIELDS), (FrameField.DATA, size)]
    plain, run, last = 0, 0, ""  # bits without stuff bits; a stuff bit ends a run of 5
    for level in wire[:bit]:
        if run == 5:
            run = 0
        else:
            plain += 1
        run = run + 1 if level == last else 1
        last = level
    for field, width in fields:
        plain -= width
        if plain <= 0:
            return field
    return FrameField.CRC


# Counting bits. The state of the stuffing is (the last bit) << 2 | (its run length) - 1.

_HEADER = 39  # bits: start of frame, 11 of the identifier, SRR, IDE, 18 of the identifier, RTR, 2 reserved, 4 of length
_STANDARD_HEADER = _HEADER - 20  # with an identifier of 11 bits, one of the reserved bits, and no SRR
_REMOTE = 1 << 6  # RTR, with what follows it of the header
_ARBITRATION = 33  # bits: start of frame, 11 of the identifier, SRR, IDE, 18 of the identifier, RTR
_CRC = 15
_START = 1 << 2  # before a frame the bus is recessive; the start of frame is dominant, so how long does not matter
_Row: TypeAlias = "list[tuple[_Row, int]]"
"""A state of the stuffing: for each byte, and then for each 7 bits, the next state and the number of bits sent."""


_ID_FIELDS = [(FrameField.START, 1), (FrameField.ID_28_TO_21, 8), (FrameField.ID_20_TO_18, 3)]
_ID_FIELDS += [(FrameField.SUBSTITUTE_REMOTE, 1), (FrameField.EXTENSION, 1)]
_STANDARD_FIELDS = [*_ID_FIELDS, (FrameField.RESERVED_0, 1), (FrameField.LENGTH, 4)]
_EXTENDED_FIELDS = [*_ID_FIELDS, (FrameField.ID_17_TO_13, 5), (FrameField.ID_12_TO_5, 8), (FrameField.ID_4_TO_0, 5)]
_EXTENDED_FIELDS += [(FrameField.REMOTE, 1), (FrameField.RESERVED_1, 1), *_STANDARD_FIELDS[-2:]]
"""The fields before the data, each with its bits."""
_TAIL_FIELDS = [(FrameField.CRC_DELIMITER, 1), (FrameField.ACK_SLOT, 2), (FrameField.ACK_DELIMITER, 3)]
_TAIL_FIELDS += [(FrameField.END, TAIL)]
"""The fields after the CRC, each with its last bit."""


def _arbitration(identifier: int) -> int:
    """Return the 32 bits from the start of frame to the end of the identifier."""
    return identifier >> 18 << 20 | 0b11 << 18 | identifier & 0x3FFFF


def _up_to_crc(frame: AnyFrame) -> tuple[int, int]:
    """Return the bits of a frame up to the end of the CRC, without stuff bits, and how many they are."""
    data = frame.data
    size = len(data)
    if frame.remote is None:
        code = size if frame.length_code is None else frame.length_code
    else:
        code = _REMOTE | frame.remote
    header, count = (_arbitration(frame.id), _HEADER) if frame.extended else (frame.id, _STANDARD_HEADER)
    bits = (header << 7 | code) << 8 * size | int.from_bytes(data, "big")
    return bits << _CRC | _crc(bits.to_bytes(13, "big")), count + 8 * size + _CRC


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
