"""Where a node is in which cycle."""

import pytest

from r2p.codecs import can_bits, rtcan
from r2p.protocols.rtcan.cycle import HOLDOVER, NO_SLOT, Alignment, Cycle, CycleState, following, timing
from tests.can_vectors import CanCase, can_cases

TIMING = timing()
START = 1_000_000_000
LATENCY = 7_000


def receive_sync(cycle: Cycle, start: int, counter: int, mask: int = 0) -> Alignment:
    """A sync frame whose start of frame was at `start`."""
    frame = rtcan.encode_sync(counter, mask)
    return cycle.on_sync(frame, start + can_bits.frame_bits(frame.id, frame.data) * TIMING.bit + LATENCY)


def slave() -> Cycle:
    return Cycle(TIMING, LATENCY)


def test_the_timing_of_the_thesis() -> None:
    assert (TIMING.slot, TIMING.cycle, TIMING.bit) == (166_000, 9_960_000, 1_000)
    assert timing(10, 20_000_000, 125_000).bit == 8_000
    with pytest.raises(ValueError, match="slots of 158 us are too short for frames of up to 160 us; at most 62 fit"):
        timing(63)


@pytest.mark.parametrize("mask", [0, 1, 0x0123_4567_89AB_CDEF, (1 << 64) - 1])
def test_the_reference_is_the_start_of_frame_whatever_the_stuffing(mask: int) -> None:
    cycle = slave()
    assert receive_sync(cycle, START, 200, mask) is Alignment.STARTED
    assert (cycle.reference, cycle.counter, cycle.mask, cycle.state) == (START, 200, mask, CycleState.FOLLOWING)
    assert cycle.slot_at(START + 166_000) == 1
    assert cycle.slot_at(START + 165_999) == 0
    assert cycle.start_of(6) == START + 996_000


def test_it_follows_the_sync_and_not_its_own_clock() -> None:
    cycle = slave()
    receive_sync(cycle, START, 1)
    assert receive_sync(cycle, START + TIMING.cycle + 480, 2, 0b10) is Alignment.ALIGNED
    assert (cycle.reference, cycle.counter, cycle.mask) == (START + TIMING.cycle + 480, 2, 0b10)
    assert cycle.measured() == (TIMING.cycle + 480, 960)


def test_the_counter_goes_on_beyond_8_bits() -> None:
    cycle = slave()
    receive_sync(cycle, START, 250)
    assert cycle.network_time(START) is None
    assert not cycle.anchor(0x1_0000_00F9)  # told one cycle ago
    assert cycle.counter == 0x1_0000_00FA
    for n in range(1, 600):
        assert receive_sync(cycle, START + n * TIMING.cycle, 250 + n & 0xFF) is Alignment.ALIGNED
        assert cycle.counter == 0x1_0000_00FA + n
    assert cycle.network_time(cycle.reference + 5) == (0x1_0000_00FA + 599) * TIMING.cycle + 5
    assert not cycle.anchor(0x1_0000_00FA + 590)
    assert cycle.anchor(7 + (0x1_0000_00FA + 599 & 0xFF))


@pytest.mark.parametrize("low", range(0, 256, 5))
def test_there_is_no_cycle_before_the_first_one(low: int) -> None:
    """Whatever a NETWORK says: a count is a field without a sign."""
    cycle = slave()
    receive_sync(cycle, START, low)
    cycle.anchor(0)
    assert (cycle.counter & 0xFF, cycle.counter >= 0) == (low, True)


def test_missed_syncs_are_bridged_for_three_cycles() -> None:
    cycle = slave()
    receive_sync(cycle, START, 255, 0b10)
    cycle.anchor(255)
    for n in range(1, HOLDOVER + 1):
        assert cycle.bridge()
        assert cycle.state is CycleState.HOLDING
        assert (cycle.counter, cycle.reference, cycle.mask) == (255 + n, START + n * TIMING.cycle, None)
    assert not cycle.bridge()
    assert not cycle.running
    assert cycle.network_time(START) is None


def test_resynchronised_after_missed_syncs() -> None:
    cycle = slave()
    receive_sync(cycle, START, 255)
    cycle.anchor(255)
    cycle.bridge()
    cycle.bridge()
    assert receive_sync(cycle, START + 3 * TIMING.cycle + 90, 2, 0b100) is Alignment.ALIGNED
    assert (cycle.counter, cycle.missed, cycle.mask, cycle.state) == (258, 0, 0b100, CycleState.FOLLOWING)
    assert cycle.measured() == (TIMING.cycle + 30, 60)


def test_a_sync_that_is_read_late_belongs_to_the_cycle_that_began_without_it() -> None:
    cycle = slave()
    receive_sync(cycle, START, 1)
    cycle.bridge()
    assert receive_sync(cycle, START + TIMING.cycle + 20, 2, 0b100) is Alignment.LATE
    assert (cycle.counter, cycle.mask, cycle.missed) == (2, 0b100, 0)
    assert receive_sync(cycle, START + TIMING.cycle + 20, 2, 0b100) is Alignment.REPEATED


