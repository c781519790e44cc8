"""The periodic messages of this node, and its plan of a cycle: what to do in which slot.

Where a message owns slots, they are its clock: `lead` before the first one of each occurrence its data are asked for,
then each fragment has its slot. Everything lies on slot boundaries, so to wake up in time is to know the next slot.
"""

import math
from collections.abc import Hashable, Iterable

import msgspec

from r2p.protocols.rtcan.calendar import Reservation, occupied
from r2p.protocols.rtcan.cycle import Timing, following


class PeriodicMessage(msgspec.Struct, eq=False):
    """A message that goes every `interval` ns. `lead`: how long before its slot its data are needed (ns).

    `active`: its slots may be used, from `from_cycle` on. Of an occurrence: `payload` to send, frames `sent`, and
    `waiting`, the number of the slot for which data were asked but not given yet. Without slots: `tick`, when it is due
    next, and `ticked`, whether data were asked.
    """

    high: int
    message: int
    size: int
    fragments: int
    interval: int
    lead: int
    handle: Hashable
    reservation: Reservation | None = None
    active: bool = False
    from_cycle: int = 0
    payload: bytes | None = None
    sent: int = 0
    waiting: int | None = None
    unknown: bool = False
    tick: int | None = None
    ticked: bool = False

    def restart(self, payload: bytes | None = None) -> bool:
        """Begin the next occurrence, with fresh data. Says whether data of the one before were left."""
        unfinished = self.payload is not None
        self.payload = payload
        self.sent = 0
        self.waiting = None
        self.unknown = False
        return unfinished


_Sends = dict[int, tuple[PeriodicMessage, int, bool]]
_Fills = dict[int, list[tuple[PeriodicMessage, int]]]


class SlotPlan:
    """What to do in the slots of the current cycle. Slot 0 of the next cycle counts as the last one of this.

    After the least common multiple of all periods, which is the longest of them, all comes again: each cycle up to
    there is worked out once.
    """

    def __init__(self, timing: Timing) -> None:
        self.periodics: dict[int, PeriodicMessage] = {}
        """The periodic messages of this node by high byte."""
        self.sends: _Sends = {}
        """By slot: a message, its fragment, and whether its data are only asked for now."""
        self.fills: _Fills = {}
        """By slot: messages whose data are asked for now, and how many slots ahead of theirs."""
        self.next = following((), timing.slots)
        """By slot: the first one after it with something to do."""
        self.own = 0
        """A bit for each slot that is ours."""
        self._timing = timing
        self._stale = True
        self._cycles: dict[int, tuple[_Sends, _Fills, list[int], int]] = {}
        self._span = 1  # cycles after which all comes again

    def invalidate(self) -> None:
        """A message got or lost its slots."""
        self._stale = True

    def begin_cycle(self, cycle: int) -> None:
        """The cycle with this number begins."""
        if self._stale:
            self._restart(cycle)
        known = self._cycles.get(cycle % self._span)
        if known is None:
            known = self._cycles[cycle % self._span] = self._work_out(cycle)
        self.sends, self.fills, self.next, self.own = known

    def _restart(self, cycle: int) -> None:
        """Other messages than before have slots, some perhaps only from a later cycle on: then it is stale still."""
        messages = self.periodics.values()
        owners = [(each.from_cycle, each.reservation.period) for each in messages if each.active and each.reservation]
        self._stale = any(begins > cycle for begins, _ in owners)
        self._span = math.lcm(self._timing.slots, *[period for _, period in owners]) // self._timing.slots
        self._cycles.clear()

    def _work_out(self, cycle: int) -> tuple[_Sends, _Fills, list[int], int]:
        sends: _Sends = {}
        fills: _Fills = {}
        for each in self.periodics.values():
            if each.active and each.reservation is not None:
                self._enter(sends, fills, cycle, each, each.reservation)
        own = sum(1 << slot for slot in sends)
        return sends, fills, following(sends.keys() | fills.keys(), self._timing.slots), own

    def _enter(self, sends: _Sends, fills: _Fills, cycle: int, each: PeriodicMessage, reservation: Reservation) -> None:
        slots = self._timing.slots
        # Whole slots, rounded up; but not before the occurrence before this one is through.
        lead = min(-(-each.lead // self._timing.slot), reservation.period - each.fragments)
        start = cycle * slots
        if cycle >= each.from_cycle:
            for slot in _set_bits(occupied(reservation, start, slots)):
                fragment = (start + slot - reservation.phase) % reservation.period
                sends[slot] = each, fragment, not lead and not fragment
        if lead:
            # Data may be asked for in this cycle for a slot of a later one.
            first = reservation.first_from(max(start + 1 + lead, each.from_cycle * slots))
            for number in range(first, start + slots + lead + 1, reservation.period):
                fills.setdefault(number - lead - start, []).append((each, lead))


def _set_bits(bits: int) -> Iterable[int]:
    while bits:
        yield (bits & -bits).bit_length() - 1
        bits &= bits - 1
