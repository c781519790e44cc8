"""Announce on one link what this module publishes and subscribes to, and which of its nodes do so.

The schedule holds keys only. The announcer makes the messages of a key in its turn, from the present state.
"""

from collections import Counter, deque

import msgspec

from r2p.codecs import management
from r2p.codecs.management import (
    ANSWERED,
    KIND_NODE,
    KIND_TOPIC,
    NO_PARAMS,
    ROLE_GONE,
    ROLE_PUBLISHES,
    ROLE_SUBSCRIBES,
    UNANSWERED,
)
from r2p.protocols.discovery.aliases import LinkNames
from r2p.protocols.discovery.directory import FOR_EVER, LEASE, Directory, decrement
from r2p.protocols.discovery.events import Outbox, PeerAddress, TopicType
from r2p.protocols.discovery.schedule import Item, ItemKind, Schedule
from r2p.units import MILLISECOND
from r2p.version import __version__

Relayed = management.Hello | management.Alive | management.Endpoint
"""Messages about other modules that a gateway passes on."""

_KindName = tuple[int, str]
"""KIND_TOPIC or KIND_NODE, and a name."""

_HELLO_EACH = 3
"""Presences in a crowd of which one has a HELLO: ALIVE extends the lease as well."""
_HELLO_EACH_TOLD = 12
"""The same on networks where newcomers are answered one by one."""
_ANSWERS_AT_ONCE = 256
"""Items said to one module in one turn."""
_KIND_OF_ROLE = {ROLE_PUBLISHES: ItemKind.PUBLISHER, ROLE_SUBSCRIBES: ItemKind.SUBSCRIBER}


class LocalTopic(msgspec.Struct, frozen=True):
    """A topic that this module publishes (`params` are the transport's), or subscribes to with a `queue`."""

    type: TopicType
    params: bytes = NO_PARAMS
    queue: int = management.QUEUE

    def type_info(self, topic: str, role: int) -> management.TypeInfo:
        return management.TypeInfo(role, topic, self.type.fingerprint, self.type.size_field)


class _AnswerPart(msgspec.Struct, frozen=True):
    """A part of an answer about everything, as of a revision of the schedule."""

    revision: int
    items: list[Item]
    messages: tuple[bytes, ...]


