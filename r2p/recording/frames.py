"""CAN frames in a bag: what is written of them, and how they are read again.

    /BUS/frames           every frame that was on the bus, as `can_msgs/msg/Frame`: its stamp is the end of the frame
    /BUS/frames/details   what that message has no field for, and what was not recorded, as `FrameDetails`

A bus has a channel for each direction, as can_msgs has no field for that: frames that this computer sent, and those
that it received. `BusInfo` is in the metadata of both. An error frame is as SocketCAN has it: the classes of errors as
its identifier, and 8 bytes about them.

In this package a frame is a tuple (`WireFrame`) until it is written: tens of thousands a second come in batches. Their
bytes are made in the thread that writes.
"""

import re
import struct
from collections.abc import Callable, Mapping
from itertools import count
from typing import Annotated, Self

import msgspec

from r2p.codecs.can_bits import ERROR, EXTENDED, FRAME_MAX, IDENTIFIER_MASK, LOCAL, REMOTE, WireFrame
from r2p.errors import DecodeError
from r2p.messages import Len, Max, Message, i64, u8, u32, u64
from r2p.msg import Header
from r2p.recording.entries import BagEntry, EntryWriter
from r2p.recording.format import CDR, SEQUENCE_MASK
from r2p.recording.writer import BagWriter
from r2p.ros.cdr import HEADER as CDR_HEADER
from r2p.ros.ros2_schemas import schema_of
from r2p.units import SECOND

FRAME_TYPE = "can_msgs/msg/Frame"
STANDARD_MASK = 0x7FF
"""The identifiers of 11 bits."""

_FRAME_MEMORY = 200  # bytes of a WireFrame, about
SENDERS_MAX = 64
_NAME_MAX = 64
TEXT_MAX = 256
_NOT_IN_NAMES = re.compile(r"[^A-Za-z0-9_]+")
_KINDS = tuple(bytes((kind >> 1 & 1, kind >> 2, kind & 1)) for kind in range(8))
"""The three flags of a frame, each a byte of can_msgs/Frame, by the highest three bits of its identifier."""

_KIND_SHIFT = 29
_LENGTH_MAX = 15  # in the length field of a frame; only remote frames have more than 8 there
_TIME = struct.Struct("<iII")
_REST = struct.Struct("<I???B8s")
_START = len(CDR_HEADER)


class CanFrame(Message, name="can_msgs/Frame"):
    """A CAN frame as ROS's drivers publish it. `dlc` of a remote frame is the number of bytes that it asks for."""

    header: Header = Header()
    id: u32 = 0
    is_rtr: bool = False
    is_extended: bool = False
    is_error: bool = False
    dlc: u8 = 0
    data: Annotated[bytes, Len(FRAME_MAX)] = bytes(FRAME_MAX)


class FrameDetails(Message, name="r2p_msgs/FrameDetails"):
    """What was on a bus besides the frames themselves. Instants are UTC, in ns.

    | `event` | of | what it has |
    | --- | --- | --- |
    | `frame` | a simulated bus | each frame: its exact `start` and `end`, its `bits`, stuffed ones included, and its `senders` |
    | `error` | a simulated bus | the same of an attempt that an error frame ended; `text` is the kind of error |
    | `arbitration lost` | a simulated bus | the identifier that lost, from `start` until it gave up at `end` |
    | `lost` | all | `count` frames that were on the bus and are not in the file; `text` says why |
    | `fault` | all | what the interface reported, in `text` |
    | `up`, `down`, `waiting` | all | the state of the interface; `text` is the reason |
    """  # noqa: E501 - a table

    event: Annotated[str, Max(_NAME_MAX)] = ""
    id: u32 = 0
    start: i64 = 0
    end: i64 = 0
    bits: u32 = 0
    count: u64 = 0
    senders: Annotated[tuple[Annotated[str, Max(_NAME_MAX)], ...], Max(SENDERS_MAX)] = ()
    text: Annotated[str, Max(TEXT_MAX)] = ""


class BusInfo(msgspec.Struct, frozen=True):
    """A bus of a recording: its name, the link (as in `r2p.Link.name`), and the parameters of its URL.

    `bitrate` in bit/s; `slots` of a cycle of `cycle` ns, until the master's announcement in the recording itself.
    """

    name: str
    link: str = ""
    bitrate: int = 1_000_000
    slots: int = 60
    cycle: int = 10_000_000

    @property
    def topic(self) -> str:
        """The name of the channel of its frames."""
        return f"/{self.name}/frames"

    @property
    def details(self) -> str:
        """The name of the channel of its details."""
        return f"{self.topic}/details"

    def metadata(self, *, sent: bool) -> dict[str, str]:
        """Return the metadata of the channel of one direction."""
        values = {name: f"{getattr(self, name)}" for name in ("link", "bitrate", "slots", "cycle")}
        return {"bus": self.name, "direction": "tx" if sent else "rx", **values}

    @classmethod
    def from_metadata(cls, metadata: Mapping[str, str]) -> Self | None:
        """Parse the metadata of a channel; return None for a channel of another program.

        Raises DecodeError for a number that can't be.
        """
        if "bus" not in metadata:
            return None
        numbers = {}
        for name in ("bitrate", "slots", "cycle"):
            text = metadata.get(name, "")
            if not (text.isascii() and text.isdecimal() and 0 < int(text[:20]) < SECOND << 10):
                raise DecodeError(f"{name} {text[:40]!r} of bus {metadata['bus'][:40]!r} is not a number")
            numbers[name] = int(text)
        return cls(metadata["bus"], metadata.get("link", ""), **numbers)


