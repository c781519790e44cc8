"""Messages of variable length: their bytes are those of ROS 1, and no count from a wire is believed."""

import array
import copy
import ctypes
import pickle
import struct
from typing import Annotated, Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r2p.errors import DecodeError, MessageError, TooLong
from r2p.messages import (
    SIZE_MAX,
    Array,
    Duration,
    FixedArray,
    Len,
    Max,
    Message,
    Scalar,
    Timestamp,
    VariableArray,
    VariableText,
    f32,
    f64,
    layout,
    message_type,
    u8,
    u16,
    u32,
)
from r2p.msg import Text
from tests.messages.classes import Wheel, define
from tests.messages.strategies import messages


class Header(Message, name="std_msgs/Header"):
    seq: u32 = 0
    stamp: Timestamp = Timestamp()
    frame_id: Annotated[str, Max(256)] = ""


class Scan(Message, name="sensor_msgs/LaserScan"):
    header: Header = Header()
    angle_min: f32 = 0.0
    angle_max: f32 = 0.0
    ranges: Annotated[Array[f32], Max(1000)] = Array()
    intensities: Annotated[tuple[f32, ...], Max(1000)] = ()


class Everything(Message):
    name: Annotated[str, Max(20)]
    a: u8
    flags: Annotated[tuple[bool, ...], Max(5)]
    raw: Annotated[bytes, Max(9)]
    serial: Annotated[bytes, Len(4)]
    wheels: Annotated[tuple[Wheel, ...], Max(3)]
    headers: tuple[Header, Header]
    rows: Annotated[tuple[Annotated[tuple[u16, ...], Max(4)], ...], Max(4)]
    names: Annotated[tuple[Annotated[str, Max(5)], ...], Max(3)]
    fixed_names: Annotated[tuple[Annotated[str, Len(3)], ...], Max(3)]
    pairs: Annotated[tuple[tuple[u8, u8], ...], Max(3)]
    numbers: Annotated[Array[f64], Max(4)]
    covariance: Annotated[Array[f64], Len(9)]
    many: Annotated[tuple[u8, ...], Len(2000)]
    lambda_: f32
    wait: Duration
    b: u16


SCAN = Scan(Header(7, Timestamp(1, 2), "laser"), -1.5, 1.5, Array([1.0, 2.5]), (0.5,))
PACKED = struct.pack("<IIII5sffIffIf", 7, 1, 2, 5, b"laser", -1.5, 1.5, 2, 1.0, 2.5, 1, 0.5)


def test_the_bytes_are_those_of_ros_1() -> None:
    assert SCAN.encode() == PACKED
    assert Scan.decode(PACKED) == SCAN
    assert Scan().encode() == bytes(12 + 4 + 8 + 4 + 4)


def test_layouts() -> None:
    found = layout(Scan)
    assert (found.name, found.size, found.size_min, found.varies) == ("sensor_msgs/LaserScan", 8288, 32, True)
    assert found.schema == (
        "header.seq:u32 header.stamp.sec:u32 header.stamp.nsec:u32 header.frame_id:str angle_min:f32 angle_max:f32 "
        "ranges:f32[] intensities:f32[]"
    )
    assert "rows[]:u16[] names[]:str fixed_names[]:char[3] pairs[]:u8[2]" in layout(Everything).schema
    assert "lambda:f32 wait.sec:i32 wait.nsec:i32" in layout(Everything).schema
    assert found.fields[3].shape == VariableArray(Scalar("f32", "f"), 1000, "array")
    assert layout(Everything).fields[4].shape == FixedArray(Scalar("u8", "B"), 4, "bytes")
    assert layout(Header).fields[2].shape == VariableText(256)
    assert (layout(Text).name, layout(Timestamp).name, layout(Wheel).name) == (
        "r2p_msgs/Text",
        "r2p_msgs/Timestamp",
        "tests/Wheel",
    )
    assert repr(layout(Header)) == (
        "<Layout of Header, 16 to 272 bytes: seq:u32 stamp.sec:u32 stamp.nsec:u32 frame_id:str>"
    )


