"""The simulated CAN bus: frames that may start only between two instants."""

from __future__ import annotations

import asyncio

import pytest

from r2p.sim.can import Latency
from tests.can_watch import BIT, GAP, HIGH, LOW, MIDDLE, at, gives_up, length, make


@pytest.mark.virtual_time
async def test_a_frame_waits_for_its_instant() -> None:
    _, watch, (a, b) = make("A", "B")
    a.request(LOW, not_before=50_000)
    b.request(HIGH)
    await asyncio.sleep(0.001)
    free = length(HIGH) + GAP
    assert [record.start for record in watch.records] == [0, max(50_000, free)]
    a.request(LOW, not_before=3_000_000)
    await asyncio.sleep(0.01)
    assert watch.records[-1].start == 3_000_000


@pytest.mark.virtual_time
async def test_the_instant_is_as_exact_as_the_latency() -> None:
    _, watch, (a, _) = make("A", "B", transmit=Latency(5_000, 3_000), drift_ppm=100.0)
    for number in range(1, 301):
        a.request(LOW, not_before=number * 1_000_000)
        await at(number * 1_000_000 + 500_000)
    await asyncio.sleep(0.001)
    off = [a.clock.local(record.start) - n * 1_000_000 for n, record in enumerate(watch.records, start=1)]
    assert (min(off) // 100, max(off) // 100) == (-30, 29)


@pytest.mark.virtual_time
@pytest.mark.parametrize("one_shot", [True, False])
@pytest.mark.parametrize("early", [0, 1, BIT])
async def test_a_frame_that_can_not_start_in_time_is_aborted_at_its_last_instant(early: int, one_shot: bool) -> None:
    _, watch, (a, b) = make("A", "B", one_shot=one_shot, receive=Latency(2_000))
    free = length(LOW) + GAP
    a.request(LOW)
    await at(BIT)
    b.request(HIGH, not_after=free - early)
    await asyncio.sleep(0.001)
    if early:
        assert watch.of("late") == [("B", HIGH, free - early + 2_000)]
        assert [record.frame for record in watch.records] == [LOW]
        assert b.pending() is None
    else:
        assert [record.start for record in watch.records] == [0, free]


@pytest.mark.virtual_time
async def test_an_aborted_frame_leaves_the_bus_to_others() -> None:
    _, watch, (a, b) = make("A", "B")
    a.request(LOW)
    await at(length(LOW))
    b.request(MIDDLE, 0, not_after=length(LOW) + GAP - 1)
    b.request(HIGH, 1, not_after=length(LOW) + GAP)
    await asyncio.sleep(0.001)
    assert watch.of("late") == [("B", MIDDLE, length(LOW) + GAP - 1)]
    assert [record.frame for record in watch.records] == [LOW, HIGH]


@pytest.mark.virtual_time
async def test_what_is_heard_does_not_wait_for_a_last_instant() -> None:
    _, watch, (a, b) = make("A", "B", receive=Latency(2_000))
    a.request(LOW)
    await at(BIT)
    b.request(HIGH, not_before=1_000_000, not_after=2_000_000)
    await asyncio.sleep(0.01)
    assert watch.of("received")[0] == ("B", LOW, length(LOW) + 2_000)
    assert watch.of("sent")[1] == ("B", HIGH, 1_000_000 + length(HIGH) + 2_000)


@pytest.mark.virtual_time
async def test_an_instant_that_is_over() -> None:
    _, watch, (a, _) = make("A", "B")
    await at(1_000_000)
    a.request(LOW, not_after=999_999)
    assert not watch.heard
    await asyncio.sleep(0.001)
    assert watch.heard == [("late", "A", LOW, 1_000_000)]


@pytest.mark.virtual_time
@pytest.mark.parametrize(("one_shot", "told"), [(True, "lost"), (False, "late")])
async def test_who_has_lost_is_not_late_as_well(told: str, one_shot: bool) -> None:
    _, watch, (a, b) = make("A", "B", one_shot=one_shot)
    a.request(LOW)
    b.request(HIGH, not_after=BIT)
    await asyncio.sleep(0.001)
    assert [entry for entry in watch.heard if entry[0] in {"lost", "late"}] == [(told, "B", HIGH, gives_up(HIGH, LOW))]
    assert [record.frame for record in watch.records] == [LOW]


@pytest.mark.virtual_time
async def test_a_frame_that_was_destroyed_is_not_tried_after_its_last_instant() -> None:
    bus, watch, (a, _) = make("A", "B")
    bus.disturb_next(50)
    a.request(LOW, not_after=10)
    await asyncio.sleep(0.001)
    assert [record.error is None for record in watch.records] == [False]
    assert watch.of("late") == [("A", LOW, watch.records[0].end)]


@pytest.mark.virtual_time
async def test_the_last_instant_goes_by_the_clock_of_the_node() -> None:
    _, watch, (a, b) = make("A", "B", offset=1_000_000_000, drift_ppm=-80.0)
    await at(100_000_000)
    a.request(LOW)
    await at(100_000_000 + BIT)
    last = b.clock.monotonic() + 20_000
    b.request(HIGH, not_after=last)
    await asyncio.sleep(0.001)
    assert watch.of("late") == [("B", HIGH, last)]
