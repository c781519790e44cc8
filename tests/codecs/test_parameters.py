"""Descriptions and sets of parameters on the wire: the bytes of PROTOCOL.md, round trips, and hostile bytes."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from r2p.codecs import parameters
from r2p.codecs.parameters import Origin, ParameterKind, ParameterList, ParameterRecord
from r2p.errors import DecodeError, MessageError

ints = st.integers(-(1 << 63), (1 << 63) - 1)
floats = st.floats(allow_nan=False)
texts = st.text(max_size=60)
nodes = st.from_regex(r"[A-Za-z0-9_]{1,64}", fullmatch=True)
names = st.from_regex(r"[A-Za-z0-9_]{1,30}(\.[A-Za-z0-9_]{1,30})?", fullmatch=True)
values: dict[ParameterKind, st.SearchStrategy[Any]] = {
    ParameterKind.BOOL: st.booleans(),
    ParameterKind.INT: ints,
    ParameterKind.FLOAT: floats,
    ParameterKind.STR: texts,
    ParameterKind.ENUM: texts,
    ParameterKind.INTS: st.lists(ints, min_size=1, max_size=16).map(tuple),
    ParameterKind.FLOATS: st.lists(floats, min_size=1, max_size=16).map(tuple),
}


@st.composite
def records(draw: st.DrawFn) -> ParameterRecord:
    kind = draw(st.sampled_from(ParameterKind))
    value = values[kind]
    limit = st.none() | (ints if kind in (ParameterKind.INT, ParameterKind.INTS) else floats)
    return ParameterRecord(
        node=draw(nodes),
        name=draw(names),
        kind=kind.text,
        value=draw(value),
        default=draw(value),
        minimum=draw(limit),
        maximum=draw(limit),
        unit=draw(texts),
        doc=draw(texts),
        read_only=draw(st.booleans()),
        choices=tuple(draw(st.lists(texts, max_size=3))),
        origin=draw(st.sampled_from(Origin)).text,
        saved=draw(st.none() | value),
        problem=draw(texts),
    )


lists = st.builds(ParameterList, st.integers(0, (1 << 32) - 1), st.booleans(), st.lists(records(), max_size=4))
changes = st.dictionaries(st.tuples(texts, texts), st.none() | st.one_of(*values.values()), max_size=5)


@settings(max_examples=50)
@given(lists)
def test_lists_come_back(listed: ParameterList) -> None:
    assert parameters.decode_list(parameters.encode_list(listed)) == listed


@settings(max_examples=50)
@given(changes)
def test_changes_come_back_with_the_types_of_their_values(
    changed: dict[tuple[str, str], parameters.Plain | None],
) -> None:
    decoded = parameters.decode_changes(parameters.encode_changes(changed))
    assert decoded == changed
    assert [type(each) for each in decoded.values()] == [type(each) for each in changed.values()]


@settings(max_examples=60)
@given(st.binary(max_size=200) | lists.map(parameters.encode_list), st.data())
def test_bytes_of_strangers_are_refused_or_read(data: bytes, more: st.DataObject) -> None:
    """Also those of messages that are cut off, or have a wrong byte."""
    cut = data[: more.draw(st.integers(0, len(data)))]
    at = more.draw(st.integers(0, max(0, len(data) - 1)))
    for each in (data, cut, data[:at] + bytes((more.draw(st.integers(0, 255)),)) + data[at + 1 :]):
        for decode in (
            parameters.decode_list,
            parameters.decode_changes,
            parameters.decode_part,
            parameters.decode_count,
        ):
            try:
                decode(each)
            except DecodeError:
                continue


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "6 bytes are announced, 0 are there"),
        (b"\2" + bytes(5), "a list of parameters of version 2"),
        (b"\1" + bytes(4) + b"\1\xff\xff\0\0", "65535 bytes are announced, 0 are there"),
        (b"\1" + bytes(4) + b"\1\4\0\0\0\1a\1b", "kind 0 are unknown"),
        (b"\1" + bytes(4) + b"\1\5\0\0\0\1a\1b\x08", "kind 8 are unknown"),
        (b"\1" + bytes(4) + b"\1\7\0\0\0\1a\1b\1\1\0", "a.b has no value"),
        (b"\1" + bytes(4) + b"\1\6\0\0\0\1a\1b\1\2", "a bool of 2"),
        (b"\1" + bytes(4) + b"\1\2\0\0\0\1\x80", "not UTF-8"),
        (b"\1" + bytes(4) + b"\1\5\0\0\0\4$(x)", r"node name .*\$\(x\)"),
        (b"\1" + bytes(4) + b"\1\5\0\0\0\1a\2b\n", "parameter name"),
    ],
)
def test_what_is_wrong_with_a_list(data: bytes, reason: str) -> None:
    with pytest.raises(DecodeError, match=reason):
        parameters.decode_list(data)


def test_a_record_of_a_later_version_is_read_as_far_as_it_is_known() -> None:
    record = ParameterRecord(node="a", name="b", kind="bool", value=True, default=False)
    data = bytearray(parameters.encode_list(ParameterList(1, True, [record, record])))
    size = 6 + 4 + data[6]
    longer = data[:6] + bytes((data[6] + 3,)) + data[7:size] + b"new" + data[size:]
    assert parameters.decode_list(bytes(longer)).records == [record, record]


def test_what_no_message_can_carry() -> None:
    for value, reason in (
        ("a" * 256, "256 bytes of UTF-8"),
        ("\udc80", "UTF-8 does not have"),
        (1 << 63, "more than 64 bits"),
        ((1, 1 << 63), "more than 64 bits"),
        ((0.5,) * 256, "256 numbers"),
        ((True,), "a tuple is not"),
        (None, ""),
        ({"a": 1}, "a dict is not"),
    ):
        if value is None:
            assert parameters.encode_value(value) == b"\0"
            continue
        with pytest.raises(MessageError, match=reason):
            parameters.encode_value(value)  # type: ignore[arg-type]


def test_a_value_that_is_no_number_reaches_its_parameter_which_refuses_it() -> None:
    (value,) = parameters.decode_changes(parameters.encode_changes({("a", "b"): math.nan})).values()
    assert isinstance(value, float)
    assert math.isnan(value)


def test_a_parameter_is_set_once_in_a_set() -> None:
    once = parameters.encode_changes({("a", "b"): 1})
    with pytest.raises(DecodeError, match=r"a\.b is set twice"):
        parameters.decode_changes(once + once)
