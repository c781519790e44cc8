"""What is in a bag: from the summary at its end, or, where that is missing, by a walk from record to record.

The summary of 1 GB is some hundred kB, and read in milliseconds. The walk reads the heads of chunks and their indexes
only; it is for files that are being written, or were cut.
"""

import struct
import zlib
from collections import Counter
from typing import Final

import msgspec
from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, Channel, Footer, Header, MetadataIndex, Schema, Statistics

from r2p.errors import BagError
from r2p.recording.format import INDEX, INDEX_ENTRY, MAGIC, MESSAGE, RECORD_HEAD
from r2p.recording.mcap_reader import (
    TIME_MAX,
    ChunkRef,
    McapReader,
    messages,
    other_records,
    parse,
)

_FOOTER: Final = RECORD_HEAD.size + 20 + len(MAGIC)  # bytes of the footer and of the magic behind it
_SECTION_MAX: Final = 1 << 28  # bytes of a summary
_DEFINITIONS_MAX: Final = 1 << 28  # bytes of schemas and channels, repeated ones included
_PIECE: Final = 1 << 20  # bytes of messages outside of chunks that are read together
_CHUNK_INDEX: Final = struct.Struct("<QQQQI")
_CHANNEL_OFFSET: Final = 10  # bytes of an id and an offset
_SIZES: Final = struct.Struct("<QQ")
_ATTACHMENT_HEAD: Final = 4096  # bytes in which the names of an attachment are
_ATTACHMENT: Final = struct.Struct("<QQI")  # times, length of the name


class Summary(msgspec.Struct, eq=False):
    """The contents of a file. `counts` are the messages by channel, `start` and `end` times of messages (ns; 0: none).

    `problem` says what is wrong with the file; it is empty for one that ends as it should. `damaged` counts chunks that
    can't be read.
    """

    library: str = ""
    channels: dict[int, Channel] = {}
    schemas: dict[int, Schema] = {}
    chunks: list[ChunkRef] = []
    counts: Counter[int] = msgspec.field(default_factory=Counter)
    attachments: list[AttachmentIndex] = []
    metadata: list[MetadataIndex] = []
    start: int = 0
    end: int = 0
    problem: str = ""
    damaged: int = 0
    definitions: int = 0
    """Bytes of the schemas and channels."""

    def add(self, opcode: int, body: bytes) -> None:
        """Enter a schema or a channel; other records are left out. Raises BagError."""
        if opcode in {Opcode.CHANNEL, Opcode.SCHEMA}:
            self.definitions += len(body)
            if self.definitions > _DEFINITIONS_MAX:
                raise BagError("the schemas and channels are too long")
        if opcode == Opcode.CHANNEL:
            channel = parse(Channel, body)
            self.channels.setdefault(channel.id, channel)
        elif opcode == Opcode.SCHEMA:
            schema = parse(Schema, body)
            self.schemas.setdefault(schema.id, schema)

    def finish(self) -> "Summary":
        """Find the times of all messages from those of the chunks."""
        filled = [chunk for chunk in self.chunks if chunk.end]
        self.start = min((chunk.start for chunk in filled), default=0)
        self.end = max((chunk.end for chunk in filled), default=0)
        return self


def read_summary(file: McapReader) -> Summary:
    """Return what is in a file, whatever its state is. Raises BagError if it can't be read at all."""
    footer = _footer(file)
    if footer is None:
        return _Walk(file, "has no end: it is still being written, or its recorder was killed").summary()
    if not footer.summary_start:
        return _Walk(file).summary()
    try:
        found = _from_section(file, footer)
    except (BagError, struct.error, UnicodeDecodeError):
        return _Walk(file, "is damaged: its summary can't be read").summary()
    return found or _Walk(file).summary()


def _footer(file: McapReader) -> Footer | None:
    """Return the footer of a file; None if it does not end with one."""
    at = file.size - _FOOTER
    if at < len(MAGIC) or file.read(file.size - len(MAGIC), len(MAGIC)) != MAGIC:
        return None
    try:
        return parse(Footer, file.body(at, Opcode.FOOTER))
    except BagError:
        return None


