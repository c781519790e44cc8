"""Publishers and the links behind their topics: guarantees, send buffers, outages, latched values."""

from __future__ import annotations

import asyncio
import logging
from typing import Any, Literal

import pytest

import r2p
from r2p.msg import Led
from r2p.transports import memory
from r2p.transports.memory import IN_FLIGHT, MemoryLink, network
from tests.bench import Recorder, crashes, drain, elapsed, hold, joined, led, local, pair, settle

STALL = 1.0


@pytest.mark.virtual_time
async def test_guarantees_tell_what_the_class_means_on_each_link() -> None:
    async with r2p.Module("A", via="memory:lab") as module:
        node, _ = pair(module)
        assert node.advertise("a", Led).guarantees == {
            "": "waits for room in every queue",
            "memory:lab": module.links[0].guarantee("leds", r2p.PublisherClass.NON_REAL_TIME),
        }
        assert "best effort" in node.advertise("b", Led, r2p.Sporadic(1.0)).guarantees["memory:lab"]
        assert "absolute phase" in node.advertise("c", Led, r2p.Periodic(1.0, Led)).guarantees[""]


@pytest.mark.virtual_time
async def test_strict_checks_what_is_known_at_once() -> None:
    async with r2p.Module("A", via="memory:lab") as module, local("B") as alone:
        node, _ = pair(module)
        node.advertise("a", Led, strict=True)
        with pytest.raises(r2p.TransportError, match="topic b on link memory:lab: best effort"):
            node.advertise("b", Led, r2p.Sporadic(1.0), strict=True)
        assert "b" not in module.space.topics
        alone.start(hold).advertise("b", Led, r2p.Sporadic(1.0), strict=True)


@pytest.mark.virtual_time
async def test_ready_waits_for_admission() -> None:
    async with r2p.Module("A", via="memory:lab") as module:
        node, _ = pair(module)
        publisher = node.advertise("a", Led)
        await publisher.ready(1.0)

        async def never(topic: str) -> None:
            await asyncio.Event().wait()

        module.links[0].admission = never  # type: ignore[method-assign]
        with pytest.raises(TimeoutError, match=r"topic 'a' was not admitted by link \S+ within 1.0 s: .+"):
            await publisher.ready(1.0)


@pytest.mark.virtual_time
async def test_losing_a_link_is_signalled_as_degraded(caplog: pytest.LogCaptureFixture) -> None:
    degraded = Recorder()
    async with r2p.Module("A", via="memory:lab") as a, r2p.Module("B", via="memory:lab") as b:
        publisher = a.start(hold).advertise("leds", Led, r2p.NonRealTime(on_degraded=degraded))
        b.start(hold).subscribe("leds", Led)
        await publisher.wait_subscriber()
        a.links[0].on_down("cable cut")
        assert degraded.calls == [r2p.Missed("leds", "cable cut", where="memory:lab", count=0)]
        await publisher.publish(led(1))
        assert a.links[0].stats.sent == 0
    told = [record for record in caplog.records if "cable cut" in record.getMessage()]
    assert {record.levelno for record in told} == {logging.WARNING}


@pytest.mark.virtual_time
async def test_a_signal_that_raises_while_a_link_goes_down_crashes_its_node_and_not_the_link() -> None:
    def broken(missed: r2p.Missed) -> None:
        raise ValueError(missed.reason)

    async def main() -> None:
        async with joined("A") as a, joined("B") as b:

            async def cuts(node: r2p.Node) -> None:
                await node.advertise("leds", Led, r2p.NonRealTime(on_degraded=broken)).wait_subscriber()
                a.links[0].on_down("cut")
                assert not a.links[0].discovery.modules
                await asyncio.Event().wait()

            b.start(hold).subscribe("leds", Led)
            a.start(cuts)
            await a.wait()

    (error,) = await crashes(main)
    assert repr(error) == "ValueError('cut')"


