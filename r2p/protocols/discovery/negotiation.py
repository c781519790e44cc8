"""Who may exchange what: both sides of ADVERTISE, SUBSCRIBE_REQUEST and SUBSCRIBE_RESPONSE (PROTOCOL.md 4).

Firmware is answered every time. Between r2p modules what only repeats itself brings no more than a response, for both
sides repeat; and where many of them ask at once they share an answer (`SharedAnswers`). Only a change becomes an event.
A type that does not fit is refused by both sides, because each sends its own with every repetition and as the answer
to what it refuses. A TYPE is never answered, so two that disagree don't argue.
"""

from collections import Counter
from typing import Any

from r2p.codecs import management
from r2p.codecs.management import ANSWERED, ROLE_PUBLISHES, ROLE_SUBSCRIBES, UNANSWERED
from r2p.protocols.discovery.announcer import Announcer, LocalTopic
from r2p.protocols.discovery.directory import LEASE, Directory
from r2p.protocols.discovery.events import (
    Mismatched,
    ModuleInfo,
    Outbox,
    PeerAddress,
    PublisherFound,
    PublisherGone,
    SubscriberJoined,
    SubscribersGone,
    TopicType,
)
from r2p.protocols.discovery.peers import Peer, Peers
from r2p.protocols.discovery.schedule import SharedAnswers
from r2p.protocols.timers import KeyedTimers

_SENT_BY_R2P = (UNANSWERED, ANSWERED)

GRACE = 50_000_000
"""Ns after a SUBSCRIBE_RESPONSE, or a reconnect, in which firmware drops data: the thread that takes the response has
its lowest priority."""


