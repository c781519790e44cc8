"""Files of Vector's tools: BLF, which is binary and compressed, and ASC, which is text; by python-can.

| what | BLF | ASC |
| --- | --- | --- |
| times | to a microsecond | to a microsecond, in the local time of the computer that wrote the file |
| what an error frame reports | kept | lost |
| names of buses | a number | a number |

python-can has times as floating-point seconds since 1970, which are good for 0.2 us: so all are rounded.
"""

import contextlib
import logging
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can

from r2p.codecs.can_bits import ERROR, EXTENDED, FRAME_MAX, IDENTIFIER_MASK, LOCAL, REMOTE
from r2p.errors import BagError
from r2p.recording.convert.can_records import FrameRecords, FrameSink
from r2p.recording.convert.stream import ConversionOptions, ConvertedRecord, Losses
from r2p.recording.frames import STANDARD_MASK, RecordedFrame
from r2p.units import MILLISECOND

_MICROSECOND = 1000  # ns
_US_PER_S = 1_000_000
_START = "Start of measurement"
_ASC = ".asc"
_OBJECT = struct.Struct("<4sHHLL")  # of BLF: signature, two numbers, length with this head, kind
_OBJECT_SIGNATURE = b"LOBJ"
_CONTAINER, _DEFLATED = 10, 2
_CONTAINER_HEAD = 16  # bytes
_CONTAINER_MAX = 1 << 24  # bytes of objects; those of Vector's tools have 128 kB

logging.getLogger("can.io").setLevel(logging.ERROR)  # python-can warns for each object that it does not know


def read(path: Path, options: ConversionOptions, losses: Losses) -> Iterator[ConvertedRecord]:
    """Iterate over the frames. A damaged file is read as far as it goes; raises BagError if that is nowhere."""
    records = FrameRecords(options, losses)
    any_read = False
    try:
        with _reader(path) as messages:
            for message in messages:
                any_read = True
                frame = _frame(message)
                if isinstance(frame, str):
                    losses[frame] += 1
                elif (record := records.record(frame)) is not None:
                    yield record
    except OSError:
        raise
    except Exception as error:
        if not any_read:
            raise BagError(f"{path} can't be read: {error!r}") from error
        losses[f"rest of the file, which can't be read ({error!r})"] += 1


@contextlib.contextmanager
def _reader(path: Path) -> Iterator[Any]:
    """Open a file. It is opened here, as python-can leaves a file open whose header it can't read."""
    if path.suffix.lower() == _ASC:
        with path.open(encoding="utf-8", errors="replace") as text:
            yield can.ASCReader(text, relative_timestamp=False)
    else:
        with path.open("rb") as binary:
            yield _BlfReader(binary)


class _BlfReader(can.BLFReader):
    """python-can's reader, but for damage by which that would never end, or take all memory."""

    def __iter__(self) -> Iterator[can.Message]:  # type: ignore[override]
        while head := self.file.read(_OBJECT.size):
            signature, _, _, size, kind = _OBJECT.unpack(head)
            if signature != _OBJECT_SIGNATURE or size < _OBJECT.size:
                raise ValueError("an object is damaged")
            body = self.file.read(size - _OBJECT.size)
            self.file.read(size % 4)  # padding
            if kind == _CONTAINER:
                yield from self._parse_container(_unpacked(body))

    def _parse_container(self, data: bytes) -> Iterator[can.Message]:
        data, self._tail = self._tail + data, b""
        at = 0
        while (at := data.find(_OBJECT_SIGNATURE, at, at + 8)) >= 0 and at + _OBJECT.size <= len(data):
            size = _OBJECT.unpack_from(data, at)[3]
            if not _OBJECT.size <= size <= _CONTAINER_MAX:
                raise ValueError("the length of an object is wrong")
            at += size
        yield from super()._parse_container(data)


