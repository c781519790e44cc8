"""A topic of a gateway: what comes in by one link goes out by those others where somebody wants it.

`ways` are worked out when something changes (`Relays`), and which of them messages of a link take when the first one
comes after that: so forwarding is one loop over what is there, and a change costs as much as the ways that it concerns.
Each message asks the clock whether its two ports may still forward: a gateway that was stopped must not go on with an
old tree.
"""

import functools
from collections import Counter
from collections.abc import Callable, Hashable, Iterator, Sequence
from typing import TYPE_CHECKING, cast

from r2p.bridge.held import Held
from r2p.bridge.port import BridgePort
from r2p.bridge.seen import Seen
from r2p.bridge.shaping import Shaper
from r2p.room import Sink
from r2p.sample import PublisherClass, Sample
from r2p.topic import Heard, Outlet, QueueSink, Topic, Waker

if TYPE_CHECKING:
    from r2p.bridge.reserving import RelayedPeriodic

MOST_HOPS = 15
"""Gateways that a message crosses at most."""


class Way:
    """One topic from one link to another: `outlet` is there while somebody wants it there.

    `shaper` changes messages on this way, or drops some; None: they pass as they are.
    """

    __slots__ = ("dropped", "forwarded", "outlet", "port", "shaper", "target")

    def __init__(self, port: BridgePort, target: "BridgedTopic", shaper: Shaper | None) -> None:
        self.port = port
        self.target = target
        self.shaper = shaper
        self.outlet: Outlet | None = None
        self.forwarded = 0
        self.dropped: Counter[str] = Counter()


class BridgedTopic(Topic):
    """A topic of a module that is a gateway."""

    def __init__(
        self, name: str, waker: Waker, ports: dict[str, BridgePort], monotonic: Callable[[], int], held: Held
    ) -> None:
        super().__init__(name, waker)
        self.relay: Relay | None = None
        """Set while it is relayed."""
        self.open: dict[str, list[Way]] = {}
        """The ways that messages take now, by the name of the link that they come from, as far as any came since the
        last change. Replaced whole at a change, as a message may be on its way through one of the lists.
        """
        self.by_carrier: dict[object, Outlet] = {}
        """The outlets, by their links."""
        self.reserved: RelayedPeriodic | None = None
        """Set where a bus is to send it in slots of its own."""
        self._ports = ports
        self._monotonic = monotonic
        self._seen = Seen()
        self._held = held

    @property
    def slotted(self) -> Sequence[object]:
        return self.publishers if self.reserved is None else [*self.publishers, self.reserved]

    @property
    def wanted(self) -> bool:
        return self.relay is not None or bool(self.queues)

    @property
    def in_use(self) -> bool:
        return self.relay is not None or super().in_use

    def heard(self, publisher: Hashable) -> Heard:
        """Nothing is shared: a message that is dropped as its link is silent now has not been here (`Seen`)."""
        return Heard()

    def deliver(self, sample: Sample, own: object = None, driver: object = None) -> list[Sink] | None:
        link = sample.source.link
        if not link:
            return super().deliver(sample, own, driver)
        now = self._monotonic()
        port = self._ports[link]
        if now >= port.place.until:
            if not (port.resumes and self._held.keep(sample, functools.partial(self.deliver, sample))):
                port.lose("converging")
            return None
        if sample.sequence and self._seen.again(sample) and not port.link.latched(self.name):
            port.lose("seen before")
            return None
        ways = self.open.get(link)
        if not ways:
            if ways is None:
                ways = self.open[link] = [] if self.relay is None else self.relay.route(link)
            if not ways and not self.queues:  # not yet, or not any more, as its publisher will soon know
                port.dropped["not subscribed"] += 1
                return None
        blocked = super().deliver(sample) if self.queues else None
        for way in ways:
            blocked = self._forward(way, sample, now, blocked)
        return blocked

    def replay(self, sample: Sample, outlet: Outlet) -> None:
        """Send the last message to a subscriber that has joined later, if it comes from another link."""
        way = None if self.relay is None else self.relay.way(sample.source.link, outlet.link)
        if way is not None and way.outlet is outlet:
            for sink in self._forward(way, sample, self._monotonic(), None) or ():
                sink.remind(sample)

    def join(self, sink: QueueSink | Outlet) -> None:
        if isinstance(sink, Outlet):
            self.by_carrier[sink.carrier] = sink
            if self.relay is not None:
                self.relay.outlet_changed(self, sink)
        super().join(sink)
        if self.relay is not None and isinstance(sink, Outlet):
            self.relay.remind(sink)

    def leave(self, sink: QueueSink | Outlet) -> None:
        if isinstance(sink, Outlet) and self.by_carrier.get(sink.carrier) is sink:
            del self.by_carrier[sink.carrier]
            if self.relay is not None:
                self.relay.outlet_changed(self, sink)
        super().leave(sink)

    def welcome(self, sink: QueueSink | Outlet) -> None:
        super().welcome(sink)
        if self.relay is not None and isinstance(sink, Outlet):
            self.relay.remind(sink)

    def _forward(self, way: Way, sample: Sample, now: int, blocked: list[Sink] | None) -> list[Sink] | None:
        if now >= way.port.place.until:
            if not (way.port.resumes and self._held.keep(sample, functools.partial(self._go_on, way, sample))):
                way.dropped["converging"] += 1
                way.port.link.stats.lost["converging"] += 1
            return blocked
        if way.shaper is None and not sample.deadline and sample.hops < MOST_HOPS:
            return _put(way, sample, blocked)
        if sample.hops >= MOST_HOPS:
            way.dropped["too many hops"] += 1
        elif sample.deadline and sample.drop_late and way.port.now() > (sample.expires or sample.deadline):
            way.dropped["late"] += 1
        elif way.shaper is None:
            return _put(way, sample, blocked)
        elif way.shaper.reserved is not None and way.shaper.reserved.take(sample):
            way.forwarded += 1
        else:
            return _put_shaped(way, way.shaper.shape(sample, now, way.port.now()), sample, blocked)
        return blocked

    def _go_on(self, way: Way, sample: Sample) -> list[Sink] | None:
        return None if way.outlet is None else self._forward(way, sample, self._monotonic(), None)

    def _send(self, sample: Sample, blocked: list[Sink] | None, driver: object) -> list[Sink] | None:
        """What is published here goes where we forward, and nowhere else: elsewhere another gateway brings it."""
        now = self._monotonic()
        silent = [each for each in self.outlets if now >= self._ports[each.link].place.until]
        if not silent:
            return super()._send(sample, blocked, driver)
        for outlet in silent:
            port = self._ports[outlet.link]
            if not (port.resumes and self._held.keep(sample, functools.partial(self._send_held, outlet, sample))):
                outlet.lost += 1
                port.lose("converging")
        outlets, self.outlets = self.outlets, [each for each in self.outlets if each not in silent]
        try:
            return super()._send(sample, blocked, driver)
        finally:
            self.outlets = outlets

    def _send_held(self, outlet: Outlet, sample: Sample) -> list[Sink] | None:
        port = self._ports.get(outlet.link)
        if port is None or self._monotonic() >= port.place.until:
            outlet.lost += 1
            if port is not None:
                port.lose("converging")
            return None
        return None if not outlet.room().line(sample) and outlet.offer(sample) else [outlet]


