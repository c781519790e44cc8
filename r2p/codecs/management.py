"""The messages of the management topic `R2P`: a 31-byte body and a type byte (PROTOCOL.md 4 and 9).

What firmware leaves open is read with tolerance: what stands behind a name's NUL, reserved and unused bytes mean
nothing, and STOP, REBOOT and BOOTLOAD, of which a tool of 2013 has a layout of its own, are read for their name only.
Types from 0x50 are r2p's own; their body begins with a version.
"""

import msgspec

from r2p.codecs._records import Codec, Record
from r2p.errors import MessageError

SIZE = 32

# Alive.flags
FLAG_STOPPED = 1
FLAG_REBOOTED = 2
FLAG_BOOT = 4

# Hello.flags
HELLO_QUERY = 1  # I am new here: repeat yourself
HELLO_TOOL = 2  # an observer, which sends no ALIVE
HELLO_LEAVING = 4

# TypeInfo.role and Endpoint.role
ROLE_PUBLISHES = 1
ROLE_SUBSCRIBES = 2
ROLE_GONE = 128  # added to an Endpoint's role: withdrawn

# Endpoint.publisher_class
CLASS_NONE = 0
CLASS_NRT = 1
CLASS_SRT = 2  # sporadic
CLASS_HRT = 3  # periodic

NO_PARAMS = bytes(10)
ANY_TYPE = bytes(8)

_VERSION = 1


class Alive(msgspec.Struct, frozen=True, gc=False):
    """A module is there; `flags` are FLAG_..."""

    module: str
    flags: int = 0


class Stop(msgspec.Struct, frozen=True, gc=False):
    """The nodes of this module end."""

    module: str


class Reboot(msgspec.Struct, frozen=True, gc=False):
    """This module restarts."""

    module: str


class Bootload(msgspec.Struct, frozen=True, gc=False):
    """This module restarts into its loader."""

    module: str


class Advertise(msgspec.Struct, frozen=True, gc=False):
    """A publisher appeared or is still there. `size` is the payload's, in bytes; `queue` means nothing here.

    `params` belong to the transport the message travels on: on RTCAN bytes 0 and 1 are the message id.
    """

    topic: str
    size: int
    queue: int = 0
    params: bytes = NO_PARAMS


class SubscribeRequest(msgspec.Struct, frozen=True, gc=False):
    """Send me this topic. Fields as `Advertise`, but `queue` is 1 or more: 0 halts firmware, so `encode` refuses it."""

    topic: str
    size: int
    queue: int
    params: bytes = NO_PARAMS


class SubscribeResponse(msgspec.Struct, frozen=True, gc=False):
    """I will, with these parameters. Fields as `Advertise`."""

    topic: str
    size: int
    queue: int = 0
    params: bytes = NO_PARAMS


class Path(msgspec.Struct, frozen=True, gc=False):
    """`module/node/topic`; each part may be empty."""

    module: str
    node: str
    topic: str


class Hello(msgspec.Struct, frozen=True, gc=False):
    """An r2p module tells r2p modules of itself: which start of it this is, for how long (ms) to believe it."""

    module: str
    instance: int
    flags: int = 0
    hops: int = 0
    lease_ms: int = 5000


class TypeInfo(msgspec.Struct, frozen=True, gc=False):
    """The layout fingerprint (8 bytes) and payload size (bytes) of a topic, as ROLE_... `ANY_TYPE` fits all."""

    role: int
    topic: str
    fingerprint: bytes
    size: int


class Unsubscribe(msgspec.Struct, frozen=True, gc=False):
    """The r2p module that started as `instance` has no subscriber of this topic any more."""

    topic: str
    instance: int


class Endpoint(msgspec.Struct, frozen=True, gc=False):
    """A node's publisher or subscriber, or (role + ROLE_GONE) its end. `publisher_class` is CLASS_..."""

    role: int
    instance: int
    node: str
    topic: str
    publisher_class: int = CLASS_NONE


class Conflict(msgspec.Struct, frozen=True, gc=False):
    """Two modules carry one name."""

    module: str
    instance_a: int
    instance_b: int


Management = (
    Alive
    | Stop
    | Reboot
    | Bootload
    | Advertise
    | SubscribeRequest
    | SubscribeResponse
    | Path
    | Hello
    | TypeInfo
    | Unsubscribe
    | Endpoint
    | Conflict
)

_PUBSUB = "16s H H 10s"
_CODEC = Codec[Management](
    SIZE,
    Record(Alive, 0x11, "7s x B"),
    Record(Stop, 0x12, "7s"),
    Record(Reboot, 0x13, "7s"),
    Record(Bootload, 0x14, "7s"),
    Record(Advertise, 0x21, _PUBSUB),
    Record(SubscribeRequest, 0x22, _PUBSUB),
    Record(SubscribeResponse, 0x23, _PUBSUB),
    Record(Path, 0x31, "7s 8s 16s", may_be_empty=("module", "node", "topic")),
    Record(Hello, 0x50, "7s I B B H", version=_VERSION),
    Record(TypeInfo, 0x51, "B 16s 8s H", version=_VERSION),
    Record(Unsubscribe, 0x52, "16s I", version=_VERSION),
    Record(Endpoint, 0x53, "B I 8s 16s B", version=_VERSION, may_be_empty=("node",)),
    Record(Conflict, 0x54, "7s I I", version=_VERSION),
)


def encode(message: Management) -> bytes:
    """The 32 bytes of a message. Raises `MessageError`, which names the field, when a value does not fit."""
    if isinstance(message, SubscribeRequest) and not message.queue:
        raise MessageError("SubscribeRequest.queue = 0 halts firmware: ask for 1 or more messages")
    return _CODEC.encode(message)


def decode(data: bytes) -> Management:
    """The message in these 32 bytes. Raises `UnknownType` for a type or version to ignore, else `DecodeError`."""
    return _CODEC.decode(data)
