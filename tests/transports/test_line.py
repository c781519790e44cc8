"""The debug line's link by itself, under virtual time: what waits, what overtakes, what is thrown away."""

import asyncio
import contextlib
import logging
import re
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from types import SimpleNamespace
from typing import Annotated, Any, Literal

import pytest

import r2p
from r2p.codecs import debug
from r2p.codecs import management as m
from r2p.msg import Led, Text
from r2p.testing.network import node_in
from r2p.transports.line import BUFFER
from tests.transports.conversation import Script, line, manage

pytestmark = pytest.mark.virtual_time

SUBSCRIBE = m.SubscribeRequest("leds", 5, 1)
ORDERS = (m.Stop, m.Reboot, m.Bootload)


@asynccontextmanager
async def scripted() -> AsyncIterator[tuple[Script, r2p.Module, r2p.Node]]:
    script = Script()
    async with r2p.Module("PC1", via=script) as module, node_in(module) as node:
        yield script, module, node


def said(script: Script) -> list[str]:
    """The topics in order; on `R2P` the kinds of messages."""
    return [type(each.management).__name__ if each.topic == "R2P" else each.topic for each in script.said]


async def test_a_person_at_a_terminal_is_understood() -> None:
    """With a line end of any kind, lower-case digits and what a terminal program says before."""
    async with scripted() as (script, _, node):
        subscriber = node.subscribe("leds", Led)
        response = manage(m.SubscribeResponse("leds", 5, 1)).strip()
        message = line("leds", Led(led=3, value=0xAB).encode()).strip().lower()
        script.hear(b"AT\r\n" + response + b"\n\xff" + message + b"\r")
        assert await subscriber.fetch(timeout=1) == Led(led=3, value=0xAB)
        assert script.link.losses == {"garbage": 2}


async def test_a_stop_overtakes_all_that_waits() -> None:
    async with scripted() as (script, module, node):
        publisher = node.advertise("leds", Led)
        script.hear(manage(SUBSCRIBE))
        await asyncio.sleep(1)
        script.blocked = True
        await publisher.publish(Led())  # the carrier takes this one, and then no more
        script.said.clear()
        for _ in range(3):
            await publisher.publish(Led())
        script.hear(manage(SUBSCRIBE))
        module.command(r2p.Command.STOP, "IMU1")
        script.unblock()
        await asyncio.sleep(0)
        order = said(script)
        assert order[0] == "Stop"
        assert "SubscribeResponse" in order[1:]
        assert set(order[order.index("leds") :]) == {"leds"}
        assert len(script.topics("leds")) >= 3


async def test_orders_keep_their_order() -> None:
    """In one turn of the loop, and while the line takes no more."""
    orders = [("STOP", "A"), ("STOP", "B"), ("REBOOT", "B"), ("STOP", "C"), ("REBOOT", "C")]
    async with scripted() as (script, module, _):
        await asyncio.sleep(1)
        for blocked in False, True:
            script.said.clear()
            script.link._blocked = blocked
            for command, name in orders:
                module.command(r2p.Command[command], name)
            script.unblock()
            await asyncio.sleep(0)
            given = [each.management for each in script.said]
            assert [(type(each).__name__.upper(), each.module) for each in given if isinstance(each, ORDERS)] == orders


async def test_orders_that_wait_for_a_blocked_line_are_bounded() -> None:
    """They have a buffer of their own, so that announcements can't fill it."""
    async with scripted() as (script, module, _):
        await asyncio.sleep(1)
        script.blocked = True
        for _ in range(2000):
            script.hear(manage(m.SubscribeRequest("leds", 5, 1)))
            module.command(r2p.Command.STOP, "A")
        assert script.link._buffered_bytes < 20_000
        assert script.link.losses["management, send buffer full"] > 1800
        script.said.clear()
        script.unblock()
        await asyncio.sleep(0)
        assert 90 < sum(isinstance(each.management, m.Stop) for each in script.said) < 100
        script.blocked = True
        for _ in range(3):
            module.command(r2p.Command.STOP, "A")
        script.link.disconnect("broken")
        assert script.link.losses["orders not sent"] == 2  # the line had taken the first one


