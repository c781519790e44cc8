"""Agree on what flows on one link: both sides of ADVERTISE, SUBSCRIBE_REQUEST and SUBSCRIBE_RESPONSE (PROTOCOL.md 4).

Firmware is answered every time. Between r2p modules a repetition brings no more than a response, as both sides repeat;
and where many of them ask at once, they share an answer (`SharedAnswers`). Only a change becomes an event.

Both sides refuse a type that does not fit, because each sends its own with every repetition and as its refusal. A TYPE
is never answered, so two modules that disagree don't argue for ever.

A subscription of firmware lasts for ever. That of an r2p peer (its HELLO came without a gateway in between) is a lease.
After a good-bye a peer counts as r2p until its lease would be over, because earlier messages may still arrive.
"""

from typing import TYPE_CHECKING, Generic, TypeVar

import msgspec

from r2p.codecs import management
from r2p.codecs.management import ANSWERED, ROLE_PUBLISHES, ROLE_SUBSCRIBES, UNANSWERED
from r2p.protocols.discovery.announcer import Announcer, LocalTopic
from r2p.protocols.discovery.directory import LEASE, Directory, counterpart, decrement, topic_lease
from r2p.protocols.discovery.events import (
    Mismatched,
    ModuleInfo,
    PeerAddress,
    PublisherFound,
    PublisherGone,
    SubscriberJoined,
    SubscribersGone,
    TopicType,
)
from r2p.units import MILLISECOND, NEVER, SECOND

if TYPE_CHECKING:
    from r2p.protocols.discovery.demand import LeasedDemand

M = TypeVar("M", management.Advertise, management.SubscribeRequest)

_SENT_BY_R2P = (UNANSWERED, ANSWERED)

GRACE = 50 * MILLISECOND
"""Ns after a SUBSCRIBE_RESPONSE, or a reconnect, in which firmware drops messages of the topic: the thread that handles
the response has its lowest priority."""
_SHARED_GAP = 20 * MILLISECOND
"""Ns between two answers about one topic, for each module on the link."""
_AT_ONCE = 3
"""Answers about one topic that need not wait."""
_RESPONSE_LOST = SECOND
"""Ns after which a response has arrived or was lost: less than a round of repetition."""
PEERS_MAX = 4096
"""Peers on one link."""


class Peer(msgspec.Struct, eq=False, gc=False):
    """One address on the link.

    `direct` are the r2p modules there, by name; a line with more than two ends has several at one address. `lease` is
    in ns, None: as long as the module lives. `publishers` are the topics whose messages are accepted from this address,
    with params and size.

    `subscriptions` are the topics that the peer subscribes to, and whether it may have restarted since: then its next
    request counts as new. `permanent` are those without a lease, `joined_at` (ns) is when `SubscriberJoined` was
    emitted last, and `waiting` are those that get no messages yet. The keys of `types` and `mismatched` are topic and
    role.
    """

    source: PeerAddress
    direct: dict[str, None] = msgspec.field(default_factory=dict)
    r2p_until: int = 0
    lease: int | None = None
    subscriptions: dict[str, bool] = msgspec.field(default_factory=dict)
    joined_at: dict[str, int] = msgspec.field(default_factory=dict)
    permanent: dict[str, None] = msgspec.field(default_factory=dict)
    waiting: dict[str, SubscriberJoined] = msgspec.field(default_factory=dict)
    publishers: dict[str, tuple[bytes, int]] = msgspec.field(default_factory=dict)
    types: dict[tuple[str, int], TopicType] = msgspec.field(default_factory=dict)
    mismatched: dict[tuple[str, int], TopicType] = msgspec.field(default_factory=dict)

    def is_r2p(self, now: int) -> bool:
        return bool(self.direct) or now < self.r2p_until

    def add_module(self, now: int, info: ModuleInfo) -> None:
        """Enter an r2p module that said HELLO from this address."""
        after = topic_lease(info)
        lease = after if after < NEVER else None
        shared = len(self.direct) > (info.name in self.direct)
        if shared and lease is not None:  # the longest lease counts, and that only ends with them all
            lease = max(lease, self.lease) if self.lease is not None else None
        self.lease = lease
        self.direct[info.name] = None
        self.r2p_until = max(self.r2p_until, now + info.lease)

    def mark_restarted(self) -> None:
        self.subscriptions = dict.fromkeys(self.subscriptions, True)

    def forget_type(self, topic: str, role: int) -> None:
        self.types.pop((topic, role), None)
        self.mismatched.pop((topic, role), None)


