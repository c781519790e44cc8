"""Who publishes a topic at the other end of a link, as far as that is known there."""

from r2p.codecs.management import ROLE_PUBLISHES
from r2p.protocols.door import Door
from r2p.sample import Source


class Sources:
    """The source of what comes in, by topic; worked out anew when something is learnt.

    r2p modules tell which of their nodes publish a topic. Where nobody did, and only one module was heard, it is that.
    """

    def __init__(self, discovery: Door, link: str) -> None:
        self._discovery = discovery
        self._link = link
        self._known: dict[str, Source] = {}
        self._generation = -1

    def of(self, topic: str) -> Source:
        if self._generation != self._discovery.generation:
            self._generation = self._discovery.generation
            self._known.clear()
        source = self._known.get(topic)
        if source is None:
            source = self._known[topic] = self._find(topic)
        return source

    def _find(self, topic: str) -> Source:
        modules = self._discovery.modules.values()
        names = {info.instance: info.name for info in modules if info.r2p}
        publishers = {
            (names.get(each.instance, ""), each.node)
            for each in self._discovery.endpoints.values()
            if each.topic == topic and each.role == ROLE_PUBLISHES
        }
        candidates = {module for module, _ in publishers} or {info.name for info in modules if not info.observer}
        module = candidates.pop() if len(candidates) == 1 else ""
        node = publishers.pop()[1] if len(publishers) == 1 else ""
        return Source(module, node, self._link)
