"""The calendar of reserved slots at the master (PROTOCOL.md 6, thesis 4.3.4).

Slots are counted through: slot s of cycle c is number c * slots + s. A reservation of period p, phase f and k fragments
owns the numbers f .. f + k - 1 and all that differ from them by a multiple of p. Of every two reservations, the sync's
included (period: the cycle, phase 0, one slot), one period divides the other: so they share no slot if they share none
within the shorter of the two periods. So the slots that are free for a period are an integer of that many bits.

Since slot 0 of every cycle is the sync's, the slots of one occurrence never span two cycles.
"""

from collections.abc import Iterator

import msgspec

from r2p.codecs.management import RefuseReason
from r2p.codecs.rtcan import SLOTS_MAX

PERIOD_MAX = 1 << 16
"""In slots: about 11 s in slots of 166 us."""
_RESERVATIONS_MAX = 1024  # each one makes an admission slower


class Reservation(msgspec.Struct, frozen=True):
    """The slots of one message; `period` and `phase` are in slots, `phase` counts from the start of cycle 0."""

    message: int
    period: int
    phase: int
    fragments: int = 1

    def first_from(self, number: int) -> int:
        """Return the first slot number from this one on where an occurrence begins."""
        return number + (self.phase - number) % self.period


class Refusal(msgspec.Struct, frozen=True):
    """No slots for `fragments` every `period`; `other` is the period, of the message `rival`, that matters."""

    message: int
    reason: RefuseReason
    period: int
    fragments: int = 1
    other: int = 0
    rival: int = 0

    @property
    def text(self) -> str:
        """The reason in words."""
        match self.reason:
            case RefuseReason.PERIOD:
                return f"a period of {self.period} slots neither divides the {self.other} of a cycle nor is a multiple"
            case RefuseReason.OTHER:
                return (
                    f"a period of {self.period} slots neither divides the {self.other} of message "
                    f"0x{self.rival:04X} nor is a multiple"
                )
            case RefuseReason.LENGTH:
                needed = max(2, self.fragments + 1)
                return f"a period of {self.period} slots: this message needs one of {needed} to {PERIOD_MAX}"
            case RefuseReason.FULL:
                run = "slot is" if self.fragments == 1 else f"{self.fragments} slots in a row are"
                return f"no {run} free every {self.period} slots"
            case RefuseReason.TAKEN:
                return "its slots were given to another message"
            case RefuseReason.MANY:
                return f"all {_RESERVATIONS_MAX} reservations are in use"


