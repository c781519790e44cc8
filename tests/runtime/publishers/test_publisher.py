"""Publishers: what all classes share, and how non real-time ones wait, at most so long."""

from __future__ import annotations

import array
import asyncio
import functools
import math
import threading
from typing import TYPE_CHECKING, Annotated, Any

import pytest

import r2p
from r2p.msg import Encoder, Led
from tests.bench import MS, Recorder, Turns, crashes, drain, elapsed, hold, led, local, numbers, pair, settle

if TYPE_CHECKING:
    from collections.abc import Callable

    from r2p.runtime.subscriber import Keep

STALL = 1.0


# What all classes share


@pytest.mark.virtual_time
async def test_publishing_packs_so_a_bad_value_raises_at_once() -> None:
    async with local() as module:
        node, _ = pair(module)
        publisher = node.advertise("leds", Led)
        for publish in (publisher.publish_nowait, node.advertise("x", Led, r2p.Sporadic(1.0)).publish_nowait):
            with pytest.raises(r2p.MessageError, match="led"):
                publish(Led(led=-1))
        with pytest.raises(r2p.MessageError, match="value"):
            await publisher.publish(Led(value=256))
        assert publisher.sent == 0


@pytest.mark.virtual_time
async def test_a_message_of_another_class_is_refused() -> None:
    async with local() as module:
        node, _ = pair(module)
        publisher = node.advertise("leds", Led)
        with pytest.raises(r2p.MessageError, match="topic leds takes Led, not Encoder"):
            await publisher.publish(Encoder())  # type: ignore[arg-type]
        with pytest.raises(r2p.MessageError, match="topic leds takes Led, not dict"):
            publisher.publish_nowait({"led": 1})  # type: ignore[arg-type]


@pytest.mark.virtual_time
async def test_samples_are_numbered_and_say_where_they_come_from() -> None:
    async with local() as module:
        node, other = pair(module)
        leds = other.subscribe("leds", Led)
        await settle(0.5)
        await node.advertise("leds", Led, r2p.Sporadic(deadline=0.25)).publish(led(1))
        await node.advertise("leds", Led).publish(led(2))
        samples = leds.samples()
        event, state = await anext(samples), await anext(samples)
        assert event.source == state.source == r2p.Source("PC1", "pub")
        assert (event.sequence, event.stamp, event.stamped) == (1, node.now(), True)
        assert (event.deadline, state.deadline) == (event.stamp + 250 * MS, 0)
        assert event.publisher_class is r2p.PublisherClass.SPORADIC
        assert (state.publisher_class, state.data) == (r2p.PublisherClass.NON_REAL_TIME, led(2).encode())


@pytest.mark.virtual_time
async def test_publishers_know_when_there_is_a_subscriber() -> None:
    async with local() as module:
        node, other = pair(module)
        publisher = node.advertise("leds", Led)
        waiting = asyncio.create_task(publisher.wait_subscriber())
        await settle()
        assert (publisher.subscribers, waiting.done()) == (0, False)
        subscription = other.subscribe("leds", Led)
        await waiting
        assert publisher.subscribers == 1
        subscription.close()
        assert publisher.subscribers == 0


@pytest.mark.virtual_time
async def test_a_closed_publisher_says_so() -> None:
    async with local() as module:
        node, _ = pair(module)
        publisher = node.advertise("leds", Led)
        waiting = asyncio.create_task(publisher.wait_subscriber())
        await settle()
        publisher.close()
        publisher.close()
        with pytest.raises(r2p.Closed, match="publisher of leds is closed"):
            await waiting
        with pytest.raises(r2p.Closed, match="advertise it again"):
            await publisher.publish(led(1))
        with pytest.raises(r2p.Closed):
            publisher.publish_nowait(led(1))
        with pytest.raises(r2p.Closed):
            await publisher.wait_subscriber()


@pytest.mark.virtual_time
async def test_misses_are_logged_once_a_second_and_signalled_each_time(caplog: pytest.LogCaptureFixture) -> None:
    missed = Recorder()
    async with local() as module:
        node, other = pair(module)
        other.subscribe("leds", Led, queue=1)
        publisher = node.advertise("leds", Led, r2p.NonRealTime(on_missed=missed))
        for number in range(31):
            publisher.publish_nowait(led(number))
            await settle(0.1)
        assert (len(missed.calls), publisher.missed) == (30, 30)
    lines = [record.getMessage() for record in caplog.records if record.name == "r2p.PC1.pub"]
    assert len(lines) == 3
    assert lines[0] == "topic leds (sub): no room (missed 1, late 0 so far)"
    assert lines[1] == "topic leds (sub): no room (missed 11, late 0 so far) (9 more since the last such line)"


