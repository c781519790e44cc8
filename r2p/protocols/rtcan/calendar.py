"""The calendar of reserved slots at the master (PROTOCOL.md 6, thesis 4.3.4).

Slots are counted through: slot s of cycle c is number c * slots + s. A reservation of period p, phase f and k fragments
owns the numbers f .. f + k - 1 and all that differ from them by a multiple of p. Two reservations of periods p and q,
the sync's included (period: the cycle, phase 0, one slot), share a slot some day if, and only if, their slots meet
modulo the greatest common divisor of p and q, as the sums of a multiple of p and one of q are just the multiples of
that. So periods need a common factor, as the thesis says, and the slots that are free for a period p are an integer of
p bits.

By the harmonic rule, which the firmware's calendar keeps, one of every two periods also has to divide the other.

Since slot 0 of every cycle is the sync's, the slots of one occurrence never span two cycles.
"""

import enum
import math
from collections.abc import Iterator
from itertools import islice, pairwise

import msgspec

from r2p.codecs.management import RefuseReason
from r2p.codecs.rtcan import SLOTS_MAX

PERIOD_MAX = 1 << 16
"""In slots: about 11 s in slots of 166 us."""
_RESERVATIONS_MAX = 1024  # each one makes an admission slower
_FULL_MAX = 16  # periods without free slots that are tried when a period is rounded down
_PHASES_MAX = 512  # phases that are compared, from the least one on
_SHORT = range(2, 17)  # periods in slots: those that other messages can hardly get once their residues are taken
_WHOLE = 1 << 20  # the loss that stands for all phases of a period


class PeriodRule(enum.Enum):
    """Which periods go together."""

    COMMON_FACTORS = "common-factors"
    """All with common factors (thesis 4.3.4)."""
    HARMONIC = "harmonic"
    """Of every two, one divides the other, and a message gets the least free phase: what the firmware does."""


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
            case RefuseReason.FACTOR:
                factor = math.gcd(self.period, self.other)
                whose = f"of message 0x{self.rival:04X}" if self.rival else "of a cycle"
                return (
                    f"a period of {self.period} slots meets the {self.other} {whose} at each phase: their greatest "
                    f"common factor is {factor}"
                )
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
            case RefuseReason.MANAGEMENT:
                return "the few slots that are left carry what keeps the others: announcements and renewals"
            case RefuseReason.MANY:
                return f"all {_RESERVATIONS_MAX} reservations are in use"


