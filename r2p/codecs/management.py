"""The messages of the management topic `R2P`: a 31-byte body and a type byte (PROTOCOL.md 4 and 9).

Modules find each other and agree on what flows with these messages. Where firmware leaves something open, `decode` is
tolerant: it ignores bytes after the NUL of a name and reserved bytes, and reads only the name of STOP, REBOOT and
BOOTLOAD, for which a tool of 2013 has another layout.

Types from 0x40 on are r2p's own. Their body begins with a version. Those up to 0x4F stay on one RTCAN bus, among the
modules that are directly on it. After the version, without gaps (`slot` and `utc_offset` in ns, `utc_error` in us):

| type | name | body |
| --- | --- | --- |
| 0x40 | NETWORK | `u8 id8; u8 priority; u32 epoch; u64 cycle; u8 slots; u32 slot; i64 utc_offset; u16 utc_error` |
| 0x41 | CLAIM | `u8 id8; u64 number; u8 priority; u8 flags` (bit 0: the id8 is fixed, 1: electing a master) |
| 0x42 | RESERVE | `u16 message; u8 serial; u8 fragments; u32 period; u32 phase; u8 flags` (bit 0: round it down) |
| 0x43 | GRANT | `u16 message; u8 serial, fragments; u32 period, phase; u64 from_cycle; u32 epoch; u16 lease_ms` |
| 0x44 | REFUSE | `u16 message; u8 serial; u8 reason; u8 fragments; u32 period; u32 other; u16 rival` |
| 0x45 | RELEASE | `u16 message` |
| 0x46 | RENEW | `u8 serial; u8 highs[24]` (of the messages, 0: none) |
| 0x47 | RENEWED | `u8 id8; u8 serial; u16 lease_ms; u8 highs[24]` |

Gateways agree on their tree (`r2p.protocols.bridge`) with three more types, which stay on their network as well:

| type | name | body |
| --- | --- | --- |
| 0x60 | BRIDGE | `u32 gateway; u8 port; u16 count; u32 agreement, root; 2 x {u32 from; u16 count} acks` (0: none) |
| 0x61 | MESH | `u32 gateway; u16 serial; u8 part; 3 x {u8 port; u32 gateway; u8 its_port} heard` (0: none) |
| 0x62 | LEAF | `u32 module; u8 port; u16 count; 3 x {u32 gateway; u16 count} acks` (0: none) |
"""

import enum
import functools

import msgspec

from r2p.codecs import PublisherClass, UnknownType
from r2p.codecs._gateway_fields import BRIDGE_ACKS as BRIDGE_ACKS
from r2p.codecs._gateway_fields import LEAF_ACKS as LEAF_ACKS
from r2p.codecs._gateway_fields import MESH_HEARD as MESH_HEARD
from r2p.codecs._gateway_fields import PARTS_MAX as PARTS_MAX
from r2p.codecs._gateway_fields import Bridge as Bridge
from r2p.codecs._gateway_fields import Leaf as Leaf
from r2p.codecs._gateway_fields import Mesh as Mesh
from r2p.codecs._gateway_fields import decode_acks as decode_acks
from r2p.codecs._gateway_fields import decode_heard as decode_heard
from r2p.codecs._gateway_fields import encode_acks as encode_acks
from r2p.codecs._gateway_fields import encode_heard as encode_heard
from r2p.codecs._gateway_fields import is_newer_serial as is_newer_serial
from r2p.codecs._gateway_fields import leaf_port as leaf_port
from r2p.codecs._gateway_fields import make_part as make_part
from r2p.codecs._gateway_fields import next_serial as next_serial
from r2p.codecs._gateway_fields import split_part as split_part
from r2p.codecs._long_names import KIND_NODE as KIND_NODE
from r2p.codecs._long_names import KIND_TOPIC as KIND_TOPIC
from r2p.codecs._long_names import LongName as LongName
from r2p.codecs._long_names import Name as Name
from r2p.codecs._long_names import alias_messages as alias_messages
from r2p.codecs._long_names import long_name_messages as long_name_messages
from r2p.codecs._long_names import long_name_number as long_name_number
from r2p.codecs._records import Codec, Record
from r2p.codecs.keys import Challenge as Challenge
from r2p.codecs.keys import Proof as Proof
from r2p.codecs.keys import Seal as Seal
from r2p.errors import MessageError

