"""Recovery of a recording that was cut off, by a crash or a loss of power, or that is damaged.

All that can be read goes into a new file: whole chunks whose checksum is right, and the messages in front of the cut in
the chunk that was cut. Behind damage the search goes on at the next chunk.
"""

import contextlib
import os
import struct
import zlib
from collections.abc import Generator, Iterator
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO, Final

import msgspec
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Footer, Header, Metadata, Schema

from r2p.errors import BagError, DecodeError
from r2p.recording.format import MAGIC, MESSAGE, META_PREFIX, RECORD_HEAD
from r2p.recording.mcap_reader import (
    CHUNK_MAX,
    McapReader,
    MessageRecord,
    messages,
    other_records,
    parse,
    unpacked,
    unpacked_to_cut,
)
from r2p.recording.writer import BagWriter
from r2p.units import NEVER, SECOND

_COMPRESSIONS: Final = b"\4\0\0\0zstd", b"\3\0\0\0lz4"  # with the length in front
_NAME_AT: Final = RECORD_HEAD.size + 28  # of the compression, with its length, in the record of a chunk
_FOOTER_BODY: Final = 20  # bytes
_RECORD_MAX: Final = CHUNK_MAX + (1 << 20)  # bytes of a record; what says that it is longer is damage
_CUT_MAX: Final = 64 << 20  # bytes up to the end of the file in which a chunk may have been cut
_PIECE: Final = 1 << 20  # bytes that are searched at once
_OVERLAP: Final = _NAME_AT + 16  # and as much of the next piece that a chunk at the end is seen
_ALL_TIMES: Final = 1 << 64


class RecoveryReport(msgspec.Struct):
    """What was found in a file. `start` and `end` are the log times of its messages (UTC, ns; 0 without messages).

    Companions of messages are not counted. `unreadable`: bytes that belong to nothing whole; `damaged`: chunks and
    records whose checksum or content is wrong; `without_channel`: messages whose channel is missing in the file.
    `complete`: nothing is missing, so the file needs no recovery.
    """

    messages: int = 0
    channels: int = 0
    attachments: int = 0
    start: int = NEVER
    end: int = 0
    unreadable: int = 0
    damaged: int = 0
    without_channel: int = 0
    complete: bool = False

    @property
    def seconds(self) -> float:
        """From the first message to the last."""
        return max(0, self.end - self.start) / SECOND


def recover(source: str | os.PathLike[str], target: str | os.PathLike[str]) -> RecoveryReport:
    """Write the readable messages of a recording into a new file, unless the recording is complete.

    Raises BagError if the source can't be opened or is not an MCAP file, FileExistsError for a target that is there
    already, OSError.
    """
    for report in recover_in_steps(source, target):  # noqa: B007 - the last one counts
        pass
    return report


def recover_in_steps(
    source: str | os.PathLike[str], target: str | os.PathLike[str]
) -> Generator[RecoveryReport, None, None]:
    """Recover in steps, as `recover` does, and yield the report after each.

    Closing the iterator early deletes the new file.
    """
    path, complete = Path(target), False
    with contextlib.closing(McapReader(Path(source))) as file, path.open("xb") as new:
        try:
            recovery = RecordingRecovery(file, new)
            yield from recovery.run()
            complete = recovery.report.complete
        except BaseException:
            path.unlink()
            raise
    if complete:
        path.unlink()


