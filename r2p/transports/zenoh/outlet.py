"""One topic on its way out by zenoh: no further than its subscribers have room for (r2p.protocols.flow)."""

from collections import Counter
from typing import TYPE_CHECKING

from r2p.codecs.attachment import Header, Origin, encode, encoder
from r2p.codecs.management import ANY_TYPE
from r2p.room import LINK_DOWN, Room
from r2p.sample import PublisherClass, Sample, Source
from r2p.topic import Topic
from r2p.transports.outlet import LinkOutlet

if TYPE_CHECKING:
    from collections.abc import Callable

    from r2p.protocols.flow import Outflow
    from r2p.transports.zenoh.link import ZenohLink

_NRT = PublisherClass.NON_REAL_TIME


class _Lane:
    """The way of one class: what zenoh sends with, and the headers of the publisher that sent last."""

    __slots__ = ("encode", "flow", "put", "source")

    def __init__(self, flow: "Outflow") -> None:
        self.flow = flow
        self.put: Callable[..., None] = _nowhere
        self.source: Source | None = None
        self.encode: Callable[[int, int, int, int], bytes] = _nothing


class ZenohOutlet(LinkOutlet):
    """One topic on its way out. Those who have no room are waited for as the class of the publisher says."""

    __slots__ = ("_error", "_lanes", "_room", "_stats", "_zenoh", "tries", "welcoming")

    def __init__(self, link: "ZenohLink", topic: Topic) -> None:
        super().__init__(link, topic)
        self._zenoh = link
        self._stats = link.stats
        self._error = link.send_error
        self._room = Room()
        self.tries: Counter[int] = Counter()
        """How often each subscriber was found to have heard nothing."""
        self._lanes = {each: _Lane(link.flow(topic.name, each)) for each in PublisherClass}
        self.welcoming = False
        """Somebody has just joined, and is sent what is latched, whoever else has room."""

    # As a sink

    def offer(self, sample: Sample) -> bool:
        lane = self._lanes[sample.publisher_class]
        flow = lane.flow
        serial = flow.serial + 1
        if serial > flow.limit or sample.source is not lane.source or not self._link.up:
            return self._offer_odd(lane, sample)
        flow.serial = serial
        stats, data = self._stats, sample.data
        try:  # zenoh sends it, or drops it where the network is too slow
            lane.put(data, attachment=lane.encode(serial, sample.sequence, sample.stamp, sample.deadline))
        except self._error:
            stats.lost[LINK_DOWN] += 1
            return True
        stats.sent += 1
        stats.bytes_sent += len(data)
        return True

    def _offer_odd(self, lane: _Lane, sample: Sample) -> bool:
        """No room, no link, another publisher than before, or something that comes from another link."""
        flow = lane.flow
        if not self._link.up:
            if sample.publisher_class != _NRT:
                return False
            self._lose(LINK_DOWN)
            return True
        if flow.serial >= flow.limit and not self.welcoming:
            return False
        origin = self._prepare(lane, sample)
        flow.serial += 1
        try:
            lane.put(sample.data, attachment=_header(origin, flow.serial, sample))
        except self._error:
            self._stats.lost[LINK_DOWN] += 1
            return True
        self._stats.sent += 1
        self._stats.bytes_sent += len(sample.data)
        return True

    def force(self, sample: Sample) -> None:
        if not self._link.up:
            self._lose(LINK_DOWN)
        elif not self.offer(sample):
            self._lose("no credit")

    def _lose(self, reason: str) -> None:
        self.lost += 1
        self._link.stats.lost[reason] += 1

    def room(self) -> Room:
        return self._room

    def refill(self) -> None:
        self._room.serve()
        self._room.recover()

    def give_up(self, refusal: str) -> None:
        """Go on without those who have no room; the others are waited for as before."""
        self._lanes[_NRT].flow.give_up()
        self._room.refuse(self, refusal)

    # For the link

    def knows(self, session: int) -> bool:
        """Whether a subscriber has joined."""
        return session in self._lanes[_NRT].flow.takers

    def joined(self, session: int, window: int) -> None:
        """A subscriber, or its new window."""
        for publisher_class, lane in self._lanes.items():
            lane.flow.joined(session, window if publisher_class == _NRT else 0)
        self.refill()

    def welcome(self) -> None:
        """Send what is latched, whoever has room."""
        self.welcoming = True
        self.topic.welcome(self)
        self.welcoming = False

    def parted(self, session: int) -> None:
        for lane in self._lanes.values():
            lane.flow.parted(session)
        self.refill()

    def credited(self, session: int, publisher_class: PublisherClass, serial: int) -> None:
        """A subscriber has taken everything up to this serial."""
        self._lanes[publisher_class].flow.credited(session, serial)
        self.refill()

    def unheard(self) -> set[int]:
        """Those to whom something was sent, and who never said that it came."""
        heard = {number for lane in self._lanes.values() for number, taker in lane.flow.takers.items() if taker.heard}
        return {number for lane in self._lanes.values() for number in lane.flow.unheard()} - heard

    def _prepare(self, lane: _Lane, sample: Sample) -> Origin:
        """The origin of a sample; the next ones of the same publisher, if it is one of our own, go the short way."""
        publisher = self._zenoh.publisher(self.topic.name, sample.publisher_class)
        lane.put = _nowhere if publisher is None else publisher.put
        layout, instance, source = self.topic.layout, self._zenoh.instance, sample.source
        origin = Origin(
            sample.publisher_class,
            instance,
            self._zenoh.instance_of(source.module) if source.link else instance,
            ANY_TYPE if layout is None else layout.fingerprint,
            source.module,
            source.node,
        )
        if not source.link:
            lane.encode = encoder(origin)
            lane.source = source
        return origin


def _nowhere(data: bytes, *, attachment: bytes) -> None:
    """There is no session."""


def _nothing(serial: int, sequence: int, stamp: int, deadline: int) -> bytes:
    """The header of nobody."""
    return b""


def _header(origin: Origin, serial: int, sample: Sample) -> bytes:
    """The header of anything; what comes from another link has crossed a gateway more."""
    hops = sample.hops + bool(sample.source.link)
    return encode(
        Header(origin, serial, sample.sequence, sample.stamp, sample.deadline, hops, sample.stamped, sample.clock)
    )