SIZE = 32
"""Bytes of a message."""


class ManagementType(enum.IntEnum):
    """The type byte of each message, its last byte."""

    ALIVE = 0x11
    STOP = 0x12
    REBOOT = 0x13
    BOOTLOAD = 0x14
    ADVERTISE = 0x21
    SUBSCRIBE_REQUEST = 0x22
    SUBSCRIBE_RESPONSE = 0x23
    PATH = 0x31
    NETWORK = 0x40
    CLAIM = 0x41
    RESERVE = 0x42
    GRANT = 0x43
    REFUSE = 0x44
    RELEASE = 0x45
    RENEW = 0x46
    RENEWED = 0x47
    HELLO = 0x50
    TYPE = 0x51
    UNSUBSCRIBE = 0x52
    ENDPOINT = 0x53
    CONFLICT = 0x54
    DENIED = 0x55
    NAME = 0x56
    LONG_NAME = 0x57
    CHALLENGE = 0x58
    PROOF = 0x59
    SEAL = 0x5A
    CALL_PART = 0x5B
    BRIDGE = 0x60
    MESH = 0x61
    LEAF = 0x62


R2P_TYPES = range(0x40, 0x100)
"""The types that firmware does not know."""
RTCAN_TYPES = range(0x40, 0x50)
"""The types for one RTCAN bus, which gateways don't pass on."""
PARAMS_TYPES = (ManagementType.ADVERTISE, ManagementType.SUBSCRIBE_REQUEST, ManagementType.SUBSCRIBE_RESPONSE)
"""The types that have `params`."""
ORDER_TYPES = (ManagementType.STOP, ManagementType.REBOOT, ManagementType.BOOTLOAD)
"""The orders that a gateway may deny."""
GATEWAY_TYPES = (ManagementType.BRIDGE, ManagementType.MESH, ManagementType.LEAF)
"""The types of messages between gateways about their tree."""
TOPIC_TYPES = frozenset(
    {
        ManagementType.ADVERTISE,
        ManagementType.SUBSCRIBE_REQUEST,
        ManagementType.SUBSCRIBE_RESPONSE,
        ManagementType.TYPE,
        ManagementType.ENDPOINT,
    }
)
"""The types of messages about topics, which concern discovery only."""
SEALED_TYPES = (*ORDER_TYPES, *GATEWAY_TYPES)
"""The types that count on a link with a key only behind their SEAL."""

# Alive.flags
FLAG_STOPPED = 1
FLAG_REBOOTED = 2
FLAG_BOOT = 4
FLAG_LOADER = 8  # an r2p module that has a boot loader, as firmware does

# Hello.flags
HELLO_QUERY = 1  # asks all modules to repeat what they have: this one is new
HELLO_TOOL = 2  # an observer, which sends no ALIVE
HELLO_LEAVING = 4
HELLO_GATEWAY = 8  # forwards messages of others: of what it sends, not all is its own
HELLO_ALIAS = 16  # `module` is the alias of a longer name, which NAME has
HELLO_SOLE_LINK = 32  # on a line: its module has no other link

LEASE_MS_MAX = 0xFFFF
"""The longest lease that a Hello can carry (ms)."""

WIRE_VERSION = 4
"""Hello.wire: the version of PROTOCOL.md, which grows when modules of before can't understand all of what is new."""
WIRE_CROWD = 3
"""The wire version from which on modules repeat topics slowly in a crowd, and keep those of others for so long."""
RELEASE_MAX = 14
"""Characters of Hello.release."""

# TypeInfo.role and Endpoint.role
ROLE_PUBLISHES = 1
ROLE_SUBSCRIBES = 2
ROLE_GONE = 128  # added to an Endpoint's role: it has ended
_ROLES = (ROLE_PUBLISHES, ROLE_SUBSCRIBES)

