"""Modules: opening and closing in order, starting nodes, events, two modules with one name."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import logging
import socket
import weakref
from typing import TYPE_CHECKING, Any

import pytest

import r2p
from r2p.codecs.management import ROLE_PUBLISHES
from r2p.modules.nodes import CLEANUP_WARNING_AFTER
from r2p.msg import Encoder, Led, Log, Odometry
from r2p.protocols.discovery.events import Mismatched, NameConflict, TopicType
from r2p.runtime.events import EVENTS
from r2p.transports.link import Transport
from r2p.transports.memory import network
from tests.bench import collect, crashes, hold, joined, led, local, settle

if TYPE_CHECKING:
    from collections.abc import Callable

    from r2p.transports.link import Hub

# Opening


def test_the_default_name_comes_from_the_host_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket, "gethostname", lambda: "lab-pc-17.example.org")
    assert r2p.Module().name == "labpc17"
    assert r2p.Module("GW").name == "GW"
    with pytest.raises(r2p.NameTooLong, match=r"module name 'G{65}' has 65 characters, at most 64"):
        r2p.Module("G" * 65)


@pytest.mark.virtual_time
async def test_where_the_links_come_from(monkeypatch: pytest.MonkeyPatch) -> None:
    async def links(**arguments: Any) -> list[str]:
        async with r2p.Module("PC1", **arguments) as module:
            return [link.name for link in module.links]

    monkeypatch.delenv("R2P_VIA", raising=False)
    assert await links() == []
    monkeypatch.setenv("R2P_VIA", "memory:a  memory:b")
    assert await links() == ["memory:a", "memory:b"]
    assert await links(via="memory:c") == ["memory:c"]
    assert await links(via=["memory:c", "memory:d"]) == ["memory:c", "memory:d"]
    assert await links(via=[]) == []


@pytest.mark.virtual_time
async def test_a_module_is_opened_once() -> None:
    module = local()
    with pytest.raises(r2p.Closed, match="module PC1 is not open: use it in an `async with` block"):
        module.start(hold)
    with pytest.raises(r2p.Closed):
        await module.reboot()
    with pytest.raises(r2p.Closed, match="use it in an `async with` block"):
        module.query()
    with pytest.raises(r2p.Closed):
        module.command(r2p.Command.STOP, "IMU1")
    with pytest.raises(r2p.Closed):
        module.network.modules()
    with pytest.raises(r2p.Closed):
        module.network.topics()
    async with module:
        with pytest.raises(r2p.Error, match="was opened before"):
            await module.__aenter__()
    with pytest.raises(r2p.Closed):
        module.start(hold)
    with pytest.raises(r2p.Error, match="module PC1 was opened before: make a new one"):
        await module.__aenter__()


class Wrong(Transport):
    """Fails: at once, or some time after it was opened."""

    def __init__(self, error: Exception, *, after: float | None = None) -> None:
        self._error = error
        self._after = after

    async def run(self, hub: Hub, opened: Callable[[], object]) -> None:
        if self._after is not None:
            opened()
            await asyncio.sleep(self._after)
        raise self._error


@pytest.mark.virtual_time
@pytest.mark.parametrize("via", [["memory:lab", "none:x"], ["memory:lab", Wrong(r2p.TransportError("in use"))]])
async def test_a_transport_that_can_not_work_is_an_error_at_once(via: list[str | Transport]) -> None:
    module = r2p.Module("PC1", via=via)
    with pytest.raises(r2p.TransportError, match=r"unknown transport 'none'|in use"):
        await module.__aenter__()
    assert module.links == []
    assert len(asyncio.all_tasks()) == 1


@pytest.mark.anyio
async def test_a_transport_that_can_not_work_in_real_time() -> None:
    with pytest.raises(r2p.TransportError, match="in use"):
        await r2p.Module("PC1", via=Wrong(r2p.TransportError("in use"))).__aenter__()


@pytest.mark.virtual_time
async def test_a_transport_that_fails_later_ends_the_module() -> None:
    ended = []

    async def node(node: r2p.Node) -> None:
        try:
            await asyncio.Event().wait()
        finally:
            ended.append(node.name)

    async def main() -> None:
        async with r2p.Module("PC1", via=Wrong(r2p.Broken("bus fell apart"), after=1.0)) as module:
            module.start(node)
            await module.wait()

    with pytest.raises(r2p.Broken, match="bus fell apart"):
        await main()
    assert ended == ["node"]


# Nodes


@pytest.mark.virtual_time
async def test_start_runs_a_function_with_its_arguments() -> None:
    got = []

    async def blink(node: r2p.Node, *args: object) -> None:
        got.append((node.name, node.module, node.priority, args))

    async with local() as module:
        module.start(blink, 1, "two", priority=3)
        module.start(blink, name="other")
        await module.wait()
    assert got == [("blink", "PC1", 3, (1, "two")), ("other", "PC1", 0, ())]


@pytest.mark.virtual_time
async def test_what_start_refuses() -> None:
    async def much_too_long(node: r2p.Node) -> None:
        pass

    def plain(node: r2p.Node) -> None:
        pass

    async with local() as module:
        module.start(hold)
        with pytest.raises(r2p.Error, match=r"module PC1 already has a node hold: give this one another name \(name="):
            module.start(hold)
        much_too_long.__name__ = "much_" + "too_" * 15 + "long"
        with pytest.raises(r2p.NameTooLong, match=r"has 69 characters.* pass name='much_(too_)*too'"):
            module.start(much_too_long)
        with pytest.raises(r2p.NameTooLong):
            module.start(hold, name="long" * 17)
        with pytest.raises(r2p.InvalidName):
            module.start(hold, name="a/b")
        with pytest.raises(r2p.Error, match="is not a coroutine function: write `async def plain"):
            module.start(plain)  # type: ignore[arg-type]
        assert list(module.nodes) == ["hold"]


@pytest.mark.virtual_time
async def test_wait_waits_for_all_nodes() -> None:
    async with local() as module:
        for seconds in (1.0, 3.0, 2.0):
            module.start(lambda_sleep, seconds, name=f"n{seconds:.0f}")
        await module.wait()
        assert module.space.loop.time() == 3.0
        await module.wait()


async def lambda_sleep(node: r2p.Node, seconds: float) -> None:
    await asyncio.sleep(seconds)


@pytest.mark.virtual_time
async def test_closing_ends_nodes_before_links_and_waits_for_their_clean_up() -> None:
    got = []

    async def motor(node: r2p.Node) -> None:
        commands = node.advertise("cmd", Led)
        try:
            await asyncio.Event().wait()
        finally:
            await asyncio.sleep(CLEANUP_WARNING_AFTER + 1.0)
            await commands.publish(led(0))

    async with joined("B") as other:
        commands = other.start(hold).subscribe("cmd", Led)
        async with joined("A") as module:
            module.start(motor)
            await commands.wait_publisher()
            await settle(1.0)
        assert module.links == []
        got.append(await commands.fetch(1.0))
    assert got == [led(0)]


@pytest.mark.virtual_time
async def test_clean_up_that_takes_long_is_logged_and_waited_for(caplog: pytest.LogCaptureFixture) -> None:
    async def slow(node: r2p.Node) -> None:
        try:
            await asyncio.Event().wait()
        finally:
            await asyncio.sleep(10.0)
            ended.append(node.name)

    ended: list[str] = []
    async with local() as module:
        module.start(slow)
        await settle(1.0)
        stopping = asyncio.create_task(module.stop())
        await settle(CLEANUP_WARNING_AFTER + 0.5)
        assert "module PC1 waits for the clean-up of PC1/slow" in caplog.text
    assert ended == ["slow"]
    await stopping


@pytest.mark.virtual_time
async def test_nothing_is_left_of_a_closed_module() -> None:
    async def chatter(node: r2p.Node) -> None:
        leds = node.subscribe("leds", Led, timeout=5.0, on_timeout=print)
        publisher = node.advertise("leds", Led, r2p.Sporadic(1.0), latch=True)
        async for _ in node.every(0.1):
            await publisher.publish(led(1))
            await leds.fetch()

    async with joined("A") as module:
        module.start(chatter)
        await settle(3.0)
    held = [weakref.ref(each) for each in (module, module.space, module.network, module.nodes["chatter"].node)]
    del module
    gc.collect()
    assert [each() for each in held] == [None] * 4


# Events


@pytest.mark.virtual_time
async def test_events_from_the_call_on_until_the_module_closes() -> None:
    async with joined("A") as module:
        link: Any = module.links[0]
        events, unused = module.events(), module.events()
        link.on_down("cut")
        await settle(2.0)
        link.on_up()
        got: list[r2p.ModuleEvent] = []
        async for event in events:
            got.append(event)
            if len(got) == 2:
                break
        assert got[0] == r2p.LinkDown("memory:lab", "cut")
        assert isinstance(got[1], r2p.LinkUp)
        assert got[1].outage == pytest.approx(2.0, abs=1e-3)
        del unused
        later: list[r2p.ModuleEvent] = []
        listening = asyncio.create_task(collect(module.events(), later))
        await settle()
        for _ in range(3):
            link.on_down("cut")
            link.on_up()
        await settle()
        assert [type(event).__name__ for event in later] == ["LinkDown", "LinkUp"] * 3
        flooded = module.events()
        for _ in range(EVENTS):
            link.on_down("cut")
            link.on_up()
    await listening
    assert len([event async for event in flooded]) == EVENTS


@pytest.mark.virtual_time
async def test_both_of_two_modules_with_one_name_report_it(caplog: pytest.LogCaptureFixture) -> None:
    one, other = joined("A"), joined("A")
    events = one.events(), other.events()
    async with one, other:
        await settle(3.0)
    for stream in events:
        conflicts = [event async for event in stream if isinstance(event, NameConflict)]
        assert conflicts[0].module == "A"
        assert {conflicts[0].instance_a, conflicts[0].instance_b} == {one.instance, other.instance}
    assert caplog.text.count("two modules carry the name A: rename one") >= 2


@pytest.mark.virtual_time
async def test_modules_with_one_name_on_two_links_are_reported_by_the_module_between_them() -> None:
    async with (
        r2p.Module("A", via="memory:left") as one,
        r2p.Module("A", via="memory:right") as other,
        r2p.Module("M", via=["memory:left", "memory:right"]),
    ):
        events = one.events(), other.events()
        await settle(3.0)
    for stream in events:
        assert [event.module async for event in stream if isinstance(event, NameConflict)]


@pytest.mark.virtual_time
async def test_types_that_differ_again_and_again_are_logged_once_a_second(caplog: pytest.LogCaptureFixture) -> None:
    async with joined("A") as a:
        for _ in range(3):
            for size in (9, 10):
                event = Mismatched("leds", None, ROLE_PUBLISHES, TopicType(5), TopicType(size))
                a._opened.discovered(a.links[0], event)
            await settle(1.0)
    lines = [record.getMessage() for record in caplog.records if "topic leds is refused" in record.getMessage()]
    assert [line.endswith(" (1 more since the last such line)") for line in lines] == [False, True, True]


@pytest.mark.virtual_time
async def test_a_module_that_comes_back_on_another_link_is_no_namesake() -> None:
    async with r2p.Module("M", via=["memory:left", "memory:right"]) as hub:
        events = hub.events()
        async with r2p.Module("A", via="memory:left") as first:
            await settle(3.0)
            network("left").loss = 1.0
            async with r2p.Module("A", via="memory:right"):
                assert first.links[0].up
                await settle(3.0)
    assert not [event async for event in events if isinstance(event, NameConflict)]


@pytest.mark.virtual_time
async def test_another_layout_is_refused_and_both_sides_report_it(caplog: pytest.LogCaptureFixture) -> None:
    async with joined("A") as a, joined("B") as b:
        events = a.events(), b.events()
        publisher = a.start(hold).advertise("leds", Led)
        leds = b.start(hold).subscribe("leds", Encoder)
        await settle(3.0)
        await publisher.publish(led(1))
        await settle(1.0)
        assert not leds.queue
        with pytest.raises(TimeoutError, match=r"within 1 s; others publish messages of 5 bytes, "):
            await leds.fetch(timeout=1)
        assert (a.network.topics()["leds"].mismatch, b.network.topics()["leds"].mismatch) == (True, True)
    for stream in events:
        assert [event.topic async for event in stream if isinstance(event, Mismatched)] == ["leds"]
    assert "topic leds is refused: others publish messages of 5 bytes" in caplog.text
    assert "use one message type on both sides, or another topic" in caplog.text


@pytest.mark.virtual_time
async def test_types_that_change_all_the_time_do_not_fill_the_log(caplog: pytest.LogCaptureFixture) -> None:
    async with joined("A") as a, joined("B") as b:
        events = a.events()
        a.start(hold).advertise("leds", Led)
        node = b.start(hold)
        for kind in (Encoder, Odometry) * 20:
            subscription = node.subscribe("leds", kind)
            await settle(0.05)
            subscription.close()
    refused = [event.topic async for event in events if isinstance(event, Mismatched)]
    assert len(refused) > 20
    logged = [text for text in caplog.messages if "topic leds is refused" in text]
    assert 0 < len(logged) <= 4  # it takes 2 s, on two links


# Observers


@pytest.mark.virtual_time
async def test_an_observer_sends_no_alive_and_has_no_log_topic() -> None:
    async with joined("A") as a, r2p.Module("_abc123", via="memory:lab", observer=True) as tool:
        leds = tool.start(hold).subscribe("leds", Led)
        publisher = a.start(hold).advertise("leds", Led)
        await publisher.wait_subscriber()
        await publisher.publish(led(1))
        assert await leds.fetch(1.0) == led(1)
        assert "log" not in tool.space.topics
        assert a.links[0].discovery.modules["_abc123"].observer
        views = {view.name: view.state for view in a.network.modules()}
        assert views == {"A": "running", "_abc123": "observer"}


@pytest.mark.virtual_time
async def test_the_modules_log_topic_is_seen_from_outside() -> None:
    async with joined("A") as a, joined("B") as b:
        records = b.start(hold).subscribe("log", Log)
        node = a.start(hold, name="arm")
        await settle(3.0)
        node.log.log(logging.WARNING, "too hot")
        record = await records.fetch(1.0)
        assert (record.node, record.text) == ("arm", "too hot")
        samples = records.samples()
        node.log.warning("still")
        assert (await anext(samples)).source.module == "A"


@pytest.mark.virtual_time
async def test_crashes_do_not_disturb_links() -> None:
    async def broken(node: r2p.Node) -> None:
        node.advertise("a", Led)
        raise ValueError

    async def main() -> None:
        async with joined("A") as a, joined("B") as b:
            leds = b.start(hold).subscribe("leds", Led)
            publisher = a.start(hold).advertise("leds", Led)
            a.start(broken)
            await publisher.wait_subscriber()
            await publisher.publish(led(1))
            assert await leds.fetch(1.0) == led(1)

    assert len(await crashes(main)) == 1


@pytest.mark.virtual_time
async def test_a_module_that_closes_before_its_nodes_run_says_so(caplog: pytest.LogCaptureFixture) -> None:
    async def ran(node: r2p.Node) -> None:
        await asyncio.Event().wait()

    async with r2p.Module("PC1") as module:
        module.start(ran)
        await asyncio.sleep(0)
    assert not caplog.messages
    async with r2p.Module("PC1") as module:
        module.start(ran)
        module.start(ran, name="other")
    (text,) = caplog.messages
    assert text == "module PC1 closed before ran, other ran: end its `async with` block with `await module.wait()`"
    with contextlib.suppress(LookupError):
        async with r2p.Module("PC1") as module:
            module.start(ran)
            raise LookupError
    assert caplog.messages == [text]
