"""One MCAP file that is being written: records and chunks one behind the other, then the summary.

What was written in whole stays readable whatever comes after: a record that does not fit on the disk is cut off again.
Schemas and channels stand before the chunks, not in them, so a chunk holds nothing but messages.
"""

import contextlib
import io
import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from typing import Any, BinaryIO, Self

import msgspec
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from r2p.errors import DecodeError
from r2p.recording.format import INDEX, INDEX_ENTRY, MAGIC, PROFILE, RECORD_HEAD
from r2p.version import __version__

LIBRARY = f"r2p {__version__}"

_LINE_SIZE = RECORD_HEAD.size + 64  # bytes of a chunk in the summary, without its channels and its compression
_PER_CHANNEL = 10  # bytes of a number of a channel
_FOOTER_IN_CRC = struct.Struct("<BQQQ")
_GROUPS = Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX


def packed(record: McapRecord) -> bytes:
    """Return the bytes of a record."""
    builder: Any = RecordBuilder()  # not all of its methods have types
    record.write(builder)
    data: bytes = builder.end()
    return data


class ChunkMessages(msgspec.Struct, frozen=True, gc=False):
    """The messages of one channel in a chunk: their number, and where their index is, behind the chunk."""

    count: int
    offset: int


class PackedChunk(msgspec.Struct, frozen=True):
    """A chunk as it stands in a file: its record, the records of its index, and what a summary says of it."""

    record: bytes
    index: bytes
    start: int
    end: int
    compression: str
    compressed_size: int
    uncompressed_size: int
    channels: dict[int, ChunkMessages]

    @property
    def size(self) -> int:
        """Bytes in the file."""
        return len(self.record) + len(self.index)

    @classmethod
    def make(cls, chunk: Chunk, index: bytes) -> Self:
        """Make one of its record and the records of its index. Raises DecodeError if the index is damaged."""
        return cls(
            packed(chunk),
            index,
            chunk.message_start_time,
            chunk.message_end_time,
            chunk.compression,
            len(chunk.data),
            chunk.uncompressed_size,
            dict(_channels(index)),
        )

    @property
    def summary_size(self) -> int:
        """Bytes of its line in a summary, and of the counts of its channels there, at the most."""
        return _LINE_SIZE + len(self.compression) + 2 * _PER_CHANNEL * len(self.channels)

    def summary(self, position: int) -> ChunkIndex:
        """Return what the summary of a file says of this chunk, at this position."""
        behind = position + len(self.record)
        return ChunkIndex(
            chunk_length=len(self.record),
            chunk_start_offset=position,
            compression=self.compression,
            compressed_size=self.compressed_size,
            message_end_time=self.end,
            message_index_length=len(self.index),
            message_index_offsets={channel: behind + part.offset for channel, part in self.channels.items()},
            message_start_time=self.start,
            uncompressed_size=self.uncompressed_size,
        )


