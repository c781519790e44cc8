"""The announcements of the modules on one link: names, topics and endpoints. Nothing here decides what flows.

Every table is bounded. A full one forgets the entry that was not repeated for longest: a flood of made-up
messages pushes out true entries only until they are repeated.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from typing import TypeVar

import msgspec

from r2p.codecs import management
from r2p.codecs.management import ROLE_PUBLISHES, ROLE_SUBSCRIBES
from r2p.protocols.discovery.events import Event, ModuleInfo, PeerAddress, TableFull, TopicType
from r2p.protocols.discovery.schedule import CROWD, CROWD_ROUNDS, SLOW_ROUNDS
from r2p.protocols.timers import KeyedTimers
from r2p.units import MILLISECOND, NEVER, SECOND

TABLE_MAX = 16_384
"""Entries in each table, unless the link's URL says otherwise."""

LEASE = 5 * SECOND
"""Shortest lease of an r2p module (ns), whatever its HELLO says: some more than three rounds of repetition."""

FOR_EVER = management.LEASE_MS_MAX * MILLISECOND
"""The longest lease of a HELLO (ns): its subscriptions last as long as the module does."""

_UNKNOWN = TopicType()
TopicRole = tuple[str, int]
K = TypeVar("K")
V = TypeVar("V")


class TopicInfo(msgspec.Struct, gc=False):
    """A topic on the link. Instants are in monotonic ns, None: never; `size` is in bytes, 0: unknown, a bound if the
    length `varies`.

    `publisher_type` and `subscriber_type` are what the peers in these roles announce, and `..._typed_at` is when they
    said so last, NEVER: they did not. `size`, `varies` and `fingerprint` are those of the publishers, or of the
    subscribers while publishers have said nothing. `type_name` is what ROS nodes call the type, `package/Name`; empty
    on other links.
    """

    name: str
    size: int = 0
    varies: bool = False
    fingerprint: bytes | None = None
    advertised_at: int | None = None
    requested_at: int | None = None
    mismatch: bool = False
    type_name: str = ""
    publisher_type: TopicType | None = None
    subscriber_type: TopicType | None = None
    publisher_typed_at: int = NEVER
    subscriber_typed_at: int = NEVER

    def type_of(self, role: int) -> TopicType | None:
        """Return the type that the peers in this role announce."""
        return self.publisher_type if role == ROLE_PUBLISHES else self.subscriber_type

    def set_heard(self, role: int, at: int | None) -> None:
        """Set the time of the last message from a peer in this role."""
        if role == ROLE_PUBLISHES:
            self.advertised_at = at
        else:
            self.requested_at = at

    def set_type(self, role: int, known: TopicType | None) -> None:
        """Set the type that the peers in this role announce; None removes it."""
        if role == ROLE_PUBLISHES:
            self.publisher_type = known
        else:
            self.subscriber_type = known
        best = self.publisher_type or self.subscriber_type or _UNKNOWN
        self.size, self.varies = best.size, best.varies
        self.fingerprint = None if best.fingerprint == management.ANY_TYPE else best.fingerprint

    def as_of(self, now: int) -> "TopicInfo":
        """Return a copy of this entry in which all that was heard was heard at `now` (monotonic ns)."""
        info = msgspec.structs.replace(self)
        if info.advertised_at is not None:
            info.advertised_at = now
        if info.requested_at is not None:
            info.requested_at = now
        if info.publisher_typed_at < NEVER:
            info.publisher_typed_at = now
        if info.subscriber_typed_at < NEVER:
            info.subscriber_typed_at = now
        return info

    def set_typed(self, role: int, at: int) -> None:
        """Set when the peers in this role said their type last."""
        if role == ROLE_PUBLISHES:
            self.publisher_typed_at = at
        else:
            self.subscriber_typed_at = at

    def is_typed(self, role: int, at: int) -> bool:
        """Return whether a peer in this role said its type at this very instant."""
        return at == (self.publisher_typed_at if role == ROLE_PUBLISHES else self.subscriber_typed_at)


