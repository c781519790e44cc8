"""Sporadic and periodic publishers: deadlines, phases, and what is given up, counted and signalled."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest

import r2p
from r2p.msg import Encoder, Led
from tests.bench import MS, SECOND, Recorder, crashes, drain, elapsed, hold, led, local, pair, settle

if TYPE_CHECKING:
    from r2p.runtime.subscriber import Keep

# Sporadic


@pytest.mark.virtual_time
async def test_events_wait_in_order_and_publish_never_does() -> None:
    async with local() as module:
        node, other = pair(module)
        leds = other.subscribe("leds", Led, queue=2)
        publisher = node.advertise("leds", Led, r2p.Sporadic(deadline=1.0))
        for number in range(6):
            await publisher.publish(led(number))
        assert elapsed(module) == 0.0
        assert [(await leds.fetch()).led for _ in range(6)] == list(range(6))
        assert (publisher.missed, publisher.late, leds.lost) == (0, 0, 0)
        assert publisher.publish_nowait(led(6))


@pytest.mark.virtual_time
async def test_a_younger_event_does_not_overtake_one_that_waits() -> None:
    async with local() as module:
        node, other = pair(module)
        leds = other.subscribe("leds", Led, queue=2)
        publisher = node.advertise("leds", Led, r2p.Sporadic(deadline=1.0))
        got = []
        for number in range(12):
            assert publisher.publish_nowait(led(number)) == (number < 2)
            if number > 4:
                got.append((await leds.fetch()).led)
        assert got == list(range(7))


@pytest.mark.virtual_time
async def test_an_event_waits_where_a_publisher_without_a_deadline_has_given_up() -> None:
    async with local() as module:
        node, other = pair(module)
        leds = other.subscribe("leds", Led, queue=2)
        events = node.advertise("leds", Led, r2p.Sporadic(deadline=5.0))
        others = node.advertise("leds", Led, r2p.NonRealTime(stall=0.1))
        for number in (100, 101):
            await others.publish(led(number))
        await events.publish(led(1))
        await others.publish(led(102))  # gives up, in vain
        await events.publish(led(2))
        assert [(await leds.fetch(0.05)).led for _ in range(4)] == [101, 102, 1, 2]
        assert (leds.lost, events.missed, others.missed) == (1, 0, 1)


@pytest.mark.virtual_time
async def test_an_event_that_is_not_everywhere_by_its_deadline_is_given_up() -> None:
    missed, late = Recorder(), Recorder()
    async with local() as module:
        node, other = pair(module)
        full, free = other.subscribe("leds", Led, queue=1), other.subscribe("leds", Led)
        publisher = node.advertise("leds", Led, r2p.Sporadic(deadline=0.5, on_missed=missed, on_late=late))
        await publisher.publish(led(1))
        await publisher.publish(led(2))
        await settle(0.499)
        assert not missed.calls
        await settle(0.002)
        assert missed.calls == [r2p.Missed("leds", "no room by the deadline", where="sub")]
        assert (publisher.missed, publisher.late, full.lost, free.lost) == (1, 0, 1, 0)
        assert (drain(full), drain(free), late.calls) == ([1], [1, 2], [])
        await publisher.publish(led(3))
        assert drain(full) == [3]


@pytest.mark.virtual_time
async def test_a_late_event_can_still_be_sent() -> None:
    missed, late = Recorder(), Recorder()
    async with local() as module:
        node, other = pair(module)
        full = other.subscribe("leds", Led, queue=1)
        klass = r2p.Sporadic(deadline=0.5, late="send", on_missed=missed, on_late=late)
        publisher = node.advertise("leds", Led, klass)
        await publisher.publish(led(1))
        await publisher.publish(led(2))
        await settle(2.0)
        assert late.calls == [r2p.Missed("leds", "no room by the deadline", where="sub")]
        assert (publisher.missed, publisher.late) == (0, 1)
        assert [(await full.fetch()).led for _ in range(2)] == [1, 2]
        assert (missed.calls, full.lost) == ([], 0)


@pytest.mark.virtual_time
async def test_no_more_than_pending_events_wait() -> None:
    missed = Recorder()
    async with local() as module:
        node, other = pair(module)
        leds = other.subscribe("leds", Led, queue=1)
        publisher = node.advertise("leds", Led, r2p.Sporadic(deadline=1.0, pending=2, on_missed=missed))
        for number in range(5):
            await publisher.publish(led(number))
        assert missed.reasons == ["too many wait"] * 2  # the oldest ones
        assert [(await leds.fetch()).led for _ in range(3)] == [0, 3, 4]
        assert (publisher.missed, leds.lost) == (2, 2)


@pytest.mark.virtual_time
async def test_an_event_does_not_push_out_what_its_own_node_has_not_read() -> None:
    missed = Recorder()
    async with local() as module:
        node, _ = pair(module)
        own = node.subscribe("leds", Led, queue=1, keep="oldest")
        publisher = node.advertise("leds", Led, r2p.Sporadic(deadline=0.1, on_missed=missed))
        await publisher.publish(led(1))
        await publisher.publish(led(2))
        await settle(0.2)
        assert (drain(own), own.lost, len(missed.calls)) == ([1], 1, 1)


@pytest.mark.virtual_time
async def test_closing_gives_up_what_waits() -> None:
    missed = Recorder()
    async with local() as module:
        node, other = pair(module)
        leds = other.subscribe("leds", Led, queue=1)
        publisher = node.advertise("leds", Led, r2p.Sporadic(deadline=1.0, on_missed=missed))
        for number in range(3):
            await publisher.publish(led(number))
        publisher.close()
        assert missed.reasons == ["publisher closed"] * 2
        assert (await leds.fetch()).led == 0
        assert not leds.queue


@pytest.mark.virtual_time
async def test_a_signal_may_close_the_publisher() -> None:
    async with local() as module:
        node, other = pair(module)
        other.subscribe("leds", Led, queue=1)
        missed = Recorder(then=lambda: publisher.close())
        publisher = node.advertise("leds", Led, r2p.Sporadic(deadline=0.5, on_missed=missed))
        for number in range(4):
            await publisher.publish(led(number))
        await settle(1.0)
        assert missed.reasons == ["no room by the deadline", "publisher closed", "publisher closed"]


@pytest.mark.virtual_time
async def test_a_subscriber_that_leaves_takes_its_pending_events_along() -> None:
    missed = Recorder()
    async with local() as module:
        node, other = pair(module)
        leds, rest = other.subscribe("leds", Led, queue=1), other.subscribe("leds", Led, queue=1)
        publisher = node.advertise("leds", Led, r2p.Sporadic(deadline=0.5, on_missed=missed))
        for number in range(2):
            await publisher.publish(led(number))
        leds.close()
        assert (await rest.fetch()).led == 0
        await settle(1.0)
        assert (drain(rest), missed.calls) == ([1], [])


# Periodic


@pytest.mark.virtual_time
async def test_a_periodic_publisher_asks_on_absolute_phase() -> None:
    stamps = []
    async with local() as module:
        node, other = pair(module)
        leds = other.subscribe("leds", Led, queue=1000)
        count = iter(range(1000))
        publisher = node.advertise("leds", Led, r2p.Periodic(0.010, lambda: led(next(count))))
        await settle(1.005)
        async for sample in leds.samples():
            stamps.append(sample.stamp)
            if not leds.queue:
                break
        start = stamps[0] - 10 * MS
        assert stamps == [start + 10 * MS * (number + 1) for number in range(100)]
        assert (publisher.sent, publisher.late, publisher.skipped) == (100, 0, 0)
        assert not hasattr(publisher, "publish")


@pytest.mark.virtual_time
async def test_none_skips_a_period() -> None:
    values = iter([led(1), None, led(3)])
    async with local() as module:
        node, other = pair(module)
        leds = other.subscribe("leds", Led)
        publisher = node.advertise("leds", Led, r2p.Periodic(0.1, lambda: next(values)))
        await settle(0.35)
        assert (drain(leds), publisher.sent, publisher.missed) == ([1, 3], 2, 0)


@pytest.mark.virtual_time
@pytest.mark.parametrize(("keep", "left"), [("newest", [2, 3]), ("oldest", [0, 1])])
async def test_no_room_drops_the_sample(keep: Keep, left: list[int]) -> None:
    async with local() as module:
        node, other = pair(module)
        for owner in (other, node):  # of its own node, too
            missed, values = Recorder(), iter([led(number) for number in range(100)])
            leds = owner.subscribe("leds", Led, queue=2, keep=keep)
            publisher = node.advertise("leds", Led, r2p.Periodic(0.1, values.__next__, on_missed=missed))
            await settle(0.45)
            assert (drain(leds), leds.lost, publisher.missed) == (left, 2, 2)
            assert [(each.reason, each.where) for each in missed.calls] == [("no room", owner.name)] * 2
            publisher.close()
            leds.close()


class Blocked:
    """Stands in for a clock: time that passes while the loop is blocked."""

    def __init__(self, module: r2p.Module) -> None:
        self.clock = module.space.clock

    def by(self, seconds: float) -> None:
        self.clock.elapsed += round(seconds * SECOND)  # type: ignore[attr-defined]  # the virtual clock's


@pytest.mark.virtual_time
async def test_late_and_skipped_periods_are_counted_and_the_phase_stays() -> None:
    late = Recorder()
    due = []
    async with local() as module:
        node, _ = pair(module)
        blocked = Blocked(module)

        def fill() -> None:
            due.append(module.space.clock.monotonic() // MS)

        publisher = node.advertise("leds", Led, r2p.Periodic(0.1, fill, on_late=late))
        await settle(0.25)
        blocked.by(0.31)  # now 0.56: the ticks of 0.3, 0.4 are lost, the one of 0.5 is late
        await settle(0.2)
        assert due == [100, 200, 560, 600, 700]
        assert (publisher.late, publisher.skipped, publisher.missed) == (1, 2, 0)
        assert late.calls == [r2p.Missed("leds", "2 period(s) skipped, the next one late", late=0.06, count=2)]


@pytest.mark.virtual_time
@pytest.mark.parametrize("bad", [lambda: 1 / 0, lambda: Encoder(), lambda: Led(led=-1)])
async def test_a_fill_that_fails_crashes_its_node_alone(bad: r2p.Periodic[Led]) -> None:
    ended = []

    async def broken(node: r2p.Node) -> None:
        node.advertise("leds", Led, r2p.Periodic(0.1, bad))  # type: ignore[arg-type]
        try:
            await asyncio.Event().wait()
        finally:
            ended.append(node.now())

    async def main() -> None:
        async with local() as module:
            other = module.start(hold)
            module.start(broken)
            await settle(1.0)
            assert not other.closed
            assert not module.nodes["broken"].running

    (error,) = await crashes(main)
    assert isinstance(error, ZeroDivisionError | r2p.MessageError)
    assert error.__notes__ == ["in node broken of module PC1"]
    assert len(ended) == 1


@pytest.mark.virtual_time
async def test_a_periodic_publisher_ends_with_its_node() -> None:
    calls = []

    async def short(node: r2p.Node) -> None:
        node.advertise("leds", Led, r2p.Periodic(0.1, lambda: calls.append(1)))
        await asyncio.sleep(0.35)

    async with local() as module:
        module.start(short)
        await settle(2.0)
        assert len(calls) == 3


@pytest.mark.virtual_time
async def test_a_driver_is_the_clock_until_it_lets_go() -> None:
    slots, other_slots = object(), object()
    async with local() as module:
        node, other = pair(module)
        leds = other.subscribe("leds", Led)
        values = iter([led(1), led(2), None, led(4)])
        publisher = node.advertise("leds", Led, r2p.Periodic(0.1, values.__next__, lead=0.002))
        assert publisher.lead == 0.002
        await settle(0.15)
        assert publisher.use_slot_clock(slots, 0.05)
        assert publisher.use_slot_clock(slots, 0.08)  # another period
        assert not publisher.use_slot_clock(other_slots, 0.1)
        await settle(1.0)
        assert (publisher.period, drain(leds)) == (0.08, [1])
        sample = publisher.tick(module.space.clock.monotonic(), 0, 0)
        assert sample is not None
        assert (Led.decode(sample.data), sample.sequence, drain(leds)) == (led(2), 2, [2])
        assert publisher.tick(module.space.clock.monotonic(), 0, 0) is None
        publisher.use_own_clock(other_slots)
        assert publisher.period == 0.08
        publisher.use_own_clock(slots)
        await settle(0.15)
        assert (publisher.period, drain(leds)) == (0.1, [4])
        assert publisher.use_slot_clock(other_slots, 0.1)
        publisher.close()
        assert not publisher.use_slot_clock(slots, 0.1)
        assert publisher.tick(0, 0, 0) is None


@pytest.mark.virtual_time
async def test_reports_of_a_link_are_counted_and_signalled() -> None:
    missed, late = Recorder(), Recorder()
    async with local() as module:
        node, _ = pair(module)
        publisher = node.advertise("leds", Led, r2p.Sporadic(1.0, on_missed=missed, on_late=late))
        publisher.link_missed("can", "no slot", 0.5)
        publisher.link_late("can", "sent late", 0.25)
        assert missed.calls == [r2p.Missed("leds", "no slot", where="can", late=0.5)]
        assert late.calls == [r2p.Missed("leds", "sent late", where="can", late=0.25)]
        assert (publisher.missed, publisher.late) == (1, 1)
