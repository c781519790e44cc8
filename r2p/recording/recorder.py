"""Records the topics of a module's network, and what happens there, into a bag.

    a message arrives -> RecordedTopic appends it to a list, in the event loop
    _TURN later       -> the list goes to the BackgroundWriter, whose thread writes it

Nothing waits for the recorder: neither a publisher, nor a link, nor the event loop. What is recorded besides topics are
parts of the recorder: each is an asynchronous context manager, made with the module and with a function that takes what
is to be written.
"""

import logging
import os
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractAsyncContextManager, AsyncExitStack
from fnmatch import fnmatchcase
from pathlib import Path
from types import TracebackType
from typing import Self

import msgspec

from r2p.clock import Alarm
from r2p.codecs.services import REQUESTS, RESPONSES
from r2p.errors import Closed, Error, InvalidName
from r2p.log_lines import get_logger
from r2p.messages import Message
from r2p.modules.module import Module
from r2p.modules.runner import saving
from r2p.monitoring.topic_types import TypeFinder
from r2p.names import RESERVED, topic_name
from r2p.recording.background_writer import BackgroundWriter
from r2p.recording.entries import BagEntry, MessageEntry, MetadataEntry
from r2p.recording.format import LATCHED
from r2p.recording.messages import LOSSES, TOPICS_MAX, RecorderLosses, TopicLosses
from r2p.recording.observations import Observations
from r2p.recording.recording_files import RecordingOptions
from r2p.recording.topics import RecordedTopic
from r2p.runtime.node import Node
from r2p.runtime.queues import Pulse
from r2p.runtime.topic import Topic
from r2p.units import MILLISECOND, SECOND

logger = get_logger("r2p.recording")

NODE = "recorder"
"""The name of the node that subscribes to what is recorded."""

Part = Callable[[Module, Callable[[BagEntry], object]], AbstractAsyncContextManager[object]]
"""Makes a part of the recorder."""

_TURN = 10 * MILLISECOND  # ns after which what has arrived goes to the disk: small pieces, which delay little else
_FOLLOW_EVERY = 50 * MILLISECOND  # ns between two looks for new topics
_LOSSES_EVERY = SECOND
_WAITING_REPORTED = 10_000_000  # bytes
_WILDCARDS = frozenset("*?[")


class TopicSelection:
    """The topics to record: names and patterns as in a shell (`camera/*`), None for all, without those excluded."""

    def __init__(self, topics: Iterable[str] | None = None, exclude: Iterable[str] = ()) -> None:
        """Choose topics. Raises InvalidName or NameTooLong for a name that no topic can have."""
        given = ["*"] if topics is None else [each.removeprefix("/") for each in _names(topics)]
        self._excluded = [each.removeprefix("/") for each in _names(exclude)]
        self._patterns = [each for each in given if _is_pattern(each)]
        named = [topic_name(each) for each in given if not _is_pattern(each)]
        if reserved := next((each for each in named if each in RESERVED), None):
            raise InvalidName(f"topic {reserved} has messages of r2p itself, which can't be recorded")
        self.names = [each for each in dict.fromkeys(named) if not self._is_excluded(each)]
        """The topics that are named in full: they are recorded from the start."""

    def has(self, topic: str) -> bool:
        """Return whether a topic is to be recorded."""
        if topic in RESERVED or self._is_excluded(topic):
            return False
        return topic in self.names or any(fnmatchcase(topic, each) for each in self._patterns)

    def _is_excluded(self, topic: str) -> bool:
        return any(fnmatchcase(topic, each) for each in self._excluded)


def _names(given: Iterable[str]) -> list[str]:
    """Return names as a list: a single text would be one of letters."""
    return [given] if isinstance(given, str) else list(given)


def _is_pattern(text: str) -> bool:
    return not _WILDCARDS.isdisjoint(text)


class TopicCount(msgspec.Struct, frozen=True):
    """What a recording has of a topic so far: `messages` that were received; of these `dropped` as the disk was too
    slow or full; and those that were `missed`, lost before they reached the recorder, by their publishers' numbers.
    """

    messages: int = 0
    dropped: int = 0
    missed: int = 0


