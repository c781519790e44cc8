"""Bags are played as they were recorded: in time, in their class, byte for byte, by publishers of the same names."""

import asyncio
import itertools
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

import r2p
from r2p import PublisherClass, Sample, Source
from r2p.messages import ClockOffset
from r2p.msg import Led, Odometry, Speed3
from r2p.recording.bag import Bag
from r2p.recording.format import LATCHED, ChannelInfo
from r2p.recording.player import Player, PlayOptions
from r2p.recording.recorder import Recorder
from r2p.recording.samples import SampleWriter
from r2p.recording.writer import BagWriter
from r2p.ros.clock import RosClock
from r2p.testing.network import Network, node_in
from r2p.units import MILLISECOND as MS
from r2p.units import SECOND

pytestmark = pytest.mark.virtual_time

T0 = 1_700_000_000 * SECOND
SPORADIC, PERIODIC = PublisherClass.SPORADIC, PublisherClass.PERIODIC
Recorded = tuple[str, Sample, type[r2p.Message] | None, int]


def led(i: int, *, node: str = "leds", module: str = "IMU", topic: str = "leds") -> Recorded:
    """A message that was stamped i * 10 ms after T0, and arrived 1 to 3 ms later."""
    sample = Sample(Led(i % 8, 1).encode(), Source(module, node, "tcp"), T0 + i * 10 * MS, sequence=i + 1)
    return topic, sample, Led, sample.stamp + (i % 3 + 1) * MS


def write(path: Path, records: list[Recorded], latched: tuple[str, ...] = ()) -> Path:
    with path.open("wb") as file:
        writer = BagWriter(file)
        samples = SampleWriter(writer)
        for record in sorted(records, key=lambda each: each[3]):
            samples.write(*record)
        if latched:
            writer.add_metadata(LATCHED, dict.fromkeys(latched, "yes"))
        writer.finish()
    return path


class _Listener:
    """A module that subscribes to topics, and keeps what arrives, with the instants."""

    def __init__(self, node: r2p.Node, topics: dict[str, type[r2p.Message] | None]) -> None:
        self.arrived: list[tuple[str, int, Sample]] = []
        self.tasks = [asyncio.create_task(self._keep(node, name, cls)) for name, cls in topics.items()]

    async def _keep(self, node: r2p.Node, name: str, cls: type[r2p.Message] | None) -> None:
        subscriber = node.subscribe(name, cls) if cls is not None else node.subscribe(name, None)
        async for sample in subscriber.samples():
            self.arrived.append((name, node.now(), sample))

    def of(self, topic: str) -> list[Sample]:
        return [sample for name, _, sample in self.arrived if name == topic]


@asynccontextmanager
async def listening(**topics: type[r2p.Message] | None) -> AsyncIterator[tuple[r2p.Module, _Listener]]:
    network = Network()
    async with network.module("play") as source, network.node("PC1") as node:
        listener = _Listener(node, topics)
        await asyncio.sleep(1)
        yield source, listener
        await asyncio.sleep(0.1)
        for task in listener.tasks:
            task.cancel()


async def played(path: Path, options: PlayOptions | None = None, **topics: type[r2p.Message] | None) -> _Listener:
    async with listening(**topics) as (source, listener):
        with Bag(path) as bag:
            async with Player(source, bag, options or PlayOptions()) as player:
                await asyncio.sleep(1)
                await player.run()
    return listener


async def test_messages_keep_their_bytes_their_spacing_and_the_distances_of_their_stamps(tmp_path: Path) -> None:
    records = [led(i) for i in range(300)]
    path = write(tmp_path / "a.mcap", records)
    listener = await played(path, leds=Led)
    first = listener.arrived[0][1]
    assert [each.data for each in listener.of("leds")] == [sample.data for _, sample, _, _ in records]
    assert [at - first for _, at, _ in listener.arrived] == [at - records[0][3] for *_, at in records]
    shift = listener.arrived[0][2].stamp - records[0][1].stamp
    assert {
        played.stamp - sample.stamp for played, (_, sample, _, _) in zip(listener.of("leds"), records, strict=True)
    } == {shift}
    assert shift == first - records[0][3]
    assert [each.sequence for each in listener.of("leds")] == list(range(1, 301))


