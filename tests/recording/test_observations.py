"""What a recorder sees besides messages: what goes wrong on emulated buses and networks is in its entries."""

import asyncio
import functools
import itertools
import json
import statistics
from collections import Counter
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import TypeVar

import msgspec
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

import r2p
import r2p.sim
from r2p.clock import clock_of
from r2p.messages import Message
from r2p.modules.statistics import ModuleStatistics, PublisherStatistics, ReasonCount
from r2p.monitoring.log import LogEntry
from r2p.msg import BusTraffic, Led
from r2p.parameters.sources import read_file
from r2p.recording.entries import AttachmentEntry, BagEntry, MessageEntry
from r2p.recording.messages import (
    EVENTS,
    PARAMETERS,
    SIGNALS,
    SLOTS,
    BusState,
    ParameterValue,
    RecordedEvent,
    RecordedSignal,
    SlotTable,
)
from r2p.recording.module_watch import growth
from r2p.recording.observations import SIGNALS_MAX, Observations, log_record
from r2p.recording.timeline import slots_at, timeline
from r2p.sim.robots.emulated import Triskar2
from r2p.sim.transport import SimPort
from r2p.testing.network import Network, node_in
from r2p.transports.rtcan.link import RtcanLink
from tests.tools.rig import VIA, Firmware
from tests.transports.rtcan.networks import Lab, until

pytestmark = pytest.mark.virtual_time

SECOND = 1_000_000_000
M = TypeVar("M", bound=Message)


class Recorded:
    """What was recorded."""

    def __init__(self) -> None:
        self.entries: list[BagEntry] = []

    def messages(self, cls: type[M], channel: str = "") -> list[M]:
        return [each for _, each in self.timed(cls, channel)]

    def timed(self, cls: type[M], channel: str = "") -> list[tuple[int, M]]:
        found = [each for each in self.entries if isinstance(each, MessageEntry)]
        return [
            (each.log_time, each.message)
            for each in found
            if isinstance(each.message, cls) and (not channel or each.channel == channel)
        ]

    def events(self, *kinds: str) -> list[RecordedEvent]:
        return [each for each in self.messages(RecordedEvent, EVENTS) if not kinds or each.kind in kinds]

    def attachment(self, name: str) -> bytes:
        found = [each for each in self.entries if isinstance(each, AttachmentEntry) and each.name == name]
        assert len(found) == 1
        return found[0].data


@asynccontextmanager
async def observed(module: r2p.Module) -> AsyncIterator[Recorded]:
    recorded = Recorded()
    async with Observations(module, recorded.entries.append, {"r2p.toml": ("application/toml", b"format = 1\n")}):
        yield recorded


@pytest.mark.parametrize("stamp", [-1, 0, 1 << 80])
def test_any_stamp_of_a_log_record_is_recorded(stamp: int) -> None:
    assert log_record(LogEntry(stamp, 20, "robot1/ARM", "wrist", "ready")).name == "robot1/ARM/wrist"


async def test_the_master_dies_its_slots_are_lost_and_another_is_elected() -> None:
    bus = Lab()
    eye_module = bus.module("EYE", options={"priority": 0})
    boss_module = bus.module("BOSS", options={"priority": 9})
    async with boss_module as boss, bus.module("SPARE"), eye_module as eye, observed(bus.host("EYE")) as recorded:
        publisher = boss.advertise("encoder", Led, r2p.Periodic(0.01, Led))
        eye.subscribe("encoder", Led, queue=1, keep="newest", lossy=True)
        await publisher.ready(timeout=10.0)
        await until(lambda: "encoder" in owners(recorded))
        assert owners(recorded)["sync"] == ("BOSS", (0,))
        module, slots = owners(recorded)["encoder"]
        assert (module, len(slots)) == ("BOSS", 1)
        assert recorded.messages(SlotTable)[-1].master == "BOSS"
        port = bus.link("BOSS").driver.port
        assert isinstance(port, SimPort)
        died = clock_of().now()
        port.controller.power_off()
        await asyncio.sleep(15.0)
        assert owners(recorded) == {"sync": ("SPARE", (0,))}
    masters = [(time, each) for time, each in recorded.timed(RecordedEvent) if "master" in each.kind]
    assert [(each.kind, each.module) for time, each in masters if time > died][:2] == [
        ("no master", ""),
        ("master", "SPARE"),
    ]
    assert {each.link for _, each in masters} == {"sim:"}
    assert masters[-1][0] - died < SECOND
    assert {each.module for each in recorded.events("module silent")} == {"BOSS"}
    state = recorded.messages(BusState)[-1]
    assert (state.master, state.own, state.up) == ("SPARE", False, True)
    assert state.clock_error >= 0
    assert {each.kind for each in recorded.messages(BusTraffic)} >= {"total", "sync", "hrt"}


