"""The events that discovery hands to the link that drives it, and the values in them.

A link acts on each event in order: it sends a message, attaches a topic to a remote subscriber or detaches it, or
reports a change to the module. `source` is the transport address of a peer on a bus (its id8 on CAN), None on a line,
which has one other end.
"""

import enum
import functools
from collections import deque
from collections.abc import Callable, Hashable, Iterable

import msgspec

from r2p.codecs import management

PeerAddress = Hashable


class Command(enum.Enum):
    """Commands from one module to another (PROTOCOL.md 4)."""

    STOP = "stop"
    REBOOT = "reboot"
    BOOTLOAD = "bootload"


MESSAGE_OF_COMMAND: dict[Command, type[management.Order]] = {
    Command.STOP: management.Stop,
    Command.REBOOT: management.Reboot,
    Command.BOOTLOAD: management.Bootload,
}
COMMAND_OF_TYPE: dict[int, Command] = dict(zip(management.ORDER_TYPES, MESSAGE_OF_COMMAND, strict=True))
"""The command by the type byte of its message: `management.order_type`."""


class TopicType(msgspec.Struct, frozen=True, gc=False):
    """The type of a topic as far as it is known: payload bytes (0: unknown) and fingerprint (`ANY_TYPE`: unknown).

    If the length `varies`, `size` is a bound, which need not be the same in all modules. A subscriber that accepts
    several types asks for none of them, and has them in `accepted`, which no message carries.
    """

    size: int = 0
    fingerprint: bytes = management.ANY_TYPE
    varies: bool = False
    accepted: tuple["TopicType", ...] = ()

    @staticmethod
    @functools.lru_cache(maxsize=1024)
    def announced(size: int, fingerprint: bytes = management.ANY_TYPE) -> "TopicType":
        """Return the type in a management message with this size field. It is cached, as messages are repeated."""
        bound, varies = management.decode_size(size)
        return TopicType(bound, fingerprint, varies)

    @property
    def size_field(self) -> int:
        """The size as in management messages."""
        return management.encode_size(self.size, varies=self.varies)

    @property
    def exact_size(self) -> int:
        """Bytes of each message; 0: unknown, or the length varies."""
        return 0 if self.varies else self.size

    def fits(self, other: "TopicType") -> bool:
        """Return whether the two agree: what is unknown fits everything."""
        if self.accepted:
            return any(each.fits(other) for each in self.accepted)
        ours, theirs = (self.exact_size or self.varies), (other.exact_size or other.varies)
        if ours and theirs and (ours, self.varies) != (theirs, other.varies):
            return False
        typed = self.fingerprint != management.ANY_TYPE and other.fingerprint != management.ANY_TYPE
        return not typed or self.fingerprint == other.fingerprint

    def covers(self, other: "TopicType") -> bool:
        """Return whether a type that fits says nothing new: only its size."""
        is_size = other.fingerprint == management.ANY_TYPE != self.fingerprint
        return is_size and other.size == self.size and other.varies == self.varies

    def merged(self, other: "TopicType") -> "TopicType":
        """Return what is known from either of two types that fit."""
        typed = self.fingerprint != management.ANY_TYPE
        known = self if self.size or self.varies else other
        return TopicType(known.size, self.fingerprint if typed else other.fingerprint, known.varies)


class ModuleInfo(msgspec.Struct, frozen=True, gc=False):
    """A module on the link.

    `flags` are those of its ALIVE, `last_heard` is in monotonic ns. Only an r2p module has an `instance` (the random
    number of its start), a `lease` (ns that it may be silent), and may be an `observer`, a tool that sends no ALIVE.
    `hops` is the number of gateways in between. `wire` and `release` are those of its HELLO (0 and empty: not known).
    `gateway` and `sole_link`, that it has no other link than the line, are known only of modules on the link itself.
    """

    name: str
    flags: int = 0
    last_heard: int = 0
    instance: int | None = None
    observer: bool = False
    lease: int = 0
    hops: int = 0
    source: PeerAddress = None
    wire: int = 0
    release: str = ""
    gateway: bool = False
    sole_link: bool = False

    @property
    def r2p(self) -> bool:
        return self.instance is not None

    @property
    def knows_crowds(self) -> bool:
        """Whether it may repeat its topics slowly, and keeps those of others that do."""
        return self.r2p and self.wire >= management.WIRE_CROWD

    def is_repeated_by(self, hello: management.Hello, source: PeerAddress) -> bool:
        """Return whether a HELLO from this address says the same as this entry, but for the lease, and asks nothing."""
        flags = management.HELLO_TOOL * self.observer
        flags |= management.HELLO_GATEWAY * self.gateway | management.HELLO_SOLE_LINK * self.sole_link
        return (
            self.instance == hello.instance
            and flags == hello.flags
            and self.hops == hello.hops
            and self.source == source
            and self.wire == hello.wire
            and self.release == hello.release
        )

    def differs(self, other: "ModuleInfo") -> bool:
        """Return whether anything differs but the time of the last message, and the lease, which follows the number of
        modules.
        """
        return msgspec.structs.replace(other, last_heard=self.last_heard, lease=self.lease) != self


