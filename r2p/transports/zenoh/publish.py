"""One class of one topic on its way out: what waits for others to go with it, and how it is sent.

What a publisher sends without a pause goes out in few packets of zenoh, each a payload of messages one after
the other, each as it is, with one header for all (r2p.codecs.attachment). Giving zenoh each for itself would take both
ends longer than all the rest of what they do.
"""

import asyncio
import functools
from collections import Counter
from collections.abc import Callable, Iterator
from itertools import groupby
from typing import TYPE_CHECKING

from r2p.codecs.attachment import PACKET_MOST, Header, Origin, Packer, encode, start_of
from r2p.codecs.management import ANY_TYPE
from r2p.protocols.flow_control import SendWindow
from r2p.runtime.backpressure import LINK_DOWN, WaitQueue
from r2p.runtime.sample import PublisherClass, Sample, Source
from r2p.runtime.topic import Topic
from r2p.transports.link import LinkSubscriber
from r2p.transports.stats import LinkStats
from r2p.transports.zenoh.threads import MOST, MOST_URGENT

if TYPE_CHECKING:
    import zenoh

    from r2p.transports.zenoh.link import ZenohLink
    from r2p.transports.zenoh.session import ZenohSession

Put = Callable[..., None]
"""zenoh's `Publisher.put(data, *, attachment)`."""

MOST_WAITING = PACKET_MOST
"""Messages that wait in a lane."""

_LONGEST = 16 * 1024
"""Bytes of a packet of several messages."""

_NOBODY = Packer(Origin(PublisherClass.NON_REAL_TIME, 0, 0, ANY_TYPE))


def nowhere(data: bytes, *, attachment: bytes) -> None:
    """There is no session."""


class TxStream:
    """The way of one class, for one publisher at a time."""

    __slots__ = ("_packer", "_put", "flow", "source", "urgent", "waiting")

    def __init__(self, flow: "SendWindow", *, urgent: bool) -> None:
        self.flow = flow
        self.urgent = urgent
        """Whether messages never wait, not even for the end of the turn."""
        self.source: Source | None = None
        self.waiting: list[Sample] = []
        """Each has been given its serial in the flow already: the last one is the flow's last."""
        self._packer = _NOBODY
        self._put: Put = nowhere

    def prepare(self, source: Source, origin: Origin, put: Put) -> None:
        """Another publisher is next; nothing of the one before waits any more."""
        self.source = source
        self._packer = Packer(origin)
        self._put = put

    def send(self, stats: "LinkStats", error: type[Exception], *, batching: bool) -> None:
        """Send what waits; zenoh drops it where the network is too slow. `error`: the session is closed.

        What is not sent is counted here, and subscribers need not miss it, too: its serials are those of what follows.
        """
        waiting, self.waiting = self.waiting, []
        serial = self.flow.serial - len(waiting) + 1
        for samples in _packets(waiting) if batching and len(waiting) > 1 else [[each] for each in waiting]:
            try:
                data = samples[0].data if len(samples) == 1 else b"".join([each.data for each in samples])
                self._put(data, attachment=self._header(samples, serial))
            except error:
                stats.lost[LINK_DOWN] += len(samples)
            except BlockingIOError:  # zenoh is busy with others
                stats.lost["send buffer full"] += len(samples)
            except Exception as failure:  # noqa: BLE001 - counted and logged; the next packet follows
                stats.lost.internal_error(failure, len(samples))
            else:
                stats.sent += len(samples)
                stats.bytes_sent += len(data)
                serial += len(samples)
        self.flow.serial = serial - 1

    def _header(self, samples: list[Sample], serial: int) -> bytes:
        """What comes from another link has crossed a gateway more."""
        first = samples[0]
        hops = first.hops + bool(first.source.link)
        if first.clock is None:
            start = start_of(hops, stamped=first.stamped)
            if len(samples) == 1:
                return self._packer.one(start, serial, first.sequence, first.stamp, first.deadline)
            stamps = [each.stamp for each in samples]
            return self._packer.several(start, serial, first.sequence, first.deadline, stamps)
        more = tuple([each.stamp for each in samples[1:]])
        origin, clock = self._packer.origin, first.clock
        header = Header(origin, serial, first.sequence, first.stamp, first.deadline, hops, first.stamped, clock, more)
        return encode(header)


