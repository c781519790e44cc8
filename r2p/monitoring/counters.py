"""What one module counts, by its last answers: totals, and rates between two answers by the module's own clock.

Names, numbers and times come from another module: names are made printable, sums stay within 64 bits, and a clock that
goes back or is not a number only costs the rates.
"""

import math
import operator
from collections.abc import Iterable, Iterator, Mapping
from itertools import islice
from typing import TypeVar

import msgspec

from r2p.log_lines import printable
from r2p.messages import layout
from r2p.modules.statistics import (
    LinkStatistics,
    ModuleStatistics,
    PublisherStatistics,
    ReasonCount,
    ServiceStatistics,
    SubscriberStatistics,
)
from r2p.monitoring.answers import AnswerNumbers, Columns, KnownAnswer
from r2p.monitoring.rates import CounterRate
from r2p.monitoring.snapshot import CLASS_NAMES, LinkFigures
from r2p.names import node_alias, topic_alias
from r2p.units import MILLISECOND, SECOND

E = TypeVar("E")

COUNT_MAX = (1 << 63) - 1
"""The greatest count: sums over modules may be greater, which JSON and others can't have."""

_PER_SECOND = MILLISECOND / SECOND
_NONE: Mapping[str, int] = {}

EndpointName = tuple[str, str]
"""A node and a topic, by the names that their module has for them."""


class PublisherCount(msgspec.Struct, eq=False):
    """What a node has published on a topic. `rate` is known from the second answer on, before that None.

    `changes` grows with each change of the other numbers, so one look says whether there was any.
    """

    sent: int = 0
    missed: int = 0
    late: int = 0
    rate: float | None = None
    publisher_class: str | None = None
    changes: int = 0

    def enter(self, sent: int, missed: int, late: int, rate: float | None) -> None:
        """Enter what its module says."""
        if sent != self.sent or rate != self.rate or missed != self.missed or late != self.late:
            self.sent, self.missed, self.late, self.rate = sent, missed, late, rate
            self.changes += 1


class SubscriberCount(msgspec.Struct, eq=False):
    """What waits for a node in its subscription of a topic, and what that has lost, by reason; `changes` as above."""

    waiting: int = 0
    lost: Mapping[str, int] = _NONE
    total: int = 0
    """The sum of `lost`."""
    changes: int = 0

    def enter(self, waiting: int, lost: int, undecodable: int, too_long: int, stale: int) -> None:
        """Enter what its module says."""
        if undecodable or too_long or stale:
            total = lost + undecodable + too_long + stale
            reasons: Mapping[str, int] = _reasons_of(lost, undecodable, too_long, stale)
        else:  # as it mostly is
            total = lost
            reasons = {"queue full": clamp(lost)} if lost else _NONE
        if waiting != self.waiting or total != self.total or reasons != self.lost:
            self.waiting, self.lost, self.total = waiting, reasons, total
            self.changes += 1


