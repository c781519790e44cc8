"""The topics that a gateway forwards, and announces on each link: worked out whenever demand changes.

On a link, a gateway publishes the topics that other links may send there, and subscribes to those that may go to
subscribers on another one. It does so only on links in the tree; so demand travels along the tree, and can't feed
itself.

A change of demand costs as much as there are links, not pairs of links: only new routes are looked at, the policy is
asked for pairs of kinds of links, and types are looked up once for all links.
"""

import functools
import itertools
import re
from collections.abc import Iterable, Iterator

import msgspec

from r2p.bridge.forwarding import READY, BridgedTopic, BridgePort, PortsByKind, RelayedTopic, Route, by_kind
from r2p.bridge.options import Policy, RelayedPeriodic, Shaper
from r2p.codecs.management import ROLE_PUBLISHES, ROLE_SUBSCRIBES
from r2p.log_lines import LineLimit, get_logger
from r2p.names import LOADER_PREFIX, TOPIC
from r2p.protocols.discovery.events import TopicType
from r2p.runtime.topic import Topic, TopicSpace
from r2p.transports.announcement import NOTHING, Announcement
from r2p.transports.stats import count_internal_error

logger = get_logger("r2p.bridge")

_NAME = re.compile(TOPIC)
LONG_NAMES = 64
"""Remembered names that are too long for a link, each logged once; beyond that, one a second is logged."""

_LINES = 1  # of the log in a second about names that are too long, when there are many of them

_Pair = tuple[BridgePort, BridgePort]
_Types = tuple[TopicType, TopicType]


