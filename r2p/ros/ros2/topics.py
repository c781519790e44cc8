"""Publishers and subscribers of ROS 2 topics over zenoh.

A transient local publisher keeps its last messages in zenoh's cache, which later subscribers ask for them. Messages go
out in the loop: where the network is slower, zenoh drops them. A thread hands over large ones, as zenoh waits for room
for their fragments, and those of publishers that keep all, for which it waits for up to 5 s.
"""

import functools
import struct
from typing import TYPE_CHECKING, Any

import msgspec
import zenoh
import zenoh.ext
from zenoh.handlers import RingChannel

from r2p.errors import DecodeError
from r2p.messages import SIZE_MAX
from r2p.ros.middleware import Qos, RosArrival, RosEndpoint
from r2p.ros.ros2.keys import (
    ATTACHMENT,
    ATTACHMENT_MAX,
    GID_BYTES,
    EntityKind,
    RmwToken,
    data_key,
    decode_attachment,
    encode_attachment,
    encode_token,
    gid_of,
)
from r2p.ros.ros2.session import RmwSession
from r2p.ros.type_names import dds_type
from r2p.runtime.backpressure import LINK_DOWN
from r2p.transports.link import MESSAGES_PER_TURN
from r2p.transports.zenoh.large import LARGE
from r2p.transports.zenoh.session import SubscriptionReader

if TYPE_CHECKING:
    from collections.abc import Callable

_CACHE_DEFAULT = 42  # messages that a transient local publisher keeps that keeps all, as in rmw_zenoh
_CACHE_MAX = 10_000
_HEARTBEAT_S = 0.5  # seconds after which a subscriber of a transient local topic learns what it has missed
_RING_MIN, _RING_MAX = 1024, 4096  # messages of one topic that wait in zenoh; of more, the oldest are lost
_BATCH = MESSAGES_PER_TURN // 2  # messages that are delivered at once: the link does not pause for them
_unpack = ATTACHMENT.unpack
_GAP_MAX = 1 << 24  # messages missed at once; more is a number that does not count
_GIDS_MAX = 1024  # publishers of one topic whose nodes are remembered


class RmwPublisher:
    """A publisher of one of the link's ROS nodes."""

    def __init__(self, session: RmwSession, endpoint: RosEndpoint) -> None:
        self.endpoint = endpoint
        self._session = session
        self._large = session.zenoh.large
        self._waits_for_room = _waits_for_room(endpoint.qos)
        self._waiting = 0
        dds_name = dds_type(endpoint.type.name)
        key = data_key(session.domain, endpoint.topic, dds_name, endpoint.type.checksum)
        self._publisher: Any = _declare_publisher(session.zenoh.raw, key, endpoint)
        self._put: Callable[..., None] = self._publisher.put
        # Behind the publisher: a node that sees the token finds the publisher there.
        kind, checksum = EntityKind.PUBLISHER, endpoint.type.checksum
        self.token = session.declare(kind, endpoint.node, endpoint.topic, dds_name, checksum, endpoint.qos)
        self._gid = gid_of(encode_token(self.token))
        self._sequence = 0

    def publish(self, data: bytes, stamp: int) -> None:
        """Send a message; `stamp` is UTC in ns, 0: now."""
        self._sequence += 1
        attachment = encode_attachment(self._sequence, stamp or self._session.clock.now(), self._gid)
        if len(data) > LARGE or self._waits_for_room or self._waiting or self._session.zenoh.outbound.uses_thread:
            self._submit(bytes(data), attachment)
            return
        try:
            self._put(data if type(data) is bytes else bytes(data), attachment=attachment)
        except zenoh.ZError:  # the session is closed
            self._session.lost[LINK_DOWN] += 1

    @property
    def reaches_subscriber(self) -> bool:
        """Return whether zenoh knows a subscriber; what a transient local publisher sends is kept for it."""
        if isinstance(self._publisher, zenoh.ext.AdvancedPublisher) or self._session.zenoh.outbound.uses_thread:
            return True  # with very many tokens zenoh may take long to answer
        # The stubs of zenoh promise a bool; the result is an object with one, and is itself always true.
        status: object = self._publisher.matching_status
        return bool(getattr(status, "matching", status))

    def close(self) -> None:
        """Undeclare the publisher; messages that wait are sent before.

        zenoh learns of it at the end of the turn. Until then a new publisher of the topic, with another QoS, finds its
        way to subscribers at once, and loses nothing.
        """
        self._session.undeclare(self.token)
        self._session.later(self._undeclare)

    def _undeclare(self) -> None:
        if self._waiting:
            self._large.submit(self._publisher.undeclare)
        else:
            self._publisher.undeclare()

    def _submit(self, data: bytes, attachment: bytes) -> None:
        """Have the thread send the message, and all later ones until it has."""
        if not self._session.add_waiting(len(data)):
            self._session.lost["send buffer full"] += 1
            return
        self._waiting += 1
        send = functools.partial(self._put, data, attachment=attachment)
        self._large.submit(send, then=functools.partial(self._sent, len(data)))

    def _sent(self, size: int, _: object) -> None:
        self._waiting -= 1
        self._session.sent(size)


