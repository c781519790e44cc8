"""Error frames, bit by bit: slow, but needed only when an error happens.

An error active node answers an error with an active error flag, 6 dominant bits. The other nodes notice the error
when the flag breaks a rule of theirs - a sixth equal bit, or a dominant one after the CRC - and send their own flags:
one to twelve bits of flags in all. The flag of an error passive node is recessive, so the others see it only if that
node was the sender, which falls silent. 8 recessive bits, the delimiter, end the error frame.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import msgspec

from r2p.codecs.can_bits import TAIL, wire_identifier

if TYPE_CHECKING:
    from collections.abc import Sequence

    from r2p.codecs.can_bits import AnyFrame
    from r2p.sim.can.controller import CanController
    from r2p.sim.can.records import ErrorKind

FLAG: Final = 6  # bits of an error flag
DELIMITER: Final = 8  # recessive bits that end an error frame


class ErrorFrame(msgspec.Struct, eq=False):
    """An error frame: what the nodes `by` have detected after these bits on the bus, and the level of their flags.

    `unseen`: controllers that only listen do not notice it.
    """

    kind: ErrorKind
    bus: str
    by: Sequence[CanController]
    flag: str
    unseen: bool = False


class Disturbance(msgspec.Struct, eq=False):
    """Bit errors to come: `count` frames of this identifier and sender, if given, lose this bit, or a random one."""

    bit: int | None
    count: int
    identifier: int | None
    sender: str | None

    def hits(self, frame: AnyFrame, senders: tuple[str, ...]) -> bool:
        """Return whether this frame is one of them."""
        return (self.sender is None or self.sender in senders) and (
            self.identifier is None or self.identifier == wire_identifier(frame)
        )


def flip(wire: str, bit: int) -> str:
    """Return the bus up to bit `bit`, counted from 1, with that bit inverted."""
    return wire[: bit - 1] + ("1" if wire[bit - 1] == "0" else "0")


def first_difference(wires: Sequence[str]) -> int:
    """Return the number, counted from 1, of the first bit in which senders of one identifier differ."""
    return next(number for number, bits in enumerate(zip(*wires, strict=False), start=1) if len(set(bits)) > 1)


def error_frame_bits(bus: str, wire: str, *, active: bool, others: bool) -> int:
    """Return the bits from the detection of an error to the end of the error frame.

    `bus`: the levels so far; `wire`: the whole frame as its sender wanted it. `active`: a node that detected the error
    is error active; `others`: a node that has yet to notice it is.
    """
    noticed = bits_until_noticed(bus, wire, "0" if active else "1") if others else 0
    return noticed + FLAG + DELIMITER


def bits_until_noticed(bus: str, wire: str, level: str) -> int:
    """Return how many more bits of this level must follow `bus` until every node has noticed the error."""
    if len(bus) >= len(wire) - TAIL:
        return 1
    return max(0, FLAG - (len(bus) - len(bus.rstrip(level))))
