"""Which topics flow between this module and each other session, worked out from the tokens of both.

Both sides see each other's tokens, so both know when two types don't fit, and tell their own user.
"""

from collections import Counter

import msgspec

from r2p.codecs.liveliness import TopicToken
from r2p.codecs.management import ANY_TYPE, NO_PARAMS, ROLE_PUBLISHES, ROLE_SUBSCRIBES
from r2p.protocols.discovery.demand import Demand
from r2p.protocols.discovery.directory import TopicInfo
from r2p.protocols.discovery.events import (
    Event,
    Mismatched,
    PublisherFound,
    PublisherGone,
    SubscriberJoined,
    SubscriberLeft,
    SubscribersGone,
    TopicType,
)
from r2p.protocols.liveliness.tokens import TokenSet, TopicRole, counterpart


class _PeerSession(msgspec.Struct):
    """The topics of another module on the network: its tokens, what of them flows, and the types that don't fit."""

    tokens: dict[TopicRole, dict[str, TopicToken]] = msgspec.field(default_factory=dict)
    matched: dict[TopicRole, int] = msgspec.field(default_factory=dict)
    mismatched: dict[TopicRole, TopicType] = msgspec.field(default_factory=dict)


class Matching:
    """The topics of one network."""

    def __init__(self, own: TokenSet, events: list[Event]) -> None:
        self.topics: dict[str, TopicInfo] = {}
        self.demand = Demand()
        """What other modules publish and subscribe, whether this one has anything to do with it or not."""
        self._own = own
        self._events = events
        self._sessions: dict[int, _PeerSession] = {}
        self._subscribers: Counter[str] = Counter()  # sessions that this module sends to, by topic
        self._token_counts: Counter[TopicRole] = Counter()
        self._sessions_of: dict[TopicRole, dict[int, _PeerSession]] = {}  # by number
        self._mismatches: Counter[str] = Counter()  # sessions and roles whose type does not fit, by topic

    def appeared(self, now: int, key: str, token: TopicToken) -> None:
        """A publisher or subscriber is there."""
        session = self._sessions.setdefault(token.session, _PeerSession())
        topic_role = token.topic, token.role
        session.tokens.setdefault(topic_role, {})[key] = token
        self._sessions_of.setdefault(topic_role, {})[token.session] = session
        self._token_counts[topic_role] += 1
        self.demand.add(*topic_role, token.session)
        self._update_topic(now, token)
        self._match(token.session, session, topic_role)

    def disappeared(self, key: str, token: TopicToken) -> None:
        """A publisher or subscriber is gone."""
        session = self._sessions[token.session]
        topic_role = token.topic, token.role
        tokens = session.tokens[topic_role]
        del tokens[key]
        if not tokens:
            del session.tokens[topic_role]
            del self._sessions_of[topic_role][token.session]
            self.demand.remove(*topic_role, token.session)
        self._match(token.session, session, topic_role)
        if not session.tokens:
            del self._sessions[token.session]
        self._update_type(self.topics[token.topic], token.role)
        self._token_counts[topic_role] -= 1
        if not self._token_counts[topic_role]:
            del self._token_counts[topic_role]
            del self._sessions_of[topic_role]
            self._remove_role(*topic_role)

    def changed(self, topic: str, role: int) -> None:
        """What this module does with the topic in this role has changed."""
        theirs = topic, counterpart(role)
        for number, session in list(self._sessions_of.get(theirs, {}).items()):
            self._clear_mismatch(session, theirs)
            self._match(number, session, theirs)

    def mark_heard(self, now: int) -> None:
        """Mark what has a token as heard now."""
        for topic, role in self._token_counts:
            self._set_heard(now, self.topics[topic], role)

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
                    self._events.append(Mismatched(topic, number, role, own.type, theirs))
        if topic in self.topics:
            self.topics[topic].mismatch = topic in self._mismatches

    def _clear_mismatch(self, session: _PeerSession, key: TopicRole) -> None:
        """Forget that the session's type of the topic did not fit."""
        if session.mismatched.pop(key, None) is not None:
            self._mismatches[key[0]] -= 1
            if not self._mismatches[key[0]]:
                del self._mismatches[key[0]]

    def _start(self, number: int, session: _PeerSession, key: TopicRole, detail: int) -> None:
        if session.matched.get(key) == detail:
            return
        topic, role = key
        if role == ROLE_SUBSCRIBES:
            self._subscribers[topic] += key not in session.matched
            self._events.append(SubscriberJoined(topic, NO_PARAMS, detail, number))
        else:
            self._events.append(PublisherFound(topic, number, NO_PARAMS, detail))
        session.matched[key] = detail

    def _end(self, number: int, session: _PeerSession, key: TopicRole) -> None:
        if session.matched.pop(key, None) is None:
            return
        topic, role = key
        if role == ROLE_PUBLISHES:
            self._events.append(PublisherGone(topic, number))
            return
        self._events.append(SubscriberLeft(topic, number, gone=key not in session.tokens))
        self._subscribers[topic] -= 1
        if not self._subscribers[topic]:
            del self._subscribers[topic]
            self._events.append(SubscribersGone(topic))

    def _update_topic(self, now: int, token: TopicToken) -> None:
        info = self.topics.setdefault(token.topic, TopicInfo(token.topic))
        self._set_heard(now, info, token.role)
        self._update_type(info, token.role)

    def _update_type(self, info: TopicInfo, role: int) -> None:
        """A topic has the type of the first session that declares one."""
        sessions = self._sessions_of.get((info.name, role), {}).values()
        types = (_type_of(session.tokens[info.name, role]) for session in sessions)
        info.set_type(role, next((each for each in types if each != TopicType()), None))

    def _set_heard(self, now: int, info: TopicInfo, role: int) -> None:
        if role == ROLE_PUBLISHES:
            info.advertised_at = now
        else:
            info.requested_at = now

    def _remove_role(self, topic: str, role: int) -> None:
        """No token has the topic in this role any more; if none has it in the other role, it is forgotten."""
        if (topic, counterpart(role)) not in self._token_counts:
            del self.topics[topic]
        elif role == ROLE_PUBLISHES:
            self.topics[topic].advertised_at = None
        else:
            self.topics[topic].requested_at = None


def _type_of(tokens: dict[str, TopicToken]) -> TopicType:
    """Return the type that a session declares; of several tokens, the first that has one counts."""
    size = next((each.size for each in tokens.values() if each.size), 0)
    fingerprint = next((each.fingerprint for each in tokens.values() if each.fingerprint != ANY_TYPE), ANY_TYPE)
    return TopicType(size, fingerprint)


def _detail(tokens: dict[str, TopicToken], role: int) -> int:
    """Return the size of a publisher's messages, or the window of a subscriber."""
    if role == ROLE_PUBLISHES:
        return _type_of(tokens).size
    return max(each.window for each in tokens.values())
