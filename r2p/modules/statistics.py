"""The statistics of a module: what its publishers, subscribers, nodes and links have counted since they began.

Other modules fetch them by r2p's own services (PROTOCOL.md 9): a version, then one part for each version up to that
one, so a module of before reads the parts that it knows.
"""

import itertools
import math
import os
import struct
import zlib
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, TypeVar

from r2p.errors import DecodeError
from r2p.messages import Max, Message, f32, f64, layout, u8, u32, u64
from r2p.modules.link_manager import LinkManager
from r2p.modules.supervisor import Supervisor
from r2p.runtime.node import Node
from r2p.runtime.subscriber import Subscriber
from r2p.runtime.topic import RemoteSubscriber
from r2p.services.server import ServiceServer
from r2p.transports.link import Link
from r2p.units import MILLISECOND, SECOND

M = TypeVar("M", bound=Message)

VERSION = 1

COMPRESSED = b"zlib"
"""The argument of a request for a compressed answer, which a module of before answers with a plain one."""

_ZLIB = b"\x78"  # what compressed content begins with; no version will have this number
_COMPRESSION = 1  # the fastest: names that repeat cost little, and counters are mostly zero
_CONTENT_MAX = 1 << 20  # bytes: five times the longest plain content
_MAX = 4096  # entries of each kind: more than fit the pages of an answer
_HEAD = struct.Struct("<BI")  # the version, and the bytes of the first part

_NAME_MAX = 255
_Name = Annotated[str, Max(_NAME_MAX)]


class ReasonCount(Message, name="r2p_msgs/ReasonCount"):
    """A counter: the number of times that something happened for this reason."""

    reason: _Name = ""
    count: u64 = 0


class NodeStatistics(Message, name="r2p_msgs/NodeStatistics"):
    """A node, also one that has ended. `restarts`: after crashes."""

    node: _Name = ""
    running: bool = False
    restarts: u32 = 0


class PublisherStatistics(Message, name="r2p_msgs/PublisherStatistics"):
    """An open publisher. `publisher_class` is 1 non real-time, 2 sporadic, 3 periodic."""

    topic: _Name = ""
    node: _Name = ""
    publisher_class: u8 = 0
    sent: u64 = 0
    missed: u64 = 0
    late: u64 = 0


class SubscriberStatistics(Message, name="r2p_msgs/SubscriberStatistics"):
    """An open subscription. `waiting` messages are in its queue now; the others were lost, by reason."""

    topic: _Name = ""
    node: _Name = ""
    waiting: u32 = 0
    lost: u64 = 0
    undecodable: u64 = 0
    too_long: u64 = 0
    stale: u64 = 0
    timeouts: u64 = 0


class ServiceStatistics(Message, name="r2p_msgs/ServiceStatistics"):
    """A service that a node serves. `running` handlers and `waiting` requests are those of now; the others are counted:
    requests whose handler has ended, those that failed, that were refused as the server was busy, and that came again.
    """

    service: _Name = ""
    node: _Name = ""
    running: u32 = 0
    waiting: u32 = 0
    handled: u64 = 0
    failed: u64 = 0
    refused: u64 = 0
    repeated: u64 = 0


class LinkStatistics(Message, name="r2p_msgs/LinkStatistics"):
    """A link. `waiting` messages wait for room; `ups`: how often it came up; `lost` is in both directions."""

    link: _Name = ""
    up: bool = False
    ups: u32 = 0
    waiting: u32 = 0
    sent: u64 = 0
    received: u64 = 0
    bytes_sent: u64 = 0
    bytes_received: u64 = 0
    lost: Annotated[tuple[ReasonCount, ...], Max(_MAX)] = ()
    faults: Annotated[tuple[ReasonCount, ...], Max(_MAX)] = ()


class TopicOnLink(Message, name="r2p_msgs/TopicOnLink"):
    """A topic on its way out by a link. `least_laxity`: the least time to the deadline (ms) with which a message was on
    the bus, below 0 after it; NaN where there was none, and on links that don't know.
    """

    topic: _Name = ""
    link: _Name = ""
    lost: u64 = 0
    least_laxity: f32 = math.nan


class ForwardedTopic(Message, name="r2p_msgs/ForwardedTopic"):
    """A topic from one link of a gateway to another."""

    topic: _Name = ""
    source: _Name = ""
    target: _Name = ""
    forwarded: u64 = 0
    dropped: u64 = 0


class ModuleStatistics(Message, name="r2p_msgs/ModuleStatistics"):
    """The counters of a module, from the start of each entry on; `uptime` and `cpu` in seconds.

    `cpu` is the processor time of the module's process, all modules in it together; NaN under virtual time, where
    each run is the same.
    """

    uptime: f64 = 0.0
    cpu: f64 = 0.0
    nodes: Annotated[tuple[NodeStatistics, ...], Max(_MAX)] = ()
    publishers: Annotated[tuple[PublisherStatistics, ...], Max(_MAX)] = ()
    subscribers: Annotated[tuple[SubscriberStatistics, ...], Max(_MAX)] = ()
    services: Annotated[tuple[ServiceStatistics, ...], Max(_MAX)] = ()
    links: Annotated[tuple[LinkStatistics, ...], Max(_MAX)] = ()
    topics: Annotated[tuple[TopicOnLink, ...], Max(_MAX)] = ()
    forwarded: Annotated[tuple[ForwardedTopic, ...], Max(_MAX)] = ()


