"""Collects the figures of a module's network once a second."""

import asyncio
import contextlib
import functools
from types import TracebackType
from typing import Self

from r2p.errors import Closed, InvalidName
from r2p.log_lines import get_logger
from r2p.modules.graph import TopicLooks, TopicView
from r2p.modules.module import Module
from r2p.modules.statistics import ModuleStatistics, first_part
from r2p.monitoring.buses import BusTables
from r2p.monitoring.counters import ModuleCounters
from r2p.monitoring.measuring import MeasuredTopic
from r2p.monitoring.polling import StatisticsPolling, can_be_asked
from r2p.monitoring.rows import (
    FigureSources,
    KnownTopics,
    TopicRow,
    TypeNames,
    keep_equal,
    link_rows,
    module_rows,
    service_rows,
)
from r2p.monitoring.snapshot import NetworkSnapshot, TopicFigures
from r2p.monitoring.topic_types import TypeFinder
from r2p.names import BUS_LOAD, BUS_SLOTS, RESERVED, topic_name
from r2p.runtime.node import Node
from r2p.units import SECOND

TOPICS_MAX = 10_000
"""Topics that a snapshot has: more are counted, and left out."""

_NODE = "monitor"
_MODULES_MAX = 256  # modules that are asked: their names come from the network
_ENTRIES_MAX = 50_000  # entries that are kept of all answers
_ENTRIES_PER_SECOND = 2_000  # of answers, which take about 60 messages: a larger network is asked less often
_AT_ONCE = 200  # topics in one turn of the event loop
_EARLY = 0.25  # s between two looks at first: a person waits for what is there ...
_EARLY_MIN, _EARLY_MAX = 2.0, 4.0  # s, ... for the former, and until rates are known, but no longer than the latter
_SHARE = 20  # times as long as collecting takes, it rests: a network of any size takes a twentieth of the loop, ...
_SHARE_EARLY = 4  # ... and more at first, when it takes long as all is new

logger = get_logger("r2p.monitoring")


