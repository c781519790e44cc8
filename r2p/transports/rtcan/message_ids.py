"""The message ids to receive on an RTCAN bus, and the topics behind them.

A publisher is known by its 16-bit message id, which it announces. The low byte is the sender's id8, by which discovery
knows its module. Modules of 2014 send management with one id for all of them, so they share one address.
"""

from collections import defaultdict
from collections.abc import Callable

from r2p.codecs import management, rtcan
from r2p.codecs.management import Advertise, Alive, ManagementType, SubscribeResponse
from r2p.errors import DecodeError
from r2p.protocols.discovery.events import ModuleInfo, PeerAddress, PublisherFound
from r2p.protocols.rtcan.engine import Engine
from r2p.protocols.rtcan.events import Profile
from r2p.runtime.topic import TopicSpace
from r2p.transports.buffered_link import BufferedLink
from r2p.units import SECOND

FIRMWARE = 0
"""The address of all firmware modules of 2014."""
R2P = 256
"""The address of all r2p modules on a bus with firmware of 2014; other modules have their id8 as address, 1 to 255."""

_LINGER = SECOND  # ns during which what still comes from a publisher that has left is counted as lost


def address_of(data: bytes, modules: dict[str, ModuleInfo], name_of: Callable[[str], str] = str) -> int:
    """Return the sender of a management message with firmware's id, FIRMWARE or R2P.

    `modules` are known by name, `name_of` returns the name behind an alias.
    """
    message_type = management.type_of(data)
    if message_type == ManagementType.ALIVE:
        alive = _decoded(data)
        names = {alive.module, name_of(alive.module)} if isinstance(alive, Alive) else set()
        is_r2p = any(modules[name].r2p for name in names if name in modules)
    else:
        is_r2p = message_type in management.R2P_TYPES or management.is_marked(data)
    return R2P if is_r2p else FIRMWARE


def publisher_in(data: bytes, source: int) -> tuple[str, int] | None:
    """Return topic and message id of the publisher that a management message from this address offers, if plausible.

    Every offer of r2p has the message id; of firmware only the answer to a subscriber has it.
    """
    offer = _decoded(data)
    if not isinstance(offer, SubscribeResponse) and (not isinstance(offer, Advertise) or source == FIRMWARE):
        return None
    message_id = management.rtcan_message_id(offer.params)
    shared = source in (FIRMWARE, R2P)
    if rtcan.high_byte(message_id) < rtcan.FIRST_TOPIC or not (shared or rtcan.id8_of(message_id) == source):
        return None
    return offer.topic, message_id


def _decoded(data: bytes) -> management.Management | None:
    """Return the message; None if discovery will count it as undecodable. The codec remembers it for discovery."""
    try:
        return management.decode(data)
    except DecodeError:
        return None


class MessageIdMap:
    """The message ids of remote publishers, for which the engine and the link receive messages."""

    def __init__(self, link: BufferedLink, engine: Engine, space: TopicSpace) -> None:
        self.topics: dict[int, bytes] = {}
        """Names of topics by message id."""
        self.lingering: dict[int, int] = {}
        """Ids of publishers that have left, and until when (monotonic ns) their late messages are counted."""
        self._link = link
        self._engine = engine
        self._space = space
        self._ids: defaultdict[tuple[str, PeerAddress], set[int]] = defaultdict(set)

    def add(self, now: int, found: PublisherFound) -> None:
        """Receive the messages of a publisher: of the announced size, unless the topic has a type here."""
        topic = self._space.topics.get(found.topic)
        if topic is None or not topic.wanted:
            return
        size, varies = found.bound if found.varies else found.size, found.varies
        if (layout := topic.received_layout) is not None:
            size, varies = layout.size, layout.varies
        if not (size or varies or found.source == FIRMWARE):
            return  # a gateway that has forgotten the type with its last publisher: the next one says its size
        message_id = management.rtcan_message_id(found.params)
        possible = varies or 1 <= size <= rtcan.PAYLOAD_MAX
        if not (possible and self._plausible(message_id, found.source)):
            self._link.stats.lost["impossible publisher"] += 1
            return
        self._assign(now, message_id, found.topic, found.source)
        self.lingering.pop(message_id, None)
        self._engine.subscribe(message_id, size, varies=varies)
        self._link.add_publisher(topic, 0 if varies else size, message_id)

    def remove(self, now: int, name: str, source: PeerAddress) -> None:
        """Stop receiving from this publisher, or from all firmware."""
        for message_id in self._ids.pop((name, source), ()):
            self._remove_id(now, message_id)

    def end_lingering(self, now: int) -> bool:
        """Stop counting messages of publishers that left long enough ago. Return whether there were any."""
        over = [message_id for message_id, until in self.lingering.items() if until <= now]
        for message_id in over:
            del self.lingering[message_id]
            self._engine.unsubscribe(message_id)
        return bool(over)

    def _plausible(self, message_id: int, source: PeerAddress) -> bool:
        # Without this check a module could claim the id of another one, and end its reception.
        if self._engine.profile is Profile.FIRMWARE:
            return message_id != rtcan.FIRMWARE_MANAGEMENT
        return rtcan.high_byte(message_id) >= rtcan.FIRST_TOPIC and rtcan.id8_of(message_id) == source

    def _assign(self, now: int, message_id: int, name: str, source: PeerAddress) -> None:
        """Assign an id to this publisher alone."""
        ids = self._ids[name, source]
        # With an address of its own a publisher has one id at a time. Publishers that share an address have one each.
        stale = set() if source in (FIRMWARE, R2P) else ids - {message_id}
        if self.topics.get(message_id, name.encode()) != name.encode():
            stale.add(message_id)
        for each in stale:
            self._remove_id(now, each)
        ids.add(message_id)
        self.topics[message_id] = name.encode()

    def _remove_id(self, now: int, message_id: int) -> None:
        name = self.topics.pop(message_id, b"").decode()
        topic = self._space.topics.get(name)
        if topic is not None and topic.wanted:  # stay subscribed, so that what is still on its way counts as lost
            self.lingering[message_id] = now + _LINGER
        else:
            self._engine.unsubscribe(message_id)
        for ids in self._ids.values():
            ids.discard(message_id)
        self._link.remove_publisher(name, message_id)