def _from_section(file: McapReader, footer: Footer) -> Summary | None:
    """Parse the summary section; return None if a walk through the file would find more."""
    length = file.size - len(MAGIC) - footer.summary_start
    if length > _SECTION_MAX:
        raise BagError("the summary is too long")
    section = file.read(footer.summary_start, length)
    if footer.summary_crc and zlib.crc32(section[:-4]) != footer.summary_crc:
        raise BagError("the checksum of the summary is wrong")
    found = Summary(library=_library(file))
    statistics: Statistics | None = None
    at = 0
    while at + RECORD_HEAD.size <= len(section):
        opcode, length = RECORD_HEAD.unpack_from(section, at)
        begin, at = at + RECORD_HEAD.size, at + RECORD_HEAD.size + length
        if opcode == Opcode.CHUNK_INDEX:
            found.chunks.append(_chunk_index(section, begin, file.size))
        elif opcode == Opcode.STATISTICS:
            statistics = parse(Statistics, section[begin:at])
        elif opcode == Opcode.ATTACHMENT_INDEX:
            found.attachments.append(parse(AttachmentIndex, section[begin:at]))
        elif opcode == Opcode.METADATA_INDEX:
            found.metadata.append(parse(MetadataIndex, section[begin:at]))
        else:
            found.add(opcode, section[begin:at])
    return _checked(found, statistics)


def _checked(found: Summary, statistics: Statistics | None) -> Summary | None:
    """Return the summary if it is complete: a writer may leave out indexes, channels or statistics."""
    if statistics is None or len(found.chunks) != statistics.chunk_count:
        return None
    found.counts = Counter(statistics.channel_message_counts)
    if not found.counts.keys() <= found.channels.keys() or (statistics.message_count and not found.chunks):
        return None
    if len({chunk.offset for chunk in found.chunks}) != len(found.chunks):
        raise BagError("two indexes are of one chunk")
    found.start, found.end = statistics.message_start_time, statistics.message_end_time
    return found


def _chunk_index(section: bytes, at: int, size: int) -> ChunkRef:
    """Return the chunk of an index record, whose body begins at `at`. Raises BagError or struct.error."""
    start, end, offset, length, offsets = _CHUNK_INDEX.unpack_from(section, at)
    at += _CHUNK_INDEX.size
    ids = section[at : at + offsets]
    at += offsets
    index_length, name = struct.unpack_from("<QI", section, at)
    at += 12
    compression = section[at : at + name]
    _, unpacked = _SIZES.unpack_from(section, at + name)
    if offset + length > size or len(ids) % _CHANNEL_OFFSET:
        raise BagError("an index of a chunk is wrong")
    channels = frozenset(each for each, _ in struct.iter_unpack("<HQ", ids)) if ids else None
    return ChunkRef(start, end, offset, length, index_length, compression.decode(), unpacked, channels)


def _library(file: McapReader) -> str:
    try:
        return parse(Header, file.body(len(MAGIC), Opcode.HEADER)).library
    except BagError:
        return ""


