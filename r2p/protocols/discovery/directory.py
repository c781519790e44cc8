"""What one link told about the network: modules, topics, endpoints. Nothing here decides what flows.

Every table is bounded: when it is full, what was not heard for longest is forgotten, so that lies on the wire push out
the truth only until it is repeated.
"""

from collections import Counter
from typing import TypeVar

import msgspec

from r2p.codecs import management
from r2p.protocols.discovery.events import ModuleInfo, PeerAddress, TopicType
from r2p.protocols.discovery.schedule import SELDOM
from r2p.protocols.timers import KeyedTimers

MOST = 4096
"""Entries in each table."""

LEASE = 5_000_000_000
"""How long an r2p module may be silent at least (ns)."""

FOR_EVER = 0xFFFF * 1_000_000
"""The longest lease of a HELLO (ns): its subscriptions last as long as the module does."""

K = TypeVar("K")
V = TypeVar("V")


class TopicInfo(msgspec.Struct):
    """A topic as heard on the link. Instants are in monotonic ns, None: never; `size` in bytes, 0: not said.

    `shapes` are its type by the role of those who said it; `size` and `fingerprint` are the publishers', if they did.
    """

    name: str
    size: int = 0
    fingerprint: bytes | None = None
    advertised_at: int | None = None
    requested_at: int | None = None
    mismatch: bool = False
    shapes: dict[int, TopicType] = {}
    typed_at: dict[int, int] = {}

    def typed(self, role: int, shape: TopicType | None) -> None:
        """Those in this role say so; None: there is nobody any more."""
        if shape is None:
            self.shapes.pop(role, None)
        else:
            self.shapes[role] = shape
        best = self.shapes.get(management.ROLE_PUBLISHES) or self.shapes.get(management.ROLE_SUBSCRIBES, TopicType())
        self.size = best.size
        self.fingerprint = None if best.fingerprint == management.ANY_TYPE else best.fingerprint


class EndpointInfo(msgspec.Struct, frozen=True):
    """A publisher or subscriber of a node, as its r2p module tells; `module` is empty until its HELLO was heard."""

    module: str
    instance: int
    node: str
    topic: str
    role: int
    publisher_class: int

    def latches(self, topic: str) -> bool:
        """Whether it publishes the topic, and latches it."""
        latches = self.publisher_class & management.CLASS_LATCHES
        return self.topic == topic and self.role == management.ROLE_PUBLISHES and latches > 0


EndpointKey = tuple[int, str, str, int]


class _Starts(msgspec.Struct):
    """The recent starts of one module name, to tell two modules from one that restarts."""

    previous: int
    at: int
    swaps: int = 0


