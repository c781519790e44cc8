"""The graph of connections: which nodes publish and subscribe to a topic, and which serve a service."""

from collections.abc import Mapping

import msgspec

from r2p.codecs.services import REQUESTS, RESPONSES, is_of_service
from r2p.modules.graph import Endpoint, TopicView
from r2p.web.foxglove.protocol import GraphUpdate

_Ids = dict[str, list[str]]


class ConnectionGraph(msgspec.Struct, frozen=True):
    """The nodes, as MODULE/NODE, by the names of topics and services, which begin with a slash."""

    published: _Ids = {}
    subscribed: _Ids = {}
    served: _Ids = {}

    def update(self, before: "ConnectionGraph") -> GraphUpdate | None:
        """Return the changes; None without any."""
        topics, services = self.published | self.subscribed, self.served
        gone = sorted((before.published | before.subscribed).keys() - topics.keys())
        found = GraphUpdate(
            published=_changed(self.published, before.published, gone),
            subscribed=_changed(self.subscribed, before.subscribed, gone),
            served=_changed(services, before.served, ()),
            removed_topics=gone,
            removed_services=sorted(before.served.keys() - services.keys()),
        )
        return found if any(msgspec.structs.astuple(found)) else None


def connections(views: Mapping[str, TopicView]) -> ConnectionGraph:
    """Return the graph of a network. Services are in it as services, not as their two topics."""
    topics = {name: view for name, view in views.items() if not is_of_service(name, views)}
    names = [each.removesuffix(REQUESTS) for each in views.keys() - topics.keys() if each.endswith(REQUESTS)]
    servers = {name: _servers(views, name) for name in sorted(names)}
    return ConnectionGraph(
        published={f"/{name}": ids for name, view in topics.items() if (ids := _nodes(view.publishers))},
        subscribed={f"/{name}": ids for name, view in topics.items() if (ids := _nodes(view.subscribers))},
        served={f"/{name}": ids for name, ids in servers.items() if ids},
    )


def _servers(views: Mapping[str, TopicView], service: str) -> list[str]:
    """Return the nodes that receive requests and send responses."""
    answering = _nodes(views[service + RESPONSES].publishers)
    return [each for each in _nodes(views[service + REQUESTS].subscribers) if each in answering]


def _nodes(endpoints: list[Endpoint]) -> list[str]:
    return sorted({f"{each.module or '?'}/{each.node}" for each in endpoints})


def _changed(now: _Ids, before: _Ids, gone: list[str] | tuple[()]) -> _Ids:
    """Return the entries that are new or differ, and empty ones for what is still known otherwise."""
    ended: _Ids = {name: [] for name in sorted(before.keys() - now.keys()) if name not in gone}
    return {name: ids for name, ids in now.items() if before.get(name) != ids} | ended
