"""The figures of a network at an instant of its recording, as the page shows those of a running one.

Rates are of the messages in the second before. What modules have counted is from their statistics, and what buses
carried from their loads, as these were recorded last: within the last seconds, as otherwise they are not known. What
changes rarely (the state of modules, the owners of slots) is from the scan, as far as that has come.
"""

import itertools
import math
from bisect import bisect_right
from collections import defaultdict
from collections.abc import Iterable, Iterator
from functools import partial

import msgspec

from r2p.codecs.services import is_of_service
from r2p.errors import DecodeError
from r2p.modules.statistics import ModuleStatistics, ServiceStatistics
from r2p.monitoring.counters import ModuleCounters, clamp, network_name
from r2p.monitoring.snapshot import (
    CLASS_NAMES,
    BusFigures,
    BusTopicFigures,
    LinkFigures,
    ModuleFigures,
    NetworkSnapshot,
    NodeFigures,
    PublisherFigures,
    ServiceFigures,
    SlotFigures,
    SubscriberFigures,
    TopicFigures,
)
from r2p.msg import BusTraffic
from r2p.recording.bag import Bag
from r2p.recording.channels import BagChannel
from r2p.recording.messages import BUS_LOADS, LOSSES, STATISTICS, RecorderLosses
from r2p.recording.observations import NETWORK
from r2p.ros.cdr import cdr
from r2p.units import SECOND
from r2p.web.dash.recorded.reader import ChunkTable, RecordingReader
from r2p.web.dash.recorded.scan import RecordingScan

RECORDED = "recorded"
"""The source of a rate: messages in the recording."""

_WINDOW = SECOND  # ns before the instant, for rates
_STATISTICS_WITHIN = 15 * SECOND  # ns: on slow links, modules are asked each ten seconds
_LOADS_WITHIN = 3 * SECOND  # ns: they are said once a second
_CHUNKS_MAX = 64  # that are read for one instant: those of r2p last half a second each
_ENTRIES_MAX = 1 << 16  # of the statistics of all modules together
_MODULES_MAX = 1024
_STATISTICS_MAX = 1 << 20  # bytes of an answer of a module
_NAME_MAX = 512  # characters; what has a longer name is not shown
_TOPICS_MAX = 10_000
_ATTACHMENT_MAX = 1 << 20  # bytes of the description of the network

Node = tuple[str, str]
"""Module and node."""


class _DescribedNode(msgspec.Struct):
    module: str = ""
    node: str = ""
    publishes: list[str] = []
    subscribes: list[str] = []


class _DescribedNetwork(msgspec.Struct):
    """What is used of the description of the network in a recording."""

    nodes: list[_DescribedNode] = []


class _Answers(msgspec.Struct):
    """What a module had counted at `time` (ns), and before that, for what has grown since."""

    time: int
    statistics: ModuleStatistics
    earlier: ModuleStatistics | None = None

    def counters(self, module: str, room: int) -> ModuleCounters:
        """Return the counters of the module, with at most `room` entries."""
        found = ModuleCounters()
        for each in filter(None, (self.earlier, self.statistics)):
            found.update(module, each, room)
        return found


class RecordedFigures:
    """Makes the figures of a recording at any instant of it."""

    def __init__(self, reader: RecordingReader, scan: RecordingScan) -> None:
        self._reader = reader
        self._scan = scan
        self._static: _Contents | None = None

    async def at(self, time: int) -> NetworkSnapshot:
        """Return the figures at an instant (ns). Raises BagError if the recording can't be opened."""
        bag = await self._reader.bag()
        with self._reader.ahead():
            return await self._at(bag, time)

    async def _at(self, bag: Bag, time: int) -> NetworkSnapshot:
        if self._static is None:
            self._static = await self._reader.run(lambda: _Contents(bag))
        static = self._static
        now = _Instant(static, self._scan, time)
        start = max(time - _WINDOW, bag.start)
        for number, chunk in itertools.islice(static.samples.back_from(time, start), _CHUNKS_MAX):
            times = await self._reader.run(partial(self._reader.times, bag, number, chunk))
            now.count(number, times, start)
        for number, chunk in itertools.islice(static.observed.back_from(time, time - _STATISTICS_WITHIN), _CHUNKS_MAX):
            wanted = static.observed.ids[number]
            records = await self._reader.run(partial(self._reader.records, bag, number, chunk, wanted))
            for record in reversed(records):
                now.observe(static.bag.files[number].channels[record[1]], record[0], record[4])
            if now.knows_all:
                break
        return await self._reader.run(now.snapshot)


