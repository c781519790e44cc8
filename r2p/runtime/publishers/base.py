"""The base of all publishers: their topic, their counters, and their reports of missed and late messages.

    _miss      a message has not reached a queue or a link: `missed`, and `on_missed`
    link_late  a message was sent after its deadline: `late`, and `on_late`; publishers report their own delays likewise
    link_degraded   a link, or its slots, are lost: `on_degraded`

All go through `_report`: at most one line of the log a second, and the callback of the class value.
"""

import asyncio
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, Generic, NoReturn, TypeVar

from msgspec import structs

from r2p.clock import check_timeout
from r2p.errors import Closed, MessageError
from r2p.log_lines import LineLimit
from r2p.messages import Layout, Message
from r2p.runtime.backpressure import LINK_DOWN, Sink
from r2p.runtime.qos import Missed, NonRealTime, Periodic, PublisherSignal, Signal, SignalKind, Sporadic
from r2p.runtime.queues import YIELD_EVERY, EndpointOwner, Pulse
from r2p.runtime.sample import PublisherClass, Sample, Source
from r2p.runtime.topic import Topic, TopicSpace

M = TypeVar("M", bound=Message)
C = TypeVar("C", bound=NonRealTime | Sporadic | Periodic[Any])

_LOG_LINES = 1  # a second about what is missed or late
_CALLBACK_PAUSE = 0.001  # seconds between callbacks where one causes the next: else the event loop would stand still
_DEFERRED_MAX = 4  # callbacks that wait their turn; any more are added to the last one
_REMEMBERED = 64  # sequence numbers of messages that were missed last: several links may report one message


