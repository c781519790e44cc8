"""The header of messages on zenoh, whose payload is one packed message or several.

It travels as zenoh's attachment (PROTOCOL.md 10). A fixed part is followed by the origin, which stays the same from
message to message of one publisher; so a reader looks it up in a table, and decodes it once. Messages without a pause
in between may travel together: the payload is then several messages one after the other, whose serials and sequences
count on from those in the header. They are of one size, or the header has their lengths: then its version is 2, for
topics whose messages vary in length. The codecs of credit, and of the sender of management messages, are here, too.

| bytes | what |
| --- | --- |
| 0 | version, 1; 2 with lengths |
| 1 | flags: bit 0 the stamp is not the publisher's, bit 1 there is a clock part |
| 2 | hops: gateways that the message has crossed |
| 3 | messages in the payload besides the first one: m |
| 4..7 | serial: counts the sender's messages on this topic in this class; missing ones were lost on the way |
| 8..15 | sequence: counts the publisher's messages, from 1; 0: unknown |
| 16..23 | stamp, UTC in ns |
| 24..31 | deadline, UTC in ns; 0: none |
| 16 more, if flagged | clock: `u32 epoch; i64 offset; u32 error` |
| 8 m more | stamps of the other messages |
| 4 (m + 1) more, in version 2 | u32: the length of each message |
| the rest | origin: `u8 class; u32 sender; u32 instance; u8 fingerprint[8]`, then `module/node` in ASCII |
"""

import functools
import re
import struct
from collections.abc import Callable
from itertools import accumulate
from typing import Generic, TypeVar

import msgspec

from r2p.codecs import PublisherClass, UnknownType
from r2p.errors import DecodeError
from r2p.messages import ClockOffset
from r2p.names import CARRIED_MAX, MODULE_PATH, MODULE_PATH_MAX, NODE, TOPIC, module_alias

T = TypeVar("T")

VERSION = 1

VERSION_LENGTHS = 2
"""The version of a header that carries the length of each message."""

FLAG_RESTAMPED = 1
FLAG_CLOCK = 2

SERIAL_WRAP = 0xFFFFFFFF
"""Mask for serials, which have 32 bits on the wire."""

_SEQUENCE_MAX = 0xFFFFFFFFFFFFFFFF

_FIXED = struct.Struct("<BBBBIQqq")
_CLOCK = struct.Struct("<IqI")
_ORIGIN = struct.Struct("<BII8s")
_CREDIT = struct.Struct("<BBII")
_LEAVING = 0x80
_SENDER = struct.Struct("<BI")
_unpack = _FIXED.unpack_from
_pack_start = struct.Struct("<IIQqq").pack  # as _FIXED, with the first four bytes as the number of `start_of`

PACKET_MAX = 256
"""Messages in one payload."""

HEADER_MAX = 4096
"""Bytes that no header has: with 256 stamps, lengths and the longest names it has about 3300."""

PACKET_BYTES_MAX = 65_536
"""Bytes of a payload with several messages. A longer message travels alone."""

_TOPIC = re.compile(TOPIC.encode())
_NAMES = re.compile(rf"((?:{MODULE_PATH})?)/((?:{NODE})?)".encode())
_MODULE = re.compile(MODULE_PATH)
_REMEMBERED_MAX = 4096  # origins that a reader keeps, in two halves; forged ones can't fill more memory
_SHOWN_MAX = 40  # bytes of a wrong name that an error shows


class Origin(msgspec.Struct, frozen=True):
    """The publisher of a message, and the module that put it on this network.

    `sender` is the r2p module that sent it: the publisher's, or a gateway; `instance` the number of the publisher's
    module, 0 for firmware. Unknown names are empty. `fingerprint` all zero: unknown type.
    """

    publisher_class: PublisherClass
    sender: int
    instance: int
    fingerprint: bytes
    module: str = ""
    node: str = ""


