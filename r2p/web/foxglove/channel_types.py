"""What a message class is to clients: a schema in `ros2msg`, and what makes messages in CDR of packed ones, and back.

r2p's standard types become those that go with them in ROS (`r2p.ros.conversions`), as on a link to ROS; all others have
their own names, and their bytes are copied, not decoded. A type that is unknown, or that ROS can't have, becomes
`r2p_msgs/Untyped`: an array of its bytes.
"""

import functools
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Annotated, Any

import msgspec

from r2p.errors import MessageError
from r2p.messages import SIZE_MAX, Array, Max, Message, layout, u8
from r2p.messages.shapes import COUNT_SIZE
from r2p.msg import Odometry, StampedOdometry
from r2p.ros.cdr import cdr
from r2p.ros.conversions import RosNames, conversion, standard_type
from r2p.ros.packages import OF_ROS
from r2p.ros.ros2_schemas import Ros2Schema, schema_of
from r2p.ros.stamps import StampSource
from r2p.ros.standard import BASE, ODOM
from r2p.ros.tf import TFMessage, transforms_of
from r2p.ros.topics import has_header, header_filler
from r2p.ros.transcoding import transcoder
from r2p.runtime.sample import Sample

Encode = Callable[[Sample], Sequence[bytes]]
"""Returns the messages that a sample becomes. Raises MessageError and DecodeError."""

ROS2 = 2
POSES = (Odometry, StampedOdometry)
"""Types whose pose is also a transform."""

_SIZE_MAX = SIZE_MAX - COUNT_SIZE  # bytes of the longest message that has an array


class UntypedMessage(Message, name="r2p_msgs/Untyped"):
    """The packed bytes of a message of unknown type."""

    data: Annotated[Array[u8], Max(_SIZE_MAX)] = Array()


class RosChannelType(msgspec.Struct, frozen=True, eq=False):
    """What messages of a topic are to clients. `problem` says why they are bytes only, or not of a standard type."""

    schema: Ros2Schema
    encode: Encode
    problem: str = ""


def channel_type(topic: str, cls: type[Message] | None, counts: Counter[str]) -> RosChannelType:
    """Return what the messages of a topic of this class are to clients; `counts` has stamps of reception."""
    if cls is None:
        return _untyped(
            f"the type of {topic} is unknown: name it in [types] of r2p.toml, or ask its publisher's module"
        )
    problem = ""
    try:
        converted = _converted(topic, cls, counts)
        if converted is not None:
            return converted
    except MessageError as error:  # rosbags is not installed
        problem = f"{topic} has the type {layout(cls).name} here, not {standard_type(cls, ROS2)}: {error}"
    try:
        return RosChannelType(schema_of(cls), _copied(cls, counts), problem)
    except MessageError as error:
        return _untyped(f"{topic} is shown as bytes: {error}")


def _untyped(problem: str) -> RosChannelType:
    pack = cdr(UntypedMessage).encode
    return RosChannelType(
        schema_of(UntypedMessage),
        lambda sample: (pack(UntypedMessage(Array(sample.data))),),
        f"{problem}; it is shown as bytes",
    )


def _converted(topic: str, cls: type[Message], counts: Counter[str]) -> RosChannelType | None:
    """Return the channel's type for a class with a counterpart in ROS; None for others."""
    theirs = own_type(cls)
    found = None if theirs is None else conversion(cls, theirs, ROS2, names_of(topic))
    if found is None:
        return None
    to_ros, decode, pack = found.to_ros, layout(cls).decode, cdr(found.theirs).encode
    stamps = StampSource(cls, counts)

    def encode(sample: Sample) -> Sequence[bytes]:
        message = sample.message
        if message is None:
            message = decode(sample.data)
        return [pack(each) for each in to_ros(message, stamps.find(sample), sample.source)]

    return RosChannelType(schema_of(found.theirs), encode)


def own_type(cls: type[Message]) -> str | None:
    """Return the ROS type that messages of this class become; None: one with their own name and fields."""
    return None if layout(cls).name.partition("/")[0] in OF_ROS else standard_type(cls, ROS2)


def names_of(topic: str) -> RosNames:
    """Return the names in messages of a topic: those of a robot behind a gateway have its prefix."""
    prefix, _, last = topic.rpartition("/")
    return RosNames(last, f"/{prefix}" if prefix else "")


def _copied(cls: type[Message], counts: Counter[str]) -> Encode:
    """Return what copies messages; one with a header that has no stamp gets one."""
    to_cdr = transcoder(cls).to_cdr
    if not has_header(layout(cls)):
        return lambda sample: (to_cdr(sample.data)[0],)
    fill, pack = header_filler(layout(cls), counts), cdr(cls).encode

    def encode(sample: Sample) -> Sequence[bytes]:
        filled = fill(sample)
        return (to_cdr(sample.data)[0] if filled is None else pack(filled),)

    return encode


@functools.cache
def transform_schema() -> Ros2Schema:
    """Return the schema of transforms."""
    return schema_of(TFMessage)


def transform_encoder(topic: str, cls: type[Message], counts: Counter[str]) -> Encode:
    """Return what makes transforms of the poses of an odometry; those of a robot behind a gateway have its prefix."""
    names, pack, decode = names_of(topic), cdr(TFMessage).encode, layout(cls).decode
    stamps, frame, child = StampSource(cls, counts), names.frame(ODOM), names.frame(BASE)

    def encode(sample: Sample) -> Sequence[bytes]:
        message: Any = sample.message
        if message is None:
            message = decode(sample.data)
        return (pack(transforms_of(message.pose, stamps.find(sample), frame, child)),)

    return encode
