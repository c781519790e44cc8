"""The topics that pages look at: each is subscribed to once, whatever the number of pages and plots.

What arrives waits for 40 ms. Then the numbers of all plots of the topic are taken out of the messages by one
`FieldExtractor`, each column is packed once, and each plot gets the columns that it has asked for. Nothing is left out:
what a page is too slow for, its client drops and counts. The newest message of a topic is decoded for all pages that
watch it, ten times a second, and less often where that takes long.
"""

import asyncio
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import msgspec

from r2p.errors import DecodeError, MessageError, WebError
from r2p.messages import Message, layout
from r2p.messages.values import to_plain
from r2p.modules.module import Module
from r2p.monitoring.fields import FieldExtractor
from r2p.monitoring.topic_types import TypeFinder
from r2p.ros.classes import standard_classes
from r2p.runtime.immediate import ImmediateSubscriber
from r2p.runtime.node import Node
from r2p.runtime.sample import Sample
from r2p.units import SECOND
from r2p.web.client import WebClient
from r2p.web.dash import protocol
from r2p.web.dash.source import raw_fields

BATCH = 0.04
"""Seconds for which points are collected."""
PATHS_MAX = 4096
"""Fields of one topic that all pages together plot: their extractor is made anew for each plot that comes or goes."""
WATCH_PERIOD = 0.1
"""Seconds between two messages of a watched topic, at least."""

_BATCH_BYTES = 1 << 20  # of messages that wait; with more they are not collected for so long
_MESSAGE_BYTES = 64  # of memory that a waiting message takes besides its data
_WATCH_SHARE = 20  # the time that showing a message takes is at most one part of so many
_TYPE_AGAIN = 1.0  # seconds after which the type of messages that can't be read is looked up again


class PlotStream(msgspec.Struct, eq=False):
    """The points of some fields of a topic that one page plots."""

    client: WebClient
    number: int
    paths: list[str]
    closed: bool = False


class TopicFeeds:
    """The topics that the pages of one process look at."""

    def __init__(self, module: Module, types: TypeFinder, refused: Counter[str]) -> None:
        """`refused` gets what can't be read."""
        self.types = types
        self.refused = refused
        self.module = module
        self.node = Node("dash", module.space)
        self._feeds: dict[str, TopicFeed] = {}

    def close(self) -> None:
        """End all subscriptions."""
        for feed in self._feeds.values():
            feed.close()
        self._feeds.clear()
        self.node.close()

    async def plot(self, topic: str, stream: PlotStream) -> None:
        """Send points of a topic. Raises WebError for an unknown topic or type, MessageError for an unknown field."""
        cls = await self.find_type(topic)
        FieldExtractor(cls, stream.paths)
        if stream.closed:  # meanwhile
            return
        feed = self._feed(topic)
        if feed.paths_with(stream) > PATHS_MAX:
            raise WebError(f"all pages together plot at most {PATHS_MAX} fields of {topic}: close some plots")
        feed.add_stream(stream, cls)

    def stop_plot(self, topic: str, stream: PlotStream) -> None:
        """Stop sending points."""
        stream.closed = True
        if (feed := self._feeds.get(topic)) is not None:
            feed.remove_stream(stream)
            self._release(feed)

    def watch(self, topic: str, client: WebClient) -> None:
        """Send a page the newest messages of a topic. Raises WebError for an unknown topic."""
        self._check(topic)
        self._feed(topic).add_watch(client)

    def unwatch(self, topic: str, client: WebClient) -> None:
        """Stop sending a page the messages of a topic."""
        if (feed := self._feeds.get(topic)) is not None:
            feed.remove_watch(client)
            self._release(feed)

    async def find_type(self, topic: str, name: str = "") -> type[Message]:
        """Return the type of a topic, or the one of this `name`. Raises WebError if it is unknown."""
        if name:
            found = next((cls for full, cls in standard_classes().items() if name in (full, cls.__name__)), None)
            if found is None:
                raise WebError(f"r2p has no type {name[:100]!r}: leave it out, and the topic's own one is taken")
            return found
        self._check(topic)
        cls = await self.types.find(topic)
        if cls is None:
            raise WebError(f"the type of {topic} is unknown: no module on the network has answered with its fields")
        return cls

    def _check(self, topic: str) -> None:
        """Raise WebError for a topic that the network does not have: subscribing to it would announce it to all."""
        if topic not in self._feeds and topic not in self.module.network.topics():
            raise WebError(f"there is no topic {topic[:100]!r} on the network")

    def _feed(self, topic: str) -> "TopicFeed":
        feed = self._feeds.get(topic)
        if feed is None:
            feed = self._feeds[topic] = TopicFeed(self, topic)
            feed.open()
        return feed

    def _release(self, feed: "TopicFeed") -> None:
        if not feed.is_used:
            feed.close()
            self._feeds.pop(feed.topic, None)