async def test_what_waits_for_a_blocked_line_is_bounded() -> None:
    missed: list[r2p.Missed] = []
    async with scripted() as (script, _, node):
        publisher = node.advertise("text", Text, r2p.NonRealTime(stall=0.01, on_missed=missed.append))
        script.hear(manage(m.SubscribeRequest("text", 64, 1)))
        await asyncio.sleep(1)
        script.blocked = True
        while not missed:
            await publisher.publish(Text())
        waiting = script.link._buffered_bytes
        assert BUFFER <= waiting < BUFFER + 200
        for _ in range(10):
            await publisher.publish(Text())
        assert script.link._buffered_bytes == waiting
        for _ in range(1000):
            script.hear(manage(m.SubscribeRequest("text", 64, 1)))
        assert script.link._buffered_bytes < BUFFER + 10_000
        losses = script.link.losses
        assert losses["send buffer full"] == 11
        assert losses["management, send buffer full"] > 800
        sent = script.link.stats.sent
        script.unblock()
        await asyncio.sleep(0)
        assert len(script.topics("text")) == sent


async def test_what_a_slow_line_does_not_get_is_missed_by_its_publisher(caplog: pytest.LogCaptureFixture) -> None:
    """With and without waiting, each once, however many others have it; the log tells the same number."""
    async with scripted() as (script, _, node):
        publisher = node.advertise("text", Text, r2p.NonRealTime(stall=0.01))
        kept = node.subscribe("text", Text, queue=1, lossy=True)
        script.hear(manage(m.SubscribeRequest("text", 64, 1)))
        await asyncio.sleep(1)
        script.blocked = True
        while not publisher.missed:
            await publisher.publish(Text())
        for _ in range(500):
            await publisher.publish(Text())
            assert not publisher.publish_nowait(Text())
        await asyncio.sleep(1)
        await publisher.publish(Text())
        assert publisher.missed == script.link.losses["send buffer full"] == 1002
        assert "(missed 1002, late 0 so far)" in caplog.text
        script.unblock()
        await asyncio.sleep(0)
        assert len(script.topics("text")) + publisher.missed == publisher.sent
        await publisher.publish(Text())
        assert publisher.missed == 1002
        assert kept.lost


async def test_one_turn_may_bring_more_than_the_buffer_holds() -> None:
    async with scripted() as (script, _, node):
        publisher = node.advertise("text", Text)
        script.hear(manage(m.SubscribeRequest("text", 64, 1, m.UNANSWERED)))
        assert all(publisher.publish_nowait(Text()) for _ in range(1000))
        await asyncio.sleep(0)
        assert len(script.topics("text")) == 1000


async def test_what_waited_when_the_line_broke_is_never_sent() -> None:
    """To firmware, whose subscription outlasts the break."""
    async with scripted() as (script, _, node):
        publisher = node.advertise("leds", Led)
        script.hear(manage(SUBSCRIBE))
        await asyncio.sleep(1)
        script.blocked = True
        for number in range(5):
            await publisher.publish(Led(led=number))
        sent = len(script.topics("leds"))
        script.link.disconnect("broken")
        await publisher.publish(Led(led=5))
        script.blocked = False
        await asyncio.sleep(10)
        script.link.connect(script)
        await publisher.publish(Led(led=6))
        await asyncio.sleep(0)
        assert script.topics("leds")[sent:] == [Led(led=6).encode()]
        assert script.link.stats.sent == sent + 1
        assert script.link.losses == {"link down": 6 - sent}


async def test_what_waits_for_a_new_connection_that_breaks_again_is_lost() -> None:
    """Firmware takes no data in the first 50 ms: what waits for them was never sent."""
    async with scripted() as (script, _, node):
        publisher = node.advertise("leds", Led)
        script.hear(manage(SUBSCRIBE))
        await asyncio.sleep(1)
        script.link.disconnect("broken")
        script.link.connect(script)
        publishing = asyncio.create_task(publisher.publish(Led()))
        await asyncio.sleep(0.01)
        script.link.disconnect("broken again")
        await publishing
        assert script.topics("leds") == []
        assert script.link.stats.sent == 0
        assert script.link.losses == {"link down": 1}


