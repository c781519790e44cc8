"""`rtcan:r2psim:NAME`: a served bus as the port of a monitor, a recording or a module."""

from __future__ import annotations

import asyncio
from contextlib import closing
from typing import TYPE_CHECKING

import pytest

import r2p
import r2p.sim
from r2p.bus import BusMonitor, FrameKind
from r2p.codecs.can_bits import Frame, OtherFrame
from r2p.errors import TransportError
from r2p.msg import Led
from r2p.protocols.can_orders import Mailbox, Outcome, Transmit, Withdraw
from r2p.recording.frame_recorder import FrameRecorder
from r2p.sim import can_bus
from r2p.sim.buses import AttachmentOptions, attach
from r2p.sim.buses.driver import BusDriver
from r2p.sim.buses.port import ServedBusPort
from r2p.sim.buses.server import serve_bus
from r2p.sim.can import ErrorKind, FrameRecord
from r2p.sim.clocks import PacedClock
from r2p.sim.loop import VirtualLoop
from r2p.sim.transport import SimCan
from r2p.testing.network import node_in
from r2p.transports.url import open_transport

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

pytestmark = pytest.mark.anyio
PATIENCE = 30.0  # seconds
VIA = "rtcan:r2psim:lab"
HERE = AttachmentOptions(served=False)


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))


def node(can: SimCan, name: str = "node") -> BusDriver:
    return BusDriver(can, AttachmentOptions(name=name), lambda _event: None)


def send(driver: BusDriver, *frames: Frame | OtherFrame) -> None:
    driver.queue.extend(frames)
    driver.pump()


async def until(condition: Callable[[], object]) -> None:
    async with asyncio.timeout(PATIENCE):
        while not condition():  # noqa: ASYNC110 - of objects that have no events
            await asyncio.sleep(0.002)


async def test_a_monitor_sees_what_was_on_the_bus_with_its_exact_times() -> None:
    can = SimCan()
    records: list[FrameRecord] = []
    can.bus.observers.append(records.append)
    a, _ = node(can, "a"), node(can, "b")
    states: list[str] = []
    async with serve_bus(can, "lab") as server, BusMonitor(VIA, on_status=states.append) as monitor:
        await until(lambda: server.clients)
        frames = [Frame(0x1F000000 + number, bytes(number)) for number in range(8)]
        send(a, *frames, OtherFrame(0x123, b"x"))
        seen = []
        async with asyncio.timeout(PATIENCE):
            async for each in monitor:
                seen.append(each)
                if len(seen) == 9:
                    break
        assert [each.stamp for each in seen] == [each.end for each in records]
        assert [each.frame for each in seen[:8]] == frames
        assert seen[8].kind is FrameKind.OTHER
        assert monitor.since <= seen[0].stamp
        assert list(server.clients) == ["monitor"]
    assert states == [f"{VIA} is up"]


async def test_a_monitor_acknowledges_nothing() -> None:
    can = SimCan()
    records: list[FrameRecord] = []
    can.bus.observers.append(records.append)
    alone = node(can)
    async with serve_bus(can, "lab") as server, BusMonitor(VIA):
        await until(lambda: server.clients)
        send(alone, Frame(1, b""))
        await until(lambda: len(records) > 5)
        assert {each.error for each in records} == {ErrorKind.ACK}


async def test_a_bus_that_no_program_serves_is_an_error_at_once() -> None:
    with pytest.raises(TransportError, match="no program serves the bus lab: start it with r2p bus serve lab"):
        async with BusMonitor(VIA):
            pass


def test_under_virtual_time_the_error_names_the_bus_of_the_loop() -> None:
    async def main() -> None:
        with pytest.raises(
            TransportError, match="rtcan:r2psim:lab is a bus in real time: under virtual time use sim:lab"
        ):
            await ServedBusPort("lab", 1_000_000).run(Listener(), lambda: None)

    r2p.sim.run(main)


async def test_a_bus_in_a_thread_of_this_process_is_seen_with_its_exact_times() -> None:
    with closing(attach("lab", HERE)) as a, closing(attach("lab", HERE)) as b:
        async with BusMonitor(VIA) as monitor:
            a.send(Frame(1, b"abc"))
            async with asyncio.timeout(PATIENCE):
                seen = await anext(aiter(monitor))
            event = await asyncio.to_thread(b.receive, PATIENCE)
        assert event is not None
        assert (seen.frame, seen.stamp) == (event.frame, event.end)
        assert monitor.since <= seen.stamp
        a.send(Frame(2, b""))  # the bus goes on without the monitor
        event = await asyncio.to_thread(b.receive, PATIENCE)
        assert event is not None
        assert event.frame == Frame(2, b"")
    with pytest.raises(TransportError, match="no program serves the bus lab"):
        async with BusMonitor(VIA):
            pass


async def test_a_bus_of_this_event_loop_is_seen_too() -> None:
    can = can_bus("lab")
    a, _ = node(can, "a"), node(can, "b")
    async with BusMonitor(VIA) as monitor:
        send(a, Frame(1, b"abc"))
        async with asyncio.timeout(PATIENCE):
            assert (await anext(aiter(monitor))).frame == Frame(1, b"abc")


async def test_a_module_uses_a_bus_in_a_thread_of_this_process() -> None:
    with closing(attach("lab", HERE)) as spy:
        async with (
            r2p.Module("A", via=VIA, watchdog=False) as module_a,
            r2p.Module("B", via="sim:lab", watchdog=False) as module_b,
            node_in(module_a) as alice,
            node_in(module_b) as bob,
        ):
            publisher, subscriber = alice.advertise("leds", Led), bob.subscribe("leds", Led)
            await publisher.wait_subscriber()
            fetching = asyncio.create_task(subscriber.fetch())
            while not fetching.done():  # a busy computer loses its master, and events with it
                await publisher.publish(Led(led=7))
                await asyncio.wait([fetching], timeout=0.1)
            assert fetching.result() == Led(led=7)
        assert spy.receive(0) is not None


