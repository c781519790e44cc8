"""Subscribers: how a queue is emptied, what is lost on the way, and that one task reads it."""

from __future__ import annotations

import asyncio
import math
from typing import TYPE_CHECKING, Annotated, Any

import pytest

import r2p
from r2p.msg import Encoder, Led
from tests.bench import Turns, collect, crashes, drain, hold, joined, led, local, numbers, settle

if TYPE_CHECKING:
    from collections.abc import AsyncIterator


class Name(r2p.Message):
    """A layout in which not all bytes are a value."""

    name: Annotated[str, r2p.Len(4)] = ""


def pair(module: r2p.Module, **options: Any) -> tuple[r2p.Publisher[Led], r2p.Subscriber[Led]]:
    """A publisher and a subscriber in two nodes."""
    publisher = module.start(hold, name="pub").advertise("leds", Led)
    return publisher, module.start(hold, name="sub").subscribe("leds", Led, **options)


# Queues


@pytest.mark.virtual_time
async def test_a_queue_holds_16_messages_unless_it_says_otherwise() -> None:
    async with local() as module:
        publisher, leds = pair(module)
        for number in range(20):
            publisher.publish_nowait(led(number))
        assert drain(leds) == list(range(4, 20))


@pytest.mark.virtual_time
@pytest.mark.parametrize(("keep", "left"), [("newest", [2, 3, 4]), ("oldest", [0, 1, 2])])
async def test_a_full_queue_drops_for_its_own_subscriber_only(keep: str, left: list[int]) -> None:
    async with local() as module:
        publisher, leds = pair(module, queue=3, keep=keep, lossy=True)
        others = [module.start(hold, name=name).subscribe("leds", Led, lossy=name < "c") for name in "abcd"]
        for number in range(5):
            await publisher.publish(led(number))
        assert (drain(leds), leds.lost) == (left, 2)
        assert [drain(other) for other in others] == [list(range(5))] * 4
        assert [other.lost for other in others] == [0] * 4


@pytest.mark.virtual_time
@pytest.mark.parametrize(
    ("options", "text"),
    [
        *(({"queue": bad}, "queue is a number of messages, 1 or more") for bad in (0, -1, 1.5, math.nan, None, True)),
        ({"queue_bytes": 0}, "queue_bytes is a number of bytes, 1 or more, not 0"),
        *(({"max_age": bad}, "max_age is in seconds, 1e-06 to") for bad in (0, math.nan, math.inf, "1")),
        *(({"timeout": bad}, "timeout is in seconds, 1e-06 to") for bad in (-1.0, 1e-9, math.nan, math.inf)),
        ({"keep": "latest"}, "keep is 'newest' or 'oldest', not 'latest'"),
        ({"callback": 5}, "a callback is a function, not 5: options are given by name"),
        ({"timeout": 1.0, "on_timeout": 5}, "on_timeout is a function, called after a timeout="),
        ({"on_timeout": print}, "on_timeout is a function, called after a timeout="),
    ],
)
async def test_options_without_sense_are_refused(options: dict[str, Any], text: str) -> None:
    async with local() as module:
        with pytest.raises(r2p.MessageError, match=text):
            pair(module, **options)
        assert list(module.space.topics["leds"].queues) == []


# Iteration


@pytest.mark.virtual_time
async def test_leaving_an_async_for_keeps_the_subscription() -> None:
    async with local() as module:
        publisher, leds = pair(module)
        for number in range(3):
            await publisher.publish(led(number))
        got = []
        for _ in range(3):
            async for message in leds:
                got.append(message)
                break
        assert numbers(got) == [0, 1, 2]
        await publisher.publish(led(3))
        assert drain(leds) == [3]


@pytest.mark.virtual_time
async def test_samples_gives_samples() -> None:
    async with local() as module:
        publisher, leds = pair(module)
        await publisher.publish(led(1))
        async for sample in leds.samples():
            assert isinstance(sample, r2p.Sample)
            assert (sample.message, sample.data) == (led(1), led(1).encode())
            break


