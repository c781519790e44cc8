"""One topic on its way out by zenoh: no further than its subscribers have room for (r2p.protocols.flow)."""

from collections import Counter
from typing import TYPE_CHECKING

from r2p.codecs.attachment import Origin
from r2p.codecs.management import ANY_TYPE
from r2p.room import LINK_DOWN, Room
from r2p.sample import PublisherClass, Sample
from r2p.topic import Topic
from r2p.transports.outlet import LinkOutlet
from r2p.transports.zenoh.lane import MOST, Lane

if TYPE_CHECKING:
    from r2p.protocols.flow import Outflow
    from r2p.transports.zenoh.link import ZenohLink

_NRT = PublisherClass.NON_REAL_TIME


class ZenohOutlet(LinkOutlet):
    """One topic on its way out. Those who have no room are waited for as the class of the publisher says."""

    __slots__ = ("_burst", "_lanes", "_zenoh", "tries", "welcoming")

    def __init__(self, link: "ZenohLink", topic: Topic) -> None:
        super().__init__(link, topic, Room())
        self._zenoh = link
        self._burst = link.burst
        self.tries: Counter[int] = Counter()
        """How often each subscriber was found to have heard nothing."""
        self._lanes = {
            each: Lane(link.senders.flow(topic.name, each), urgent=each is not _NRT) for each in PublisherClass
        }
        self.welcoming = False
        """Somebody has just joined, and is sent what is latched, whoever else has room."""

    # As a sink

    def offer(self, sample: Sample) -> bool:
        lane = self._lanes[sample.publisher_class]
        flow = lane.flow
        if flow.serial >= flow.limit or sample.source is not lane.source or not self._link.up:
            if not self._link.up:
                return self._offer_down(sample)
            if not self._has_room(flow) and not self.welcoming:
                return False
            if sample.source is not lane.source:
                self._prepare(lane, sample)
        flow.serial += 1
        lane.waiting.append(sample)
        if lane.urgent or len(lane.waiting) in (1, MOST):
            self._burst.add(lane)
        return True

    def _offer_down(self, sample: Sample) -> bool:
        if sample.publisher_class != _NRT:
            return False
        self._lose(LINK_DOWN)
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

    def refill(self) -> None:
        while not self._link.stats.lost.guard(self.lines.serve):
            pass  # the one that raised waits no more
        self.lines.recover()

    def give_up(self, refusal: str) -> None:
        """Go on without those who have no room; the others are waited for as before."""
        self._lanes[_NRT].flow.give_up()
        self._zenoh.credits.expect()
        self.lines.refuse(self, refusal)

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

    def parted(self, session: int) -> int:
        """A subscriber is sent nothing any more; says what it has not confirmed, unless it left in order."""
        self._zenoh.credits.look()
        unconfirmed = sum([lane.flow.parted(session) for lane in self._lanes.values()])
        self.refill()
        return unconfirmed

    def credited(self, session: int, publisher_class: PublisherClass, serial: int, *, leaving: bool = False) -> None:
        """A subscriber has taken everything up to this serial; who waits for that is served by `refill`.

        `leaving`: it does not subscribe any more, in no class.
        """
        self._lanes[publisher_class].flow.credited(session, serial)
        self.leaves(session, leaving=leaving)

    def leaves(self, session: int, *, leaving: bool) -> None:
        """Whether a subscriber has said that it does not subscribe any more."""
        for lane in self._lanes.values():
            lane.flow.leaves(session, leaving=leaving)

    @property
    def expects(self) -> bool:
        """Whether somebody waits for credit, or went on without a subscriber that may give it again."""
        return bool(self.lines) or not all(each.waited_for for each in self._lanes[_NRT].flow.takers.values())

    def unheard(self) -> set[int]:
        """Those to whom something was sent, and who never said that it came."""
        heard = {number for lane in self._lanes.values() for number, taker in lane.flow.takers.items() if taker.heard}
        return {number for lane in self._lanes.values() for number in lane.flow.unheard()} - heard

    def _prepare(self, lane: Lane, sample: Sample) -> None:
        """Another publisher than before."""
        self._burst.send(lane)
        layout, instance, source = self.topic.layout, self._zenoh.instance, sample.source
        origin = Origin(
            sample.publisher_class,
            instance,
            self._zenoh.instance_of(source.module) if source.link else instance,
            ANY_TYPE if layout is None else layout.fingerprint,
            self._zenoh.source_name(source),
            source.node,
        )
        lane.prepare(source, origin, self._zenoh.senders.put(self.topic.name, sample.publisher_class))