class Relay:
    """A topic of the robot, on all links: `topics` by name, one unless it is called otherwise on some links.

    Its ways lead from links that have offered it to those that have wanted it; they stay for their counters. `offering`
    and `wanting` are the ports where that is so now.
    """

    def __init__(self) -> None:
        self.topics: dict[str, BridgedTopic] = {}
        self.offering: list[BridgePort] = []
        self.wanting: list[BridgePort] = []
        self.sources: set[str] = set()
        """The links whose ways to all of `targets` are worked out."""
        self.targets: set[str] = set()
        self._from: dict[str, dict[str, Way]] = {}
        """Ways by the name of the link that they come from, and that of the link that they go to."""
        self._into: dict[str, dict[str, Way]] = {}
        """The other way round."""

    @property
    def ways(self) -> Iterator[tuple[tuple[str, str], Way]]:
        """All ways, each with the names of its two links."""
        return (((source, target), way) for source, ways in self._from.items() for target, way in ways.items())

    def way(self, source: str, target: str) -> Way | None:
        """The way from one link to another, if there is one."""
        return self._from.get(source, {}).get(target)

    def add(self, source: str, way: Way) -> None:
        """There is one more way; it is not `open` before `changed` is called."""
        way.outlet = way.target.by_carrier.get(way.port.link)
        self._from.setdefault(source, {})[way.port.name] = way
        self._into.setdefault(way.port.name, {})[source] = way

    def keep(self, links: set[str]) -> None:
        """Forget the ways from and to other links."""
        for link in (self._from.keys() | self._into.keys()) - links:
            self.forget(link)
        self.sources &= links
        self.targets &= links

    def forget(self, link: str) -> None:
        """Forget the ways from and to a link."""
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
        """The ways, or who takes what they bring, have changed: `route` is asked anew by the next message."""
        for topic in self.topics.values():
            topic.open = {}

    def outlet_changed(self, topic: BridgedTopic, outlet: Outlet) -> None:
        """A link joined or left."""
        now = topic.by_carrier.get(outlet.carrier)
        for way in self._into.get(outlet.link, {}).values():
            if way.target is topic and way.port.link is outlet.carrier:
                way.outlet = now
        self.changed()

    def route(self, source: str) -> list[Way]:
        """The ways that messages from a link take now."""
        return [way for way in self._from.get(source, {}).values() if way.outlet is not None]

    def remind(self, outlet: Outlet) -> None:
        """Send what publishers latch to a subscriber that has joined."""
        for topic in self.topics.values():
            for memory in topic.memories:
                memory.remind(topic, cast("QueueSink", _Reminder(topic, outlet)))


class _Reminder:
    """Stands for the queue of a new subscriber where a link is asked for the last message."""

    def __init__(self, topic: BridgedTopic, outlet: Outlet) -> None:
        self._topic = topic
        self._outlet = outlet

    def remind(self, sample: Sample) -> None:
        self._topic.replay(sample, self._outlet)


def _put(way: Way, sample: Sample, blocked: list[Sink] | None) -> list[Sink] | None:
    outlet = cast("Outlet", way.outlet)
    way.forwarded += 1
    if not outlet.room().line(sample) and outlet.offer(sample):
        return blocked
    if not outlet.patient and sample.publisher_class == PublisherClass.NON_REAL_TIME:
        outlet.force(sample)
        return blocked
    return [outlet] if blocked is None else [*blocked, outlet]


def _put_shaped(way: Way, shaped: Sample | None, sample: Sample, blocked: list[Sink] | None) -> list[Sink] | None:
    if shaped is sample:
        return _put(way, sample, blocked)
    if shaped is None:
        way.dropped["rate limit"] += 1
        return blocked
    for sink in _put(way, shaped, None) or ():
        sink.force(shaped)  # who is given back to the link waits for the message that came in
    return blocked
