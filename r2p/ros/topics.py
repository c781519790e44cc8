"""Topics on a ROS network: which class a topic has here, which type there, and how messages become those of the other.

`TopicTypes` decides, and `RosTopic` is the result: with it, bytes of one side become bytes of the other. Types go by
their full names: one that comes with ROS stays what it is, r2p's standard types become those of the conversions, and
everything else is a type of its own, as `r2p msg export` writes it.
"""

import functools
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from typing import Any

import msgspec

from r2p.errors import DecodeError, MessageError
from r2p.messages import Layout, Message, Timestamp, layout
from r2p.names import BUS_LOAD, BUS_SLOTS, LOADER_PREFIX, RESERVED
from r2p.ros.cdr import HEADER, cdr, packed_size
from r2p.ros.classes import RosTypes, definitions_of, standard_classes
from r2p.ros.conversions import Conversion, RosNames, conversion, standard_type
from r2p.ros.definitions import definition_text, parse
from r2p.ros.library import definitions_of_ros, ros1_md5, ros2_hash
from r2p.ros.middleware import RosType
from r2p.ros.options import RosOptions, lookup
from r2p.ros.packages import OF_ROS
from r2p.ros.stamps import StampSource, stamp_of
from r2p.ros.type_names import short_name
from r2p.runtime.sample import Sample

_OWN = frozenset({*RESERVED, BUS_LOAD, BUS_SLOTS, "gateway"})

Decoded = tuple[bytes, Message | None, int]
"""Packed bytes of the class here, the message if it is known anyway, and its stamp in UTC (ns, 0: none)."""


class RosTopic(msgspec.Struct, frozen=True, eq=False):
    """How messages of one topic become those of a ROS type, and back.

    `shape` is that of the topic's class, `type` the ROS type. `encode` returns the messages to publish, serialised, or
    raises MessageError or DecodeError; `decode` returns a message for this side, or raises DecodeError. `note` says
    what one of the two types lacks.
    """

    shape: Layout[Any]
    type: RosType
    encode: Callable[[Sample], Sequence[bytes]]
    decode: Callable[[bytes], Decoded]
    note: str = ""


def is_own(topic: str) -> bool:
    """Return whether a topic is r2p's own, which a ROS network has no use for."""
    return topic in _OWN or topic.startswith(LOADER_PREFIX)


def is_of_action(name: str) -> bool:
    """Return whether a topic or a service is a part of an action. ROS 1 has no actions."""
    return "/_action/" in name


@functools.lru_cache(maxsize=1024)
def ros_type(cls: type[Message], version: int) -> RosType:
    """Return the type of a class in ROS 1 or 2. Raises MessageError if ROS can't have it."""
    name = layout(cls).name
    if version == 1:
        return RosType(name, ros1_md5(cls), definition_text(name, definitions_of(cls, 1)))
    return RosType(name, ros2_hash(cls))


@functools.lru_cache(maxsize=1024)
def ros_class(name: str, version: int, definition: str = "") -> type[Message]:
    """Return the class of a ROS type, from its definition; without one, from those that come with ROS.

    Raises MessageError for a type that is nowhere, or that r2p has no class for.
    """
    name = short_name(name)
    if definition:
        return RosTypes(version, parse(name, definition)).load(name)
    known = standard_classes().get(name)
    if known is not None and name.partition("/")[0] not in OF_ROS:
        return known
    return RosTypes(version, definitions_of_ros(name, version)).load(name)


class TopicTypes:
    """Decides for one link to ROS 1 or 2 (`version`) how topics travel; `counts` has stamps of reception."""

    def __init__(self, version: int, options: RosOptions, module: str, counts: Counter[str]) -> None:
        self.version = version
        self._options = options
        self._module = module
        self._counts = counts

    def stated(self, topic: str) -> type[Message] | None:
        """Return the class that the user states for a topic."""
        found = lookup(self._options.types, topic)
        return found if isinstance(found, type) and issubclass(found, Message) else None

    def find(self, topic: str, cls: type[Message], peers: Collection[str]) -> RosTopic:
        """Return how a topic of this class travels. `peers` are the types that ROS nodes have for it, by name.

        Without an option for the topic it is the usual type of the class, unless all peers have another one that the
        class converts to. Raises MessageError if ROS can't have the class, or not as the type in the options.
        """
        stated = lookup(self._options.ros_types, topic)
        if stated:
            return self._as_type(topic, cls, short_name(stated))
        usual = self._usual(cls)
        if len(peers) == 1 and usual not in peers:
            try:
                return self._as_type(topic, cls, next(iter(peers)))
            except MessageError:
                pass  # the mismatch is reported when both are known
        return self._as_type(topic, cls, usual)

    def _usual(self, cls: type[Message]) -> str:
        name = layout(cls).name
        if name.partition("/")[0] in OF_ROS:
            return name
        return standard_type(cls, self.version) or name

    def _as_type(self, topic: str, cls: type[Message], name: str) -> RosTopic:
        if name == layout(cls).name:
            return self._same(cls, cls, ros_type(cls, self.version))
        names = RosNames(topic, self._options.ns, self._module)
        found = conversion(cls, name, self.version, names)
        if found is not None:
            return self._converted(found)
        theirs = ros_class(name, self.version)
        if layout(theirs).schema != layout(cls).schema:
            raise MessageError(f"{layout(cls).name} can't become {name}: r2p has no conversion between the two")
        return self._same(cls, theirs, ros_type(theirs, self.version))

    def _same(self, cls: type[Message], theirs: type[Message], kind: RosType) -> RosTopic:
        """Return how a class travels as a type with the same fields."""
        shape = layout(cls)
        fill = header_filler(shape, self._counts) if has_header(shape) else None
        if self.version == 1:
            return RosTopic(shape, kind, _packed(shape, fill), _unpacked(shape))
        return RosTopic(shape, kind, _to_cdr(theirs, fill), _from_cdr(shape, theirs))

    def _converted(self, found: Conversion) -> RosTopic:
        shape, stamps = layout(found.ours), StampSource(found.ours, self._counts)
        pack, unpack = _codec(found.theirs, self.version)

        def encode(sample: Sample) -> Sequence[bytes]:
            message = sample.message
            if message is None:
                message = shape.decode(sample.data)
            return [pack(each) for each in found.to_ros(message, stamps.find(sample), sample.source)]

        def decode(data: bytes) -> Decoded:
            theirs = unpack(data)
            message = found.from_ros(theirs)
            return shape.encode(message), message, _utc(stamp_of(theirs))

        note = f"to ROS without {found.lost_to_ros}" if found.lost_to_ros else ""
        return RosTopic(shape, ros_type(found.theirs, self.version), encode, _guarded(decode), note)


