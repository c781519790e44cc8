"""The types of channels: the class by which the messages of a channel are read."""

import contextlib
import functools

import msgspec

from r2p.errors import MessageError
from r2p.messages import Message, layout
from r2p.messages.schemas import message_type
from r2p.recording.format import ChannelInfo
from r2p.ros.classes import RosTypes, standard_classes
from r2p.ros.definitions import parse


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