class SubscriptionNegotiation:
    """What flows on one link, by peer and topic."""

    def __init__(
        self, own: Announcer, outbox: Outbox, directory: Directory, timers: KeyedTimers, counts: Counter[str]
    ) -> None:
        self._own = own
        self._outbox = outbox
        self._directory = directory
        self._timers = timers
        self._counts = counts
        self._peers = Peers(counts)
        self._answers: SharedAnswers[Any] = SharedAnswers(timers)
        self._attached: set[str] = set()
        """The topics of which the link has been told that they have subscribers."""

    # What peers say

    def advertised(self, now: int, message: management.Advertise, source: PeerAddress) -> None:
        """A publisher: ask for its data if somebody here wants it."""
        topic = message.topic
        self._directory.typed(now, topic, ROLE_PUBLISHES, TopicType(message.size)).advertised_at = now
        own = self._own.subscribers.get(topic)
        peer = self._peers.get_or_create(source) if own is not None else None
        if own is None or peer is None:
            return
        if peer.is_r2p(now) and (
            _receives(peer, message)
            or self._answers.waits(now, (ROLE_PUBLISHES, topic), source, message, self._directory.r2p_modules)
        ):
            return
        self._request(now, topic, own, [(peer, message)])

    def requested(self, now: int, message: management.SubscribeRequest, source: PeerAddress) -> None:
        """A subscriber: answer, and attach it if it is new. The size that it tells is not looked at."""
        topic = message.topic
        self._directory.typed(now, topic, ROLE_SUBSCRIBES, TopicType(message.size)).requested_at = now
        own = self._own.publishers.get(topic)
        peer = self._peers.get_or_create(source) if own is not None else None
        if own is None or peer is None:
            return
        r2p = peer.is_r2p(now) or message.params in _SENT_BY_R2P
        modules = self._directory.r2p_modules
        if not (r2p and self._answers.waits(now, (ROLE_SUBSCRIBES, topic), source, message, modules)):
            self._respond(now, topic, own, [(peer, message)])

    def responded(self, now: int, message: management.SubscribeResponse, source: PeerAddress) -> None:
        """A publisher that will send: let its data in."""
        topic = message.topic
        peer = self._peers.get_or_create(source) if topic in self._own.subscribers else None
        if peer is None or not self._fits(peer, topic, ROLE_PUBLISHES, _theirs(peer, message)):
            return
        self._directory.typed(now, topic, ROLE_PUBLISHES, TopicType(message.size))
        if peer.opened.get(topic) != (message.params, message.size):
            peer.opened[topic] = (message.params, message.size)
            self._own.answered.add(topic)
            self._outbox.emit(PublisherFound(topic, source, message.params, message.size))

    def typed(self, now: int, message: management.TypeInfo, source: PeerAddress) -> None:
        """A peer's type of a topic: compare it if the topic is ours too."""
        self._directory.typed(now, message.topic, message.role, TopicType(message.size, message.fingerprint))
        own = self._counterpart(message.role).get(message.topic)
        peer = self._peers.get_or_create(source) if own is not None else None
        if peer is not None:
            theirs = peer.types[message.topic, message.role] = TopicType(message.size, message.fingerprint)
            self._fits(peer, message.topic, message.role, theirs)

    def unsubscribed(self, now: int, message: management.Unsubscribe, source: PeerAddress) -> None:
        """A subscriber is gone; where several modules share an address, only the lease tells who is left."""
        peer = self._peers.get(source)
        if peer is not None and peer.direct == {self._directory.name_of(message.instance)}:
            self._end(peer, message.topic)
        else:
            self._counts["unsubscribe left to the lease"] += 1

    # Answers

    def answer(self, now: int, role: int, topic: str) -> None:
        """Answer all r2p modules that have said since the last answer that they publish or subscribe the topic."""
        asked = self._answers.take(now, (role, topic), self._directory.r2p_modules)
        known = [(peer, message) for source, message in asked if (peer := self._peers.get(source)) is not None]
        own = self._counterpart(role).get(topic)
        if own is None or not known:
            return
        if role == ROLE_PUBLISHES:
            self._request(now, topic, own, known)
        else:
            self._respond(now, topic, own, known)

    def _request(self, now: int, topic: str, own: LocalTopic, offers: list[tuple[Peer, management.Advertise]]) -> None:
        """Ask publishers for their data; those whose data come in by now, at our next request."""
        r2p = [peer.is_r2p(now) for peer, _ in offers]
        offers = [each for each, is_r2p in zip(offers, r2p, strict=True) if not (is_r2p and _receives(*each))]
        if any(r2p) and offers:
            self._outbox.say(own.type(topic, ROLE_SUBSCRIBES))
        sizes = [offer.size for peer, offer in offers if self._fits(peer, topic, ROLE_PUBLISHES, _theirs(peer, offer))]
        if sizes:
            self._outbox.say(*self._own.requests(topic, own, sizes[-1]))

    def _respond(
        self, now: int, topic: str, own: LocalTopic, requests: list[tuple[Peer, management.SubscribeRequest]]
    ) -> None:
        """Answer subscribers, and attach those that are new."""
        if any(_needs_type(now, peer, request) for peer, request in requests):
            self._outbox.say(own.type(topic, ROLE_PUBLISHES))
        requests = [each for each in requests if self._may_subscribe(each[0], topic)]
        if not requests:
            return
        queue = max(requests[-1][1].queue, 1)
        self._outbox.say(management.SubscribeResponse(topic, own.shape.size, queue, own.params))
        for peer, request in requests:
            unanswered = peer.is_r2p(now) and request.params == UNANSWERED
            if self._peers.join(now, peer, topic, unanswered=unanswered):
                self._own.wanted.add(topic)
                self._join(now, peer, SubscriberJoined(topic, request.params, request.queue, peer.source))
            self._renew(now, peer, topic)

    def _may_subscribe(self, peer: Peer, topic: str) -> bool:
        theirs = peer.types.get((topic, ROLE_SUBSCRIBES))
        return theirs is None or self._fits(peer, topic, ROLE_SUBSCRIBES, theirs)

    # What changed on our side

    def retyped(self, topic: str, role: int) -> None:
        """Our own type is new: compare it with those of the peers in this role."""
        for peer in self._peers.all():
            peer.refused.pop((topic, role), None)
            theirs = peer.types.get((topic, role))
            if theirs is not None:
                self._fits(peer, topic, role, theirs)

    def withdrawn(self, topic: str) -> None:
        """Our last publisher is gone."""
        self._answers.forget((ROLE_SUBSCRIBES, topic))
        for peer in self._peers.all():
            self._end(peer, topic)
            peer.forget_type(topic, ROLE_SUBSCRIBES)

    def unwanted(self, topic: str) -> None:
        """Our last subscriber is gone."""
        self._answers.forget((ROLE_PUBLISHES, topic))
        for peer in self._peers.all():
            self._shut(peer, topic)
            peer.forget_type(topic, ROLE_PUBLISHES)

    # Who is there

    def met(self, now: int, info: ModuleInfo, *, is_new: bool) -> None:
        """An r2p module is the very other end: from now on its address has leases."""
        peer = self._peers.get_or_create(info.source)
        if peer is None:
            return
        if not peer.is_r2p(now):  # nor was it firmware that asked before the link was down
            for topic in [topic for topic, stale in peer.requests.items() if stale]:
                self._end(peer, topic)
        if is_new and peer.r2p_until:  # the first HELLO of all may just be later than its module's requests
            peer.mark_stale()
        peer.meet(now, info)
        for topic in list(peer.permanent):
            self._renew(now, peer, topic)

    def restarted(self, source: PeerAddress) -> None:
        """A module there lost what it knew: its next requests are as good as new."""
        peer = self._peers.get(source)
        if peer is not None:
            peer.mark_stale()

    def moved_away(self, now: int, info: ModuleInfo) -> None:
        """A module is not at this address any more; with the last r2p module goes all that was asked and offered."""
        peer = self._peers.get(info.source)
        if peer is not None and info.name in peer.direct:
            peer.direct.discard(info.name)
            if not peer.direct:
                self._depart(now, peer)

    def left(self, now: int, source: PeerAddress) -> None:
        """The good-bye of a module whose other HELLOs were all lost."""
        peer = self._peers.get(source)
        if peer is not None and not peer.direct:
            self._depart(now, peer)

    def interrupted(self) -> None:
        """The link is down. Firmware does not notice a reconnect: its subscriptions stay, leases end."""
        self._answers.clear()
        for peer in self._peers.all():
            peer.r2p_until = 0
            for topic in [topic for topic in peer.requests if topic not in peer.permanent]:
                self._end(peer, topic)
            peer.mark_stale()
            self._peers.prune(peer)

    def lease_over(self, source: PeerAddress, topic: str) -> None:
        peer = self._peers.get(source)
        if peer is not None:
            self._end(peer, topic)

    def grace_over(self, source: PeerAddress, topic: str) -> None:
        """Firmware has taken our response by now: it may get data.

        On a line we advertise once more: it may be the one of a gateway of firmware, which passes data on only after a
        second round of request and response.
        """
        peer = self._peers.get(source)
        joined = peer.waiting.pop(topic, None) if peer is not None else None
        if joined is not None:
            self._attach(joined)
            if source is None:
                self._own.advertise_again(topic)

    def memory_over(self, source: PeerAddress) -> None:
        """What a peer sent before it left can't arrive any more."""
        peer = self._peers.get(source)
        if peer is not None:
            self._peers.prune(peer)

    def _depart(self, now: int, peer: Peer) -> None:
        self._answers.drop(peer.source)
        for topic in list(peer.requests):
            self._end(peer, topic)
        for topic in list(peer.opened):
            self._shut(peer, topic)
        peer.types.clear()
        peer.refused.clear()
        peer.r2p_until = now + LEASE
        self._timers.set(("peer", peer.source), peer.r2p_until)

    def _counterpart(self, role: int) -> dict[str, LocalTopic]:
        """Our side of what a peer in this role tells."""
        return {ROLE_PUBLISHES: self._own.subscribers, ROLE_SUBSCRIBES: self._own.publishers}.get(role, {})

    def _fits(self, peer: Peer, topic: str, role: int, theirs: TopicType) -> bool:
        """Whether a peer's type fits ours; if not, it is told once and nothing flows."""
        ours = self._counterpart(role)[topic].shape
        fits = ours.fits(theirs)
        self._directory.topic(topic).mismatch = not fits
        if fits:
            peer.refused.pop((topic, role), None)
            return True
        if peer.refused.get((topic, role)) != theirs:
            peer.refused[topic, role] = theirs
            self._outbox.emit(Mismatched(topic, peer.source, role, ours, theirs))
        if role == ROLE_SUBSCRIBES:
            self._end(peer, topic)
        else:
            self._shut(peer, topic)
        return False

    def _join(self, now: int, peer: Peer, joined: SubscriberJoined) -> None:
        """A subscriber is new. Firmware is given time to take the response before the data."""
        if peer.is_r2p(now) or joined.params in _SENT_BY_R2P:
            self._attach(joined)
        else:
            peer.waiting[joined.topic] = joined
            self._timers.set(("grace", peer.source, joined.topic), now + GRACE)

    def _attach(self, joined: SubscriberJoined) -> None:
        self._attached.add(joined.topic)
        self._outbox.emit(joined)

    def _renew(self, now: int, peer: Peer, topic: str) -> None:
        """A subscription was made or repeated: a lease with r2p peers, for ever with firmware."""
        key = ("lease", peer.source, topic)
        if not peer.is_r2p(now):
            peer.permanent.add(topic)
            self._timers.clear(key)
            return
        peer.permanent.discard(topic)
        if peer.lease is not None:
            self._timers.set(key, now + peer.lease)

    def _end(self, peer: Peer, topic: str) -> None:
        self._answers.drop(peer.source, (ROLE_SUBSCRIBES, topic))
        self._timers.clear(("lease", peer.source, topic))
        if peer.waiting.pop(topic, None) is not None:
            self._timers.clear(("grace", peer.source, topic))
        if self._peers.end(peer, topic):
            self._own.wanted.discard(topic)
            if topic in self._attached:
                self._attached.remove(topic)
                self._outbox.emit(SubscribersGone(topic))

    def _shut(self, peer: Peer, topic: str) -> None:
        if peer.opened.pop(topic, None) is not None:
            if not any(topic in each.opened for each in self._peers.all()):
                self._own.answered.discard(topic)
            self._outbox.emit(PublisherGone(topic, peer.source))


def _receives(peer: Peer, message: management.Advertise) -> bool:
    """Whether what this publisher offers comes in already, and it knows of subscribers."""
    return peer.opened.get(message.topic) == (message.params, message.size)


def _needs_type(now: int, peer: Peer, message: management.SubscribeRequest) -> bool:
    """Whether an r2p subscriber may not know our type: repeats of its requests only keep its lease."""
    if not peer.is_r2p(now):
        return False
    return message.params == UNANSWERED or peer.requests.get(message.topic) is not False


def _theirs(peer: Peer, message: management.Advertise | management.SubscribeResponse) -> TopicType:
    """What a publisher's message says of its type, with the TYPE before it if that speaks of the same size."""
    typed = peer.types.get((message.topic, ROLE_PUBLISHES))
    return typed if typed is not None and typed.size == message.size else TopicType(message.size)
