"""Recorded frames of a robot, read as a bus, and played onto a bus where nothing else sends."""

import asyncio
import contextlib
import itertools
from collections.abc import AsyncIterator
from pathlib import Path

import can
import pytest

import r2p
import r2p.sim
from r2p.bus import FrameKind
from r2p.clock import clock_of
from r2p.codecs.can_bits import AnyFrame, Frame, OtherFrame
from r2p.errors import BagError, TransportError
from r2p.msg import Led
from r2p.recording.background_writer import BackgroundWriter
from r2p.recording.bag import Bag
from r2p.recording.frame_player import FramePlayer
from r2p.recording.frame_reader import BusReader, observe
from r2p.recording.frame_recorder import FrameRecorder
from r2p.recording.frames import BusInfo, FrameEntry
from r2p.recording.pacing import Pacer
from r2p.recording.recording_files import RecordingOptions
from r2p.sim.can import CanNode, FrameRecord
from r2p.sim.transport import SimCan
from r2p.transports.rtcan.transport import RtcanOptions

SECOND = 1_000_000_000
_channels = itertools.count()


@contextlib.asynccontextmanager
async def recording(path: Path, bus: SimCan, name: str = "lab") -> AsyncIterator[None]:
    disk = BackgroundWriter(path, RecordingOptions(min_free=0), clock_of(), lambda _text: None)
    async with FrameRecorder(bus, disk.put, name=name):
        yield
    await disk.close()


async def robot(path: Path) -> list[int]:
    """Record a module that counts in slots and in events, and one that subscribes. Return what the latter got."""
    bus, got = SimCan(seed=3), []

    async def motor(node: r2p.Node) -> None:
        numbers = itertools.count()
        node.advertise("encoder", Led, r2p.Periodic(0.02, lambda: Led(led=next(numbers) % 256)))
        await node.spin()

    async def watch(node: r2p.Node) -> None:
        async for message in node.subscribe("encoder", Led):
            got.append(message.led)  # noqa: PERF401 - it is cancelled

    async with (
        recording(path, bus),
        r2p.Module("MOTOR", via=bus.transport()) as module,
        r2p.Module("PC", via=bus.transport()) as pc,
    ):
        pc.start(watch)
        module.start(motor)
        await asyncio.sleep(6)
    return got


@pytest.mark.virtual_time
async def test_frames_of_a_robot_give_a_listening_module_the_same_messages(tmp_path: Path) -> None:
    path = tmp_path / "robot.mcap"
    expected = await robot(path)
    bus, got = SimCan(seed=4), []

    async def watch(node: r2p.Node) -> None:
        async for message in node.subscribe("encoder", Led):
            got.append(message.led)  # noqa: PERF401 - it is cancelled

    with Bag(path) as bag:
        async with (
            r2p.Module("EAR", via=bus.transport(RtcanOptions(id=200, priority=0))) as module,
            FramePlayer(bag, bus) as player,
        ):
            module.start(watch)
            await player.run()
            await asyncio.sleep(0.1)
        errors = sum(frame.error for frame in BusReader(bag).read())  # from when the first module was alone
        assert player.refused == {"error frames can't be sent": errors}
        assert player.sent == BusReader(bag).counts["lab"] - errors
    assert len(got) > 150
    assert got == expected[-len(got) :]


def test_the_same_run_is_the_same_file(tmp_path: Path) -> None:
    async def run(path: Path) -> None:
        bus = SimCan(seed=3)
        a, b = (bus.bus.attach(CanNode(name, drift_ppm=20.0)) for name in "AB")
        async with recording(path, bus):
            for number in range(100):
                a.request(Frame(0x100 + number, b"a"))
                b.request(Frame(0x180 - number, b"b"))
                await asyncio.sleep(0.0003)

    r2p.sim.run(lambda: run(tmp_path / "one.mcap"))
    r2p.sim.run(lambda: run(tmp_path / "two.mcap"))
    assert (tmp_path / "one.mcap").read_bytes() == (tmp_path / "two.mcap").read_bytes()


@pytest.mark.virtual_time
async def test_played_frames_have_their_instants_to_the_ns(tmp_path: Path) -> None:
    await robot(tmp_path / "robot.mcap")
    bus, played = SimCan(seed=4), []
    bus.bus.observers.append(lambda record: played.append((record.end, record.frame.id, record.frame.data)))
    bus.bus.attach(CanNode("listener"))  # without it no frame is acknowledged
    with Bag(tmp_path / "robot.mcap") as bag:
        async with FramePlayer(bag, bus) as player:
            await player.run()
        frames = [frame for frame in BusReader(bag).read() if not frame.error]
    assert [frame[1:] for frame in played] == [(frame.id, frame.data) for frame in frames]
    first, began = frames[0].time, played[0][0]
    assert [at - began for at, _, _ in played] == [frame.time - first for frame in frames]


