"""Which topics a gateway relays, and what it tells each link of them: looked at anew whenever demand changes.

On a link we publish what is offered, and subscribe what is wanted, on another one to or from which it may go. All of
that only on links that are in the tree; so demand travels along the tree, and can't feed itself.
"""

import itertools
import re
from collections.abc import Iterable, Iterator

import msgspec

from r2p.bridge.forwarding import BridgedTopic, Relay, RelayedPeriodic, Route, Shaper
from r2p.bridge.options import Policy
from r2p.bridge.port import BridgePort
from r2p.codecs.management import ROLE_PUBLISHES, ROLE_SUBSCRIBES
from r2p.log_lines import LineLimit, get_logger
from r2p.names import LOADER_PREFIX
from r2p.protocols.discovery.events import TopicType
from r2p.runtime.topic import Topic, TopicSpace
from r2p.transports.announcement import NOTHING, Announcement
from r2p.transports.stats import count_internal_error

logger = get_logger("r2p.bridge")

_NAME = re.compile(r"[A-Za-z0-9_]+(?:/[A-Za-z0-9_]+)?")
LONG_NAMES = 64
"""Names too long for a link that are remembered, so that each is told once; beyond that one a second is told."""

_LINES = 1  # of the log in a second about names that are too long, when there are many of them
_BUSES = frozenset({"rtcan", "sim"})