class Header(msgspec.Struct, frozen=True, gc=False):
    """The header of one message, or of several."""

    origin: Origin
    serial: int
    sequence: int
    stamp: int
    deadline: int = 0
    hops: int = 0
    stamped: bool = True
    clock: ClockOffset | None = None
    more: tuple[int, ...] = ()
    """The stamps of the later messages in the same payload."""
    lengths: tuple[int, ...] = ()
    """The bytes of each message in the payload, on topics whose messages vary in length; else empty."""


class Packer:
    """Packs headers without a clock part, of one origin: the fast way.

    `start` is the result of `start_of`: as one number the first four bytes take one argument of `pack` instead of four.
    """

    __slots__ = ("_pack", "_tail", "origin")

    def __init__(self, origin: Origin) -> None:
        self.origin = origin
        self._tail = _encode_origin(origin)
        self._pack = struct.Struct(f"<IIQqq{len(self._tail)}s").pack

    def one(self, start: int, serial: int, sequence: int, stamp: int, deadline: int) -> bytes:
        """Pack the header of one message."""
        return self._pack(start, serial & SERIAL_WRAP, sequence, stamp, deadline, self._tail)

    def several(self, start: int, serial: int, sequence: int, deadline: int, stamps: list[int]) -> bytes:
        """Pack the header of several messages, PACKET_MAX at most; serial and sequence are those of the first."""
        first, *others = stamps
        more = len(others)
        fixed = _pack_start(start | more << 24, serial & SERIAL_WRAP, sequence, first, deadline)
        return fixed + _stamps(more).pack(*others) + self._tail

    def varying(
        self, start: int, serial: int, sequence: int, deadline: int, stamps: list[int], lengths: list[int]
    ) -> bytes:
        """Pack the header of messages with these lengths, PACKET_MAX at most; `start` is of VERSION_LENGTHS."""
        first, *others = stamps
        more = len(others)
        fixed = _pack_start(start | more << 24, serial & SERIAL_WRAP, sequence, first, deadline)
        return fixed + _stamps(more).pack(*others) + _lengths(more + 1).pack(*lengths) + self._tail


def start_of(hops: int, *, stamped: bool, version: int = VERSION) -> int:
    """Return the first four bytes of the header of one message without a clock part, as a number."""
    return version | (0 if stamped else FLAG_RESTAMPED << 8) | min(hops, 255) << 16


def encode(header: Header) -> bytes:
    """Encode a header; serial and error are cut to their 32 bits, hops to 255."""
    flags = (0 if header.stamped else FLAG_RESTAMPED) | (0 if header.clock is None else FLAG_CLOCK)
    hops, more, serial = min(header.hops, 255), len(header.more), header.serial & SERIAL_WRAP
    version = VERSION_LENGTHS if header.lengths else VERSION
    fixed = _FIXED.pack(version, flags, hops, more, serial, header.sequence, header.stamp, header.deadline)
    clock = header.clock
    if clock is not None:
        fixed += _CLOCK.pack(clock.epoch, clock.offset, min(clock.error, 0xFFFFFFFF))
    lengths = _lengths(more + 1).pack(*header.lengths) if header.lengths else b""
    return fixed + _stamps(more).pack(*header.more) + lengths + _encode_origin(header.origin)


