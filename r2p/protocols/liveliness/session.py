"""Discovery on a network that itself reports changes: zenoh's liveliness tokens (PROTOCOL.md 10).

Links use it like `Discovery`, and get the same events; but nothing is repeated, requested, or leased. This module's
topics become tokens (`Declare`, `Undeclare`); `appeared` and `disappeared` report those of other modules, earlier ones
included. Everything else travels as a management message on the network's control key: commands, CONFLICT, and
gateways' messages about firmware.
"""

from collections import Counter
from typing import TYPE_CHECKING

import msgspec

from r2p.codecs import liveliness, management
from r2p.codecs.liveliness import ModuleToken, SoftwareToken, TopicToken
from r2p.names import module_alias
from r2p.protocols.discovery.aliases import LinkNames, ModuleAliases
from r2p.protocols.discovery.announcer import LocalTopic, Relayed
from r2p.protocols.discovery.demand import Demand
from r2p.protocols.discovery.directory import decrement
from r2p.protocols.discovery.events import (
    Event,
    ModuleInfo,
    NameConflict,
    PeerAddress,
    QueryTokens,
    TopicType,
)
from r2p.protocols.discovery.interface import DiscoveryProtocol
from r2p.protocols.liveliness.modules import ModuleRegistry
from r2p.protocols.liveliness.tokens import Matching, TokenSet
from r2p.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Collection

TOKENS_MAX = 65_536
"""Tokens of other modules that are kept, unless the link's URL says otherwise."""

TOO_MANY = "too many tokens"
"""The reason under which tokens without room are counted."""

_MARK_EVERY = SECOND // 4
"""Ns after which everything with a token is marked as heard once more, if anybody wants to know."""

_PAUSE_MIN = 5 * SECOND
"""Ns from when there is room for refused tokens until they are queried; twice as long each time."""

_PAUSE_MAX = 300 * SECOND
"""Ns that this pause may become, and ns without a query after which it is short again."""


