"""The records of an MCAP file, read without trust in its numbers: each length is checked against the size of the file.

A file may be cut, damaged or hostile. What can't be read raises BagError, and nothing is allocated for a number that
stands in the file: records are never longer than the rest of the file, and chunks unpack to CHUNK_MAX bytes at most.
"""

import itertools
import struct
import zlib
from collections.abc import Callable, Iterable
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Final, TypeVar

import msgspec
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode

from r2p.errors import BagError
from r2p.recording.format import MAGIC, MESSAGE, MESSAGE_RECORD, RECORD_HEAD

if TYPE_CHECKING:
    from collections.abc import Container

R = TypeVar("R")

CHUNK_MAX: Final = 1 << 28
"""Bytes of messages in one chunk, at most; of a larger one nothing is read."""

MESSAGES_MAX: Final = 1 << 20
"""Messages in one chunk, at most: a chunk of some kilobytes may unpack to millions without content."""

TIME_MAX: Final = (1 << 64) - 1
"""The last instant that a file can have (UTC, ns)."""

_RECORD_MAX: Final = 1 << 28  # bytes of a record that is neither a chunk nor an attachment
_CHUNK_HEAD: Final = struct.Struct("<QQQII")  # start, end, size, CRC, length of the name of the compression
_LENGTH: Final = struct.Struct("<Q")
_AT_ONCE: Final = 1 << 24  # bytes that are unpacked in one go
_STEP: Final = 1 << 20  # ... and in several: each of this size
_OTHERS: Final = {
    b"SQLite format 3": "is a bag of rosbag2 in SQLite: ros2 bag convert makes it MCAP",
    b"#ROSBAG V2": "is a bag of ROS 1: r2p bag convert reads it",
    b"\x28\xb5\x2f\xfd": "is compressed: unzstd FILE makes it readable",
    b"\x04\x22\x4d\x18": "is compressed: unlz4 FILE makes it readable",
}

MessageRecord = tuple[int, int, int, int, bytes]
"""Log time, id of the channel, sequence, publish time, data."""


class ChunkRef(msgspec.Struct, frozen=True, gc=False):
    """A chunk of a file: the times of its first and last message (ns), where its record begins and how long it is.

    `channels` are the ids of those with messages in it, None if that is unknown. `index_length` are the bytes of the
    indexes of messages behind it. Messages that stand outside of chunks are collected in chunks that are not `real`.
    """

    start: int
    end: int
    offset: int
    length: int
    index_length: int = 0
    compression: str = ""
    size: int = 0  # bytes of the messages when they are unpacked
    channels: frozenset[int] | None = None
    real: bool = True

    def may_have(self, channels: Iterable[int]) -> bool:
        """Return whether there may be messages of one of these channels in it."""
        return self.channels is None or not self.channels.isdisjoint(channels)