async def test_at_another_rate_all_is_nearer_together_but_for_deadlines(tmp_path: Path) -> None:
    records = [led(i) for i in range(0, 30, 3)]
    for _, sample, _, _ in records:
        sample.publisher_class, sample.deadline = SPORADIC, sample.stamp + 20 * MS
    listener = await played(write(tmp_path / "a.mcap", records), PlayOptions(rate=2.0), leds=Led)
    stamps = [each.stamp for each in listener.of("leds")]
    assert [after - before for before, after in itertools.pairwise(stamps)] == [15 * MS] * 9
    assert {each.deadline - each.stamp for each in listener.of("leds")} == {20 * MS}
    assert {each.publisher_class for each in listener.of("leds")} == {SPORADIC}


async def test_a_time_in_a_payload_that_was_translated_is_translated_to_now(tmp_path: Path) -> None:
    topic, sample, cls, at = led(0)
    sample.clock = ClockOffset(77, T0 - 5_000, 300)
    listener = await played(write(tmp_path / "a.mcap", [(topic, sample, cls, at)]), leds=Led)
    (arrived,) = listener.of("leds")
    assert arrived.clock is not None
    assert arrived.clock.utc(5_000) - arrived.stamp == sample.clock.utc(5_000) - sample.stamp


async def test_publishers_keep_their_nodes_and_two_of_one_name_get_those_of_their_modules(tmp_path: Path) -> None:
    records = [
        led(0, node="wheel", module="MOTOR1"),
        led(1, node="wheel", module="MOTOR2"),
        led(2, node="imu", module="IMU1"),
        led(3, node="", module=""),
    ]
    listener = await played(write(tmp_path / "a.mcap", records), leds=Led)
    assert [f"{each.source}" for each in listener.of("leds")] == [
        "play/MOTOR1_wheel",
        "play/MOTOR2_wheel",
        "play/imu",
        "play/play",
    ]


async def test_untyped_topics_are_played_as_they_are(tmp_path: Path) -> None:
    topic, sample, _, at = led(0)
    sample.data = b"what is this?"
    listener = await played(write(tmp_path / "a.mcap", [(topic, sample, None, at)]), leds=None)
    assert [each.data for each in listener.of("leds")] == [b"what is this?"]


async def test_untyped_topics_of_several_lengths_are_played_too(tmp_path: Path) -> None:
    records = [led(i) for i in range(20)]
    for i, (_, sample, _, _) in enumerate(records):
        sample.data = bytes(i + 1)
    path = write(tmp_path / "a.mcap", [(topic, sample, None, at) for topic, sample, _, at in records])
    listener = await played(path, leds=None)
    assert [each.data for each in listener.of("leds")] == [bytes(i + 1) for i in range(20)]


async def test_a_periodic_topic_stays_periodic(tmp_path: Path) -> None:
    records = [led(i) for i in range(20)]
    for _, sample, _, _ in records:
        sample.publisher_class = PERIODIC
    listener = await played(write(tmp_path / "a.mcap", records), leds=Led)
    assert {each.publisher_class for each in listener.of("leds")} == {PERIODIC}
    assert len(listener.of("leds")) == 20


