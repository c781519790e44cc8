"""Slots and cycles: this node's place in the cycle, by its own clock (PROTOCOL.md 6, thesis 4.3.3).

The reference is the start of frame of the sync in slot 0. The master plans it on a grid of its own clock; if the
confirmation of its own frame shows that it left later than latencies vary, that start counts. A slave has it from each
sync that it receives: the reception's stamp, less the exact length of the frame with its stuff bits, less its own
calibrated latency. The slave's own clock bridges missing syncs, for at most three cycles.

The first sync of a master that continues a network may leave late: then its grid begins with that sync, and
moves back from cycle to cycle, so that network time catches up.
"""

import enum
from collections.abc import Callable, Container
from functools import lru_cache

import msgspec

from r2p.codecs import rtcan
from r2p.codecs.can_bits import INTERMISSION, frame_bits_max, start_of_frame
from r2p.codecs.rtcan import CYCLE_MASK, FRAME_MAX, Frame
from r2p.units import SECOND

HOLDOVER = 3
"""Cycles without a sync that a slave bridges."""
NO_SLOT = 1 << 16
"""After every slot of a cycle."""
_CATCH_UP = 64  # part of a slot by which a cycle is shortened while network time catches up
_IN_TIME = 8_000  # ns between plan and stamp of a sync: two calibrated latencies that vary by +-3 us, and a bit more
_AMBIGUOUS = 128  # cycles: half of what the 8 bits of a sync tell apart
_MEAN = 16  # cycles over which free slots are counted, roughly
_DELAYED = 16  # cycles that a sync may be ahead of NETWORK, which waits for a free slot
_MICROSECOND = 1000


class Timing(msgspec.Struct, frozen=True):
    """Parameters shared by all nodes of a network: slots in a cycle, length of a slot (ns), bit time (ns)."""

    slots: int
    slot: int
    bit: int

    @property
    def cycle(self) -> int:
        """The true length of a cycle (ns)."""
        return self.slots * self.slot


def timing(slots: int = 60, nominal: int = 10_000_000, bit_rate: int = 1_000_000) -> Timing:
    """Return the slots of a nominal cycle (ns): whole microseconds each. Raises ValueError if no frame fits in."""
    slot = nominal // slots // _MICROSECOND * _MICROSECOND
    bit = SECOND // bit_rate
    longest = (frame_bits_max(FRAME_MAX) + INTERMISSION) * bit
    if slot < longest:
        short = f"slots of {slot // 1000} us are too short for frames of up to {longest // 1000} us"
        fitting = nominal // (-(-longest // _MICROSECOND) * _MICROSECOND)
        raise ValueError(f"{short}; at most {fitting} fit in this cycle, alike for all nodes")
    return Timing(slots, slot, bit)


class CycleState(enum.Enum):
    """The node's way to know its place in the cycle."""

    NONE = "no cycle"
    FOLLOWING = "following"  # the last sync was received
    HOLDING = "holding"  # one to three syncs were missed
    LEADING = "leading"  # the node is the master


_NONE = CycleState.NONE  # Python 3.11 is slow to find a member of an enum


class Alignment(enum.Enum):
    """The effect of a sync frame on the cycle."""

    STARTED = "started"  # there was no cycle before
    RESUMED = "resumed"  # ... but one that was lost goes on, where it should be by now
    ALIGNED = "aligned"
    LATE = "late"  # this cycle has already begun without it
    REPEATED = "repeated"  # this cycle has its sync already
    FOREIGN = "foreign"  # off the grid, or of another count: another master's


