"""What a module knows of the network: topics, nodes and modules, its own and what its links have heard.

r2p modules tell everything; firmware tells its name and its topics, one step each half second, and not which node they
belong to. Ages say how old the knowledge is.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Protocol

import msgspec

from r2p.codecs.management import FLAG_BOOT, FLAG_REBOOTED, FLAG_STOPPED, ROLE_PUBLISHES
from r2p.messages import Layout, Message
from r2p.protocols.discovery.events import Mismatched, ModuleInfo
from r2p.runtime.sample import PublisherClass

if TYPE_CHECKING:
    from r2p.runtime.topic import Topic, TopicSpace
    from r2p.transports.link import Link

_SECOND = 1_000_000_000


class Endpoint(msgspec.Struct, frozen=True, order=True):
    """A publisher (`publisher_class` is set) or a subscriber of a node. `link` is empty for one of this module."""

    module: str
    node: str
    publisher_class: PublisherClass | None = None
    link: str = ""


class TopicView(msgspec.Struct):
    """A topic as far as it is known here.

    `size` in bytes, 0: unknown; `fingerprint` of its layout, None: unknown. `layout` only where this module uses it.
    `publishers` and `subscribers` are those known by node; `published_on` and `subscribed_on` name the links ("": this
    module) on which somebody publishes or subscribes, known by node or not. `age`: seconds since it was last heard of.
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


class ModuleView(msgspec.Struct):
    """A module. `state` is "running", "stopped", "boot" or "observer"; `age` is in s since it was heard (0: this one).

    `link` is empty for this module, `instance` is None for firmware.
    """

    name: str
    state: str
    rebooted: bool
    age: float
    link: str
    instance: int | None


class GraphOwner(Protocol):
    """The module whose view it is."""

    @property
    def name(self) -> str: ...
    @property
    def instance(self) -> int: ...
    @property
    def observer(self) -> bool: ...
    @property
    def stopped(self) -> bool: ...
    @property
    def rebooted(self) -> bool: ...
    @property
    def space(self) -> "TopicSpace": ...
    @property
    def links(self) -> Sequence["Link"]: ...


class NetworkView:
    """The views of one module; each call looks anew. Raises Closed before the module is open."""

    def __init__(self, module: GraphOwner) -> None:
        self._module = module

    def modules(self) -> list[ModuleView]:
        """All modules, this one first, then by name; observers included."""
        module = self._module
        now = module.space.clock.monotonic()
        state = "observer" if module.observer else "stopped" if module.stopped else "running"
        own = ModuleView(module.name, state, module.rebooted, 0.0, "", module.instance)
        others = [
            ModuleView(
                info.name,
                _state(info),
                bool(info.flags & FLAG_REBOOTED),
                (now - info.last_heard) / _SECOND,
                link.name,
                info.instance,
            )
            for link in module.links
            for info in link.discovery.modules.values()
        ]
        return [own, *sorted(others, key=lambda view: (view.name, view.link))]

    def topics(self) -> dict[str, TopicView]:
        """All topics by name, in order."""
        views: dict[str, TopicView] = {}
        for topic in self._module.space.topics.values():
            if not topic.unused:
                self._add_own(views.setdefault(topic.name, TopicView(topic.name)), topic)
        for link in self._module.links:
            self._add_link(views, link)
        return dict(sorted(views.items()))

    def nodes(self) -> dict[tuple[str, str], tuple[list[str], list[str]]]:
        """(module, node) -> the topics that it publishes, and those that it subscribes; in order."""
        table: dict[tuple[str, str], tuple[list[str], list[str]]] = {}
        for view in self.topics().values():
            for index, endpoints in enumerate((view.publishers, view.subscribers)):
                for endpoint in endpoints:
                    entry = table.setdefault((endpoint.module, endpoint.node), ([], []))
                    _add(entry[index], view.name)
        return dict(sorted(table.items()))

    async def message_type(self, fingerprint: bytes) -> type[Message] | None:
        """A message class of this layout, from whoever on the network has it and can be asked; may take a second."""
        for link in list(self._module.links):
            found = await link.message_type(fingerprint) if link.up else None
            if found is not None:
                return found
        return None

    def _add_own(self, view: TopicView, topic: "Topic") -> None:
        view.age = 0.0
        view.layout = topic.layout
        if topic.layout is not None:
            view.size, view.fingerprint = topic.layout.size, topic.layout.fingerprint
        name = self._module.name
        view.publishers += [Endpoint(name, each.node.name, each.publisher_class) for each in topic.publishers]
        view.subscribers += [Endpoint(name, each.owner) for each in topic.queues]
        if topic.publishers:
            view.published_on.append("")
        if topic.queues:
            view.subscribed_on.append("")

    def _add_link(self, views: dict[str, TopicView], link: "Link") -> None:
        now = self._module.space.clock.monotonic()
        for info in link.discovery.topics.values():
            view = views.setdefault(info.name, TopicView(info.name))
            view.size = view.size or info.size
            view.fingerprint = view.fingerprint or info.fingerprint
            view.mismatch |= info.mismatch
            if info.advertised_at is not None:
                _add(view.published_on, link.name)
            if info.requested_at is not None:
                _add(view.subscribed_on, link.name)
            heard = max(info.advertised_at or 0, info.requested_at or 0)
            age = (now - heard) / _SECOND
            view.age = age if view.age is None else min(view.age, age)
        names = {info.instance: info.name for info in link.discovery.modules.values()}
        for endpoint in link.discovery.endpoints.values():
            module = endpoint.module or names.get(endpoint.instance, "")  # it may be told before its module's name
            view = views.setdefault(endpoint.topic, TopicView(endpoint.topic))
            publishes = endpoint.role == ROLE_PUBLISHES
            klass = PublisherClass(endpoint.publisher_class & 3 or 1) if publishes else None  # a byte from outside
            (view.publishers if publishes else view.subscribers).append(
                Endpoint(module, endpoint.node, klass, link.name)
            )


def describe_mismatch(event: Mismatched) -> str:
    """What is wrong, and what to do."""
    role = "publish" if event.role == ROLE_PUBLISHES else "subscribe"
    if event.ours.size != event.theirs.size:
        what = f"messages of {event.theirs.size} bytes, here they have {event.ours.size}"
    else:
        what = f"another layout of the same {event.ours.size} bytes"
    return f"others {role} {what}; use one message type on both sides, or another topic"


def _state(info: ModuleInfo) -> str:
    if info.observer:
        return "observer"
    if info.flags & FLAG_BOOT:
        return "boot"
    return "stopped" if info.flags & FLAG_STOPPED else "running"


def _add(names: list[str], name: str) -> None:
    if name not in names:
        names.append(name)
