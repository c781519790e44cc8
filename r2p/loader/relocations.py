"""The relocations that GCC emits for Cortex-M: ELF for the Arm Architecture (IHI 0044), table 4.

Addends are in the place itself. Bit 0 of a function's address says that it is a Thumb function, as all of them are.
"""

import struct
from collections.abc import Callable

_NOP = 0xF3AF, 0x8000  # NOP.W: what a call of a weak function becomes that is defined nowhere

_Apply = Callable[[bytearray, int, int, int], None]


def relocate(kind: int, image: bytearray, offset: int, symbol: int | None, place: int) -> None:
    """Apply a relocation at `offset` of an image, whose address is `place`.

    `symbol` is the address of its symbol; None: a weak one that is defined nowhere. Raises ValueError if the target is
    out of reach, the place is not in the image, or the kind is not one that GCC emits.
    """
    entry = _KINDS.get(kind)
    if entry is None:
        raise ValueError(f"relocation type {kind} is not supported: compile for a Cortex-M, without -fPIC")
    size, apply = entry
    if not 0 <= offset <= len(image) - size:
        raise ValueError("the place is outside of its section")
    if symbol is None and apply in (_call, _jump24):
        struct.pack_into("<2H", image, offset, *_NOP)
    else:
        apply(image, offset, symbol or 0, place)


def _nothing(image: bytearray, offset: int, symbol: int, place: int) -> None:
    pass


def _absolute(image: bytearray, offset: int, symbol: int, place: int) -> None:
    (addend,) = struct.unpack_from("<i", image, offset)
    struct.pack_into("<I", image, offset, (symbol + addend) & 0xFFFF_FFFF)


def _relative(image: bytearray, offset: int, symbol: int, place: int) -> None:
    _absolute(image, offset, symbol - place, place)


def _relative31(image: bytearray, offset: int, symbol: int, place: int) -> None:
    (word,) = struct.unpack_from("<I", image, offset)
    value = _signed(word, 31) + symbol - place
    struct.pack_into("<I", image, offset, word & 0x8000_0000 | value & 0x7FFF_FFFF)


def _call(image: bytearray, offset: int, symbol: int, place: int) -> None:
    _branch24(image, offset, symbol, place)
    high, low = struct.unpack_from("<2H", image, offset)
    struct.pack_into("<2H", image, offset, high, low | 0x1000)  # BL: a BLX would change to ARM state


def _jump24(image: bytearray, offset: int, symbol: int, place: int) -> None:
    _branch24(image, offset, symbol, place)


def _branch24(image: bytearray, offset: int, symbol: int, place: int) -> None:
    """B.W and BL: sign, two bits that are inverted if it is 0, 10 bits, 11 bits."""
    high, low = struct.unpack_from("<2H", image, offset)
    sign = high >> 10 & 1
    upper = (low >> 13 & 1 ^ sign ^ 1) << 23 | (low >> 11 & 1 ^ sign ^ 1) << 22
    addend = _signed(sign << 24 | upper | (high & 0x3FF) << 12 | (low & 0x7FF) << 1, 25)
    value = _distance(symbol, addend, place, 25)
    sign = value >> 24 & 1
    first, second = value >> 23 & 1 ^ sign ^ 1, value >> 22 & 1 ^ sign ^ 1
    high = high & 0xF800 | sign << 10 | value >> 12 & 0x3FF
    low = low & 0xD000 | first << 13 | second << 11 | value >> 1 & 0x7FF
    struct.pack_into("<2H", image, offset, high, low)


def _jump19(image: bytearray, offset: int, symbol: int, place: int) -> None:
    """B<c>.W: sign, J2, J1, 6 bits, 11 bits."""
    high, low = struct.unpack_from("<2H", image, offset)
    bits = (high >> 10 & 1) << 20 | (low >> 11 & 1) << 19 | (low >> 13 & 1) << 18 | (high & 0x3F) << 12
    value = _distance(symbol, _signed(bits | (low & 0x7FF) << 1, 21), place, 21)
    high = high & 0xFBC0 | (value >> 20 & 1) << 10 | value >> 12 & 0x3F
    low = low & 0xD000 | (value >> 18 & 1) << 13 | (value >> 19 & 1) << 11 | value >> 1 & 0x7FF
    struct.pack_into("<2H", image, offset, high, low)


def _jump11(image: bytearray, offset: int, symbol: int, place: int) -> None:
    _short_jump(image, offset, symbol, place, 11)


def _jump8(image: bytearray, offset: int, symbol: int, place: int) -> None:
    _short_jump(image, offset, symbol, place, 8)


def _short_jump(image: bytearray, offset: int, symbol: int, place: int, bits: int) -> None:
    mask = (1 << bits) - 1
    (word,) = struct.unpack_from("<H", image, offset)
    value = _distance(symbol, _signed((word & mask) << 1, bits + 1), place, bits + 1)
    struct.pack_into("<H", image, offset, word & ~mask | value >> 1 & mask)


def _move_low(image: bytearray, offset: int, symbol: int, place: int) -> None:
    _move(image, offset, lambda addend: symbol + addend)


def _move_high(image: bytearray, offset: int, symbol: int, place: int) -> None:
    _move(image, offset, lambda addend: (symbol + addend) >> 16)


def _move(image: bytearray, offset: int, value: Callable[[int], int]) -> None:
    """MOVW and MOVT: the 16 bits are 4, 1, 3 and 8 bits."""
    high, low = struct.unpack_from("<2H", image, offset)
    addend = _signed((high & 0xF) << 12 | (high >> 10 & 1) << 11 | (low >> 12 & 7) << 8 | low & 0xFF, 16)
    bits = value(addend)
    high = high & 0xFBF0 | bits >> 12 & 0xF | (bits >> 11 & 1) << 10
    low = low & 0x8F00 | (bits >> 8 & 7) << 12 | bits & 0xFF
    struct.pack_into("<2H", image, offset, high, low)


def _distance(symbol: int, addend: int, place: int, bits: int) -> int:
    """Return how far a branch jumps. Raises ValueError if it can't reach that far."""
    value = (symbol & ~1) + addend - place
    if _signed(value, bits) != value:
        raise ValueError(f"{symbol:#010x} is out of reach of a branch at {place:#010x}: compile with -mlong-calls")
    return value


def _signed(value: int, bits: int) -> int:
    """Return the low bits as a signed number."""
    value &= (1 << bits) - 1
    return value - (1 << bits) if value >> (bits - 1) else value


_KINDS: dict[int, tuple[int, _Apply]] = {
    0: (0, _nothing),  # R_ARM_NONE
    2: (4, _absolute),  # R_ARM_ABS32
    3: (4, _relative),  # R_ARM_REL32
    10: (4, _call),  # R_ARM_THM_CALL
    30: (4, _jump24),  # R_ARM_THM_JUMP24
    38: (4, _absolute),  # R_ARM_TARGET1: of lists of constructors
    40: (0, _nothing),  # R_ARM_V4BX
    42: (4, _relative31),  # R_ARM_PREL31
    47: (4, _move_low),  # R_ARM_THM_MOVW_ABS_NC
    48: (4, _move_high),  # R_ARM_THM_MOVT_ABS
    51: (4, _jump19),  # R_ARM_THM_JUMP19
    102: (2, _jump11),  # R_ARM_THM_JUMP11
    103: (2, _jump8),  # R_ARM_THM_JUMP8
}
"""By the number of a type: the bytes that it changes, and how."""