class NetworkMonitor:
    """Collects figures while its block is open: `snapshot` is the newest, and `changed()` waits for the next one.

    Modules are asked for their statistics each `period` (s), and less often where answers are slow. In its first
    seconds, until rates are known, it looks four times a second at what is there. Collecting takes short turns in the
    event loop, whatever the number of topics.
    """

    def __init__(self, module: Module, *, period: float = 1.0, types: TypeFinder | None = None) -> None:
        """`types`: those that a tool knows or uses itself."""
        self.snapshot = NetworkSnapshot(time=0)
        """The newest figures."""
        self.types = types or TypeFinder(module)
        """Finds the message classes of topics."""
        self._module = module
        self._clock = module.space.clock
        self._period = period
        self._changed = asyncio.Event()
        self._node = Node(_NODE, module.space)
        self._sources = FigureSources(BusTables(module, self._node), self.types)
        self._type_names = TypeNames(self.types)
        self._looks = TopicLooks(module.network, module.space)
        self._views: dict[str, TopicView] = {}
        self._topics = KnownTopics.of({})
        self._topic_rows: list[TopicRow] = []
        self._counted: object = None
        self._polling = StatisticsPolling(module, period)
        self._polls: dict[str, asyncio.Task[None]] = {}
        self._entries = 0  # that are kept of all answers
        self._learning: asyncio.Task[None] | None = None
        self._is_early = True
        self._opened_at = 0

    async def __aenter__(self) -> Self:
        """Begin to collect. Raises Closed if the module is not open."""
        self._opened_at = self._clock.monotonic()
        await self._collect()
        self._task = asyncio.create_task(self._run(), name=f"{self._module.name} monitor")
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        tasks = [self._task, *self._polls.values(), *filter(None, [self._learning])]
        for task in tasks:
            task.cancel()
        await asyncio.wait(tasks)
        self._sources.buses.close()
        for measured in self._sources.measured.values():
            measured.close()
        self._sources.measured.clear()
        self._node.close()
        self.types.close()

    async def changed(self) -> NetworkSnapshot:
        """Wait for the next figures, and return them."""
        await self._changed.wait()
        return self.snapshot

    async def ready(self) -> NetworkSnapshot:
        """Wait until the rates of all modules that answer are known, for a few seconds at most, and return the figures.

        What is not announced yet is not waited for.
        """
        while self._is_early:
            await self.changed()
        return self.snapshot

    # Measured topics

    def measure(self, topic: str) -> None:
        """Subscribe to a topic, to know its rate, latency and losses; as often as `stop_measuring` is called later.

        Raises InvalidName and NameTooLong for a name that no topic can have.
        """
        if topic in RESERVED:
            raise InvalidName(f"topic {topic} has messages of r2p itself, which can't be measured")
        measured = self._sources.measured.get(topic)
        if measured is None:
            known = any(topic in link.discovery.topics for link in self._module.links)
            name = topic if known else topic_name(topic)
            measured = self._sources.measured[topic] = MeasuredTopic(self._module, self._node, name)
            measured.open()
        measured.users += 1

    def stop_measuring(self, topic: str) -> None:
        """Give up a measurement; the last user of a topic ends its subscription."""
        measured = self._sources.measured.get(topic)
        if measured is None:
            return
        measured.users -= 1
        if not measured.users:
            del self._sources.measured[topic]
            measured.close()

    # Once each period

    async def _run(self) -> None:
        took = 0.0
        while True:
            if self._is_early:
                await asyncio.sleep(max(min(self._period, _EARLY), _SHARE_EARLY * took))
            else:
                await asyncio.sleep(max(self._period, _SHARE * took))
            started = self._clock.monotonic()
            try:
                await self._collect()
            except Closed:
                return
            except Exception as error:
                logger.error("internal error, please report it: figures are missing", exc_info=error)
            took = (self._clock.monotonic() - started) / SECOND

    async def _collect(self) -> None:
        network, sources = self._module.network, self._sources
        for measured in sources.measured.values():
            measured.report()
        buses = sources.buses.look()
        modules = network.modules()
        self._poll({view.name for view in modules if can_be_asked(view)})
        topics = self._look()
        sources.sum_up(topics.views)
        self._learn(topics)
        before = self.snapshot
        self.snapshot = NetworkSnapshot(
            time=self._clock.now(),
            network=", ".join(link.name for link in self._module.links),
            modules=keep_equal(before.modules, module_rows(modules, topics, sources)),
            topics=await self._collect_topics(topics),
            services=keep_equal(before.services, service_rows(topics, sources, self._type_names)),
            links=keep_equal(before.links, link_rows(sources.counters)),
            buses=keep_equal(before.buses, buses),
            topics_left_out=topics.left_out,
        )
        self._is_early = self._is_early and self._has_just_begun()
        changed, self._changed = self._changed, asyncio.Event()
        changed.set()

    def _has_just_begun(self) -> bool:
        """Return whether modules may still be announced, or one that answers has not said rates yet."""
        since = (self._clock.monotonic() - self._opened_at) / SECOND
        answering = (each for each in self._sources.counters.values() if each.answers is not False)
        return since < _EARLY_MIN or (since < _EARLY_MAX and not all(each.has_rates for each in answering))

    def _is_own_wish(self, view: TopicView) -> bool:
        """Return whether only this tool would have the topic: what a bus reports, if there is one."""
        return (
            view.name.endswith((BUS_LOAD, BUS_SLOTS))
            and not (view.published_on or view.publishers)
            and view.subscribed_on == [""]
            and all(not each.link and each.node == _NODE for each in view.subscribers)
        )

    def _look(self) -> KnownTopics:
        """Return the topics of now: the same object as before, if only ages have changed."""
        views = self._looks.look()
        if views is not self._views:
            self._views = views
            shown = [(name, view) for name, view in views.items() if not self._is_own_wish(view)]
            self._topics = KnownTopics.of(dict(shown[:TOPICS_MAX]), max(0, len(shown) - TOPICS_MAX))
        return self._topics

    async def _collect_topics(self, topics: KnownTopics) -> list[TopicFigures]:
        """Return the rows of topics, in several turns of the event loop."""
        counted = topics, self._sources.endpoint_revisions()
        if counted != self._counted:
            self._counted = counted
            before = {row.name: row for row in self.snapshot.topics}
            sources, types = self._sources, self._type_names
            self._topic_rows = [
                TopicRow(view, sources, types, before.get(name), is_of_service=name in topics.of_services)
                for name, view in topics.views.items()
            ]
        rows: list[TopicFigures] = []
        for start in range(0, len(self._topic_rows), _AT_ONCE):
            rows += [row.update() for row in self._topic_rows[start : start + _AT_ONCE]]
            await asyncio.sleep(0)
        return rows

    # Types

    def _learn(self, topics: KnownTopics) -> None:
        """Ask for types that are unknown, one after the other, unless that is being done."""
        if self._learning is not None and not self._learning.done():
            return
        known = self.types.by_fingerprint
        unknown = [topic for fingerprint, topic in topics.to_learn.items() if known(fingerprint) is None]
        if unknown:
            finding = self._find_types(unknown)
            self._learning = asyncio.create_task(finding, name=f"{self._module.name} finds types")

    async def _find_types(self, topics: list[str]) -> None:
        with contextlib.suppress(Closed):
            for topic in topics:
                await self.types.find(topic)

    # Statistics

    def _poll(self, names: set[str]) -> None:
        """Begin to ask new modules, and stop asking those that have left."""
        ended = {name for name, task in self._polls.items() if task.done()}  # by an internal error: it begins anew
        for name in (self._polls.keys() - names) | ended:
            self._polls.pop(name).cancel()
            self._entries -= self._sources.counters.pop(name).entries
        for name in sorted(names - self._polls.keys())[: _MODULES_MAX - len(self._polls)]:
            counters = self._sources.counters[name] = ModuleCounters()
            on_answer = functools.partial(self._answered, name, counters)
            asking = self._polling.run(name, on_answer, counters.silence)
            self._polls[name] = asyncio.create_task(asking, name=f"monitor asks {name}")

    def _answered(self, name: str, counters: ModuleCounters, answer: ModuleStatistics | bytes) -> None:
        others = self._entries - counters.entries
        try:
            if isinstance(answer, bytes):
                counters.read(name, first_part(answer), _ENTRIES_MAX - others)
            else:
                counters.update(name, answer, _ENTRIES_MAX - others)
        finally:
            self._entries = others + counters.entries
        self._polling.period = max(self._period, self._entries / _ENTRIES_PER_SECOND)
