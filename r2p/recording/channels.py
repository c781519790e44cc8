"""The channels of a bag, and the types of the messages on them."""

import functools
import re
from collections.abc import Callable, Mapping
from typing import Literal, TypeAlias, TypeVar

import msgspec
from mcap.records import Channel, Schema

from r2p.errors import DecodeError, MessageError
from r2p.messages import Message, layout
from r2p.recording.format import CDR, META_PREFIX, OWN_PREFIX, PACKED, ChannelInfo
from r2p.recording.summary import Summary
from r2p.recording.types import ChannelType, type_of
from r2p.ros.cdr import cdr
from r2p.ros.ros2_schemas import ROS2MSG
from r2p.ros.transcoding import transcoder

M = TypeVar("M", bound=Message)

_LATCHED_IN_ROS = re.compile(r"durability:\s*(?:1\b|transient_local)")

Kind: TypeAlias = Literal["samples", "meta", "messages"]
"""What is on a channel: samples of a topic, their companions, or other messages."""


class BagChannel(msgspec.Struct, eq=False, dict=True):
    """A channel of a bag: its name (`/odometry`), the encoding of its messages, their schema, and how many they are.

    `info` says where samples come from; it is None on channels of other messages. For channels of other programs it is
    made up as far as possible: they have a topic and a type, but no publisher.
    """

    name: str
    encoding: str
    metadata: Mapping[str, str]
    count: int
    kind: Kind
    info: ChannelInfo | None = None
    schema_name: str = ""
    schema_encoding: str = ""
    schema: bytes = b""

    @functools.cached_property
    def cls(self) -> type[Message] | None:
        """The class of the messages; None if their type is unknown, or r2p can't have it (`problem`)."""
        return None if self._found[0] is None else self._found[0].cls

    @property
    def problem(self) -> str:
        """Why the type of the messages is unknown; empty if it is known."""
        return self._found[1]

    @functools.cached_property
    def from_cdr(self) -> Callable[[bytes, bytes], bytes]:
        """The function that makes packed messages of CDR, and of what CDR does not have. Raises DecodeError."""
        found, problem = self._found
        if found is None or found.cdr_cls is None:
            raise DecodeError(problem or f"the definition of {found and layout(found.cls).name} is not in the file")
        cls = found.cdr_cls
        if b"wstring" not in self.schema:
            return transcoder(cls).from_cdr
        codec = cdr(cls)  # of another program: ours write no wide texts
        return lambda data, _: layout(cls).encode(codec.decode(data))

    @functools.cached_property
    def _found(self) -> tuple[ChannelType | None, str]:
        try:
            return self._type(), ""
        except MessageError as error:
            return None, str(error)

    def _type(self) -> ChannelType:
        """Return the type of the messages. Raises MessageError."""
        definition = self.schema.decode(errors="replace") if self.schema_encoding == ROS2MSG else ""
        if self.info is not None and self.info.schema:
            found = type_of(self.info, definition)
            if found is not None:
                return found
        if self.schema_encoding != ROS2MSG:
            raise MessageError(f"the type of {self.name} is not in the file")
        from r2p.ros.topics import ros_class  # only here, as it takes a tenth of a second

        cls = ros_class(self.schema_name, 2, definition)
        return ChannelType(cls, cls)

    @property
    def type_name(self) -> str:
        """The full name of the type, as r2p has it; empty if it is unknown."""
        if self.info is not None and self.info.type:
            return self.info.type
        return self.schema_name.replace("/msg/", "/")

    @functools.cached_property
    def key(self) -> tuple[object, ...]:
        """What this channel has in common with the same one in other parts of a recording."""
        return self.name, self.encoding, tuple(sorted(self.metadata.items())), self.schema_name

    @property
    def is_latched(self) -> bool:
        """Whether rosbag2 recorded the channel as one whose last message late subscribers get."""
        return _LATCHED_IN_ROS.search(self.metadata.get("offered_qos_profiles", "")) is not None

    def plus(self, count: int) -> "BagChannel":
        """Return the channel with more messages, of another file."""
        return msgspec.structs.replace(self, count=self.count + count)

    def check(self, cls: type[Message]) -> str:
        """Return why messages of this channel can't be read as this class; empty if they can."""
        own = self.cls
        if own is None or layout(own).fingerprint == layout(cls).fingerprint:
            return ""
        return f"{self.name} was recorded as {layout(own).name}, whose fields are not those of {layout(cls).name}"


def channels_of(summary: Summary, *, is_own: bool) -> dict[int, BagChannel]:
    """Return the channels of a file by id. In a file of r2p (`is_own`), other channels than its own have no samples."""
    return {number: _channel(each, summary, is_own=is_own) for number, each in summary.channels.items()}


def _channel(record: Channel, summary: Summary, *, is_own: bool) -> BagChannel:
    schema = summary.schemas.get(record.schema_id) or Schema(0, b"", "", "")
    info, kind = _info(record, schema, is_own=is_own)
    return BagChannel(
        record.topic,
        record.message_encoding,
        record.metadata,
        summary.counts[record.id],
        kind,
        info,
        schema.name,
        schema.encoding,
        schema.data,
    )


def _info(record: Channel, schema: Schema, *, is_own: bool) -> tuple[ChannelInfo | None, Kind]:
    """Return where the messages of a channel come from, and what they are."""
    if record.message_encoding not in {CDR, PACKED}:
        return None, "messages"
    try:
        info = ChannelInfo.from_metadata(record.metadata)
    except DecodeError:  # of another program
        info = None
    if info is not None:
        return info, "meta" if record.topic.startswith(META_PREFIX) else "samples"
    if is_own or record.topic.startswith(OWN_PREFIX) or schema.encoding != ROS2MSG:
        return None, "messages"
    return ChannelInfo(record.topic.strip("/"), numbered=False, type=schema.name.replace("/msg/", "/")), "samples"