@pytest.mark.virtual_time
@pytest.mark.parametrize("latch", [False, True])
async def test_latch_gives_the_last_value_to_whoever_joins_later(latch: bool) -> None:
    async with local() as module:
        node, other = pair(module)
        classes: list[r2p.NonRealTime | r2p.Sporadic] = [r2p.NonRealTime(), r2p.Sporadic(1.0)]
        for topic, klass in enumerate(classes):
            publisher = node.advertise(f"t{topic}", Led, klass, latch=latch)
            early = other.subscribe(f"t{topic}", Led)
            await publisher.publish(led(1))
            await publisher.publish(led(2))
            late = other.subscribe(f"t{topic}", Led)
            assert drain(early) == [1, 2]
            assert drain(late) == ([2] if latch else [])
            publisher.close()
            assert drain(other.subscribe(f"t{topic}", Led)) == []


@pytest.mark.virtual_time
async def test_latch_works_for_periodic_publishers() -> None:
    async with local() as module:
        node, other = pair(module)
        node.advertise("leds", Led, r2p.Periodic(10.0, lambda: led(7)), latch=True)
        await settle(15.0)
        assert drain(other.subscribe("leds", Led)) == [7]


@pytest.mark.virtual_time
@pytest.mark.parametrize("klass", [r2p.NonRealTime(), r2p.Sporadic(deadline=1.0)])
async def test_publish_yields_at_least_every_16_messages(klass: r2p.NonRealTime) -> None:
    async with local() as module:
        node, _ = pair(module)
        publisher = node.advertise("leds", Led, klass)
        with Turns() as turns:
            for number in range(160):
                await publisher.publish(led(number))
        assert turns.count >= 10


@pytest.mark.virtual_time
async def test_what_a_signal_raises_crashes_the_node() -> None:
    def broken(missed: r2p.Missed) -> None:
        raise ValueError("no idea")

    async def careless(node: r2p.Node) -> None:
        publisher = node.advertise("leds", Led, r2p.Sporadic(deadline=0.1, on_missed=broken))
        for number in range(2):
            await publisher.publish(led(number))
        await asyncio.Event().wait()

    async def main() -> None:
        async with local() as module:
            module.start(hold, name="sub").subscribe("leds", Led, queue=1)
            module.start(careless)
            await settle(0.5)

    (error,) = await crashes(main)
    assert str(error) == "no idea"


@pytest.mark.virtual_time
@pytest.mark.parametrize("klass", [r2p.NonRealTime, functools.partial(r2p.Sporadic, 0.01, pending=1)])
async def test_a_callback_that_publishes_is_called_a_little_later_for_what_is_missed_by_that(
    klass: Callable[..., r2p.NonRealTime],
) -> None:
    async with local() as module:
        node, other = pair(module)
        leds = other.subscribe("leds", Led, queue=1)
        missed = Recorder(then=lambda: [publisher.publish_nowait(led(7)) for _ in range(2)])
        publisher = node.advertise("leds", Led, klass(on_missed=missed))
        for number in range(3):
            publisher.publish_nowait(led(number))
        await asyncio.sleep(0.1)
        assert not module.nodes["pub"].error
        assert 50 <= len(missed.calls) <= 410
        assert sum(each.count for each in missed.calls) == pytest.approx(publisher.missed, abs=16)
        leds.close()
        await asyncio.sleep(0.1)
        calls = len(missed.calls)
        await asyncio.sleep(1.0)
        assert len(missed.calls) == calls


@pytest.mark.anyio
async def test_publishing_from_a_thread() -> None:
    async with local() as module:
        node, other = pair(module)
        leds, publisher = other.subscribe("leds", Led), node.advertise("leds", Led)
        loop = asyncio.get_running_loop()
        thread = threading.Thread(target=lambda: loop.call_soon_threadsafe(publisher.publish_nowait, led(5)))
        thread.start()
        assert await leds.fetch() == led(5)
        thread.join()


BAD = 0.0, -1.0, 1e-9, math.nan, math.inf, 1e300, "1", True, None


