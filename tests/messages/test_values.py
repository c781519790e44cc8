"""Messages to text and back."""

from __future__ import annotations

import contextlib
import json
import math
import struct
from decimal import ROUND_CEILING, ROUND_FLOOR, Context, Decimal
from typing import Annotated, Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import r2p
from r2p import Array
from r2p.messages.values import from_plain, parse, parse_line, pick, shortest_f32, to_plain
from r2p.msg import (
    IMU,
    Header,
    Image,
    JointState,
    LaserScan,
    Led,
    PointCloud2,
    PointField,
    Proximity,
    Speed2,
    StampedPose3,
    String,
    Text,
    Velocity3,
)
from r2p.tools.output import to_yaml
from r2p.tools.session import UsageError
from r2p.tools.types import class_path, load_type, of_size, standard_types, type_name
from tests.messages.strategies import messages


class Switch(r2p.Message):
    """Names that are booleans in YAML 1.1."""

    on: bool = False
    y: r2p.f32 = 0.0
    no: Annotated[str, r2p.Len(8)] = ""


class Grid(r2p.Message):
    """Arrays of all kinds."""

    cells: tuple[tuple[r2p.u8, r2p.u8], tuple[r2p.u8, r2p.u8]] = ((0, 0), (0, 0))
    poses: tuple[Velocity3, Velocity3] = (Velocity3(), Velocity3())
    names: tuple[Annotated[str, r2p.Len(2)], Annotated[str, r2p.Len(2)]] = ("", "")
    far: r2p.f64 = 0.0


class Bytes(r2p.Message):
    """Bytes, with a bound and of fixed length, and a name that Python forbids."""

    raw: Annotated[bytes, r2p.Max(4)] = b""
    serial: Annotated[bytes, r2p.Len(3)] = bytes(3)
    class_: r2p.u8 = 0


TYPES: list[type[r2p.Message]] = [*standard_types(), Switch, Grid, Bytes]
SCANNED = Header(frame_id="5")


@pytest.mark.parametrize("cls", TYPES, ids=lambda cls: cls.__name__)
@given(data=st.data())
def test_what_echo_prints_pub_takes(cls: type[r2p.Message], data: st.DataObject) -> None:
    sent = data.draw(messages(r2p.layout(cls)))
    plain = to_plain(cls.decode(sent.encode()))

    assert parse_line(cls, json.dumps(plain, allow_nan=False)).encode() == sent.encode()
    assert parse(cls, [json.dumps(plain, allow_nan=False)]).encode() == sent.encode()
    assert parse(cls, [to_yaml(plain)]).encode() == sent.encode()


def test_types_are_offered_by_names_that_type_takes() -> None:
    assert [load_type(type_name(cls)) for cls in standard_types()] == standard_types()
    assert [load_type(class_path(cls)) for cls in standard_types()] == standard_types()
    assert {type_name(cls).partition("/")[0] for cls in standard_types()} == {"r2p_msgs", "sensor_msgs", "std_msgs"}
    assert "r2p_msgs/Timestamp" in of_size(8)
    assert load_type("sensor_msgs/msg/LaserScan") is LaserScan  # as in ROS 2


def test_a_full_name_that_is_unknown() -> None:
    with pytest.raises(UsageError, match=r"has a type sensor_msgs/Laserscan; did you mean sensor_msgs/LaserScan\?$"):
        load_type("sensor_msgs/Laserscan")
    with pytest.raises(UsageError, match=r"write package\.module:Class or FILE\.py:Class"):
        load_type("nowhere/Zzz")


