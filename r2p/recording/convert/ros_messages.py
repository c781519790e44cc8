"""Messages of ROS as they are in recordings: their types, their bytes as those that r2p packs, and how to read them."""

import functools
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import msgspec

from r2p.errors import DecodeError, InvalidName, MessageError
from r2p.messages import Message, layout
from r2p.names import topic_name
from r2p.recording.convert.stream import ConversionOptions, ConvertedRecord, Losses
from r2p.ros.classes import definitions_of, standard_classes
from r2p.ros.definitions import definition_text
from r2p.ros.library import definitions_of_ros, definitions_with_those_of_ros, ros1_md5, ros2_hash
from r2p.ros.packages import OF_ROS
from r2p.ros.ros2_schemas import schema_of
from r2p.ros.stamps import StampSource
from r2p.ros.topics import ros_class
from r2p.ros.transcoding import transcoder
from r2p.ros.type_names import ros2_name, short_name
from r2p.runtime.sample import Sample, Source


class RosDecoder(msgspec.Struct, frozen=True):
    """Decodes the messages of one type of ROS 1 or 2. A call returns the message as r2p packs it, and its own stamp
    (UTC, ns; 0: no stamp), and raises DecodeError.
    """

    cls: type[Message]
    pack: Callable[[bytes], bytes]
    own_stamp: Callable[[bytes], int]

    def __call__(self, data: bytes) -> tuple[bytes, int]:
        packed = self.pack(data)
        own = self.own_stamp(packed)
        return packed, own if own >= StampSource.OLDEST_UTC else 0


@functools.lru_cache(maxsize=1024)
def ros_decoder(name: str, version: int, definition: str) -> RosDecoder:
    """Return the decoder of a type; without a definition it is the one of its name that comes with ROS.

    Raises MessageError for a type that is unknown, or that r2p has no class for.
    """
    cls = _standard(ros_class(short_name(name), version, definition), version)
    own_stamp = StampSource(cls, Counter()).own
    if version == 1:
        return RosDecoder(cls, _checked(cls), own_stamp)
    from_cdr = transcoder(cls).from_cdr
    return RosDecoder(cls, lambda data: from_cdr(data, b""), own_stamp)


def _standard(cls: type[Message], version: int) -> type[Message]:
    """Return the class of r2p.msg with this name and these fields in ROS, where texts of fixed length are octets."""
    known = standard_classes().get(layout(cls).name)
    return known if known is not None and definitions_of(known, version) == definitions_of(cls, version) else cls


def _checked(cls: type[Message]) -> Callable[[bytes], bytes]:
    """Return what passes bytes of ROS 1 on, which are those of r2p, if they are of this type."""
    decode = layout(cls).decode

    def check(data: bytes) -> bytes:
        decode(data)
        return data

    return check


class RosSchema(msgspec.Struct, frozen=True):
    """What a recording of ROS has of a type: its name, its definition with those in it, and its checksum."""

    name: str
    definition: str
    checksum: str


def schema_or_loss(record: ConvertedRecord, version: int) -> RosSchema | str:
    """Return the schema of a record's type in ROS 1 or 2; without one, the description of its loss."""
    if record.cls is None:
        return f"messages of {record.topic}, whose type is unknown: --type {record.topic}=TYPE states it"
    try:
        return _ros_schema(record.cls, version)
    except MessageError as error:
        return f"messages of {record.topic}: {error}"


@functools.lru_cache(maxsize=1024)
def _ros_schema(cls: type[Message], version: int) -> RosSchema:
    """Return the schema of a message class in ROS 1 or 2.

    Raises MessageError for one that ROS can't define, or that has other fields than ROS's type of its name.
    """
    if version > 1:
        schema = schema_of(cls)
        return RosSchema(schema.name, schema.text, ros2_hash(cls))
    name = layout(cls).name
    of_ros = name.partition("/")[0] in OF_ROS
    found = definitions_of_ros(name, 1) if of_ros else definitions_with_those_of_ros(cls, 1)
    return RosSchema(ros2_name(name), definition_text(name, found), ros1_md5(cls))  # rosbags has such names


def records_of(reader: Any, version: int, options: ConversionOptions, losses: Losses) -> Iterator[ConvertedRecord]:
    """Iterate over the messages of an open reader of rosbags, as far as the options ask for them.

    A publisher is the node of ROS that its connection names; only those of ROS 1 do.
    """
    channels = {each.id: _channel(each, version, options) for each in reader.connections}
    chosen = [each for each in reader.connections if channels[each.id] is not None]
    for connection, time, data in reader.messages(chosen, options.start, options.end) if chosen else ():
        channel = channels[connection.id]
        if isinstance(channel, str):
            losses[channel] += 1
        elif channel is not None:
            yield from _record(*channel, time, bytes(data), losses)


def _channel(connection: Any, version: int, options: ConversionOptions) -> tuple[str, Source, RosDecoder] | str | None:
    """Return topic, publisher and decoder of a connection, a description of its loss, or None to leave it out."""
    name, definition = connection.topic, connection.msgdef
    try:
        topic = topic_name(name)
        if not options.wants(topic):
            return None
        decoder = ros_decoder(connection.msgtype, version, definition.data if definition.format.name == "MSG" else "")
    except (InvalidName, MessageError) as error:
        return f"messages of {name}: {error}"
    *module, node = (getattr(connection.ext, "callerid", None) or "").strip("/").split("/")
    return topic, Source("_".join(module), node), decoder


def _record(
    topic: str, source: Source, decoder: RosDecoder, time: int, data: bytes, losses: Losses
) -> Iterator[ConvertedRecord]:
    try:
        packed, stamp = decoder(data)
    except DecodeError:
        losses[f"messages of {topic} that can't be decoded"] += 1
        return
    yield ConvertedRecord(topic, time, Sample(packed, source, stamp or time, stamped=stamp > 0), decoder.cls)