@pytest.mark.virtual_time
@pytest.mark.parametrize("how", ["iterate", "fetch", "spin"])
async def test_whoever_reads_lets_others_run_at_least_every_16_messages(how: str) -> None:
    got: list[Led] = []

    async def greedy(node: r2p.Node) -> None:
        """Its queue is never empty: it is refilled while it reads."""
        publisher = node.advertise("leds", Led)
        leds = node.subscribe("leds", Led, got.append if how == "spin" else None, queue=200)
        for number in range(100):
            publisher.publish_nowait(led(number))
        while len(got) < 1000:
            if how == "spin":
                await node.spin()
                publisher.publish_nowait(led(0))
                continue
            if how == "fetch":
                got.append(await leds.fetch())
                publisher.publish_nowait(led(0))
                continue
            async for message in leds:
                got.append(message)
                publisher.publish_nowait(led(0))
                if len(got) >= 1000:
                    break

    async with local() as module:
        module.start(greedy)
        with Turns() as turns:
            while len(got) < 1000:
                before = len(got)
                await asyncio.sleep(0)
                assert len(got) - before <= 16
        assert turns.count >= 1000 // 16


@pytest.mark.virtual_time
@pytest.mark.parametrize("how", ["iterate", "fetch", "spin"])
async def test_a_node_of_low_priority_handles_one_message_a_turn(how: str) -> None:
    got: list[int] = []

    async def low(node: r2p.Node) -> None:
        leds = node.subscribe("leds", Led, (lambda m: got.append(m.led)) if how == "spin" else None)
        while len(got) < 8:
            if how == "spin":
                await node.spin()
            elif how == "fetch":
                got.append((await leds.fetch()).led)
            else:
                async for message in leds:
                    got.append(message.led)
                    if len(got) == 8:
                        break

    async with local() as module:
        module.start(hold, priority=5)
        module.start(low)
        publisher = module.start(hold, name="pub").advertise("leds", Led)
        await publisher.wait_subscriber()
        await settle()
        for number in range(8):
            publisher.publish_nowait(led(number))
        while len(got) < 8:
            before = len(got)
            await asyncio.sleep(0)
            assert len(got) - before <= 1
        assert got == list(range(8))


@pytest.mark.virtual_time
async def test_closing_ends_the_iteration() -> None:
    async with local() as module:
        _, leds = pair(module)

        async def read() -> list[Led]:
            return [message async for message in leds]

        async with asyncio.TaskGroup() as tasks:
            reading = tasks.create_task(read())
            fetching = tasks.create_task(leds.wait_publisher())
            await settle()
            leds.close()
            leds.close()
        assert reading.result() == []
        assert fetching.done()
        with pytest.raises(r2p.Closed, match="subscribe again"):
            await leds.fetch()
        assert await read() == []


@pytest.mark.virtual_time
async def test_a_subscriber_is_a_context_manager() -> None:
    async with local() as module:
        publisher, leds = pair(module)
        async with leds as same:
            assert same is leds
            assert publisher.subscribers == 1
        assert publisher.subscribers == 0


@pytest.mark.virtual_time
async def test_two_readers_are_an_error() -> None:
    async with local() as module:
        _, leds = pair(module)
        node = module.nodes["sub"].node
        async with asyncio.TaskGroup() as tasks:
            first = tasks.create_task(leds.fetch())
            await settle()
            for read in (leds.fetch(), anext(aiter(leds)), leds.fetch(1.0)):
                with pytest.raises(RuntimeError, match="two tasks read one subscription of leds: subscribe once"):
                    await read
            leds.callback = lambda message: None
            with pytest.raises(RuntimeError, match="two tasks read"):
                await node.spin()
            assert not first.done()
            module.nodes["pub"].node.advertise("leds", Led).publish_nowait(led(1))
        assert first.result() == led(1)


@pytest.mark.virtual_time
@pytest.mark.parametrize("how", ["iterate", "fetch", "fetch with time-out"])
async def test_a_cancelled_reader_loses_no_message(how: str) -> None:
    async with local() as module:
        publisher, leds = pair(module)

        async def read() -> None:
            if how == "iterate":
                await collect(leds, got)
            while True:
                got.append(await (leds.fetch() if how == "fetch" else leds.fetch(1.0)))

        for turns in range(8):
            got: list[Led] = []
            reading = asyncio.create_task(read())
            await settle()
            for number in range(3):
                publisher.publish_nowait(led(number))
            for _ in range(turns):
                await asyncio.sleep(0)
            reading.cancel()
            await asyncio.wait([reading])
            assert numbers(got) + drain(leds) == [0, 1, 2]
            assert leds._sink.waiter is None