@pytest.mark.virtual_time
@pytest.mark.parametrize(
    ("klass", "options", "match"),
    [
        *((r2p.Sporadic, {"deadline": bad}, "deadline is in seconds, 1e-06 to 1e[+]09, not") for bad in BAD),
        *((r2p.Periodic, {"period": bad, "fill": Led}, "period is in seconds, 1e-06 to") for bad in BAD),
        *((r2p.NonRealTime, {"stall": bad}, "stall is in seconds, 0 to") for bad in (-1, math.nan, math.inf, None)),
        *((r2p.Periodic, {"period": 1, "fill": Led, "lead": bad}, "lead is in seconds") for bad in (-1, math.nan)),
        *((r2p.Sporadic, {"deadline": 1, "pending": bad}, "pending is a number") for bad in (0, -1, 1.5, True, None)),
        (r2p.Sporadic, {"deadline": 1, "late": "sned"}, "late is 'drop' or 'send', not 'sned'"),
        (r2p.Periodic, {"period": 1, "fill": Led()}, "fill is a function that returns the message, not Led"),
        (r2p.NonRealTime, {"on_missed": "me"}, "on_missed is a function that takes an r2p.Missed, not 'me'"),
        (lambda: r2p.Sporadic, {}, "give a class value, such as r2p.Sporadic"),
        (lambda: None, {}, "give a class value"),
    ],
)
async def test_a_class_value_without_sense_is_refused_and_leaves_nothing(
    klass: Any, options: dict[str, Any], match: str
) -> None:
    async with local() as module:
        node = module.start(hold)
        with pytest.raises(r2p.MessageError, match=f"^topic leds: {match}"):
            node.advertise("leds", Led, klass(**options))
        assert "leds" not in module.space.topics
        assert not node.publishers


# Non real-time


@pytest.mark.virtual_time
async def test_queues_with_room_get_it_at_once_and_the_publisher_waits_for_the_others() -> None:
    async with local() as module:
        node, other = pair(module)
        wide, narrow = other.subscribe("leds", Led, queue=8), other.subscribe("leds", Led, queue=1)
        publisher = node.advertise("leds", Led)
        await publisher.publish(led(1))
        publishing = asyncio.create_task(publisher.publish(led(2)))
        await settle(0.5)
        assert drain(wide) == [1, 2]
        assert not publishing.done()
        assert (await narrow.fetch()).led == 1
        await publishing
        assert elapsed(module) == pytest.approx(0.5, abs=1e-3)
        assert drain(narrow) == [2]
        assert (publisher.missed, narrow.lost) == (0, 0)


@pytest.mark.virtual_time
async def test_a_queue_that_makes_no_room_in_time_is_lossy_until_it_has_some() -> None:
    missed = Recorder()
    async with local() as module:
        node, other = pair(module)
        leds = other.subscribe("leds", Led, queue=4)
        publisher = node.advertise("leds", Led, r2p.NonRealTime(stall=STALL, on_missed=missed))
        for number in range(5):
            await publisher.publish(led(number))
        assert elapsed(module) == pytest.approx(STALL)
        for number in range(5, 8):  # lossy: no publisher waits, the oldest are lost
            await publisher.publish(led(number))
        assert elapsed(module) == pytest.approx(STALL)
        reasons = ["no room for 1.0 s", "no room", "no room", "no room"]
        assert missed.calls == [r2p.Missed("leds", reason, where="sub") for reason in reasons]
        assert (publisher.missed, leds.lost) == (4, 4)
        assert [(await leds.fetch()).led for _ in range(4)] == [4, 5, 6, 7]
        for number in range(8, 12):
            await publisher.publish(led(number))
        publishing = asyncio.create_task(publisher.publish(led(12)))
        await settle(STALL / 2)
        assert not publishing.done()  # it is waited for again
        await leds.fetch()
        await leds.fetch()
        await publishing
        assert (publisher.missed, leds.lost) == (4, 4)


@pytest.mark.virtual_time
async def test_a_slow_reader_that_makes_room_within_the_stall_loses_nothing() -> None:
    got = []

    async def slow(node: r2p.Node) -> None:
        async for message in node.subscribe("leds", Led, queue=16):
            await asyncio.sleep(0.2)  # half of the queue takes longer than `stall`
            got.append(message)

    async with local() as module:
        module.start(slow)
        publisher = module.start(hold).advertise("leds", Led, r2p.NonRealTime(stall=STALL))
        await publisher.wait_subscriber()
        for number in range(60):
            await publisher.publish(led(number))
        await settle(10.0)
        assert numbers(got) == list(range(60))
        assert publisher.missed == 0