class SubscriptionNegotiation:
    """The subscriptions of one link, by peer and topic."""

    def __init__(self, own: Announcer, directory: Directory) -> None:
        self._own = own
        self._directory = directory
        self._timers = directory.timers
        self._outbox = own.outbox
        self._counts = directory.counts
        self._peers: dict[PeerAddress, Peer] = {}
        self._offers = SharedAnswers[management.Advertise](directory, ROLE_PUBLISHES)
        self._requests = SharedAnswers[management.SubscribeRequest](directory, ROLE_SUBSCRIBES)
        self._attached: set[str] = set()
        """Topics with a `SubscriberJoined`, and no `SubscribersGone` since."""
        self.demand: LeasedDemand | None = None
        """What gateways track, whose leases begin and end with those here."""

    # Messages

    def advertised(self, now: int, message: management.Advertise, source: PeerAddress) -> None:
        """Handle ADVERTISE of a publisher: request its messages if this module subscribes to the topic."""
        topic = message.topic
        self._directory.add_size(now, topic, ROLE_PUBLISHES, message.size).advertised_at = now
        own = self._own.topics[ROLE_SUBSCRIBES].get(topic)
        peer = self._get_or_create(source) if own is not None else None
        if own is None or peer is None:
            return
        # Firmware is asked at once and every time: it may have restarted without notice.
        if peer.is_r2p(now) and (_receives(peer, message) or self._defer(now, self._offers, message, source)):
            return
        self._send_request(now, topic, own, [(peer, message)])

    def requested(self, now: int, message: management.SubscribeRequest, source: PeerAddress) -> None:
        """Handle SUBSCRIBE_REQUEST of a subscriber: respond, and attach it if it is new. Its size is ignored."""
        topic = message.topic
        self._directory.add_size(now, topic, ROLE_SUBSCRIBES, message.size).requested_at = now
        own = self._own.topics[ROLE_PUBLISHES].get(topic)
        peer = self._get_or_create(source) if own is not None else None
        if own is None or peer is None:
            return
        r2p = peer.is_r2p(now) or message.params in _SENT_BY_R2P  # its HELLO may be later than its request
        if not (r2p and self._defer(now, self._requests, message, source)):
            self._send_response(now, topic, own, [(peer, message)])

    def responded(self, now: int, message: management.SubscribeResponse, source: PeerAddress) -> None:
        """Handle SUBSCRIBE_RESPONSE of a publisher that will send: accept its messages."""
        topic = message.topic
        peer = self._get_or_create(source) if topic in self._own.topics[ROLE_SUBSCRIBES] else None
        if peer is None or not self._fits(peer, topic, ROLE_PUBLISHES, _implied_type(peer, message)):
            return
        self._directory.add_size(now, topic, ROLE_PUBLISHES, message.size)
        # Every response to a repeated request arrives here; only new params, as after a restart, are an event.
        if peer.publishers.get(topic) != (message.params, message.size):
            self._own.publisher_counts[topic] += topic not in peer.publishers
            peer.publishers[topic] = (message.params, message.size)
            theirs = TopicType.announced(message.size)
            bound = theirs.size if theirs.varies else 0
            self._outbox.emit(PublisherFound(topic, source, message.params, theirs.exact_size, theirs.varies, bound))

    def typed(self, now: int, message: management.TypeInfo, source: PeerAddress) -> None:
        """Handle TYPE: compare a peer's type of a topic with this module's, if it has the topic."""
        theirs = TopicType.announced(message.size, message.fingerprint)
        self._directory.add_type(now, message.topic, message.role, theirs)
        own = self._counterpart(message.role).get(message.topic)
        peer = self._get_or_create(source) if own is not None else None
        if peer is not None:
            peer.types[message.topic, message.role] = theirs
            self._fits(peer, message.topic, message.role, theirs)

    def unsubscribed(self, now: int, message: management.Unsubscribe, source: PeerAddress) -> None:
        """Handle UNSUBSCRIBE: end a subscription. If several modules share an address, only the lease can end it, as
        the others may still subscribe.
        """
        peer = self._peers.get(source)
        if peer is not None and peer.direct.keys() == {self._directory.name_of(message.instance)}:
            self._remove_subscriber(peer, message.topic)
        else:
            self._counts["unsubscribe left to the lease"] += 1

    def publisher_types(self, topic: str) -> dict[PeerAddress, TopicType]:
        """Return the types of the publishers of a topic whose messages are accepted, by address."""
        peers = (peer for peer in self._peers.values() if topic in peer.publishers)
        return {peer.source: peer.types.get((topic, ROLE_PUBLISHES), TopicType()) for peer in peers}

    # Answers

    def _defer(self, now: int, answers: "SharedAnswers[M]", message: M, source: PeerAddress) -> bool:
        """Decide whether to answer an r2p module later, together with others: not where each is answered alone."""
        return not self._directory.has_addresses and answers.defer(now, message.topic, source, message)

    def answer(self, now: int, role: int, topic: str) -> None:
        """Answer all r2p modules that have said since the last answer that they publish or subscribe to the topic."""
        own = self._counterpart(role).get(topic)
        if role == ROLE_PUBLISHES:
            offers = self._with_peers(self._offers.pop(now, topic))
            if own is not None and offers:
                self._send_request(now, topic, own, offers)
        else:
            requests = self._with_peers(self._requests.pop(now, topic))
            if own is not None and requests:
                self._send_response(now, topic, own, requests)

    def _answer_alone(self, asked: list[tuple[Peer, M]], answer: list[management.Management]) -> bool:
        """Answer the one that has asked, where that is possible and arrives; else return False."""
        if not self._directory.has_addresses or len(asked) != 1:
            return False
        self._outbox.answer(asked[0][0].source, self._outbox.encode(answer))
        return True

    def _with_peers(self, asked: list[tuple[PeerAddress, M]]) -> list[tuple[Peer, M]]:
        return [(peer, message) for source, message in asked if (peer := self._peers.get(source)) is not None]

    def _send_request(
        self, now: int, topic: str, own: LocalTopic, offers: list[tuple[Peer, management.Advertise]]
    ) -> None:
        """Request the messages of publishers, but for those of r2p that have responded meanwhile."""
        r2p = [peer.is_r2p(now) for peer, _ in offers]
        offers = [each for each, is_r2p in zip(offers, r2p, strict=True) if not (is_r2p and _receives(*each))]
        answer: list[management.Management] = []
        if any(r2p) and offers:  # before the request: publishers compare it with theirs when they respond
            answer.append(own.type_info(topic, ROLE_SUBSCRIBES))
        sizes = [
            offer.size for peer, offer in offers if self._fits(peer, topic, ROLE_PUBLISHES, _implied_type(peer, offer))
        ]
        if sizes:
            answer += self._own.requests(topic, own, sizes[-1])
        if not self._answer_alone(offers, answer):
            self._outbox.send(*answer)
            if sizes:
                self._own.await_response(topic)

    def _send_response(
        self, now: int, topic: str, own: LocalTopic, requests: list[tuple[Peer, management.SubscribeRequest]]
    ) -> None:
        """Respond to subscribers, and attach those that are new."""
        asked, answer = requests, list[management.Management]()
        if any(_needs_type(now, peer, request) for peer, request in requests):
            answer.append(own.type_info(topic, ROLE_PUBLISHES))
        requests = [each for each in requests if self._may_subscribe(*each, own.type)]
        if requests:
            queue = max(requests[-1][1].queue, 1)  # a request with 0, at which firmware halts, is answered with 1
            answer.append(management.SubscribeResponse(topic, own.type.size_field, queue, own.params))
        if not self._answer_alone(asked, answer):
            self._outbox.send(*answer)
        for peer, request in requests:
            unanswered = peer.is_r2p(now) and request.params == UNANSWERED
            if self._add_subscriber(now, peer, topic, unanswered=unanswered):
                self._announce_subscriber(
                    now, peer, SubscriberJoined(topic, request.params, request.queue, peer.source)
                )
            self._renew(now, peer, topic)

    def _may_subscribe(self, peer: Peer, request: management.SubscribeRequest, own: TopicType) -> bool:
        """Compare types where the subscriber has announced its own; a size alone says nothing, except that the length
        varies or does not: firmware can't receive such messages.
        """
        topic = request.topic
        theirs = peer.types.get((topic, ROLE_SUBSCRIBES))
        if theirs is None and own.varies:
            theirs = TopicType.announced(request.size)
        return theirs is None or self._fits(peer, topic, ROLE_SUBSCRIBES, theirs)

    # Changes of this module

    def type_changed(self, topic: str, role: int) -> None:
        """Compare this module's new type of a topic with those of the peers in this role."""
        for peer in list(self._peers.values()):
            peer.mismatched.pop((topic, role), None)  # so a mismatch with the new type is reported, too
            theirs = peer.types.get((topic, role))
            if theirs is not None:
                self._fits(peer, topic, role, theirs)

    def topic_removed(self, topic: str, role: int) -> None:
        """End the flow of a topic that this module no longer publishes or subscribes to."""
        theirs = counterpart(role)
        (self._requests if theirs == ROLE_SUBSCRIBES else self._offers).forget(topic)
        for peer in list(self._peers.values()):
            self._end(peer, topic, theirs)
            peer.forget_type(topic, theirs)

    # Changes of the peers

    def module_found(self, now: int, info: ModuleInfo, *, is_new: bool) -> None:
        """Note an r2p module directly at an address: from now on, subscriptions from there are leases."""
        peer = self._get_or_create(info.source)
        if peer is None:
            return
        if peer.subscriptions and not peer.is_r2p(now):
            # Nor was it firmware that had subscribed before the link was down.
            for topic in [topic for topic, restarted in peer.subscriptions.items() if restarted]:
                self._remove_subscriber(peer, topic)
        if is_new and peer.r2p_until:  # the first HELLO of all may just be later than its module's requests
            peer.mark_restarted()
            self._end_unless_repeated(now, peer)
        peer.add_module(now, info)
        for topic in list(peer.permanent):
            self._renew(now, peer, topic)

    def _end_unless_repeated(self, now: int, peer: Peer) -> None:
        """End the subscriptions of a module that has restarted, unless it still wants them."""
        for topic in peer.subscriptions:
            if topic not in peer.permanent and peer.lease is not None:
                self._timers.set(("lease", peer.source, topic), now + LEASE)

    def restarted(self, source: PeerAddress) -> None:
        """Note that a module at an address has restarted without its subscriptions: its next requests count as new."""
        peer = self._peers.get(source)
        if peer is not None:
            peer.mark_restarted()

    def set_lossless(self, now: int, *, lossless: bool, has_addresses: bool) -> None:
        """Note the same as `Directory.set_lossless`; subscriptions get leases once something may be lost."""
        had_addresses = self._directory.has_addresses
        self._directory.set_lossless(now, lossless=lossless, has_addresses=has_addresses)
        if had_addresses and not has_addresses:
            self._start_leases(now)

    def _start_leases(self, now: int) -> None:
        for peer in self._peers.values():
            if peer.is_r2p(now):
                for topic in peer.subscriptions:
                    self._renew(now, peer, topic)
        if self.demand is not None:
            self.demand.start_leases(now)

    def module_gone(self, now: int, info: ModuleInfo) -> None:
        """Note that a module left its address. With the last r2p module there, all subscriptions and publishers end."""
        peer = self._peers.get(info.source)
        if peer is not None and info.name in peer.direct:
            del peer.direct[info.name]
            if not peer.direct:
                self._forget_peer(now, peer)

    def unknown_left(self, now: int, source: PeerAddress) -> None:
        """Handle the good-bye of a module whose other HELLOs were all lost."""
        peer = self._peers.get(source)
        if peer is not None and not peer.direct:
            self._forget_peer(now, peer)

    def link_down(self) -> None:
        """End all leases. Firmware does not notice that the link is down, so its subscriptions stay."""
        self._offers.clear()
        self._requests.clear()
        for peer in list(self._peers.values()):
            peer.r2p_until = 0  # another module may answer after the reconnect
            for topic in [topic for topic in peer.subscriptions if topic not in peer.permanent]:
                self._remove_subscriber(peer, topic)
            peer.mark_restarted()
            self._prune(peer)

    def lease_over(self, source: PeerAddress, topic: str) -> None:
        peer = self._peers.get(source)
        if peer is not None:
            self._remove_subscriber(peer, topic)

    def grace_over(self, source: PeerAddress, topic: str) -> None:
        """Attach firmware, which has handled the response by now.

        On a line advertise once more: the other end may be a gateway of firmware, which passes messages on only after a
        second round of request and response.
        """
        peer = self._peers.get(source)
        joined = peer.waiting.pop(topic, None) if peer is not None else None
        if joined is not None:  # else it left meanwhile
            self._attach(joined)
            if source is None:
                self._own.advertise_again(topic)

    def linger_over(self, source: PeerAddress) -> None:
        """Forget a peer: its last messages have arrived by now."""
        peer = self._peers.get(source)
        if peer is not None:
            self._prune(peer)

    def _forget_peer(self, now: int, peer: Peer) -> None:
        if self.demand is not None:
            self.demand.module_gone(peer.source)
        self._offers.remove(peer.source)
        self._requests.remove(peer.source)
        for topic in list(peer.subscriptions):
            self._remove_subscriber(peer, topic)
        for topic in list(peer.publishers):
            self._remove_publisher(peer, topic)
        peer.types.clear()
        peer.mismatched.clear()
        peer.r2p_until = now + LEASE
        self._timers.set(("peer", peer.source), peer.r2p_until)

    def _get_or_create(self, source: PeerAddress) -> Peer | None:
        """Return the peer at this address; None, and counted, if there are too many."""
        peer = self._peers.get(source)
        if peer is None:
            if len(self._peers) >= PEERS_MAX:
                self._counts["too many peers"] += 1
                return None
            peer = self._peers[source] = Peer(source)
        return peer

    def _prune(self, peer: Peer) -> None:
        """Forget a peer that has no module, no subscription and no publisher."""
        if not (peer.direct or peer.subscriptions or peer.publishers):
            self._peers.pop(peer.source, None)

    def _counterpart(self, role: int) -> dict[str, LocalTopic]:
        """Return this module's topics in the opposite role of a peer."""
        return self._own.topics[counterpart(role)] if role in self._own.topics else {}

    def _fits(self, peer: Peer, topic: str, role: int, theirs: TopicType) -> bool:
        """Return whether a peer's type fits this module's. If not, nothing flows, and one event reports it."""
        ours = self._counterpart(role)[topic].type
        fits = ours.fits(theirs)  # what is unknown fits, so firmware, which has no fingerprints, is judged by size only
        self._directory.touch_topic(topic).mismatch = not fits
        if fits:
            peer.mismatched.pop((topic, role), None)
            return True
        self._own.await_agreement(topic, counterpart(role))
        if peer.mismatched.get((topic, role)) != theirs:
            peer.mismatched[topic, role] = theirs
            self._outbox.emit(Mismatched(topic, peer.source, role, ours, theirs))
        self._end(peer, topic, role)
        return False

    def _add_subscriber(self, now: int, peer: Peer, topic: str, *, unanswered: bool) -> bool:
        """Enter a subscription; return whether it is new, or counts as new.

        It counts as new after a restart, and if the peer is still `unanswered` a while after it joined: the response
        was lost, and with it all messages since, which the peer did not accept.
        """
        restarted = peer.subscriptions.get(topic)
        peer.subscriptions[topic] = False
        if restarted is None:
            self._own.subscriber_counts[topic] += 1
        elif not restarted and not (unanswered and now - peer.joined_at[topic] >= _RESPONSE_LOST):
            return False
        peer.joined_at[topic] = now
        return True

    def _announce_subscriber(self, now: int, peer: Peer, joined: SubscriberJoined) -> None:
        """Attach a new subscriber. Firmware gets time to handle the response before the first message."""
        if peer.is_r2p(now) or joined.params in _SENT_BY_R2P:
            self._attach(joined)
        else:
            peer.waiting[joined.topic] = joined
            self._timers.set(("grace", peer.source, joined.topic), now + GRACE)

    def _attach(self, joined: SubscriberJoined) -> None:
        self._attached.add(joined.topic)
        self._outbox.emit(joined)

    def _renew(self, now: int, peer: Peer, topic: str) -> None:
        """Extend a subscription that was made or repeated: by a lease for r2p peers, for ever for firmware."""
        key = ("lease", peer.source, topic)
        if not peer.is_r2p(now):
            peer.permanent[topic] = None
            self._timers.clear(key)
            return
        peer.permanent.pop(topic, None)
        if peer.lease is not None:  # else the end of its module ends it
            self._timers.set(key, self._directory.lease_end(now, peer.source, peer.lease))

    def _end(self, peer: Peer, topic: str, role: int) -> None:
        """End the flow to or from a peer in this role."""
        if role == ROLE_SUBSCRIBES:
            self._remove_subscriber(peer, topic)
        else:
            self._remove_publisher(peer, topic)

    def _remove_subscriber(self, peer: Peer, topic: str) -> None:
        self._requests.remove(peer.source, topic)  # an answer that is due would attach it again
        self._timers.clear(("lease", peer.source, topic))
        if peer.waiting.pop(topic, None) is not None:
            self._timers.clear(("grace", peer.source, topic))
        if peer.subscriptions.pop(topic, None) is None:
            return
        peer.permanent.pop(topic, None)
        del peer.joined_at[topic]
        if decrement(self._own.subscriber_counts, topic) and topic in self._attached:
            self._attached.remove(topic)
            self._outbox.emit(SubscribersGone(topic))

    def _remove_publisher(self, peer: Peer, topic: str) -> None:
        if peer.publishers.pop(topic, None) is not None:
            decrement(self._own.publisher_counts, topic)
            self._outbox.emit(PublisherGone(topic, peer.source))