# Fetch


@pytest.mark.virtual_time
async def test_fetch_waits_for_one_message() -> None:
    async with local() as module:
        publisher, leds = pair(module)
        fetching = asyncio.create_task(leds.fetch(timeout=2.0))
        await settle(1.0)
        await publisher.publish(led(1))
        assert await fetching == led(1)
        with pytest.raises(TimeoutError, match=r"^no message on 'leds' within 2 s; its publisher is silent$"):
            await leds.fetch(timeout=2.0)
        assert module.space.loop.time() == pytest.approx(3.0, abs=1e-3)
        publisher.close()
        with pytest.raises(TimeoutError, match="within 0 s; it has no publisher yet"):
            await leds.fetch(timeout=0)


@pytest.mark.virtual_time
async def test_the_time_out_of_fetch_counts_from_its_call_also_when_old_messages_wait() -> None:
    async with local() as module:
        publisher, leds = pair(module, max_age=0.1)
        for number in range(3):
            await publisher.publish(led(number))
        await settle(1.0)
        with pytest.raises(TimeoutError, match="publisher is silent, and 3 messages so far were older than max_age"):
            await leds.fetch(timeout=1.0)
        assert leds.stale == 3


@pytest.mark.virtual_time
async def test_subscribers_know_when_there_is_a_publisher() -> None:
    async with local() as module:
        node = module.start(hold)
        leds = node.subscribe("leds", Led)
        waiting = [asyncio.create_task(leds.wait_publisher()) for _ in range(2)]
        await settle()
        assert (leds.publishers, waiting[0].done()) == (0, False)
        publisher = node.advertise("leds", Led)
        await asyncio.gather(*waiting)
        assert leds.publishers == 1
        publisher.close()
        waiter = asyncio.create_task(leds.wait_publisher())
        await settle()
        leds.close()
        with pytest.raises(r2p.Closed):
            await waiter
        with pytest.raises(r2p.Closed):
            await leds.wait_publisher()


# Types


@pytest.mark.virtual_time
async def test_without_a_type_messages_are_packed_bytes() -> None:
    async with local() as module:
        publisher, _ = pair(module)
        raw = module.nodes["sub"].node.subscribe("leds", None, max_age=10.0)
        await publisher.publish(led(1))
        await publisher.publish(led(2))
        assert await raw.fetch() == led(1).encode()
        assert [data async for data in once(raw)] == [led(2).encode()]


async def once(subscriber: r2p.Subscriber[bytes]) -> AsyncIterator[bytes]:
    async for data in subscriber:
        yield data
        return


class Image(r2p.Message):
    data: Annotated[bytes, r2p.Max(1000)] = b""


def sizes_in(subscriber: r2p.Subscriber[Image]) -> list[int]:
    return [len(sample.data) - 4 for sample in subscriber.queue]


@pytest.mark.virtual_time
@pytest.mark.parametrize("timeout", [None, 10.0])
async def test_a_queue_is_full_by_its_bytes_too(timeout: float | None) -> None:
    """The next message finds room while there are fewer: so one message always does, and may exceed them."""
    async with local() as module:
        node = module.start(hold)
        images = node.subscribe("image", Image, queue=4, lossy=True, queue_bytes=1000, timeout=timeout)
        oldest = node.subscribe("image", Image, queue=4, lossy=True, queue_bytes=1000, keep="oldest")
        publisher = module.start(hold, name="pub").advertise("image", Image)
        for size in (100, 100, 996, 200, 50, 0, 0, 0, 0):
            await publisher.publish(Image(data=bytes(size)))
            if size == 996:
                assert sizes_in(images) == [100, 100, 996]
            if size == 200:
                assert sizes_in(images) == [200]  # the long one takes the places of all before it
        assert sizes_in(images) == [0, 0, 0, 0]
        assert (images.lost, sizes_in(oldest), oldest.lost) == (5, [100, 100, 996], 6)
        assert len((await oldest.fetch()).data) == 100
        assert sizes_in(oldest) == [100, 996]
        images.queue.clear()
        for size in (10, 20, 30, 40, 50):
            await publisher.publish(Image(data=bytes(size)))
        assert sizes_in(images) == [20, 30, 40, 50]