@pytest.mark.virtual_time
async def test_frames_of_every_kind_are_recorded_and_played_to_the_ns(tmp_path: Path) -> None:
    path = tmp_path / "kinds.mcap"
    frames: list[AnyFrame] = [OtherFrame(0x123, b"abc"), Frame(0x123, b"12345678")]
    frames += [OtherFrame(0x12, b"", False, 5), OtherFrame(0x12, b"", True, 0)]
    bus = SimCan(seed=4)
    a, _ = (bus.bus.attach(CanNode(name)) for name in "AB")
    async with recording(path, bus):
        for frame in frames:
            a.request(frame)
            await asyncio.sleep(0.001)
    records: list[FrameRecord] = []
    bus.bus.observers.append(records.append)
    with Bag(path) as bag:
        async with FramePlayer(bag, bus) as player:
            await player.run()
        assert not player.refused
    assert [record.frame for record in records] == frames
    assert [record.start - records[0].start for record in records] == [0, 1_000_000, 2_000_000, 3_000_000]


@pytest.mark.virtual_time
async def test_a_recording_is_described_as_the_bus_was(tmp_path: Path) -> None:
    await robot(tmp_path / "robot.mcap")
    with Bag(tmp_path / "robot.mcap") as bag:
        reader = BusReader(bag)
        monitor = reader.monitor("lab")
        seen = [observe(monitor, frame) for frame in reader.read("lab")]
        hrt = [each for each in seen if each is not None and each.kind is FrameKind.HRT]
        assert {(each.topic, each.module) for each in hrt} == {("encoder", "MOTOR")}
        assert len({each.slot for each in hrt}) == 1
        owned = [slot for slot in reader.watch("lab").slots if "encoder" in slot.owners]
        assert [slot.missed for slot in owned] in ([0], [1])  # the last one, when the module stops
        loads = list(reader.loads("lab", SECOND))
        counted = sum(tally.frames for _, load in loads for tally in load.tallies.values())
        errors = sum(number for _, load in loads for number in load.faults.values())
        assert counted + errors == reader.counts["lab"]
        assert {begin - loads[0][0] for begin, _ in loads} == {number * SECOND for number in range(len(loads))}


@pytest.mark.virtual_time
async def test_a_bus_with_a_live_master_is_refused(tmp_path: Path) -> None:
    await robot(tmp_path / "robot.mcap")
    bus = SimCan(seed=4)
    with Bag(tmp_path / "robot.mcap") as bag:
        async with r2p.Module("MASTER", via=bus.transport()):
            await asyncio.sleep(5)
            with pytest.raises(TransportError, match=r"has a live RTCAN master: .* another bus, such as vcan0"):
                await FramePlayer(bag, bus).__aenter__()
            async with FramePlayer(bag, bus, anyway=True, end=bag.start + SECOND) as player:
                await player.run(Pacer(asyncio.get_running_loop(), rate=10.0))
            assert player.sent
        with pytest.raises(TransportError, match="tcp:x:1 is not a CAN bus"):
            FramePlayer(bag, "tcp:x:1")
        with pytest.raises(BagError, match="no frames of a bus 'can7'; it has those of lab"):
            FramePlayer(bag, bus, bus="can7")


@pytest.mark.anyio
async def test_frames_of_all_kinds_go_to_an_interface_of_python_can(tmp_path: Path) -> None:
    channel, path = f"play{next(_channels)}", tmp_path / "kinds.mcap"
    disk = BackgroundWriter(path, RecordingOptions(min_free=0), clock_of(), lambda _text: None)
    kinds = [(0x123, b"abc"), (1 << 31 | 0x1234567, b"12345678"), (1 << 30 | 0x12, bytes(5)), (1 << 29 | 8, bytes(8))]
    disk.put([FrameEntry(BusInfo("can0"), [(*each, 0, SECOND) for each in kinds])])
    await disk.close()
    with can.Bus(interface="virtual", channel=channel) as peer, Bag(path) as bag:
        async with FramePlayer(bag, f"rtcan:virtual:{channel}", anyway=True) as player:
            await player.run()
        received = [peer.recv(10) for _ in range(3)]
    assert [
        (each.arbitration_id, each.is_extended_id, each.is_remote_frame, each.dlc, bytes(each.data))
        for each in received
        if each is not None
    ] == [(0x123, False, False, 3, b"abc"), (0x1234567, True, False, 8, b"12345678"), (0x12, False, True, 5, b"")]
    assert (player.sent, player.refused) == (3, {"error frames can't be sent": 1})
