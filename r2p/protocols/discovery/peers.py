"""The peers of one link by transport address: what each of them publishes and subscribes to, and with which types.

A subscription of firmware lasts for ever. That of an r2p peer (its HELLO came without a gateway in between) is a lease.
After a good-bye a peer counts as r2p until its lease would be over, because what it sent before may still arrive.
"""

from collections import Counter

import msgspec

from r2p.protocols.discovery.directory import FOR_EVER
from r2p.protocols.discovery.events import ModuleInfo, PeerAddress, SubscriberJoined, TopicType
from r2p.units import SECOND

MOST = 4096
"""Peers on one link."""

_RESPONSE_LOST = SECOND
"""Ns after which a response has arrived or was lost: less than a round of repetition."""


class Peer(msgspec.Struct, eq=False):
    """One address on the link.

    `direct` are the r2p modules there, by name; a line with more than two ends has several at one address. `lease` is
    in ns, None: as long as the module lives. `publishers` are the topics whose messages are accepted from this address,
    with params and size.

    `subscriptions` are the topics that the peer subscribes to, and whether it may have restarted since: then its next
    request is as good as new. `permanent` are those that are no leases, `joined_at` (ns) is when `SubscriberJoined` was
    emitted last, and `waiting` are those that get no messages yet. The keys of `types` and `mismatched` are topic and
    role.
    """

    source: PeerAddress
    direct: set[str] = msgspec.field(default_factory=set)
    r2p_until: int = 0
    lease: int | None = None
    subscriptions: dict[str, bool] = msgspec.field(default_factory=dict)
    joined_at: dict[str, int] = msgspec.field(default_factory=dict)
    permanent: set[str] = msgspec.field(default_factory=set)
    waiting: dict[str, SubscriberJoined] = msgspec.field(default_factory=dict)
    publishers: dict[str, tuple[bytes, int]] = msgspec.field(default_factory=dict)
    types: dict[tuple[str, int], TopicType] = msgspec.field(default_factory=dict)
    mismatched: dict[tuple[str, int], TopicType] = msgspec.field(default_factory=dict)

    def is_r2p(self, now: int) -> bool:
        return bool(self.direct) or now < self.r2p_until

    def add_module(self, now: int, info: ModuleInfo) -> None:
        """Enter an r2p module that said HELLO from this address."""
        lease = None if info.lease >= FOR_EVER else info.lease
        shared = len(self.direct) > (info.name in self.direct)
        if shared and lease is not None:  # the longest lease counts, and that only ends with them all
            lease = max(lease, self.lease) if self.lease is not None else None
        self.lease = lease
        self.direct.add(info.name)
        self.r2p_until = max(self.r2p_until, now + info.lease)

    def mark_restarted(self) -> None:
        self.subscriptions = dict.fromkeys(self.subscriptions, True)

    def forget_type(self, topic: str, role: int) -> None:
        self.types.pop((topic, role), None)
        self.mismatched.pop((topic, role), None)


class Peers:
    """All peers of one link, and how many of them subscribe to each topic."""

    def __init__(self, counts: Counter[str]) -> None:
        self._peers: dict[PeerAddress, Peer] = {}
        self._subscribers: Counter[str] = Counter()
        self._counts = counts

    def get(self, source: PeerAddress) -> Peer | None:
        return self._peers.get(source)

    def get_or_create(self, source: PeerAddress) -> Peer | None:
        """The peer at this address; None, and counted, where there are too many."""
        peer = self._peers.get(source)
        if peer is None:
            if len(self._peers) >= MOST:
                self._counts["too many peers"] += 1
                return None
            peer = self._peers[source] = Peer(source)
        return peer

    def all(self) -> list[Peer]:
        return list(self._peers.values())

    def add_subscriber(self, now: int, peer: Peer, topic: str, *, unanswered: bool) -> bool:
        """Enter a subscription. Returns whether it is new, or as good as new.

        It is as good as new after a restart. So it is where the peer is still `unanswered` a while after it joined: the
        response was lost, and with it what was sent before the peer accepted anything.
        """
        restarted = peer.subscriptions.get(topic)
        peer.subscriptions[topic] = False
        if restarted is None:
            self._subscribers[topic] += 1
        elif not restarted and not (unanswered and now - peer.joined_at[topic] >= _RESPONSE_LOST):
            return False
        peer.joined_at[topic] = now
        return True

    def remove_subscriber(self, peer: Peer, topic: str) -> bool:
        """End a subscription. Returns whether it was the last one of the topic."""
        if peer.subscriptions.pop(topic, None) is None:
            return False
        peer.permanent.discard(topic)
        del peer.joined_at[topic]
        self._subscribers[topic] -= 1
        if self._subscribers[topic]:
            return False
        del self._subscribers[topic]
        return True

    def prune(self, peer: Peer) -> None:
        """Forget a peer that has no module, no subscription and no publisher."""
        if not (peer.direct or peer.subscriptions or peer.publishers):
            self._peers.pop(peer.source, None)
