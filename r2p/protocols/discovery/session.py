"""The management protocol of one link (PROTOCOL.md 4 and 9): who is there, and what may flow.

The protocol is stateless and lazy: everything is said again and again, every request is answered every time, and no
single message matters. `Announcer` says what this module has, `SubscriptionNegotiation` answers what others want,
`Directory` remembers what the peers said, `PeerLiveness` reports which peers come and go; `Discovery` drives them all.
"""

from collections import Counter
from collections.abc import Callable, Hashable
from typing import Any

from r2p.codecs import UnknownType, management
from r2p.codecs.management import ANY_TYPE, NO_PARAMS, ROLE_PUBLISHES, ROLE_SUBSCRIBES
from r2p.errors import DecodeError
from r2p.names import module_alias
from r2p.protocols.discovery.announcer import Announcer, LocalTopic, Relayed
from r2p.protocols.discovery.demand import Demand, LeasedDemand
from r2p.protocols.discovery.directory import Directory, EndpointInfo, EndpointKey, TopicInfo
from r2p.protocols.discovery.events import (
    COMMAND_OF_TYPE,
    Command,
    CommandDenied,
    CommandReceived,
    ConnectionDenied,
    EchoDetected,
    Event,
    Mismatched,
    ModuleChanged,
    ModuleGone,
    ModuleInfo,
    NameConflict,
    Outbox,
    PeerAddress,
    PublisherFound,
    PublisherGone,
    Send,
    SubscriberJoined,
    SubscribersGone,
    TopicType,
)
from r2p.protocols.discovery.liveness import PeerLiveness
from r2p.protocols.discovery.negotiation import SubscriptionNegotiation
from r2p.protocols.discovery.schedule import Kind, Schedule
from r2p.protocols.timers import KeyedTimers

__all__ = [
    "Command",
    "CommandReceived",
    "Discovery",
    "EchoDetected",
    "EndpointInfo",
    "Event",
    "Mismatched",
    "ModuleChanged",
    "ModuleGone",
    "ModuleInfo",
    "NameConflict",
    "PeerAddress",
    "PublisherFound",
    "PublisherGone",
    "Send",
    "SubscriberJoined",
    "SubscribersGone",
    "TopicInfo",
    "TopicType",
]

_SECOND = 1_000_000_000
_SLEPT = _SECOND
"""Ns by which nobody is late who runs at all."""
_HEARD_AGAIN = 2 * _SECOND
"""Ns in which whoever lives says so."""
_ORDERS: dict[Command, Callable[[str], management.Management]] = {
    Command.STOP: management.Stop,
    Command.REBOOT: management.Reboot,
    Command.BOOTLOAD: management.Bootload,
}