def _unpacked(body: bytes) -> bytes:
    """Return what is in a container. Raises ValueError or an error of zlib or struct."""
    (method,) = struct.unpack_from("<H", body)
    packed = body[_CONTAINER_HEAD:]
    if method == _DEFLATED:
        packed = zlib.decompressobj().decompress(packed, _CONTAINER_MAX + 1)
    elif method:
        raise ValueError(f"compression {method} of a container is unknown")
    if len(packed) > _CONTAINER_MAX:
        raise ValueError("a container is too long")
    return packed


def _frame(message: can.Message) -> RecordedFrame | str:
    """Return a message of python-can as a frame, or in words what it is instead."""
    if message.is_fd:
        return "frames of CAN FD"
    remote = message.dlc if message.is_remote_frame and not message.is_error_frame else None
    data = b"" if remote is not None else bytes(message.data)
    identifier, extended = message.arbitration_id, message.is_extended_id and not message.is_error_frame
    if message.is_error_frame:
        data = data[:FRAME_MAX].ljust(FRAME_MAX, b"\0")
    elif identifier > (IDENTIFIER_MASK if extended else STANDARD_MASK) or len(data) > FRAME_MAX or (remote or 0) > 15:
        return "frames that CAN can't have"
    return RecordedFrame(
        round(message.timestamp * _US_PER_S) * _MICROSECOND,
        f"can{message.channel if isinstance(message.channel, int) and message.channel >= 0 else 0}",
        identifier & IDENTIFIER_MASK,
        data,
        extended,
        remote,
        message.is_error_frame,
        not message.is_rx,
    )


def open_sink(path: Path, options: ConversionOptions, losses: Losses) -> "CanFileSink":
    """Begin a file."""
    return CanFileSink(path, losses)


class CanFileSink(FrameSink):
    """Writes a file."""

    def __init__(self, path: Path, losses: Losses) -> None:
        """Begin the file. Raises OSError."""
        super().__init__(losses)
        self._asc = can.ASCWriter(path) if path.suffix.lower() == _ASC else None
        self._writer = self._asc or can.BLFWriter(path)
        self._channels: dict[str, int] = {}
        self._begun = False

    def write(self, frame: RecordedFrame) -> bool:
        channel = self._channels.get(frame.bus)
        if channel is None:
            channel = self._channels[frame.bus] = self._number(frame.bus)
        if frame.bus != f"can{channel}":
            self.losses[f"names of the bus {frame.bus}, which is channel {channel + 1} there"] += 1
        if frame.time % _MICROSECOND:
            self.losses["times finer than a microsecond"] += 1
        if frame.error and self._asc is not None:
            self.losses["contents of error frames"] += 1
        if not self._begun:
            self._begin(frame.time)
        self._writer.on_message_received(_message(frame, channel))
        return True

    def _begin(self, time: int) -> None:
        """Begin an ASC file at a whole millisecond, as its header has no more digits, and times count from there."""
        self._begun = True
        if self._asc is not None:
            self._asc.log_event(_START, time // MILLISECOND / 1000)

    def _number(self, bus: str) -> int:
        """Return the channel of a bus: the number in its name, unless another one has it."""
        taken = set(self._channels.values())
        wanted = bus[3:] if bus.startswith("can") and bus[3:].isdecimal() and len(bus) < 7 else ""
        if wanted and int(wanted) not in taken:
            return int(wanted)
        return next(number for number in range(len(taken) + 1) if number not in taken)

    def finish(self) -> None:
        """The end of the file is written when it is closed."""

    def close(self) -> None:
        self._writer.stop()


def _message(frame: RecordedFrame, channel: int) -> can.Message:
    identifier, data, flags, time = frame.wire
    remote = bool(identifier & REMOTE)
    return can.Message(
        timestamp=time // _MICROSECOND / _US_PER_S,
        arbitration_id=identifier & IDENTIFIER_MASK,
        is_extended_id=bool(identifier & EXTENDED),
        is_remote_frame=remote,
        is_error_frame=bool(identifier & ERROR),
        channel=channel,
        dlc=min(len(data), FRAME_MAX),
        data=None if remote else data,
        is_rx=not flags & LOCAL,
    )