@given(st.integers(0, 2**32 - 1))
def test_an_f32_prints_the_shortest_text_that_packs_to_the_same_bytes(bits: int) -> None:
    packed = struct.pack("<I", bits)
    value = struct.unpack("<f", packed)[0]
    if not math.isfinite(value):
        return
    text = repr(shortest_f32(value))

    assert struct.pack("<f", float(text)) == packed
    digits = len(Decimal(text).normalize().as_tuple().digits)
    for fewer in range(1, digits):
        for rounding in (ROUND_FLOOR, ROUND_CEILING):
            shorter = float(Context(prec=fewer, rounding=rounding).create_decimal(Decimal(value)))
            assert struct.pack("<d", shorter) != struct.pack("<d", value)
            try:
                other = struct.pack("<f", shorter)
            except OverflowError:
                continue
            assert other != packed


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        ([], Velocity3()),
        (["{x: 1.5, w: 0.25}"], Velocity3(x=1.5, w=0.25)),
        (["x: 1.5\nw: 0.25\n"], Velocity3(x=1.5, w=0.25)),
        (['{"x": 1.5, "w": 0.25}'], Velocity3(x=1.5, w=0.25)),
        (["x=1.5", "w=0.25"], Velocity3(x=1.5, w=0.25)),
        (["{x: 1, y: 2}", "y=3"], Velocity3(x=1.0, y=3.0)),
        (["x=1e-3", "y=-2E2", "w=+.5"], Velocity3(x=1e-3, y=-200.0, w=0.5)),
        (["{x: inf, y: -.inf, w: '-Infinity'}"], Velocity3(x=math.inf, y=-math.inf, w=-math.inf)),
        (["led=0x1f", "value=1e2"], Led(led=31, value=100)),
        (["led=007", "value=5.0"], Led(led=7, value=5)),
        (["text=5"], Text(text="5")),
        (["text=on: {no} 'yes'"], Text(text="on: {no} 'yes'")),
        (["text="], Text()),
        (["{text: 1e-3}"], Text(text="1e-3")),
        (["timestamp.sec=5", "{timestamp: {nsec: 7}, x: 1}"], StampedPose3(timestamp=r2p.Timestamp(5, 7), x=1.0)),
        (["{timestamp.sec: 5}"], StampedPose3(timestamp=r2p.Timestamp(5, 0))),
        (["value=[1, -.5]"], Speed2(value=(1.0, -0.5))),
        (["ranges=[1,2,3,0xffff]"], Proximity(ranges=(1, 2, 3, 65535))),
        (["{on: yes, y: 1, no: off}"], Switch(on=True, y=1.0, no="off")),
        (["on=0"], Switch()),
        (["ranges=[1, -.5, inf]", "header.frame_id=5"], LaserScan(SCANNED, ranges=Array([1.0, -0.5, math.inf]))),
        (["data=[1, 0xff]"], Image(data=Array(b"\1\xff"))),
        (["data=Af8=", "encoding=on"], Image(data=Array(b"\1\xff"), encoding="on")),
        (['{"raw": "Af8=", "class": 7}'], Bytes(raw=b"\1\xff", class_=7)),
        (["raw=[1, 255]", "class_=7"], Bytes(raw=b"\1\xff", class_=7)),
        (["{name: [a, on], position: [1]}"], JointState(name=("a", "on"), position=Array([1.0]))),
        (["fields=[{name: x, datatype: 7}, {}]"], PointCloud2(fields=(PointField("x", datatype=7), PointField()))),
        (["poses=[{x: 1}, {}]", "names=[a, b]"], Grid(poses=(Velocity3(x=1.0), Velocity3()), names=("a", "b"))),
    ],
)
def test_people_write(texts: list[str], message: r2p.Message) -> None:
    assert parse(type(message), texts) == message