class ModuleCounters:
    """The counters of one module. `answers` says whether it answers; None before its first answer or time-out."""

    def __init__(self) -> None:
        self.answers: bool | None = None
        self.has_rates = False
        """Whether it has answered twice since it began, or since it was silent."""
        self.left_out = 0
        """Entries of the last answer for which there was no room."""
        self.entries = 0
        """Entries that are kept of the last answer."""
        self.uptime: float | None = None
        self.cpu: float | None = None
        """The share of a processor core."""
        self.publishers: dict[EndpointName, PublisherCount] = {}
        self.subscribers: dict[EndpointName, SubscriberCount] = {}
        """Counts, of publishers as well, are updated in place."""
        self.endpoint_revision = 0
        """A number that changes when there are other publishers or subscribers."""
        self.nodes: dict[str, tuple[bool, int]] = {}
        """Whether each node runs, and how often it was restarted."""
        self.services: dict[EndpointName, ServiceStatistics] = {}
        self.links: dict[str, LinkFigures] = {}
        self.lost: Mapping[str, int] = _NONE
        """Messages that links, gateways and subscribers of the module have lost, by topic; only those with losses."""
        self.laxity: Mapping[str, float] = {}
        """The least time to a deadline (s) by topic."""
        self._known: KnownAnswer | None = None
        self._in_order = _EntriesInOrder()
        self._aliases: dict[EndpointName, EndpointName] = {}
        self._rates: dict[tuple[str, ...], CounterRate] = {}
        self._time: float | None = None
        self._processor = math.nan

    def silence(self, _reason: str = "") -> None:
        """Note that the module does not answer: totals stay, rates are unknown."""
        self.answers = self.has_rates = False
        self.cpu = None
        self._rates.clear()
        self._time = None
        for each in self.publishers.values():
            each.enter(each.sent, each.missed, each.late, None)
        unknown = dict.fromkeys(("sent", "received", "bytes_sent", "bytes_received"))
        self.links = {key: msgspec.structs.replace(link, **unknown) for key, link in self.links.items()}

    def read(self, module: str, part: bytes, room: int) -> None:
        """Enter an answer as `update`, that of `statistics.first_part`. Raises DecodeError.

        It is cheap where only numbers differ from the last one.
        """
        numbers = None if self._known is None or self.entries > room else self._known.read(part)
        if numbers is not None and self._time is not None and self._time <= numbers.uptime < math.inf:
            self._update_numbers(module, numbers)
            return
        self._known = None
        statistics = layout(ModuleStatistics).decode(part)
        self.update(module, statistics, room)
        self._know(statistics, part)

    def update(self, module: str, statistics: ModuleStatistics, room: int) -> None:
        """Enter an answer, of which at most `room` entries are kept."""
        time = statistics.uptime
        self.has_rates = self._time is not None
        restarted = self._time is not None and time < self._time
        if restarted:
            self._rates.clear()
            self._time = 0.0
        self.answers = True
        self.uptime = time if 0.0 <= time < math.inf else None
        self._update_processor(time, statistics.cpu, restarted=restarted)
        limited = _Room(room)
        before, self._rates = self._rates, {}
        self._update_links(module, limited.take(statistics.links), before, time)
        self._update_nodes(statistics, limited)
        self._update_publishers(limited.take(statistics.publishers), before, time)
        self._update_subscribers(limited.take(statistics.subscribers))
        self._update_topics(statistics, limited)
        self.entries, self.left_out = limited.taken, limited.left_out
        self._time = time if self.uptime is not None else None

    # Look-ups by names that others have for the module's topics

    def publisher(self, module: str, node: str, topic: str) -> PublisherCount | None:
        """Return the count of a publisher, by the names that this network has for its module, node and topic."""
        for name in local_names(module, topic):
            found = self.publishers.get((node, name)) or self.publishers.get(self._by_alias(node, name))
            if found is not None:
                return found
        return None

    def subscriber(self, module: str, node: str, topic: str) -> SubscriberCount | None:
        """Return the count of a subscriber, by such names."""
        for name in local_names(module, topic):
            found = self.subscribers.get((node, name)) or self.subscribers.get(self._by_alias(node, name))
            if found is not None:
                return found
        return None

    def service(self, module: str, node: str, name: str) -> ServiceStatistics | None:
        """Return the count of a service, by such names."""
        found = (self.services.get((node, each)) for each in local_names(module, name))
        return next((each for each in found if each is not None), None)

    def _by_alias(self, node: str, topic: str) -> EndpointName:
        """Return the full names of an endpoint that is known by its aliases: RTCAN and debug lines carry these."""
        if not self._aliases:
            known = {*self.publishers, *self.subscribers}
            self._aliases = {(node_alias(each), topic_alias(name)): (each, name) for each, name in known}
        return self._aliases.get((node_alias(node), topic_alias(topic)), ("", ""))

    # An answer of which only numbers are new

    def _know(self, statistics: ModuleStatistics, part: bytes) -> None:
        """Note where the numbers of this answer are, unless entries were left out, or several have one name."""
        counted = len(self.publishers), len(self.subscribers)
        if self.left_out or counted != (len(statistics.publishers), len(statistics.subscribers)):
            return
        self._known = KnownAnswer(statistics, part)
        self._in_order = _EntriesInOrder(
            [*self.publishers.values()],
            [self._rates[key] for key in self.publishers],
            [*self.subscribers.values()],
            [each.topic for each in statistics.topics],
            [each.topic for each in statistics.forwarded],
        )

    def _update_numbers(self, module: str, numbers: AnswerNumbers) -> None:
        """Enter an answer with the same entries as the one before."""
        known, time = self._in_order, numbers.uptime
        self.answers = self.has_rates = True
        self.uptime = time
        self._update_processor(time, numbers.cpu, restarted=False)
        self._update_links(module, numbers.links, self._rates, time)
        self.services = {(each.node, each.service): each for each in numbers.services}
        sent, missed, late = numbers.publishers
        totals = _clamped(sent), _clamped(missed), _clamped(late)
        for count, rate, raw, of_sent, of_missed, of_late in zip(
            known.publishers, known.rates, sent, *totals, strict=True
        ):
            count.enter(of_sent, of_missed, of_late, rate.add(time, raw))
        if numbers.subscribers is not known.columns[0]:
            for each, waiting, lost, undecodable, too_long, stale, _ in zip(
                known.subscribers, *numbers.subscribers, strict=True
            ):
                each.enter(waiting, lost, undecodable, too_long, stale)
        columns = numbers.subscribers, numbers.topics, numbers.forwarded
        if not all(map(operator.is_, columns, known.columns)):
            known.columns = columns
            dropped = zip(known.forwarded, numbers.forwarded[1], strict=True)
            self._sum_up(zip(known.topics, *numbers.topics, strict=True), dropped)
        self._time = time

    # Parts of an answer

    def _update_processor(self, uptime: float, cpu: float, *, restarted: bool) -> None:
        before, self._processor = 0.0 if restarted else self._processor, cpu
        step = math.nan if self._time is None else uptime - self._time
        share = (cpu - before) / step if step > 0.0 else math.nan
        self.cpu = share if 0.0 <= share < math.inf else None

    def _rate(
        self, key: tuple[str, ...], time: float, count: int, before: dict[tuple[str, ...], CounterRate]
    ) -> float | None:
        rate = before.get(key)
        if rate is None:
            start = time if self._time is None else self._time  # an entry that is new since the last answer began at 0
            rate = CounterRate(start, count if self._time is None else 0)
        self._rates[key] = rate
        return rate.add(time, count)

    def _update_publishers(
        self, entries: Iterable[PublisherStatistics], before: dict[tuple[str, ...], CounterRate], time: float
    ) -> None:
        sums: dict[EndpointName, PublisherStatistics] = {}
        for each in entries:
            key = each.node, each.topic
            sums[key] = each if key not in sums else _sum(sums[key], each)
        counts = {key: self.publishers.get(key) or PublisherCount() for key in sums}
        for key, each in sums.items():
            count = counts[key]
            rate = self._rate(key, time, each.sent, before)
            count.enter(clamp(each.sent), clamp(each.missed), clamp(each.late), rate)
            count.publisher_class = _CLASS_NAMES.get(each.publisher_class)  # a later r2p may have others
        self._note_endpoints(self.publishers, counts)
        self.publishers = counts

    def _update_subscribers(self, entries: Iterable[SubscriberStatistics]) -> None:
        counts: dict[EndpointName, SubscriberCount] = {}
        for each in entries:
            key = each.node, each.topic
            count = counts[key] = self.subscribers.get(key) or SubscriberCount()
            count.enter(each.waiting, each.lost, each.undecodable, each.too_long, each.stale)
        self._note_endpoints(self.subscribers, counts)
        self.subscribers = counts

    def _note_endpoints(self, before: Mapping[EndpointName, object], now: Mapping[EndpointName, object]) -> None:
        if before.keys() != now.keys():
            self.endpoint_revision += 1
            self._aliases = {}

    def _update_nodes(self, statistics: ModuleStatistics, limited: "_Room") -> None:
        self.nodes = {printable(each.node): (each.running, each.restarts) for each in limited.take(statistics.nodes)}
        self.services = {(each.node, each.service): each for each in limited.take(statistics.services)}

    def _update_links(
        self,
        module: str,
        entries: Iterable[LinkStatistics],
        before: dict[tuple[str, ...], CounterRate],
        time: float,
    ) -> None:
        self.links = {}
        for each in entries:
            counts = each.sent, each.received, each.bytes_sent, each.bytes_received
            rates = [self._rate(("link", each.link, f"{i}"), time, count, before) for i, count in enumerate(counts)]
            row = LinkFigures(module, printable(each.link), each.up, each.ups, each.waiting)
            row.sent, row.received, row.bytes_sent, row.bytes_received = rates
            row.lost, row.faults = _reasons(each.lost), _reasons(each.faults)
            self.links[row.name] = row

    def _update_topics(self, statistics: ModuleStatistics, limited: "_Room") -> None:
        topics = ((each.topic, each.lost, each.least_laxity) for each in limited.take(statistics.topics))
        self._sum_up(topics, ((each.topic, each.dropped) for each in limited.take(statistics.forwarded)))

    def _sum_up(self, topics: Iterable[tuple[str, int, float]], dropped: Iterable[tuple[str, int]]) -> None:
        """Add up the losses of topics on links, in gateways and of subscribers, and find the least laxities."""
        lost: dict[str, int] = {}
        laxity: dict[str, float] = {}
        for topic, number, least in topics:
            if number:
                lost[topic] = lost.get(topic, 0) + number
            if math.isfinite(least):
                laxity[topic] = min(least * _PER_SECOND, laxity.get(topic, math.inf))
        for topic, number in dropped:
            if number:
                lost[topic] = lost.get(topic, 0) + number
        for (_, topic), count in self.subscribers.items():
            if count.total:
                lost[topic] = lost.get(topic, 0) + count.total
        self.lost, self.laxity = lost, laxity