class McapReader:
    """An open MCAP file. `size` is that of the file when it was opened: a recorder may go on writing."""

    def __init__(self, path: Path) -> None:
        """Open the file. Raises BagError, also for a file that is not MCAP."""
        self.path = path
        try:
            if not path.is_dir() and path.exists() and not path.is_file():  # a pipe would be waited for
                raise BagError(f"{path} is a pipe or a device: a recording is read at several places, so copy it first")
            self._file: BinaryIO = path.open("rb")
            self.size = self._file.seek(0, 2)
        except OSError as error:
            raise BagError(f"can't read {path}: {error.strerror}") from error
        try:
            self._check_magic()
        except BagError:
            self._file.close()
            raise

    def _check_magic(self) -> None:
        begin = self.read(0, min(self.size, 16))
        if not self.size:
            raise BagError(f"{self.path} is empty: its recorder was stopped before anything was written")
        if not begin.startswith(MAGIC):
            other = next((text for magic, text in _OTHERS.items() if begin.startswith(magic)), "is not an MCAP file")
            raise BagError(f"{self.path} {other.replace('FILE', str(self.path))}")

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def read(self, offset: int, length: int) -> bytes:
        """Return these bytes of the file. Raises BagError if it does not have them."""
        if offset < 0 or length < 0 or offset + length > self.size:
            raise BagError(f"{self.path} ends early")
        try:
            self._file.seek(offset)
            data = self._file.read(length)
        except OSError as error:
            raise BagError(f"can't read {self.path}: {error.strerror}") from error
        except ValueError:
            raise BagError(f"{self.path} is closed: read it inside of its with block") from None
        if len(data) < length:
            raise BagError(f"{self.path} has become shorter while it was read")
        return data

    def head(self, offset: int) -> tuple[int, int]:
        """Return the opcode of the record at `offset`, and the bytes behind its head; they all exist.

        Raises BagError.
        """
        opcode, length = RECORD_HEAD.unpack(self.read(offset, RECORD_HEAD.size))
        if length > self.size - offset - RECORD_HEAD.size:
            raise BagError(f"{self.path} ends early")
        return opcode, length

    def body(self, offset: int, opcode: int) -> bytes:
        """Return the body of the record at `offset`, which must have this opcode. Raises BagError."""
        found, length = self.head(offset)
        if found != opcode or length > _RECORD_MAX:
            raise BagError(f"{self.path} is damaged: at byte {offset} is not what its index says")
        return self.read(offset + RECORD_HEAD.size, length)

    def chunk(self, ref: ChunkRef) -> bytes:
        """Return the records of a chunk, unpacked. Raises BagError."""
        if ref.length > CHUNK_MAX:
            raise self._damaged(ref, "it is too long")
        if not ref.real:
            return self.read(ref.offset, ref.length)
        opcode, length = self.head(ref.offset)
        if opcode != Opcode.CHUNK or length + RECORD_HEAD.size != ref.length:
            raise self._damaged(ref, "it is not what the index says")
        body = self.read(ref.offset + RECORD_HEAD.size, length)
        try:
            return unpacked(body)
        except Exception as error:  # each library has its own errors
            raise self._damaged(ref, str(error) or "its numbers are wrong") from error

    def _damaged(self, ref: ChunkRef, why: str) -> BagError:
        return BagError(f"{self.path}: the chunk at byte {ref.offset} can't be read: {why}")

    def chunk_head(self, offset: int, length: int) -> ChunkRef:
        """Return what the chunk record at `offset` says of itself; `length` is that of its body. Raises BagError."""
        head = self.read(offset + RECORD_HEAD.size, min(length, _CHUNK_HEAD.size + 64))
        try:
            start, end, size, _, name = _CHUNK_HEAD.unpack_from(head)
            compression = head[_CHUNK_HEAD.size :][:name].decode()
        except (struct.error, UnicodeDecodeError) as error:
            raise BagError(f"{self.path} is damaged at byte {offset}") from error
        return ChunkRef(start, end, offset, length + RECORD_HEAD.size, compression=compression, size=size)


def unpacked(body: bytes) -> bytes:
    """Return the records in the body of a chunk. Raises any exception."""
    _, _, size, crc, name = _CHUNK_HEAD.unpack_from(body)
    at = _CHUNK_HEAD.size + name
    compression = body[_CHUNK_HEAD.size : at].decode()
    (length,) = _LENGTH.unpack_from(body, at)
    packed = memoryview(body)[at + _LENGTH.size :][:length]
    if len(packed) != length:
        raise ValueError("it ends early")
    if size > CHUNK_MAX:
        raise ValueError("it is too long")
    data = _decompressed(compression, packed, size)
    if len(data) != size:
        raise ValueError(f"it has {len(data)} bytes, but says {size}")
    if crc and zlib.crc32(data) != crc:
        raise ValueError("its checksum is wrong")
    return data


def unpacked_to_cut(body: bytes) -> bytes:
    """Return the records in the body of a chunk within which the file ends, as far as they go. Raises any exception.

    The last one may be cut; no checksum covers them.
    """
    _, _, size, _, name = _CHUNK_HEAD.unpack_from(body)
    compression = body[_CHUNK_HEAD.size : _CHUNK_HEAD.size + name].decode()
    packed = body[_CHUNK_HEAD.size + name + _LENGTH.size :]
    if not compression:
        return packed
    return _in_steps(_reader(compression, packed), min(size, CHUNK_MAX))