@pytest.mark.virtual_time
async def test_publishers_wait_for_bytes() -> None:
    async with local() as module:
        images = module.start(hold).subscribe("image", Image, queue_bytes=1500)
        publisher = module.start(hold, name="pub").advertise("image", Image, r2p.NonRealTime(stall=5.0))
        for _ in range(2):
            await publisher.publish(Image(data=bytes(800)))
        waiting = asyncio.create_task(publisher.publish(Image(data=bytes(1))))
        await settle(1.0)
        assert (waiting.done(), len(images.queue)) == (False, 2)
        await images.fetch()
        await waiting
        assert (sizes_in(images), images.lost, publisher.missed) == ([800, 1], 0, 0)


@pytest.mark.virtual_time
async def test_what_does_not_decode_is_counted_and_skipped() -> None:
    async with joined("A") as a, joined("B") as b:
        names = b.start(hold).subscribe("name", Name)
        publisher = a.start(hold).advertise("name", Name)
        await publisher.wait_subscriber()
        publisher._topic.deliver(r2p.Sample(b"\xff\xfe\0\0", r2p.Source("A", "hold"), 0))
        await publisher.publish(Name(name="abc"))
        assert await names.fetch() == Name(name="abc")
        assert names.undecodable == 1


@pytest.mark.virtual_time
async def test_a_message_from_a_link_is_decoded_once_for_all() -> None:
    async with joined("A") as a, joined("B") as b:
        first = b.start(hold, name="a").subscribe("leds", Led)
        second = b.start(hold, name="b").subscribe("leds", Led)
        publisher = a.start(hold).advertise("leds", Led)
        await publisher.wait_subscriber()
        await publisher.publish(led(1))
        message = await first.fetch()
        assert message == led(1)
        assert await second.fetch() is message


# Guards


@pytest.mark.virtual_time
@pytest.mark.parametrize("how", ["iterate", "fetch", "spin"])
async def test_max_age_skips_what_is_too_old(how: str) -> None:
    got: list[Led] = []
    stale: list[int] = []

    async def read(node: r2p.Node) -> None:
        leds = node.subscribe("leds", Led, got.append if how == "spin" else None, max_age=0.1)
        await asyncio.sleep(1.0)
        if how == "spin":
            await node.spin()
        elif how == "fetch":
            got.extend([await leds.fetch(), await leds.fetch()])
        else:
            async for message in leds:
                got.append(message)
                if len(got) == 2:
                    break
        stale.append(leds.stale)

    async with local() as module:
        module.start(read)
        publisher = module.start(hold).advertise("leds", Led)
        await settle(0.5)
        for number in range(4):
            await publisher.publish(led(number))
            await settle(0.2 if number < 2 else 0.04)
        await settle(1.0)
        assert (numbers(got), stale) == ([2, 3], [2])


@pytest.mark.virtual_time
@pytest.mark.parametrize("where", ["locally", "across a link"])
async def test_max_age_and_timeout_guard_the_other_end(where: str) -> None:
    silences = []
    async with joined("A") as a, joined("B") as b:
        publisher = (b if where == "locally" else a).start(hold).advertise("cmd", Led)
        node = b.start(hold, name="motor")
        commands = node.subscribe("cmd", Led, max_age=0.2, timeout=0.5, on_timeout=lambda: silences.append(node.now()))
        await publisher.wait_subscriber()
        await settle(0.2)
        for number in range(5):
            await publisher.publish(led(number))
            last = node.now()
            await settle(0.3)
        assert silences == []
        await settle(5.0)
        assert silences == [pytest.approx(last + 0.5e9, abs=2e6)]  # once
        assert commands.timeouts == 1
        await publisher.publish(led(9))  # and again after the next message
        await settle(0.6)
        assert commands.timeouts == len(silences) == 2