class RoutingTable:
    """The relayed topics by their name on the robot."""

    def __init__(self, ports: dict[str, BridgePort], space: TopicSpace, policy: Policy) -> None:
        self.by_name: dict[str, Relay] = {}
        self._ports = ports
        self._space = space
        self._policy = policy
        self._dirty: dict[str, None] = {}
        self._idle: set[str] = set()
        """Topics that are offered or wanted, and may go nowhere as long as no other link comes."""
        self._reviewing = False
        self._shapes: dict[tuple[str, str], tuple[TopicType, TopicType]] = {}
        self._known: dict[tuple[str, int], list[tuple[BridgePort, TopicType]]] | None = None
        """What `_known_types` found, while all links are asked about the same topics one after the other."""
        self._too_long: dict[str, None] = {}
        self._limit = LineLimit(_LINES)

    # What has changed

    def changed(self, names: Iterable[str], port: BridgePort) -> None:
        """The demand for these topics has changed on a link."""
        self._mark(topic for name in names if (topic := self._meant(name, port)) is not None)

    def port_changed(self, port: BridgePort) -> None:
        """The link is new, or gone, or has another place in the tree: what it offers and wants is looked at anew, and
        what others do is told to this link only.
        """
        heard = {topic for name in port.demand.topics() if (topic := self._meant(name, port))}
        self._mark(heard | self._idle)
        there = port.in_tree and self._ports.get(port.name) is port
        for topic, relay in list(self.by_name.items()):
            if topic in heard or self.by_name.get(topic) is not relay:
                continue
            if there and self._carries(topic, port):
                self._enter(relay, topic, port)
            else:
                relay.forget(port.name)
            self._tell_port(topic, port)

    def retyped(self) -> None:
        """See whether other types, or sizes, are told than before."""
        self._known = {}
        try:
            changed = {topic for (topic, link), shape in self._shapes.items() if self._is_retyped(topic, link, shape)}
        finally:
            self._known = None
        self._mark(changed)

    def _is_retyped(self, topic: str, link: str, shape: tuple[TopicType, TopicType]) -> bool:
        port = self._ports.get(link)
        return port is not None and topic in self.by_name and self._types(topic, port) != shape

    def _mark(self, topics: Iterable[str]) -> None:
        """Look at these anew, at once: what comes in next may need a new way."""
        self._dirty.update(dict.fromkeys(sorted(topics)))
        if self._reviewing:
            return
        self._reviewing = True
        try:
            while self._dirty:
                topic = next(iter(self._dirty))
                del self._dirty[topic]
                try:
                    self._review(topic)
                except Exception as error:  # noqa: BLE001 - counted and logged; the next topic follows
                    count_internal_error((port.link.stats.lost for port in self._ports.values()), error)
        finally:
            self._reviewing = False

    def _review(self, topic: str) -> None:
        ports = [port for port in self._ports.values() if port.in_tree and self._carries(topic, port)]
        offering = [port for port in ports if self._offers(topic, port)]
        wanting = [port for port in ports if self._wants(topic, port)]
        if self._is_used(topic, ports, offering, wanting):
            self._idle.discard(topic)
            self._relay(topic, ports, offering, wanting)
            return
        self._end(topic)
        if (offering or wanting) and not self._policy.allows_nowhere(topic):
            self._idle.add(topic)
        else:
            self._idle.discard(topic)

    def _is_used(
        self, topic: str, ports: list[BridgePort], offering: list[BridgePort], wanting: list[BridgePort]
    ) -> bool:
        """Whether messages flow anywhere, or would if there were any."""
        if self._policy.allows_nowhere(topic):
            return False
        return any(self._allows(topic, *each) for each in _pairs(offering, ports)) or any(
            self._allows(topic, *each) for each in _pairs(ports, wanting)
        )

    def _allows(self, topic: str, source: BridgePort, target: BridgePort) -> bool:
        return self._policy.allows(topic, source.name, target.name)

    # Relays

    def _relay(
        self, topic: str, ports: list[BridgePort], offering: list[BridgePort], wanting: list[BridgePort]
    ) -> None:
        relay = self.by_name.get(topic)
        if relay is None:
            relay = self.by_name[topic] = Relay()
        relay.offering, relay.wanting = offering, wanting
        for port in ports:
            self._enter(relay, topic, port)
        if topic.startswith(LOADER_PREFIX):
            offering = wanting = ports  # it flows without being offered or wanted
        relay.keep({port.name for port in ports})
        self._find_ways(relay, topic, offering, wanting)
        self._tell(topic)

    def _find_ways(self, relay: Relay, topic: str, offering: list[BridgePort], wanting: list[BridgePort]) -> None:
        """Add the ways from and to what is new here: looking at all pairs each time would cost links squared."""
        sources, targets = {port.name for port in offering}, {port.name for port in wanting}
        new = [port for port in offering if port.name not in relay.sources]
        old = [port for port in offering if port.name in relay.sources]
        added = [port for port in wanting if port.name not in relay.targets]
        for source, target in itertools.chain(_pairs(new, wanting), _pairs(old, added)):
            if relay.way(source.name, target.name) is None and self._allows(topic, source, target):
                here = self._topic(topic, target)
                relay.add(source.name, Route(target, here, self._shaper(topic, source.name, target)))
        relay.sources, relay.targets = sources, targets
        if new or added:
            relay.changed()

    def _enter(self, relay: Relay, topic: str, port: BridgePort) -> None:
        here = self._topic(topic, port)
        if here.relay is not relay:
            here.relay = relay
            here.open = {}
        relay.topics[here.name] = here

    def _end(self, topic: str) -> None:
        relay = self.by_name.pop(topic, None)
        if relay is None:
            return
        for here in relay.topics.values():
            here.relay = here.reserved = None
            here.open = {}
        self._tell(topic, relay.topics)
        for here in relay.topics.values():
            if here.unused and not here.in_use:
                self._space.topics.pop(here.name, None)

    def _tell(self, topic: str, topics: dict[str, BridgedTopic] | None = None) -> None:
        self._known = {}
        try:
            for port in list(self._ports.values()):
                self._tell_port(topic, port, topics)
        finally:
            self._known = None

    def _tell_port(self, topic: str, port: BridgePort, topics: dict[str, BridgedTopic] | None = None) -> None:
        """Tell one link of a topic; `topics`: those of a relay that has ended."""
        here = (topics or self._space.topics).get(self._policy.to_link_name(topic, port.name))
        if topics is not None:
            self._shapes.pop((topic, port.name), None)
        elif here is not None:
            self._shapes[topic, port.name] = self._types(topic, port)
        if here is not None:
            port.link.stats.lost.guard(port.link.topic_changed, here)

    def desired_state(self, port: BridgePort, topic: Topic, own: Announcement) -> Announcement:
        """What a link is to be told of a topic that this module itself has as `own`."""
        if not port.in_tree:
            return NOTHING
        name = self._policy.to_canonical(topic.name, port.name)
        relay = None if name is None else self.by_name.get(name)
        if name is None or relay is None:
            return own
        publishes = any(self._allows(name, each, port) for each in relay.offering if each is not port)
        subscribes = any(self._allows(name, port, each) for each in relay.wanting if each is not port)
        if not publishes and not subscribes:
            return own
        shape, asked = (own.asked, own.asked) if topic.layout is not None else self._types(name, port)
        return msgspec.structs.replace(
            own,
            publishes=own.publishes or publishes,
            subscribes=own.subscribes or subscribes,
            size=shape.size,
            fingerprint=shape.fingerprint,
            asked=asked,
        )

    def _types(self, topic: str, port: BridgePort) -> tuple[TopicType, TopicType]:
        """The types in which a link is told that we publish and subscribe: what publishers say of it, if there are any.

        Those that it has itself are asked for what they have, so that one of another type elsewhere does not end it.
        """
        relay = self.by_name[topic]
        here = self._told(topic, [port], ROLE_PUBLISHES)
        published = self._told_elsewhere(topic, port, relay.offering, ROLE_PUBLISHES)
        asked = self._told_elsewhere(topic, port, relay.wanting, ROLE_SUBSCRIBES)
        return published or asked or TopicType(), here or asked or published or TopicType()

    def _told_elsewhere(self, topic: str, port: BridgePort, ports: list[BridgePort], role: int) -> TopicType | None:
        """The type that the first other one of these links tells; where there are none, the first that is known."""
        if ports:
            return self._told(topic, (each for each in ports if each is not port), role)
        return next((shape for each, shape in self._known_types(topic, role) if each is not port), None)

    def _known_types(self, topic: str, role: int) -> list[tuple[BridgePort, TopicType]]:
        """The first two links that know a type: so each link finds one besides its own, and none looks at all."""
        known = None if self._known is None else self._known.get((topic, role))
        if known is None:
            told = ((port, self._told(topic, [port], role)) for port in self._ports.values() if port.in_tree)
            known = list(itertools.islice(((port, shape) for port, shape in told if shape is not None), 2))
            if self._known is not None:
                self._known[topic, role] = known
        return known

    def _told(self, topic: str, ports: Iterable[BridgePort], role: int) -> TopicType | None:
        """The type that the first link tells."""
        infos = (each.link.discovery.topics.get(self._policy.to_link_name(topic, each.name)) for each in ports)
        return next((info.types[role] for info in infos if info is not None and role in info.types), None)

    # One topic on one link

    def _offers(self, topic: str, port: BridgePort) -> bool:
        return port.demand.is_published(self._policy.to_link_name(topic, port.name))

    def _wants(self, topic: str, port: BridgePort) -> bool:
        return port.demand.is_subscribed(self._policy.to_link_name(topic, port.name))

    def _topic(self, topic: str, port: BridgePort) -> BridgedTopic:
        here = self._space.open(self._policy.to_link_name(topic, port.name), None)
        assert isinstance(here, BridgedTopic)  # this module makes no others
        return here

    def _meant(self, name: str, port: BridgePort) -> str | None:
        """The topic of the robot; None for what is not its own, and for what only a hostile wire can say."""
        topic = self._policy.to_canonical(name, port.name)
        return topic if topic and _NAME.fullmatch(topic) else None

    def _carries(self, topic: str, port: BridgePort) -> bool:
        """Whether the topic's name fits there."""
        name = self._policy.to_link_name(topic, port.name)
        if not _NAME.fullmatch(name):
            return False  # a namespace within that of a prefix
        if len(name) <= port.link.max_name:
            return True
        if name not in self._too_long:
            self._tell_too_long(name, port)
        return False

    def _tell_too_long(self, name: str, port: BridgePort) -> None:
        many = len(self._too_long) >= LONG_NAMES
        more = self._limit.suffix("", self._space.clock.monotonic()) if many else ""
        if more is not None:
            text = "link %s carries no name as long as %s: the topic is not relayed there%s"
            logger.warning(text, port.name, name, more)
        if many:
            del self._too_long[next(iter(self._too_long))]
        self._too_long[name] = None

    def _shaper(self, topic: str, source: str, target: BridgePort) -> Shaper | None:
        policy = self._policy
        is_bus = target.name.partition(":")[0] in _BUSES
        shaper = Shaper.of(
            rate=policy.rate_limit(topic),
            klass=policy.class_of(topic, source),
            soften=is_bus,
            learnt=(lambda size, period: reserve(size, period)) if is_bus and policy.reserves(topic) else None,
        )

        def reserve(size: int, period: float) -> None:
            here = self._topic(topic, target)
            if here.reserved is None or here.reserved.size != size:
                here.reserved = RelayedPeriodic(here.name, size, period)
            if shaper is not None:
                shaper.reserved = here.reserved
            target.link.topic_changed(here)

        return shaper


def _pairs(sources: list[BridgePort], targets: list[BridgePort]) -> Iterator[tuple[BridgePort, BridgePort]]:
    return ((source, target) for source in sources for target in targets if source is not target)