class _Contents:
    """What of a recording does not depend on the time."""

    def __init__(self, bag: Bag) -> None:
        self.bag = bag
        self.samples = ChunkTable(bag, lambda each: each.kind == "samples")
        self.observed = ChunkTable(bag, _is_observed)
        self.observed_names = {each.name for each in bag.channels if _is_observed(each)}
        self.channels: dict[str, list[BagChannel]] = defaultdict(list)
        """The channels with samples of each topic."""
        self.left_out = 0
        """Channels that are not shown, as there are too many, or their names are too long."""
        for each in bag.channels:
            if each.kind != "samples" or each.info is None:
                continue
            topic, known = each.info.topic, len(self.channels)
            if _is_short(each) and (topic in self.channels or known < _TOPICS_MAX):
                self.channels[topic].append(each)
            else:
                self.left_out += 1
        self.nodes = _described_nodes(bag)

    def publishers(self, topic: str) -> dict[Node, PublisherFigures]:
        """Return the publishers of a topic that the recording has messages of; of other programs they are not known."""
        found: dict[Node, PublisherFigures] = {}
        for each in self.channels.get(topic, ()):
            info = each.info
            if info is not None and (info.module or info.node):
                found[info.module, info.node] = PublisherFigures(
                    info.module, info.node, info.link, CLASS_NAMES[info.publisher_class]
                )
        return found


def _is_short(channel: BagChannel) -> bool:
    """Return whether the names of a channel have lengths that a network could have."""
    info = channel.info
    names = (channel.name, channel.type_name, *((info.module, info.node, info.link) if info is not None else ()))
    return max(map(len, names)) <= _NAME_MAX


def _is_observed(channel: BagChannel) -> bool:
    return (
        channel.kind == "messages"
        and len(channel.name) <= _NAME_MAX
        and (channel.name == LOSSES or channel.name.startswith((f"{STATISTICS}/", f"{BUS_LOADS}/")))
    )


def _described_nodes(bag: Bag) -> dict[Node, _DescribedNode]:
    """Return the nodes in the description of the network that the recorder attached; without one, an empty list."""
    for attachment in itertools.chain.from_iterable(file.attachments(NETWORK, _ATTACHMENT_MAX) for file in bag.files):
        try:
            network = msgspec.json.decode(attachment.data, type=_DescribedNetwork)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            continue
        return {(each.module, each.node): each for each in network.nodes[:_ENTRIES_MAX]}
    return {}


