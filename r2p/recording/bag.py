"""A bag to read."""

import os
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar, overload

import msgspec
from mcap.reader import make_reader

from r2p.errors import DecodeError
from r2p.messages import Message
from r2p.recording.format import CDR, META_PREFIX, ChannelInfo
from r2p.recording.messages import SampleMeta
from r2p.recording.samples import sample_of
from r2p.recording.types import class_of
from r2p.ros.cdr import cdr
from r2p.runtime.sample import Sample

M = TypeVar("M", bound=Message)

_DEFAULT = SampleMeta()


class RecordedSample(msgspec.Struct, frozen=True):
    """A sample of a bag: its topic, when it was recorded (`log_time`, UTC, ns), and its class if that is known."""

    topic: str
    log_time: int
    sample: Sample
    cls: type[Message] | None


class Bag:
    """A recording.

    with r2p.Bag("drive.mcap") as bag:
        for sample in bag.samples("odometry"):
            print(sample.stamp, sample.message.x)
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        """Open the file. Raises OSError."""
        self.path = Path(path)
        self._file = self.path.open("rb")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    @overload
    def samples(self, topic: str) -> Iterator[Sample[Any]]: ...

    @overload
    def samples(self, topic: str, cls: type[M]) -> Iterator[Sample[M]]: ...

    def samples(self, topic: str, cls: type[Message] | None = None) -> Iterator[Sample[Any]]:
        """Iterate over the samples of a topic, in the order in which they were recorded."""
        for recorded in self.records([topic]):
            kind = cls or recorded.cls
            if kind is not None:
                yield msgspec.structs.replace(recorded.sample, message=kind.decode(recorded.sample.data))

    def records(self, topics: list[str] | None = None) -> Iterator[RecordedSample]:
        """Iterate over the samples of all topics, or of some, in the order in which they were recorded."""
        names = (
            None if topics is None else [name for topic in topics for name in (f"/{topic}", f"{META_PREFIX}{topic}")]
        )
        self._file.seek(0)
        metas: dict[ChannelInfo, SampleMeta] = {}
        for _, channel, message in make_reader(self._file).iter_messages(names):
            info = ChannelInfo.from_metadata(channel.metadata)
            if info is None:
                continue
            if channel.topic.startswith(META_PREFIX):
                metas[info] = cdr(SampleMeta).decode(message.data)
                continue
            cls = class_of(info)
            try:
                sample = sample_of(
                    info,
                    message.sequence,
                    message.publish_time,
                    message.data,
                    metas.pop(info, _DEFAULT),
                    is_cdr=channel.message_encoding == CDR,
                    cls=cls,
                )
            except DecodeError:
                continue
            yield RecordedSample(info.topic, message.log_time, sample, cls)
