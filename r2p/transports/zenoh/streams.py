"""What comes in by zenoh, on its way to the topics: one bounded queue for each topic, so that none delays another.

    zenoh's ring -> Tap (one wake-up of the loop for a batch) -> Stream.arrived -> Topic.deliver -> credit

A non real-time message waits for as long as its subscribers have no room: its publisher waits with it, or goes on
without them, as its class says; that is decided there (r2p.protocols.flow). Others wait a few turns of the loop.
"""

import asyncio
from collections import deque
from collections.abc import Callable, Hashable, Iterable
from typing import TYPE_CHECKING, Any

import msgspec

from r2p.codecs import UnknownType
from r2p.codecs.attachment import FLAG_RESTAMPED, ORIGIN_AT, PLAIN, Origin, Reader, unpack_plain
from r2p.errors import DecodeError
from r2p.protocols.events import Shape
from r2p.protocols.flow import Inflow
from r2p.room import Claim, Sink
from r2p.sample import PublisherClass, Sample, Source
from r2p.topic import PATIENCE, QueueSink, Topic
from r2p.transports.intake import TURN, LinkStats

if TYPE_CHECKING:
    import zenoh

    from r2p.transports.zenoh.session import Tap

WINDOW = 512
"""Messages of one publisher that may be on the way to one subscriber's module, at most."""

_WINDOW_BYTES = 96 * 1024
"""... and their bytes: ten topics at full speed fit into zenoh's own queue of 1 MB."""

_OVERHEAD = 96  # bytes of header and framing

MOST = 8 * WINDOW
"""Messages that wait for one topic at most."""

_SENDERS = 4096
"""Senders of which a stream, or the link, keeps count."""

_NRT = PublisherClass.NON_REAL_TIME


class _Lane(msgspec.Struct, eq=False):
    """One publisher of a stream. `size` of its messages in bytes, -1: any; `sequence` is that of the last one."""

    origin: Origin
    source: Source
    publisher_class: PublisherClass
    flow: Inflow
    size: int
    fits: bool
    sequence: int = 0


class _Held(Claim):
    """A message that waits for room, and the stream with it."""

    __slots__ = ("_go_on",)

    def __init__(self, sample: Sample, sinks: list[Sink], go_on: Callable[[], None]) -> None:
        self._go_on = go_on
        super().__init__(sample, sinks)

    def settled(self, sink: Sink, refusal: str) -> None:
        if not self.lacking:
            self._go_on()


class _Blocked(msgspec.Struct):
    """The message that has no room, and where; `turns` of the loop are left in which it is just tried again."""

    lane: _Lane
    serial: int
    sample: Sample
    sinks: list[Sink]
    turns: int = PATIENCE
    held: _Held | None = None


