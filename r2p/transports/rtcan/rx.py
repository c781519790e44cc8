"""What came in over an RTCAN bus, made into samples: when it was sent, by whom, how urgent it was there."""

from collections import Counter, defaultdict

import msgspec

from r2p.clock import Clock
from r2p.codecs import management, rtcan
from r2p.codecs.management import ROLE_PUBLISHES, ManagementType
from r2p.errors import DecodeError
from r2p.protocols.discovery.events import ModuleInfo, PeerAddress
from r2p.protocols.discovery.session import Discovery
from r2p.protocols.rtcan.engine import Engine
from r2p.protocols.rtcan.events import LONG_AGO, Mailbox, Profile, Received
from r2p.runtime.sample import PublisherClass, Sample, Source
from r2p.runtime.topic import TopicSpace
from r2p.transports.buffered_link import BufferedLink
from r2p.transports.can.port import CanPort
from r2p.transports.rtcan.status import UtcEstimator

_MILLISECOND = 1_000_000
_STEADY = 10_000_000  # ns; two clocks of one computer stay together that long
_CLASSES = {
    Mailbox.HRT: PublisherClass.PERIODIC,
    Mailbox.SRT: PublisherClass.SPORADIC,
    Mailbox.NRT: PublisherClass.NON_REAL_TIME,
}


class ReceivedMessage(msgspec.Struct, frozen=True, gc=False):
    """A whole message that came in; `message` is its id."""

    topic: bytes
    data: bytes
    message: int
    received: Received


class SampleBuilder:
    """Makes them, for the link of this name. `clock` is the module's, `translation` that of the network's time."""

    def __init__(
        self, link: str, engine: Engine, port: CanPort, discovery: Discovery, translation: UtcEstimator, clock: Clock
    ) -> None:
        self._engine = engine
        self._port = port
        self._now = port.now
        self._discovery = discovery
        self._origins = SenderLookup(discovery, link)
        self._translation = translation
        self._clock = clock
        self._offset = 0  # of UTC from the monotonic clock (ns)
        self._offset_until = LONG_AGO

    def make(self, topic: str, arrival: ReceivedMessage) -> Sample:
        """The sample of a message of this topic."""
        received = arrival.received
        started = self._port.monotonic(self._started(received))
        now = self._now()
        if now >= self._offset_until:
            self._offset = self._clock.now() - self._clock.monotonic()
            self._offset_until = now + _STEADY
        stamp = self._offset + started
        source = self._origins.of(topic, arrival.message)
        laxity = received.laxity
        deadline = stamp + laxity * _MILLISECOND if rtcan.HRT < laxity < rtcan.SRT_MAX else 0
        sender = self._discovery.modules.get(source.module)
        return Sample(
            arrival.data,
            source,
            stamp,
            deadline,
            0,
            _CLASSES[received.mailbox],
            stamped=False,
            drop_late=sender is not None and sender.r2p,  # firmware says 50 ms of everything
            clock=self._translation.clock(now),
        )

    def _started(self, received: Received) -> int:
        """When it began. A coarse port does not know that to the bit, and counting them would take its time."""
        bit = self._engine.timing.bit
        if self._port.coarse:
            return received.stamp - rtcan.frame_bits_max(min(len(received.payload), rtcan.FRAME_MAX)) * bit
        return received.started(bit)


# Which message ids are taken on an RTCAN bus, and for which topics: one inlet for each publisher.


_SHUTTING = 1_000_000_000
"""Ns in which messages that come after their publisher's good-bye, or by its former id, are counted as lost."""