def bus_name(address: str) -> str:
    """Return the name of a bus in a recording, by the address of its URL: `slcan_dev_ttyACM0`, or `can0`."""
    return _NOT_IN_NAMES.sub("_", address).strip("_") or "can"


class FrameEntry(BagEntry, gc=False):
    """Frames of one bus to be written. `utc_offset`: ns from their stamps, which are monotonic, to UTC."""

    bus: BusInfo
    frames: list[WireFrame]
    utc_offset: int = 0

    @property
    def nbytes(self) -> int:
        return _FRAME_MEMORY * (1 + len(self.frames))

    @property
    def lost_as(self) -> str:
        return self.bus.topic

    @property
    def count(self) -> int:
        return len(self.frames)

    def write(self, out: EntryWriter) -> None:
        out.part(FrameWriter).write(self)


class FrameWriter:
    """Writes frames into a bag."""

    def __init__(self, writer: BagWriter) -> None:
        self._writer = writer
        self._buses: dict[BusInfo, _WrittenBus] = {}

    def write(self, entry: FrameEntry) -> None:
        """Write all frames of an entry. Their log time is their stamp: that is when they were received."""
        bus = self._buses.get(entry.bus) or self._begin(entry.bus)
        add, offset, pack, name, kinds = self._writer.add, entry.utc_offset, bus.pack, bus.name, _KINDS
        for identifier, data, flags, stamp in entry.frames:
            time = stamp + offset
            seconds, rest = divmod(time, SECOND)
            packed = pack(
                CDR_HEADER, seconds, rest, len(name), name,
                identifier & IDENTIFIER_MASK, kinds[identifier >> _KIND_SHIFT], len(data), data,
            )  # fmt: skip
            channel = bus.channel(sent=bool(flags & LOCAL))
            add(channel, time, time, next(bus.numbers) & SEQUENCE_MASK, packed)

    def _begin(self, bus: BusInfo) -> "_WrittenBus":
        written = self._buses[bus] = _WrittenBus(bus, self._writer)
        return written


class _WrittenBus:
    """The channels of a bus, and the function that packs its frames: only the length of its name matters to that."""

    def __init__(self, bus: BusInfo, writer: BagWriter) -> None:
        self.name = bus.name.encode() + b"\0"
        self.numbers = count(1)
        self.pack: Callable[..., bytes] = _struct_for(len(self.name)).pack
        self._bus = bus
        self._writer = writer
        self._channels: dict[bool, int] = {}

    def channel(self, *, sent: bool) -> int:
        """Return the channel of one direction."""
        if sent not in self._channels:
            schema, metadata = schema_of(CanFrame).record, self._bus.metadata(sent=sent)
            self._channels[sent] = self._writer.add_channel(self._bus.topic, CDR, metadata, schema)
        return self._channels[sent]


def _struct_for(length: int) -> struct.Struct:
    """Return the layout of can_msgs/Frame for a name of this length, its NUL included."""
    return struct.Struct(f"<{_START}siII{length}s{-length % 4}xI3sB{FRAME_MAX}s")


# Reading


class RecordedFrame(msgspec.Struct, frozen=True, gc=False):
    """A frame of a recording: when it ended (UTC, ns), on which bus, and what it was.

    `remote` is the number of bytes that a remote frame asks for; `sent`: this computer sent it.
    """

    time: int
    bus: str
    id: int
    data: bytes
    extended: bool = True
    remote: int | None = None
    error: bool = False
    sent: bool = False

    @property
    def wire(self) -> WireFrame:
        """The frame as it goes into a `FrameEntry`, with its time as the stamp."""
        flags = EXTENDED * self.extended | REMOTE * (self.remote is not None) | ERROR * self.error
        data = self.data if self.remote is None else bytes(self.remote)
        return self.id | flags, data, LOCAL * self.sent, self.time


def frame_of(data: bytes, bus: str, *, sent: bool = False) -> RecordedFrame:
    """Return the frame of a can_msgs/Frame in CDR. Raises DecodeError."""
    try:
        seconds, rest, length = _TIME.unpack_from(data, _START)
        at = _START + _TIME.size + length
        identifier, remote, extended, error, size, content = _REST.unpack_from(data, at + -length % 4)
    except struct.error as problem:
        raise DecodeError(f"not a can_msgs/Frame: {problem}") from None
    if not data.startswith(CDR_HEADER[:2]):
        raise DecodeError("not a can_msgs/Frame in little-endian CDR")
    found = RecordedFrame(
        seconds * SECOND + rest,
        bus,
        identifier,
        b"" if remote else content[:size],
        extended,
        size if remote else None,
        error,
        sent,
    )
    return _checked(found, size)


def frame_of_message(message: CanFrame, bus: str, *, sent: bool = False) -> RecordedFrame:
    """Return the frame of a message. Raises DecodeError for one that is not of CAN 2.0."""
    size = message.dlc
    data, remote = (b"", size) if message.is_rtr else (message.data[:size], None)
    stamp = message.header.stamp.ns
    found = RecordedFrame(stamp, bus, message.id, data, message.is_extended, remote, message.is_error, sent)
    return _checked(found, size)


def _checked(frame: RecordedFrame, size: int) -> RecordedFrame:
    longest = FRAME_MAX if frame.remote is None else _LENGTH_MAX
    highest = IDENTIFIER_MASK if frame.extended or frame.error else STANDARD_MASK
    if frame.id > highest or size > longest:
        raise DecodeError(f"not a frame of CAN 2.0: identifier {frame.id:#x}, {size} bytes")
    return frame
