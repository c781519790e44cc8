"""The network as a module knows it: topics, nodes and modules, its own and those that its links have discovered.

r2p modules announce all of it at once. Firmware announces its name and its topics, one of them each half second, and
not the nodes that they belong to. The `age` of a view says how old the knowledge is.
"""

import asyncio
import contextlib
import functools
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Iterator, Mapping
from typing import Any, TypeVar

import msgspec

from r2p.clock import check_seconds
from r2p.codecs.management import FLAG_BOOT, FLAG_LOADER, FLAG_REBOOTED, FLAG_STOPPED, ROLE_PUBLISHES, WIRE_VERSION
from r2p.codecs.own_services import WIRE_MIN, Operation
from r2p.errors import DecodeError, Error, ParameterError, ServiceError
from r2p.messages import Layout, Message
from r2p.modules import parameter_services
from r2p.modules.link_manager import LinkManager
from r2p.modules.own_services import unknown_operation
from r2p.modules.remote_nodes import RemoteNodes
from r2p.modules.statistics import COMPRESSED, ModuleStatistics, decode
from r2p.modules.type_lookup import find_type
from r2p.parameters.definition import ParameterInfo
from r2p.protocols.discovery.directory import EndpointInfo
from r2p.protocols.discovery.events import ModuleInfo
from r2p.runtime.sample import PublisherClass
from r2p.runtime.topic import Topic, TopicSpace
from r2p.transports.link import Link
from r2p.units import SECOND
from r2p.version import __version__

T = TypeVar("T")

_CLASSES = tuple(PublisherClass(number or 1) for number in range(4))


class Endpoint(msgspec.Struct, frozen=True, order=True):
    """A publisher (`publisher_class` is set) or a subscriber of a node. `link` is empty for one of this module."""

    module: str
    node: str
    publisher_class: PublisherClass | None = None
    link: str = ""


class TopicView(msgspec.Struct):
    """A topic, as far as this module knows it.

    `size` is in bytes (0: unknown); that of the longest message, if their length `varies`. `fingerprint` is that of its
    layout (None: unknown). `layout` is set only where this module uses the topic. `ros_type` is what ROS nodes call the
    type, `package/Name`; empty: no ROS node has the topic.

    `publishers` and `subscribers` list endpoints whose node is known; `published_on` and `subscribed_on` name all links
    ("": this module) on which it is published and subscribed. `age` is in seconds since it was last announced.
    """

    name: str
    size: int = 0
    fingerprint: bytes | None = None
    layout: Layout[Any] | None = None
    publishers: list[Endpoint] = msgspec.field(default_factory=list)
    subscribers: list[Endpoint] = msgspec.field(default_factory=list)
    published_on: list[str] = msgspec.field(default_factory=list)
    subscribed_on: list[str] = msgspec.field(default_factory=list)
    age: float | None = None
    mismatch: bool = False
    varies: bool = False
    ros_type: str = ""


class ModuleView(msgspec.Struct):
    """A module. `state` is "running", "stopped", "boot" or "observer"; `age` is in s since its last message.

    `link` is empty for this module, `instance` is None for firmware. `wire` is the version of the wire formats that the
    module uses, `release` its version of r2p: None where it does not announce them, as firmware. `has_loader`: whether
    it has a boot loader, as firmware and emulated boards do. `kind` is "r2p", "firmware", or "ROS" for a ROS node.
    """

    name: str
    state: str
    rebooted: bool
    age: float
    link: str
    instance: int | None
    wire: int | None = None
    release: str | None = None
    has_loader: bool = False
    kind: str = "r2p"


