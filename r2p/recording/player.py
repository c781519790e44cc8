"""Plays the messages of a bag on a module, as they were published: in time, in their class, byte for byte."""

import asyncio
import contextlib
import itertools
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from fnmatch import fnmatchcase
from types import TracebackType
from typing import Final, Self

import msgspec

from r2p.clock import Ticker
from r2p.errors import BagError, InvalidName, NameTooLong, TypeMismatch
from r2p.messages import SIZE_MAX, ClockOffset, Message, Timestamp, layout
from r2p.modules.module import Module
from r2p.names import (
    BUS_LOAD,
    BUS_SLOTS,
    LOADER_PREFIX,
    LOG,
    NODE_MAX,
    RESERVED,
    SERVICE_SUFFIXES,
    node_name,
    topic_name,
)
from r2p.protocols.discovery.events import TopicType
from r2p.recording.bag import Bag, RecordedSample
from r2p.recording.channels import BagChannel
from r2p.recording.format import ChannelInfo
from r2p.recording.pacing import PacedStream, Pacer
from r2p.recording.played_publisher import PlayedPeriodic, PlayedPublisher, period_of
from r2p.ros.clock import PERIOD, TOPIC, RosClock
from r2p.runtime.node import Node
from r2p.runtime.sample import PublisherClass, Sample
from r2p.units import SECOND

DEFAULT_NODE: Final = "play"
"""The name of the node for messages whose publisher is unknown."""

_PERIODS_OF: Final = 16  # messages of a periodic topic by which its period is found
_SURVEYED: Final = 10_000  # messages that are read before for their sizes and periods
_FAR: Final = 1 << 62  # ns since 1970, in the year 2116; stamps and deadlines beyond it are damage
_OVERHEAD: Final = 200  # bytes of a sample besides its own

Publication = tuple[str, str, str, PublisherClass]
"""A publisher in the recording: topic, module, node and class."""


class PlayOptions(msgspec.Struct, frozen=True, kw_only=True):
    """What of a bag is played, and how.

    `topics` and `exclude` are names or patterns as in a shell (`camera/*`); without `topics` all are played but those
    of r2p itself (`log`, `bus_load`, `bus_slots`), of boot loaders and of services: what is named is played in any
    case. `remap` gives topics other names. `start` and `end` are instants of the recording (UTC, ns), without `end`
    itself. `rate`: times the speed of the recording. `loop`: begin again at the end, for ever. `clock`: publish the
    time of the recording as `clock`, and keep the stamps of then.
    """

    topics: tuple[str, ...] = ()
    exclude: tuple[str, ...] = ()
    remap: Mapping[str, str] = {}
    start: int | None = None
    end: int | None = None
    rate: float = 1.0
    loop: bool = False
    clock: bool = False

    def wants(self, topic: str, type_name: str = "") -> bool:
        """Return whether a topic is to be played, by its name in the recording."""
        if topic in RESERVED or any(fnmatchcase(topic, each) for each in self.exclude):
            return False
        if topic in self.topics:
            return True
        if _is_special(topic, type_name) or (self.clock and topic == TOPIC):
            return False
        return not self.topics or any(fnmatchcase(topic, each) for each in self.topics)


def _is_special(topic: str, type_name: str) -> bool:
    """Return whether playing a topic says what is not so now, or makes other modules do more than messages do."""
    if topic in (LOG, BUS_LOAD, BUS_SLOTS) or topic.startswith(LOADER_PREFIX):
        return True
    return topic.endswith(SERVICE_SUFFIXES) and (not type_name or type_name.endswith(topic[-2:]))


class PlayedTopic(msgspec.Struct, frozen=True):
    """A topic that is played. `recorded` is its name in the recording, `cls` None if its type is unknown."""

    name: str
    recorded: str
    cls: type[Message] | None
    messages: int


class TopicTraits(msgspec.Struct):
    """What the first messages of a topic have in common; stamps in ns."""

    shortest: int = SIZE_MAX
    longest: int = 0
    stamps: list[int] = []

    def add(self, sample: Sample) -> None:
        """Enter a message."""
        size = len(sample.data)
        self.shortest, self.longest = min(size, self.shortest), max(size, self.longest)
        if len(self.stamps) < _PERIODS_OF:
            self.stamps.append(sample.stamp)

    @property
    def type(self) -> TopicType:
        """The type to announce. Of messages of several lengths there may be longer ones."""
        varies = self.shortest < self.longest
        return TopicType(2 * self.longest if varies else self.longest, varies=varies)