def owners(recorded: Recorded) -> dict[str, tuple[str, tuple[int, ...]]]:
    """The owners of slots by topic, as they were recorded last."""
    tables = recorded.messages(SlotTable, SLOTS)
    return {each.topic: (each.module, each.slots) for each in tables[-1].owners} if tables else {}


async def test_watching_a_bus_sends_nothing_on_it() -> None:
    bus = Lab()
    async with bus.module("MOTOR"), bus.module("EYE"):
        await asyncio.sleep(5.0)
        async with observed(bus.host("EYE")) as recorded:
            await asyncio.sleep(5.0)
            assert recorded.messages(BusTraffic)
            topics = bus.host("MOTOR").network.topics()
        assert not {"bus_load", "bus_slots"} & topics.keys()


async def test_each_miss_of_the_own_publishers_is_recorded_and_those_of_others_are_counted(
    r2p_network: Network,
) -> None:
    async with (
        r2p_network.module("ROBOT") as robot,
        r2p_network.module("ARM") as arm,
        node_in(robot, name="control") as own,
        node_in(arm, name="reach") as other,
        observed(robot) as recorded,
    ):
        own.subscribe("steer", Led, queue=2)
        other.subscribe("grip", Led, queue=2)
        steer = own.advertise("steer", Led, r2p.Sporadic(0.02, pending=100))
        grip = other.advertise("grip", Led, r2p.Sporadic(0.02, pending=100))
        await asyncio.sleep(2.0)
        started = clock_of().now()
        for number in range(5):
            steer.publish_nowait(Led(led=number))
            grip.publish_nowait(Led(led=number))
        await asyncio.sleep(3.0)
        assert steer.missed == grip.missed == 3
    signals = recorded.timed(RecordedSignal, SIGNALS)
    own_misses = [(time, each) for time, each in signals if each.topic == "steer" and each.kind == "missed"]
    assert [(each.source, each.count, each.sequence) for _, each in own_misses] == [
        ("publisher", 1, 3),
        ("publisher", 1, 4),
        ("publisher", 1, 5),
    ]
    assert {(each.module, each.node, each.where, each.publisher_class) for _, each in own_misses} == {
        ("ROBOT", "control", "control", 2)
    }
    assert own_misses[0][1].reason == "no room by the deadline"
    assert {time - started for time, _ in own_misses} == {20_000_000}
    counted = [each for _, each in signals if each.topic == "grip" and each.kind == "missed"]
    assert [(each.source, each.module, each.node, each.count) for each in counted] == [
        ("statistics", "ARM", "reach", 3)
    ]
    assert 0.9 < counted[0].interval < 1.5


async def test_a_flood_of_misses_is_added_up_and_none_is_lost(r2p_network: Network) -> None:
    async with r2p_network.module("ROBOT") as robot, node_in(robot) as node, observed(robot) as recorded:
        node.subscribe("steer", Led, queue=1)
        steer = node.advertise("steer", Led, r2p.Sporadic(0.02, pending=1))
        for number in range(SIGNALS_MAX + 500):
            steer.publish_nowait(Led(led=number % 256))
        await asyncio.sleep(2.0)
    signals = [each for each in recorded.messages(RecordedSignal) if each.kind == "missed"]
    assert sum(each.count for each in signals) == steer.missed > SIGNALS_MAX
    assert len(signals) < SIGNALS_MAX + 10


async def test_a_link_dies_and_comes_back(r2p_network: Network) -> None:
    async with (
        r2p_network.module("ROBOT") as robot,
        r2p_network.module("PC") as pc,
        node_in(pc) as node,
        node_in(robot, name="control") as control,
        observed(robot) as recorded,
    ):
        node.subscribe("steer", Led)
        steer = control.advertise("steer", Led, r2p.Sporadic(0.02))
        await steer.wait_subscriber()
        r2p_network.disconnect(robot)
        await asyncio.sleep(0.1)
        steer.publish_nowait(Led())
        await asyncio.sleep(1.0)
        r2p_network.connect(robot)
        await asyncio.sleep(1.0)
    first, down, up = recorded.events("link up", "link down")
    assert (first.kind, first.text) == ("link up", "as the recording began")
    assert (down.kind, up.kind, down.link) == ("link down", "link up", up.link)
    assert 1.0 < up.outage < 2.0
    signals = recorded.messages(RecordedSignal)
    assert [(each.kind, each.where, each.count) for each in signals if each.source == "publisher"] == [
        ("degraded", down.link, 0),
        ("missed", down.link, 1),
    ]