def _declare_publisher(
    session: zenoh.Session, key: str, endpoint: RosEndpoint
) -> "zenoh.Publisher | zenoh.ext.AdvancedPublisher":
    """Declare the publisher."""
    qos = endpoint.qos
    block, drop = zenoh.CongestionControl.BLOCK, zenoh.CongestionControl.DROP
    congestion, remote = block if _waits_for_room(qos) else drop, zenoh.Locality.REMOTE
    reliability = zenoh.Reliability.RELIABLE if qos.reliable else zenoh.Reliability.BEST_EFFORT
    if not qos.transient_local:
        return session.declare_publisher(
            key, congestion_control=congestion, reliability=reliability, allowed_destination=remote
        )
    detection = zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=_HEARTBEAT_S) if qos.reliable else None
    return zenoh.ext.declare_advanced_publisher(
        session,
        key,
        congestion_control=congestion,
        reliability=reliability,
        allowed_destination=remote,
        cache=zenoh.ext.CacheConfig(max_samples=_cached(qos.depth)),
        sample_miss_detection=detection,
        publisher_detection=True,
    )


def _waits_for_room(qos: Qos) -> bool:
    """Return whether all messages are to arrive, as in rmw_zenoh: a thread sends them, as zenoh waits for room."""
    return qos.reliable and not qos.depth


def _cached(depth: int) -> int:
    return min(depth or _CACHE_DEFAULT, _CACHE_MAX)


class RmwRemotePublisher(msgspec.Struct):
    """Another node's publisher: its node in this version of the graph, and the number of its last message."""

    node: str
    graph_version: int
    sequence: int