class _Walk:
    """A walk through the records of a file that has no usable summary."""

    def __init__(self, file: McapReader, problem: str = "") -> None:
        self._file = file
        self._found = Summary(library=_library(file), problem=problem)
        self._at = len(MAGIC)
        self._chunk: ChunkRef | None = None  # the last one, whose indexes follow
        self._in_chunk: Counter[int] = Counter()
        self._piece: list[int] = []  # first time, last time, offset of messages outside of chunks

    def summary(self) -> Summary:
        """Return what was found up to the end, or to the first record that is not whole."""
        opcode = 0
        while opcode != Opcode.DATA_END:
            try:
                opcode, length = self._file.head(self._at)
                if not opcode:
                    raise BagError("a record without an opcode")
                self._record(opcode, length)
            except BagError:
                self._found.problem = self._found.problem or f"is damaged or cut at byte {self._at}"
                break
            self._at += RECORD_HEAD.size + length
        self._end_chunk(is_last=True)
        self._end_piece()
        if self._found.damaged and not self._found.problem:
            self._found.problem = "has damaged chunks"
        return self._found.finish()

    def _record(self, opcode: int, length: int) -> None:
        body = self._at + RECORD_HEAD.size
        if opcode != Opcode.MESSAGE_INDEX:
            self._end_chunk()
        if opcode != Opcode.MESSAGE:
            self._end_piece()
        match opcode:
            case Opcode.MESSAGE:
                self._message(length)
            case Opcode.CHUNK:
                self._chunk = self._file.chunk_head(self._at, length)
            case Opcode.MESSAGE_INDEX if length >= INDEX.size:
                channel, entries = INDEX.unpack(self._file.read(body, INDEX.size))
                self._in_chunk[channel] += min(entries, length - INDEX.size) // INDEX_ENTRY
            case Opcode.SCHEMA | Opcode.CHANNEL:
                self._found.add(opcode, self._file.body(self._at, opcode))
            case Opcode.METADATA:
                self._metadata(length)
            case Opcode.ATTACHMENT:
                self._attachment(length)

    def _message(self, length: int) -> None:
        """Enter a message outside of a chunk."""
        if length < MESSAGE.size:
            raise BagError("a message is too short")
        channel, _, log_time, _ = MESSAGE.unpack(self._file.read(self._at + RECORD_HEAD.size, MESSAGE.size))
        if self._piece and self._at - self._piece[2] >= _PIECE:
            self._end_piece()
        first, last, offset = self._piece or (log_time, log_time, self._at)
        self._piece = [min(first, log_time), max(last, log_time), offset]
        self._found.counts[channel] += 1

    def _end_piece(self) -> None:
        if self._piece:
            first, last, offset = self._piece
            length = self._at - offset
            self._found.chunks.append(ChunkRef(first, last, offset, length, size=length, real=False))
            self._piece = []

    def _end_chunk(self, *, is_last: bool = False) -> None:
        """Enter a chunk with what its indexes say; without them, or if a channel is new, it is looked into.

        The indexes of the last one before a cut may be incomplete.
        """
        chunk, counts = self._chunk, self._in_chunk
        self._chunk, self._in_chunk = None, Counter()
        if chunk is None:
            return
        if is_last or not counts or not counts.keys() <= self._found.channels.keys():
            try:
                counts = self._look_into(chunk)
            except BagError:
                self._found.damaged += 1
                return
        index_length = self._at - chunk.offset - chunk.length
        known = msgspec.structs.replace(chunk, channels=frozenset(counts), index_length=index_length)
        self._found.chunks.append(known)
        self._found.counts.update(counts)

    def _look_into(self, chunk: ChunkRef) -> Counter[int]:
        """Enter the channels of a chunk, and return the number of its messages by channel. Raises BagError."""
        data = self._file.chunk(chunk)
        for opcode, body in other_records(data):
            self._found.add(opcode, body)
        return Counter(message[1] for message in messages(data, None, 0, TIME_MAX + 1))

    def _metadata(self, length: int) -> None:
        body = self._file.body(self._at, Opcode.METADATA)
        (size,) = struct.unpack_from("<I", body.ljust(4, b"\0"))
        name = body[4 : 4 + size].decode(errors="replace")
        self._found.metadata.append(MetadataIndex(offset=self._at, length=length + RECORD_HEAD.size, name=name))

    def _attachment(self, length: int) -> None:
        """Enter an attachment without reading its data."""
        head = self._file.read(self._at + RECORD_HEAD.size, min(length, _ATTACHMENT_HEAD))
        try:
            log_time, create_time, name = _ATTACHMENT.unpack_from(head)
            (media_type,) = struct.unpack_from("<I", head, _ATTACHMENT.size + name)
            texts = head[_ATTACHMENT.size :]
            names = texts[:name].decode(), texts[name + 4 :][:media_type].decode()
            (size,) = struct.unpack_from("<Q", texts, name + 4 + media_type)
        except (struct.error, UnicodeDecodeError) as error:
            raise BagError("an attachment is damaged") from error
        length += RECORD_HEAD.size
        self._found.attachments.append(AttachmentIndex(self._at, length, log_time, create_time, size, *names))