@pytest.mark.parametrize(
    ("late", "counter"), [(TIMING.slot + 1, 2), (-TIMING.slot - 1, 2), (0, 3), (0, 1), (TIMING.cycle // 2, 2)]
)
def test_a_sync_off_the_grid_is_another_masters(late: int, counter: int) -> None:
    cycle = slave()
    receive_sync(cycle, START, 1, 0b10)
    assert receive_sync(cycle, START + TIMING.cycle + late, counter) is Alignment.FOREIGN
    assert (cycle.reference, cycle.counter, cycle.mask) == (START, 1, 0b10)


def test_a_lost_cycle_starts_anew_with_any_sync_and_keeps_the_count() -> None:
    cycle = slave()
    receive_sync(cycle, START, 1)
    cycle.anchor(0x301)
    cycle.stop()
    assert receive_sync(cycle, START + 40 * TIMING.cycle + 4_000_000, 41) is Alignment.STARTED
    assert cycle.counter == 0x329


@pytest.mark.parametrize(
    ("late", "alignment"),
    [
        (0, Alignment.RESUMED),
        (TIMING.slot, Alignment.RESUMED),
        (-TIMING.slot, Alignment.RESUMED),
        (TIMING.slot + 1, Alignment.STARTED),
    ],
)
def test_a_lost_cycle_goes_on_where_a_new_master_begins_at_most_a_slot_late(late: int, alignment: Alignment) -> None:
    cycle = slave()
    receive_sync(cycle, START, 1)
    cycle.anchor(0x301)
    cycle.stop()
    assert receive_sync(cycle, START + 7 * TIMING.cycle + late, 8) is alignment
    assert (cycle.counter, cycle.reference) == (0x308, START + 7 * TIMING.cycle + late)


def test_a_master_keeps_its_grid() -> None:
    cycle = slave()
    assert cycle.upcoming(START) == (START, 1)  # the original's first cycle is 1, too
    cycle.lead(START, 1, 0b1001)
    assert (cycle.reference, cycle.counter, cycle.mask) == (START, 1, 0b1001)
    for _ in range(300):
        frame = cycle.advance(0)
    assert cycle.reference == START + 300 * TIMING.cycle
    assert (cycle.counter, frame.id) == (301, (301 & 0xFF) << 7)
    assert cycle.network_time(START) == TIMING.cycle
    assert frame == rtcan.encode_sync(301 & 0xFF, 0)


def test_a_new_master_goes_on_with_the_grid_and_the_count_of_the_old_one() -> None:
    cycle = slave()
    receive_sync(cycle, START, 1)
    cycle.anchor(0x301)
    for _ in range(HOLDOVER + 1):
        cycle.bridge()
    now = START + 7 * TIMING.cycle + 5
    assert cycle.upcoming(now) == (START + 8 * TIMING.cycle, 0x309)


@pytest.mark.golden
@pytest.mark.parametrize("case", can_cases("hrt-time"), ids=str)
def test_recorded_network_time(case: CanCase) -> None:
    """The original's formula, with its rounding: (cycle * slots + slot) * slot length + timer."""
    words = {step.verb: step.words for step in case.steps}
    clock, slots = int(words["start"][0]), int(words["start"][1])
    cycle = Cycle(timing(slots, 1_000_000_000 // clock))
    cycle.lead(0, int(words["cycle"][0]), None)
    at = cycle.start_of(int(words["slot"][0])) + int(words["cnt"][0]) * 1_000
    recorded = case.of("time")[0].fields
    assert cycle.network_time(at) == recorded["sec"] * 1_000_000_000 + recorded["nsec"]


def test_the_slot_that_follows() -> None:
    assert following({2, 4}, 4) == [2, 2, 4, 4, NO_SLOT]
    assert following((), 2) == [NO_SLOT] * 3
    assert following({0}, 1) == [NO_SLOT] * 2, "slot 0 is before all others"


def test_free_slots_are_those_of_the_mask() -> None:
    cycle = Cycle(timing())
    assert not cycle.free
    cycle.lead(0, 1, 0b1011)
    assert cycle.free == {2, *range(4, 60)}
    assert [cycle.next_free[slot] for slot in (0, 2, 58, 59, 60)] == [2, 4, 59, NO_SLOT, NO_SLOT]
    cycle.stop()
    assert not cycle.free
    assert set(cycle.next_free) == {NO_SLOT}


def test_free_slots_are_counted_over_the_last_cycles() -> None:
    cycle = slave()
    free = TIMING.slots - 1
    assert cycle.free_rate == pytest.approx(free * 1e9 / TIMING.cycle)
    cycle.lead(0, 1, 1)
    for _ in range(200):
        cycle.advance(0b1111)
    assert cycle.free_rate == pytest.approx((free - 3) * 1e9 / TIMING.cycle, rel=1e-3)
