"""Who on a link publishes and who wants which topic, whether this module has anything to do with it or not.

Discovery answers for what its own module has; a gateway has nothing of its own, and must know what others offer and
want. Only gateways keep this.
"""

from collections.abc import Hashable

from r2p.codecs import management
from r2p.codecs.management import ROLE_PUBLISHES, ROLE_SUBSCRIBES
from r2p.protocols.discovery.directory import FOR_EVER, MOST, Directory
from r2p.protocols.discovery.events import PeerAddress
from r2p.protocols.timers import KeyedTimers

_Entry = tuple[str, int]


class Demand:
    """Topics and roles, and who told of them."""

    def __init__(self) -> None:
        self._who: dict[_Entry, dict[Hashable, None]] = {}
        self._changed: set[str] = set()

    def is_published(self, topic: str) -> bool:
        """Whether somebody publishes it."""
        return (topic, ROLE_PUBLISHES) in self._who

    def is_subscribed(self, topic: str) -> bool:
        """Whether somebody subscribes it."""
        return (topic, ROLE_SUBSCRIBES) in self._who

    def sources_of(self, topic: str, role: int) -> list[Hashable]:
        """Those who told so."""
        return list(self._who.get((topic, role), ()))

    def pop_changed(self) -> set[str]:
        """The topics of which this has changed since the last call."""
        changed, self._changed = self._changed, set()
        return changed

    def topics(self) -> set[str]:
        return {topic for topic, _ in self._who}

    def add(self, topic: str, role: int, who: Hashable) -> bool:
        """Somebody publishes or subscribes (ROLE_...) the topic; False if there is no place for one more."""
        tellers = self._who.get((topic, role))
        if tellers is None:
            if len(self._who) >= MOST:
                return False
            tellers = self._who[topic, role] = {}
            self._changed.add(topic)
        if who not in tellers and len(tellers) >= MOST:
            return False
        tellers[who] = None
        return True

    def remove(self, topic: str, role: int, who: Hashable) -> None:
        """He does not any more."""
        tellers = self._who.get((topic, role))
        if tellers is None:
            return
        tellers.pop(who, None)
        if not tellers:
            del self._who[topic, role]
            self._changed.add(topic)

    def entries_of(self, who: Hashable) -> list[_Entry]:
        """What he told."""
        return [entry for entry, tellers in self._who.items() if who in tellers]


class LeasedDemand(Demand):
    """Demand as management messages tell it: of r2p modules for a lease, of firmware for good.

    It uses the timers of its discovery, with keys that begin with "demand".
    """

    def __init__(self, timers: KeyedTimers, directory: Directory) -> None:
        super().__init__()
        self._timers = timers
        self._directory = directory
        self._lasting: dict[PeerAddress, dict[_Entry, None]] = {}
        """What was told without a lease, by who told it."""

    def heard(self, now: int, message: management.Management, source: PeerAddress) -> None:
        """A management message."""
        match message:
            case management.Advertise(topic) | management.SubscribeResponse(topic):
                self._enter(now, topic, ROLE_PUBLISHES, source)
            case management.SubscribeRequest(topic):
                self._enter(now, topic, ROLE_SUBSCRIBES, source)
            case management.Unsubscribe(topic, instance) if self._alone(source, instance):
                self.expired(topic, ROLE_SUBSCRIBES, source)
            case management.Hello(_, instance, flags, 0):
                if not flags & management.HELLO_LEAVING:
                    self._renew(now, source)
                elif self._alone(source, instance):
                    self.left(source)

    def expired(self, topic: str, role: int, source: PeerAddress) -> None:
        """The lease of an entry is over."""
        self._timers.clear(("demand", topic, role, source))
        lasting = self._lasting.get(source)
        if lasting is not None:
            lasting.pop((topic, role), None)
            if not lasting:
                del self._lasting[source]
        self.remove(topic, role, source)

    def left(self, source: PeerAddress) -> None:
        for topic, role in self.entries_of(source):
            self.expired(topic, role, source)

    def interrupted(self) -> None:
        """The link is down: leases end, firmware does not notice."""
        for topic, role in list(self._who):
            for source in list(self._who.get((topic, role), ())):
                if ("demand", topic, role, source) in self._timers:
                    self.expired(topic, role, source)

    def _enter(self, now: int, topic: str, role: int, source: PeerAddress) -> None:
        lease = self._lease(source)
        if not self.add(topic, role, source):
            return
        if lease is not None:
            self._timers.set(("demand", topic, role, source), now + lease)
            self._lasting.get(source, {}).pop((topic, role), None)
        elif ("demand", topic, role, source) not in self._timers:
            self._lasting.setdefault(source, {})[topic, role] = None

    def _renew(self, now: int, source: PeerAddress) -> None:
        """What was heard before the first HELLO is a lease, too."""
        lease = self._lease(source) if source in self._lasting else None
        if lease is not None:
            for topic, role in self._lasting.pop(source):
                self._timers.set(("demand", topic, role, source), now + lease)

    def _lease(self, source: PeerAddress) -> int | None:
        lease = self._directory.lease_of(source)
        return lease if lease is not None and lease < FOR_EVER else None

    def _alone(self, source: PeerAddress, instance: int) -> bool:
        """Whether nobody else speaks from this address, as far as that is known."""
        return self._directory.speaks_alone(source, instance)