class Stream:
    """What comes in of one topic."""

    def __init__(self, topic: Topic, streams: "Streams") -> None:
        self.topic = topic
        self.senders: set[Hashable] = set()
        self.tap: Tap | None = None
        self.last: Sample | None = None
        self._streams = streams
        self._loop = streams.loop
        self._flows: dict[tuple[int, int], Inflow] = {}
        self._blocked: _Blocked | None = None
        self._waiting: deque[tuple[_Lane, int, Sample]] = deque()
        self._paused = False
        self._queueing = False
        self.retype()

    def retype(self) -> None:
        """The topic's type may be another one."""
        layout = self.topic.layout
        self._shape = Shape() if layout is None else Shape(layout.size, layout.fingerprint)
        self._forget()

    def _forget(self) -> None:
        self._reader = Reader(self._lane)
        self._known = self._reader.known

    def parted(self, sender: Hashable) -> None:
        """A publisher's module is gone: should it come back, what it repeats is as good as new."""
        if sender in self.senders:
            self.senders.discard(sender)
            self.topic.inlets -= 1
            self._forget()

    def close(self) -> None:
        tap, self.tap = self.tap, None
        if tap is not None:
            tap.close()
        self._waiting.clear()
        blocked, self._blocked = self._blocked, None
        if blocked is not None and blocked.held is not None:
            blocked.held.withdraw()

    def arrived(self, sample: "zenoh.Sample | None") -> None:
        """In the loop: hand out what is there, at most TURN messages in one turn."""
        tap = self.tap
        if tap is None:
            return
        take, accept = tap.take, self._accept
        for _ in range(TURN):
            if sample is None:
                self._loop.call_soon(self._look_again)  # after those who were woken: they may want to answer
                return
            accept(sample)
            if self._blocked is not None and not self._queueing:
                self._paused = True  # the rest stays where it is for now
                return
            sample = take()
        self._loop.call_soon(self.arrived, sample)

    def _look_again(self) -> None:
        tap = self.tap
        if tap is not None:
            sample = tap.take()
            if sample is None:
                tap.wait()
            else:
                self.arrived(sample)

    def _accept(self, arrived: "zenoh.Sample") -> None:
        data = arrived.payload.to_bytes()
        attachment = arrived.attachment
        header = b"" if attachment is None else attachment.to_bytes()
        lane = self._known.get(header[ORIGIN_AT:])
        if lane is None or header[:2] != PLAIN:
            self._accept_odd(data, header)
            return
        hops, serial, sequence, stamp, deadline = unpack_plain(header)
        if self._is_good(lane, len(data), serial, sequence):
            sample = Sample(data, lane.source, stamp, deadline, sequence, lane.publisher_class)
            if hops:
                sample.hops = hops
            self._hand_out(lane, serial, sample)

    def _accept_odd(self, data: bytes, header: bytes) -> None:
        """The first message of a publisher, one with something special about it, or none of ours."""
        try:
            lane, serial, sequence, stamp, deadline, hops, flags, clock = self._reader.read(header)
        except DecodeError as error:
            self._streams.stats.lost["unknown type" if isinstance(error, UnknownType) else "undecodable"] += 1
            return
        if self._is_good(lane, len(data), serial, sequence):
            stamped = not flags & FLAG_RESTAMPED
            sample = Sample(
                data, lane.source, stamp, deadline, sequence, lane.publisher_class, None, stamped, True, hops, clock
            )
            self._hand_out(lane, serial, sample)

    def _is_good(self, lane: _Lane, size: int, serial: int, sequence: int) -> bool:
        """Whether it is a new message of the right type; what is wrong is counted."""
        if size != lane.size and not self._may_have(lane, size):
            return False
        flow = lane.flow
        if serial == flow.next:
            flow.next = serial + 1
        elif not self._is_new(lane, serial):
            return False
        if sequence == lane.sequence and sequence:
            self._streams.credit(self.topic.name, lane.origin, serial)  # sent again: somebody wants to know
            return False
        lane.sequence = sequence
        stats = self._streams.stats
        stats.received += 1
        stats.bytes_received += size
        return True

    def _hand_out(self, lane: _Lane, serial: int, sample: Sample) -> None:
        self.last = sample
        if self._blocked is None:
            self._deliver(lane, serial, sample)
        else:
            self._queue(lane, serial, sample)

    def _may_have(self, lane: _Lane, size: int) -> bool:
        """Whether a publisher's messages may have so many bytes; counts those that may not."""
        if not lane.fits:
            self._streams.stats.lost["wrong type"] += 1
        elif lane.size >= 0 or not 0 < size <= self._streams.longest:
            self._streams.stats.lost["wrong size"] += 1
        else:
            return True
        return False

    def _is_new(self, lane: _Lane, serial: int) -> bool:
        """Not the one that was expected: count what is missing. False for one that came before."""
        gap = lane.flow.gap(serial)
        if gap < 0:
            self._streams.stats.lost["repeated"] += 1
        elif gap:
            self._streams.count_gap(self.topic.name, lane.source, gap)
        return gap >= 0

    def _queue(self, lane: _Lane, serial: int, sample: Sample) -> None:
        """Another one waits for room: events and periods don't wait behind a message that does not expire."""
        if lane.publisher_class != _NRT:
            for sink in self.topic.deliver(sample) or ():
                sink.force(sample)
        elif len(self._waiting) < MOST:
            self._waiting.append((lane, serial, sample))
        else:
            self._streams.stats.lost["receive queue full"] += 1

    def _deliver(self, lane: _Lane, serial: int, sample: Sample) -> None:
        sinks = self.topic.deliver(sample)
        if sinks is None:
            self._taken(lane, serial)
        else:
            self._blocked = _Blocked(lane, serial, sample, sinks)
            self._loop.call_soon(self._retry, self._blocked)

    def _retry(self, blocked: _Blocked) -> None:
        """Most readers make room within a turn of the loop. For the others an event or a period does not wait; what
        does not expire gets in line, and lets others pass.
        """
        if blocked is not self._blocked:
            return
        sample = blocked.sample
        blocked.sinks = [sink for sink in blocked.sinks if not sink.offer(sample)]
        blocked.turns -= 1
        if not blocked.sinks:
            self._go_on()
        elif blocked.turns:
            self._loop.call_soon(self._retry, blocked)
        elif blocked.lane.publisher_class != _NRT:
            for sink in blocked.sinks:
                sink.force(sample)
            self._go_on()
        else:
            blocked.held = _Held(sample, blocked.sinks, self._settled)
            self._queueing = True
            self._read_on()

    def _settled(self) -> None:
        """The message that was held is placed; it may be in the middle of the reader's work, so go on after it."""
        self._loop.call_soon(self._go_on)

    def _go_on(self) -> None:
        blocked, self._blocked = self._blocked, None
        if blocked is not None:
            self._taken(blocked.lane, blocked.serial)
        waiting = self._waiting
        while waiting and self._blocked is None:
            self._deliver(*waiting.popleft())
        if self._blocked is None:
            self._queueing = False
            self._read_on()

    def _read_on(self) -> None:
        if self._paused:
            self._paused = False
            if self.tap is not None:
                self.arrived(self.tap.take())

    def _taken(self, lane: _Lane, serial: int) -> None:
        """The queues have it: tell its publisher now and then."""
        flow = lane.flow
        flow.until_credit -= 1
        if not flow.until_credit:
            flow.credited()
            self._streams.credit(self.topic.name, lane.origin, serial)

    def _lane(self, origin: Origin) -> _Lane:
        """A publisher is new."""
        key = origin.sender, origin.publisher_class
        if key not in self._flows:
            if len(self._flows) >= _SENDERS:
                self._flows.clear()
            window = self._streams.window(self.topic) if origin.publisher_class == _NRT else 0
            self._flows[key] = Inflow(window)
        fits = self._shape.fits(Shape(0, origin.fingerprint))
        return _Lane(
            origin,
            Source(origin.module, origin.node, self._streams.link),
            PublisherClass(origin.publisher_class),
            self._flows[key],
            (self._shape.size or -1) if fits else -1,
            fits,
        )