class NetworkView:
    """The network as one module knows it, looked up anew by each call. Raises Closed before the module is open."""

    def __init__(self, opened: Callable[[], LinkManager]) -> None:
        """`opened` returns the link manager of the module, or raises Closed."""
        self._opened = opened

    def modules(self) -> list[ModuleView]:
        """List the modules, this one first, then by name; observers included."""
        module = self._opened()
        now = module.space.clock.monotonic()
        own = self._own_view(module)
        for link in module.links:
            link.discovery.refresh_ages(now)
        others = [_module_view(link, info, now) for link in module.links for info in link.discovery.modules.values()]
        return [own, *sorted(others, key=lambda view: (view.name, view.link))]

    def _own_view(self, module: LinkManager) -> ModuleView:
        state = _state(module.flags, observer=module.observer)
        rebooted = bool(module.flags & FLAG_REBOOTED)
        own = ModuleView(module.space.module, state, rebooted, 0.0, "", module.instance, WIRE_VERSION, __version__)
        own.has_loader = bool(module.flags & FLAG_LOADER)
        return own

    def topics(self) -> dict[str, TopicView]:
        """Return the topics by name, in order."""
        module = self._opened()
        views: dict[str, TopicView] = {}
        for topic in module.space.topics.values():
            if not topic.unused:
                _add_own(views.setdefault(topic.name, TopicView(topic.name)), topic, module.space.module)
        for link in module.links:
            _add_discovered(views, link)
        _set_ages(views, module.space)
        return dict(sorted(views.items()))

    def nodes(self) -> dict[tuple[str, str], tuple[list[str], list[str]]]:
        """Return the topics that each (module, node) publishes, and those that it subscribes to; in order."""
        table: dict[tuple[str, str], tuple[list[str], list[str]]] = {}
        for view in self.topics().values():
            for index, endpoints in enumerate((view.publishers, view.subscribers)):
                for endpoint in endpoints:
                    entry = table.setdefault((endpoint.module, endpoint.node), ([], []))
                    _add(entry[index], view.name)
        return dict(sorted(table.items()))

    async def statistics(self, module: str) -> ModuleStatistics:
        """Fetch what a module has counted, this one or any r2p module on the network.

        Raises Error if there is no such module, or it can't answer, and TimeoutError if it does not.
        """
        return await self.read_statistics(module, decode)

    async def read_statistics(self, module: str, read: Callable[[bytes], T]) -> T:
        """Fetch the same, and return what `read` makes of the content of the answer, as `statistics.decode` does.

        `read` may raise DecodeError, which becomes an Error as well.
        """
        firmware = "it counts nothing that others can ask for"
        content = await self.ask(module, Operation.STATISTICS, COMPRESSED, what="statistics", firmware=firmware)
        try:
            return read(content)
        except DecodeError as error:
            raise Error(f"the answer of {module} is not what this version of r2p can read: {error}") from error

    async def ask(self, module: str, operation: Operation, argument: bytes = b"", *, what: str, firmware: str) -> bytes:
        """Ask a module, this one or any r2p module on the network, and return the content of its answer.

        `what` is asked for, and what `firmware` can't do, are for the texts of errors. Raises Error if there is no such
        module, or it can't answer, ServiceError with the text of its own error, and TimeoutError if it does not answer:
        whether it has changed what it was to change is then unknown.
        """
        view = self._view(module)
        if view is None:
            raise Error(f"there is no module {module} on the network")
        if view.instance is None:
            raise Error(f"{module} is firmware: {firmware}")
        if view.kind == "ROS":
            raise Error(f"{module} is a ROS node, which knows nothing of r2p's modules: use the commands of ROS")
        if view.link and view.wire is None:
            raise Error(
                f"{module} is a ROS node behind a gateway, or its r2p is too old for {what}: use the commands of ROS, "
                "or update r2p there"
            )
        if view.link and view.wire is not None and view.wire < WIRE_MIN:
            raise Error(f"{module} has wire version {view.wire}, {what} need {WIRE_MIN}: update r2p there")
        services = self._opened().own_services
        call = services.change if operation.changes else services.fetch
        try:
            return await call(view.instance, operation, argument)
        except TimeoutError:
            text = f"module {module} does not answer, {view.age:.1f} s after its last message"
            if operation.changes:
                text += "; whether it has made the change is unknown"
            raise TimeoutError(text) from None
        except ServiceError as error:
            if str(error) != unknown_operation(operation):
                raise
            text = f"{module} has r2p {view.release or 'of an earlier version'}, which knows no {what}: update it there"
            raise Error(text) from None

    def nodes_of(self, module: str) -> RemoteNodes:
        """Return the nodes of a module, this one or any r2p module, to list, start, stop, restart and swap them."""
        return RemoteNodes(self.ask, module)

    async def message_type(self, fingerprint: bytes, topic: str = "") -> type[Message] | None:
        """Ask the modules on the network for a message class of this layout; None without an answer.

        `topic`: the one whose class is meant, where several have this layout.

        Modules that publish or subscribe to a topic of the type are asked, on any link and through gateways. It takes
        as long as its schema on a slow line, and some seconds if the modules are silent.
        """
        module = self._opened()
        return await find_type(module.links, module.own_services, fingerprint, topic)

    async def parameters(self, module: str, node: str | None = None) -> list[ParameterInfo]:
        """Fetch the parameters of a module, this one or any r2p module on the network; of one node or all.

        Raises ParameterError for an unknown node, Error if there is no such module or it can't answer, and TimeoutError
        if it does not.
        """
        return await parameter_services.fetch(self._asker(module), module, node)

    async def set_parameters(self, module: str, values: Mapping[tuple[str, str], object]) -> None:
        """Set parameters of a module, one or several, by (node, name): all or nothing.

        An int converts to a float, the name of a member to an enum, and None stands for the value of the start, as
        `reset_parameters` says. Raises ParameterError with the reason of the module that refuses the values or any
        change: then nothing has changed. Raises Error if there is no such module, it can't answer, or it has restarted
        meanwhile; and TimeoutError if it does not answer, and whether it has set them is unknown.
        """
        with self._explains_restarts(module):
            await parameter_services.change(self._asker(module), module, values)

    async def save_parameters(self, module: str) -> int:
        """Have a module save what was set to its file; return how many values the file has for it.

        Raises as `set_parameters`; also ParameterError if the module has no file, or can't write it.
        """
        with self._explains_restarts(module):
            return await parameter_services.save(self._asker(module), module)

    async def reset_parameters(self, module: str, node: str | None = None, names: Iterable[str] | None = None) -> int:
        """Undo what was set and saved, as `ModuleParameters.reset`: of a module, a node, or some of its parameters.

        Return how many parameters were reset. Raises as `set_parameters`.
        """
        with self._explains_restarts(module):
            return await parameter_services.reset(self._asker(module), module, node, names)

    def watch_parameters(self, module: str, *, period: float = 0.5) -> AsyncIterator[ParameterInfo]:
        """Iterate over the changes of a module's parameters, from the first step on: each parameter as it is then.

        The module is asked each `period` seconds, also after it was silent or has restarted. Raises MessageError for a
        period that is not a number of seconds, 0.001 or more; and when iterated, Error if there is no such module, and
        TimeoutError if it does not answer at the beginning.
        """
        check_seconds("the period of watch_parameters()", period, least=0.001)
        return parameter_services.watch(self._asker(module), lambda: self._instance_of(module), module, period)

    def follow_parameters(
        self, module: str, *, period: float = 0.5, pause: Callable[[float], Awaitable[object]] = asyncio.sleep
    ) -> AsyncIterator[dict[tuple[str, str], ParameterInfo]]:
        """Iterate over all parameters of a module by (node, name): as they are now, and after each change.

        The module is asked as by `watch_parameters`; `pause` waits between two questions. Raises when iterated, Error
        if there is no such module, and TimeoutError if it does not answer at the beginning.
        """
        instance = functools.partial(self._instance_of, module)
        return parameter_services.follow(self._asker(module), instance, module, period, pause)

    def _asker(self, module: str) -> parameter_services.Ask:
        firmware = "its parameters are bytes in its flash, see `r2p param --help`"
        return functools.partial(self.ask, module, what="parameters", firmware=firmware)

    @contextlib.contextmanager
    def _explains_restarts(self, module: str) -> Iterator[None]:
        """Raise Error if the module has restarted meanwhile, instead of an error that this has caused."""
        before = self._instance_of(module)
        try:
            yield
        except (ParameterError, TimeoutError) as error:
            now = self._instance_of(module)
            if now is None or before is None or now == before:
                raise
            text = f"module {module} has restarted meanwhile, and has the values of its start: do it again"
            raise Error(text) from error

    def _instance_of(self, module: str) -> int | None:
        view = self._view(module)
        return None if view is None else view.instance

    def _view(self, name: str) -> ModuleView | None:
        module = self._opened()
        if name == module.space.module:
            return self._own_view(module)
        now = module.space.clock.monotonic()
        for link in module.links:
            link.discovery.refresh_ages(now)
        infos = ((link, link.discovery.modules.get(name)) for link in module.links)
        found = [_module_view(link, info, now) for link, info in infos if info is not None]
        return min(found, key=lambda each: (each.kind == "ROS", each.age), default=None)  # it may be seen as both


