"""A gateway's links and topics: messages from one link go out by the others where they are subscribed.

    link  ->  BridgedTopic.deliver  ->  Route  ->  RemoteSubscriber of another link

`RoutingTable` makes the routes when demand changes. The first message that then comes from a link looks up which of
them are in use, and the result is kept for the next ones. So forwarding is one loop over a list, and a change costs as
much as the routes that it concerns. For each message the clock is read to see whether both ports may still forward: a
gateway that was stopped must not go on with an old tree. Messages that arrive while the gateway listens anew are held,
and forwarded if it may forward afterwards. So are those for a link that has a new subscriber and can't serve it yet.
"""

import asyncio
import functools
from collections import Counter, deque
from collections.abc import Callable, Hashable, Iterator, Sequence
from typing import TYPE_CHECKING

from r2p.bridge.options import RelayedPeriodic, Shaper
from r2p.log_lines import LineLimit
from r2p.protocols.bridge.ports import PortState, TreePort
from r2p.runtime.backpressure import PendingDelivery, Sink
from r2p.runtime.queues import SubscriberQueue, WakeScheduler
from r2p.runtime.sample import DuplicateFilter, LastReceived, PublisherClass, Sample
from r2p.runtime.topic import RemoteSubscriber, SlotPublisher, Topic
from r2p.transports.link import Link
from r2p.units import LONG_AGO, SECOND

if TYPE_CHECKING:
    from r2p.protocols.discovery.events import TopicType

HOPS_MAX = 15
"""Gateways on a message's way, at most: the last defence against loops where messages carry hops."""

HELD_MAX = 4096
"""Places for messages that are held for one reason."""

READY = SECOND
"""For how long messages wait for a link to serve a new subscriber (ns)."""

_NOT_SUBSCRIBED = "not subscribed"
_PLACE = 16 * 1024
"""Bytes of a message in each place: so these messages have 64 MiB at most, and one message more."""


class BridgePort:
    """A link and its place in the tree (one that forwards nothing while the link is down).

    `kind` is that of `Policy.kind`, `now` gives UTC in ns.
    """

    def __init__(self, link: Link, number: int, kind: tuple[bool, ...], now: Callable[[], int]) -> None:
        self.link = link
        self.number = number
        self.kind = kind
        self.now = now
        self.is_client = not link.admits_gateways
        """True if no gateway may be at the link's other end."""
        self.tree_port = TreePort(number, 0)
        self.state = PortState.LISTENING
        """The last reported state."""
        self.dropped: Counter[str] = Counter()
        """Messages that arrived, or were published here, while nothing was forwarded."""
        self.announced_types: dict[str, tuple[TopicType, TopicType]] = {}
        """Types with which the link publishes and subscribes to forwarded topics, by canonical name. Kept here, as
        clients come and go under new names: what another table had of them would stay.
        """
        self.demand = link.discovery.demand()
        self.denied_at = LONG_AGO
        """Time of the last answer that an order does not pass (monotonic ns)."""
        self.refusal_lines = LineLimit(1)  # a second
        """Limit of the log lines about these."""

    @property
    def name(self) -> str:
        return self.link.name

    @property
    def in_tree(self) -> bool:
        return self.tree_port.in_tree

    @property
    def resumes(self) -> bool:
        """Return whether the port pauses only because this program stood still, and is likely to go on."""
        return self.tree_port.resumes or self.tree_port.state is PortState.ALONE

    def count_dropped(self, reason: str) -> None:
        """Count a message that does not pass."""
        self.dropped[reason] += 1
        self.link.stats.lost[reason] += 1


PortsByKind = list[list[BridgePort]]


def by_kind(ports: list[BridgePort]) -> PortsByKind:
    """The ports in groups between which the policy makes no difference."""
    groups: dict[tuple[bool, ...], list[BridgePort]] = {}
    for port in ports:
        groups.setdefault(port.kind, []).append(port)
    return list(groups.values())


