"""Who sent what comes in: lines and CAN frames do not say it, so it follows from what discovery knows."""

from r2p.codecs.management import ROLE_PUBLISHES
from r2p.protocols.discovery.events import PeerAddress
from r2p.protocols.discovery.session import DiscoveryProtocol
from r2p.runtime.sample import Source


class SenderLookup:
    """The source of messages by topic and address, looked up anew when discovery has learnt something.

    r2p modules announce which of their nodes publish a topic. A topic that none has announced comes from the only
    module that can have sent it, if there is only one. `shared` are the addresses that several modules may have.
    """

    def __init__(self, discovery: DiscoveryProtocol, link: str, shared: tuple[PeerAddress, ...] = ()) -> None:
        self._discovery = discovery
        self._link = link
        self._shared = shared
        self._sources: dict[tuple[str, PeerAddress], Source] = {}
        self._generation = -1

    def source(self, topic: str, address: PeerAddress = None) -> Source:
        """The source of a message from this address. Without an address it may be any module at the other end.

        A name is empty if it is unknown or ambiguous.
        """
        if self._generation != self._discovery.generation:
            self._generation = self._discovery.generation
            self._sources.clear()
        source = self._sources.get((topic, address))
        if source is None:
            source = self._sources[topic, address] = self._find(topic, address)
        return source

    def _find(self, topic: str, address: PeerAddress) -> Source:
        modules = list(self._discovery.modules.values())
        if address is not None:
            direct = [info for info in modules if info.source == address]
            modules = direct or [info for info in modules if info.source in self._shared]
        names = {info.instance: info.name for info in modules if info.r2p}
        # Without an address, a publisher of a module that is not known yet may be the sender; its module has no name.
        publishers = {
            (names.get(each.instance, ""), each.node)
            for each in self._discovery.endpoints.values()
            if each.topic == topic and each.role == ROLE_PUBLISHES and (address is None or each.instance in names)
        }
        if len(publishers) == 1:
            return Source(*publishers.pop(), self._link)
        candidates = {module for module, _ in publishers} or {info.name for info in modules if not info.observer}
        return Source(candidates.pop() if len(candidates) == 1 else "", "", self._link)
