"""Which topics the other modules of a link publish and subscribe to, whether this module has them or not.

Discovery itself only answers for the topics of its own module. A gateway has none, and must know what each link offers
and wants; so only gateways keep this table.
"""

from collections.abc import Hashable

from r2p.codecs import management
from r2p.codecs.management import ROLE_PUBLISHES, ROLE_SUBSCRIBES
from r2p.protocols.discovery.directory import FOR_EVER, MOST, Directory
from r2p.protocols.discovery.events import PeerAddress
from r2p.protocols.timers import KeyedTimers

_TopicRole = tuple[str, int]


class Demand:
    """Topics by role (ROLE_...), and the sources that publish or subscribe to them: peers, or sessions of zenoh."""

    def __init__(self) -> None:
        self._sources: dict[_TopicRole, dict[Hashable, None]] = {}
        self._changed: set[str] = set()

    def is_published(self, topic: str) -> bool:
        return (topic, ROLE_PUBLISHES) in self._sources

    def is_subscribed(self, topic: str) -> bool:
        return (topic, ROLE_SUBSCRIBES) in self._sources

    def topics(self) -> set[str]:
        return {topic for topic, _ in self._sources}

    def sources_of(self, topic: str, role: int) -> list[Hashable]:
        return list(self._sources.get((topic, role), ()))

    def entries_of(self, source: Hashable) -> list[_TopicRole]:
        """What a source publishes and subscribes to."""
        return [entry for entry, sources in self._sources.items() if source in sources]

    def pop_changed(self) -> set[str]:
        """The topics that got their first source in a role, or lost the last one, since the last call."""
        changed, self._changed = self._changed, set()
        return changed

    def add(self, topic: str, role: int, source: Hashable) -> bool:
        """Enter a source; False if the table is full."""
        sources = self._sources.get((topic, role))
        if sources is None:
            if len(self._sources) >= MOST:
                return False
            sources = self._sources[topic, role] = {}
            self._changed.add(topic)
        if source not in sources and len(sources) >= MOST:
            return False
        sources[source] = None
        return True

    def remove(self, topic: str, role: int, source: Hashable) -> None:
        sources = self._sources.get((topic, role))
        if sources is None:
            return
        sources.pop(source, None)
        if not sources:
            del self._sources[topic, role]
            self._changed.add(topic)


class LeasedDemand(Demand):
    """Demand by management messages: what r2p modules say holds for a lease, what firmware says for good.

    It uses the timers of its discovery, with keys that begin with "demand".
    """

    def __init__(self, timers: KeyedTimers, directory: Directory) -> None:
        super().__init__()
        self._timers = timers
        self._directory = directory
        self._permanent: dict[PeerAddress, dict[_TopicRole, None]] = {}
        """Entries without a lease, by source."""

    def receive(self, now: int, message: management.Management, source: PeerAddress) -> None:
        match message:
            case management.Advertise(topic) | management.SubscribeResponse(topic):
                self._enter(now, topic, ROLE_PUBLISHES, source)
            case management.SubscribeRequest(topic):
                self._enter(now, topic, ROLE_SUBSCRIBES, source)
            case management.Unsubscribe(topic, instance) if self._directory.is_alone(source, instance):
                self.expired(topic, ROLE_SUBSCRIBES, source)
            case management.Hello(_, instance, flags, 0):
                if not flags & management.HELLO_LEAVING:
                    self._start_leases(now, source)
                elif self._directory.is_alone(source, instance):
                    self._source_gone(source)

    def expired(self, topic: str, role: int, source: PeerAddress) -> None:
        """End an entry."""
        self._timers.clear(("demand", topic, role, source))
        permanent = self._permanent.get(source)
        if permanent is not None:
            permanent.pop((topic, role), None)
            if not permanent:
                del self._permanent[source]
        self.remove(topic, role, source)

    def link_down(self) -> None:
        """End all leases. Firmware does not notice that the link is down, so its entries stay."""
        for topic, role in list(self._sources):
            for source in list(self._sources.get((topic, role), ())):
                if ("demand", topic, role, source) in self._timers:
                    self.expired(topic, role, source)

    def _source_gone(self, source: PeerAddress) -> None:
        for topic, role in self.entries_of(source):
            self.expired(topic, role, source)

    def _enter(self, now: int, topic: str, role: int, source: PeerAddress) -> None:
        lease = self._lease(source)  # None also while an r2p module's HELLO has not come: see `_start_leases`
        if not self.add(topic, role, source):
            return
        if lease is not None:
            self._timers.set(("demand", topic, role, source), now + lease)
            self._permanent.get(source, {}).pop((topic, role), None)
        elif ("demand", topic, role, source) not in self._timers:
            self._permanent.setdefault(source, {})[topic, role] = None

    def _start_leases(self, now: int, source: PeerAddress) -> None:
        """What a module said before its first HELLO is a lease, too."""
        lease = self._lease(source) if source in self._permanent else None
        if lease is not None:
            for topic, role in self._permanent.pop(source):
                self._timers.set(("demand", topic, role, source), now + lease)

    def _lease(self, source: PeerAddress) -> int | None:
        lease = self._directory.lease_of(source)
        return lease if lease is not None and lease < FOR_EVER else None