class HeldMessages:
    """Messages that wait until they can be forwarded, and how to go on with each."""

    def __init__(self) -> None:
        self._held: deque[tuple[Sample, Callable[[], list[Sink] | None]]] = deque()
        self._places = 0

    def __len__(self) -> int:
        return len(self._held)

    def hold(self, sample: Sample, go_on: Callable[[], list[Sink] | None]) -> bool:
        """Hold a message; return False if there are too many. `go_on` returns the sinks without room."""
        if self._places >= HELD_MAX:
            return False
        self._places += 1 + len(sample.data) // _PLACE
        self._held.append((sample, go_on))
        return True

    def release(self, failed: Callable[[Exception], object], *, but: Sequence[Sample] = ()) -> None:
        """Go on with all messages but these; `failed` is called with exceptions."""
        held, self._held, self._places = self._held, deque(), 0
        for sample, go_on in held:
            if any(sample is each for each in but):
                continue
            try:
                if sinks := go_on():
                    PendingDelivery(sample, sinks)
            except Exception as error:  # noqa: BLE001 - counted and logged; the next one follows
                failed(error)


class Route:
    """One topic from one link to another: `subscriber` is set while it is subscribed there.

    `shaper` changes messages on this route, or drops some; None: they pass as they are.

    Publishers know of a new subscriber at once, while its link may first have to tell it what to receive, or to see
    that messages reach it. Until then, but at most until `ready_by` (monotonic ns), messages are `held`.
    """

    __slots__ = ("dropped", "forwarded", "held", "port", "ready_by", "shaper", "source", "subscriber", "target")

    def __init__(self, source: BridgePort, port: BridgePort, target: "BridgedTopic", shaper: Shaper | None) -> None:
        self.source = source
        self.port = port
        self.target = target
        self.shaper = shaper
        self.subscriber: RemoteSubscriber | None = None
        self.forwarded = 0
        self.dropped: Counter[str] = Counter()
        """Losses by reason; the link counts only those due to the tree (`converging`)."""
        self.ready_by = LONG_AGO
        self.held: HeldMessages | None = None