class Directory:
    """The tables of one link. Each endpoint has a timer, ("endpoint", its key): it is believed for that long."""

    def __init__(self, timers: KeyedTimers, counts: Counter[str]) -> None:
        self.modules: dict[str, ModuleInfo] = {}
        self.topics: dict[str, TopicInfo] = {}
        self.endpoints: dict[EndpointKey, EndpointInfo] = {}
        self.generation = 0
        """Another number means that modules or endpoints have changed."""
        self._timers = timers
        self._counts = counts
        self.ends: dict[str, int] = {}
        """The instances of the r2p modules on the link itself, not behind a gateway."""
        self._direct: dict[PeerAddress, dict[str, ModuleInfo]] = {}
        self._leases: dict[PeerAddress, Counter[int]] = {}
        self._names: dict[int, str] = {}
        self._endpoints_of: dict[int, dict[EndpointKey, None]] = {}  # by instance
        self._starts: dict[str, _Starts] = {}

    @property
    def knows_r2p(self) -> bool:
        """Whether any r2p module is known on the link."""
        return bool(self._names)

    @property
    def r2p_modules(self) -> int:
        """How many r2p modules are known on the link."""
        return len(self._names)

    def name_of(self, instance: int) -> str:
        return self._names.get(instance, "")

    def lease_of(self, source: PeerAddress) -> int | None:
        """The longest lease of the r2p modules that speak from an address themselves; None: there are none."""
        return max(self._leases.get(source, ()), default=None)

    def speaks_alone(self, source: PeerAddress, instance: int) -> bool:
        """Whether no other module than this one is known to speak from an address itself."""
        return all(info.instance == instance for info in self._direct.get(source, {}).values())

    def alive(self, now: int, message: management.Alive, source: PeerAddress) -> tuple[ModuleInfo | None, ModuleInfo]:
        """A module's state: what was known before, and what is known now."""
        before = self.modules.get(message.module)
        if before is None:
            info = ModuleInfo(message.module, message.flags, now, source=source)
        else:
            info = msgspec.structs.replace(before, flags=message.flags, last_heard=now)
        return before, info

    def hello(self, now: int, message: management.Hello, source: PeerAddress) -> tuple[ModuleInfo | None, ModuleInfo]:
        """An r2p module: what was known before, and what is known now."""
        before = self.modules.get(message.module)
        return before, ModuleInfo(
            name=message.module,
            flags=before.flags if before is not None else 0,
            last_heard=now,
            instance=message.instance,
            observer=bool(message.flags & management.HELLO_TOOL),
            lease=max(LEASE, message.lease_ms * 1_000_000),
            hops=message.hops,
            source=source,
        )

    def keep(self, info: ModuleInfo) -> ModuleInfo | None:
        """Enter a module; who had to be forgotten for it comes back."""
        before = self.modules.get(info.name)
        if before is not None and before.instance is not None and before.instance != info.instance:
            self._forget_instance(before.instance)
        self.generation += before is None or _who(before) != _who(info)
        forgotten = self._put(self.modules, info.name, info, "modules forgotten")
        self._forget_direct(before)
        self._forget_direct(forgotten)
        self._enter_direct(info)
        if info.instance is not None:
            self._names[info.instance] = info.name
        if info.instance is not None and not info.hops:
            self.ends[info.name] = info.instance
        else:
            self.ends.pop(info.name, None)
        if forgotten is not None:
            self._forget(forgotten)
        return forgotten

    def remove(self, info: ModuleInfo) -> None:
        """A module is gone, and its endpoints with it."""
        known = self.modules.pop(info.name, None)
        if known is not None:
            self._forget_direct(known)
            self.generation += 1
            self._forget(info)

    def count_swaps(self, now: int, before: ModuleInfo | None, instance: int) -> int:
        """How often a name went back and forth between two instances within a lease; a restart does not go back."""
        if before is None or before.instance in {None, instance}:
            return 0
        known = self._starts.get(before.name)
        back = known is not None and known.previous == instance and now - known.at < LEASE
        swaps = known.swaps + 1 if known is not None and back else 0
        self._starts[before.name] = _Starts(before.instance or 0, now, swaps)
        return swaps

    def was(self, name: str, instance: int) -> bool:
        """Whether the module had this instance just before its present one."""
        known = self._starts.get(name)
        return known is not None and known.previous == instance

    def size_of(self, topic: str) -> int:
        """Bytes of the topic's messages; 0: not heard yet."""
        info = self.topics.get(topic)
        return 0 if info is None else info.size

    def topic(self, name: str) -> TopicInfo:
        """The entry of a topic that was just heard of."""
        info = self.topics.get(name) or TopicInfo(name)
        self._put(self.topics, name, info, "topics forgotten")
        return info

    def typed(self, now: int, topic: str, role: int, shape: TopicType) -> TopicInfo:
        """The type of a topic. Of several that differ the first one stays, as long as it is repeated."""
        info = self.topic(topic)
        for each, at in list(info.typed_at.items()):
            if now > at + LEASE:
                del info.typed_at[each]
                info.typed(each, None)
        known = info.shapes.get(role, TopicType())
        if shape != TopicType() and known.fits(shape):
            if known.fingerprint in {management.ANY_TYPE, shape.fingerprint}:
                info.typed_at[role] = now
            info.typed(role, known.joined(shape))
        return info

    def endpoint(self, now: int, message: management.Endpoint) -> None:
        """A publisher or subscriber of a remote node is there, or gone."""
        role = message.role & ~management.ROLE_GONE
        key = (message.instance, message.node, message.topic, role)
        if message.role & management.ROLE_GONE:
            self.forget_endpoint(key)
            return
        module = self.name_of(message.instance)
        info = EndpointInfo(module, message.instance, message.node, message.topic, role, message.publisher_class)
        self.generation += self.endpoints.get(key) != info
        old = self._put(self.endpoints, key, info, "endpoints forgotten")
        self._endpoints_of.setdefault(message.instance, {})[key] = None
        if old is not None:
            self._drop_endpoint((old.instance, old.node, old.topic, old.role))
        known = self.modules.get(module)
        if known is None:  # a stranger, who may never say hello
            self._timers.set(("endpoint", key), now + LEASE)
        elif known.lease < FOR_EVER:
            self._timers.set(("endpoint", key), now + SELDOM * known.lease)
        else:
            self._timers.clear(("endpoint", key))

    def forget_endpoint(self, key: EndpointKey) -> None:
        if self.endpoints.pop(key, None) is not None:
            self.generation += 1
            self._drop_endpoint(key)

    def _drop_endpoint(self, key: EndpointKey) -> None:
        """It is not in the table any more."""
        self._timers.clear(("endpoint", key))
        keys = self._endpoints_of[key[0]]
        del keys[key]
        if not keys:
            del self._endpoints_of[key[0]]

    def forget_endpoints(self) -> None:
        for key in list(self.endpoints):
            self.forget_endpoint(key)

    def _put(self, table: dict[K, V], key: K, value: V, reason: str) -> V | None:
        """Enter a value as the latest heard one; what had to go for it comes back."""
        table.pop(key, None)
        forgotten = None
        if len(table) >= MOST:
            forgotten = table.pop(next(iter(table)))
            self._counts[reason] += 1
        table[key] = value
        return forgotten

    def _enter_direct(self, info: ModuleInfo) -> None:
        if info.hops == 0:
            self._direct.setdefault(info.source, {})[info.name] = info
            if info.r2p:
                self._leases.setdefault(info.source, Counter())[info.lease] += 1

    def _forget_direct(self, info: ModuleInfo | None) -> None:
        if info is None or info.hops:
            return
        there = self._direct[info.source]
        del there[info.name]
        if not there:
            del self._direct[info.source]
        if info.r2p:
            leases = self._leases[info.source]
            leases[info.lease] -= 1
            if not leases[info.lease]:
                del leases[info.lease]
            if not leases:
                del self._leases[info.source]

    def _forget(self, info: ModuleInfo) -> None:
        self._starts.pop(info.name, None)
        self.ends.pop(info.name, None)
        if info.instance is not None:
            self._forget_instance(info.instance)

    def _forget_instance(self, instance: int) -> None:
        self._names.pop(instance, None)
        for key in list(self._endpoints_of.get(instance, ())):
            self.forget_endpoint(key)


def _who(info: ModuleInfo) -> tuple[object, ...]:
    return (info.instance, info.observer, info.source, info.flags, info.hops)
