"""Frames of a virtual interface of the kernel, recorded into a file."""

from __future__ import annotations

import asyncio
from collections import Counter
from typing import TYPE_CHECKING

import pytest
from mcap.reader import make_reader

from r2p.clock import clock_of
from r2p.errors import TransportError
from r2p.recording.background_writer import BackgroundWriter
from r2p.recording.bag import Bag
from r2p.recording.frame_player import FramePlayer
from r2p.recording.frame_recorder import FrameRecorder
from r2p.recording.frames import BusInfo, FrameEntry, frame_of
from r2p.recording.recording_files import RecordingOptions
from tests.can.rig import Candump, cangen, cansend, ip, until

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = [pytest.mark.can, pytest.mark.anyio, pytest.mark.one_loop]


async def test_every_kind_of_frame_is_in_the_file(vcan: str, tmp_path: Path) -> None:
    path = tmp_path / "bus.mcap"
    disk = BackgroundWriter(path, RecordingOptions(), clock_of(), lambda _text: None)
    async with FrameRecorder(f"rtcan:{vcan}", disk.put) as recorder:
        for text in ("123#0102", "7FF#R3", "1ABCDE00#R8", "00000123#BB", "20000008#0000040000000000"):
            cansend(vcan, text)
        await until(lambda: recorder.frames == 5)
    await disk.close()
    with path.open("rb") as file:
        messages = list(make_reader(file).iter_messages([f"/{vcan}/frames"]))
    frames = [frame_of(message.data, vcan) for _, _, message in messages]
    assert [(each.id, each.extended, each.remote, each.error, each.data) for each in frames] == [
        (0x123, False, None, False, b"\1\2"),
        (0x7FF, False, 3, False, b""),
        (0x1ABCDE00, True, 8, False, b""),
        (0x123, True, None, False, b"\xbb"),
        (0x8, False, None, True, b"\0\0\4" + bytes(5)),
    ]
    assert {channel.metadata["direction"] for _, channel, _ in messages} == {"tx"}  # by programs of this computer
    assert [message.log_time for _, _, message in messages] == sorted(each.time for each in frames)


async def test_every_frame_is_in_the_file_or_counted(vcan: str, tmp_path: Path) -> None:
    """The loop stands still while frames come, more than the kernel keeps."""
    ip("set", "dev", vcan, "txqueuelen", "1000")
    count = 30_000
    disk = BackgroundWriter(tmp_path / "bus.mcap", RecordingOptions(), clock_of(), lambda _text: None)
    async with FrameRecorder(f"rtcan:{vcan}", disk.put) as recorder:
        cangen(vcan, count)
    await disk.close()
    assert recorder.lost["receive queue full"] > 0
    assert recorder.frames + recorder.lost.total() == count
    with (tmp_path / "bus.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    by_topic: Counter[str] = Counter()
    for channel, number in summary.statistics.channel_message_counts.items():
        by_topic[summary.channels[channel].topic] += number
    assert by_topic[f"/{vcan}/frames"] == recorder.frames


async def test_an_interface_that_goes_down_is_recorded_again(vcan: str) -> None:
    seen: list[object] = []
    async with FrameRecorder(f"rtcan:{vcan}", seen.extend) as recorder:
        cansend(vcan, "001#")
        await until(lambda: recorder.frames)
        ip("set", vcan, "down")
        await until(lambda: any("down" in str(each) for each in seen))
        ip("set", vcan, "up")
        async with asyncio.timeout(30):
            while recorder.frames < 2:
                await (await asyncio.create_subprocess_exec("cansend", vcan, "002#")).wait()
                await asyncio.sleep(0.01)


async def test_a_recording_is_played_onto_the_interface(vcan: str, tmp_path: Path) -> None:
    path = tmp_path / "bus.mcap"
    disk = BackgroundWriter(path, RecordingOptions(), clock_of(), lambda _text: None)
    texts = ["123#0102", "7FF#R3", "1ABCDE00#R8", "00000123#BB"]
    async with FrameRecorder(f"rtcan:{vcan}", disk.put) as recorder:
        for text in texts:
            cansend(vcan, text)
        await until(lambda: recorder.frames == len(texts))
    await disk.close()
    with Bag(path) as bag:
        async with Candump(vcan) as candump, FramePlayer(bag, f"rtcan:{vcan}", anyway=True) as player:
            await player.run()
            played = [await candump.line() for _ in texts]
    assert played == [
        f"{vcan} 123 [2] 01 02",
        f"{vcan} 7FF [3] remote request",
        f"{vcan} 1ABCDE00 [8] remote request",
        f"{vcan} 00000123 [1] BB",
    ]
    assert player.sent == 4


async def test_an_interface_that_can_not_be_played_onto_is_named(vcan: str, tmp_path: Path) -> None:
    path = tmp_path / "bus.mcap"
    disk = BackgroundWriter(path, RecordingOptions(), clock_of(), lambda _text: None)
    disk.put([FrameEntry(BusInfo("can0"), [(0x123, b"", 0, 0)])])
    await disk.close()
    with Bag(path) as bag:
        with pytest.raises(TransportError, match="no CAN interface has this name"):
            await FramePlayer(bag, "rtcan:nocan0").__aenter__()
        ip("set", vcan, "down")
        with pytest.raises(TransportError, match=f"{vcan}: .*ip link set"):
            await FramePlayer(bag, f"rtcan:{vcan}", anyway=True).__aenter__()
