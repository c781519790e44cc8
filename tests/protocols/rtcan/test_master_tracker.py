"""Whether a master that sends no NETWORK has the same cycle: its length shows that, and jitters."""

import random

import pytest

from r2p.codecs import can_bits, management, rtcan
from r2p.protocols.rtcan.cycle import Alignment, Cycle, Timing, timing
from r2p.protocols.rtcan.network import MasterTracker

US, MS, SECOND = 1_000, 1_000_000, 1_000_000_000
FINE, COARSE = timing(), timing(10, 100 * MS)


def receive_sync(cycle: Cycle, start: int, counter: int) -> Alignment:
    frame = rtcan.encode_sync(counter, 1)
    return cycle.on_sync(frame, start + can_bits.frame_bits(frame.id, frame.data) * 1_000)


def believed(ours: Timing, theirs: int, jitter: int, ppm: int = 0) -> bool | None:
    """After 2 s of syncs that are up to `jitter` ns off, every `theirs` ns."""
    numbers = random.Random(f"{theirs} {jitter}")
    cycle = Cycle(ours)
    tracker = MasterTracker(cycle)
    answer = None
    for n in range(2 * SECOND // theirs):
        start = n * (theirs + theirs * ppm // 1_000_000) + numbers.randint(-jitter, jitter)
        if receive_sync(cycle, start, n) is Alignment.STARTED:
            tracker.on_started(start)
        answer = tracker.has_our_length(start)
        assert answer is None or start > SECOND
    return answer


@pytest.mark.parametrize("ppm", [-100, 0, 100])
@pytest.mark.parametrize(
    ("ours", "jitter"), [(FINE, 0), (FINE, 3 * US), (FINE, 60 * US), (COARSE, 0), (COARSE, 4 * MS)]
)
def test_a_cycle_like_ours_is_believed_however_it_jitters(ours: Timing, jitter: int, ppm: int) -> None:
    """A PC that is busy sends its syncs milliseconds late."""
    assert believed(ours, ours.cycle, jitter, ppm) is True


@pytest.mark.parametrize("jitter", [0, 3 * US, 10 * US])
@pytest.mark.parametrize("slots", [50, 59, 61, 40])
def test_a_cycle_of_other_slots_is_not(slots: int, jitter: int) -> None:
    """With the same nominal cycle it differs by a few tenths of a percent."""
    assert timing(slots).cycle != FINE.cycle
    assert believed(FINE, timing(slots).cycle, jitter) is False


def test_one_sync_tells_nothing() -> None:
    cycle = Cycle(FINE)
    tracker = MasterTracker(cycle)
    receive_sync(cycle, 0, 1)
    tracker.on_started(0)
    assert tracker.has_our_length(2 * SECOND) is None


# Two masters


def network(id8: int, cycle: int, epoch: int) -> management.Network:
    return management.Network(id8, 1, epoch, cycle, FINE.slots, FINE.slot)


def following(*, count: int) -> tuple[Cycle, MasterTracker]:
    """A slave of node 10, which is in cycle 7, when 11 says that it is in cycle `count`."""
    cycle = Cycle(FINE)
    tracker = MasterTracker(cycle)
    receive_sync(cycle, 0, 7)
    assert tracker.on_started(0) is None
    assert tracker.on_network(MS, network(10, 7, 100), None, None)
    assert not tracker.on_network(2 * MS, network(11, count, 200), 10, 100)
    return cycle, tracker


def test_syncs_that_go_on_after_a_better_master_has_spoken_are_its_own() -> None:
    cycle, tracker = following(count=7)
    for n in range(1, 5):
        assert receive_sync(cycle, n * FINE.cycle, 7 + n) is Alignment.ALIGNED
        found = tracker.on_aligned(n * FINE.cycle)
        assert found == (network(11, 10, 200) if n == 4 else None)


def test_not_those_of_another_count() -> None:
    cycle, tracker = following(count=70)
    receive_sync(cycle, FINE.cycle, 8)
    assert tracker.on_aligned(5 * FINE.cycle) is None


def test_not_where_the_better_ones_own_syncs_are_heard() -> None:
    cycle, tracker = following(count=7)
    assert receive_sync(cycle, FINE.cycle // 2, 8) is Alignment.FOREIGN
    tracker.on_foreign()
    receive_sync(cycle, FINE.cycle, 8)
    assert tracker.on_aligned(5 * FINE.cycle) is None
