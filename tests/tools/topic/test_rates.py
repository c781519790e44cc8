"""`r2p topic hz`, `bw` and `delay`."""

from __future__ import annotations

import asyncio
import json
from typing import TYPE_CHECKING, Any

import pytest

import r2p
from r2p.msg import Led
from r2p.tools.session import TimedOut
from r2p.tools.topic.rates import QUEUE, bw, delay, hz
from r2p.transports.memory import network
from tests.tools.rig import Firmware, printed, robot, tool

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable


async def leds(node: r2p.Node) -> None:
    publisher = node.advertise("leds", Led)
    async for _ in node.every(0.1):
        await publisher.publish(Led())


@pytest.mark.virtual_time
async def test_hz(capsys: pytest.CaptureFixture[str]) -> None:
    async with robot(leds), tool() as session:
        start = asyncio.get_running_loop().time()
        await hz(session, "leds", count=3)
        assert asyncio.get_running_loop().time() - start == pytest.approx(3)
    reports = printed(capsys)
    assert len(reports) == 3
    assert 28 <= reports[-1].pop("window") <= 30
    assert reports[-1] == {
        "topic": "leds",
        "rate": pytest.approx(10.0),
        "min": pytest.approx(0.1),
        "max": pytest.approx(0.1),
        "std": pytest.approx(0.0),
        "gaps": 0,
        "lost_on_way": 0,
        "lost_here": 0,
        "stamps": "sender",
    }


@pytest.mark.virtual_time
async def test_hz_tells_losses_on_the_way_from_pauses_of_the_publisher(capsys: pytest.CaptureFixture[str]) -> None:
    async def hesitant(node: r2p.Node) -> None:
        publisher = node.advertise("leds", Led)
        await publisher.wait_subscriber()
        for number in range(60):
            await asyncio.sleep(0.5 if number == 30 else 0.1)
            await publisher.publish(Led())
        await asyncio.Event().wait()

    async with robot(hesitant), tool() as session:
        measuring = asyncio.create_task(hz(session, "leds", count=6))
        await asyncio.sleep(1.05)
        network("lab").loss = 1.0
        await asyncio.sleep(0.5)
        network("lab").loss = 0.0
        await measuring
    last = printed(capsys)[-1]
    assert (last["gaps"], last["lost_on_way"], last["lost_here"]) == (1, 5, 0)
    assert last["max"] == pytest.approx(0.5)


@pytest.mark.virtual_time
async def test_hz_does_not_take_disorder_for_losses(capsys: pytest.CaptureFixture[str]) -> None:
    async with robot(leds), tool() as session:
        await session.settle()
        network("lab").delay = 0.2
        network("lab").reorder = 0.3
        await hz(session, "leds", count=20)
        assert network("lab").counts["reordered"] > 20
    assert printed(capsys)[-1]["lost_on_way"] <= 3  # those that are still on their way


@pytest.mark.virtual_time
async def test_hz_tells_what_the_tool_loses(capsys: pytest.CaptureFixture[str]) -> None:
    async def burst(node: r2p.Node) -> None:
        publisher = node.advertise("leds", Led)
        await publisher.wait_subscriber()
        for _ in range(QUEUE + 7):
            publisher.publish_nowait(Led())
        await asyncio.sleep(0.5)
        await publisher.publish(Led())
        await asyncio.Event().wait()

    async with tool() as session:
        session.module.start(burst)
        await hz(session, "leds", once=True, window=10_000)
    (report,) = printed(capsys)
    assert (report["lost_here"], report["lost_on_way"]) == (7, 0)


@pytest.mark.virtual_time
async def test_hz_of_firmware_knows_only_reception(capsys: pytest.CaptureFixture[str]) -> None:
    async with tool() as session:
        imu = Firmware()
        loop = asyncio.get_running_loop()
        loop.call_later(0.1, imu.advertise, "leds", 5)
        for number in range(8):
            loop.call_later(0.2 + number / 10, imu.publish, "leds", bytes(5))
        await hz(session, "leds", once=True)
    (report,) = printed(capsys)
    assert report["rate"] == pytest.approx(10.0)
    assert report["lost_on_way"] is None


@pytest.mark.virtual_time
async def test_bw(capsys: pytest.CaptureFixture[str]) -> None:
    async with robot(leds), tool() as session:
        await bw(session, "leds", count=2)
    last = printed(capsys)[-1]
    assert 18 <= last.pop("window") <= 20
    assert last == {
        "topic": "leds",
        "bytes_per_second": pytest.approx(50.0),
        "messages_per_second": pytest.approx(10.0),
        "min": 5,
        "mean": 5.0,
        "max": 5,
        "lost_here": 0,
    }


@pytest.mark.virtual_time
async def test_delay(capsys: pytest.CaptureFixture[str]) -> None:
    async with robot(leds), tool() as session:
        network("lab").delay = 0.25
        await delay(session, "leds", count=3)
    last = printed(capsys)[-1]
    assert last.pop("window") >= 20
    assert last == {
        "topic": "leds",
        "mean": pytest.approx(0.25),
        "min": pytest.approx(0.25),
        "max": pytest.approx(0.25),
        "std": pytest.approx(0.0),
        "from": "publish() in BOT/leds",
        "to": "this tool",
        "clocks": "one clock",
        "lost_here": 0,
    }


