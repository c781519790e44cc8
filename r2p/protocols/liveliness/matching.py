"""Who may exchange what, among those who tell it by tokens: our side of each topic against that of every session.

Both sides see the other's tokens, so both know when two types don't fit, and tell their own user.
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
    """What one r2p module on the network has declared of topics, what of it flows, and what was refused."""

    tokens: dict[TopicRole, dict[str, TopicToken]] = msgspec.field(default_factory=dict)
    matched: dict[TopicRole, int] = msgspec.field(default_factory=dict)
    refused: dict[TopicRole, TopicType] = msgspec.field(default_factory=dict)


class Matching:
    """The topics of one network."""

    def __init__(self, own: TokenSet, events: list[Event]) -> None:
        self.topics: dict[str, TopicInfo] = {}
        self.demand = Demand()
        """What others offer and want, whether we have anything to do with it or not."""
        self._own = own
        self._events = events
        self._sessions: dict[int, _PeerSession] = {}
        self._takers: Counter[str] = Counter()
        self._told: Counter[TopicRole] = Counter()
        self._telling: dict[TopicRole, dict[int, _PeerSession]] = {}  # those that have tokens of it, by number
        self._refused: Counter[str] = Counter()  # sessions whose type does not fit, by topic

    def appeared(self, now: int, key: str, token: TopicToken) -> None:
        """A publisher or subscriber of some session is there."""
        session = self._sessions.setdefault(token.session, _PeerSession())
        topic_role = token.topic, token.role
        session.tokens.setdefault(topic_role, {})[key] = token
        self._telling.setdefault(topic_role, {})[token.session] = session
        self._told[topic_role] += 1
        self.demand.add(*topic_role, token.session)
        self._note(now, token)
        self._review(token.session, session, topic_role)

    def disappeared(self, key: str, token: TopicToken) -> None:
        """It is not there any more."""
        session = self._sessions[token.session]
        topic_role = token.topic, token.role
        tokens = session.tokens[topic_role]
        del tokens[key]
        if not tokens:
            del session.tokens[topic_role]
            del self._telling[topic_role][token.session]
            self.demand.remove(*topic_role, token.session)
        self._review(token.session, session, topic_role)
        if not session.tokens:
            del self._sessions[token.session]
        self._retype(self.topics[token.topic], token.role)
        self._told[topic_role] -= 1
        if not self._told[topic_role]:
            del self._told[topic_role]
            del self._telling[topic_role]
            self._forget_role(*topic_role)

    def changed(self, topic: str, role: int) -> None:
        """Our own side of the topic in this role has changed."""
        theirs = topic, counterpart(role)
        for number, session in list(self._telling.get(theirs, {}).items()):
            self._accept(session, theirs)
            self._review(number, session, theirs)

    def freshen(self, now: int) -> None:
        """What is there is as good as just heard."""
        for topic, role in self._told:
            self._mark(now, self.topics[topic], role)

    def _review(self, number: int, session: _PeerSession, key: TopicRole) -> None:
        topic, role = key
        tokens = session.tokens.get(key)
        own = self._own.own(topic, counterpart(role))
        if not tokens or own is None:
            self._accept(session, key)
            self._end(number, session, key)
        else:
            theirs = _shape(tokens)
            if own.shape.fits(theirs):
                self._accept(session, key)
                self._match(number, session, key, _detail(tokens, role))
            else:
                self._end(number, session, key)
                if session.refused.get(key) != theirs:
                    self._refused[topic] += key not in session.refused
                    session.refused[key] = theirs
                    self._events.append(Mismatched(topic, number, role, own.shape, theirs))
        if topic in self.topics:
            self.topics[topic].mismatch = topic in self._refused

    def _accept(self, session: _PeerSession, key: TopicRole) -> None:
        """The session's type of the topic is not refused any more."""
        if session.refused.pop(key, None) is not None:
            self._refused[key[0]] -= 1
            if not self._refused[key[0]]:
                del self._refused[key[0]]

    def _match(self, number: int, session: _PeerSession, key: TopicRole, detail: int) -> None:
        if session.matched.get(key) == detail:
            return
        topic, role = key
        if role == ROLE_SUBSCRIBES:
            self._takers[topic] += key not in session.matched
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
        self._takers[topic] -= 1
        if not self._takers[topic]:
            del self._takers[topic]
            self._events.append(SubscribersGone(topic))

    def _note(self, now: int, token: TopicToken) -> None:
        info = self.topics.setdefault(token.topic, TopicInfo(token.topic))
        self._mark(now, info, token.role)
        self._retype(info, token.role)

    def _retype(self, info: TopicInfo, role: int) -> None:
        """The type of a topic is that of the first session that tells one."""
        sessions = self._telling.get((info.name, role), {}).values()
        shapes = (_shape(session.tokens[info.name, role]) for session in sessions)
        info.set_type(role, next((shape for shape in shapes if shape != TopicType()), None))

    def _mark(self, now: int, info: TopicInfo, role: int) -> None:
        if role == ROLE_PUBLISHES:
            info.advertised_at = now
        else:
            info.requested_at = now

    def _forget_role(self, topic: str, role: int) -> None:
        """Nobody has the topic in this role any more; where nobody does in the other one it is forgotten."""
        if (topic, counterpart(role)) not in self._told:
            del self.topics[topic]
        elif role == ROLE_PUBLISHES:
            self.topics[topic].advertised_at = None
        else:
            self.topics[topic].requested_at = None


def _shape(tokens: dict[str, TopicToken]) -> TopicType:
    """The type that a session tells; the first one that does."""
    size = next((each.size for each in tokens.values() if each.size), 0)
    fingerprint = next((each.fingerprint for each in tokens.values() if each.fingerprint != ANY_TYPE), ANY_TYPE)
    return TopicType(size, fingerprint)


def _detail(tokens: dict[str, TopicToken], role: int) -> int:
    """What else matters: the size of a publisher's messages, the window of a subscriber."""
    if role == ROLE_PUBLISHES:
        return _shape(tokens).size
    return max(each.window for each in tokens.values())
