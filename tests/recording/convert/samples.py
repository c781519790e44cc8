"""A recording with messages of all classes of r2p.msg, and how to compare it with what others read of it."""

from __future__ import annotations

import itertools
import math
import struct
from typing import TYPE_CHECKING, Any

import r2p
from r2p.messages import (
    Array,
    Chars,
    Duration,
    FixedArray,
    Message,
    Nested,
    Scalar,
    Shape,
    Timestamp,
    VariableArray,
    VariableText,
    layout,
)
from r2p.messages.parts import view_of
from r2p.recording.samples import SampleWriter
from r2p.recording.writer import BagWriter
from r2p.ros.classes import standard_classes
from r2p.units import SECOND

if TYPE_CHECKING:
    from pathlib import Path

START = 1_700_000_000 * SECOND
FLOATS = itertools.cycle((0.1, -1.5e-30, math.nan, math.inf, -0.0, 2.5))
TEXTS = itertools.cycle(("", "lab", "a, \"b\"\nc = 'd'", "x" * 9))


def filled(cls: type[Message]) -> Message:
    """A message whose fields have values that are easily lost: infinities, texts with line breaks, large numbers."""
    shape = layout(cls)
    return shape.cls(**{each.name: _value(each.shape) for each in shape.fields})


def _value(shape: Shape) -> Any:
    match shape:
        case Nested(inner) if inner.cls in (Timestamp, Duration):
            return inner.cls(1_700_000_123, 456_789_012)
        case Nested(inner):
            return filled(inner.cls)
        case FixedArray(item, count, container):
            return _array(item, min(count, 1 << 16), container)
        case VariableArray(item, limit, container):
            return _array(item, min(limit, 3), container)
        case Chars(length) | VariableText(length):
            return next(TEXTS)[:length]
        case Scalar("bool"):
            return True
        case Scalar("f32"):
            return struct.unpack("<f", struct.pack("<f", next(FLOATS)))[0]
        case Scalar("f64"):
            return next(FLOATS)
        case Scalar():
            return shape.limits[1] - 1


def _array(item: Shape, count: int, container: str) -> Any:
    values = [_value(item) for _ in range(count)]
    if container == "bytes":
        return bytes(values)
    return Array(view_of(values, item.format)) if container == "array" and isinstance(item, Scalar) else tuple(values)


MESSAGES = {
    f"t_{name.lower().replace('/', '_')}": filled(cls)
    for name, cls in standard_classes().items()
    if cls not in (Timestamp, Duration)
}
"""A message of each class, by the topic that it has in the recording. ROS has times only within messages."""


def samples() -> list[tuple[str, r2p.Sample, type[Message], int]]:
    """All messages, with everything that a sample may have, 1 ms apart."""
    source = r2p.Source("IMU", "led", "tcp")
    made = []
    for i, (topic, message) in enumerate(MESSAGES.items()):
        stamp = START + i * 1_000_000
        for deadline, sequence in ((0, 2 * i + 1), (stamp + 20_000_000, 2 * i + 2)):
            sample = r2p.Sample(message.encode(), source, stamp, deadline, sequence)
            made.append((topic, sample, type(message), stamp + 300 + deadline % 2))
    return made


def record(path: Path) -> Path:
    """Write the recording, with an attachment and two messages of unknown type."""
    with path.open("wb") as file:
        writer = BagWriter(file)
        written = SampleWriter(writer)
        for each in samples():
            topic, sample, cls, time = each
            written.write(topic, sample, cls, time)
        for sequence in (1, 2):
            written.write("unknown", r2p.Sample(b"\x02", r2p.Source("LED1"), START, 0, sequence), None, START)
        writer.attach("r2p.toml", "application/toml", b"via = []", START)
        writer.finish()
    return path


def same(ours: Any, theirs: Any) -> bool:
    """Whether a value is what a reader of ROS's recordings returns for it."""
    match ours:
        case Timestamp() | Duration():
            nsec = getattr(theirs, "nanosec", None)
            return (ours.sec, ours.nsec) == (theirs.sec, theirs.nsec if nsec is None else nsec)
        case r2p.Message():
            names = [
                each for each in layout(type(ours)).fields if not (each.name == "seq" and not hasattr(theirs, "seq"))
            ]
            return all(same(getattr(ours, each.name), getattr(theirs, each.wire_name)) for each in names)
        case float():
            return ours == theirs or (math.isnan(ours) and math.isnan(theirs))
        case str() if not isinstance(theirs, str):  # characters of a fixed number
            return bytes(theirs).rstrip(b"\0") == ours.encode()
        case tuple() | bytes() | r2p.Array():
            return len(ours) == len(theirs) and all(map(same, ours, theirs))
        case _:
            return bool(ours == theirs)