@pytest.mark.virtual_time
async def test_delay_needs_stamps(monkeypatch: pytest.MonkeyPatch) -> None:
    async with tool() as session:
        link: Any = session.module.links[0]
        original = link.sample

        def unstamped(*arguments: Any) -> r2p.Sample:
            sample: r2p.Sample = original(*arguments)
            sample.stamped = False
            return sample

        monkeypatch.setattr(link, "sample", unstamped)
        async with robot(leds):
            with pytest.raises(ExceptionGroup) as caught:
                await delay(session, "leds")
    assert caught.group_contains(r2p.Error, match="no stamps: link memory:lab does not carry")


@pytest.mark.virtual_time
async def test_silence(capsys: pytest.CaptureFixture[str]) -> None:
    async def ends(node: r2p.Node) -> None:
        publisher = node.advertise("leds", Led)
        await publisher.wait_subscriber()
        for _ in range(20):
            await publisher.publish(Led())
            await asyncio.sleep(0.1)
        await asyncio.Event().wait()

    async with robot(ends), tool() as session:
        with pytest.raises(TimedOut, match="nothing received on leds for 3 s"):
            await hz(session, "leds", timeout=3)
    assert capsys.readouterr().err.endswith("r2p: no new messages of leds\n")


@pytest.mark.virtual_time
@pytest.mark.parametrize("measure", [hz, bw, delay])
async def test_after_a_silence_it_measures_anew(
    measure: Callable[..., Awaitable[None]], capsys: pytest.CaptureFixture[str]
) -> None:
    """What came before would make it look slow for as long as the window is."""

    async def pauses(node: r2p.Node) -> None:
        publisher = node.advertise("leds", Led)
        await publisher.wait_subscriber()
        for number in range(100):
            await asyncio.sleep(30 if number == 40 else 0.1)
            await publisher.publish(Led())

    async with robot(pauses) as module, tool() as session:
        await measure(session, "leds", count=8)
        await module.wait()
    captured = capsys.readouterr()
    reports = [json.loads(line) for line in captured.out.splitlines()]
    assert captured.err.count("no new messages of leds") == 1
    assert [report["window"] < 41 for report in reports] == [True] * 8
    for report in reports:
        assert report.get("rate", report.get("messages_per_second", 10.0)) == pytest.approx(10.0, rel=0.01)
    if measure is hz:
        assert reports[-1]["max"] == pytest.approx(0.1)
        assert (reports[0]["gaps"], reports[-1]["gaps"]) == (0, 1)


@pytest.mark.virtual_time
async def test_a_publisher_that_has_left_is_missed(capsys: pytest.CaptureFixture[str]) -> None:
    async with tool() as session:
        measuring = asyncio.create_task(hz(session, "leds", timeout=20))
        for _ in range(2):
            async with robot(leds):
                await asyncio.sleep(3)
            await asyncio.sleep(3)
        with pytest.raises(TimedOut):
            await measuring
    said = capsys.readouterr().err.splitlines()
    assert said == 2 * ["r2p: leds has no publisher any more", "r2p: no new messages of leds"]


@pytest.mark.virtual_time
@pytest.mark.parametrize("measure", [hz, bw, delay])
async def test_a_topic_with_a_name_much_like_it_is_named(
    measure: Callable[..., Awaitable[None]], capsys: pytest.CaptureFixture[str]
) -> None:
    async with robot(leds), tool() as session:
        with pytest.raises(TimedOut, match="nothing received on ledz for 5 s"):
            await measure(session, "ledz", timeout=5)
    assert "ledz has no publisher; did you mean leds?" in capsys.readouterr().err


@pytest.mark.virtual_time
async def test_a_slow_topic(capsys: pytest.CaptureFixture[str]) -> None:
    """It pauses between two messages for longer than a report takes, and is not silent for that."""

    async def slow(node: r2p.Node) -> None:
        publisher = node.advertise("slow", Led, latch=True)
        async for _ in node.every(4.0):
            await publisher.publish(Led())

    async with robot(slow), tool() as session:
        await hz(session, "slow", count=3)
    captured = capsys.readouterr()
    assert [json.loads(line)["rate"] for line in captured.out.splitlines()] == [0.25] * 3
    assert captured.err.count("waiting for the second message of slow") == 1
    assert "no new messages" not in captured.err


@pytest.mark.virtual_time
async def test_for_people(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "200")
    async with robot(leds), tool() as session:
        await hz(session, "leds", once=True)
        await bw(session, "leds", once=True)
        await delay(session, "leds", once=True)
    rate, bandwidth, late = capsys.readouterr().out.splitlines()
    assert rate.startswith("10.00 Hz, period 100.000 ms to 100.000 ms, std 0.000 ms (over ")
    assert rate.endswith("), 0 gaps at the publisher, 0 lost on the way, 0 lost here")
    assert bandwidth.startswith("50.0 B/s, 10.00 messages/s of 5 B (over ")
    assert late.startswith("0.000 ms, 0.000 ms to 0.000 ms")
    assert late.endswith("; from publish() in BOT/leds to this tool, one clock")
