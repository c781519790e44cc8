"""What all publishers share: their topic, their counters, and how they tell what somebody missed."""

import asyncio
from collections import deque
from collections.abc import Sequence
from typing import Generic, NoReturn, TypeVar

from msgspec import structs

from r2p.durations import timeout_or_none
from r2p.errors import Closed, MessageError
from r2p.log_lines import LineLimit
from r2p.messages import Layout, Message
from r2p.runtime.backpressure import LINK_DOWN, Sink
from r2p.runtime.qos import Missed, Signal
from r2p.runtime.sample import PublisherClass, Sample, Source
from r2p.runtime.topic import YIELD_EVERY, EndpointOwner, Topic, TopicSpace

M = TypeVar("M", bound=Message)

_LINES = 1  # of the log in a second about what is missed or late
_AGAIN = 0.001  # seconds until a signal that publishes is told what became of that
_AT_ONCE = 4  # of those, one by one
_REMEMBERED = 64  # messages that were missed last


class BasePublisher(Generic[M]):
    """What all publishers share. Made by `Node.advertise`."""

    publisher_class: PublisherClass

    def __init__(self, space: TopicSpace, node: EndpointOwner, topic: Topic, layout: Layout[M], *, latch: bool) -> None:
        self.topic = topic.name
        self.type = layout.cls
        self.node = node
        self.latch = latch
        self.sent = 0
        """Messages published; the sequence number of the last one."""
        self.missed = 0
        """Messages that somebody did not get in time."""
        self.late = 0
        """Messages that were published or sent after their time."""
        self._space = space
        self._topic = topic
        self._encode = layout.encode
        self._clock = space.clock
        self._now = space.clock.now
        self._source = Source(space.module, node.name)
        self._last: Sample | None = None
        self._credit = YIELD_EVERY
        self._lines = LineLimit(_LINES)
        self._waiters: list[asyncio.Future[None]] = []
        self._signalling = False
        self._later: list[tuple[Signal, Missed]] = []
        self._missed_lately: deque[int] = deque(maxlen=_REMEMBERED)
        self._newest_missed = 0

    @property
    def size(self) -> int:
        """Bytes of one message."""
        return self._topic.layout.size if self._topic.layout else 0

    @property
    def subscribers(self) -> int:
        """Who would get a message now: local queues, and one for each link with subscribers behind it."""
        return len(self._topic.queues) + sum(outlet.reachable for outlet in self._topic.remote_subscribers)

    async def wait_subscriber(self) -> None:
        """Wait until somebody subscribes. Raises Closed if the publisher is closed before."""
        if self not in self._topic.publishers:
            raise self._is_closed()
        if not self.subscribers:
            waiter = self._space.loop.create_future()
            self._waiters.append(waiter)
            try:
                await waiter
            finally:
                self._waiters.remove(waiter)

    @property
    def guarantees(self) -> dict[str, str]:
        """What the publisher's class means on each link, by link name; "" is this module."""
        local = {
            PublisherClass.NON_REAL_TIME: "waits for room in every queue",
            PublisherClass.SPORADIC: "in every queue by the deadline, or signalled",
            PublisherClass.PERIODIC: "on absolute phase of the local clock; late periods are counted",
        }
        links = {link.name: link.guarantee(self.topic, self.publisher_class) for link in self._space.links}
        return {"": local[self.publisher_class]} | links

    async def ready(self, timeout: float | None = None) -> None:
        """Wait until every link that is up has admitted the topic.

        Raises TimeoutError after `timeout` seconds, and MessageError for a time-out that is not a number of seconds.
        Links that give best effort admit at once.
        """
        timeout_or_none(f"topic {self.topic}: the time-out of ready", timeout)
        async with asyncio.timeout(timeout):
            for link in list(self._space.links):
                await link.admission(self.topic)

    def close(self) -> None:
        """Stop publishing; the links tell their peers."""
        if self in self._topic.publishers:
            self._topic.publishers.remove(self)
            self._encode = self._closed
            self._space.release(self._topic)
            self.node.forget(self)
            for waiter in self._waiters:
                if not waiter.done():
                    waiter.set_exception(self._is_closed())

    def _closed(self, message: M) -> NoReturn:
        raise self._is_closed()

    def _is_closed(self) -> Closed:
        return Closed(f"publisher of {self.topic} is closed: advertise it again")

    # Called by the topic and its links

    def subscriber_joined(self, sink: Sink) -> None:
        """Somebody joined, or came back after a reboot: a latched value is sent again."""
        if self._last is not None:
            sink.offer_latched(self._last)
        for waiter in self._waiters:
            if not waiter.done():
                waiter.set_result(None)

    def link_degraded(self, link: str, reason: str) -> None:
        """A link that carried the topic does not any more."""
        self._signal(Missed(self.topic, reason, where=link, count=0), self._on_degraded)

    def link_missed(self, link: str, reason: str, late: float = 0.0, sequence: int = 0) -> None:
        """A link gave up a message that it had taken; `late` is in seconds.

        With its `sequence` a message that others missed, too, counts once.
        """
        self._miss(sequence, reason, link, late)

    def link_late(self, link: str, reason: str, late: float = 0.0) -> None:
        """A link sent a message after its deadline."""
        self.late += 1
        self._signal(Missed(self.topic, reason, link, late), self._on_late)

    # For the classes below

    _on_missed: Signal | None = None
    _on_late: Signal | None = None
    _on_degraded: Signal | None = None

    def _sample(self, message: M, deadline: int = 0) -> Sample:
        if message.__class__ is not self.type:
            raise self._wrong_type(message)
        data = self._encode(message)
        self.sent = sequence = self.sent + 1
        stamp = self._now()
        if deadline:
            deadline += stamp
        sample = Sample(data, self._source, stamp, deadline, sequence, self.publisher_class, message)
        if self.latch:
            self._last = sample
        return sample

    def _wrong_type(self, message: object) -> MessageError:
        return MessageError(f"topic {self.topic} takes {self.type.__name__}, not {type(message).__name__}")

    def _miss(self, sequence: int, reason: str, without: str | Sequence[Sink], late: float = 0.0) -> None:
        """A message has not reached these sinks, or this link; however many that are, it counts once."""
        is_news = self._is_news(sequence)
        self.missed += is_news
        # As _line_suffix, inlined: where a queue is full, this is done for each message.
        more = None if reason == LINK_DOWN else self._lines.suffix("", self._clock.monotonic())
        if self._on_missed is not None or more is not None:
            names = without if isinstance(without, str) else where(without)
            self._tell(Missed(self.topic, reason, names, late, int(is_news)), self._on_missed, more)

    def _is_news(self, sequence: int) -> bool:
        """Whether this message has not been missed yet; of one without a number that is not known."""
        if not sequence:
            return True
        if sequence <= self._newest_missed and (sequence == self._newest_missed or sequence in self._missed_lately):
            return False
        self._newest_missed = max(sequence, self._newest_missed)
        self._missed_lately.append(sequence)
        return True

    def _line_suffix(self, reason: str) -> str | None:
        """What to append to a line of the log; None: leave it out, as all of a link that is down: that is logged."""
        return None if reason == LINK_DOWN else self._lines.suffix("", self._clock.monotonic())

    def _unreachable(self, sample: Sample, sinks: list[Sink]) -> None:
        """Links that are down: who is behind them misses the sample."""
        for sink in sinks:
            sink.force(sample)
        self._miss(sample.sequence, LINK_DOWN, sinks)

    def _signal(self, missed: Missed, callback: Signal | None) -> None:
        self._tell(missed, callback, self._line_suffix(missed.reason))

    def _tell(self, missed: Missed, callback: Signal | None, more: str | None) -> None:
        """Log it, unless `more` is None, and call the user's code."""
        if more is not None:
            self.node.log.warning("%s (missed %d, late %d so far)%s", missed, self.missed, self.late, more)
        if callback is None:
            return
        if self._signalling:
            self._signal_later(missed, callback)
        else:
            self._call(missed, callback)

    def _call(self, missed: Missed, callback: Signal) -> None:
        if self.node.ending:
            return
        self._signalling = True
        try:
            callback(missed)
        except Exception as error:  # noqa: BLE001 - the user's code: whatever it raises crashes its node
            # Later: a link may be at work in the node's own task, where a crash would raise through it.
            self._space.loop.call_soon(self.node.crash, error)
        finally:
            self._signalling = False

    def _signal_later(self, missed: Missed, callback: Signal) -> None:
        """A signal publishes, and that is missed, too: signal it when that is over; what is too much becomes one."""
        if not self._later:
            self._space.loop.call_later(_AGAIN, self._signal_now)
        elif len(self._later) >= _AT_ONCE and self._later[-1][0] is callback:
            missed = structs.replace(missed, count=self._later.pop()[1].count + missed.count)
        self._later.append((callback, missed))

    def _signal_now(self) -> None:
        later, self._later = self._later, []
        for callback, missed in later:
            self._call(missed, callback)


def where(sinks: Sequence[Sink]) -> str:
    """The names of nodes and links, for a signal."""
    return ", ".join(dict.fromkeys(sink.owner for sink in sinks))