class HeaderReader(Generic[T]):
    """Decodes headers. `remember` is called with each new origin; its result is kept, and returned with its headers."""

    def __init__(self, remember: Callable[[Origin], T]) -> None:
        self._make = remember
        self._recent: dict[bytes, T] = {}
        """Entries by the bytes of the origin that were new or used since `_older` was replaced."""
        self._older: dict[bytes, T] = {}

    @property
    def known(self) -> dict[bytes, T]:
        """Return a copy of the remembered entries, by the bytes of the origin."""
        return self._older | self._recent

    def forget(self, key: bytes) -> None:
        """Forget an origin: `remember` is called again if it returns."""
        self._recent.pop(key, None)
        self._older.pop(key, None)

    def read(  # noqa: C901 - one after the other, without calls: this runs for each packet
        self, data: bytes
    ) -> tuple[T, int, int, tuple[int, ...], int, int, bool, ClockOffset | None, tuple[int, ...]]:
        """Return the result of `remember` for the origin, serial and sequence of the first message, the stamps of all,
        then deadline, hops, whether the stamps are the publisher's, clock, and the lengths of all; () without lengths.

        Raises `UnknownType` for a version to ignore, else `DecodeError`.
        """
        # A tuple, not a `Header`: this runs for each packet, and its reader unpacks the parts at once.
        try:
            version, flags, hops, more, serial, sequence, stamp, deadline = _unpack(data)
        except struct.error:  # too short; a header of another version may be
            version = data[0] if data else VERSION
        if version != VERSION and version != VERSION_LENGTHS:  # faster than `in` with both
            raise UnknownType(f"version {version} of the header")
        if len(data) < _FIXED.size:
            raise _too_short("header", data, _FIXED.size)
        at = _FIXED.size
        clock = None
        if flags & FLAG_CLOCK:
            if len(data) < at + _CLOCK.size:
                raise _too_short("header with a clock", data, at + _CLOCK.size)
            clock = ClockOffset(*_CLOCK.unpack_from(data, at))
            at += _CLOCK.size
        stamps: tuple[int, ...] = (stamp,)
        if more:
            if len(data) < at + 8 * more:
                raise _too_short("header with stamps", data, at + 8 * more)
            stamps += _stamps(more).unpack_from(data, at)
            at += 8 * more
        lengths: tuple[int, ...] = ()
        if version == VERSION_LENGTHS:
            if len(data) < at + 4 * (more + 1):
                raise _too_short("header with lengths", data, at + 4 * (more + 1))
            lengths = _lengths(more + 1).unpack_from(data, at)
            at += 4 * (more + 1)
        if sequence + more > _SEQUENCE_MAX:
            raise DecodeError(f"sequence {sequence} leaves none for {more} more messages")
        tail = data[at:]  # the key of what is known: the origin of a known publisher is not decoded again
        known = self._recent.get(tail)
        if known is None:
            known = self._remember(tail)
        return known, serial, sequence, stamps, deadline, hops, not flags & FLAG_RESTAMPED, clock, lengths

    def _remember(self, tail: bytes) -> T:
        known = self._older.pop(tail, None)
        if known is None:
            known = self._make(_decode_origin(tail))
        if len(self._recent) >= _REMEMBERED_MAX // 2:
            # Forged origins can fill both. An origin that is evicted loses what recognises duplicates of its messages,
            # so it must not be one in use: only one that was absent while 2048 others arrived.
            self._older, self._recent = self._recent, {}
        self._recent[tail] = known
        return known


def decode(data: bytes) -> Header:
    """Decode a header. Raises `UnknownType` for a version to ignore, else `DecodeError`."""
    reader = HeaderReader(lambda origin: origin)
    origin, serial, sequence, stamps, deadline, hops, stamped, clock, lengths = reader.read(data)
    return Header(origin, serial, sequence, stamps[0], deadline, hops, stamped, clock, stamps[1:], lengths)


def split(size: int, count: int, lengths: tuple[int, ...]) -> list[int]:
    """Return where the messages of a payload of `size` bytes end. Raises DecodeError if they can't be its messages.

    Without the payload itself: it is copied only if this, and the receiver's bound, let it pass.
    """
    if count > 1 and size > PACKET_BYTES_MAX:
        raise DecodeError(f"{count} messages in {size} bytes, more than {PACKET_BYTES_MAX}")
    if not lengths:
        each, odd = divmod(size, count)
        if odd or not each:
            raise DecodeError(f"{size} bytes for {count} messages")
        return list(range(each, size + 1, each))
    ends = list(accumulate(lengths))
    if ends[-1] != size:
        raise DecodeError(f"lengths of {ends[-1]} bytes for a payload of {size}")
    return ends