class TopicFeed:
    """One topic, for all pages that plot or watch it."""

    def __init__(self, feeds: TopicFeeds, topic: str) -> None:
        self.topic = topic
        self._feeds = feeds
        self._loop = asyncio.get_running_loop()
        self._subscriber = ImmediateSubscriber(feeds.module.space, feeds.node, self._receive, lossy=True)
        self._plots = _Plots(self)
        self._watches = _Watches(self)
        self._learning: asyncio.Task[None] | None = None

    @property
    def cls(self) -> type[Message] | None:
        """The type of the messages as far as it is known now."""
        return self._feeds.types.known(self.topic)

    @property
    def is_used(self) -> bool:
        return bool(self._plots.streams or self._watches.clients)

    def open(self) -> None:
        """Subscribe to messages of any type: a publisher may come back with another one."""
        self._subscriber.open(self.topic, None)

    def close(self) -> None:
        """End the subscription."""
        self._subscriber.close()
        self._plots.close()
        self._watches.close()
        if self._learning is not None:
            self._learning.cancel()

    def add_stream(self, stream: PlotStream, cls: type[Message]) -> None:
        self._plots.streams.append(stream)
        self._plots.rebuild(cls)

    def paths_with(self, stream: PlotStream) -> int:
        """Return how many fields are plotted with one more stream."""
        return len({path for each in (*self._plots.streams, stream) for path in each.paths})

    def remove_stream(self, stream: PlotStream) -> None:
        if stream in self._plots.streams:
            self._plots.streams.remove(stream)
            self._plots.rebuild(self.cls)

    def add_watch(self, client: WebClient) -> None:
        self._watches.add(client)
        if self.cls is None:
            self.learn_type()

    def remove_watch(self, client: WebClient) -> None:
        self._watches.clients.pop(client, None)

    def after(self, seconds: float, call: Callable[[], None]) -> asyncio.TimerHandle:
        return self._loop.call_later(seconds, call)

    def time(self) -> float:
        return self._loop.time()

    def refuse(self, count: int) -> None:
        """Count messages that can't be read, and look for their type."""
        self._feeds.refused["messages of another type"] += count
        self.learn_type()

    def learn_type(self) -> None:
        """Look up the type anew, as messages can't be read with the one that is known; at most once a second."""
        if self._learning is None:
            self._learning = self._loop.create_task(self._learn(), name=f"type of {self.topic}")

    async def _learn(self) -> None:
        cls = await self._feeds.types.find(self.topic)
        self._plots.rebuild(cls)
        await asyncio.sleep(_TYPE_AGAIN)
        self._learning = None

    def _receive(self, sample: Sample) -> None:
        if self._plots.streams:
            self._plots.add(sample)
        if self._watches.clients:
            self._watches.add_sample(sample)


