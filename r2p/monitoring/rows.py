"""The rows of a snapshot: what is announced of topics, modules and services, with what is counted and measured.

A row that is equal to the one before is the same object, so who shows it sees at once what has changed.
"""

import contextlib
from collections.abc import Iterable, Mapping
from typing import Any, TypeVar

import msgspec

from r2p.codecs import rtcan
from r2p.codecs.services import REQUESTS, RESPONSES
from r2p.errors import MessageError
from r2p.messages import layout
from r2p.modules.graph import Endpoint, ModuleView, TopicView
from r2p.monitoring.buses import BusTables
from r2p.monitoring.counters import ModuleCounters, clamp, network_name
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
        self.lost, self.laxity = {}, {}
        for module, counters in self.counters.items():
            for topic, count in counters.lost.items():
                name = network_name(module, topic, topics)
                self.lost[name] = clamp(self.lost.get(name, 0) + count)
            for topic, laxity in counters.laxity.items():
                name = network_name(module, topic, topics)
                self.laxity[name] = min(laxity, self.laxity.get(name, laxity))


class TopicRows:
    """Makes the rows of topics, one by one."""

    def __init__(self, sources: FigureSources) -> None:
        self._sources = sources
        self._names: dict[bytes, str | None] = {}

    def row(self, view: TopicView, *, is_of_service: bool) -> TopicFigures:
        """Return the figures of a topic."""
        publishers, counted = self._publishers(view)
        subscribers, some_known = self._subscribers(view)
        figures = TopicFigures(
            view.name,
            type=self.type_name(view),
            size=view.size or None,
            varies=view.varies,
            mismatch=view.mismatch,
            age=None if view.age is None else view.age // _AGE_STEP * _AGE_STEP,
            publishers=publishers,
            subscribers=subscribers,
            laxity=self._sources.laxity.get(view.name),
            is_of_service=is_of_service,
        )
        known = [each for each in counted.values() if each is not None and each.sent is not None]
        if known:
            figures.missed = clamp(sum(each.missed or 0 for each in known))
            figures.late = clamp(sum(each.late or 0 for each in known))
        if known or some_known:
            figures.lost_on_way = self._sources.lost.get(view.name, 0)
        measured = self._sources.measured.get(view.name)
        if measured is not None:
            _enter_measured(figures, measured)
        self._enter_rate(figures, view, counted, measured)
        return figures

    def type_name(self, view: TopicView) -> str | None:
        """Return what the type of a topic is called; ROS nodes that have the topic decide."""
        if view.ros_type:
            return view.ros_type
        if view.layout is not None:
            return view.layout.name
        if view.fingerprint is None:
            return None
        name = self._names.get(view.fingerprint)
        if name is None:
            cls = self._sources.types.by_fingerprint(view.fingerprint)
            if cls is not None:
                name = self._names[view.fingerprint] = layout(cls).name
        return name

    def _publishers(
        self, view: TopicView
    ) -> tuple[list[PublisherFigures], dict[tuple[str, str], PublisherFigures | None]]:
        """Return the rows of publishers, and those to count: one of each node, however many links it is seen on."""
        rows: list[PublisherFigures] = []
        counted: dict[tuple[str, str], PublisherFigures | None] = {}
        for each in view.publishers:
            row = self._publisher(view.name, each)
            rows.append(row)
            counted[each.module, each.node] = row
        seen = {each.link for each in view.publishers}
        for link in view.published_on:
            if link not in seen:  # firmware, which does not say which node it is
                counted["", link] = None
        return rows, counted

    def _publisher(self, topic: str, endpoint: Endpoint) -> PublisherFigures:
        klass = endpoint.publisher_class
        row = PublisherFigures(
            endpoint.module, endpoint.node, endpoint.link, None if klass is None else CLASS_NAMES[klass]
        )
        counters = self._sources.counters.get(endpoint.module)
        count = None if counters is None else counters.publisher(endpoint.module, endpoint.node, topic)
        if count is not None:
            row.rate, row.sent, row.missed, row.late = count.rate, count.sent, count.missed, count.late
        return row

    def _subscribers(self, view: TopicView) -> tuple[list[SubscriberFigures], bool]:
        """Return the rows of subscribers, and whether the counters of any are known."""
        rows, known = [], False
        for each in view.subscribers:
            row = SubscriberFigures(each.module, each.node, each.link)
            counters = self._sources.counters.get(each.module)
            count = None if counters is None else counters.subscriber(each.module, each.node, view.name)
            if count is not None:
                row.waiting, row.lost, known = count.waiting, count.lost, True
            rows.append(row)
        return rows, known

    def _enter_rate(
        self,
        figures: TopicFigures,
        view: TopicView,
        counted: Mapping[tuple[str, str], PublisherFigures | None],
        measured: MeasuredTopic | None,
    ) -> None:
        """Enter the rate, by the best of its sources, and the bandwidth."""
        rates = [None if each is None else each.rate for each in counted.values()]
        known = [rate for rate in rates if rate is not None]
        if rates and len(known) == len(rates):
            figures.rate, figures.rate_source = sum(known), "counters"
        elif (rate := self._rate_on_bus(view)) is not None:
            figures.rate, figures.rate_source = rate, "bus"
        elif measured is not None and measured.rate is not None:
            figures.rate, figures.rate_source = measured.rate, "measured"
        if view.size and not view.varies and figures.rate is not None:
            figures.bandwidth = figures.rate * view.size
        elif measured is not None:
            figures.bandwidth = measured.bandwidth

    def _rate_on_bus(self, view: TopicView) -> float | None:
        frames = self._sources.buses.frames.get(view.name)
        if frames is None or view.varies:
            return None
        with contextlib.suppress(MessageError):  # of unknown size, or too long for a bus
            return frames / rtcan.fragment_count(view.size)
        return None