def _codec(cls: type[Message], version: int) -> tuple[Callable[[Any], bytes], Callable[[bytes], Any]]:
    if version == 1:
        return layout(cls).encode, layout(cls).decode
    return cdr(cls).encode, cdr(cls).decode


def _guarded(decode: Callable[[bytes], Decoded]) -> Callable[[bytes], Decoded]:
    """Return a function that raises DecodeError also for a message that this side can't have."""

    def guarded(data: bytes) -> Decoded:
        try:
            return decode(data)
        except MessageError as error:
            raise DecodeError(str(error)) from None

    return guarded


def _utc(stamp: Timestamp | None) -> int:
    """Return a stamp of ROS as the stamp of a sample; 0 for that of a simulation, which begins at 0."""
    return stamp.ns if stamp is not None and stamp.ns >= StampSource.OLDEST_UTC else 0


# Types with the same fields on both sides


def has_header(shape: Layout[Any]) -> bool:
    """Return whether messages begin with a Header, whose stamp says when they were made."""
    header = next((each.shape for each in shape.fields if each.name == "header"), None)
    return header is not None and getattr(getattr(header, "layout", None), "name", "") == "std_msgs/Header"


Fill = Callable[[Sample], Message | None]
"""Returns the message of a sample with its stamp in the header; None if the bytes of the sample have it already."""


def header_filler(shape: Layout[Any], counts: Counter[str]) -> Fill:
    """Return the filler of `header.stamp` for messages without a stamp of their own, or with one of another clock."""
    source = StampSource(shape.cls, counts)

    def fill(sample: Sample) -> Any:
        found = source.find(sample)
        if found == source.own(sample.data):
            return None
        message: Any = sample.message
        if message is None:
            message = shape.decode(sample.data)
        header = msgspec.structs.replace(message.header, stamp=Timestamp.from_ns(found))
        return msgspec.structs.replace(message, header=header)

    return fill


def _packed(shape: Layout[Any], fill: Fill | None) -> Callable[[Sample], Sequence[bytes]]:
    if shape.exact_size:  # it has no header with a stamp: there is a text in that
        return _fixed(b"", shape.exact_size)

    def encode(sample: Sample) -> Sequence[bytes]:
        message = None if fill is None else fill(sample)
        return (sample.data if message is None else message.encode(),)

    return encode


def _fixed(header: bytes, size: int) -> Callable[[Sample], Sequence[bytes]]:
    """Return a function that puts a header before the packed bytes, which are those of ROS."""

    def encode(sample: Sample) -> Sequence[bytes]:
        data = sample.data
        if len(data) != size:  # of another module, which has not announced its type
            raise DecodeError(f"{len(data)} bytes are not {size}")
        return (header + data if header else data,)

    return encode


def _unpacked(shape: Layout[Any]) -> Callable[[bytes], Decoded]:
    size, stamps = shape.exact_size, StampSource(shape.cls, Counter())

    def decode(data: bytes) -> Decoded:
        if size and len(data) != size:
            raise DecodeError(f"{shape.cls.__name__} takes {size} bytes, not {len(data)}")
        own = stamps.own(data)
        return data, None, own if own >= StampSource.OLDEST_UTC else 0

    return decode if size or stamps.read is not None else lambda data: (data, None, 0)


def _to_cdr(theirs: type[Message], fill: Fill | None) -> Callable[[Sample], Sequence[bytes]]:
    pack, decode = cdr(theirs).encode, layout(theirs).decode
    if size := packed_size(theirs):  # it has no header with a stamp: there is a text in that
        return _fixed(HEADER, size)

    def encode(sample: Sample) -> Sequence[bytes]:
        filled = None if fill is None else fill(sample)
        message = sample.message if filled is None else filled
        if type(message) is not theirs:
            message = decode(sample.data if filled is None else filled.encode())
        return (pack(message),)

    return encode


def _from_cdr(shape: Layout[Any], theirs: type[Message]) -> Callable[[bytes], Decoded]:
    unpack, is_same, stamps = cdr(theirs).decode, theirs is shape.cls, StampSource(theirs, Counter())
    pack, size = layout(theirs).encode, packed_size(theirs)
    begin, end = len(HEADER), len(HEADER) + size

    def decode(data: bytes) -> Decoded:
        if size and len(data) >= end and data[:begin] == HEADER:
            packed, message = data[begin:end], None
        else:
            message = unpack(data)
            packed = pack(message)
        own = stamps.own(packed)
        return packed, message if is_same else None, own if own >= StampSource.OLDEST_UTC else 0

    return _guarded(decode)
