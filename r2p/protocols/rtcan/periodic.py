"""The periodic messages of this node, and its local calendar: what to do in which slot of a cycle.

Where a message owns slots, they are its clock: `lead` before the first one of each occurrence its data are asked for,
then each fragment has its slot. Everything lies on slot boundaries; so a cycle is a set of bits, of which the next one
says when to wake up.
"""

from collections.abc import Hashable, Iterable

import msgspec

from r2p.protocols.rtcan.calendar import Reservation, occupied
from r2p.protocols.rtcan.cycle import Timing


class Periodic(msgspec.Struct, eq=False):
    """A message that goes every `interval` ns. `lead`: how long before its slot its data are wanted (ns).

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
        """The next occurrence, with fresh data. Says whether there was something of the one before."""
        unfinished = self.payload is not None
        self.payload = payload
        self.sent = 0
        self.waiting = None
        self.unknown = False
        return unfinished


class Agenda:
    """What to do in the slots of one cycle: `fills` asks for data, `sends` has a message and its fragment.

    Bit i of `bits` says that there is something in slot i. Slot 0 of the next cycle counts as the last one of this.
    """

    def __init__(self, timing: Timing) -> None:
        self.bits = 0
        self.sends: dict[int, tuple[Periodic, int]] = {}
        self.fills: dict[int, list[Periodic]] = {}
        self._timing = timing
        self._stale = True

    def changed(self) -> None:
        """A message got or lost its slots."""
        self._stale = True

    def turn(self, cycle: int, periodics: Iterable[Periodic]) -> None:
        """A cycle begins."""
        if not self._stale:
            return
        self._stale = False
        self.sends.clear()
        self.fills.clear()
        for each in periodics:
            if each.active and each.reservation is not None:
                self._enter(cycle, each, each.reservation)
                longer = each.reservation.period > self._timing.slots
                self._stale = self._stale or longer or each.from_cycle > cycle
        self.bits = sum(1 << slot for slot in self.sends.keys() | self.fills.keys())

    def lead_slots(self, each: Periodic) -> int:
        """Slots from where the data are wanted to the slot; 0: in the slot itself."""
        assert each.reservation is not None
        return min(-(-each.lead // self._timing.slot), each.reservation.period - each.fragments)

    def _enter(self, cycle: int, each: Periodic, reservation: Reservation) -> None:
        slots = self._timing.slots
        lead = self.lead_slots(each)
        start = cycle * slots
        if cycle >= each.from_cycle:
            for slot in _set_bits(occupied(reservation, start, slots)):
                self.sends[slot] = each, (start + slot - reservation.phase) % reservation.period
        if lead:
            first = reservation.first_from(max(start + 1 + lead, each.from_cycle * slots))
            for number in range(first, start + slots + lead + 1, reservation.period):
                self.fills.setdefault(number - lead - start, []).append(each)


def _set_bits(bits: int) -> Iterable[int]:
    while bits:
        yield (bits & -bits).bit_length() - 1
        bits &= bits - 1
