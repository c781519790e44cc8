"""Which message ids are taken on an RTCAN bus, and for which topics: one inlet for each publisher.

An r2p module has one id for a topic; another one replaces it. Those of firmware come from one address, so each id that
is told there is one more publisher. An id belongs to the topic that it was last told for.
"""

from collections import Counter, defaultdict

from r2p.codecs import rtcan
from r2p.protocols.events import Source
from r2p.protocols.rtcan.engine import Engine
from r2p.protocols.rtcan.events import Profile
from r2p.topic import TopicSpace
from r2p.transports.intake import Inlets
from r2p.transports.rtcan.origins import FIRMWARE, R2P, message_of

_SHUTTING = 1_000_000_000
"""Ns in which messages that come after their publisher's good-bye, or by its former id, are counted as lost."""


class RtcanInlets:
    """Opens and shuts the ids at the engine and at the intake. `lost` counts what can't be opened."""

    def __init__(self, engine: Engine, intake: Inlets, space: TopicSpace, lost: Counter[str]) -> None:
        self.topics: dict[int, bytes] = {}
        """Names of topics by message id."""
        self.shutting: dict[int, int] = {}
        """Ids that were shut by their publisher, and until when (monotonic ns) what still comes of them is counted."""
        self._engine = engine
        self._intake = intake
        self._space = space
        self._lost = lost
        self._ids: defaultdict[tuple[str, Source], set[int]] = defaultdict(set)

    def open(self, now: int, name: str, source: Source, params: bytes, size: int) -> None:
        """Take the messages of a publisher, of `size` bytes unless the topic has a type here."""
        topic = self._space.topics.get(name)
        if topic is None or not topic.wanted:
            return
        size = topic.layout.size if topic.layout is not None else size
        message = message_of(params)
        if not self._plausible(message, source) or not 1 <= size <= rtcan.PAYLOAD_MAX:
            self._lost["impossible publisher"] += 1
            return
        self._claim(now, message, name, source)
        self.shutting.pop(message, None)
        self._engine.subscribe(message, size)
        self._intake.open(topic, size, message)

    def shut(self, now: int, name: str, source: Source) -> None:
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

    def _plausible(self, message: int, source: Source) -> bool:
        if self._engine.profile is Profile.FIRMWARE:
            return message != rtcan.FIRMWARE_MANAGEMENT
        return rtcan.high_byte(message) >= rtcan.FIRST_TOPIC and rtcan.id8_of(message) == source

    def _claim(self, now: int, message: int, name: str, source: Source) -> None:
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
        self._intake.shut(name, message)
