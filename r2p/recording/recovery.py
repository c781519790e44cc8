"""Recovery of a recording that was cut off, by a crash or a loss of power, or that is damaged.

All that can be read goes into a new file: whole chunks whose checksum is right, and the messages in front of the cut in
the chunk that was cut. Behind damage the search goes on at the next chunk. Nothing in the file is believed: lengths are
those of bytes that are there.
"""

import io
import os
import struct
import zlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import IO, BinaryIO, Final

import lz4.frame
import msgspec
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Footer, Header, Metadata, Schema
from mcap.writer import MCAP0_MAGIC

from r2p.errors import DecodeError
from r2p.recording.mcap_file import RECORD
from r2p.recording.writer import BagWriter

_CHUNK: Final = struct.Struct("<QQQII")  # start, end, uncompressed size, checksum, length of the compression's name
_LENGTH: Final = struct.Struct("<Q")
_MESSAGE: Final = struct.Struct("<HIQQ")
_COMPRESSIONS: Final = b"\4\0\0\0zstd", b"\3\0\0\0lz4"  # with the length in front
_NAME_AT: Final = RECORD.size + _CHUNK.size - 4  # of the compression, with its length, in the record of a chunk
_CHUNK_MAX: Final = 1 << 30  # bytes of messages in a chunk; more is damage
_PIECE: Final = 1 << 20  # bytes that are read at once
_FOOTER_SIZE: Final = RECORD.size + 20 + len(MCAP0_MAGIC)
_DAMAGED: Final = (struct.error, McapError, ValueError, zstandard.ZstdError, RuntimeError, EOFError, OverflowError)
"""What the libraries raise for bytes that are not what they should be; lz4 raises RuntimeError."""


class RecoveryReport(msgspec.Struct):
    """What was found in a file. `start` and `end` are the log times of its messages (UTC, ns; 0 without messages).

    `unreadable`: bytes that belong to nothing whole; `damaged`: chunks and records whose checksum or content is wrong;
    `without_channel`: messages whose channel is not in the file any more. `complete`: nothing is missing, so the file
    needs no recovery.
    """

    messages: int = 0
    channels: int = 0
    attachments: int = 0
    start: int = 0
    end: int = 0
    unreadable: int = 0
    damaged: int = 0
    without_channel: int = 0
    complete: bool = False

    @property
    def seconds(self) -> float:
        """From the first message to the last."""
        return (self.end - self.start) / 1e9


def recover(source: str | os.PathLike[str], target: str | os.PathLike[str]) -> RecoveryReport:
    """Write what can be read of a recording into a new file; there is none if the recording is complete.

    Raises DecodeError if the source is not an MCAP file, FileExistsError for a target that is there already, OSError.
    """
    path = Path(target)
    with Path(source).open("rb") as file:
        check_magic(file, Path(source).name)
        with path.open("xb") as new:
            try:
                report = Recovery(file, new).run()
            except BaseException:
                path.unlink()
                raise
        if report.complete:
            path.unlink()
    return report


def check_magic(file: IO[bytes], name: str) -> None:
    """Raise DecodeError if a file does not begin as an MCAP file does."""
    begin = file.read(len(MCAP0_MAGIC))
    if not begin:
        raise DecodeError(f"{name} is empty: nothing was recorded before it was cut off")
    if begin != MCAP0_MAGIC:
        raise DecodeError(f"{name} is not an MCAP file: it does not begin as one")