@pytest.mark.parametrize(
    ("cls", "texts", "complaint"),
    [
        (Image, ["data=Af8"], "Image.data takes a list of at most 33554432, or their base64, not 'Af8'"),
        (Bytes, ["raw=[1,2,3,4,5]"], "Bytes.raw takes a list of at most 4, or their base64, not a list of 5"),
        (Bytes, ["raw=[1,256]"], "Bytes.raw[1] takes an integer from 0 to 255, not '256'"),
        (String, ["{data: [1]}"], "String.data takes a text of at most 65536 bytes in UTF-8, not a list of 1"),
        (Led, ["valu=1"], "Led has no field valu: it has led, value"),
        (Led, ["led=-1"], "Led.led takes an integer from 0 to 4294967295, not '-1'"),
        (Led, ["value=1.5"], "Led.value takes an integer from 0 to 255, not '1.5'"),
        (Led, ["value="], "Led.value takes an integer from 0 to 255, not nothing"),
        (Led, ["{led: [1]}"], "Led.led takes an integer from 0 to 4294967295, not a list of 1"),
        (Led, ["led.x=1"], "Led.led takes an integer from 0 to 4294967295, not a mapping"),
        (Led, ["{value: nan}"], "Led.value takes an integer from 0 to 255, not 'nan'"),
        (Led, ["led"], "'led' is not a message: write '{x: 1.5, w: 0.25}' or x=1.5 w=0.25"),
        (Led, ["{led: 1"], "'{led: 1' is not valid YAML: did not find expected ',' or '}' at its end"),
        (Led, ["{led: 1 ]}"], "'{led: 1 ]}' is not valid YAML: did not find expected ',' or '}' at character 9"),
        (Led, ['{"led": 1'], "'{\"led\": 1' is not valid JSON: expecting ',' delimiter at its end"),
        (
            Led,
            ['{"led": 1,\n "value" 0}'],
            "'{\"led\": 1,\\n \"value\" 0}' is not valid JSON: expecting ':' delimiter at character 10 in line 2",
        ),
        (Led, ["{? [1] : 2}"], "'{? [1] : 2}' is no"),
        (Velocity3, ["x=1e39"], "Velocity3.x takes a number up to"),
        (Velocity3, ["x=true"], "Velocity3.x takes a number up to"),
        (StampedPose3, ["timestamp=5"], "StampedPose3.timestamp takes a mapping of sec, nsec, not '5'"),
        (StampedPose3, ["timestamp=5", "timestamp.sec=5"], "timestamp.sec: timestamp already has a value"),
        (StampedPose3, ["timestamp.se=5"], "StampedPose3.timestamp has no field se: it has sec, nsec"),
        (Speed2, ["value=[1]"], "Speed2.value takes a list of 2, not a list of 1"),
        (Speed2, ["value=[1, x]"], r"Speed2.value[1] takes a number up to"),
        (Switch, ["on=maybe"], "Switch.on takes true or false, not 'maybe'"),
        (Switch, ["no=123456789"], "Switch.no takes at most 8 ASCII characters without a NUL, not '123456789'"),
    ],
)
def test_mistakes_are_told(cls: type[r2p.Message], texts: list[str], complaint: str) -> None:
    with pytest.raises(r2p.MessageError) as caught:
        parse(cls, texts)
    assert str(caught.value).startswith(complaint)


@pytest.mark.parametrize(
    "line", ['{"led": 1, "value": true}', '{"led": null}', '{"led": "x"}', "[1]", "{led", '{"led":1}x']
)
def test_bad_lines_of_a_stream_are_message_errors(line: str) -> None:
    with pytest.raises(r2p.MessageError):
        parse_line(Led, line)


@given(st.text())
def test_any_text_is_a_message_or_a_message_error(text: str) -> None:
    with contextlib.suppress(r2p.MessageError):
        parse(Grid, [text])
    with contextlib.suppress(r2p.MessageError):
        parse_line(Grid, text)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("{led: &a 1, value: *a}", r"'\{led: &a 1, value: \*a\}' has an alias, \*a: write out what it stands for"),
        ("{a: &a {x: 1}" + "".join(f", a{i}: &a{i} [*a, *a]" for i in range(30)) + "}", r"has an alias, \*a"),
        ("led: " + "[" * 30_000, "is nested more than 32 levels deep"),
        ("{led: " * 200 + "1" + "}" * 200, "is nested more than 32 levels deep"),
        ("led=" + "[" * 100 + "]" * 100, "is nested more than 32 levels deep"),
        ("led" + ".x" * 30_000 + "=1", "is nested more than 32 levels deep"),
        ("{led" + ".x" * 100 + ": 1}", "is nested more than 32 levels deep"),
        ("{led.a.b.c.d.e.f.g.h: " * 8 + "1" + "}" * 8, "is nested more than 32 levels deep"),
        ("led: \udcff", "is not valid YAML"),
        ("x" * 1000, r"'x{80}\.\.\.' is not a message"),
    ],
)
def test_what_would_take_all_memory_or_the_stack_is_a_mistake(text: str, complaint: str) -> None:
    with pytest.raises(r2p.MessageError, match=complaint) as caught:
        parse(Led, [text])
    assert len(str(caught.value)) < 300
    with pytest.raises(r2p.MessageError, match=complaint):
        parse_line(Led, text)


