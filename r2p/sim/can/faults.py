"""Errors on the bus: how long error frames take, and how each controller counts errors (fault confinement).

An error active node answers an error with an active error flag, 6 dominant bits. The other nodes notice the error when
the flag breaks a rule of theirs - a sixth equal bit, or a dominant one after the CRC - and send their own flags: one to
twelve bits of flags in all. The flag of an error passive node is recessive, so the others see it only if that node was
the sender, which falls silent. 8 recessive bits, the delimiter, end the error frame.

This goes bit by bit and is slow, but it runs only when an error happens.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from r2p.codecs.rtcan import TAIL
from r2p.sim.can.node import ControllerState

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

_FLAG: Final = 6  # bits of an error flag
_DELIMITER: Final = 8  # bits after it

RECESSIVE_BITS: Final = 11
"""Recessive bits in a row after which a controller takes the bus for idle."""

# Limits of the error counters (ISO 11898-1, fault confinement)
_PASSIVE_ABOVE: Final = 127
_BUS_OFF_ABOVE: Final = 255  # of the transmit counter only
_AFTER_GOOD_FRAME: Final = 119  # a receive counter above 127 goes back to 119 to 127: here to the lowest


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
    if not others:
        return _FLAG + _DELIMITER
    return bits_until_noticed(bus, wire, "0" if active else "1") + _FLAG + _DELIMITER


def bits_until_noticed(bus: str, wire: str, level: str) -> int:
    """Return how many more bits of this level must follow `bus` until every node has noticed the error."""
    if len(bus) >= len(wire) - TAIL:
        return 1
    return max(0, _FLAG - (len(bus) - len(bus.rstrip(level))))


class Confinement:
    """The two error counters of a controller, and the state that follows from them.

    `on_change` is called with each new state.
    """

    def __init__(self, on_change: Callable[[ControllerState], object]) -> None:
        self.state = ControllerState.ACTIVE
        self.live = True
        """Whether the controller sends and receives: it is neither down nor in bus-off."""
        self.passive = False
        self.transmit = 0
        self.receive = 0
        self._on_change = on_change

    def transmitted(self) -> None:
        """Count a frame that was sent without an error."""
        self._count(self.transmit - 1, self.receive)

    def received(self) -> None:
        """Count a frame that was received without an error."""
        self._count(self.transmit, self.receive - 1 if self.receive <= _PASSIVE_ABOVE else _AFTER_GOOD_FRAME)

    def failed(self, *, transmit: int = 0, receive: int = 0) -> None:
        """Count a frame that was destroyed while it was sent or received."""
        self._count(self.transmit + transmit, self.receive + receive)

    def restart(self) -> None:
        """Reset both counters, and be error active."""
        self.transmit = self.receive = 0
        self.enter(ControllerState.ACTIVE)

    def enter(self, state: ControllerState) -> None:
        """Change the state."""
        if state is not self.state:
            self.state = state
            self.live = state is ControllerState.ACTIVE or state is ControllerState.PASSIVE
            self.passive = state is ControllerState.PASSIVE
            self._on_change(state)

    def _count(self, transmit: int, receive: int) -> None:
        self.transmit = max(0, transmit)
        self.receive = max(0, receive)
        if self.transmit > _BUS_OFF_ABOVE:
            self.enter(ControllerState.BUS_OFF)
        else:
            self.enter(
                ControllerState.PASSIVE if max(self.transmit, self.receive) > _PASSIVE_ABOVE else ControllerState.ACTIVE
            )