# Endpoint.publisher_class: a PublisherClass, by the names of PROTOCOL.md
CLASS_NONE = 0
CLASS_NRT, CLASS_SRT, CLASS_HRT = PublisherClass
CLASS_LATCHES = 128  # added to the others: new subscribers get its last message

NO_PARAMS = bytes(10)
UNANSWERED = bytes(9) + b"\1"
"""Params of an r2p module's SUBSCRIBE_REQUEST while it has not received a SUBSCRIBE_RESPONSE."""
ANSWERED = bytes(9) + b"\2"
"""The same, after a SUBSCRIBE_RESPONSE: so a publisher recognises an r2p module before its first HELLO."""
ANY_TYPE = bytes(8)
"""The fingerprint that fits every type."""

QUEUE = 5
"""Entries of a SUBSCRIBE_REQUEST's queue by default."""
QUEUE_MAX = 16
"""Entries of such a queue at most."""
QUEUE_BYTES_MAX = 1024
"""Bytes of such a queue at most. Firmware has 20 kB of RAM and takes the queue from its heap; without room it writes to
NULL.
"""
QUEUE_ENTRY = 8
"""Bytes that firmware needs for an entry besides its message."""

# Denied.reason
DENIED_CONTROL = 1  # the gateway accepts no orders from this link
DENIED_READ_ONLY = 2  # the gateway sends nothing on the link of the module
DENIED_CLIENTS = 3  # the server of a debug line serves as many clients as it may: `order` is 0
DENIED_BOOT = 4  # STOP would hang a module in boot mode
DENIED_GATEWAYS = 5  # the server of a debug line accepts no gateway: `order` is 0
DENIED_NO_KEY = 6  # the order lacks the seal of the link's key; `order` 0: the other end of the line has no key
DENIED_OTHER_KEY = 7  # the seal of the order, or the proof of the other end of the line, was made with another key
DENIED_OPEN_LINK = 8  # the order crossed a link without a key, and the link of the module has one

# Claim.flags
CLAIM_FIXED = 1  # the module can't take another id8
CLAIM_ELECTING = 2  # the module knows no master


class RefuseReason(enum.IntEnum):
    """The reason why a master grants no slots: `Refuse.reason`."""

    PERIOD = 1  # the master keeps the harmonic rule: neither this period divides the cycle nor the cycle it
    OTHER = 2  # the same, for the period of another message
    LENGTH = 3  # too short for the fragments, or too long
    FULL = 4  # not so many slots in a row are free
    TAKEN = 5  # the slots that it had were given to another message
    MANY = 6  # no further reservation can be kept
    FACTOR = 7  # the greatest common factor with the cycle, or with the period of another message, is too small
    MANAGEMENT = 8  # the slots that are left are needed for management


SIZE_VARIES = 0x8000
"""Bit of a payload's size: the length of the messages varies. The other bits are the most bytes that they have."""

EPOCH_MAX = 0xFFFFFFFF  # Network.epoch
REQUEST_SERIALS = 256  # values of Reserve.serial and Renew.serial
NO_PHASE = 0xFFFFFFFF  # Reserve.phase: any will do
RESERVE_ROUND_DOWN = 1  # Reserve.flags: a shorter period will do, the longest possible one
RENEW_MAX = 24  # high bytes in a Renew
NO_UTC = 0xFFFF  # Network.utc_error: the offset is unknown

_VERSION = 1
_MARK = b"r2p"
_MARKED = slice(22, 25)  # of an encoded message: in its params, behind RTCAN's message id


class Alive(msgspec.Struct, frozen=True, gc=False):
    """A module lives; `flags` are FLAG_..."""

    module: str
    flags: int = 0


class Stop(msgspec.Struct, frozen=True, gc=False):
    """Order a module to stop: its nodes end."""

    module: str


class Reboot(msgspec.Struct, frozen=True, gc=False):
    """Order a module to restart."""

    module: str


class Bootload(msgspec.Struct, frozen=True, gc=False):
    """Order a module to restart into its loader."""

    module: str


Order = Stop | Reboot | Bootload


