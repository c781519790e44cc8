"""Messages from zenoh on their way to the queues of their topics.

    zenoh's ring -> SubscriptionReader -> RxStream (packets) -> Topic.deliver (messages) -> credit

Each topic has a stream, and its own bounded ring inside zenoh, so that no topic delays another. A non real-time message
waits as long as the topic's subscribers have no room, and later ones wait behind it. The publisher's class decides
whether the publisher waits too, or goes on without these subscribers (r2p.protocols.flow_control). Events and periodic
messages wait a few turns of the event loop, then they replace older messages.
"""

import itertools
from collections.abc import Hashable

import msgspec
import zenoh

from r2p.codecs import UnknownType
from r2p.codecs.attachment import HEADER_MAX, SERIAL_WRAP, Credit, HeaderReader, Origin, encode_credit, split
from r2p.codecs.management import ANY_TYPE
from r2p.errors import DecodeError
from r2p.protocols.discovery.events import TopicType
from r2p.protocols.flow_control import CREDIT_BYTES, UNCOUNTED_BYTES, ReceiveWindow
from r2p.protocols.time_left import TimeLeft
from r2p.runtime.backpressure import Sink
from r2p.runtime.sample import LastReceived, PublisherClass, Sample, Source
from r2p.runtime.topic import Topic
from r2p.transports.announcement import asked_type
from r2p.transports.link import MESSAGES_PER_TURN, Hub, Link
from r2p.transports.receive_backpressure import Backlog
from r2p.transports.zenoh.large import LARGE, keep_freed_memory
from r2p.transports.zenoh.session import SubscriptionReader, ZenohSession

RING = 4096
"""Packets of one topic that zenoh keeps; of more, it loses the oldest."""

_RING_MIN = 64  # ... where messages may be long
_RING_BYTES = 64 << 20  # bytes of those, if all were as long as the topic's messages may be
_RING_UNKNOWN = 512  # ... without a type, when all that is known of the messages is that they have 64 MiB at most

WINDOW = RING // 2
"""Messages of one publisher on the way to one subscriber's module, at most: zenoh keeps two windows of short ones, each
in a packet of its own.
"""

_WINDOW_BYTES = 192 * 1024  # bytes of all but long ones, which the publisher limits: five topics fit into 1 MB
_UNKNOWN_SIZE = 1024  # bytes that the messages of a topic without a type are expected to have, at most
_OVERHEAD = 32  # bytes of a message besides its payload, in a packet of several: its stamp and its share of the header
_FINAL_CREDITS_MAX = 256  # sessions that learn that a topic is no longer subscribed to; older ones may be long gone
_SENDERS_MAX = 4096  # senders whose serials a stream remembers, and topics whose serials outlast an outage
_RESUME_S = 10.0  # seconds after a link came up in which its topics are subscribed again, or are used on another link

_NRT = PublisherClass.NON_REAL_TIME

ReceiveWindows = dict[tuple[int, PublisherClass], ReceiveWindow]
"""The progress of each session in each class."""


class RemotePublisher(msgspec.Struct, eq=False):
    """A publisher in another module, by one sender of its messages: its own module, or a gateway.

    `size` is that of its messages in bytes, -1: any; `last_size` and `sequence` are those of the last message (but
    `last_size` only if its bytes need not be counted).
    `last_received` is shared by all ways of its messages, by other gateways and other links.
    """

    origin: Origin
    source: Source
    publisher_class: PublisherClass
    window: ReceiveWindow
    size: int
    type_fits: bool
    last_received: LastReceived
    last_size: int = -1
    sequence: int = 0
    time_left: TimeLeft = msgspec.field(default_factory=TimeLeft)


