"""The messages of ROS in r2p.msg: the bytes that rosbags, which r2p shares no code with, gives them for ROS 1."""

import dataclasses
from functools import cache
from typing import Any, TypeAlias, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from r2p.messages import Duration, FixedArray, Message, Nested, Scalar, Shape, Timestamp, VariableArray, layout
from r2p.msg import (
    CompressedImage,
    Empty,
    Header,
    Image,
    JointState,
    LaserScan,
    PointCloud2,
    PointField,
    String,
)
from r2p.tools.types import standard_types
from tests.messages.strategies import messages

OF_ROS = [cls for cls in standard_types() if not layout(cls).name.startswith("r2p_msgs/")]
Ros: TypeAlias = Any  # rosbags makes its classes at run time


@cache
def store() -> Ros:
    return get_typestore(Stores.ROS1_NOETIC)


def ros_name(cls: type[Message]) -> str:
    package, _, name = layout(cls).name.partition("/")
    return f"{package}/msg/{name}"


def to_ros(shape: Shape, value: Any) -> Ros:
    """The value as rosbags wants it."""
    match shape:
        case Nested(inner) if inner.cls in (Timestamp, Duration):
            kind = "Time" if inner.cls is Timestamp else "Duration"
            # To rosbags the seconds of a time are signed: the same bytes, up to 2038 also the same number.
            return store().types[f"builtin_interfaces/msg/{kind}"](np.uint32(value.sec).astype(np.int32), value.nsec)
        case Nested(inner):
            values = [to_ros(field.shape, getattr(value, field.name)) for field in inner.fields]
            # rosbags wants a field where a message has none.
            return store().types[ros_name(inner.cls)](*(values or [0]))
        case VariableArray(Scalar(_, code)) | FixedArray(Scalar(_, code)):
            return np.asarray(value, dtype=code)
        case VariableArray(item) | FixedArray(item):
            return [to_ros(item, each) for each in value]
        case _:
            return value


@given(message=st.sampled_from(OF_ROS).flatmap(lambda cls: cast("st.SearchStrategy[Message]", messages(layout(cls)))))
@settings(max_examples=200)
def test_the_bytes_are_those_of_ros_1(message: Message) -> None:
    cls = type(message)
    theirs = bytes(store().serialize_ros1(to_ros(Nested(layout(cls)), message), ros_name(cls)))
    assert message.encode() == theirs
    assert cls.decode(theirs) == message


@pytest.mark.parametrize("cls", OF_ROS)
def test_fields_have_the_names_and_the_order_of_ros(cls: type[Message]) -> None:
    theirs = [field.name for field in dataclasses.fields(store().types[ros_name(cls)])]
    theirs = [name for name in theirs if name not in {"__msgtype__", "structure_needs_at_least_one_member"}]
    assert [field.name for field in layout(cls).fields] == [name for name in theirs if not name.isupper()]


def test_what_there_is() -> None:
    assert {*OF_ROS} == {
        CompressedImage, Empty, Header, Image, JointState, LaserScan, PointCloud2, PointField, String,
    }  # fmt: skip


def test_constants_are_those_of_ros() -> None:
    theirs = store().types["sensor_msgs/msg/PointField"]
    names = [name for name in vars(PointField) if name.isupper()]
    assert len(names) == 8
    assert [getattr(PointField, name) for name in names] == [getattr(theirs, name) for name in names]


def test_numpy_sees_an_image_without_a_copy() -> None:
    pixels = np.arange(24, dtype=np.uint8).reshape(2, 12)
    packed = Image(height=2, width=4, encoding="rgb8", step=12, data=pixels).encode()  # type: ignore[arg-type]
    image = Image.decode(packed)
    seen = np.asarray(image.data).reshape(image.height, image.step)
    assert seen.base is not None
    assert (seen == pixels).all()
    assert np.shares_memory(seen, np.frombuffer(packed, np.uint8))