def test_a_bound_is_not_a_part_of_the_type() -> None:
    one: Any = define("One", [("x", Annotated[str, Max(3)])])
    other: Any = define("One", [("x", Annotated[str, Max(300)])])
    assert layout(one).fingerprint == layout(other).fingerprint
    assert layout(define("One", [("x", Annotated[bytes, Max(3)])])).schema == "x:u8[]"
    huge: Any = define("Huge", [("x", Annotated[tuple[other, ...], Max(SIZE_MAX)])])
    assert layout(huge).size == SIZE_MAX


@given(messages(layout(Everything)))
def test_everything_comes_back(message: Everything) -> None:
    data = message.encode()
    assert layout(Everything).size_min <= len(data) <= layout(Everything).size
    assert Everything.decode(data) == message
    assert hash(Everything.decode(data)) == hash(message)


@given(messages(layout(Everything)), st.data())
def test_damaged_bytes_are_a_message_or_an_error(message: Everything, data: st.DataObject) -> None:
    packed = bytearray(message.encode())
    for _ in range(data.draw(st.integers(1, 3))):
        packed[data.draw(st.integers(0, min(len(packed) - 1, 60)))] = data.draw(st.integers(0, 255))
    cut = bytes(packed[: data.draw(st.integers(0, len(packed)))])
    for damaged in (bytes(packed), cut, bytes(packed) + b"\0"):
        try:
            found = Everything.decode(damaged)
        except DecodeError:
            continue
        assert Everything.decode(found.encode()) == found or "nan" in repr(found)


@pytest.mark.parametrize(
    ("data", "error", "text"),
    [
        (b"", DecodeError, "Header: .*16 bytes"),
        (PACKED[:15], DecodeError, "Header: "),
        (PACKED[:18], DecodeError, "Header: a count of 5 with 2 bytes behind it"),
        (bytes(12) + b"\xff\xff\xff\xff" + bytes(400), DecodeError, "Header: a count of 4294967295"),
        (
            bytes(12) + struct.pack("<I", 300) + bytes(300),
            TooLong,
            "Header: 300 elements, and at most 256 are accepted",
        ),
        (bytes(17), DecodeError, "Header: 1 bytes are left over"),
        (bytes(12) + b"\1\0\0\0\xff", DecodeError, "Header: .*utf-8"),
    ],
)
def test_what_is_not_decoded(data: bytes, error: type[DecodeError], text: str) -> None:
    with pytest.raises(DecodeError, match=f"^{text}") as caught:
        Header.decode(data)
    assert type(caught.value) is error


@pytest.mark.parametrize(
    ("message", "text"),
    [
        (Header(frame_id="x" * 257), r"Header.frame_id \(str\) takes a text of at most 256 bytes in UTF-8, not 'xxx"),
        (Header(frame_id="\ud800"), r"Header.frame_id"),
        (Header(frame_id=b"x"), r"Header.frame_id \(str\) takes a text"),  # type: ignore[arg-type]
        (Scan(intensities=(0.0,) * 1001), r"Scan.intensities \(f32\[\]\) takes a tuple of at most 1000, not"),
        (Scan(intensities=[1.0]), r"Scan.intensities \(f32\[\]\) takes a tuple"),  # type: ignore[arg-type]
        (Scan(intensities=(1.0, "x")), r"Scan.intensities\[1\] \(f32\) takes a number"),  # type: ignore[arg-type]
        (Scan(ranges=Array([1.0] * 1001)), r"Scan.ranges \(f32\[\]\) takes at most 1000 values, each a number"),
        (Scan(ranges=["x"]), r"Scan.ranges"),  # type: ignore[arg-type]
        (Scan(ranges=None), r"Scan.ranges"),  # type: ignore[arg-type]
        (Scan(header=None), r"Scan.header"),  # type: ignore[arg-type]
    ],
)
def test_what_is_not_packed(message: Message, text: str) -> None:
    with pytest.raises(MessageError, match=f"^{text}"):
        message.encode()


WRITABLE = [
    [1.0, 2.5],
    array.array("f", [1.0, 2.5]),
    np.array([1.0, 2.5], "f4"),
    np.array([1.0, 2.5], "f8"),
    np.array([1.0, 0.0, 2.5, 0.0], "f4")[::2],
    np.array([[1.0, 2.5]], "f4"),
    np.array([1.0, 2.5], ">f4"),
    (ctypes.c_float * 2)(1.0, 2.5),
    Array(array.array("f", [1.0, 2.5])),
]


