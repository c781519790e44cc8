"""New bags from old ones: a part of a recording, or several recordings in one.

`cut` copies whole chunks as they are, and takes messages only out of those in which it begins, ends, or leaves a topic
out. A chunk is unpacked before it is copied, as nothing else tells whether it is damaged: 1 to 2 GB of messages a
second, some ten times as many as could be written anew. `merge` reads all messages, as they go into one order. Both are
iterators, which yield after each piece, so that a program can do something else in between or stop; then the file that
was begun is deleted.
"""

import heapq
import os
from collections.abc import Callable, Collection, Generator, Iterator, Sequence
from fnmatch import fnmatchcase
from operator import itemgetter
from pathlib import Path
from typing import BinaryIO, Final

import msgspec
from mcap.opcode import Opcode
from mcap.records import Chunk
from msgspec.structs import replace

from r2p.errors import BagError, DecodeError, MessageError
from r2p.recording.bag import Bag, RawMessage
from r2p.recording.bag_file import BagFile
from r2p.recording.channels import BagChannel
from r2p.recording.format import LATCHED, METADATA, OWN_PREFIX
from r2p.recording.mcap_reader import TIME_MAX, ChunkRef, parse
from r2p.recording.messages import SampleMeta
from r2p.recording.writer import ABOUT, BagWriter
from r2p.ros.cdr import cdr

Wanted = Callable[[BagChannel], bool]
"""Whether a channel is to be in the new file."""

_PIECE: Final = 4096  # messages after which an iterator yields


class ChannelSelection(msgspec.Struct, frozen=True):
    """The channels that a new file gets: those of `topics`, None for all, without those of `exclude`.

    Both are names and patterns (`camera/*`) of topics, or with a slash before them of other channels (`/can0/frames`).
    With `topics`, what r2p itself recorded (`/r2p/...`) stays, as it says what was lost; other channels go.
    """

    topics: Sequence[str] | None = None
    exclude: Sequence[str] = ()

    def __call__(self, channel: BagChannel) -> bool:
        """Return whether a channel is to be in the new file."""
        if any(_is_meant(channel, each) for each in self.exclude):
            return False
        if self.topics is None or (channel.info is None and channel.name.startswith(OWN_PREFIX)):
            return True
        return any(_is_meant(channel, each) for each in self.topics)

    def unmatched(self, channels: Collection[BagChannel]) -> list[str]:
        """Return the names and patterns that match no channel."""
        given = [*(self.topics or ()), *self.exclude]
        return [each for each in given if not any(_is_meant(channel, each) for channel in channels)]


def _is_meant(channel: BagChannel, pattern: str) -> bool:
    """Return whether a name or a pattern is that of a channel; a topic has those of its companions, too."""
    if channel.info is not None:
        return fnmatchcase(channel.info.topic, pattern.removeprefix("/"))
    return fnmatchcase(channel.name, pattern)


class Edited(msgspec.Struct):
    """What was done so far: chunks that were copied as they are, and those left out because they can't be read."""

    copied_chunks: int = 0
    unreadable: int = 0


def cut(
    bag: Bag,
    path: str | os.PathLike[str],
    *,
    start: int | None = None,
    end: int | None = None,
    wanted: Wanted | None = None,
    keep_latched: bool = False,
) -> Generator[Edited]:
    """Write what was recorded from `start` to `end` (UTC, ns; `end` not included) into a new file.

    With `keep_latched` it begins with the last message before `start` of each publisher of a latched topic, as if it
    were received then; stamps stay. Raises BagError if the file exists, or can't be written.
    """
    with _NewFile(path) as file:
        yield from _Cut(bag, _writer_for(file, [(bag, 0)]), start, end, wanted).run(keep_latched=keep_latched)