def _receives(peer: Peer, message: management.Advertise) -> bool:
    """Return whether the messages of this publisher, with these params and size, are accepted already."""
    return peer.publishers.get(message.topic) == (message.params, message.size)


def _needs_type(now: int, peer: Peer, message: management.SubscribeRequest) -> bool:
    """Return whether an r2p subscriber may still lack this module's type. Later requests only extend its lease."""
    if not peer.is_r2p(now):
        return False
    return message.params == UNANSWERED or peer.subscriptions.get(message.topic) is not False


def _implied_type(peer: Peer, message: management.Advertise | management.SubscribeResponse) -> TopicType:
    """Return the type that a publisher's message implies: that of the TYPE before it, if the sizes agree."""
    typed = peer.types.get((message.topic, ROLE_PUBLISHES))
    return typed if typed is not None and typed.size_field == message.size else TopicType.announced(message.size)


class SharedAnswers(Generic[M]):
    """The answers to r2p modules in one role, by topic: some go at once, others wait to serve several modules.

    All modules on the link hear an answer, so it serves all earlier requests. For each topic the first few answers go
    at once; then there is one for each `_SHARED_GAP` and module. Without that, when n modules start together, each
    would answer each of the others, and each of these answers would be answered. The timers have keys that begin with
    "answer".
    """

    def __init__(self, directory: Directory, role: int) -> None:
        self._directory = directory
        self._timers = directory.timers
        self._role = role
        self._full_at: dict[str, int] = {}
        self._deferred: dict[str, dict[PeerAddress, M]] = {}

    def defer(self, now: int, topic: str, source: PeerAddress, message: M) -> bool:
        """Decide whether the answer to this message waits for its timer."""
        deferred = self._deferred.get(topic)
        if deferred is not None:
            deferred[source] = message
            return True
        ready = self._full_at.get(topic, 0) - (_AT_ONCE - 1) * self._gap
        if ready <= now:
            self._count(now, topic)
            return False
        self._deferred[topic] = {source: message}
        self._timers.set(("answer", self._role, topic), ready)
        return True

    def pop(self, now: int, topic: str) -> list[tuple[PeerAddress, M]]:
        """Return the peers to answer, as the timer has expired, each with its last message."""
        self._count(now, topic)
        return list(self._deferred.pop(topic, {}).items())

    def remove(self, source: PeerAddress, topic: str | None = None) -> None:
        """Stop answering a peer, about one topic or about all."""
        for deferred in self._deferred.values() if topic is None else [self._deferred.get(topic, {})]:
            deferred.pop(source, None)

    def forget(self, topic: str) -> None:
        self._full_at.pop(topic, None)
        self._deferred.pop(topic, None)
        self._timers.clear(("answer", self._role, topic))

    def clear(self) -> None:
        for topic in self._full_at.keys() | self._deferred.keys():
            self.forget(topic)

    @property
    def _gap(self) -> int:
        return _SHARED_GAP * self._directory.r2p_modules

    def _count(self, now: int, topic: str) -> None:
        self._full_at[topic] = max(self._full_at.get(topic, 0), now) + self._gap
