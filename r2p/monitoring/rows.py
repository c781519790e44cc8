"""The rows of a snapshot: what is announced of topics, modules and services, with what is counted and measured.

A row that is equal to the one before is the same object, so a display sees at once what has changed.
"""

import contextlib
from collections.abc import Iterable, Mapping
from collections.abc import Set as AbstractSet
from typing import Any, Self, TypeVar

import msgspec

from r2p.codecs import rtcan
from r2p.codecs.services import REQUESTS, RESPONSES
from r2p.errors import MessageError
from r2p.messages import layout
from r2p.modules.graph import Endpoint, ModuleView, TopicView
from r2p.monitoring.buses import BusTables
from r2p.monitoring.counters import ModuleCounters, PublisherCount, SubscriberCount, clamp, network_name
from r2p.monitoring.measuring import MeasuredTopic
from r2p.monitoring.snapshot import (
    CLASS_NAMES,
    Figures,
    LinkFigures,
    ModuleFigures,
    NodeFigures,
    PublisherFigures,
    ServiceFigures,
    SubscriberFigures,
    TopicFigures,
)
from r2p.monitoring.topic_types import TypeFinder

F = TypeVar("F", bound=Figures)

_AGE_STEP = 10  # s


class KnownTopics(msgspec.Struct, frozen=True, eq=False):
    """The topics of a snapshot, and what follows from their names and endpoints: found out once for many snapshots."""

    views: Mapping[str, TopicView]
    left_out: int
    services: Mapping[str, tuple[TopicView, TopicView]]
    """The topics of requests and of responses, by the name of their service."""
    of_services: AbstractSet[str]
    """The names of these topics."""
    nodes: Mapping[str, Mapping[str, NodeFigures]]
    """The nodes by module and name, and their topics."""
    to_learn: Mapping[bytes, str]
    """A topic of each type whose name is known by its fingerprint only."""

    @classmethod
    def of(cls, views: Mapping[str, TopicView], left_out: int = 0) -> Self:
        """Return these topics."""
        bases = (name.removesuffix(RESPONSES) for name in views if name.endswith(RESPONSES))
        services = {
            base: (views[f"{base}{REQUESTS}"], views[f"{base}{RESPONSES}"])
            for base in bases
            if f"{base}{REQUESTS}" in views
        }
        of_services = {view.name for pair in services.values() for view in pair}
        to_learn = {
            view.fingerprint: view.name
            for view in views.values()
            if view.fingerprint is not None and not (view.ros_type or view.layout)
        }
        return cls(views, left_out, services, of_services, _nodes_by_module(views.values()), to_learn)


class FigureSources(msgspec.Struct, eq=False):
    """Where figures come from: counters by module, buses, measured topics, and types.

    `lost` and `laxity` are those of all modules by topic, as `sum_up` has found them.
    """

    buses: BusTables
    types: TypeFinder
    counters: dict[str, ModuleCounters] = {}
    measured: dict[str, MeasuredTopic] = {}
    lost: dict[str, int] = {}
    laxity: dict[str, float] = {}

    def sum_up(self, topics: Mapping[str, TopicView]) -> None:
        """Add up the losses of all modules, and find the least laxities, by the names of topics on this network."""
        lost: dict[str, int] = {}
        laxities: dict[str, float] = {}
        self.lost, self.laxity = lost, laxities
        for module, counters in self.counters.items():
            is_prefixed = "/" in module
            for topic, count in counters.lost.items():
                name = network_name(module, topic, topics) if is_prefixed or topic not in topics else topic
                lost[name] = clamp(lost.get(name, 0) + count)
            for topic, laxity in counters.laxity.items():
                name = network_name(module, topic, topics) if is_prefixed or topic not in topics else topic
                laxities[name] = min(laxity, laxities.get(name, laxity))

    def endpoint_revisions(self) -> list[tuple[ModuleCounters, int]]:
        """Return what is equal for as long as the modules have counts of the same publishers and subscribers."""
        return [(each, each.endpoint_revision) for each in self.counters.values()]


