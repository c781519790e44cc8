"""The topics of other modules on one link, for gateways: whether the module itself uses them or not."""

from collections.abc import Hashable, Iterator, Mapping
from typing import Any

from r2p.codecs import management
from r2p.codecs.management import ROLE_PUBLISHES, ROLE_SUBSCRIBES
from r2p.protocols.discovery.directory import LEASE, TABLE_MAX, Directory
from r2p.protocols.discovery.events import PeerAddress

_TopicRole = tuple[str, int]
_NONE: Mapping[Any, Any] = {}


class Demand:
    """Topics by role (ROLE_...), and the sources that publish or subscribe to them: peers, or sessions of zenoh."""

    def __init__(self, most: int = TABLE_MAX) -> None:
        """`most` topics are kept, and so many sources of each."""
        self._most = most
        self._sources: dict[_TopicRole, dict[Any, Any]] = {}
        self._changed: set[str] = set()

    def __contains__(self, entry: _TopicRole) -> bool:
        return entry in self._sources

    def __iter__(self) -> Iterator[_TopicRole]:
        return iter(self._sources)

    def is_published(self, topic: str) -> bool:
        return (topic, ROLE_PUBLISHES) in self._sources

    def is_subscribed(self, topic: str) -> bool:
        return (topic, ROLE_SUBSCRIBES) in self._sources

    def topics(self) -> set[str]:
        return {topic for topic, _ in self._sources}

    def sources_of(self, topic: str, role: int) -> Mapping[Any, Any]:
        """Return the sources of a topic in a role, with what was entered for each."""
        return self._sources.get((topic, role), _NONE)

    def entries_of(self, source: Hashable) -> list[_TopicRole]:
        """Return what a source publishes and subscribes to."""
        return [entry for entry, sources in self._sources.items() if source in sources]

    def pop_changed(self) -> set[str]:
        """Return the topics that got their first source in a role, or lost the last one, since the last call."""
        changed, self._changed = self._changed, set()
        return changed

    def add(self, topic: str, role: int, source: Hashable, value: object = None) -> bool:
        """Enter a source, and a value for it; return False if the table is full."""
        sources = self._sources.get((topic, role))
        if sources is None:
            if len(self._sources) >= self._most:
                return False
            sources = self._sources[topic, role] = {}
            self._changed.add(topic)
        if source not in sources and len(sources) >= self._most:
            return False
        sources[source] = value
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
    """Demand by management messages: of r2p modules for a lease, of firmware for good.

    It uses the timers of its discovery, with keys that begin with "demand".
    """

    def __init__(self, directory: Directory) -> None:
        super().__init__(directory.most)
        self._timers = directory.timers
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
                    for topic, role in self.entries_of(source):
                        self.expired(topic, role, source)

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

    def _enter(self, now: int, topic: str, role: int, source: PeerAddress) -> None:
        # None also before the HELLO of an r2p module: see `_start_leases`.
        lease = self._directory.lease_of(source)
        if not self.add(topic, role, source):
            self._directory.counts["topics not forwarded"] += 1
            return
        if lease is not None:
            self._set_timer(now, topic, role, source, lease)
            self._permanent.get(source, {}).pop((topic, role), None)
        elif ("demand", topic, role, source) not in self._timers:
            self._permanent.setdefault(source, {})[topic, role] = None

    def rename(self, now: int, old: str, new: str) -> None:
        """Move the sources of a topic from its alias to the name behind it, or back."""
        for role in (ROLE_PUBLISHES, ROLE_SUBSCRIBES):
            for source in list(self.sources_of(old, role)):
                self.expired(old, role, source)
                self._enter(now, new, role, source)

    def _start_leases(self, now: int, source: PeerAddress) -> None:
        """Make leases of a module's entries before its first HELLO, too."""
        lease = self._directory.lease_of(source) if source in self._permanent else None
        if lease is not None:
            for topic, role in self._permanent.pop(source):
                self._set_timer(now, topic, role, source, lease)

    def start_leases(self, now: int) -> None:
        """Let all entries of r2p modules end that are not repeated, as something may be lost from now on."""
        for topic, role in self._sources:
            for source in self.sources_of(topic, role):
                if ("demand", topic, role, source) in self._timers:
                    self._set_timer(now, topic, role, source, self._directory.lease_of(source) or LEASE)

    def module_gone(self, source: PeerAddress) -> None:
        """End what has no lease, at an address where no r2p module is left."""
        if not self._directory.has_addresses:
            return
        for topic, role in self.entries_of(source):
            if ("demand", topic, role, source) in self._timers:
                self.expired(topic, role, source)

    def _set_timer(self, now: int, topic: str, role: int, source: PeerAddress, lease: int) -> None:
        self._timers.set(("demand", topic, role, source), self._directory.lease_end(now, source, lease))