@pytest.mark.virtual_time
async def test_publish_waits_for_a_links_send_buffer_too() -> None:
    async with joined("A") as a, joined("B") as b:
        publisher = a.start(hold).advertise("leds", Led, r2p.NonRealTime(stall=STALL))
        leds = b.start(hold).subscribe("leds", Led, queue=2 * IN_FLIGHT)
        await publisher.wait_subscriber()
        await settle(1.0)
        network("lab").delay = 0.25 * STALL  # the network holds what is on its way
        began = elapsed(a)
        for number in range(IN_FLIGHT + 1):
            await publisher.publish(led(number))
        assert elapsed(a) - began == pytest.approx(0.25 * STALL, abs=1e-3)
        assert (publisher.missed, a.links[0].stats.lost.total()) == (0, 0)
        await settle(1.0)
        assert drain(leds) == list(range(IN_FLIGHT + 1))


@pytest.mark.virtual_time
async def test_a_link_that_makes_no_room_in_time_is_lossy_until_it_has(monkeypatch: pytest.MonkeyPatch) -> None:
    missed = Recorder()
    full = False
    async with joined("A") as a, joined("B") as b:
        publisher = a.start(hold).advertise("leds", Led, r2p.NonRealTime(stall=STALL, on_missed=missed))
        leds = b.start(hold).subscribe("leds", Led)
        await publisher.wait_subscriber()
        monkeypatch.setattr(MemoryLink, "full", property(lambda _link: full))
        full = True
        began = elapsed(a)
        for number in range(10):
            await publisher.publish(led(number))
        assert elapsed(a) - began == pytest.approx(STALL, abs=1e-3)
        reasons = ["no room for 1.0 s", *["no room"] * 9]
        assert missed.calls == [r2p.Missed("leds", reason, where="memory:lab") for reason in reasons]
        assert publisher.missed == 10
        link: Any = a.links[0]
        assert link.stats.lost["send buffer full"] == 10
        assert len(link.wait_queue.recoveries) == 1  # it recovers by itself, and nothing else waits
        assert not link.wait_queue.non_real_time
        full = False
        link.made_room()
        await publisher.publish(led(20))
        full = True
        publishing = asyncio.create_task(publisher.publish(led(21)))
        await settle(0.5 * STALL)
        assert not publishing.done()  # it is waited for again
        full = False
        link.made_room()
        await publishing
        await settle()
        assert drain(leds) == [20, 21]


@pytest.mark.virtual_time
async def test_what_a_link_does_not_get_any_more_is_counted_by_both() -> None:
    async with joined("A") as module, joined("B") as peer:
        node, other = pair(module)[0], pair(peer)[1]
        other.subscribe("leds", Led, queue=2 * IN_FLIGHT)
        publisher = node.advertise("leds", Led, r2p.NonRealTime(stall=5.0))
        events = node.advertise("leds", Led, r2p.Sporadic(deadline=0.5))
        await publisher.wait_subscriber()
        network("lab").delay = 3.0
        while not network("lab").full:
            publisher.publish_nowait(led(0))
        await asyncio.sleep(0)  # the network takes one more
        for number in range(3):
            with pytest.raises(TimeoutError):
                await asyncio.wait_for(publisher.publish(led(number)), 0.01)
        await events.publish(led(0))
        await asyncio.sleep(1.0)
        assert (publisher.missed, events.missed) == (3, 1)
        assert module.links[0].losses == {"publish cancelled": 3, "given up by its publisher": 1}


@pytest.mark.virtual_time
async def test_events_that_wait_when_a_link_breaks_are_lost_and_counted() -> None:
    async with joined("A") as a, joined("B") as b:
        node, other = a.start(hold), b.start(hold)
        events, bulk = other.subscribe("event", Led), other.subscribe("bulk", Led, queue=2 * IN_FLIGHT)
        event, filler = node.advertise("event", Led, r2p.Sporadic(deadline=60.0)), node.advertise("bulk", Led)
        await asyncio.gather(event.wait_subscriber(), filler.wait_subscriber())
        await settle(1.0)
        network("lab").delay = 0.5
        while not network("lab").full:
            await filler.publish(led(0))
        for number in range(4):
            assert not event.publish_nowait(led(number))
        link: Any = a.links[0]
        before = link.stats.lost["link down"]
        link.disconnect("cut")
        assert link.stats.lost["link down"] >= before + 4
        await settle(10.0)
        link.connect()
        await settle(10.0)
        assert not events.queue
        assert len(bulk.queue) <= IN_FLIGHT
        await event.publish(led(9))
        assert (await events.fetch(2.0)).led == 9