class _Plots:
    """The plots of one topic: what has arrived for them, and what takes the numbers out of it."""

    def __init__(self, feed: TopicFeed) -> None:
        self.streams: list[PlotStream] = []
        self._feed = feed
        self._extractor: FieldExtractor | None = None
        self._samples: list[Sample] = []
        self._bytes = 0
        self._timer: asyncio.TimerHandle | None = None

    def add(self, sample: Sample) -> None:
        self._samples.append(sample)
        self._bytes += len(sample.data) + _MESSAGE_BYTES
        if self._timer is None:
            self._timer = self._feed.after(BATCH, self._flush)
        elif self._bytes > _BATCH_BYTES:
            self._flush()

    def rebuild(self, cls: type[Message] | None) -> None:
        """Send what has arrived so far, and take the fields of all present plots out of what comes."""
        self._flush()
        paths = list(dict.fromkeys(path for stream in self.streams for path in stream.paths))
        try:
            self._extractor = None if cls is None else FieldExtractor(cls, paths)
        except MessageError:  # a publisher has come back with a type that lacks one
            self._extractor = None

    def close(self) -> None:
        self._samples.clear()
        self._stop_timer()

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _flush(self) -> None:
        self._stop_timer()
        samples, self._samples, self._bytes = self._samples, [], 0
        if not samples:
            return
        if self._extractor is None:
            self._feed.refuse(len(samples))
            return
        before = self._extractor.undecodable
        times, columns = self._extractor.columns(
            [sample.stamp / SECOND for sample in samples], [sample.data for sample in samples]
        )
        if self._extractor.undecodable > before:
            self._feed.refuse(self._extractor.undecodable - before)
        if times:
            self._send(times, dict(zip(self._extractor.paths, columns, strict=True)))

    def _send(self, times: Sequence[float], columns: dict[str, Sequence[float]]) -> None:
        """Send each stream its columns, each of which is packed once."""
        packed_times = protocol.pack_values(times)
        packed = {path: protocol.pack_values(column) for path, column in columns.items()}
        for stream in self.streams:
            if all(path in packed for path in stream.paths):
                found = [packed[path] for path in stream.paths]
                data = protocol.join_points(stream.number, len(times), packed_times, found)
                stream.client.send(data, f"plot {stream.number}", amount=len(times))


class _Watches:
    """The pages that watch one topic, and its newest message."""

    def __init__(self, feed: TopicFeed) -> None:
        self.clients: dict[WebClient, None] = {}
        """The pages, in order (the values mean nothing)."""
        self._feed = feed
        self._newest: Sample | None = None
        self._shown = ""  # the newest message as it was sent
        self._skipped = -1
        self._next_at = 0.0
        self._timer: asyncio.TimerHandle | None = None

    def add(self, client: WebClient) -> None:
        self.clients[client] = None
        if self._shown:
            client.send(self._shown, f"message {self._feed.topic}")

    def add_sample(self, sample: Sample) -> None:
        self._newest = sample
        self._skipped += 1
        if self._timer is None:
            self._timer = self._feed.after(max(0.0, self._next_at - self._feed.time()), self._show)

    def close(self) -> None:
        if self._timer is not None:
            self._timer.cancel()

    def _show(self) -> None:
        self._timer = None
        sample, skipped, self._skipped = self._newest, self._skipped, -1
        if sample is None:
            return
        begin = self._feed.time()
        self._shown = protocol.encode(self._news(sample, skipped)).decode()
        for client in self.clients:
            client.send_newest(self._shown, f"message {self._feed.topic}")
        end = self._feed.time()
        self._next_at = end + max(WATCH_PERIOD, _WATCH_SHARE * (end - begin))

    def _news(self, sample: Sample, skipped: int) -> dict[str, Any]:
        return {
            "op": "message",
            "topic": self._feed.topic,
            "time": sample.stamp,
            "module": sample.source.module,
            "node": sample.source.node,
            "sequence": sample.sequence,
            "skipped": skipped,
            "fields": self._fields(sample.data),
        }

    def _fields(self, data: bytes) -> dict[str, Any]:
        """Return a message as plain values, long arrays shortened; its bytes in hex where its type is unknown."""
        cls = self._feed.cls
        if cls is not None:
            try:
                return to_plain(layout(cls).decode(data), "short")
            except DecodeError:
                pass
        self._feed.learn_type()
        return raw_fields(data)
