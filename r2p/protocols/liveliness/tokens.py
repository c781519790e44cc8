"""Liveliness tokens of this module, and which topics flow between it and each other session because of them.

`TokenSet` decides which tokens to declare and undeclare, several in a key. Changes are collected, and become events all
at once: so a publisher that is announced first and gets the name of its node a moment later is one token, and a change
declares the new token before it undeclares the old one.

`Matching` compares these tokens with those of others. Both sides see each other's, so both know when two types don't
fit, and report it to their own user.
"""

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import cast

import msgspec

from r2p.codecs import liveliness, management
from r2p.codecs.liveliness import ModuleToken, SoftwareToken, TopicToken
from r2p.codecs.management import ANY_TYPE, NO_PARAMS, ROLE_PUBLISHES, ROLE_SUBSCRIBES
from r2p.protocols.discovery.announcer import LocalTopic
from r2p.protocols.discovery.demand import Demand
from r2p.protocols.discovery.directory import TopicInfo, counterpart, decrement
from r2p.protocols.discovery.events import (
    Declare,
    Mismatched,
    Outbox,
    PublisherFound,
    PublisherGone,
    SubscriberJoined,
    SubscriberLeft,
    SubscribersGone,
    TopicType,
    Undeclare,
)
from r2p.protocols.liveliness.packing import TokenPacker
from r2p.version import __version__

TopicRole = tuple[str, int]
"""A topic, and ROLE_PUBLISHES or ROLE_SUBSCRIBES."""

_Subject = tuple[str | int, ...]
"""What tokens are about: a TopicRole, the module itself, or the key of something relayed, behind `_RELAYED`."""

_MODULE: _Subject = ("module",)
_RELAYED = "relayed"


class TokenSet:
    """The tokens of one module."""

    def __init__(self, module: str, instance: int, *, observer: bool) -> None:
        self._flags = 0
        self._module = module
        self._instance = instance
        self._observer = observer
        self._topics: dict[TopicRole, LocalTopic] = {}
        self._nodes: dict[TopicRole, dict[str, int]] = {}
        self._relayed: dict[_Subject, liveliness.Token] = {}
        self._present: dict[_Subject, set[str]] = {}
        """The tokens that are declared, or about to be."""
        self._module_key = ""
        """The declared key of the module itself, and its version: it has no topics, and so hardly ever changes."""
        self._packer = TokenPacker()
        self._dirty: dict[_Subject, None] = {_MODULE: None}
        """Subjects that may need other tokens than are declared, in the order of their change."""

    @property
    def has_changes(self) -> bool:
        """Return whether something has changed since `pop_changes` was called."""
        return bool(self._dirty) or self._packer.has_changes

    def get(self, topic: str, role: int) -> LocalTopic | None:
        return self._topics.get((topic, role))

    def set_flags(self, flags: int) -> None:
        self._flags = flags
        self._dirty[_MODULE] = None

    def set_topic(self, topic: str, role: int, own: LocalTopic) -> None:
        """Declare that the module publishes or subscribes to a topic."""
        self._topics[topic, role] = own
        self._dirty[topic, role] = None

    def remove_topic(self, topic: str, role: int) -> None:
        """Undeclare the topic in this role."""
        self._topics.pop((topic, role), None)
        self._dirty[topic, role] = None

    def add_node(self, topic: str, role: int, node: str, publisher_class: int) -> None:
        """Add a node that publishes or subscribes to the topic; each has a token of its own."""
        self._nodes.setdefault((topic, role), {})[node] = publisher_class
        self._dirty[topic, role] = None

    def remove_node(self, topic: str, role: int, node: str) -> None:
        nodes = self._nodes.get((topic, role), {})
        nodes.pop(node, None)
        if not nodes:
            self._nodes.pop((topic, role), None)
        self._dirty[topic, role] = None

    def set_relayed(self, key: _Subject, token: liveliness.Token | None) -> None:
        """Declare a token of a module behind this gateway; None undeclares it."""
        if token is None:
            self._relayed.pop(key, None)
        else:
            self._relayed[key] = token
        self._dirty[(_RELAYED, *key)] = None

    def relayed(self, key: _Subject) -> liveliness.Token | None:
        return self._relayed.get(key)

    def pop_changes(self) -> list[Declare | Undeclare]:
        """Return the declarations and their ends since the last call."""
        dirty, self._dirty = self._dirty, {}
        events = self._module_changes() if dirty.pop(_MODULE, "") is None else []
        for subject in dirty:
            present, wanted = self._present.get(subject, set()), self._wanted(subject)
            for token in sorted(wanted - present):
                self._packer.add(token)
            for token in present - wanted:
                self._packer.remove(token)
            if wanted:
                self._present[subject] = wanted
            else:
                self._present.pop(subject, None)
        return events + self._packer.pop_changes()

    def withdraw_all(self) -> list[Declare | Undeclare]:
        """Undeclare everything, as the network is away; it is declared anew by the next `pop_changes`."""
        events = self._packer.withdraw_all()
        if self._module_key:
            events.append(Undeclare(self._module_key))
            self._module_key = ""
            self._dirty[_MODULE] = None
        return events

    def _module_changes(self) -> list[Declare | Undeclare]:
        before, self._module_key = self._module_key, liveliness.pack([*self._module_tokens()])
        if self._module_key == before:
            return []
        return [Declare(self._module_key), *([Undeclare(before)] if before else [])]

    def _module_tokens(self) -> Iterator[str]:
        yield liveliness.encode(ModuleToken(self._instance, self._module, self._instance, self._flags, self._observer))
        if not self._observer:  # a tool is gone before its version matters
            release = __version__[: management.RELEASE_MAX]
            yield liveliness.encode(SoftwareToken(self._instance, self._instance, management.WIRE_VERSION, release))

    def _wanted(self, subject: _Subject) -> set[str]:
        if subject[0] == _RELAYED:
            relayed = self._relayed.get(subject[1:])
            return set() if relayed is None else {liveliness.encode(relayed)}
        key = cast("TopicRole", subject)
        own = self._topics.get(key)
        if own is None:
            return set()
        nodes = self._nodes.get(key) or {"": 0}
        return {self._token(key, own, node, publisher_class) for node, publisher_class in nodes.items()}

    def _token(self, key: TopicRole, own: LocalTopic, node: str, publisher_class: int) -> str:
        topic, role = key
        known = own.type
        window = own.queue if role == ROLE_SUBSCRIBES else 0
        token = TopicToken(
            self._instance,
            role,
            topic,
            self._instance,
            node,
            publisher_class,
            known.size,
            known.fingerprint,
            window,
            varies=known.varies,
        )
        return liveliness.encode(token)