def possible_senders(modules: Iterable[ModuleInfo]) -> set[str]:
    """Return the modules that may send what none of them has announced, by name; empty: there may be others.

    Behind a gateway there may always be modules whose announcements are late. Tools announce all that they publish.
    """
    modules = list(modules)
    forwarded = any(info.gateway or info.hops for info in modules)
    return set() if forwarded else {info.name for info in modules if not info.observer}


class Send(msgspec.Struct, frozen=True):
    """Send these 32 bytes on the topic `R2P`, `urgent` ones before everything else."""

    data: bytes
    urgent: bool = False


class SendTo(msgspec.Struct, frozen=True):
    """Send these messages to the module at this address. Only links with addresses (`set_lossless`) get this event."""

    messages: tuple[bytes, ...]
    to: PeerAddress


class SubscriberJoined(msgspec.Struct, frozen=True):
    """A remote subscriber is new, or back after a restart: attach the topic to this link, and send its latched value.

    `queue` is the length that the subscriber asked for.
    """

    topic: str
    params: bytes
    queue: int
    source: PeerAddress = None


class SubscribersGone(msgspec.Struct, frozen=True):
    """The topic has no subscriber left on this link: detach it."""

    topic: str


class SubscriberLeft(msgspec.Struct, frozen=True):
    """One remote subscriber of a topic has left; `SubscribersGone` follows the last. Only where links tell them apart.

    `gone`: the subscriber has ended; else it still subscribes, and this module's publication has ended or changed.
    """

    topic: str
    source: PeerAddress
    gone: bool = True


class PublisherFound(msgspec.Struct, frozen=True):
    """A remote publisher is new, or has new parameters: accept its messages. `size` is in bytes, 0: unknown, or their
    length `varies`: then they have at most `bound` bytes.
    """

    topic: str
    source: PeerAddress
    params: bytes
    size: int
    varies: bool = False
    bound: int = 0


class PublisherGone(msgspec.Struct, frozen=True):
    """A remote publisher is gone, or has a type that does not fit: stop accepting messages from it."""

    topic: str
    source: PeerAddress


class CommandReceived(msgspec.Struct, frozen=True):
    """A command for this module."""

    command: Command


class Mismatched(msgspec.Struct, frozen=True):
    """A peer has another type for a topic, so nothing flows. `role` is the peer's, ROLE_..."""

    topic: str
    source: PeerAddress
    role: int
    ours: TopicType
    theirs: TopicType

    def describe(self) -> str:
        """Describe how the types differ, and what to do about it."""
        return describe_mismatch(self.role, self.ours, self.theirs)


def describe_mismatch(role: int, ours: TopicType, theirs: TopicType) -> str:
    """Describe how the type of peers in a role differs from this module's, and what to do about it."""
    verb = "publish" if role == management.ROLE_PUBLISHES else "subscribe to"
    if ours.accepted:
        what = "of variable length" if theirs.varies else f"of {theirs.size} bytes" if theirs.size else "of a type"
        return (
            f"others {verb} messages {what} that are not accepted here: add their type to accept=, or rename the topic"
        )
    if ours.varies and theirs.varies:
        what = "another layout"
    elif ours.varies:
        what = f"messages of {theirs.size} bytes, here their length varies, which firmware can't send or receive"
    elif theirs.varies:
        what = f"messages of variable length, here they have {ours.size} bytes"
    elif ours.size != theirs.size:
        what = f"messages of {theirs.size} bytes, here they have {ours.size}"
    else:
        what = f"another layout of the same {ours.size} bytes"
    return f"others {verb} {what}; use one message type on both sides, or another topic"


