"""What comes in over an RTCAN bus: who sent it, which message ids to receive, and the samples made of messages.

A publisher is known by its 16-bit message id, which it announces. The low byte is the sender's id8, by which discovery
knows its module. Modules of 2014 send management with one id for all of them, so they share one address.
"""

from collections import Counter, defaultdict

import msgspec

from r2p.clock import Clock
from r2p.codecs import management, rtcan
from r2p.codecs.management import ROLE_PUBLISHES, Advertise, Alive, ManagementType, SubscribeResponse
from r2p.errors import DecodeError
from r2p.protocols.discovery.events import ModuleInfo, PeerAddress
from r2p.protocols.discovery.session import Discovery
from r2p.protocols.rtcan.engine import Engine
from r2p.protocols.rtcan.events import Mailbox, Profile, Received
from r2p.runtime.sample import PublisherClass, Sample, Source
from r2p.runtime.topic import TopicSpace
from r2p.transports.buffered_link import BufferedLink
from r2p.transports.rtcan.driver import EngineDriver
from r2p.transports.rtcan.status import UtcEstimator
from r2p.units import LONG_AGO, MILLISECOND, SECOND

FIRMWARE = 0
"""The address of all firmware modules of 2014."""
R2P = 256
"""The address of all r2p modules on a bus with firmware of 2014; other modules have their id8 as address, 1 to 255."""

_OFFSET_VALID = 10_000_000  # ns for which the offset of UTC from the monotonic clock is not read again
_LINGER = SECOND  # ns in which what still comes from a publisher that has left is counted as lost
_CLASSES = {
    Mailbox.HRT: PublisherClass.PERIODIC,
    Mailbox.SRT: PublisherClass.SPORADIC,
    Mailbox.NRT: PublisherClass.NON_REAL_TIME,
}


# Who sent it


def address_of(data: bytes, modules: dict[str, ModuleInfo]) -> int:
    """FIRMWARE or R2P: who sent a management message with the id of firmware. `modules` are those known by name."""
    message_type = management.type_of(data)
    if message_type == ManagementType.ALIVE:
        alive = _decoded(data)
        info = modules.get(alive.module) if isinstance(alive, Alive) else None
        is_r2p = info is not None and info.r2p
    else:
        is_r2p = message_type in management.R2P_TYPES or management.is_marked(data)
    return R2P if is_r2p else FIRMWARE


def publisher_in(data: bytes, source: int) -> tuple[str, int] | None:
    """Topic and message id of the publisher that a management message from this address offers, if it can be true.

    Every offer of r2p has the message id; of firmware only the answer to a subscriber has it.
    """
    offer = _decoded(data)
    if not isinstance(offer, SubscribeResponse) and (not isinstance(offer, Advertise) or source == FIRMWARE):
        return None
    message = management.rtcan_message_id(offer.params)
    shared = source in (FIRMWARE, R2P)
    if rtcan.high_byte(message) < rtcan.FIRST_TOPIC or not (shared or rtcan.id8_of(message) == source):
        return None
    return offer.topic, message


def _decoded(data: bytes) -> management.Management | None:
    """The message, or None where discovery would count it as undecodable. The codec remembers it for discovery."""
    try:
        return management.decode(data)
    except DecodeError:
        return None


class SenderLookup:
    """Finds the module and the node behind a message id, as far as discovery knows them."""

    def __init__(self, discovery: Discovery, link: str) -> None:
        self._discovery = discovery
        self._link = link
        self._known: dict[tuple[str, int], Source] = {}
        self._generation = -1

    def source(self, topic: str, message: int) -> Source:
        """The source of a message with this id. A name that is unknown or ambiguous is empty."""
        if self._generation != self._discovery.generation:  # discovery has learnt something since
            self._generation = self._discovery.generation
            self._known.clear()
        source = self._known.get((topic, message))
        if source is None:
            source = self._known[topic, message] = self._find(topic, rtcan.id8_of(message))
        return source

    def _find(self, topic: str, id8: int) -> Source:
        all_modules = self._discovery.modules.values()
        direct = [info for info in all_modules if info.source == id8]
        modules = direct or [info for info in all_modules if info.source in (FIRMWARE, R2P)]
        names: dict[int | None, str] = {info.instance: info.name for info in modules if info.r2p}
        publishers = {
            (names[each.instance], each.node)
            for each in self._discovery.endpoints.values()
            if each.topic == topic and each.role == ROLE_PUBLISHES and each.instance in names
        }
        if len(publishers) == 1:
            return Source(*publishers.pop(), self._link)
        candidates = {module for module, _ in publishers} or {info.name for info in modules if not info.observer}
        return Source(candidates.pop() if len(candidates) == 1 else "", "", self._link)


# Samples


class ReceivedMessage(msgspec.Struct, frozen=True, gc=False):
    """A whole message that came in; `message` is its id."""

    topic: bytes
    data: bytes
    message: int
    received: Received