async def test_a_silent_module_delays_no_other(r2p_network: Network) -> None:
    async with (
        r2p_network.module("DEAD") as dead,
        r2p_network.module("ALIVE"),
        r2p_network.module("ROBOT") as robot,
        observed(robot) as recorded,
    ):
        await asyncio.sleep(3.0)
        r2p_network.disconnect(dead)
        silent_since = clock_of().now()
        await asyncio.sleep(20.0)
    times = [time for time, _ in recorded.timed(ModuleStatistics, "/r2p/statistics/ALIVE") if time > silent_since]
    assert len(times) > 15
    assert max(after - before for before, after in itertools.pairwise(times)) < 1.5 * SECOND
    assert [each.module for each in recorded.events("no answer", "module silent")][:1] == ["DEAD"]
    assert not [time for time, _ in recorded.timed(ModuleStatistics, "/r2p/statistics/DEAD") if time > silent_since]


async def test_firmware_that_dies_is_noted_and_its_return() -> None:
    async with r2p.Module("ROBOT", via=VIA, watchdog=False) as robot, observed(robot) as recorded:
        imu = Firmware("IMU")
        for _ in range(5):
            imu.alive()
            await asyncio.sleep(2.0)
        await asyncio.sleep(20.0)
        imu.alive()
        await asyncio.sleep(2.0)
    events = [each for each in recorded.events() if each.module == "IMU"]
    assert [each.kind for each in events] == ["module found", "module silent", "module found"]


async def test_parameters_and_their_changes_and_the_network_are_in_the_file(
    r2p_network: Network, tmp_path: Path
) -> None:
    async def control(node: r2p.Node) -> None:
        node.parameter("kp", 0.5, unit="1/s")
        node.parameter("name", "left")
        node.advertise("leds", Led)
        await asyncio.get_running_loop().create_future()

    async with r2p_network.module("ARM") as arm, r2p_network.module("ROBOT") as robot, observed(robot) as recorded:
        arm.start(control)
        await asyncio.sleep(5.0)
        await robot.network.set_parameters("ARM", {("control", "kp"): 0.75})
        await asyncio.sleep(3.0)
    values = recorded.messages(ParameterValue, PARAMETERS)
    assert {each.module for each in values} == {"ARM"}
    assert [(each.name, each.value) for each in values] == [("kp", "0.5"), ("name", '"left"'), ("kp", "0.75")]
    assert [each.number for each in values if each.name == "kp"] == [0.5, 0.75]
    assert recorded.attachment("r2p.toml") == b"format = 1\n"
    again = tmp_path / "parameters.toml"
    again.write_bytes(recorded.attachment("parameters.toml"))
    assert read_file(again, "ARM").values == {("control", "kp"): 0.5, ("control", "name"): "left"}
    network = json.loads(recorded.attachment("network.json"))
    assert {each["name"] for each in network["modules"]} == {"ROBOT", "ARM"}
    assert {"module": "ARM", "node": "control", "publishes": ["leds"], "subscribes": []} in network["nodes"]
    assert network["versions"]["r2p"] == r2p.__version__


async def test_parameters_of_a_module_that_dies_early_are_in_the_file(r2p_network: Network) -> None:
    async def control(node: r2p.Node) -> None:
        node.parameter("kp", 0.5)
        await asyncio.get_running_loop().create_future()

    async with r2p_network.module("ROBOT") as robot:
        async with r2p_network.module("ARM") as arm:
            arm.start(control)
            await asyncio.sleep(1.0)
            observing = observed(robot)
            recorded = await observing.__aenter__()
            await asyncio.sleep(1.5)
        await asyncio.sleep(3.0)
        await observing.__aexit__(None, None, None)
    assert b"kp = 0.5" in recorded.attachment("parameters.toml")


def counted(missed: int, uptime: float = 5.0, lost: int = 0) -> ModuleStatistics:
    link = r2p.LinkStatistics(link="tcp", lost=(ReasonCount("send buffer full", lost),))
    publisher = PublisherStatistics("steer", "control", 2, sent=100, missed=missed, late=1)
    return ModuleStatistics(uptime=uptime, publishers=(publisher,), links=(link,))