async def test_what_was_on_the_way_when_the_line_broke_is_unknown() -> None:
    async with scripted() as (script, _, node):
        publisher = node.advertise("leds", Led)
        script.hear(manage(SUBSCRIBE))
        await asyncio.sleep(1)
        for number in range(10):
            await publisher.publish(Led(led=number))
            await asyncio.sleep(0.001)
        script.unconfirmed = 2 * len(line("leds", Led().encode())) + 1
        script.link.disconnect("broken")
        assert script.link.losses == {"unknown at disconnect": 3}
        script.link.connect(script)
        script.unconfirmed = 5
        script.link.disconnect("broken again, before anything was sent")
        assert script.link.losses == {"unknown at disconnect": 3}


async def test_publishers_stop_waiting_for_a_line_that_breaks() -> None:
    """A message without a deadline as well as an event with one: both are lost, counted."""
    async with scripted() as (script, _, node):
        filler = node.advertise("text", Text, r2p.NonRealTime(stall=3600.0))
        events = node.advertise("leds", Led, r2p.Sporadic(3600.0))
        script.hear(manage(m.SubscribeRequest("text", 64, 1)) + manage(SUBSCRIBE))
        await asyncio.sleep(1)
        script.blocked = True
        flood = asyncio.create_task(_flood(filler))
        await asyncio.sleep(1)
        stalled = filler.sent
        assert not events.publish_nowait(Led())
        held = len(script.link._samples)
        script.link.disconnect("broken")
        assert script.link.losses["link down"] == held + 2
        await asyncio.sleep(0)
        flood.cancel()
        assert filler.sent > stalled


async def test_events_never_wait_behind_a_blocked_line() -> None:
    """Their publisher keeps them, and they go first; those of NRT publishers keep their order behind them."""
    signals: list[r2p.Missed] = []
    async with scripted() as (script, _, node):
        bulk = node.advertise("text", Text)
        klass = r2p.Sporadic(0.5, on_missed=signals.append, on_late=signals.append)
        events = [node.advertise("leds", Led, klass), node.advertise("leds", Led, klass)]
        script.hear(manage(m.SubscribeRequest("text", 64, 1)) + manage(SUBSCRIBE))
        await asyncio.sleep(1)
        script.blocked = True
        flood = asyncio.create_task(_flood(bulk))
        await asyncio.sleep(0.5)
        script.said.clear()
        for number in range(6):
            assert not events[number % 2].publish_nowait(Led(led=number))
        await asyncio.sleep(0.4)
        script.unblock()
        assert script.topics("leds") == [Led(led=number).encode() for number in range(6)]
        assert said(script)[:6] == ["leds"] * 6
        flood.cancel()
        assert not signals


async def test_an_event_overtakes_what_waits_for_the_end_of_the_turn() -> None:
    async with scripted() as (script, _, node):
        bulk, event = node.advertise("text", Text), node.advertise("leds", Led, r2p.Sporadic(0.5))
        script.hear(manage(m.SubscribeRequest("text", 64, 1)) + manage(SUBSCRIBE))
        await asyncio.sleep(0.9)
        script.said.clear()
        for _ in range(3):
            bulk.publish_nowait(Text())
        event.publish_nowait(Led())
        event.publish_nowait(Led())
        await asyncio.sleep(0)
        assert said(script) == ["text", "leds", "leds", "text", "text"]


@pytest.mark.parametrize(("late", "sent"), [("drop", []), ("send", [Led(led=2).encode()])])
async def test_an_event_that_a_line_does_not_take_in_time_is_late(
    late: Literal["drop", "send"], sent: list[bytes]
) -> None:
    missed: list[r2p.Missed] = []
    told: list[r2p.Missed] = []
    async with scripted() as (script, _, node):
        event = node.advertise("leds", Led, r2p.Sporadic(0.1, late=late, on_missed=missed.append, on_late=told.append))
        script.hear(manage(SUBSCRIBE))
        await asyncio.sleep(1)
        script.blocked = True
        await event.publish(Led(led=1))  # the line takes this one, slowly, and then no more
        await asyncio.sleep(0.05)
        script.said.clear()
        await event.publish(Led(led=2))
        await asyncio.sleep(1)
        script.unblock()
        await asyncio.sleep(1)
        assert script.topics("leds") == sent
        first = r2p.Missed("leds", "sent late", where="script", late=0.95)
        second = r2p.Missed("leds", "no room by the deadline", where="script")
        assert missed == ([second] if late == "drop" else [])
        assert told == ([first] if late == "drop" else [second, first])
        assert (event.missed, event.late) == (len(missed), len(told))


