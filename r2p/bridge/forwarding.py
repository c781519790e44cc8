"""A topic of a gateway: what comes in by one link goes out by those others where somebody wants it.

`ways` are worked out when something changes (`Relays`), and which of them messages of a link take when the first one
comes after that: so forwarding is one loop over what is there, and a change costs as much as the ways that it concerns.
Each message asks the clock whether its two ports may still forward: a gateway that was stopped must not go on with an
old tree.
"""

import functools
from collections import Counter, deque
from collections.abc import Callable, Hashable, Iterator, Sequence
from typing import Any, cast

import msgspec

from r2p.bridge.options import ClassOf
from r2p.bridge.port import BridgePort
from r2p.protocols.time_left import TimesLeft
from r2p.runtime.backpressure import Sink
from r2p.runtime.publishers import PeriodicPublisher
from r2p.runtime.sample import PublisherClass, Sample
from r2p.runtime.topic import LastReceived, RemoteSubscriber, SubscriberQueue, Topic, WakeScheduler

# Second line of defence: messages that say who published them are recognised when they come again.


_KEPT = 64  # of each publisher
_PUBLISHERS = 1024


class DuplicateFilter:
    """The last messages of each publisher of a topic. One that comes again has the same number and the same stamp."""

    def __init__(self) -> None:
        self._stamps: dict[tuple[str, str], list[int]] = {}

    def again(self, sample: Sample) -> bool:
        """Whether it has been here; from now on it has."""
        source = sample.source
        key = (source.module, source.node)
        stamps = self._stamps.get(key)
        if stamps is None:
            if len(self._stamps) >= _PUBLISHERS:
                self._stamps.clear()
            stamps = self._stamps[key] = [0] * _KEPT
        place = sample.sequence % _KEPT
        if stamps[place] == sample.stamp:
            return True
        stamps[place] = sample.stamp
        return False


# What a gateway changes in messages on their way, or holds back: rates, and classes that the next link can't keep.


_SECOND = 1_000_000_000
_UNKNOWN_PERIOD = _SECOND // 20
_LONGEST_PERIOD = 10 * _SECOND
_SURE = 8  # intervals
Learnt = Callable[[int, float], None]