class Streams:
    """All topics that come in by one link."""

    def __init__(
        self,
        link: str,
        loop: asyncio.AbstractEventLoop,
        stats: LinkStats,
        *,
        longest: int,
        latched: Callable[[str], bool],
        credit: Callable[[str, Origin, int], None],
        subscribe: Callable[[str, Callable[["zenoh.Sample"], None]], "Tap | None"],
    ) -> None:
        self.link = link
        self.loop = loop
        self.stats = stats
        self.longest = longest
        self.credit = credit
        self.gaps: dict[tuple[str, Source], int] = {}
        """Messages lost on the way, by topic and source."""
        self._latched = latched
        self._subscribe = subscribe
        self._streams: dict[str, Stream] = {}

    def begin(self, topic: Topic) -> None:
        """Somebody here subscribes the topic, or its type has changed."""
        stream = self._streams.get(topic.name)
        if stream is not None and stream.topic is topic:
            stream.retype()
            return
        stream = self._streams[topic.name] = Stream(topic, self)
        topic.memories.append(self)
        stream.tap = self._subscribe(topic.name, stream.arrived)

    def connect(self) -> None:
        """There is a session now: subscribe what was begun before."""
        for name, stream in self._streams.items():
            stream.tap = self._subscribe(name, stream.arrived)

    def window(self, topic: Topic) -> int:
        """How many messages may be on the way; 0: as many as come, the subscribers would rather lose some."""
        if topic.queues and all(queue.lossy for queue in topic.queues):
            return 0
        size = self.longest if topic.layout is None else topic.layout.size
        return min(WINDOW, _WINDOW_BYTES // (size + _OVERHEAD))

    def count_gap(self, topic: str, source: Source, gap: int) -> None:
        """Messages were lost on the way."""
        self.stats.lost["on the way"] += gap
        if len(self.gaps) >= _SENDERS:
            self.gaps.clear()
        self.gaps[topic, source] = self.gaps.get((topic, source), 0) + gap

    # As Intake

    def take(self, arrivals: Iterable[Any]) -> None:
        """Each stream takes what comes by itself."""

    def open(self, topic: Topic, size: int, sender: Hashable) -> None:
        """A publisher is there."""
        stream = self._streams.get(topic.name)
        if stream is not None and sender not in stream.senders:
            stream.senders.add(sender)
            topic.inlets += 1
            for queue in topic.queues:
                queue.publisher_joined()

    def shut(self, name: str, sender: Hashable) -> None:
        """It is gone, though what it sent may still be on the way."""
        stream = self._streams.get(name)
        if stream is not None:
            stream.parted(sender)

    def shut_all(self, name: str) -> None:
        """Nobody here subscribes the topic any more."""
        stream = self._streams.pop(name, None)
        if stream is not None:
            stream.close()
            stream.topic.inlets -= len(stream.senders)
            stream.topic.memories.remove(self)

    def remind(self, topic: Topic, sink: QueueSink) -> None:
        """Send the last message to a new subscriber, if the publisher latches it."""
        last = self._streams[topic.name].last
        if last is not None and self._latched(topic.name):
            sink.force(last)

    def close(self) -> None:
        for name in list(self._streams):
            self.shut_all(name)
