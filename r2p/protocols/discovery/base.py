"""The interface that a link has to its discovery, whichever kind it is.

`r2p.protocols.discovery.session.Discovery` finds peers by management messages, which it repeats.
`r2p.protocols.liveliness.session.LivelinessDiscovery` finds them by the liveliness tokens of a zenoh network. A link
drives both alike: it hands over what its module has and what it receives, and acts on the events that come back.
"""

from abc import ABC, abstractmethod
from collections import Counter

from r2p.codecs.management import ANY_TYPE, NO_PARAMS, QUEUE
from r2p.protocols.discovery.announcer import Relayed
from r2p.protocols.discovery.demand import Demand
from r2p.protocols.discovery.directory import EndpointInfo, EndpointKey, TopicInfo
from r2p.protocols.discovery.events import Command, Event, ModuleInfo, PeerAddress


class DiscoveryProtocol(ABC):
    """The modules, topics and subscriptions of one link.

    Every method that takes `now` (monotonic ns) returns the events to act on, in order. Call `poll` at
    `next_deadline()`, which may have changed after each call.
    """

    counts: Counter[str]
    """Received messages that were dropped, by reason."""
    modules: dict[str, ModuleInfo]
    """The other modules by name. One of this module's own name is another module that has it too."""
    topics: dict[str, TopicInfo]
    """The topics of the other modules, by name."""
    endpoints: dict[EndpointKey, EndpointInfo]
    """The publishers and subscribers of remote nodes, by instance, node, topic and role."""

    @property
    @abstractmethod
    def flags(self) -> int:
        """This module's flags: FLAG_... of ALIVE."""

    @property
    @abstractmethod
    def sole_peer(self) -> int | None:
        """The instance of the only r2p module on the link itself; None unless there is exactly one."""

    @property
    @abstractmethod
    def generation(self) -> int:
        """A number that changes when `modules` or `endpoints` change, their `last_heard` aside."""

    @abstractmethod
    def demand(self) -> Demand:
        """What the other modules publish and subscribe to, for gateways."""

    # What this module has

    @abstractmethod
    def set_flags(self, now: int, flags: int) -> list[Event]:
        """Announce a new state of this module at once: FLAG_... of ALIVE."""

    @abstractmethod
    def advertise(
        self, now: int, topic: str, size: int, fingerprint: bytes = ANY_TYPE, params: bytes = NO_PARAMS
    ) -> list[Event]:
        """Publish a topic: messages of `size` bytes (0: not known yet). `params` are the transport's."""

    @abstractmethod
    def withdraw(self, now: int, topic: str) -> list[Event]:
        """End the publication of a topic: its remote subscribers are gone."""

    @abstractmethod
    def subscribe(
        self, now: int, topic: str, size: int = 0, queue: int = QUEUE, fingerprint: bytes = ANY_TYPE
    ) -> list[Event]:
        """Subscribe to a topic; size 0 and no fingerprint take every type. `queue`: how many messages a publisher may
        have on the way to this module.
        """

    @abstractmethod
    def unsubscribe(self, now: int, topic: str) -> list[Event]:
        """End the subscription of a topic: its remote publishers are gone."""

    @abstractmethod
    def add_endpoint(self, now: int, node: str, topic: str, role: int, publisher_class: int = 0) -> list[Event]:
        """Announce that a node publishes or subscribes to (ROLE_...) a topic, as CLASS_..."""

    @abstractmethod
    def remove_endpoint(self, now: int, node: str, topic: str, role: int) -> list[Event]:
        """Announce that a node's publisher or subscriber has ended."""

    # What users and gateways ask for

    @abstractmethod
    def command(self, now: int, command: Command, module: str) -> list[Event]:
        """Command a module to stop, to reboot or to enter its loader."""

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
        """When to call `poll` (monotonic ns); a time in the past means at once."""

    @abstractmethod
    def poll(self, now: int) -> list[Event]:
        """Do what is due."""

    @abstractmethod
    def receive(self, now: int, data: bytes, source: PeerAddress = None) -> list[Event]:
        """Handle a management message from `source`. Bad bytes are counted, and raise nothing."""