def _channels(index: bytes) -> Iterator[tuple[int, ChunkMessages]]:
    position, seen = 0, set()
    while position < len(index):
        try:
            opcode, length = RECORD_HEAD.unpack_from(index, position)
            channel, size = INDEX.unpack_from(index, position + RECORD_HEAD.size)
        except struct.error:
            raise DecodeError("the index of a chunk is cut short") from None
        fits = length == INDEX.size + size and size % INDEX_ENTRY == 0
        if opcode != Opcode.MESSAGE_INDEX or not fits or channel in seen:
            raise DecodeError("the index of a chunk is damaged")
        seen.add(channel)
        yield channel, ChunkMessages(size // INDEX_ENTRY, position)
        position += RECORD_HEAD.size + length
    if position > len(index):
        raise DecodeError("the index of a chunk is cut short")


def message_index(channel: int, pairs: bytes) -> bytes:
    """Return the index of a channel's messages in a chunk: pairs of log time and offset, packed."""
    return RECORD_HEAD.pack(Opcode.MESSAGE_INDEX, INDEX.size + len(pairs)) + INDEX.pack(channel, len(pairs)) + pairs


class _Written(msgspec.Struct, frozen=True, gc=False):
    """A record or chunk of the file: where it begins, the checksum of all before it, and its line in the summary."""

    position: int
    crc: int
    opcode: int
    line: bytes
    start: int = 0
    end: int = 0


class McapWriter:
    """A file that is being written. `size`: its bytes so far; `summary_size`: those that `finish` adds at the most."""

    def __init__(self, file: BinaryIO, *, profile: str = PROFILE) -> None:
        """Begin the file. Raises OSError, as all of its methods do that write."""
        self._file = file
        self.size = 0
        self._crc = 0
        self._written: list[_Written] = []
        self._schemas: dict[int, bytes] = {}
        self._channels: dict[int, bytes] = {}
        self._counts: Counter[int] = Counter()
        self.summary_size = 1 << 10  # the records of a fixed size at the end have less
        self._put(MAGIC + packed(Header(profile, LIBRARY)))

    def write(self, item: McapRecord | PackedChunk) -> None:
        """Write a chunk, or a record that stands outside of chunks."""
        before, crc = self.size, self._crc
        if isinstance(item, PackedChunk):
            self._put(item.record + item.index)
            self._counts.update({channel: part.count for channel, part in item.channels.items()})
            self._enter(before, crc, packed(item.summary(before)), item)
        else:
            data = packed(item)
            self._put(data)
            self._enter(before, crc, self._line(item, data, before))

    def _line(self, record: McapRecord, data: bytes, position: int) -> bytes:
        if isinstance(record, Schema):
            self._schemas[record.id] = data
        elif isinstance(record, Channel):
            self._channels[record.id] = data
        elif isinstance(record, Metadata):
            return packed(MetadataIndex(position, len(data), record.name))
        elif isinstance(record, Attachment):
            size = len(record.data)
            times = record.log_time, record.create_time
            return packed(AttachmentIndex(position, len(data), *times, size, record.name, record.media_type))
        return data

    def _enter(self, position: int, crc: int, line: bytes, chunk: PackedChunk | None = None) -> None:
        self.summary_size += len(line) if chunk is None else chunk.summary_size
        times = (chunk.start, chunk.end) if chunk else ()
        self._written.append(_Written(position, crc, line[0], line, *times))

    @property
    def counts(self) -> dict[int, int]:
        """The messages of each channel."""
        return dict(self._counts)

    @property
    def has_messages(self) -> bool:
        """Whether the file has a chunk."""
        return bool(self._counts)

    def finish(self) -> None:
        """Write the summary and the end of the file, and leave it open."""
        end = packed(DataEnd(self._crc))
        start = self.size + len(end)
        builder: Any = RecordBuilder()
        groups: list[SummaryOffset] = []
        for opcode, lines in self._summary():
            begin = builder.count
            for line in lines:
                builder.write(line)
            if builder.count > begin:
                groups.append(SummaryOffset(opcode, start + begin, builder.count - begin))
        offsets = start + builder.count
        for group in groups:
            group.write(builder)
        summary = builder.end()
        crc = zlib.crc32(_FOOTER_IN_CRC.pack(Opcode.FOOTER, 20, start, offsets), zlib.crc32(summary))
        self._put(end + summary + packed(Footer(start, offsets, crc)) + MAGIC)
        self._file.flush()

    def _summary(self) -> Iterator[tuple[Opcode, list[bytes]]]:
        yield Opcode.SCHEMA, list(self._schemas.values())
        yield Opcode.CHANNEL, list(self._channels.values())
        yield Opcode.STATISTICS, [packed(self._statistics())]
        for opcode in _GROUPS:
            yield opcode, [item.line for item in self._written if item.opcode == opcode]

    def _statistics(self) -> Statistics:
        start, end = self._times()
        records = Counter(item.opcode for item in self._written)
        return Statistics(
            attachment_count=records[Opcode.ATTACHMENT_INDEX],
            channel_count=len(self._channels),
            channel_message_counts=dict(self._counts),
            chunk_count=records[Opcode.CHUNK_INDEX],
            message_count=self._counts.total(),
            message_end_time=end,
            message_start_time=start,
            metadata_count=records[Opcode.METADATA_INDEX],
            schema_count=len(self._schemas),
        )

    def _times(self) -> tuple[int, int]:
        chunks = [item for item in self._written if item.opcode == Opcode.CHUNK_INDEX]
        return min((item.start for item in chunks), default=0), max((item.end for item in chunks), default=0)

    def drop_last_chunk(self) -> PackedChunk | None:
        """Truncate the file before its last chunk to make room for the summary. Return the chunk, None without one."""
        while self._written:
            item = self._written.pop()
            chunk = self._read_back(item.position) if item.opcode == Opcode.CHUNK_INDEX else None
            self.size, self._crc = item.position, item.crc
            self._file.seek(self.size)
            self._file.truncate()
            if chunk is not None:
                self._counts.subtract({channel: part.count for channel, part in chunk.channels.items()})
                self._counts = +self._counts
                return chunk
        return None

    def _read_back(self, position: int) -> PackedChunk:
        """Return the last chunk, which stands there."""
        self._file.seek(position)
        data = self._file.read(self.size - position)
        length = RECORD_HEAD.size + RECORD_HEAD.unpack_from(data)[1]
        record: Any = Chunk
        return PackedChunk.make(record.read(ReadDataStream(io.BytesIO(data[RECORD_HEAD.size : length]))), data[length:])

    def _put(self, data: bytes) -> None:
        rest = memoryview(data)
        try:
            while rest:
                rest = rest[self._file.write(rest) :]
        except OSError:
            with contextlib.suppress(OSError):
                self._file.seek(self.size)
                self._file.truncate()
            raise
        self._crc = zlib.crc32(data, self._crc)
        self.size += len(data)
