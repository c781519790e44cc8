"""Recordings in other formats: what comes back of them, what programs of others read, and what is lost, in words."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import Stores, get_typestore

import r2p
from r2p.codecs.can_bits import LOCAL, WireFrame
from r2p.messages import Message, layout
from r2p.msg import BusTraffic, Led, Odometry, Pose3, Velocity3
from r2p.recording.bag import Bag
from r2p.recording.convert.formats import convert, target_format
from r2p.recording.convert.stream import ConversionOptions
from r2p.recording.entries import EntryWriter, MessageEntry
from r2p.recording.format import LATCHED, META_PREFIX
from r2p.recording.frames import BusInfo, FrameEntry, FrameWriter
from r2p.recording.samples import SampleWriter
from r2p.recording.writer import BagWriter
from r2p.ros.cdr import cdr
from tests.recording.convert.samples import MESSAGES, START, record, same

TYPES: dict[str, type[Message]] = {topic: type(message) for topic, message in MESSAGES.items()}


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("recording") / "drive.mcap")


def content(path: Path) -> list[Any]:
    with Bag(path) as bag:
        return sorted(((each.topic, each.log_time, each.cls, each.sample) for each in bag.records()), key=repr)


def test_nothing_is_lost_in_a_recording_of_ours(recording: Path, tmp_path: Path) -> None:
    result = convert(recording, tmp_path / "copy.mcap")
    assert (sum(result.messages.values()), result.losses) == (len(content(recording)), {})
    assert content(tmp_path / "copy.mcap") == content(recording)
    with Bag(tmp_path / "copy.mcap") as bag:
        assert [(each.name, each.data) for each in bag.attachments()] == [("r2p.toml", b"via = []")]


def test_ros2_has_no_place_for_what_has_no_type(recording: Path, tmp_path: Path) -> None:
    result = convert(recording, tmp_path / "drive")
    assert result.losses == {"messages of unknown, whose type is unknown: --type unknown=TYPE states it": 2}
    convert(tmp_path / "drive", tmp_path / "back.mcap")
    assert content(tmp_path / "back.mcap") == [each for each in content(recording) if each[0] != "unknown"]


@pytest.mark.parametrize("to", ["csv", "parquet"])
def test_tables_come_back(to: str, recording: Path, tmp_path: Path) -> None:
    if to == "parquet":
        pytest.importorskip("pyarrow")
    assert convert(recording, tmp_path / "tables", to=to).losses == {"attachments": 1}
    types = ConversionOptions(types=TYPES) if to == "csv" else None
    convert(tmp_path / "tables", tmp_path / "back.mcap", types)
    assert content(tmp_path / "back.mcap") == content(recording)


def test_ros1_keeps_the_bytes_and_the_times(recording: Path, tmp_path: Path) -> None:
    result = convert(recording, tmp_path / "drive.bag")
    count = 2 * len(MESSAGES)
    assert result.losses == {
        "attachments": 1,
        "stamps of publishers": count,
        "sequence numbers": count,
        "deadlines": len(MESSAGES),
        "messages of unknown, whose type is unknown: --type unknown=TYPE states it": 2,
    }
    convert(tmp_path / "drive.bag", tmp_path / "back.mcap")
    assert [
        (topic, time, cls, sample.data, sample.source) for topic, time, cls, sample in content(tmp_path / "back.mcap")
    ] == [
        (topic, time, cls, sample.data, r2p.Source("IMU", "led"))
        for topic, time, cls, sample in content(recording)
        if cls is not None
    ]


def test_frames_and_events_keep_their_channels(tmp_path: Path) -> None:
    with (tmp_path / "drive.mcap").open("wb") as file:
        writer = BagWriter(file)
        frames: list[WireFrame] = [(0x123, b"abc", 0, START), (0x124, b"d", LOCAL, START + 5)]
        FrameWriter(writer).write(FrameEntry(BusInfo("can0"), frames))
        writer.finish()
    convert(tmp_path / "drive.mcap", tmp_path / "drive")
    assert all_records(tmp_path / "drive") == all_records(tmp_path / "drive.mcap")
    assert len(all_records(tmp_path / "drive")) == 2
    result = convert(tmp_path / "drive", tmp_path / "frames.csv")
    assert result.messages == {"can0/frames": 2}
    assert (
        (tmp_path / "frames.csv")
        .read_text()
        .splitlines()[1]
        .endswith(",can0,291,False,False,False,3,97,98,99,0,0,0,0,0")
    )


def test_channels_that_are_named_after_buses_are_converted(tmp_path: Path) -> None:
    with (tmp_path / "drive.mcap").open("wb") as file:
        writer = BagWriter(file)
        EntryWriter(writer).write(MessageEntry("/r2p/bus_load/rtcan:can0/management/R2P/?", BusTraffic(), START))
        writer.finish()
    result = convert(tmp_path / "drive.mcap", tmp_path / "drive")
    assert result.messages == {"r2p/bus_load/rtcan_can0/management/R2P/_": 1}
    assert not result.losses


def all_records(path: Path) -> list[Any]:
    with Bag(path) as bag:
        return [
            (each.channel.name, each.channel.metadata, each.log_time, each.publish_time, each.sequence, each.data)
            for each in bag.raw()
        ]


# Read by others


@pytest.mark.parametrize("name", ["drive.bag", "drive"])
def test_rosbags_reads_all_types(name: str, recording: Path, tmp_path: Path) -> None:
    convert(recording, tmp_path / name)
    read: dict[str, list[Any]] = {}
    with AnyReader([tmp_path / name]) as reader:
        for connection, _, data in reader.messages():
            if not connection.topic.startswith(META_PREFIX):
                message = reader.deserialize(data, connection.msgtype)
                read.setdefault(connection.topic.removeprefix("/"), []).append(message)
    assert read.keys() == MESSAGES.keys()
    assert [topic for topic in read if not all(same(MESSAGES[topic], each) for each in read[topic])] == []


def test_mcap_ros2_reads_all_types(recording: Path) -> None:
    with recording.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        names = [f"/{topic}" for topic in MESSAGES]
        read = [(each.channel.topic[1:], each.decoded_message) for each in reader.iter_decoded_messages(names)]
    assert len(read) == 2 * len(MESSAGES)
    assert [topic for topic, message in read if not same(MESSAGES[topic], message)] == []


# Of others


def test_mcap_files_of_other_programs(tmp_path: Path) -> None:
    with (tmp_path / "theirs.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start("", "other")
        ros2 = writer.register_schema("std_msgs/msg/Int16", "ros2msg", b"int16 data")
        ros1 = writer.register_schema("std_msgs/Int16", "ros1msg", b"int16 data")
        for topic, encoding, schema, data in (
            ("/two", "cdr", ros2, b"\0\1\0\0\5\0"),
            ("/one", "ros1", ros1, b"\5\0"),
            ("/json", "json", 0, b"{}"),
            ("/no topic", "ros1", ros1, b"\5\0"),
            ("/short", "ros1", ros1, b"\5"),
        ):
            channel = writer.register_channel(topic, encoding, schema)
            writer.add_message(channel, START, data, START)
        writer.finish()
    result = convert(tmp_path / "theirs.mcap", tmp_path / "ours.mcap")
    assert result.messages == {"one": 1, "two": 1}
    assert [each.split(":")[0] for each in sorted(result.losses)] == [
        "messages of /json, encoded as json, not as cdr or ros1",
        "messages of /no topic",
        "messages of short that can't be decoded",
    ]
    assert [(topic, layout(cls).name, sample.data) for topic, _, cls, sample in content(tmp_path / "ours.mcap")] == [
        ("one", "std_msgs/Int16", b"\5\0"),
        ("two", "std_msgs/Int16", b"\5\0"),
    ]


def test_sqlite_of_ros2(tmp_path: Path) -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    with Rosbag2Writer(tmp_path / "theirs", version=8) as writer:
        connection = writer.add_connection("/odom", "nav_msgs/msg/Odometry", typestore=store)
        ours = Odometry(Pose3(1.0, 2.0, 0.5), Velocity3(0.5, 0.0, 0.25))
        for each in _as_ros(ours):
            writer.write(connection, START, each)
    for source in ("theirs", "theirs/theirs.db3"):
        types = ConversionOptions(types={"odom": Odometry})
        result = convert(tmp_path / source, tmp_path / "back.mcap", types, overwrite=True)
        assert list(result.losses.values()) == [1]
        ((topic, time, cls, sample),) = content(tmp_path / "back.mcap")
        assert (topic, time, cls, Odometry.decode(sample.data)) == ("odom", START, Odometry, ours)


def _as_ros(message: Odometry) -> list[bytes]:
    from r2p.ros.conversions import conversion

    found = conversion(Odometry, "nav_msgs/Odometry", 2)
    assert found is not None
    return [cdr(found.theirs).encode(each) for each in found.to_ros(message, START, r2p.Source())]


# Types


def write(path: Path, topic: str, cls: type[Message] | None, *messages: Message) -> Path:
    with path.open("wb") as file:
        writer = BagWriter(file)
        for number, each in enumerate(messages, 1):
            sample = r2p.Sample(each.encode(), r2p.Source("A"), START, sequence=number)
            SampleWriter(writer).write(topic, sample, cls, START + number)
        writer.finish()
    return path


@pytest.mark.parametrize("name", ["drive.bag", "drive"])
def test_standard_types_of_ros(name: str, tmp_path: Path) -> None:
    ours = Odometry(Pose3(1.0, 2.0, 0.5), Velocity3(0.5, 0.0, 0.25))
    write(tmp_path / "drive.mcap", "odometry", Odometry, ours)
    result = convert(tmp_path / "drive.mcap", tmp_path / name, ConversionOptions(ros=True))
    assert (
        result.losses["messages of odometry became nav_msgs/Odometry, without covariances, which are 0: unknown"] == 1
    )
    with AnyReader([tmp_path / name]) as reader:
        ((connection, _, data),) = list(
            reader.messages([each for each in reader.connections if each.topic == "/odometry"])
        )
        theirs: Any = reader.deserialize(data, connection.msgtype)
    assert (theirs.pose.pose.position.y, theirs.twist.twist.angular.z) == (2.0, 0.25)
    assert theirs.header.stamp.sec == START // 10**9


def test_messages_of_unknown_type_get_one(tmp_path: Path) -> None:
    write(tmp_path / "drive.mcap", "leds", None, Led(3, 1), Odometry())
    result = convert(tmp_path / "drive.mcap", tmp_path / "typed.mcap", ConversionOptions(types={"le*": Led}))
    assert result.losses == {"messages of leds of another type than r2p_msgs/Led, kept as bytes": 1}
    assert [each[2] for each in content(tmp_path / "typed.mcap")] == [Led, None]


def test_latched_topics_stay_latched(tmp_path: Path) -> None:
    with (tmp_path / "drive.mcap").open("xb") as file:
        writer = BagWriter(file)
        writer.add_metadata(LATCHED, {"map": ""})
        SampleWriter(writer).write("map", r2p.Sample(Led(3, 1).encode(), r2p.Source("PC"), START), Led, START)
        writer.finish()
    convert(tmp_path / "drive.mcap", tmp_path / "copy.mcap")
    with Bag(tmp_path / "copy.mcap") as bag:
        assert bag.metadata == {LATCHED: {"map": ""}}
    assert convert(tmp_path / "drive.mcap", tmp_path / "out.csv").losses["metadata records"] == 1


def test_a_type_that_messages_do_not_become(tmp_path: Path) -> None:
    write(tmp_path / "drive.mcap", "leds", Led, Led(3, 1))
    with pytest.raises(r2p.BagError, match="leds has messages of type r2p_msgs/Led, which do not become r2p_msgs/Odo"):
        convert(tmp_path / "drive.mcap", tmp_path / "typed.mcap", ConversionOptions(types={"leds": Odometry}))
    assert [each.name for each in tmp_path.iterdir()] == ["drive.mcap"]


# What is left out, and what is refused


def test_only_some_topics_and_times(recording: Path, tmp_path: Path) -> None:
    options = ConversionOptions(topics=("t_r2p_msgs_led", "t_std*"), start=START + 1, end=START + 10_000_000)
    result = convert(recording, tmp_path / "some.bag", options)
    assert result.messages == {"t_r2p_msgs_led": 2}


def test_one_table_has_one_topic(recording: Path, tmp_path: Path) -> None:
    with pytest.raises(
        r2p.BagError, match=r"out.csv is one table, .* choose one with --topics, or name a folder and --to csv"
    ):
        convert(recording, tmp_path / "out.csv")
    convert(recording, tmp_path / "out.csv", ConversionOptions(topics=("unknown",)))
    assert (tmp_path / "out.csv").read_text().splitlines()[0].endswith("_.class,data")


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("led,value\n1,2\n", "line 2: it needs the time when it was recorded in _.log_time"),
        ("_.log_time,led\n5,red\n", "line 2: Led.led takes an integer from 0 to 4294967295, not 'red'"),
        ('_.log_time,led\n5,1\n6,"1', "line 2: unexpected end of data"),
        ("_.log_time,_.class,led\n5,fast,1\n", "line 2: _.class 'fast' is not a class of publishers"),
    ],
)
def test_a_row_that_makes_no_sense_is_named(text: str, error: str, tmp_path: Path) -> None:
    (tmp_path / "leds.csv").write_text(text)
    with pytest.raises(r2p.BagError) as caught:
        convert(tmp_path / "leds.csv", tmp_path / "leds.mcap", ConversionOptions(types={"leds": Led}))
    assert f"leds.csv, {error}" in str(caught.value)


def test_what_is_there_is_not_replaced(recording: Path, tmp_path: Path) -> None:
    target = tmp_path / "drive.bag"
    target.write_text("precious")
    with pytest.raises(r2p.BagError, match=r"drive.bag exists: .* --overwrite"):
        convert(recording, target)
    (tmp_path / "drive").mkdir()
    (tmp_path / "drive" / "notes.txt").touch()
    with pytest.raises(r2p.BagError, match=r"it also has notes.txt, which is not rosbag2"):
        convert(recording, tmp_path / "drive", overwrite=True)
    with pytest.raises(r2p.BagError, match="is what is to be converted"):
        convert(recording, recording, overwrite=True)
    assert target.read_text() == "precious"
    convert(recording, target, overwrite=True)
    assert target.read_bytes().startswith(b"#ROSBAG V2.0")


@pytest.mark.parametrize(
    ("name", "to", "error"),
    [
        ("drive.xyz", None, "a file's suffix says what it is, one of .mcap"),
        ("drive.db3", None, "db3 can be read only; a folder, as in drive/, is for rosbag2"),
        ("drive.bag", "mp4", "mp4 is not a format to convert to; these are: mcap"),
        ("drive.csv", "mcap", "a file of mcap ends in .mcap"),
    ],
)
def test_a_format_that_is_none(name: str, to: str | None, error: str) -> None:
    with pytest.raises(r2p.BagError) as caught:
        target_format(Path(name), to)
    assert error in str(caught.value)


@pytest.mark.parametrize("name", ["drive.bag", "drive/drive_0.mcap", "drive/metadata.yaml", "t.parquet"])
def test_damaged_files_are_errors_or_losses_in_words(name: str, recording: Path, tmp_path: Path) -> None:
    if name == "t.parquet":
        pytest.importorskip("pyarrow")
    source = tmp_path / Path(name).parts[0]
    topics = ("t_r2p_msgs_led",) if name == "t.parquet" else ("t_r2p_msgs_l*", "t_sensor*")
    convert(recording, source, ConversionOptions(topics=topics))
    whole = (tmp_path / name).read_bytes()
    damaged = 0
    for place in range(0, len(whole), max(1, len(whole) // 60)):
        (tmp_path / name).write_bytes(whole[:place] + bytes([whole[place] ^ 0x55]) + whole[place + 1 :])
        try:
            convert(source, tmp_path / "back.mcap", overwrite=True)
        except r2p.BagError:
            damaged += 1
    assert damaged
