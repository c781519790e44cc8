"""Nodes: spin, every, remapping, logging, and what is left when a node has ended: nothing."""

from __future__ import annotations

import asyncio
import logging
import sys
from pathlib import Path
from typing import Annotated, Any

import pytest

import r2p
from r2p.msg import Led, Log
from tests.bench import MS, crashes, hold, joined, led, local, numbers, settle

# Spin


@pytest.mark.virtual_time
async def test_spin_serves_callbacks_and_says_false_on_time_out() -> None:
    got: list[tuple[str, int]] = []
    served = []

    async def spinner(node: r2p.Node) -> None:
        node.subscribe("a", Led, lambda message: got.append(("a", message.led)))

        async def slow(message: Led) -> None:
            await asyncio.sleep(0.1)
            got.append(("b", message.led))

        node.subscribe("b", Led, slow)
        iterated = node.subscribe("c", Led)
        for _ in range(4):
            yes = await node.spin(1.0)
            served.append((yes, node.now()))
        assert len(iterated.queue) == 1

    async with local() as module:
        module.start(spinner)
        start = module.space.clock.now()
        node = module.start(hold)
        a, b, c = (node.advertise(topic, Led) for topic in "abc")
        await a.wait_subscriber()
        await c.publish(led(9))
        await settle(0.5)
        await a.publish(led(1))
        await b.publish(led(2))
        await settle(0.5)
        await a.publish(led(3))
        await settle(3.0)
        assert got == [("a", 1), ("b", 2), ("a", 3)]
        assert [yes for yes, _ in served] == [True, True, False, False]
        assert [(at - start) // MS for _, at in served] == pytest.approx([600, 1000, 2000, 3000], abs=2)


@pytest.mark.virtual_time
async def test_what_a_node_of_ros_has_says_what_to_write_here() -> None:
    async with local() as module:
        node: Any = module.start(hold)
        with pytest.raises(AttributeError, match=r"no create_publisher: write `node.advertise\(topic, type\)`"):
            node.create_publisher(Led, "leds", 10)
        with pytest.raises(AttributeError, match=r"a node has no subscrib$"):
            node.subscrib("leds", Led)


@pytest.mark.virtual_time
async def test_spin_needs_a_callback() -> None:
    async with local() as module:
        node = module.start(hold)
        node.subscribe("a", Led)
        with pytest.raises(r2p.Error, match="node hold spins without a callback: give subscribe"):
            await node.spin()


@pytest.mark.virtual_time
async def test_what_a_callback_raises_comes_out_of_spin() -> None:
    async with local() as module:
        node = module.start(hold)
        leds = node.subscribe("a", Led, lambda message: 1 // message.led)
        publisher = node.advertise("a", Led)
        for number in (0, 5):
            await publisher.publish(led(number))
        with pytest.raises(ZeroDivisionError):
            await node.spin()
        assert len(leds.queue) == 1
        assert await node.spin()


@pytest.mark.virtual_time
async def test_messages_that_wait_for_a_node_that_does_not_spin_are_a_warning(
    caplog: pytest.LogCaptureFixture,
) -> None:
    got: list[Led] = []

    async def deaf(node: r2p.Node) -> None:
        node.subscribe("silent", Led, print)
        node.subscribe("leds", Led, got.append)
        await asyncio.sleep(10.0)
        await node.spin()
        await asyncio.sleep(10.0)

    async with local() as module:
        module.start(deaf)
        publisher = module.start(hold).advertise("leds", Led)
        await settle(3.5)
        assert warnings(caplog) == []  # nothing waits yet
        await publisher.publish(led(1))
        await settle(2.0)
        text = "node deaf does not call spin(): messages on leds wait for its callbacks; write "
        assert warnings(caplog) == [text + "`while True: await node.spin()`"]
        await settle(5.0)
        assert got == [led(1)]
        await publisher.publish(led(2))
        await module.nodes["deaf"].stop()
        assert len(warnings(caplog)) == 1  # once


@pytest.mark.virtual_time
@pytest.mark.parametrize("spins", [False, True])
async def test_callbacks_of_a_node_that_returns_without_spin_are_a_warning(
    spins: bool, caplog: pytest.LogCaptureFixture
) -> None:
    async def short(node: r2p.Node) -> None:
        node.subscribe("leds", Led, print)
        node.subscribe("other", Led)
        if spins:
            await node.spin(0.1)

    async with local() as module:
        module.start(short)
        await module.wait()
    text = "node short does not call spin(): it has returned, so its callbacks for leds were never called; write "
    assert warnings(caplog) == ([] if spins else [text + "`while True: await node.spin()`"])


def warnings(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [each.getMessage() for each in caplog.records if each.levelno == logging.WARNING]


@pytest.mark.virtual_time
async def test_a_callback_may_close_its_subscription() -> None:
    async with local() as module:
        node = module.start(hold)
        got = []

        def once(message: Led) -> None:
            got.append(message)
            leds.close()

        leds = node.subscribe("a", Led, once)
        node.subscribe("b", Led, got.append)
        publisher = node.advertise("a", Led)
        for number in range(3):
            await publisher.publish(led(number))
        assert await node.spin(1.0)
        assert not await node.spin(1.0)
        assert numbers(got) == [0]


@pytest.mark.virtual_time
async def test_the_time_out_of_a_subscription_ends_a_spin() -> None:
    async with local() as module:
        node = module.start(hold)
        leds = node.subscribe("a", Led, lambda message: None, timeout=0.5)
        assert not await node.spin()
        assert leds.timeouts == 1
        assert leds._sink.waiter is None


@pytest.mark.virtual_time
async def test_a_cancelled_spin_loses_no_message() -> None:
    async with local() as module:
        node = module.start(hold)
        got: list[Led] = []
        leds = node.subscribe("a", Led, got.append)
        publisher = node.advertise("a", Led)
        for turns in range(6):
            spinning = asyncio.create_task(node.spin())
            await settle()
            publisher.publish_nowait(led(turns))
            for _ in range(turns):
                await asyncio.sleep(0)
            spinning.cancel()
            await asyncio.wait([spinning])
            assert leds._sink.waiter is None
        await node.spin()
        assert numbers(got) == list(range(6))


# Every


@pytest.mark.virtual_time
async def test_every_ticks_on_absolute_phase_and_counts_what_a_slow_body_skips() -> None:
    async with local() as module:
        node = module.start(hold)
        ticks = []
        start = module.space.clock.monotonic()
        async for tick in node.every(0.1):
            ticks.append(((tick.due - start) // MS, round(tick.late, 6), tick.skipped))
            if len(ticks) == 2:
                await asyncio.sleep(0.36)
            if len(ticks) == 6:
                break
        assert ticks == [(100, 0, 0), (200, 0, 0), (500, 0.06, 2), (600, 0, 0), (700, 0, 0), (800, 0, 0)]


def open_files() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


@pytest.mark.skipif(sys.platform != "linux", reason="counts file descriptors")
@pytest.mark.anyio
async def test_no_ticker_outlives_its_node() -> None:
    async def broken(node: r2p.Node) -> None:
        ticks = node.every(0.001)  # what was raised keeps it alive
        async for _ in ticks:
            raise ValueError

    async def short(node: r2p.Node) -> None:
        async for _ in node.every(0.001):
            return

    async def cancelled(node: r2p.Node) -> None:
        async for _ in node.every(0.001):
            await asyncio.Event().wait()

    async def main() -> None:
        async with local() as module:
            before = open_files()
            for function in (broken, short):
                module.start(function, name=function.__name__)
            await module.wait()
            module.start(cancelled, name="late")
            await asyncio.sleep(0)
            await asyncio.sleep(0)
            await module.nodes["late"].stop()
            assert open_files() <= before  # what another test has left may be gone meanwhile

    assert len(await crashes(main)) == 1


# Names


@pytest.mark.virtual_time
async def test_names_are_checked() -> None:
    async with local() as module:
        node = module.start(hold)
        with pytest.raises(r2p.NameTooLong, match=r"topic name 'a/a/.*\.\.\. has 257 characters, at most 255"):
            node.advertise("a/" * 128 + "a", Led)
        with pytest.raises(r2p.InvalidName):
            node.subscribe("not a topic", Led)
        assert node.advertise("/leds", Led).topic == "leds"  # as in the thesis


@pytest.mark.virtual_time
async def test_remapping_of_a_module_and_of_a_node() -> None:
    async with r2p.Module("PC1", via=[], remap={"encoder": "enc0", "/odo": "odo0"}) as module:
        one = module.start(hold, name="one")
        two = module.start(hold, name="two", remap={"encoder": "enc2"})
        assert [node.subscribe("encoder", Led).topic for node in (one, two)] == ["enc0", "enc2"]
        assert [node.advertise("odo", Led).topic for node in (one, two)] == ["odo0", "odo0"]
        assert one.subscribe("other", Led).topic == "other"
        with pytest.raises(r2p.NameTooLong):
            module.start(hold, name="three", remap={"encoder": "long" * 64})
    with pytest.raises(r2p.InvalidName):
        r2p.Module("PC1", via=[], remap={"encoder": ""})


# Logging


@pytest.mark.virtual_time
async def test_a_node_logs_under_its_own_name_and_on_the_topic_log(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    async with local() as module:
        node, other = module.start(hold, name="arm"), module.start(hold, name="watch")
        records = other.subscribe("log", Log)
        await settle(1.0)
        node.log.debug("hidden")
        node.log.info("at %d%%", 50)
        message = await records.fetch(1.0)
        stamp = r2p.Timestamp.from_ns(node.now())
        assert message == Log(stamp=stamp, level=20, module="PC1", node="arm", text="at 50%")
        assert not records.queue
    record = next(each for each in caplog.records if each.getMessage() == "at 50%")
    assert (record.name, record.funcName) == (
        "r2p.PC1.arm",
        "test_a_node_logs_under_its_own_name_and_on_the_topic_log",
    )


@pytest.mark.virtual_time
async def test_an_exception_is_logged_with_its_traceback() -> None:
    async with local() as module:
        node, other = module.start(hold, name="arm"), module.start(hold, name="watch")
        records = other.subscribe("log", Log, queue=100)
        try:
            raise ValueError("stuck")
        except ValueError as error:
            node.log.exception("first")
            node.log.error("second", exc_info=error)
            node.log.error("third", exc_info=sys.exc_info())
        node.log.error("fourth", exc_info=True)  # there is none
        texts = [Log.decode(sample.data).text for sample in records.queue]
        assert texts.count("ValueError: stuck") == 3
        assert [text for text in texts if text in {"first", "second", "third", "fourth"}] == [
            "first",
            "second",
            "third",
            "fourth",
        ]
        assert texts[1] == "Traceback (most recent call last):"


# The end


@pytest.mark.virtual_time
async def test_a_node_that_has_ended_takes_no_topics() -> None:
    async def short(node: r2p.Node) -> None:
        pass

    async with local() as module:
        node = module.start(short)
        await module.wait()
        assert node.closed
        with pytest.raises(r2p.Closed, match="node short has ended: it can't use topic leds any more"):
            node.subscribe("leds", Led)
        with pytest.raises(r2p.Closed):
            node.advertise("leds", Led)


@pytest.mark.virtual_time
async def test_a_node_forgets_what_is_closed() -> None:
    async with local() as module:
        node = module.start(hold)
        users = [use("leds", Led) for _ in range(3) for use in (node.advertise, node.subscribe)]
        for user in users:
            user.close()
        assert (list(node.publishers), list(node.subscribers)) == ([], [])


@pytest.mark.virtual_time
async def test_all_that_a_node_opened_is_closed_however_it_ends() -> None:
    async def opens(node: r2p.Node, how: str) -> None:
        node.advertise("a", Led)
        node.advertise("b", Led, r2p.Sporadic(1.0))
        node.advertise("c", Led, r2p.Periodic(1.0, Led))
        node.subscribe("d", Led)
        node.subscribe("e", Led, print, timeout=1.0, on_timeout=print)
        if how == "raises":
            raise ValueError
        if how == "is cancelled":
            await asyncio.Event().wait()

    async def main() -> None:
        async with joined("A") as module:
            for how in ("returns", "raises", "is cancelled"):
                node = module.start(opens, how, name="n")
                await settle(1.5)
                await module.nodes["n"].stop()
                assert node.closed
                assert list(module.space.topics) == ["log"]

    assert len(await crashes(main)) == 1


@pytest.mark.virtual_time
async def test_the_management_topic_is_not_for_nodes() -> None:
    async with local() as module:
        node = module.start(hold)
        with pytest.raises(r2p.InvalidName, match="R2P is reserved for messages of r2p"):
            node.advertise("R2P", Led)
        with pytest.raises(r2p.InvalidName):
            node.subscribe("/R2P", None)


@pytest.mark.virtual_time
async def test_a_node_of_periodic_publishers_spins() -> None:
    async with local() as module:
        node = module.start(hold)
        publisher = node.advertise("a", Led, r2p.Periodic(0.1, Led))
        assert not await node.spin(timeout=1.05)
        assert publisher.sent == 10


@pytest.mark.virtual_time
async def test_a_spin_that_waits_serves_a_subscription_that_a_handler_makes(caplog: pytest.LogCaptureFixture) -> None:
    got: list[int] = []

    async def spinner(node: r2p.Node) -> None:
        async def open_topic(_request: Led) -> Led:
            node.subscribe("a", Led, lambda message: got.append(message.led))
            return Led()

        node.serve("open", Led, Led, open_topic)
        while True:
            await node.spin()

    async with local() as module:
        module.start(spinner)
        node = module.start(hold)
        await node.client("open", Led, Led).call(Led())
        await node.advertise("a", Led).publish(led(7))
        await asyncio.sleep(3.0)  # the reminder of a node that does not spin comes after two
    assert got == [7]
    assert "spin()" not in caplog.text


# Links that can't carry a type


class Blob(r2p.Message):
    data: Annotated[bytes, r2p.Len(2000)] = bytes(2000)


class Text(r2p.Message):
    text: Annotated[str, r2p.Max(2000)] = ""


@pytest.mark.virtual_time
async def test_links_that_do_not_carry_a_type_or_its_longest_messages_are_named(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async with r2p.Module("A", via=["sim:bus", "memory:lab"]) as module:
        node = module.start(hold)
        for cls in (Blob, Text):
            node.advertise(f"{cls.__name__}1", cls)
            node.subscribe(f"{cls.__name__}2", cls)
        blob = "2000 bytes, and it carries at most 1024 in a message"
        text = "up to 2004 bytes, and it carries at most 1020 in a message"
        assert warnings(caplog) == [
            f"topic Blob1 is not sent on link sim:bus: {blob}",
            f"topic Blob2 can't be received on link sim:bus: {blob}",
            f"topic Text1: link sim:bus can't carry its longest messages ({text}); they are counted as too long",
            f"topic Text2: link sim:bus can't carry its longest messages ({text}); they are counted as too long",
        ]
        with pytest.raises(r2p.TransportError, match="topic Text3 on link sim:bus: up to 2004 bytes"):
            node.advertise("Text3", Text, strict=True)