class RecordingRecovery:
    """Reads one file to its end, or to the cut, and writes what is whole."""

    def __init__(self, source: McapReader, target: BinaryIO) -> None:
        """Begin the new file. Raises OSError, as `run` does."""
        self._source = source
        self.report = RecoveryReport()
        self._schemas: dict[int, Schema] = {}
        self._companions: set[int] = set()
        self._crc: int | None = zlib.crc32(MAGIC)  # of all records so far; None behind damage
        self._in_summary = self._ended = False
        self._writer = BagWriter(target, about={}, profile=self._profile())

    def run(self) -> Iterator[RecoveryReport]:
        """Write all that can be read; yield what it was so far after each record."""
        self._read_summary()
        position = len(MAGIC)
        while position < self._source.size and not self._ended:
            position = self._record(position)
            yield self.report
        self._writer.finish()
        report = self.report
        report.start = report.start if report.messages else 0
        report.channels = len(self._writer.channels)
        report.complete = self._ended and not (report.unreadable or report.damaged or report.without_channel)
        yield report

    # Records

    def _profile(self) -> str:
        header = self._whole_record(len(MAGIC))
        if header is None or header[0] != Opcode.HEADER:
            return ""
        try:
            return str(parse(Header, header[1]).profile)
        except BagError:
            return ""  # counted when its turn comes

    def _read_summary(self) -> None:
        """Begin the channels of the summary, in case the records of some are damaged."""
        footer = self._whole_record(self._source.size - len(MAGIC) - _FOOTER_BODY - RECORD_HEAD.size)
        if footer is None or footer[0] != Opcode.FOOTER:
            return
        position = int.from_bytes(footer[1][:8], "little")
        while len(MAGIC) <= position and (record := self._whole_record(position)) is not None:
            opcode, content = record
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._understand(opcode, content)
            elif opcode == Opcode.FOOTER:
                return
            position += RECORD_HEAD.size + len(content)

    def _record(self, position: int) -> int:
        """Read the record at a position, and return that of the next one."""
        record = self._whole_record(position)
        if record is None:
            self._crc = None
            return self._behind_damage(position)
        opcode, content = record
        end = position + RECORD_HEAD.size + len(content)
        if self._understand(opcode, content, position):
            if self._crc is not None:
                self._crc = zlib.crc32(content, zlib.crc32(RECORD_HEAD.pack(opcode, len(content)), self._crc))
            return end
        self.report.damaged += 1
        self._crc = None
        plausible = self._source.size - end < RECORD_HEAD.size or self._whole_record(end) is not None
        return end if plausible else self._next_chunk(position + 1)

    def _whole_record(self, position: int) -> tuple[int, bytes] | None:
        """Return the opcode and the content of the record that begins here, if all of it is there."""
        try:
            opcode, length = self._source.head(position)
            if not opcode or length > _RECORD_MAX:
                return None
            return opcode, self._source.read(position + RECORD_HEAD.size, length)
        except BagError:
            return None

    def _behind_damage(self, position: int) -> int:
        """Return where the next chunk begins, and write what is left of a chunk that was cut off here."""
        if self._source.size - position <= _CUT_MAX and self._read(position, 1) == bytes((Opcode.CHUNK,)):
            with contextlib.suppress(Exception):  # each library has its own errors
                self._messages(unpacked_to_cut(self._read(position + RECORD_HEAD.size, _CUT_MAX)))
        end = self._next_chunk(position + 1)
        if not self._in_summary:  # of which a new one is made
            self.report.unreadable += end - position
        return end

    def _next_chunk(self, position: int) -> int:
        """Return the offset of the next bytes that look like a chunk; without any, the end of the file."""
        while position < self._source.size:
            at = _find_chunk(self._read(position, _PIECE + _OVERLAP))
            if at is not None:
                return position + at
            position += _PIECE
        return self._source.size

    def _read(self, position: int, length: int) -> bytes:
        """Read these bytes of the file; return empty bytes after an error of the disk."""
        try:
            return self._source.read(position, min(length, self._source.size - position))
        except BagError:
            return b""

    # Contents

    def _understand(self, opcode: int, content: bytes, position: int = 0) -> bool:
        """Write what a record has; return False if it is damaged. Records of other kinds are left out."""
        try:
            match opcode:
                case Opcode.SCHEMA:
                    schema = parse(Schema, content)
                    self._schemas.setdefault(schema.id, schema)
                case Opcode.CHANNEL:
                    self._channel(parse(Channel, content))
                case Opcode.MESSAGE:
                    channel, sequence, log_time, publish_time = MESSAGE.unpack_from(content)
                    self._message((log_time, channel, sequence, publish_time, content[MESSAGE.size :]))
                case Opcode.CHUNK:
                    return self._chunk(content)
                case Opcode.ATTACHMENT:
                    self._attachment(content)
                case Opcode.METADATA:
                    self._writer.register(parse(Metadata, content))
                case Opcode.DATA_END:
                    _check_crc(int.from_bytes(content[:4], "little"), self._crc)
                    self._in_summary = True
                case Opcode.FOOTER:
                    self._ended = self._is_end(parse(Footer, content), position)
        except (BagError, DecodeError, struct.error):
            return False
        return True

    def _channel(self, channel: Channel) -> None:
        schema = self._schemas.get(channel.schema_id)
        if schema is None:
            channel = replace(channel, schema_id=0)
        self._writer.copy_channel(channel, schema)
        if channel.topic.startswith(META_PREFIX):
            self._companions.add(channel.id)

    def _attachment(self, content: bytes) -> None:
        _check_crc(int.from_bytes(content[-4:], "little"), zlib.crc32(content[:-4]))
        self._writer.register(parse(Attachment, content))
        self.report.attachments += 1

    def _is_end(self, footer: Footer, position: int) -> bool:
        """Whether this is the end of a file, whose summary is right."""
        end = position + RECORD_HEAD.size + _FOOTER_BODY
        if footer.summary_start and footer.summary_crc:
            summary = self._read(footer.summary_start, end - 4 - footer.summary_start)
            _check_crc(footer.summary_crc, zlib.crc32(summary))
        return self._read(end, len(MAGIC)) == MAGIC

    # Messages

    def _chunk(self, content: bytes) -> bool:
        try:
            data = unpacked(content)
        except Exception:  # noqa: BLE001 - each library has its own errors
            return False
        self._messages(data)
        return True

    def _messages(self, data: bytes) -> None:
        """Write the messages among records, up to the point to which they are whole."""
        for opcode, content in other_records(data):
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL) and not self._understand(opcode, content):
                self.report.damaged += 1
        for message in messages(data, None, 0, _ALL_TIMES):
            self._message(message)

    def _message(self, message: MessageRecord) -> None:
        log_time, channel, sequence, publish_time, data = message
        report = self.report
        if channel not in self._writer.channels:
            report.without_channel += 1
            return
        self._writer.add(channel, log_time, publish_time, sequence, data)
        report.messages += channel not in self._companions
        report.start = min(report.start, log_time)
        report.end = max(report.end, log_time)


def _check_crc(expected: int, found: int | None) -> None:
    """Raise DecodeError if a checksum is wrong; 0 is one that was not made."""
    if expected and found is not None and expected != found:
        raise DecodeError("the checksum is wrong")


def _find_chunk(block: bytes) -> int | None:
    """Return where in a block something begins that looks like a chunk: both lengths in its record agree."""
    found = []
    for name in _COMPRESSIONS:
        at = block.find(name, _NAME_AT)
        while at >= 0 and not _is_chunk(block, at - _NAME_AT, len(name)):
            at = block.find(name, at + 1)
        if at >= 0:
            found.append(at - _NAME_AT)
    return min(found, default=None)


def _is_chunk(block: bytes, position: int, name: int) -> bool:
    opcode, length = RECORD_HEAD.unpack_from(block, position)
    begin = position + _NAME_AT + name
    data = int.from_bytes(block[begin : begin + 8], "little")
    return bool(opcode == Opcode.CHUNK and length == _NAME_AT - RECORD_HEAD.size + name + 8 + data)
