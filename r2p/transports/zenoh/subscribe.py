"""What comes in of one topic by zenoh, on its way to the queues.

    zenoh's ring -> Tap -> Stream.arrived (packets) -> Topic.deliver (messages) -> credit

A non real-time message waits for as long as its subscribers have no room. Whether its publisher waits with it, or goes
on without them, is decided by its class, at its side (r2p.protocols.flow_control). Others wait a few turns of the loop.
"""

import asyncio
import itertools
from collections import deque
from collections.abc import Callable, Hashable
from typing import TYPE_CHECKING, Protocol

import msgspec

from r2p.clock import clock_of
from r2p.codecs import UnknownType
from r2p.codecs.attachment import SERIAL_WRAP, HeaderReader, Origin
from r2p.errors import DecodeError
from r2p.protocols.discovery.events import TopicType
from r2p.protocols.flow_control import ReceiveWindow
from r2p.protocols.time_left import TimeLeft
from r2p.runtime.backpressure import PendingDelivery, Sink
from r2p.runtime.duplicates import LastReceived
from r2p.runtime.sample import PublisherClass, Sample, Source
from r2p.runtime.topic import Topic
from r2p.transports.link import MESSAGES_PER_TURN
from r2p.transports.receive_backpressure import FULL_QUEUE_TURNS
from r2p.transports.stats import LinkStats

if TYPE_CHECKING:
    import zenoh

    from r2p.transports.zenoh.session import SubscriptionReader

RING = 4096
"""Packets of one topic that wait in zenoh at most."""

_MOST = 16_384
"""Messages of one topic that wait behind one for which there is no room: what eight publishers may send meanwhile."""

Flows = dict[tuple[int, int], ReceiveWindow]
"""By session and class."""

_FAREWELLS = 256
"""Sessions that are told that a topic is not subscribed any more."""

SENDERS = 4096
"""Senders of which a stream, or the link, keeps count."""

_NRT = PublisherClass.NON_REAL_TIME


class RemotePublisher(msgspec.Struct, eq=False):
    """One way of a publisher's messages into a stream. `size` of them in bytes, -1: any; `usual` and `sequence` are
    size and number of the last one. `heard` is shared by all its ways: by other gateways, and by other links.
    """

    origin: Origin
    source: Source
    publisher_class: PublisherClass
    flow: ReceiveWindow
    size: int
    fits: bool
    heard: LastReceived
    usual: int = -1
    sequence: int = 0
    time_left: TimeLeft = msgspec.field(default_factory=TimeLeft)


class _Held(PendingDelivery):
    """A message that waits for room, and the stream with it."""

    __slots__ = ("_go_on",)

    def __init__(self, sample: Sample, sinks: list[Sink], go_on: Callable[[], None]) -> None:
        self._go_on = go_on
        super().__init__(sample, sinks)

    def completed(self, sink: Sink, refusal: str) -> None:
        if not self.remaining:
            self._go_on()


class _Blocked(msgspec.Struct):
    """The message that has no room, and where; `turns` of the loop are left in which it is just tried again."""

    lane: RemotePublisher
    serial: int
    sample: Sample
    sinks: list[Sink]
    turns: int = FULL_QUEUE_TURNS
    held: _Held | None = None