class TypeNames:
    """What the types of topics are called."""

    def __init__(self, types: TypeFinder) -> None:
        self._types = types
        self._names: dict[bytes, str] = {}

    def name(self, view: TopicView) -> str | None:
        """Return what the type of a topic is called; ROS nodes that have the topic decide."""
        if view.ros_type:
            return view.ros_type
        if view.layout is not None:
            return view.layout.name
        if view.fingerprint is None:
            return None
        name = self._names.get(view.fingerprint)
        if name is None:
            cls = self._types.by_fingerprint(view.fingerprint)
            if cls is not None:
                name = self._names[view.fingerprint] = layout(cls).name
        return name


class TopicRow:
    """Makes the row of one topic, again and again: where its counts are is found out only once.

    While none of the facts that it is made of has changed, nothing is made.
    """

    __slots__ = (
        "_all_counted",
        "_any_counted",
        "_counted",
        "_facts",
        "_is_of_service",
        "_publisher_figures",
        "_publishers",
        "_sources",
        "_subscriber_counts",
        "_subscriber_figures",
        "_subscribers",
        "_type_name",
        "_types",
        "_view",
        "row",
    )

    def __init__(
        self,
        view: TopicView,
        sources: FigureSources,
        types: "TypeNames",
        row: TopicFigures | None,
        *,
        is_of_service: bool,
    ) -> None:
        """`row` is the last one that was made of the topic, if any was."""
        self.row = row
        self._view = view
        self._sources = sources
        self._types = types
        self._type_name: str | None = None
        self._is_of_service = is_of_service
        self._facts: tuple[Any, ...] = (None, None)
        self._publishers = [(each, _class_name(each), self._publisher_count(each)) for each in view.publishers]
        self._subscribers = [(each, self._subscriber_count(each)) for each in view.subscribers]
        self._subscriber_counts = [count for _, count in self._subscribers if count is not None]
        # Tuples, of which the garbage collector soon finds that there is nothing to collect: lists it looks at again.
        self._publisher_figures: tuple[PublisherFigures, ...] = ()
        self._subscriber_figures: tuple[SubscriberFigures, ...] = ()
        # One of each node, however many links it is seen on; and firmware, which does not say which node it is.
        counts = {(each.module, each.node): count for each, _, count in self._publishers}
        self._counted = [count for count in counts.values() if count is not None]
        is_anonymous = not {each.link for each in view.publishers}.issuperset(view.published_on)
        self._all_counted = len(self._counted) == len(counts) > 0 and not is_anonymous
        self._any_counted = bool(self._counted or self._subscriber_counts)

    def _publisher_count(self, endpoint: Endpoint) -> PublisherCount | None:
        counters = self._sources.counters.get(endpoint.module)
        return None if counters is None else counters.publisher(endpoint.module, endpoint.node, self._view.name)

    def _subscriber_count(self, endpoint: Endpoint) -> SubscriberCount | None:
        counters = self._sources.counters.get(endpoint.module)
        return None if counters is None else counters.subscriber(endpoint.module, endpoint.node, self._view.name)

    def update(self) -> TopicFigures:
        """Return the figures of now; if they are equal to the last ones, these."""
        sources, name, age = self._sources, self._view.name, self._view.age
        if self._type_name is None:
            self._type_name = self._types.name(self._view)
        published = subscribed = 0
        for publisher in self._counted:
            published += publisher.changes
        for subscriber in self._subscriber_counts:
            subscribed += subscriber.changes
        measured = sources.measured.get(name)
        facts = (
            published,
            subscribed,
            self._type_name,
            None if age is None else age // _AGE_STEP * _AGE_STEP,
            sources.lost.get(name, 0),
            sources.laxity.get(name),
            sources.buses.frames.get(name),
            measured is None,
        )
        if self.row is None or measured is not None or facts != self._facts:
            if facts[0] != self._facts[0]:
                self._publisher_figures = tuple([_publisher(*each) for each in self._publishers])
            if facts[1] != self._facts[1]:
                self._subscriber_figures = tuple([_subscriber(*each) for each in self._subscribers])
            self._facts = facts
            row = self._make(measured, *facts[2:6])
            if self.row != row:
                self.row = row
        return self.row

    def _make(
        self, measured: MeasuredTopic | None, type_name: str | None, age: float | None, lost: int, laxity: float | None
    ) -> TopicFigures:
        view, counted = self._view, self._counted
        missed: int | None = None
        late: int | None = None
        if len(counted) == 1:  # as almost all topics have
            missed, late = counted[0].missed, counted[0].late
        elif counted:
            missed = clamp(sum([each.missed for each in counted]))
            late = clamp(sum([each.late for each in counted]))
        rate, source = self._rate(measured)
        figures = TopicFigures(
            view.name,
            type_name,
            view.size or None,
            view.varies,
            view.mismatch,
            age,
            self._publisher_figures,
            self._subscriber_figures,
            rate,
            source,
            rate * view.size if rate is not None and view.size and not view.varies else None,
            laxity,
            missed=missed,
            late=late,
            lost_on_way=lost if self._any_counted else None,
            is_of_service=self._is_of_service,
        )
        if measured is not None:
            _enter_measured(figures, measured)
        return figures

    def _rate(self, measured: MeasuredTopic | None) -> tuple[float | None, str | None]:
        """Return the rate, by the best of its sources, and which one that is."""
        rate = self._counted_rate()
        if rate is not None:
            return rate, "counters"
        rate = self._rate_on_bus()
        if rate is not None:
            return rate, "bus"
        if measured is not None and measured.rate is not None:
            return measured.rate, "measured"
        return None, None

    def _counted_rate(self) -> float | None:
        """Return the rates of all publishers together; None where one of them is unknown."""
        if not self._all_counted:
            return None
        if len(self._counted) == 1:
            return self._counted[0].rate
        rates = [each.rate for each in self._counted if each.rate is not None]
        return sum(rates) if len(rates) == len(self._counted) else None

    def _rate_on_bus(self) -> float | None:
        frames = self._sources.buses.frames.get(self._view.name)
        if frames is None or self._view.varies:
            return None
        with contextlib.suppress(MessageError):  # of unknown size, or too long for a bus
            return frames / rtcan.fragment_count(self._view.size)
        return None


