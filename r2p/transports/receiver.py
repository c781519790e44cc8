"""What comes in by a link, on its way to the topics: only what was opened, and a few messages at a time.

A slow reader must not stop a line that others share, and a fast one should lose nothing. So a full queue gets
FULL_QUEUE_TURNS turns of the event loop to make room; one that does not is lossy, for this link, until it has plenty.
What a gateway passes on from an end that waits while nothing is read gets STALL seconds, as from a publisher of this
module: so the flow is from end to end.
"""

import asyncio
import functools
import logging
from collections import Counter, deque
from collections.abc import Callable, Hashable, Iterable
from typing import Any, ParamSpec, Protocol, TypeVar

import msgspec

from r2p.clock import Clock, clock_of
from r2p.codecs.management import ROLE_PUBLISHES
from r2p.log_lines import LineLimit, get_logger
from r2p.protocols.discovery.base import DiscoveryProtocol
from r2p.runtime.backpressure import INTERNAL_ERROR, PendingDelivery, Sink
from r2p.runtime.sample import Sample, Source
from r2p.runtime.topic import FULL_QUEUE_TURNS, RemoteSubscriber, SubscriberQueue, Topic

# What a link drops: counted by reason, and told at debug level, in one place for all who count.


logger = get_logger("r2p.link")

TRY_AGAIN = 100_000_000
"""Ns after which a timer goes off again whose work raised; else a deadline that is over would be tried without end."""

_LINES = 1
"""Lines of the log in a second about one reason."""

_TRACEBACK = "traceback"

T = TypeVar("T")
P = ParamSpec("P")


class LoggedCounter(Counter[str]):
    """A counter that logs each reason when its number grows, at most once a second; free while nothing is dropped."""

    def __init__(self, link: str = "", clock: Clock | None = None) -> None:
        """`link` is its name, for the log; `clock` by default that of the running event loop."""
        super().__init__()
        self._link = link
        self._clock = clock or clock_of()
        self._limit = LineLimit(_LINES)

    def __setitem__(self, reason: str, count: int) -> None:
        grown = count > self[reason]
        super().__setitem__(reason, count)
        if grown and logger.isEnabledFor(logging.DEBUG):
            more = self._limit.suffix(reason, self._clock.monotonic())
            if more is not None:
                logger.debug("link %s drops: %s (%d so far)%s", self._link, reason, count, more)

    def internal_error(self, error: Exception, count: int = 1) -> None:
        """The handling of an item, or of `count` messages, raised: count them, log the traceback once a second."""
        self["internal error"] += count
        more = self._limit.suffix(_TRACEBACK, self._clock.monotonic())
        if more is not None:
            text = "link %s: internal error (%d so far), please report it%s"
            logger.error(text, self._link, self["internal error"], more, exc_info=error)

    def guard(self, call: Callable[P, object], *args: P.args, **kwargs: P.kwargs) -> bool:
        """Call it; False if it raised."""
        try:
            call(*args, **kwargs)
        except Exception as error:  # noqa: BLE001 - counted and logged
            self.internal_error(error)
            return False
        return True

    def drain(self, items: deque[T], handle: Callable[[T], Any], most: int) -> None:
        """Take items out and handle them, in order, `most` of them at most: those that are there now."""
        for _ in range(min(len(items), most)):
            item = items.popleft()
            try:
                handle(item)
            except Exception as error:  # noqa: BLE001 - counted and logged; the next one follows
                self.internal_error(error)


def internal_error_of(all_losses: Iterable[LoggedCounter], error: Exception) -> None:
    """Something raised that concerns several links: counted at each, as each may lack what was to be done."""
    for losses in all_losses:
        losses.internal_error(error)


# receiver


TURN = 64
"""Messages that a link hands out before it lets the event loop run once."""


STALL = 1.0
"""Seconds for which a line stands still, at most, as another link has no room."""

STALL_AGAIN = 0.05
"""... and right after that was in vain: where many topics have no room, the line must not stand still once for each. It
grows with the time that has passed since."""