class MessageIdMap:
    """Opens and shuts the ids at the engine and at the link. `lost` counts what can't be opened."""

    def __init__(self, engine: Engine, link: BufferedLink, space: TopicSpace, lost: Counter[str]) -> None:
        self.topics: dict[int, bytes] = {}
        """Names of topics by message id."""
        self.shutting: dict[int, int] = {}
        """Ids that were shut by their publisher, and until when (monotonic ns) what still comes of them is counted."""
        self._engine = engine
        self._link = link
        self._space = space
        self._lost = lost
        self._ids: defaultdict[tuple[str, PeerAddress], set[int]] = defaultdict(set)

    def open(self, now: int, name: str, source: PeerAddress, params: bytes, size: int) -> None:
        """Take the messages of a publisher, of `size` bytes unless the topic has a type here."""
        topic = self._space.topics.get(name)
        if topic is None or not topic.wanted:
            return
        size = topic.layout.size if topic.layout is not None else size
        message = management.rtcan_message_id(params)
        if not self._plausible(message, source) or not 1 <= size <= rtcan.PAYLOAD_MAX:
            self._lost["impossible publisher"] += 1
            return
        self._claim(now, message, name, source)
        self.shutting.pop(message, None)
        self._engine.subscribe(message, size)
        self._link.add_publisher(topic, size, message)

    def shut(self, now: int, name: str, source: PeerAddress) -> None:
        """Take no more from this publisher, or from all firmware."""
        for message in self._ids.pop((name, source), ()):
            self._close(now, message)

    def forget_shut(self, now: int) -> bool:
        """Look no more for what comes of ids that were shut a while ago. Says whether there were any."""
        over = [message for message, until in self.shutting.items() if until <= now]
        for message in over:
            del self.shutting[message]
            self._engine.unsubscribe(message)
        return bool(over)

    def _plausible(self, message: int, source: PeerAddress) -> bool:
        if self._engine.profile is Profile.FIRMWARE:
            return message != rtcan.FIRMWARE_MANAGEMENT
        return rtcan.high_byte(message) >= rtcan.FIRST_TOPIC and rtcan.id8_of(message) == source

    def _claim(self, now: int, message: int, name: str, source: PeerAddress) -> None:
        """The id is this publisher's, and nobody else's."""
        ids = self._ids[name, source]
        stale = set() if source in (FIRMWARE, R2P) else ids - {message}
        if self.topics.get(message, name.encode()) != name.encode():
            stale.add(message)
        for each in stale:
            self._close(now, each)
        ids.add(message)
        self.topics[message] = name.encode()

    def _close(self, now: int, message: int) -> None:
        name = self.topics.pop(message, b"").decode()
        topic = self._space.topics.get(name)
        if topic is not None and topic.wanted:
            self.shutting[message] = now + _SHUTTING
        else:
            self._engine.unsubscribe(message)
        for ids in self._ids.values():
            ids.discard(message)
        self._link.remove_publisher(name, message)


# Who is behind a message id on an RTCAN bus, as far as discovery has heard.


FIRMWARE = 0
"""The address of all firmware modules of 2014."""
R2P = 256
"""The address of all r2p modules in a network of theirs."""


def address(data: bytes, modules: dict[str, ModuleInfo]) -> int:
    """Which kind of module sent this management message with the id of firmware. `modules` are those known."""
    kind = management.type_of(data)
    if kind == ManagementType.ALIVE:
        alive = _decoded(data)
        known = modules.get(alive.module) if isinstance(alive, management.Alive) else None
        ours = known is not None and known.r2p
    else:
        ours = kind in management.R2P_TYPES or management.is_marked(data)
    return R2P if ours else FIRMWARE


def publisher_in(data: bytes, source: int) -> tuple[str, int] | None:
    """Topic and message id of a publisher that a management message of this address offers, if it can be true.

    Publishers of r2p tell it in all that they offer, those of firmware only when asked.
    """
    kind = management.type_of(data)
    if kind != ManagementType.SUBSCRIBE_RESPONSE and (kind != ManagementType.ADVERTISE or source == FIRMWARE):
        return None
    offer = _decoded(data)
    if not isinstance(offer, management.SubscribeResponse | management.Advertise):
        return None
    message, shared = management.rtcan_message_id(offer.params), source in (FIRMWARE, R2P)
    if rtcan.high_byte(message) < rtcan.FIRST_TOPIC or not (shared or rtcan.id8_of(message) == source):
        return None
    return offer.topic, message


def _decoded(data: bytes) -> management.Management | None:
    try:
        return management.decode(data)
    except DecodeError:
        return None


class SenderLookup:
    """The source of samples by topic and message id, worked out anew when something is learnt."""

    def __init__(self, discovery: Discovery, link: str) -> None:
        self._discovery = discovery
        self._link = link
        self._known: dict[tuple[str, int], Source] = {}
        self._generation = -1

    def of(self, topic: str, message: int) -> Source:
        """Empty names for what was not heard, and for what may be one or another."""
        if self._generation != self._discovery.generation:
            self._generation = self._discovery.generation
            self._known.clear()
        source = self._known.get((topic, message))
        if source is None:
            source = self._known[topic, message] = self._find(topic, rtcan.id8_of(message))
        return source

    def _find(self, topic: str, id8: int) -> Source:
        everybody = self._discovery.modules.values()
        direct = [info for info in everybody if info.source == id8]
        modules = direct or [info for info in everybody if info.source in (FIRMWARE, R2P)]
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
