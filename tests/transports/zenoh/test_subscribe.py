"""What comes in of one topic, packet by packet; a stand-in takes zenoh's place."""

import asyncio
from collections import Counter, deque
from types import SimpleNamespace
from typing import Annotated, Any

import pytest
import zenoh

import r2p
from r2p.clock import clock_of
from r2p.codecs import PublisherClass, attachment
from r2p.codecs.attachment import Header, Origin
from r2p.messages import SIZE_MAX, layout
from r2p.msg import Led
from r2p.runtime.backpressure import Sink
from r2p.runtime.queues import SubscriberQueue, WakeScheduler
from r2p.runtime.sample import Sample
from r2p.runtime.topic import Topic
from r2p.transports import receive_backpressure
from r2p.transports.stats import LinkStats
from r2p.transports.zenoh.subscribe import WINDOW, RxStream, ZenohReceiver

pytestmark = pytest.mark.virtual_time

SIZE = layout(Led).size


class Note(r2p.Message):
    """Up to 100 bytes with the count."""

    text: Annotated[str, r2p.Max(96)] = ""


class Scan(r2p.Message):
    """250 kB, of which zenoh keeps as many as fit into 64 MiB."""

    data: Annotated[bytes, r2p.Max(250_000)] = b""


class Long(r2p.Message):
    """The same, with another bound."""

    text: Annotated[str, r2p.Max(1_000_000)] = ""


class Uncopied:
    """A payload that is too long to be copied."""

    def __init__(self, size: int) -> None:
        self._size = size

    def __len__(self) -> int:
        return self._size


class Ring:
    """A topic `leds` with a subscriber, and what waits for it in zenoh."""

    def __init__(
        self, queue: int, *, typed: bool = True, topic: type[Topic] = Topic, kind: type[r2p.Message] = Led
    ) -> None:
        loop = asyncio.get_running_loop()
        self.credits: list[tuple[int, int]] = []
        self.last_words = 0
        self.stats = LinkStats()
        self.wake_scheduler = WakeScheduler(loop)
        self.topic = topic("leds", self.wake_scheduler)
        self.topic.layout = layout(kind) if typed else None
        self._ring: deque[Any] = deque()
        self._idle = True
        hub: Any = SimpleNamespace(space=SimpleNamespace(loop=loop, clock=clock_of(loop)), instance=1)
        link: Any = SimpleNamespace(
            name="zenoh:", stats=self.stats, max_payload=SIZE_MAX, latched=lambda _: False, gateway_hooks=None
        )
        self.receiver = ZenohReceiver(link, hub)
        session: Any = SimpleNamespace(subscribe=self._subscribe, put=self._put_credit)
        self.receiver.connect(session, "r2p/lab")
        self.sink = self.subscribe(queue)
        self.sink.size_max = self.topic.layout.size if self.topic.layout is not None else SIZE_MAX
        self.receiver.subscribe(self.topic)

    def subscribe(self, queue: int) -> SubscriberQueue:
        owner: Any = SimpleNamespace(name="node", priority=0)
        sink = SubscriberQueue(self.wake_scheduler, owner, queue, lossy=False, keep_oldest=False)
        self.topic.join(sink)
        return sink

    def _subscribe(self, _key: str, _most: int, arrived: Any) -> Any:
        self._arrived = arrived
        return SimpleNamespace(receive=self._receive, wait=self._wait, close=lambda: None)

    def _put_credit(self, _key: str, data: bytes, *, final: bool) -> None:
        credit = attachment.decode_credit(data)
        assert credit.leaving == final
        self.credits.append((credit.publisher_class, credit.serial))
        self.last_words += final

    def _receive(self) -> Any:
        return self._ring.popleft() if self._ring else None

    def _wait(self) -> None:
        self._idle = True

    def idle(self) -> None:
        """It has been declared anew."""
        self._idle = True
        self._ring.clear()

    def put(
        self,
        serial: int,
        count: int = 1,
        *,
        publisher_class: int = 1,
        size: int = SIZE,
        sender: int = 7,
        deadline: int = 0,
    ) -> None:
        """So many messages in one packet; sequences are as the serials, stamps ten times as much."""
        origin = Origin(PublisherClass(publisher_class), sender, sender, bytes(8), "A", "node")
        stamps = [10 * (serial + at) for at in range(count)]
        header = attachment.encode(Header(origin, serial, serial, stamps[0], deadline, more=tuple(stamps[1:])))
        data = b"".join([(serial + at).to_bytes(size, "little") for at in range(count)])
        self.put_packet(data, header)

    def put_varying(self, serial: int, *messages: bytes, lengths: tuple[int, ...] = (), payload: object = None) -> None:
        """Messages in one packet, with their lengths; or with others."""
        origin = Origin(PublisherClass(1), 7, 7, bytes(8), "A", "node")
        lengths = lengths or tuple([len(each) for each in messages])
        stamps = tuple([10 * (serial + at) for at in range(len(lengths))])
        header = Header(origin, serial, serial, stamps[0], more=stamps[1:], lengths=lengths)
        self.put_packet(b"".join(messages) if payload is None else payload, attachment.encode(header))

    def put_packet(self, data: object, header: bytes) -> None:
        """A packet in zenoh's own objects."""
        payload = zenoh.ZBytes(data) if isinstance(data, bytes) else data
        sample = SimpleNamespace(payload=payload, attachment=zenoh.ZBytes(header))
        if self._idle:
            self._idle = False
            self._arrived(sample)
        else:
            self._ring.append(sample)