@pytest.mark.parametrize("values", [*WRITABLE, (1.0, 2.5), Array([1.0, 2.5]), np.array([1, 2], "i8")])
def test_what_an_array_field_takes(values: Any) -> None:
    scan = Scan(ranges=values)
    assert scan.encode() == Scan(ranges=Array([float(each) for each in np.ravel(values)])).encode()
    shares: Any = layout(Scan).packing.shares
    assert not shares(scan), "what decoding gives is something else, or can be written to"
    assert shares(Scan.decode(scan.encode()))


def test_what_a_field_of_bytes_takes() -> None:
    class Raw(Message):
        data: Annotated[bytes, Max(4)]

    shares: Any = layout(Raw).packing.shares
    for value in (b"ab", bytearray(b"ab"), memoryview(b"ab"), np.array([97, 98], "u1")):
        raw = Raw(value)  # type: ignore[arg-type]
        assert raw.encode() == b"\2\0\0\0ab"
        assert shares(raw) is isinstance(value, bytes)
    assert layout(Header).packing.shares is None, "nothing in it could be written to"


def test_arrays_are_immutable_sequences_with_a_buffer() -> None:
    found = Scan.decode(PACKED).ranges
    assert (len(found), found[0], found[-1], list(found), found.tolist()) == (2, 1.0, 2.5, [1.0, 2.5], [1.0, 2.5])
    assert found == (1.0, 2.5) == found
    assert found == Array([1.0, 2.5])
    assert found != [1.0]
    assert found != "ab"
    assert (found != None) is True  # noqa: E711
    assert hash(found) == hash((1.0, 2.5))
    assert (found[:1].tolist(), found[::-1].tolist(), 2.5 in found, found.index(2.5)) == ([1.0], [2.5, 1.0], True, 1)
    view = memoryview(found)
    assert (view.format, view.readonly, bytes(found), found.tobytes()) == ("f", True, found.tobytes(), view.tobytes())
    numbers = np.asarray(found)
    assert (numbers.dtype.str, numbers.flags.owndata, numbers.flags.writeable) == ("<f4", False, False)
    with pytest.raises(TypeError):
        found[0] = 1  # type: ignore[index]
    with pytest.raises(TypeError, match="not writable"):
        ctypes.c_char.from_buffer(found)
    assert pickle.loads(pickle.dumps(SCAN)) == copy.deepcopy(SCAN) == SCAN
    assert repr(found) == "Array([1.0, 2.5])"
    assert repr(Array(range(9))) == "Array([0, 1, 2, ... 9 in all])"
    assert Array([2**64 - 1]).view.format == "Q"
    for values in (["x"], [2**64], [-1, 2**64 - 1]):
        with pytest.raises((TypeError, OverflowError)):
            Array(values)


def test_nothing_is_copied_on_the_way_in() -> None:
    found = Scan.decode(PACKED)
    assert found.ranges.view.obj is PACKED


@pytest.mark.parametrize("cls", [Scan, Header, Everything])
def test_a_class_from_its_schema(cls: type[Message]) -> None:
    found = message_type("my_msgs/Learnt", layout(cls).schema)
    assert (layout(found).name, found.__name__) == ("my_msgs/Learnt", "Learnt")
    assert layout(found).fingerprint == layout(cls).fingerprint
    data = layout(cls).zero.encode()
    assert found.decode(data).encode() == data


@pytest.mark.parametrize("name", ["Scan", "a/b/C", "sensor_msgs/", "/Scan", "a b/C", "größe/C"])
def test_full_names_that_are_refused(name: str) -> None:
    with pytest.raises(MessageError, match="is not the full name of a type, such as sensor_msgs/LaserScan"):

        class Named(Message, name=name):
            x: u8


def test_durations() -> None:
    assert Duration.from_ns(-1) == Duration(-1, 999_999_999)
    assert Duration.from_ns(-1).ns == -1
    with pytest.raises(MessageError, match="longer than 68 years"):
        Duration.from_ns(1 << 62)