def test_growth_survives_restarts_and_closed_publishers() -> None:
    def grown(before: ModuleStatistics, after: ModuleStatistics, *, own: bool = False) -> Counter[str]:
        return Counter(
            {f"{each.kind} {each.reason}".strip(): each.count for each in growth("M", before, after, own=own)}
        )

    assert grown(counted(3), counted(3, 6.0)) == {}
    assert grown(counted(3), counted(5, 6.0, lost=7)) == {"missed": 2, "lost send buffer full": 7}
    assert grown(counted(3), counted(5, 6.0, lost=7), own=True) == {"lost send buffer full": 7}
    assert grown(counted(3), counted(4, 0.5)) == {"missed": 4, "late": 1}, "restarted: all of it is new"
    assert grown(counted(3), counted(1, 6.0)) == {"missed": 1}, "closed, and advertised again"
    assert grown(counted(3), msgspec.structs.replace(counted(0, 6.0), publishers=())) == {}


async def drive(path: Path) -> None:
    """Record a bus whose master dies, with a deadline that is missed before."""
    bus = Lab()
    boss_module = bus.module("BOSS", options={"priority": 9})
    async with boss_module as boss, bus.module("SPARE"), bus.module("EYE", options={"priority": 0}) as eye:
        recorder = r2p.Recorder(bus.host("EYE"), path, [])
        async with recorder:
            boss.subscribe("grip", Led, queue=1)
            grip = boss.advertise("grip", Led, r2p.Sporadic(0.02))
            publisher = boss.advertise("encoder", Led, r2p.Periodic(0.01, Led))
            eye.subscribe("encoder", Led, queue=1, keep="newest", lossy=True)
            await publisher.ready(timeout=10.0)
            await asyncio.sleep(3.0)
            grip.publish_nowait(Led())
            grip.publish_nowait(Led())
            await asyncio.sleep(2.0)
            port = bus.link("BOSS").driver.port
            assert isinstance(port, SimPort)
            port.controller.power_off()
            await asyncio.sleep(8.0)


def test_the_file_alone_says_who_owned_which_slot_and_what_was_missed(tmp_path: Path) -> None:
    path, again = tmp_path / "drive.mcap", tmp_path / "again.mcap"
    for each in (path, again):
        r2p.sim.run(functools.partial(drive, each))
    assert path.read_bytes() == again.read_bytes(), "the same run records the same bytes"
    with r2p.Bag(path) as bag:
        found = [(each.kind, each.about, each.text) for each in timeline(bag)]
        owned = {each.topic: each.module for each in slots_at(bag, bag.start + 5 * SECOND)[0].owners}
        in_the_end = {each.topic: each.module for each in slots_at(bag, bag.end)[0].owners}
        assert not bag.undecodable
    assert (owned, in_the_end) == ({"sync": "BOSS", "encoder": "BOSS"}, {"sync": "SPARE"})
    expected = [
        ("missed", "grip of BOSS/test", "no room by the deadline, as it logged"),
        ("master", "sim:", "no RTCAN master: no sync for too long"),
        ("slots", "encoder of BOSS", "has lost slot 1 on sim"),
        ("module", "BOSS", "silent"),
    ]
    assert [each for each in found if each in expected] == expected
    assert set(channels_read_by_others(path)) == {
        *("events", "signals", "buses", "slots", "bus_load", "statistics", "log", "recorder")
    }


def channels_read_by_others(path: Path) -> Iterator[str]:
    """The channels of a file, once for each message that mcap-ros2-support can read; it raises for others."""
    with path.open("rb") as file:
        for each in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            assert each.decoded_message is not None
            yield each.channel.topic.split("/")[2]


def test_questions_leave_the_bus_to_the_robot(tmp_path: Path) -> None:
    """Statistics of seven boards each second would double the load of their bus."""

    async def share(link: RtcanLink, seconds: float) -> float:
        shares: list[float] = []
        link.bus_listeners.append(lambda loads, _slots: shares.append(loads[0].share))
        await asyncio.sleep(seconds)
        link.bus_listeners.pop()
        return statistics.fmean(shares)

    async def main() -> None:
        async with Triskar2("sim:robot", seed=1) as robot, r2p.Module("PC", via="sim:robot") as pc:
            await robot.ready()
            link = next(each for each in pc.links if isinstance(each, RtcanLink))
            before = await share(link, 3.0)
            async with r2p.Recorder(pc, tmp_path / "drive.mcap", []):
                await asyncio.sleep(1.0)
                assert await share(link, 11.0) < before + 0.04

    r2p.sim.run(main)