@pytest.mark.virtual_time
async def test_old_messages_do_not_end_a_silence() -> None:
    silences = []
    async with local() as module:
        publisher, leds = pair(module, max_age=0.1, timeout=0.5, on_timeout=lambda: silences.append(1))
        for _ in range(10):
            publisher._topic.deliver(r2p.Sample(led(1).encode(), r2p.Source(), leds._space.clock.now() - 10**9))
            await settle(0.2)
        assert len(silences) == 1


@pytest.mark.virtual_time
async def test_without_on_timeout_the_iteration_raises() -> None:
    async with local() as module:
        publisher, leds = pair(module, timeout=0.5)
        got: list[Led] = []
        for _ in range(2):
            await publisher.publish(led(1))
            with pytest.raises(TimeoutError, match=r"no message on 'leds' within 0\.5 s; its publisher is silent"):
                await collect(leds, got)
        with pytest.raises(TimeoutError, match="no message on 'leds'"):
            await leds.fetch()
        assert len(got) == 2
        assert leds.timeouts == 3


@pytest.mark.virtual_time
async def test_no_time_out_after_close() -> None:
    silences = []
    async with local() as module:
        publisher, leds = pair(module, queue=1, timeout=0.5, on_timeout=lambda: silences.append(1))
        await settle(1.0)
        assert len(silences) == 1
        await publisher.publish(led(1))
        publishing = asyncio.create_task(publisher.publish(led(2)))  # reaches a queue that was closed meanwhile
        await settle()
        leds.close()
        await publishing
        await settle(2.0)
        assert len(silences) == 1


@pytest.mark.virtual_time
async def test_an_on_timeout_that_fails_crashes_its_node() -> None:
    async def guarded(node: r2p.Node) -> None:
        async for _ in node.subscribe("cmd", Led, timeout=0.5, on_timeout=lambda: 1 / 0):
            pass

    async def main() -> None:
        async with local() as module:
            module.start(guarded)
            await module.wait()

    (error,) = await crashes(main)
    assert isinstance(error, ZeroDivisionError)


# A remote latched topic


@pytest.mark.virtual_time
async def test_latch_across_a_link() -> None:
    async with joined("A") as a:
        publisher = a.start(hold).advertise("map", Encoder, latch=True)
        await publisher.publish(Encoder(delta=4.0))
        async with joined("B") as b:
            first = b.start(hold, name="a").subscribe("map", Encoder)
            assert await first.fetch(5.0) == Encoder(delta=4.0)


@pytest.mark.virtual_time
@pytest.mark.parametrize("latch", [False, True])
async def test_a_second_local_subscriber_of_a_remote_latched_topic_gets_the_last_value_too(latch: bool) -> None:
    async with joined("A") as a, joined("B") as b:
        publisher = a.start(hold).advertise("map", Encoder, latch=latch)
        first = b.start(hold, name="a").subscribe("map", Encoder)
        await publisher.wait_subscriber()
        await publisher.publish(Encoder(delta=4.0))
        assert await first.fetch(5.0) == Encoder(delta=4.0)
        await settle(2.0)
        second = b.start(hold, name="b").subscribe("map", Encoder)
        assert len(second.queue) == (1 if latch else 0)
        if latch:
            assert await second.fetch() == Encoder(delta=4.0)
        assert not first.queue
        publisher.close()
        await settle(2.0)
        third = b.start(hold, name="c").subscribe("map", Encoder)
        await settle(2.0)
        assert not third.queue


@pytest.mark.virtual_time
async def test_latch_again_when_the_subscribers_module_reboots() -> None:
    got: list[Encoder] = []

    async def reader(node: r2p.Node) -> None:
        await collect(node.subscribe("map", Encoder), got)

    async with joined("A") as a, joined("B") as b:
        publisher = a.start(hold).advertise("map", Encoder, latch=True)
        b.start(reader)
        await publisher.publish(Encoder(delta=4.0))
        await settle(2.0)
        assert len(got) == 1
        a.command(r2p.Command.REBOOT, "B")
        await settle(2.0)
        assert len(got) == 2
        assert b.rebooted
