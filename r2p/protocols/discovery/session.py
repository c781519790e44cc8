"""The interface of discovery to its link, and `Discovery` by management messages (PROTOCOL.md 4 and 9).

`Discovery` finds peers by messages that it repeats, `r2p.protocols.liveliness.session.LivelinessDiscovery` by the
liveliness tokens of a zenoh network. A link drives both alike: it hands over its module's topics and received messages,
and acts on the returned events.

The protocol of management messages keeps no connections: everything is announced again and again, every request is
answered every time, and no single message matters. `Announcer` announces this module's topics,
`SubscriptionNegotiation` answers offers and requests of peers, `PeerLiveness` reports modules that join and leave, and
`Directory` remembers their announcements, and `LinkNames` translates names that are too long for messages. `Discovery`
gives each received message to the part that handles it, and calls the parts at their deadlines.
"""

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Hashable, Mapping
from typing import Any, TypeVar

from r2p.codecs import UnknownType, management
from r2p.codecs.management import ANY_TYPE, KIND_TOPIC, NO_PARAMS, QUEUE, ROLE_PUBLISHES, ROLE_SUBSCRIBES
from r2p.errors import DecodeError
from r2p.names import module_alias
from r2p.protocols.discovery.aliases import LinkNames
from r2p.protocols.discovery.announcer import Announcer, LocalTopic, Relayed
from r2p.protocols.discovery.directory import (
    Demand,
    Directory,
    EndpointInfo,
    EndpointKey,
    LeasedDemand,
    TopicInfo,
    counterpart,
)
from r2p.protocols.discovery.events import (
    COMMAND_OF_TYPE,
    MESSAGE_OF_COMMAND,
    Command,
    CommandDenied,
    CommandReceived,
    ConnectionDenied,
    Event,
    ModuleInfo,
    Outbox,
    PeerAddress,
    TopicType,
)
from r2p.protocols.discovery.liveness import PeerLiveness
from r2p.protocols.discovery.negotiation import SubscriptionNegotiation
from r2p.protocols.discovery.schedule import ItemKind, Schedule
from r2p.protocols.timers import KeyedTimers
from r2p.units import SECOND

D = TypeVar("D", bytes, str)
M = TypeVar("M")

_SUSPENDED = SECOND
"""Ns by which `poll` is late only when this program did not run: its computer slept, or a debugger held it."""
_CONNECTION_DENIED = (
    management.DENIED_CLIENTS,
    management.DENIED_GATEWAYS,
    management.DENIED_NO_KEY,
    management.DENIED_OTHER_KEY,
)
"""Reasons for which a connection is denied, not an order."""
_HEARD_AGAIN = 2 * SECOND
"""Ns in which every live peer repeats itself."""