@pytest.mark.virtual_time
async def test_periodic_samples_of_an_outage_do_not_arrive_later() -> None:
    async with joined("A") as a, joined("B") as b:
        values = iter([led(number) for number in range(10_000)])
        publisher = a.start(hold).advertise("leds", Led, r2p.Periodic(0.1, values.__next__))
        leds = b.start(hold).subscribe("leds", Led, queue=1000)
        await leds.wait_publisher()
        await settle(1.05)  # between two periods
        link: Any = a.links[0]
        link.disconnect("cut")
        leds.queue.clear()
        await settle(5.0)
        missing = publisher.sent
        link.connect()
        await settle(5.0)
        got = drain(leds)
        assert missing <= got[0] <= missing + 20
        assert got == list(range(got[0], publisher.sent))


@pytest.mark.virtual_time
async def test_a_slow_subscriber_does_not_stop_a_link_for_others() -> None:
    async with joined("A") as a, joined("B") as b:
        node, other = a.start(hold), b.start(hold)
        slow, fast = other.subscribe("slow", Led, queue=1), other.subscribe("fast", Led, queue=1000)
        stuck, quick = node.advertise("slow", Led), node.advertise("fast", Led)
        await asyncio.gather(stuck.wait_subscriber(), quick.wait_subscriber())
        began = elapsed(a)
        for number in range(500):
            await stuck.publish(led(number))
            await quick.publish(led(number))
        await settle(0.01)
        assert elapsed(a) - began < 0.1
        assert drain(fast) == list(range(500))
        assert (len(slow.queue), slow.lost, fast.lost) == (1, 499, 0)


@pytest.mark.virtual_time
async def test_latched_values_go_to_modules_that_come_back() -> None:
    async with joined("A") as a:
        publisher = a.start(hold).advertise("map", Led, latch=True)
        await publisher.publish(led(7))
        for _ in range(3):
            async with joined("B") as b:  # a new process each time
                assert (await b.start(hold).subscribe("map", Led).fetch(5.0)).led == 7
                b.links[0].on_down("cut")
                b.links[0].on_up()
                await settle(1.0)


@pytest.mark.virtual_time
async def test_latched_values_wait_for_room_on_the_link(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "IN_FLIGHT", 8)

    async def babble(node: r2p.Node) -> None:
        publisher = node.advertise("noise", Led)
        await publisher.wait_subscriber()
        while True:
            await publisher.publish(led(0))

    async with joined("A") as a, joined("B") as b:
        network("lab").delay = 0.01
        node, other = a.start(hold), b.start(hold)
        for number in range(20):
            await node.advertise(f"map{number}", Led, latch=True).publish(led(number))
        a.start(babble, name="first")
        a.start(babble, name="second")
        other.subscribe("noise", Led, lossy=True)
        await settle(2.0)
        maps = [other.subscribe(f"map{number}", Led) for number in range(20)]
        await settle(3.0)
        assert [drain(each) for each in maps] == [[number] for number in range(20)]


@pytest.mark.virtual_time
async def test_any_type_is_fine_for_a_subscriber_of_bytes_across_a_link() -> None:
    async with joined("A") as a, joined("B") as b:
        raw = b.start(hold).subscribe("leds", None)
        publisher = a.start(hold).advertise("leds", Led)
        await publisher.wait_subscriber()
        await publisher.publish(led(1))
        assert await raw.fetch(1.0) == led(1).encode()
        typed = b.start(hold, name="typed").subscribe("leds", Led)
        await publisher.publish(led(2))
        assert await typed.fetch(1.0) == led(2)


