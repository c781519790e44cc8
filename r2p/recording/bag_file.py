"""One file of a bag, and which files a path means."""

import glob
import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import msgspec
from mcap.opcode import Opcode
from mcap.records import Attachment as AttachmentRecord
from mcap.records import Metadata as MetadataRecord

from r2p.errors import BagError
from r2p.recording.channels import BagChannel, channels_of
from r2p.recording.format import FORMAT, METADATA, RECORD_HEAD
from r2p.recording.mcap_reader import TIME_MAX, ChunkRef, McapReader, MessageRecord, messages, parse
from r2p.recording.summary import Summary, read_summary

SUFFIX = ".mcap"
_TIMES_KEPT = 16  # chunks
_WILDCARDS = frozenset("*?[")

Paths = str | os.PathLike[str] | Sequence[str | os.PathLike[str]]


class Attachment(msgspec.Struct, frozen=True):
    """A file inside of a bag, such as r2p.toml; `time` is in ns (UTC)."""

    name: str
    media_type: str
    data: bytes
    time: int


class BagFile:
    """One file of a bag: its summary, its channels by id, and its messages, chunk by chunk."""

    def __init__(self, path: Path) -> None:
        """Open the file. Raises BagError."""
        self.file = McapReader(path)
        try:
            self.summary: Summary = read_summary(self.file)
            self.is_own = any(index.name == METADATA for index in self.summary.metadata)
            """Whether r2p wrote the file."""
            self._check_format()
        except BagError:
            self.file.close()
            raise
        self.channels: dict[int, BagChannel] = channels_of(self.summary, is_own=self.is_own)
        self._times: dict[int, list[tuple[int, int]]] = {}  # by offset of the chunk

    def _check_format(self) -> None:
        """Raise BagError for a file of a newer version."""
        values = next((values for name, values in self.metadata() if name == METADATA), {})
        number = values.get("format", "")
        if number.isdecimal() and len(number) < 10 and int(number) > FORMAT:
            writer = values.get("r2p", "")
            raise BagError(
                f"{self.file.path} has version {number} of the format, by r2p {writer}; this r2p reads up to {FORMAT}: "
                "update it"
            )

    def metadata(self) -> Iterator[tuple[str, dict[str, str]]]:
        """Yield the metadata records that can be read: name and values."""
        for index in self.summary.metadata:
            try:
                record = parse(MetadataRecord, self.file.body(index.offset, Opcode.METADATA))
            except BagError:
                continue
            yield record.name, record.metadata

    def attachments(self, name: str | None = None, most: int | None = None) -> Iterator[Attachment]:
        """Yield the attachments that can be read; those of a name, if one is given, and of at most so many bytes."""
        for index in self.summary.attachments:
            if name not in (None, index.name):
                continue
            try:
                opcode, length = self.file.head(index.offset)
                if opcode != Opcode.ATTACHMENT or (most is not None and length > most):
                    continue
                body = self.file.read(index.offset + RECORD_HEAD.size, length)
                record = parse(AttachmentRecord, body)
            except BagError:
                continue
            yield Attachment(record.name, record.media_type, record.data, record.log_time)

    def messages(self, chunk: ChunkRef, ids: frozenset[int] | None, start: int, end: int) -> list[MessageRecord]:
        """Return the messages of a chunk on the channels `ids`; None: on all channels of the file.

        Raises BagError if the chunk can't be read.
        """
        return messages(self.file.chunk(chunk), self.channels if ids is None else ids, start, end)

    def times(self, chunk: ChunkRef) -> list[tuple[int, int]]:
        """Return the log times in a chunk with their channels; none for a damaged one. The last chunks are cached."""
        if chunk.offset not in self._times:
            try:
                found = [message[:2] for message in self.messages(chunk, None, 0, TIME_MAX + 1)]
            except BagError:
                found = []
            if len(self._times) >= _TIMES_KEPT:
                self._times.pop(next(iter(self._times)))
            self._times[chunk.offset] = found
        return self._times[chunk.offset]


def bag_paths(path: Paths) -> list[Path]:
    """Return the files of a path, in the order of their names: a file, all of a directory, those of a pattern.

    `drive.mcap` also means its parts `drive-0001.mcap` ... where there is no file of this name. Raises BagError.
    """
    if not isinstance(path, str | os.PathLike):
        return [each for one in path for each in bag_paths(one)]
    given = Path(path)
    if given.is_dir():
        found = sorted(given.glob(f"*{SUFFIX}"), key=_natural)
        if not found:
            raise BagError(f"{given} has no {SUFFIX} files")
        return found
    if given.exists():
        return [given]
    if not _WILDCARDS.isdisjoint(str(path)):
        found = sorted((Path(each) for each in glob.glob(str(path))), key=_natural)  # noqa: PTH207 - may be absolute
        if not found:
            raise BagError(f"no file matches {path}")
        return found
    parts = sorted(given.parent.glob(f"{glob.escape(given.stem)}-[0-9]*{given.suffix}"), key=_natural)
    if not parts:
        raise BagError(f"there is no file {given}")
    return parts


def _natural(path: Path) -> list[tuple[int, str]]:
    """Return a key for sorting by which part 10 comes after part 9."""
    return [(int(each), "") if each.isdecimal() else (-1, each) for each in re.split(r"(\d+)", path.name)]