class SampleBuilder:
    """Makes samples of messages. `clock` is the module's, `utc` estimates the network's time in UTC."""

    def __init__(self, driver: EngineDriver, discovery: Discovery, link: str, clock: Clock, utc: UtcEstimator) -> None:
        self._engine = driver.engine
        self._port = driver.port
        self._now = driver.now
        self._discovery = discovery
        self._senders = SenderLookup(discovery, link)
        self._clock = clock
        self._utc = utc
        self._offset = 0  # of UTC from the monotonic clock (ns)
        self._offset_until = LONG_AGO

    def build(self, topic: str, arrival: ReceivedMessage) -> Sample:
        """The sample of a message of this topic. Its stamp is the start of the message's first frame."""
        received = arrival.received
        started = self._port.monotonic(self._started(received))
        now = self._now()
        if now >= self._offset_until:  # two clocks of one computer: not worth two system calls per message
            self._offset = self._clock.now() - self._clock.monotonic()
            self._offset_until = now + _OFFSET_VALID
        stamp = self._offset + started
        source = self._senders.source(topic, arrival.message)
        laxity = received.laxity  # ms that were left; SRT_MAX stands for more, too, so it gives no deadline
        deadline = stamp + laxity * MILLISECOND if rtcan.HRT < laxity < rtcan.SRT_MAX else 0
        sender = self._discovery.modules.get(source.module)
        return Sample(
            arrival.data,
            source,
            stamp,
            deadline,
            0,
            _CLASSES[received.mailbox],
            stamped=False,
            drop_late=sender is not None and sender.r2p,  # firmware gives 50 ms to everything, which means nothing
            clock=self._utc.offset(now),
        )

    def _started(self, received: Received) -> int:
        """When the first frame began. A coarse port does not know that to the bit: don't spend time counting bits."""
        bit = self._engine.timing.bit
        if self._port.coarse:
            return received.stamp - rtcan.frame_bits_max(min(len(received.payload), rtcan.FRAME_MAX)) * bit
        return received.started(bit)


# Which message ids to receive


class MessageIdMap:
    """The message ids of remote publishers, for which the engine and the link receive messages.

    `lost` counts publishers that can't be received.
    """

    def __init__(self, engine: Engine, link: BufferedLink, space: TopicSpace, lost: Counter[str]) -> None:
        self.topics: dict[int, bytes] = {}
        """Names of topics by message id."""
        self.lingering: dict[int, int] = {}
        """Ids of publishers that have left, and until when (monotonic ns) what still comes from them is counted."""
        self._engine = engine
        self._link = link
        self._space = space
        self._lost = lost
        self._ids: defaultdict[tuple[str, PeerAddress], set[int]] = defaultdict(set)

    def add(self, now: int, name: str, source: PeerAddress, params: bytes, size: int) -> None:
        """Receive the messages of a publisher, of `size` bytes unless the topic has a type here."""
        topic = self._space.topics.get(name)
        if topic is None or not topic.wanted:
            return
        size = topic.layout.size if topic.layout is not None else size
        message = management.rtcan_message_id(params)
        if not self._plausible(message, source) or not 1 <= size <= rtcan.PAYLOAD_MAX:
            self._lost["impossible publisher"] += 1
            return
        self._assign(now, message, name, source)
        self.lingering.pop(message, None)
        self._engine.subscribe(message, size)
        self._link.add_publisher(topic, size, message)

    def remove(self, now: int, name: str, source: PeerAddress) -> None:
        """Receive no more from this publisher, or from all firmware."""
        for message in self._ids.pop((name, source), ()):
            self._remove_id(now, message)

    def end_lingering(self, now: int) -> bool:
        """Stop counting what comes from publishers that have left long enough ago. Returns whether there were any."""
        over = [message for message, until in self.lingering.items() if until <= now]
        for message in over:
            del self.lingering[message]
            self._engine.unsubscribe(message)
        return bool(over)

    def _plausible(self, message: int, source: PeerAddress) -> bool:
        # Without this check a module could claim the id of another one, and end what is received from that.
        if self._engine.profile is Profile.FIRMWARE:
            return message != rtcan.FIRMWARE_MANAGEMENT
        return rtcan.high_byte(message) >= rtcan.FIRST_TOPIC and rtcan.id8_of(message) == source

    def _assign(self, now: int, message: int, name: str, source: PeerAddress) -> None:
        """Assign an id to this publisher alone."""
        ids = self._ids[name, source]
        # With an address of its own a publisher has one id at a time. Those that share an address have one each.
        stale = set() if source in (FIRMWARE, R2P) else ids - {message}
        if self.topics.get(message, name.encode()) != name.encode():
            stale.add(message)
        for each in stale:
            self._remove_id(now, each)
        ids.add(message)
        self.topics[message] = name.encode()

    def _remove_id(self, now: int, message: int) -> None:
        name = self.topics.pop(message, b"").decode()
        topic = self._space.topics.get(name)
        if topic is not None and topic.wanted:  # stay subscribed, so that what is still on its way counts as lost
            self.lingering[message] = now + _LINGER
        else:
            self._engine.unsubscribe(message)
        for ids in self._ids.values():
            ids.discard(message)
        self._link.remove_publisher(name, message)