class EndpointInfo(msgspec.Struct, frozen=True, gc=False):
    """A publisher or subscriber of a node, as announced by its r2p module.

    `module` is empty until the HELLO of this `instance` was received.
    """

    module: str
    instance: int
    node: str
    topic: str
    role: int
    publisher_class: int

    def latches(self, topic: str) -> bool:
        """Return whether the endpoint publishes this topic, and latches it."""
        latches = self.publisher_class & management.CLASS_LATCHES
        return self.topic == topic and self.role == ROLE_PUBLISHES and latches > 0


EndpointKey = tuple[int, str, str, int]


class _Starts(msgspec.Struct):
    """The recent starts under one module name, to distinguish two modules from a restart."""

    previous: int
    at: int
    swaps: int = 0


class Directory:
    """The tables of one link. Each endpoint has a timer, ("endpoint", its key), after which it is forgotten."""

    def __init__(
        self, timers: KeyedTimers, counts: Counter[str], emit: Callable[[Event], object] = lambda _event: None
    ) -> None:
        self.most = TABLE_MAX
        """Entries in each table."""
        self.modules: dict[str, ModuleInfo] = {}
        self.topics: dict[str, TopicInfo] = {}
        self.endpoints: dict[EndpointKey, EndpointInfo] = {}
        self.generation = 0
        """A number that changes when modules or endpoints change."""
        self.timers = timers
        """Timers of everything that lasts for a while on this link."""
        self.counts = counts
        """Counts of what was dropped on this link, by reason."""
        self.is_lossless = False
        """Whether all that is sent arrives, for as long as the link is up."""
        self.has_addresses = False
        """Whether the link can send to one module alone, and loses nothing."""
        self._direct: dict[PeerAddress, dict[str, ModuleInfo]] = {}
        self._leases: dict[PeerAddress, dict[int, int]] = {}  # how many modules have each
        self._names: dict[int, str] = {}
        self._endpoints_of: dict[int, dict[EndpointKey, None]] = {}  # by instance
        self._ends: dict[TopicRole, int] = {}  # how many endpoints each topic has in each role
        self._starts: dict[str, _Starts] = {}
        self._emit = emit
        self._said_full = False
        self._others = 0  # modules on the link itself that do not know crowds: firmware, or r2p of before

    @property
    def r2p_modules(self) -> int:
        """The number of r2p modules known on the link."""
        return len(self._names)

    @property
    def crowd(self) -> int:
        """The number of r2p modules for which topics are repeated slowly; 0: they are repeated in every round.

        There must be many, and all on the link must know crowds. Where nothing is lost, one is as good as many.
        """
        modules = len(self._names)
        if self._others or modules < (1 if self.is_lossless else CROWD):
            return 0
        return max(modules, CROWD_ROUNDS) if self.is_lossless else modules

    def sole_peer(self) -> int | None:
        """The instance of the only r2p module on the link itself, not behind a gateway; None unless there is one."""
        direct = [info.instance for there in self._direct.values() for info in there.values() if info.r2p]
        return direct[0] if len(direct) == 1 else None

    def name_of(self, instance: int) -> str:
        return self._names.get(instance, "")

    def lease_of(self, source: PeerAddress) -> int | None:
        """Return the longest lease of topics of modules at an address; None without any, or if it never ends."""
        lease = max(self._leases.get(source, ()), default=NEVER)
        return lease if lease < NEVER else None

    def lease_end(self, now: int, source: PeerAddress, lease: int) -> int:
        """Return when a topic of an r2p module at this address is over if it is not repeated (ns).

        Where nothing is lost, the module says so itself, and has its own lease: NEVER.
        """
        return NEVER if self.has_addresses and source in self._direct else now + lease

    def is_alone(self, source: PeerAddress, instance: int) -> bool:
        """Return whether no other module than this one is known directly at an address."""
        return all(info.instance == instance for info in self._direct.get(source, {}).values())

    def read_alive(
        self, now: int, message: management.Alive, source: PeerAddress
    ) -> tuple[ModuleInfo | None, ModuleInfo]:
        """Read a module's state; return the previous information and the new one, which is not entered yet."""
        before = self.modules.get(message.module)
        if before is None:
            info = ModuleInfo(message.module, message.flags, now, source=source)
        else:
            info = msgspec.structs.replace(before, flags=message.flags, last_heard=now)
        return before, info

    def read_hello(
        self, now: int, message: management.Hello, source: PeerAddress
    ) -> tuple[ModuleInfo | None, ModuleInfo]:
        """Read an r2p module's HELLO; return the previous information and the new one, which is not entered yet."""
        before = self.modules.get(message.module)
        return before, ModuleInfo(
            name=message.module,
            flags=before.flags if before is not None else 0,
            last_heard=now,
            instance=message.instance,
            observer=bool(message.flags & management.HELLO_TOOL),
            gateway=bool(message.flags & management.HELLO_GATEWAY),
            sole_link=bool(message.flags & management.HELLO_SOLE_LINK),
            lease=lease_in(message),
            hops=message.hops,
            source=source,
            wire=message.wire,
            release=message.release,
        )

    def refresh(self, now: int, info: ModuleInfo, lease: int) -> ModuleInfo:
        """Note that a module lives of which nothing but its lease may have changed (ns); return its new entry."""
        fresh = msgspec.structs.replace(info, last_heard=now, lease=lease)
        del self.modules[info.name]  # to enter it as the last one again
        self.modules[info.name] = fresh
        if lease != info.lease:
            self._forget_direct(info)
            self._enter_direct(fresh)
        elif not info.hops:
            self._direct[info.source][info.name] = fresh
        return fresh

    def enter(self, info: ModuleInfo) -> ModuleInfo | None:
        """Enter a module; return the one that was forgotten for it, if the table was full."""
        before = self.modules.get(info.name)
        if before is not None and before.instance is not None and before.instance != info.instance:
            self._forget_instance(before.instance)  # the endpoints of its last start are gone
        self.generation += before is None or before.differs(info)
        self.modules.pop(info.name, None)  # to enter it as the last one again
        full = len(self.modules) >= self.most
        forgotten = self._pop_first(self.modules, "modules forgotten") if full else None
        self.modules[info.name] = info
        self._forget_direct(before)
        self._forget_direct(forgotten)
        self._enter_direct(info)
        if info.instance is not None:
            is_new = info.instance not in self._names
            self._names[info.instance] = info.name
            for key in self._endpoints_of.get(info.instance, ()) if is_new else ():  # they came before its HELLO
                self._start_lease(info.last_heard, key, info)
        if forgotten is not None:
            self._forget(forgotten)
        return forgotten

    def remove(self, info: ModuleInfo) -> None:
        """Forget a module, and its endpoints with it."""
        known = self.modules.pop(info.name, None)
        if known is not None:
            self._forget_direct(known)
            self.generation += 1
            self._forget(info)

    def count_swaps(self, now: int, before: ModuleInfo | None, instance: int) -> int:
        """Return how often a name has gone back and forth between two instances within a lease.

        Two modules of one name do so with every HELLO; a module that restarts never goes back.
        """
        if before is None or before.instance in {None, instance}:
            return 0
        known = self._starts.get(before.name)
        back = known is not None and known.previous == instance and now - known.at < LEASE
        swaps = known.swaps + 1 if known is not None and back else 0
        self._starts[before.name] = _Starts(before.instance or 0, now, swaps)
        return swaps

    def was_before(self, name: str, instance: int) -> bool:
        """Return whether a module had this instance just before its present one."""
        known = self._starts.get(name)
        return known is not None and known.previous == instance

    def size_of(self, topic: str) -> int:
        """The size field of the topic's messages; 0: unknown."""
        info = self.topics.get(topic)
        return 0 if info is None else management.encode_size(info.size, varies=info.varies)

    def touch_topic(self, name: str) -> TopicInfo:
        """Return the entry of a topic that a message has just named."""
        topics = self.topics
        info = topics.pop(name, None)  # to enter it as the last one again
        if info is None:
            info = TopicInfo(name)
            if len(topics) >= self.most:
                self._pop_first(topics, "topics forgotten")
        topics[name] = info
        return info

    def add_size(self, now: int, topic: str, role: int, size: int) -> TopicInfo:
        """Enter the size field from a peer. Usually its type came just before, and says more than the size."""
        info = self.topics.get(topic)
        known = info.type_of(role) if info is not None and info.is_typed(role, now) else None
        if info is not None and known is not None and known.size_field == size:
            return info
        return self.add_type(now, topic, role, TopicType.announced(size))

    def add_type(self, now: int, topic: str, role: int, said: TopicType) -> TopicInfo:
        """Enter the type from a peer. Of several different ones the first stays, as long as it is repeated."""
        info = self.touch_topic(topic)
        oldest = now - LEASE
        if info.publisher_typed_at < oldest or info.subscriber_typed_at < oldest:
            self._forget_types(info, role, oldest)
        known = info.type_of(role)
        if said == known:  # as almost always
            info.set_typed(role, now)
        elif said == _UNKNOWN:
            pass
        elif known is None:
            info.set_typed(role, now)
            info.set_type(role, said)
        elif not known.covers(said) and known.fits(said):
            if known.fingerprint in {management.ANY_TYPE, said.fingerprint}:
                info.set_typed(role, now)
            info.set_type(role, known.merged(said))
        return info

    def _forget_types(self, info: TopicInfo, said: int, oldest: int) -> None:
        """Forget types that were last announced before `oldest` (ns), as one in the role `said` is announced."""
        for role, at in ((ROLE_PUBLISHES, info.publisher_typed_at), (ROLE_SUBSCRIBES, info.subscriber_typed_at)):
            if at < oldest and (role == said or not self.has_addresses):  # what is said once lasts until the next one
                info.set_typed(role, NEVER)
                info.set_type(role, None)

    def enter_endpoint(self, now: int, message: management.Endpoint) -> None:
        """Enter a publisher or subscriber of a remote node, or forget it if it is gone."""
        instance, node, topic, role = message.instance, message.node, message.topic, message.role
        if role & management.ROLE_GONE:
            self.forget_endpoint((instance, node, topic, role & ~management.ROLE_GONE))
            return
        module = self.name_of(instance)
        self._keep_endpoint(now, EndpointInfo(module, instance, node, topic, role, message.publisher_class))

    def enter_endpoints(
        self,
        instance: int,
        ends: Sequence[TopicRole],
        entries_of: Callable[[str], dict[EndpointKey, EndpointInfo]],
    ) -> bool:
        """Enter endpoints of a module, if all of them are new and need no leases; return whether they were entered.

        `ends` are the topic and the role of each, `entries_of` makes the entries, given the name of the module.
        """
        module = self.modules.get(self.name_of(instance))
        if module is None or module.hops or not self.is_lossless:
            return False
        entries = entries_of(module.name)
        if len(entries) > self.most - len(self.endpoints) or not self.endpoints.keys().isdisjoint(entries):
            return False
        self.endpoints.update(entries)
        self._endpoints_of.setdefault(instance, {}).update(dict.fromkeys(entries))
        for each in ends:
            self._ends[each] = self._ends.get(each, 0) + 1
        self.generation += len(entries)
        return True

    def _keep_endpoint(self, now: int, info: EndpointInfo) -> None:
        key = (info.instance, info.node, info.topic, info.role)
        before = self.endpoints.pop(key, None)  # to enter it as the last one again
        self.generation += before != info
        if before is None:
            end = info.topic, info.role
            self._ends[end] = self._ends.get(end, 0) + 1
            self._endpoints_of.setdefault(info.instance, {})[key] = None
            if len(self.endpoints) >= self.most:
                old = self._pop_first(self.endpoints, "endpoints forgotten")
                self._drop_endpoint((old.instance, old.node, old.topic, old.role))
        self.endpoints[key] = info
        self._start_lease(now, key, self.modules.get(info.module))

    def _start_lease(self, now: int, key: EndpointKey, module: ModuleInfo | None) -> None:
        """Let an endpoint of a known module end if it is not repeated; its end is not lost where nothing is."""
        if module is None:  # its HELLO may never come
            self.timers.set(("endpoint", key), now + LEASE)
        elif module.lease < FOR_EVER and not (self.is_lossless and module.hops == 0):
            rounds = CROWD_ROUNDS if module.knows_crowds else SLOW_ROUNDS
            self.timers.set(("endpoint", key), now + rounds * module.lease)
        elif ("endpoint", key) in self.timers:
            self.timers.clear(("endpoint", key))

    def set_lossless(self, now: int, *, lossless: bool, has_addresses: bool) -> None:
        """Note whether all that is sent arrives, and whether it can be sent to one module alone."""
        was_lossless, self.is_lossless = self.is_lossless, lossless
        self.has_addresses = has_addresses
        if was_lossless and not lossless:
            for key, info in self.endpoints.items():
                self._start_lease(now, key, self.modules.get(info.module))

    def rename(self, now: int, kind: int, old: str, new: str) -> None:
        """Rename a topic or a node (KIND_...) from its alias to the name behind it, or back."""
        if kind == management.KIND_TOPIC and (info := self.topics.pop(old, None)) is not None:
            info.name = new
            self.topics.setdefault(new, info)
        field = "topic" if kind == management.KIND_TOPIC else "node"
        for key, endpoint in list(self.endpoints.items()):
            if getattr(endpoint, field) == old:
                self._keep_endpoint(now, msgspec.structs.replace(endpoint, **{field: new}))
                self.forget_endpoint(key)

    def forget_endpoint(self, key: EndpointKey) -> None:
        if self.endpoints.pop(key, None) is not None:
            self.generation += 1
            self._drop_endpoint(key)

    def _drop_endpoint(self, key: EndpointKey) -> None:
        """Forget everything of an endpoint that has left the table."""
        self.timers.clear(("endpoint", key))
        instance, _, topic, role = key
        if decrement(self._ends, (topic, role)) and self.has_addresses and (info := self.topics.get(topic)):
            info.set_typed(role, NEVER)  # the next type is said once, too
            info.set_type(role, None)
        keys = self._endpoints_of[instance]
        del keys[key]
        if not keys:
            del self._endpoints_of[instance]

    def _pop_first(self, table: dict[K, V], reason: str) -> V:
        """Make room: forget, and return, the entry that was not repeated for longest. A dict keeps the order."""
        forgotten = table.pop(next(iter(table)))
        self.note_forgotten(reason)
        return forgotten

    def note_forgotten(self, reason: str) -> None:
        """Count an entry for which there was no room, and report the first one."""
        self.counts[reason] += 1
        if not self._said_full:
            self._said_full = True
            self._emit(TableFull(self.most))

    def _enter_direct(self, info: ModuleInfo) -> None:
        if info.hops == 0:
            self._direct.setdefault(info.source, {})[info.name] = info
            self._others += not info.knows_crowds
            if info.r2p:
                leases, lease = self._leases.setdefault(info.source, {}), topic_lease(info)
                leases[lease] = leases.get(lease, 0) + 1

    def _forget_direct(self, info: ModuleInfo | None) -> None:
        if info is None or info.hops:
            return
        there = self._direct[info.source]
        del there[info.name]
        self._others -= not info.knows_crowds
        if not there:
            del self._direct[info.source]
        if info.r2p:
            leases = self._leases[info.source]
            if decrement(leases, topic_lease(info)) and not leases:
                del self._leases[info.source]

    def _forget(self, info: ModuleInfo) -> None:
        self._starts.pop(info.name, None)
        if info.instance is not None:
            self._forget_instance(info.instance)

    def _forget_instance(self, instance: int) -> None:
        self._names.pop(instance, None)
        for key in list(self._endpoints_of.get(instance, ())):
            self.forget_endpoint(key)


def lease_in(message: management.Hello) -> int:
    """Return how long an r2p module may be silent after this HELLO (ns)."""
    return max(LEASE, message.lease_ms * MILLISECOND)


def topic_lease(info: ModuleInfo) -> int:
    """Return how long a topic is kept that its r2p module does not repeat (ns), or NEVER; it ends with the module."""
    if info.lease >= FOR_EVER:
        return NEVER
    return info.lease * CROWD_ROUNDS if info.knows_crowds else info.lease


def counterpart(role: int) -> int:
    """Return the role at the other end of a topic."""
    return ROLE_SUBSCRIBES if role == ROLE_PUBLISHES else ROLE_PUBLISHES


def decrement(counter: dict[K, int], key: K) -> bool:
    """Count one less of a key, and remove it with the last one; return whether this was the last one."""
    counter[key] -= 1
    if counter[key]:
        return False
    del counter[key]
    return True
