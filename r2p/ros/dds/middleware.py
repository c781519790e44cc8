"""`DdsMiddleware`: the topics of a ROS link over DDS.

Each node's publisher of a topic is a writer; subscribers of one topic share a reader, which all their nodes show as
theirs. A writer without room for a message keeps it here, and tries again; the oldest one gives way.
"""

import asyncio
import contextlib
import contextvars
import threading
from collections import deque
from collections.abc import Callable
from typing import ClassVar

import msgspec
from cyclonedds.core import DDSException

from r2p.clock import real_clock, real_time
from r2p.errors import ServiceError
from r2p.ros.dds.cyclone import DdsEvents, Participant
from r2p.ros.dds.graph import DdsEndpoint, DdsGraph, OwnNode, announce
from r2p.ros.dds.names import DISCOVERY, dds_topic, ros_topic, user_data
from r2p.ros.middleware import Middleware, MiddlewareUser, Qos, RosArrival, RosEndpoint, RosServer, RosService, RosType
from r2p.ros.type_names import dds_type
from r2p.runtime.backpressure import LINK_DOWN
from r2p.transports.stats import LoggedCounter
from r2p.units import SECOND

RETRY_S = 0.002
"""Seconds after which a message that a writer had no room for is tried again."""
SLOW = SECOND
"""Ns without room after which publishers no longer wait for a slow subscriber."""

_HELD_MAX = 1000  # messages that wait for a writer without a depth
_DISCOVERY_QOS = Qos(transient_local=True, depth=1)
_ALL_NODES = Qos(transient_local=True, depth=0)  # each participant has sent one message
_ALIGNMENT = 4
_POLICIES = {
    2: ("its last messages for late subscribers", "transient_local", "volatile"),
    4: ("a deadline", "a shorter deadline:", "a longer deadline:"),
    11: ("reliable delivery", "reliable", "best_effort"),
}
"""By the number of a policy: what a subscriber asks for in vain, and the option for the publisher and for it."""
_NO_SERVICES = "DDS has topics only here, no services: use ros2:, with zenoh, for services, parameters and actions"


class _OwnWriter(msgspec.Struct, eq=False):
    """A publisher of this link; `held` waits for room, since `full_since` (monotonic ns)."""

    endpoint: RosEndpoint
    number: int
    peers: set[int] = msgspec.field(default_factory=set)
    held: deque[bytes] = msgspec.field(default_factory=deque)
    full_since: int = 0


class _OwnReader(msgspec.Struct, eq=False):
    """The subscribers of a topic in this link, and the writers that they are connected to, by handle: their nodes."""

    topic: bytes
    endpoints: list[RosEndpoint]
    number: int = 0
    peers: dict[int, str] = msgspec.field(default_factory=dict)


