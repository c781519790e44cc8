"""Messages on their way to zenoh: grouped into packets, and sent by one of zenoh's publishers.

Messages without a pause in between go out in few packets. Each is a payload of messages one after the other, with one
header for all (r2p.codecs.attachment): handing each message to zenoh separately would take both ends longer than
everything else. So the first message goes out at once, and later ones of the same turn go together at its end.
"""

import asyncio
import functools
from collections.abc import Callable, Iterator
from itertools import groupby

import msgspec
import zenoh

from r2p.codecs.attachment import PACKET_MAX, VERSION, VERSION_LENGTHS, Header, Origin, Packer, encode, start_of
from r2p.codecs.management import ANY_TYPE
from r2p.protocols.flow_control import SendWindow
from r2p.runtime.backpressure import LINK_DOWN
from r2p.runtime.sample import PublisherClass, Sample, Source
from r2p.runtime.topic import Topic
from r2p.transports.stats import LinkStats
from r2p.transports.zenoh.large import LARGE, LargePacket, LargeSender
from r2p.transports.zenoh.session import ZenohSession
from r2p.transports.zenoh.threads import PENDING_MAX, PENDING_URGENT_MAX

Put = Callable[..., None]
"""`Publisher.put(data, *, attachment)` of zenoh."""

BATCH_MAX = PACKET_MAX
"""Messages that wait in a stream until the turn ends; more go out at once."""

_BATCH_BYTES_MAX = 16 * 1024  # bytes of a packet of several messages

FLOOD = 8
"""Messages in one turn that make a flood; slower ones go out at the end of their turn."""

FLOOD_TURNS = 12
"""Turns of the loop in which messages of a flood wait for more of them, at most."""

_NO_PACKER = Packer(Origin(PublisherClass.NON_REAL_TIME, 0, 0, ANY_TYPE))


def put_nowhere(data: bytes, *, attachment: bytes) -> None:
    """Put a packet without a session: the messages count as sent, as on a network without subscribers."""


class TxStream:
    """The messages of one topic and class on their way out, of one publisher at a time."""

    __slots__ = ("_direct_put", "_packer", "_put", "large", "samples", "source", "urgent", "varies", "window")

    def __init__(self, window: SendWindow, *, urgent: bool) -> None:
        self.window = window
        self.varies = False
        """True if the messages vary in length, so that headers carry the lengths."""
        self.large: LargeSender | None = None
        """Sends large packets; None if all messages of the topic are short."""
        self.urgent = urgent
        """True if messages never wait, not even for the end of the loop's turn."""
        self.source: Source | None = None
        self.samples: list[Sample] = []
        """Waiting samples. Each already has its serial in the window: the last one here has the window's last."""
        self._packer = _NO_PACKER
        self._put: Put = put_nowhere
        self._direct_put: Put = put_nowhere

    def prepare(self, source: Source, origin: Origin, put: Put, direct_put: Put = put_nowhere) -> None:
        """Switch to another publisher, after sending the previous one's messages. `direct_put` is for large ones."""
        self.source = source
        self._packer = Packer(origin)
        self._put = put
        self._direct_put = direct_put

    def send(self, stats: LinkStats, *, batching: bool) -> None:
        """Send waiting messages; zenoh drops them if the network is too slow.

        Messages that are not sent are counted here. Subscribers must not count them as well, so later ones get their
        serials.
        """
        all_samples, self.samples = self.samples, []
        serial = self.window.serial - len(all_samples) + 1  # each was given one when it was offered
        packets = _varying_packets if self.varies else _packets
        for samples in packets(all_samples) if batching and len(all_samples) > 1 else [[each] for each in all_samples]:
            try:
                data = samples[0].data if len(samples) == 1 else b"".join([each.data for each in samples])
                header = self._header(samples, serial)
                if self.large is not None and self.large.accepts(self.window, len(data)):
                    self._send_large(self.large, samples, serial, data, header)
                else:
                    self._put(data, attachment=header)
            except zenoh.ZError:  # the session is closed
                stats.lost[LINK_DOWN] += len(samples)
            except BlockingIOError:  # the thread that sends is behind
                stats.lost["send buffer full"] += len(samples)
            except Exception as failure:  # noqa: BLE001 - counted and logged; the next packet follows
                stats.lost.internal_error(failure, len(samples))
            else:
                stats.sent += len(samples)
                stats.bytes_sent += len(data)
                serial += len(samples)
        if self.window.serial != serial - 1:
            self.window.rewind(self.window.serial - serial + 1)

    def _send_large(self, large: LargeSender, samples: list[Sample], serial: int, data: bytes, header: bytes) -> None:
        count = len(samples)
        publisher_class = self._packer.origin.publisher_class
        last = serial + count - 1
        large.send(LargePacket(self.window, publisher_class, last, count, data, header, self._direct_put))

    def _header(self, samples: list[Sample], serial: int) -> bytes:
        first = samples[0]
        hops = first.hops + bool(first.source.link)  # messages from another link cross this gateway
        if first.clock is None:  # nearly always: packed in one call, without a `Header`
            start = start_of(hops, stamped=first.stamped, version=VERSION_LENGTHS if self.varies else VERSION)
            if self.varies:
                stamps, lengths = [each.stamp for each in samples], [len(each.data) for each in samples]
                return self._packer.varying(start, serial, first.sequence, first.deadline, stamps, lengths)
            if len(samples) == 1:
                return self._packer.one(start, serial, first.sequence, first.stamp, first.deadline)
            stamps = [each.stamp for each in samples]
            return self._packer.several(start, serial, first.sequence, first.deadline, stamps)
        more = tuple([each.stamp for each in samples[1:]])
        origin, clock = self._packer.origin, first.clock
        header = Header(origin, serial, first.sequence, first.stamp, first.deadline, hops, first.stamped, clock, more)
        if self.varies:
            header = msgspec.structs.replace(header, lengths=tuple([len(each.data) for each in samples]))
        return encode(header)


