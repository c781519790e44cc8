"""A listener on a bus: every frame, the load, the slots; on the simulated bus, and as the tools use it."""

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator, Callable

import pytest
from typer.testing import CliRunner

import r2p
from r2p.bus import BusLoad, BusMonitor, FrameKind
from r2p.codecs.rtcan import Frame
from r2p.msg import Led
from r2p.protocols.can_orders import Transmit, Withdraw
from r2p.protocols.rtcan.monitor import TrafficCount
from r2p.sim.can import CanNode
from r2p.sim.transport import SimCan, SimPort
from r2p.tools.bus import app, slots
from r2p.tools.bus.traffic import frame_line, frame_record, listen, load_record, load_text, trouble
from r2p.tools.session import Settings, UsageError
from r2p.transports.can.port import CanPort, CanPortListener

pytestmark = pytest.mark.virtual_time

RATE = 100


@contextlib.asynccontextmanager
async def robot() -> AsyncIterator[tuple[SimCan, BusMonitor]]:
    """A module with slots of its own, one that subscribes, and a listener."""
    bus = SimCan()

    async def motor(node: r2p.Node) -> None:
        node.advertise("encoder", Led, r2p.Periodic(1 / RATE, lambda: Led(led=7)))
        node.advertise("unheard", Led, r2p.Periodic(1 / RATE, Led))
        await node.spin()

    async def watch(node: r2p.Node) -> None:
        async for _ in node.subscribe("encoder", Led):
            pass

    async with (
        r2p.Module("MOTOR", via=bus.transport()) as module,
        r2p.Module("PC", via=bus.transport()) as pc,
        BusMonitor(SimPort(bus, CanNode("listener"))) as listener,
    ):
        module.start(motor)
        pc.start(watch)
        await asyncio.sleep(6)
        yield bus, listener


async def test_frames_come_with_their_names_and_slots() -> None:
    async with robot() as (_, listener):
        seen = []
        async for each in listener:
            seen.append(each)
            if len(seen) == 500:
                break
        hrt = [each for each in seen if each.kind is FrameKind.HRT]
        assert {(each.topic, each.module) for each in hrt} == {("encoder", "MOTOR")}
        assert len({each.slot for each in hrt}) == 1
        assert listener.lost == 0


async def test_the_load_is_that_of_the_bus() -> None:
    async with robot() as (bus, listener):
        bus.bus.reset_statistics()
        load = await anext(listener.loads(5.0))
        assert load.total == pytest.approx(bus.bus.load(), rel=0.01)
        frames = load.tallies["encoder", "MOTOR", FrameKind.HRT].frames
        assert frames == pytest.approx(5 * 100.4, abs=2)


async def test_the_slots_show_their_owner_also_one_that_died() -> None:
    async with robot() as (bus, listener):
        assert await listener.cycles(20, timeout=1.0)
        owned = [slot for slot in listener.slots if "encoder" in slot.owners]
        assert [(slot.reserved, slot.missed) for slot in owned] == [(20, 0)]
        cells = slots.cells_of(listener.slots)
        assert [cell.owner for cell in cells].count("encoder") == 1
        assert cells[0].owner == "sync"
        assert [cell.owner for cell in cells].count("reserved but not used: no subscriber, or the owner is gone") == 1
        assert [row["used"] for row in slots.rows(listener.slots) if row["owner"] == "encoder"] == [20]
        bus.power_off()
        assert not await listener.cycles(20, timeout=1.0)


async def test_slow_iterations_lose_the_oldest_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("r2p.bus.QUEUE_MAX", 500)
    async with robot() as (_, listener):
        frames = aiter(listener)
        first = await anext(frames)
        await asyncio.sleep(5)
        assert listener.lost > 0
        assert (await anext(frames)).stamp > first.stamp + 1_000_000_000
        await frames.aclose()  # type: ignore[attr-defined]


async def test_an_iteration_that_ended_keeps_and_loses_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("r2p.bus.QUEUE_MAX", 500)
    async with robot() as (_, listener):
        stamps = []
        async for seen in listener:
            stamps.append(seen.stamp)
            break
        await asyncio.sleep(5)
        assert listener.lost == 0
        async for seen in listener:
            stamps.append(seen.stamp)
            break
        assert stamps[1] > stamps[0] + 5_000_000_000


async def test_a_monitor_that_is_not_open_raises_closed() -> None:
    monitor = BusMonitor(SimPort(SimCan(), CanNode("listener")))

    async def use() -> None:
        with pytest.raises(r2p.Closed, match="listener is not open: use it in an `async with` block"):
            await anext(aiter(monitor))
        with pytest.raises(r2p.Closed):
            await anext(monitor.loads(1.0))
        with pytest.raises(r2p.Closed):
            await monitor.cycles(1, timeout=1.0)

    await use()
    for read in (lambda: monitor.timing, lambda: monitor.slots, lambda: monitor.slot_cycles):
        with pytest.raises(r2p.Closed):
            read()
    async with monitor:
        with pytest.raises(r2p.Error, match="opened before"):
            await monitor.__aenter__()
    await use()
    assert monitor.timing.slots == 60