class _Instant:
    """Collects what is known of one instant."""

    def __init__(self, static: _Contents, scan: RecordingScan, time: int) -> None:
        self._static = static
        self._scan = scan
        self._time = time
        self._counts: dict[str, int] = defaultdict(int)
        self._heard: dict[str, int] = {}  # the last message of a module (ns)
        self._seconds = 0.0
        self._answers: dict[str, _Answers] = {}
        self._counters: dict[str, ModuleCounters] = {}
        self._loads: dict[str, tuple[int, BusTraffic]] = {}
        self._lost: RecorderLosses | None = None
        self._complete: set[str] = set()

    @property
    def knows_all(self) -> bool:
        """Whether earlier chunks would add nothing."""
        return self._complete >= self._static.observed_names

    def count(self, number: int, times: dict[int, list[int]], start: int) -> None:
        """Count the messages of a chunk after `start`."""
        channels = self._static.bag.files[number].channels
        self._seconds = (self._time - start) / SECOND
        for key, each in times.items():
            channel = channels.get(key)
            if channel is None or channel.info is None or channel.kind != "samples":
                continue
            end = bisect_right(each, self._time)
            if count := end - bisect_right(each, start):
                self._counts[channel.info.topic] += count
                self._heard[channel.info.module] = max(each[end - 1], self._heard.get(channel.info.module, 0))

    def observe(self, channel: BagChannel, time: int, data: bytes) -> None:
        """Enter a message of a recorder; those that come later are earlier."""
        name = channel.name
        if time > self._time or name in self._complete or len(data) > _STATISTICS_MAX:
            return
        try:
            if name.startswith(f"{STATISTICS}/"):
                self._answered(name.removeprefix(f"{STATISTICS}/"), time, cdr(ModuleStatistics).decode(data))
            elif name == LOSSES:
                self._complete.add(name)
                self._lost = cdr(RecorderLosses).decode(data)
            else:
                self._complete.add(name)
                if time > self._time - _LOADS_WITHIN:
                    self._loads[name.removeprefix(f"{BUS_LOADS}/")] = time, cdr(BusTraffic).decode(data)
        except DecodeError:
            self._complete.add(name)

    def _answered(self, module: str, time: int, statistics: ModuleStatistics) -> None:
        later = self._answers.get(module)
        if later is None and len(self._answers) >= _MODULES_MAX:
            return
        if later is None:
            self._answers[module] = _Answers(time, statistics)
        elif time < later.time:
            self._complete.add(f"{STATISTICS}/{module}")
            later.earlier = statistics

    def snapshot(self) -> NetworkSnapshot:
        """Return the figures of all that was entered."""
        room = _ENTRIES_MAX
        for name, answers in sorted(self._answers.items()):
            counters = self._counters[name] = answers.counters(name, room)
            room -= counters.entries
        return NetworkSnapshot(
            time=self._time,
            network=", ".join(each.file.path.name for each in self._static.bag.files[:1]),
            modules=list(self._modules()),
            topics=list(self._topics()),
            services=list(self._services()),
            links=list(self._links()),
            buses=list(self._buses()),
            topics_left_out=self._static.left_out,
        )

    # Topics

    def _topics(self) -> Iterator[TopicFigures]:
        publishers, subscribers = self._counted_publishers(), self._counted_subscribers()
        names = {*self._static.channels, *publishers, *subscribers}
        lost_on_way, laxity = self._on_links()
        lost = {each.topic: each for each in self._lost.topics} if self._lost is not None else {}
        for name in sorted(names)[:_TOPICS_MAX]:
            known = self._static.publishers(name)
            known |= publishers.get(name, {})
            size, varies = self._scan.sizes.get(name, (None, False))
            topic = TopicFigures(
                name,
                size=size,
                varies=varies,
                type=next((each.type_name for each in self._static.channels.get(name, ()) if each.type_name), None),
                publishers=tuple(known.values()),
                subscribers=tuple(subscribers.get(name, {}).values()),
                missed=_sum(each.missed for each in known.values()),
                late=_sum(each.late for each in known.values()),
                laxity=laxity.get(name),
                is_of_service=is_of_service(name, names),
            )
            self._add_rate(topic)
            if topic.rate is not None and size is not None and not varies:
                topic.bandwidth = topic.rate * size
            missed = lost[name].missed if name in lost else 0 if self._lost is not None else None
            topic.lost_on_way = _sum((lost_on_way.get(name, 0 if self._counters else None), missed))
            topic.lost_here = lost[name].dropped if name in lost else missed
            yield topic

    def _add_rate(self, topic: TopicFigures) -> None:
        rates = [each.rate for each in topic.publishers if each.rate is not None]
        if topic.name in self._static.channels and self._seconds >= 0.5:
            topic.rate, topic.rate_source = self._counts.get(topic.name, 0) / self._seconds, RECORDED
        elif rates and len(rates) == len(topic.publishers):
            topic.rate, topic.rate_source = sum(rates), "counters"

    def _counted_publishers(self) -> dict[str, dict[Node, PublisherFigures]]:
        """Return the publishers by topic, with what their modules have counted."""
        found: dict[str, dict[Node, PublisherFigures]] = defaultdict(dict)
        for module, counters in self._counters.items():
            for (node, name), count in counters.publishers.items():
                topic = network_name(module, name, self._static.channels)
                row = self._static.publishers(topic).get((module, node)) or PublisherFigures(module, node)
                row.rate, row.sent, row.missed, row.late = count.rate, count.sent, count.missed, count.late
                # Messages that came by a link without classes, such as a gateway's TCP port, were recorded without.
                row.publisher_class = count.publisher_class or row.publisher_class
                found[topic][module, node] = row
        return found

    def _counted_subscribers(self) -> dict[str, dict[Node, SubscriberFigures]]:
        found: dict[str, dict[Node, SubscriberFigures]] = defaultdict(dict)
        for (module, node), described in self._static.nodes.items():
            for topic in described.subscribes:
                found[topic][module, node] = SubscriberFigures(module, node)
        for module, counters in self._counters.items():
            for (node, name), count in counters.subscribers.items():
                topic = network_name(module, name, self._static.channels)
                found[topic][module, node] = SubscriberFigures(module, node, waiting=count.waiting, lost=count.lost)
        return found

    def _on_links(self) -> tuple[dict[str, int], dict[str, float]]:
        """Return what links, gateways and subscribers have lost of each topic, and its least laxity (s)."""
        lost: dict[str, int] = {}
        laxity: dict[str, float] = {}
        for module, counters in self._counters.items():
            for name, count in counters.lost.items():
                topic = network_name(module, name, self._static.channels)
                lost[topic] = lost.get(topic, 0) + count
            for name, least in counters.laxity.items():
                topic = network_name(module, name, self._static.channels)
                laxity[topic] = min(least, laxity.get(topic, least))
        return lost, laxity

    # Modules and links

    def _modules(self) -> Iterator[ModuleFigures]:
        events = self._scan.module_events.at(self._time)
        present = {name: each for name, each in events.items() if each.kind != "module gone"}
        nodes = self._nodes()
        for name in sorted(present.keys() | self._answers.keys() | {module for module, _ in nodes} - {""}):
            if name in events and name not in present:
                continue
            event, counters = present.get(name), self._counters.get(name)
            parts = event.text.split(", ") if event is not None and event.kind != "module silent" else []
            yield ModuleFigures(
                name,
                state="silent" if event is not None and event.kind == "module silent" else next(iter(parts), ""),
                kind=parts[1] if len(parts) > 1 else "r2p" if counters is not None else "",
                age=self._age(name),
                link=event.link if event is not None else "",
                release=parts[2] if len(parts) > 2 else None,
                answers=None if f"{STATISTICS}/{name}" not in self._static.observed_names else counters is not None,
                uptime=counters.uptime if counters is not None else None,
                cpu=counters.cpu if counters is not None else None,
                nodes=[nodes[key] for key in sorted(key for key in nodes if key[0] == name)],
            )

    def _age(self, module: str) -> float:
        """Return how many seconds ago a module was last heard; NaN (null in JSON) if it never was."""
        answer = self._answers.get(module)
        heard = max(self._heard.get(module, 0), answer.time if answer is not None else 0)
        return (self._time - heard) / SECOND if heard else math.nan

    def _nodes(self) -> dict[Node, NodeFigures]:
        """Return the nodes of all modules: as they were described, and as modules have said since."""
        topics: dict[Node, tuple[set[str], set[str]]] = defaultdict(lambda: (set(), set()))
        for key, described in self._static.nodes.items():
            topics[key][0].update(described.publishes)
            topics[key][1].update(described.subscribes)
        for topic in self._static.channels:
            for key in self._static.publishers(topic):
                if key[1]:
                    topics[key][0].add(topic)
        said: dict[Node, tuple[bool, int]] = {}
        for module, counters in self._counters.items():
            said |= {(module, node): each for node, each in counters.nodes.items()}
            for node, name in counters.publishers:
                topics[module, node][0].add(network_name(module, name, self._static.channels))
            for node, name in counters.subscribers:
                topics[module, node][1].add(network_name(module, name, self._static.channels))
        return {
            key: NodeFigures(key[1], *said.get(key, (None, None)), *map(sorted, topics[key]))
            for key in {*topics, *said}
        }

    def _links(self) -> Iterator[LinkFigures]:
        for counters in self._counters.values():
            yield from counters.links.values()

    def _services(self) -> Iterator[ServiceFigures]:
        served: dict[str, list[tuple[str, ServiceStatistics]]] = defaultdict(list)
        for module, counters in self._counters.items():
            for (node, name), each in counters.services.items():
                served[network_name(module, name, self._static.channels)].append((f"{module}/{node}", each))
        for name, servers in sorted(served.items()):
            yield ServiceFigures(
                name,
                servers=[server for server, _ in servers],
                running=sum(each.running for _, each in servers),
                waiting=sum(each.waiting for _, each in servers),
                handled=clamp(sum(each.handled for _, each in servers)),
                failed=clamp(sum(each.failed for _, each in servers)),
                refused=clamp(sum(each.refused for _, each in servers)),
            )

    # Buses

    def _buses(self) -> Iterator[BusFigures]:
        buses: dict[str, BusFigures] = {}
        for channel, (_, row) in sorted(self._loads.items()):
            name = channel[: channel.find(row.bus) + len(row.bus)] if row.bus and row.bus in channel else channel
            bus = buses.setdefault(name, BusFigures(name))
            if row.kind == "total":
                bus.share, bus.frames, bus.errors = row.share, row.frames, row.errors
                bus.reserved, bus.free_used = row.reserved, row.free_used
            else:
                bus.topics.append(BusTopicFigures(row.kind, row.topic, row.module, row.share, row.frames))
        for name, table in self._scan.slots.at(self._time).items():
            bus = buses.setdefault(name, BusFigures(name))
            bus.master, bus.cycle, bus.slots_in_cycle = table.master or None, table.cycle, table.slots_in_cycle
            bus.slots = [SlotFigures(each.topic, each.module, list(each.slots)) for each in table.owners]
        yield from buses.values()


def _sum(values: Iterable[int | None]) -> int | None:
    """Return the sum of the known counts; None without any."""
    known = [each for each in values if each is not None]
    return clamp(sum(known)) if known else None
