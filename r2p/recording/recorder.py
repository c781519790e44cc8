"""Records the topics of a module's network into a bag."""

import asyncio
import contextlib
import os
from collections.abc import Iterable, Mapping
from fnmatch import fnmatchcase
from pathlib import Path
from types import TracebackType
from typing import Self

from r2p.messages import Message, layout
from r2p.modules.module import Module
from r2p.names import RESERVED, topic_name
from r2p.recording.samples import SampleWriter
from r2p.recording.writer import BagWriter
from r2p.ros.classes import standard_classes
from r2p.runtime.immediate import ImmediateSubscriber
from r2p.runtime.node import Node
from r2p.runtime.sample import Sample, Source

RECORDER = "recorder"
"""The name of the node that subscribes to what is recorded."""

_PERIOD = 0.05  # seconds between two looks for new topics, after which what has arrived is written
_WILDCARDS = frozenset("*?[")

_Received = tuple[str, Sample, type[Message] | None, int]


class TopicSelection:
    """The topics to record: names and patterns as in a shell (`camera/*`), None for all, without those excluded."""

    def __init__(self, topics: Iterable[str] | None = None, exclude: Iterable[str] = ()) -> None:
        """Raises InvalidName or NameTooLong for a name that no topic can have."""
        given = ["*"] if topics is None else [each.removeprefix("/") for each in topics]
        self.names = [topic_name(each) for each in given if not _is_pattern(each)]
        """The topics that are named in full: they are recorded from the start."""
        self._patterns = [each for each in given if _is_pattern(each)]
        self._excluded = [each.removeprefix("/") for each in exclude]

    def has(self, topic: str) -> bool:
        """Return whether a topic is to be recorded."""
        if topic in RESERVED or any(fnmatchcase(topic, each) for each in self._excluded):
            return False
        return topic in self.names or any(fnmatchcase(topic, each) for each in self._patterns)


def _is_pattern(text: str) -> bool:
    return not _WILDCARDS.isdisjoint(text)


class Recorder:
    """Records topics into a file, while its block runs.

        async with r2p.Recorder(module, "drive.mcap", ["odometry", "camera/*"]):
            await module.wait()

    `topics` are names or patterns, None for all; topics that appear later are recorded from then on. `exclude` are
    patterns of topics to leave out. `types` has, by topic, the types of messages that no other module can tell.
    """

    def __init__(
        self,
        module: Module,
        path: str | os.PathLike[str],
        topics: Iterable[str] | None = None,
        *,
        exclude: Iterable[str] = (),
        types: Mapping[str, type[Message]] | None = None,
    ) -> None:
        self.path = Path(path)
        self.messages: dict[str, int] = {}
        """The messages that were recorded, by topic."""
        self._module = module
        self._selection = TopicSelection(topics, exclude)
        self._types = types or {}
        self._topics: dict[str, _RecordedTopic] = {}
        self.received: list[_Received] = []
        """What has arrived since the last write."""

    async def __aenter__(self) -> Self:
        """Begin to record. Raises FileExistsError if there is such a file, and OSError if it can't be made."""
        self._node = Node(RECORDER, self._module.space)
        self._file = self.path.open("xb")
        self._writer = BagWriter(self._file)
        self._samples = SampleWriter(self._writer)
        for name in self._selection.names:
            self._record(name)
        self._follow()
        self._task = asyncio.create_task(self._run(), name=f"{self._module.name} {RECORDER}")
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the file."""
        self._task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await self._task
        for each in self._topics.values():
            each.sink.close()
        self._node.close()
        self._write()
        self._writer.finish()
        self._file.close()

    async def _run(self) -> None:
        while True:
            await asyncio.sleep(_PERIOD)
            self._follow()
            self._write()

    def _follow(self) -> None:
        """Record the topics that have appeared."""
        for name, view in self._module.network.topics().items():
            if (view.publishers or view.published_on) and name not in self._topics and self._selection.has(name):
                self._record(name)

    def _record(self, name: str) -> None:
        self.messages[name] = 0
        self._topics[name] = _RecordedTopic(self._module, self._node, self._types.get(name), name, self.received)

    def _write(self) -> None:
        for topic, sample, cls, log_time in self.received:
            self.messages[topic] += 1
            self._samples.write(topic, sample, cls, log_time)
        self.received.clear()


class _RecordedTopic:
    """One topic: its subscription, and the type of each of its publishers."""

    def __init__(
        self, module: Module, node: Node, cls: type[Message] | None, name: str, received: list[_Received]
    ) -> None:
        self._space = module.space
        self._name = name
        self._cls = cls
        self._received = received
        self._types: dict[Source, type[Message] | None] = {}
        self.sink = ImmediateSubscriber(module.space, node, self._handle, lossy=True)
        self._topic = self.sink.open(name, None)

    def _handle(self, sample: Sample) -> None:
        source = sample.source
        if source not in self._types:
            self._types[source] = self._cls or self._find(source)
        self._received.append((self._name, sample, self._types[source], self._space.clock.now()))

    def _find(self, source: Source) -> type[Message] | None:
        own = self._topic.layout
        fingerprint = self._space.fingerprint_of(self._topic, source)
        if own is not None and (not source.link or own.fingerprint == fingerprint):
            return own.cls
        known = (cls for cls in standard_classes().values() if layout(cls).fingerprint == fingerprint)
        return next(known, None)