def _class_name(endpoint: Endpoint) -> str | None:
    return None if endpoint.publisher_class is None else CLASS_NAMES[endpoint.publisher_class]


def _publisher(each: Endpoint, publisher_class: str | None, count: PublisherCount | None) -> PublisherFigures:
    if count is None:
        return PublisherFigures(each.module, each.node, each.link, publisher_class)
    return PublisherFigures(
        each.module, each.node, each.link, publisher_class, count.rate, count.sent, count.missed, count.late
    )


def _subscriber(each: Endpoint, count: SubscriberCount | None) -> SubscriberFigures:
    if count is None:
        return SubscriberFigures(each.module, each.node, each.link)
    return SubscriberFigures(each.module, each.node, each.link, count.waiting, count.lost)


def _enter_measured(figures: TopicFigures, measured: MeasuredTopic) -> None:
    figures.measured = True
    if figures.bandwidth is None:
        figures.bandwidth = measured.bandwidth
    figures.latency = measured.latency
    figures.lost_here = clamp(measured.lost_here)
    gaps = measured.lost_on_way
    if gaps is not None:
        figures.lost_on_way = max(gaps, figures.lost_on_way or 0)


def module_rows(views: Iterable[ModuleView], topics: KnownTopics, sources: FigureSources) -> list[ModuleFigures]:
    """Return the figures of modules, each once, with their nodes."""
    best: dict[str, ModuleView] = {}
    for view in views:
        known = best.get(view.name)
        if known is None or _rank(view) < _rank(known):  # it may be seen on several links, and as a ROS node
            best[view.name] = view
    return [_module(view, sources.counters.get(name), topics.nodes.get(name, {})) for name, view in best.items()]


