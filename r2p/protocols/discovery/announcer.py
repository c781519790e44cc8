"""What this module has to say of itself on one link: what it publishes, subscribes, and who in it does so."""

from collections.abc import Callable

import msgspec

from r2p.codecs import management
from r2p.codecs.management import ANSWERED, NO_PARAMS, ROLE_GONE, ROLE_PUBLISHES, ROLE_SUBSCRIBES, UNANSWERED
from r2p.protocols.discovery import peers as aliases
from r2p.protocols.discovery.directory import FOR_EVER, LEASE
from r2p.protocols.discovery.events import Outbox, TopicType
from r2p.protocols.discovery.schedule import Item, Kind, Schedule


class LocalTopic(msgspec.Struct, frozen=True):
    """A topic that this module publishes (`params` are the transport's) or subscribes (with a `queue`)."""

    shape: TopicType
    params: bytes = NO_PARAMS
    queue: int = management.QUEUE

    def type(self, topic: str, role: int) -> management.TypeInfo:
        return management.TypeInfo(role, topic, self.shape.fingerprint, self.shape.size)


Relayed = management.Hello | management.Alive | management.Endpoint
"""What a gateway passes on of other modules."""


class Announcer:
    """Turns what the module has into messages, as the schedule allows.

    While `r2p` modules are known on the link, types go before announcements, and endpoints are told.
    """

    def __init__(
        self,
        module: str,
        instance: int,
        schedule: Schedule,
        outbox: Outbox,
        size_of: Callable[[str], int],
        *,
        observer: bool,
    ) -> None:
        """`size_of`: what is known of a topic's size (bytes, 0: nothing) from others."""
        self.flags = 0
        self.publishers: dict[str, LocalTopic] = {}
        self.subscribers: dict[str, LocalTopic] = {}
        self.r2p = False
        self.answered: set[str] = set()
        """The subscribed topics that somebody publishes to us."""
        self.wanted: set[str] = set()
        """The published topics that somebody subscribes."""
        self._module = module
        self._instance = instance
        self._observer = observer
        self._size_of = size_of
        self._schedule = schedule
        self._outbox = outbox
        self._endpoints: dict[tuple[str, str, int], int] = {}
        self._relayed: dict[tuple[str | int, ...], Relayed] = {}

    def publish(self, topic: str, own: LocalTopic) -> bool:
        """Announce a publisher of the topic. Says whether that is news."""
        return self._enter(self.publishers, Kind.PUBLISHER, topic, own)

    def advertise_again(self, topic: str) -> None:
        """Say as soon as possible that we publish the topic."""
        if topic in self.publishers:
            self._add(Kind.PUBLISHER, topic)

    def withdraw(self, topic: str) -> bool:
        return self._remove(self.publishers, Kind.PUBLISHER, topic)

    def subscribe(self, topic: str, own: LocalTopic) -> bool:
        """Announce a subscriber of the topic. Says whether that is news."""
        return self._enter(self.subscribers, Kind.SUBSCRIBER, topic, own)

    def unsubscribe(self, topic: str) -> bool:
        was_there = self._remove(self.subscribers, Kind.SUBSCRIBER, topic)
        if was_there and self.r2p:
            self.once(Kind.UNSUBSCRIBE, topic)
        return was_there

    def endpoint(self, node: str, topic: str, role: int, publisher_class: int) -> None:
        key = (node, topic, role)
        if self._endpoints.get(key) != publisher_class:
            self._endpoints[key] = publisher_class
            if self.r2p:
                self._add(Kind.ENDPOINT, *key)

    def endpoint_gone(self, node: str, topic: str, role: int) -> None:
        if self._endpoints.pop((node, topic, role), None) is not None:
            self._drop(Kind.ENDPOINT, node, topic, role)
            if self.r2p:
                self.once(Kind.ENDPOINT_GONE, node, topic, role)

    def once(self, kind: Kind, *key: str | int) -> None:
        """Say it as soon as the rate allows, if the link is up. What waits already is not said twice."""
        if self._outbox.up:
            self._schedule.add(Item(kind, key, once=True))

    def relay(self, message: Relayed) -> None:
        """Say what another module has said on another link, as soon as the rate allows."""
        if not self._outbox.up:
            return
        match message:
            case management.Hello(module) | management.Alive(module):
                key: tuple[str | int, ...] = (type(message).__name__, module)
            case management.Endpoint(role, instance, node, topic):
                key = (instance, node, topic, role & ~ROLE_GONE)
        if isinstance(message, management.Hello):
            lease = max(message.lease_ms, 3 * self._schedule.relay_time // 1_000_000)
            message = msgspec.structs.replace(message, lease_ms=min(lease, 0xFFFF))
        self._relayed[key] = message
        self._schedule.relay(Item(Kind.RELAY, key, once=True))

    def follow(self, *, r2p: bool) -> None:
        """Endpoints are only told while there are r2p modules to hear it."""
        if self.r2p == r2p:
            return
        self.r2p = r2p
        for key in self._endpoints:
            if r2p:
                self._add(Kind.ENDPOINT, *key)
            else:
                self._drop(Kind.ENDPOINT, *key)

    def go_on(self, now: int) -> None:
        """Say what is due."""
        while self._outbox.up and (item := self._schedule.pop(now)) is not None:
            messages = self._messages(item)
            if messages:
                self._outbox.say(*messages)
                self._schedule.sent(now, len(messages))

    def introduction(self, flags: int = 0) -> management.Hello:
        """Our HELLO. Its lease outlasts two lost rounds of repetition."""
        tool = management.HELLO_TOOL if self._observer else 0
        lease = min(max(LEASE, 3 * self._schedule.round_time), FOR_EVER) // 1_000_000
        return management.Hello(self._module, self._instance, flags | tool, 0, lease)

    def requests(self, topic: str, own: LocalTopic, size: int = 0) -> list[management.Management]:
        """Our request; r2p modules are told whether anybody has answered yet.

        There is none while nobody has said the topic's size (`size`: the publisher that is asked): a request of size 0
        makes firmware's gateways overrun their buffers.
        """
        size = own.shape.size or size or self._size_of(topic)
        if not size:
            return []
        params = NO_PARAMS if not self.r2p else ANSWERED if topic in self.answered else UNANSWERED
        return [management.SubscribeRequest(topic, size, management.queue_length(size, own.queue), params)]

    def _advertisement(self, topic: str, own: LocalTopic) -> management.Advertise:
        """Our advertisement; r2p modules are told whether anybody has subscribed yet."""
        unanswered = self.r2p and topic not in self.wanted
        params = management.with_unanswered(own.params) if unanswered else own.params
        return management.Advertise(topic, own.shape.size, 0, params)

    def _enter(self, table: dict[str, LocalTopic], kind: Kind, topic: str, own: LocalTopic) -> bool:
        if table.get(topic) == own:
            return False
        table[topic] = own
        self._add(kind, topic)
        return True

    def _remove(self, table: dict[str, LocalTopic], kind: Kind, topic: str) -> bool:
        if table.pop(topic, None) is None:
            return False
        self._drop(kind, topic)
        return True

    def _add(self, kind: Kind, *key: str | int) -> None:
        """Say it as soon as possible, and again and again."""
        self._schedule.add(Item(kind, key))

    def _drop(self, kind: Kind, *key: str | int) -> None:
        self._schedule.drop(Item(kind, key))

    def _messages(self, item: Item) -> list[management.Management]:
        match item.kind, item.key:
            case Kind.PUBLISHER, (str(topic),):
                own = self.publishers[topic]
                return self._typed(own, topic, ROLE_PUBLISHES, [self._advertisement(topic, own)])
            case Kind.SUBSCRIBER, (str(topic),):
                own = self.subscribers[topic]
                return self._typed(own, topic, ROLE_SUBSCRIBES, self.requests(topic, own))
            case Kind.UNSUBSCRIBE, (str(topic),):
                return [management.Unsubscribe(topic, self._instance)]
            case Kind.CONFLICT, (str(module), int(a), int(b)):
                return [management.Conflict(module, a, b)]
            case Kind.ENDPOINT, (str(node), str(topic), int(role)):
                publisher_class = self._endpoints[node, topic, role]
                return [management.Endpoint(role, self._instance, node, topic, publisher_class)]
            case Kind.ENDPOINT_GONE, (str(node), str(topic), int(role)):
                return [management.Endpoint(role | ROLE_GONE, self._instance, node, topic)]
            case Kind.RELAY, key:
                return _short(self._relayed.pop(key))
            case kind, _:
                return self._presence(management.HELLO_QUERY if kind is Kind.QUERY else 0)

    def _typed(
        self, own: LocalTopic, topic: str, role: int, messages: list[management.Management]
    ) -> list[management.Management]:
        return [own.type(topic, role), *messages] if self.r2p else messages

    def _presence(self, flags: int) -> list[management.Management]:
        hello = self.introduction(flags)
        return [hello] if self._observer else [hello, management.Alive(self._module, self.flags)]


def _short(message: Relayed) -> list[management.Management]:
    """A message with an alias in place of a long name, behind what that stands for."""
    if isinstance(message, management.Endpoint):
        return [message]
    names = aliases.told(message.module)
    return [*names, msgspec.structs.replace(message, module=names[0].alias)] if names else [message]