def test_json_that_is_nested_too_deeply() -> None:
    complaint = r"is nested more than 32 levels deep|led takes"
    for depth in (100, 900, 100_000):
        with pytest.raises(r2p.MessageError, match=complaint):
            parse_line(Led, '{"led": ' * depth + "1" + "}" * depth)
        with pytest.raises(r2p.MessageError, match=complaint):
            parse_line(Led, '{"led": ' + "[" * depth + "]" * depth + "}")


def test_not_a_number_goes_through_as_a_text() -> None:
    plain = to_plain(IMU(roll=math.nan, pitch=math.inf, yaw=-math.inf))
    assert [plain[name] for name in ("roll", "pitch", "yaw")] == ["nan", "inf", "-inf"]
    assert math.isnan(from_plain(IMU, plain).roll)


def test_bytes_are_base64_and_names_those_of_the_wire() -> None:
    assert to_plain(Bytes(b"\1\xff", b"abc", 7)) == {"raw": "Af8=", "serial": [97, 98, 99], "class": 7}
    assert to_plain(Image(data=Array(b"\1\xff")))["data"] == "Af8="


def test_long_arrays_are_shortened_for_people() -> None:
    scan = to_plain(LaserScan(ranges=Array([0.5] * 720), intensities=Array([1.0] * 16)), "short")
    assert scan["ranges"] == [0.5] * 8 + ["and 712 more"]
    assert scan["intensities"] == [1.0] * 16
    assert "ranges: [0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, and 712 more]\n" in to_yaml(scan)
    assert to_plain(Image(data=Array(bytes(921_600))), "short")["data"] == "<bytes 921600>"
    assert to_plain(Image(data=Array(bytes(3))), "short")["data"] == [0, 0, 0]
    assert to_plain(String("ä" * 2000), "short")["data"] == "ä" * 200 + "... (2000 characters)"


def test_what_varies_is_one_cell_of_a_table() -> None:
    joints = to_plain(JointState(name=("a", "b"), position=Array([0.1])), "cells")
    assert [joints[name] for name in ("name", "position", "effort")] == ['["a", "b"]', "[0.1]", "[]"]
    assert to_plain(PointCloud2(fields=(PointField("x"),)), "cells")["fields"] == (
        '[{"name": "x", "offset": 0, "datatype": 0, "count": 0}]'
    )


def test_what_meta_adds_is_no_field() -> None:
    assert parse_line(Led, '{"led": 3, "_": {"topic": "leds"}}') == Led(led=3)


@pytest.mark.parametrize(
    ("path", "value"),
    [("far", 2.5), ("poses[1].x", 0.5), ("poses[1]", {"x": 0.5, "y": 0.0, "w": 0.0}), ("cells[0][1]", 7)],
)
def test_pick(path: str, value: Any) -> None:
    grid = Grid(cells=((0, 7), (0, 0)), poses=(Velocity3(), Velocity3(x=0.5)), far=2.5)
    assert pick(grid, path) == value


def test_pick_from_arrays_of_variable_length() -> None:
    scan = LaserScan(ranges=Array([0.1, 0.2]))  # as published: not rounded
    assert [pick(scan, path) for path in ("ranges[1]", "ranges[2]", "header.stamp.sec")] == [0.2, None, 0]
    assert pick(Bytes(class_=3), "class") == pick(Bytes(class_=3), "class_") == 3
    cloud = PointCloud2(fields=(PointField("x"),))
    assert [pick(cloud, path) for path in ("fields[0].name", "fields[1].name", "data[0]")] == ["x", None, None]
    with pytest.raises(KeyError, match="no field ranges"):
        pick(scan, "ranges[16384]")
    with pytest.raises(KeyError, match="no field ranges"):
        pick(scan, f"ranges[{'9' * 5000}]")


@pytest.mark.parametrize("path", ["fat", "poses.x", "cells[2]", "far.x", "poses[0].z"])
def test_pick_tells_what_there_is(path: str) -> None:
    with pytest.raises(KeyError, match="the fields are cells, poses, names, far"):
        pick(Grid(), path)
    with pytest.raises(KeyError, match=r"the fields are timestamp\.sec, timestamp\.nsec, x, y, w"):
        pick(StampedPose3(), "z")
