"""Frames are the same after they have been in a bag, and other programs read them."""

import struct
from io import BytesIO
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from r2p.codecs.can_bits import ERROR, EXTENDED, LOCAL, REMOTE, WireFrame
from r2p.errors import DecodeError
from r2p.messages import Timestamp
from r2p.msg import Header
from r2p.protocols.rtcan.cycle import timing
from r2p.protocols.rtcan.monitor import Monitor
from r2p.recording.frame_reader import observe
from r2p.recording.frames import BusInfo, CanFrame, FrameEntry, FrameWriter, RecordedFrame, bus_name, frame_of
from r2p.recording.writer import BagWriter
from r2p.ros.cdr import cdr

UTC = 1_700_000_000_123_456_789


@st.composite
def wire_frames(draw: st.DrawFn) -> WireFrame:
    """Frames of each kind, of either direction."""
    kind = draw(st.sampled_from([0, EXTENDED, REMOTE, REMOTE | EXTENDED, ERROR]))
    identifier = draw(st.integers(0, 0x7FF if kind in (0, REMOTE) else 0x1FFF_FFFF))
    size = draw(st.integers(0, 8)) if kind != ERROR else 8
    data = bytes(size) if kind & REMOTE else draw(st.binary(min_size=size, max_size=size))
    return kind | identifier, data, draw(st.sampled_from([0, LOCAL])), draw(st.integers(0, 1 << 60))


def written(bus: BusInfo, frames: list[WireFrame], offset: int = 0) -> BytesIO:
    file = BytesIO()
    writer = BagWriter(file)
    FrameWriter(writer).write(FrameEntry(bus, frames, offset))
    writer.finish()
    file.seek(0)
    return file


@given(frames=st.lists(wire_frames(), max_size=20), name=st.text("abcdefgh_0", min_size=1, max_size=9))
def test_frames_come_back(frames: list[WireFrame], name: str) -> None:
    bus = BusInfo(name, f"rtcan:{name}", 500_000, 20, 10_000_000)
    read = []
    for _, channel, message in make_reader(written(bus, frames, 1000)).iter_messages(log_time_order=False):
        assert BusInfo.from_metadata(channel.metadata) == bus
        frame = frame_of(message.data, name, sent=channel.metadata["direction"] == "tx")
        assert frame.time == message.log_time == message.publish_time
        read.append(frame.wire)
    assert read == [(identifier, data, flags, stamp + 1000) for identifier, data, flags, stamp in frames]


@given(frame=wire_frames(), name=st.text("abcdefgh_0", max_size=9))
def test_the_packed_frame_is_the_cdr_of_its_type(frame: WireFrame, name: str) -> None:
    identifier, data, _, stamp = frame
    ((_, _, message),) = make_reader(written(BusInfo(name), [frame])).iter_messages()
    assert cdr(CanFrame).decode(message.data) == CanFrame(
        Header(stamp=Timestamp.from_ns(stamp), frame_id=name),
        identifier & 0x1FFF_FFFF,
        bool(identifier & REMOTE),
        bool(identifier & EXTENDED),
        bool(identifier & ERROR),
        len(data),
        data.ljust(8, b"\0"),
    )


def test_mcap_ros2_support_reads_frames() -> None:
    frames = [(EXTENDED | 0x1234567, b"abc", 0, 5), (REMOTE | 0x123, bytes(4), LOCAL, 6)]
    reader = make_reader(written(BusInfo("can0"), frames, UTC), decoder_factories=[DecoderFactory()])
    first, second = (each.decoded_message for each in reader.iter_decoded_messages(["/can0/frames"]))
    assert (first.id, first.is_extended, first.dlc, bytes(first.data)) == (0x1234567, True, 3, b"abc\0\0\0\0\0")
    assert (second.id, second.is_rtr, second.dlc, second.header.frame_id) == (0x123, True, 4, "can0")
    assert first.header.stamp.sec * 10**9 + first.header.stamp.nanosec == UTC + 5


def test_rosbags_reads_frames() -> None:
    frames = [(EXTENDED | 0x1234567, b"abc", 0, 5), (ERROR | 0x8, b"\0\0\4" + bytes(5), LOCAL, 6)]
    store = get_typestore(Stores.ROS2_HUMBLE)
    found: list[Any] = []
    for schema, _, message in make_reader(written(BusInfo("vcan12"), frames, UTC)).iter_messages():
        assert schema is not None
        if schema.name not in store.fielddefs:
            store.register(get_types_from_msg(schema.data.decode(), schema.name))
        found.append(store.deserialize_cdr(message.data, schema.name))
        assert bytes(store.serialize_cdr(found[-1], schema.name)) == message.data
    assert [(each.id, each.is_error, each.dlc, each.header.frame_id, each.header.stamp.nanosec) for each in found] == [
        (0x1234567, False, 3, "vcan12", UTC % 10**9 + 5),
        (0x8, True, 8, "vcan12", UTC % 10**9 + 6),
    ]


@given(data=st.binary(max_size=80))
def test_any_bytes_are_a_frame_or_refused(data: bytes) -> None:
    for each in (data, b"\0\1\0\0" + data, b"\0\1\0\0" + bytes(8) + struct.pack("<I", 0xFFFF_FFF0) + data):
        try:
            frame = frame_of(each, "can0")
        except DecodeError:
            continue
        assert isinstance(frame, RecordedFrame)


@given(frames=st.lists(wire_frames(), max_size=30))
def test_a_monitor_takes_any_frames(frames: list[WireFrame]) -> None:
    """Also garbage where RTCAN has management and syncs, in any order of time."""
    monitor = Monitor(timing())
    for _, _, message in make_reader(written(BusInfo("can0"), frames)).iter_messages(log_time_order=False):
        observe(monitor, frame_of(message.data, "can0"))
    load = monitor.load(max((stamp for *_, stamp in frames), default=1))
    assert sum(tally.frames for tally in load.tallies.values()) == sum(not frame[0] & ERROR for frame in frames)


@pytest.mark.parametrize("bad", ["", "x", "-1", "0", "9" * 5000, "٣"])
def test_metadata_of_a_bus_that_can_not_be_is_refused(bad: str) -> None:
    metadata = BusInfo("can0").metadata(sent=False)
    with pytest.raises(DecodeError, match="bitrate"):
        BusInfo.from_metadata(metadata | {"bitrate": bad})
    assert BusInfo.from_metadata({}) is None


@pytest.mark.parametrize(
    ("address", "name"), [("can0", "can0"), ("slcan:/dev/ttyACM0", "slcan_dev_ttyACM0"), ("::", "can")]
)
def test_the_name_of_a_bus_is_one_of_ros(address: str, name: str) -> None:
    assert bus_name(address) == name