class Calendar:
    """All reservations of a network with cycles of `slots`. Raises ValueError unless those are 2..64."""

    def __init__(self, slots: int) -> None:
        if not 2 <= slots <= SLOTS_MAX:
            raise ValueError(f"{slots} slots: a cycle has 2 to {SLOTS_MAX}")
        self.slots = slots
        self._entries: dict[int, Reservation] = {}

    def __iter__(self) -> Iterator[Reservation]:
        return iter(self._entries.values())

    def __len__(self) -> int:
        return len(self._entries)

    def get(self, message: int) -> Reservation | None:
        return self._entries.get(message)

    def admit(
        self, message: int, period: int, fragments: int = 1, *, round_down: bool = False
    ) -> Reservation | Refusal:
        """Reserve slots, with the least possible phase; `round_down`: with the longest possible period up to this one.

        A message that has slots of another period or size gives those back first.
        """
        wanted = self._wanted(message, period, round_down)
        before = self._entries.get(message)
        if before is not None and (before.period, before.fragments) == (wanted, fragments):
            return before
        self.remove(message)  # its own slots are free for it
        if (refusal := self._impossible(message, wanted, fragments)) is not None:
            return refusal
        phase = _first_run(self.free(wanted), fragments)
        if phase is None:
            return Refusal(message, RefuseReason.FULL, wanted, fragments)
        return self._enter(Reservation(message, wanted, phase, fragments))

    def readmit(self, reservation: Reservation) -> Reservation | Refusal:
        """Enter a reservation that another master granted, with its phase."""
        message, period, phase, fragments = msgspec.structs.astuple(reservation)
        if self._entries.get(message) == reservation:
            return reservation
        self.remove(message)
        if (refusal := self._impossible(message, period, fragments)) is not None:
            return refusal
        train = (1 << fragments) - 1
        if phase >= period or self.free(period) >> phase & train != train:
            return Refusal(message, RefuseReason.TAKEN, period, fragments)
        return self._enter(reservation)

    def remove(self, message: int) -> bool:
        """Give back the slots of a message; return whether it had any."""
        return self._entries.pop(message, None) is not None

    def free(self, period: int) -> int:
        """Return a mask; bit i: no reservation owns slot i, or one that differs from it by a multiple of the period."""
        free = (1 << period) - 1 & ~_comb(self.slots, 0, 1, period)
        for each in self._entries.values():
            free &= ~_comb(each.period, each.phase, each.fragments, period)
        return free

    def mask(self, cycle: int) -> int:
        """The reservation mask of a cycle: bit i says that its slot i is reserved, slot 0 for the sync."""
        mask = 1
        start = cycle * self.slots
        for each in self._entries.values():
            mask |= occupied(each, start, self.slots)
        return mask

    def _enter(self, reservation: Reservation) -> Reservation:
        self._entries[reservation.message] = reservation
        return reservation

    def _wanted(self, message: int, period: int, round_down: bool) -> int:
        """Return the longest period up to `period` that is harmonic with all others, else `period` itself."""
        if not round_down or not 1 < period <= PERIOD_MAX:
            return period
        others = {each.period for each in self._entries.values() if each.message != message} | {self.slots}
        for shorter in _candidates(period, self.slots):
            if all(_harmonic(shorter, other) for other in others):
                return shorter
        return period

    def _impossible(self, message: int, period: int, fragments: int) -> Refusal | None:
        if not 1 < period <= PERIOD_MAX or not 0 < fragments < period:
            return Refusal(message, RefuseReason.LENGTH, period, fragments)
        if not _harmonic(period, self.slots):
            return Refusal(message, RefuseReason.PERIOD, period, fragments, self.slots)
        for each in self._entries.values():
            if not _harmonic(period, each.period):
                return Refusal(message, RefuseReason.OTHER, period, fragments, each.period, each.message)
        if len(self._entries) >= _RESERVATIONS_MAX:
            return Refusal(message, RefuseReason.MANY, period, fragments)
        return None


def occupied(reservation: Reservation, start: int, slots: int) -> int:
    """Return the slots of the reservation in a cycle that begins with number `start`, as a mask."""
    period, train = reservation.period, (1 << reservation.fragments) - 1
    offset = (reservation.phase - start) % period
    if period >= slots:  # at most one occurrence, and a whole one: none spans two cycles
        return train << offset if offset < slots else 0
    return _comb(period, offset, reservation.fragments, slots)


def _harmonic(a: int, b: int) -> bool:
    return a % b == 0 or b % a == 0


def _candidates(period: int, slots: int) -> Iterator[int]:
    """Yield the periods up to this one that are harmonic with the cycle, the longest first."""
    yield from range(period - period % slots, 0, -slots)
    yield from (divisor for divisor in range(min(period, slots - 1), 1, -1) if slots % divisor == 0)


def _comb(period: int, phase: int, fragments: int, length: int) -> int:
    """Bits phase .. phase + fragments - 1, and all that differ by multiples of the period, modulo `length`."""
    if fragments >= length:
        return (1 << length) - 1
    train = (1 << fragments) - 1
    if period >= length:
        bits = train << phase % length
        return (bits | bits >> length) & (1 << length) - 1
    # A bit for each occurrence: 1 + 2**p + 2**2p + ... is a geometric series. The product repeats the train there.
    teeth = ((1 << -(-length // period) * period) - 1) // ((1 << period) - 1)
    return (train << phase % period) * teeth & (1 << length) - 1


def _first_run(free: int, length: int) -> int | None:
    """The index of the first `length` set bits in a row."""
    starts = free
    for shift in range(1, length):
        starts &= free >> shift  # bit i stays set while bits i .. i + shift are free
    return (starts & -starts).bit_length() - 1 if starts else None
