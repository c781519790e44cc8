"""What clients publish: in the type of the topic, or in a ROS type that r2p converts to it.

A client names a type with each of its channels. Where the topic has another one in r2p, as `Velocity3` where the client
publishes a `geometry_msgs/Twist`, messages are converted as on a link to ROS. Without a name it is the type in which
the topic is shown to clients.
"""

from collections import Counter
from collections.abc import Callable
from typing import Any

import msgspec

from r2p.errors import Error, MessageError
from r2p.messages import Message, layout
from r2p.monitoring.topic_types import TypeFinder
from r2p.names import topic_name
from r2p.ros.conversions import conversion
from r2p.ros.ros2_schemas import ROS2MSG
from r2p.ros.topics import ros_class
from r2p.ros.type_names import short_name
from r2p.runtime.node import Node
from r2p.runtime.publishers.non_real_time import Publisher
from r2p.web.foxglove.channel_types import ROS2, names_of, own_type
from r2p.web.foxglove.protocol import CDR, JSON, ClientChannel
from r2p.web.foxglove.services import decode_as

Convert = Callable[[Any], Message]


class _Accepted(msgspec.Struct, frozen=True, eq=False):
    """The class of a topic, the type in which a client publishes it, and what makes one of the other."""

    ours: type[Message]
    theirs: type[Message]
    convert: Convert | None = None


class ClientPublication:
    """A client's channel: publishes its messages until it is closed."""

    def __init__(self, channel: ClientChannel, accepted: _Accepted, publisher: Publisher[Any]) -> None:
        self.channel = channel
        self.publisher = publisher
        self._accepted = accepted

    def publish(self, data: bytes) -> None:
        """Publish a message; subscribers that are full lose it, counted. Raises Error for one of another type."""
        message = decode_as(self._accepted.theirs, self.channel.encoding, data)
        convert = self._accepted.convert
        self.publisher.publish_nowait(message if convert is None else convert(message))


class ClientPublications:
    """The publishers of one node, which the channels of all clients share: one for each topic."""

    def __init__(self, node: Node, types: TypeFinder) -> None:
        self._node = node
        self._types = types
        self._publishers: dict[str, Publisher[Any]] = {}
        self._users: Counter[str] = Counter()

    async def open(self, channel: ClientChannel) -> ClientPublication:
        """Return what publishes the messages of a client's channel. Raises Error, for the user."""
        topic = topic_name(channel.topic)
        if channel.encoding not in (CDR, JSON):
            raise Error(f"{channel.topic}: the encoding is {channel.encoding[:40]!r}: publish {CDR} or {JSON}")
        accepted = _accepted(topic, await self._types.find(topic), channel)
        publisher = self._publishers.get(topic)
        if publisher is None:
            publisher = self._publishers[topic] = self._node.advertise(topic, accepted.ours)
        elif publisher.type is not accepted.ours:
            raise Error(f"{channel.topic} is published by another client as {layout(publisher.type).name}")
        self._users[topic] += 1
        return ClientPublication(channel, accepted, publisher)

    def close(self, publication: ClientPublication) -> None:
        """End a channel; the publisher ends with the last one of its topic."""
        topic = publication.publisher.topic
        self._users[topic] -= 1
        if not self._users[topic]:
            del self._users[topic]
            self._publishers.pop(topic).close()


def _accepted(topic: str, ours: type[Message] | None, channel: ClientChannel) -> _Accepted:
    """Return how a topic, whose class is known or None, is published with a client's type."""
    name = short_name(channel.schema_name) if channel.schema_name else ""
    if ours is None:
        if not name:
            raise Error(f"the type of {channel.topic} is unknown: advertise it with a schemaName")
        cls = ros_class(name, ROS2, _definition(channel))
        return _Accepted(cls, cls)
    name = name or own_type(ours) or layout(ours).name
    if name == layout(ours).name:
        return _Accepted(ours, ours)
    found = conversion(ours, name, ROS2, names_of(topic))
    if found is not None:
        return _Accepted(ours, found.theirs, found.from_ros)
    theirs = _class_or_none(name, channel)
    if theirs is None or layout(theirs).schema != layout(ours).schema:
        names = dict.fromkeys(each for each in (own_type(ours), layout(ours).name) if each)
        raise Error(f"{channel.topic} is {' or '.join(names)}, not {name}: choose that type to publish")
    decode = layout(ours).decode
    return _Accepted(ours, theirs, lambda message: decode(message.encode()))


def _class_or_none(name: str, channel: ClientChannel) -> type[Message] | None:
    try:
        return ros_class(name, ROS2, _definition(channel))
    except MessageError:
        return None


def _definition(channel: ClientChannel) -> str:
    return channel.schema or "" if channel.schema_encoding == ROS2MSG else ""