class Player:
    """Plays a bag while its block runs: topics are announced from its start, and messages are published by `run`.

        with r2p.Bag("drive.mcap") as bag:
            async with Player(module, bag, PlayOptions(topics=("encoder*",))) as player:
                await player.run()

    Each publisher of the recording is a node of this module, with the name that it had. Messages are published at their
    log times. Their stamps keep their distances, and deadlines their distance to the stamp; both are those of now. What
    messages themselves say stays as it is.
    """

    def __init__(self, module: Module, bag: Bag, options: PlayOptions = PlayOptions()) -> None:  # noqa: B008 - frozen
        """Choose the topics.

        Raises BagError for a choice without messages, InvalidName and NameTooLong for the names in `remap`, and
        MessageError for a rate that is out of range.
        """
        self.topics: dict[str, PlayedTopic] = {}
        """The topics by their names here."""
        self.left_out: dict[str, str] = {}
        """Topics that were chosen and can't be played, with the reason."""
        self.played: Counter[str] = Counter()
        """Messages that were played, by topic."""
        self.pacer = Pacer(module.space.loop, rate=options.rate)
        """The position, the rate and the pauses: CAN frames of the same recording may share it."""
        self._module = module
        self._space = module.space
        self._bag = bag
        self._options = options
        self._channels = self._chosen()
        self._publishers: dict[Publication, PlayedPublisher] = {}
        self._closing = contextlib.ExitStack()
        self._stream: PacedStream[RecordedSample] | None = None
        self._latched = bag.latched

    # What is played

    def _chosen(self) -> list[BagChannel]:
        wanted = [
            each
            for each in self._bag.channels
            if each.info is not None and each.kind == "samples" and self._options.wants(each.info.topic, each.type_name)
        ]
        if not wanted:
            raise BagError(self._nothing())
        if self.start > self._bag.end or self.end < self.start:
            seconds = (self._bag.end - self._bag.start) / SECOND
            raise BagError(
                f"nothing to play: no message of the recording, of {seconds:.1f} s, is from `start` to `end`"
            )
        found = [each for each in wanted if self._has_type(each)]
        if not found:
            topic, why = next(iter(self.left_out.items()))
            raise BagError(f"nothing to play: of {topic}, {why}")
        return found

    def _nothing(self) -> str:
        topics = list(self._bag.topics)
        name = ", ".join(str(each) for each in self._bag.paths)
        if not topics:
            return f"{name} has no messages of topics: there is nothing to play"
        shown = f"{', '.join(topics[:20])}{', ...' if len(topics) > 20 else ''}"
        return f"nothing to play: no topic of {name} is meant; it has {shown}"

    def _has_type(self, channel: BagChannel) -> bool:
        """Enter the topic of a channel; return False if it can't be played."""
        assert channel.info is not None
        recorded = channel.info.topic
        try:
            name = self._name(recorded)
        except (InvalidName, NameTooLong) as error:
            if recorded in self._options.remap:
                raise
            self.left_out[recorded] = str(error)
            return False
        if channel.encoding == "cdr" and channel.cls is None:
            self.left_out[recorded] = channel.problem
            return False
        known = self.topics.get(name)
        cls = channel.cls
        if known is not None and known.recorded != recorded:
            raise InvalidName(f"{known.recorded} and {recorded} would both be played as {name}: choose other names")
        if known is not None and None not in (known.cls, cls) and _differ(known.cls, cls):
            assert known.cls is not None
            self.left_out[recorded] = (
                f"it was recorded in several types, and is played as {layout(known.cls).name} only"
            )
            return False
        messages = channel.count + (known.messages if known is not None else 0)
        self.topics[name] = PlayedTopic(name, recorded, cls or (known and known.cls) or None, messages)
        return True

    def _name(self, recorded: str) -> str:
        """Return the name under which a topic is played. Raises InvalidName or NameTooLong."""
        name = topic_name(self._options.remap.get(recorded, recorded))
        if name in RESERVED:
            raise InvalidName(f"topic {name} has messages of r2p itself, which can't be played")
        return name

    @property
    def start(self) -> int:
        """Where in the recording playing begins (UTC, ns)."""
        return self._bag.start if self._options.start is None else max(self._options.start, self._bag.start)

    @property
    def end(self) -> int:
        """Where in the recording playing ends (UTC, ns)."""
        return self._bag.end if self._options.end is None else min(self._options.end, self._bag.end)

    @property
    def missed(self) -> dict[str, Counter[str]]:
        """Messages that did not reach every subscriber, by topic and reason."""
        found: dict[str, Counter[str]] = {}
        for each in self._publishers.values():
            if each.missed:
                found.setdefault(each.topic.name, Counter()).update(each.missed)
        return found

    @property
    def waiting(self) -> bool:
        """Whether messages that were played still wait for room."""
        return any(each.waiting for each in self._publishers.values())

    @property
    def subscribed(self) -> list[str]:
        """The topics that have subscribers now."""
        topics = self._space.topics
        return [
            name
            for name in self.topics
            if (topic := topics.get(name)) is not None
            and (topic.queues or any(each.reachable for each in topic.remote_subscribers))
        ]

    def other_publishers(self) -> dict[str, list[str]]:
        """Return the topics that other modules publish now, each with these publishers (`MODULE/node`)."""
        views = self._module.network.topics()
        found: dict[str, list[str]] = {}
        for name in self.topics:
            view = views.get(name)
            links = [each for each in view.published_on if each] if view is not None else []
            if view is not None and links:
                named = [f"{each.module or '?'}/{each.node}" for each in view.publishers if each.link]
                found[name] = named or [f"a module on {each}" for each in links]
        return found

    # Playing

    async def __aenter__(self) -> Self:
        """Announce the topics. Raises TypeMismatch if this module has one of them in another type."""
        traits = await self._survey()
        try:
            nodes = self._nodes()
            for channel in self._channels:
                self._publish(channel, nodes, traits)
            if self._options.clock:
                self._publish_clock()
        except BaseException:
            self._close()
            raise
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Withdraw the topics."""
        self._close()

    async def run(self) -> None:
        """Play from the start to the end; with `loop` again and again. Raises BagError if reading fails."""
        self._stream = PacedStream(self.pacer, self._play, lambda each: _OVERHEAD + len(each.sample.data))
        while True:
            await self._stream.open(self._records())
            self.pacer.begin(self.start)
            self._play_latched()
            await self._stream.run()
            if not self._options.loop:
                return

    def _close(self) -> None:
        if self._stream is not None:
            self._stream.close()
        for each in self._publishers.values():
            each.close()
        self._closing.close()

    def _records(self) -> Iterator[tuple[int, RecordedSample]]:
        names = {each.recorded for each in self.topics.values()}
        for record in self._bag.records(names, start=self.start, end=self._options.end):
            yield record.log_time, record

    def _play_latched(self) -> None:
        """Publish the latched values from before the start: a subscriber of then had them."""
        latched = {each.recorded for each in self.topics.values() if each.recorded in self._latched}
        if self.start > self._bag.start and latched:
            for record in self._bag.last_before(self.start, latched):
                self._play(self.start, record)

    def _play(self, time: int, record: RecordedSample) -> None:
        publisher = self._publishers.get(_publication(record.channel.info))
        if publisher is None:  # its type can't be played
            return
        publisher.sent += 1
        self.played[publisher.topic.name] += 1
        publisher.play(self._sample(time, record.sample, publisher))

    def _sample(self, time: int, old: Sample, publisher: PlayedPublisher) -> Sample:
        """Return a sample as it is published now; `time` is when it was recorded (UTC, ns)."""
        now = self.pacer.utc(time)
        stamp = old.stamp if self._options.clock else now + round((old.stamp - time) / self.pacer.rate)
        if abs(stamp) > _FAR:  # in a damaged recording
            stamp = now
        shift = stamp - old.stamp
        span = old.deadline - old.stamp if old.deadline else 0
        if abs(span) > _FAR:
            span = 0
        moved = old.clock and _moved(old.clock, shift)
        return Sample(
            old.data,
            publisher.source,
            stamp,
            stamp + span if span else 0,
            publisher.sent,
            old.publisher_class,
            None,
            old.stamped,
            old.drop_late,
            0,
            moved,
            now + span if span else 0,
        )

    # Topics and nodes

    def _nodes(self) -> Callable[[ChannelInfo], Node]:
        """Return a function that returns the node of a publisher, by its old name, with its module's where needed."""
        owners: dict[str, set[str]] = {}
        for each in self._channels:
            assert each.info is not None
            owners.setdefault(_node_name(each.info), set()).add(each.info.module)
        nodes: dict[str, Node] = {}

        def find(info: ChannelInfo) -> Node:
            name = _node_name(info)
            if len(owners[name]) > 1 and info.module:
                name = f"{info.module.replace('/', '_')}_{name}"[-NODE_MAX:]
            if name not in nodes:
                nodes[name] = node = Node(name, self._space)
                self._closing.callback(node.close)
            return nodes[name]

        return find

    def _publish(
        self, channel: BagChannel, nodes: Callable[[ChannelInfo], Node], surveyed: Mapping[str, TopicTraits]
    ) -> None:
        info = channel.info
        assert info is not None
        key = _publication(info)
        if key in self._publishers:
            return
        name = self._name(info.topic)
        cls = self.topics[name].cls
        try:
            topic = self._space.open(name, None if cls is None else layout(cls))
        except TypeMismatch as error:
            raise TypeMismatch(f"{error}; play it under another name") from None
        node, latch = nodes(info), info.topic in self._latched
        traits = surveyed.get(info.topic, TopicTraits())
        if cls is None:
            topic.unnamed_type = traits.type
        period = period_of(traits.stamps) / self.pacer.rate
        if info.publisher_class is PublisherClass.PERIODIC and period:
            self._publishers[key] = PlayedPeriodic(self._space, node, topic, latch=latch, period=period)
        else:
            self._publishers[key] = PlayedPublisher(self._space, node, topic, info.publisher_class, latch=latch)

    async def _survey(self) -> dict[str, TopicTraits]:
        """Read the first messages of topics of which links have to know more than the file says."""
        unnamed = {each.recorded for each in self.topics.values() if each.cls is None}
        has_slots = any(link.has_slots for link in self._module.links)
        infos = [each.info for each in self._channels if each.info is not None] if has_slots else []
        periodic = {each.topic for each in infos if each.publisher_class is PublisherClass.PERIODIC}
        if not unnamed | periodic:
            return {}
        return await asyncio.get_running_loop().run_in_executor(None, self._read_traits, unnamed | periodic)

    def _read_traits(self, names: set[str]) -> dict[str, TopicTraits]:
        found = {name: TopicTraits() for name in names}
        for record in itertools.islice(self._bag.records(names, start=self.start, end=self._options.end), _SURVEYED):
            found[record.topic].add(record.sample)
        return found

    def _publish_clock(self) -> None:
        node = Node(TOPIC, self._space)
        self._closing.callback(node.close)
        publisher = node.advertise(TOPIC, RosClock)

        def publish(scheduled: int, late: int, skipped: int) -> None:
            publisher.publish_nowait(RosClock(Timestamp.from_ns(min(self.pacer.position, self.end))))

        ticker = Ticker(self._space.loop, PERIOD, publish, background=True)
        ticker.start()
        self._closing.callback(ticker.close)


def _differ(one: type[Message] | None, other: type[Message] | None) -> bool:
    return one is not None and other is not None and layout(one).fingerprint != layout(other).fingerprint


def _publication(info: ChannelInfo | None) -> Publication:
    assert info is not None
    return info.topic, info.module, info.node, info.publisher_class


def _node_name(info: ChannelInfo) -> str:
    for name in (info.node, info.module.rpartition("/")[2]):
        with contextlib.suppress(InvalidName, NameTooLong):  # of another program, or none
            return node_name(name)
    return DEFAULT_NODE


def _moved(clock: ClockOffset, shift: int) -> ClockOffset | None:
    """Return the translation of network time to UTC at another time: what a payload says is then of that time, too.

    None for one that can't be, in a damaged recording.
    """
    offset = clock.offset + shift
    can_be = abs(offset) <= _FAR and 0 <= clock.epoch < 1 << 32
    return msgspec.structs.replace(clock, offset=offset) if can_be else None
