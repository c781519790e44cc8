"""The figures of a network, compared with what a simulated bus and the modules themselves say."""

import asyncio
from collections.abc import Callable
from typing import Any

import msgspec
import pytest

import r2p
from r2p.codecs import rtcan
from r2p.modules.graph import TopicView
from r2p.monitoring.monitor import NetworkMonitor
from r2p.monitoring.polling import can_be_asked
from r2p.monitoring.rows import TopicRow
from r2p.monitoring.snapshot import ModuleFigures, NetworkSnapshot, TopicFigures
from r2p.msg import Led, String
from r2p.testing.network import Network, node_in
from tests.tools.rig import VIA, Firmware, keep_types
from tests.transports.rtcan.networks import CYCLE, Lab, until

pytestmark = pytest.mark.virtual_time

SECOND = 1_000_000_000


async def figures(monitor: NetworkMonitor, ready: Callable[[NetworkSnapshot], object]) -> NetworkSnapshot:
    """Wait for a snapshot that has what is wanted."""
    async with asyncio.timeout(60.0):
        while not ready(snapshot := await monitor.changed()):
            pass
    return snapshot


async def test_rates_loads_and_slots_are_those_of_the_exact_bus() -> None:
    bus = Lab()
    async with (
        bus.module("BOSS", options={"priority": 9}) as boss,
        bus.module("EYE", options={"priority": 0}) as eye,
        NetworkMonitor(bus.host("EYE")) as monitor,
    ):
        publisher = boss.advertise("encoder", Led, r2p.Periodic(0.01, Led))
        eye.subscribe("encoder", Led, lossy=True)
        await publisher.ready(timeout=10.0)
        await asyncio.sleep(5.0)
        loads = [(await figures(monitor, bool)).buses[0] for _ in range(8)]
        hrt = bus.hrt("BOSS")
        syncs = bus.sent(lambda each: each.laxity == rtcan.HRT and rtcan.high_byte(each.message_id) == 0)
        snapshot = monitor.snapshot
    encoder = next(each for each in snapshot.topics if each.name == "encoder")
    assert (encoder.rate_source, encoder.size, encoder.type) == ("counters", 5, "r2p_msgs/Led")
    assert encoder.rate == pytest.approx(SECOND / CYCLE, rel=2e-3)
    assert encoder.bandwidth == pytest.approx(5 * (encoder.rate or 0.0))
    assert encoder.laxity is None or encoder.laxity > 0.009  # before it has slots, the first one may go as an event
    rows = [each for load in loads for each in load.topics if (each.kind, each.topic) == ("hrt", "encoder")]
    bits = hrt[-1].bits + 3  # with the intermission; all messages are equal
    assert [each.frames for each in rows] == pytest.approx([SECOND / CYCLE] * len(loads), abs=1.0)
    assert [each.share for each in rows] == pytest.approx([each.frames * bits * 1e-6 for each in rows], rel=1e-5)
    owners = {each.topic: (each.module, each.slots) for each in loads[-1].slots}
    began = max(each.start for each in syncs if each.start <= hrt[-1].start)
    assert owners == {"sync": ("BOSS", [0]), "encoder": ("BOSS", [round((hrt[-1].start - began) * 60 / CYCLE)])}
    assert (loads[-1].name, loads[-1].master, loads[-1].slots_in_cycle) == ("sim", "BOSS", 60)
    assert loads[-1].share == pytest.approx(sum(each.share for each in loads[-1].topics), rel=1e-5)


def topic(snapshot: NetworkSnapshot, name: str) -> TopicFigures:
    return next(each for each in snapshot.topics if each.name == name)