class Cycle:
    """The cycle of one node. `mask` None: the free slots of this cycle are unknown.

    `free` are the slots that are surely free; `next_free` has for each slot the first of them after it. `counter` is
    the whole cycle counter once `anchored`; before, only its low 8 bits are valid.
    """

    def __init__(self, timing: Timing, receive_latency: int = 0) -> None:
        self.timing = timing
        self.state = CycleState.NONE
        self.reference = 0
        self.counter = 0
        self.mask: int | None = None
        self.free, self.next_free = _free(None, timing.slots)
        self.missed = 0
        self.anchored = False
        self._grid = 0  # the reference as it was planned
        self._behind = 0  # how far the grid is behind that of the network's first master (ns)
        self._slot = timing.slot
        self._latency = receive_latency
        self._first = 0
        self._first_at = 0
        self._length = 0
        self._widest = 0  # how far a sync was from where it was expected by the one before it (ns)
        self._mean_free: float = timing.slots - 1

    @property
    def free_rate(self) -> float:
        """Free slots a second, averaged over the last cycles; without a cycle, all slots are free."""
        return self._mean_free * SECOND / self.timing.cycle

    @property
    def running(self) -> bool:
        return self.state is not _NONE

    def slot_at(self, now: int) -> int:
        """Return the slot at this instant, counted from the start of this cycle; not limited to it."""
        return (now - self.reference) // self._slot

    def start_of(self, slot: int) -> int:
        """Return when a slot of this cycle, or of a later one, begins."""
        return self.reference + slot * self._slot

    def number_of(self, slot: int) -> int:
        """Return the number of a slot of this cycle, counted from the start of cycle 0."""
        return self.counter * self.timing.slots + slot

    def network_time(self, now: int) -> int | None:
        """Return the time that all nodes share (ns): since the start of cycle 0. None: unknown."""
        if not self.anchored or not self.running:
            return None
        return self.counter * self.timing.cycle + now - self.reference

    # Slave

    def on_sync(self, frame: Frame, stamp: int) -> Alignment:
        """Follow a sync frame; `stamp` is the instant of the reception interrupt."""
        sync = rtcan.decode_sync(frame)
        start = start_of_frame(frame, stamp - self._latency, self.timing.bit)
        if self.state is _NONE:
            return self._start(start, sync.cycle, sync.mask)
        cycles, off = self._distance(start)
        if abs(off) > self.timing.slot or cycles < 0 or (self.counter + cycles) & CYCLE_MASK != sync.cycle:
            return Alignment.FOREIGN
        if cycles == 0 and self.mask is not None:
            return Alignment.REPEATED
        self.counter += cycles
        # Over all cycles since the start: the jitter of two stamps, spread over many cycles, does not matter.
        self._length = (start - self._first_at) // max(1, self.counter - self._first)
        self._widest = max(self._widest, abs(off))
        self._follow(start, sync.mask)
        return Alignment.ALIGNED if cycles else Alignment.LATE

    def doubt(self) -> None:
        """Distrust the mask of this cycle: the free slots are unknown, unless there is another sync."""
        self._set_mask(None)

    def measured(self) -> tuple[int, int] | None:
        """Return the length of a cycle by the syncs since its start, and its possible error by their jitter (ns).

        None before there are two.
        """
        if not self._length:
            return None
        return self._length, 2 * self._widest // max(1, self.counter - self._first)

    def bridge(self) -> bool:
        """Begin the next cycle without a sync; return False for one too many, which loses the cycle."""
        self.missed += 1
        if self.missed > HOLDOVER:
            self.stop()
            return False
        self.state = CycleState.HOLDING  # own slots go on; no slot is free, as its mask is not known
        self.counter += 1
        self.reference += self.timing.cycle
        self._grid = self.reference
        self._set_mask(None)
        return True

    def anchor(self, counter: int) -> bool:
        """Use the whole counter of a NETWORK of this cycle or a bit earlier; return whether it changes this node's."""
        whole = _nearest(counter, self.counter, _DELAYED)
        changed = self.anchored and whole != self.counter
        self._first += whole - self.counter
        self.counter = whole
        self.anchored = True
        return changed

    def stop(self) -> None:
        """Forget the cycle."""
        self.state = CycleState.NONE
        self._set_mask(None)
        self._length = 0

    # Master

    def first_sync(self, now: int, mask: Callable[[int], int], *, inherits: bool) -> tuple[Frame, int, int]:
        """The first sync of a new master, its start and its count; `mask(count)` gives the slots that it reserves.

        If the master `inherits` a network, its grid and count go on.
        """
        self.anchored = inherits
        start, counter = self.upcoming(now)
        return rtcan.encode_sync(counter, mask(counter)), start, counter

    def upcoming(self, now: int) -> tuple[int, int]:
        """Return start and count of the next cycle: by the previous grid and counter, if any."""
        if not self.anchored:
            return now, 1
        cycles = -(-(now - self._grid) // self.timing.cycle)
        return self._grid + cycles * self.timing.cycle, self.counter + cycles

    def delay(self, by: int) -> bool:
        """Take into account that the first sync of a continued network left `by` ns late.

        Return False if it was too late for its count: network time can no longer catch up, and a new network begins.
        """
        self._behind += by
        return 2 * self._behind < self.timing.cycle

    def lead(self, start: int, counter: int, mask: int | None, *, anew: bool = False) -> None:
        """Lead from the cycle that began at `start`; `anew`: a new network."""
        self._begin(CycleState.LEADING, start, mask)
        if anew:
            self._behind = 0
        self.counter = counter
        self.anchored = True

    def advance(self, mask: int) -> Frame:
        """Begin the next cycle; its sync frame comes back."""
        self.counter += 1
        self.reference = self.end
        self._behind -= self._grid + self.timing.cycle - self.reference
        self._grid = self.reference
        self._set_mask(mask)
        return rtcan.encode_sync(self.counter, mask)

    @property
    def end(self) -> int:
        """Return when the master's next cycle begins."""
        return self._grid + self.timing.cycle - min(self._behind, self._slot // _CATCH_UP)

    def on_sync_sent(self, frame: Frame, at: int) -> bool:
        """Correct the reference if the master's sync, on the bus until `at`, left late: its slaves are late with it.

        Return False for the sync of an earlier cycle.

        Delays within the jitter of latencies change nothing: the plan is as good a guess as the stamp, and keeps the
        slots of the next cycle exactly one cycle later.
        """
        start = start_of_frame(frame, at, self.timing.bit)
        ours = rtcan.message_of(frame.id) == self.counter & CYCLE_MASK  # it may be confirmed in the next cycle
        if ours and _IN_TIME < start - self._grid <= self._slot:
            self.reference = start
        return ours

    def _start(self, start: int, low: int, mask: int) -> Alignment:
        cycles, off = self._distance(start)
        counter = self.counter + cycles
        resumed = self.anchored and counter & CYCLE_MASK == low and abs(off) <= self.timing.slot
        self.counter = _nearest(counter, low, _AMBIGUOUS) if self.anchored else low
        self._follow(start, mask)
        self._first, self._first_at, self._widest = self.counter, start, 0
        return Alignment.RESUMED if resumed else Alignment.STARTED

    def _follow(self, start: int, mask: int) -> None:
        self._begin(CycleState.FOLLOWING, start, mask)
        self._behind = 0

    def _begin(self, state: CycleState, start: int, mask: int | None) -> None:
        self.state = state
        self.reference = self._grid = start
        self._set_mask(mask)
        self.missed = 0

    def _set_mask(self, mask: int | None) -> None:
        if mask != self.mask:
            self.mask = mask
            self.free, self.next_free = _free(mask, self.timing.slots)
        if mask is not None:
            self._mean_free += (len(self.free) - self._mean_free) / _MEAN

    def _distance(self, start: int) -> tuple[int, int]:
        """Return how many cycles after this one a start of frame lies, and how far off (ns)."""
        cycles = (start - self.reference + self.timing.cycle // 2) // self.timing.cycle
        return cycles, start - self.reference - cycles * self.timing.cycle


def following(chosen: Container[int], slots: int) -> list[int]:
    """Return for each slot from 0 to `slots` the first chosen one after it, up to `slots`; else NO_SLOT."""
    after = [NO_SLOT]
    for slot in range(slots, 0, -1):
        after.append(slot if slot in chosen else after[-1])
    return after[::-1]


@lru_cache(maxsize=64)  # few masks come, again and again
def _free(mask: int | None, slots: int) -> tuple[frozenset[int], list[int]]:
    """Return the free slots of this mask, and the next one after each slot."""
    free = frozenset() if mask is None else frozenset(slot for slot in range(1, slots) if not mask >> slot & 1)
    return free, following(free, slots)


def _nearest(counter: int, low: int, before: int) -> int:
    """The counter with the low 8 bits of `low` that is next to this one: up to `before` it, or else after it."""
    nearest = counter + ((low - counter + before) & CYCLE_MASK) - before
    return nearest if nearest >= 0 else nearest + CYCLE_MASK + 1