class RxStream:
    """What comes in of one topic."""

    def __init__(self, topic: Topic, streams: "RxStreams", flows: Flows) -> None:
        self.topic = topic
        self.senders: set[Hashable] = set()
        self.tap: SubscriptionReader | None = None
        self.last: Sample | None = None
        self._streams = streams
        self._loop = streams.loop
        self.flows = flows
        """How far each session has come in each class."""
        self._blocked: _Blocked | None = None
        self._waiting: deque[tuple[RemotePublisher, int, Sample | None]] = deque()
        """What is behind the message that is blocked; None: one that was refused, and is only told of."""
        self._paused = False
        self._queueing = False
        self._shape = _shape(topic)
        self._reader = HeaderReader(self._lane)

    def retype(self) -> None:
        """The topic's type, or what its subscribers put up with, may be another one."""
        shape = _shape(self.topic)
        if shape != self._shape:
            self._shape = shape
            for lane in self._reader.known.values():
                self._fit(lane)
        window = self._streams.window(self.topic)
        for (_, publisher_class), flow in self.flows.items():
            if publisher_class == _NRT and flow.window != window:
                flow.resized(window)

    def opened(self, session: int) -> None:
        """A publisher's module is there: it is to know when we leave, even if nothing of what it sent has come yet."""
        self._flow(session, int(_NRT))

    def parted(self, sender: Hashable) -> None:
        """A publisher's module is gone: should it come back, what it repeats is as good as new."""
        if sender in self.senders:
            self.senders.discard(sender)
            self.topic.remote_publishers -= 1
            known = self._reader.known
            for key in [key for key, lane in known.items() if lane.origin.sender == sender]:
                del known[key]
        for (session, _), flow in self.flows.items():
            if session == sender:
                flow.interrupted()

    def close(self) -> None:
        tap, self.tap = self.tap, None
        if tap is not None:
            tap.close()
        self._take_leave()
        if self._waiting:
            self._streams.stats.lost["not subscribed"] += sum(sample is not None for _, _, sample in self._waiting)
            self._waiting.clear()
        blocked, self._blocked = self._blocked, None
        if blocked is not None and blocked.held is not None:
            blocked.held.withdraw()

    def _take_leave(self) -> None:
        """Tell those who publish that what is still on the way is not wanted any more."""
        latest = itertools.islice(reversed(self.flows.items()), _FAREWELLS)  # older ones may be gone for long
        for (session, publisher_class), flow in latest:
            last = (flow.next - 1) & SERIAL_WRAP if flow.next >= 0 else 0
            credit, guard = self._streams.credit, self._streams.stats.lost.guard
            guard(credit, self.topic.name, session, publisher_class, last, leaving=True)

    def arrived(self, arrived: "zenoh.Sample | None") -> None:
        """In the loop: hand out what is there, about MESSAGES_PER_TURN messages in a turn."""
        tap = self.tap
        if tap is None:
            return
        left = MESSAGES_PER_TURN
        while arrived is not None and left > 0:
            try:
                attachment = arrived.attachment
                left -= self._unpack(arrived.payload.to_bytes(), b"" if attachment is None else attachment.to_bytes())
            except Exception as error:  # noqa: BLE001 - counted and logged; the next packet follows
                self._streams.stats.lost.internal_error(error)
                left -= 1
            if self._blocked is not None and not self._queueing:
                self._paused = True  # the rest stays where it is for now
                return
            arrived = tap.take()
        if arrived is None:
            self._loop.call_soon(self._look_again)  # after those who were woken: they may want to answer
        else:
            self._loop.call_soon(self.arrived, arrived)

    def _look_again(self) -> None:
        tap = self.tap
        if tap is not None:
            sample = tap.take()
            if sample is None:
                tap.wait()
            else:
                self.arrived(sample)

    def _unpack(self, data: bytes, header: bytes) -> int:
        """Hand out the messages of one packet; says how many that were."""
        try:
            lane, serial, sequence, stamps, deadline, hops, stamped, clock = self._reader.read(header)
            parts = (data,) if len(stamps) == 1 else _parts(data, len(stamps))
        except DecodeError as error:
            self._streams.stats.lost["unknown type" if isinstance(error, UnknownType) else "undecodable"] += 1
            return 1
        source, publisher_class, step = lane.source, lane.publisher_class, 1 if sequence else 0
        samples = []
        for part, stamp in zip(parts, stamps, strict=True):
            samples.append(
                Sample(part, source, stamp, deadline, sequence, publisher_class, None, stamped, True, hops, clock)
            )
            sequence += step
        if deadline:
            self._expire(lane, samples)
        first = samples[0]
        if (
            len(first.data) == lane.usual
            and serial == lane.flow.next
            and (first.sequence > lane.heard.sequence or not sequence)
            and self._blocked is None
        ):
            self._take(lane, serial, samples)
        else:
            for number, sample in enumerate(samples, serial):
                if self._is_good(lane, number, sample):
                    self._hand_out(lane, number, sample)
        return len(samples)

    def _expire(self, lane: RemotePublisher, samples: list[Sample]) -> None:
        """Work out their deadline by the clock here."""
        clock = self._streams.clock
        now, utc = clock.monotonic(), clock.now()
        for sample in samples:
            sample.expires = utc + lane.time_left.left(now, sample.stamp, sample.deadline)

    def _take(self, lane: RemotePublisher, serial: int, samples: list[Sample]) -> None:
        """What was expected next, and nobody lacks room yet: as `_is_good` and `_hand_out`, at once for all."""
        self.last = last = samples[-1]
        flow, heard, count = lane.flow, lane.heard, len(samples)
        flow.next = serial + count & SERIAL_WRAP
        lane.sequence = heard.sequence = last.sequence
        heard.stamp = last.stamp
        stats = self._streams.stats
        stats.received += count
        stats.bytes_received += count * lane.usual
        deliver = self.topic.deliver
        for sample in samples:
            if self._blocked is not None:
                self._queue(lane, serial, sample)
                serial += 1
                continue
            try:
                sinks = deliver(sample)
            except Exception as error:  # noqa: BLE001 - counted and logged; the next one follows
                stats.lost.internal_error(error)
                sinks = None
            if sinks is not None:
                self._block(lane, serial, sample, sinks)
            else:
                flow.until_credit -= 1
                if not flow.until_credit:
                    self._give_credit(lane, serial)
            serial += 1

    def _is_good(self, lane: RemotePublisher, serial: int, sample: Sample) -> bool:
        """Whether it is a new message of the right type; what is wrong is counted."""
        size, sequence, stamp = len(sample.data), sample.sequence, sample.stamp
        flow, heard = lane.flow, lane.heard
        if size != lane.usual and not self._may_have(lane, size):
            self._refused(lane, serial)
            return False
        lane.usual = size
        if serial == flow.next:
            flow.next = serial + 1
        elif not self._is_new(lane, serial):
            return False
        if not heard.accept(sequence, stamp):
            self._came_again(lane, serial, sequence)
            return False
        lane.sequence = sequence
        stats = self._streams.stats
        stats.received += 1
        stats.bytes_received += size
        return True

    def _refused(self, lane: RemotePublisher, serial: int) -> None:
        """A message that nobody here can use. It is no gap, as it came and was counted; and it is as good as taken, or
        its publisher would wait for it: after those that wait for room.
        """
        gap = lane.flow.gap(serial) if lane.flow.next >= 0 else 0  # serials are counted from the first good one
        if gap < 0:
            return
        if gap:
            self._streams.count_gap(self.topic.name, lane.source, gap)
            lane.flow.skipped(gap)
        if self._blocked is None or lane.publisher_class != _NRT:
            self._taken(lane, serial)
        elif len(self._waiting) < _MOST:
            self._waiting.append((lane, serial, None))
        else:
            lane.flow.skipped(1)

    def _came_again(self, lane: RemotePublisher, serial: int, sequence: int) -> None:
        """A message that was here before: by this way, as somebody wants to know whether it came, or by another one."""
        if sequence == lane.sequence:
            self._streams.credit(self.topic.name, lane.origin.sender, lane.origin.publisher_class, serial)
        else:
            lane.sequence = sequence
            self._streams.stats.lost["seen before"] += 1
            self._taken(lane, serial)

    def _hand_out(self, lane: RemotePublisher, serial: int, sample: Sample) -> None:
        self.last = sample
        if self._blocked is None:
            self._deliver(lane, serial, sample)
        else:
            self._queue(lane, serial, sample)

    def _may_have(self, lane: RemotePublisher, size: int) -> bool:
        """Whether a publisher's messages may have so many bytes; counts those that may not."""
        if not lane.fits:
            self._streams.stats.lost["wrong type"] += 1
        elif size != lane.size and (lane.size >= 0 or not 0 < size <= self._streams.max_payload):
            self._streams.stats.lost["wrong size"] += 1
        else:
            return True
        return False

    def _is_new(self, lane: RemotePublisher, serial: int) -> bool:
        """Not the one that was expected: count what is missing. False for one that came before."""
        gap = lane.flow.gap(serial)
        if gap < 0:
            self._streams.stats.lost["repeated"] += 1
        elif gap:
            self._streams.count_gap(self.topic.name, lane.source, gap)
            lane.flow.skipped(gap)
        return gap >= 0

    def _queue(self, lane: RemotePublisher, serial: int, sample: Sample) -> None:
        """Another one waits for room: events and periods don't wait behind a message that does not expire."""
        if lane.publisher_class != _NRT and self._queueing:
            for sink in self._delivered(sample) or ():
                self._streams.stats.lost.guard(sink.force, sample)
            self._taken(lane, serial)
        elif len(self._waiting) < _MOST:
            self._waiting.append((lane, serial, sample))
        else:
            self._streams.stats.lost["receive queue full"] += 1
            lane.flow.skipped(1)

    def _deliver(self, lane: RemotePublisher, serial: int, sample: Sample | None) -> None:
        sinks = None if sample is None else self._delivered(sample)
        if sample is None or sinks is None:
            self._taken(lane, serial)
        else:
            self._block(lane, serial, sample, sinks)

    def _delivered(self, sample: Sample) -> list[Sink] | None:
        """Hand it to the topic: gives back who has no room. Where that raises it is lost, and counted."""
        try:
            return self.topic.deliver(sample)
        except Exception as error:  # noqa: BLE001 - counted and logged; the next one follows
            self._streams.stats.lost.internal_error(error)
            return None

    def _block(self, lane: RemotePublisher, serial: int, sample: Sample, sinks: list[Sink]) -> None:
        """There is no room for this one."""
        self._blocked = _Blocked(lane, serial, sample, sinks)
        self._loop.call_soon(self._retry, self._blocked)

    def _retry(self, blocked: _Blocked) -> None:
        """Most readers make room within a turn of the loop. For the others an event or a period does not wait; what
        does not expire gets in line, and lets others pass.
        """
        if blocked is not self._blocked:
            return
        sample = blocked.sample
        blocked.sinks = [sink for sink in blocked.sinks if not self._settles(sink, sample)]
        blocked.turns -= 1
        if not blocked.sinks:
            self._go_on()
        elif blocked.turns:
            self._loop.call_soon(self._retry, blocked)
        elif blocked.lane.publisher_class != _NRT:
            for sink in blocked.sinks:
                self._streams.stats.lost.guard(sink.force, sample)
            self._go_on()
        else:
            blocked.held = _Held(sample, blocked.sinks, self._settled)
            self._queueing = True
            self._read_on()

    def _settles(self, sink: Sink, sample: Sample) -> bool:
        """Whether it is not waited for any more: it has the message, or has raised."""
        try:
            return sink.offer(sample)
        except Exception as error:  # noqa: BLE001 - counted and logged; the others follow
            self._streams.stats.lost.internal_error(error)
            return True

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

    def _taken(self, lane: RemotePublisher, serial: int) -> None:
        """The queues have it: tell its publisher now and then."""
        lane.flow.until_credit -= 1
        if not lane.flow.until_credit:
            self._give_credit(lane, serial)

    def _give_credit(self, lane: RemotePublisher, serial: int) -> None:
        lane.flow.credited()
        origin, streams = lane.origin, self._streams
        streams.stats.lost.guard(streams.credit, self.topic.name, origin.sender, origin.publisher_class, serial)

    def _lane(self, origin: Origin) -> RemotePublisher:
        """A publisher is new."""
        key = origin.sender, origin.publisher_class
        lane = RemotePublisher(
            origin,
            Source(origin.module, origin.node, self._streams.link),
            PublisherClass(origin.publisher_class),
            self._flow(*key),
            -1,
            False,
            self.topic.last_received((origin.instance or key, origin.module, origin.node, origin.publisher_class)),
        )
        self._fit(lane)
        return lane

    def _flow(self, session: int, publisher_class: int) -> ReceiveWindow:
        """How far it has come; the latest one is last."""
        flow = self.flows.pop((session, publisher_class), None)
        if flow is None:
            if len(self.flows) >= SENDERS:
                self.flows.clear()
            flow = ReceiveWindow(self._streams.window(self.topic) if publisher_class == _NRT else 0)
        self.flows[session, publisher_class] = flow
        return flow

    def _fit(self, lane: RemotePublisher) -> None:
        lane.fits = self._shape.fits(TopicType(0, lane.origin.fingerprint))
        lane.size = (self._shape.size or -1) if lane.fits else -1
        lane.usual = -1


