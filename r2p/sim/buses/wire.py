"""The connection between a served bus and its clients, byte by byte: a private protocol of programs on one computer.

All numbers are little-endian. A client begins with HELLO, and the server answers WELCOME, or REFUSED before it ends:

    HELLO    magic "R2PB", version (u16), first half of the secret (16 bytes), size (u16), JSON: `AttachmentOptions`
    WELCOME  magic, version, second half of the secret, size, JSON: `BusDescription`
    REFUSED  magic, version, 16 zeros, size, a text that says why

A server that gets anything else, or the wrong secret, hangs up. Then both send messages: type (u8), size (u32) of what
follows, at most `BODY_MAX` bytes.

    clients  SEND     records of 13 bytes: identifier (u32), length (u8), data (8 bytes, zeros at the end)
             FILTERS  records of 9 bytes: value (u32), mask (u32), 0: 11 bits, 1: 29 bits, 2: both (u8)
             FLUSH    nothing: drop the frames that wait
             RESTART  nothing: leave bus-off
    server   EVENTS   done (u64), lost (u64), state (u8), error counters (u16, u16), and records of 35 bytes:
                      identifier, length, kind (u8), place of an error (u8), data, end (i64, ns), UTC (i64, ns), error
                      counters

Identifiers have the flags EXTENDED and REMOTE above their 29 bits, as in SocketCAN; the length of a remote frame is the
number of bytes that it asks for. `done` counts the frames of the client that have left its queue, sent or not: it sends
at most `TX_QUEUE` beyond that. `lost` counts events that it did not read in time. `kind`: bit 0 for an own frame, 3
bits for the `ErrorKind` and 3 for the new `ControllerState`, both counted from 1; with 0 for both there is a frame.

The version changes with any of this: both programs need the same one.
"""

from __future__ import annotations

import struct
from enum import IntEnum
from typing import TYPE_CHECKING, Final

import msgspec

from r2p.codecs.can_bits import ERROR, EXTENDED, FRAME_MAX, IDENTIFIER_MASK, REMOTE, Frame, OtherFrame
from r2p.errors import DecodeError
from r2p.sim.buses.attachment import BusFilter, BusFrame
from r2p.sim.can import ControllerState, ErrorKind

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

VERSION: Final = 1
PROOF_SIZE: Final = 16
"""Bytes of the secret that each side sends."""
GREETING_MAX: Final = 32_768
"""Bytes after the head of a greeting, at most: more than the JSON of `FILTERS_MAX` filters."""
BODY_MAX: Final = 1 << 19
"""Bytes of a message after its head, at most: some 15 000 events."""

_MAGIC: Final = b"R2PB"
_GREETING: Final = struct.Struct("<4sH16sH")
_HEAD: Final = struct.Struct("<BI")
_SENT: Final = struct.Struct("<IB8s")
_FILTER: Final = struct.Struct("<IIB")
_STATUS: Final = struct.Struct("<QQBHH")
_EVENT: Final = struct.Struct("<IBBB8sqqHH")

GREETING_SIZE: Final = _GREETING.size
HEAD_SIZE: Final = _HEAD.size
STATUS_SIZE: Final = _STATUS.size
EVENT_SIZE: Final = _EVENT.size
EVENTS_MAX: Final = (BODY_MAX - _STATUS.size) // EVENT_SIZE
"""Events in a message, at most."""

_OWN: Final = 1
_ERROR_SHIFT: Final = 1
_STATE_SHIFT: Final = 4
_THREE_BITS: Final = 0b111
_ERRORS: Final = (None, *ErrorKind, *[None] * (_THREE_BITS - len(ErrorKind)))
_STATES: Final = (None, *ControllerState, *[None] * (_THREE_BITS - len(ControllerState)))
_ERROR_NUMBERS: Final = {kind: _ERRORS.index(kind) << _ERROR_SHIFT for kind in _ERRORS}
_STATE_NUMBERS: Final = {state: _STATES.index(state) << _STATE_SHIFT for state in _STATES}
_WIDTHS: Final = (False, True, None)  # of a filter's `extended`
_COUNTER_MAX: Final = 0xFFFF
_STANDARD_MAX: Final = (1 << 11) - 1
_REMOTE_MAX: Final = 15  # the length field of a frame has 4 bits


class MessageType(IntEnum):
    """The types of messages."""

    SEND = 1
    FILTERS = 2
    FLUSH = 3
    RESTART = 4
    EVENTS = 5


class BusDescription(msgspec.Struct, frozen=True):
    """What a client learns of its bus at first: bit/s, and the name of its own node there.

    At the computer's monotonic instant `since` (ns) the bus had its instant `now`; its time goes `speed` times as fast.
    """

    bitrate: int
    node: str
    now: int
    since: int
    speed: float


class Status(msgspec.Struct, frozen=True):
    """The head of EVENTS."""

    done: int
    lost: int
    state: ControllerState
    tx_errors: int
    rx_errors: int


# Greetings


class Greeting(msgspec.Struct, frozen=True):
    """The head of HELLO, WELCOME and REFUSED; `size` bytes follow."""

    version: int
    proof: bytes
    size: int


def encode_greeting(proof: bytes, body: bytes) -> bytes:
    """Return HELLO or WELCOME; REFUSED with a proof of b""."""
    return _GREETING.pack(_MAGIC, VERSION, proof, len(body)) + body