async def test_an_event_that_a_line_had_begun_to_send_when_it_broke_is_missed() -> None:
    missed: list[r2p.Missed] = []
    async with scripted() as (script, _, node):
        event = node.advertise("leds", Led, r2p.Sporadic(0.1, on_missed=missed.append))
        script.hear(manage(SUBSCRIBE))
        await asyncio.sleep(1)
        await event.publish(Led())
        script.blocked = True
        await asyncio.sleep(1)
        await event.publish(Led())
        script.link.disconnect("broken")
        assert missed == [r2p.Missed("leds", "link down", where="script")]
        assert (script.link.stats.sent, script.link.losses["link down"]) == (1, 1)


async def test_a_period_waits_for_a_line_until_the_next_one() -> None:
    missed: list[r2p.Missed] = []
    late: list[r2p.Missed] = []
    values = iter([Led(led=number) for number in range(100)])
    async with scripted() as (script, _, node):
        klass = r2p.Periodic(1.0, values.__next__, on_missed=missed.append, on_late=late.append)
        state = node.advertise("leds", Led, klass)
        script.hear(manage(SUBSCRIBE))
        await asyncio.sleep(2.5)
        script.blocked = True
        script.link.carrier_full()
        await asyncio.sleep(0.7)  # at 3.2
        script.unblock()
        assert (missed, late) == ([], [])
        script.blocked = True
        script.link.carrier_full()
        await asyncio.sleep(2.6)  # at 5.8, when 3 has been sent
        script.unblock()
        assert script.topics("leds") == [Led(led=number).encode() for number in (0, 1, 2, 4)]
        assert missed == [r2p.Missed("leds", "no room", where="script")]
        assert late == [r2p.Missed("leds", "sent late", where="script", late=0.8)]
        assert (state.missed, state.late) == (1, 1)


async def test_what_a_line_that_is_down_does_not_get() -> None:
    """Each sample of a real-time publisher is missed; the link's end is signalled to the others."""
    missed: list[r2p.Missed] = []
    degraded: list[r2p.Missed] = []
    signals: dict[str, Any] = {"on_missed": missed.append, "on_degraded": degraded.append}
    async with scripted() as (script, _, node):
        event = node.advertise("event", Led, r2p.Sporadic(0.1, **signals))
        state = node.advertise("state", Led, r2p.Periodic(1.0, Led, **signals))
        text = node.advertise("text", Led, r2p.NonRealTime(**signals))
        script.hear(b"".join(manage(m.SubscribeRequest(topic, 5, 1)) for topic in ("event", "state", "text")))
        await asyncio.sleep(0.5)
        script.link.disconnect("broken")
        assert {each.topic for each in degraded} == {"event", "state", "text"}
        for _ in range(3):
            assert not event.publish_nowait(Led())
            assert text.publish_nowait(Led())
        await asyncio.sleep(2)
        down = [(each.topic, each.reason, each.where) for each in missed]
        assert down == [("event", "link down", "script")] * 3 + [("state", "link down", "script")] * 2
        assert (event.missed, state.missed, text.missed) == (3, 2, 0)
        assert script.link.losses["link down"] == 8


async def test_the_outage_is_reported() -> None:
    async with scripted() as (script, module, node):
        events = module.events()
        publisher = node.advertise("leds", Led)
        script.hear(manage(SUBSCRIBE))
        await asyncio.sleep(1)
        script.link.disconnect("broken")
        for _ in range(3):
            await publisher.publish(Led())
        await asyncio.sleep(2.5)
        script.link.connect(script)
        told = [await anext(events), await anext(events)]
        assert told == [r2p.LinkDown("script", "broken"), r2p.LinkUp("script", 2.5, 3)]