class TopicLooks:
    """The topics of a network for a caller that looks at them again and again: cheap while none of them changes."""

    def __init__(self, network: NetworkView, space: TopicSpace) -> None:
        self._network = network
        self._space = space
        self._facts: dict[object, object] = {}
        self._views: dict[str, TopicView] = {}

    def look(self) -> dict[str, TopicView]:
        """Return the topics by name, in order: the same objects as before, unless more than ages has changed."""
        facts = _facts(self._space)
        if facts == self._facts:
            _set_ages(self._views, self._space)
        else:
            self._facts, self._views = facts, self._network.topics()
        return self._views


def _module_view(link: Link, info: ModuleInfo, now: int) -> ModuleView:
    state = _state(info.flags, observer=info.observer)
    age = (now - info.last_heard) / SECOND
    rebooted, wire, release = bool(info.flags & FLAG_REBOOTED), info.wire or None, info.release or None
    has_loader = info.instance is None or bool(info.flags & FLAG_LOADER)
    kind = link.foreign or ("firmware" if info.instance is None else "r2p")
    return ModuleView(info.name, state, rebooted, age, link.name, info.instance, wire, release, has_loader, kind)


def _state(flags: int, *, observer: bool) -> str:
    if observer:
        return "observer"
    if flags & FLAG_BOOT:
        return "boot"
    return "stopped" if flags & FLAG_STOPPED else "running"