@pytest.mark.virtual_time
async def test_what_subscribers_miss_while_their_link_is_down_is_counted() -> None:
    async with joined("A") as a, joined("B") as b:
        link = a.links[0]
        assert isinstance(link, MemoryLink)
        publisher = a.start(hold).advertise("leds", Led)
        subscriber = b.start(hold).subscribe("leds", Led)
        await publisher.wait_subscriber()
        link.disconnect()
        for value in range(3):
            await publisher.publish(led(value))
        assert publisher.subscribers == 0
        events = a.events()
        link.connect()
        assert await anext(events) == r2p.LinkUp("memory:lab", 0.0, 3)
        await publisher.wait_subscriber()
        await publisher.publish(led(9))
        assert await subscriber.fetch() == led(9)
        link.disconnect()
        publisher.close()
        link.connect()
        await settle(1.0)
        assert "leds" not in a.space.topics


@pytest.mark.virtual_time
async def test_the_driver_of_a_periodic_publisher_sends_the_sample_itself() -> None:
    async with joined("A") as a, joined("B") as b:
        publisher = a.start(hold).advertise("leds", Led, r2p.Periodic(0.1, Led))
        leds = b.start(hold).subscribe("leds", Led)
        await publisher.wait_subscriber()
        link = a.links[0]
        assert publisher.use_slot_clock(link, 0.1)
        sent = link.stats.sent
        assert publisher.tick(0, 0, 0) is not None
        await settle(1.0)
        assert (link.stats.sent, drain(leds)) == (sent, [])
        publisher.use_own_clock(link)
        await settle(0.15)
        assert len(drain(leds)) == 1


@pytest.mark.virtual_time
@pytest.mark.parametrize("late", ["drop", "send"])
async def test_a_link_is_offered_a_sample_with_what_late_means(
    late: Literal["drop", "send"], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[r2p.Sample] = []
    monkeypatch.setattr(MemoryLink, "has_room_for", lambda _link, sample: asked.append(sample))
    async with joined("A") as a, joined("B") as b:
        publisher = a.start(hold).advertise("leds", Led, r2p.Sporadic(0.5, late=late))
        b.start(hold).subscribe("leds", Led)
        await publisher.wait_subscriber()
        assert not publisher.publish_nowait(led(1))
        assert [sample.drop_late for sample in asked] == [late == "drop"]


@pytest.mark.virtual_time
async def test_a_link_that_became_lossy_does_not_disturb_those_that_wait() -> None:
    """A reader that is too slow for both: what comes over the link is lossy, the module's own publisher waits."""
    got = []

    async def reader(node: r2p.Node) -> None:
        async for message in node.subscribe("leds", Led, queue=4):
            await asyncio.sleep(0.1)
            got.append(message)

    async def publish(node: r2p.Node, value: int) -> None:
        publisher = node.advertise("leds", Led)
        await publisher.wait_subscriber()
        while True:
            await publisher.publish(Led(value=value))
            await asyncio.sleep(0.02)

    async with joined("A") as a, joined("B") as b:
        a.start(reader)
        a.start(publish, 1, name="near")
        b.start(publish, 2, name="far")
        await settle(20.0)
        (near,) = a.space.topics["leds"].publishers
        assert isinstance(near, r2p.Publisher)
        assert near.missed == 0
        (leds,) = a.space.topics["leds"].queues
        assert leds.blocks_publishers
        assert leds.lost > 100
        assert {each.value for each in got} == {1, 2}


@pytest.mark.virtual_time
async def test_a_link_keeps_nothing_of_a_reader_that_left() -> None:
    async with joined("A") as a, joined("B") as b:
        publisher = a.start(hold).advertise("leds", Led)
        other = b.start(hold)
        slow, quick = other.subscribe("leds", Led, queue=1), other.subscribe("leds", Led)
        await publisher.wait_subscriber()
        for number in range(5):
            await publisher.publish(led(number))
            await settle(0.1)
        assert slow.lost == 4
        link: Any = b.links[0]
        assert link._backpressure._lossy == {slow._sink}
        slow.close()
        assert not link._backpressure._lossy
        await publisher.publish(led(5))
        await settle()
        assert drain(quick) == list(range(6))
