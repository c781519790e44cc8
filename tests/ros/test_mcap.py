"""CDR of r2p, and the definitions of its classes, as a reader of ROS 2 recordings in MCAP files decodes them."""

import math
from typing import Any

import pytest
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory

import r2p
from r2p.messages import Duration, Timestamp, layout
from r2p.ros.cdr import cdr
from r2p.ros.classes import definitions_of
from r2p.ros.definitions import definition_text, parse
from tests.ros.recorded import class_of, message, recorded
from tests.ros.test_recorded_messages import REFUSED

TIMES = {
    name: parse(name, "int32 sec\nuint32 nanosec")[name]
    for name in ("builtin_interfaces/Time", "builtin_interfaces/Duration")
}
UNREADABLE = {"test_msgs/msg/WStrings", "builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration"}
"""The reader has no wide texts; and a time alone has no definition here."""
UNREADABLE |= {
    f"test_msgs/action/Fibonacci_{name}_{part}"
    for name in ("SendGoal", "GetResult")
    for part in ("Request", "Response")
}
UNREADABLE |= {"test_msgs/action/Fibonacci_FeedbackMessage"}
"""Types with parts of an action in them, whose names the reader does not accept."""
NAMES = sorted({case["type"] for case in recorded(2)["messages"]} - UNREADABLE - set(REFUSED))


def decode(cls: type[r2p.Message], data: bytes) -> Any:
    name = layout(cls).name
    text = definition_text(name, {**TIMES, **definitions_of(cls, 2)})
    schema = Schema(1, text.encode(), "ros2msg", name.replace("/", "/msg/"))
    decoder = DecoderFactory().decoder_for("cdr", schema)
    assert decoder is not None
    return decoder(data)


def same(ours: Any, theirs: Any) -> bool:
    """Whether two values are equal. In ROS 2 a header has no `seq`, and the parts of times have other signs."""
    if isinstance(ours, Timestamp | Duration):
        return not (ours.sec - theirs.sec) % (1 << 32) and not (ours.nsec - theirs.nanosec) % (1 << 32)
    if isinstance(ours, r2p.Message):
        names = [name for name in ours.__struct_fields__ if name != "seq"]
        return all(same(getattr(ours, name), getattr(theirs, name.rstrip("_"))) for name in names)
    if isinstance(ours, float):
        return ours == theirs or (math.isnan(ours) and math.isnan(theirs))
    if isinstance(ours, tuple | bytes | r2p.Array):
        return len(ours) == len(theirs) and all(map(same, ours, theirs))
    return bool(ours == theirs)


@pytest.mark.parametrize("name", NAMES)
def test_each_recorded_message_is_read(name: str) -> None:
    cls = class_of(2, name)
    for case in recorded(2)["messages"]:
        if case["type"] == name:
            ours = message(cls, case["value"])
            assert same(ours, decode(cls, cdr(cls).encode(ours))), case["style"]