class Recovery:
    """Reads one file to its end, or to the cut, and writes what is whole."""

    def __init__(self, source: IO[bytes], target: BinaryIO) -> None:
        """`source` begins with MCAP's magic bytes. Raises OSError, as `run` does."""
        self._source = source
        self._size = source.seek(0, os.SEEK_END)
        self._report = RecoveryReport()
        self._schemas: dict[int, Schema] = {}
        self._crc: int | None = zlib.crc32(MCAP0_MAGIC)  # of all records so far; None behind damage
        self._ended = False
        self._writer = BagWriter(target, about={}, profile=self._profile())

    def run(self) -> RecoveryReport:
        """Write all that can be read, and return what it was."""
        self._read_summary()
        position = len(MCAP0_MAGIC)
        while position < self._size and not self._ended:
            position = self._record(position)
        self._writer.finish()
        report = self._report
        report.channels = len(self._writer.channels)
        report.complete = self._ended and not (report.unreadable or report.damaged or report.without_channel)
        return report

    # Records

    def _profile(self) -> str:
        header = self._whole_record(len(MCAP0_MAGIC))
        if header is not None and header[0] == Opcode.HEADER:
            try:
                return Header.read(_stream(header[1])).profile
            except _DAMAGED:
                pass  # counted when its turn comes
        return ""

    def _read_summary(self) -> None:
        """Begin the channels that the summary names, if there is one: the records of some may be damaged."""
        footer = self._whole_record(max(len(MCAP0_MAGIC), self._size - _FOOTER_SIZE))
        if footer is None or footer[0] != Opcode.FOOTER:
            return
        position = int.from_bytes(footer[1][: _LENGTH.size], "little")
        while len(MCAP0_MAGIC) <= position and (record := self._whole_record(position)) is not None:
            opcode, content = record
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._understood(opcode, content)
            elif opcode == Opcode.FOOTER:
                return
            position += RECORD.size + len(content)

    def _record(self, position: int) -> int:
        """Read the record at a position, and return that of the next one."""
        record = self._whole_record(position)
        if record is None:
            self._crc = None
            return self._behind_damage(position, self._read(position, _CHUNK_MAX))
        opcode, content = record
        end = position + RECORD.size + len(content)
        if self._understood(opcode, content, position):
            if self._crc is not None:
                self._crc = zlib.crc32(content, zlib.crc32(RECORD.pack(opcode, len(content)), self._crc))
            return end
        self._report.damaged += 1
        self._crc = None
        return end if self._plausible(end) else self._behind_damage(position, b"")

    def _whole_record(self, position: int) -> tuple[int, bytes] | None:
        head = self._read(position, RECORD.size)
        if len(head) < RECORD.size:
            return None
        opcode, length = RECORD.unpack(head)
        if opcode == 0 or length > self._size - position - RECORD.size:
            return None
        return opcode, self._read(position + RECORD.size, length)

    def _plausible(self, position: int) -> bool:
        """Whether something like a record begins here, or the file ends."""
        return self._size - position < RECORD.size or self._whole_record(position) is not None

    def _read(self, position: int, length: int) -> bytes:
        self._source.seek(position)
        return self._source.read(max(0, min(length, self._size - position)))

    def _behind_damage(self, position: int, data: bytes) -> int:
        """Return where the next chunk begins, and write what is left of a chunk that was cut off here."""
        if data[:1] == bytes((Opcode.CHUNK,)):
            self._messages(self._cut_chunk(data[RECORD.size :]))
        end = self._next_chunk(position + 1)
        self._report.unreadable += end - position
        return end

    def _next_chunk(self, position: int) -> int:
        """Return where something begins that looks like a chunk; the end of the file if there is none."""
        while position < self._size:
            block = self._read(position, _PIECE + _NAME_AT + len(_COMPRESSIONS[0]))
            for at in _chunks_in(block[: _PIECE + _NAME_AT + len(_COMPRESSIONS[0])]):
                return position + at
            position += _PIECE
        return self._size

    # Contents

    def _understood(self, opcode: int, content: bytes, position: int = 0) -> bool:
        """Write what a record has; return False if it is damaged. Records of other kinds are left out."""
        try:
            match opcode:
                case Opcode.SCHEMA:
                    schema = Schema.read(_stream(content))
                    self._schemas.setdefault(schema.id, schema)
                case Opcode.CHANNEL:
                    self._channel(Channel.read(_stream(content)))
                case Opcode.MESSAGE:
                    self._message(content)
                case Opcode.CHUNK:
                    self._messages(_whole_chunk(content))
                case Opcode.ATTACHMENT:
                    self._attachment(content)
                case Opcode.METADATA:
                    self._writer.register(Metadata.read(_stream(content)))
                case Opcode.DATA_END:
                    _check_crc(int.from_bytes(content[:4], "little"), self._crc)
                case Opcode.FOOTER:
                    self._ended = self._is_end(Footer.read(_stream(content)), position)
        except _DAMAGED:
            return False
        return True

    def _channel(self, channel: Channel) -> None:
        schema = self._schemas.get(channel.schema_id)
        if schema is None:
            channel = replace(channel, schema_id=0)
        self._writer.copy_channel(channel, schema)

    def _attachment(self, content: bytes) -> None:
        _check_crc(int.from_bytes(content[-4:], "little"), zlib.crc32(content[:-4]))
        self._writer.register(Attachment.read(_stream(content)))
        self._report.attachments += 1

    def _is_end(self, footer: Footer, position: int) -> bool:
        """Whether this is the end of a file, whose summary is right."""
        end = position + RECORD.size + 20
        if footer.summary_start and footer.summary_crc:
            summary = self._read(footer.summary_start, end - 4 - footer.summary_start)
            _check_crc(footer.summary_crc, zlib.crc32(summary))
        return self._read(end, self._size) == MCAP0_MAGIC

    # Messages

    def _messages(self, data: bytes) -> None:
        """Write the messages of a chunk, up to the point to which it is whole."""
        for opcode, content in _records(data):
            if opcode == Opcode.MESSAGE:
                self._message(content)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL) and not self._understood(opcode, content):
                self._report.damaged += 1

    def _message(self, content: bytes) -> None:
        channel, sequence, log_time, publish_time = _MESSAGE.unpack_from(content)
        report = self._report
        if channel not in self._writer.channels:
            report.without_channel += 1
            return
        self._writer.add(channel, log_time, publish_time, sequence, content[_MESSAGE.size :])
        report.start = min(report.start, log_time) if report.messages else log_time
        report.end = max(report.end, log_time)
        report.messages += 1

    def _cut_chunk(self, content: bytes) -> bytes:
        """Return the messages of the chunk at the end of a file, as far as they are there."""
        try:
            return _decompress(*_compressed(content))
        except _DAMAGED:
            return b""


