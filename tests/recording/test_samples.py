"""Samples are the same after they have been in a bag."""

from pathlib import Path
from typing import Annotated

import pytest
from mcap.reader import make_reader

import r2p
from r2p.messages import ClockOffset, layout
from r2p.msg import Header, Led
from r2p.recording.bag import Bag, RecordedSample
from r2p.recording.format import CDR, PACKED
from r2p.recording.samples import SampleWriter
from r2p.recording.writer import BagWriter
from tests.messages.classes import define

PLAIN = r2p.Sample(Led(3, 1).encode(), r2p.Source("IMU", "led", "tcp"), 1_000, sequence=7)
SAMPLES = {
    "plain": PLAIN,
    "of this module": r2p.Sample(Led(3, 1).encode(), r2p.Source("IMU", "led"), 1_000, sequence=1),
    "with a deadline": r2p.Sample(
        Led(3, 1).encode(), r2p.Source("IMU"), 1_000, 21_000, 8, r2p.PublisherClass.SPORADIC, expires=22_000
    ),
    "of firmware": r2p.Sample(Led(3, 1).encode(), r2p.Source(), 5_000, stamped=False),
    "in network time": r2p.Sample(
        Led(3, 1).encode(), r2p.Source("IMU"), 1_000, hops=2, clock=ClockOffset(77, -5, 300), drop_late=False
    ),
    "of a large number": r2p.Sample(Led(3, 1).encode(), r2p.Source("IMU"), 1_000, sequence=1 << 40),
    "of a clock before 1970": r2p.Sample(Led(3, 1).encode(), r2p.Source("IMU"), -1_000, sequence=3),
    "of another size": r2p.Sample(b"12345", r2p.Source("IMU"), 1_000, sequence=9),
}


def recorded(path: Path, cls: type[r2p.Message], *samples: r2p.Sample) -> list[RecordedSample]:
    """What is read of samples of this class."""
    with path.open("xb") as file:
        writer = BagWriter(file)
        for number, sample in enumerate(samples):
            SampleWriter(writer).write("leds", sample, cls, 5_000 + number)
        writer.finish()
    with Bag(path) as bag:
        return list(bag.records())


@pytest.mark.parametrize("sample", SAMPLES.values(), ids=SAMPLES)
def test_a_sample_comes_back(sample: r2p.Sample, tmp_path: Path) -> None:
    (record,) = recorded(tmp_path / "one.mcap", Led, sample)
    assert (record.topic, record.log_time, record.sample) == ("leds", 5_000, sample)


class Wheel(r2p.Message, name="robot_msgs/Wheel"):
    speed: r2p.f32 = 0.0


class Axle(r2p.Message, name="robot_msgs/Axle"):
    header: Header = Header()
    left: Wheel = Wheel()
    class_: r2p.u8 = 0


class Matrix(r2p.Message, name="robot_msgs/Matrix"):
    rows: tuple[tuple[r2p.f32, r2p.f32], tuple[r2p.f32, r2p.f32]] = ((0, 0), (0, 0))


class OtherWheel(r2p.Message, name="robot_msgs/Wheel"):
    ok: bool = False


class Mixed(r2p.Message, name="robot_msgs/Mixed"):
    one: Wheel = Wheel()
    other: OtherWheel = OtherWheel()


class _Private(r2p.Message):
    value: r2p.u8 = 0


LONG = define("Long", [(f"{'long_name_' * 30}{number}", Wheel) for number in range(120)])
LONG_MATRIX = define("LongMatrix", [(f"{'long_name_' * 30}{number}", Matrix) for number in range(120)])
ENCODINGS: dict[str, tuple[type[r2p.Message], str, str]] = {  # with the type that the reader finds
    "with others in it": (Axle, CDR, "robot_msgs/Axle"),
    "with a long layout": (LONG, CDR, "tests/Long"),
    "with an array of arrays": (Matrix, PACKED, "robot_msgs/Matrix"),
    "with two types of one name": (Mixed, PACKED, "robot_msgs/Mixed"),
    "with a name that ROS can't have": (_Private, PACKED, "tests/_Private"),
    "that is too long for ROS and for a schema": (LONG_MATRIX, PACKED, ""),
}


@pytest.mark.parametrize(("cls", "encoding", "name"), ENCODINGS.values(), ids=ENCODINGS)
def test_a_class_comes_back(cls: type[r2p.Message], encoding: str, name: str, tmp_path: Path) -> None:
    sample = r2p.Sample(layout(cls).zero.encode(), r2p.Source("IMU"), 1_000, sequence=1)
    (record,) = recorded(tmp_path / "one.mcap", cls, sample)
    with (tmp_path / "one.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
        assert summary is not None
        (channel,) = summary.channels.values()
    assert record.sample == sample
    assert channel.message_encoding == encoding
    assert (channel.metadata["type"], record.cls is not None) == (name, bool(name))
    if record.cls is not None:
        assert layout(record.cls).fingerprint == layout(cls).fingerprint


def test_the_names_of_messages_in_others_come_back(tmp_path: Path) -> None:
    sample = r2p.Sample(Axle(left=Wheel(2.5), class_=3).encode(), r2p.Source("IMU"), 1_000, sequence=1)
    (record,) = recorded(tmp_path / "one.mcap", Axle, sample)
    assert record.cls is not None
    assert f"{record.cls.decode(sample.data)}" == f"{Axle(left=Wheel(2.5), class_=3)}"


class Headers(r2p.Message, name="robot_msgs/Headers"):
    headers: Annotated[tuple[Header, ...], r2p.Max(20_000)] = ()


@pytest.mark.parametrize("count", [1, 16_384, 16_385], ids=["one", "as many as fit", "one more"])
def test_numbers_of_headers_come_back(count: int, tmp_path: Path) -> None:
    """CDR does not have them: they are in the companion, up to its limit, and the message is packed beyond."""
    message = Headers(tuple(Header(seq) for seq in range(1, count + 1)))
    sample = r2p.Sample(message.encode(), r2p.Source("CAM"), 1_000, sequence=1)
    assert [each.sample for each in recorded(tmp_path / "one.mcap", Headers, sample)] == [sample]


class Named(r2p.Message, name="robot_msgs/Named"):
    header: Header = Header()
    name: Annotated[str, r2p.Len(4)] = ""


def test_a_text_of_fixed_length_comes_back_as_a_text(tmp_path: Path) -> None:
    """To ROS, it is an array of octets; and only its definition says which message within is a header."""
    sample = r2p.Sample(Named(Header(5), "abc").encode(), r2p.Source("IMU"), 1_000, sequence=1)
    (record,) = recorded(tmp_path / "one.mcap", Named, sample)
    assert record.sample == sample
    assert record.cls is not None
    assert f"{record.cls.decode(sample.data)}".endswith("name='abc')")