class Recorder:
    """Records topics into a file while its block runs.

        async with r2p.Recorder(module, "drive.mcap", ["odometry", "camera/*"]):
            await module.wait()

    `topics` are names and patterns, None for all; topics that appear later are recorded from then on. `exclude` are
    names and patterns of topics to leave out. `types` has, by topic, the types of messages that no module announces.
    `options` say how the file is written: limits, several files, snapshots. `parts` record what is not a message: what
    happens on the network, unless others are given.

    Raises InvalidName or NameTooLong for a name that no topic can have.
    """

    def __init__(
        self,
        module: Module,
        path: str | os.PathLike[str],
        topics: Iterable[str] | None = None,
        *,
        exclude: Iterable[str] = (),
        types: Mapping[str, type[Message]] | None = None,
        options: RecordingOptions | None = None,
        parts: Iterable[Part] = (Observations,),
    ) -> None:
        self.path = Path(path)
        self._module = module
        self._selection = TopicSelection(topics, exclude)
        self._stated = {name.removeprefix("/"): cls for name, cls in (types or {}).items()}
        self._options = options or RecordingOptions()
        self._parts = list(parts)
        self._topics: dict[str, RecordedTopic] = {}
        self._entries: list[BagEntry] = []
        self._latched: set[str] = set()
        self._generations: list[tuple[int, int]] = []
        self._losses_at = 0
        self._follow_at = 0
        self._ended = Pulse()
        self._writer: BackgroundWriter | None = None
        self._closed = False
        self._stack = AsyncExitStack()

    # What a program reads

    @property
    def started(self) -> bool:
        """Whether the recording has begun; True also after its end."""
        return self._writer is not None

    @property
    def keeps(self) -> bool:
        """Whether the recorder only keeps the last seconds in memory, and writes them as snapshots."""
        return self._options.snapshot > 0.0

    @property
    def paths(self) -> list[Path]:
        """The files so far, oldest first. Raises Closed before the recorder was started."""
        return self._opened.paths

    @property
    def bytes_written(self) -> int:
        """Bytes in the files so far. Raises Closed before the recorder was started."""
        return self._opened.bytes_written

    @property
    def stopped(self) -> str:
        """The reason why the recording has ended by itself, such as a full disk; empty while it goes on."""
        return "" if self._writer is None else self._writer.stopped

    def counts(self) -> dict[str, TopicCount]:
        """Return what was received and lost so far, by topic. Raises Closed before the recorder was started.

        Other channels, such as `/can0/frames`, are there if the disk was too slow for them.
        """
        dropped, recorded = self._opened.lost, self._opened.recorded
        counts = {}
        for name, topic in sorted(self._topics.items()):
            lost = dropped.get(name, 0)
            received = recorded.get(name, 0) + lost if self._closed and not self.keeps else topic.messages
            counts[name] = TopicCount(received + topic.rejected, lost + topic.rejected, topic.missed)
        return counts

    async def wait(self) -> None:
        """Wait until the recording ends by itself: at a limit, or as the disk is full. `stopped` says why."""
        while not self.stopped:
            await self._ended.wait()

    async def snapshot(self) -> Path:
        """Write the last seconds (`snapshot` of the options) into a file, and return its path.

        Raises Error if the recorder keeps none, OSError if the file can't be written, and Closed unless it runs.
        """
        if not self.keeps:
            raise Error("the recorder keeps no last seconds in memory: start it with snapshot= in its options")
        self._hand_over()
        return await self._opened.snapshot()

    @property
    def _opened(self) -> BackgroundWriter:
        if self._writer is None:
            raise Closed(f"the recorder of {self.path} was not started: use it in an `async with` block")
        return self._writer

    def _report(self, text: str) -> None:
        """Log a report of the writer: as a warning, unless a limit that the program has set ended the recording."""
        logger.log(logging.DEBUG if self.stopped.startswith("max_") else logging.WARNING, "%s", text)

    # The beginning and the end

    async def __aenter__(self) -> Self:
        """Begin to record. Raises FileExistsError if the file exists, OSError if it can't be made, and Closed if the
        module is not open.
        """
        if self._writer is not None:
            raise Error(f"the recorder of {self.path} was started before: make a new one")
        space = self._module.space
        self._writer = BackgroundWriter(self.path, self._options, space.clock, self._report)
        self._stack.push_async_callback(self._writer.close)
        try:
            await self._begin()
        except BaseException:
            await self._stack.aclose()
            raise
        return self

    async def _begin(self) -> None:
        space = self._module.space
        self._node = Node(NODE, space)
        self._types = TypeFinder(self._module, self._stated)
        self._alarm = Alarm(space.loop, self._turn, background=True)
        self._stack.callback(self._finish)
        for part in self._parts:
            await self._stack.enter_async_context(part(self._module, self._entries.append))
        for name in self._selection.names:
            self._consider(name)
        for topic in list(space.topics.values()):
            self._own_changed(topic)
        space.listeners.append(self._own_changed)
        self._stack.callback(space.listeners.remove, self._own_changed)
        self._turn()

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the subscriptions, write what has arrived, and end the file.

        After a signal the program may take up to half a minute for that; a second one ends it at once.
        """
        with saving():
            if (waiting := self._opened.queued_bytes) > _WAITING_REPORTED:
                logger.warning("%.0f MB of the recording still wait for the disk", waiting / 1e6)
            await self._stack.aclose()
            self._closed = True

    def _finish(self) -> None:
        self._alarm.close()
        self._types.close()
        for each in self._topics.values():
            each.close()
        self._node.close()
        self._hand_over()
        self._put_losses()
        self._put_latched()
        self._hand_over()

    # While it runs

    def _turn(self) -> None:
        """Hand over what has arrived; less often, look for new topics and say what was lost."""
        now = self._module.space.clock.monotonic()
        if now >= self._follow_at:
            self._follow_at = now + _FOLLOW_EVERY
            self._follow()
            for topic in self._topics.values():
                topic.poll(now)
        if now >= self._losses_at:
            self._losses_at = now + _LOSSES_EVERY
            self._put_losses()
            self._put_latched()
        self._hand_over()
        if self.stopped:
            self._ended.emit()
        self._alarm.set(now + _TURN)

    def _follow(self) -> None:
        """Record topics that have appeared, and look for other types, if anything has changed in discovery."""
        links = self._module.links
        for link in links:
            for info in list(link.discovery.topics.values()):
                if info.advertised_at is not None and link.discovery.topic_behind(info.name) == info.name:
                    self._consider(info.name)
        generations = [(id(link), link.discovery.generation) for link in links]
        if generations != self._generations:
            self._generations = generations
            for topic in self._topics.values():
                topic.review()

    def _own_changed(self, topic: Topic) -> None:
        """Record a topic that this module publishes, from its first message on; those of tools are not of interest."""
        if topic.publishers and not self._module.observer:
            self._consider(topic.name)

    def _consider(self, name: str) -> None:
        if name not in self._topics and self._selection.has(name):
            self._record(name)

    def _record(self, name: str) -> None:
        topic = self._topics[name] = RecordedTopic(self._node, name, self._types, self._entries.append)
        topic.open()
        if name.endswith(RESPONSES):  # a server is there: the first request comes with its topic
            self._consider(name.removesuffix(RESPONSES) + REQUESTS)

    def _hand_over(self) -> None:
        if self._entries:
            self._opened.put(self._entries.copy())  # a copy: the topics go on with this list
            self._entries.clear()

    def _put_latched(self) -> None:
        """Write which topics are latched, when there are more than before: to be played as such."""
        unknown = [name for name in self._topics if name not in self._latched]
        if found := [name for name in unknown if self._is_latched(name)]:
            self._latched.update(found)
            self._entries.append(MetadataEntry(LATCHED, dict.fromkeys(sorted(self._latched), "yes")))

    def _is_latched(self, name: str) -> bool:
        own = self._module.space.topics.get(name)
        if own is not None and any(each.latch for each in own.publishers):
            return True
        return any(link.latched(name) for link in self._module.links)

    def _put_losses(self) -> None:
        counts = self.counts()
        lossy = [
            TopicLosses(name, each.dropped, each.missed) for name, each in counts.items() if each.dropped or each.missed
        ]
        losses = RecorderLosses(
            messages=sum(each.messages for each in counts.values()),
            queued_bytes=self._opened.queued_bytes,
            topics=tuple(lossy[:TOPICS_MAX]),
        )
        self._entries.append(MessageEntry(LOSSES, losses, self._module.space.clock.now()))