class NameConflict(msgspec.Struct, frozen=True):
    """Two modules have the same name. Firmware has no instance: None."""

    module: str
    instance_a: int | None
    instance_b: int | None


class CommandDenied(msgspec.Struct, frozen=True):
    """A gateway does not let a command through; `reason` is DENIED_... of management."""

    gateway: str
    command: Command
    module: str
    reason: int


class ConnectionDenied(msgspec.Struct, frozen=True):
    """The other end of the line does not accept this connection: `reason` is DENIED_CLIENTS, DENIED_GATEWAYS,
    DENIED_NO_KEY or DENIED_OTHER_KEY.
    """

    server: str
    reason: int


class EchoDetected(msgspec.Struct, frozen=True):
    """The line echoes this module's own messages."""


class TableFull(msgspec.Struct, frozen=True):
    """A table of discovery has had no room for the first time: of its `most` entries, those that are silent for longest
    are forgotten from now on.
    """

    most: int


class ModuleChanged(msgspec.Struct, frozen=True):
    """A module is new, or anything but the time of its last message has changed."""

    info: ModuleInfo


class ModuleGone(msgspec.Struct, frozen=True):
    """An r2p module said good-bye, or was `silent` for its lease. On zenoh the two can't be distinguished."""

    info: ModuleInfo
    silent: bool = False


KIND_MODULE = 0
"""The kind of modules, beside KIND_TOPIC and KIND_NODE of LONG_NAME."""


class AliasConflict(msgspec.Struct, frozen=True):
    """Two names have one alias on a link. `refused` is the topic of this module that the link does not carry for that;
    empty if there is none. `kind` is KIND_...
    """

    kind: int
    alias: str
    name: str
    other: str
    refused: str = ""


class AliasesDiffer(msgspec.Struct, frozen=True):
    """Another module on the link uses another alias for a topic of this module, so nothing flows between them."""

    name: str
    alias: str
    other_alias: str


class AliasFreed(msgspec.Struct, frozen=True):
    """A topic that was refused has its alias for itself now."""

    topic: str


AliasEvent = AliasConflict | AliasesDiffer | AliasFreed


class Declare(msgspec.Struct, frozen=True):
    """Declare this liveliness token."""

    key: str


class Undeclare(msgspec.Struct, frozen=True):
    """Undeclare this liveliness token."""

    key: str


class QueryTokens(msgspec.Struct, frozen=True):
    """Query the network for all tokens; `appeared` gets each of them, and `query_ended` the end."""


Event = (
    Send
    | SendTo
    | SubscriberJoined
    | SubscribersGone
    | SubscriberLeft
    | PublisherFound
    | PublisherGone
    | CommandReceived
    | Mismatched
    | NameConflict
    | CommandDenied
    | ConnectionDenied
    | EchoDetected
    | TableFull
    | ModuleChanged
    | ModuleGone
    | Declare
    | Undeclare
    | QueryTokens
    | AliasEvent
)

_SENT_MAX = 256
"""Messages to recognise when a line echoes them: more than are on the way at a time."""


class Outbox:
    """The events of one call. While the link is not `up` nothing is sent.

    `to_wire` replaces names that are too long for their fields.
    """

    def __init__(self, to_wire: Callable[[management.Management], management.Management]) -> None:
        self.up = False
        self._to_wire = to_wire
        self._events: list[Event] = []
        self._sent: deque[bytes] = deque(maxlen=_SENT_MAX)

    def send(self, *messages: management.Management, urgent: bool = False) -> None:
        if self.up:
            for message in messages:
                data = management.encode(self._to_wire(message))
                self._sent.append(data)
                self._events.append(Send(data, urgent))

    def encode(self, messages: Iterable[management.Management]) -> tuple[bytes, ...]:
        """Return messages as they are for `answer`."""
        return tuple(management.encode(self._to_wire(message)) for message in messages)

    def answer(self, to: PeerAddress, messages: tuple[bytes, ...]) -> None:
        if self.up and messages:
            self._events.append(SendTo(messages, to))

    def emit(self, *events: Event) -> None:
        self._events += events

    def drain(self) -> list[Event]:
        events, self._events = self._events, []
        return events

    def pop_echo(self, data: bytes) -> bool:
        """Return whether these bytes were sent lately; each message is recognised once."""
        if data not in self._sent:
            return False
        self._sent.remove(data)
        return True