class _EntriesInOrder(msgspec.Struct, eq=False):
    """What the entries of an answer are counted in, in their order, and the columns that were entered last."""

    publishers: list[PublisherCount] = []
    rates: list[CounterRate] = []
    """Those of publishers."""
    subscribers: list[SubscriberCount] = []
    topics: list[str] = []
    forwarded: list[str] = []
    columns: tuple[Columns, ...] = ((), (), ())
    """Those of subscribers, topics and forwarded topics."""


class _Room:
    """How many entries of an answer are kept."""

    def __init__(self, room: int) -> None:
        self.taken = self.left_out = 0
        self._room = room

    def take(self, entries: tuple[E, ...]) -> Iterator[E]:
        """Iterate over the entries for which there is room."""
        kept = min(len(entries), max(0, self._room - self.taken))
        self.taken += kept
        self.left_out += len(entries) - kept
        return islice(entries, kept)


_CLASS_NAMES = {int(number): name for number, name in CLASS_NAMES.items()}


def clamp(count: int) -> int:
    """Return a sum over modules, within what JSON can have."""
    return count if count <= COUNT_MAX else COUNT_MAX  # noqa: FURB136 - called for each counter: `min` takes longer


def _sum(one: PublisherStatistics, other: PublisherStatistics) -> PublisherStatistics:
    """Return the counts of two publishers of one node and topic together, of the class of the latter."""
    totals = one.sent + other.sent, one.missed + other.missed, one.late + other.late
    return PublisherStatistics(other.topic, other.node, other.publisher_class, *totals)