class Advertise(msgspec.Struct, frozen=True, gc=False):
    """A topic has a publisher. `size` is the payload's, in bytes (see `encode_size`); `queue` means nothing here.

    `params` belong to the transport of the message: on RTCAN, bytes 0 and 1 are the message id.
    """

    topic: str
    size: int
    queue: int = 0
    params: bytes = NO_PARAMS


class SubscribeRequest(msgspec.Struct, frozen=True, gc=False):
    """Request the messages of a topic. Fields as in `Advertise`, but `queue` is 1 or more: 0 halts firmware.

    Firmware must not get a size of 0 either, nor a queue that its heap can't hold: see `queue_length`.
    """

    topic: str
    size: int
    queue: int
    params: bytes = NO_PARAMS


class SubscribeResponse(msgspec.Struct, frozen=True, gc=False):
    """Accept a SubscribeRequest: the publisher will send, with these params. Fields as in `Advertise`."""

    topic: str
    size: int
    queue: int = 0
    params: bytes = NO_PARAMS


class Path(msgspec.Struct, frozen=True, gc=False):
    """The path `module/node/topic`; each part may be empty."""

    module: str
    node: str
    topic: str


class Hello(msgspec.Struct, frozen=True, gc=False):
    """An r2p module runs. `instance` is the random number of its start; it is gone after `lease_ms` of silence.

    `wire` is its WIRE_VERSION, `release` the version of its software; 0 and empty before r2p announced them.
    """

    module: str
    instance: int
    flags: int = 0
    hops: int = 0
    lease_ms: int = 5000
    wire: int = 0
    release: str = ""


class TypeInfo(msgspec.Struct, frozen=True, gc=False):
    """The type of a topic in the role ROLE_...: the fingerprint (8 bytes) of its layout, its size as in Advertise."""

    role: int
    topic: str
    fingerprint: bytes
    size: int


class Unsubscribe(msgspec.Struct, frozen=True, gc=False):
    """The r2p module that started as `instance` no longer subscribes to this topic."""

    topic: str
    instance: int


class Endpoint(msgspec.Struct, frozen=True, gc=False):
    """A node has a publisher or subscriber (ROLE_...), or had one (plus ROLE_GONE). `publisher_class` sums CLASS_..."""

    role: int
    instance: int
    node: str
    topic: str
    publisher_class: int = CLASS_NONE


class Conflict(msgspec.Struct, frozen=True, gc=False):
    """Two modules have one name."""

    module: str
    instance_a: int
    instance_b: int


class Denied(msgspec.Struct, frozen=True, gc=False):
    """A gateway does not let an order through to a module: `order` is the type byte of the order, `reason` DENIED_...

    Or the other end of a debug line does not accept the connection: `order` is 0.
    """

    gateway: str
    module: str
    order: int
    reason: int


class Network(msgspec.Struct, frozen=True, gc=False):
    """The parameters of an RTCAN network, from its master; `cycle` anchors the cycle counter. `slot` is in ns.

    `utc_offset` is UTC less network time (ns), `utc_error` how far off it may be (us).
    """

    id8: int
    priority: int
    epoch: int
    cycle: int
    slots: int
    slot: int
    utc_offset: int = 0
    utc_error: int = NO_UTC


class Claim(msgspec.Struct, frozen=True, gc=False):
    """A module uses this id8. Of two that claim it, the one with the lower `number` (64 random bits) keeps it.

    `priority` is that for the election of a master, 0: never; `flags` are CLAIM_...
    """

    id8: int
    number: int
    priority: int = 0
    flags: int = 0


class Reserve(msgspec.Struct, frozen=True, gc=False):
    """Request slots for a periodic message or, with a `phase`, keep those it has. Periods and phases are in slots."""

    message: int
    serial: int
    fragments: int
    period: int
    phase: int = NO_PHASE
    flags: int = 0


class Grant(msgspec.Struct, frozen=True, gc=False):
    """Grant slots to a message for `lease_ms`, from the cycle `from_cycle` on. `serial` is the request's.

    The slots are those whose number, counted from the start of cycle 0, is `phase` modulo `period`, and for more
    fragments the next ones.
    """

    message: int
    serial: int
    fragments: int
    period: int
    phase: int
    from_cycle: int
    epoch: int
    lease_ms: int