class RxStream:
    """The received messages of one topic."""

    def __init__(self, topic: Topic, receiver: "ZenohReceiver", windows: ReceiveWindows) -> None:
        self.topic = topic
        self.senders: set[Hashable] = set()
        """Modules whose discovery announced a publisher of the topic."""
        self.reader: SubscriptionReader | None = None
        self.last: Sample | None = None
        self.windows = windows
        """Sessions in the order of their last use."""
        self.backlog = Backlog(receiver.loop, receiver.link.stats.lost, self._deliver, self._resume)
        self._stats = receiver.link.stats
        self._receiver = receiver
        self._loop = receiver.loop
        self._paused = False
        self._type = asked_type(topic)
        self._bound, self._long = self._limits()
        self._headers = HeaderReader(self._new_publisher)

    def update(self) -> None:
        """Apply a change of the topic's type, or of the number of messages on the way."""
        self._bound, self._long = self._limits()
        topic_type = asked_type(self.topic)
        if topic_type != self._type:
            self._type = topic_type
            for publisher in self._headers.known.values():
                self._check_type(publisher)
        size = self._receiver.window(self.topic)
        for (_, publisher_class), window in self.windows.items():
            if publisher_class == _NRT and window.size != size:
                window.resize(size)

    def _limits(self) -> tuple[int, bool]:
        """Return the bytes of the longest message, and whether messages may be so long that their bytes are counted."""
        layout, link = self.topic.received_layout, self._receiver.link
        if layout is None:
            return link.max_payload, True
        if not layout.varies:
            return layout.size, layout.size > UNCOUNTED_BYTES
        if link.gateway_hooks is not None:  # other modules may have other bounds: no part of the type
            return link.max_payload, True
        return max((queue.size_max for queue in self.topic.queues), default=layout.size), True

    def fingerprint_of(self, source: Source) -> bytes:
        """Return the fingerprint in the headers of a publisher's messages; ANY_TYPE for headers without one."""
        origins = (each.origin for each in self._headers.known.values() if each.source == source)
        return next((origin.fingerprint for origin in origins), ANY_TYPE)

    def add_session(self, session: int) -> None:
        """Remember a publisher's module, which gets a final credit even if none of its messages has arrived yet."""
        self._window(session, _NRT)

    def remove_sender(self, sender: Hashable) -> None:
        """Forget a publisher's module: after its return, its repeated messages count as new."""
        if sender in self.senders:
            self.senders.discard(sender)
            self.topic.remote_publishers -= 1
            for key, publisher in self._headers.known.items():
                if publisher.origin.sender == sender:
                    self._headers.forget(key)
        for (session, _), window in self.windows.items():
            if session == sender:
                window.restart()

    def close(self) -> None:
        reader, self.reader = self.reader, None
        if reader is not None:
            reader.close()
        self._send_final_credits()
        dropped = self.backlog.clear()
        if dropped:
            self._stats.lost["not subscribed"] += dropped

    def _send_final_credits(self) -> None:
        """Inform publishers that messages still on the way are no longer wanted."""
        latest = itertools.islice(reversed(self.windows.items()), _FINAL_CREDITS_MAX)
        for (session, publisher_class), window in latest:
            last = (window.next_serial - 1) & SERIAL_WRAP if window.next_serial >= 0 else 0
            send = self._receiver.send_credit
            self._stats.lost.guard(send, self.topic.name, session, publisher_class, last, leaving=True)

    # Packets

    def on_packet(self, packet: zenoh.Sample | None) -> None:
        """Deliver this packet and those behind it, about MESSAGES_PER_TURN messages in a turn of the loop."""
        reader = self.reader
        if reader is None:
            return
        left = MESSAGES_PER_TURN
        while packet is not None and left > 0:
            try:
                attachment = packet.attachment
                header = b"" if attachment is None or len(attachment) > HEADER_MAX else attachment.to_bytes()
                left -= self._unpack(packet.payload, header)
            except Exception as error:  # noqa: BLE001 - counted and logged; the next packet follows
                self._stats.lost.internal_error(error)
                left -= 1
            if self.backlog.blocked is not None and not self.backlog.holds:
                self._paused = True  # the rest stays in zenoh's ring for now
                return
            packet = reader.receive()
        if packet is None:
            # Behind the readers that these messages woke: their answers go out before the switch to the thread.
            self._loop.call_soon(self._check_again)
        else:
            self._loop.call_soon(self.on_packet, packet)

    def _resume(self) -> None:
        """Go on reading if that was paused."""
        if self._paused:
            self._paused = False
            if self.reader is not None:
                self.on_packet(self.reader.receive())

    def _check_again(self) -> None:
        reader = self.reader
        if reader is not None:
            packet = reader.receive()
            if packet is None:
                reader.wait()
            else:
                self.on_packet(packet)

    def _unpack(self, payload: zenoh.ZBytes, header: bytes) -> int:
        """Deliver the messages of one packet; return how many they are."""
        size = len(payload)
        try:
            publisher, serial, sequence, stamps, deadline, hops, stamped, clock, lengths = self._headers.read(header)
            if 0 < size <= self._bound and not lengths and len(stamps) == 1:
                parts = [payload.to_bytes()]
            else:
                parts = _split(payload, len(stamps), lengths, self._bound)
        except DecodeError as error:
            self._stats.lost["unknown type" if isinstance(error, UnknownType) else "undecodable"] += 1
            return 1
        if not parts:
            return self._refuse(publisher, serial, size)
        # Sequence 0 means that it is not known, so it is 0 in each message of the packet.
        source, publisher_class, step = publisher.source, publisher.publisher_class, 1 if sequence else 0
        samples: list[Sample] = []
        for part, stamp in zip(parts, stamps, strict=True):
            samples.append(
                Sample(part, source, stamp, deadline, sequence, publisher_class, None, stamped, True, hops, clock)
            )
            sequence += step
        if deadline:
            self._set_expiry(publisher, samples)
        first = samples[0]
        if lengths:
            size_fits = publisher.type_fits and publisher.size < 0 and max(lengths) <= min(self._bound, UNCOUNTED_BYTES)
        else:
            size_fits = len(first.data) == publisher.last_size
        # The hot path: the expected next messages, whose bytes need not be counted. All others are checked one by one.
        if (
            size_fits
            and serial == publisher.window.next_serial
            and (first.sequence > publisher.last_received.sequence or not sequence)
        ):
            self._note_expected(publisher, serial, samples, size)
            self._take(publisher, serial, samples)
        else:
            for number, sample in enumerate(samples, serial):
                if self._is_new(publisher, number, sample):
                    self.last = sample if self._keeps(sample) else None
                    self._take(publisher, number, [sample])
        return len(samples)

    def _keeps(self, sample: Sample) -> bool:
        """Return whether to keep a message as the last one: a large one only if its publisher latches it."""
        return len(sample.data) <= LARGE or self._receiver.link.latched(self.topic.name)

    def _refuse(self, publisher: RemotePublisher, serial: int, size: int) -> int:
        """Count a message that is longer than any of this topic can be, or empty without lengths that say so."""
        if self._size_fits(publisher, size):
            self._stats.lost["wrong size"] += 1
        self._reject(publisher, serial)
        return 1

    def _set_expiry(self, publisher: RemotePublisher, samples: list[Sample]) -> None:
        """Translate the deadline to this computer's clock."""
        clock = self._receiver.clock
        now, utc = clock.monotonic(), clock.now()  # once for the packet: its messages arrived together
        for sample in samples:
            sample.expires = utc + publisher.time_left.left(now, sample.stamp, sample.deadline)

    def _note_expected(self, publisher: RemotePublisher, serial: int, samples: list[Sample], size: int) -> None:
        """Note a packet of expected messages with so many bytes: `_is_new` for all at once."""
        self.last = last = samples[-1]
        last_received, count = publisher.last_received, len(samples)
        publisher.window.next_serial = serial + count & SERIAL_WRAP
        publisher.sequence = last_received.sequence = last.sequence
        last_received.stamp = last.stamp
        self._stats.received += count
        self._stats.bytes_received += size

    # Messages: several only if their bytes need not be counted

    def _take(self, publisher: RemotePublisher, serial: int, samples: list[Sample]) -> None:
        """Deliver new messages, or put them behind a blocked one; events and periods overtake one that waits without a
        limit.
        """
        backlog = self.backlog
        if backlog.blocked is None:
            self._deliver(publisher, serial, samples)
        elif publisher.publisher_class != _NRT and backlog.holds:
            for sample in samples:
                for sink in self._deliver_to_topic(sample) or ():
                    self._stats.lost.guard(sink.force, sample)
            self._acknowledge(publisher, serial, samples)
        elif not self._append(publisher, serial, samples):
            self._stats.lost["receive queue full"] += len(samples)

    def _deliver(self, publisher: RemotePublisher, serial: int, samples: list[Sample] | None) -> None:
        """Deliver messages, up to one that has to wait for room; the others wait behind it. None: acknowledge one."""
        if samples is None:  # of unknown size: where it may be long, with credit at once
            self._acknowledge(publisher, serial, None)
            return
        at, count = 0, len(samples)
        while at < count:
            taken = self.topic.deliver_run(samples, at) if count - at > 1 else 0
            if not taken:
                sinks = self._deliver_to_topic(samples[at])
                if sinks is not None:
                    if at:
                        self._acknowledge(publisher, serial, samples[:at])
                    self.backlog.block(publisher, serial + at, samples[at:], sinks)
                    return
                taken = 1
            at += taken
        self._acknowledge(publisher, serial, samples)

    def _deliver_to_topic(self, sample: Sample) -> list[Sink] | None:
        """Hand a message to the topic; return the sinks without room. A message that raises is lost, and counted."""
        try:
            return self.topic.deliver(sample)
        except Exception as error:  # noqa: BLE001 - counted and logged; the next one follows
            self._stats.lost.internal_error(error)
            return None

    def _append(self, publisher: RemotePublisher, serial: int, samples: list[Sample] | None) -> bool:
        fits = self.backlog.append(publisher, serial, samples)
        if not fits:  # they get no acknowledgement of their own, so the next credit comes earlier
            publisher.window.skip(1 if samples is None else len(samples))
        return fits

    def _acknowledge(self, publisher: RemotePublisher, serial: int, samples: list[Sample] | None) -> None:
        """Note that the queues accepted messages, and grant their publisher credit now and then."""
        if samples is None:
            size, count = CREDIT_BYTES if self._long else 0, 1
        else:
            size, count = len(samples[0].data), len(samples)
        if publisher.window.accept(size, count):
            self._send_credit(publisher, serial + count - 1)

    def _send_credit(self, publisher: RemotePublisher, serial: int) -> None:
        publisher.window.credit_sent()
        origin, send = publisher.origin, self._receiver.send_credit
        self._stats.lost.guard(send, self.topic.name, origin.sender, origin.publisher_class, serial)

    def _is_new(self, publisher: RemotePublisher, serial: int, sample: Sample) -> bool:
        """Return whether the sample is a new message of the right type; all else is counted here."""
        size, sequence = len(sample.data), sample.sequence
        if size != publisher.last_size:
            if not self._size_fits(publisher, size):
                self._reject(publisher, serial)
                return False
            if size <= UNCOUNTED_BYTES:
                publisher.last_size = size
        if not self._advance(publisher, serial):
            self._stats.lost["repeated"] += 1
            return False
        if not publisher.last_received.accept(sequence, sample.stamp):
            self._drop_duplicate(publisher, serial, sequence)
            return False
        publisher.sequence = sequence
        self._stats.received += 1
        self._stats.bytes_received += size
        return True

    def _size_fits(self, publisher: RemotePublisher, size: int) -> bool:
        """Return whether a publisher's messages may have this many bytes; those that may not are counted."""
        if not publisher.type_fits:
            self._stats.lost["wrong type"] += 1
        elif publisher.size >= 0 and size != publisher.size:
            self._stats.lost["wrong size"] += 1
        elif size > self._bound:
            self._stats.lost["too long"] += 1
            for queue in self.topic.queues:
                queue.too_long += 1
        else:
            return True
        return False

    def _advance(self, publisher: RemotePublisher, serial: int) -> bool:
        """Count the gap before this serial. Return False for a serial that arrived before."""
        gap = publisher.window.advance(serial)
        if gap > 0:
            self._stats.lost["on the way"] += gap
            publisher.window.skip(gap)
        return gap >= 0

    def _reject(self, publisher: RemotePublisher, serial: int) -> None:
        """Acknowledge a message of the wrong type: it is not a gap, as it was counted, and its publisher must not wait
        for it. The acknowledgement waits behind the messages before it.
        """
        if publisher.window.next_serial >= 0 and not self._advance(publisher, serial):
            return  # serials are counted from the first message that is of use
        if self.backlog.blocked is None or publisher.publisher_class != _NRT:
            self._acknowledge(publisher, serial, None)
        else:
            self._append(publisher, serial, None)

    def _drop_duplicate(self, publisher: RemotePublisher, serial: int, sequence: int) -> None:
        """Drop a duplicate: of this sender, which repeats it until it is acknowledged, or of another one."""
        if sequence == publisher.sequence:
            origin = publisher.origin
            self._receiver.send_credit(self.topic.name, origin.sender, origin.publisher_class, serial)
        else:
            publisher.sequence = sequence
            self._stats.lost["seen before"] += 1
            self._acknowledge(publisher, serial, None)

    # Publishers

    def _new_publisher(self, origin: Origin) -> RemotePublisher:
        key = origin.sender, origin.publisher_class
        publisher = RemotePublisher(
            origin,
            Source(origin.module, origin.node, self._receiver.link.name),
            origin.publisher_class,
            self._window(*key),
            -1,  # until `_check_type`, as well as the next one
            False,
            # By the run of the module, on any way; firmware has no such number, so there by the sender.
            self.topic.last_received((origin.instance or key, origin.module, origin.node, origin.publisher_class)),
        )
        self._check_type(publisher)
        return publisher

    def _window(self, session: int, publisher_class: PublisherClass) -> ReceiveWindow:
        window = self.windows.pop((session, publisher_class), None)
        if window is None:
            if len(self.windows) >= _SENDERS_MAX:
                self.windows.clear()  # bounded memory comes before counting gaps: each window begins anew
            window = ReceiveWindow(self._receiver.window(self.topic) if publisher_class == _NRT else 0)
        self.windows[session, publisher_class] = window  # as the last entry
        return window

    def _check_type(self, publisher: RemotePublisher) -> None:
        publisher.type_fits = self._type.fits(TopicType(0, publisher.origin.fingerprint))
        publisher.size = (self._type.exact_size or -1) if publisher.type_fits else -1
        publisher.last_size = -1