class LivelinessDiscovery(DiscoveryProtocol):
    """The discovery of one module on a network with liveliness tokens."""

    def __init__(
        self,
        module: str,
        instance: int,
        *,
        observer: bool = False,
        counts: Counter[str] | None = None,
        tokens_max: int | None = None,
    ) -> None:
        """`tokens_max`: tokens of other modules that are kept."""
        super().__init__(module, instance, counts, LinkNames())
        self._own = TokenSet(module, instance, observer=observer)
        self.tokens_max = TOKENS_MAX if tokens_max is None else tokens_max
        self._matching = Matching(self._own, self._outbox, self.tokens_max)
        self._modules = ModuleRegistry(module, instance, self._outbox, self.counts)
        self.modules = self._modules.modules
        self.topics = self._matching.topics
        self.endpoints = self._modules.endpoints
        self._tokens: dict[str, liveliness.Token] = {}
        self._carried: dict[str, Collection[str]] = {}
        """The tokens that each key of other sessions stands for."""
        self._carriers: Counter[str] = Counter()
        """How many more keys have a token, of those that several have."""
        self._refused = RefusedTokens(self.tokens_max, instance)
        self._aliases = ModuleAliases(module, self.counts)
        self._marked_at = 0

    @property
    def generation(self) -> int:
        return self._modules.generation

    @property
    def known_keys(self) -> "Collection[str]":
        """The keys of other sessions whose tokens are known."""
        return self._carried.keys()

    # What this module has

    def set_flags(self, now: int, flags: int) -> list[Event]:
        if flags != self.flags:
            self.flags = flags
            self._own.set_flags(flags)
        return self._outbox.drain()

    def add_endpoint(self, now: int, node: str, topic: str, role: int, publisher_class: int = 0) -> list[Event]:
        self._own.add_node(topic, role, node, publisher_class)
        return self._outbox.drain()

    def remove_endpoint(self, now: int, node: str, topic: str, role: int) -> list[Event]:
        self._own.remove_node(topic, role, node)
        return self._outbox.drain()

    def module_behind(self, alias: str) -> str:
        return next((name for name in self.modules if module_alias(name) == alias), self._aliases.name_of(alias))

    def refresh_ages(self, now: int) -> None:
        """Mark everything with a token as heard: it is there, though nothing is repeated."""
        if now < self._marked_at + _MARK_EVERY:
            return
        self._marked_at = now
        self._matching.mark_heard(now)
        self._modules.mark_heard(now)

    # For gateways

    def demand(self) -> Demand:
        return self._matching.demand

    def relay(self, now: int, message: Relayed) -> list[Event]:
        """Pass on r2p modules and their nodes as tokens with more hops, and of firmware each sign of life, so that its
        age can be seen.
        """
        match message:
            case management.Hello(name, instance, flags, hops, _, wire, release):
                token = ModuleToken(self._instance, name, instance, 0, bool(flags & management.HELLO_TOOL), hops)
                before = self._own.relayed(("module", name))
                if isinstance(before, ModuleToken):
                    token = msgspec.structs.replace(token, flags=before.flags)
                gone = bool(flags & management.HELLO_LEAVING)
                if not gone or (isinstance(before, ModuleToken) and before.instance == instance):
                    self._relay(("module", name), token, gone=gone)  # its next start may have been announced already
                    if wire and not token.observer:
                        software = SoftwareToken(self._instance, instance, wire, release)
                        self._relay(("version", name), software, gone=gone)
            case management.Alive(name, flags):
                known = self._own.relayed(("module", name))
                if isinstance(known, ModuleToken):
                    token = msgspec.structs.replace(known, flags=flags & liveliness.FLAGS_MASK)
                    self._relay(("module", name), token, gone=False)
                else:
                    self._outbox.send(*management.alias_messages(name), management.Alive(name, flags))
            case management.Endpoint(role, instance, node, topic, publisher_class):
                key = (instance, node, topic, role & ~management.ROLE_GONE)
                endpoint = TopicToken(self._instance, key[3], topic, instance, node, publisher_class, hops=1)
                self._relay(key, endpoint, gone=bool(role & management.ROLE_GONE))
        return self._outbox.drain()

    def _relay(self, key: tuple[str | int, ...], token: liveliness.Token, *, gone: bool) -> None:
        if gone:
            self._own.set_relayed(key, None)
        elif liveliness.is_representable(token):
            self._own.set_relayed(key, token)
        else:
            self.counts["name not carried"] += 1

    # What users ask for

    def query(self, now: int) -> list[Event]:
        """Do nothing: all topics of r2p modules are known."""
        return self._outbox.drain()

    def report_conflict(self, now: int, module: str, instance_a: int, instance_b: int) -> list[Event]:
        self._outbox.send(management.Conflict(module, instance_a, instance_b))
        return self._outbox.drain()

    # The link

    def link_up(self, now: int) -> list[Event]:
        self._outbox.up = True
        self._outbox.emit(*self._own.pop_changes())
        self._refused.note_joined()
        self._review_refused(now)
        return self._outbox.drain()

    def link_down(self, now: int) -> list[Event]:
        """Forget all tokens, which will appear again; then this module declares its own anew."""
        self._outbox.up = False
        self._outbox.emit(*self._own.withdraw_all())
        for key in list(self._tokens):
            self._remove_token(now, key)
        self._carried.clear()
        self._carriers.clear()
        self._refused.clear()
        self._modules.clear()  # only firmware is left, which gateways announce by messages
        return self._outbox.drain()

    def leave(self, now: int) -> list[Event]:
        """Stop; the tokens end with the session."""
        self._outbox.up = False
        self._refused.clear()
        return self._outbox.drain()

    def next_deadline(self) -> int | None:
        if self._outbox.up and self._own.has_changes:
            return 0
        due = (self._modules.next_deadline(), self._refused.next_deadline())
        return min((each for each in due if each is not None), default=None)

    def poll(self, now: int) -> list[Event]:
        """Declare changes of this module; query refused tokens."""
        if self._outbox.up:
            self._outbox.emit(*self._own.pop_changes())
        if self._refused.begin_query(now, self._free):
            self._outbox.emit(QueryTokens())
        self._modules.poll(now)
        return self._outbox.drain()

    def receive(self, now: int, data: bytes, source: PeerAddress = None) -> list[Event]:
        message = self._decode(management.decode, data)
        if message is not None:
            self._handle(now, message, source)
        return self._outbox.drain()

    def publisher_type(self, topic: str, module: str) -> TopicType:
        types = self._matching.publisher_types(topic)
        return types.pop() if len(types) == 1 else TopicType()

    # Tokens of other modules

    def appeared(self, now: int, key: str) -> list[Event]:
        """Handle a key that exists, with its tokens; ignore a known one."""
        if key in self._carried:
            return self._outbox.drain()
        tokens = self._tokens_of(key)
        known = [each for each in tokens if each in self._tokens]
        new = len(tokens) - len(known)
        if new > self._free:
            return self.refused(now, new)
        if tokens:
            self._carried[key] = tokens.keys()
        for carried, token in tokens.items():
            if known and carried in self._tokens:
                self._carriers[carried] += 1  # another key has it, too
            else:
                self._add_token(now, carried, token)
        return self._outbox.drain()

    def disappeared(self, now: int, key: str) -> list[Event]:
        """Handle the end of a key, and of those of its tokens that no other key has."""
        carried = self._carried.pop(key, None)
        if carried is None:
            self._refused.remove_one()
        for each in carried or ():
            if each in self._carriers:
                decrement(self._carriers, each)
            else:
                self._remove_token(now, each)
        self._review_refused(now)
        return self._outbox.drain()

    def _tokens_of(self, key: str) -> dict[str, liveliness.Token]:
        """Return the tokens of another session that a key stands for; count its invalid parts."""
        tokens, errors = liveliness.tokens_of(key)
        for error in errors:
            self._count_undecodable(error)
        if any(token.session == self._instance for token in tokens.values()):  # of one, as a key has one session
            return {}
        return tokens

    def _add_token(self, now: int, key: str, token: liveliness.Token) -> None:
        self._tokens[key] = token
        self._refused.note_found()
        if isinstance(token, ModuleToken):
            self._modules.module_appeared(now, key, token)
        elif isinstance(token, SoftwareToken):
            self._modules.software_appeared(now, key, token)
        else:
            self._modules.endpoint_appeared(token)
            if not token.hops:  # behind a gateway: its own tokens say what it passes on
                self._matching.appeared(now, key, token)

    def refused(self, now: int, count: int = 1) -> list[Event]:
        """Count tokens for which there was no room."""
        self.counts[TOO_MANY] += count
        return self.missed(now, count)

    def missed(self, now: int, count: int) -> list[Event]:
        """Note that so many tokens may be unreported, which are queried when there is room."""
        self._refused.add(count)
        self._review_refused(now)
        return self._outbox.drain()

    def query_ended(self, now: int, *, complete: bool) -> list[Event]:
        """Note that all answers to `QueryTokens` have come, or, if not `complete`, some of them."""
        self._refused.query_ended(complete=complete)
        self._review_refused(now)
        return self._outbox.drain()

    # Topics

    def _set_topic(self, now: int, topic: str, role: int, own: LocalTopic) -> list[Event]:
        if self._own.get(topic, role) != own:
            self._own.set_topic(topic, role, own)
            self._matching.changed(topic, role)
        return self._outbox.drain()

    def _remove_topic(self, now: int, topic: str, role: int) -> list[Event]:
        self._own.remove_topic(topic, role)
        self._matching.changed(topic, role)
        return self._outbox.drain()

    @property
    def _free(self) -> int:
        return self.tokens_max - len(self._tokens)

    def _review_refused(self, now: int) -> None:
        if self._outbox.up:
            self._refused.review(now, self._free)

    def _remove_token(self, now: int, key: str) -> None:
        token = self._tokens.pop(key, None)
        if isinstance(token, ModuleToken):
            self._modules.module_disappeared(now, key, token)
        elif isinstance(token, SoftwareToken):
            self._modules.software_disappeared(now, key, token)
        elif token is not None:
            self._modules.endpoint_disappeared(token)
            if not token.hops:
                self._matching.disappeared(key, token)

    # Messages

    def _handle(self, now: int, message: management.Management, source: PeerAddress) -> None:
        match message:
            case management.Stop() | management.Reboot() | management.Bootload():
                self._commanded(now, message, source)
            case management.Conflict(name, a, b) if name == module_alias(self._module) and self._instance in (a, b):
                self._outbox.emit(NameConflict(self._module, a, b))
            case management.Denied():
                self._denied(now, message, source)
            case management.Name():
                self._aliases.receive(message)
            case management.Alive(name, flags):
                name = self._aliases.name_of(name)
                self._modules.add_firmware(ModuleInfo(name, flags, now, hops=1, source=source))