class BridgedTopic(Topic):
    """A topic of a module that is a gateway."""

    def __init__(
        self,
        name: str,
        wake_scheduler: WakeScheduler,
        ports: dict[str, BridgePort],
        monotonic: Callable[[], int],
        held: HeldMessages,
    ) -> None:
        super().__init__(name, wake_scheduler)
        self.relayed: RelayedTopic | None = None
        """The forwarded topic, while the gateway forwards it."""
        self.active_routes: dict[str, list[Route]] = {}
        """The routes that messages take now, by the name of the link that they come from: looked up when the first one
        comes. A change replaces the whole dict, as a message may be on its way through one of the lists.
        """
        self.by_link: dict[object, RemoteSubscriber] = {}
        """Remote subscribers by their links."""
        self.reserved: RelayedPeriodic | None = None
        """The periodic publisher, where a bus is to send the topic in slots of its own."""
        self._ports = ports
        self._monotonic = monotonic
        self._duplicates = DuplicateFilter()
        self._held = held

    @property
    def slot_publishers(self) -> list[SlotPublisher]:
        own = super().slot_publishers
        return own if self.reserved is None else [*own, self.reserved]

    @property
    def wanted(self) -> bool:
        return self.relayed is not None or bool(self.queues)

    @property
    def in_use(self) -> bool:
        return self.relayed is not None or super().in_use

    def last_received(self, publisher: Hashable) -> LastReceived:
        """Return a new one for each link, as one link may drop a message that another one forwards later."""
        return LastReceived()

    # Messages

    def deliver(self, sample: Sample, own: object = None, slot_link: object = None) -> list[Sink] | None:
        link = sample.source.link
        if not link:
            return super().deliver(sample, own, slot_link)
        now = self._monotonic()
        port = self._ports[link]
        if now >= port.tree_port.forwards_until:
            if not self._hold_in_pause(port, sample, functools.partial(self._deliver_held, port, sample)):
                port.count_dropped("converging")
            return None
        # A latched value arrives again, unchanged, for each new subscriber.
        if sample.sequence and not self._duplicates.accept(sample) and not port.link.latched(self.name):
            port.count_dropped("seen before")
            return None
        routes = self.active_routes.get(link)
        if not routes:
            if routes is None:
                routes = [] if self.relayed is None else self.relayed.active_from(link, now)
                self.active_routes[link] = routes
            if not routes and not self.queues:  # not yet, or no longer, which its publisher will soon know: no loss
                port.dropped[_NOT_SUBSCRIBED] += 1
                return None
        blocked = super().deliver(sample) if self.queues else None
        for route in routes:
            blocked = self._forward(route, sample, now, blocked)
        return blocked

    def deliver_run(self, samples: list[Sample], at: int) -> int:
        """Queue nothing in bulk: each message is looked at, and forwarded."""
        return 0

    def _hold_in_pause(self, port: BridgePort, sample: Sample, go_on: Callable[[], list[Sink] | None]) -> bool:
        """Hold a message while its port pauses; return False if it does not, or if the message is of no use later."""
        non_real_time = sample.publisher_class == PublisherClass.NON_REAL_TIME
        return non_real_time and port.resumes and self._held.hold(sample, go_on)

    def _deliver_held(self, port: BridgePort, sample: Sample) -> list[Sink] | None:
        if self._ports.get(port.name) is port:
            return self.deliver(sample)
        port.count_dropped("converging")  # its link is gone
        return None

    def _forward(self, route: Route, sample: Sample, now: int, blocked: list[Sink] | None) -> list[Sink] | None:
        port, subscriber = route.port, route.subscriber
        if subscriber is None:
            self._await_subscriber(route, sample, now)
            return blocked
        if now >= port.tree_port.forwards_until:
            if not self._hold_in_pause(port, sample, functools.partial(self._forward_held, route, sample)):
                route.dropped["converging"] += 1
                port.link.stats.lost["converging"] += 1
            return blocked
        shaper = route.shaper
        if shaper is None and not sample.deadline and sample.hops < HOPS_MAX:  # most messages: nothing else to ask
            return _offer(route, subscriber, sample, blocked)
        if sample.hops >= HOPS_MAX:
            route.dropped["too many hops"] += 1
        elif sample.deadline and sample.drop_late and port.now() > sample.due and not self.is_latched(sample):
            route.dropped["late"] += 1
        elif shaper is None:
            return _offer(route, subscriber, sample, blocked)
        elif shaper.reserved is not None and shaper.reserved.offer(sample):
            route.forwarded += 1
        else:
            return _offer_shaped(route, subscriber, shaper.shape(sample, now, port.now()), sample, blocked)
        return blocked

    def _await_subscriber(self, route: Route, sample: Sample, now: int) -> None:
        """Hold a message until the link can serve its new subscriber.

        The message is dropped, and counted, if too many are held already, or if the link takes too long.
        """
        if route.held is None and now < route.ready_by and self.relayed is not None:
            route.held = HeldMessages()
            self.relayed.holding[route] = None
            seconds = (route.ready_by - now) / SECOND
            asyncio.get_running_loop().call_later(seconds, self.relayed.give_up, route, route.held)
        if route.held is None or not route.held.hold(sample, functools.partial(self._forward_held, route, sample)):
            route.source.dropped[_NOT_SUBSCRIBED] += 1

    def is_latched(self, sample: Sample) -> bool:
        source = self._ports.get(sample.source.link)
        return source is not None and source.link.latched(self.name)

    def _forward_held(self, route: Route, sample: Sample) -> list[Sink] | None:
        return self._forward(route, sample, self._monotonic(), None)

    def _send(
        self, subscribers: list[RemoteSubscriber], sample: Sample, blocked: list[Sink] | None, slot_link: object
    ) -> list[Sink] | None:
        """Send this module's messages on links to which this gateway forwards; other gateways serve the rest."""
        now = self._monotonic()
        silent = [each for each in subscribers if now >= self._ports[each.link_name].tree_port.forwards_until]
        for each in silent:
            port = self._ports[each.link_name]
            if not self._hold_in_pause(port, sample, functools.partial(self._send_held, each, sample)):
                each.lost += 1
                port.count_dropped("converging")
        if silent:
            subscribers = [each for each in subscribers if each not in silent]
        return super()._send(subscribers, sample, blocked, slot_link)

    def _send_held(self, subscriber: RemoteSubscriber, sample: Sample) -> list[Sink] | None:
        port = self._ports.get(subscriber.link_name)
        if port is None or self._monotonic() >= port.tree_port.forwards_until:
            subscriber.lost += 1
            if port is not None:
                port.count_dropped("converging")
            return None
        return None if subscriber.offer_in_order(sample) else [subscriber]

    def count_unsendable(self, sample: Sample, link: str, reason: str) -> None:
        route = None if self.relayed is None else self.relayed.route(sample.source.link, link)
        if route is not None:
            route.forwarded -= 1
            route.dropped[reason] += 1

    # Subscribers

    def join(self, sink: SubscriberQueue | RemoteSubscriber) -> None:
        if isinstance(sink, RemoteSubscriber):
            self.by_link[sink.link] = sink
            if self.relayed is not None:
                self.relayed.subscriber_changed(self, sink)
                self.relayed.release_held(self, sink)
        super().join(sink)  # which ends with `resend_latched`

    def leave(self, sink: SubscriberQueue | RemoteSubscriber) -> None:
        if isinstance(sink, RemoteSubscriber) and self.by_link.get(sink.link) is sink:
            del self.by_link[sink.link]
            if self.relayed is not None:
                self.relayed.subscriber_changed(self, sink)
        super().leave(sink)

    def resend_latched(self, sink: SubscriberQueue | RemoteSubscriber) -> None:
        super().resend_latched(sink)
        self._forward_latched(sink)

    def _forward_latched(self, sink: SubscriberQueue | RemoteSubscriber) -> None:
        """Send values latched on other links to a link with a new subscriber."""
        if self.relayed is None or not isinstance(sink, RemoteSubscriber):
            return
        for topic in self.relayed.topics.values():
            for sample in topic.latched_values():
                route = self.relayed.route(sample.source.link, sink.link_name)
                if route is not None and route.subscriber is sink:
                    for blocked in self._forward(route, sample, self._monotonic(), None) or ():
                        blocked.offer_latched(sample)