class DiscoveryProtocol(ABC):
    """The modules, topics and subscriptions of one link.

    Every method that takes `now` (monotonic ns) returns the events to act on, in order. Call `poll` at
    `next_deadline()`, which may have changed after each call. `counts` is the counter to use, for an owner that watches
    it.
    """

    flags: int
    """Flags of this module: FLAG_... of ALIVE."""
    counts: Counter[str]
    """Received messages that were dropped, by reason."""
    modules: dict[str, ModuleInfo]
    """The other modules by name. One of this module's own name is another module with the same name."""
    topics: dict[str, TopicInfo]
    """The topics of the other modules, by name."""
    endpoints: dict[EndpointKey, EndpointInfo]
    """The publishers and subscribers of remote nodes, by instance, node, topic and role."""

    def __init__(self, module: str, instance: int, counts: Counter[str] | None, names: LinkNames) -> None:
        self.flags = 0
        self.is_gateway = False
        """True once this module is announced as a gateway."""
        self.counts = Counter() if counts is None else counts
        self._module = module
        self._instance = instance
        self._outbox = Outbox(names.to_wire)

    def is_booting(self, module: str) -> bool:
        """Return whether a module is in boot mode, where a STOP does lasting harm."""
        info = self.modules.get(module)
        return info is not None and bool(info.flags & management.FLAG_BOOT)

    @property
    def sole_peer(self) -> int | None:
        """The instance of the only r2p module on the link itself; None unless there is one, and just one."""
        return None

    def address_of(self, instance: int) -> PeerAddress:
        """Return the address of an r2p module on the link itself; None if it is not known, or behind a gateway."""
        return None

    def set_lossless(self, now: int, *, lossless: bool = True, addresses: bool = False) -> list[Event]:
        """Note whether all that is sent arrives, for as long as the link is up: then little needs to be repeated.

        `addresses`: the link can also send to one module alone, so that one who asks is answered alone. Nothing is to
        be done where nothing is repeated, anyway.
        """
        return []

    def refresh_ages(self, now: int) -> None:
        """Bring the times at which things were heard up to date, before they are read.

        Nothing is to be done where they are noted as messages come.
        """

    @property
    @abstractmethod
    def generation(self) -> int:
        """A number that changes with `modules` and `endpoints`, except for their `last_heard`."""

    @abstractmethod
    def demand(self) -> Demand:
        """Return what the other modules publish and subscribe to, for gateways."""

    @abstractmethod
    def publisher_type(self, topic: str, module: str) -> TopicType:
        """Return the type in which a module (empty: any) publishes a topic, if only one is possible."""

    # Names

    def alias(self, topic: str) -> str:
        """Return what travels on this link for the name of a topic: the name itself, or its alias."""
        return topic

    def topic_behind(self, alias: str) -> str:
        """Return the topic that an alias stands for; the alias itself if that is a name, or is not known."""
        return alias

    def module_behind(self, alias: str) -> str:
        """Return the module that an alias stands for; the alias itself if that is a name, or is not known."""
        return alias

    def other_module(self, name: str) -> str:
        """Return another module that has the same alias; empty without one."""
        return ""

    def claim(self, topic: str) -> list[Event]:
        """Use the name of a topic on this link, before anything is announced about it."""
        return []

    def release(self, topic: str) -> list[Event]:
        """Stop using the name of a topic."""
        return []

    def topics_with_alias(self, alias: str) -> set[str]:
        """Return the known topics with this alias; if there are several, this link can't distinguish them."""
        return set()

    def rival(self, topic: str) -> str:
        """Return the other name with the alias of this topic, so that the link can't carry it; empty: it can."""
        return ""

    # What this module has

    @abstractmethod
    def set_flags(self, now: int, flags: int) -> list[Event]:
        """Announce a new state of this module at once: FLAG_... of ALIVE."""

    def advertise(
        self,
        now: int,
        topic: str,
        size: int,
        fingerprint: bytes = ANY_TYPE,
        params: bytes = NO_PARAMS,
        *,
        varies: bool = False,
    ) -> list[Event]:
        """Publish a topic: messages of `size` bytes (0: not known yet); of at most so many, if their length `varies`.

        `params` are the transport's.
        """
        return self._set_topic(now, topic, ROLE_PUBLISHES, LocalTopic(TopicType(size, fingerprint, varies), params))

    def withdraw(self, now: int, topic: str) -> list[Event]:
        """End the publication of a topic: its remote subscribers are gone."""
        return self._remove_topic(now, topic, ROLE_PUBLISHES)

    def subscribe(
        self,
        now: int,
        topic: str,
        size: int = 0,
        queue: int = QUEUE,
        fingerprint: bytes = ANY_TYPE,
        *,
        varies: bool = False,
        accepted: tuple[TopicType, ...] = (),
    ) -> list[Event]:
        """Subscribe to a topic; size 0 and no fingerprint take every type, or those that are `accepted`.

        `queue`: how many messages a publisher may have on the way to this module. Management messages bound it by what
        firmware has memory for (`queue_length`); for tokens 0 is any number, as the module would rather lose some.
        """
        own = LocalTopic(TopicType(size, fingerprint, varies, accepted), queue=queue)
        return self._set_topic(now, topic, ROLE_SUBSCRIBES, own)

    def unsubscribe(self, now: int, topic: str) -> list[Event]:
        """End the subscription of a topic: its remote publishers are gone."""
        return self._remove_topic(now, topic, ROLE_SUBSCRIBES)

    @abstractmethod
    def add_endpoint(self, now: int, node: str, topic: str, role: int, publisher_class: int = 0) -> list[Event]:
        """Announce that a node publishes or subscribes to (ROLE_...) a topic, as CLASS_..."""

    @abstractmethod
    def remove_endpoint(self, now: int, node: str, topic: str, role: int) -> list[Event]:
        """Announce that a node's publisher or subscriber has ended."""

    def announce_gateway(self) -> None:
        """Announce from now on that this module is a gateway; for networks where messages do not name their sender."""
        self.is_gateway = True

    # What users and gateways ask for

    def command(self, now: int, command: Command, module: str) -> list[Event]:
        """Command a module to stop, to reboot or to enter its loader."""
        self._outbox.send(MESSAGE_OF_COMMAND[command](module), urgent=True)
        return self._outbox.drain()

    @abstractmethod
    def query(self, now: int) -> list[Event]:
        """Ask all modules to repeat what they publish and subscribe to."""

    @abstractmethod
    def report_conflict(self, now: int, module: str, instance_a: int, instance_b: int) -> list[Event]:
        """Report that two modules, which don't hear each other, have one name."""

    @abstractmethod
    def relay(self, now: int, message: Relayed) -> list[Event]:
        """Pass on the message of a module on another link of this gateway."""

    # The link

    @abstractmethod
    def link_up(self, now: int) -> list[Event]:
        """Start: the other end, or the network, can be reached."""

    @abstractmethod
    def link_down(self, now: int) -> list[Event]:
        """Forget what ends with the connection: it was lost, and may come back."""

    @abstractmethod
    def leave(self, now: int) -> list[Event]:
        """Say good-bye. Nothing is sent after it."""

    @abstractmethod
    def next_deadline(self) -> int | None:
        """Return when to call `poll` (monotonic ns); a time in the past means at once."""

    @abstractmethod
    def poll(self, now: int) -> list[Event]:
        """Do what is due."""

    @abstractmethod
    def receive(self, now: int, data: bytes, source: PeerAddress = None) -> list[Event]:
        """Handle a management message from `source`. Bad bytes are counted, and raise nothing."""

    @abstractmethod
    def _set_topic(self, now: int, topic: str, role: int, own: LocalTopic) -> list[Event]:
        """Announce that this module publishes or subscribes to a topic."""

    @abstractmethod
    def _remove_topic(self, now: int, topic: str, role: int) -> list[Event]:
        """Stop announcing that."""

    def _decode(self, decode: Callable[[D], M], data: D) -> M | None:
        """Decode a message or a token; None for one that is counted."""
        try:
            return decode(data)
        except DecodeError as error:
            self._count_undecodable(error)
        return None

    def _count_undecodable(self, error: DecodeError) -> None:
        self.counts["unknown type" if isinstance(error, UnknownType) else "undecodable"] += 1

    def _commanded(self, now: int, message: management.Order, source: PeerAddress) -> None:
        if message.module == module_alias(self._module):
            self._outbox.emit(CommandReceived(COMMAND_OF_TYPE[management.order_type(message)]))

    def _denied(self, now: int, message: management.Denied, source: PeerAddress) -> None:
        if message.order in COMMAND_OF_TYPE:
            command = COMMAND_OF_TYPE[message.order]
            gateway = self.module_behind(message.gateway)
            self._outbox.emit(CommandDenied(gateway, command, message.module, message.reason))