def _enter_measured(figures: TopicFigures, measured: MeasuredTopic) -> None:
    figures.measured = True
    figures.latency = measured.latency
    figures.lost_here = clamp(measured.lost_here)
    gaps = measured.lost_on_way
    if gaps is not None:
        figures.lost_on_way = max(gaps, figures.lost_on_way or 0)


def module_rows(
    views: Iterable[ModuleView], topics: Mapping[str, TopicView], sources: FigureSources
) -> list[ModuleFigures]:
    """Return the figures of modules, each once, with their nodes."""
    best: dict[str, ModuleView] = {}
    for view in views:
        known = best.get(view.name)
        if known is None or _rank(view) < _rank(known):  # it may be seen on several links, and as a ROS node
            best[view.name] = view
    nodes = _nodes_by_module(topics.values())
    return [_module(view, sources.counters.get(name), nodes.get(name, {})) for name, view in best.items()]


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


def _module(view: ModuleView, counters: ModuleCounters | None, nodes: dict[str, NodeFigures]) -> ModuleFigures:
    row = ModuleFigures(view.name, view.state, view.kind, view.age, view.link, view.release, rebooted=view.rebooted)
    if counters is not None:
        row.answers, row.uptime, row.cpu = counters.answers, counters.uptime, counters.cpu
        for name, (running, restarts) in counters.nodes.items():
            node = nodes.setdefault(name, NodeFigures(name))
            node.running, node.restarts = running, restarts
    row.nodes = [nodes[name] for name in sorted(nodes)]
    return row


def link_rows(counters: Mapping[str, ModuleCounters]) -> list[LinkFigures]:
    """Return the figures of the links of all modules that have answered."""
    return [link for _, each in sorted(counters.items()) for link in each.links.values()]


def service_rows(topics: Mapping[str, TopicView], sources: FigureSources, types: TopicRows) -> list[ServiceFigures]:
    """Return the figures of services: pairs of topics."""
    rows = []
    for name, responses in topics.items():
        base = name.removesuffix(RESPONSES)
        requests = topics.get(f"{base}{REQUESTS}")
        if base != name and requests is not None:
            rows.append(_service(base, requests, responses, sources, types))
    return rows


def _service(
    name: str, requests: TopicView, responses: TopicView, sources: FigureSources, types: TopicRows
) -> ServiceFigures:
    servers = dict.fromkeys((each.module, each.node) for each in responses.publishers)
    row = ServiceFigures(
        name,
        type=_service_type(types.type_name(requests), types.type_name(responses)),
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