def encode(statistics: ModuleStatistics, argument: bytes = b"") -> bytes:
    """Encode the content of an answer; `argument` is that of the request, and may ask for a compressed one."""
    part = statistics.encode()
    content = _HEAD.pack(VERSION, len(part)) + part
    return zlib.compress(content, _COMPRESSION) if argument == COMPRESSED else content


def decode(data: bytes) -> ModuleStatistics:
    """Decode the content of an answer, of this version or a later one, compressed or not. Raises DecodeError."""
    return layout(ModuleStatistics).decode(first_part(data))


def first_part(data: bytes) -> bytes:
    """Return the packed ModuleStatistics in the content of an answer, as `decode` takes it. Raises DecodeError."""
    if data.startswith(_ZLIB):
        data = _decompress(data)
    if len(data) < _HEAD.size:
        raise DecodeError("not the statistics of a module")
    version, length = _HEAD.unpack_from(data)
    if version < VERSION or length > len(data) - _HEAD.size:
        raise DecodeError(f"statistics of version {version}, whose first part has {length} bytes")
    return data[_HEAD.size : _HEAD.size + length]


def _decompress(data: bytes) -> bytes:
    try:
        reader = zlib.decompressobj()
        content = reader.decompress(data, _CONTENT_MAX)
    except zlib.error as error:
        raise DecodeError(f"compressed statistics are damaged: {error}") from error
    if not reader.eof:
        raise DecodeError(f"compressed statistics are cut off, or longer than {_CONTENT_MAX} bytes")
    return content


def collect(manager: LinkManager, supervisors: Mapping[str, Supervisor]) -> ModuleStatistics:
    """Return the statistics of a module with these links and nodes."""
    nodes = [each.node for each in supervisors.values()]
    processor = os.times()
    cpu = math.nan if manager.space.clock.virtual else processor.user + processor.system
    remote = [(topic.name, each) for topic in manager.space.topics.values() for each in topic.remote_subscribers]
    return ModuleStatistics(
        uptime=(manager.space.clock.monotonic() - manager.opened_at) / SECOND,
        cpu=cpu,
        nodes=_limited(
            NodeStatistics(name, running=each.running, restarts=each.restarts) for name, each in supervisors.items()
        ),
        publishers=_limited(
            PublisherStatistics(each.topic, node.name, int(each.publisher_class), each.sent, each.missed, each.late)
            for node in _with_own(nodes, manager)
            for each in node.publishers
        ),
        subscribers=_limited(_of_subscriber(node, each) for node in nodes for each in node.subscribers),
        services=_limited(
            _of_service(node, each) for node in nodes for each in node.services if isinstance(each, ServiceServer)
        ),
        links=_limited(_of_link(link, [each for _, each in remote]) for link in manager.links),
        topics=_limited(_of_topic(manager, topic, each) for topic, each in remote),
        forwarded=_forwarded(manager),
    )


def _with_own(nodes: Iterable[Node], manager: LinkManager) -> dict[Node, None]:
    """Return nodes, and those with which the module itself publishes: its log, and what it says of buses."""
    publishers = (each for topic in manager.space.topics.values() for each in topic.publishers)
    return dict.fromkeys((*nodes, *(each.node for each in publishers if isinstance(each.node, Node))))


def _of_subscriber(node: Node, each: Subscriber[Any]) -> SubscriberStatistics:
    counts = each.undecodable, each.too_long, each.stale, each.timeouts
    return SubscriberStatistics(each.topic, node.name, len(each.queue), each.lost, *counts)


def _of_service(node: Node, each: ServiceServer[Any, Any]) -> ServiceStatistics:
    counts = each.handled, each.failed, each.refused, each.repeated
    return ServiceStatistics(each.name, node.name, each.running, each.waiting, *counts)


def _of_link(link: Link, remote: Iterable[RemoteSubscriber]) -> LinkStatistics:
    stats = link.stats
    queues = {id(queue): queue for each in remote if each.link is link for queue in [each.get_wait_queue()]}
    waiting = sum(len(queue.real_time) + len(queue.non_real_time) for queue in queues.values())
    counts = stats.sent, stats.received, stats.bytes_sent, stats.bytes_received
    lost, faults = _counts(link.losses), _counts(stats.faults)
    return LinkStatistics(_cut(link.name), link.up, stats.ups, waiting, *counts, lost, faults)


def _of_topic(manager: LinkManager, topic: str, remote: RemoteSubscriber) -> TopicOnLink:
    link = next((each for each in manager.links if each is remote.link), None)
    laxity = None if link is None else link.stats.least_laxity.get(topic)
    return TopicOnLink(topic, _cut(remote.link_name), remote.lost, math.nan if laxity is None else laxity / MILLISECOND)


def _forwarded(manager: LinkManager) -> tuple[ForwardedTopic, ...]:
    if manager.bridge is None:
        return ()
    return _limited(
        ForwardedTopic(each.topic, _cut(each.source), _cut(each.target), each.forwarded, sum(each.dropped.values()))
        for each in manager.bridge.statistics().routes
    )


def _counts(counts: Mapping[str, int]) -> tuple[ReasonCount, ...]:
    return _limited(ReasonCount(reason, count) for reason, count in sorted(counts.items()) if count > 0)


def _limited(entries: Iterable[M]) -> tuple[M, ...]:
    return tuple(itertools.islice(entries, _MAX))


def _cut(name: str) -> str:
    return name.encode()[:_NAME_MAX].decode(errors="ignore")
