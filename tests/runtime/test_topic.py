"""Topics: who gets a sample, in which order, and who is woken when."""

from __future__ import annotations

import asyncio
import gc
import weakref
from typing import TYPE_CHECKING

import pytest

import r2p
from r2p.msg import Encoder, Led
from r2p.runtime.backpressure import WaitQueue
from r2p.runtime.sample import Sample, Source
from r2p.runtime.topic import RemoteSubscriber
from tests.bench import hold, joined, led, local, settle

if TYPE_CHECKING:
    from collections.abc import Callable


class Lamp(r2p.Message):
    """The layout of Led under another name."""

    led: r2p.u32 = 0
    value: r2p.u8 = 0


class Line(RemoteSubscriber):
    """The subscribers behind a link, where `event` happens at the first message."""

    def __init__(self, name: str, event: Callable[[], object] | None = None, *, full: bool = False) -> None:
        super().__init__(name, self, WaitQueue())
        self.event = event
        self.full = full
        self.got: list[bytes] = []

    def offer(self, sample: Sample) -> bool:
        event, self.event = self.event, None
        if event is not None:
            event()
        if not self.full:
            self.got.append(sample.data)
        return not self.full

    def force(self, sample: Sample) -> None:
        raise AssertionError(sample)

    def refill(self) -> None:
        raise AssertionError


# Types


@pytest.mark.virtual_time
async def test_one_topic_has_one_layout_in_a_module() -> None:
    async with local() as module:
        node = module.start(hold)
        node.advertise("leds", Led)
        with pytest.raises(r2p.TypeMismatch, match=r"topic leds is Led \(.*\) in module PC1, not Encoder"):
            node.subscribe("leds", Encoder)
        with pytest.raises(r2p.TypeMismatch):
            node.advertise("leds", Encoder)
        assert len(node.publishers) == 1
        assert not node.subscribers


@pytest.mark.virtual_time
async def test_the_same_layout_under_another_name_fits() -> None:
    async with local() as module:
        node, other = module.start(hold, name="a"), module.start(hold, name="b")
        lamps = other.subscribe("leds", Lamp)
        await node.advertise("leds", Led).publish(Led(led=3, value=1))
        assert await lamps.fetch() == Lamp(led=3, value=1)


@pytest.mark.virtual_time
async def test_a_topic_without_users_is_forgotten_and_may_have_another_type() -> None:
    async with local() as module:
        node = module.start(hold)
        publisher, subscriber = node.advertise("leds", Led), node.subscribe("leds", Led)
        publisher.close()
        with pytest.raises(r2p.TypeMismatch):
            node.advertise("leds", Encoder)
        subscriber.close()
        assert "leds" not in module.space.topics
        node.advertise("leds", Encoder)


@pytest.mark.virtual_time
async def test_what_fails_leaves_no_topic_behind() -> None:
    async with local() as module:
        node = module.start(hold)
        with pytest.raises(r2p.MessageError):
            node.advertise("leds", Led, r2p.Sporadic(deadline=0))
        with pytest.raises(r2p.MessageError):
            node.advertise("leds", Led, r2p.Periodic(period=-1, fill=Led))
        assert "leds" not in module.space.topics
        assert not node.publishers


# Delivery


@pytest.mark.virtual_time
async def test_all_subscribers_get_the_very_object_that_was_published() -> None:
    async with local() as module:
        node, other = module.start(hold, name="a"), module.start(hold, name="b")
        first, second = other.subscribe("leds", Led), other.subscribe("leds", Led)
        message = led(1)
        await node.advertise("leds", Led).publish(message)
        assert await first.fetch() is message
        assert await second.fetch() is message


@pytest.mark.virtual_time
async def test_several_publishers_share_a_topic() -> None:
    async with local() as module:
        node, other, third = (module.start(hold, name=name) for name in "abc")
        leds = third.subscribe("leds", Led)
        await node.advertise("leds", Led).publish(led(1))
        await other.advertise("leds", Led).publish(led(2))
        samples = leds.samples()
        assert [str((await anext(samples)).source) for _ in range(2)] == ["PC1/a", "PC1/b"]


