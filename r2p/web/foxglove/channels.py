"""The topics of the network as channels: a topic is subscribed while a client wants it, and each message of it is made
once for all clients.

A channel has the type of its topic. Where that is not known yet, other modules are asked, and the channel comes when
they have answered: with bytes only if none of them knows it. One whose type is found later, or changes, is replaced.

`/tf` is made of the poses of all odometries, unless the network has one of its own.
"""

import asyncio
from collections import Counter
from collections.abc import Callable, Mapping, Sequence

from r2p.codecs.services import is_of_service
from r2p.errors import DecodeError, Error, MessageError
from r2p.messages import Message, layout
from r2p.modules.graph import TopicView
from r2p.monitoring.topic_types import TypeFinder
from r2p.names import LOADER_PREFIX, RESERVED
from r2p.ros.ros2_schemas import ROS2MSG, Ros2Schema
from r2p.runtime.immediate import ImmediateSubscriber
from r2p.runtime.node import Node
from r2p.runtime.sample import Sample
from r2p.runtime.topic import TopicSpace
from r2p.units import SECOND
from r2p.web.client import WebClient
from r2p.web.foxglove import protocol
from r2p.web.foxglove.channel_types import POSES, Encode, channel_type, transform_encoder, transform_schema

TRANSFORMS = "tf"

_AT_ONCE = 16  # topics whose type is asked for
_ASKED_AGAIN = 10 * SECOND  # ns after which an unknown type is looked for again

_TypeKey = tuple[str, str] | None
"""Name and schema of a class: two classes that were learnt of other modules may be the same."""


class Channel:
    """A channel, with the topics that its messages come from: one as a rule."""

    def __init__(self, number: int, name: str, schema: Ros2Schema, space: TopicSpace, node: Node) -> None:
        self.info = protocol.ServerChannel(number, f"/{name}", protocol.CDR, schema.name, ROS2MSG, schema.text)
        self.name = name
        self.problem = ""
        """Why it has bytes only, or not the standard type."""
        self.clients: dict[WebClient, int] = {}
        """The clients that have subscribed, with their numbers for it."""
        self.undecodable = 0
        """Messages that are not of the channel's type."""
        self._space = space
        self._node = node
        self._encoders: dict[str, Encode] = {}
        self._subscribers: dict[str, ImmediateSubscriber] = {}

    def set_sources(self, encoders: Mapping[str, Encode]) -> None:
        """Send the messages of these topics, each by its encoder."""
        for topic in self._encoders.keys() - encoders.keys():
            del self._encoders[topic]
            self._close(topic)
        for topic in encoders.keys() - self._encoders.keys():
            self._encoders[topic] = encoders[topic]
            if self.clients:
                self._open(topic)

    def subscribe(self, client: WebClient, number: int) -> None:
        """Send the messages to a client, the last ones of latched topics first."""
        if self.clients:
            self._send_latched(client, number)
        self.clients[client] = number
        for topic in self._encoders.keys() - self._subscribers.keys():
            self._open(topic)

    def unsubscribe(self, client: WebClient) -> None:
        """Stop sending a client the messages."""
        if self.clients.pop(client, None) is not None and not self.clients:
            for topic in list(self._subscribers):
                self._close(topic)

    def close(self) -> None:
        """End all subscriptions."""
        self.clients.clear()
        self.set_sources({})

    def _open(self, topic: str) -> None:
        encode = self._encoders[topic]

        def handle(sample: Sample) -> None:
            self._send(self._encoded(encode, sample), self.clients)

        subscriber = self._subscribers[topic] = ImmediateSubscriber(self._space, self._node, handle, lossy=True)
        subscriber.open(topic, None)

    def _close(self, topic: str) -> None:
        subscriber = self._subscribers.pop(topic, None)
        if subscriber is not None:
            subscriber.close()

    def _send_latched(self, client: WebClient, number: int) -> None:
        """Send what one more subscriber gets at once: the latched messages."""
        for topic, encode in self._encoders.items():

            def handle(sample: Sample, encode: Encode = encode) -> None:
                self._send(self._encoded(encode, sample), {client: number})

            late = ImmediateSubscriber(self._space, self._node, handle, lossy=True)
            late.open(topic, None)
            late.close()

    def _encoded(self, encode: Encode, sample: Sample) -> Sequence[bytes]:
        try:
            return encode(sample)
        except (DecodeError, MessageError):
            self.undecodable += 1
            return ()

    def _send(self, messages: Sequence[bytes], clients: Mapping[WebClient, int]) -> None:
        now, name = self._space.clock.now(), self.info.topic
        for data in messages:
            for client, number in clients.items():
                client.send(protocol.message(number, now, data), name)


