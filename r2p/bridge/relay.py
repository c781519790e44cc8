"""A topic of a gateway: what comes in by one link goes out by those others where somebody wants it.

`ways` is worked out when something changes (`Relays`), so that forwarding is one loop over what is there. Each message
asks the clock whether its two ports may still forward: a gateway that was stopped must not go on with an old tree.
"""

import functools
from collections import Counter
from collections.abc import Callable, Hashable, Sequence
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
        """The ways that messages take now, by the name of the link that they come from."""
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
        if ways is None and not self.queues:  # not yet, or not any more, as its publisher will soon know
            port.dropped["not subscribed"] += 1
            return None
        blocked = super().deliver(sample) if self.queues else None
        for way in ways or ():
            blocked = self._forward(way, sample, now, blocked)
        return blocked

    def replay(self, sample: Sample, outlet: Outlet) -> None:
        """Send the last message to somebody who has joined later, if it comes from another link."""
        for way in self.open.get(sample.source.link, ()):
            if way.outlet is outlet:
                for sink in self._forward(way, sample, self._monotonic(), None) or ():
                    sink.remind(sample)

    def join(self, sink: QueueSink | Outlet) -> None:
        super().join(sink)
        self._joined(sink)

    def leave(self, sink: QueueSink | Outlet) -> None:
        super().leave(sink)
        if self.relay is not None:
            self.relay.route()

    def welcome(self, sink: QueueSink | Outlet) -> None:
        super().welcome(sink)
        self._joined(sink)

    def _joined(self, sink: QueueSink | Outlet) -> None:
        if self.relay is not None and isinstance(sink, Outlet):
            self.relay.route()
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

    `ways` are by the names of the two links, from those that have offered it to those that have wanted it; they stay
    for their counters. `offering` and `wanting` are the ports where that is so now.
    """

    def __init__(self) -> None:
        self.topics: dict[str, BridgedTopic] = {}
        self.ways: dict[tuple[str, str], Way] = {}
        self.offering: list[BridgePort] = []
        self.wanting: list[BridgePort] = []

    def keep(self, links: set[str]) -> None:
        """Forget the ways from and to other links."""
        for key in [key for key in self.ways if key[0] not in links or key[1] not in links]:
            del self.ways[key]

    def forget(self, link: str) -> bool:
        """Forget the ways from and to a link; says whether there were any."""
        keys = [key for key in self.ways if link in key]
        for key in keys:
            del self.ways[key]
        return bool(keys)

    def route(self) -> None:
        """Somebody joined or left, or the ways have changed."""
        outlets: dict[tuple[str, object], Outlet] = {}
        for topic in self.topics.values():
            topic.open = {}
            outlets |= {(topic.name, each.carrier): each for each in topic.outlets}
        for (source, _), way in self.ways.items():
            way.outlet = outlet = outlets.get((way.target.name, way.port.link))
            if outlet is None:
                continue
            for topic in self.topics.values():
                topic.open.setdefault(source, []).append(way)

    def remind(self, outlet: Outlet) -> None:
        """Send what publishers latch to somebody who has joined."""
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
