"""The definition of a message class for programs that read CDR with `ros2msg`, such as ROS 2 and Foxglove."""

import functools

import msgspec

from r2p.messages import Message, layout
from r2p.ros.classes import definitions_of
from r2p.ros.definitions import definition_text, parse
from r2p.ros.type_names import ros2_name, short_name

ROS2MSG = "ros2msg"
"""The encoding of such schemas, in MCAP and in Foxglove's protocol."""

_TIMES = {
    **parse("builtin_interfaces/Time", "int32 sec\nuint32 nanosec\n"),
    **parse("builtin_interfaces/Duration", "int32 sec\nuint32 nanosec\n"),
}
"""Definitions that ROS 2 has built in, and that a file has to contain."""


class Ros2Schema(msgspec.Struct, frozen=True):
    """A schema of the encoding `ros2msg`: the name of the type in ROS 2, and its definition with those in it."""

    name: str
    text: str

    @property
    def record(self) -> tuple[str, str, bytes]:
        """The schema as files of MCAP have it: name, encoding and text."""
        return self.name, ROS2MSG, self.text.encode()


@functools.lru_cache(maxsize=1024)
def schema_of(cls: type[Message]) -> Ros2Schema:
    """Return the schema of a message class. Raises MessageError for one that ROS 2 can't define."""
    name = layout(cls).name
    definitions = definitions_of(cls, 2)
    for each in definitions:
        short_name(each)
    return Ros2Schema(ros2_name(name), definition_text(name, _TIMES | definitions))
