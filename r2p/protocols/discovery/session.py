"""Discovery by management messages (PROTOCOL.md 4 and 9).

The protocol of management messages keeps no connections: everything is announced again and again, every request is
answered every time, and no single message matters. `Announcer` announces this module's topics,
`SubscriptionNegotiation` answers offers and requests of peers, `PeerLiveness` reports modules that join and leave, and
`Directory` remembers their announcements, and `LinkNames` translates names that are too long for messages. `Discovery`
gives each received message to the part that handles it, and calls the parts at their deadlines.
"""

from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Mapping
from typing import Any

from r2p.codecs import management
from r2p.codecs.management import KIND_TOPIC, ROLE_PUBLISHES, ROLE_SUBSCRIBES
from r2p.errors import DecodeError
from r2p.protocols.discovery.aliases import LinkNames
from r2p.protocols.discovery.announcer import Announcer, LocalTopic, Relayed
from r2p.protocols.discovery.demand import Demand, LeasedDemand
from r2p.protocols.discovery.directory import Directory, counterpart
from r2p.protocols.discovery.events import ConnectionDenied, Event, PeerAddress, TopicType
from r2p.protocols.discovery.interface import DiscoveryProtocol
from r2p.protocols.discovery.liveness import PeerLiveness
from r2p.protocols.discovery.negotiation import SubscriptionNegotiation
from r2p.protocols.discovery.schedule import ItemKind, Schedule
from r2p.protocols.discovery.topic_batch import TopicBatch
from r2p.protocols.timers import KeyedTimers
from r2p.units import SECOND

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

    def announce_sole_link(self, *, sole: bool) -> None:
        self._announcer.has_sole_link = sole

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

    def receive_topics(self, now: int, batch: TopicBatch, source: PeerAddress) -> list[Event]:
        """Handle messages about topics that came together, from a network that returns no echoes."""
        if not self._outbox.up:
            self.counts["link down"] += len(batch.messages)
            return []
        self._schedule.traffic(now)
        handlers, demand = self._handlers, self._negotiation.demand
        messages: Iterable[management.Management] = batch.messages
        if self._names.has_aliases:
            messages = map(self._names.from_wire, messages)
        elif demand is None:
            messages = batch.enter_new(now, self._directory, self._announcer.topics)
        for message in messages:
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
