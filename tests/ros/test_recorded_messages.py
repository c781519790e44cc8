"""Each message that a real ROS program has serialised has the same bytes here, and means the same."""

import ast
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import r2p
from r2p.msg import JointState, PointCloud2
from r2p.ros.cdr import HEADER, cdr
from tests.ros.recorded import class_of, message, recorded

REFUSED = [f"test_msgs/msg/{name}" for name in ("Arrays", "MultiNested")]
REFUSED += [f"test_msgs/msg/{name}Sequences" for name in ("Bounded", "BoundedPlain", "Unbounded")]
"""Types with arrays of messages without fields, which r2p has no classes for: a count would be all that arrives."""

Case = dict[str, Any]


def by_type(version: int, *lists: str) -> list[Any]:
    """The cases of each type, as one parameter."""
    found: dict[str, list[Case]] = {}
    for name in lists:
        for case in recorded(version)[name]:
            found.setdefault(case["type"], []).append(case)
    return [pytest.param(name, cases, id=name) for name, cases in found.items()]


def written_by_ros2(case: Case) -> bytes:
    """The bytes up to the last that mean something, with zeros for padding."""
    data = bytearray.fromhex(case["bytes"])[: case["size_without_tail"]]
    for offset, length in case["padding"]:
        data[offset : offset + length] = bytes(len(data[offset : offset + length]))
    return bytes(data)


@pytest.mark.parametrize(("name", "cases"), by_type(1, "messages"))
def test_ros1(name: str, cases: list[Case]) -> None:
    cls = class_of(1, name)
    for case in cases:
        data = bytes.fromhex(case["bytes"])
        assert message(cls, case["value"]).encode() == data, case["style"]
        assert cls.decode(data).encode() == data, case["style"]


@pytest.mark.parametrize(("name", "cases"), by_type(2, "messages", "parameter_messages", "parameter_events"))
def test_ros2(name: str, cases: list[Case]) -> None:
    if name in REFUSED:
        with pytest.raises(r2p.MessageError, match="has no bytes, so an array of it says nothing"):
            r2p.layout(class_of(2, name))
        return
    cls = class_of(2, name)
    codec = cdr(cls)
    for case in cases:
        data = written_by_ros2(case)
        assert codec.encode(message(cls, case["value"])) == data, case["style"]
        # What is decoded has padding of any bytes, and more behind it.
        assert codec.encode(codec.decode(bytes.fromhex(case["bytes"]))) == data, case["style"]


@pytest.mark.parametrize("call", recorded(2)["parameter_calls"], ids=lambda call: f"{call['type']}-{call['note']}")
def test_calls_of_parameter_services(call: Case) -> None:
    for part in (call["request"], call["response"]):
        codec, data = cdr(class_of(2, part["type"])), written_by_ros2(part)
        assert codec.encode(codec.decode(bytes.fromhex(part["bytes"]))) == data


@pytest.mark.parametrize("sample", recorded(2)["topic_samples"], ids=lambda sample: sample["note"])
def test_what_a_subscriber_receives(sample: Case) -> None:
    codec = cdr(class_of(2, sample["type"]))
    taken, serialised = (codec.decode(bytes.fromhex(sample[key])) for key in ("taken", "serialize_message"))
    assert codec.encode(taken) == codec.encode(serialised)


@pytest.mark.parametrize("case", recorded(1)["decode_edge"], ids=lambda case: f"{case['type']}-{case['note']}")
def test_odd_bytes_of_ros1(case: Case) -> None:
    """What r2p accepts keeps its bytes, also a time with too many nanoseconds, of which genpy makes another one; or it
    means what it means to genpy. r2p refuses all that is cut or left over, genpy only some of it.
    """
    cls = class_of(1, case["type"])
    data = bytes.fromhex(case["bytes"])
    try:
        found = cls.decode(data)
    except r2p.DecodeError:
        assert case.get("reencoded") != case["bytes"]
    else:
        assert found.encode().hex() in (case["bytes"], case.get("reencoded"))


@pytest.mark.parametrize("case", recorded(1)["encode_edge"], ids=lambda case: f"{case['type']}-{case['note']}")
def test_odd_values_of_ros1(case: Case) -> None:
    """What genpy refuses r2p refuses, with an error that names the field; so are a number for a bool and a duration for
    a time, which genpy packs.
    """
    (name, text), *_ = case["fields"].items()
    value = r2p.Duration(1, 2) if text.startswith("genpy.Duration") else ast.literal_eval(text)
    made = class_of(1, case["type"])(**{name: value})
    if case["note"] in ("int 1 for bool", "duration for time") or "error" in case:
        with pytest.raises(r2p.MessageError, match=rf"\w+\.{name} \("):
            made.encode()
    else:
        assert made.encode().hex() == case["bytes"]


def test_a_message_begins_with_its_header() -> None:
    codec = cdr(r2p.msg.String)
    assert codec.encode(r2p.msg.String("hi")) == HEADER + b"\x03\0\0\0hi\0"
    with pytest.raises(r2p.DecodeError, match="little-endian CDR"):
        codec.decode(b"\0\0\0\0\0\0\0\x03hi\0")


@given(st.binary(max_size=64), st.integers(0, 300))
def test_any_bytes_are_a_message_or_an_error(data: bytes, cut: int) -> None:
    for cls in (JointState, PointCloud2, class_of(2, "test_msgs/msg/WStrings")):
        codec = cdr(cls)
        for each in (HEADER + data, codec.encode(cls())[:cut] + data):
            try:
                found = codec.decode(each)
            except r2p.DecodeError:
                continue
            assert codec.decode(codec.encode(found)) is not None


def test_a_count_from_the_wire_allocates_nothing() -> None:
    many = HEADER + bytes(8) + b"\x01\0\0\0\0\0\0\0" + b"\xff\xff\0\0"
    with pytest.raises(r2p.DecodeError, match=r"a count of 65535 with 0 bytes behind it|at most 256"):
        cdr(JointState).decode(many)


def test_a_value_that_does_not_fit_is_named() -> None:
    with pytest.raises(r2p.MessageError, match=r"JointState.name\[1\] \(str\) takes a text"):
        cdr(JointState).encode(JointState(name=("a", 5)))  # type: ignore[arg-type] # what is tested
