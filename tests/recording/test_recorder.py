"""What a recorder finds, follows and counts."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest
from mcap.reader import make_reader

import r2p
from r2p.msg import Led, Log, Velocity3
from r2p.recording import topics as recorded_topics
from r2p.recording.bag import Bag
from r2p.recording.messages import LOSSES, RecorderLosses, TopicLosses
from r2p.recording.recorder import Recorder, TopicSelection
from r2p.ros.cdr import cdr
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


@pytest.mark.virtual_time
async def test_a_recorder_holds_no_type_and_no_topic_of_its_module(tmp_path: Path) -> None:
    """A node may return with another type, and the recording has both."""
    path = tmp_path / "own.mcap"

    async def publish(node: r2p.Node, message: r2p.Message) -> None:
        await node.advertise("value", type(message)).publish(message)

    async with r2p.Module("BOT", via=[]) as bot:
        async with Recorder(bot, path):
            for number, message in enumerate((Led(1, 2), Private(3), Led(4, 5))):
                bot.start(publish, message, name=f"node{number}")
                await bot.wait()
        assert "value" not in bot.space.topics
    assert [kind for kind, _ in recorded(path, "value")] == ["r2p_msgs/Led", "tests/Private", "r2p_msgs/Led"]


@pytest.mark.virtual_time
async def test_publishers_without_end_are_recorded_without_their_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorded_topics, "PUBLISHERS_MAX", 2)
    path = tmp_path / "many.mcap"
    async with r2p.Module("BOT", via=[]) as bot, Recorder(bot, path, ["value"], types={"value": Led}):
        for number in range(6):
            source = r2p.Source("BOT", f"node{number}", "tcp")
            bot.space.topics["value"].deliver(r2p.Sample(Led(number, 0).encode(), source, 1, sequence=5))
    with Bag(path) as bag:
        nodes = [each.sample.source.node for each in bag.records(["value"])]
    assert nodes == ["node0", "node1", "", "", "", ""]


@pytest.mark.virtual_time
async def test_numbers_that_never_came_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "gaps.mcap"
    async with r2p.Module("BOT", via=[]) as bot, Recorder(bot, path, ["value"]) as recorder:
        for number in (7, 8, 11, 12, 1, 2, 4, 0, 0):
            bot.space.topics["value"].deliver(r2p.Sample(b"1", r2p.Source("A", "b", "tcp"), 1, sequence=number))
        await asyncio.sleep(1.0)
        count = recorder.counts()["value"]
        assert (count.messages, count.dropped, count.missed) == (9, 0, 3)
    with path.open("rb") as file:
        losses = [
            cdr(RecorderLosses).decode(message.data) for _, _, message in make_reader(file).iter_messages([LOSSES])
        ]
    assert losses[-1].topics == (TopicLosses("value", 0, 3),)
    assert losses[-1].messages == 9


@pytest.mark.processes
def test_only_what_records_loads_recordings_and_without_the_extra_it_says_so() -> None:
    code = """
import sys
import r2p, r2p.tools.bag, r2p.tools.gateway, r2p.tools.run, r2p.tools.topic
print([name for name in sys.modules if "mcap" in name or "r2p.recording" in name])
sys.modules["mcap"] = None
sys.argv = ["r2p", "bag", "record", "-a", "--via", "memory:lab"]
from r2p.tools.main import main
main()
"""
    done = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (1, "[]\n")
    assert done.stderr == "r2p: recordings need mcap: pip install 'r2p[bag]'\n"