Changed = Callable[[Channel], None]
"""Called with a channel that has come or gone."""


class ChannelTable:
    """The channels of a module's network, as of the last `review`."""

    def __init__(self, space: TopicSpace, node: Node, types: TypeFinder, added: Changed, removed: Changed) -> None:
        self.by_number: dict[int, Channel] = {}
        self.counts: Counter[str] = Counter()
        """The problem with the stamps of messages."""
        self._space = space
        self._node = node
        self._types = types
        self._added = added
        self._removed = removed
        self._by_topic: dict[str, tuple[Channel, _TypeKey]] = {}
        self._wanted: set[str] = set()
        self._looking: dict[str, asyncio.Task[None]] = {}
        self._looked_at: dict[str, int] = {}
        self._limit = asyncio.Semaphore(_AT_ONCE)
        self._transforms: Channel | None = None
        self._numbers = 0

    def review(self, views: Mapping[str, TopicView]) -> None:
        """Add newly published topics, and remove those that are no longer published."""
        self._wanted = {name for name, view in views.items() if view.published_on and _is_shown(name, views)}
        for name in self._by_topic.keys() - self._wanted:
            self._remove(name)
        for name in self._looked_at.keys() - self._wanted:
            del self._looked_at[name]
        for name in sorted(self._wanted):
            self._review_type(name)
        self._review_transforms()

    def _review_type(self, name: str) -> None:
        cls = self._types.known(name)
        channel, key = self._by_topic.get(name, (None, None))
        if cls is None:
            if key is None:  # one that had a type keeps it
                self._look(name)
        elif channel is None or key != _key(cls):
            self._put(name, cls)

    def _look(self, name: str) -> None:
        """Ask other modules for a type, unless that was just done."""
        now = self._space.clock.monotonic()
        if name in self._looking or now - self._looked_at.get(name, -_ASKED_AGAIN) < _ASKED_AGAIN:
            return
        self._looked_at[name] = now
        self._looking[name] = asyncio.create_task(self._find(name), name=f"type of {name} for Foxglove")

    async def _find(self, name: str) -> None:
        try:
            async with self._limit:
                cls = await self._types.find(name)
        except Error:  # the module was closed meanwhile
            return
        finally:
            del self._looking[name]
        if name in self._wanted and (cls is not None or name not in self._by_topic):
            self._put(name, cls)
            self._review_transforms()

    def _put(self, name: str, cls: type[Message] | None) -> None:
        """Add the channel of a topic; one of another type is replaced."""
        if name in self._by_topic:
            self._remove(name)
        found = channel_type(name, cls, self.counts)
        channel = self._add(name, found.schema)
        channel.problem = found.problem
        channel.set_sources({name: found.encode})
        self._by_topic[name] = channel, None if cls is None else _key(cls)
        self._added(channel)

    def _add(self, name: str, schema: Ros2Schema) -> Channel:
        self._numbers += 1
        channel = self.by_number[self._numbers] = Channel(self._numbers, name, schema, self._space, self._node)
        return channel

    def _remove(self, name: str) -> None:
        channel, _ = self._by_topic.pop(name)
        self._withdraw(channel)

    def _withdraw(self, channel: Channel) -> None:
        del self.by_number[channel.info.id]
        channel.close()
        self._removed(channel)

    def _review_transforms(self) -> None:
        """Have one channel with the poses of all robots that publish no transforms themselves."""
        encoders = {
            name: transform_encoder(name, cls, self.counts)
            for name in self._by_topic
            if _beside(name, TRANSFORMS) not in self._wanted and (cls := self._types.known(name)) in POSES
        }
        if TRANSFORMS in self._wanted:  # two channels can't have one name
            encoders = {}
        if encoders and self._transforms is None:
            self._transforms = self._add(TRANSFORMS, transform_schema())
            self._transforms.set_sources(encoders)
            self._added(self._transforms)
        elif encoders and self._transforms is not None:
            self._transforms.set_sources(encoders)
        elif self._transforms is not None:
            self._withdraw(self._transforms)
            self._transforms = None

    def close(self) -> None:
        """End all subscriptions, and stop asking for types."""
        for task in list(self._looking.values()):
            task.cancel()
        for channel in self.by_number.values():
            channel.close()


def _is_shown(name: str, topics: Mapping[str, TopicView]) -> bool:
    return name not in RESERVED and not name.startswith(LOADER_PREFIX) and not is_of_service(name, topics)


def _key(cls: type[Message]) -> _TypeKey:
    return layout(cls).name, layout(cls).schema


def _beside(name: str, other: str) -> str:
    """Return the name of another topic of the same robot."""
    return f"{name.rpartition('/')[0]}/{other}".removeprefix("/")