async def test_what_the_commands_print() -> None:
    async with robot() as (_, listener):
        lines, records = [], []
        async for seen in listener:
            lines.append(frame_line(seen, listener.since))
            records.append(json.loads(json.dumps(frame_record(seen, listener.since))))
            if len(lines) == 200:
                break
        encoder = next(record for record in records if record["topic"] == "encoder")
        assert encoder["kind"] == "hrt"
        assert encoder["fragments"] == 1
        assert encoder["data"] == "0700000000"
        assert any("hrt" in line and "encoder" in line and "MOTOR" in line and "1/1" in line for line in lines)
        load = await anext(listener.loads(2.0))
        text = load_text(load)
        assert text.startswith("load ")
        assert any("encoder" in line and "MOTOR" in line for line in text.splitlines())
        assert trouble(load) is None
        assert load_record(load)["load"] == pytest.approx(load.total, abs=1e-6)


async def test_a_crowded_bus_is_reported() -> None:
    async with robot() as (bus, listener):

        async def talk(node: r2p.Node) -> None:
            flood = node.advertise("flood", Led)
            await flood.wait_subscriber()
            while flood.subscribers:
                await flood.publish(Led())

        async def hear(node: r2p.Node) -> None:
            async for _ in node.subscribe("flood", Led, lossy=True):
                pass

        async with r2p.Module("LOUD", via=bus.transport()) as loud, r2p.Module("EAR", via=bus.transport()) as ear:
            loud.start(talk)
            ear.start(hear)
            await asyncio.sleep(2)
            load = await anext(listener.loads(0.2))
        assert load.free_used > 0.95
        assert "starve" in str(trouble(load))


async def test_a_bus_that_can_not_be_opened_is_an_error() -> None:
    with pytest.raises(r2p.TransportError, match="python-can"):
        async with BusMonitor("rtcan:nonsense:0"):
            pass
    with pytest.raises(r2p.TransportError, match="slots"):
        async with BusMonitor("rtcan:can0,slots=1"):
            pass


async def test_what_it_waits_for_is_reported_once() -> None:
    reported: list[str] = []
    async with BusMonitor(SimPort(SimCan(), CanNode("listener")), on_status=reported.append) as listener:
        for reason in ("no adapter", "no adapter", "no power"):
            listener.on_waiting(reason)
        listener.on_up()
        listener.on_waiting("no power")
    assert reported == [
        "listener is up",
        "listener: no adapter; trying again",
        "listener: no power; trying again",
        "listener is up",
        "listener: no power; trying again",
    ]


def test_an_invalid_topic_is_a_usage_error() -> None:
    result = CliRunner().invoke(app, ["dump", "--topic", "no-name", "--via", "rtcan:can0"])
    assert result.exit_code == 2
    assert "letters, digits and underscores" in result.stderr


@pytest.mark.parametrize(
    ("via", "text"),
    [
        ([], "rtcan:can0$"),
        (["memory:lab"], r"\(not memory:lab\)"),
        (["rtcan:can0", "rtcan:can1"], r"\(not rtcan:can0 and rtcan:can1\)"),
        (["r2psim:lab"], r"did you mean rtcan:r2psim:lab\?$"),
        (["sim:lab"], "sim: is a bus inside one program: r2p sim --bus NAME"),
    ],
)
async def test_the_commands_take_one_can_bus(via: list[str], text: str) -> None:
    with pytest.raises(UsageError, match=rf"give one CAN bus, .*{text}"):
        async with listen(Settings(via=via)):
            pass


class LatePort(CanPort):
    """A bus with one frame each `APART` ns, read by a process that can stand still: then its clock jumps."""

    APART = 5_000_000

    def __init__(self) -> None:
        super().__init__("late")
        self._stood = 0

    def now(self) -> int:
        return super().now() + self._stood

    def stand_still(self, duration: int) -> None:
        self._stood += duration

    async def run(self, listener: CanPortListener, opened: Callable[[], object]) -> None:
        opened()
        frame, stamp = Frame(20 << 23, bytes(8)), self.now() + self.APART // 2
        while True:
            for _ in range(8):  # as much as one turn of the loop reads
                if stamp <= self.now():
                    listener.on_frame(frame, stamp)
                    stamp += self.APART
            await asyncio.sleep(0.001)

    def transmit(self, order: Transmit) -> None:
        raise AssertionError

    def withdraw(self, order: Withdraw) -> None:
        raise AssertionError

    def set_filters(self, filters: list[tuple[int, int]] | None) -> None:
        assert filters is None


@pytest.mark.parametrize("stopped_at", [0.3, 0.9999, 1.0, 1.0001])
async def test_the_load_is_right_after_the_process_stood_still(stopped_at: float) -> None:
    port, reported = LatePort(), list[str]()
    async with BusMonitor(port, on_status=reported.append) as bus:
        asyncio.get_running_loop().call_later(stopped_at, port.stand_still, 2_500_000_000)
        loads = bus.loads(1.0)
        frames = [sum(tally.frames for tally in (await anext(loads)).tallies.values()) for _ in range(6)]
        await loads.aclose()  # type: ignore[attr-defined]
    assert frames == [200] * 6
    assert ["this program stood still for 2" in text for text in reported] == [True]


async def test_an_impossible_load_is_reported() -> None:
    tallies = {("", "", FrameKind.OTHER): TrafficCount(1, 2000)}
    load = BusLoad(1_000_000, 1000, tallies, {}, 0.0, 0.0, None)
    assert "200% is more than the bus can carry" in str(trouble(load))
    full = BusLoad(1_000_000, 1000, {("", "", FrameKind.OTHER): TrafficCount(1, 1001)}, {}, 0.0, 0.0, None)
    assert "100% of the free slots are used" in str(trouble(full))
