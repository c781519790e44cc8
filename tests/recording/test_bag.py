"""Bags are read as one recording, whatever their files look like; those of other programs and damaged ones, too."""

import contextlib
import re
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer

import r2p
from r2p.msg import Led, Odometry
from r2p.recording.bag import Bag
from r2p.recording.messages import SampleMeta
from r2p.recording.writer import BagWriter
from r2p.ros.cdr import cdr
from r2p.ros.ros2_schemas import schema_of
from tests.recording.making import MS, T0, led, leds, of, plain, write


def test_a_bag_says_what_it_has(tmp_path: Path) -> None:
    with r2p.Bag(write(tmp_path / "drive.mcap", leds(9))) as bag:
        assert (bag.start, bag.end, bag.topics) == (T0 + 2 * MS, T0 + 10 * MS, {"leds": 9})
        assert [(each.name, each.count, each.kind) for each in bag.channels] == [
            ("/leds", 9, "samples"),
            ("/r2p/meta/leds", 3, "meta"),
        ]
        assert bag.metadata == {"robot": {"name": "carrot"}}
        assert [each.data for each in bag.attachments()] == [b"via = []"]
        assert bag.problems == []


@pytest.mark.parametrize("chunk_size", [1, 100, 1 << 20])
def test_companions_find_their_messages_in_other_chunks(chunk_size: int, tmp_path: Path) -> None:
    samples = leds(20)
    with Bag(write(tmp_path / "drive.mcap", samples, chunk_size=chunk_size)) as bag:
        assert plain(bag) == of(samples)
        assert plain(bag, start=T0 + 5 * MS, end=T0 + 9 * MS) == of(samples[3:7])


def test_parts_of_a_recording_are_one_bag(tmp_path: Path) -> None:
    samples = leds(30)
    for i in range(3):
        write(tmp_path / f"drive-{i + 9:04}.mcap", samples[10 * i :][:10])
    for path in (tmp_path, tmp_path / "drive.mcap", tmp_path / "drive-*.mcap", sorted(tmp_path.iterdir())):
        with Bag(path) as bag:
            assert plain(bag) == of(samples)
            assert bag.topics == {"leds": 30}
            assert len(list(bag.attachments())) == 1


def test_files_of_several_recorders_are_put_in_the_order_of_time(tmp_path: Path) -> None:
    samples = leds(30)
    write(tmp_path / "a.mcap", samples[::2])
    write(tmp_path / "b.mcap", samples[1::2], chunk_size=1 << 20)
    with Bag(tmp_path) as bag:
        assert plain(bag) == of(samples)


def test_samples_have_messages_of_a_type(tmp_path: Path) -> None:
    path = write(tmp_path / "drive.mcap", [*leds(3), ("raw", led(1), None, T0), ("raw", led(2), None, T0)])
    with Bag(path) as bag:
        assert [sample.message for sample in bag.samples("leds")] == [Led(i, 1) for i in (1, 2, 3)]
        assert [sample.message.led for sample in bag.samples("/leds", Led)] == [1, 2, 3]
        assert [sample.message.led for sample in bag.samples("raw", Led)] == [1, 2]
        with pytest.raises(r2p.TypeMismatch, match="recorded as r2p_msgs/Led"):
            bag.samples("leds", Odometry)
        with pytest.raises(r2p.BagError, match="has no topic led; did you mean leds"):
            bag.samples("led")
        with pytest.raises(r2p.BagError, match="type of raw is unknown: give its class"):
            bag.samples("raw")


def test_messages_that_are_not_of_the_type_are_counted(tmp_path: Path) -> None:
    short = r2p.Sample(b"1", r2p.Source("IMU"), T0)
    with Bag(write(tmp_path / "drive.mcap", [("raw", short, None, T0), ("raw", led(1), None, T0)])) as bag:
        assert [sample.message.led for sample in bag.samples("raw", Led)] == [1]
        assert bag.undecodable == {"raw": 1}


def test_the_last_values_before_an_instant(tmp_path: Path) -> None:
    samples = sorted([*leds(30), ("leds", led(1, source="BASE"), Led, T0)], key=lambda each: each[3])
    with Bag(write(tmp_path / "drive.mcap", samples)) as bag:
        assert [each.sample for each in bag.last_before(T0 + 20 * MS)] == [samples[0][1], samples[18][1]]
        assert bag.last_before(T0) == []
        assert bag.last_before(T0 + 20 * MS, ["other"]) == []


