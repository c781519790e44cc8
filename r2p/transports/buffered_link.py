"""A link with one send buffer and one way in for all its topics: the debug line, the memory network and RTCAN.

    publisher  ->  BufferedSubscriber.offer  ->  write     while there is room, else the sample waits in `wait_queue`
    wire       ->  receive  ->  sample  ->  Topic.deliver  full queues are left to `LinkBackpressure`

A subclass implements `full`, `write`, `write_management` and `sample`, calls `receive` with each received message, and
`made_room` when it accepts again what it had rejected.
"""

import abc
from collections import deque
from collections.abc import Hashable, Iterable
from typing import Any, ClassVar, Protocol

import msgspec

from r2p.codecs import UnknownType, call_parts, management
from r2p.codecs.management import ROLE_PUBLISHES, ManagementType
from r2p.errors import DecodeError
from r2p.names import CALLS, LOG, MANAGEMENT, REPLIES
from r2p.protocols.call_parts import CallAssembler
from r2p.protocols.discovery.events import ModuleInfo, PeerAddress, SubscriberJoined, possible_senders
from r2p.protocols.discovery.interface import DiscoveryProtocol
from r2p.protocols.discovery.session import Discovery
from r2p.runtime.backpressure import LINK_DOWN, WaitQueue
from r2p.runtime.sample import Sample, Source
from r2p.runtime.topic import PublisherHandle, Topic
from r2p.transports.link import MESSAGES_PER_TURN, Hub, Link, LinkSubscriber
from r2p.transports.receive_backpressure import LinkBackpressure
from r2p.units import SECOND

_MANAGEMENT = MANAGEMENT.encode()
_CALLS = (CALLS.encode(), REPLIES.encode())
_CALL_PART = ManagementType.CALL_PART
_EARLY = SECOND  # ns by which a message may come before the answer to its subscription
_EARLY_MAX = 256  # messages that come early and are kept: any sender can send them, so there is a limit
_EARLY_LONG = 64 * 1024  # bytes
_NOT_SUBSCRIBED = "not subscribed"

TOO_LONG = "too long"
"""The reason of a message that has more bytes than the link carries: it is counted, and never sent."""


class Arrival(Protocol):
    """A received message: the `BufferedLink.key` of its topic, and packed bytes."""

    @property
    def topic(self) -> bytes: ...

    @property
    def data(self) -> bytes: ...


class _ReceivedTopic(msgspec.Struct):
    """A topic that is received. `sizes`: bytes of the messages of each publisher, by its address; 0: any.

    The last message is kept for later subscribers, as its publisher may only afterwards announce that it is latched.
    """

    topic: Topic
    sizes: dict[Hashable, int]
    last: Sample | None = None


