"""What this module has to say of itself on one link: what it publishes, subscribes, and who in it does so."""

import msgspec

from r2p.codecs import management
from r2p.codecs.management import NO_PARAMS, ROLE_GONE, ROLE_PUBLISHES, ROLE_SUBSCRIBES
from r2p.protocols.directory import FOR_EVER, LEASE
from r2p.protocols.events import Shape
from r2p.protocols.outbox import Outbox
from r2p.protocols.schedule import Item, Kind, Schedule


class Own(msgspec.Struct, frozen=True):
    """A topic that this module publishes (`params` are the transport's) or subscribes (with a `queue`)."""

    shape: Shape
    params: bytes = NO_PARAMS
    queue: int = 1

    def type(self, topic: str, role: int) -> management.TypeInfo:
        return management.TypeInfo(role, topic, self.shape.fingerprint, self.shape.size)

    def request(self, topic: str) -> management.SubscribeRequest:
        return management.SubscribeRequest(topic, self.shape.size, self.queue)


class Announcer:
    """Turns what the module has into messages, as the schedule allows.

    While `r2p` modules are known on the link, types go before announcements, and endpoints are told.
    """

    def __init__(self, module: str, instance: int, schedule: Schedule, outbox: Outbox, *, observer: bool) -> None:
        self.flags = 0
        self.publishers: dict[str, Own] = {}
        self.subscribers: dict[str, Own] = {}
        self.r2p = False
        self._module = module
        self._instance = instance
        self._observer = observer
        self._schedule = schedule
        self._outbox = outbox
        self._endpoints: dict[tuple[str, str, int], int] = {}
        self._items: dict[tuple[Kind, tuple[str | int, ...]], Item] = {}

    def publish(self, topic: str, own: Own) -> bool:
        """Announce a publisher of the topic. Says whether that is news."""
        return self._enter(self.publishers, Kind.PUBLISHER, topic, own)

    def withdraw(self, topic: str) -> bool:
        return self._remove(self.publishers, Kind.PUBLISHER, topic)

    def subscribe(self, topic: str, own: Own) -> bool:
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
        """Say it as soon as the rate allows, if the link is up."""
        if self._outbox.up:
            self._schedule.add(Item(kind, key, once=True))

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
            self._outbox.say(*messages)
            self._schedule.sent(now, len(messages))

    def introduction(self, flags: int = 0) -> management.Hello:
        """Our HELLO. Its lease outlasts two lost rounds of repetition."""
        tool = management.HELLO_TOOL if self._observer else 0
        lease = min(max(LEASE, 3 * self._schedule.round_time), FOR_EVER) // 1_000_000
        return management.Hello(self._module, self._instance, flags | tool, 0, lease)

    def _enter(self, table: dict[str, Own], kind: Kind, topic: str, own: Own) -> bool:
        if table.get(topic) == own:
            return False
        table[topic] = own
        self._add(kind, topic)
        return True

    def _remove(self, table: dict[str, Own], kind: Kind, topic: str) -> bool:
        if table.pop(topic, None) is None:
            return False
        self._drop(kind, topic)
        return True

    def _add(self, kind: Kind, *key: str | int) -> None:
        """Say it as soon as possible, and again and again."""
        self._drop(kind, *key)
        item = self._items[kind, key] = Item(kind, key)
        self._schedule.add(item)

    def _drop(self, kind: Kind, *key: str | int) -> None:
        item = self._items.pop((kind, key), None)
        if item is not None:
            self._schedule.drop(item)

    def _messages(self, item: Item) -> list[management.Management]:
        match item.kind, item.key:
            case Kind.PUBLISHER, (str(topic),):
                own = self.publishers[topic]
                return self._typed(own, topic, ROLE_PUBLISHES, _advertise(topic, own))
            case Kind.SUBSCRIBER, (str(topic),):
                own = self.subscribers[topic]
                return self._typed(own, topic, ROLE_SUBSCRIBES, own.request(topic))
            case Kind.UNSUBSCRIBE, (str(topic),):
                return [management.Unsubscribe(topic, self._instance)]
            case Kind.CONFLICT, (str(module), int(a), int(b)):
                return [management.Conflict(module, a, b)]
            case Kind.ENDPOINT, (str(node), str(topic), int(role)):
                publisher_class = self._endpoints[node, topic, role]
                return [management.Endpoint(role, self._instance, node, topic, publisher_class)]
            case Kind.ENDPOINT_GONE, (str(node), str(topic), int(role)):
                return [management.Endpoint(role | ROLE_GONE, self._instance, node, topic)]
            case kind, _:
                return self._presence(management.HELLO_QUERY if kind is Kind.QUERY else 0)

    def _typed(self, own: Own, topic: str, role: int, message: management.Management) -> list[management.Management]:
        return [own.type(topic, role), message] if self.r2p else [message]

    def _presence(self, flags: int) -> list[management.Management]:
        hello = self.introduction(flags)
        return [hello] if self._observer else [hello, management.Alive(self._module, self.flags)]


def _advertise(topic: str, own: Own) -> management.Advertise:
    return management.Advertise(topic, own.shape.size, 0, own.params)
