"""Topics on a ROS network: their names there, their types, and how a message becomes one of the other side.

`GraphNames` translates names of topics and nodes. `TopicTypes` decides which class a topic has here and which type
there, and `RosTopic` is the result: with it, bytes of one side become bytes of the other.
"""

import functools
import re
from collections.abc import Callable

import msgspec

from r2p.errors import DecodeError, MessageError
from r2p.messages import Layout, Message, layout
from r2p.names import (
    BUS_LOAD,
    BUS_SLOTS,
    CARRIED_MAX,
    LOADER_PREFIX,
    LOG,
    MODULE_MAX,
    MODULE_PATH,
    NAMESPACE_MAX,
    NODE_MAX,
    RESERVED,
    SERVICE_SUFFIXES,
    TOPIC,
)
from r2p.ros.cdr import cdr
from r2p.ros.classes import definitions_of
from r2p.ros.definitions import definition_text, short_name
from r2p.ros.library import ros1_md5, ros2_hash
from r2p.ros.middleware import RosType
from r2p.ros.options import RosOptions, lookup
from r2p.runtime.sample import Sample

_OWN = frozenset({*RESERVED, BUS_LOAD, BUS_SLOTS, LOG, "gateway"})
_ROS_NAMES = {LOG: "rosout"}
_OUR_NAMES = {theirs: ours for ours, theirs in _ROS_NAMES.items()}
_ROS_TOPIC = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
_R2P_TOPIC = re.compile(TOPIC)
_R2P_MODULE = re.compile(MODULE_PATH)
_FOREIGN = re.compile(r"[^A-Za-z0-9_]+")
_ROS_MAX = 240  # characters of a name in ROS 2


class GraphNames:
    """Translates names: `odometry` is `/robot1/odometry` on a link with the namespace `/robot1`, `log` is `/rosout`.

    What other ROS nodes have outside of the namespace is not seen here, except for the topics that ROS has once.
    """

    def __init__(self, options: RosOptions) -> None:
        self.ns = options.ns
        self._absolute = frozenset(options.absolute)

    def to_ros(self, topic: str) -> str | None:
        """Return the name of a topic on the ROS network; None if ROS has no such names."""
        topic = _ROS_NAMES.get(topic, topic)
        name = f"/{topic}" if topic in self._absolute else f"{self.ns}/{topic}"
        return name if len(name) <= _ROS_MAX and _ROS_TOPIC.fullmatch(name) else None

    def from_ros(self, name: str) -> str | None:
        """Return the name of a ROS topic here; None for one outside of the namespace, or that no topic can have."""
        topic = name[1:]
        if topic not in self._absolute:
            if not name.startswith(f"{self.ns}/"):
                return None
            topic = name[len(self.ns) + 1 :]
            if topic in self._absolute and self.ns:
                return None
        topic = _OUR_NAMES.get(topic, topic)
        return topic if len(topic) <= CARRIED_MAX and _R2P_TOPIC.fullmatch(topic) else None

    def node(self, *parts: str) -> str:
        """Return the full name of a ROS node for a module or node: `/robot1/blink`."""
        valid = (f"n{part}" if part[:1].isdecimal() else part for part in "/".join(parts).split("/"))
        return f"{self.ns}/{'/'.join(valid)}"

    def module(self, node: str) -> tuple[str, str]:
        """Return the names of module and node under which another ROS node is shown here.

        `/arm/driver` is module `arm/driver` with a node `driver`; any characters are possible in the argument.
        """
        inner = node.removeprefix(f"{self.ns}/") if self.ns else node
        parts = [each for part in inner.split("/") if (each := _FOREIGN.sub("_", part))]
        last = parts[-1] if parts else "unnamed"
        path = "/".join([parts[0], "_".join(parts[1:])]) if len(parts) > 1 else last
        if (len(parts) > 1 and len(parts[0]) > NAMESPACE_MAX) or not _R2P_MODULE.fullmatch(path):
            path = "_".join(parts)[:MODULE_MAX] or last
        return path, last[:NODE_MAX]


def is_service(topic: str, shape: Layout[Message] | None) -> bool:
    """Return whether a topic is one of the two of a service; without a layout, by its name."""
    return topic.endswith(SERVICE_SUFFIXES) and (shape is None or shape.name.endswith(topic[-2:]))


def is_own(topic: str) -> bool:
    """Return whether a topic is r2p's own, which a ROS network has no use for."""
    return topic in _OWN or topic.startswith(LOADER_PREFIX)


class RosTopic(msgspec.Struct, frozen=True, eq=False):
    """How messages of one topic become those of a ROS type, and back.

    `shape` is that of the topic's class, `type` the ROS type. `encode` returns the bytes to publish, or raises
    MessageError or DecodeError; `decode` returns the packed bytes of that class, and the message if it is known anyway,
    or raises DecodeError.
    """

    shape: Layout[Message]
    type: RosType
    encode: Callable[[Sample], bytes]
    decode: Callable[[bytes], tuple[bytes, Message | None]]


@functools.lru_cache(maxsize=1024)
def ros_type(cls: type[Message], version: int) -> RosType:
    """Return the type of a class in ROS 1 or 2. Raises MessageError if ROS can't have it."""
    name = layout(cls).name
    if version == 1:
        return RosType(name, ros1_md5(cls), definition_text(name, definitions_of(cls, 1)))
    return RosType(name, ros2_hash(cls))


@functools.lru_cache(maxsize=1024)
def ros_topic(cls: type[Message], version: int, type_name: str = "") -> RosTopic:
    """Return how messages of a class travel on a ROS network, as the type of this name (empty: the usual one).

    Raises MessageError if they can't.
    """
    name = short_name(type_name) if type_name else layout(cls).name
    if name != layout(cls).name:
        raise MessageError(f"{cls.__name__} can't become {name}")
    return _same(cls, version)


def _same(cls: type[Message], version: int) -> RosTopic:
    """Return the topic of a class whose fields ROS has as well."""
    shape, kind = layout(cls), ros_type(cls, version)
    if version == 1:
        return RosTopic(shape, kind, _data_of, functools.partial(_checked, shape))
    codec = cdr(cls)

    def encode(sample: Sample) -> bytes:
        message = sample.message
        return codec.encode(shape.decode(sample.data) if message is None else message)

    def decode(data: bytes) -> tuple[bytes, Message | None]:
        message = codec.decode(data)
        try:
            return shape.encode(message), message
        except MessageError as error:
            raise DecodeError(str(error)) from None

    return RosTopic(shape, kind, encode, decode)


def _data_of(sample: Sample) -> bytes:
    return sample.data


def _checked(shape: Layout[Message], data: bytes) -> tuple[bytes, Message | None]:
    if shape.exact_size and len(data) != shape.exact_size:
        raise DecodeError(f"{shape.cls.__name__} takes {shape.exact_size} bytes, not {len(data)}")
    return data, None


class TopicTypes:
    """Decides which class a topic has here, and which type on the ROS network."""

    def __init__(self, version: int, options: RosOptions) -> None:
        self._version = version
        self._options = options

    def find(self, topic: str, shape: Layout[Message] | None) -> RosTopic | None:
        """Return how a topic travels; None if no class is known. Raises MessageError if ROS can't have its type."""
        cls = lookup(self._options.types, topic) if shape is None else shape.cls
        if cls is None:
            return None
        return ros_topic(cls, self._version, self._type_name(topic))

    def _type_name(self, topic: str) -> str:
        return lookup(self._options.ros_types, topic) or ""