async def test_firmware_has_time_after_a_reconnect() -> None:
    """It drops what comes before its management thread has run; its subscription is still there."""
    async with scripted() as (script, _, node):
        leds, event = node.advertise("leds", Led), node.advertise("event", Led, r2p.Sporadic(deadline=0.2))
        script.hear(manage(SUBSCRIBE) + manage(m.SubscribeRequest("event", 5, 1)))
        await asyncio.sleep(1)
        for _ in range(2):
            script.link.disconnect("broken")
            await asyncio.sleep(10)
            script.said.clear()
            script.link.connect(script)
            connected = asyncio.get_running_loop().time()
            assert leds.subscribers == 1
            await event.publish(Led(led=1))
            await leds.publish(Led(led=2))
            assert asyncio.get_running_loop().time() - connected == pytest.approx(0.05)
            await asyncio.sleep(0)
            assert [each.topic for each in script.said if each.topic != "R2P"] == ["event", "leds"]
            assert any(each.topic == "R2P" for each in script.said if each.ms < connected * 1000 + 1)
        assert not script.link.losses


async def test_an_r2p_peer_needs_no_time() -> None:
    async with scripted() as (script, _, node):
        leds = node.advertise("leds", Led)
        for _ in range(2):
            script.hear(manage(m.Hello("PC2", 7)) + manage(SUBSCRIBE))
            assert leds.publish_nowait(Led())
            await asyncio.sleep(0)
            script.link.disconnect("broken")
            script.link.connect(script)
        assert len(script.topics("leds")) == 2


async def test_closing_sends_what_waits_and_then_the_good_bye() -> None:
    async with scripted() as (script, _, node):
        publisher = node.advertise("leds", Led)
        script.hear(manage(SUBSCRIBE))
        await asyncio.sleep(1)
        script.blocked = True
        await publisher.publish(Led())
        await asyncio.sleep(0)
        for _ in range(4):
            await publisher.publish(Led())
        assert len(script.topics("leds")) == 1
    assert len(script.topics("leds")) == 5
    goodbye = script.said[-1].management
    assert isinstance(goodbye, m.Hello)
    assert goodbye.flags & m.HELLO_LEAVING


async def test_nothing_happens_after_closing() -> None:
    """Callbacks that were on their way find a link that is closed."""
    script = Script()
    async with r2p.Module("PC1", via=script) as module, node_in(module) as node:
        link = script.link
        subscriber = node.subscribe("leds", Led, queue=1)
        publisher = node.advertise("leds", Led)
        script.hear(manage(SUBSCRIBE) + manage(m.SubscribeResponse("leds", 5, 1)))
        script.hear(line("leds", Led().encode()) * 200)  # waits for room, more in the backlog
        publisher.publish_nowait(Led())  # a line is corked
    spoken = len(script.said)
    link.feed(line("leds", Led().encode()))
    link.carrier_ready()
    link.connect(script)
    link.disconnect("late")
    await asyncio.sleep(10)
    assert len(script.said) == spoken
    assert not subscriber.queue
    assert not link.up


async def test_a_line_keeps_nothing_of_a_topic_that_was_closed() -> None:
    script = Script()
    async with r2p.Module("PC1", via=script) as module, node_in(module) as node:
        publisher = node.advertise("leds", Led)
        script.hear(manage(SUBSCRIBE))
        await asyncio.sleep(1)
        await publisher.publish(Led())
        assert set(script.link._encoders) == {"leds"}
        publisher.close()
        assert not script.link._encoders


async def test_a_slow_reader_does_not_stop_the_line() -> None:
    """Its own messages are lost, counted; the others' come."""
    async with scripted() as (script, _, node):
        slow = node.subscribe("slow", Led, queue=2)
        fast = node.subscribe("fast", Led)
        script.hear(manage(m.SubscribeResponse("slow", 5)) + manage(m.SubscribeResponse("fast", 5)))
        for number in range(500):
            script.hear(line("slow", Led(led=number).encode()) + line("fast", Led(led=number).encode()))
        turns = asyncio.create_task(_count_turns())
        for number in range(500):
            assert await fast.fetch(timeout=1) == Led(led=number)
        turns.cancel()
        assert await turns < 500  # it was waited for once, not for each message
        assert [await slow.fetch(timeout=1), await slow.fetch(timeout=1)] == [Led(led=498), Led(led=499)]
        assert (slow.lost, fast.lost) == (498, 0)


