"""Worst-case response times of events on RTCAN, and what networks of real engines on the simulated bus find."""

import random

import msgspec
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from benchmarks.analysis.sets import compare_rtcan
from r2p.analysis import (
    BusMessage,
    EventModel,
    MessageClass,
    Urgency,
    control_rates,
    event_bounds,
    event_breakdown,
    management_load,
    slot_supply,
)
from r2p.protocols.rtcan.calendar import Reservation
from r2p.protocols.rtcan.cycle import timing
from r2p.units import MILLISECOND

TIMING = timing()
FRAME = 157_000  # ns of the longest frame


def event(name: str, deadline: float, period: float = 100, size: int = 8) -> BusMessage:
    """Times in ms."""
    return BusMessage(
        name=name,
        size=size,
        period=round(period * MILLISECOND),
        deadline=round(deadline * MILLISECOND),
        message_class=MessageClass.SRT,
    )


def background(period: int | None = None) -> BusMessage:
    return BusMessage(name="log", size=64, period=period, message_class=MessageClass.NRT)


def bounds(*messages: BusMessage, model: EventModel | None = None) -> list[int | None]:
    """Beside the sync alone."""
    return [each.bound for each in event_bounds(messages, slot_supply(TIMING), model or EventModel())]


def test_a_single_event_waits_for_the_next_free_slot_at_most_beyond_the_sync() -> None:
    assert bounds(event("a", 5)) == [2 * TIMING.slot + FRAME]
    assert bounds(event("a", 5, size=17)) == [4 * TIMING.slot + FRAME]
    assert bounds(event("a", 5), model=EventModel(latency=10_000)) == [2 * TIMING.slot + FRAME + 10_000]


def test_non_real_time_messages_do_not_delay_events_in_the_order_of_laxity_alone() -> None:
    assert bounds(event("a", 5), background()) == [2 * TIMING.slot + FRAME, None]
    assert bounds(event("a", 5), background(), model=EventModel(ordered=False)) == [None, None]
    known = bounds(event("a", 5), background(100 * MILLISECOND), model=EventModel(ordered=False))
    assert known == [10 * TIMING.slot + FRAME] * 2  # 9 frames, and the sync


def test_the_least_laxity_goes_first() -> None:
    events = [event("urgent", 2), *[event(f"e{number}", 40) for number in range(20)]]
    urgent, *others = bounds(*events)
    assert urgent is not None
    assert urgent <= 6 * TIMING.slot  # two at most that have waited so long would have been late
    assert others == [22 * TIMING.slot + FRAME] * 20
    assert bounds(*events, model=EventModel(ordered=False)) == [22 * TIMING.slot + FRAME] * 21


def test_deadlines_from_62_ms_on_are_alike_on_the_bus() -> None:
    far = [event(f"e{number}", 70 + number) for number in range(10)]
    assert bounds(*far) == [11 * TIMING.slot + FRAME] * 10


def test_a_late_confirmation_costs_a_second_slot() -> None:
    events = [event("a", 5), event("b", 5)]
    assert bounds(*events, model=EventModel(frame_slots=2))[0] == 5 * TIMING.slot + FRAME


def test_reserved_slots_make_events_wait() -> None:
    supply = slot_supply(TIMING, [Reservation(1, 6, 1, 3)])  # 3 of 6 slots in a row
    found = event_bounds([event("a", 5)], supply)
    assert [each.bound for each in found] == [5 * TIMING.slot + FRAME]  # the sync is beside them, once a cycle


def test_more_events_than_free_slots_have_no_bound() -> None:
    crowd = [event(f"e{number}", 3, period=1) for number in range(7)]
    assert bounds(*crowd) == [None] * 7
    assert all(each.misses for each in event_bounds(crowd, slot_supply(TIMING)))
    full = slot_supply(TIMING, [Reservation(1, 6, 1, 5), *[Reservation(2 + n, 60, 6 * n) for n in range(1, 10)]])
    assert not full.free
    assert [each.bound for each in event_bounds([event("a", 5)], full)] == [None]


def test_control_messages_are_those_of_the_owners_and_of_the_master() -> None:
    rates = control_rates(["a", "b", "c"], {"b", "c"}, "a")
    assert rates == {"a": 1 + 3, "b": 2, "c": 2}
    assert control_rates(["a"], set()) == {"a": 1, "the master": 1}
    load = management_load(rates, other=0.5)
    assert [each.frames for each in load] == [8] * 3 + [4] * 3
    assert [each.deadline for each in load] == [10 * MILLISECOND] * 3 + [50 * MILLISECOND] * 3
    alone = bounds(*management_load({"a": 4.0}))
    assert alone == [17 * TIMING.slot + FRAME]  # all four messages of a second at once, beside the sync


def test_control_is_as_urgent_as_the_discovery_that_waits_behind_it() -> None:
    """A message of discovery that is nearly due lends its laxity to a control message of its node, which goes first."""
    crowd = [event(f"e{number}", 4, period=50) for number in range(12)]
    alone, *_ = bounds(event("a", 4), *crowd, *management_load({"n": 1.0}))
    beside, *_, discovery = bounds(event("a", 4), *crowd, *management_load({"n": 1.0}, 0.5))
    assert alone is not None
    assert beside is not None
    assert discovery is not None
    assert beside - alone >= 8 * TIMING.slot  # a control message, behind one of discovery that had started
    assert discovery <= 50 * MILLISECOND


def test_discovery_loses_ties_for_its_last_four_milliseconds() -> None:
    """As it is no more urgent then than with four left."""
    before = [event(f"e{number}", 4.9, period=200) for number in range(17)]
    tied = [event(f"t{number}", 9.5, period=200) for number in range(10)]
    own = event("own", 5, period=200)
    eased = msgspec.structs.replace(own, urgency=Urgency.EASED)
    assert bounds(own, *before, *tied)[0] == 19 * TIMING.slot + FRAME  # its own, and the sync
    assert bounds(eased, *before, *tied)[0] == 29 * TIMING.slot + FRAME


def test_the_breakdown_is_by_how_much_more_often_events_may_come() -> None:
    events = [event(f"e{number}", 10, period=10) for number in range(5)]
    found = event_breakdown(events, [], slot_supply(TIMING))
    assert 5 < found.scale < 12
    assert found.utilisation == pytest.approx(found.scale * 5 * TIMING.slot / (10 * MILLISECOND) * 60 / 59, rel=0.02)
    assert event_breakdown([event("a", 0.2)], [], slot_supply(TIMING)).scale == 0


@settings(max_examples=3, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.integers(0, 1 << 32), st.sampled_from([0.3, 0.6]), st.sampled_from([0, 2, 20]))
def test_no_response_of_a_real_network_is_longer_than_its_bound(seed: int, load: float, discovery: int) -> None:
    compared = compare_rtcan(random.Random(seed), load=load, duration=60 * MILLISECOND, discovery=discovery)
    assert compared
    for each in compared:
        assert each.bound is None or each.slowest <= each.bound