def _stream(content: bytes) -> ReadDataStream:
    return ReadDataStream(io.BytesIO(content))


def _check_crc(expected: int, found: int | None) -> None:
    """Raise DecodeError if a checksum is wrong; 0 is one that was not made."""
    if expected and expected != found:
        raise DecodeError("the checksum is wrong")


def _records(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Iterate over the whole records in a piece of a file."""
    position = 0
    while position + RECORD.size <= len(data):
        opcode, length = RECORD.unpack_from(data, position)
        position += RECORD.size
        if length > len(data) - position:
            return
        yield opcode, data[position : position + length]
        position += length


def _chunks_in(block: bytes) -> Iterator[int]:
    """Iterate over the places in a block, in their order, where something begins that looks like a chunk."""
    found = set()
    for name in _COMPRESSIONS:
        at = block.find(name, _NAME_AT)
        while at >= 0:
            if block[at - _NAME_AT] == Opcode.CHUNK:
                found.add(at - _NAME_AT)
            at = block.find(name, at + 1)
    yield from sorted(found)


def _compressed(content: bytes) -> tuple[str, bytes, int]:
    """Return the compression of a chunk, its data as far as they are there, and how many messages' bytes they are."""
    size, length = _CHUNK.unpack_from(content)[2], _CHUNK.unpack_from(content)[4]
    name = content[_CHUNK.size : _CHUNK.size + length]
    begin = _CHUNK.size + len(name) + _LENGTH.size
    (data,) = _LENGTH.unpack_from(content, begin - _LENGTH.size)
    return name.decode(), content[begin : begin + data], size


def _whole_chunk(content: bytes) -> bytes:
    """Return the messages of a chunk. Raises one of _DAMAGED."""
    compression, data, size = _compressed(content)
    messages = _decompress(compression, data, size)
    if len(messages) != size:
        raise DecodeError("the chunk is cut off")
    _check_crc(_CHUNK.unpack_from(content)[3], zlib.crc32(messages))
    return messages


def _decompress(compression: str, data: bytes, size: int) -> bytes:
    """Return the first `size` bytes that were compressed, or as many as there are. Raises one of _DAMAGED."""
    if size > _CHUNK_MAX:
        raise DecodeError("the chunk is too large")
    if not compression:
        return data[:size]
    file = io.BytesIO(data)
    if compression == "zstd":
        return _read_up_to(zstandard.ZstdDecompressor().stream_reader(file), size)
    if compression == "lz4":
        return _read_up_to(lz4.frame.open(file), size)
    raise DecodeError(f"the compression {compression!r} is unknown")


def _read_up_to(reader: IO[bytes], size: int) -> bytes:
    """Read pieces, so that memory is only taken for what is there."""
    pieces, missing = [], size
    try:
        while missing and (piece := reader.read(min(missing, _PIECE))):
            pieces.append(piece)
            missing -= len(piece)
    except EOFError:  # lz4, at the cut
        pass
    return b"".join(pieces)
