"""What discovery tells the shell around it: to send, to attach, to let go, to report. All values are frozen.

`source` is the transport address of a sender on a bus (its id8 on CAN), None on a line with one other end.
"""

import enum
from collections import deque
from collections.abc import Hashable

import msgspec

from r2p.codecs import management

PeerAddress = Hashable


class Command(enum.Enum):
    """What one module can order another to do (PROTOCOL.md 4)."""

    STOP = "stop"
    REBOOT = "reboot"
    BOOTLOAD = "bootload"


COMMAND_OF_TYPE: dict[int, Command] = dict(zip(management.ORDER_TYPES, Command, strict=True))
"""The command by the type of the message that orders it."""


class TopicType(msgspec.Struct, frozen=True):
    """The type of a topic as far as it is known: payload bytes (0: unknown) and fingerprint (all zero: unknown)."""

    size: int = 0
    fingerprint: bytes = management.ANY_TYPE

    def fits(self, other: "TopicType") -> bool:
        """Whether nothing that both know differs."""
        if self.size != other.size and self.size and other.size:
            return False
        typed = self.fingerprint != management.ANY_TYPE and other.fingerprint != management.ANY_TYPE
        return not typed or self.fingerprint == other.fingerprint

    def joined(self, other: "TopicType") -> "TopicType":
        """What one of two that fit knows."""
        typed = self.fingerprint != management.ANY_TYPE
        return TopicType(self.size or other.size, self.fingerprint if typed else other.fingerprint)


class ModuleInfo(msgspec.Struct, frozen=True):
    """A module as heard on the link.

    `flags` are those of its ALIVE, `last_heard` is in monotonic ns. Only an r2p module has an `instance` (the random
    number of its start), a `lease` (ns that it may be silent), and can be an `observer`, a tool that sends no ALIVE.
    `hops` counts the gateways in between.
    """

    name: str
    flags: int = 0
    last_heard: int = 0
    instance: int | None = None
    observer: bool = False
    lease: int = 0
    hops: int = 0
    source: PeerAddress = None

    @property
    def r2p(self) -> bool:
        return self.instance is not None


class Send(msgspec.Struct, frozen=True):
    """Put these 32 bytes on the topic `R2P`; `urgent` ones before everything else."""

    data: bytes
    urgent: bool = False


class SubscriberJoined(msgspec.Struct, frozen=True):
    """A remote subscriber is new, or came back after a restart. Attach the topic to this link if it is not
    yet, and send the latched value; `queue` is the length that it asked for.
    """

    topic: str
    params: bytes
    queue: int
    source: PeerAddress = None


class SubscribersGone(msgspec.Struct, frozen=True):
    """Nobody on this link subscribes the topic any more: detach it."""

    topic: str


class PublisherFound(msgspec.Struct, frozen=True):
    """A remote publisher is new, or has new parameters: take its data. `size` is in bytes, 0 where it did not say."""

    topic: str
    source: PeerAddress
    params: bytes
    size: int


class PublisherGone(msgspec.Struct, frozen=True):
    """That remote publisher is gone or has another type: take no more data from it."""

    topic: str
    source: PeerAddress


class CommandReceived(msgspec.Struct, frozen=True):
    """Somebody orders this very module."""

    command: Command


class Mismatched(msgspec.Struct, frozen=True):
    """Same topic, another type: refused. `role` is theirs: ROLE_PUBLISHES or ROLE_SUBSCRIBES."""

    topic: str
    source: PeerAddress
    role: int
    ours: TopicType
    theirs: TopicType


class NameConflict(msgspec.Struct, frozen=True):
    """Two modules carry one name; an instance is None for firmware, which has none."""

    module: str
    instance_a: int | None
    instance_b: int | None


class CommandDenied(msgspec.Struct, frozen=True):
    """A gateway does not let an order through; `reason` is DENIED_... of management."""

    gateway: str
    command: Command
    module: str
    reason: int


class ConnectionDenied(msgspec.Struct, frozen=True):
    """The module at the other end serves as many clients as it may, and closes the connection; or, if this one is of a
    `gateway`, lets nothing pass.
    """

    server: str
    gateway: bool = False


class EchoDetected(msgspec.Struct, frozen=True):
    """The line gives back what we send."""


class ModuleChanged(msgspec.Struct, frozen=True):
    """A module is new, or another than before in anything but the time it was heard."""

    info: ModuleInfo


class ModuleGone(msgspec.Struct, frozen=True):
    """An r2p module said good-bye, or was `silent` for its lease; on zenoh, which tells no more, it is just gone."""

    info: ModuleInfo
    silent: bool = False


class Declare(msgspec.Struct, frozen=True):
    """Keep this liveliness token, for as long as we live or until `Undeclare`."""

    key: str


class Undeclare(msgspec.Struct, frozen=True):
    """Keep it no more."""

    key: str


class QueryTokens(msgspec.Struct, frozen=True):
    """Ask the network for all tokens: call `Presence.appeared` with each of them, then `Presence.looked`."""


class SubscriberLeft(msgspec.Struct, frozen=True):
    """Nothing flows to one remote subscriber any more; `SubscribersGone` follows the last one. Only where links can
    tell subscribers apart. `gone`: the subscriber itself is gone; else it still subscribes, and this
    module publishes no more, or another type.
    """

    topic: str
    source: PeerAddress
    gone: bool = True


Event = (
    Send
    | SubscriberJoined
    | SubscribersGone
    | PublisherFound
    | PublisherGone
    | CommandReceived
    | Mismatched
    | NameConflict
    | CommandDenied
    | ConnectionDenied
    | EchoDetected
    | ModuleChanged
    | ModuleGone
    | Declare
    | Undeclare
    | QueryTokens
    | SubscriberLeft
)


# Where everything that happens is collected until the shell takes it: messages to send and news to act on.


_REMEMBERED = 256
"""Messages that are recognised when a line echoes them."""


class Outbox:
    """The events of one call. While the link is not `up` nothing is sent."""

    def __init__(self) -> None:
        self.up = False
        self._events: list[Event] = []
        self._sent: deque[bytes] = deque(maxlen=_REMEMBERED)

    def say(self, *messages: management.Management, urgent: bool = False) -> None:
        if self.up:
            for message in messages:
                data = management.encode(message)
                self._sent.append(data)
                self._events.append(Send(data, urgent))

    def emit(self, event: Event) -> None:
        self._events.append(event)

    def take(self) -> list[Event]:
        events, self._events = self._events, []
        return events

    def forget(self, data: bytes) -> bool:
        """Whether we sent this lately; each message is recognised once."""
        if data not in self._sent:
            return False
        self._sent.remove(data)
        return True