async def test_latched_topics_are_for_those_who_come_later_and_for_a_late_start(tmp_path: Path) -> None:
    records = [led(0, topic="map", node="mapper"), *(led(i) for i in range(100))]
    path = write(tmp_path / "a.mcap", records, latched=("map",))
    async with listening(leds=Led) as (source, listener):
        with Bag(path) as bag:
            async with Player(source, bag, PlayOptions(start=T0 + SECOND // 2)) as player:
                await player.run()
                async with node_in(source) as node:
                    late = _Listener(node, {"map": Led})
                    await asyncio.sleep(0.1)
    assert len(listener.of("leds")) == 50
    assert [each.data for each in late.of("map")] == [Led(0, 1).encode()]


async def test_what_was_latched_when_it_was_recorded_is_latched_when_it_is_played(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    network = Network()
    async with network.node("IMU", name="mapper") as node, network.module("PC1") as pc:
        await node.advertise("map", Led, latch=True).publish(Led(5, 1))
        async with Recorder(pc, path):
            await asyncio.sleep(1)
            await node.advertise("leds", Led).publish(Led(1, 1))
            await asyncio.sleep(1)
    async with listening() as (source, _):
        with Bag(path) as bag:
            assert bag.latched == {"map"}
            async with Player(source, bag) as player:
                await player.run()
                async with node_in(source) as node:
                    late = _Listener(node, {"map": Led, "leds": Led})
                    await asyncio.sleep(0.1)
    assert [(name, sample.data) for name, _, sample in late.arrived] == [("map", Led(5, 1).encode())]


async def test_a_subscriber_without_room_gets_messages_later_and_holds_up_no_others(tmp_path: Path) -> None:
    records = [led(i) for i in range(100)] + [led(i, topic="other") for i in range(100)]
    path = write(tmp_path / "a.mcap", records)
    async with listening(other=Led) as (source, listener):
        slow: list[bytes] = []

        async def read_slowly(node: r2p.Node) -> None:
            async for sample in node.subscribe("leds", Led, queue=1).samples():
                slow.append(sample.data)
                await asyncio.sleep(0.02)

        source.start(read_slowly)
        with Bag(path) as bag:
            async with Player(source, bag) as player:
                await asyncio.sleep(1)
                began = listener.arrived
                await player.run()
                await asyncio.sleep(0.001)
                assert [at - began[0][1] for _, at, _ in began] == [at - records[100][3] for *_, at in records[100:]]
                assert player.missed == {}
                assert len(slow) < 60
                await asyncio.sleep(0.9)
                assert len(slow) > 90


async def test_what_no_one_reads_for_a_second_is_counted(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", [led(i) for i in range(200)])
    async with listening() as (source, _):

        async def read_nothing(node: r2p.Node) -> None:
            node.subscribe("leds", Led, queue=1)
            await asyncio.sleep(1000)

        source.start(read_nothing)
        with Bag(path) as bag:
            async with Player(source, bag) as player:
                await player.run()
                assert sum(player.missed["leds"].values()) > 100


async def test_names_patterns_and_other_names(tmp_path: Path) -> None:
    topics = ["encoder1", "encoder2", "speed", "log", "calibrate_q", "BOOT_IMU1", "bus_load"]
    path = write(
        tmp_path / "a.mcap",
        [(name, led(i)[1], None if name[-2:] == "_q" else Led, T0 + i * 10 * MS) for i, name in enumerate(topics)],
    )

    def names(**options: object) -> list[str]:
        return sorted(Player(module, bag, PlayOptions(**options)).topics)  # type: ignore[arg-type]

    async with Network().module("play") as module:
        with Bag(path) as bag:
            assert names() == ["encoder1", "encoder2", "speed"]
            assert names(topics=("encoder*", "log")) == ["encoder1", "encoder2", "log"]
            assert names(exclude=("enc*",)) == ["speed"]
            assert names(topics=("speed",), remap={"speed": "old/speed"}) == ["old/speed"]
            with pytest.raises(r2p.BagError, match=r"no topic of .* is meant; it has BOOT_IMU1, bus_load"):
                names(topics=("wheel*",))
            with pytest.raises(r2p.InvalidName, match="encoder1 and speed would both be played as speed"):
                names(remap={"encoder1": "speed"})
            with pytest.raises(r2p.BagError, match=r"of 0\.1 s, is from `start` to `end`"):
                names(start=T0 + 5 * SECOND)
            with pytest.raises(r2p.MessageError, match="the rate is"):
                names(rate=0.0)


async def test_a_topic_in_several_types_is_played_in_the_first(tmp_path: Path) -> None:
    other = Sample(Speed3().encode(), Source("PC1", "other", "tcp"), T0, sequence=1)
    path = write(tmp_path / "a.mcap", [led(0), ("leds", other, Speed3, T0 + 5 * MS), led(2)])
    async with listening(leds=Led) as (source, listener):
        with Bag(path) as bag:
            async with Player(source, bag) as player:
                await asyncio.sleep(1)
                await player.run()
                assert player.left_out == {
                    "leds": "it was recorded in several types, and is played as r2p_msgs/Led only"
                }
    assert len(listener.of("leds")) == 2


async def test_other_publishers_of_the_topics_are_seen(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", [led(0), led(1, topic="speed")])
    network = Network()
    async with network.module("play") as source, network.node("MOTOR1", name="wheel") as node:
        node.advertise("speed", Speed3)
        await asyncio.sleep(1)
        with Bag(path) as bag:
            assert Player(source, bag).other_publishers() == {"speed": ["MOTOR1/wheel"]}
            assert Player(source, bag, PlayOptions(remap={"speed": "old/speed"})).other_publishers() == {}


async def test_loops_and_ends(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", [led(i) for i in range(0, 90, 3)])
    async with listening(leds=Led) as (source, listener):
        with Bag(path) as bag:
            async with Player(source, bag, PlayOptions(start=T0 + 300 * MS, end=T0 + 602 * MS, loop=True)) as player:
                with pytest.raises(TimeoutError):
                    async with asyncio.timeout(1):
                        await player.run()
    per_loop = 11  # from 0.3 to 0.6 s, both included
    numbers = [each.data[0] for each in listener.of("leds")]
    assert numbers[per_loop : 2 * per_loop] == numbers[:per_loop]
    assert len(numbers) > 3 * per_loop


async def test_the_time_of_the_recording_is_published(tmp_path: Path) -> None:
    records = [led(i) for i in range(0, 90, 3)]
    path = write(tmp_path / "a.mcap", records)
    listener = await played(path, PlayOptions(clock=True, rate=0.5), leds=Led, clock=RosClock)
    times = [RosClock.decode(each.data).clock.ns for each in listener.of("clock")]
    during = [each for each in times if each > records[0][3]]
    assert during[50] - during[40] == 50 * MS  # 100 ms at half the speed
    assert max(times) <= records[-1][3]
    assert [each.stamp for each in listener.of("leds")] == [sample.stamp for _, sample, _, _ in records]


async def test_odometry_of_an_own_type_is_known_without_its_class(tmp_path: Path) -> None:
    class Own(r2p.Message, name="test_msgs/Own"):
        x: r2p.f64 = 0.0

    sample = Sample(Own(2.5).encode(), Source("PC1", "own", "tcp"), T0, sequence=1)
    path = write(tmp_path / "a.mcap", [("own", sample, Own, T0), ("odometry", sample, Odometry, T0)])
    listener = await played(path, own=Own)
    assert [each.message for each in listener.of("own")] == [Own(2.5)]


async def test_what_a_recording_of_strangers_says_is_left_out_or_put_right(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    far = (1 << 63) - 1
    with path.open("wb") as file:
        writer = BagWriter(file)
        for topic in ("/R2P", "//R2P", "/log", "/BOOT_IMU1", "../../evil", "a b", "/leds"):
            about = ChannelInfo(topic, "../IMU", "a b", SPORADIC)
            channel = writer.add_channel("/x", "r2p", about.metadata, None)
            writer.add(channel, T0, far, 1, Led(1, 1).encode())
        SampleWriter(writer).write(
            "far", Sample(Led(1, 1).encode(), Source(), far, -far, clock=ClockOffset(-1, far, 0)), None, T0
        )
        writer.finish()
    network = Network()
    async with network.module("play") as module, network.node("PC1") as node:
        listener = _Listener(node, {"leds": None, "far": None})
        await asyncio.sleep(1)
        with Bag(path) as bag, pytest.raises(r2p.InvalidName, match="messages of r2p itself"):
            Player(module, bag, PlayOptions(remap={"leds": "R2P"}))
        with Bag(path) as bag:
            async with Player(module, bag) as player:
                assert list(player.topics) == ["leds", "far"]
                assert set(player.left_out) == {"../../evil", "a b"}
                await asyncio.sleep(1)
                await player.run()
        await asyncio.sleep(0.1)
        assert {each.source.node for each in listener.of("leds")} == {"IMU"}
        (arrived,) = listener.of("far")
        assert abs(arrived.stamp - node.now()) < SECOND
        assert (arrived.deadline, arrived.clock) == (0, None)
        for task in listener.tasks:
            task.cancel()
