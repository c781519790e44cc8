"""Checks of a whole MCAP file: mcap's strict reader with checksums, and that every index points where it says."""

import io
import struct
import zlib
from collections import Counter
from pathlib import Path

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Chunk, Footer, McapRecord, Message, MessageIndex, Metadata, Schema
from mcap.stream_reader import StreamReader, breakup_chunk, get_chunk_data_stream
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC

HEADER = struct.Struct("<BQ")
FOOTER_SIZE = HEADER.size + 20 + len(MCAP0_MAGIC)


def check(path: Path) -> list[Message]:
    """Return the messages of a file, in the order in which they stand there; fail if anything in it is wrong."""
    data = path.read_bytes()
    records = list(StreamReader(io.BytesIO(data), validate_crcs=True, emit_chunks=True).records)
    summary = make_reader(io.BytesIO(data), validate_crcs=True).get_summary()
    assert summary is not None
    messages = [part for record in records if isinstance(record, Chunk) for part in messages_of(record)]
    check_counts(summary, records, messages)
    check_definitions(records)
    check_indexes(data, summary)
    check_footer(data, records[-1])
    return messages


def messages_of(chunk: Chunk) -> list[Message]:
    """The messages of a chunk; its checksum is right."""
    return [record for record in breakup_chunk(chunk, validate_crc=True) if isinstance(record, Message)]


def check_counts(summary: Summary, records: list[McapRecord], messages: list[Message]) -> None:
    """The statistics count what is there."""
    found = summary.statistics
    assert found is not None
    kinds = Counter(type(record) for record in records)
    assert found.message_count == len(messages)
    assert found.channel_message_counts == Counter(message.channel_id for message in messages)
    assert found.chunk_count == kinds[Chunk] == len(summary.chunk_indexes)
    assert found.attachment_count == kinds[Attachment] == len(summary.attachment_indexes)
    assert found.metadata_count == kinds[Metadata] == len(summary.metadata_indexes)
    assert (found.channel_count, found.schema_count) == (len(summary.channels), len(summary.schemas))
    if messages:
        times = [message.log_time for message in messages]
        assert (found.message_start_time, found.message_end_time) == (min(times), max(times))


def check_definitions(records: list[McapRecord]) -> None:
    """Each channel stands before its messages, and each schema before its channels."""
    schemas, channels = {0}, set()
    for record in records:
        if isinstance(record, Schema):
            schemas.add(record.id)
        elif isinstance(record, Channel):
            assert record.schema_id in schemas
            channels.add(record.id)
        elif isinstance(record, Chunk):
            assert {message.channel_id for message in messages_of(record)} <= channels


def check_indexes(data: bytes, summary: Summary) -> None:
    """Each index of the summary points at what it describes, and each message is in the index of its chunk."""
    for index in summary.chunk_indexes:
        assert record_at(data, index.chunk_start_offset) == (Opcode.CHUNK, index.chunk_length)
        chunk = Chunk.read(stream_at(data, index.chunk_start_offset))
        assert (chunk.message_start_time, chunk.message_end_time, chunk.uncompressed_size, len(chunk.data)) == (
            index.message_start_time,
            index.message_end_time,
            index.uncompressed_size,
            index.compressed_size,
        )
        end = index.chunk_start_offset + index.chunk_length + index.message_index_length
        check_message_indexes(data, chunk, index.message_index_offsets, end)
    for found in summary.attachment_indexes:
        assert record_at(data, found.offset) == (Opcode.ATTACHMENT, found.length)
        assert Attachment.read(stream_at(data, found.offset)).name == found.name
        body = data[found.offset + HEADER.size : found.offset + found.length]
        assert zlib.crc32(body[:-4]) == int.from_bytes(body[-4:], "little")
    for entry in summary.metadata_indexes:
        assert record_at(data, entry.offset) == (Opcode.METADATA, entry.length)
        assert Metadata.read(stream_at(data, entry.offset)).name == entry.name


def check_message_indexes(data: bytes, chunk: Chunk, offsets: dict[int, int], end: int) -> None:
    inside = get_chunk_data_stream(chunk)[0].read(chunk.uncompressed_size)
    messages = messages_of(chunk)
    times = [message.log_time for message in messages]
    assert (chunk.message_start_time, chunk.message_end_time) == (min(times), max(times))
    counts = Counter(message.channel_id for message in messages)
    assert offsets.keys() == counts.keys()
    for channel, offset in offsets.items():
        opcode, length = record_at(data, offset)
        assert opcode == Opcode.MESSAGE_INDEX
        assert offset + length <= end
        index = MessageIndex.read(stream_at(data, offset))
        assert (index.channel_id, len(index.records)) == (channel, counts[channel])
        for time, position in index.records:
            opcode, length = record_at(inside, position)
            message = Message.read(stream_at(inside, position), length - HEADER.size)
            assert (opcode, message.channel_id, message.log_time) == (Opcode.MESSAGE, channel, time)


def check_footer(data: bytes, footer: McapRecord) -> None:
    """The checksum of the summary is right, and its groups are where their offsets say."""
    assert isinstance(footer, Footer)
    assert footer.summary_crc == zlib.crc32(data[footer.summary_start : -len(MCAP0_MAGIC) - 4])
    position = footer.summary_offset_start
    while position < len(data) - FOOTER_SIZE:
        opcode, length = record_at(data, position)
        assert opcode == Opcode.SUMMARY_OFFSET
        group, start, size = struct.unpack_from("<BQQ", data, position + HEADER.size)
        assert groups(data, start, size) == {group}
        position += length
    assert position == len(data) - FOOTER_SIZE


def groups(data: bytes, start: int, size: int) -> set[int]:
    """The opcodes of the records that fill a part of the file."""
    found, position = set(), start
    while position < start + size:
        opcode, length = record_at(data, position)
        found.add(opcode)
        position += length
    assert position == start + size
    return found


def record_at(data: bytes, position: int) -> tuple[int, int]:
    """The opcode of the record there, and its whole length."""
    opcode, length = HEADER.unpack_from(data, position)
    return opcode, HEADER.size + length


def stream_at(data: bytes, position: int) -> ReadDataStream:
    """A stream at the content of the record there."""
    return ReadDataStream(io.BytesIO(data[position + HEADER.size :]))