class Discovery(DiscoveryProtocol):
    """The management protocol of one link.

    `rate` is the number of management messages a second, at most, that were not asked for, `burst` the number of them
    that may go at once. An `observer` sends no ALIVE. `aliases` are those chosen for topics.
    """

    def __init__(
        self,
        module: str,
        instance: int,
        *,
        rate: float = 250.0,
        burst: int = 32,
        observer: bool = False,
        counts: Counter[str] | None = None,
        aliases: Mapping[str, str] | None = None,
    ) -> None:
        self._observer = observer
        self._timers = KeyedTimers()
        self._names = LinkNames(aliases, self._timers)
        super().__init__(module, instance, counts, self._names)
        self._names.emit, self._names.counts = self._outbox.emit, self.counts
        self._schedule = Schedule(rate, burst, 0)
        self._directory = Directory(self._timers, self.counts, self._outbox.emit)
        self.modules = self._directory.modules
        self.topics = self._directory.topics
        self.endpoints = self._directory.endpoints
        self._announcer = Announcer(
            module, instance, self._schedule, self._outbox, self._directory, self._names, observer=observer
        )
        self._negotiation = SubscriptionNegotiation(self._announcer, self._directory)
        self._liveness = PeerLiveness(self._announcer, self._negotiation, self._directory)
        self._handlers: dict[type, Callable[[int, Any, PeerAddress], None]] = {
            management.Alive: self._liveness.alive,
            management.Stop: self._commanded,
            management.Reboot: self._commanded,
            management.Bootload: self._commanded,
            management.Advertise: self._negotiation.advertised,
            management.SubscribeRequest: self._negotiation.requested,
            management.SubscribeResponse: self._negotiation.responded,
            management.Hello: self._liveness.hello,
            management.TypeInfo: self._negotiation.typed,
            management.Unsubscribe: self._negotiation.unsubscribed,
            management.Endpoint: self._liveness.endpoint,
            management.Name: self._liveness.name,
            management.LongName: self._long_name,
            management.Conflict: self._liveness.conflict,
            management.Denied: self._denied,
        }

    # What is known of the link

    def limit_tables(self, most: int) -> None:
        """Set how many topics, endpoints, modules and long names of others are kept, each."""
        self._directory.most = self._names.most = self._liveness.aliases.most = most

    @property
    def sole_peer(self) -> int | None:
        return self._directory.sole_peer()

    def address_of(self, instance: int) -> PeerAddress:
        info = self.modules.get(self._directory.name_of(instance))
        return info.source if info is not None and info.instance == instance and not info.hops else None

    @property
    def generation(self) -> int:
        return self._directory.generation

    def demand(self) -> Demand:
        """Return what the other modules publish and subscribe to, which is tracked from the first call on."""
        if self._negotiation.demand is None:
            self._negotiation.demand = LeasedDemand(self._directory)
        return self._negotiation.demand

    # Names

    def publisher_type(self, topic: str, module: str) -> TopicType:
        types = self._negotiation.publisher_types(topic)
        info = self.modules.get(module)
        if info is not None and info.source in types:
            return types[info.source]
        return next(iter(types.values())) if len(set(types.values())) == 1 else TopicType()

    def alias(self, topic: str) -> str:
        return self._names.alias(KIND_TOPIC, topic)

    def topic_behind(self, alias: str) -> str:
        return self._names.name(KIND_TOPIC, alias)

    def module_behind(self, alias: str) -> str:
        return self._liveness.module_behind(alias)

    def other_module(self, name: str) -> str:
        return self._liveness.other_module(name)

    def claim(self, topic: str) -> list[Event]:
        self._names.claim(KIND_TOPIC, topic)
        self._announcer.set_claimed(topic, claimed=self._names.owns(topic))
        return self._outbox.drain()

    def release(self, topic: str) -> list[Event]:
        self._names.release(KIND_TOPIC, topic)
        self._announcer.set_claimed(topic, claimed=False)
        return self._outbox.drain()

    def topics_with_alias(self, alias: str) -> set[str]:
        return self._names.topics(alias)

    def rival(self, topic: str) -> str:
        return self._names.rival(topic)

    def _long_name(self, now: int, message: management.LongName, source: PeerAddress) -> None:
        """Handle LONG_NAME: rename everything that is known under this alias."""
        short = self._names.receive(now, message)
        if short and not self._observer:  # the user of a tool may ask for a topic by its alias
            self._announcer.announce_name(KIND_TOPIC, short)
        for change in self._names.pop_renames():
            self._directory.rename(now, change.kind, change.old, change.new)
            if self._negotiation.demand is not None and change.kind == KIND_TOPIC:
                self._negotiation.demand.rename(now, change.old, change.new)

    # What this module has

    def set_flags(self, now: int, flags: int) -> list[Event]:
        if flags != self.flags:
            self.flags = self._announcer.flags = flags
            self._announcer.announce_once(ItemKind.PRESENCE)
        return self._flush(now)

    def _set_topic(self, now: int, topic: str, role: int, own: LocalTopic) -> list[Event]:
        if self._announcer.set_topic(topic, role, own):
            self._negotiation.type_changed(topic, counterpart(role))
            if role == ROLE_PUBLISHES and self._negotiation.demand is not None:
                # Earlier requests, before there was a publisher, need not be repeated.
                for source in self._negotiation.demand.sources_of(topic, ROLE_SUBSCRIBES):
                    self._negotiation.requested(now, management.SubscribeRequest(topic, own.type.size_field, 1), source)
        return self._flush(now)

    def _remove_topic(self, now: int, topic: str, role: int) -> list[Event]:
        if self._announcer.remove_topic(topic, role):
            self._negotiation.topic_removed(topic, role)
        return self._flush(now)

    def add_endpoint(self, now: int, node: str, topic: str, role: int, publisher_class: int = 0) -> list[Event]:
        self._announcer.add_endpoint(node, topic, role, publisher_class)
        return self._flush(now)

    def remove_endpoint(self, now: int, node: str, topic: str, role: int) -> list[Event]:
        self._announcer.remove_endpoint(node, topic, role)
        return self._flush(now)

    def announce_gateway(self) -> None:
        self.is_gateway = self._announcer.is_gateway = True

    # What users and gateways ask for

    def query(self, now: int) -> list[Event]:
        self._announcer.announce_once(ItemKind.QUERY)
        return self._flush(now)

    def report_conflict(self, now: int, module: str, instance_a: int, instance_b: int) -> list[Event]:
        self._announcer.announce_once(ItemKind.CONFLICT, module, instance_a, instance_b)
        return self._flush(now)

    def relay(self, now: int, message: Relayed) -> list[Event]:
        self._announcer.relay(message)
        return self._flush(now)

    # The link

    def set_pace(self, rate: float, burst: int, quiet: float) -> None:
        """Change the pace, for links that learn in use what the others can take.

        Repetitions wait for `quiet` seconds without management traffic. `rate` and `burst`: as for the class.
        """
        self._schedule.set_pace(rate, burst, round(quiet * SECOND))

    def set_lossless(self, now: int, *, lossless: bool = True, addresses: bool = False) -> list[Event]:
        has_addresses = lossless and addresses
        self._negotiation.set_lossless(now, lossless=lossless, has_addresses=has_addresses)
        self._announcer.set_lossless(lossless=has_addresses)
        self._announcer.update_r2p()
        return self._flush(now)

    def hold(self, until: int) -> None:
        """Announce nothing before `until` (monotonic ns), as what was announced is not on the link yet."""
        self._schedule.hold(until)

    def link_up(self, now: int) -> list[Event]:
        """Introduce this module to the other end, query it, and announce everything."""
        self._outbox.up = True
        self._schedule.start(now)
        return self._flush(now)

    def link_down(self, now: int) -> list[Event]:
        """End all leases. Firmware's subscriptions stay, as it does not notice a reconnect."""
        self._outbox.up = False
        self._announcer.link_down()
        self._liveness.link_down(now)  # first: negotiation then drops what modules leave behind for a while
        self._negotiation.link_down()
        if self._negotiation.demand is not None:
            self._negotiation.demand.link_down()
        return self._outbox.drain()

    def leave(self, now: int) -> list[Event]:
        self._outbox.send(self._announcer.hello(management.HELLO_LEAVING))
        self._outbox.up = False
        self._announcer.link_down()
        return self._outbox.drain()

    def next_deadline(self) -> int | None:
        due = self._timers.next()
        if not self._outbox.up:
            return due
        if self._announcer.has_answers:
            return 0
        turn = self._schedule.due()
        return turn if due is None else min(due, turn)

    def poll(self, now: int) -> list[Event]:
        """End the leases that have run out, and repeat what is due.

        Called far too late, it ends no lease: this program was suspended, and has messages to read.
        """
        due = self._timers.next()
        if due is not None and now - due > _SUSPENDED:
            self._timers.put_off(now + _HEARD_AGAIN)
        # One that expires may set and clear others: each is popped when its turn comes.
        for key in self._timers.pop(now):
            self._expired(now, key)
        return self._flush(now)

    def receive_topics(self, now: int, messages: tuple[management.Management, ...], source: PeerAddress) -> list[Event]:
        """Handle messages about topics that came together, decoded, from a network that returns no echoes."""
        if not self._outbox.up:
            self.counts["link down"] += len(messages)
            return []
        self._schedule.traffic(now)
        handlers, demand = self._handlers, self._negotiation.demand
        for message in map(self._names.from_wire, messages) if self._names.has_aliases else messages:
            handlers[type(message)](now, message, source)
            if demand is not None:
                demand.receive(now, message, source)
        return self._outbox.drain()

    def receive(self, now: int, data: bytes, source: PeerAddress = None) -> list[Event]:
        if not self._outbox.up:
            self.counts["link down"] += 1
            return []
        self._schedule.traffic(now)  # whatever it is, it took time on a line that is to be quiet
        try:
            message = management.decode(data)
        except DecodeError as error:
            self._count_undecodable(error)
            return []
        handler = self._handlers.get(type(message))
        if handler is not None and not self._liveness.drop_echo(now, data):
            message = self._names.from_wire(message)
            handler(now, message, source)  # before demand, which looks up the leases that a HELLO has set
            if self._negotiation.demand is not None:
                self._negotiation.demand.receive(now, message, source)
        return self._outbox.drain()

    def _flush(self, now: int) -> list[Event]:
        self._announcer.flush(now)
        return self._outbox.drain()

    def _expired(self, now: int, key: Hashable) -> None:
        match key:
            case ("lease", source, str(topic)):
                self._negotiation.lease_over(source, topic)
            case ("answer", int(role), str(topic)):
                self._negotiation.answer(now, role, topic)
            case ("grace", source, str(topic)):
                self._negotiation.grace_over(source, topic)
            case ("module", str(name)):
                self._liveness.expired(now, name)
            case ("demand", str(topic), int(role), source) if self._negotiation.demand is not None:
                self._negotiation.demand.expired(topic, role, source)
            case ("peer", source):
                self._negotiation.linger_over(source)
            case ("alias", int(kind), str(alias)):
                self._names.expired(kind, alias)
            case ("endpoint", (int(instance), str(node), str(topic), int(role))):
                self._directory.forget_endpoint((instance, node, topic, role))

    def _denied(self, now: int, message: management.Denied, source: PeerAddress) -> None:
        if message.order == 0 and message.reason in _CONNECTION_DENIED:
            self._outbox.emit(ConnectionDenied(self.module_behind(message.gateway), message.reason))
        else:
            super()._denied(now, message, source)