class Announcer:
    """The announcements of one module, sent as fast as the schedule allows.

    While r2p modules are known on the link (`r2p`), or no others can be there, a TYPE precedes each announcement, and
    endpoints are announced. The names behind aliases are announced always, and before what travels as the alias.
    """

    def __init__(
        self,
        module: str,
        instance: int,
        schedule: Schedule,
        outbox: Outbox,
        directory: Directory,
        names: LinkNames,
        *,
        observer: bool,
    ) -> None:
        self.module = module
        self.instance = instance
        self.flags = 0
        self.r2p = False
        self._announces_endpoints = False
        self.topics: dict[int, dict[str, LocalTopic]] = {ROLE_PUBLISHES: {}, ROLE_SUBSCRIBES: {}}
        """Topics that the module publishes and subscribes to, by ROLE_... and name."""
        self.publisher_counts: Counter[str] = Counter()
        """Number of peers that publish each subscribed topic to this module; topics without one are missing."""
        self.subscriber_counts: Counter[str] = Counter()
        """The same for published topics, and peers that subscribe to them."""
        self._observer = observer
        self.is_gateway = False
        self.has_sole_link = False
        self.outbox = outbox
        self._directory = directory
        self._names = names
        self._schedule = schedule
        self._endpoints: dict[tuple[str, str, int], int] = {}
        self._relayed: dict[tuple[str | int, ...], Relayed] = {}
        self._relayed_names: dict[tuple[str | int, ...], list[_KindName]] = {}
        """The names in relayed endpoints, by the key of each."""
        self._said: set[tuple[str | int, ...]] = set()
        """Subscriptions and endpoints that modules knew when the link went down, by their keys."""
        self._ended: dict[Item, None] = {}
        """Those of them that have ended since, which the modules must be told."""
        self._claimed: set[str] = set()
        """Topics whose names are announced, also while the link does not carry them as another one has the alias."""
        self._long_names: Counter[_KindName] = Counter()
        """Names that travel as aliases, and how many announcements have each."""
        self._answers: dict[PeerAddress, deque[_AnswerPart]] = {}
        """What is still to be said to modules that have asked, by address."""
        self._answer: list[_AnswerPart] = []
        """The last answer, for others that ask until something changes."""
        schedule.is_settled = self._is_settled
        self._hello_in = 0
        """Presences until the next HELLO in a crowd."""
        self._said_lease = 0
        """The lease in the last HELLO to all (ms)."""

    # The module's topics

    def set_topic(self, topic: str, role: int, own: LocalTopic) -> bool:
        """Announce that the module publishes or subscribes to a topic; return whether that is new, or has changed."""
        if self.topics[role].get(topic) == own:
            return False
        if topic not in self.topics[role]:
            self._add_name(KIND_TOPIC, topic)  # before the topic: an alias is of no use without its name
        self.topics[role][topic] = own
        self._ended.pop(Item(ItemKind.UNSUBSCRIBE, (topic,), once=True), None)
        self._add(_KIND_OF_ROLE[role], topic)
        return True

    def remove_topic(self, topic: str, role: int) -> bool:
        """Stop announcing the topic in this role; return whether it was announced."""
        if self.topics[role].pop(topic, None) is None:
            return False
        self._drop(_KIND_OF_ROLE[role], topic)
        self._drop_name(KIND_TOPIC, topic)
        if role == ROLE_SUBSCRIBES:
            self._announce_end(ItemKind.UNSUBSCRIBE, topic)
        return True

    def add_endpoint(self, node: str, topic: str, role: int, publisher_class: int) -> None:
        key = (node, topic, role)
        if self._endpoints.get(key) != publisher_class:
            if key not in self._endpoints:
                self._names.claim(KIND_NODE, node)
                self._add_name(KIND_NODE, node)
            self._endpoints[key] = publisher_class
            self._ended.pop(Item(ItemKind.ENDPOINT_GONE, key, once=True), None)
            if self._has_readers:
                self._add(ItemKind.ENDPOINT, *key)

    def remove_endpoint(self, node: str, topic: str, role: int) -> None:
        if self._endpoints.pop((node, topic, role), None) is not None:
            self._drop(ItemKind.ENDPOINT, node, topic, role)
            self._drop_name(KIND_NODE, node)
            if not any(each == node for each, _, _ in self._endpoints):
                self._names.release(KIND_NODE, node)
            self._announce_end(ItemKind.ENDPOINT_GONE, node, topic, role)

    def _announce_end(self, kind: ItemKind, *key: str | int) -> None:
        """Announce the end of a subscription or endpoint, now or after an outage: others may keep it for good."""
        item = Item(kind, key, once=True)
        if self.outbox.up and self._has_readers:
            self._schedule.add(item)
        elif self._directory.is_lossless and key in self._said:
            self._ended[item] = None

    # When to announce it

    def announce_once(self, kind: ItemKind, *key: str | int) -> None:
        """Announce an item once, as soon as the rate allows, if the link is up and it is not waiting already."""
        if self.outbox.up:
            self._schedule.add(Item(kind, key, once=True))

    def advertise_again(self, topic: str) -> None:
        """Repeat the advertisement of a topic as soon as the rate allows."""
        if topic in self.topics[ROLE_PUBLISHES]:
            self._add(ItemKind.PUBLISHER, topic)

    def await_response(self, topic: str) -> None:
        """Repeat the request for a topic until it has been answered."""
        self._schedule.quicken(Item(ItemKind.SUBSCRIBER, (topic,)))

    def await_agreement(self, topic: str, role: int) -> None:
        """Repeat a topic until its type fits those of its peers."""
        self._schedule.quicken(Item(_KIND_OF_ROLE[role], (topic,)))

    def _is_settled(self, item: Item) -> bool:
        """Return whether a topic needs no answer: a subscriber without a known publisher has none to come."""
        if item.kind not in _KIND_OF_ROLE.values():
            return True
        info = self._directory.topics.get(str(item.key[0]))
        if info is not None and info.mismatch:  # the peer may take it, once it has forgotten the type of before
            return False
        if item.kind is ItemKind.PUBLISHER or item.key[0] in self.publisher_counts:
            return True
        return info is None or info.advertised_at is None

    def set_lossless(self, *, lossless: bool) -> None:
        """Repeat as little as is possible where nothing is lost. Begin with a HELLO, which may have been lost before,
        and is rare from now on.
        """
        if self._schedule.set_lossless(lossless=lossless):
            self._hello_in = 0
            self.announce_once(ItemKind.PRESENCE)

    def repeat_all(self, now: int, *, tool: bool) -> None:
        """Repeat everything soon, as a module on the link is new, or asks for it; `tool`: it shows all to a user."""
        self._hello_in = 0
        self._schedule.repeat(now, self._directory.r2p_modules, tool=tool)

    def answer(self, source: PeerAddress) -> None:
        """Say everything to one module that asks, where that is possible and arrives. What is to be announced for the
        first time is not said twice.
        """
        if not self._answer or self._answer[0].revision != self._schedule.revision:
            items = self._schedule.announced()
            starts = range(0, max(len(items), 1), _ANSWERS_AT_ONCE)
            self._answer = [self._part(items[at : at + _ANSWERS_AT_ONCE]) for at in starts]
        self._answers[source] = deque(self._answer)

    @property
    def has_answers(self) -> bool:
        return bool(self._answers)

    def relay(self, message: Relayed) -> None:
        """Pass on a message of another module from another link, as soon as the rate allows."""
        if not self.outbox.up:
            return
        match message:
            case management.Hello(module) | management.Alive(module):
                key: tuple[str | int, ...] = (type(message).__name__, module)
            case management.Endpoint(role, instance, node, topic):
                key = (instance, node, topic, role & ~ROLE_GONE)
                self._relay_names(key, [] if role & ROLE_GONE else [(KIND_TOPIC, topic), (KIND_NODE, node)])
        if isinstance(message, management.Hello):
            # On a slow link the next one is late: its module must not seem gone until then.
            lease = max(message.lease_ms, 3 * self._schedule.relay_time // MILLISECOND)
            message = msgspec.structs.replace(message, lease_ms=min(lease, management.LEASE_MS_MAX))
        self._relayed[key] = message
        self._schedule.relay(Item(ItemKind.RELAY, key, once=True))

    def update_r2p(self) -> None:
        """Begin or end what only r2p modules understand, as the first one has come, or the last one has gone."""
        self._schedule.set_crowd(self._directory.crowd)
        before, self.r2p = self.r2p, self._directory.r2p_modules > 0
        if self.r2p and not before:
            for item in self._ended:
                self._schedule.add(item)
            self._ended.clear()
            self._said.clear()
        if self._announces_endpoints != self._has_readers:
            self._announces_endpoints = self._has_readers
            for key in self._endpoints:
                if self._announces_endpoints:
                    self._add(ItemKind.ENDPOINT, *key)
                else:
                    self._drop(ItemKind.ENDPOINT, *key)

    @property
    def _has_readers(self) -> bool:
        """Whether all on the link may understand what firmware does not. What is announced once does not wait until the
        first r2p module is known.
        """
        return self.r2p or self._directory.has_addresses

    # Names that travel as aliases

    def announce_name(self, kind: int, name: str) -> None:
        """Announce once that this module has a topic of a short name, which is also the alias of another one."""
        self.announce_once(ItemKind.LONG_NAME, kind, name, 0)

    def set_claimed(self, topic: str, *, claimed: bool) -> None:
        """Announce the name of a topic for as long as this module uses it: so both modules with an alias stay refused,
        and tools that come later learn why.
        """
        if claimed and topic not in self._claimed:
            self._claimed.add(topic)
            self._add_name(KIND_TOPIC, topic)
        elif not claimed and topic in self._claimed:
            self._claimed.remove(topic)
            self._drop_name(KIND_TOPIC, topic)

    def _add_name(self, kind: int, name: str) -> None:
        """Announce the name behind an alias for as long as anything announced has the alias."""
        if self._names.alias(kind, name) == name:
            return
        self._long_names[kind, name] += 1
        if self._long_names[kind, name] == 1:
            self._schedule_name(kind, name, announced=True)

    def _drop_name(self, kind: int, name: str) -> None:
        """Note that one announcement less has the name."""
        if (kind, name) in self._long_names and decrement(self._long_names, (kind, name)):
            self._schedule_name(kind, name, announced=False)

    def _relay_names(self, key: tuple[str | int, ...], names: list[_KindName]) -> None:
        """Announce the names in the relayed message with this key, instead of those before."""
        before = self._relayed_names.pop(key, [])
        long = [(kind, name) for kind, name in names if self._names.alias(kind, name) != name]
        if long:
            self._relayed_names[key] = long
        for each in long:
            self._add_name(*each)
        for each in before:
            self._drop_name(*each)

    def _schedule_name(self, kind: int, name: str, *, announced: bool) -> None:
        for part in range(len(self._name_messages(kind, name))):
            (self._add if announced else self._drop)(ItemKind.LONG_NAME, kind, name, part)

    def _name_messages(self, kind: int, name: str) -> list[management.LongName]:
        return management.long_name_messages(kind, self._names.text(kind, name))

    def link_down(self) -> None:
        """Stop, until the link is up again."""
        if self.r2p:
            self._said = {*((topic,) for topic in self.topics[ROLE_SUBSCRIBES]), *self._endpoints}
        self._answers.clear()
        self._schedule.stop()

    def flush(self, now: int) -> None:
        """Send due announcements, and a part of the answers."""
        if self._answers:
            self._answer_one()
        while self.outbox.up and (item := self._schedule.pop(now)) is not None:
            messages = self._messages(item)
            if messages:
                self.outbox.send(*messages)
                self._schedule.sent(now, len(messages))

    def _answer_one(self) -> None:
        """Say to one of those that have asked what fits into a turn."""
        source, parts = next(iter(self._answers.items()))
        part = parts.popleft()
        if part.revision != self._schedule.revision:
            part = self._part([item for item in part.items if item in self._schedule])
        self.outbox.answer(source, self.outbox.encode(self._introduction()) + part.messages)
        if not parts:
            del self._answers[source]

    def _part(self, items: list[Item]) -> "_AnswerPart":
        messages = self.outbox.encode(each for item in items for each in self._messages(item))
        return _AnswerPart(self._schedule.revision, items, messages)

    # The messages

    def hello(self, flags: int = 0) -> management.Hello:
        """Return this module's HELLO. Its lease outlasts two lost rounds, or a late one where nothing is lost."""
        flags |= management.HELLO_TOOL if self._observer else 0
        flags |= management.HELLO_GATEWAY if self.is_gateway else 0
        flags |= management.HELLO_SOLE_LINK if self.has_sole_link else 0
        release = __version__[: management.RELEASE_MAX]
        return management.Hello(self.module, self.instance, flags, 0, self.lease, management.WIRE_VERSION, release)

    @property
    def lease(self) -> int:
        """The time that this module may be silent (ms). Rounds take longer the more modules there are."""
        rounds = 2 if self._directory.has_addresses else 3
        return min(max(LEASE, rounds * self._schedule.round_time), FOR_EVER) // MILLISECOND

    def requests(self, topic: str, own: LocalTopic, size: int = 0) -> list[management.Management]:
        """Return the request for a topic with this announced size field (0: unknown), if it may be sent.

        While the size is unknown, it may not: a request of size 0 makes gateways of firmware overrun their buffers.
        """
        size = own.type.size_field or size or self._directory.size_of(topic)
        if not size:
            return []
        params = NO_PARAMS if not self.r2p else ANSWERED if topic in self.publisher_counts else UNANSWERED
        return [management.SubscribeRequest(topic, size, management.queue_length(size, own.queue), params)]

    def _advertisement(self, topic: str, own: LocalTopic) -> management.Advertise:
        """Return the advertisement of a topic, which shows r2p modules whether the topic has a subscriber yet."""
        unanswered = self.r2p and topic not in self.subscriber_counts
        params = management.with_unanswered(own.params) if unanswered else own.params
        return management.Advertise(topic, own.type.size_field, 0, params)

    def _messages(self, item: Item) -> list[management.Management]:
        match item.kind, item.key:
            case ItemKind.PUBLISHER, (str(topic),):
                own = self.topics[ROLE_PUBLISHES][topic]
                return self._with_type(own, topic, ROLE_PUBLISHES, [self._advertisement(topic, own)])
            case ItemKind.SUBSCRIBER, (str(topic),):
                own = self.topics[ROLE_SUBSCRIBES][topic]
                return self._with_type(own, topic, ROLE_SUBSCRIBES, self.requests(topic, own))
            case ItemKind.UNSUBSCRIBE, (str(topic),):
                return [management.Unsubscribe(topic, self.instance)]
            case ItemKind.CONFLICT, (str(module), int(a), int(b)):
                return [management.Conflict(module, a, b)]
            case ItemKind.ENDPOINT, (str(node), str(topic), int(role)):
                publisher_class = self._endpoints[node, topic, role]
                return [management.Endpoint(role, self.instance, node, topic, publisher_class)]
            case ItemKind.ENDPOINT_GONE, (str(node), str(topic), int(role)):
                return [management.Endpoint(role | ROLE_GONE, self.instance, node, topic)]
            case ItemKind.LONG_NAME, (int(kind), str(name), int(part)):
                return [self._name_messages(kind, name)[part]]
            case ItemKind.RELAY, key:  # the last that the module said, if it said more meanwhile
                return _with_alias(self._relayed.pop(key))
            case kind, _:
                return self._presence(management.HELLO_QUERY if kind is ItemKind.QUERY else 0)

    def _with_type(
        self, own: LocalTopic, topic: str, role: int, messages: list[management.Management]
    ) -> list[management.Management]:
        if self._has_readers:
            return [own.type_info(topic, role), *messages]
        return [] if own.type.varies else messages  # gateways of firmware would make buffers for messages of one size

    def _presence(self, flags: int) -> list[management.Management]:
        # First the HELLO: after an ALIVE alone the module would be taken for firmware.
        return self._introduction(flags) if flags or not self._is_known() else self._introduction(None)

    def _introduction(self, flags: int | None = 0) -> list[management.Management]:
        """Return what shows that the module is there; without HELLO if its flags are None."""
        hello = [] if flags is None else [self.hello(flags)]
        alive = [] if self._observer else [management.Alive(self.module, self.flags)]
        return [*management.alias_messages(self.module), *hello, *alive]

    def _is_known(self) -> bool:
        """Return whether an ALIVE is enough this time: in a crowd, which would take it for firmware if it were new."""
        alone = self._directory.has_addresses  # newcomers are answered alone: the others don't learn a longer lease
        changed = alone and self.lease != self._said_lease
        if self._observer or not self._directory.crowd or self._hello_in <= 0 or changed:
            self._hello_in = (_HELLO_EACH_TOLD if alone else _HELLO_EACH) - 1
            self._said_lease = self.lease
            return False
        self._hello_in -= 1
        return True

    # The schedule

    def _add(self, kind: ItemKind, *key: str | int) -> None:
        self._schedule.add(Item(kind, key))

    def _drop(self, kind: ItemKind, *key: str | int) -> None:
        self._schedule.drop(Item(kind, key))


def _with_alias(message: Relayed) -> list[management.Management]:
    """Return a message, after the name of a module that travels as an alias."""
    names = [] if isinstance(message, management.Endpoint) else management.alias_messages(message.module)
    return [*names, message]
