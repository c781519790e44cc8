"""Bags to read: one file, or the parts of a recording as one."""

import difflib
import functools
import logging
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Collection, Generator, Iterator
from operator import itemgetter
from types import TracebackType
from typing import Any, Final, Generic, Self, TypeVar, overload

import msgspec

from r2p.errors import BagError, DecodeError, TypeMismatch
from r2p.messages import Message
from r2p.recording.bag_file import Attachment, BagFile, Paths, bag_paths
from r2p.recording.channels import BagChannel, M
from r2p.recording.format import CDR, LATCHED, METADATA, ChannelInfo
from r2p.recording.mcap_reader import TIME_MAX, ChunkRef, MessageRecord
from r2p.recording.messages import SampleMeta
from r2p.recording.samples import sample_of
from r2p.ros.cdr import cdr
from r2p.runtime.sample import Sample

C = TypeVar("C", covariant=True)

logger = logging.getLogger("r2p.bag")

_DEFAULT: Final = SampleMeta()
_HELD_MAX: Final = 1 << 28  # bytes of messages that wait for their turn, where the chunks of a file overlap
_HELD_EACH: Final = 200  # bytes of each besides its data
_COMPANIONS_MAX: Final = 1 << 16  # of one log time
_TIME = itemgetter(0)


class RecordedSample(msgspec.Struct, frozen=True, gc=False):
    """A sample of a bag: its topic, when it was recorded (`log_time`, UTC, ns), and its class if that is known.

    `sample.message` is None: `cls.decode(sample.data)` makes it, as `Bag.samples` does.
    """

    topic: str
    log_time: int
    sample: Sample
    cls: type[Message] | None
    channel: BagChannel


class RecordedMessage(msgspec.Struct, Generic[C], frozen=True, gc=False):
    """A message of a channel other than those of topics, such as `/r2p/events`; times in ns (UTC)."""

    channel: BagChannel
    log_time: int
    publish_time: int
    sequence: int
    message: C


class RawMessage(msgspec.Struct, frozen=True, gc=False):
    """A message of any channel as it is in the file; times in ns (UTC)."""

    channel: BagChannel
    log_time: int
    publish_time: int
    sequence: int
    data: bytes


def is_of(topics: Collection[str] | None, kinds: Collection[str]) -> Callable[[BagChannel], bool]:
    """Return a predicate for channels: True for those of these topics (None: all) and of one of these kinds."""
    names = None if topics is None else {each.removeprefix("/") for each in topics}
    return lambda each: each.info is not None and each.kind in kinds and (names is None or each.info.topic in names)


def _memory(messages: list[MessageRecord]) -> int:
    """Return the bytes of memory of messages."""
    return _HELD_EACH * len(messages) + sum([len(each[4]) for each in messages])