class RelayedTopic:
    """A topic of the robot, on all links. `topics` has it by its names, which differ where there is a prefix.

    Its routes lead from links on which it has been published to those on which it has been subscribed; they stay for
    their counters. `published_on` and `subscribed_on` are the ports where that is so now. While a route is `holding`
    messages, its source counts as one where the topic is published, even if the publisher has gone meanwhile. `review`
    looks at that anew.
    """

    def __init__(self, review: Callable[[], object]) -> None:
        self._review = review
        self.holding: dict[Route, None] = {}
        self.topics: dict[str, BridgedTopic] = {}
        self.published_on: list[BridgePort] = []
        self.published_on_kinds: PortsByKind = []
        self.subscribed_on: list[BridgePort] = []
        self.subscribed_on_kinds: PortsByKind = []
        self.sources: set[str] = set()
        """Links with routes to all of `targets`."""
        self.targets: set[str] = set()
        self._from: dict[str, dict[str, Route]] = {}
        """Routes by the names of their source and of their target."""
        self._into: dict[str, dict[str, Route]] = {}
        """Routes by the names of their target and of their source."""

    def set_demand(self, published_on: list[BridgePort], subscribed_on: list[BridgePort]) -> None:
        """Enter the links where the topic is published and subscribed now."""
        self.published_on, self.published_on_kinds = published_on, by_kind(published_on)
        self.subscribed_on, self.subscribed_on_kinds = subscribed_on, by_kind(subscribed_on)

    @property
    def routes(self) -> Iterator[tuple[tuple[str, str], Route]]:
        """All routes, each with the names of its two links."""
        return (((source, target), route) for source, routes in self._from.items() for target, route in routes.items())

    def route(self, source: str, target: str) -> Route | None:
        """Return the route from one link to another, if there is one."""
        return self._from.get(source, {}).get(target)

    def active_from(self, source: str, now: int) -> list[Route]:
        """Return the routes that messages from a link take now, or may soon take."""
        routes = self._from.get(source, {}).values()
        return [route for route in routes if route.subscriber is not None or now < route.ready_by]

    def add(self, source: str, route: Route) -> None:
        """Add a route; no message takes it before `changed` is called."""
        route.subscriber = route.target.by_link.get(route.port.link)
        self._from.setdefault(source, {})[route.port.name] = route
        self._into.setdefault(route.port.name, {})[source] = route

    def routes_added(self, published_on: list[BridgePort], subscribed_on: list[BridgePort]) -> None:
        """Note that the routes from all of the first to all of the second are there."""
        self.sources = {port.name for port in published_on}
        self.targets = {port.name for port in subscribed_on}

    def keep(self, links: set[str]) -> None:
        """Remove the routes from and to all other links."""
        for link in (self._from.keys() | self._into.keys()) - links:
            self.remove(link)
        self.sources &= links
        self.targets &= links

    def remove(self, link: str) -> None:
        """Remove the routes from and to a link."""
        self.sources.discard(link)
        self.targets.discard(link)
        onward, inward = self._from.pop(link, {}), self._into.pop(link, {})
        for target in onward:
            del self._into[target][link]
        for source in inward:
            del self._from[source][link]
        if onward or inward:
            self.changed()

    def changed(self) -> None:
        """Let the next message ask `active_from` anew, as routes or their subscribers have changed."""
        for topic in self.topics.values():
            topic.active_routes = {}

    def subscriber_changed(self, topic: BridgedTopic, subscriber: RemoteSubscriber) -> None:
        """Follow a link that joined the topic or left it."""
        now = topic.by_link.get(subscriber.link)
        for route in self._into.get(subscriber.link_name, {}).values():
            if route.target is topic and route.port.link is subscriber.link:
                route.subscriber = now
                route.ready_by = LONG_AGO
        self.changed()

    def release_held(self, topic: BridgedTopic, subscriber: RemoteSubscriber) -> None:
        """Forward what waited for a link that has joined the topic, but for values that it will get as latched ones."""
        if not self.holding:
            return
        latched = [sample for each in self.topics.values() for sample in each.latched_values()]
        for route in list(self.holding):
            if route.target is topic and route.port.link is subscriber.link and route.held is not None:
                route.subscriber = subscriber  # also where the source is gone, and the route with it
                held, route.held = route.held, None
                held.release(route.port.link.stats.lost.internal_error, but=latched)
                self._held_no_more(route)

    def give_up(self, route: Route, held: HeldMessages) -> None:
        """Drop what waited in vain."""
        if route.held is held:
            route.held = None
            there = route.source.link.up  # else its counters are gone with it
            (route.source if there else route.port).dropped[_NOT_SUBSCRIBED] += len(held)
            self._held_no_more(route)

    def _held_no_more(self, route: Route) -> None:
        del self.holding[route]
        asyncio.get_running_loop().call_soon(self._review)  # its publisher may have gone meanwhile