def _rank(view: ModuleView) -> tuple[bool, bool, float]:
    return bool(view.link), view.kind == "ROS", view.age


def _nodes_by_module(topics: Iterable[TopicView]) -> dict[str, dict[str, NodeFigures]]:
    modules: dict[str, dict[str, NodeFigures]] = {}
    for view in topics:
        for endpoints, field in ((view.publishers, "publishes"), (view.subscribers, "subscribes")):
            for each in endpoints:
                nodes = modules.setdefault(each.module, {})
                node = nodes.get(each.node)
                if node is None:
                    node = nodes[each.node] = NodeFigures(each.node)
                names: list[str] = getattr(node, field)
                if not names or names[-1] != view.name:  # topics come in order, a node perhaps by several links
                    names.append(view.name)
    return modules


def _module(view: ModuleView, counters: ModuleCounters | None, known: Mapping[str, NodeFigures]) -> ModuleFigures:
    row = ModuleFigures(view.name, view.state, view.kind, view.age, view.link, view.release, rebooted=view.rebooted)
    nodes = dict(known)
    if counters is not None:
        row.answers, row.uptime, row.cpu = counters.answers, counters.uptime, counters.cpu
        for name, (running, restarts) in counters.nodes.items():
            node = nodes.get(name) or NodeFigures(name)
            nodes[name] = NodeFigures(name, running, restarts, node.publishes, node.subscribes)
    row.nodes = [nodes[name] for name in sorted(nodes)]
    return row


def link_rows(counters: Mapping[str, ModuleCounters]) -> list[LinkFigures]:
    """Return the figures of the links of all modules that have answered."""
    return [link for _, each in sorted(counters.items()) for link in each.links.values()]


def service_rows(topics: KnownTopics, sources: FigureSources, types: TypeNames) -> list[ServiceFigures]:
    """Return the figures of services: pairs of topics."""
    return [_service(name, *pair, sources, types) for name, pair in topics.services.items()]


def _service(
    name: str, requests: TopicView, responses: TopicView, sources: FigureSources, types: TypeNames
) -> ServiceFigures:
    servers = dict.fromkeys((each.module, each.node) for each in responses.publishers)
    row = ServiceFigures(
        name,
        type=_service_type(types.name(requests), types.name(responses)),
        servers=[f"{module or '?'}/{node}" for module, node in servers],
    )
    counters = ((module, node, sources.counters.get(module)) for module, node in servers)
    counts = [each.service(module, node, name) for module, node, each in counters if each is not None]
    known = [each for each in counts if each is not None]
    if known:
        row.running, row.waiting = sum(each.running for each in known), sum(each.waiting for each in known)
        row.handled, row.failed, row.refused = (
            clamp(sum(getattr(each, field) for each in known)) for field in ("handled", "failed", "refused")
        )
    return row


def _service_type(requests: str | None, responses: str | None) -> str | None:
    """Return the name of a service's type, or the names of request and response if these are not of one class."""
    if requests is None or responses is None:
        return None
    request, response = requests.removesuffix(REQUESTS), responses.removesuffix(RESPONSES)
    one = request.removesuffix("_Request")
    return one if one != request and f"{one}_Response" == response else f"{request}, {response}"


def keep_equal(before: Iterable[F], rows: Iterable[F]) -> list[F]:
    """Return the rows; instead of each that has not changed, the one of before."""
    known = {_key(row): row for row in before}
    return [row if (last := known.get(_key(row))) is None or last != row else last for row in rows]


def _key(row: Any) -> str:
    """Return what identifies a row; of links the module is a part of it."""
    return f"{row.module} {row.name}" if isinstance(row, LinkFigures) else str(row.name)