def _parts(data: bytes, count: int) -> list[bytes]:
    """The messages of a payload. Raises DecodeError if they can't be of one size."""
    size, odd = divmod(len(data), count)
    if odd or not size:
        raise DecodeError(f"{len(data)} bytes for {count} messages")
    return [data[at : at + size] for at in range(0, len(data), size)]


def _shape(topic: Topic) -> TopicType:
    return TopicType() if topic.layout is None else TopicType(topic.layout.size, topic.layout.fingerprint)


# All that comes in by zenoh: a bounded queue for each topic, so that none delays another.


WINDOW = 2048
"""Messages of one publisher that may be on the way to one subscriber's module, at most."""

_WINDOW_BYTES = 192 * 1024
"""... and their bytes: five topics at full speed fit into zenoh's own queue of 1 MB."""

_RESUME = 10.0
"""Seconds after a link came up in which its topics are subscribed again, or are used on another link."""

_OVERHEAD = 32  # bytes of stamp, and share in header and framing, in a packet of several


class GiveCredit(Protocol):
    """Tells the session `sender` that its messages up to this serial have been taken."""

    def __call__(
        self, topic: str, sender: int, publisher_class: int, serial: int, /, *, leaving: bool = False
    ) -> None: ...


class RxStreams:
    """All topics that come in by one link."""

    def __init__(
        self,
        link: str,
        loop: asyncio.AbstractEventLoop,
        stats: LinkStats,
        *,
        longest: int,
        latched: Callable[[str], bool],
        credit: "GiveCredit",
        subscribe: Callable[[str, Callable[["zenoh.Sample"], None]], "SubscriptionReader | None"],
    ) -> None:
        self.link = link
        self.loop = loop
        self.clock = clock_of(loop)
        self.stats = stats
        self.max_payload = longest
        self.credit = credit
        self.gaps: dict[tuple[str, Source], int] = {}
        """Messages lost on the way, by topic and source."""
        self._latched = latched
        self._subscribe = subscribe
        self._streams: dict[str, RxStream] = {}
        self._kept: dict[str, tuple[Flows, dict[tuple[int, int], int]]] = {}
        """How far the publishers of each topic had come when the link went down, and a copy of that."""
        self._kept_until = 0.0
        self._up = False

    def begin(self, topic: Topic) -> None:
        """Somebody here subscribes the topic, or its type has changed."""
        stream = self._streams.get(topic.name)
        if stream is not None and stream.topic is topic:
            stream.retype()
            return
        stream = self._streams[topic.name] = RxStream(topic, self, self._flows(topic.name))
        topic.latched_sources.append(self)
        stream.tap = self._subscribe(topic.name, stream.arrived)

    def connect(self) -> None:
        """There is a session now: subscribe what was begun before."""
        for name, stream in self._streams.items():
            stream.tap = self._subscribe(name, stream.arrived)

    def interrupted(self) -> None:
        """The link is down: what is sent until it is back is lost, so keep how far each publisher had come."""
        self._up = False
        if len(self._kept) >= SENDERS or self.loop.time() >= self._kept_until:
            self._kept.clear()
        self._kept |= {name: (stream.flows, _progress(stream.flows)) for name, stream in self._streams.items()}

    def resumed(self) -> None:
        """It is up again."""
        self._up = True
        self._kept_until = self.loop.time() + _RESUME

    def _flows(self, topic: str) -> "Flows":
        """How far the publishers of a topic had come when the link went down; else it begins anew."""
        if self.loop.time() >= self._kept_until:
            self._kept.clear()
        flows, _ = self._kept.pop(topic, ({}, {}))
        return flows

    def window(self, topic: Topic) -> int:
        """How many messages may be on the way; 0: as many as come, the subscribers would rather lose some."""
        if topic.queues and all(queue.lossy for queue in topic.queues):
            return 0
        size = self.max_payload if topic.layout is None else topic.layout.size
        return min(WINDOW, _WINDOW_BYTES // (size + _OVERHEAD))

    def count_gap(self, topic: str, source: Source, gap: int) -> None:
        """Messages were lost on the way."""
        self.stats.lost["on the way"] += gap
        if len(self.gaps) >= SENDERS:
            self.gaps.clear()
        self.gaps[topic, source] = self.gaps.get((topic, source), 0) + gap

    # Publishers

    def open(self, topic: Topic, size: int, sender: Hashable) -> None:
        """A publisher is there."""
        stream = self._streams.get(topic.name)
        if stream is not None and sender not in stream.senders:
            stream.senders.add(sender)
            topic.remote_publishers += 1
            if isinstance(sender, int):
                stream.opened(sender)
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
            _, before = self._kept.get(name, ({}, {}))
            if self._up and before != _progress(stream.flows):  # it went on after the outage, and ends by itself
                self._kept.pop(name, None)
            stream.close()
            stream.topic.remote_publishers -= len(stream.senders)
            stream.topic.latched_sources.remove(self)

    def latched_value(self, topic: Topic) -> Sample | None:
        """The last message, if its publisher latches it."""
        last = self._streams[topic.name].last
        return last if last is not None and self._latched(topic.name) else None

    def close(self) -> None:
        for name in list(self._streams):
            self.shut_all(name)


def _progress(flows: Flows) -> dict[tuple[int, int], int]:
    """The serial that is expected of each publisher that has been heard."""
    return {key: flow.next for key, flow in flows.items() if flow.next >= 0}
