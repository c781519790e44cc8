"""The free slots between reserved ones, and how short slots may be."""

import pytest

from r2p.analysis import SlotAccuracy, SlotSupply, guard_time, slot_supply, smallest_slot
from r2p.errors import MessageError
from r2p.protocols.rtcan.calendar import Calendar, Reservation
from r2p.protocols.rtcan.cycle import timing

TIMING = timing()
EXACT = SlotAccuracy(0.0, 0)


def test_beside_the_sync_all_slots_are_free() -> None:
    supply = slot_supply(TIMING)
    assert supply.free == list(range(1, 60))
    assert supply.share == pytest.approx(59 / 60)
    assert [supply.wait(count) for count in (0, 1, 59, 60, 590)] == [
        slots * TIMING.slot for slots in (0, 2, 60, 62, 600)
    ]


def test_the_wait_is_the_longest_of_the_whole_pattern() -> None:
    calendar = Calendar(60)
    for message, period, fragments in ((1, 6, 2), (2, 120, 3), (3, 60, 4)):
        calendar.admit(message, period, fragments)
    supply = slot_supply(TIMING, calendar)
    masks = [calendar.mask(cycle) for cycle in range(2)]
    assert supply.free == SlotSupply(TIMING, masks).free
    endless = [slot + 120 * turn for turn in range(5) for slot in supply.free]
    for count in (1, 2, 5, len(supply.free), len(supply.free) + 3):
        longest = max(b - a for a, b in zip(endless, endless[count:], strict=False))
        assert supply.wait(count) == longest * TIMING.slot


def test_a_pattern_that_repeats_late_counts_more_slots_as_reserved() -> None:
    exact = [Reservation(1, 60, 1), Reservation(2, 120, 2)]
    rare = Reservation(3, 60 * 1021, 30, 2)
    supply = slot_supply(TIMING, [*exact, rare])
    assert {30, 31, 90, 91}.isdisjoint(supply.free)
    assert set(supply.free) == set(slot_supply(TIMING, [*exact, Reservation(3, 60, 30, 2)]).free)
    odd = slot_supply(TIMING, [Reservation(1, 60 * 1021 + 1, 5)])  # shares no factor: any slot, at some time
    assert not odd.free
    assert odd.wait(1) is None


def test_the_guard_grows_with_the_drift_the_jitter_and_lost_syncs() -> None:
    cycle = 10_000_000
    assert guard_time(cycle, EXACT) == 0
    assert guard_time(cycle, SlotAccuracy(50.0, 0)) == 1_000
    assert guard_time(cycle, SlotAccuracy(50.0, 0), missed=3) == 4_000
    assert guard_time(cycle, SlotAccuracy(0.0, 3_000)) == 12_000


@pytest.mark.parametrize(("bitrate", "shortest"), [(1_000_000, 160_000), (500_000, 320_000), (125_000, 1_280_000)])
def test_the_shortest_slot_of_exact_nodes_is_the_longest_frame(bitrate: int, shortest: int) -> None:
    bit = 1_000_000_000 // bitrate
    assert smallest_slot(60, bit, EXACT) == shortest
    assert smallest_slot(60, bit, EXACT, size=0) == 80 * bit


def test_the_shortest_slot_has_room_for_its_own_guard_and_none_for_less() -> None:
    accuracy = SlotAccuracy(100.0, 2_000)
    for missed in (0, 3):
        slot = smallest_slot(60, 1000, accuracy, missed=missed)
        assert slot >= 160_000 + guard_time(60 * slot, accuracy, missed)
        shorter = slot - 1000
        assert shorter < 160_000 + guard_time(60 * shorter, accuracy, missed)


def test_clocks_that_are_too_far_off_are_an_error() -> None:
    with pytest.raises(MessageError, match="can't share a cycle of 60 slots"):
        smallest_slot(60, 1000, SlotAccuracy(3_000.0))