class _NewFile:
    """A file that is deleted again unless its block ends without an exception."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._path = Path(path)

    def __enter__(self) -> BinaryIO:
        try:
            self._file: BinaryIO = self._path.open("xb")
        except FileExistsError as error:
            raise BagError(f"{self._path} is there already, and is not overwritten") from error
        except OSError as error:
            raise BagError(f"can't write {self._path}: {error.strerror}") from error
        return self._file

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        try:
            self._file.close()
        except OSError as failed:  # what was buffered does not fit on the disk
            error = error or failed
        if error is None:
            return
        self._path.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise BagError(f"can't write {self._path}: {error.strerror}") from error


class _Cut:
    """One run of `cut`."""

    def __init__(self, bag: Bag, writer: BagWriter, start: int | None, end: int | None, wanted: Wanted | None) -> None:
        self._bag = bag
        self._writer = writer
        self._span = (0 if start is None else start, TIME_MAX + 1 if end is None else end)
        self._done = Edited()
        self._ids = [self._begin_channels(each, wanted or ChannelSelection()) for each in bag.files]

    def _begin_channels(self, file: BagFile, wanted: Wanted) -> dict[int, int]:
        """Begin the channels of a file that are wanted, and return their new ids: the same ones, if they are free."""
        ids = {}
        for number, record in file.summary.channels.items():
            channel = file.channels[number]
            if wanted(channel):
                try:
                    self._writer.copy_channel(record, file.summary.schemas.get(record.schema_id))
                    ids[number] = number
                except DecodeError:  # another part has another channel of this id
                    ids[number] = _add_channel(self._writer, channel)
        return ids

    def run(self, *, keep_latched: bool) -> Iterator[Edited]:
        if keep_latched:
            self._add_last()
        start, end = self._span
        chunks = [(chunk, number) for number, file in enumerate(self._bag.files) for chunk in file.summary.chunks]
        for chunk, number in sorted(chunks, key=lambda each: (each[0].start, each[1], each[0].offset)):
            file, ids = self._bag.files[number], self._ids[number]
            is_empty = chunk.end < start or chunk.start >= end
            if is_empty or not chunk.may_have(ids):
                continue
            if not self._copy(file, chunk, ids):
                self._reread(file, chunk, ids)
            yield self._done
        self._writer.finish()
        yield self._done

    def _copy(self, file: BagFile, chunk: ChunkRef, ids: dict[int, int]) -> bool:
        """Copy a chunk as it is; return False if not all of it is wanted, or that is not possible."""
        start, end = self._span
        is_inside = start <= chunk.start and chunk.end < end and chunk.real and chunk.index_length
        if not is_inside or chunk.channels is None or any(ids.get(each) != each for each in chunk.channels):
            return False
        try:
            file.file.chunk(chunk)  # raises for a damaged one, which _reread counts
            record = parse(Chunk, file.file.body(chunk.offset, Opcode.CHUNK))
            self._writer.copy_chunk(record, file.file.read(chunk.offset + chunk.length, chunk.index_length))
        except (BagError, DecodeError):
            return False
        self._done.copied_chunks += 1
        return True

    def _reread(self, file: BagFile, chunk: ChunkRef, ids: dict[int, int]) -> None:
        """Write the messages of a chunk that are wanted."""
        try:
            found = file.messages(chunk, frozenset(ids), *self._span)
        except BagError:
            self._done.unreadable += 1
            return
        for log_time, channel, sequence, publish_time, data in sorted(found, key=itemgetter(0)):
            self._writer.add(ids[channel], log_time, publish_time, sequence, data)

    def _add_last(self) -> None:
        """Write the last message of each latching publisher before the start, with its companion, at the start."""
        new = {
            file.channels[number]: id_there
            for file, ids in zip(self._bag.files, self._ids, strict=True)
            for number, id_there in ids.items()
        }
        for last in self._bag.last_before(self._span[0], self._bag.latched):
            time, info = last.log_time, last.channel.info
            at_once = list(self._bag.raw(lambda each, info=info: each.info == info, start=time, end=time + 1))  # type: ignore[misc]
            sequence = next(each.sequence for each in reversed(at_once) if each.channel is last.channel)
            for each in at_once:
                if each.sequence == sequence and each.channel in new:
                    self._writer.add(new[each.channel], self._span[0], each.publish_time, sequence, each.data)


def merge(
    bags: Sequence[tuple[Bag, int]], path: str | os.PathLike[str], *, wanted: Wanted | None = None
) -> Generator[Edited]:
    """Write several recordings into a new file, in the order of time.

    Each has an offset (ns) that is added to all of its times, for computers whose clocks differ: log times, stamps, and
    deadlines. Times inside of messages stay. An attachment with the name of another one, but other contents, gets the
    name of its recording before its own. Raises BagError if the file exists, or can't be written.
    """
    with _NewFile(path) as file:
        writer = _writer_for(file, bags)
        done = Edited()
        ids: dict[tuple[int, BagChannel], int] = {}
        streams = [_shifted(number, *each, wanted) for number, each in enumerate(bags)]
        for count, (number, record) in enumerate(heapq.merge(*streams, key=lambda each: each[1].log_time)):
            key = (number, record.channel)
            if key not in ids:
                ids[key] = _add_channel(writer, record.channel)
            writer.add(ids[key], record.log_time, record.publish_time, record.sequence, record.data)
            if count % _PIECE == 0:
                yield done
        writer.finish()
        done.unreadable = sum(bag.damaged for bag, _ in bags)
        yield done


def _shifted(number: int, bag: Bag, offset: int, wanted: Wanted | None) -> Iterator[tuple[int, RawMessage]]:
    """Yield the messages of a bag, with the number of the bag, at their times in the new file."""
    for record in bag.raw(wanted):
        if not offset:
            yield number, record
            continue
        data = _shifted_companion(record.data, offset) if record.channel.kind == "meta" else record.data
        log_time, publish_time = _moved(record.log_time, offset), _moved(record.publish_time, offset)
        yield number, RawMessage(record.channel, log_time, publish_time, record.sequence, data)


def _moved(time: int, offset: int) -> int:
    return min(max(0, time + offset), TIME_MAX)


def _shifted_companion(data: bytes, offset: int) -> bytes:
    codec = cdr(SampleMeta)
    try:
        meta = codec.decode(data)
        deadline, expires = (each and each + offset for each in (meta.deadline, meta.expires))
        clock_offset = meta.clock_offset + (offset if meta.clock_error >= 0 else 0)
        moved = replace(meta, deadline=deadline, expires=expires, clock_offset=clock_offset)
        return codec.encode(moved)
    except (DecodeError, MessageError):  # damaged, or centuries away
        return data


def _writer_for(file: BinaryIO, bags: Sequence[tuple[Bag, int]]) -> BagWriter:
    """Begin a file with the metadata and attachments of all bags; it is one of r2p's if one of them is."""
    files = [each for bag, _ in bags for each in bag.files]
    writer = BagWriter(file, about=ABOUT if any(each.is_own for each in files) else {})
    known = [(LATCHED, {name: value for bag, _ in bags for name, value in bag.metadata.get(LATCHED, {}).items()})]
    for each in files:
        known += [record for record in each.metadata() if record[0] not in {METADATA, LATCHED} and record not in known]
    for record in known:
        if record[1]:
            writer.add_metadata(*record)
    attached: dict[str, bytes] = {}
    for bag, offset in bags:
        for attachment in bag.attachments():
            name = attachment.name
            if attached.get(name, attachment.data) != attachment.data:
                name = f"{bag.paths[0].stem}/{name}"
            if name not in attached:
                attached[name] = attachment.data
                writer.attach(name, attachment.media_type, attachment.data, _moved(attachment.time, offset))
    return writer


def _add_channel(writer: BagWriter, channel: BagChannel) -> int:
    """Begin a channel under a free id; one of another program says its topic, as those of r2p do."""
    metadata = dict(channel.metadata)
    if channel.info is not None and "topic" not in metadata:
        metadata = channel.info.metadata | metadata
    schema = (channel.schema_name, channel.schema_encoding, channel.schema) if channel.schema_name else None
    try:
        return writer.add_channel(channel.name, channel.encoding, metadata, schema)
    except MessageError as error:
        raise BagError(str(error)) from error