class LinkStats(msgspec.Struct):
    """Counters of one link since it was opened. `lost` counts by reason what was dropped, in both directions; `faults`
    what went wrong on the line or the bus, by kind, whether anything was lost by it or not.

    `sent` are samples that were given to the line, the bus or its buffer, and not thrown away there since.
    """

    sent: int = 0
    received: int = 0
    bytes_sent: int = 0
    bytes_received: int = 0
    ups: int = 0
    lost: LoggedCounter = msgspec.field(default_factory=LoggedCounter)
    faults: Counter[str] = msgspec.field(default_factory=Counter)

    def add(self, other: "LinkStats", losses: Counter[str]) -> None:
        """Count what another link has counted, too; its `losses` are those of its discovery as well."""
        for name in ("sent", "received", "bytes_sent", "bytes_received", "ups"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        for reason, count in losses.items():
            dict.__setitem__(self.lost, reason, self.lost[reason] + count)  # its link has logged it
        self.faults.update(other.faults)


class Arrival(Protocol):
    """What came in: a topic's name as it is on this link, and packed bytes."""

    @property
    def topic(self) -> bytes: ...

    @property
    def data(self) -> bytes: ...


class RemotePublishers(msgspec.Struct):
    """Where the messages of one topic go, and who may send them: address -> bytes of its messages, 0: any.

    The last message is kept for those who subscribe later: whether it is latched may be told after it came.
    """

    topic: Topic
    senders: dict[Hashable, int]
    last: Sample | None = None


class Intake(Protocol):
    """What a link lets in: `Receiver`, or one of a transport's own."""

    def open(self, topic: Topic, size: int, sender: Hashable) -> None:
        """Take what `sender` publishes: messages of `size` bytes, 0: of any size. Again: with another size."""

    def shut(self, name: str, sender: Hashable) -> None:
        """Take no more from this sender."""

    def shut_all(self, name: str) -> None:
        """Take no more of this topic."""

    def take(self, arrivals: Iterable[Arrival]) -> None:
        """Hand out what came in."""

    def take_first(self, arrival: Arrival) -> None:
        """Hand out something that came before its inlet was open, ahead of what came in since."""

    def close(self) -> None:
        """Forget what was not handed out yet, and take no more."""


class ReceiverOwner(Protocol):
    """The link of an intake."""

    def sample(self, topic: str, arrival: Any) -> Sample:
        """The sample that came in."""

    def sender(self, arrival: Any) -> Hashable:
        """The sender's address on a bus; None on a line with one other end."""

    def latched(self, topic: str) -> bool:
        """Whether a publisher at the other end latches the topic."""

    def take_other(self, arrival: Any) -> None:
        """Something came in for which there is no inlet."""

    def take_unexpected(self, arrival: Any) -> None:
        """Something came in for a topic from a sender that does not publish it, as far as is known."""

    @property
    def waits(self) -> bool:
        """Whether the other end waits while nothing is read, and nothing is lost by that."""

    def pause(self) -> None:
        """Stop reading, if possible: what came in is still being handed out."""

    def resume(self) -> None:
        """Go on reading."""


class _PendingArrival(PendingDelivery):
    """What came in, and waits in line with what this module publishes."""

    __slots__ = ("over",)

    def __init__(self, sample: Sample, sinks: list[Sink]) -> None:
        self.over: Callable[[], None] | None = None
        """Called when it is placed; before that is set it is looked up each turn."""
        super().__init__(sample, sinks)

    def completed(self, sink: Sink, refusal: str) -> None:
        if not self.remaining and self.over is not None:
            self.over()


class Receiver:
    """The inlets of one link, and the way through them."""

    def __init__(self, link: ReceiverOwner, loop: asyncio.AbstractEventLoop, stats: LinkStats) -> None:
        self._link = link
        self._loop = loop
        self._stats = stats
        self._inlets: dict[bytes, RemotePublishers] = {}
        self._backlog: deque[Any] = deque()
        self._busy = False
        self._paused = False
        self._closed = False
        self._patience = 0
        self._lossy: set[Sink] = set()
        self._stalled: _PendingArrival | None = None
        self._stall: asyncio.TimerHandle | None = None
        self._in_vain = -STALL

    def open(self, topic: Topic, size: int, sender: Hashable) -> None:
        """Take what `sender` publishes: messages of `size` bytes, 0: of any size. Again: with another size."""
        key = topic.name.encode()
        inlet = self._inlets.get(key)
        if inlet is None:
            inlet = self._inlets[key] = RemotePublishers(topic, {})
            topic.latched_sources.append(self)
        is_new = sender not in inlet.senders
        inlet.senders[sender] = size
        if is_new:
            topic.remote_publishers += 1
            for queue in topic.queues:
                queue.publisher_joined()

    def shut(self, name: str, sender: Hashable) -> None:
        """Take no more from this sender."""
        inlet = self._inlets.get(name.encode())
        if inlet is not None and sender in inlet.senders:
            del inlet.senders[sender]
            inlet.topic.remote_publishers -= 1
            if not inlet.senders:
                self.shut_all(name)

    def shut_all(self, name: str) -> None:
        """Take no more of this topic."""
        inlet = self._inlets.pop(name.encode(), None)
        if inlet is not None:
            inlet.topic.remote_publishers -= len(inlet.senders)
            inlet.topic.latched_sources.remove(self)

    def offer_latched(self, topic: Topic, sink: SubscriberQueue) -> None:
        """Send the last message to a new subscriber, if the publisher latches it."""
        last = self._inlets[topic.name.encode()].last
        if last is not None and self._link.latched(topic.name):
            sink.offer_latched(last)

    def close(self) -> None:
        """Forget what was not handed out yet, and take no more."""
        self._closed = True
        self._backlog.clear()
        if self._stalled is not None:
            self._stalled.withdraw()
            self._end_stall()
        for name in list(self._inlets):
            self.shut_all(name.decode())

    def take(self, arrivals: Iterable[Arrival]) -> None:
        """Hand out what came in, at most TURN messages in one turn of the loop."""
        if self._closed:
            return
        self._backlog.extend(arrivals)
        if not self._busy:
            self._hand_out()
        elif self._paused:
            self._link.pause()  # the line has been connected anew

    def take_first(self, arrival: Arrival) -> None:
        """Hand out something that came before its inlet was open, ahead of what came in since."""
        if not self._closed:
            self._backlog.appendleft(arrival)
            if not self._busy:
                self._hand_out()

    def _hand_out(self) -> None:
        self._busy = True
        link, backlog, inlets, lost = self._link, self._backlog, self._inlets, self._stats.lost
        for _ in range(TURN):
            if not backlog:
                self._busy = False
                self._read_on()
                return
            arrival = backlog.popleft()
            try:
                inlet = inlets.get(arrival.topic)
                if inlet is None:
                    link.take_other(arrival)
                    continue
                size = inlet.senders.get(link.sender(arrival))
                if size is None:
                    link.take_unexpected(arrival)
                elif size and len(arrival.data) != size:
                    lost["wrong size"] += 1
                else:
                    self._stats.received += 1
                    inlet.last = sample = link.sample(inlet.topic.name, arrival)
                    blocked = inlet.topic.deliver(sample)
                    if blocked is not None and self._wait(sample, blocked):
                        return
            except Exception as error:  # noqa: BLE001 - counted and logged; the next one follows
                lost.internal_error(error)
        self._loop.call_soon(self._hand_out)
        self._read_no_more()

    def _read_no_more(self) -> None:
        if not self._paused:
            self._paused = True
            self._link.pause()

    def _read_on(self) -> None:
        if self._paused:
            self._paused = False
            self._link.resume()

    def _wait(self, sample: Sample, blocked: list[Sink]) -> bool:
        """Wait for room in these sinks; False if none of them is worth it."""
        for sink in self._lossy.intersection(blocked):
            self._stats.lost.guard(sink.force, sample)
        patient = [sink for sink in blocked if sink not in self._lossy]
        if not patient:
            return False
        self._patience = FULL_QUEUE_TURNS
        self._loop.call_soon(self._look, _PendingArrival(sample, patient))
        self._read_no_more()
        return True

    def _look(self, claim: _PendingArrival) -> None:
        self._patience -= 1
        if claim.remaining and self._patience > 0 and not self._closed:
            self._loop.call_soon(self._look, claim)
            return
        stands_still = self._link.waits and not self._closed
        links: list[Sink] = [sink for sink in claim.remaining if stands_still and isinstance(sink, RemoteSubscriber)]
        for sink in claim.withdraw():
            if sink not in links:
                self._stats.lost.guard(sink.force, claim.sample)
                self._lossy.add(sink)
                sink.wait_queue().recoveries.append(functools.partial(self._lossy.discard, sink))
        if links:
            self._stand_still(_PendingArrival(claim.sample, links))
        elif not self._closed:
            self._hand_out()

    def _stand_still(self, claim: _PendingArrival) -> None:
        """Until these links have room, or have had none for too long."""
        claim.over = self._go_on
        self._stalled = claim
        longest = min(STALL, max(STALL_AGAIN, self._loop.time() - self._in_vain))
        self._stall = self._loop.call_later(longest, self._give_up, claim, f"no room for {longest:.2g} s")

    def _go_on(self) -> None:
        """It is placed, in the middle of somebody's work: go on after it."""
        self._end_stall()
        self._loop.call_soon(self._hand_out)

    def _end_stall(self) -> None:
        self._stalled = None
        if self._stall is not None:
            self._stall.cancel()
            self._stall = None

    def _give_up(self, claim: _PendingArrival, refusal: str) -> None:
        guard = self._stats.lost.guard
        for sink in list(claim.remaining):
            guard(sink.refill)
        for sink in list(claim.remaining):
            if not guard(sink.become_lossy, refusal):
                sink.wait_queue().remove(sink, claim)
                claim.complete(sink, INTERNAL_ERROR)  # else the line would stand still for ever
            self._in_vain = self._loop.time()


# Who publishes a topic at the other end of a link, as far as that is known there.


class PublisherLookup:
    """The source of what comes in, by topic; worked out anew when something is learnt.

    r2p modules tell which of their nodes publish a topic. Where nobody did, and only one module was heard, it is that.
    """

    def __init__(self, discovery: DiscoveryProtocol, link: str) -> None:
        self._discovery = discovery
        self._link = link
        self._known: dict[str, Source] = {}
        self._generation = -1

    def of(self, topic: str) -> Source:
        if self._generation != self._discovery.generation:
            self._generation = self._discovery.generation
            self._known.clear()
        source = self._known.get(topic)
        if source is None:
            source = self._known[topic] = self._find(topic)
        return source

    def _find(self, topic: str) -> Source:
        modules = self._discovery.modules.values()
        names = {info.instance: info.name for info in modules if info.r2p}
        publishers = {
            (names.get(each.instance, ""), each.node)
            for each in self._discovery.endpoints.values()
            if each.topic == topic and each.role == ROLE_PUBLISHES
        }
        candidates = {module for module, _ in publishers} or {info.name for info in modules if not info.observer}
        module = candidates.pop() if len(candidates) == 1 else ""
        node = publishers.pop()[1] if len(publishers) == 1 else ""
        return Source(module, node, self._link)
