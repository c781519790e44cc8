"""Packed messages become CDR and come back, bit for bit, whatever their bytes are."""

import struct
from typing import Annotated, Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import r2p
from r2p.messages import Array, Layout, Nested, Scalar, Shape, VariableText, layout
from r2p.messages.shapes import HINTS, Chars, FixedArray, VariableArray
from r2p.msg import Header, Image, JointState, Led, String
from r2p.ros.cdr import HEADER, WIDE, cdr
from r2p.ros.std_srvs import Empty
from r2p.ros.transcoding import transcoder
from tests.messages.classes import define
from tests.messages.strategies import messages

LEAVES = [
    *HINTS.values(),
    Annotated[str, r2p.Len(3)],
    Annotated[str, r2p.Max(12)],
    Header,
    r2p.Timestamp,
    Empty.Request,
]


def array_of(item: Any) -> st.SearchStrategy[Any]:
    """An annotation of an array of such elements."""
    bound = st.builds(r2p.Max, st.integers(1, 9)) | st.builds(r2p.Len, st.integers(1, 3))
    numbers = item in HINTS.values()
    array: Any = Array
    kinds: list[Any] = [tuple.__class_getitem__((item, ...)), *([array[item]] * numbers)]
    return st.builds(lambda kind, mark: Annotated[kind, mark], st.sampled_from(kinds), bound)


def annotations() -> st.SearchStrategy[Any]:
    leaves = st.sampled_from(LEAVES)
    filled = st.sampled_from([each for each in LEAVES if each is not Empty.Request])
    return st.recursive(
        leaves | filled.flatmap(array_of) | st.just(Annotated[bytes, r2p.Max(9)]),
        lambda inner: classes(inner) | classes(inner).filter(lambda cls: layout(cls).size > 0).flatmap(array_of),
        max_leaves=8,
    )


def classes(fields: st.SearchStrategy[Any]) -> st.SearchStrategy[type[r2p.Message]]:
    return st.lists(fields, min_size=1, max_size=5).map(
        lambda hints: define("Any", [(f"f{number}", hint) for number, hint in enumerate(hints)])
    )


def packed(shape: Shape) -> st.SearchStrategy[bytes]:
    """Any bytes that fit a shape: also NaNs, texts that are not UTF-8, and bools of any value."""
    match shape:
        case Scalar() | Chars():
            return st.binary(min_size=shape.size, max_size=shape.size)
        case VariableText():
            return st.binary(max_size=9).map(lambda data: struct.pack("<I", len(data)) + data)
        case FixedArray(item, count):
            return st.lists(packed(item), min_size=count, max_size=count).map(b"".join)
        case VariableArray(item):
            return st.lists(packed(item), max_size=3).map(lambda each: struct.pack("<I", len(each)) + b"".join(each))
        case Nested(inner):
            return st.tuples(*[packed(field.shape) for field in inner.fields]).map(b"".join)


def without_seq(cls: type[r2p.Message], encoded: bytes) -> bytes:
    """The packed message, with all `seq` of headers zero."""
    return cdr(cls).decode(encoded).encode()  # type: ignore[no-any-return]


@settings(max_examples=40)
@given(classes(annotations()), st.data())
def test_messages_of_any_class(cls: type[r2p.Message], data: st.DataObject) -> None:
    shape: Layout[Any] = layout(cls)
    both, message = transcoder(cls), data.draw(messages(shape))
    encoded, rest = both.to_cdr(message.encode())
    assert encoded == cdr(cls).encode(message)
    assert both.from_cdr(encoded, rest) == message.encode()
    assert both.from_cdr(encoded + b"\1\2\3", b"") == without_seq(cls, encoded)

    anything = data.draw(packed(Nested(shape)))
    encoded, rest = both.to_cdr(anything)
    assert both.from_cdr(encoded, rest) == anything