async def test_another_bit_rate_is_an_error() -> None:
    async with serve_bus(SimCan(bitrate=500_000), "lab"):
        with pytest.raises(TransportError, match="the bus lab has 500000 bit/s, not 1000000"):
            async with BusMonitor(VIA):
                pass
        async with BusMonitor(f"{VIA},bitrate=500000,slots=20") as monitor:
            assert monitor.timing.bit == 2_000


async def test_a_server_may_end_and_come_back() -> None:
    states: list[str] = []
    can = SimCan()
    a, _ = node(can, "a"), node(can, "b")
    async with serve_bus(can, "lab"):
        monitor = BusMonitor(VIA, on_status=states.append)
        await monitor.__aenter__()
    await until(lambda: len(states) == 3)
    async with serve_bus(can, "lab") as server:
        await until(lambda: server.clients)
        send(a, Frame(1, b""))
        async with asyncio.timeout(PATIENCE):
            assert (await anext(aiter(monitor))).frame == Frame(1, b"")
        await monitor.__aexit__()
    up, down, waiting, again = states
    assert up == again == f"{VIA} is up"
    assert down.startswith(f"{VIA} is down: the program that served the bus lab has ended")
    assert waiting.startswith(f"{VIA}: no program serves the bus lab")


class Listener:
    """Notes what a port reports."""

    def __init__(self) -> None:
        self.frames: list[tuple[Frame | OtherFrame, int]] = []
        self.confirmed: list[tuple[Mailbox, Outcome, int]] = []
        self.up: list[str] = []
        self.faults: list[str] = []

    def on_frame(self, frame: Frame, stamp: int) -> None:
        self.frames.append((frame, stamp))

    def on_other_frame(self, frame: OtherFrame, stamp: int) -> None:
        self.frames.append((frame, stamp))

    def on_confirmed(self, mailbox: Mailbox, outcome: Outcome, at: int) -> None:
        self.confirmed.append((mailbox, outcome, at))

    def on_up(self) -> None:
        self.up.append("up")

    def on_down(self, reason: str) -> None:
        self.up.append(reason)

    def on_waiting(self, reason: str) -> None:
        self.up.append(reason)

    def on_fault(self, kind: str) -> None:
        self.faults.append(kind)

    def internal_error(self, error: Exception) -> None:
        raise error


async def test_a_module_s_frames_are_confirmed_with_their_exact_ends() -> None:
    can = SimCan()
    records: list[FrameRecord] = []
    can.bus.observers.append(records.append)
    other = node(can)
    port, listener = ServedBusPort("lab", 1_000_000), Listener()
    async with serve_bus(can, "lab"):
        port.set_filters([(0, 1)])
        running = asyncio.create_task(port.run(listener, lambda: None))
        await until(lambda: listener.up == ["up"])
        port.transmit(Transmit(Frame(0x80, b"hard"), Mailbox.HRT, port.now()))
        port.transmit(Transmit(Frame(0x90, b"soft"), Mailbox.SRT, port.now()))
        port.transmit(Transmit(Frame(0xA0, b"never"), Mailbox.NRT, port.now() + 10**12))
        port.withdraw(Withdraw(Mailbox.NRT))
        await until(lambda: len(listener.confirmed) == 3)
        late, *sent = listener.confirmed
        assert late[:2] == (Mailbox.NRT, Outcome.LATE)
        assert sent == [(Mailbox.HRT, Outcome.SENT, records[0].end), (Mailbox.SRT, Outcome.SENT, records[1].end)]
        send(other, Frame(3, b"filtered"), Frame(2, b"passes"))
        await until(lambda: listener.frames)
        assert listener.frames == [(Frame(2, b"passes"), records[3].end)]
        can.power_off()
        await until(lambda: "down" in listener.up)
        running.cancel()
        await asyncio.wait([running])


async def test_frames_are_recorded() -> None:
    can = SimCan()
    a, _ = node(can, "a"), node(can, "b")
    entries: list[object] = []
    async with serve_bus(can, "lab") as server, FrameRecorder(VIA, entries.extend) as recorder:
        await until(lambda: server.clients)
        send(a, Frame(0x123, b"abc"), OtherFrame(0x7F, b""))
        await until(lambda: recorder.frames >= 2)
    frames = [frame for each in entries for frame in getattr(each, "frames", [])]
    assert [(identifier, data) for identifier, data, _, _ in frames] == [(0x123 | 1 << 31, b"abc"), (0x7F, b"")]
    assert recorder.bus.name == "r2psim_lab"


def test_only_monitors_follow_a_bus_at_another_speed() -> None:
    async def main() -> None:
        can = can_bus("lab")
        a, _ = node(can, "a"), node(can, "b")
        async with serve_bus(can, "lab"):
            port = ServedBusPort("lab", 1_000_000)
            with pytest.raises(TransportError, match="rtcan:r2psim:lab goes 3 times as fast as real time"):
                await port.run(Listener(), lambda: None)
            async with BusMonitor(VIA) as monitor:
                send(a, Frame(1, b""))
                async for seen in monitor:
                    assert 0 <= seen.stamp - monitor.since < 60 * 10**9
                    break

    loop = VirtualLoop(clock=PacedClock(3.0))
    with asyncio.Runner(loop_factory=lambda: loop) as runner:
        runner.run(main())


def test_the_url_names_a_channel() -> None:
    with pytest.raises(TransportError, match="lacks the channel"):
        open_transport("rtcan:r2psim:")
    open_transport(VIA)