@pytest.mark.virtual_time
async def test_its_own_subscription_never_blocks_a_node() -> None:
    async with local() as module:
        node, _ = pair(module)
        own = node.subscribe("leds", Led, queue=2)
        publisher = node.advertise("leds", Led)
        for number in range(5):
            await publisher.publish(led(number))
        assert elapsed(module) == 0.0
        assert (drain(own), own.lost) == ([3, 4], 3)


@pytest.mark.virtual_time
async def test_no_publisher_waits_for_a_lossy_subscriber() -> None:
    async with local() as module:
        node, other = pair(module)
        lossy = other.subscribe("leds", Led, queue=2, lossy=True)
        publisher = node.advertise("leds", Led)
        for number in range(5):
            await publisher.publish(led(number))
        assert elapsed(module) == 0.0
        assert (drain(lossy), lossy.lost, publisher.missed) == ([3, 4], 3, 0)
        for number in range(3):
            await publisher.publish(led(number))
        assert elapsed(module) == 0.0  # for good


@pytest.mark.virtual_time
async def test_publish_nowait_says_whether_all_queues_that_are_not_lossy_had_room() -> None:
    missed = Recorder()
    async with local() as module:
        node, other = pair(module)
        leds = other.subscribe("leds", Led, queue=1)
        other.subscribe("leds", Led, queue=1, lossy=True)
        publisher = node.advertise("leds", Led, r2p.NonRealTime(on_missed=missed))
        assert publisher.publish_nowait(led(1))
        assert not publisher.publish_nowait(led(2))
        assert (drain(leds), leds.lost, publisher.missed, missed.reasons) == ([2], 1, 1, ["no room"])


@pytest.mark.virtual_time
async def test_a_publish_that_waits_can_be_cancelled() -> None:
    async with local() as module:
        node, other = pair(module)
        leds = other.subscribe("leds", Led, queue=1)
        publisher = node.advertise("leds", Led)
        await publisher.publish(led(1))
        for number in range(100):
            with pytest.raises(TimeoutError):
                await asyncio.wait_for(publisher.publish(led(number)), 0.01)
        assert (leds.lost, publisher.missed) == (100, 100)
        assert not leds._sink.wait_queue  # nothing grows
        assert (await leds.fetch()).led == 1
        await publisher.publish(led(7))
        assert drain(leds) == [7]


@pytest.mark.virtual_time
async def test_a_subscriber_that_leaves_is_waited_for_no_more() -> None:
    async with local() as module:
        node, other = pair(module)
        leds = other.subscribe("leds", Led, queue=1)
        publisher = node.advertise("leds", Led)
        await publisher.publish(led(1))
        publishing = asyncio.create_task(publisher.publish(led(2)))
        await settle(0.1)
        leds.close()
        await publishing
        assert elapsed(module) == pytest.approx(0.1, abs=1e-3)
        assert (publisher.missed, len(leds.queue)) == (0, 0)


@pytest.mark.virtual_time
async def test_several_tasks_publish_at_once() -> None:
    got = []

    async def reader(node: r2p.Node) -> None:
        async for message in node.subscribe("leds", Led, queue=3):
            got.append(message)
            await asyncio.sleep(0.01)

    async with local() as module:
        module.start(reader)
        publisher = module.start(hold).advertise("leds", Led)
        await publisher.wait_subscriber()

        async def publish(start: int) -> None:
            for number in range(start, start + 20):
                await publisher.publish(led(number))

        async with asyncio.TaskGroup() as tasks:
            for start in (0, 100, 200, 300):
                tasks.create_task(publish(start))
        await settle(5.0)
        assert sorted(numbers(got)) == [start + number for start in (0, 100, 200, 300) for number in range(20)]
        for start in (0, 100, 200, 300):
            mine = [each for each in numbers(got) if start <= each < start + 100]
            assert mine == sorted(mine)