@pytest.mark.virtual_time
async def test_what_came_by_a_link_goes_to_no_link() -> None:
    async with joined("A") as a, joined("B") as b:
        publisher = a.start(hold, name="a").advertise("leds", Led)
        relay = b.start(hold, name="b")
        leds = relay.subscribe("leds", Led)
        relay.advertise("leds", Led)  # so that b's link has an outlet for the topic as well
        back = a.start(hold, name="c").subscribe("leds", Led)
        await leds.wait_publisher()
        await settle(1.0)
        await publisher.publish(led(1))
        assert await leds.fetch() == led(1)
        await settle(1.0)
        assert len(back.queue) == 1  # the local delivery alone
        assert b.links[0].stats.sent == 0


def received(count: int) -> list[Sample]:
    """Samples with the sequences 1 to `count`, from a link."""
    return [Sample(led(1).encode(), Source("A", "a", "line"), 0, sequence=number + 1) for number in range(count)]


@pytest.mark.virtual_time
async def test_a_single_subscriber_takes_messages_in_bulk_as_far_as_it_has_room() -> None:
    async with local() as module:
        leds, samples = module.start(hold, name="a").subscribe("leds", Led, queue=5), received(8)
        topic = module.space.topics["leds"]
        reader = asyncio.create_task(leds.fetch())
        await settle()
        assert topic.deliver_run(samples, 1) == 5
        await reader  # it was woken
        assert [each.sequence for each in leds.queue] == [3, 4, 5, 6]
        assert topic.deliver_run(samples, 6) == 1
        assert topic.deliver_run(samples, 7) == 0
        assert (leds.lost, len(leds.queue)) == (0, 5)


@pytest.mark.virtual_time
async def test_messages_that_are_looked_at_one_by_one_are_not_taken_in_bulk() -> None:
    async with local() as module:
        node, samples = module.start(hold, name="a"), received(3)
        counted = node.subscribe("leds", Led, queue=5, queue_bytes=12)
        topic = module.space.topics["leds"]
        assert topic.deliver_run(samples, 0) == 0
        counted.close()
        node.subscribe("leds", Led)
        topic = module.space.topics["leds"]
        topic.drop_filter = lambda _link: False
        assert topic.deliver_run(samples, 0) == 0
        topic.drop_filter = None
        node.subscribe("leds", Led)
        assert topic.deliver_run(samples, 0) == 0
        assert all(not sink.queue for sink in topic.queues)


@pytest.mark.virtual_time
async def test_ten_thousand_topics() -> None:
    async with local() as module:
        node, other = module.start(hold, name="a"), module.start(hold, name="b")
        publishers = [node.advertise(f"t{number}", Led) for number in range(10_000)]
        subscribers = [other.subscribe(f"t{number}", Led) for number in range(10_000)]
        for number, publisher in enumerate(publishers):
            await publisher.publish(led(number))
        assert [(await each.fetch()).led for each in subscribers] == list(range(10_000))
        assert len(module.network.topics()) == 10_001  # and `log`
        for publisher, subscriber in zip(publishers, subscribers, strict=True):
            publisher.close()
            subscriber.close()
        assert list(module.space.topics) == ["log"]


@pytest.mark.virtual_time
async def test_nothing_is_held_after_close() -> None:
    async with local() as module:
        node, other = module.start(hold, name="a"), module.start(hold, name="b")
        publisher = node.advertise("leds", Led, latch=True)
        event = node.advertise("leds", Led, r2p.Sporadic(deadline=1.0))
        subscriber = other.subscribe("leds", Led, queue=1)
        full = other.subscribe("leds", Led, queue=1)  # stays full, with an event waiting for it
        await publisher.publish(led(1))
        await event.publish(led(2))
        held = [weakref.ref(each) for each in (publisher, event, subscriber)]
        for user in (publisher, event, subscriber):
            user.close()
        await settle()
        del publisher, event, subscriber, user
        gc.collect()
        assert [each() for each in held] == [None] * 3
        assert len(full.queue) == 1


# What happens while a message is on its way through the lists


