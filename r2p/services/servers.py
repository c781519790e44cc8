"""The servers of one service in other modules, as the discovery of this module's links knows them.

A server's node subscribes to the requests and publishes the responses; nodes are announced a little after their topics.
Firmware announces no nodes, so it only shows in the topics themselves.
"""

from typing import Any

import msgspec

from r2p.codecs.management import ROLE_PUBLISHES, ROLE_SUBSCRIBES
from r2p.codecs.services import REQUESTS, RESPONSES
from r2p.runtime.topic import LinkView, TopicSpace
from r2p.services.definition import Definition
from r2p.units import SECOND

_SETTLED = SECOND // 2  # ns without a change after which the r2p modules behind a link have announced everything


class RemoteServer(msgspec.Struct, frozen=True, order=True):
    """A server in another module; `hops`: gateways in between."""

    hops: int
    module: str
    instance: int


class KnownServers:
    """The servers of a service behind the links of a module."""

    def __init__(self, space: TopicSpace, definition: Definition[Any, Any]) -> None:
        self._space = space
        self._definition = definition
        self._found: list[tuple[RemoteServer, bool]] = []
        self._links: list[LinkView] | None = None
        self._generations: list[int] = []
        self._changed_at = space.clock.monotonic()

    @property
    def current(self) -> bool:
        """Return whether nothing has changed since `find` has looked."""
        if self._links != self._space.links:
            return False
        for link, generation in zip(self._space.links, self._generations, strict=True):
            if link.discovery.generation != generation:
                return False
        return True

    def find(self) -> list[tuple[RemoteServer, bool]]:
        """Return the servers, the nearest first, each with whether nothing gets lost on the way to it.

        They are looked up anew when the discovery of a link has changed.
        """
        if not self.current:
            found: dict[RemoteServer, bool] = {}
            for link in self._space.links:
                for each in self._behind(link):
                    found[each] = link.lossless and not each.hops
            self._links = list(self._space.links)
            self._generations = [link.discovery.generation for link in self._links]
            self._changed_at = self._space.clock.monotonic()
            self._found = sorted(found.items())
        return self._found

    def _behind(self, link: LinkView) -> list[RemoteServer]:
        modules = {info.instance: info for info in link.discovery.modules.values() if info.r2p}
        wanted = {(self._definition.request_topic, ROLE_SUBSCRIBES), (self._definition.response_topic, ROLE_PUBLISHES)}
        roles: dict[int, set[tuple[str, int]]] = {}
        for each in link.discovery.endpoints.values():
            if each.instance in modules and (each.topic, each.role) in wanted:
                roles.setdefault(each.instance, set()).add((each.topic, each.role))
        serving = [modules[instance] for instance, found in roles.items() if found == wanted]
        return [RemoteServer(info.hops, info.name, info.instance or 0) for info in serving]

    @property
    def settled(self) -> bool:
        """Return whether all modules behind all links have announced their nodes, as far as that shows.

        r2p modules announce all at once; what firmware has, and a link on which nothing was heard, never shows it.
        """
        self.find()
        quiet = self._space.clock.monotonic() - self._changed_at >= _SETTLED
        return not self._space.links or (quiet and all(map(_is_complete, self._space.links)))

    def names(self) -> list[str]:
        """Return the names of all services that are known here, without this one, in order."""
        topics = {topic for link in self._space.links for topic in link.discovery.topics} | set(self._space.topics)
        names = {topic.removesuffix(REQUESTS) for topic in topics if topic.endswith(REQUESTS)}
        return sorted(name for name in names if name != self._definition.name and name + RESPONSES in topics)


def _is_complete(link: LinkView) -> bool:
    """Return whether a link is up, with r2p modules alone behind it."""
    modules = link.discovery.modules.values()
    return link.up and bool(modules) and all(info.r2p for info in modules)