async def turns(count: int = 20) -> None:
    for _ in range(count):
        await asyncio.sleep(0)


def numbers(sink: SubscriberQueue) -> list[int]:
    return [each.sequence for each in sink.queue]


async def test_events_of_one_packet_stay_in_order_where_there_is_no_room() -> None:
    """Our own senders send each for itself; others need not."""
    ring = Ring(queue=2)
    ring.put(1, 4, publisher_class=2)
    await turns()
    assert numbers(ring.sink) == [3, 4]
    assert ring.sink.lost == 2


async def test_a_deadline_is_told_by_the_clock_here() -> None:
    """The sender's clock shows 1970; the second packet was held up for a second, if the stamps are right."""
    clock = clock_of()
    ring = Ring(queue=10)
    ring.put(1, 2, publisher_class=2, deadline=5_000_000_020)
    await turns()
    arrived = clock.now()
    await asyncio.sleep(1)
    ring.put(3, publisher_class=2, deadline=5_000_000_030)
    ring.put(4)
    await turns()
    assert [each.deadline for each in ring.sink.queue] == [5_000_000_020] * 2 + [5_000_000_030, 0]
    expected = [arrived + 5_000_000_010, arrived + 5_000_000_000, arrived + 5_000_000_000, 0]
    assert [each.expires for each in ring.sink.queue] == pytest.approx(expected, abs=2_000_000)


async def test_the_rest_of_a_packet_waits_with_the_message_that_has_no_room() -> None:
    ring = Ring(queue=2)
    ring.put(1, 5)
    ring.put(6)
    taken = []
    for _ in range(6):
        await turns()
        taken.append(ring.sink.queue.popleft().sequence)
        ring.sink.refill()
    assert taken == [1, 2, 3, 4, 5, 6]
    assert (ring.stats.received, ring.stats.lost) == (6, Counter())


async def test_what_is_lost_on_the_way_earns_credit() -> None:
    """Else a publisher would wait for what never came, if that is more than half of a window."""
    ring = Ring(queue=4 * WINDOW)
    ring.put(1)
    ring.put(WINDOW - 100, 10)
    await turns()
    assert ring.credits[:2] == [(1, 1), (1, WINDOW - 100)]
    assert ring.stats.lost == {"on the way": WINDOW - 102}


async def test_an_event_that_passes_a_message_that_waits_is_told_of() -> None:
    ring = Ring(queue=1)
    ring.put(1, 2)
    await turns()
    ring.put(1, publisher_class=2)
    await turns()
    assert (2, 1) in ring.credits
    assert ring.sink.lost == 1


async def test_a_message_of_the_wrong_size_is_counted_once() -> None:
    ring = Ring(queue=10)
    ring.put(1)
    ring.put(2, 3, size=SIZE + 1)
    ring.put(5)
    await turns()
    assert ring.stats.lost == {"wrong size": 3}
    assert numbers(ring.sink) == [1, 5]