def test_other_messages_are_read_by_channel(tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    schema = schema_of(SampleMeta)
    with path.open("wb") as file:
        writer = BagWriter(file)
        number = writer.add_channel("/r2p/x", "cdr", {}, (schema.name, "ros2msg", schema.text.encode()))
        writer.add(number, T0, T0, 1, cdr(SampleMeta).encode(SampleMeta(hops=3)))
        writer.add(number, T0, T0, 2, b"broken")
        writer.finish()
    with Bag(path) as bag:
        assert [each.message.hops for each in bag.messages("/r2p/x")] == [3]
        assert [each.message for each in bag.messages("/r2p/x", SampleMeta)] == [SampleMeta(hops=3)]
        assert list(bag.messages("/r2p/y")) == []
        assert bag.undecodable == {"/r2p/x": 2}
        assert bag.topics == {}


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("use_chunking", [True, False])
@pytest.mark.parametrize("summary", [True, False])
def test_files_of_other_programs(
    compression: CompressionType, use_chunking: bool, summary: bool, tmp_path: Path
) -> None:
    path = tmp_path / "ros.mcap"
    with path.open("wb") as file:
        writer = Writer(
            file, chunk_size=50, compression=compression, use_chunking=use_chunking, repeat_channels=summary
        )
        writer.start("ros2", "rosbag2")
        text = "float64 x\nstring name\n"
        schema = writer.register_schema("my_msgs/msg/Thing", "ros2msg", text.encode())
        channel = writer.register_channel("/arm/thing", "cdr", schema, {"offered_qos_profiles": ""})
        for i in range(5):
            data = b"\0\1\0\0" + bytes(8) + b"\3\0\0\0ab\0"
            writer.add_message(channel, T0 + i, data, T0 + i, i)
        writer.register_channel("/image", "protobuf", 0, {})
        writer.finish()
    with Bag(path) as bag:
        assert bag.problems == []
        assert bag.topics == {"arm/thing": 5}
        samples = list(bag.samples("arm/thing"))
        assert [(each.message.name, each.stamp) for each in samples] == [("ab", T0 + i) for i in range(5)]


def test_a_file_without_an_end_is_read_as_far_as_it_goes(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    samples = leds(20)
    path = write(tmp_path / "drive.mcap", samples, finish=False)
    whole = write(tmp_path / "whole.mcap", samples)
    with Bag(path) as bag, Bag(whole) as other:
        assert plain(bag) == of(samples)
        assert (bag.start, bag.end, bag.topics, bag.metadata) == (other.start, other.end, other.topics, other.metadata)
        assert [each.data for each in bag.attachments()] == [b"via = []"]
    assert f"r2p bag recover {path}" in caplog.text


def test_a_file_is_read_when_it_is_cut_anywhere(tmp_path: Path) -> None:
    samples = leds(4)
    data = write(tmp_path / "whole.mcap", samples, chunk_size=1).read_bytes()
    path = tmp_path / "cut.mcap"
    read = []
    for size in range(8, len(data)):
        path.write_bytes(data[:size])
        with Bag(path) as bag:
            assert bag.problems
            found = plain(bag)
            assert found == of(samples)[: len(found)]
            read.append(len(found))
    assert sorted(set(read)) == [0, 1, 2, 3, 4]
    assert read == sorted(read)


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (b"", "is empty"),
        (b"hello", "is not an MCAP file"),
        (b"SQLite format 3\0", "ros2 bag convert"),
        (b"#ROSBAG V2.0\n", "bag of ROS 1"),
    ],
)
def test_other_files_are_refused_with_advice(data: bytes, text: str, tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(data)
    with pytest.raises(r2p.BagError, match=text):
        Bag(path)


def test_files_that_are_not_there(tmp_path: Path) -> None:
    with pytest.raises(r2p.BagError, match=re.escape(f"there is no file {tmp_path}/a.mcap")):
        Bag(tmp_path / "a.mcap")
    with pytest.raises(r2p.BagError, match=r"has no \.mcap files"):
        Bag(tmp_path)
    with pytest.raises(r2p.BagError, match="no file matches"):
        Bag(tmp_path / "*.mcap")


def test_a_newer_format_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.add_metadata("r2p", {"format": "9", "r2p": "5.0"})
        writer.finish()
    with pytest.raises(r2p.BagError, match=r"version 9 of the format, by r2p 5\.0; .*: update it"):
        Bag(path)


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return write(tmp_path_factory.mktemp("bag") / "small.mcap", leds(12)).read_bytes()


def _flip(data: bytearray, at: int, value: int) -> None:
    data[at % len(data)] = value


def _number(data: bytearray, at: int, value: int) -> None:
    at %= len(data) - 8
    data[at : at + 8] = (value << 40 | 0xFF_FFFF_FFFF).to_bytes(8, "little")


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=150)
@given(changes=st.lists(st.tuples(st.sampled_from([_flip, _number]), st.integers(8, 1 << 16), st.integers(0, 255))))
def test_hostile_files_raise_only_bag_errors(
    changes: list[tuple[Callable[[bytearray, int, int], None], int, int]], small: bytes, tmp_path: Path
) -> None:
    data = bytearray(small)
    for change, at, value in changes:
        change(data, at, value)
    path = tmp_path / "hostile.mcap"
    path.write_bytes(data)
    with contextlib.suppress(r2p.BagError), Bag(path) as bag:
        assert all(isinstance(each.sample.data, bytes) for each in bag.records())
        assert bag.last_before(T0 + 5 * MS) is not None
        list(bag.raw())
        list(bag.attachments())
        assert isinstance(bag.metadata, dict)