async def _count_turns() -> int:
    """Turns of the event loop until it is cancelled."""
    turns = 0
    with contextlib.suppress(asyncio.CancelledError):
        while True:
            await asyncio.sleep(0)
            turns += 1
    return turns


async def test_a_message_of_the_wrong_size_is_dropped() -> None:
    async with scripted() as (script, _, node):
        subscriber = node.subscribe("leds", Led)
        script.hear(manage(m.SubscribeResponse("leds", 5)) + line("leds", bytes(4)) + line("leds", bytes(5)))
        assert await subscriber.fetch(timeout=1) == Led()
        assert script.link.losses == {"wrong size": 1}


async def test_a_subscriber_without_a_type_follows_a_new_size() -> None:
    """The module behind the topic was replaced by one with another layout."""
    async with scripted() as (script, _, node):
        subscriber = node.subscribe("topic", None)
        for size in (4, 6):
            script.hear(manage(m.SubscribeResponse("topic", size)) + line("topic", bytes(size)))
            assert await subscriber.fetch(timeout=1) == bytes(size)
        script.hear(line("topic", bytes(4)))
        assert script.link.losses == {"wrong size": 1}
        assert subscriber.publishers == 1


async def test_a_message_that_is_too_long_for_a_line_is_not_offered() -> None:
    class Long(r2p.Message):
        """256 bytes."""

        values: Annotated[tuple[r2p.u64, ...], r2p.Len(32)] = (0,) * 32

    async with scripted() as (script, _, node):
        node.advertise("long", Long)
        script.hear(manage(m.SubscribeRequest("long", 256, 1)))
        await asyncio.sleep(5)
        assert "long" not in {getattr(each.management, "topic", "") for each in script.said}
        with pytest.raises(r2p.TransportError, match="256 bytes, and it carries at most 255"):
            node.advertise("longer", Long, strict=True)


async def test_management_gets_through_a_line_that_is_always_busy() -> None:
    """A lease outlives 20 s of more data than the line takes."""
    async with scripted() as (script, _, node):
        publisher = node.advertise("text", Text, r2p.NonRealTime(stall=60.0))
        script.hear(manage(m.Hello("IMU1", 7)) + manage(m.SubscribeRequest("text", 64, 1)))
        flood = asyncio.create_task(_flood(publisher))
        for _ in range(20):
            script.blocked = True
            await asyncio.sleep(1)
            script.hear(manage(m.Hello("IMU1", 7)) + manage(m.SubscribeRequest("text", 64, 1)))
            script.said.clear()
            script.unblock()
            await asyncio.sleep(0)
            assert "SubscribeResponse" in said(script)[:20]
        flood.cancel()
        assert "management, send buffer full" not in script.link.losses


async def _flood(publisher: r2p.Publisher[Text]) -> None:
    while True:
        await publisher.publish(Text())


async def test_user_code_that_raises_does_not_harm_the_link() -> None:
    """It is the end of its node."""

    def fail(missed: r2p.Missed) -> None:
        raise ZeroDivisionError(missed.reason)

    async def run(script: Script) -> None:
        async with r2p.Module("PC1", via=script) as module, node_in(module) as node:
            node.advertise("leds", Led, r2p.Sporadic(0.1, on_degraded=fail))
            script.hear(manage(m.Hello("IMU1", 7)) + manage(SUBSCRIBE))
            script.link.disconnect("broken")
            assert not script.link.up
            assert not module.network.modules()[1:]
            await asyncio.sleep(1)
            script.link.connect(script)
            assert script.link.up
            assert not module.nodes["test"].running

    with pytest.raises(r2p.NodeCrashed):
        await run(Script())