def decode_greeting(data: bytes) -> Greeting:
    """Return the head of a greeting, of `GREETING_SIZE` bytes. Raises DecodeError for anything else."""
    magic, version, proof, size = _GREETING.unpack(data)
    if magic != _MAGIC or size > GREETING_MAX:
        raise DecodeError("not the greeting of a served bus")
    return Greeting(version, proof, size)


# Messages


def encode_message(kind: MessageType, body: bytes = b"") -> bytes:
    """Return a message."""
    return _HEAD.pack(kind, len(body)) + body


def decode_head(data: bytes | bytearray, offset: int = 0) -> tuple[int, int]:
    """Return type and size of the message at this offset. Raises DecodeError if it is too long."""
    kind, size = _HEAD.unpack_from(data, offset)
    if size > BODY_MAX:
        raise DecodeError(f"a message of {size} bytes, of {BODY_MAX} at most")
    return kind, size


def encode_frames(frames: Iterable[Frame | OtherFrame]) -> bytes:
    """Return the body of SEND."""
    return b"".join([_SENT.pack(*parts(frame)) for frame in frames])


def decode_frames(body: bytes) -> list[Frame | OtherFrame]:
    """Return the frames in the body of SEND. Raises DecodeError."""
    _check_size(body, _SENT)
    return [_frame(identifier, length, data) for identifier, length, data in _SENT.iter_unpack(body)]


def encode_filters(filters: Sequence[BusFilter]) -> bytes:
    """Return the body of FILTERS."""
    return b"".join([_FILTER.pack(each.value, each.mask, _WIDTHS.index(each.extended)) for each in filters])


def decode_filters(body: bytes) -> list[BusFilter]:
    """Return the filters in the body of FILTERS. Raises DecodeError."""
    _check_size(body, _FILTER)
    records = list(_FILTER.iter_unpack(body))
    if any(width >= len(_WIDTHS) for _, _, width in records):
        raise DecodeError("a filter for identifiers of an unknown width")
    return [BusFilter(value, mask, _WIDTHS[width]) for value, mask, width in records]


def encode_status(status: Status) -> bytes:
    """Return the head of the body of EVENTS."""
    number = _STATES.index(status.state)
    counters = min(status.tx_errors, _COUNTER_MAX), min(status.rx_errors, _COUNTER_MAX)
    return _STATUS.pack(status.done, status.lost, number, *counters)


def encode_event(event: BusFrame) -> bytes:
    """Return one record of EVENTS."""
    identifier, length, data = (0, 0, b"") if event.frame is None else parts(event.frame)
    tx_errors, rx_errors = min(event.tx_errors, _COUNTER_MAX), min(event.rx_errors, _COUNTER_MAX)
    kind = event.own | _ERROR_NUMBERS[event.error] | _STATE_NUMBERS[event.state]
    return _EVENT.pack(identifier, length, kind, event.place, data, event.end, event.utc, tx_errors, rx_errors)


def decode_status(body: bytes) -> Status:
    """Return the head of the body of EVENTS. Raises DecodeError."""
    if len(body) < _STATUS.size or (len(body) - _STATUS.size) % EVENT_SIZE:
        raise DecodeError(f"events of {len(body)} bytes")
    done, lost, number, tx_errors, rx_errors = _STATUS.unpack_from(body)
    state = _STATES[number & _THREE_BITS]
    if state is None:
        raise DecodeError(f"unknown state {number} of a controller")
    return Status(done, lost, state, tx_errors, rx_errors)


EventRecord = tuple[int, int, int, int, bytes, int, int, int, int]
"""An event as it is on the wire: cheap to keep, until `decode_event`."""


def event_records(body: bytes) -> Iterator[EventRecord]:
    """Return the records in the body of EVENTS, whose status was decoded."""
    return _EVENT.iter_unpack(memoryview(body)[_STATUS.size :])


def decode_event(record: EventRecord) -> BusFrame:
    """Return the event of a record."""
    identifier, length, kind, place, data, end, utc, tx_errors, rx_errors = record
    if kind <= _OWN:  # most
        return BusFrame(_frame(identifier, length, data), end, utc, kind == _OWN)
    error = _ERRORS[kind >> _ERROR_SHIFT & _THREE_BITS]
    state = _STATES[kind >> _STATE_SHIFT & _THREE_BITS]
    return BusFrame(None, end, utc, bool(kind & _OWN), error, place, state, tx_errors, rx_errors)


def parts(frame: Frame | OtherFrame) -> tuple[int, int, bytes]:
    """Return identifier with flags, length and data of a frame."""
    if type(frame) is Frame:
        return frame.id | EXTENDED, len(frame.data), frame.data
    assert isinstance(frame, OtherFrame)
    flags = frame.extended * EXTENDED
    if frame.remote is not None:
        return frame.id | flags | REMOTE, frame.remote, b""
    return frame.id | flags, len(frame.data), frame.data


def _frame(identifier: int, length: int, data: bytes) -> Frame | OtherFrame:
    number, extended = identifier & IDENTIFIER_MASK, bool(identifier & EXTENDED)
    if identifier & ERROR or (number > _STANDARD_MAX and not extended):
        raise DecodeError(f"not the identifier of a frame: {identifier:#x}")
    if identifier & REMOTE and length <= _REMOTE_MAX:
        return OtherFrame(number, b"", extended, length)
    if length > FRAME_MAX:
        raise DecodeError(f"a frame of {length} bytes, of {FRAME_MAX} at most")
    return Frame(number, data[:length]) if extended else OtherFrame(number, data[:length])


def _check_size(body: bytes, record: struct.Struct) -> None:
    if len(body) % record.size:
        raise DecodeError(f"{len(body)} bytes are no whole records of {record.size}")