@pytest.mark.virtual_time
async def test_waiting_publishers_are_served_in_order() -> None:
    """Three that always have something to say, and a reader that is slower than each: all get their share."""
    got = []

    async def reader(node: r2p.Node) -> None:
        async for message in node.subscribe("leds", Led, queue=2):
            await asyncio.sleep(0.1)
            got.append(message.led)

    async def publish(node: r2p.Node, number: int) -> None:
        publisher = node.advertise("leds", Led, r2p.NonRealTime(stall=STALL))
        await publisher.wait_subscriber()
        while True:
            await publisher.publish(led(number))

    async with local() as module:
        module.start(reader)
        for number in range(3):
            module.start(publish, number, name=f"pub{number}")
        await settle(10.0)
        assert len(got) > 90
        assert all({*got[begin : begin + 3]} == {0, 1, 2} for begin in range(3, len(got) - 2))
        publishers = module.space.topics["leds"].publishers
        assert [publisher.missed for publisher in publishers] == [0, 0, 0]  # type: ignore[attr-defined]


@pytest.mark.virtual_time
async def test_tasks_of_one_publisher_do_not_overtake_each_other() -> None:
    async with local() as module:
        node, other = pair(module)
        leds = other.subscribe("leds", Led, queue=4)
        publisher = node.advertise("leds", Led)
        async with asyncio.TaskGroup() as tasks:
            for number in range(20):
                tasks.create_task(publisher.publish(led(number)))
            await settle(0.1)
            got = []
            for number in range(20, 40):  # while those still wait
                got.append((await leds.fetch()).led)
                tasks.create_task(publisher.publish(led(number)))
                await settle()
            got += [(await leds.fetch()).led for _ in range(20)]
        assert got == list(range(40))


@pytest.mark.virtual_time
@pytest.mark.parametrize(("keep", "left"), [("newest", [2, 3]), ("oldest", [0, 1])])
async def test_a_message_that_does_not_wait_pushes_in_what_waits_before_it(keep: Keep, left: list[int]) -> None:
    async with local() as module, asyncio.TaskGroup() as tasks:
        node, other = pair(module)
        leds = other.subscribe("leds", Led, queue=2, keep=keep)
        publisher = node.advertise("leds", Led)
        for number in range(2):
            await publisher.publish(led(number))
        waits = tasks.create_task(publisher.publish(led(2)))
        await settle()
        assert not publisher.publish_nowait(led(3))
        await settle()
        assert waits.done() == (keep == "newest")
        assert [(await leds.fetch()).led for _ in range(2)] == left
        assert leds.lost == {"newest": 2, "oldest": 1}[keep]


@pytest.mark.virtual_time
async def test_a_newer_value_pushes_in_a_latched_one_that_waits() -> None:
    async with local() as module:
        node, other = pair(module)
        values = [node.advertise("leds", Led, latch=True) for _ in range(2)]
        for number, publisher in enumerate(values):
            await publisher.publish(led(number))
        leds = other.subscribe("leds", Led, queue=1, lossy=True)  # the first one is in, the second one waits
        await values[1].publish(led(2))
        assert [(await leds.fetch()).led for _ in range(len(leds.queue))] == [2]
        await settle()
        assert not leds.queue
        assert leds.lost == 2


@pytest.mark.virtual_time
async def test_when_one_publisher_has_waited_long_enough_none_waits_any_more() -> None:
    async with local() as module:
        node, other = pair(module)
        leds = other.subscribe("leds", Led, queue=1)
        missed = Recorder()
        publisher = node.advertise("leds", Led, r2p.NonRealTime(stall=STALL, on_missed=missed))
        await publisher.publish(led(0))
        first = asyncio.create_task(publisher.publish(led(1)))
        await settle(0.5 * STALL)
        second = asyncio.create_task(publisher.publish(led(2)))
        await settle(0.6 * STALL)
        assert first.done()
        assert second.done()
        assert (drain(leds), leds.lost, publisher.missed) == ([2], 2, 2)
        assert missed.reasons == ["no room for 1.0 s"] * 2


@pytest.mark.virtual_time
async def test_an_event_gets_the_first_place_and_events_keep_their_order() -> None:
    async with local() as module:
        node, other = pair(module)
        leds = other.subscribe("leds", Led, queue=1)
        bulk = node.advertise("leds", Led)
        alarms = [node.advertise("leds", Led, r2p.Sporadic(1.0)) for _ in range(2)]
        await bulk.publish(led(0))
        waiting = [asyncio.create_task(bulk.publish(led(number))) for number in (8, 9)]
        await settle()
        for number in range(1, 7):
            assert not alarms[number % 2].publish_nowait(led(number))
        assert [(await leds.fetch()).led for _ in range(9)] == [0, 1, 2, 3, 4, 5, 6, 8, 9]
        await asyncio.gather(*waiting)
        assert not leds._sink.wait_queue  # nothing is left behind


