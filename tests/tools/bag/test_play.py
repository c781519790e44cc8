"""`r2p bag play`, and its keys."""

import asyncio
import logging
from pathlib import Path
from typing import Any

import pytest

import r2p
from r2p.msg import Led
from r2p.recording.pacing import Pacer
from r2p.recording.samples import SampleWriter
from r2p.recording.writer import BagWriter
from r2p.tools.bag.controls import Controls, next_rate, previous_rate
from r2p.tools.bag.play import play
from r2p.tools.session import UsageError
from r2p.units import MILLISECOND, SECOND

VIA = ["memory:lab"]
T0 = 1_700_000_000 * SECOND


@pytest.fixture
def recorded(tmp_path: Path) -> Path:
    path = tmp_path / "drive.mcap"
    with path.open("wb") as file:
        writer = BagWriter(file)
        samples = SampleWriter(writer)
        for i in range(100):
            at = T0 + i * 10 * MILLISECOND
            for topic in ("leds", "others"):
                sample = r2p.Sample(Led(i, 1).encode(), r2p.Source("IMU", "leds", "tcp"), at, sequence=i + 1)
                samples.write(topic, sample, Led, at)
        writer.finish()
    return path


async def played(path: Path, **options: Any) -> list[tuple[int, str]]:
    """Return the LEDs that another module received on both topics, with their senders."""
    seen: list[tuple[int, str]] = []

    async def listen(node: r2p.Node, topic: str) -> None:
        async for sample in node.subscribe(topic, Led).samples():
            seen.append((sample.message.led, f"{sample.source}"))  # noqa: PERF401 - it goes on for ever

    async with r2p.Module("PC1", via=VIA, watchdog=False) as module:
        for topic in ("leds", "old/others"):
            module.start(listen, topic, name=f"listen_{topic.replace('/', '_')}")
        await play([path], via=VIA, **options)
    return seen


@pytest.mark.virtual_time
async def test_a_recording_is_played_to_those_who_are_there(recorded: Path, capsys: Any) -> None:
    seen = await played(recorded, remap=["others:=old/others"], name="PLAYER")
    assert sorted(seen) == sorted((i, "PLAYER/leds") for i in range(100) for _ in range(2))
    assert "r2p: played 200 messages of 2 topics in 990 ms" in capsys.readouterr().err


@pytest.mark.virtual_time
async def test_a_part_at_another_rate(recorded: Path, capsys: Any) -> None:
    from r2p.tools.bag.times import moment

    seen = await played(recorded, topics=["leds"], start=moment("-490ms"), rate=0.5)
    assert [number for number, _ in seen] == list(range(50, 100))
    assert "played 50 messages of 1 topic in 980 ms" in capsys.readouterr().err


@pytest.mark.virtual_time
async def test_a_live_publisher_is_not_disturbed(recorded: Path) -> None:
    async def leds(node: r2p.Node) -> None:
        node.advertise("leds", Led)
        await asyncio.sleep(1000)

    async def start_later(module: r2p.Module) -> None:
        await asyncio.sleep(5)
        module.start(leds)
        await asyncio.sleep(5)

    async with r2p.Module("IMU1", via=VIA, watchdog=False) as module:
        later = asyncio.create_task(start_later(module))
        with pytest.raises(ExceptionGroup) as running:
            await play([recorded], via=VIA, loop=True)
        await later
        assert "leds is now published by IMU1/leds: playing has ended" in _text(running.value)
        with pytest.raises(ExceptionGroup) as beginning:
            await play([recorded], via=VIA)
        assert "leds is published by IMU1/leds" in _text(beginning.value)
        assert "--remap leds:=recorded/leds" in _text(beginning.value)
        await play([recorded], via=VIA, anyway=True)
        await play([recorded], via=VIA, exclude=["leds"])


def _text(error: BaseException) -> str:
    return " ".join(map(_text, error.exceptions)) if isinstance(error, BaseExceptionGroup) else str(error)


@pytest.mark.virtual_time
async def test_it_waits_for_a_subscriber(recorded: Path, capsys: Any) -> None:
    async def listen(node: r2p.Node) -> None:
        await node.subscribe("others", Led).fetch()
        numbers.append(1)

    numbers: list[int] = []
    async with r2p.Module("PC1", via=VIA, watchdog=False) as module, asyncio.TaskGroup() as tasks:
        playing = tasks.create_task(play([recorded], via=VIA, wait_for=["/others"]))
        await asyncio.sleep(100)
        assert not playing.done()
        module.start(listen)
    assert numbers == [1]
    output = capsys.readouterr().err
    assert "waiting for a subscriber of others on memory:lab" in output
    assert "played 200 messages" in output


@pytest.mark.virtual_time
async def test_without_subscribers_it_says_so(recorded: Path, capsys: Any) -> None:
    await play([recorded], via=VIA)
    assert "no subscriber of leds, others yet" in capsys.readouterr().err


@pytest.mark.virtual_time
@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"via": None}, "no network to play on"),
        ({"rate": 0.0}, "--rate: the rate is"),
        ({"remap": ["leds=other"]}, "--remap leds=other: write it as OLD:=NEW"),
        ({"topics": ["le ds"]}, "--topics: no topic can match"),
        ({"wait_for": ["led"]}, "--wait-for led: it is not played; leds, others are"),
        ({"bus": "can0"}, "--bus is a bus of CAN frames: add --frames"),
        ({"frames": True, "clock": True}, "--clock is for messages"),
        ({"topics": ["wheel*"]}, "it has leds, others"),
    ],
)
async def test_mistakes_are_named(recorded: Path, options: dict[str, Any], text: str) -> None:
    with pytest.raises((UsageError, r2p.Error)) as error:
        await play([recorded], **{"via": VIA, **options})
    assert text in str(error.value)


@pytest.mark.virtual_time
async def test_keys_pause_step_and_change_the_rate(capsys: Any) -> None:
    pacer = Pacer(asyncio.get_running_loop())
    pacer.begin(T0)
    controls = Controls(pacer, T0, T0 + 10 * SECOND, lambda: 7, "messages")
    await asyncio.sleep(1.5)
    assert controls.text == "1.5 of 10.0 s  1x  7 messages"
    for key in "++--":
        controls.key(key)
    assert pacer.rate == 1.0
    controls.key(" ")
    assert controls.text == "1.5 of 10.0 s  1x  7 messages  paused"
    for key in "\x1b[C.x":
        controls.key(key)
    assert pacer.paused
    controls.key(" ")
    assert not pacer.paused
    with controls.running():  # not at a terminal
        logging.getLogger("r2p").warning("a line")
    assert "\r" not in capsys.readouterr().err


def test_rates_go_by_steps_that_come_back_to_one() -> None:
    rates = [1.0]
    for _ in range(20):
        rates.append(next_rate(rates[-1]))
    assert rates[:4] == [1.0, 2.0, 5.0, 10.0]
    assert rates[-1] == 10_000.0
    for _ in range(20):
        rates.append(previous_rate(rates[-1]))
    assert 1.0 in rates[21:]
    assert previous_rate(0.001) == 0.001