class Refuse(msgspec.Struct, frozen=True, gc=False):
    """Refuse slots for `fragments` every `period`. The period `other`, of the message `rival`, is in the way.

    `reason` is a RefuseReason, or a number that a newer version knows.
    """

    message: int
    serial: int
    reason: int
    fragments: int
    period: int
    other: int = 0
    rival: int = 0


class Release(msgspec.Struct, frozen=True, gc=False):
    """Give back the slots of a message."""

    message: int


class Renew(msgspec.Struct, frozen=True, gc=False):
    """Keep the slots that were granted to the sender for its topics with these high bytes (24 bytes, 0: none)."""

    serial: int
    highs: bytes


class Renewed(msgspec.Struct, frozen=True, gc=False):
    """Extend the leases of those `highs` of the module `id8` by `lease_ms`. Other ones that it asked for have none."""

    id8: int
    serial: int
    lease_ms: int
    highs: bytes


FirmwareMessage = Alive | Order | Advertise | SubscribeRequest | SubscribeResponse | Path
RtcanMessage = Network | Claim | Reserve | Grant | Refuse | Release | Renew | Renewed
R2pMessage = Hello | TypeInfo | Unsubscribe | Endpoint | Conflict | Denied | Name | LongName
KeyMessage = Challenge | Proof | Seal
GatewayMessage = Bridge | Mesh | Leaf
Management = FirmwareMessage | RtcanMessage | R2pMessage | KeyMessage | GatewayMessage

_PUBSUB = "16s H H 10s"
_CODEC = Codec[Management](
    SIZE,
    Record(Alive, ManagementType.ALIVE, "7s x B"),
    Record(Stop, ManagementType.STOP, "7s"),
    Record(Reboot, ManagementType.REBOOT, "7s"),
    Record(Bootload, ManagementType.BOOTLOAD, "7s"),
    Record(Advertise, ManagementType.ADVERTISE, _PUBSUB),
    Record(SubscribeRequest, ManagementType.SUBSCRIBE_REQUEST, _PUBSUB),
    Record(SubscribeResponse, ManagementType.SUBSCRIBE_RESPONSE, _PUBSUB),
    Record(Path, ManagementType.PATH, "7s 8s 16s", may_be_empty=("module", "node", "topic")),
    Record(Network, ManagementType.NETWORK, "B B I Q B I q H", version=_VERSION),
    Record(Claim, ManagementType.CLAIM, "B Q B B", version=_VERSION),
    Record(Reserve, ManagementType.RESERVE, "H B B I I B", version=_VERSION),
    Record(Grant, ManagementType.GRANT, "H B B I I Q I H", version=_VERSION),
    Record(Refuse, ManagementType.REFUSE, "H B B B I I H", version=_VERSION),
    Record(Release, ManagementType.RELEASE, "H", version=_VERSION),
    Record(Renew, ManagementType.RENEW, "B 24s", version=_VERSION),
    Record(Renewed, ManagementType.RENEWED, "B B H 24s", version=_VERSION),
    Record(Hello, ManagementType.HELLO, "7s I B B H B 14s", version=_VERSION, may_be_empty=("release",)),
    Record(TypeInfo, ManagementType.TYPE, "B 16s 8s H", version=_VERSION),
    Record(Unsubscribe, ManagementType.UNSUBSCRIBE, "16s I", version=_VERSION),
    Record(Endpoint, ManagementType.ENDPOINT, "B I 8s 16s B", version=_VERSION, may_be_empty=("node",)),
    Record(Conflict, ManagementType.CONFLICT, "7s I I", version=_VERSION),
    Record(Denied, ManagementType.DENIED, "7s 7s B B", version=_VERSION),
    Record(Name, ManagementType.NAME, "7s B 22s", version=_VERSION),
    Record(LongName, ManagementType.LONG_NAME, "B B I 24s", version=_VERSION),
    Record(Challenge, ManagementType.CHALLENGE, "I 16s", version=_VERSION),
    Record(Proof, ManagementType.PROOF, "I I B 16s", version=_VERSION),
    Record(Seal, ManagementType.SEAL, "I I I H 16s", version=_VERSION),
    Record(Bridge, ManagementType.BRIDGE, "I B H I I 12s", version=_VERSION),
    Record(Mesh, ManagementType.MESH, "I H B 18s", version=_VERSION),
    Record(Leaf, ManagementType.LEAF, "I B H 18s", version=_VERSION),
)