class BufferedLink(Link):
    """A link with a send buffer, which delivers received messages in the order of their arrival."""

    in_order: ClassVar[bool] = True
    """True if the link keeps the order; else a message may overtake the answer that announces it."""

    def __init__(
        self, name: str, hub: Hub, *, management_rate: float = 250.0, discovery: DiscoveryProtocol | None = None
    ) -> None:
        super().__init__(name, hub, management_rate=management_rate, discovery=discovery)
        self.wait_queue = WaitQueue()
        """The samples that wait for room in the send buffer, of all topics."""
        self._received: dict[bytes, _ReceivedTopic] = {}
        self._arrivals: deque[Any] = deque()
        self._delivering = False
        self._paused = False
        self._backpressure = LinkBackpressure(
            self._space.loop, self.stats.lost, self._deliver_rest, lambda: self.flow_controlled
        )
        self._early: dict[tuple[bytes, Hashable], tuple[Arrival, int]] = {}
        """The last message of each publisher that is not announced yet, and its arrival (ns)."""
        self._call_parts = CallAssembler(self.stats.lost)
        self._call_serial = 0

    def limit_tables(self, most: int | None) -> None:
        """Keep so many topics, endpoints, modules and long names of others, each, if the link's URL says how many."""
        if most is not None:
            assert isinstance(self.discovery, Discovery)
            self.discovery.limit_tables(most)

    # For subclasses to implement

    def key(self, topic: str) -> bytes:
        """Return `Arrival.topic` of a topic's messages: its name, or what travels for it."""
        return topic.encode()

    @property
    @abc.abstractmethod
    def full(self) -> bool:
        """Return whether the send buffer has no room."""

    @abc.abstractmethod
    def write(self, topic: str, sample: Sample) -> None:
        """Put a sample into the send buffer; there is room."""

    @abc.abstractmethod
    def sample(self, topic: str, arrival: Any) -> Sample:
        """Make a sample of a received message. Raises DecodeError for one that can't be, which is counted."""

    def has_room_for(self, sample: Sample) -> bool:
        """Return whether there is room for this very sample now; called before each `write`."""
        return not self.full

    def discard(self) -> int:
        return 0

    def sender(self, arrival: Any) -> Hashable:
        """Return the sender's address on a bus; None on a line with one other end."""
        return None

    @property
    def flow_controlled(self) -> bool:
        """Return whether the other end waits while nothing is read, without losing anything."""
        return False

    def pause(self) -> None:
        """Stop reading, if possible: received messages are still being delivered."""

    def resume(self) -> None:
        """Go on reading."""

    # Management, and r2p's own services: in parts, as every link carries management

    def manage(self, data: bytes, source: Hashable) -> None:
        if management.type_of(data) != _CALL_PART:
            super().manage(data, source)
            return
        try:
            message = self._call_parts.receive(self._clock.monotonic(), call_parts.decode(data))
        except UnknownType:
            self.stats.lost["unknown type"] += 1
        except DecodeError:
            self.stats.lost["undecodable"] += 1
        else:
            if message is not None:
                self.calls.receive(message, source)

    def write_call(self, data: bytes, to: Hashable) -> None:
        self._call_serial = (self._call_serial + 1) % call_parts.SERIALS
        for part in call_parts.encode(self._hub.instance, self._call_serial, data):
            self.write_management(part)

    # Out

    def made_room(self) -> None:
        """Send waiting samples, in order, while there is room. Call it when the answer of `has_room_for` may change."""
        while not self.stats.lost.guard(self.wait_queue.serve):
            pass  # the sample that raised is out of the queue: go on with the others
        if not self.full:
            self.wait_queue.recover()

    def count_unsendable(self, topic: str, sample: Sample, reason: str) -> None:
        """Count a message that the link can't carry, and report it to its publisher, or to the gateway."""
        self.stats.lost[reason] += 1
        if (publisher := self.publisher_of(topic, sample)) is not None:
            publisher.link_missed(self.name, reason, sequence=sample.sequence)
        elif (known := self._space.topics.get(topic)) is not None:
            known.count_unsendable(sample, self.name, reason)

    def publisher_of(self, topic: str, sample: Sample) -> PublisherHandle | None:
        """Return this module's publisher of a sample, to which its fate is reported; None if another module's."""
        known = self._space.topics.get(topic)
        return None if known is None else known.publisher_of(sample)

    def on_down(self, reason: str) -> None:
        if self.up:
            self._early.clear()
            super().on_down(reason)
            self.wait_queue.reject_all(LINK_DOWN)  # nothing makes room any more

    def _release_topics(self) -> None:
        self.wait_queue.reject_all("link closed")
        super()._release_topics()
        self._arrivals.clear()
        self._backpressure.close()
        for received in list(self._received.values()):
            self.remove_publishers(received.topic.name)

    def _subscriber_joined(self, event: SubscriberJoined) -> None:
        self._add_subscriber(event.topic)

    def _add_subscriber(self, name: str) -> None:
        topic = self._space.topics.get(name)
        if topic is None:
            return
        subscriber = self._subscribers.get(name)
        if subscriber is None or subscriber.topic is not topic:
            subscriber = self._subscribers[name] = BufferedSubscriber(self, topic, self.wait_queue)
            topic.join(subscriber)
        else:
            topic.resend_latched(subscriber)

    # In: topics and their senders

    def add_publisher(self, topic: Topic, size: int, source: Hashable) -> None:
        key = self.key(topic.name)
        received = self._received.get(key)
        if received is None:
            received = self._received[key] = _ReceivedTopic(topic, {})
            topic.latched_sources.append(self)
        is_new = source not in received.sizes
        received.sizes[source] = size
        if is_new:
            topic.remote_publishers += 1
            for queue in topic.queues:
                queue.publisher_joined()

    def remove_publisher(self, name: str, source: Hashable) -> None:
        received = self._received_topic(name)
        if received is not None and source in received.sizes:
            del received.sizes[source]
            received.topic.remote_publishers -= 1
            if not received.sizes:
                self.remove_publishers(name)

    def remove_publishers(self, name: str) -> None:
        received = self._received_topic(name)
        if received is not None:
            del self._received[self.key(name)]
            received.topic.remote_publishers -= len(received.sizes)
            received.topic.latched_sources.remove(self)

    def _received_topic(self, name: str) -> _ReceivedTopic | None:
        received = self._received.get(self.key(name))
        return received if received is not None and received.topic.name == name else None  # else it has its alias

    def latched_value(self, topic: Topic) -> Sample | None:
        """The last message, if its publisher latches it."""
        last = self._received[self.key(topic.name)].last
        return last if last is not None and self.latched(topic.name) else None

    # In: messages

    def receive(self, arrivals: Iterable[Arrival]) -> None:
        """Deliver received messages, at most MESSAGES_PER_TURN in one turn of the loop."""
        if self._closed:
            return
        self._arrivals.extend(arrivals)
        if not self._delivering:
            self._deliver()
        elif self._paused:
            self.pause()  # the connection is a new one, which still reads

    def receive_other(self, arrival: Any) -> None:
        """Handle a message of any other topic: management, or something unexpected."""
        if arrival.topic == _MANAGEMENT:
            self.manage(arrival.data, self.sender(arrival))
        elif arrival.topic in _CALLS:
            self.calls.receive(arrival.data, self.sender(arrival))
        else:
            self._receive_unexpected(arrival)

    def _deliver(self) -> None:
        self._delivering = True
        arrivals, received, lost = self._arrivals, self._received, self.stats.lost
        # All in one loop, as this is done for each message. One without a subscriber costs one look into a dictionary.
        for _ in range(MESSAGES_PER_TURN):
            if not arrivals:
                self._delivering = False
                self._resume_reading()
                return
            arrival = arrivals.popleft()
            try:
                entry = received.get(arrival.topic)
                if entry is None:
                    self.receive_other(arrival)
                    continue
                size = entry.sizes.get(self.sender(arrival))
                if size is None:
                    self._receive_unexpected(arrival)
                elif size and len(arrival.data) != size:
                    lost["wrong size"] += 1
                else:
                    self.stats.received += 1
                    entry.last = sample = self.sample(entry.topic.name, arrival)
                    blocked = entry.topic.deliver(sample)
                    if blocked is not None and self._backpressure.wait(sample, blocked):
                        self._pause_reading()
                        return
            except DecodeError:
                lost["undecodable"] += 1
            except Exception as error:  # noqa: BLE001 - counted and logged; the next one follows
                lost.internal_error(error)
        self._space.loop.call_soon(self._deliver)
        self._pause_reading()  # further messages would only wait here

    def _pause_reading(self) -> None:
        if not self._paused:
            self._paused = True
            self.pause()

    def _resume_reading(self) -> None:
        if self._paused:
            self._paused = False
            self.resume()

    def _deliver_rest(self) -> None:
        """Go on after the blocked message, which has been delivered or given up."""
        if not self._closed:
            self._deliver()

    # In: a message may overtake the answer that announces its publisher; kept, as a latched one does not come again

    def _receive_unexpected(self, arrival: Arrival) -> None:
        self.stats.lost[_NOT_SUBSCRIBED] += 1
        topic = None if self.in_order else self._space.topics.get(arrival.topic.decode("ascii", "replace"))
        if topic is None or not topic.wanted:
            return
        key = arrival.topic, self.sender(arrival)
        self._early.pop(key, None)
        if len(self._early) >= _EARLY_MAX:
            del self._early[next(iter(self._early))]
        if len(arrival.data) > _EARLY_LONG:  # one of these at most: with many of them memory would be large
            self._early = {key: each for key, each in self._early.items() if len(each[0].data) <= _EARLY_LONG}
        self._early[key] = arrival, self._clock.monotonic()

    def _publisher_found(self, name: str, size: int, source: Hashable = None) -> None:
        super()._publisher_found(name, size, source)
        if self._received_topic(name) is not None:
            self._receive_early(self.key(name), source)

    def _receive_early(self, name: bytes, source: Hashable) -> None:
        arrival, at = self._early.pop((name, source), (None, 0))
        alone = len(self._space.links) == 1  # else the same message may have come by another link meanwhile
        if arrival is not None and alone and not self._closed and self._clock.monotonic() - at <= _EARLY:
            self.stats.lost[_NOT_SUBSCRIBED] -= 1
            self._arrivals.appendleft(arrival)
            if not self._delivering:
                self._deliver()