@pytest.mark.parametrize("queue", [4 * WINDOW, 1])
async def test_messages_that_cannot_be_used_earn_credit(queue: int) -> None:
    """Else a publisher would wait for those who will never take them. They do so behind what waits for room."""
    ring = Ring(queue=queue)
    ring.put(1, 2)
    for serial in range(3, WINDOW, 64):
        ring.put(serial, 64, size=SIZE + 1)
    await turns(2 * WINDOW // 64)
    last = ring.credits[-1][1]
    assert (last == 1) == (queue == 1)
    ring.sink.queue.clear()
    ring.sink.refill()
    await turns()
    assert ring.credits[-1][1] > WINDOW // 2
    assert ring.stats.lost == {"wrong size": 2048}


async def test_serials_are_counted_from_the_first_message_that_can_be_used() -> None:
    ring = Ring(queue=10)
    ring.put(7, size=SIZE + 1)
    ring.put(7)
    await turns()
    assert (numbers(ring.sink), ring.stats.lost) == ([7], {"wrong size": 1})
    assert set(ring.credits) == {(1, 7)}


async def test_a_message_of_the_wrong_size_behind_a_gap_is_counted_once() -> None:
    ring = Ring(queue=10)
    ring.put(1)
    ring.put(4, size=SIZE + 1)
    ring.put(5)
    await turns()
    assert ring.stats.lost == {"wrong size": 1, "on the way": 2}


async def test_what_was_heard_is_still_known_when_the_type_is() -> None:
    ring = Ring(queue=10, typed=False)
    ring.put(1, 2)
    await turns()
    ring.topic.layout = layout(Led)
    ring.receiver.subscribe(ring.topic)
    ring.put(3, size=SIZE + 1)
    ring.put(4)
    await turns()
    assert ring.stats.lost == {"wrong size": 1}
    again = attachment.encode(Header(Origin(PublisherClass.NON_REAL_TIME, 8, 7, bytes(8), "A", "node"), 1, 4, 40))
    ring.receiver._streams["leds"]._unpack(zenoh.ZBytes(bytes(SIZE)), again)  # by another gateway
    assert numbers(ring.sink) == [1, 2, 4]
    assert ring.stats.lost["seen before"] == 1


async def test_what_eight_publishers_may_send_is_kept_while_nothing_is_read() -> None:
    ring = Ring(queue=1)
    for sender in range(1, 9):
        for serial in range(1, WINDOW, 64):
            ring.put(serial, 64, sender=sender)
        await turns(2 * WINDOW // 64)
    assert not ring.stats.lost
    assert ring.stats.received == 8 * WINDOW


class FaultyTopic(Topic):
    """Raises at the messages with these sequence numbers."""

    faulty: frozenset[int] = frozenset()

    def deliver(self, sample: Sample, own: object = None, driver: object = None) -> list[Sink] | None:
        if sample.sequence in self.faulty:
            raise RuntimeError(sample)
        return super().deliver(sample, own, driver)

    def deliver_run(self, samples: list[Sample], at: int) -> int:
        return 0


@pytest.mark.internal_errors
@pytest.mark.parametrize("publisher_class", [1, 2])
@pytest.mark.parametrize("queue", [3, 99])
async def test_a_message_that_raises_does_not_stop_the_others(queue: int, publisher_class: int) -> None:
    """It is as good as taken: its publisher does not wait for it."""
    ring = Ring(queue=queue, topic=FaultyTopic)
    assert isinstance(ring.topic, FaultyTopic)
    ring.topic.faulty = frozenset({2, 6, 8})
    ring.put(1, publisher_class=publisher_class)
    ring.put(2, 5, publisher_class=publisher_class)
    ring.put(7, publisher_class=publisher_class)
    ring.put(8, publisher_class=publisher_class)
    taken = []
    for _ in range(12):
        await turns()
        taken += numbers(ring.sink)
        ring.sink.queue.clear()
        ring.sink.refill()
    assert taken == [each for each in (1, 3, 4, 5, 7) if each in taken]
    assert len(taken) + ring.sink.lost == 5
    assert ring.stats.lost == {"internal error": 3}
    assert ring.receiver._streams["leds"].backlog.blocked is None


@pytest.mark.internal_errors
async def test_a_packet_that_raises_does_not_stop_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    ring = Ring(queue=99)
    unpack, stream = RxStream._unpack, ring.receiver._streams["leds"]

    def faulty(data: zenoh.ZBytes, header: bytes) -> int:
        if data.to_bytes()[0] == 2:
            raise RuntimeError(data)
        return unpack(stream, data, header)

    monkeypatch.setattr(stream, "_unpack", faulty, raising=False)
    for serial in range(1, 4):
        ring.put(serial)
    await turns()
    assert numbers(ring.sink) == [1, 3]
    assert ring.stats.lost == {"internal error": 1, "on the way": 1}


@pytest.mark.internal_errors
async def test_a_sink_that_raises_while_a_message_waits_for_it_does_not_stop_the_stream(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ring = Ring(queue=1)
    ring.put(1, 2)
    monkeypatch.setattr(SubscriberQueue, "offer", lambda *_: 1 // 0)
    await turns(3)
    monkeypatch.undo()
    ring.sink.queue.clear()
    ring.put(3)
    await turns()
    assert numbers(ring.sink) == [3]
    assert ring.stats.lost == {"internal error": 1}


def reconnect(ring: Ring) -> None:
    """The link goes down and comes up; its topics are subscribed anew then."""
    ring.receiver.on_down()
    ring.receiver.remove_publisher("leds", 7)
    ring.receiver.on_up()
    ring.receiver.unsubscribe("leds")
    ring.receiver.subscribe(ring.topic)


async def test_what_was_sent_while_the_link_was_down_is_counted_when_it_is_back() -> None:
    ring = Ring(queue=16)
    ring.put(1, 3)
    await turns()
    reconnect(ring)
    ring.idle()
    ring.put(10)
    await turns()
    assert (ring.stats.received, ring.stats.lost) == (4, Counter({"on the way": 6}))


async def test_what_was_sent_before_a_topic_is_subscribed_again_is_not_lost() -> None:
    ring = Ring(queue=16)
    ring.put(1, 3)
    await turns()
    reconnect(ring)
    ring.receiver.unsubscribe("leds")  # no subscriber is left here
    ring.receiver.subscribe(ring.topic)
    ring.idle()
    ring.put(10)
    await turns()
    assert ring.stats.lost == Counter()


async def test_what_came_by_another_link_in_the_meantime_is_not_lost() -> None:
    ring = Ring(queue=16)
    ring.put(1, 3)
    await turns()
    ring.receiver.on_down()
    ring.receiver.unsubscribe("leds")
    ring.receiver.on_up()
    await asyncio.sleep(11)  # the topic is used elsewhere
    ring.receiver.subscribe(ring.topic)
    ring.idle()
    ring.put(10)
    await turns()
    assert ring.stats.lost == Counter()


async def test_a_topic_that_went_on_after_an_outage_begins_anew_when_it_was_closed() -> None:
    ring = Ring(queue=16)
    ring.put(1, 3)
    await turns()
    ring.receiver.on_down()
    ring.receiver.on_up()
    ring.put(6)
    await turns()
    assert ring.stats.lost == {"on the way": 2}
    ring.receiver.unsubscribe("leds")  # no subscriber is left here
    ring.receiver.subscribe(ring.topic)
    ring.idle()
    ring.put(500)
    await turns()
    assert ring.stats.lost == {"on the way": 2}


async def test_a_later_outage_does_not_count_what_was_sent_before_it_without_a_subscriber() -> None:
    ring = Ring(queue=16)
    ring.put(1, 3)
    await turns()
    ring.receiver.on_down()
    ring.receiver.unsubscribe("leds")
    ring.receiver.on_up()
    await asyncio.sleep(60)
    ring.receiver.on_down()
    ring.receiver.on_up()
    ring.receiver.subscribe(ring.topic)
    ring.idle()
    ring.put(500)
    await turns()
    assert ring.stats.lost == Counter()


@pytest.mark.internal_errors
async def test_a_last_credit_that_fails_does_not_keep_the_stream() -> None:
    ring = Ring(queue=1)
    ring.receiver.add_publisher(ring.topic, 7)
    ring.put(1, 3)
    await turns()
    ring.receiver.send_credit = lambda *_, **__: 1 // 0  # type: ignore[assignment]
    ring.receiver.unsubscribe("leds")
    assert (ring.topic.remote_publishers, ring.topic.latched_sources) == (0, [])
    assert ring.stats.lost == {"internal error": 1, "not subscribed": 1}


async def test_who_unsubscribes_tells_those_of_whom_nothing_has_come_yet() -> None:
    """What they sent may be on the way."""
    ring = Ring(queue=2)
    ring.receiver.add_publisher(ring.topic, 7)
    ring.receiver.remove_publisher("leds", 7)  # as discovery does, before the stream ends
    ring.receiver.unsubscribe("leds")
    assert (ring.last_words, ring.credits) == (1, [(1, 0)])


async def test_who_unsubscribes_tells_those_who_publish_and_counts_what_waits() -> None:
    ring = Ring(queue=2)
    ring.receiver.add_publisher(ring.topic, 7)
    for serial in range(1, 5):
        ring.put(serial)
    await turns()
    ring.receiver.unsubscribe("leds")
    assert ring.last_words == 1
    assert ring.credits[-1] == (1, 4)
    assert ring.stats.received == 4
    assert (len(ring.sink.queue), ring.stats.lost) == (2, Counter({"not subscribed": 1}))  # one was being placed


def texts(ring: Ring) -> list[str]:
    """What waits in the queue, decoded."""
    return [layout(Note).decode(each.data).text for each in ring.sink.queue]


def note(text: str) -> bytes:
    return layout(Note).encode(Note(text))


async def test_a_packet_of_messages_of_several_lengths() -> None:
    ring = Ring(queue=20, kind=Note)
    ring.put_varying(1, note(""), note("two"), note("three"))
    ring.put_varying(4, note("four"))
    ring.put_varying(5, note("six"), note("s"))
    await turns()
    assert texts(ring) == ["", "two", "three", "four", "six", "s"]
    assert numbers(ring.sink) == [1, 2, 3, 4, 5, 6]
    assert ring.stats.bytes_received == sum(4 + len(each) for each in texts(ring))
    assert not ring.stats.lost


async def test_messages_without_bytes() -> None:
    class Go(r2p.Message): ...

    ring = Ring(queue=20, kind=Go)
    ring.put_varying(1, b"")
    ring.put_varying(2, b"", b"", b"")
    ring.put_varying(5, b"", b"surplus")
    await turns()
    assert numbers(ring.sink) == [1, 2, 3, 4, 5]
    assert ring.stats.lost == {"too long": 1}


async def test_lengths_that_lie_are_counted() -> None:
    ring = Ring(queue=20, kind=Note)
    ring.put_varying(1, note("a"), lengths=(4,))
    ring.put_varying(1, note("a"), note("b"), lengths=(5, 6))
    ring.put_varying(1, lengths=(2**32 - 1,) * 256, payload=Uncopied(2**32 - 1))
    ring.put_varying(1, lengths=(1, 65_536), payload=Uncopied(65_537))
    ring.put_varying(1, note("fine"))
    await turns()
    assert texts(ring) == ["fine"]
    assert ring.stats.lost == {"undecodable": 4}


class CountingTopic(Topic):
    """Notes how many messages are taken at once."""

    def __init__(self, name: str, wake_scheduler: WakeScheduler) -> None:
        super().__init__(name, wake_scheduler)
        self.runs: list[int] = []

    def deliver_run(self, samples: list[Sample], at: int) -> int:
        taken = super().deliver_run(samples, at)
        self.runs.append(taken)
        return taken


@pytest.mark.parametrize("varies", [False, True])
async def test_messages_are_taken_in_bulk_also_behind_one_that_waits(varies: bool) -> None:
    ring = Ring(queue=4, topic=CountingTopic, kind=Note if varies else Led)
    assert isinstance(ring.topic, CountingTopic)
    messages = [note("x" * number) for number in range(1, 20)]
    for serial, count in ((1, 1), (2, 8), (10, 10)):
        if varies:
            ring.put_varying(serial, *messages[serial - 1 : serial - 1 + count])
        else:
            ring.put(serial, count)
    taken: list[Sample] = []
    while len(taken) < 19:
        await turns()
        taken += ring.sink.queue
        ring.sink.queue.clear()
        ring.sink.refill()
    assert [each.sequence for each in taken] == [*range(1, 20)]
    if varies:
        assert [each.data for each in taken] == messages
    assert max(ring.topic.runs) == 3  # behind the first one, or one that had to wait
    assert (ring.stats.received, ring.stats.bytes_received) == (19, sum(len(each.data) for each in taken))
    assert not ring.stats.lost


async def test_what_is_too_long_is_counted_without_a_copy_and_granted_credit() -> None:
    ring = Ring(queue=20, kind=Note)
    ring.put_varying(1, note("a"))
    for serial in (2, 3):
        ring.put_varying(serial, lengths=(64 << 20,), payload=Uncopied(64 << 20))
    ring.put_varying(4, note("b"), bytes(101), note("c"))  # among others, of which none is lost
    await turns()
    assert texts(ring) == ["a", "b", "c"]
    assert ring.stats.lost == {"too long": 3}
    assert ring.sink.too_long == 3
    assert ring.credits == [(1, 1), (1, 2), (1, 3), (1, 5)]


async def test_the_bound_is_that_of_the_subscriber_with_the_highest() -> None:
    ring = Ring(queue=20, kind=Note)
    other = ring.subscribe(20)
    other.size_max = layout(Long).size
    ring.receiver.subscribe(ring.topic)
    ring.put_varying(1, bytes(1_000_000))
    ring.put_varying(2, lengths=(1_000_005,), payload=Uncopied(1_000_005))
    await turns()
    assert [len(each.data) for each in other.queue] == [1_000_000]
    assert (ring.sink.too_long, other.too_long) == (1, 1)


async def test_a_large_message_is_one_object_from_zenoh_to_the_fields() -> None:
    class Picture(r2p.Message):
        values: Annotated[r2p.Array[r2p.u8], r2p.Max(1_000_000)]

    ring = Ring(queue=20, kind=Picture)
    ring.put_varying(1, layout(Picture).encode(Picture(values=r2p.Array(bytes(500_000)))))
    await turns()
    (sample,) = ring.sink.queue
    fields = layout(Picture).decode(sample.data)
    assert fields.values.view.obj is sample.data
    assert ring.receiver.latched_value(ring.topic) is None  # not kept either, as nobody latches it
    assert ring.credits == [(1, 1)]


async def test_large_messages_get_credit_one_by_one() -> None:
    ring = Ring(queue=99, kind=Long)
    for serial in range(1, 5):
        ring.put_varying(serial, bytes(20_000))
    for serial in range(5, 15):
        ring.put_varying(serial, bytes(5_000))
    await turns()
    assert [serial for _, serial in ring.credits] == [1, 2, 3, 4, 8, 12]


async def test_what_waits_for_a_slow_subscriber_is_limited_in_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(receive_backpressure, "BACKLOG_BYTES_MAX", 60_000)
    ring = Ring(queue=1, kind=Long)
    for serial in range(1, 9):
        ring.put_varying(serial, bytes(20_000))
    await turns()
    assert ring.stats.lost == {"receive queue full": 3}
    received = 0
    while ring.sink.queue:
        received += 1
        ring.sink.queue.popleft()
        ring.sink.refill()
        await turns()
    assert received == 5
    ring.put_varying(9, bytes(20_000))
    await turns()
    assert numbers(ring.sink) == [9]


@pytest.mark.parametrize(
    ("kind", "window"),
    [(Led, WINDOW), (Note, 1489), (Scan, 134), (Long, 33), (None, 186)],
    ids=["short", "varies", "medium", "long", "raw"],
)
async def test_the_window_follows_from_the_bound(kind: type[r2p.Message] | None, window: int) -> None:
    """It is never 0: that would be no flow control."""
    ring = Ring(queue=9, kind=kind or Led, typed=kind is not None)
    assert ring.receiver.window(ring.topic) == window