class Credit(msgspec.Struct, frozen=True, gc=False):
    """The progress of a subscriber's session: up to this serial of the publisher's session, in this topic and class.

    `leaving`: it no longer subscribes, so this is its final credit.
    """

    session: int
    publisher_class: PublisherClass
    serial: int
    topic: str
    leaving: bool = False


def encode_credit(credit: Credit) -> bytes:
    """`u8 version; u8 class; u32 session; u32 serial`, then the topic in ASCII; class + 128: `leaving`."""
    publisher_class = credit.publisher_class | _LEAVING * credit.leaving
    fixed = _CREDIT.pack(VERSION, publisher_class, credit.session, credit.serial & SERIAL_WRAP)
    return fixed + credit.topic.encode()


def decode_credit(data: bytes) -> Credit:
    """Decode a credit. Raises `UnknownType` for a version to ignore, else `DecodeError`."""
    _check_version(data, "credit")
    if len(data) < _CREDIT.size:
        raise _too_short("credit", data, _CREDIT.size + 1)
    if len(data) - _CREDIT.size > CARRIED_MAX or _TOPIC.fullmatch(data, _CREDIT.size) is None:
        raise DecodeError(f"credit for {data[_CREDIT.size :][:_SHOWN_MAX]!r}, which is not a valid topic")
    _, publisher_class, session, serial = _CREDIT.unpack_from(data)
    leaving = bool(publisher_class & _LEAVING)
    return Credit(session, _checked_class(publisher_class & ~_LEAVING), serial, data[_CREDIT.size :].decode(), leaving)


def encode_sender(session: int) -> bytes:
    """Encode the sender of a management message: `u8 version; u32 session`."""
    return _SENDER.pack(VERSION, session)


def decode_sender(data: bytes) -> int:
    """Return the session. Raises `UnknownType` for a version to ignore, else `DecodeError`."""
    _check_version(data, "sender")
    if len(data) != _SENDER.size:
        raise DecodeError(f"sender of {len(data)} bytes, {_SENDER.size} needed")
    session: int = _SENDER.unpack(data)[1]
    return session


def name_for(module: str) -> str:
    """Return a module's name in headers: its alias if it is too long or in two namespaces; empty if neither fits."""
    for name in (module, module_alias(module)):
        if len(name) <= MODULE_PATH_MAX and _MODULE.fullmatch(name):
            return name
    return ""


def _check_version(data: bytes, what: str) -> None:
    if data and data[0] != VERSION:  # without any bytes it is too short, of whatever version
        raise UnknownType(f"version {data[0]} of the {what}")


def _too_short(what: str, data: bytes, needed: int) -> DecodeError:
    return DecodeError(f"{what} too short: {len(data)} bytes, at least {needed} needed")


@functools.cache
def _stamps(count: int) -> struct.Struct:
    return struct.Struct(f"<{count}q")


@functools.cache
def _lengths(count: int) -> struct.Struct:
    return struct.Struct(f"<{count}I")


def _encode_origin(origin: Origin) -> bytes:
    fixed = _ORIGIN.pack(origin.publisher_class, origin.sender, origin.instance, origin.fingerprint)
    return fixed + f"{origin.module}/{origin.node}".encode()


def _decode_origin(data: bytes) -> Origin:
    names = _NAMES.fullmatch(data, _ORIGIN.size)
    if names is None or len(names[1]) > MODULE_PATH_MAX:
        raise DecodeError(f"header ends in {data[_ORIGIN.size :][:_SHOWN_MAX]!r}, which is not a valid `module/node`")
    number, sender, instance, fingerprint = _ORIGIN.unpack_from(data)
    return Origin(_checked_class(number), sender, instance, fingerprint, names[1].decode(), names[2].decode())


def _checked_class(number: int) -> PublisherClass:
    try:
        return PublisherClass(number)
    except ValueError:
        raise DecodeError(f"{number} is not a publisher class") from None