class Calendar:
    """All reservations of a network with cycles of `slots`. Raises ValueError unless those are 2..64."""

    def __init__(self, slots: int, rule: PeriodRule = PeriodRule.COMMON_FACTORS) -> None:
        if not 2 <= slots <= SLOTS_MAX:
            raise ValueError(f"{slots} slots: a cycle has 2 to {SLOTS_MAX}")
        self.slots = slots
        self.rule = rule
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
        """Reserve slots, at the phase that leaves most to others.

        The least phase by the harmonic rule, and with `round_down` while all periods are harmonic: then the topics of a
        control loop, which ask one after another, have slots one after another, and little time passes between them.
        `round_down`: with the longest possible period up to this one that divides the cycle or is a multiple of it,
        else with this one. A message that has slots of another period or size gives those back first.
        """
        before = self._entries.pop(message, None)  # its own slots are free for it
        refusals: list[Refusal] = []
        for wanted in self._candidates(period, round_down):
            if before is not None and (before.period, before.fragments) == (wanted, fragments):
                return self._enter(before)
            outcome = self._place(message, wanted, fragments, round_down=round_down)
            if isinstance(outcome, Reservation):
                return self._enter(outcome)
            refusals.append(outcome)
            if sum(each.reason is RefuseReason.FULL for each in refusals) == _FULL_MAX:
                break
        full = (each for each in refusals if each.reason is RefuseReason.FULL)
        return next(full, refusals[0])

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
        """Return a mask; bit i: no reservation ever owns slot i, or one that differs by a multiple of the period."""
        free = (1 << period) - 1 & ~_comb(math.gcd(self.slots, period), 0, 1, period)
        for each in self._entries.values():
            free &= ~_comb(math.gcd(each.period, period), each.phase, each.fragments, period)
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

    def _candidates(self, period: int, round_down: bool) -> Iterator[int]:
        """Yield the periods to try, in order: at least one."""
        if not round_down or not 1 < period <= PERIOD_MAX:
            yield period
            return
        yield from range(period - period % self.slots, 0, -self.slots)
        yield from (divisor for divisor in range(min(period, self.slots - 1), 1, -1) if self.slots % divisor == 0)
        yield period

    def _is_harmonic(self, period: int) -> bool:
        """Return whether of every two periods, this one included, one divides the other."""
        periods = sorted({self.slots, period, *(each.period for each in self._entries.values())})
        return all(longer % shorter == 0 for shorter, longer in pairwise(periods))

    def _place(self, message: int, period: int, fragments: int, *, round_down: bool) -> Reservation | Refusal:
        if (refusal := self._impossible(message, period, fragments)) is not None:
            return refusal
        starts = _starts(self.free(period), fragments)
        if not starts:
            return Refusal(message, RefuseReason.FULL, period, fragments)
        if self.rule is PeriodRule.HARMONIC or (round_down and self._is_harmonic(period)):
            return Reservation(message, period, next(_set_bits(starts)), fragments)
        return Reservation(message, period, self._phase(starts, period, fragments), fragments)

    def _phase(self, starts: int, period: int, fragments: int) -> int:
        """Return the phase of those possible that takes the least from others; the least one of equal phases."""
        losses = self._losses(period, fragments)
        return min(
            islice(_set_bits(starts), _PHASES_MAX),
            key=lambda phase: sum(loss[phase % len(loss)] for loss in losses),
        )

    def _losses(self, period: int, fragments: int) -> list[list[int]]:
        """Return the share of each short period's free phases that a new reservation takes, by its phase's residue.

        Most of them meet at the residues that others have spoiled already, where a new one costs nothing.
        """
        losses = []
        for short in _SHORT:
            factor, free = math.gcd(short, period), self.free(short)
            if free and factor > 1:
                taken = (_comb(factor, residue, fragments, short) & free for residue in range(factor))
                losses.append([_WHOLE * each.bit_count() // free.bit_count() for each in taken])
        return losses

    def _impossible(self, message: int, period: int, fragments: int) -> Refusal | None:
        if not 1 < period <= PERIOD_MAX or not 0 < fragments < period:
            return Refusal(message, RefuseReason.LENGTH, period, fragments)
        if (reason := self._clash(period, fragments, self.slots, 1)) is not None:
            reason = RefuseReason.PERIOD if reason is RefuseReason.OTHER else reason
            return Refusal(message, reason, period, fragments, self.slots)
        for each in self._entries.values():
            if (reason := self._clash(period, fragments, each.period, each.fragments)) is not None:
                return Refusal(message, reason, period, fragments, each.period, each.message)
        if len(self._entries) >= _RESERVATIONS_MAX:
            return Refusal(message, RefuseReason.MANY, period, fragments)
        return None

    def _clash(self, period: int, fragments: int, other: int, others: int) -> RefuseReason | None:
        """Return why two periods don't go together, at whatever phases; `others`: fragments of the other one."""
        factor = math.gcd(period, other)
        if factor in (period, other):
            return None  # what is possible depends on the phases
        if self.rule is PeriodRule.HARMONIC:
            return RefuseReason.OTHER
        return RefuseReason.FACTOR if factor < fragments + others else None


def asked_exactly(interval: int, slot: int, slots: int) -> bool:
    """Return whether an owner asks for just this interval (ns) first: whole slots that would be rounded down."""
    period, rest = divmod(interval, slot)
    return not rest and math.gcd(period, slots) not in (period, slots)


def occupied(reservation: Reservation, start: int, slots: int) -> int:
    """Return the slots of the reservation in a cycle that begins with number `start`, as a mask."""
    period, train = reservation.period, (1 << reservation.fragments) - 1
    offset = (reservation.phase - start) % period
    if period >= slots:  # at most one occurrence, and a whole one: none spans two cycles
        return train << offset if offset < slots else 0
    return _comb(period, offset, reservation.fragments, slots)


def _comb(period: int, phase: int, fragments: int, length: int) -> int:
    """Return the bits below `length` that differ from phase .. phase + fragments - 1 by a multiple of the period."""
    if fragments >= period:
        return (1 << length) - 1
    bits = ((1 << fragments) - 1) << phase % period
    tooth = (bits | bits >> period) & (1 << period) - 1
    if period < length:
        # A bit for each tooth: 1 + 2**p + 2**2p + ... is a geometric series. The product repeats the tooth there.
        tooth *= ((1 << -(-length // period) * period) - 1) // ((1 << period) - 1)
    return tooth & (1 << length) - 1


def _starts(free: int, length: int) -> int:
    """Return the bits where so many set bits in a row begin."""
    starts = free
    for shift in range(1, length):
        starts &= free >> shift  # bit i stays set while bits i .. i + shift are free
    return starts


def _set_bits(bits: int) -> Iterator[int]:
    while bits:
        yield (bits & -bits).bit_length() - 1
        bits &= bits - 1