class Bag:
    """A recording to read.

        with r2p.Bag("drive.mcap") as bag:
            for sample in bag.samples("odometry", Odometry):
                print(sample.stamp, sample.message.x)

    It may have several files: the parts of one recording, which are read as one. A file that is still being written has
    what had been written when it was opened.
    """

    def __init__(self, path: Paths) -> None:
        """Open a file, a directory of files, a pattern (`drive-*.mcap`), or several of these.

        Raises BagError if there is none, or one can't be read. A file without an end, because its recorder was killed
        or is still at work, is read as far as it goes, and the log says so: see `problems`.
        """
        self.paths = bag_paths(path)
        self.files: list[BagFile] = []
        """The files of the recording, with their chunks."""
        try:
            for each in self.paths:
                self.files.append(BagFile(each))
        except BagError:
            self.close()
            raise
        self.undecodable: Counter[str] = Counter()
        """Messages that could not be read, by topic or channel."""
        self.damaged = sum(each.summary.damaged for each in self.files)
        """Chunks that could not be read, among those that were looked at so far; `check` looks at all."""
        self._unreadable: set[tuple[int, int]] = set()  # those among them that were found later: file and offset
        for problem in self.problems:
            logger.warning("%s", problem)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the files."""
        for each in self.files:
            each.file.close()

    @property
    def problems(self) -> list[str]:
        """What is wrong with the files, each with advice; empty if they all end as they should."""
        return [
            f"{each.file.path} {each.summary.problem}; r2p bag recover {each.file.path} makes a whole file of it"
            for each in self.files
            if each.summary.problem
        ]

    @functools.cached_property
    def start(self) -> int:
        """The log time of the first message (UTC, ns); 0 for a bag without messages."""
        return min((each.summary.start for each in self.files if each.summary.counts.total()), default=0)

    @functools.cached_property
    def end(self) -> int:
        """The log time of the last message (UTC, ns); 0 for a bag without messages."""
        return max((each.summary.end for each in self.files if each.summary.counts.total()), default=0)

    @functools.cached_property
    def channels(self) -> list[BagChannel]:
        """The channels of all files; one that several files have is there once."""
        found: dict[object, BagChannel] = {}
        for each in self.files:
            for channel in each.channels.values():
                known = found.get(channel.key)
                found[channel.key] = channel if known is None else known.plus(channel.count)
        return list(found.values())

    @functools.cached_property
    def topics(self) -> dict[str, int]:
        """The topics with samples, and how many they have."""
        counts: dict[str, int] = {}
        for channel in self.channels:
            if channel.info is not None and channel.kind == "samples":
                counts[channel.info.topic] = counts.get(channel.info.topic, 0) + channel.count
        return dict(sorted(counts.items()))

    @property
    def metadata(self) -> dict[str, dict[str, str]]:
        """The metadata records by name, without that of the format; the last of a name."""
        found: dict[str, dict[str, str]] = {}
        for each in self.files:
            in_file = {name: values for name, values in each.metadata() if name != METADATA}
            latched = found.get(LATCHED, {}) | in_file.get(LATCHED, {})
            found |= in_file | ({LATCHED: latched} if latched else {})
        return found

    @property
    def latched(self) -> set[str]:
        """The topics whose last message a late subscriber gets."""
        return {
            *self.metadata.get(LATCHED, ()),
            *(each.info.topic for each in self.channels if each.info and each.is_latched),
        }

    def attachments(self) -> Iterator[Attachment]:
        """Read the attachments that can be read; those that each part of a recording has, once."""
        seen = set()
        for file in self.files:
            for each in file.attachments():
                if (each.name, each.time) not in seen:
                    seen.add((each.name, each.time))
                    yield each

    @overload
    def samples(self, topic: str, *, start: int | None = None, end: int | None = None) -> Iterator[Sample[Any]]: ...

    @overload
    def samples(
        self, topic: str, cls: type[M], *, start: int | None = None, end: int | None = None
    ) -> Iterator[Sample[M]]: ...

    def samples(
        self, topic: str, cls: type[Message] | None = None, *, start: int | None = None, end: int | None = None
    ) -> Iterator[Sample[Any]]:
        """Iterate over the samples of a topic with their messages, in the order in which they were recorded.

        `start` and `end` are log times (UTC, ns), `end` not included. Without a class it is the one of the recording;
        of a topic that was recorded without its type, give one. Messages that can't be read are left out, and counted
        in `undecodable`.

        Raises BagError for a topic that the bag does not have, or whose type is unknown, and TypeMismatch for one with
        other fields than `cls`.
        """
        topic = topic.removeprefix("/")
        self._check_topic(topic, cls)
        return self._decoded(topic, cls, start, end)

    def _decoded(
        self, topic: str, cls: type[Message] | None, start: int | None, end: int | None
    ) -> Iterator[Sample[Any]]:
        for recorded in self.records([topic], start=start, end=end):
            kind = cls or recorded.cls
            if kind is None:
                self._count_undecodable(topic, "its type is unknown")
                continue
            try:
                message = kind.decode(recorded.sample.data)
            except DecodeError as error:
                self._count_undecodable(topic, error)
                continue
            yield msgspec.structs.replace(recorded.sample, message=message)

    def _check_topic(self, topic: str, cls: type[Message] | None) -> None:
        found = [each for each in self.channels if each.info is not None and each.info.topic == topic]
        if not found:
            raise BagError(f"{self._named} has no topic {topic}{self._suggestion(topic)}")
        if cls is None and all(each.cls is None for each in found):
            raise BagError(f"the type of {topic} is unknown: give its class, as in samples({topic!r}, Odometry)")
        for each in found:
            if cls is not None and (why := each.check(cls)):
                raise TypeMismatch(why)

    def _suggestion(self, topic: str) -> str:
        topics = list(self.topics)
        close = difflib.get_close_matches(topic, topics, n=1)
        if close:
            return f"; did you mean {close[0]}?"
        return f"; it has {', '.join(topics[:20])}{', ...' if len(topics) > 20 else ''}" if topics else ""

    @property
    def _named(self) -> str:
        return f"{self.paths[0]}" if len(self.paths) == 1 else f"{self.paths[0]} and {len(self.paths) - 1} others"

    def records(
        self, topics: Collection[str] | None = None, *, start: int | None = None, end: int | None = None
    ) -> Iterator[RecordedSample]:
        """Iterate over the samples of all topics, or of some, in the order of their log times.

        `start` and `end` are log times (UTC, ns), `end` not included. Messages that are not decoded have what was
        recorded of them besides their bytes, such as their deadlines.
        """
        metas: dict[tuple[ChannelInfo, int], SampleMeta] = {}  # of the current log time
        now = 0
        for number, (log_time, channel_id, sequence, publish_time, data) in self._messages(
            is_of(topics, {"samples", "meta"}), start, end
        ):
            if log_time != now:
                now = log_time
                metas.clear()
            channel = self.files[number].channels[channel_id]
            info = channel.info
            assert info is not None
            try:
                if channel.kind == "meta":
                    if len(metas) >= _COMPANIONS_MAX:  # without their messages
                        metas.clear()
                    metas[info, sequence] = cdr(SampleMeta).decode(data)
                    continue
                meta = metas.pop((info, sequence), _DEFAULT) if metas else _DEFAULT
                from_cdr = channel.from_cdr if channel.encoding == CDR else None
                sample = sample_of(info, sequence, publish_time, data, meta, from_cdr=from_cdr)
            except DecodeError as error:
                self._count_undecodable(info.topic, channel.problem or error)
                continue
            yield RecordedSample(info.topic, log_time, sample, channel.cls, channel)

    @overload
    def messages(
        self, channel: str, *, start: int | None = None, end: int | None = None
    ) -> Iterator[RecordedMessage[Any]]: ...

    @overload
    def messages(
        self, channel: str, cls: type[M], *, start: int | None = None, end: int | None = None
    ) -> Iterator[RecordedMessage[M]]: ...

    def messages(
        self, channel: str, cls: type[Message] | None = None, *, start: int | None = None, end: int | None = None
    ) -> Iterator[RecordedMessage[Any]]:
        """Iterate over the messages of a channel that is not of a topic: `/r2p/events`, `/can0/frames`.

        Without a class they are of that of the file. A channel that the bag does not have has no messages; those that
        can't be read are left out, and counted in `undecodable`.
        """
        for record in self.raw(lambda each: each.name == channel, start=start, end=end):
            kind = cls or record.channel.cls
            try:
                if kind is None:
                    raise DecodeError(record.channel.problem)
                message = cdr(kind).decode(record.data)
            except DecodeError as error:
                self._count_undecodable(channel, error)
                continue
            yield RecordedMessage(record.channel, record.log_time, record.publish_time, record.sequence, message)

    def raw(
        self,
        wanted: Callable[[BagChannel], bool] | None = None,
        *,
        start: int | None = None,
        end: int | None = None,
    ) -> Iterator[RawMessage]:
        """Iterate over the messages of all channels, or of those wanted, as they are in the file."""
        for number, (log_time, channel_id, sequence, publish_time, data) in self._messages(wanted, start, end):
            yield RawMessage(self.files[number].channels[channel_id], log_time, publish_time, sequence, data)

    def check(self) -> Generator[None]:
        """Read every chunk, so that `damaged` counts all that can't be read. Yields after each."""
        for number, file in enumerate(self.files):
            for chunk in file.summary.chunks:
                self._read(number, chunk, frozenset(), 0, 0)
                yield

    def last_before(self, time: int, topics: Collection[str] | None = None) -> list[RecordedSample]:
        """Return the last sample of each channel before `time` (UTC, ns), if it has one: what a late subscriber gets.

        The search goes back chunk by chunk, and reads only those with a channel that is still missing.
        """
        found: list[RecordedSample] = []
        for channel, log_time in self._last_times(time, topics):
            info = channel.info
            assert info is not None
            at_once = self.records([info.topic], start=log_time, end=log_time + 1)
            found += [each for each in at_once if each.channel is channel][-1:]
        return sorted(found, key=lambda each: each.log_time)

    def _last_times(self, time: int, topics: Collection[str] | None) -> list[tuple[BagChannel, int]]:
        """Return the last log time of each channel with samples before `time`."""
        chunks = self._chunks(is_of(topics, {"samples"}), 0, time)
        last: dict[tuple[int, int], int] = {}
        done: dict[int, set[int]] = {number: set() for number in range(len(self.files))}
        for chunk, number, ids in sorted(chunks, key=lambda each: -each[0].end):
            settled = done[number]
            settled.update(channel for (file, channel), at in last.items() if file == number and at >= chunk.end)
            wanted = (ids or frozenset()) - settled
            if chunk.may_have(wanted):
                for message in self._read(number, chunk, wanted, 0, time):
                    key = (number, message[1])
                    last[key] = max(message[0], last.get(key, 0))
        return [(self.files[number].channels[channel], at) for (number, channel), at in last.items()]

    def _messages(
        self, wanted: Callable[[BagChannel], bool] | None, start: int | None, end: int | None
    ) -> Iterator[tuple[int, MessageRecord]]:
        """Yield messages in the order of their log times, each with the number of its file.

        Those with the same time stay in the order of the file. A chunk is read when its turn comes.
        """
        first, last = 0 if start is None else start, TIME_MAX + 1 if end is None else end
        chunks = self._chunks(wanted, first, last)
        held: list[tuple[int, int, MessageRecord]] = []
        size = 0
        for i, (chunk, number, ids) in enumerate(chunks):
            found = self._read(number, chunk, ids, first, last)
            held += [(each[0], number, each) for each in found]
            held.sort(key=_TIME)
            size += _memory(found)
            is_all = i + 1 == len(chunks) or size > _HELD_MAX  # beyond that, order counts less than memory
            ready = len(held) if is_all else bisect_left(held, chunks[i + 1][0].start, key=_TIME)
            for _, file, message in held[:ready]:
                yield file, message
            size -= _memory([message for _, _, message in held[:ready]])
            del held[:ready]

    def _read(
        self, number: int, chunk: ChunkRef, ids: frozenset[int] | None, start: int, end: int
    ) -> list[MessageRecord]:
        """Return the messages of a chunk. A damaged chunk is counted once, and has an empty list."""
        try:
            return self.files[number].messages(chunk, ids, start, end)
        except BagError as error:
            if (place := (number, chunk.offset)) not in self._unreadable:
                self._unreadable.add(place)
                self.damaged += 1
                if self.damaged == 1:
                    logger.warning("%s; r2p bag recover saves what is behind it", error)
            return []

    def _chunks(
        self, wanted: Callable[[BagChannel], bool] | None, start: int, end: int
    ) -> list[tuple[ChunkRef, int, frozenset[int] | None]]:
        """Return the chunks with such messages in the order of time, with their file and the ids of channels."""
        found = []
        for number, file in enumerate(self.files):
            ids = None if wanted is None else frozenset(key for key, each in file.channels.items() if wanted(each))
            for chunk in file.summary.chunks:
                is_in_time = chunk.end >= start and chunk.start < end
                if is_in_time and (ids is None or chunk.may_have(ids)):
                    found.append((chunk, number, ids))
        found.sort(key=lambda each: (each[0].start, each[1], each[0].offset))
        return found

    def _count_undecodable(self, name: str, why: object) -> None:
        self.undecodable[name] += 1
        if self.undecodable[name] == 1:
            logger.warning("%s: messages of %s are left out: %s", self._named, name, why)