@pytest.mark.virtual_time
async def test_a_link_that_leaves_while_it_is_written_to_hides_no_other_link() -> None:
    async with local() as module:
        publisher = module.start(hold).advertise("leds", Led)
        topic = module.space.topics["leds"]
        lines = [Line("a", lambda: topic.leave(lines[0])), Line("b"), Line("c")]
        for line in lines:
            topic.join(line)
        await publisher.publish(led(1))
        assert [len(line.got) for line in lines] == [1, 1, 1]
        await publisher.publish(led(2))
        assert [len(line.got) for line in lines] == [1, 2, 2]


@pytest.mark.virtual_time
@pytest.mark.parametrize("leaves", [0, 2])
async def test_a_full_link_that_leaves_meanwhile_is_not_waited_for(leaves: int) -> None:
    async with local() as module:
        publisher = module.start(hold).advertise("leds", Led)
        topic = module.space.topics["leds"]
        lines = [Line("a", full=True), Line("b", lambda: topic.leave(lines[leaves])), Line("c", full=True)]
        for line in lines:
            topic.join(line)
        sample = publisher._sample(led(1))
        assert topic.deliver(sample) == [lines[2 - leaves]]
        lines[2 - leaves].full = False
        assert topic.deliver(sample) is None


@pytest.mark.virtual_time
async def test_a_full_subscriber_that_a_callback_closes_is_not_waited_for() -> None:
    async with local() as module:
        node, other = module.start(hold, name="a"), module.start(hold, name="b")
        publisher = node.advertise("leds", Led)
        leds = other.subscribe("leds", Led, queue=1)
        module.space.topics["leds"].join(Line("a", leds.close))
        assert publisher.publish_nowait(led(1))
        leds = other.subscribe("leds", Led, queue=1)
        await publisher.publish(led(2))
        module.space.topics["leds"].join(Line("b", leds.close))
        async with asyncio.timeout(0):
            await publisher.publish(led(3))
        assert publisher.missed == 0


@pytest.mark.virtual_time
async def test_a_publisher_that_its_own_latched_message_closes_hides_no_other_publisher() -> None:
    async with local() as module:
        first = module.start(hold, name="a").advertise("leds", Led, latch=True)
        second = module.start(hold, name="b").advertise("leds", Led, latch=True)
        await first.publish(led(1))
        await second.publish(led(2))
        line = Line("line", first.close)
        module.space.topics["leds"].join(line)
        assert line.got == [led(number).encode() for number in (1, 2)]


# Waking


async def awaken(priorities: list[int]) -> list[list[int]]:
    """Wake one waiting subscriber of each priority; gives those that ran, turn by turn."""
    turns: list[list[int]] = []

    async def wait(node: r2p.Node) -> None:
        leds = node.subscribe("leds", Led)
        await leds.fetch()
        turns[-1].append(node.priority)

    async with local() as module:
        for number, priority in enumerate(priorities):
            module.start(wait, name=f"n{number}", priority=priority)
        publisher = module.start(hold, name="source", priority=min(priorities)).advertise("leds", Led)
        await settle()
        publisher.publish_nowait(led(1))
        while sum(map(len, turns)) < len(priorities):
            turns.append([])
            await asyncio.sleep(0)
    return [turn for turn in turns if turn]


@pytest.mark.virtual_time
async def test_the_highest_priority_is_woken_at_once_and_the_rest_one_a_turn_highest_first() -> None:
    assert await awaken([1, 5, 0, 5, 2]) == [[5, 5], [2], [1], [0]]


@pytest.mark.virtual_time
async def test_nodes_of_one_priority_are_all_woken_at_once() -> None:
    assert await awaken([-3, -3, -3]) == [[-3, -3, -3]]


@pytest.mark.virtual_time
async def test_the_highest_priority_is_that_of_the_nodes_which_still_run() -> None:
    async with local() as module:
        important, other = module.start(hold, name="a", priority=9), module.start(hold, name="b", priority=1)
        await settle()
        assert module.space.wake_scheduler.top == 9
        await module.nodes["a"].stop()
        assert (important.closed, other.closed) == (True, False)
        assert module.space.wake_scheduler.top == 1
    assert module.space.wake_scheduler.top == 0