def _add_own(view: TopicView, topic: Topic, module: str) -> None:
    """Add the topics and nodes of this module."""
    view.layout = topic.layout
    if topic.layout is not None:
        view.size, view.fingerprint = topic.layout.size, topic.layout.fingerprint
        view.varies = topic.layout.varies
    view.publishers += [Endpoint(module, each.node.name, each.publisher_class) for each in topic.publishers]
    view.subscribers += [Endpoint(module, each.owner) for each in topic.queues]
    if topic.publishers:
        view.published_on.append("")
    if topic.queues:
        view.subscribed_on.append("")


def _add_discovered(views: dict[str, TopicView], link: Link) -> None:
    """Add the topics and nodes that the discovery of a link has found."""
    for info in link.discovery.topics.values():
        view = views.setdefault(info.name, TopicView(info.name))
        view.size = view.size or info.size
        view.varies |= info.varies
        view.fingerprint = view.fingerprint or info.fingerprint
        view.mismatch |= info.mismatch
        view.ros_type = view.ros_type or info.type_name
        if info.advertised_at is not None:
            _add(view.published_on, link.name)
        if info.requested_at is not None:
            _add(view.subscribed_on, link.name)
    names = {info.instance: info.name for info in link.discovery.modules.values()}
    named = {(each.node, each.topic, each.role) for each in link.discovery.endpoints.values() if _module(each, names)}
    for endpoint in link.discovery.endpoints.values():
        module = _module(endpoint, names)
        if not module and (endpoint.node, endpoint.topic, endpoint.role) in named:
            continue  # most likely an earlier start of that module, which a gateway has not forgotten yet
        view = views.setdefault(endpoint.topic, TopicView(endpoint.topic))
        publishes = endpoint.role == ROLE_PUBLISHES
        klass = _CLASSES[endpoint.publisher_class & 3] if publishes else None  # a byte from outside
        (view.publishers if publishes else view.subscribers).append(Endpoint(module, endpoint.node, klass, link.name))


def _set_ages(views: dict[str, TopicView], space: TopicSpace) -> None:
    """Set the time since each topic was last announced, on any link."""
    now, announced = space.clock.monotonic(), dict[str, int]()
    for topic in space.topics.values():
        if not topic.unused:
            announced[topic.name] = now
    for link in space.links:
        link.discovery.refresh_ages(now)
        for name, info in link.discovery.topics.items():
            at, requested_at = info.advertised_at or 0, info.requested_at or 0
            if requested_at > at:
                at = requested_at
            if at >= announced.get(name, 0):
                announced[name] = at
    for name, view in views.items():
        heard_at = announced.get(name)
        view.age = None if heard_at is None else (now - heard_at) / SECOND


def _facts(space: TopicSpace) -> dict[object, object]:
    """Return everything that views of topics show, except for their ages. Repeated announcements change only orders."""
    facts: dict[object, object] = {
        topic.name: (
            topic.layout,
            [(each.node.name, each.publisher_class) for each in topic.publishers],
            [each.owner for each in topic.queues],
        )
        for topic in space.topics.values()
    }
    for link in space.links:
        topics = {
            name: (
                info.size,
                info.varies,
                info.fingerprint,
                info.mismatch,
                info.type_name,
                info.advertised_at is None,
                info.requested_at is None,
            )
            for name, info in link.discovery.topics.items()
        }
        facts[link] = link.name, link.discovery.generation, topics
    return facts


def _module(endpoint: EndpointInfo, names: dict[int | None, str]) -> str:
    """Return the name of an endpoint's module; empty: the endpoint was announced before it."""
    return endpoint.module or names.get(endpoint.instance, "")


def _add(names: list[str], name: str) -> None:
    if name not in names:
        names.append(name)