@settings(max_examples=25)
@given(classes(annotations()), st.data())
def test_cut_and_damaged_bytes(cls: type[r2p.Message], data: st.DataObject) -> None:
    both, anything = transcoder(cls), data.draw(packed(Nested(layout(cls))))
    encoded, rest = both.to_cdr(anything)
    for each in (anything + b"\0", anything[:-1]) if anything else (b"\0",):
        with pytest.raises(r2p.DecodeError):
            both.to_cdr(each)
    with pytest.raises(r2p.DecodeError):
        both.from_cdr(encoded[:-1], rest)
    with pytest.raises(r2p.DecodeError):
        both.from_cdr(encoded, rest + b"\0")
    hostile = data.draw(st.binary(max_size=80))
    for function, given_bytes in ((both.to_cdr, hostile), (both.from_cdr, HEADER + hostile)):
        try:
            found = function(given_bytes) if function is both.to_cdr else both.from_cdr(given_bytes, rest)
        except r2p.DecodeError:
            continue
        assert len(found) <= 8 * (len(hostile) + layout(cls).size_min + 8)


@pytest.mark.parametrize("cls", [JointState, Image, String])
def test_large_counts_allocate_nothing(cls: type[r2p.Message]) -> None:
    both, size = transcoder(cls), layout(cls).size_min
    refused = 0
    for at in range(size - 3):
        data = bytearray(size)
        data[at : at + 4] = b"\xff" * 4
        try:
            both.to_cdr(bytes(data))
        except r2p.DecodeError:
            refused += 1
    assert refused >= layout(cls).schema.count(":str") + layout(cls).schema.count("[]")
    with pytest.raises(r2p.DecodeError, match="a count of 4294967295"):
        both.from_cdr(HEADER + b"\xff" * 100, b"")


class Spin(r2p.Message, name="robot_msgs/Spin"):
    on: bool = False
    name: Annotated[str, r2p.Len(4)] = ""
    rate: r2p.f32 = 0.0
    angle: r2p.f64 = 0.0
    note: Annotated[str, r2p.Max(5)] = ""


def test_no_bit_is_lost() -> None:
    data = b"\2" + b"a\0b\0" + b"\1\0\x80\x7f" + struct.pack("<Q", 0xFFF0_0000_0000_0BAD) + b"\3\0\0\0\xff\0\xfe"
    encoded, rest = transcoder(Spin).to_cdr(data)
    assert encoded == HEADER + b"\2a\0b\0\0\0\0\1\0\x80\x7f\0\0\0\0" + data[9:17] + b"\4\0\0\0\xff\0\xfe\0"
    assert (transcoder(Spin).from_cdr(encoded, rest), rest) == (data, b"")


def test_the_number_of_a_header_is_the_rest() -> None:
    both, message = transcoder(JointState), JointState(Header(7, frame_id="map"))
    encoded, rest = both.to_cdr(message.encode())
    assert (encoded, rest) == (cdr(JointState).encode(message), b"\7\0\0\0")
    assert both.from_cdr(encoded, rest) == message.encode()
    assert both.to_cdr(JointState().encode())[1] == b""
    for wrong in (b"\7\0\0", b"\7\0\0\0" * 2):
        with pytest.raises(r2p.DecodeError, match=r"JointState: . bytes are not what CDR could not hold"):
            both.from_cdr(encoded, wrong)


class OddHeader(r2p.Message, name="std_msgs/Header"):
    seq: r2p.u8 = 0


def test_another_header_is_refused() -> None:
    with pytest.raises(r2p.MessageError, match="the seq of std_msgs/Header is u8 here"):
        transcoder(OddHeader)


class Wide(r2p.Message, name="test_msgs/Wide"):
    text: Annotated[Annotated[str, r2p.Max(9)], WIDE] = ""


def test_a_wide_text_is_a_string_in_recordings() -> None:
    assert transcoder(Wide).to_cdr(Wide("é").encode())[0] == HEADER + b"\3\0\0\0\xc3\xa9\0"


def test_a_text_without_terminator_is_empty() -> None:
    assert transcoder(String).from_cdr(HEADER + bytes(4), b"") == String().encode()


@pytest.mark.parametrize("cls", [Led, String])
def test_errors_name_the_class(cls: type[r2p.Message]) -> None:
    with pytest.raises(r2p.DecodeError, match=f"^{cls.__name__}: "):
        transcoder(cls).to_cdr(b"12345678901")
    with pytest.raises(r2p.DecodeError, match=f"^{cls.__name__}: .*little-endian"):
        transcoder(cls).from_cdr(bytes(13), b"")
