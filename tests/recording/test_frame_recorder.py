"""What is recorded of a bus: a simulated one, and the virtual interface of python-can. tests/can has SocketCAN."""

import asyncio
import itertools
from collections.abc import Callable

import can
import pytest

from r2p.codecs.can_bits import ERROR, EXTENDED, REMOTE, Frame, WireFrame, frame_bits
from r2p.errors import TransportError
from r2p.recording.entries import BagEntry, MessageEntry
from r2p.recording.frame_recorder import FrameRecorder
from r2p.recording.frames import BusInfo, FrameDetails, FrameEntry
from r2p.sim.can import CanNode
from r2p.sim.transport import SimCan, can_bus
from r2p.transports.can.port import CanPortListener
from r2p.transports.can.pythoncan import PythonCanPort

MS = 1_000_000
_channels = itertools.count()


class Entries(list[BagEntry]):
    """What would be written."""

    def put(self, entries: list[BagEntry]) -> None:
        self.extend(entries)

    @property
    def frames(self) -> list[WireFrame]:
        """All frames, with stamps in UTC."""
        return [
            (identifier, data, flags, stamp + entry.utc_offset)
            for entry in self
            if isinstance(entry, FrameEntry)
            for identifier, data, flags, stamp in entry.frames
        ]

    @property
    def details(self) -> list[FrameDetails]:
        found = [entry.message for entry in self if isinstance(entry, MessageEntry)]
        assert all(entry.channel.endswith("/frames/details") for entry in self if isinstance(entry, MessageEntry))
        return [message for message in found if isinstance(message, FrameDetails)]


@pytest.mark.virtual_time
async def test_a_simulated_bus_is_recorded_to_the_bit() -> None:
    entries, shared = Entries(), SimCan(seed=1)
    epoch = asyncio.get_running_loop().clock.now()  # type: ignore[attr-defined]
    a, b = (shared.bus.attach(CanNode(name)) for name in "AB")
    async with FrameRecorder(shared, entries.put, name="lab") as recorder:
        a.request(Frame(0x100, b"first"))
        b.request(Frame(0x200, b"second"))
        await asyncio.sleep(0.01)
        shared.bus.disturb_next(20)
        a.request(Frame(0x300, b""))
        await asyncio.sleep(0.01)
    a.request(Frame(0x400, b""))  # not recorded any more
    await asyncio.sleep(0.01)
    bits = [frame_bits(0x100, b"first"), frame_bits(0x200, b"second")]
    first = epoch + bits[0] * 1000
    second = first + 3000 + bits[1] * 1000
    assert entries.frames[:2] == [(EXTENDED | 0x100, b"first", 0, first), (EXTENDED | 0x200, b"second", 0, second)]
    assert [(frame[0] & ERROR, frame[1]) for frame in entries.frames[2:]] == [(ERROR, b"\0\0\1" + bytes(5)), (0, b"")]
    assert recorder.frames == 4
    assert [(each.event, each.id, each.senders, each.text) for each in entries.details] == [
        ("arbitration lost", 0x200, ("B",), ""),
        ("frame", 0x100, ("A",), ""),
        ("frame", 0x200, ("B",), ""),
        ("error", 0x300, ("A",), "bit error"),
        ("frame", 0x300, ("A",), ""),
    ]
    assert [(each.start, each.end, each.bits) for each in entries.details[1:3]] == [
        (epoch, first, bits[0]),
        (first + 3000, second, bits[1]),
    ]


@pytest.mark.virtual_time
async def test_a_simulated_bus_has_a_url() -> None:
    entries, shared = Entries(), can_bus("lab", bitrate=500_000)
    a, _ = (shared.bus.attach(CanNode(name)) for name in "AB")
    async with FrameRecorder("sim:lab,bitrate=500000,slots=20", entries.put) as recorder:
        a.request(Frame(0x100, b"first"))
        await asyncio.sleep(0.01)
    assert recorder.bus == BusInfo("lab", "sim:lab", 500_000, 20, 10 * MS)
    assert [frame[:2] for frame in entries.frames] == [(EXTENDED | 0x100, b"first")]


@pytest.mark.anyio
async def test_an_interface_of_python_can_is_recorded() -> None:
    channel = f"record{next(_channels)}"
    entries, arrived = Entries(), asyncio.Event()

    def put(new: list[BagEntry]) -> None:
        entries.extend(new)
        if len(entries.frames) == 4:
            arrived.set()

    with can.Bus(interface="virtual", channel=channel) as peer:
        async with FrameRecorder(f"rtcan:virtual:{channel}", put) as recorder:
            peer.send(can.Message(arbitration_id=0x123, is_extended_id=False, data=b"abc"))
            peer.send(can.Message(arbitration_id=0x1234567, is_extended_id=True, data=b"12345678"))
            peer.send(can.Message(arbitration_id=0x12, is_extended_id=False, is_remote_frame=True, dlc=5))
            peer.send(can.Message(arbitration_id=0x13, is_extended_id=False, is_fd=True, data=bytes(64)))
            peer.send(can.Message(arbitration_id=0x8, is_extended_id=False, is_error_frame=True, data=b"\0\0\4"))
            async with asyncio.timeout(30):
                await arrived.wait()
    assert [frame[:2] for frame in entries.frames] == [
        (0x123, b"abc"),
        (EXTENDED | 0x1234567, b"12345678"),
        (REMOTE | 0x12, bytes(5)),
        (ERROR | 0x8, b"\0\0\4" + bytes(5)),
    ]
    assert recorder.lost == {"CAN FD": 1}
    assert [(each.event, each.count, each.text) for each in entries.details] == [("up", 0, ""), ("lost", 1, "CAN FD")]
    assert recorder.bus.topic == f"/virtual_{channel}/frames"


@pytest.mark.anyio
@pytest.mark.parametrize("url", ["tcp:localhost:1", "rtcan:virtual", "rtcan:can0,slots=x"])
async def test_a_url_without_a_can_bus_is_refused(url: str) -> None:
    with pytest.raises(TransportError, match=r"CAN bus|lacks the channel|slots=x"):
        FrameRecorder(url, Entries().put)


@pytest.mark.anyio
async def test_an_interface_that_fails_for_good_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    """The driver is gone when the adapter is plugged in again."""
    entries, reports, plugged = Entries(), asyncio.Queue[str](), asyncio.Event()

    async def run(_port: PythonCanPort, listener: CanPortListener, opened: Callable[[], object]) -> None:
        opened()
        listener.on_up()
        await plugged.wait()
        raise TransportError("rtcan:virtual:gone: no driver")

    monkeypatch.setattr(PythonCanPort, "run", run)
    async with FrameRecorder("rtcan:virtual:gone", entries.put, report=reports.put_nowait):
        assert await reports.get() == "rtcan:virtual:gone is up"
        plugged.set()
        assert "no driver; its frames are recorded no more" in await reports.get()
    assert [each.event for each in entries.details] == ["up", "down"]
