"""The slots of RTCAN as the analysis sees them: which are free, how long one waits for them, how short they may be.

Slots are counted through, as in `r2p.bus.Calendar`. An event is published at any instant; so the worst case is that a
free slot has begun just now, and the wait for the n-th free one after it is the longest distance between a free slot
and the n-th one after it, in the whole pattern that the reservations make.
"""

import math
from collections.abc import Iterable, Sequence

import msgspec

from r2p.codecs.can_bits import FRAME_MAX, INTERMISSION, frame_bits_max
from r2p.errors import MessageError
from r2p.protocols.rtcan.calendar import Reservation, occupied
from r2p.protocols.rtcan.cycle import HOLDOVER, Timing

_CYCLES_MAX = 256  # of a pattern of slots; where reservations repeat later, more slots count as reserved
_MICROSECOND = 1000  # ns
_MILLION = 1_000_000


class SlotSupply:
    """The free slots of a network, as the time that one waits for them in the worst case.

    `masks` are the reservation masks of the cycles after which all comes again, at least one.
    """

    def __init__(self, timing: Timing, masks: Sequence[int]) -> None:
        self.timing = timing
        slots = timing.slots
        taken = [cycle * slots + slot for cycle, mask in enumerate(masks) for slot in range(slots) if mask >> slot & 1]
        self._length = slots * len(masks)
        self.free = sorted(set(range(self._length)).difference(taken))
        """The numbers of the free slots, from the start of the pattern on."""
        self._waits: dict[int, int] = {}

    @property
    def share(self) -> float:
        """The share of the slots that is free."""
        return len(self.free) / self._length

    def wait(self, count: int) -> int | None:
        """Return how long after the start of a free slot the `count`-th one after it starts at the latest (ns).

        None: there are no free slots.
        """
        if not self.free:
            return None
        rounds, rest = divmod(count, len(self.free))
        slots = rounds * self._length + self._longest(rest)
        return slots * self.timing.slot

    def _longest(self, count: int) -> int:
        """Return the slots from a free one to the `count`-th after it, at most."""
        found = self._waits.get(count)
        if found is None:
            ahead = self.free[count:] + [slot + self._length for slot in self.free[:count]]
            found = self._waits[count] = max(after - slot for slot, after in zip(self.free, ahead, strict=True))
        return found


def slot_supply(timing: Timing, reservations: Iterable[Reservation] = ()) -> SlotSupply:
    """Return the free slots beside these reservations and the sync.

    If the pattern of the reservations repeats only after more than 256 cycles, those with the longest periods count as
    if they had their slots in every cycle: the bounds stay safe, and become longer.
    """
    kept = list(reservations)
    while math.lcm(timing.slots, *(each.period for each in kept)) // timing.slots > _CYCLES_MAX:
        longest = max(kept, key=lambda each: each.period if timing.slots % each.period else 0)
        kept.remove(longest)
        kept += _in_every_cycle(longest, timing.slots)
    cycles = math.lcm(timing.slots, *(each.period for each in kept)) // timing.slots
    return SlotSupply(timing, [_mask(kept, cycle * timing.slots, timing.slots) for cycle in range(cycles)])


def _in_every_cycle(reservation: Reservation, slots: int) -> list[Reservation]:
    """Return reservations of periods that divide the cycle, which have all slots that this one ever has."""
    period = math.gcd(reservation.period, slots)
    starts = {(reservation.phase + fragment) % period for fragment in range(reservation.fragments)}
    return [Reservation(reservation.message, period, start) for start in sorted(starts)]


def _mask(reservations: Iterable[Reservation], start: int, slots: int) -> int:
    mask = 1  # the sync
    for each in reservations:
        mask |= _owned(each, start, slots)
    return mask


def _owned(reservation: Reservation, start: int, slots: int) -> int:
    if reservation.period > 1:
        return occupied(reservation, start, slots)
    return (1 << slots) - 1


# How short a slot may be


class SlotAccuracy(msgspec.Struct, frozen=True):
    """How exactly the nodes of a network hit their slots.

    `ppm`: how far off each clock is at most, either way. `jitter`: how much the latency of a node varies at most from
    its calibrated value, either way (ns), for sending and for receiving alike.
    """

    ppm: float = 50.0
    jitter: int = 0


def guard_time(cycle: int, accuracy: SlotAccuracy, missed: int = 0) -> int:
    """Return the guard (ns) that a slot needs behind the longest frame, with cycles of so many ns.

    One node may be early by as much as its neighbour is late. Each has the start of the cycle from a sync that left and
    arrived with the jitter, and sends with the jitter: of two slaves the sync is the same, so receiving and sending
    count for both; of a slave and its master, sending the sync counts instead. Either makes four times the jitter. And
    both clocks drift apart until the next sync. `missed`: how many syncs in a row may be lost; hard real-time messages
    go on for up to 3 cycles without one.
    """
    apart = 2 * accuracy.ppm * cycle * (1 + missed) / _MILLION
    return 4 * accuracy.jitter + math.ceil(apart)


def smallest_slot(
    slots: int, bit: int, accuracy: SlotAccuracy, *, size: int = FRAME_MAX, missed: int = HOLDOVER
) -> int:
    """Return the shortest slot (ns, whole us) for a cycle of `slots` slots, in which frames never meet.

    `size`: the most data bytes of a frame; `bit` in ns. The cycle, and so the drift, becomes longer with the slot.
    Raises `MessageError` if no slot is long enough for such a drift.
    """
    frame = (frame_bits_max(size) + INTERMISSION) * bit
    drift = 2 * accuracy.ppm * slots * (1 + missed) / _MILLION  # of a slot
    if drift >= 1:
        raise MessageError(f"clocks that are off by {accuracy.ppm:g} ppm can't share a cycle of {slots} slots")
    slot = _whole(math.ceil((frame + 4 * accuracy.jitter) / (1 - drift)))
    while slot < frame + guard_time(slots * slot, accuracy, missed):
        slot += _MICROSECOND
    return slot


def _whole(time: int) -> int:
    return -(-time // _MICROSECOND) * _MICROSECOND