class BufferedSubscriber(LinkSubscriber):
    """One topic on its way into the send buffer of a link, which it shares with the link's other topics."""

    __slots__ = ()

    link: BufferedLink

    def offer(self, sample: Sample) -> bool:
        link = self.link
        if not link.up:
            return self.offer_down(sample)
        if not link.has_room_for(sample):
            return False
        link.write(self.topic.name, sample)
        return True

    def force(self, sample: Sample) -> None:
        link = self.link
        if link.up and not link.full:
            link.write(self.topic.name, sample)
        else:
            self.count_lost("send buffer full" if link.up else LINK_DOWN)

    def refill(self) -> None:
        self.link.made_room()


class SenderLookup:
    """The source of messages by topic and address, looked up anew after changes in discovery.

    Lines and CAN frames do not name their sender, so it follows from discovery: r2p modules announce themselves, and
    which of their nodes publish a topic. A topic that no module has announced comes from the only possible sender, if
    there is only one. Behind a gateway there may always be modules whose announcements are late: there only a publisher
    that was announced has a name, and of the log, which all modules publish, none has. `shared` are addresses that
    several modules may have.
    """

    def __init__(self, discovery: DiscoveryProtocol, link: str, shared: tuple[PeerAddress, ...] = ()) -> None:
        self._discovery = discovery
        self._link = link
        self._shared = shared
        self._sources: dict[tuple[str, PeerAddress], Source] = {}
        self._generation = -1

    def source(self, topic: str, address: PeerAddress = None) -> Source:
        """Return the source of a message from this address. Without an address it may be any module at the other end.

        A name is empty if it is unknown or ambiguous.
        """
        if self._generation != self._discovery.generation:
            self._generation = self._discovery.generation
            self._sources.clear()
        source = self._sources.get((topic, address))
        if source is None:
            source = self._sources[topic, address] = self._find(topic, address)
        return source

    def _find(self, topic: str, address: PeerAddress) -> Source:
        modules = self._modules_at(address)
        names = {info.instance: info.name for info in modules if info.r2p}
        # Without an address, a publisher of a module that is not known yet may be the sender; its module has no name.
        publishers = {
            (names.get(each.instance, ""), each.node)
            for each in self._discovery.endpoints.values()
            if each.topic == topic and each.role == ROLE_PUBLISHES and (address is None or each.instance in names)
        }
        possible = possible_senders(modules)
        if _is_published_by_all(topic) and len(possible) != 1:
            return Source(link=self._link)  # the first that announces it need not have sent this message
        if len(publishers) == 1:
            return Source(*publishers.pop(), self._link)
        candidates = {module for module, _ in publishers} or possible
        return Source(candidates.pop() if len(candidates) == 1 else "", "", self._link)

    def _modules_at(self, address: PeerAddress) -> list[ModuleInfo]:
        modules = list(self._discovery.modules.values())
        if address is None:
            return modules
        direct = [info for info in modules if info.source == address]
        return direct or [info for info in modules if info.source in self._shared]


def _is_published_by_all(topic: str) -> bool:
    """Return whether all r2p modules publish the topic."""
    return topic.rpartition("/")[2] == LOG