async def test_what_is_measured_is_exact_rate_bytes_latency_and_losses() -> None:
    network = Network(delay=0.005, seed=3)
    async with network.node("ARM") as node, network.module("PC", observer=True) as pc, NetworkMonitor(pc) as monitor:
        publisher = node.advertise("pose", String)
        monitor.measure("pose")
        monitor.measure("pose")
        await until(lambda: "pose" in pc.network.topics())
        await asyncio.sleep(5.0)
        network.loss = 0.1
        received = pc.links[0].stats.received
        for _ in range(2000):
            await publisher.publish(String(data="x" * 6))
            await asyncio.sleep(0.01)
        network.loss = 0.0
        await publisher.publish(String())
        await asyncio.sleep(0.1)  # for as long as it is on the way
        await figures(monitor, lambda snapshot: topic(snapshot, "pose").latency)
        received = pc.links[0].stats.received - received
        found = topic(monitor.snapshot, "pose")
        assert found.measured
        assert found.lost_on_way == publisher.sent - received > 100
        assert found.lost_here == 0
        assert found.latency is not None
        assert [found.latency.p50, found.latency.p99] == pytest.approx([0.005, 0.005])
        assert found.rate_source == "counters"
        monitor.stop_measuring("pose")
        assert topic(await monitor.changed(), "pose").measured
        monitor.stop_measuring("pose")
        found = topic(await monitor.changed(), "pose")
        assert (found.measured, found.latency, found.lost_here) == (False, None, None)
        monitor.stop_measuring("pose")  # once too often


async def test_a_module_that_does_not_answer_has_unknown_rates_and_a_measured_one() -> None:
    network = Network()
    async with network.module("ARM") as arm, node_in(arm) as node, network.module("PC", observer=True) as pc:
        keep_types(arm)
        node.advertise("joint", Led, r2p.Periodic(0.02, Led))
        async with NetworkMonitor(pc) as monitor:
            snapshot = await figures(monitor, lambda each: _module(each, "ARM").answers is False)
            joint = topic(snapshot, "joint")
            assert (joint.rate, joint.rate_source, joint.missed, joint.lost_on_way) == (None, None, None, None)
            assert "rate" not in msgspec.json.decode(msgspec.json.encode(joint))
            monitor.measure("joint")
            await asyncio.sleep(20.0)
            joint = topic(monitor.snapshot, "joint")
            assert joint.rate_source == "measured"
            assert joint.rate == pytest.approx(50.0, rel=0.01)
            assert joint.bandwidth == pytest.approx(50.0 * 5, rel=0.01)


def _module(snapshot: NetworkSnapshot, name: str) -> ModuleFigures:
    return next((each for each in snapshot.modules if each.name == name), ModuleFigures(name, "", "", 0.0))


async def test_rates_are_there_after_seconds_also_where_answers_are_slow() -> None:
    network = Network(delay=0.15)  # an answer takes 0.3 s: afterwards it is asked for each 10 s
    async with network.module("ARM") as arm, node_in(arm) as node, network.module("PC", observer=True) as pc:
        node.advertise("joint", Led, r2p.Periodic(0.01, Led))
        await until(lambda: _is_known(pc, "ARM"))
        started = asyncio.get_running_loop().time()
        async with NetworkMonitor(pc) as monitor:
            snapshot = await monitor.ready()
            assert asyncio.get_running_loop().time() - started < 3.0
            assert topic(snapshot, "joint").rate == pytest.approx(100.0, abs=1.1)
            assert topic(snapshot, "log").rate == 0.0  # which the module itself publishes


def _is_known(module: r2p.Module, name: str) -> bool:
    return any(each.name == name and can_be_asked(each) for each in module.network.modules())


async def test_a_module_that_restarts_and_a_publisher_that_comes_anew_keep_true_rates() -> None:
    network = Network()
    async with network.module("PC", observer=True) as pc, NetworkMonitor(pc) as monitor:
        for _ in range(2):
            async with network.node("ARM") as node:
                node.advertise("joint", Led, r2p.Periodic(0.01, Led))
                snapshot = await figures(monitor, lambda each: any(row.rate for row in each.topics))
                for _ in range(15):
                    snapshot = await monitor.changed()
                    assert topic(snapshot, "joint").rate == pytest.approx(100.0, abs=1.1)
                assert _module(snapshot, "ARM").answers
                assert (_module(snapshot, "ARM").uptime or 0.0) < 60.0
            await figures(monitor, lambda each: not _module(each, "ARM").state)
        assert all(each.rate is None for each in monitor.snapshot.topics)
        assert {each.module for each in monitor.snapshot.links} == {"PC"}


