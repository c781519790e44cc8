"""The messages of r2p's own services (PROTOCOL.md 9): calls from one module to another, known without announcements.

A request travels on the topic `R2P_CALL`, its answer on `R2P_REPLY`. Both have at most 200 bytes, but for answers with
several pages, which have `ANSWER_MAX` at most. They begin alike:

| bytes | content |
| --- | --- |
| 0..11 | the header of services (`r2p.codecs.services`): caller, number, kind, version, and the module that is called |
| 12 | `u8 hops`: gateways that the message has crossed |
| 13 | `u8 operation`; from 128 on, those that change something |
| 14..15 | `u16 page` that is wanted, or answered |
| 16..17 | `u16 pages`: how many there are; in a request: how many the answer may have, 0 as 1 |
| 18..19 | `u16 edition` of the content, which all its pages share; 0 in a request for the first page |
| the rest | of a request: its argument; of a response: the page, and those after it; of an error: its text |
"""

import enum
import struct

import msgspec

from r2p.codecs import services
from r2p.codecs.services import HEADER_SIZE, Kind, ServiceHeader
from r2p.errors import DecodeError, MessageError
from r2p.names import CALLS, REPLIES

MESSAGE_MAX = 200
"""Bytes of a message: one line of the debug transport, also with the longest name."""

WIRE_MIN = 2
"""Hello.wire of the modules that know these services, at least."""

CHANGES = 128
"""The first of the operations that change something: they need permission, of gateways on the way as well."""

PAGES_MAX = 1024
"""Pages of the longest content."""

EDITIONS = 1 << 16
"""Values of `edition`; the first is 1."""

_HEAD = struct.Struct("<BBHHH")
_SIZE = HEADER_SIZE + _HEAD.size
_HOPS = slice(HEADER_SIZE, HEADER_SIZE + 1)

PAGE_MAX = MESSAGE_MAX - _SIZE
"""Bytes of an argument, of a page, or of the text of an error."""

PAGES_AT_ONCE_MAX = 8
"""Pages that one answer has, on links that carry messages of any length: their rate lets so many go at once."""

ANSWER_MAX = _SIZE + PAGES_AT_ONCE_MAX * PAGE_MAX
"""Bytes of such an answer."""

_TO_SERVER = (Kind.REQUEST, Kind.CANCEL)
_KIND = 6  # in the header
_OPERATION = HEADER_SIZE + 1
_TOPICS = (REPLIES.encode(), CALLS.encode())


class Operation(enum.IntEnum):
    """Operations of modules; a module answers any other one with an error."""

    SCHEMA = 1
    STATISTICS = 2
    PARAMETERS = 3
    PARAMETER_CHANGES = 4
    NODES = 5
    PARAMETER_STAGE = 128
    PARAMETER_COMMIT = 129
    PARAMETER_SAVE = 130
    PARAMETER_RESET = 131
    NODE_COMMAND = 136
    NODE_CODE = 137
    LOG_LEVEL = 138

    @property
    def changes(self) -> bool:
        """Return whether the operation may change something."""
        return self >= CHANGES


class OwnCall(msgspec.Struct, frozen=True, gc=False):
    """A request, or its answer: see the table above. `operation` is an Operation, or one of a newer version."""

    header: ServiceHeader
    operation: int
    page: int = 0
    pages: int = 0
    edition: int = 0
    body: bytes = b""
    hops: int = 0

    @property
    def target(self) -> int:
        """The instance of the module that the message is for."""
        return self.header.server if self.is_request else self.header.instance

    @property
    def is_request(self) -> bool:
        return self.header.kind in _TO_SERVER

    @property
    def changes(self) -> bool:
        """Return whether the operation may change something."""
        return self.operation >= CHANGES


def page_count(body: bytes) -> int:
    """Return how many pages an answer has; an empty one is a page, too."""
    return max(1, -(-len(body) // PAGE_MAX))


def encode(call: OwnCall) -> bytes:
    """Encode a message. Raises MessageError for more bytes than it carries."""
    most = PAGE_MAX * (PAGES_AT_ONCE_MAX if call.header.kind is Kind.RESPONSE else 1)
    if len(call.body) > most:
        raise MessageError(f"a message of r2p's own services carries {most} bytes, not {len(call.body)}")
    head = _HEAD.pack(call.hops, call.operation, call.page, call.pages, call.edition)
    return services.encode(call.header, head + call.body)


def decode(data: bytes) -> OwnCall:
    """Decode a message. Raises DecodeError, UnknownType for one of another kind or version."""
    most = ANSWER_MAX if len(data) > _KIND and data[_KIND] == Kind.RESPONSE else MESSAGE_MAX
    if not _SIZE <= len(data) <= most:
        raise DecodeError(f"a message of r2p's own services has {_SIZE} to {most} bytes, not {len(data)}")
    header = services.decode(data)
    hops, operation, page, pages, edition = _HEAD.unpack_from(data, HEADER_SIZE)
    return OwnCall(header, operation, page, pages, edition, bytes(data[_SIZE:]), hops)


def topic_of(data: bytes) -> bytes:
    """Return the topic of an encoded message."""
    return _TOPICS[data[_KIND] in _TO_SERVER]


def is_change(data: bytes) -> bool:
    """Return whether bytes may be a request that changes something, which needs a seal on a link with a key."""
    return len(data) >= _SIZE and data[_KIND] in _TO_SERVER and data[_OPERATION] >= CHANGES


def refusal(call: OwnCall, text: str) -> bytes:
    """Encode the answer to a request that this module, or a gateway in the place of the called one, refuses."""
    header = ServiceHeader(call.header.instance, call.header.number, Kind.ERROR, call.header.server)
    return encode(OwnCall(header, call.operation, call.page, body=services.encode_text(text, PAGE_MAX)))


def with_hops(data: bytes, hops: int) -> bytes:
    """Return an encoded message with another number of hops (0 to 255)."""
    return data[: _HOPS.start] + bytes((hops,)) + data[_HOPS.stop :]