@pytest.mark.internal_errors
async def test_a_line_whose_reading_raises_does_not_stop_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    sound = debug._checked

    def faulty(whole: re.Match[bytes]) -> debug.Line | None:
        found = sound(whole)
        if found is not None and found.data == b"1":
            raise RuntimeError(found)
        return found

    monkeypatch.setattr(debug, "_checked", faulty)
    async with scripted() as (script, _, node):
        subscriber = node.subscribe("leds", None, lossy=True)
        script.hear(manage(m.SubscribeResponse("leds", 1, 1)))
        lines = b"".join(line("leds", str(number).encode()) for number in range(5))
        script.hear(b"before\r\n" + lines[:-5])
        script.hear(lines[-5:] + b"after\r\n")
        assert [sample.data for sample in subscriber._sink.queue] == [b"0", b"2", b"3", b"4"]
        assert script.link.losses == {"internal error": 1, "garbage": 2}


@pytest.mark.parametrize("heard", [True, False])
async def test_a_line_that_is_refused_again_and_again_is_told_once(
    caplog: pytest.LogCaptureFixture, heard: bool
) -> None:
    """It is up again when a module is heard there, or it has not been refused for a while."""
    caplog.set_level(logging.INFO, "r2p")
    script = Script()
    module = r2p.Module("PC1", via=script)
    events = module.events()
    async with module:
        for number in range(10):
            if number:
                await asyncio.sleep(2)
                script.link.connect(script)
            script.hear(manage(m.Denied("A", "A", 0, m.DENIED_CLIENTS)))
            script.link.disconnect("closed")
            assert script.link.denied
        told = [await anext(events) for _ in range(3)]
        assert [type(each) for each in told] == [r2p.LinkUp, r2p.LinkNotice, r2p.LinkDown]
        assert (caplog.text.count("is up"), caplog.text.count("is down")) == (1, 1)
        await asyncio.sleep(2)
        script.link.connect(script)
        if heard:
            script.hear(manage(m.Hello("A", 7)))
        else:
            await asyncio.sleep(3)
        assert not script.link.denied
        assert await anext(events) == r2p.LinkUp("script", 20.0 if heard else 23.0, 0)
        script.link.disconnect("closed")
        assert caplog.text.count("is down") == 2


async def test_a_flood_of_modules_that_come_and_go_does_not_fill_the_log(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "r2p")
    async with scripted() as (script, module, _):
        for second in range(2):
            for number in range(1000):
                script.hear(manage(m.Hello(f"M{number}", number + 1, 0, 0, 5000)))
                script.hear(manage(m.Hello(f"M{number}", number + 1, m.HELLO_LEAVING, 0, 5000)))
            assert caplog.text.count("is gone") == 10 * (second + 1)
            await asyncio.sleep(1)
        assert "module M0 is gone (990 more since the last such line)" in caplog.text
        assert not script.link.discovery.modules
        assert len(module.links) == 1


async def test_a_flood_of_conflicts_does_not_fill_the_log(caplog: pytest.LogCaptureFixture) -> None:
    async with scripted() as (script, _, __):
        for number in range(200):
            for swap in range(8):
                script.hear(manage(m.Hello(f"M{number}", 2 * number + swap % 2 + 1, 0, 0, 5000)))
        assert caplog.text.count("two modules carry the name") == 10
        assert script.link.losses["conflicts not reported"] >= 136


async def test_lines_that_wait_keep_the_stamp_of_their_reception(monkeypatch: pytest.MonkeyPatch) -> None:
    """A new connection reads while lines of the old one are still being delivered."""
    monkeypatch.setattr("r2p.transports.buffered_link.MESSAGES_PER_TURN", 1)
    async with scripted() as (script, _, node):
        subscriber = node.subscribe("leds", Led)
        link, message = script.link, line("leds", Led().encode())
        link.feed(manage(m.SubscribeResponse("leds", 5, 1)))
        await asyncio.sleep(0.1)
        received_at = link._clock.now()
        link.feed(3 * message)
        link.disconnect("pulled")
        link.connect(script)
        clock = SimpleNamespace(now=lambda: received_at + 1, monotonic=link._clock.monotonic)
        monkeypatch.setattr(link, "_clock", clock)
        link.feed(2 * message)
        await asyncio.sleep(0.1)
        assert [sample.stamp - received_at for sample in subscriber._sink.queue] == [0, 0, 0, 1, 1]
        link.feed(message)
        assert subscriber._sink.queue[-1].stamp == received_at + 1
        assert link.losses == {}