class RoutingTable:
    """The topics that the gateway forwards, by their canonical names."""

    def __init__(self, ports: dict[str, BridgePort], space: TopicSpace, policy: Policy) -> None:
        self.by_name: dict[str, RelayedTopic] = {}
        self._ports = ports
        self._space = space
        self._policy = policy
        self._to_review: dict[str, None] = {}
        self._reviewing = False
        self._idle: set[str] = set()
        """Topics that are published or subscribed, and may go nowhere until there is another link."""
        self._known: dict[tuple[str, int], list[tuple[BridgePort, TopicType]]] | None = None
        """A cache of `_known_types`, for a pass over all links that asks about the same topics."""
        self._too_long: dict[str, None] = {}
        self._limit = LineLimit(_LINES)

    # What has changed

    def demand_changed(self, names: Iterable[str], port: BridgePort) -> None:
        """Review topics whose demand has changed on a link."""
        self._review_all(topic for name in names if (topic := self._to_canonical(name, port)) is not None)

    def port_changed(self, port: BridgePort) -> None:
        """Review the topics of a link that is new, or gone, or has another place in the tree, and announce there the
        topics of other links and of this module.
        """
        there = {topic for name in port.demand.topics() if (topic := self._to_canonical(name, port))}
        self._review_all(there | self._idle)
        is_member = port.in_tree and self._ports.get(port.name) is port
        for topic, relayed in list(self.by_name.items()):
            if topic in there or self.by_name.get(topic) is not relayed:
                continue
            if is_member and self._carries(topic, port):
                self._enter(relayed, topic, port)
            else:
                relayed.remove(port.name)
            self._announce_on(topic, port)
        for own in list(self._space.topics.values()):
            if not own.unused and self._to_canonical(own.name, port) not in self.by_name:
                port.link.stats.lost.guard(port.link.topic_changed, own)

    def check_types(self) -> None:
        """Check whether types or sizes differ from the announced ones."""
        self._known = {}
        try:
            changed = {
                topic
                for port in self._ports.values()
                for topic, types in port.announced_types.items()
                if topic in self.by_name and self._types(topic, port) != types
            }
        finally:
            self._known = None
        self._review_all(changed)

    def _review_all(self, topics: Iterable[str]) -> None:
        """Review these topics at once: the next message may need a new route."""
        self._to_review.update(dict.fromkeys(sorted(topics)))
        if self._reviewing:  # what a review announces may change demand: that is reviewed after it
            return
        self._reviewing = True
        try:
            while self._to_review:
                topic = next(iter(self._to_review))
                del self._to_review[topic]
                try:
                    self._review(topic)
                except Exception as error:  # noqa: BLE001 - counted and logged; the next topic follows
                    count_internal_error((port.link.stats.lost for port in self._ports.values()), error)
        finally:
            self._reviewing = False

    def _review(self, topic: str) -> None:
        ports = [port for port in self._ports.values() if port.in_tree and self._carries(topic, port)]
        names = {port: self._policy.to_link_name(topic, port.name) for port in ports}
        published_on = [port for port in ports if port.demand.is_published(names[port])]
        if (relayed := self.by_name.get(topic)) is not None:
            published_on += dict.fromkeys(each.source for each in relayed.holding if each.source not in published_on)
        subscribed_on = [port for port in ports if port.demand.is_subscribed(names[port])]
        if self._is_used(topic, ports, published_on, subscribed_on):
            self._idle.discard(topic)
            self._relay(topic, ports, published_on, subscribed_on)
            return
        self._end(topic)
        if (published_on or subscribed_on) and not self._policy.allows_nowhere(topic):
            self._idle.add(topic)
        else:
            self._idle.discard(topic)

    # What is allowed

    def _is_used(
        self, topic: str, ports: list[BridgePort], published_on: list[BridgePort], subscribed_on: list[BridgePort]
    ) -> bool:
        """Return whether messages may go from a publisher to any link, or from any link to a subscriber."""
        if self._policy.allows_nowhere(topic):
            return False
        everywhere = by_kind(ports)
        return self._is_allowed(topic, by_kind(published_on), everywhere) or self._is_allowed(
            topic, everywhere, by_kind(subscribed_on)
        )

    def _is_allowed(self, topic: str, sources: PortsByKind, targets: PortsByKind) -> bool:
        """Return whether the topic may go from one of the sources to another of the targets."""
        return next(self._allowed_pairs(topic, sources, targets), None) is not None

    def _allowed_pairs(self, topic: str, sources: PortsByKind, targets: PortsByKind) -> Iterator[_Pair]:
        for these in sources:
            for those in targets:
                if self._policy.allows(topic, these[0].name, those[0].name):
                    yield from ((one, other) for one in these for other in those if one is not other)

    # Topics that are forwarded

    def _relay(
        self, topic: str, ports: list[BridgePort], published_on: list[BridgePort], subscribed_on: list[BridgePort]
    ) -> None:
        relayed = self.by_name.get(topic)
        if relayed is None:
            relayed = self.by_name[topic] = RelayedTopic(functools.partial(self._review_all, (topic,)))
        relayed.set_demand(published_on, subscribed_on)
        published_on = [port for port in published_on if port in ports]
        for port in ports:
            self._enter(relayed, topic, port)
        if topic.startswith(LOADER_PREFIX):
            published_on = subscribed_on = ports  # messages of the loader flow without being announced
        relayed.keep({port.name for port in ports})
        self._add_routes(relayed, topic, published_on, subscribed_on)
        self._announce(topic)

    def _add_routes(
        self, relayed: RelayedTopic, topic: str, published_on: list[BridgePort], subscribed_on: list[BridgePort]
    ) -> None:
        """Add the routes from and to new links: looking at all pairs each time would cost links squared."""
        new = [port for port in published_on if port.name not in relayed.sources]
        old = [port for port in published_on if port.name in relayed.sources]
        added = [port for port in subscribed_on if port.name not in relayed.targets]
        pairs = itertools.chain(
            self._allowed_pairs(topic, by_kind(new), by_kind(subscribed_on)),
            self._allowed_pairs(topic, by_kind(old), by_kind(added)),
        )
        ready_by = self._space.clock.monotonic() + READY
        for source, target in pairs:
            route = relayed.route(source.name, target.name)
            if route is None:
                shaper = self._shaper(topic, source, target)
                route = Route(source, target, self._topic(topic, target), shaper)
                relayed.add(source.name, route)
            if route.subscriber is None:
                route.ready_by = ready_by
        relayed.routes_added(published_on, subscribed_on)
        if new or added:
            relayed.changed()

    def _shaper(self, topic: str, source: BridgePort, target: BridgePort) -> Shaper | None:
        has_slots = target.link.has_slots
        reserve = (
            functools.partial(self._reserve, topic, target) if has_slots and self._policy.reserves(topic) else None
        )
        varies = functools.partial(self._varies, topic, target)
        return self._policy.shaper(topic, source.name, soften=has_slots, reserve=reserve, varies=varies)

    def _varies(self, topic: str, target: BridgePort) -> bool:
        """Return whether the length of messages to this link varies."""
        here = self._topic(topic, target)
        return here.layout.varies if here.layout is not None else self._types(topic, target)[0].varies

    def _reserve(self, topic: str, target: BridgePort, size: int, period: float) -> RelayedPeriodic:
        """Ask a bus for slots for messages of `size` bytes each `period` seconds; of the bound, if their length varies.

        Messages with more bytes than any slots could have go as sporadic ones, if the bus carries them at all.
        """
        here, varies = self._topic(topic, target), self._varies(topic, target)
        if varies:
            size = here.layout.size if here.layout is not None else self._types(topic, target)[0].size
        if here.reserved is None or (here.reserved.size, here.reserved.varies) != (size, varies):
            here.reserved = RelayedPeriodic(size, period, varies=varies)
        target.link.topic_changed(here)
        return here.reserved

    def _enter(self, relayed: RelayedTopic, topic: str, port: BridgePort) -> None:
        here = self._topic(topic, port)
        if here.relayed is not relayed:
            here.relayed = relayed
            here.active_routes = {}
        relayed.topics[here.name] = here

    def _end(self, topic: str) -> None:
        relayed = self.by_name.pop(topic, None)  # first: links ask `desired_state`, which looks there
        if relayed is None:
            return
        for here in relayed.topics.values():
            here.relayed = here.reserved = None
            here.active_routes = {}
        self._announce(topic, relayed.topics)
        for here in relayed.topics.values():
            if here.unused and not here.in_use:
                self._space.topics.pop(here.name, None)

    # What is announced

    def _announce(self, topic: str, ended: dict[str, BridgedTopic] | None = None) -> None:
        """Announce a topic on all links; `ended`: its name while it was forwarded."""
        self._known = {}
        try:
            for port in list(self._ports.values()):
                self._announce_on(topic, port, ended)
        finally:
            self._known = None

    def _announce_on(self, topic: str, port: BridgePort, ended: dict[str, BridgedTopic] | None = None) -> None:
        here = (ended or self._space.topics).get(self._policy.to_link_name(topic, port.name))
        if ended is not None:
            port.announced_types.pop(topic, None)
        elif here is not None:
            port.announced_types[topic] = self._types(topic, port)
        if here is not None:
            port.link.stats.lost.guard(port.link.topic_changed, here)

    def desired_state(self, port: BridgePort, topic: Topic, own: Announcement) -> Announcement:
        """Return a link's announcement of a topic; `own` is this module's."""
        if not port.in_tree:
            return NOTHING
        name = self._policy.to_canonical(topic.name, port.name)
        relayed = None if name is None else self.by_name.get(name)
        if name is None or relayed is None:
            return own
        publishes = self._is_allowed(name, relayed.published_on_kinds, [[port]])
        subscribes = self._is_allowed(name, [[port]], relayed.subscribed_on_kinds)
        if not publishes and not subscribes:
            return own
        published, asked = TopicType(own.size, own.fingerprint, own.varies), own.asked
        if topic.layout is None:
            published, asked = self._types(name, port)
        return msgspec.structs.replace(
            own,
            publishes=own.publishes or publishes,
            subscribes=own.subscribes or subscribes,
            size=published.size,
            varies=published.varies,
            fingerprint=published.fingerprint,
            asked=asked,
        )

    def types_elsewhere(self, port: BridgePort, name: str) -> _Types:
        """Return the types in which a topic, by its name on a link, is published and subscribed on the other links."""
        topic = self._policy.to_canonical(name, port.name)
        relayed = None if topic is None else self.by_name.get(topic)
        if topic is None or relayed is None:
            return TopicType(), TopicType()
        published = self._type_on(topic, (each for each in relayed.published_on if each is not port), ROLE_PUBLISHES)
        asked = self._type_on(topic, (each for each in relayed.subscribed_on if each is not port), ROLE_SUBSCRIBES)
        return published or TopicType(), asked or TopicType()

    def _types(self, topic: str, port: BridgePort) -> _Types:
        """Return the types with which a link is to publish and to subscribe: those of publishers, if there are any.

        Those on the link itself are asked for what they have, so that another type elsewhere does not end the topic.
        """
        relayed = self.by_name[topic]
        here = self._type_on(topic, [port], ROLE_PUBLISHES)
        published = self._type_elsewhere(topic, port, relayed.published_on, ROLE_PUBLISHES)
        asked = self._type_elsewhere(topic, port, relayed.subscribed_on, ROLE_SUBSCRIBES)
        if not (published or asked) and relayed.holding and topic in port.announced_types:
            return port.announced_types[topic]  # the publisher has gone, and its messages have yet to be sent
        return published or asked or TopicType(), here or asked or published or TopicType()

    def _type_elsewhere(self, topic: str, port: BridgePort, ports: list[BridgePort], role: int) -> TopicType | None:
        """Return the type on the first other one of these links; without any, the first known type."""
        if ports:
            return self._type_on(topic, (each for each in ports if each is not port), role)
        return next((known for each, known in self._known_types(topic, role) if each is not port), None)

    def _known_types(self, topic: str, role: int) -> list[tuple[BridgePort, TopicType]]:
        """Return the first two links that know a type: so each link finds another one without looking at all."""
        known = None if self._known is None else self._known.get((topic, role))
        if known is None:
            types = ((port, self._type_on(topic, [port], role)) for port in self._ports.values() if port.in_tree)
            known = list(itertools.islice(((port, each) for port, each in types if each is not None), 2))
            if self._known is not None:
                self._known[topic, role] = known
        return known

    def _type_on(self, topic: str, ports: Iterable[BridgePort], role: int) -> TopicType | None:
        """Return the first announced type on these links."""
        infos = (each.link.discovery.topics.get(self._policy.to_link_name(topic, each.name)) for each in ports)
        types = (info.type_of(role) for info in infos if info is not None)
        return next((each for each in types if each is not None), None)

    # One topic on one link

    def _topic(self, topic: str, port: BridgePort) -> BridgedTopic:
        here = self._space.open(self._policy.to_link_name(topic, port.name), None)
        assert isinstance(here, BridgedTopic)  # this module makes no others
        return here

    def _to_canonical(self, name: str, port: BridgePort) -> str | None:
        """Return the canonical name; None for another robot's topics, and for names that only a hostile peer sends."""
        topic = self._policy.to_canonical(name, port.name)
        return topic if topic and _NAME.fullmatch(topic) else None

    def _carries(self, topic: str, port: BridgePort) -> bool:
        """Return whether the topic's name fits the link."""
        name = self._policy.to_link_name(topic, port.name)
        if not _NAME.fullmatch(name):
            return False
        if len(name) <= port.link.max_name:
            return True
        if name not in self._too_long:
            self._log_too_long(name, port)
        return False

    def _log_too_long(self, name: str, port: BridgePort) -> None:
        many = len(self._too_long) >= LONG_NAMES
        more = self._limit.suffix("", self._space.clock.monotonic()) if many else ""
        if more is not None:
            text = "link %s carries no name as long as %s: the topic is not relayed there%s"
            logger.warning(text, port.name, name, more)
        if many:
            del self._too_long[next(iter(self._too_long))]
        self._too_long[name] = None