async def test_modules_on_fast_links_are_asked_at_the_same_times(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: dict[str, list[float]] = {}
    network = Network()
    async with (
        network.module("ARM"),
        network.module("HAND"),
        network.module("PC", observer=True) as pc,
        NetworkMonitor(pc),
    ):
        read = pc.network.read_statistics

        def noted(module: str, entering: Any) -> Any:
            asked.setdefault(module, []).append(asyncio.get_running_loop().time())
            return read(module, entering)

        monkeypatch.setattr(pc.network, "read_statistics", noted)
        await asyncio.sleep(10.0)
    assert asked["ARM"][-5:] == pytest.approx(asked["HAND"][-5:], abs=1e-3)
    assert len(asked["ARM"]) in (9, 10, 11)


async def _grip(request: Led) -> Led:
    return request


async def test_losses_misses_services_nodes_and_links_are_those_of_the_modules() -> None:
    network = Network()
    async with (
        network.module("ARM") as arm,
        node_in(arm, name="wrist") as node,
        network.node("HAND") as hand,
        network.module("PC", observer=True) as pc,
        NetworkMonitor(pc) as monitor,
    ):
        slow = hand.subscribe("joint", Led, queue=4, lossy=True)
        fast = node.advertise("joint", Led)
        await until(lambda: "joint" in pc.network.topics())
        node.serve("grip", Led, Led, _grip)
        client = hand.client("grip", Led, Led)
        await client.ready(timeout=10.0)
        for number in range(3):
            await client.call(Led(led=number))
        for _ in range(100):
            await fast.publish(Led())
        snapshot = await figures(monitor, lambda each: topic(each, "joint").lost_on_way == slow.lost == 96)
        snapshot = await figures(monitor, lambda each: each.services and each.services[0].handled == 3)
    joint = topic(snapshot, "joint")
    assert [(each.module, each.node, each.waiting, each.lost) for each in joint.subscribers] == [
        ("HAND", "test", 4, {"queue full": 96})
    ]
    assert [(each.module, each.node, each.sent, each.missed, each.late) for each in joint.publishers] == [
        ("ARM", "wrist", 100, 0, 0)
    ]
    (service,) = snapshot.services
    assert (service.name, service.servers, service.type) == ("grip", ["ARM/wrist"], "r2p_msgs/Led, r2p_msgs/Led")
    assert (service.running, service.waiting, service.failed, service.refused) == (0, 0, 0, 0)
    wrist = next(each for each in _module(snapshot, "ARM").nodes if each.name == "wrist")
    assert (wrist.running, wrist.restarts, wrist.publishes) == (True, 0, ["grip_r", "joint"])
    assert {(each.module, each.name, each.up) for each in snapshot.links} == {
        (module, "memory:", True) for module in ("ARM", "HAND", "PC")
    }


async def test_topics_of_a_robot_behind_a_prefix_have_the_counters_of_its_modules() -> None:
    robot, lab = Network(), Network()
    options = r2p.BridgeOptions(prefix="robot1/", prefix_on=("memory:lab",))
    async with (
        r2p.Module("GW", via=[robot.transport("robot"), lab.transport("lab")], bridge=options, watchdog=False),
        robot.node("LONG_NAMED", name="a_long_name") as node,
        lab.module("PC", observer=True) as pc,
        NetworkMonitor(pc) as monitor,
    ):
        node.advertise("joint", Led, r2p.Periodic(0.02, Led))
        await figures(monitor, lambda each: any(row.rate for row in each.topics))
        found = topic(monitor.snapshot, "robot1/joint")
        assert found.rate == pytest.approx(50.0, abs=1.0)
        assert found.publishers[0].module == "robot1/LONG_NAMED"


async def test_rows_that_have_not_changed_are_the_same_objects_and_many_topics_are_cut(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("r2p.monitoring.monitor.TOPICS_MAX", 5)
    network = Network()
    async with network.node("ARM") as node, network.module("PC", observer=True) as pc:
        for number in range(7):
            node.advertise(f"idle{number}", Led)
        await until(lambda: len(pc.network.topics()) == 8)
        async with NetworkMonitor(pc) as monitor:
            await asyncio.sleep(33.0)  # ages go on in steps of 10 s
            before, after = monitor.snapshot, await monitor.changed()
            assert (len(after.topics), after.topics_left_out) == (5, 3)
            assert before.topics is not after.topics
            assert all(one is other for one, other in zip(before.topics, after.topics, strict=True))
            assert _module(before, "ARM") is not _module(after, "ARM")


async def test_where_the_counts_of_topics_are_is_found_out_only_after_a_change(monkeypatch: pytest.MonkeyPatch) -> None:
    found: list[str] = []

    class Counted(TopicRow):
        def __init__(self, view: TopicView, *args: Any, **options: Any) -> None:
            super().__init__(view, *args, **options)
            found.append(view.name)

    monkeypatch.setattr("r2p.monitoring.monitor.TopicRow", Counted)
    network = Network()
    async with network.node("ARM") as node, network.module("PC", observer=True) as pc, NetworkMonitor(pc) as monitor:
        node.advertise("joint", Led, r2p.Periodic(0.01, Led))
        sporadic = node.advertise("rare", Led)
        await figures(monitor, lambda each: topics_with_rates(each) >= {"joint", "rare"})
        found.clear()
        before = monitor.snapshot
        await asyncio.sleep(5.0)  # ages go on in steps of 10 s
        assert topic(monitor.snapshot, "rare") is topic(before, "rare")
        assert topic(monitor.snapshot, "joint") != topic(before, "joint")
        await sporadic.publish(Led())
        await figures(monitor, lambda each: topic(each, "rare").publishers[0].sent == 1)
        assert not found
        node.subscribe("joint", Led, lossy=True)
        await figures(monitor, lambda each: any(row.waiting is not None for row in topic(each, "joint").subscribers))
        assert {"joint", "rare"} <= set(found)


def topics_with_rates(snapshot: NetworkSnapshot) -> set[str]:
    return {each.name for each in snapshot.topics if each.rate is not None}


async def test_names_that_no_topic_can_have_are_not_measured() -> None:
    network = Network()
    async with network.module("PC", observer=True) as pc, NetworkMonitor(pc) as monitor:
        for name in ("R2P", "R2P_CALL", "a b", "x" * 300):
            with pytest.raises((r2p.InvalidName, r2p.NameTooLong)):
                monitor.measure(name)
        assert (await monitor.changed()).topics == []  # nor shows what only this tool would like to know of buses
        assert {"bus_load", "bus_slots"} == pc.network.topics().keys()
    assert pc.network.topics() == {}


async def test_firmware_says_nothing_of_its_rates() -> None:
    async with r2p.Module("PC", via=[VIA], observer=True, watchdog=False) as pc, NetworkMonitor(pc) as monitor:
        firmware = Firmware()
        firmware.alive()
        firmware.advertise("imu", 24)
        snapshot = await figures(monitor, lambda each: len(each.modules) > 1)
        imu = topic(snapshot, "imu")
        assert (imu.size, imu.rate, imu.publishers, imu.age) == (24, None, (), 0.0)
        assert _module(snapshot, "IMU").answers is None
        monitor.measure("imu")
        await monitor.changed()
        firmware.advertise("imu", 24)
        await monitor.changed()
        for _ in range(10):
            firmware.publish("imu", bytes(24))
        snapshot = await figures(monitor, lambda each: topic(each, "imu").rate)
        imu = topic(snapshot, "imu")
        assert (imu.rate_source, imu.latency, imu.lost_on_way, imu.lost_here) == ("measured", None, None, 0)
