"""What a conversion reads from one format and writes to the other."""

import abc
from collections import Counter
from collections.abc import Mapping
from fnmatch import fnmatchcase
from types import TracebackType
from typing import Self, TypeAlias

import msgspec

from r2p.messages import Message, layout
from r2p.recording.bag_file import Attachment
from r2p.recording.entries import MetadataEntry
from r2p.runtime.sample import Sample

Losses: TypeAlias = Counter[str]
"""What the result lacks, in words, and how many of them: `losses["deadlines"] += 1`."""


ATTACHMENTS = "attachments"
"""What is lost of a recording with attachments in most formats."""
METADATA_RECORDS = "metadata records"
"""The same, of a recording with these: the topics that are latched."""


class ConversionOptions(msgspec.Struct, frozen=True, kw_only=True):
    """What of a recording is converted, and into which types.

    `topics` are names or patterns such as `camera/*`; none: all. `start` and `end` (UTC, ns) are the first instant and
    the one after the last. `types` are the classes that messages become, by topic or pattern; `known_types` are those
    of topics whose type is not in the recording. With `ros`, r2p's standard messages become those of ROS.
    """

    topics: tuple[str, ...] = ()
    start: int | None = None
    end: int | None = None
    types: Mapping[str, type[Message]] = {}
    known_types: Mapping[str, type[Message]] = {}
    ros: bool = False

    def wants(self, topic: str) -> bool:
        """Return whether a topic is converted."""
        return not self.topics or any(fnmatchcase(topic, each) for each in self.topics)

    def names(self, topic: str) -> bool:
        """Return whether the user asks for just this topic, or for a pattern that it fits."""
        return bool(self.topics) and self.wants(topic)

    def stated(self, topic: str) -> type[Message] | None:
        """Return the class that messages of a topic become."""
        return next((cls for each, cls in self.types.items() if fnmatchcase(topic, each)), None)

    def type_of(self, topic: str) -> type[Message] | None:
        """Return the class of a topic whose type is not in the recording."""
        return self.stated(topic) or self.known_types.get(topic)

    def covers(self, time: int) -> bool:
        """Return whether a message of this time is converted."""
        return (self.start is None or self.start <= time) and (self.end is None or time < self.end)


class ConvertedRecord(msgspec.Struct, frozen=True):
    """A message: its topic, when it was recorded (`log_time`, UTC, ns), and its class if that is known.

    `metadata` is that of a channel which the recorder writes besides the topics, such as `can0/frames` or
    `r2p/events`; None for a topic.
    """

    topic: str
    log_time: int
    sample: Sample
    cls: type[Message] | None
    metadata: Mapping[str, str] | None = None

    @property
    def type_name(self) -> str:
        """The full name of its type; empty if that is unknown."""
        return "" if self.cls is None else layout(self.cls).name


ConvertedItem: TypeAlias = ConvertedRecord | Attachment | MetadataEntry


class RecordSink(abc.ABC):
    """Writes one file, or the files of one folder. Leaving it after an error leaves them unfinished."""

    def __init__(self, losses: Losses) -> None:
        self.losses = losses

    @abc.abstractmethod
    def put(self, record: ConvertedRecord) -> bool:
        """Write a message, and count in `losses` what of it has no place here; return False if that is all of it.

        Raises BagError.
        """

    def attach(self, attachment: Attachment) -> None:
        """Write an attachment. Most formats have no place for it."""
        self.losses[ATTACHMENTS] += 1

    def describe(self, metadata: MetadataEntry) -> None:
        """Write a metadata record. Most formats have no place for it."""
        self.losses[METADATA_RECORDS] += 1

    @abc.abstractmethod
    def finish(self) -> None:
        """Write the end of the files."""

    @abc.abstractmethod
    def close(self) -> None:
        """Close the files, finished or not."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self.finish()
        finally:
            self.close()

    def lose(self, what: str) -> bool:
        """Count a message that has no place here, in words; return False."""
        self.losses[what] += 1
        return False

    def count_context(self, sample: Sample) -> None:
        """Count what ROS's recordings have no place for: how a message travelled."""
        if sample.deadline:
            self.losses["deadlines"] += 1
        if sample.stamped:
            self.losses["stamps of publishers"] += 1
        if sample.sequence:
            self.losses["sequence numbers"] += 1