class _PeerSession(msgspec.Struct):
    """The topics of another module on the network: its tokens, those that flow, and the types that don't fit."""

    tokens: dict[TopicRole, dict[str, TopicToken]] = msgspec.field(default_factory=dict)
    matched: dict[TopicRole, int] = msgspec.field(default_factory=dict)
    mismatched: dict[TopicRole, TopicType] = msgspec.field(default_factory=dict)


class Matching:
    """The topics of one network."""

    def __init__(self, own: TokenSet, outbox: Outbox, most: int) -> None:
        """`most`: tokens of other modules that are kept, and so topics of each role."""
        self.topics: dict[str, TopicInfo] = {}
        self.demand = Demand(most)
        """Everything that other modules publish and subscribe to, used by this one or not; with their sessions."""
        self._own = own
        self._outbox = outbox
        self._sessions: dict[int, _PeerSession] = {}
        self._subscribers: Counter[str] = Counter()  # sessions that this module sends to, by topic
        self._mismatches: Counter[str] = Counter()  # sessions and roles whose type does not fit, by topic

    def appeared(self, now: int, key: str, token: TopicToken) -> None:
        """Enter a token of a publisher or subscriber."""
        number, topic_role = token.session, (token.topic, token.role)
        session = self._sessions.get(number)  # `setdefault` would make a new one in vain, for each of many tokens
        if session is None:
            session = self._sessions[number] = _PeerSession()
        tokens = session.tokens.get(topic_role)
        if tokens is None:
            session.tokens[topic_role] = {key: token}
            self.demand.add(token.topic, token.role, number, session)
        else:
            tokens[key] = token
        info = self.topics.get(token.topic)
        if info is None:
            info = self.topics[token.topic] = TopicInfo(token.topic)
        info.set_heard(token.role, now)
        known = info.type_of(token.role)
        if known is None:  # nobody has declared a type before
            own = _type_of({key: token})
            if own != TopicType():
                info.set_type(token.role, own)
        elif not (known.size or known.varies) or known.fingerprint == ANY_TYPE:
            self._update_type(info, token.role)
        if self._concerns(session, topic_role):
            self._match(number, session, topic_role)

    def _sessions_of(self, topic: str, role: int) -> Mapping[int, _PeerSession]:
        """Return the sessions that have a topic in this role, by number."""
        return self.demand.sources_of(topic, role)

    def _concerns(self, session: _PeerSession, key: TopicRole) -> bool:
        """Return whether this module has the other role of the topic, or has had it."""
        topic, role = key
        has_role = self._own.get(topic, counterpart(role)) is not None
        return has_role or key in session.matched or key in session.mismatched

    def disappeared(self, key: str, token: TopicToken) -> None:
        """Forget a token that is gone."""
        session = self._sessions[token.session]
        topic_role = token.topic, token.role
        tokens = session.tokens[topic_role]
        del tokens[key]
        if not tokens:
            del session.tokens[topic_role]
            self.demand.remove(*topic_role, token.session)
        self._match(token.session, session, topic_role)
        if not session.tokens:
            del self._sessions[token.session]
        self._update_type(self.topics[token.topic], token.role)
        if topic_role not in self.demand:
            self._remove_role(*topic_role)

    def changed(self, topic: str, role: int) -> None:
        """Match a topic again after this module begins or ends it in this role, or changes its type."""
        theirs = topic, counterpart(role)
        for number, session in list(self._sessions_of(*theirs).items()):
            self._clear_mismatch(session, theirs)
            self._match(number, session, theirs)

    def mark_heard(self, now: int) -> None:
        """Mark what has a token as heard now."""
        topics = self.topics
        for topic, role in self.demand:  # a thousand, or more, for each look at the network
            if role == ROLE_PUBLISHES:
                topics[topic].advertised_at = now
            else:
                topics[topic].requested_at = now

    def _match(self, number: int, session: _PeerSession, key: TopicRole) -> None:
        topic, role = key
        tokens = session.tokens.get(key)
        own = self._own.get(topic, counterpart(role))
        if not tokens or own is None:
            self._clear_mismatch(session, key)
            self._end(number, session, key)
        else:
            theirs = _type_of(tokens)
            if own.type.fits(theirs):
                self._clear_mismatch(session, key)
                self._start(number, session, key, _detail(tokens, role))
            else:
                self._end(number, session, key)
                if session.mismatched.get(key) != theirs:
                    self._mismatches[topic] += key not in session.mismatched
                    session.mismatched[key] = theirs
                    self._outbox.emit(Mismatched(topic, number, role, own.type, theirs))
        if topic in self.topics:
            self.topics[topic].mismatch = topic in self._mismatches

    def publisher_types(self, topic: str) -> set[TopicType]:
        """Return the types of a topic's publishers whose messages are accepted."""
        key = topic, ROLE_PUBLISHES
        sessions = self._sessions_of(*key).values()
        return {_type_of(session.tokens[key]) for session in sessions if key in session.matched}

    def _clear_mismatch(self, session: _PeerSession, key: TopicRole) -> None:
        """Forget that the session's type of the topic did not fit."""
        if session.mismatched.pop(key, None) is not None:
            decrement(self._mismatches, key[0])

    def _start(self, number: int, session: _PeerSession, key: TopicRole, detail: int) -> None:
        if session.matched.get(key) == detail:
            return
        topic, role = key
        if role == ROLE_SUBSCRIBES:
            self._subscribers[topic] += key not in session.matched
            self._outbox.emit(SubscriberJoined(topic, NO_PARAMS, detail, number))
        else:
            self._outbox.emit(PublisherFound(topic, number, NO_PARAMS, detail))
        session.matched[key] = detail

    def _end(self, number: int, session: _PeerSession, key: TopicRole) -> None:
        if session.matched.pop(key, None) is None:
            return
        topic, role = key
        if role == ROLE_PUBLISHES:
            self._outbox.emit(PublisherGone(topic, number))
            return
        self._outbox.emit(SubscriberLeft(topic, number, gone=key not in session.tokens))
        if decrement(self._subscribers, topic):
            self._outbox.emit(SubscribersGone(topic))

    def _update_type(self, info: TopicInfo, role: int) -> None:
        """Give a topic the type of the first session that declares one."""
        sessions = self._sessions_of(info.name, role).values()
        types = (_type_of(session.tokens[info.name, role]) for session in sessions)
        info.set_type(role, next((each for each in types if each != TopicType()), None))

    def _remove_role(self, topic: str, role: int) -> None:
        """Forget the role of a topic that has lost its last token; without the other role, the topic too."""
        if (topic, counterpart(role)) not in self.demand:
            del self.topics[topic]
        else:
            self.topics[topic].set_heard(role, None)


def _type_of(tokens: dict[str, TopicToken]) -> TopicType:
    """Return the type that a session declares; of several tokens, the first that has one counts."""
    if len(tokens) == 1:  # thousands, when a module joins
        (only,) = tokens.values()
        return TopicType(only.size, only.fingerprint, only.varies)
    size, varies = next(((each.size, each.varies) for each in tokens.values() if each.size or each.varies), (0, False))
    fingerprint = next((each.fingerprint for each in tokens.values() if each.fingerprint != ANY_TYPE), ANY_TYPE)
    return TopicType(size, fingerprint, varies)


def _detail(tokens: dict[str, TopicToken], role: int) -> int:
    """Return the size of a publisher's messages, or the window of a subscriber."""
    if role == ROLE_PUBLISHES:
        return _type_of(tokens).exact_size
    return max(each.window for each in tokens.values())