class ZenohReceiver:
    """All topics that a link receives."""

    def __init__(self, link: Link, hub: Hub) -> None:
        self.link = link
        self.loop = hub.space.loop
        self.clock = hub.space.clock
        self._instance = hub.instance
        self._session: ZenohSession | None = None
        self._prefix = ""
        self._streams: dict[str, RxStream] = {}
        self._kept: dict[str, tuple[ReceiveWindows, dict[tuple[int, PublisherClass], int]]] = {}
        """The windows of each topic when the link went down, with their progress."""
        self._kept_until = 0.0
        self._up = False

    def subscribe(self, topic: Topic) -> None:
        """Subscribe to a topic, or apply another type of it."""
        stream = self._streams.get(topic.name)
        if stream is not None and stream.topic is topic:
            stream.update()
            return
        stream = self._streams[topic.name] = RxStream(topic, self, self._resume_windows(topic.name))
        topic.latched_sources.append(self)
        self._start_reading(stream)

    def connect(self, session: ZenohSession, prefix: str) -> None:
        """Use this session; subscribe to the topics opened before."""
        self._session = session
        self._prefix = prefix
        for stream in self._streams.values():
            self._start_reading(stream)

    def _start_reading(self, stream: RxStream) -> None:
        if self._session is not None:
            key = f"{self._prefix}/topic/{stream.topic.name}"
            stream.reader = self._session.subscribe(key, _ring_of(stream.topic), stream.on_packet)

    def send_credit(
        self, topic: str, session: int, publisher_class: PublisherClass, serial: int, *, leaving: bool = False
    ) -> None:
        """Report to a publisher's session that its messages up to this serial were accepted.

        `leaving`: the topic is no longer subscribed to, in any class.
        """
        if self._session is not None:
            data = encode_credit(Credit(self._instance, publisher_class, serial, topic, leaving))
            self._session.put(f"{self._prefix}/credit/{session:x}", data, final=leaving)

    def on_down(self) -> None:
        """Keep each publisher's progress when the link goes down, as its messages meanwhile are lost."""
        self._up = False
        if len(self._kept) >= _SENDERS_MAX or self.loop.time() >= self._kept_until:
            self._kept.clear()  # what was kept at an earlier outage, and is not used
        self._kept |= {name: (stream.windows, _progress(stream.windows)) for name, stream in self._streams.items()}

    def on_up(self) -> None:
        """Use the kept progress for a while: the link is up again."""
        self._up = True
        self._kept_until = self.loop.time() + _RESUME_S

    def _resume_windows(self, topic: str) -> ReceiveWindows:
        """Return the publishers' progress when the link went down, if that was not long ago."""
        if self.loop.time() >= self._kept_until:
            self._kept.clear()
        windows, _ = self._kept.pop(topic, ({}, {}))
        return windows

    def window(self, topic: Topic) -> int:
        """Return how many messages may be on the way; 0: any number, as the subscribers are lossy."""
        if topic.queues and all(queue.lossy for queue in topic.queues):
            return 0
        size = _UNKNOWN_SIZE if topic.layout is None else topic.layout.size
        if topic.accepted:
            size = max(each.size for each in topic.accepted)
        return min(_ring(size) // 2, _WINDOW_BYTES // (min(size, UNCOUNTED_BYTES) + _OVERHEAD))

    # Publishers

    def fingerprint_of(self, topic: str, source: Source) -> bytes:
        """Return the fingerprint in the headers of a publisher's messages; ANY_TYPE for headers without one."""
        stream = self._streams.get(topic)
        return ANY_TYPE if stream is None else stream.fingerprint_of(source)

    def add_publisher(self, topic: Topic, sender: Hashable) -> None:
        """Add a module that publishes the topic."""
        self.subscribe(topic)
        stream = self._streams[topic.name]
        if sender not in stream.senders:
            stream.senders.add(sender)
            topic.remote_publishers += 1
            if isinstance(sender, int):
                stream.add_session(sender)
            for queue in topic.queues:
                queue.publisher_joined()

    def remove_publisher(self, name: str, sender: Hashable) -> None:
        """Remove a module that published the topic; its messages may still be on the way."""
        stream = self._streams.get(name)
        if stream is not None:
            stream.remove_sender(sender)

    def unsubscribe(self, name: str) -> None:
        """End the subscription of a topic."""
        stream = self._streams.pop(name, None)
        if stream is not None:
            _, before = self._kept.get(name, ({}, {}))
            if self._up and before != _progress(stream.windows):  # it went on after the outage, and ends by itself
                self._kept.pop(name, None)
            stream.close()
            stream.topic.remote_publishers -= len(stream.senders)
            stream.topic.latched_sources.remove(self)

    def latched_value(self, topic: Topic) -> Sample | None:
        """Return the last message, if its publisher latches it."""
        last = self._streams[topic.name].last
        return last if last is not None and self.link.latched(topic.name) else None

    def close(self) -> None:
        for name in list(self._streams):
            self.unsubscribe(name)
        self._session = None


def _split(payload: zenoh.ZBytes, count: int, lengths: tuple[int, ...], bound: int) -> list[bytes]:
    """Return the messages of a payload; none, and no copy of it, if it is longer than they can be, or empty where no
    lengths say so. Raises DecodeError.
    """
    size = len(payload)
    if count == 1 and not lengths:
        return []
    ends = split(size, count, lengths)
    if count == 1 and size > bound:
        return []
    if size > LARGE:
        keep_freed_memory()
    data = payload.to_bytes()  # the only copy of a large message, which travels alone
    return [data] if count == 1 else [data[at:end] for at, end in zip([0, *ends], ends, strict=False)]


def _ring_of(topic: Topic) -> int:
    """Return how many packets zenoh keeps for a topic."""
    return _RING_UNKNOWN if topic.layout is None else _ring(topic.layout.size)


def _ring(size: int) -> int:
    """Return how many packets zenoh keeps of messages that have so many bytes at most."""
    return RING if size * RING <= _RING_BYTES else max(_RING_MIN, _RING_BYTES // size)


def _progress(windows: ReceiveWindows) -> dict[tuple[int, PublisherClass], int]:
    """The next serial of each publisher from which a message has arrived."""
    return {key: window.next_serial for key, window in windows.items() if window.next_serial >= 0}