def _packets(samples: list[Sample]) -> Iterator[list[Sample]]:
    """Group messages that may share a packet: of one size, counting on, with one header that is true for all."""
    for run in _runs(samples, sized=True):
        most = max(1, _BATCH_BYTES_MAX // max(1, len(run[0].data)))
        for at in range(0, len(run), most):
            yield run[at : at + most]


def _varying_packets(samples: list[Sample]) -> Iterator[list[Sample]]:
    """Group messages of any size that may share a packet."""
    for run in _runs(samples, sized=False):
        packet: list[Sample] = []
        size = 0
        for sample in run:
            size += len(sample.data)
            if packet and size > _BATCH_BYTES_MAX:
                yield packet
                packet, size = [], len(sample.data)
            packet.append(sample)
        yield packet


def _runs(samples: list[Sample], *, sized: bool) -> Iterator[list[Sample]]:
    """Split messages into runs that may share a header; those in a run are of one size, if `sized`."""
    count = len(samples)
    keys = [
        (
            each.sequence and each.sequence - at + count,  # 0: not known
            sized and len(each.data),
            each.deadline,
            each.hops,
            each.stamped,
            each.clock,
        )
        for at, each in enumerate(samples)
    ]
    if keys.count(keys[0]) == count:  # nearly always
        yield samples
        return
    for _, places in groupby(range(count), keys.__getitem__):
        yield [samples[at] for at in places]


class Batcher:
    """Decides when the streams of one link send: the first message at once, the others when the turn is over."""

    def __init__(self, loop: asyncio.AbstractEventLoop, stats: LinkStats, *, batching: bool) -> None:
        """`batching`: several messages may share a payload."""
        self._loop = loop
        self._batching = batching
        self._stats = stats
        self._turn_begun = False
        self._turns = 0
        self._count = 0
        self._streams: dict[TxStream, None] = {}

    def add(self, stream: TxStream) -> None:
        """Send soon: the stream has become non-empty, or full."""
        if not self._turn_begun:  # so a message that comes alone is not held up
            self._turn_begun = True
            self._loop.call_soon(self._end_turn)
        elif not stream.urgent and len(stream.samples) < BATCH_MAX:
            self._streams[stream] = None
            return
        stream.send(self._stats, batching=self._batching)

    def send(self, stream: TxStream) -> None:
        """Send the waiting messages of this stream."""
        if self._streams.pop(stream, stream) is None:
            stream.send(self._stats, batching=self._batching)

    def send_now(self, stream: TxStream) -> None:
        """Send the messages of this stream: the last one is too large to wait for others."""
        self._streams.pop(stream, None)
        stream.send(self._stats, batching=self._batching)

    def flush(self) -> None:
        """Send the waiting messages of all streams."""
        streams, self._streams = self._streams, {}
        self._turns = self._count = 0
        for stream in streams:
            stream.send(self._stats, batching=self._batching)

    def discard(self) -> int:
        """Drop waiting messages, and return their number. They are counted here, so later ones get their serials."""
        streams, self._streams = self._streams, {}
        count = sum(len(stream.samples) for stream in streams)
        for stream in streams:
            stream.window.rewind(len(stream.samples))
            stream.samples.clear()
        return count

    def _end_turn(self) -> None:
        """Send waiting messages, unless they are a growing flood: a turn later makes fewer and fuller packets."""
        count = sum([len(stream.samples) for stream in self._streams])
        self._turn_begun = count > 0
        if self._turn_begun:
            self._loop.call_soon(self._end_turn)
        self._turns += 1
        if self._batching and count >= self._count + FLOOD and self._turns < FLOOD_TURNS:
            self._count = count
        else:
            self.flush()


class PublisherCache:
    """The zenoh publishers of one link, and the windows of their messages; they outlast subscribers.

    There is one publisher for each topic and class, declared as soon as the topic is published: so zenoh looks for a
    route before the first subscriber is there.
    """

    def __init__(self) -> None:
        self._session: ZenohSession | None = None
        self._prefix = ""
        self._publishers: dict[tuple[str, PublisherClass], zenoh.Publisher] = {}
        self._large: set[str] = set()  # topics whose messages may be large
        self._asked: set[str] = set()
        self._answers: dict[str, bool] = {}
        self._windows: dict[tuple[str, PublisherClass], SendWindow] = {}

    def connect(self, session: ZenohSession, prefix: str) -> None:
        """Use this session; the key of a topic is its name behind the prefix."""
        self._session = session
        self._prefix = prefix

    def close(self) -> None:
        """Stop sending; declarations end with the session."""
        self._session = None

    def declare(self, topic: Topic, size: int) -> bool:
        """Declare the publishers of a published topic, whose messages have at most `size` bytes (0: unknown).

        Return True if earlier publishers of the topic were replaced: large messages have priorities of their own.
        """
        replaced = (topic.name in self._large) != (size > LARGE)
        if replaced:
            self.undeclare(topic.name)
            self._large ^= {topic.name}
        classes = {publisher.publisher_class for publisher in topic.publishers}
        for publisher_class in classes or {PublisherClass.NON_REAL_TIME}:  # none in this module: a gateway passes it on
            self._publisher(topic.name, publisher_class)
        return replaced

    def undeclare(self, topic: str) -> None:
        """Undeclare the publishers of a topic."""
        for key in [key for key in self._publishers if key[0] == topic]:
            publisher = self._publishers.pop(key)
            if self._session is not None:
                self._session.undeclare_publisher(publisher, large=topic in self._large)

    def reaches(self, topic: str) -> bool:
        """Return whether zenoh knows a subscriber that messages of the topic reach; False until zenoh answers."""
        publishers = [publisher for (name, _), publisher in self._publishers.items() if name == topic]
        if not publishers or self._session is None:
            return False
        outbound = self._session.outbound
        if not outbound.uses_thread:  # else zenoh may take long to answer: the result is there at a later call
            return all(_reaches(publisher) for publisher in publishers)
        answer = self._answers.pop(topic, None)
        if answer is None and topic not in self._asked:
            self._asked.add(topic)
            answered = functools.partial(self._answered, topic)
            outbound.submit(lambda: all(_reaches(publisher) for publisher in publishers), then=answered)
        return bool(answer)

    def _answered(self, topic: str, reached: bool | None) -> None:
        self._asked.discard(topic)
        self._answers[topic] = bool(reached)

    def put(self, topic: str, publisher_class: PublisherClass) -> Put:
        """Return the function that sends packets of the topic. It raises BlockingIOError if too many wait already."""
        publisher = self._publisher(topic, publisher_class)
        if publisher is None or self._session is None:
            return put_nowhere
        most = PENDING_MAX if publisher_class == PublisherClass.NON_REAL_TIME else PENDING_URGENT_MAX
        outbound, send = self._session.outbound, publisher.put

        def put(data: bytes, *, attachment: bytes) -> None:
            if outbound.uses_thread:
                outbound.submit(lambda: send(data, attachment=attachment), max_pending=most)
            else:  # no `call`: this is the way of each packet
                send(data, attachment=attachment)

        return put

    def direct_put(self, topic: str, publisher_class: PublisherClass) -> Put:
        """Return zenoh's function for packets of the topic, which may wait."""
        publisher = self._publisher(topic, publisher_class)
        return put_nowhere if publisher is None else publisher.put

    def _publisher(self, topic: str, publisher_class: PublisherClass) -> zenoh.Publisher | None:
        key = topic, publisher_class
        if key not in self._publishers and self._session is not None:
            self._publishers[key] = self._session.declare_publisher(
                f"{self._prefix}{topic}", publisher_class, large=topic in self._large
            )
        return self._publishers.get(key)

    def window(self, topic: str, publisher_class: PublisherClass) -> SendWindow:
        """Return the window of a topic in a class; it counts on for as long as the link lives."""
        return self._windows.setdefault((topic, publisher_class), SendWindow())


def _reaches(publisher: zenoh.Publisher) -> bool:
    # The stubs of zenoh promise a bool; the result is an object with one, and is itself always true.
    status: object = publisher.matching_status
    return bool(getattr(status, "matching", status))