def _offer(route: Route, subscriber: RemoteSubscriber, sample: Sample, blocked: list[Sink] | None) -> list[Sink] | None:
    """Send a message; return the sinks without room, and this sink if its publisher has to wait for it."""
    route.forwarded += 1
    # `Sink.offer_in_order`, inlined as in `Topic._send`: each message that a gateway forwards passes here.
    waiting = subscriber.wait_queue
    in_line = (waiting.real_time or waiting.non_real_time) and waiting.line_of(sample)
    if not in_line and subscriber.offer(sample):
        return blocked
    if not subscriber.blocks_publishers and sample.publisher_class == PublisherClass.NON_REAL_TIME:
        subscriber.force(sample)  # it had no room for long: one slow link must not hold up all the others
        return blocked
    return [subscriber] if blocked is None else [*blocked, subscriber]


def _offer_shaped(
    route: Route, subscriber: RemoteSubscriber, shaped: Sample | None, sample: Sample, blocked: list[Sink] | None
) -> list[Sink] | None:
    if shaped is sample:
        return _offer(route, subscriber, sample, blocked)
    if shaped is None:
        route.dropped["rate limit"] += 1
        return blocked
    for sink in _offer(route, subscriber, shaped, None) or ():
        sink.force(shaped)  # it must not wait: the link would offer the message that came in, not the one shaped here
    return blocked
