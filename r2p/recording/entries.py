"""What the event loop hands to the thread that writes: small structs, cheap to make.

An entry knows how it is written, so that something new to record needs only a class of entries.
"""

import itertools
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping
from typing import Any, ClassVar, TypeVar

import msgspec

from r2p.messages import Message
from r2p.recording.format import CDR, SEQUENCE_MASK
from r2p.recording.samples import SampleWriter
from r2p.recording.writer import BagWriter
from r2p.ros.cdr import cdr
from r2p.ros.ros2_schemas import schema_of
from r2p.runtime.sample import Sample

P = TypeVar("P")

_OVERHEAD = 256  # bytes of the objects around the payload of an entry, about


class BagEntry(msgspec.Struct, gc=False):
    """Something to write. Not changed after it was handed over."""

    urgent: ClassVar[bool] = False
    """True if it is kept, up to a second limit, when the disk is too slow for messages and frames."""

    @property
    def nbytes(self) -> int:
        """Bytes of memory until it is written, about."""
        return _OVERHEAD

    @property
    @abstractmethod
    def lost_as(self) -> str:
        """The topic, or channel, under which the entry is counted if it can't be written."""

    @property
    def count(self) -> int:
        """Messages in the entry."""
        return 1

    @abstractmethod
    def write(self, out: "EntryWriter") -> None:
        """Write the entry, in the thread."""


class SampleEntry(BagEntry, gc=False):
    """A sample of a topic, of the given class if it is known, received at `log_time` (ns, UTC)."""

    topic: str
    sample: Sample
    cls: type[Message] | None
    log_time: int

    @property
    def nbytes(self) -> int:
        return _OVERHEAD + len(self.sample.data)

    @property
    def lost_as(self) -> str:
        return self.topic

    def write(self, out: "EntryWriter") -> None:
        out.samples.write(self.topic, self.sample, self.cls, self.log_time)


class MessageEntry(BagEntry, gc=False):
    """A message of a channel of the recorder's own, such as /r2p/events. `publish_time` 0: the same as `log_time`.

    Each metadata has a channel of its own.
    """

    urgent: ClassVar[bool] = True

    channel: str
    message: Message
    log_time: int
    publish_time: int = 0
    metadata: Mapping[str, str] = {}

    @property
    def lost_as(self) -> str:
        return self.channel

    def write(self, out: "EntryWriter") -> None:
        kind = type(self.message)
        channel = out.channel(self.channel, kind, self.metadata)
        sequence = next(channel.count) & SEQUENCE_MASK
        data = cdr(kind).encode(self.message)
        out.writer.add(channel.id, self.log_time, self.publish_time or self.log_time, sequence, data)


class AttachmentEntry(BagEntry, gc=False):
    """A file to attach, such as r2p.toml, as it was at `time` (ns, UTC)."""

    urgent: ClassVar[bool] = True

    name: str
    media_type: str
    data: bytes
    time: int

    @property
    def nbytes(self) -> int:
        return _OVERHEAD + len(self.data)

    @property
    def lost_as(self) -> str:
        return f"attachment {self.name}"

    def write(self, out: "EntryWriter") -> None:
        out.writer.attach(self.name, self.media_type, self.data, self.time)


class MetadataEntry(BagEntry, gc=False):
    """A metadata record."""

    urgent: ClassVar[bool] = True

    name: str
    values: Mapping[str, str]

    @property
    def lost_as(self) -> str:
        return f"metadata {self.name}"

    def write(self, out: "EntryWriter") -> None:
        out.writer.add_metadata(self.name, self.values)


class OwnChannel(msgspec.Struct, eq=False):
    """A channel of the recorder's own, and the numbers of its messages."""

    id: int
    count: Iterator[int] = msgspec.field(default_factory=lambda: itertools.count(1))


class EntryWriter:
    """Writes entries into a bag. `samples` and `writer` are for the entries."""

    def __init__(self, writer: BagWriter) -> None:
        self.writer = writer
        self.samples = SampleWriter(writer)
        self._channels: dict[Any, OwnChannel] = {}
        self._parts: dict[Any, Any] = {}

    def write(self, entry: BagEntry) -> None:
        """Write an entry. Raises OSError if the bag has a file; MessageError for an entry that can't be written."""
        entry.write(self)

    def part(self, kind: Callable[[BagWriter], P]) -> P:
        """Return the writer of this kind for this bag, which is made when it is first asked for."""
        if kind not in self._parts:
            self._parts[kind] = kind(self.writer)
        part: P = self._parts[kind]
        return part

    def channel(self, name: str, cls: type[Message], metadata: Mapping[str, str]) -> OwnChannel:
        """Return the channel of this name, class and metadata; begin it if it is new."""
        key = name, cls, tuple(metadata.items())
        channel = self._channels.get(key)
        if channel is None:
            channel = self._channels[key] = OwnChannel(
                self.writer.add_channel(name, CDR, metadata, schema_of(cls).record)
            )
        return channel
