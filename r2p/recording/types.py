"""The types of channels: the class of a channel, and the schema by which other programs read it."""

import functools

import msgspec

from r2p.errors import MessageError
from r2p.messages import Message, layout
from r2p.messages.schemas import message_type
from r2p.recording.format import ChannelInfo
from r2p.ros.classes import definitions_of, standard_classes
from r2p.ros.definitions import definition_text, parse
from r2p.ros.type_names import ros2_name

_TIMES = {
    **parse("builtin_interfaces/Time", "int32 sec\nuint32 nanosec\n"),
    **parse("builtin_interfaces/Duration", "int32 sec\nuint32 nanosec\n"),
}
"""What ROS 2 knows without its definition; a file has to say it."""


class Ros2Schema(msgspec.Struct, frozen=True):
    """A schema of the encoding `ros2msg`: the name of the type in ROS 2, and its definition with those in it."""

    name: str
    text: str


@functools.lru_cache(maxsize=1024)
def schema_of(cls: type[Message]) -> Ros2Schema:
    """Return the schema of a message class. Raises MessageError for one that ROS 2 can't define."""
    name = layout(cls).name
    return Ros2Schema(ros2_name(name), definition_text(name, _TIMES | definitions_of(cls, 2)))


def class_of(info: ChannelInfo) -> type[Message] | None:
    """Return the class of a channel: that of r2p.msg, or one made of its schema; None if its type is unknown."""
    return _class(info.type, info.schema) if info.type else None


@functools.lru_cache(maxsize=1024)
def _class(name: str, schema: str) -> type[Message] | None:
    known = standard_classes().get(name)
    if known is not None and layout(known).schema == schema:
        return known
    try:
        return message_type(name, schema)
    except MessageError:
        return None