def _clamped(counts: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(map(clamp, counts)) if max(counts, default=0) > COUNT_MAX else counts


def _reasons_of(lost: int, undecodable: int, too_long: int, stale: int) -> dict[str, int]:
    """Return what a subscriber has lost, by reason."""
    counts = {"queue full": lost, "undecodable": undecodable, "too long": too_long, "stale": stale}
    return {reason: clamp(count) for reason, count in counts.items() if count}


def _reasons(counts: Iterable[ReasonCount]) -> dict[str, int]:
    return {printable(each.reason): clamp(each.count) for each in counts}


def local_names(module: str, topic: str) -> Iterator[str]:
    """Yield what a module itself may call a topic of this network: without the prefix that both have here."""
    namespace, slash, name = module.rpartition("/")
    if slash and topic.startswith(f"{namespace}/"):
        yield topic[len(namespace) + 1 :]
    yield topic
    if not slash and "_" in name:
        for position in (i + 1 for i, letter in enumerate(name) if letter == "_"):
            if topic.startswith(name[:position]):
                yield topic[position:]


def network_name(module: str, topic: str, known: Mapping[str, object]) -> str:
    """Return what this network calls a topic of a module; `known` has the topics of this network."""
    namespace, slash, name = module.rpartition("/")
    if slash:
        return f"{namespace}/{topic}"
    if topic in known:
        return topic
    prefixed = (name[: i + 1] + topic for i, letter in enumerate(name) if letter == "_")
    return next((each for each in prefixed if each in known), topic)