class RmwSubscription:
    """The link's subscribers of one topic in one type: each has a token, and all of them one zenoh subscriber."""

    def __init__(self, session: RmwSession, first: RosEndpoint) -> None:
        self.topic = first.topic
        self.tokens: dict[RosEndpoint, RmwToken] = {}
        self._session = session
        self._type = dds_type(first.type.name)
        self._key = data_key(session.domain, first.topic, self._type, first.type.checksum)
        self._encoded = first.topic.encode()
        self._publishers: dict[bytes, RmwRemotePublisher] = {}
        self._reader: SubscriptionReader | None = None
        self._transient_local = False
        self._held: zenoh.Sample | None = None
        self._stopped = False

    def add(self, endpoint: RosEndpoint) -> RmwToken:
        """Add a subscriber, and return its token."""
        if self._reader is None or (endpoint.qos.transient_local and not self._transient_local):
            self._transient_local |= endpoint.qos.transient_local
            self._subscribe(endpoint.qos)
        # Behind the subscriber: a publisher that sees the token may send at once, and one of buffers only then.
        kind, checksum = EntityKind.SUBSCRIBER, endpoint.type.checksum
        token = self._session.declare(kind, endpoint.node, endpoint.topic, self._type, checksum, endpoint.qos)
        self.tokens[endpoint] = token
        return token

    def remove(self, endpoint: RosEndpoint) -> None:
        """Remove a subscriber."""
        token = self.tokens.pop(endpoint, None)
        if token is not None:
            self._session.undeclare(token)

    def close(self) -> None:
        """End the subscription."""
        for token in self.tokens.values():
            self._session.undeclare(token)
        self.tokens.clear()
        reader, self._reader = self._reader, None
        if reader is not None:
            reader.close()

    def resume(self) -> None:
        """Go on reading after a pause."""
        if not self._stopped or self._reader is None:
            return
        self._stopped = False
        sample, self._held = self._held, None
        self._read(sample or self._reader.receive())

    def _subscribe(self, qos: Qos) -> None:
        if self._reader is not None:
            self._reader.close()
        subscriber = _declare_subscriber(self._session.zenoh.raw, self._key, qos)
        self._reader = SubscriptionReader(subscriber, self._session.loop, self._read)
        self._stopped, self._held = False, None

    def _read(self, sample: zenoh.Sample | None) -> None:
        """Deliver this message and those behind it, some in each turn of the loop."""
        reader, session = self._reader, self._session
        if reader is None:
            return
        if session.paused:
            self._held, self._stopped = sample, True
            return
        arrivals: list[RosArrival] = []
        while sample is not None and len(arrivals) < _BATCH:
            try:
                arrival = self._arrival(sample)
            except DecodeError as error:
                session.lost[str(error)] += 1
            else:
                if arrival is not None:
                    arrivals.append(arrival)
            sample = reader.receive()
        if arrivals:
            session.lost.guard(session.user.received, arrivals)
        if sample is None:
            # Behind the readers that these messages woke: their answers go out before the switch to the thread.
            session.loop.call_soon(self._read_again)
        else:
            session.loop.call_soon(self._read, sample)

    def _read_again(self) -> None:
        if self._reader is None or self._stopped:
            return
        sample = self._reader.receive()
        if sample is None:
            self._reader.wait()
        else:
            self._read(sample)

    def _arrival(self, sample: zenoh.Sample) -> RosArrival | None:
        """Return a message; None for one that was received before. Raises DecodeError, with the reason to count."""
        header, payload = sample.attachment, sample.payload
        if not 0 < len(payload) <= SIZE_MAX:
            raise DecodeError("too long" if payload else "undecodable")
        if header is None or len(header) > ATTACHMENT_MAX:
            raise DecodeError("wrong attachment")
        data = header.to_bytes()
        try:  # that of rmw_zenoh without a call
            sequence, stamp, gid_size, gid = _unpack(data)
        except struct.error:
            gid_size = 0
        if gid_size != GID_BYTES:
            sequence, stamp, gid = _decode_unusual(data)
        publisher = self._publishers.get(gid)
        if publisher is None or publisher.graph_version != self._session.graph.version:
            publisher = self._look_up(gid, publisher)
        if sequence != publisher.sequence + 1 and self._was_received(sequence, publisher.sequence, gid):
            return None
        publisher.sequence = sequence
        if sequence < 0 or stamp < 0:
            sequence, stamp = max(sequence, 0), max(stamp, 0)
        return RosArrival(self._encoded, payload.to_bytes(), publisher.node, sequence, stamp, gid)

    def _was_received(self, sequence: int, last: int, gid: bytes) -> bool:
        """Return whether a transient local publisher's message came before; count those missed before this one.

        Publishers whose gid is not one can't be told apart, so neither is known of them.
        """
        if len(gid) != GID_BYTES or not any(gid):
            return False
        if 0 < last < sequence < last + _GAP_MAX:
            self._session.lost["on the way"] += sequence - last - 1
        return self._transient_local and 0 < sequence <= last

    def _look_up(self, gid: bytes, known: "RmwRemotePublisher | None") -> "RmwRemotePublisher":
        """Return a publisher whose node is that in the graph now."""
        graph = self._session.graph
        if len(self._publishers) >= _GIDS_MAX:
            self._publishers.clear()
        sequence = 0 if known is None else known.sequence
        node = graph.node_of(gid, EntityKind.PUBLISHER, self.topic)
        found = self._publishers[gid] = RmwRemotePublisher(node, graph.version, sequence)
        return found


def _decode_unusual(data: bytes) -> tuple[int, int, bytes]:
    try:
        return decode_attachment(data)
    except DecodeError:
        raise DecodeError("wrong attachment") from None


def _declare_subscriber(session: zenoh.Session, key: str, qos: Qos) -> Any:
    """Declare a subscriber with a bounded queue, and for a transient local one ask publishers for what they keep."""
    waiting: RingChannel[zenoh.Sample] = RingChannel(max(_RING_MIN, min(qos.depth or _RING_MAX, _RING_MAX)))
    remote = zenoh.Locality.REMOTE
    if not qos.transient_local:
        return session.declare_subscriber(key, waiting, allowed_origin=remote)
    recovery = zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True) if qos.reliable else None
    return zenoh.ext.declare_advanced_subscriber(
        session,
        key,
        waiting,
        allowed_origin=remote,
        history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=_cached(qos.depth)),
        recovery=recovery,
        subscriber_detection=True,
    )
