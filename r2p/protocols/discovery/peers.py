"""Who is at the other end, by transport address, and what it subscribed, publishes and calls its types.

A firmware peer's subscriptions last for ever. Those of an r2p peer (its HELLO came without a gateway in between) are
leases. A peer counts as r2p until its lease is over even after it said good-bye: what it sent before may still arrive.
"""

from collections import Counter

import msgspec

from r2p.codecs.management import Name
from r2p.names import MODULE_PATH_MAX, module_alias
from r2p.protocols.discovery.directory import FOR_EVER
from r2p.protocols.discovery.events import ModuleInfo, PeerAddress, SubscriberJoined, TopicType

MOST = 4096
"""Peers on one link."""

ANSWER_LOST_AFTER = 1_000_000_000
"""Ns after which an answer has come, or was lost: less than a round of repetition."""


class Peer(msgspec.Struct, eq=False):
    """One address on the link.

    `direct`: the r2p modules there, by name (several share an address where a line has more than two ends). `lease` in
    ns, None: as long as the module lives. `requests`: the topics subscribed, and whether the module restarted since;
    `joined_at`: when that was told last (ns); `permanent`: those that are no leases; `waiting`: those to which no data
    is sent yet. The keys of `types` and `refused` are topic and role.
    """

    source: PeerAddress
    direct: set[str] = msgspec.field(default_factory=set)
    r2p_until: int = 0
    lease: int | None = None
    requests: dict[str, bool] = msgspec.field(default_factory=dict)
    joined_at: dict[str, int] = msgspec.field(default_factory=dict)
    permanent: set[str] = msgspec.field(default_factory=set)
    waiting: dict[str, SubscriberJoined] = msgspec.field(default_factory=dict)
    opened: dict[str, tuple[bytes, int]] = msgspec.field(default_factory=dict)
    types: dict[tuple[str, int], TopicType] = msgspec.field(default_factory=dict)
    refused: dict[tuple[str, int], TopicType] = msgspec.field(default_factory=dict)

    def is_r2p(self, now: int) -> bool:
        return bool(self.direct) or now < self.r2p_until

    def meet(self, now: int, info: ModuleInfo) -> None:
        """The HELLO of an r2p module at this address."""
        lease = None if info.lease >= FOR_EVER else info.lease
        shared = len(self.direct) > (info.name in self.direct)
        if shared and lease is not None:  # the longest lease counts, and that only ends with them all
            lease = max(lease, self.lease) if self.lease is not None else None
        self.lease = lease
        self.direct.add(info.name)
        self.r2p_until = max(self.r2p_until, now + info.lease)

    def mark_stale(self) -> None:
        """Whoever sits there restarted: its next requests are as good as new."""
        self.requests = dict.fromkeys(self.requests, True)

    def forget_type(self, topic: str, role: int) -> None:
        self.types.pop((topic, role), None)
        self.refused.pop((topic, role), None)


class Peers:
    """All peers of one link, and how many of them subscribe each topic."""

    def __init__(self, counts: Counter[str]) -> None:
        self._peers: dict[PeerAddress, Peer] = {}
        self._subscribed: Counter[str] = Counter()
        self._counts = counts

    def get(self, source: PeerAddress) -> Peer | None:
        return self._peers.get(source)

    def get_or_create(self, source: PeerAddress) -> Peer | None:
        """The peer at this address, a new one if need be; None and counted where there are too many."""
        peer = self._peers.get(source)
        if peer is None:
            if len(self._peers) >= MOST:
                self._counts["too many peers"] += 1
                return None
            peer = self._peers[source] = Peer(source)
        return peer

    def all(self) -> list[Peer]:
        return list(self._peers.values())

    def join(self, now: int, peer: Peer, topic: str, *, unanswered: bool) -> bool:
        """The peer subscribes the topic. Says whether that is new, or as good as new.

        So it is when the peer is still `unanswered` a while after the last time: the answer was lost, and with it what
        was sent before the peer took anything.
        """
        stale = peer.requests.get(topic)
        peer.requests[topic] = False
        if stale is None:
            self._subscribed[topic] += 1
        elif not stale and not (unanswered and now - peer.joined_at[topic] >= ANSWER_LOST_AFTER):
            return False
        peer.joined_at[topic] = now
        return True

    def end(self, peer: Peer, topic: str) -> bool:
        """The peer's subscription is over. Says whether it was the last one of the topic."""
        if peer.requests.pop(topic, None) is None:
            return False
        peer.permanent.discard(topic)
        del peer.joined_at[topic]
        self._subscribed[topic] -= 1
        if self._subscribed[topic]:
            return False
        del self._subscribed[topic]
        return True

    def prune(self, peer: Peer) -> None:
        """Forget a peer with whom there is nothing going on."""
        if not (peer.direct or peer.requests or peer.opened):
            self._peers.pop(peer.source, None)


# Names of modules that are too long for a message: an alias travels, and what it stands for (PROTOCOL.md 9).


_PIECE = 22
_MOST = 4096
_MOST_PARTS = 256


def told(name: str) -> list[Name]:
    """The messages that tell what the alias of this name stands for; none if it is its own."""
    alias = module_alias(name)
    if alias == name:
        return []
    pieces = [name[at : at + _PIECE] for at in range(0, len(name), _PIECE)]
    return [Name(alias, number << 4 | len(pieces) - 1, piece) for number, piece in enumerate(pieces)]


class Aliases:
    """What was heard of aliases."""

    def __init__(self) -> None:
        self._names: dict[str, str] = {}
        self._parts: dict[str, dict[int, str]] = {}

    def name_of(self, alias: str) -> str:
        """The name, or the alias where none is known."""
        return self._names.get(alias, alias)

    def heard(self, message: Name) -> str | None:
        """A NAME was heard; gives back the name if it is new, and complete."""
        number, last = message.part >> 4, message.part & 15
        parts = self._parts.setdefault(message.alias, {})
        parts[number] = message.piece
        if not set(range(last + 1)) <= parts.keys():
            _bound(self._parts, _MOST_PARTS)
            return None
        del self._parts[message.alias]
        name = "".join(parts[each] for each in range(last + 1))
        if len(name) > MODULE_PATH_MAX or module_alias(name) != message.alias or self._names.get(message.alias) == name:
            return None
        self._names[message.alias] = name
        _bound(self._names, _MOST)
        return name


def _bound(table: dict[str, object] | dict[str, str] | dict[str, dict[int, str]], most: int) -> None:
    while len(table) > most:
        del table[next(iter(table))]