def _packets(samples: list[Sample]) -> Iterator[list[Sample]]:
    """What goes out together: messages of one size that count on, and that one header is true for."""
    for _, alike in groupby(enumerate(samples), _kind):
        run = [sample for _, sample in alike]
        most = max(1, _LONGEST // max(1, len(run[0].data)))
        for at in range(0, len(run), most):
            yield run[at : at + most]


def _kind(numbered: tuple[int, Sample]) -> object:
    """Equal for neighbours that may share a header."""
    position, each = numbered
    counts_from = each.sequence - position if each.sequence else None
    return counts_from, len(each.data), each.deadline, each.hops, each.stamped, each.clock


# What goes out when: the first message at once, the others together when the turn of the event loop is over.


TURNS = 12
"""Turns of the loop in which messages of a flood wait for more of them, at most."""

FLOOD = 8
"""Messages in one turn that make a flood; what comes more slowly goes out when its turn is over."""


class Batcher:
    """The messages of all topics of one link."""

    def __init__(
        self, loop: asyncio.AbstractEventLoop, stats: LinkStats, error: type[Exception], *, batching: bool
    ) -> None:
        self._loop = loop
        self._batching = batching
        self._stats = stats
        self._error = error
        self._begun = False
        self._turns = 0
        self._count = 0
        self._lanes: dict[TxStream, None] = {}

    def add(self, lane: TxStream) -> None:
        """A message waits in a lane that was empty, or as many as may wait there: send them in good time."""
        if not self._begun:
            self._begun = True
            self._loop.call_soon(self._end)
        elif not lane.urgent and len(lane.waiting) < MOST_WAITING:
            self._lanes[lane] = None
            return
        lane.send(self._stats, self._error, batching=self._batching)

    def send(self, lane: TxStream) -> None:
        """Send what waits in this one."""
        if self._lanes.pop(lane, lane) is None:
            lane.send(self._stats, self._error, batching=self._batching)

    def flush(self) -> None:
        """Send what waits."""
        lanes, self._lanes = self._lanes, {}
        self._turns = self._count = 0
        for lane in lanes:
            lane.send(self._stats, self._error, batching=self._batching)

    def discard(self) -> int:
        """Forget what waits; says how much that was. Subscribers need not miss it, too, so its serials come again."""
        lanes, self._lanes = self._lanes, {}
        count = sum(len(lane.waiting) for lane in lanes)
        for lane in lanes:
            lane.flow.serial -= len(lane.waiting)
            lane.waiting.clear()
        return count

    def _end(self) -> None:
        """A turn is over: send what waits, unless it becomes more and more."""
        count = sum([len(lane.waiting) for lane in self._lanes])
        self._begun = count > 0
        if self._begun:
            self._loop.call_soon(self._end)
        self._turns += 1
        if self._batching and count >= self._count + FLOOD and self._turns < TURNS:
            self._count = count
        else:
            self.flush()


# One topic on its way out by zenoh: no further than its subscribers have room for (r2p.protocols.flow_control).


_NRT = PublisherClass.NON_REAL_TIME


class ZenohSubscriber(LinkSubscriber):
    """One topic on its way out. Those who have no room are waited for as the class of the publisher says."""

    __slots__ = ("_burst", "_lanes", "_zenoh", "tries", "welcoming")

    def __init__(self, link: "ZenohLink", topic: Topic) -> None:
        super().__init__(link, topic, WaitQueue())
        self._zenoh = link
        self._burst = link.burst
        self.tries: Counter[int] = Counter()
        """How often each subscriber was found to have heard nothing."""
        self._lanes = {
            each: TxStream(link.senders.flow(topic.name, each), urgent=each is not _NRT) for each in PublisherClass
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
        if lane.urgent or len(lane.waiting) in (1, MOST_WAITING):
            self._burst.add(lane)
        return True

    def _offer_down(self, sample: Sample) -> bool:
        if sample.publisher_class != _NRT:
            return False
        self._lose(LINK_DOWN)
        return True

    def _has_room(self, flow: "SendWindow") -> bool:
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
        while not self._link.stats.lost.guard(self.waiting.serve):
            pass  # the one that raised waits no more
        self.waiting.recover()

    def become_lossy(self, refusal: str) -> None:
        """Go on without those who have no room; the others are waited for as before."""
        self._lanes[_NRT].flow.give_up()
        self._zenoh.credits.expect()
        self.waiting.reject(self, refusal)

    # For the link

    def knows(self, session: int) -> bool:
        """Whether a subscriber has joined."""
        return session in self._lanes[_NRT].flow.takers

    def joined(self, session: int, window: int) -> None:
        """A subscriber, or its new window."""
        for publisher_class, lane in self._lanes.items():
            lane.flow.joined(session, window if publisher_class == _NRT else 0)
        self.refill()

    def resend_latched(self) -> None:
        """Send what is latched, whoever has room."""
        self.welcoming = True
        self.topic.resend_latched(self)
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
        return bool(self.waiting) or not all(each.waited_for for each in self._lanes[_NRT].flow.takers.values())

    def unacknowledged(self) -> set[int]:
        """Those to whom something was sent, and who never said that it came."""
        heard = {number for lane in self._lanes.values() for number, taker in lane.flow.takers.items() if taker.heard}
        return {number for lane in self._lanes.values() for number in lane.flow.unacknowledged()} - heard

    def _prepare(self, lane: TxStream, sample: Sample) -> None:
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


# What zenoh sends the messages of a link with, and how far each topic has come; both outlast the outlets.


class PublisherCache:
    """One for each topic and class, declared as soon as somebody publishes: so zenoh looks for a way in good time."""

    def __init__(self) -> None:
        self._session: ZenohSession | None = None
        self._prefix = ""
        self._senders: dict[tuple[str, int], zenoh.Publisher] = {}
        self._asked: set[str] = set()
        self._answers: dict[str, bool] = {}
        self._flows: dict[tuple[str, int], SendWindow] = {}

    def connect(self, session: "ZenohSession", prefix: str) -> None:
        """There is a session now; the key of a topic is its name behind the prefix."""
        self._session = session
        self._prefix = prefix

    def close(self) -> None:
        """Sent is nothing any more; what is declared goes with the session."""
        self._session = None

    def declare(self, topic: Topic) -> None:
        """Somebody publishes it."""
        classes = {int(publisher.publisher_class) for publisher in topic.publishers}
        for publisher_class in classes or {int(PublisherClass.NON_REAL_TIME)}:  # none of our own: a gateway
            self.publisher(topic.name, publisher_class)

    def undeclare(self, topic: str) -> None:
        """Nobody does any more."""
        for key in [key for key in self._senders if key[0] == topic]:
            sender = self._senders.pop(key)
            if self._session is not None:
                self._session.ends(sender)

    def reach(self, topic: str) -> bool:
        """Whether zenoh knows of a subscriber that messages of the topic reach. False while zenoh has yet to say it."""
        senders = [sender for (name, _), sender in self._senders.items() if name == topic]
        if not senders or self._session is None:
            return False
        outbound = self._session.outbound
        if not outbound.by_thread:
            return all(_reaches(sender) for sender in senders)
        answer = self._answers.pop(topic, None)
        if answer is None and topic not in self._asked:
            self._asked.add(topic)
            outbound.ask(lambda: all(_reaches(sender) for sender in senders), functools.partial(self._answer, topic))
        return bool(answer)

    def _answer(self, topic: str, reached: bool | None) -> None:
        self._asked.discard(topic)
        self._answers[topic] = bool(reached)

    def put(self, topic: str, publisher_class: int) -> Put:
        """What sends packets of the topic."""
        sender = self.publisher(topic, publisher_class)
        if sender is None or self._session is None:
            return nowhere
        most = MOST if publisher_class == PublisherClass.NON_REAL_TIME else MOST_URGENT
        return functools.partial(self._session.outbound.put, sender.put, most)

    def publisher(self, topic: str, publisher_class: int) -> "zenoh.Publisher | None":
        """What zenoh sends with."""
        key = topic, publisher_class
        if key not in self._senders and self._session is not None:
            self._senders[key] = self._session.publisher(f"{self._prefix}{topic}", publisher_class)
        return self._senders.get(key)

    def flow(self, topic: str, publisher_class: int) -> SendWindow:
        """What went out on the topic; it counts on for as long as the link lives."""
        return self._flows.setdefault((topic, publisher_class), SendWindow())


def _reaches(sender: "zenoh.Publisher") -> bool:
    """zenoh's stubs tell of a bool; what comes is an object that says it, and is itself always true."""
    status: object = sender.matching_status
    return bool(getattr(status, "matching", status))
