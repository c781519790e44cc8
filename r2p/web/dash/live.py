"""A running network as the source of pages."""

import contextlib
from collections.abc import Awaitable, Callable
from contextlib import AsyncExitStack
from types import TracebackType
from typing import Any, Self

from r2p.errors import InvalidName, WebError
from r2p.messages import Message, layout
from r2p.messages.values import to_plain
from r2p.modules.module import Module
from r2p.monitoring import commands
from r2p.monitoring.fields import describe_fields
from r2p.monitoring.log import LogFollower
from r2p.monitoring.monitor import NetworkMonitor
from r2p.monitoring.snapshot import NetworkSnapshot
from r2p.monitoring.topic_types import TypeFinder
from r2p.ros.classes import standard_classes
from r2p.version import __version__
from r2p.web.client import WebClient
from r2p.web.dash import protocol
from r2p.web.dash.feeds import PlotStream, TopicFeeds
from r2p.web.dash.log_feed import LogFeed, PageLog
from r2p.web.dash.publications import Publications, call_service, service_types
from r2p.web.dash.source import DashSource, SourceSession, check_plot, check_watches

_ZERO_MAX = 1 << 16  # bytes of a type whose zero message is given

Answer = Callable[[Any], Awaitable[object]]


class LiveSource(DashSource):
    """The network of an open module, as its monitor sees it. An asynchronous context manager."""

    def __init__(
        self,
        module: Module,
        monitor: NetworkMonitor,
        types: TypeFinder,
        *,
        allow_publish: bool = False,
        allow_control: bool = False,
    ) -> None:
        super().__init__()
        self.module = module
        self.monitor = monitor
        self.types = types
        self.allow_publish = allow_publish
        self.allow_control = allow_control
        self.feeds = TopicFeeds(module, types, self.refused)
        self.log = LogFeed(lambda: LogFollower(module))

    async def __aenter__(self) -> Self:
        self._stack = AsyncExitStack()
        self._stack.callback(self.types.close)
        self._stack.callback(self.feeds.close)
        self._stack.push_async_callback(self.log.close)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self._stack.aclose()

    def hello(self) -> dict[str, Any]:
        return {
            "op": "hello",
            "version": __version__,
            "title": self.monitor.snapshot.network,
            "recording": False,
            "publish": self.allow_publish,
            "control": self.allow_control,
        }

    def session(self, client: WebClient) -> SourceSession:
        return LiveSession(self, client)