class BasePublisher(Generic[M, C]):
    """The base of all publishers: made by `Node.advertise`, closed by `close()` or when their node ends."""

    publisher_class: PublisherClass

    # Of a swap of the node (`held`); in the class, as an object of more than 30 attributes is larger and slower.
    hand_over: Callable[[], Callable[[], None] | None] | None = None
    """Lets the publisher that replaces this one go on here; returns what then sends the messages that it held back."""
    abandon: Callable[[], None] | None = None
    """Called if a publisher is closed that is held back."""
    held_back = 0
    """Calls of `publish()` that are held back."""
    first_at = 0
    """The instant of the first message in place of another publisher (monotonic ns); 0: none yet."""

    def __init__(
        self,
        space: TopicSpace,
        node: EndpointOwner,
        topic: Topic,
        layout: Layout[M],
        klass: C,
        *,
        latch: bool,
    ) -> None:
        self.topic = topic.name
        """The topic's name, after remapping."""
        self.type = layout.cls
        """The message class."""
        self.node = node
        """The node that publishes."""
        self.latch = latch
        """True if the last message is sent to subscribers that join later."""
        self.sent = 0
        """Messages published; the sequence number of the last one."""
        self.missed = 0
        """Messages that did not reach every subscriber in time."""
        self.late = 0
        """Messages that were published or sent after their time."""
        self._class = klass
        self._on_missed = klass.on_missed
        self._on_late: Signal | None = klass.on_late
        self._on_degraded = klass.on_degraded
        self._space = space
        self._topic = topic
        self._encode = layout.encode
        self._decode = layout.decode
        self._shares = layout.packing.shares
        self._clock = space.clock
        self._now = space.clock.now
        self._source = Source(space.module, node.name)
        self._last: Sample | None = None
        self._until_yield = YIELD_EVERY
        self._log_limit = LineLimit(_LOG_LINES)
        self._subscriber_came = Pulse()
        self._in_callback = False
        self._deferred: list[tuple[Signal, Missed]] = []
        self._missed_lately: deque[int] = deque(maxlen=_REMEMBERED)
        self._newest_missed = 0

    @property
    def size(self) -> int:
        """Bytes of one message; of the longest, if their length varies."""
        return self._topic.layout.size if self._topic.layout else 0

    @property
    def varies(self) -> bool:
        """True if the length of the messages varies."""
        return self._topic.layout is not None and self._topic.layout.varies

    @property
    def subscribers(self) -> int:
        """The number of subscribers now: queues of this module, and links with subscribers behind them."""
        return len(self._topic.queues) + sum(remote.reachable for remote in self._topic.remote_subscribers)

    async def wait_subscriber(self) -> None:
        """Wait until the topic has a subscriber. Raises Closed if the publisher is closed, before or meanwhile."""
        if self in self._topic.publishers and not self.subscribers:
            await self._subscriber_came.wait()
        if self not in self._topic.publishers:
            raise self._is_closed()

    @property
    def guarantees(self) -> dict[str, str]:
        """The guarantees of the publisher's class on each link, in words, by the link's name; "" is this module."""
        local = {
            PublisherClass.NON_REAL_TIME: "waits for room in every queue",
            PublisherClass.SPORADIC: "in every queue by the deadline, or signalled",
            PublisherClass.PERIODIC: "on absolute phase of the local clock; late periods are counted",
        }
        links = {link.name: link.guarantee(self.topic, self.publisher_class) for link in self._space.links}
        return {"": local[self.publisher_class]} | links

    async def ready(self, timeout: float | None = None) -> None:
        """Wait until every link that is up has admitted the topic; links that give best effort do so at once.

        Raises TimeoutError after `timeout` seconds, and MessageError for a time-out that is not a number of seconds.
        """
        check_timeout(f"topic {self.topic}: the time-out of ready", timeout)
        end = None if timeout is None else self._space.loop.time() + timeout
        for link in list(self._space.links):
            try:
                async with asyncio.timeout_at(end):
                    await link.admission(self.topic)
            except TimeoutError:
                state = link.guarantee(self.topic, self.publisher_class)
                text = f"topic {self.topic!r} was not admitted by link {link.name} within {timeout} s: {state}"
                raise TimeoutError(text) from None

    def close(self) -> None:
        """Stop publishing; the links inform their peers."""
        if self in self._topic.publishers:
            # Before this one is gone: else the links would announce that the topic is not published any more.
            release = self.hand_over() if self.hand_over is not None else self.abandon
            self._topic.publishers.remove(self)
            self._encode = self._closed  # so that publish() does not have to look each time
            self._space.release(self._topic)
            self.node.forget(self)
            self._subscriber_came.emit()
            if release is not None:
                release()

    @property
    def source(self) -> Source:
        """The source of its messages."""
        return self._source

    @property
    def latched(self) -> Sample | None:
        """The message for subscribers that join later."""
        return self._last

    @property
    def is_open(self) -> bool:
        """True until the publisher is closed."""
        return self in self._topic.publishers

    def check(self, message: M) -> None:
        """Raise MessageError for a message that does not fit the type."""
        if message.__class__ is not self.type:
            raise self._wrong_type(message)
        self._encode(message)

    def follow(self, other: "BasePublisher[Any, Any]") -> None:
        """Go on where another publisher of the topic ends: with its next number, and the value that it latches."""
        self.sent = other.sent
        if other.source == self._source:
            self._source = other.source  # the same object: what waits in a full queue keeps its order by it
        if self.latch and self._last is None:
            self._last = other.latched
        self._note_first()

    def _note_first(self) -> None:
        encode = self._encode

        def encode_first(message: M) -> bytes:
            data = encode(message)
            self._encode = encode
            self.first_at = self._clock.monotonic()
            return data

        self._encode = encode_first

    def _closed(self, message: M) -> NoReturn:
        raise self._is_closed()

    def _is_closed(self) -> Closed:
        return Closed(f"publisher of {self.topic} is closed: advertise it again")

    # Called by the topic and its links

    def subscriber_joined(self, sink: Sink) -> None:
        """Send a latched value: a subscriber joined, or came back after a reboot."""
        if self._last is not None:
            sink.offer_latched(self._last)
        self._subscriber_came.emit()

    def link_degraded(self, link: str, reason: str) -> None:
        """Report that a link no longer carries the topic, or has lost its slots."""
        self._report(SignalKind.DEGRADED, Missed(self.topic, reason, where=link, count=0), self._on_degraded)

    def link_missed(self, link: str, reason: str, late: float = 0.0, sequence: int = 0) -> None:
        """Report that a link gave up an accepted message, such as one for a slot that has passed; `late` is in seconds.

        With its `sequence` a message that is missed on several links counts once.
        """
        self._miss(sequence, reason, link, late)

    def link_late(self, link: str, reason: str, late: float = 0.0) -> None:
        """Report that a link sent a message after its deadline; `late` is in seconds."""
        self.late += 1
        self._report(SignalKind.LATE, Missed(self.topic, reason, link, late), self._on_late)

    # For the classes below

    def _sample(self, message: M, deadline: int = 0) -> Sample:
        if message.__class__ is not self.type:
            raise self._wrong_type(message)
        data = self._encode(message)
        self.sent = sequence = self.sent + 1
        stamp = self._now()
        if deadline:
            deadline += stamp
        shared = message if self._shares is None or self._shares(message) else self._decode(data)
        sample = Sample(data, self._source, stamp, deadline, sequence, self.publisher_class, shared)
        if self.latch:
            self._last = sample
        return sample

    def _wrong_type(self, message: object) -> MessageError:
        return MessageError(f"topic {self.topic} takes {self.type.__name__}, not {type(message).__name__}")

    def _miss(self, sequence: int, reason: str, without: str | Sequence[Sink], late: float = 0.0) -> None:
        """Count and report a message that has not reached these sinks, or this link: once, however many they are."""
        is_first = self._is_first_miss(sequence)
        self.missed += is_first
        # `_report`, inlined: with a full queue this runs for each message, mostly without a line and a callback.
        suffix = None if reason == LINK_DOWN else self._log_limit.suffix("", self._clock.monotonic())
        if self._on_missed is not None or suffix is not None or self._space.signal_listeners:
            names = without if isinstance(without, str) else where(without)
            missed = Missed(self.topic, reason, names, late, int(is_first))
            self._inform(SignalKind.MISSED, missed, sequence)
            self._log_and_call(missed, self._on_missed, suffix)

    def _is_first_miss(self, sequence: int) -> bool:
        """Return whether this message has not been missed yet. One without a number counts each time."""
        if not sequence:
            return True
        if sequence <= self._newest_missed and (sequence == self._newest_missed or sequence in self._missed_lately):
            return False
        self._newest_missed = max(sequence, self._newest_missed)
        self._missed_lately.append(sequence)
        return True

    def _miss_unreachable(self, sample: Sample, sinks: list[Sink]) -> None:
        """Count and report a sample as missed by the subscribers behind links that are down."""
        for sink in sinks:
            sink.force(sample)
        self._miss(sample.sequence, LINK_DOWN, sinks)

    def _report(self, kind: SignalKind, missed: Missed, callback: Signal | None) -> None:
        """Log the miss, and call the user's callback; a link that is down has been logged as such."""
        self._inform(kind, missed)
        suffix = None if missed.reason == LINK_DOWN else self._log_limit.suffix("", self._clock.monotonic())
        self._log_and_call(missed, callback, suffix)

    def _inform(self, kind: SignalKind, missed: Missed, sequence: int = 0) -> None:
        for listener in self._space.signal_listeners:
            listener(PublisherSignal(kind, self.node.name, self.publisher_class, sequence, missed))

    def _log_and_call(self, missed: Missed, callback: Signal | None, suffix: str | None) -> None:
        if suffix is not None:
            self.node.log.warning("%s (missed %d, late %d so far)%s", missed, self.missed, self.late, suffix)
        if callback is None:
            return
        if self._in_callback:
            self._defer(missed, callback)
        else:
            self._call(missed, callback)

    def _call(self, missed: Missed, callback: Signal) -> None:
        if self.node.ending:
            return
        self._in_callback = True
        try:
            callback(missed)
        except Exception as error:  # noqa: BLE001 - the user's code: whatever it raises crashes its node
            # Later: this may run in the node's own task, in a call of a link, where a crash would raise through it.
            self._space.loop.call_soon(self.node.crash, error)
        finally:
            self._in_callback = False

    def _defer(self, missed: Missed, callback: Signal) -> None:
        """Report later: a callback published a message that was missed as well, and must not be called recursively."""
        if not self._deferred:
            self._space.loop.call_later(_CALLBACK_PAUSE, self._call_deferred)
        elif len(self._deferred) >= _DEFERRED_MAX and self._deferred[-1][0] is callback:
            missed = structs.replace(missed, count=self._deferred.pop()[1].count + missed.count)
        self._deferred.append((callback, missed))

    def _call_deferred(self) -> None:
        deferred, self._deferred = self._deferred, []
        for callback, missed in deferred:
            self._call(missed, callback)


def where(sinks: Sequence[Sink]) -> str:
    """Return the names of nodes and links, for a `Missed`."""
    return ", ".join(dict.fromkeys(sink.owner for sink in sinks))