class DdsMiddleware(Middleware):
    """One participant in a DDS domain."""

    version = 2
    has_services: ClassVar[bool] = False
    lost: LoggedCounter

    def __init__(self, domain: int, interface: str) -> None:
        self.lost = LoggedCounter()
        self._place = domain, interface
        self._clock = real_clock()
        self._graph = DdsGraph()
        self._nodes: list[str] = []
        self._writers: dict[tuple[str, str], _OwnWriter] = {}
        self._readers: dict[str, _OwnReader] = {}
        self._by_number: dict[int, _OwnWriter | _OwnReader] = {}
        self._discovery = 0, 0
        self._announces = self._retries = False
        self._participant: Participant | None = None
        self._user: MiddlewareUser

    async def run(self, user: MiddlewareUser, opened: Callable[[], object]) -> None:
        self._user, loop, context = user, asyncio.get_running_loop(), contextvars.copy_context()

        def hand_over(events: DdsEvents) -> None:
            with contextlib.suppress(RuntimeError):  # the loop has ended
                loop.call_soon_threadsafe(self._handle, events, context=context)

        participant = self._participant = await self._join(hand_over)
        try:
            name = dds_type("rmw_dds_common/ParticipantEntitiesInfo")
            writer = participant.add_writer(DISCOVERY, name, _DISCOVERY_QOS, b"")
            self._discovery = writer, participant.add_reader(DISCOVERY, name, _ALL_NODES, b"")
            for publisher in self._writers.values():
                self._open(publisher)
            for subscriber in self._readers.values():
                self._open(subscriber)
            self._announce_soon()
            user.middleware_up()
            opened()
            await loop.create_future()
        finally:
            self._participant = None
            await asyncio.shield(asyncio.to_thread(participant.close))

    async def _join(self, hand_over: Callable[[DdsEvents], None]) -> Participant:
        """Make the participant, in a thread. One that is there only after a cancellation leaves again."""
        made: list[Participant] = []
        lock, given_up = threading.Lock(), threading.Event()

        def make() -> Participant:
            participant = Participant(*self._place, hand_over)
            with lock:
                made.append(participant)
                unwanted = given_up.is_set()
            if unwanted:
                participant.close()
            return participant

        try:
            return await asyncio.to_thread(make)
        except asyncio.CancelledError:
            with lock:
                given_up.set()
                there = list(made)
            for participant in there:
                await asyncio.shield(asyncio.to_thread(participant.close))
            raise

    # Nodes and endpoints

    def add_node(self, node: str) -> None:
        self._nodes.append(node)
        self._announce_soon()

    def remove_node(self, node: str) -> None:
        self._nodes.remove(node)
        self._announce_soon()

    def advertise(self, endpoint: RosEndpoint) -> None:
        own = self._writers[endpoint.node, endpoint.topic] = _OwnWriter(endpoint, 0)
        self._open(own)

    def withdraw(self, endpoint: RosEndpoint) -> None:
        own = self._writers.pop((endpoint.node, endpoint.topic), None)
        if own is not None:
            self._close(own)

    def subscribe(self, endpoint: RosEndpoint) -> None:
        own = self._readers.get(endpoint.topic)
        if own is None:
            own = self._readers[endpoint.topic] = _OwnReader(endpoint.topic.encode(), [endpoint])
            self._open(own)
        else:
            own.endpoints.append(endpoint)
        self._announce_soon()

    def unsubscribe(self, endpoint: RosEndpoint) -> None:
        own = self._readers.get(endpoint.topic)
        if own is None or endpoint not in own.endpoints:
            return
        own.endpoints.remove(endpoint)
        if not own.endpoints:
            del self._readers[endpoint.topic]
            self._close(own)
        self._announce_soon()

    def _open(self, own: _OwnWriter | _OwnReader) -> None:
        """Make the writer or reader, if the participant is there; else that is done once it is."""
        participant = self._participant
        if participant is None:
            return
        endpoint = own.endpoint if isinstance(own, _OwnWriter) else own.endpoints[0]
        add = participant.add_writer if isinstance(own, _OwnWriter) else participant.add_reader
        topic, kind, data = dds_topic(endpoint.topic), dds_type(endpoint.type.name), user_data(endpoint.type.checksum)
        try:
            own.number = add(topic, kind, endpoint.qos, data)
        except DDSException as error:
            self._user.notice(f"topic {endpoint.topic}", f"DDS refuses {endpoint.topic}: {error}", trouble=True)
            return
        self._by_number[own.number] = own
        for peer in (*self._graph.writers.values(), *self._graph.readers.values()):
            self._compare(peer, endpoint.type, topic)
        self._announce_soon()

    def _close(self, own: _OwnWriter | _OwnReader) -> None:
        if self._by_number.pop(own.number, None) is not None and self._participant is not None:
            self._participant.remove(own.number)
        self._announce_soon()

    def _announce_soon(self) -> None:
        if self._participant is not None and not self._announces:
            self._announces = True
            asyncio.get_running_loop().call_soon(self._announce)

    def _announce(self) -> None:
        self._announces = False
        participant = self._participant
        if participant is None:
            return
        nodes = {name: OwnNode() for name in self._nodes}
        for writer in self._writers.values():
            if writer.number and writer.endpoint.node in nodes:
                nodes[writer.endpoint.node].writers.append(participant.gid_of(writer.number))
        for reader in self._readers.values():
            for node in {each.node for each in reader.endpoints if reader.number and each.node in nodes}:
                nodes[node].readers.append(participant.gid_of(reader.number))
        participant.write(self._discovery[0], _padded(announce(participant.gid, nodes)))

    # Out

    def publish(self, node: str, topic: str, data: bytes, stamp: int) -> None:
        own = self._writers.get((node, topic))
        if own is None or not own.number or self._participant is None:
            self.lost[LINK_DOWN if self._participant is None else "not advertised"] += 1
            return
        payload = _padded(data)
        if own.held or not self._participant.write(own.number, payload):
            self._hold(own, payload)

    def _hold(self, own: _OwnWriter, payload: bytes) -> None:
        if not own.held:
            own.full_since = self._clock.monotonic()
        elif len(own.held) >= (own.endpoint.qos.depth or _HELD_MAX):
            own.held.popleft()
            self.lost["send buffer full"] += 1
        own.held.append(payload)
        if not self._retries:
            self._retry_soon()

    def _retry_soon(self) -> None:
        self._retries = True
        with real_time():
            asyncio.get_running_loop().call_later(RETRY_S, self._retry)

    def _retry(self) -> None:
        participant, was_full, self._retries = self._participant, self.full, False
        if participant is None:
            return
        for own in self._writers.values():
            while own.held and participant.write(own.number, own.held[0]):
                own.held.popleft()
        if any(own.held for own in self._writers.values()):
            self._retry_soon()
        if was_full and not self.full:
            self._user.made_room()

    @property
    def full(self) -> bool:
        if not self._retries:
            return False
        oldest = self._clock.monotonic() - SLOW
        return any(own.held and own.full_since > oldest for own in self._writers.values())

    # In

    def pause(self) -> None:
        if self._participant is not None:
            self._participant.pause()

    def resume(self) -> None:
        if self._participant is not None:
            self._participant.resume()

    def _handle(self, events: DdsEvents) -> None:
        if self._participant is None:
            return
        for error in events.errors:
            self.lost.internal_error(error)
        if events.unreadable:
            self.lost["announcement that can't be read"] += events.unreadable
        self.lost.guard(self._handle_all, events)
        self._participant.made_room()

    def _handle_all(self, events: DdsEvents) -> None:
        changed = bool(events.found or events.lost or events.lost_participants)
        self._discovered(events)
        for number, samples in events.samples:
            if number == self._discovery[1]:  # before the messages of the nodes that are announced there
                changed = True
                bad = [sample for sample in samples if not self._graph.announced(sample.data)]
                if bad:
                    self.lost["wrong names of nodes"] += len(bad)
        if changed:
            self._user.graph_changed(self._graph.ros_graph())
        for number, peers in events.matches:
            self._matched(number, peers)
        for number, policy in events.misfits:
            self._misfit(number, policy)
        arrivals = self._arrivals(events)
        if arrivals:
            self._user.received(arrivals)

    def _arrivals(self, events: DdsEvents) -> list[RosArrival]:
        arrivals = []
        for number, samples in events.samples:
            own = self._by_number.get(number)
            if isinstance(own, _OwnReader):
                for sample in samples:
                    node, gid = self._graph.writer_of(sample.writer)
                    arrivals.append(RosArrival(own.topic, sample.data, node, 0, sample.stamp, gid))
        return arrivals

    def _discovered(self, events: DdsEvents) -> None:
        for gid in events.lost:
            self._graph.remove(gid)
        for gid in events.lost_participants:
            self._graph.remove_participant(gid)
        for peer, writes in events.found:
            self._graph.add(peer, writes=writes)
            for own in self._by_number.values():
                endpoint = own.endpoint if isinstance(own, _OwnWriter) else own.endpoints[0]
                self._compare(peer, endpoint.type, dds_topic(endpoint.topic))

    def _matched(self, number: int, peers: set[int]) -> None:
        own = self._by_number.get(number)
        if isinstance(own, _OwnWriter):
            topic = own.endpoint.topic
            new, own.peers = peers - own.peers, peers
            for _ in new:
                self._user.subscriber_joined(topic)
            if not any(each.peers for each in self._writers.values() if each.endpoint.topic == topic):
                self._user.subscribers_gone(topic)
        elif own is not None:
            self._matched_writers(own, peers)

    def _matched_writers(self, own: _OwnReader, peers: set[int]) -> None:
        endpoint = own.endpoints[0]
        for handle in own.peers.keys() - peers:
            self._user.publisher_gone(endpoint.topic, own.peers.pop(handle))
        for handle in peers - own.peers.keys():
            node, gid = self._graph.writer_of(handle)
            own.peers[handle] = node
            peer = self._graph.writers.get(gid)
            latched = peer is not None and peer.qos.transient_local
            self._user.publisher_found(endpoint.topic, node, endpoint.type.name, "", latched=latched)

    def _misfit(self, number: int, policy: int) -> None:
        """Report that another endpoint asks for more than is offered, or offers less than is asked for here."""
        own = self._by_number.get(number)
        if own is None:
            return
        what, publisher, subscriber = _POLICIES.get(policy, (f"policy {policy} of DDS", "", ""))
        if isinstance(own, _OwnWriter):
            topic, advice = own.endpoint.topic, publisher
            text = f"a subscriber of {topic} asks for {what}, which this publisher does not offer"
        else:
            topic, advice = own.topic.decode(), subscriber
            text = f"a publisher of {topic} does not offer {what}, which is asked for here"
        hint = f": --qos {topic[1:]}={advice} makes them fit" if advice else ""
        self._user.notice(f"qos {topic}", f"{text}, so no messages flow between them{hint}", trouble=True)

    def _compare(self, peer: DdsEndpoint, own: RosType, topic: str) -> None:
        """Report that another endpoint of a topic has another type."""
        if peer.topic != topic:
            return
        name, where = dds_type(own.name), ros_topic(topic)
        if peer.type != name:
            text = f"{where} has the type {own.name} here and {peer.type} elsewhere, so they are not connected: "
            self._user.notice(f"type {topic}", f"{text}--ros-type chooses another", trouble=True)
        elif peer.checksum and peer.checksum != own.checksum:
            text = f"{where}: another node has another definition of {own.name}, of another version of ROS, "
            self._user.notice(f"type {topic}", f"{text}so values may be wrong: use the same", trouble=True)

    # Services

    def serve(self, server: RosServer) -> None:
        self._user.notice("services", f"{server.service} is not served over DDS: {_NO_SERVICES}", trouble=True)

    def unserve(self, server: RosServer) -> None:
        """Do nothing, as services are not served over DDS."""

    async def call(self, node: str, service: str, type: RosService, request: bytes, timeout: float) -> bytes:
        raise ServiceError(f"{service} can't be called over DDS: {_NO_SERVICES}")


def _padded(data: bytes) -> bytes:
    """Return a payload of whole words, as DDS sends it: else Cyclone DDS adds what its memory has."""
    return bytes(data) + bytes(-len(data) % _ALIGNMENT)
