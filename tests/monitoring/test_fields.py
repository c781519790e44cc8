"""The numbers that plots take out of packed messages."""

from __future__ import annotations

import math
from typing import Annotated, Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

import r2p
from r2p.messages import layout, message_type
from r2p.monitoring.fields import FieldExtractor, describe_fields

_F32 = st.floats(width=32)
_F64 = st.floats()


class Point(r2p.Message):
    x: r2p.f32 = 0.0
    y: r2p.f64 = 0.0


class Label(r2p.Message):
    text: Annotated[str, r2p.Max(20)] = ""
    value: r2p.i16 = 0


class FixedMessage(r2p.Message):
    on: bool = False
    name: Annotated[str, r2p.Len(5)] = ""
    points: tuple[Point, Point] = (Point(), Point())
    raw: Annotated[bytes, r2p.Len(4)] = bytes(4)
    last: r2p.u64 = 0


class VariableMessage(r2p.Message):
    first: r2p.u8 = 0
    text: Annotated[str, r2p.Max(20)] = ""
    center: Point = Point()
    ranges: Annotated[r2p.Array[r2p.f32], r2p.Max(6)] = r2p.Array()
    points: Annotated[tuple[Point, ...], r2p.Max(3)] = ()
    labels: Annotated[tuple[Label, ...], r2p.Max(3)] = ()
    pair: tuple[Label, Label] = (Label(), Label())
    last: bool = False


_POINTS = st.builds(Point, _F32, _F64)
_LABELS = st.builds(Label, st.text(max_size=5), st.integers(-(2**15), 2**15 - 1))
_FIXED = st.builds(
    FixedMessage,
    st.booleans(),
    st.sampled_from(["", "abc", "abcde"]),
    st.tuples(_POINTS, _POINTS),
    st.binary(min_size=4, max_size=4),
    st.integers(0, 2**64 - 1),
)
_VARIABLE = st.builds(
    VariableMessage,
    st.integers(0, 255),
    st.text(max_size=5),
    _POINTS,
    st.lists(_F32, max_size=6).map(r2p.Array),
    st.lists(_POINTS, max_size=3).map(tuple),
    st.lists(_LABELS, max_size=3).map(tuple),
    st.tuples(_LABELS, _LABELS),
    st.booleans(),
)
_PATHS: dict[Any, list[str]] = {
    FixedMessage: ["on", "points[0].x", "points[1].y", "points[1].x", "raw[3]", "last"],
    VariableMessage: [
        "first",
        "center.y",
        "ranges[0]",
        "ranges[5]",
        "points[0].y",
        "points[2].x",
        "labels[1].value",
        "labels[2].value",
        "pair[0].value",
        "pair[1].value",
        "last",
    ],
}


def _same(one: float, other: float) -> bool:
    return one == other or (math.isnan(one) and math.isnan(other))


@given(st.one_of(_FIXED, _VARIABLE), st.data())
def test_the_numbers_are_those_of_the_decoded_message(message: Any, data: st.DataObject) -> None:
    paths = data.draw(st.lists(st.sampled_from(_PATHS[type(message)]), min_size=1, max_size=6))
    packed = message.encode()
    times, columns = FieldExtractor(type(message), paths).columns([1.0, 2.0], [packed, packed])
    decoded = layout(type(message)).decode(packed)
    assert list(times) == [1.0, 2.0]
    for path, column in zip(paths, columns, strict=True):
        assert all(_same(float(each), _at(decoded, path)) for each in column), path


def _at(message: Any, path: str) -> float:
    """The number at a path, found by another way than that of the extractor."""
    for step in path.replace("]", "").replace("[", ".").split("."):
        if step.isdecimal():
            if int(step) >= len(message):
                return math.nan
            message = message[int(step)]
        else:
            message = getattr(message, step)
    return float(message)


@given(st.sampled_from([FixedMessage, VariableMessage]), st.binary(max_size=200), st.data())
def test_bytes_of_another_type_are_counted_and_left_out(
    cls: type[r2p.Message], garbage: bytes, data: st.DataObject
) -> None:
    paths = data.draw(st.lists(st.sampled_from(_PATHS[cls]), min_size=1, max_size=6))
    good = layout(cls).zero.encode()
    extractor = FieldExtractor(cls, paths)
    times, columns = extractor.columns([1.0, 2.0, 3.0], [good, garbage, good])
    assert extractor.undecodable == 3 - len(times)
    assert list(times) in ([1.0, 3.0], [1.0, 2.0, 3.0])
    assert {len(column) for column in columns} == {len(times)}


@pytest.mark.parametrize(
    "path", ["", "nothing", "text", "center", "ranges", "ranges[6]", "ranges[-1]", "first[0]", "center..x", "x" * 5000]
)
def test_a_path_that_leads_to_no_number_is_an_error(path: str) -> None:
    with pytest.raises(r2p.MessageError, match=r"has no number .*; it has first, center\.x, center\.y, ranges\[\]"):
        FieldExtractor(VariableMessage, [path])


def test_a_count_in_a_message_is_not_believed() -> None:
    extractor = FieldExtractor(VariableMessage, ["last"])
    for at in (1, 13 + 4, 13 + 8):
        packed = bytearray(VariableMessage().encode())
        packed[at : at + 4] = b"\xff\xff\xff\xff"
        assert extractor.columns([1.0], [bytes(packed)]) == ((), [()])
    assert extractor.undecodable == 3


def test_types_that_are_nested_without_end_are_an_error() -> None:
    inner: type[r2p.Message] = Label
    for depth in range(40):
        inner = _array_of(inner, depth)
    path = "items[0]." * 40 + "value"
    with pytest.raises(r2p.MessageError, match="has too many arrays in arrays to be plotted"):
        FieldExtractor(inner, [path])


def _array_of(inner: Any, depth: int) -> Any:
    hints = {"items": Annotated[tuple[inner, ...], r2p.Max(2)]}
    metaclass: Any = type(r2p.Message)
    return metaclass(f"Level{depth}", (r2p.Message,), {"__annotations__": hints, "items": ()})


def test_fields_are_described_for_forms() -> None:
    described = [msgspec.to_builtins(each) for each in describe_fields(VariableMessage)]
    assert described[:5] == [
        {"path": "first", "kind": "u8", "plottable": True},
        {"path": "text", "kind": "text", "limit": 20},
        {"path": "center", "kind": "message"},
        {"path": "center.x", "kind": "f32", "plottable": True},
        {"path": "center.y", "kind": "f64", "plottable": True},
    ]
    assert {"path": "ranges", "kind": "f32", "max": 6, "plottable": True} in described
    assert {"path": "pair", "kind": "message", "length": 2} in described
    assert {"path": "pair[].value", "kind": "i16", "plottable": True} in described


def test_a_type_that_is_learnt_is_plotted_as_well() -> None:
    learnt = message_type("test/Learnt", layout(VariableMessage).schema)
    packed = VariableMessage(first=3, last=True).encode()
    assert FieldExtractor(learnt, ["last", "first"]).columns([0.0], [packed])[1] == [(True,), (3,)]
