"""Recordings of each version of the format stay readable: files that r2p wrote when it was the newest one.

A new version needs a file of its own: `python -m tests.recording.test_format tests/golden/bags/format-2.mcap`.
"""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import pytest

import r2p
from r2p.messages import ClockOffset
from r2p.msg import Header, JointState, Led
from r2p.recording import messages
from r2p.recording.bag import Bag
from r2p.recording.entries import AttachmentEntry, EntryWriter, MessageEntry, MetadataEntry, SampleEntry
from r2p.recording.format import FORMAT, LATCHED
from r2p.recording.frames import BusInfo, FrameEntry
from r2p.recording.writer import BagWriter
from tests.docs.blocks import ROOT

BAGS = ROOT / "tests" / "golden" / "bags"
UTC = 1_700_000_000_000_000_000
IMU, PC = r2p.Source("IMU", "led", "rtcan:can0"), r2p.Source("PC", "arm", "zenoh:")


class Gripper(r2p.Message, name="robot_msgs/Gripper"):
    name: Annotated[str, r2p.Len(8)] = ""
    force: r2p.f32 = 0.0


class Hand(r2p.Message, name="robot_msgs/Hand"):
    header: Header = Header()
    grippers: Annotated[tuple[Gripper, ...], r2p.Max(4)] = ()
    covariance: Annotated[r2p.Array[r2p.f64], r2p.Max(36)] = r2p.Array()


class Matrix(r2p.Message, name="robot_msgs/Matrix"):
    rows: tuple[tuple[r2p.f32, r2p.f32], tuple[r2p.f32, r2p.f32]] = ((1.0, 0.0), (0.0, 1.0))


HAND = Hand(Header(7, r2p.Timestamp(5, 6), "wrist"), (Gripper("left", 1.5), Gripper("right", 2.5)), r2p.Array([1.0]))
JOINTS = JointState(Header(frame_id="base"), ("hip", "knee"), r2p.Array([0.5, -0.5]))
SAMPLES: list[tuple[str, r2p.Sample, type[r2p.Message] | None]] = [
    ("leds", r2p.Sample(Led(3, 1).encode(), IMU, UTC, sequence=7), Led),
    (
        "leds",
        r2p.Sample(b"\2\0\0\0\xff", IMU, UTC + 1, UTC + 21, 8, r2p.PublisherClass.PERIODIC, expires=UTC + 22),
        Led,
    ),
    ("leds", r2p.Sample(b"not a Led", IMU, UTC + 2, sequence=9), Led),
    ("leds", r2p.Sample(Led(4, 0).encode(), r2p.Source(), UTC + 3, stamped=False), Led),
    ("joints", r2p.Sample(JOINTS.encode(), PC, UTC + 4, sequence=1 << 40, hops=2), JointState),
    ("hand", r2p.Sample(HAND.encode(), PC, -5, 0, 1, drop_late=False, clock=ClockOffset(77, -5, 300)), Hand),
    ("matrix", r2p.Sample(Matrix().encode(), PC, UTC + 6, sequence=1), Matrix),
    ("unknown", r2p.Sample(b"\0\1\2\3", PC, UTC + 7, sequence=1), None),
]
OWN: list[tuple[str, r2p.Message]] = [
    (messages.EVENTS, messages.RecordedEvent("link down", "zenoh:", text="the cable is out", outage=0.5)),
    (messages.SIGNALS, messages.RecordedSignal("missed", "publisher", "leds", "IMU", late=0.25, count=1, sequence=9)),
    (messages.LOSSES, messages.RecorderLosses(9, 1024, (messages.TopicLosses("leds", 1, 2),))),
    (messages.SLOTS, messages.SlotTable("rtcan:can0", 0.01, 60, "PC", (messages.SlotOwner("leds", "IMU", (2, 31)),))),
    (messages.PARAMETERS, messages.ParameterValue("IMU", "led", "rate", "float", "2.5", 2.5, "Hz", "code")),
]
FRAMES = [(0x123, b"\1\2", 1, UTC + 8), (0x9234_5678, bytes(8), 2, UTC + 9)]


def write(path: Path) -> None:
    """Write a recording with something of everything."""
    with path.open("xb") as file:
        writer = BagWriter(file)
        entries = EntryWriter(writer)
        entries.write(MetadataEntry(LATCHED, {"joints": ""}))
        entries.write(AttachmentEntry("r2p.toml", "application/toml", b'[modules.IMU]\nvia = "tcp:imu"\n', UTC))
        for number, (topic, sample, cls) in enumerate(SAMPLES):
            entries.write(SampleEntry(topic, sample, cls, UTC + number))
        entries.write(FrameEntry(BusInfo("can0", "rtcan:can0"), FRAMES))
        for number, (channel, message) in enumerate(OWN):
            entries.write(MessageEntry(channel, message, UTC + 10 + number))
        writer.finish()


def contents(path: Path) -> Iterator[Any]:
    """Everything that is read of a recording, with the types as texts."""
    with Bag(path) as bag:
        yield bag.metadata
        yield [(each.name, each.media_type, each.data, each.time) for each in bag.attachments()]
        yield [(each.name, each.encoding, each.schema_name, each.schema, each.count) for each in bag.channels]
        for each in bag.records():
            message = None if each.cls is None else each.cls.decode(each.sample.data)
            yield each.topic, each.log_time, each.sample, f"{message}"
        for channel, own in OWN:
            yield [(each.log_time, each.message) for each in bag.messages(channel, type(own))]
        yield [(each.log_time, each.publish_time, f"{each.message}") for each in bag.messages("/can0/frames")]
        assert (bag.problems, bag.undecodable, bag.damaged) == ([], {}, 0)


@pytest.mark.parametrize("path", sorted(BAGS.glob("*.mcap")), ids=lambda path: path.stem)
def test_older_recordings_are_read_as_new_ones(path: Path, tmp_path: Path) -> None:
    write(tmp_path / "now.mcap")
    assert list(contents(path)) == list(contents(tmp_path / "now.mcap"))
    with Bag(path) as bag:
        assert [each.sample for each in bag.records()] == [sample for _, sample, _ in SAMPLES]


def test_there_is_a_recording_of_each_version() -> None:
    assert [each.name for each in sorted(BAGS.glob("*.mcap"))] == [
        f"format-{each}.mcap" for each in range(1, FORMAT + 1)
    ]


if __name__ == "__main__":
    write(Path(sys.argv[1]))
