"""The interface of discovery to its link, which drives it (PROTOCOL.md 4 and 9).

`r2p.protocols.discovery.session.Discovery` finds peers by messages that it repeats,
`r2p.protocols.liveliness.session.LivelinessDiscovery` by the liveliness tokens of a zenoh network. A link drives both
alike: it hands over its module's topics and received messages, and acts on the returned events.
"""

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable
from typing import TypeVar

from r2p.codecs import UnknownType, management
from r2p.codecs.management import ANY_TYPE, NO_PARAMS, QUEUE, ROLE_PUBLISHES, ROLE_SUBSCRIBES
from r2p.errors import DecodeError
from r2p.names import module_alias
from r2p.protocols.discovery.aliases import LinkNames
from r2p.protocols.discovery.announcer import LocalTopic, Relayed
from r2p.protocols.discovery.demand import Demand
from r2p.protocols.discovery.directory import EndpointInfo, EndpointKey, TopicInfo
from r2p.protocols.discovery.events import (
    COMMAND_OF_TYPE,
    MESSAGE_OF_COMMAND,
    Command,
    CommandDenied,
    CommandReceived,
    Event,
    ModuleInfo,
    Outbox,
    PeerAddress,
    TopicType,
)

D = TypeVar("D", bytes, str)
M = TypeVar("M")


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

    def announce_sole_link(self, *, sole: bool) -> None:
        """Announce from now on whether this module has no other link, so that a gateway there need not wait for it."""

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
