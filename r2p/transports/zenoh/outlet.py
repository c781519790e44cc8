"""One topic on its way out by zenoh: no further than its subscribers have room for (r2p.protocols.flow)."""

from collections import Counter
from typing import TYPE_CHECKING

from r2p.codecs.attachment import SERIAL_WRAP, START, Header, Origin, Packer, encode, start_of
from r2p.codecs.management import ANY_TYPE
from r2p.room import LINK_DOWN, Room
from r2p.sample import PublisherClass, Sample, Source
from r2p.topic import Topic
from r2p.transports.outlet import LinkOutlet
from r2p.transports.zenoh.burst import MOST, nowhere

if TYPE_CHECKING:
    from r2p.protocols.flow import Outflow
    from r2p.transports.zenoh.burst import Put
    from r2p.transports.zenoh.link import ZenohLink

_NRT = PublisherClass.NON_REAL_TIME
_NOBODY = Packer(Origin(_NRT, 0, 0, ANY_TYPE))


class _Lane:
    """The way of one class: what zenoh sends with, and the headers of the publisher that sent last.

    `own` is that publisher, if it is one of this module.
    """

    __slots__ = ("flow", "origin", "own", "pack", "put", "source", "tail")

    def __init__(self, flow: "Outflow") -> None:
        self.flow = flow
        self.put: Put = nowhere
        self.own: Source | None = None
        self.source: Source | None = None
        self.origin: Origin | None = None
        self.pack = _NOBODY.pack
        self.tail = _NOBODY.tail


class ZenohOutlet(LinkOutlet):
    """One topic on its way out. Those who have no room are waited for as the class of the publisher says."""

    __slots__ = ("_burst", "_lanes", "_room", "_zenoh", "tries", "welcoming")

    def __init__(self, link: "ZenohLink", topic: Topic) -> None:
        super().__init__(link, topic)
        self._zenoh = link
        self._burst = link.burst
        self._room = Room()
        self.tries: Counter[int] = Counter()
        """How often each subscriber was found to have heard nothing."""
        self._lanes = {each: _Lane(link.senders.flow(topic.name, each)) for each in PublisherClass}
        self.welcoming = False
        """Somebody has just joined, and is sent what is latched, whoever else has room."""

    # As a sink

    def offer(self, sample: Sample) -> bool:
        lane = self._lanes[sample.publisher_class]
        flow = lane.flow
        serial = flow.serial + 1
        if serial > flow.limit or sample.source is not lane.own or not self._link.up:
            return self._offer_odd(lane, sample)
        flow.serial = serial
        header = lane.pack(START, serial & SERIAL_WRAP, sample.sequence, sample.stamp, sample.deadline, lane.tail)
        burst = self._burst
        if burst.begun and len(burst.waiting) < MOST and sample.publisher_class is _NRT:
            burst.waiting.append((lane.put, sample.data, header))
        else:
            burst.add(lane.put, sample.data, header, urgent=sample.publisher_class is not _NRT)
        return True

    def _offer_odd(self, lane: _Lane, sample: Sample) -> bool:
        """No room, no link, another publisher than before, or something that comes from another link."""
        if not self._link.up:
            if sample.publisher_class != _NRT:
                return False
            self._lose(LINK_DOWN)
            return True
        if not self._has_room(lane.flow) and not self.welcoming:
            return False
        if sample.source is not lane.source:
            self._prepare(lane, sample)
        lane.flow.serial += 1
        header = _header(lane, sample)
        self._burst.add(lane.put, sample.data, header, urgent=sample.publisher_class is not _NRT)
        return True

    def _has_room(self, flow: "Outflow") -> bool:
        """Whether its subscribers have, as far as they have told."""
        if flow.serial < flow.limit:
            return True
        self._zenoh.credits.look()
        if flow.serial < flow.limit:
            return True
        self._zenoh.credits.expect()
        return False

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
        self._zenoh.credits.expect()
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
        """A subscriber has taken everything up to this serial; who waits for that is served by `refill`."""
        self._lanes[publisher_class].flow.credited(session, serial)

    @property
    def expects(self) -> bool:
        """Whether somebody waits for credit, or went on without a subscriber that may give it again."""
        return bool(self._room) or not all(each.waited_for for each in self._lanes[_NRT].flow.takers.values())

    def unheard(self) -> set[int]:
        """Those to whom something was sent, and who never said that it came."""
        heard = {number for lane in self._lanes.values() for number, taker in lane.flow.takers.items() if taker.heard}
        return {number for lane in self._lanes.values() for number in lane.flow.unheard()} - heard

    def _prepare(self, lane: _Lane, sample: Sample) -> None:
        """Another publisher: its next messages go the short way, if it is one of our own the very short one."""
        publisher = self._zenoh.senders.publisher(self.topic.name, sample.publisher_class)
        lane.put = nowhere if publisher is None else publisher.put
        layout, instance, source = self.topic.layout, self._zenoh.instance, sample.source
        lane.origin = Origin(
            sample.publisher_class,
            instance,
            self._zenoh.instance_of(source.module) if source.link else instance,
            ANY_TYPE if layout is None else layout.fingerprint,
            source.module,
            source.node,
        )
        packer = Packer(lane.origin)
        lane.pack, lane.tail = packer.pack, packer.tail
        lane.source = source
        lane.own = None if source.link else source


def _header(lane: _Lane, sample: Sample) -> bytes:
    """The header of anything; what comes from another link has crossed a gateway more."""
    serial, hops = lane.flow.serial, sample.hops + bool(sample.source.link)
    if sample.clock is None:
        start = start_of(hops, stamped=sample.stamped)
        return lane.pack(start, serial & SERIAL_WRAP, sample.sequence, sample.stamp, sample.deadline, lane.tail)
    assert lane.origin is not None  # it was prepared
    return encode(
        Header(lane.origin, serial, sample.sequence, sample.stamp, sample.deadline, hops, sample.stamped, sample.clock)
    )