class Shaper:
    """The changes on one way.

    `rate`: messages a second at most, in bursts of two. `klass`: what a debug line can't say. `soften`: periodic
    messages become sporadic ones that are due within their period, as the next link has no slots for them. `learnt` is
    called with size (bytes) and period (s) when those of a publisher are known, and again when it comes back with
    another size; it may set `reserved`, which takes the messages then.
    """

    def __init__(
        self, *, rate: float | None, klass: ClassOf | None, soften: bool, learnt: "Learnt | None" = None
    ) -> None:
        self.reserved: RelayedPeriodic | None = None
        self._learnt = learnt
        self._gap = None if rate is None else round(_SECOND / rate)
        self._class = klass
        self._soften = soften
        self._free_at = 0
        self._periods: dict[tuple[str, str], _RateWindow] = {}
        self._times_left = TimesLeft()

    @classmethod
    def of(
        cls, *, rate: float | None, klass: ClassOf | None, soften: bool, learnt: "Learnt | None" = None
    ) -> "Shaper | None":
        """None where there is nothing to change."""
        return cls(rate=rate, klass=klass, soften=soften, learnt=learnt) if rate or klass or soften else None

    def shape(self, sample: Sample, now: int, utc: int) -> Sample | None:
        """The message to forward at `now` (monotonic ns; the same in UTC); None: it is one too many."""
        if self._gap is not None:
            if now < self._free_at:
                return None
            self._free_at = max(self._free_at, now - self._gap) + self._gap
        if self._class is not None and not sample.deadline:
            sample = _classed(sample, self._class)
        if self._soften and sample.publisher_class is PublisherClass.PERIODIC:
            return self._softened(sample, now, utc)
        return sample

    def _softened(self, sample: Sample, now: int, utc: int) -> Sample:
        period, deadline, expires = self._period(sample), sample.deadline, sample.expires
        if not deadline:
            deadline = sample.stamp + period
            source = sample.source
            expires = utc + self._times_left.of((source.module, source.node)).left(now, sample.stamp, deadline)
        sporadic = PublisherClass.SPORADIC
        return msgspec.structs.replace(
            sample, publisher_class=sporadic, deadline=deadline, expires=expires, drop_late=False
        )

    def _period(self, sample: Sample) -> int:
        """The publisher's period, as its stamps show it."""
        source = sample.source
        known = self._periods.get((source.module, source.node))
        if known is None:
            if len(self._periods) >= TimesLeft.MOST:
                self._periods.clear()
            self._periods[source.module, source.node] = _RateWindow(sample.stamp, len(sample.data))
            return _UNKNOWN_PERIOD
        since = sample.stamp - known.stamp
        known.stamp = sample.stamp
        if since >= _LONGEST_PERIOD or len(sample.data) != known.size:
            known.size, known.period, known.count = len(sample.data), 0, 0
        elif since > 0:
            known.count += 1
            known.period = since if not known.period else min(since, known.period + known.period // 8)
            if known.count == _SURE and self._learnt is not None:
                self._learnt(known.size, known.period / _SECOND)
        return known.period or _UNKNOWN_PERIOD


class _RateWindow(msgspec.Struct):
    """The last stamp of a publisher, the size of its messages, and its period as far as known (ns)."""

    stamp: int
    size: int
    period: int = 0
    count: int = 0


def _classed(sample: Sample, klass: ClassOf) -> Sample:
    deadline = sample.stamp + round(klass.time * _SECOND) if klass.time else 0
    return msgspec.structs.replace(sample, publisher_class=klass.publisher_class, deadline=deadline, drop_late=False)


# What a gateway keeps while it listens anew because its event loop stood still.


MOST = 4096
"""Messages that are kept at most."""


class HeldMessages:
    """Messages, and how to go on with each."""

    def __init__(self) -> None:
        self._waiting: deque[tuple[Sample, Callable[[], list[Sink] | None]]] = deque()

    def __bool__(self) -> bool:
        return bool(self._waiting)

    def keep(self, sample: Sample, go_on: Callable[[], list[Sink] | None]) -> bool:
        """Keep a message; False if it can't be kept. `go_on` gives back the sinks that have no room for it."""
        if sample.publisher_class != PublisherClass.NON_REAL_TIME or len(self._waiting) >= MOST:
            return False
        self._waiting.append((sample, go_on))
        return True

    def release(self, failed: Callable[[Exception], object]) -> None:
        """Go on with all of them; `failed` is called with what one of them raises."""
        waiting, self._waiting = self._waiting, deque()
        for sample, go_on in waiting:
            try:
                for sink in go_on() or ():
                    sink.force(sample)
            except Exception as error:  # noqa: BLE001 - counted and logged; the next one follows
                failed(error)


# forwarding


MOST_HOPS = 15
"""Gateways that a message crosses at most."""


class Route:
    """One topic from one link to another: `outlet` is there while somebody wants it there.

    `shaper` changes messages on this way, or drops some; None: they pass as they are.
    """

    __slots__ = ("dropped", "forwarded", "outlet", "port", "shaper", "target")

    def __init__(self, port: BridgePort, target: "BridgedTopic", shaper: Shaper | None) -> None:
        self.port = port
        self.target = target
        self.shaper = shaper
        self.outlet: RemoteSubscriber | None = None
        self.forwarded = 0
        self.dropped: Counter[str] = Counter()


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
        self.relay: Relay | None = None
        """Set while it is relayed."""
        self.open: dict[str, list[Route]] = {}
        """The ways that messages take now, by the name of the link that they come from, as far as any came since the
        last change. Replaced whole at a change, as a message may be on its way through one of the lists.
        """
        self.by_link: dict[object, RemoteSubscriber] = {}
        """The outlets, by their links."""
        self.reserved: RelayedPeriodic | None = None
        """Set where a bus is to send it in slots of its own."""
        self._ports = ports
        self._monotonic = monotonic
        self._seen = DuplicateFilter()
        self._held = held

    @property
    def slot_publishers(self) -> Sequence[object]:
        return self.publishers if self.reserved is None else [*self.publishers, self.reserved]

    @property
    def wanted(self) -> bool:
        return self.relay is not None or bool(self.queues)

    @property
    def in_use(self) -> bool:
        return self.relay is not None or super().in_use

    def last_received(self, publisher: Hashable) -> LastReceived:
        """Shares nothing: a message dropped because its link is silent now was never here (`DuplicateFilter`)."""
        return LastReceived()

    def deliver(self, sample: Sample, own: object = None, slot_link: object = None) -> list[Sink] | None:
        link = sample.source.link
        if not link:
            return super().deliver(sample, own, slot_link)
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

    def replay(self, sample: Sample, outlet: RemoteSubscriber) -> None:
        """Send the last message to a subscriber that has joined later, if it comes from another link."""
        way = None if self.relay is None else self.relay.way(sample.source.link, outlet.link_name)
        if way is not None and way.outlet is outlet:
            for sink in self._forward(way, sample, self._monotonic(), None) or ():
                sink.offer_latched(sample)

    def join(self, sink: SubscriberQueue | RemoteSubscriber) -> None:
        if isinstance(sink, RemoteSubscriber):
            self.by_link[sink.link] = sink
            if self.relay is not None:
                self.relay.outlet_changed(self, sink)
        super().join(sink)
        if self.relay is not None and isinstance(sink, RemoteSubscriber):
            self.relay.offer_latched(sink)

    def leave(self, sink: SubscriberQueue | RemoteSubscriber) -> None:
        if isinstance(sink, RemoteSubscriber) and self.by_link.get(sink.link) is sink:
            del self.by_link[sink.link]
            if self.relay is not None:
                self.relay.outlet_changed(self, sink)
        super().leave(sink)

    def resend_latched(self, sink: SubscriberQueue | RemoteSubscriber) -> None:
        super().resend_latched(sink)
        if self.relay is not None and isinstance(sink, RemoteSubscriber):
            self.relay.offer_latched(sink)

    def _forward(self, way: Route, sample: Sample, now: int, blocked: list[Sink] | None) -> list[Sink] | None:
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

    def _go_on(self, way: Route, sample: Sample) -> list[Sink] | None:
        return None if way.outlet is None else self._forward(way, sample, self._monotonic(), None)

    def _send(self, sample: Sample, blocked: list[Sink] | None, slot_link: object) -> list[Sink] | None:
        """What is published here goes where we forward, and nowhere else: elsewhere another gateway brings it."""
        now = self._monotonic()
        silent = [each for each in self.remote_subscribers if now >= self._ports[each.link_name].place.until]
        if not silent:
            return super()._send(sample, blocked, slot_link)
        for outlet in silent:
            port = self._ports[outlet.link_name]
            if not (port.resumes and self._held.keep(sample, functools.partial(self._send_held, outlet, sample))):
                outlet.lost += 1
                port.lose("converging")
        outlets, self.remote_subscribers = (
            self.remote_subscribers,
            [each for each in self.remote_subscribers if each not in silent],
        )
        try:
            return super()._send(sample, blocked, slot_link)
        finally:
            self.remote_subscribers = outlets

    def _send_held(self, outlet: RemoteSubscriber, sample: Sample) -> list[Sink] | None:
        port = self._ports.get(outlet.link_name)
        if port is None or self._monotonic() >= port.place.until:
            outlet.lost += 1
            if port is not None:
                port.lose("converging")
            return None
        return None if not outlet.wait_queue().queue_of(sample) and outlet.offer(sample) else [outlet]


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
        self._from: dict[str, dict[str, Route]] = {}
        """Ways by the name of the link that they come from, and that of the link that they go to."""
        self._into: dict[str, dict[str, Route]] = {}
        """The other way round."""

    @property
    def ways(self) -> Iterator[tuple[tuple[str, str], Route]]:
        """All ways, each with the names of its two links."""
        return (((source, target), way) for source, ways in self._from.items() for target, way in ways.items())

    def way(self, source: str, target: str) -> Route | None:
        """The way from one link to another, if there is one."""
        return self._from.get(source, {}).get(target)

    def add(self, source: str, way: Route) -> None:
        """There is one more way; it is not `open` before `changed` is called."""
        way.outlet = way.target.by_link.get(way.port.link)
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

    def outlet_changed(self, topic: BridgedTopic, outlet: RemoteSubscriber) -> None:
        """A link joined or left."""
        now = topic.by_link.get(outlet.link)
        for way in self._into.get(outlet.link_name, {}).values():
            if way.target is topic and way.port.link is outlet.link:
                way.outlet = now
        self.changed()

    def route(self, source: str) -> list[Route]:
        """The ways that messages from a link take now."""
        return [way for way in self._from.get(source, {}).values() if way.outlet is not None]

    def offer_latched(self, outlet: RemoteSubscriber) -> None:
        """Send what publishers latch to a subscriber that has joined."""
        for topic in self.topics.values():
            for memory in topic.latched_sources:
                memory.offer_latched(topic, cast("SubscriberQueue", _LatchedReplay(topic, outlet)))


class _LatchedReplay:
    """Stands for the queue of a new subscriber where a link is asked for the last message."""

    def __init__(self, topic: BridgedTopic, outlet: RemoteSubscriber) -> None:
        self._topic = topic
        self._outlet = outlet

    def offer_latched(self, sample: Sample) -> None:
        self._topic.replay(sample, self._outlet)


def _put(way: Route, sample: Sample, blocked: list[Sink] | None) -> list[Sink] | None:
    outlet = cast("RemoteSubscriber", way.outlet)
    way.forwarded += 1
    if not outlet.wait_queue().queue_of(sample) and outlet.offer(sample):
        return blocked
    if not outlet.waits and sample.publisher_class == PublisherClass.NON_REAL_TIME:
        outlet.force(sample)
        return blocked
    return [outlet] if blocked is None else [*blocked, outlet]


def _put_shaped(way: Route, shaped: Sample | None, sample: Sample, blocked: list[Sink] | None) -> list[Sink] | None:
    if shaped is sample:
        return _put(way, sample, blocked)
    if shaped is None:
        way.dropped["rate limit"] += 1
        return blocked
    for sink in _put(way, shaped, None) or ():
        sink.force(shaped)  # who is given back to the link waits for the message that came in
    return blocked


# A periodic topic of another link that is sent in slots of its own on an RTCAN bus.


class RelayedPeriodic(PeriodicPublisher[Any]):
    """Stands for the publisher, which is elsewhere: messages of `size` bytes each `period` seconds."""

    publisher_class = PublisherClass.PERIODIC
    lead = 0.0005

    def __init__(self, topic: str, size: int, period: float) -> None:
        # Not its base's: there is no node behind it, no clock, and nobody to signal to.
        self.topic = topic
        self.period = period
        self.latch = False
        self.missed = 0
        self._size = size
        self._latest: Sample | None = None
        self._by: object = None

    @property
    def size(self) -> int:
        return self._size

    def take(self, sample: Sample) -> bool:
        """A message came; False if the bus does not send it in slots now, and it has to go another way.

        So it has to if it has another size: the slots are for messages of one size.
        """
        if self._by is None or len(sample.data) != self._size:
            return False
        self.missed += self._latest is not None
        self._latest = sample
        return True

    def use_slot_clock(self, slot_link: object, period: float) -> bool:
        if self._by not in (None, slot_link):
            return False
        self._by = slot_link
        self.period = period
        return True

    def use_own_clock(self, slot_link: object) -> None:
        if self._by is slot_link:
            self._by = self._latest = None

    def tick(self, scheduled: int, late: int, skipped: int) -> Sample | None:
        """What came since the last slot."""
        latest, self._latest = self._latest, None
        return latest

    def link_degraded(self, link: str, reason: str) -> None:
        """The slots are lost: messages go as events, which the link's notices tell."""

    def link_missed(self, link: str, reason: str, late: float = 0.0, sequence: int = 0) -> None:
        self.missed += 1

    def link_late(self, link: str, reason: str, late: float = 0.0) -> None:
        """It was sent in its slot, or not at all."""