class RefusedTokens:
    """Counts tokens that were refused as there were too many, and says when to query them.

    The network reports each token only once, if at all while many sessions join, so all are queried after that, and
    refused ones when there is room. They are not kept, only counted: memory stays bounded. Many answers are work for a
    router, so this waits until all of them have room, or a quarter of the table is free, and longer and longer where
    that happens again and again. It ends with a query that brings nothing new: under load, one in some thousand ends
    before its last answers. While the network has more tokens than fit, some stay unknown.
    """

    def __init__(self, most: int, spread: int) -> None:
        """`most` tokens are kept. `spread` is a number that few modules share: it keeps them from querying at once."""
        self._enough = most // 4
        self._spread = spread % 256
        self._any = False
        self._count = 0
        """An estimate: a token that ended may have been a refused one."""
        self._largest = 0
        """Tokens of the largest refused pack: with less room, it would be refused again."""
        self._query_at: int | None = None
        self._querying = False
        self._found = False
        self._pause = _PAUSE_MIN
        self._last_query: int | None = None

    def add(self, count: int = 1) -> None:
        """Count refused tokens."""
        self._any = True
        self._count += count
        self._largest = max(self._largest, count)

    def remove_one(self) -> None:
        """Note the end of a token that was not kept."""
        self._count = max(0, self._count - 1)

    def note_joined(self) -> None:
        """Have all tokens queried once, later: some reports are missing where many sessions join together."""
        self._any = True

    def note_found(self) -> None:
        """Note that a token has got a place: if an answer brought it, another one may be missing among the answers."""
        self._found = True

    def clear(self) -> None:
        """Start over: all tokens are gone, and will be reported again."""
        self._any = False
        self._count = self._largest = 0
        self._query_at = None

    def next_deadline(self) -> int | None:
        """Return when to call `begin_query` (monotonic ns)."""
        return self._query_at

    def review(self, now: int, free: int) -> None:
        """Plan a query if there is room for `free` tokens."""
        if self._querying or self._query_at is not None or not self._fit(free):
            return
        if self._last_query is not None and now - self._last_query >= _PAUSE_MAX:
            self._pause = _PAUSE_MIN
        self._query_at = now + self._pause + self._pause * self._spread // 256

    def begin_query(self, now: int, free: int) -> bool:
        """Decide whether to query the tokens now; then `query_ended` has to follow."""
        if self._query_at is None or now < self._query_at:
            return False
        self._query_at = None
        if not self._fit(free):
            return False
        self._any, self._count, self._largest, self._querying, self._found = False, 0, 0, True, False
        self._last_query, self._pause = now, min(2 * self._pause, _PAUSE_MAX)
        return True

    def query_ended(self, *, complete: bool) -> None:
        """Note that the query is over; if not `complete`, some answers may be missing."""
        self._querying = False
        self._count //= 2  # one that came meanwhile may also be among the answers; rather too few than too many
        self._any = self._any or self._found or not complete

    def _fit(self, free: int) -> bool:
        # As the count is an estimate, a quarter of the table is enough in any case.
        return self._any and free >= min(max(self._count, self._largest, 1), self._enough)