class Discovery:
    """The management protocol of one link.

    `rate` is the most management messages a second that nobody asked for, `burst` how many of them may go at once,
    `quiet` the time (s) without management traffic before something is repeated. An `observer` sends no ALIVE.
    `counts` is the counter to use, where its owner wants to see it grow.

    Every method takes `now` (monotonic ns) and gives back what to do, in order; call `poll` at `next_deadline()`.
    """

    def __init__(
        self,
        module: str,
        instance: int,
        *,
        rate: float = 250.0,
        burst: int = 32,
        quiet: float = 0.0,
        observer: bool = False,
        counts: Counter[str] | None = None,
    ) -> None:
        self.counts: Counter[str] = Counter() if counts is None else counts
        """Received messages that were dropped, by reason."""
        self._module = module
        self._instance = instance
        self._outbox = Outbox()
        self._schedule = Schedule(rate, burst, round(quiet * _SECOND))
        self._timers = KeyedTimers()
        self._directory = Directory(self._timers, self.counts)
        self._announcer = Announcer(
            module, instance, self._schedule, self._outbox, self._directory.size_of, observer=observer
        )
        self._exchange = SubscriptionNegotiation(
            self._announcer, self._outbox, self._directory, self._timers, self.counts
        )
        self._neighbours = PeerLiveness(
            module,
            instance,
            self._directory,
            self._exchange,
            self._announcer,
            self._schedule,
            self._timers,
            self._outbox,
            self.counts,
        )
        self._demand: LeasedDemand | None = None
        self._handlers: dict[type, Callable[[int, Any, PeerAddress], None]] = {
            management.Alive: self._neighbours.alive,
            management.Stop: self._stop,
            management.Reboot: self._reboot,
            management.Bootload: self._bootload,
            management.Advertise: self._exchange.advertised,
            management.SubscribeRequest: self._exchange.requested,
            management.SubscribeResponse: self._exchange.responded,
            management.Hello: self._neighbours.hello,
            management.TypeInfo: self._exchange.typed,
            management.Unsubscribe: self._exchange.unsubscribed,
            management.Endpoint: self._neighbours.endpoint,
            management.Name: self._neighbours.named,
            management.Conflict: self._neighbours.conflict,
            management.Denied: self._denied,
        }

    # What was learnt

    @property
    def flags(self) -> int:
        """Our own flags, as in ALIVE."""
        return self._announcer.flags

    @property
    def modules(self) -> dict[str, ModuleInfo]:
        """The modules heard on the link, by name; one of our own name is another module that has it too."""
        return self._directory.modules

    @property
    def topics(self) -> dict[str, TopicInfo]:
        """The topics heard of on the link, by name."""
        return self._directory.topics

    @property
    def endpoints(self) -> dict[EndpointKey, EndpointInfo]:
        """The publishers and subscribers of remote nodes, by instance, node, topic and role."""
        return self._directory.endpoints

    @property
    def sole_peer(self) -> int | None:
        """The instance of the one r2p module on the link itself; None if there is none, or more than one."""
        ends = self._directory.ends
        return next(iter(ends.values())) if len(ends) == 1 else None

    @property
    def generation(self) -> int:
        """Another number means that `modules` or `endpoints` have changed in more than when they were heard."""
        return self._directory.generation

    # What the module has and wants

    def set_flags(self, now: int, flags: int) -> list[Event]:
        """The module's state changed: tell at once. `flags` are FLAG_... of ALIVE."""
        if flags != self._announcer.flags:
            self._announcer.flags = flags
            self._announcer.once(Kind.PRESENCE)
        return self._go_on(now)

    def advertise(
        self, now: int, topic: str, size: int, fingerprint: bytes = ANY_TYPE, params: bytes = NO_PARAMS
    ) -> list[Event]:
        """The module publishes this topic: messages of `size` bytes. `params` are the transport's."""
        if self._announcer.publish(topic, LocalTopic(TopicType(size, fingerprint), params)):
            self._exchange.retyped(topic, ROLE_SUBSCRIBES)
            for source in self._demand.sources_of(topic, ROLE_SUBSCRIBES) if self._demand is not None else ():
                self._exchange.requested(now, management.SubscribeRequest(topic, size, 1), source)  # was heard before
        return self._go_on(now)

    def withdraw(self, now: int, topic: str) -> list[Event]:
        """The module does not publish this topic any more: whoever joined has left."""
        if self._announcer.withdraw(topic):
            self._exchange.withdrawn(topic)
        return self._go_on(now)

    def subscribe(
        self, now: int, topic: str, size: int = 0, queue: int = management.QUEUE, fingerprint: bytes = ANY_TYPE
    ) -> list[Event]:
        """The module subscribes this topic. Size 0 and no fingerprint: whatever its type is; it is then not asked for
        before its size has been heard.

        `queue`: messages that a publisher may have to keep for us, bounded by what firmware bears (`queue_length`).
        """
        own = LocalTopic(TopicType(size, fingerprint), queue=queue)
        if self._announcer.subscribe(topic, own):
            self._exchange.retyped(topic, ROLE_PUBLISHES)
        return self._go_on(now)

    def unsubscribe(self, now: int, topic: str) -> list[Event]:
        """The module does not subscribe this topic any more: what was opened is shut."""
        if self._announcer.unsubscribe(topic):
            self._exchange.unwanted(topic)
        return self._go_on(now)

    def endpoint(self, now: int, node: str, topic: str, role: int, publisher_class: int = 0) -> list[Event]:
        """A node publishes or subscribes (ROLE_...) the topic, as CLASS_...; told to r2p modules only."""
        self._announcer.endpoint(node, topic, role, publisher_class)
        return self._go_on(now)

    def endpoint_gone(self, now: int, node: str, topic: str, role: int) -> list[Event]:
        """It does not any more."""
        self._announcer.endpoint_gone(node, topic, role)
        return self._go_on(now)

    # What a person or the shell wants

    def command(self, now: int, command: Command, module: str) -> list[Event]:
        """Order a module to stop, reboot or enter its loader."""
        self._outbox.say(_ORDERS[command](module_alias(module)), urgent=True)
        return self._outbox.take()

    def query(self, now: int) -> list[Event]:
        """Ask everybody to repeat what they publish and subscribe."""
        self._announcer.once(Kind.QUERY)
        return self._go_on(now)

    def conflict(self, now: int, module: str, instance_a: int, instance_b: int) -> list[Event]:
        """Tell the link that two modules, which don't hear each other, carry one name."""
        self._announcer.once(Kind.CONFLICT, module_alias(module), instance_a, instance_b)
        return self._go_on(now)

    # For gateways

    def demand(self) -> Demand:
        """What others offer and want; kept from the first call on."""
        if self._demand is None:
            self._demand = LeasedDemand(self._timers, self._directory)
        return self._demand

    def relay(self, now: int, message: Relayed) -> list[Event]:
        """Pass on what a module on another link has said."""
        self._announcer.relay(message)
        return self._go_on(now)

    # The link

    def pace(self, rate: float, burst: int, quiet: float) -> None:
        """Speak at another rate from now on: for links that learn only in use what the others bear."""
        self._schedule.pace(rate, burst, round(quiet * _SECOND))

    def link_up(self, now: int) -> list[Event]:
        """The other end can be reached: introduce yourself, ask, and announce everything."""
        self._outbox.up = True
        self._schedule.start(now)
        return self._go_on(now)

    def link_down(self, now: int) -> list[Event]:
        """The other end is away. Leases end; firmware's subscriptions stay, it does not notice a reconnect."""
        self._outbox.up = False
        self._schedule.stop()
        self._neighbours.interrupted(now)
        self._exchange.interrupted()
        if self._demand is not None:
            self._demand.interrupted()
        return self._outbox.take()

    def leave(self, now: int) -> list[Event]:
        """Say good-bye; nothing is sent after it."""
        self._outbox.say(self._announcer.introduction(management.HELLO_LEAVING))
        self._outbox.up = False
        self._schedule.stop()
        return self._outbox.take()

    def next_deadline(self) -> int | None:
        """When to call `poll` (monotonic ns); a time in the past means at once."""
        due = self._timers.next()
        if not self._outbox.up:
            return due
        turn = self._schedule.due()
        return turn if due is None else min(due, turn)

    def poll(self, now: int) -> list[Event]:
        """What the time brings: leases run out, things are repeated.

        Called far too late, it lets none run out: this program was stopped, and has yet to read what others said.
        """
        due = self._timers.next()
        if due is not None and now - due > _SLEPT:
            self._timers.put_off(now + _HEARD_AGAIN)
        for key in self._timers.pop(now):
            self._expired(now, key)
        return self._go_on(now)

    def receive(self, now: int, data: bytes, source: PeerAddress = None) -> list[Event]:
        """A message of the topic `R2P` came in from `source`. Never raises for bad bytes: they are counted."""
        if not self._outbox.up:
            self.counts["link down"] += 1
            return []
        self._schedule.traffic(now)
        try:
            message = management.decode(data)
        except UnknownType:
            self.counts["unknown type"] += 1
        except DecodeError:
            self.counts["undecodable"] += 1
        else:
            handler = self._handlers.get(type(message))
            if handler is not None and not self._neighbours.is_echo(now, data):
                handler(now, message, source)
                if self._demand is not None:
                    self._demand.heard(now, message, source)
        return self._outbox.take()

    def _go_on(self, now: int) -> list[Event]:
        self._announcer.go_on(now)
        return self._outbox.take()

    def _expired(self, now: int, key: Hashable) -> None:
        match key:
            case ("lease", source, str(topic)):
                self._exchange.lease_over(source, topic)
            case ("answer", int(role), str(topic)):
                self._exchange.answer(now, role, topic)
            case ("grace", source, str(topic)):
                self._exchange.grace_over(source, topic)
            case ("module", str(name)):
                self._neighbours.expired(now, name)
            case ("demand", str(topic), int(role), source) if self._demand is not None:
                self._demand.expired(topic, role, source)
            case ("peer", source):
                self._exchange.memory_over(source)
            case ("endpoint", (int(instance), str(node), str(topic), int(role))):
                self._directory.forget_endpoint((instance, node, topic, role))

    # Orders

    def _denied(self, now: int, message: management.Denied, source: PeerAddress) -> None:
        if message.reason in (management.DENIED_CLIENTS, management.DENIED_GATEWAYS):
            self._outbox.emit(ConnectionDenied(message.gateway, message.reason == management.DENIED_GATEWAYS))
        elif message.order in COMMAND_OF_TYPE:
            denied = CommandDenied(message.gateway, COMMAND_OF_TYPE[message.order], message.module, message.reason)
            self._outbox.emit(denied)

    def _stop(self, now: int, message: management.Stop, source: PeerAddress) -> None:
        self._obey(Command.STOP, message.module)

    def _reboot(self, now: int, message: management.Reboot, source: PeerAddress) -> None:
        self._obey(Command.REBOOT, message.module)

    def _bootload(self, now: int, message: management.Bootload, source: PeerAddress) -> None:
        self._obey(Command.BOOTLOAD, message.module)

    def _obey(self, command: Command, module: str) -> None:
        if module == self._module:
            self._outbox.emit(CommandReceived(command))
