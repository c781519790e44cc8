"""What a recorder finds, follows and counts."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest

import r2p
from r2p.msg import Led, Log, Velocity3
from r2p.recording import topics as recorded_topics
from r2p.recording.bag import Bag
from r2p.recording.recorder import Recorder, TopicSelection
from tests.tools.rig import VIA, Firmware, keep_types

if TYPE_CHECKING:
    from pathlib import Path


class Private(r2p.Message):
    """A type that only its publisher knows."""

    secret: r2p.u16 = 0


class Renewed(r2p.Message):
    """What the same publisher sends after its restart."""

    secret: r2p.u32 = 0
    more: r2p.u32 = 0


def recorded(path: Path, topic: str) -> list[tuple[str, bytes]]:
    """The type and the bytes of each message of a topic."""
    with Bag(path) as bag:
        records = list(bag.records([topic]))
    return [("" if each.cls is None else r2p.layout(each.cls).name, each.sample.data) for each in records]


def module(name: str) -> r2p.Module:
    return r2p.Module(name, via=[VIA])


@pytest.mark.virtual_time
async def test_the_first_message_of_this_module_is_recorded(tmp_path: Path) -> None:
    """It is published within the step that advertises it."""

    async def publish(node: r2p.Node) -> None:
        leds = node.advertise("leds", Led)
        for number in range(3):
            leds.publish_nowait(Led(number, 1))

    path = tmp_path / "own.mcap"
    async with r2p.Module("BOT", via=[]) as bot, Recorder(bot, path):
        bot.start(publish)
        await bot.wait()
    assert recorded(path, "leds") == [("r2p_msgs/Led", Led(number, 1).encode()) for number in range(3)]


@pytest.mark.virtual_time
async def test_topics_of_others_are_followed_with_types_that_only_they_know(tmp_path: Path) -> None:
    path = tmp_path / "others.mcap"

    async def publish(node: r2p.Node) -> None:
        secrets, other = node.advertise("secrets", Private), node.advertise("sec_q", Led)
        await asyncio.sleep(0.5)
        for number in range(5):
            await secrets.publish(Private(number))
            await other.publish(Led())
            await asyncio.sleep(0.01)
        await asyncio.sleep(1.0)

    async with module("PC") as pc, Recorder(pc, path, ["sec*"], exclude=["*_q"]), module("BOT") as bot:
        bot.start(publish)
        await bot.wait()
    assert recorded(path, "secrets") == [("tests/Private", Private(number).encode()) for number in range(5)]
    assert recorded(path, "sec_q") == []


@pytest.mark.virtual_time
async def test_without_an_answer_messages_are_packed_after_half_a_second(tmp_path: Path) -> None:
    path = tmp_path / "silent.mcap"
    async with module("BOT") as bot, module("PC") as pc:
        keep_types(bot)

        async def publish(node: r2p.Node) -> None:
            secrets = node.advertise("secrets", Private)
            await secrets.wait_subscriber()
            await secrets.publish(Private(7))
            await asyncio.sleep(2 * recorded_topics.HELD_MAX / 1e9)
            await secrets.publish(Private(8))

        async with Recorder(pc, path) as recorder:
            bot.start(publish)
            await bot.wait()
            await asyncio.sleep(0.1)
            assert recorder.counts()["secrets"].messages == 2
    assert recorded(path, "secrets") == [("", Private(7).encode()), ("", Private(8).encode())]


@pytest.mark.virtual_time
async def test_a_publisher_may_return_with_another_type(tmp_path: Path) -> None:
    path = tmp_path / "restart.mcap"
    async with module("PC") as pc, Recorder(pc, path) as recorder:
        for message in (Private(1), Renewed(2, 3), Private(4)):
            async with module("BOT") as bot:

                async def publish(node: r2p.Node, message: r2p.Message = message) -> None:
                    secrets = node.advertise("secrets", type(message))
                    await secrets.wait_subscriber()
                    await secrets.publish(message)
                    await asyncio.sleep(1.0)

                bot.start(publish)
                await bot.wait()
        assert recorder.counts()["secrets"].missed == 0
    assert recorded(path, "secrets") == [
        ("tests/Private", Private(1).encode()),
        ("tests/Renewed", Renewed(2, 3).encode()),
        ("tests/Private", Private(4).encode()),
    ]


@pytest.mark.virtual_time
async def test_firmware_and_latched_messages_are_recorded(tmp_path: Path) -> None:
    path = tmp_path / "firmware.mcap"
    async with module("BOT") as bot, module("PC") as pc:

        async def latch(node: r2p.Node) -> None:
            await node.advertise("goal", Led, latch=True).publish(Led(5, 5))
            await asyncio.sleep(5.0)

        bot.start(latch)
        await asyncio.sleep(1.0)
        firmware = Firmware()
        async with Recorder(pc, path, types={"/speed": Velocity3}):
            firmware.alive()
            for topic, data in (("speed", Velocity3(x=1.0).encode()), ("log", Log(text="low").encode()), ("x", b"12")):
                firmware.advertise(topic, len(data))
                await asyncio.sleep(0.2)
                firmware.advertise(topic, len(data))
                firmware.publish(topic, data)
            await asyncio.sleep(0.2)
    assert recorded(path, "goal") == [("r2p_msgs/Led", Led(5, 5).encode())]
    assert [kind for kind, _ in recorded(path, "speed")] == ["r2p_msgs/Velocity3"]
    assert [kind for kind, _ in recorded(path, "log")] == ["r2p_msgs/Log"]
    assert recorded(path, "x") == [("", b"12")]


def test_a_selection_has_names_and_patterns() -> None:
    selection = TopicSelection(["/odometry", "camera/*"], ["camera/raw", "*_q"])
    assert selection.names == ["odometry"]
    chosen = ["odometry", "camera/left", "camera/raw", "camera/a_q", "imu"]
    assert [each for each in chosen if selection.has(each)] == ["odometry", "camera/left"]
    assert TopicSelection().has("anything")
    with pytest.raises(r2p.InvalidName, match="messages of r2p itself"):
        TopicSelection(["R2P"])