@pytest.mark.virtual_time
async def test_a_message_that_several_did_not_get_is_one_that_was_missed() -> None:
    missed = Recorder()
    async with local() as module:
        node, other = pair(module)
        third = module.start(hold, name="third")
        full = [other.subscribe("a", Led, queue=1), third.subscribe("a", Led, queue=1)]
        full += [other.subscribe("b", Led, queue=1), third.subscribe("b", Led, queue=1)]
        state = node.advertise("a", Led, r2p.NonRealTime(stall=STALL, on_missed=missed))
        event = node.advertise("b", Led, r2p.Sporadic(0.5, on_missed=missed))
        for publisher in (state, event):
            await publisher.publish(led(1))
        state.publish_nowait(led(2))
        await event.publish(led(2))
        await state.publish(led(3))
        assert (state.missed, event.missed, [each.lost for each in full]) == (2, 1, [2, 2, 1, 1])
        assert {each.where for each in missed.calls} == {"sub, third"}
        assert [each.count for each in missed.calls] == [1, 1, 1]


@pytest.mark.virtual_time
async def test_one_message_may_be_missed_here_and_there() -> None:
    missed = Recorder()
    async with local() as module:
        node, other = pair(module)
        other.subscribe("leds", Led, queue=1)
        publisher = node.advertise("leds", Led, r2p.Sporadic(0.5, on_missed=missed))
        await publisher.publish(led(1))
        await publisher.publish(led(2))
        publisher.link_missed("can", "never sent", 0.0, publisher.sent)
        await settle(1.0)
        assert [(each.where, each.count) for each in missed.calls] == [("can", 1), ("sub", 0)]
        assert publisher.missed == 1


@pytest.mark.virtual_time
async def test_without_a_callback_a_miss_is_described_only_when_it_is_logged(monkeypatch: pytest.MonkeyPatch) -> None:
    described: list[r2p.Missed] = []

    def describe(topic: str, reason: str, names: str, late: float, count: int) -> r2p.Missed:
        described.append(r2p.Missed(topic, reason, names, late, count))
        return described[-1]

    monkeypatch.setattr("r2p.runtime.publishers.base.Missed", describe)
    async with local() as module:
        module.start(hold, name="sub").subscribe("leds", Led, queue=1)
        publisher = module.start(hold, name="pub").advertise("leds", Led)
        await settle()
        for number in range(100):
            publisher.publish_nowait(led(number))
        assert publisher.missed == 99
        assert len(described) == 1


@pytest.mark.virtual_time
async def test_a_message_that_many_missed_does_not_make_others_count_again() -> None:
    async with local() as module:
        publisher = module.start(hold, name="pub").advertise("leds", Led)
        for link in ("first", *(f"link{number}" for number in range(100))):
            publisher.link_missed(link, "never sent", sequence=1 if link == "first" else 2)
        publisher.link_missed("last", "never sent", sequence=1)
        assert publisher.missed == 2


class Samples(r2p.Message):
    values: Annotated[r2p.Array[r2p.f32], r2p.Max(4)] = r2p.Array()


@pytest.mark.virtual_time
@pytest.mark.parametrize("klass", [r2p.NonRealTime(), r2p.Sporadic(deadline=1.0)])
async def test_a_buffer_that_can_be_written_to_is_not_shared(klass: r2p.NonRealTime | r2p.Sporadic) -> None:
    """Subscribers get what was published, also if the publisher uses its buffer again; what is immutable they share."""
    async with local() as module:
        node = module.start(hold, name="n")
        subscriber = node.subscribe("samples", Samples)
        publisher = node.advertise("samples", Samples, klass)
        buffer = array.array("f", [1.0, 2.0])
        await publisher.publish(Samples(buffer))  # type: ignore[arg-type]
        buffer[0] = 9.0
        received = await subscriber.fetch()
        assert received == Samples(r2p.Array([1.0, 2.0]))
        await publisher.publish(received)
        assert await subscriber.fetch() is received
