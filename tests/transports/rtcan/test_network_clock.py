"""Ticks by network time and hooks on the sync, in true time, on modules whose clocks drift and whose stamps jitter."""

from __future__ import annotations

import asyncio
import itertools
import logging
import random
from contextlib import AsyncExitStack, asynccontextmanager
from typing import TYPE_CHECKING, Any

import pytest

import r2p
from r2p.clock import clock_of
from r2p.errors import Error, TransportError
from r2p.msg import Led
from r2p.protocols.rtcan.events import Profile
from r2p.protocols.rtcan.master import Role
from r2p.sim.can import Latency
from r2p.testing.network import node_in
from r2p.transports.memory import MemoryNetwork
from tests.transports.rtcan.networks import CYCLE, Lab, until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

pytestmark = pytest.mark.virtual_time

PERIOD = 0.01
NS = 10_000_000
SECOND = 1_000_000_000
LATENCY = 4_000


class Board:
    """A module whose node notes the true instants of its ticks and syncs."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.ticks: dict[tuple[int, int], tuple[int, r2p.NetworkTick]] = {}
        self.syncs: dict[tuple[int, int], tuple[int, r2p.Sync]] = {}

    async def run(self, node: r2p.Node) -> None:
        node.on_sync(self.on_sync)
        async for tick in node.every(PERIOD, clock="network"):
            assert (tick.epoch, tick.time) not in self.ticks
            self.ticks[tick.epoch, tick.time] = clock_of().monotonic(), tick

    def on_sync(self, sync: r2p.Sync) -> None:
        assert (sync.epoch, sync.time) not in self.syncs
        self.syncs[sync.epoch, sync.time] = clock_of().monotonic(), sync

    def forget(self) -> None:
        self.ticks.clear()
        self.syncs.clear()


@asynccontextmanager
async def boards(
    count: int, *, jitter: int = 0, ppm: float = 100.0, **node: object
) -> AsyncIterator[tuple[Lab, list[Board]]]:
    """Modules whose clocks differ by up to `ppm` either way, and by a second; the first one becomes the master."""
    made, numbers = Lab(), random.Random(1)
    latency = Latency(LATENCY, jitter)
    async with AsyncExitStack() as stack:
        found = [Board(f"M{number}") for number in range(count)]
        for number, board in enumerate(found):
            drift = numbers.uniform(-ppm, ppm) if 0 < number < count - 1 else (-ppm if number else ppm)
            settings = {"offset": numbers.randrange(SECOND), "transmit": latency, "receive": latency} | node
            chosen: dict[str, object] = {"priority": max(1, 200 - number), "id": number + 1}
            await stack.enter_async_context(made.module(board.name, options=chosen, drift_ppm=drift, **settings))
            made.host(board.name).start(board.run)
        await until(lambda: all(len(board.ticks) > 64 for board in found))
        for board in found:
            board.forget()
        yield made, found


def misalignment(events: list[dict[tuple[int, int], int]], least: int) -> int:
    """The largest true time between two modules at what they call one instant (ns)."""
    common = set.intersection(*(set(each) for each in events))
    assert len(common) >= least
    return max(max(each[key] for each in events) - min(each[key] for each in events) for key in common)


def ticks_of(found: list[Board]) -> list[dict[tuple[int, int], int]]:
    return [{key: at for key, (at, _) in board.ticks.items()} for board in found]


def syncs_of(found: list[Board]) -> list[dict[tuple[int, int], int]]:
    return [{key: at for key, (at, _) in board.syncs.items()} for board in found]


@pytest.mark.parametrize(
    ("count", "jitter", "limit"), [(2, 0, 300), (2, 1_000, 2_000), (2, 3_000, 6_000), (20, 1_000, 2_000)]
)
async def test_modules_tick_and_latch_at_the_same_instants(count: int, jitter: int, limit: int) -> None:
    async with boards(count, jitter=jitter) as (_, found):
        await asyncio.sleep(3.0)
        assert misalignment(syncs_of(found), 290) <= 2 * jitter
        assert misalignment(ticks_of(found), 290) <= limit
        for board in found:
            ticks = [tick for _, tick in board.ticks.values()]
            assert {tick.time % NS for tick in ticks} == {0}
            assert {after.time - before.time for before, after in itertools.pairwise(ticks)} == {NS}
            assert not any(tick.skipped or not tick.aligned for tick in ticks)
            assert all(abs(at - tick.due) <= 1 and abs(tick.late) < 1e-8 for at, tick in board.ticks.values())


async def test_a_sync_says_when_it_was() -> None:
    async with boards(3) as (made, found):
        made.clear()
        await asyncio.sleep(1.0)
        ends = {each.end for each in made.sent(lambda found: found.message_id < 256)}
        for board in found:
            assert {at - LATENCY for at, _ in board.syncs.values()} <= ends
            syncs = [sync for _, sync in board.syncs.values()]
            assert {round(sync.late * 1e9) for sync in syncs} == {LATENCY}
            assert all(100_000 < sync.time % CYCLE < 166_000 for sync in syncs)
            assert not any(sync.skipped for sync in syncs)
            assert all(abs(at - LATENCY - sync.due) <= 2 for at, sync in board.syncs.values())


async def test_a_module_that_misses_syncs_ticks_on_and_counts_them() -> None:
    async with boards(2, loss=0.3) as (_, found):
        await asyncio.sleep(3.0)
        assert misalignment(ticks_of(found), 290) <= 2_000
        slave = [sync for _, sync in found[1].syncs.values()]
        assert len(slave) < 280
        missed = (slave[-1].time - slave[0].time + CYCLE // 2) // CYCLE + 1 - len(slave)
        assert sum(sync.skipped for sync in slave[1:]) == missed


def on_the_grid(board: Board) -> list[r2p.NetworkTick]:
    ticks = [tick for _, tick in board.ticks.values()]
    assert ticks
    return ticks


async def test_ticks_go_on_while_another_master_is_elected() -> None:
    async with boards(4, jitter=1_000) as (made, found):
        await asyncio.sleep(1.0)
        made.can.port("M0").power_off()
        await asyncio.sleep(3.0)
        assert made.link("M1").engine.election.role is Role.MASTER
        assert misalignment(ticks_of(found[1:]), 390) < 6_000
        syncs = syncs_of(found[1:])
        assert set(syncs[0]) == set(syncs[1]) == set(syncs[2])  # also the first one of the new master
        assert misalignment(syncs, 380) <= 2_000
        for board in found[1:]:
            ticks = on_the_grid(board)
            assert {after.time - before.time for before, after in itertools.pairwise(ticks)} == {NS}
            assert len({tick.epoch for tick in ticks}) == 1
            assert all(tick.aligned and not tick.skipped for tick in ticks)


async def test_without_a_sync_for_long_ticks_go_on_by_the_local_clock_and_the_log_says_so(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async with boards(2) as (made, found):
        events = made.host("M1").events()
        made.can.port("M1").power_off()
        await asyncio.sleep(10.0)
        mine = on_the_grid(found[1])
        assert {after.time - before.time for before, after in itertools.pairwise(mine)} == {NS}
        assert 280 <= sum(tick.aligned for tick in mine) <= 300
        assert not mine[-1].aligned
        assert misalignment(ticks_of(found), 990) < 20_000  # by a clock that is off by 200 ppm, but knows it
        assert made.link("M1").engine.counts["network time lost"] == 1
        with caplog.at_level(logging.INFO):
            made.can.port("M1").power_on()
            await asyncio.sleep(10.0)
        assert "ticks by network time follow the master" in caplog.text
        assert on_the_grid(found[1])[-1].aligned
        assert misalignment(ticks_of(found), 1900) < 20_000
        kinds: list[str] = []
        while not kinds or kinds[-1] != "network time":
            event = await anext(events)
            kinds += [event.kind] if isinstance(event, r2p.LinkNotice) else []
        assert "no network time" in kinds


@pytest.mark.parametrize("delay", [0.0, 0.0033, 0.5, 5.0])
async def test_another_run_of_the_network_repeats_no_tick(delay: float) -> None:
    """A new master, which never heard of the network before, begins another one."""
    made = Lab()
    first, second = Board("S1"), Board("S2")
    slave: dict[str, object] = {"priority": 0}
    async with (
        made.module("S1", options=slave, drift_ppm=90.0),
        made.module("S2", options=slave, drift_ppm=-90.0, offset=SECOND),
    ):
        made.host("S1").start(first.run)
        made.host("S2").start(second.run)
        async with made.module("OLD", options={"priority": 9}):
            await until(lambda: len(first.ticks) > 100)
        await asyncio.sleep(delay)
        async with made.module("NEW", options={"priority": 9}):
            await asyncio.sleep(5.0)
        for board in first, second:
            ticks = on_the_grid(board)
            assert len({tick.epoch for tick in ticks}) == 2
            gaps = [after.due - before.due for before, after in itertools.pairwise(ticks)]
            assert min(gaps) >= NS // 2
            assert max(gaps) < 3 * NS
            periods = (ticks[-1].due - ticks[0].due) / NS
            assert abs(len(ticks) - 1 + sum(tick.skipped for tick in ticks[1:]) - periods) <= 1
        assert misalignment(ticks_of([first, second]), 300) < 400_000  # by 180 ppm, while there is no master


async def test_ticks_wait_for_the_network_and_say_so(caplog: pytest.LogCaptureFixture) -> None:
    made = Lab()
    async with made.module("A", options={"priority": 0}) as node:
        waiting = asyncio.ensure_future(anext(node.every(PERIOD, clock="network")))
        await asyncio.sleep(6.0)
        assert not waiting.done()
        assert "ticks by network time wait: there is no master on this bus" in caplog.text
        async with made.module("B", options={"priority": 9}):
            tick = await waiting
            assert tick.time % NS == 0
            assert tick.epoch


async def test_without_rtcan_ticks_are_those_of_utc() -> None:
    network, seen = MemoryNetwork(), []

    async def follow(node: r2p.Node) -> None:
        await asyncio.sleep(0.001 * len(node.module))
        async for tick in node.every(PERIOD, clock="network"):
            assert node.now() == tick.time
            seen.append((tick.time, tick.epoch, tick.skipped, tick.aligned))

    async with r2p.Module("A", via=network.transport("a")) as one, r2p.Module("BB", via=network.transport("b")) as two:
        one.start(follow)
        two.start(follow)
        await asyncio.sleep(1.0)
    assert {seen.count(each) for each in seen[:-1]} == {2}
    assert sorted({time for time, *_ in seen}) == list(range(seen[0][0], seen[-1][0] + 1, NS))
    assert {each[1:] for each in seen} == {(0, 0, True)}
    assert seen[0][0] % NS == 0


async def test_a_slow_body_skips_ticks() -> None:
    made = Lab()
    async with made.module("A") as node:
        ticks = node.every(PERIOD, clock="network")
        first = await anext(ticks)
        await asyncio.sleep(0.035)
        late = await anext(ticks)
        assert (late.time - first.time, late.skipped) == (3 * NS, 2)
        assert late.late == pytest.approx(0.005, abs=1e-6)
        assert (await anext(ticks)).time - late.time == NS


async def test_a_tick_that_is_waited_for_keeps_virtual_time_going() -> None:
    made = Lab()
    async with made.module("A") as node:
        tick = await anext(node.every(25.0, clock="network"))
        assert tick.time == 25 * SECOND


async def test_who_does_not_ask_for_syncs_gets_none() -> None:
    made = Lab()
    async with made.module("A") as node:
        engine = made.link("A").engine
        assert not engine._context.report_syncs
        async for _ in (ticks := node.every(PERIOD, clock="network")):
            assert engine._context.report_syncs
            break
        await ticks.aclose()  # type: ignore[attr-defined]
        assert not engine._context.report_syncs


async def test_firmware_has_no_time() -> None:
    made = Lab()
    async with made.module("A", options={"profile": Profile.FIRMWARE}) as node:
        tick = await anext(node.every(PERIOD, clock="network"))
        assert tick.epoch == 0
        assert tick.time == node.now()
        with pytest.raises(TransportError, match="needs a link with RTCAN"):
            node.on_sync(print)


async def test_a_hook_ends_with_its_node_and_its_error_is_the_node_s() -> None:
    made = Lab()
    calls: list[r2p.Sync] = []

    async def latch(node: r2p.Node, callback: Callable[[r2p.Sync], object]) -> None:
        node.on_sync(callback)
        while True:
            await node.spin()

    def fail(sync: r2p.Sync) -> None:
        calls.append(sync)
        raise ValueError(f"at {sync.time}")

    async def crashing() -> None:
        async with r2p.Module("C", via=made.can.transport()) as third:
            third.start(latch, fail, name="bad")
            await third.wait()

    async with made.module("A"), made.module("B"):
        module = made.host("A")
        good: list[r2p.Sync] = []
        running = module.start(latch, good.append, name="good")
        await until(lambda: good)
        with pytest.raises(r2p.NodeCrashed) as crash:
            await crashing()
        assert isinstance(crash.value.exceptions[0], ValueError)
        assert len(calls) == 1
        await module.stop_node(running.name)
        count = len(good)
        await asyncio.sleep(0.1)
        assert len(good) == count


async def test_on_sync_says_what_it_needs() -> None:
    async with r2p.Module("A", via=MemoryNetwork().transport("a")) as module, node_in(module) as node:
        with pytest.raises(TransportError, match="on_sync\\(\\) needs a link with RTCAN"):
            node.on_sync(print)


async def test_a_coroutine_function_is_no_hook() -> None:
    made = Lab()

    async def latch(sync: r2p.Sync) -> None: ...

    async with made.module("A") as node:
        with pytest.raises(Error, match="can't be a coroutine function"):
            node.on_sync(latch)
        with pytest.raises(r2p.MessageError, match="'local' or 'network'"):
            node.every(0.1, clock="utc")  # type: ignore[call-overload]
        node.advertise("leds", Led)


async def test_a_stamp_in_network_time_is_utc_at_a_pc_behind_a_gateway() -> None:
    """Of samples that were latched at a sync, and at a tick; all clocks of the bus are wrong, each in another way."""
    made, lan = Lab(), "memory:lan?delay=0.003"
    latency = Latency(LATENCY, 1_000)
    master: dict[str, Any] = {"offset": 7 * SECOND, "drift_ppm": 100.0, "transmit": latency, "receive": latency}
    sensor: dict[str, Any] = {"offset": 3 * SECOND, "drift_ppm": -100.0, "transmit": latency, "receive": latency}
    bus = made.can.transport(drift_ppm=50.0, offset=SECOND, receive=latency)
    true: dict[int, int] = {}

    async def sample(node: r2p.Node) -> None:
        stamps = node.advertise("stamps", r2p.Timestamp)
        latched: list[r2p.Sync] = []

        def latch(sync: r2p.Sync) -> None:
            true[sync.time] = clock_of().now() - LATENCY
            latched[:] = [sync]

        node.on_sync(latch)
        async for tick in node.every(0.1, clock="network"):
            true[tick.time] = clock_of().now()
            await stamps.publish(r2p.Timestamp.from_ns(tick.time))
            await stamps.publish(r2p.Timestamp.from_ns(latched[0].time))

    async with (
        made.module("MASTER", options={"priority": 9}, **master),
        made.module("SENSOR", **sensor),
        r2p.Module("GW", via=[bus, lan], bridge=True),
        r2p.Module("PC", via=lan) as pc,
        node_in(pc) as laptop,
    ):
        made.host("SENSOR").start(sample)
        subscriber = laptop.subscribe("stamps", r2p.Timestamp, queue=100)
        seen, epochs = 0, set()
        async for found in subscriber.samples():
            if found.clock is None or laptop.now() < 1_356_998_400 * SECOND + 15 * SECOND:
                continue  # the gateway has not measured it yet
            time = found.message.ns
            assert 1_000 <= found.clock.error < 20_000
            assert abs(found.clock.utc(time) - true[time]) <= found.clock.error + 5_000
            epochs.add(found.clock.epoch)
            seen += 1
            if seen == 40:
                break
        assert len(epochs) == 1


async def test_of_several_buses_the_first_one_s_time_counts() -> None:
    """Its syncs, too; the other bus has another master and another time."""
    first, second = Lab(), Lab()
    board = Board("GW")
    latency = Latency(LATENCY)
    node: dict[str, Any] = {"transmit": latency, "receive": latency}
    async with first.module("A", options={"priority": 9}, **node), second.module("B", options={"priority": 9}, **node):
        await asyncio.sleep(0.7777)
        links = [first.can.transport(**node), second.can.transport(offset=5_000, **node)]
        async with r2p.Module("GW", via=links, watchdog=False) as gateway:
            gateway.start(board.run)
            await until(lambda: len(board.ticks) > 50)
            other = Board("A")
            first.host("A").start(other.run)
            await until(lambda: len(other.ticks) > 50)
            assert {epoch for epoch, _ in board.ticks} == {first.link("A").engine.network.epoch}
            assert misalignment(ticks_of([board, other]), 50) < 300
            assert misalignment(syncs_of([board, other]), 50) == 0
            assert gateway.links[1].network_clock() is not None  # it is there for whoever asks, and costs nothing
