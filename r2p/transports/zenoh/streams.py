"""All that comes in by zenoh: a bounded queue for each topic, so that none delays another."""

import asyncio
from collections.abc import Callable, Hashable, Iterable
from typing import TYPE_CHECKING, Any, Protocol

from r2p.clock import clock_of
from r2p.sample import Source
from r2p.topic import QueueSink, Topic
from r2p.transports.intake import LinkStats
from r2p.transports.zenoh.stream import SENDERS, Flows, Stream

if TYPE_CHECKING:
    import zenoh

    from r2p.transports.zenoh.session import Tap

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
        credit: "GiveCredit",
        subscribe: Callable[[str, Callable[["zenoh.Sample"], None]], "Tap | None"],
    ) -> None:
        self.link = link
        self.loop = loop
        self.clock = clock_of(loop)
        self.stats = stats
        self.longest = longest
        self.credit = credit
        self.gaps: dict[tuple[str, Source], int] = {}
        """Messages lost on the way, by topic and source."""
        self._latched = latched
        self._subscribe = subscribe
        self._streams: dict[str, Stream] = {}
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
        stream = self._streams[topic.name] = Stream(topic, self, self._flows(topic.name))
        topic.memories.append(self)
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
        size = self.longest if topic.layout is None else topic.layout.size
        return min(WINDOW, _WINDOW_BYTES // (size + _OVERHEAD))

    def count_gap(self, topic: str, source: Source, gap: int) -> None:
        """Messages were lost on the way."""
        self.stats.lost["on the way"] += gap
        if len(self.gaps) >= SENDERS:
            self.gaps.clear()
        self.gaps[topic, source] = self.gaps.get((topic, source), 0) + gap

    # As Intake

    def take(self, arrivals: Iterable[Any]) -> None:
        """Each stream takes what comes by itself."""

    def take_first(self, arrival: Any) -> None:
        """Nothing comes before its stream is open."""

    def open(self, topic: Topic, size: int, sender: Hashable) -> None:
        """A publisher is there."""
        stream = self._streams.get(topic.name)
        if stream is not None and sender not in stream.senders:
            stream.senders.add(sender)
            topic.inlets += 1
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
            stream.topic.inlets -= len(stream.senders)
            stream.topic.memories.remove(self)

    def remind(self, topic: Topic, sink: QueueSink) -> None:
        """Send the last message to a new subscriber, if the publisher latches it."""
        last = self._streams[topic.name].last
        if last is not None and self._latched(topic.name):
            sink.remind(last)

    def close(self) -> None:
        for name in list(self._streams):
            self.shut_all(name)


def _progress(flows: Flows) -> dict[tuple[int, int], int]:
    """The serial that is expected of each publisher that has been heard."""
    return {key: flow.next for key, flow in flows.items() if flow.next >= 0}