def _decompressed(compression: str, packed: memoryview, size: int) -> bytes:
    if not compression:
        return bytes(packed)
    if compression == "zstd" and size <= _AT_ONCE:
        import zstandard  # only here, as of lz4: most files have one of them, and `r2p bag info` needs neither

        if zstandard.frame_content_size(packed) in {-1, size}:
            return zstandard.decompress(packed, max_output_size=size)
    return _in_steps(_reader(compression, packed), size)


def _reader(compression: str, packed: bytes | memoryview) -> Callable[[int], bytes]:
    """Return a function that unpacks up to so many further bytes; it returns empty bytes at the end, or at a cut.

    Raises ValueError for an unknown compression.
    """
    if compression == "zstd":
        import zstandard

        return zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True).read
    if compression == "lz4":
        import lz4.frame  # type: ignore[import-untyped]

        return _lz4_reader(lz4.frame.LZ4FrameDecompressor(), packed)
    raise ValueError(f"its compression, {compression[:20]!r}, is unknown")


def _lz4_reader(decompressor: Any, packed: bytes | memoryview) -> Callable[[int], bytes]:
    feed = itertools.chain((packed,), itertools.repeat(b""))

    def read(count: int) -> bytes:
        if decompressor.eof:
            return b""
        data: bytes = decompressor.decompress(next(feed), max_length=count)
        return data

    return read


def _in_steps(read: Callable[[int], bytes], size: int) -> bytes:
    """Return what is unpacked, up to a byte more than `size`: as much memory is taken as bytes come out."""
    data = bytearray()
    while len(data) <= size and (piece := read(min(_STEP, size + 1 - len(data)))):
        data += piece
    return bytes(data)


def messages(data: bytes, wanted: "Container[int] | None", start: int, end: int) -> list[MessageRecord]:
    """Return the messages among the records of a chunk: of these channels, with a log time from `start` to `end`.

    What follows a record that is cut is left out. Raises BagError if there are more than MESSAGES_MAX.
    """
    if len(data) > MESSAGES_MAX * MESSAGE_RECORD.size and _has_too_many(data):
        raise BagError(f"a chunk has more than {MESSAGES_MAX} messages")
    found: list[MessageRecord] = []
    unpack, add, at, size = MESSAGE_RECORD.unpack_from, found.append, 0, len(data)
    head, shortest = MESSAGE_RECORD.size, MESSAGE.size
    while at + head <= size:
        opcode, length, channel, sequence, log_time, publish_time = unpack(data, at)
        begin, at = at + head, at + RECORD_HEAD.size + length
        if opcode != Opcode.MESSAGE:
            continue
        if length < shortest or at > size:
            break
        if start <= log_time < end and (wanted is None or channel in wanted):
            add((log_time, channel, sequence, publish_time, data[begin:at]))
    return found


def _has_too_many(data: bytes) -> bool:
    """Return whether there are more than MESSAGES_MAX records."""
    count = at = 0
    while at + RECORD_HEAD.size <= len(data) and count <= MESSAGES_MAX:
        at += RECORD_HEAD.size + RECORD_HEAD.unpack_from(data, at)[1]
        count += 1
    return count > MESSAGES_MAX


def other_records(data: bytes) -> list[tuple[int, bytes]]:
    """Return the records of a chunk that are not messages: opcode and body."""
    found, at = [], 0
    while at + RECORD_HEAD.size <= len(data):
        opcode, length = RECORD_HEAD.unpack_from(data, at)
        begin, at = at + RECORD_HEAD.size, at + RECORD_HEAD.size + length
        if at > len(data):
            break
        if opcode != Opcode.MESSAGE:
            found.append((opcode, data[begin:at]))
    return found


def parse(record: type[R], body: bytes) -> R:
    """Return the body of a record as an object of its class in `mcap.records`. Raises BagError."""
    reader: Any = record
    try:
        found: R = reader.read(ReadDataStream(BytesIO(body)))
    except (McapError, struct.error, ValueError, OverflowError) as error:
        raise BagError(f"a record is damaged: {error}") from error
    return found