class LiveSession(SourceSession):
    """One page that shows a running network, and what it has asked for."""

    def __init__(self, source: LiveSource, client: WebClient) -> None:
        self._source = source
        self._client = client
        self._first = True
        self._streams: dict[int, tuple[str, PlotStream]] = {}
        self._watched: set[str] = set()
        self._measured: set[str] = set()
        self._log: PageLog | None = None
        self._publications = Publications(source.feeds, client)
        self._answers: dict[type, Answer] = {
            protocol.Plot: self._plot,
            protocol.StopPlot: self._stop_plot,
            protocol.Watch: self._watch,
            protocol.Unwatch: self._unwatch,
            protocol.FollowLog: self._follow_log,
            protocol.Describe: self._describe,
            protocol.ListParameters: self._list_parameters,
        }
        self._publishing: dict[type, Answer] = {
            protocol.Publish: self._publications.publish,
            protocol.StopPublishing: self._publications.stop,
            protocol.CallService: self._call,
        }
        self._controlling: dict[type, Answer] = {
            protocol.SetParameters: self._set_parameters,
            protocol.SaveParameters: self._save_parameters,
            protocol.OrderNode: self._order_node,
            protocol.OrderModule: self._order_module,
        }

    async def snapshots(self) -> NetworkSnapshot:
        if self._first:
            self._first = False
            return self._source.monitor.snapshot
        return await self._source.monitor.changed()

    async def answer(self, request: protocol.DashRequest) -> object:
        kind = type(request)
        if kind in self._publishing:
            self._check_allowed(request, "--allow-publish", allowed=self._source.allow_publish)
            return await self._publishing[kind](request)
        if kind in self._controlling:
            self._check_allowed(request, "--allow-control", allowed=self._source.allow_control)
            return await self._controlling[kind](request)
        if kind not in self._answers:
            raise self.refuse(request, "only a recording has a time line: r2p dash FILE.mcap")
        return await self._answers[kind](request)

    async def close(self) -> None:
        for topic, stream in self._streams.values():
            self._source.feeds.stop_plot(topic, stream)
        for topic in self._watched:
            self._end_watch(topic)
        self._streams.clear()
        self._watched.clear()
        if self._log is not None:
            await self._source.log.remove(self._log)
        await self._publications.close()

    def _check_allowed(self, request: protocol.DashRequest, option: str, *, allowed: bool) -> None:
        if not allowed:
            self._source.refused[option] += 1
            raise self.refuse(request, f"not allowed: start r2p dash with {option}")

    # Plots and watches

    async def _plot(self, request: protocol.Plot) -> None:
        check_plot(request, self._streams)
        topic, paths = _topic_and_paths(request.fields)
        self._remove_stream(request.stream)
        stream = PlotStream(self._client, request.stream, paths)
        self._streams[request.stream] = topic, stream
        try:
            await self._source.feeds.plot(topic, stream)
        except BaseException:
            if self._streams.get(request.stream) == (topic, stream):
                del self._streams[request.stream]
            raise

    async def _stop_plot(self, request: protocol.StopPlot) -> None:
        self._remove_stream(request.stream)

    def _remove_stream(self, number: int) -> None:
        topic, stream = self._streams.pop(number, ("", None))
        if stream is not None:
            self._source.feeds.stop_plot(topic, stream)

    async def _watch(self, request: protocol.Watch) -> None:
        if request.topic in self._watched:
            return
        check_watches(self._watched)
        self._source.feeds.watch(request.topic, self._client)
        self._watched.add(request.topic)
        with contextlib.suppress(InvalidName):  # of r2p's own topics there is nothing to measure
            self._source.monitor.measure(request.topic)
            self._measured.add(request.topic)

    async def _unwatch(self, request: protocol.Unwatch) -> None:
        if request.topic in self._watched:
            self._watched.remove(request.topic)
            self._end_watch(request.topic)

    def _end_watch(self, topic: str) -> None:
        self._source.feeds.unwatch(topic, self._client)
        if topic in self._measured:
            self._measured.remove(topic)
            self._source.monitor.stop_measuring(topic)

    async def _follow_log(self, request: protocol.FollowLog) -> None:
        if self._log is None:
            self._log = PageLog(self._client)
        await self._source.log.add(self._log, request.level)

    # Types

    async def _describe(self, request: protocol.Describe) -> object:
        if request.service:
            found = await service_types(self._source.feeds, request.service)
            return {name: describe(cls) for name, cls in zip(("request", "response"), found, strict=True)}
        if not request.topic and not request.type:
            return {"types": sorted(standard_classes())}
        return describe(await self._source.feeds.find_type(request.topic, request.type))

    async def _call(self, request: protocol.CallService) -> object:
        return await call_service(self._source.feeds, request)

    # Parameters and orders

    async def _list_parameters(self, request: protocol.ListParameters) -> object:
        return await self._source.module.network.parameters(request.module)

    async def _set_parameters(self, request: protocol.SetParameters) -> None:
        values = {(request.node, name): _value(value) for name, value in request.values.items()}
        await self._source.module.network.set_parameters(request.module, values)

    async def _save_parameters(self, request: protocol.SaveParameters) -> object:
        return await self._source.module.network.save_parameters(request.module)

    async def _order_node(self, request: protocol.OrderNode) -> None:
        await commands.order_node(self._source.module, request.module, request.node, request.order)

    async def _order_module(self, request: protocol.OrderModule) -> None:
        await commands.order_module(self._source.module, request.module, request.order)


def describe(cls: type[Message]) -> dict[str, Any]:
    """Return what `Describe` answers for one type; of a very large one without `zero`."""
    shape = layout(cls)
    described: dict[str, Any] = {"type": shape.name, "fields": describe_fields(cls)}
    if shape.size_min <= _ZERO_MAX:
        described["zero"] = to_plain(shape.zero)
    return described


def _topic_and_paths(fields: list[str]) -> tuple[str, list[str]]:
    """Return the topic of fields, and their paths in its messages. Raises WebError."""
    pairs = [field.partition(".") for field in fields]
    topics = sorted({topic for topic, _, _ in pairs})
    if len(topics) > 1:
        raise WebError(f"the fields of one stream are those of one topic, not of {', '.join(topics)[:200]}")
    for topic, _, path in pairs:
        if not path:
            raise WebError(f"{topic[:100]!r} names no field: write TOPIC.FIELD, such as odometry.x")
    return topics[0], [path for _, _, path in pairs]


def _value(value: Any) -> object:
    """Return the value of a parameter from JSON, which has lists for tuples."""
    return tuple(value) if isinstance(value, list) else value
