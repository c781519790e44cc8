"""What goes wrong on a bus, bit by bit: collisions, and error frames. Slow, and only needed when it does.

An error active node answers an error with an active error flag, 6 dominant bits. The other nodes notice it when it
breaks a rule of theirs - a sixth equal bit, or a dominant one after the CRC - and send their own: one to twelve bits
of flags in all. An error passive node's flag is recessive, and so is nothing to the others, unless it falls silent as
the sender. Then come 8 recessive bits, the delimiter.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from r2p.codecs.rtcan import TAIL

if TYPE_CHECKING:
    from collections.abc import Sequence

FLAG: Final = 6
DELIMITER: Final = 8


def flip(wire: str, bit: int) -> str:
    """The bus up to bit `bit`, counted from 1, which noise turns into its opposite."""
    return wire[: bit - 1] + ("1" if wire[bit - 1] == "0" else "0")


def first_difference(wires: Sequence[str]) -> int:
    """Where senders of one identifier begin to differ: that bit's number, counted from 1."""
    return next(number for number, bits in enumerate(zip(*wires, strict=False), start=1) if len(set(bits)) > 1)


def error_frame_bits(bus: str, wire: str, *, active: bool, others: bool) -> int:
    """From the detection of an error to the end of the error frame.

    `bus`: the levels so far, `wire`: the whole frame as it was meant. `active`: a node that detected it is error
    active; `others`: one that has yet to notice is.
    """
    if not others:
        return FLAG + DELIMITER
    return bits_until_noticed(bus, wire, "0" if active else "1") + FLAG + DELIMITER


def bits_until_noticed(bus: str, wire: str, level: str) -> int:
    """How many more bits of this level it takes after these on the bus until every node knows that it is an error."""
    if len(bus) >= len(wire) - TAIL:
        return 1
    return max(0, FLAG - (len(bus) - len(bus.rstrip(level))))