_CACHED = 16_384
"""Messages that are remembered as they are encoded and decoded: 200 modules in a process have 6 000."""


@functools.lru_cache(maxsize=_CACHED)
def encode(message: Management) -> bytes:
    """Encode a message to 32 bytes. Raises `MessageError`, which names the field, for a value that does not fit.

    It is cached, as modules repeat themselves.
    """
    if isinstance(message, SubscribeRequest) and not message.queue:
        raise MessageError("SubscribeRequest.queue = 0 halts firmware: ask for 1 or more messages")
    return _CODEC.encode(message)


def decode(data: bytes) -> Management:
    """Decode 32 bytes. Raises `UnknownType` for a type, role or version to ignore, else `DecodeError`."""
    return _decode(bytes(data))


@functools.lru_cache(maxsize=_CACHED)
def _decode(data: bytes) -> Management:
    """`decode`, cached: modules repeat themselves byte by byte, and all modules of a process receive the same bytes."""
    message = _CODEC.decode(data)
    if isinstance(message, TypeInfo | Endpoint):
        gone = ROLE_GONE if isinstance(message, Endpoint) else 0
        if message.role & ~gone not in _ROLES:
            raise UnknownType(f"role {message.role} of {type(message).__name__}")
    return message


def type_of(data: bytes) -> int:
    """The type byte of an encoded message, which `ManagementType` need not list; 0 if it has not 32 bytes."""
    return data[-1] if len(data) == SIZE else 0


def encode_size(size: int, *, varies: bool) -> int:
    """Return the size field of messages of `size` bytes, or of at most so many. More than it can hold is cut."""
    return SIZE_VARIES | min(size, SIZE_VARIES - 1) if varies else size


def decode_size(field: int) -> tuple[int, bool]:
    """Return the bytes in a size field, and whether the length varies."""
    return field & ~SIZE_VARIES, field >= SIZE_VARIES


def order_type(order: Order) -> int:
    """Return the type byte of an order, as in a Denied."""
    return _CODEC.code_of(order)


def queue_length(size: int, wanted: int = QUEUE) -> int:
    """Return the queue to request from firmware for messages with this size field: 1 to 16, 1024 bytes at most."""
    size, _ = decode_size(size)
    return max(1, min(wanted, QUEUE_MAX, QUEUE_BYTES_MAX // (size + QUEUE_ENTRY)))


# Contents of params: on RTCAN a message id and the mark, and in the last byte the state of an r2p subscription.


def with_unanswered(params: bytes) -> bytes:
    """Return the params of an ADVERTISE without an r2p subscriber yet."""
    return params[:-1] + UNANSWERED[-1:]


def rtcan_params(message_id: int) -> bytes:
    """Return the params that offer a topic under this message id."""
    return message_id.to_bytes(2, "little").ljust(len(NO_PARAMS), b"\0")


def rtcan_message_id(params: bytes) -> int:
    """Return the message id in the params of an ADVERTISE or a SUBSCRIBE_RESPONSE."""
    return int.from_bytes(params[:2], "little")


def mark(data: bytes) -> bytes:
    """Mark an encoded message as sent by r2p, for a bus where all management has one message id.

    Only messages with params have room for the mark; other ones stay as they are.
    """
    return _with_mark(data, _MARK) if type_of(data) in PARAMS_TYPES else data


def unmark(data: bytes) -> bytes:
    """Remove the mark."""
    return _with_mark(data, bytes(len(_MARK))) if is_marked(data) else data


def is_marked(data: bytes) -> bool:
    """Return whether an encoded message carries the mark."""
    return type_of(data) in PARAMS_TYPES and data[_MARKED] == _MARK


def _with_mark(data: bytes, text: bytes) -> bytes:
    return data[: _MARKED.start] + text + data[_MARKED.stop :]
