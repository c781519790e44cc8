"""The types of channels: the class of a channel, and the schema by which other programs read it."""

import contextlib
import functools

import msgspec

from r2p.errors import MessageError
from r2p.messages import Message, layout
from r2p.messages.schemas import message_type
from r2p.recording.format import ROS2MSG, ChannelInfo
from r2p.ros.classes import RosTypes, definitions_of, standard_classes
from r2p.ros.definitions import definition_text, parse
from r2p.ros.type_names import ros2_name, short_name

_TIMES = {
    **parse("builtin_interfaces/Time", "int32 sec\nuint32 nanosec\n"),
    **parse("builtin_interfaces/Duration", "int32 sec\nuint32 nanosec\n"),
}
"""What ROS 2 knows without its definition; a file has to say it."""


class Ros2Schema(msgspec.Struct, frozen=True):
    """A schema of the encoding `ros2msg`: the name of the type in ROS 2, and its definition with those in it."""

    name: str
    text: str

    @property
    def record(self) -> tuple[str, str, bytes]:
        """The schema as `BagWriter.add_channel` takes it: name, encoding and text."""
        return self.name, ROS2MSG, self.text.encode()


@functools.lru_cache(maxsize=1024)
def schema_of(cls: type[Message]) -> Ros2Schema:
    """Return the schema of a message class. Raises MessageError for one that ROS 2 can't define."""
    name = layout(cls).name
    definitions = definitions_of(cls, 2)
    for each in definitions:
        short_name(each)
    return Ros2Schema(ros2_name(name), definition_text(name, _TIMES | definitions))


class ChannelType(msgspec.Struct, frozen=True, eq=False):
    """The class of the messages of a channel, and the one by which their CDR is read, if that is known.

    They differ where the definition is not the whole truth: to ROS, a text of fixed length is an array of octets.
    """

    cls: type[Message]
    cdr_cls: type[Message] | None


def type_of(info: ChannelInfo, definition: str = "") -> ChannelType | None:
    """Return the type of a channel; None if it is unknown. `definition` is the text of its schema, if it has one.

    The class is that of r2p.msg with its layout, else one made of the definition, else of the layout alone; then
    messages within others have made-up names.
    """
    return _type(info.type, info.schema, definition) if info.type else None


@functools.lru_cache(maxsize=1024)
def _type(name: str, schema: str, definition: str) -> ChannelType | None:
    defined = _defined(name, definition) if definition or not schema else None  # a message without fields has neither
    if defined is not None and layout(defined).schema == schema:
        return ChannelType(defined, defined)
    if defined is not None and layout(defined).schema != schema.replace(":char[", ":u8["):
        defined = None
    known = standard_classes().get(name)
    if known is not None and layout(known).schema == schema:
        return ChannelType(known, defined)
    for each in (name, name.rpartition("/")[2]):  # a class may have a name that ROS can't have, as `_Led`
        with contextlib.suppress(MessageError):
            return ChannelType(message_type(each, schema), defined)
    return None


def _defined(name: str, definition: str) -> type[Message] | None:
    with contextlib.suppress(MessageError):
        cls = RosTypes(2, parse(name, definition)).load(name)
        layout(cls)
        return cls
    return None
