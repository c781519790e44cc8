"""Discovery on a network that tells by itself who lives: zenoh's liveliness tokens (PROTOCOL.md 10).

The same door as `Discovery`, and the same events; but nothing is repeated, asked for, or leased. What this module has
becomes tokens (`Declare`, `Undeclare`); the tokens of the others come in with `appeared` and `disappeared`, also those
that were there before. What has no place in a token travels as a management message on the network's control key: the
orders, CONFLICT, and what gateways have to say of firmware.
"""

from collections import Counter

import msgspec

from r2p.codecs import UnknownType, liveliness, management
from r2p.codecs.liveliness import ModuleToken, TopicToken
from r2p.codecs.management import ANY_TYPE, NO_PARAMS, ROLE_PUBLISHES, ROLE_SUBSCRIBES
from r2p.errors import DecodeError
from r2p.names import module_alias
from r2p.protocols.discovery.announcer import Relayed
from r2p.protocols.discovery.base import DiscoveryProtocol
from r2p.protocols.discovery.demand import Demand
from r2p.protocols.discovery.directory import MOST, Aliases, EndpointInfo, EndpointKey, TopicInfo
from r2p.protocols.discovery.events import (
    COMMAND_OF_TYPE,
    MESSAGE_OF_COMMAND,
    Command,
    CommandDenied,
    CommandReceived,
    Event,
    ModuleInfo,
    NameConflict,
    PeerAddress,
    QueryTokens,
    Send,
    TopicType,
    command_of,
)
from r2p.protocols.liveliness.matching import Matching
from r2p.protocols.liveliness.modules import ModuleRegistry
from r2p.protocols.liveliness.refused import Refused
from r2p.protocols.liveliness.tokens import DeclaredTopic, TokenSet

TOKENS = 4 * MOST
"""Tokens of others that are kept at most."""

_SECOND = 1_000_000_000
_FRESHEN = _SECOND // 2
"""How often what lives is marked as heard (ns)."""


class LivelinessDiscovery(DiscoveryProtocol):
    """Who is there, on a network with liveliness tokens.

    Every method takes `now` (monotonic ns) and gives back what to do, in order; call `poll` at `next_deadline()`.
    `counts` is the counter to use, where its owner wants to see it grow.
    """

    def __init__(
        self, module: str, instance: int, *, observer: bool = False, counts: Counter[str] | None = None
    ) -> None:
        self.counts = Counter() if counts is None else counts
        self._module = module
        self._instance = instance
        self._up = False
        self._events: list[Event] = []
        self._own = TokenSet(module, instance, observer=observer)
        self._matching = Matching(self._own, self._events)
        self._census = ModuleRegistry(module, instance, self._events, self.counts)
        self._tokens: dict[str, liveliness.Token] = {}
        self._refused = Refused(TOKENS, instance)
        self._aliases = Aliases()
        self._freshen_at: int | None = None

    @property
    def flags(self) -> int:
        """Our own flags, as in ALIVE."""
        return self._own.flags

    @property
    def modules(self) -> dict[str, ModuleInfo]:
        """The other modules by name; one of our own name is another module that has it too."""
        return self._census.modules

    @property
    def endpoints(self) -> dict[EndpointKey, EndpointInfo]:
        """The publishers and subscribers of remote nodes, by instance, node, topic and role."""
        return self._census.endpoints

    @property
    def sole_peer(self) -> int | None:
        """None: there may always be more than one module."""
        return None

    @property
    def generation(self) -> int:
        """Another number means that `modules` or `endpoints` have changed in more than when they were heard."""
        return self._census.generation

    @property
    def topics(self) -> dict[str, TopicInfo]:
        """The topics of the others, by name."""
        return self._matching.topics

    # What the module has and wants

    def set_flags(self, now: int, flags: int) -> list[Event]:
        """The module's state changed. `flags` are FLAG_... of ALIVE."""
        if flags != self._own.flags:
            self._own.set_flags(flags)
        return self._take()

    def advertise(
        self, now: int, topic: str, size: int, fingerprint: bytes = ANY_TYPE, params: bytes = NO_PARAMS
    ) -> list[Event]:
        """The module publishes this topic: messages of `size` bytes (0: not known)."""
        return self._enter(topic, ROLE_PUBLISHES, DeclaredTopic(TopicType(size, fingerprint)))

    def withdraw(self, now: int, topic: str) -> list[Event]:
        """The module does not publish this topic any more: whoever joined has left."""
        return self._remove(topic, ROLE_PUBLISHES)

    def subscribe(
        self, now: int, topic: str, size: int = 0, queue: int = 16, fingerprint: bytes = ANY_TYPE
    ) -> list[Event]:
        """The module subscribes this topic. Size 0 and no fingerprint: whatever its type is.

        `queue`: how many messages may be on the way to it; 0: as many as come, it would rather lose some.
        """
        return self._enter(topic, ROLE_SUBSCRIBES, DeclaredTopic(TopicType(size, fingerprint), queue))

    def unsubscribe(self, now: int, topic: str) -> list[Event]:
        """The module does not subscribe this topic any more: what was opened is shut."""
        return self._remove(topic, ROLE_SUBSCRIBES)

    def endpoint(self, now: int, node: str, topic: str, role: int, publisher_class: int = 0) -> list[Event]:
        """A node publishes or subscribes (ROLE_...) the topic, as CLASS_..."""
        self._own.node(topic, role, node, publisher_class)
        return self._take()

    def endpoint_gone(self, now: int, node: str, topic: str, role: int) -> list[Event]:
        """It does not any more."""
        self._own.node_gone(topic, role, node)
        return self._take()

    # For gateways

    def demand(self) -> Demand:
        """What others offer and want."""
        return self._matching.demand

    def relay(self, now: int, message: Relayed) -> list[Event]:
        """Pass on what a module on another link has said: r2p modules and their nodes as tokens with more hops, of
        firmware each sign of life, so that its age can be seen.
        """
        match message:
            case management.Hello(name, instance, flags, hops):
                token = ModuleToken(self._instance, name, instance, 0, bool(flags & management.HELLO_TOOL), hops)
                before = self._own.relayed(("module", name))
                if isinstance(before, ModuleToken):
                    token = msgspec.structs.replace(token, flags=before.flags)
                gone = bool(flags & management.HELLO_LEAVING)
                if not gone or (isinstance(before, ModuleToken) and before.instance == instance):
                    self._relay(("module", name), token, gone=gone)  # its next start may have been told already
            case management.Alive(name, flags):
                known = self._own.relayed(("module", name))
                if isinstance(known, ModuleToken):
                    token = msgspec.structs.replace(known, flags=flags & liveliness.FLAGS)
                    self._relay(("module", name), token, gone=False)
                else:
                    for each in management.alias_messages(name):
                        self._say(each)
                    self._say(management.Alive(module_alias(name), flags))
            case management.Endpoint(role, instance, node, topic, publisher_class):
                key = (instance, node, topic, role & ~management.ROLE_GONE)
                endpoint = TopicToken(self._instance, key[3], topic, instance, node, publisher_class, hops=1)
                self._relay(key, endpoint, gone=bool(role & management.ROLE_GONE))
        return self._take()

    def _relay(self, key: tuple[str | int, ...], token: liveliness.Token, *, gone: bool) -> None:
        if gone:
            self._own.relay(key, None)
        elif liveliness.is_carried(token):
            self._own.relay(key, token)
        else:
            self.counts["name not carried"] += 1

    # What a person or the shell wants

    def command(self, now: int, command: Command, module: str) -> list[Event]:
        """Order a module to stop, reboot or enter its loader."""
        self._say(MESSAGE_OF_COMMAND[command](module_alias(module)), urgent=True)
        return self._take()

    def query(self, now: int) -> list[Event]:
        """Nobody has to be asked: what r2p modules have is known."""
        return self._take()

    def conflict(self, now: int, module: str, instance_a: int, instance_b: int) -> list[Event]:
        """Tell two modules, which don't see each other, that they carry one name."""
        self._say(management.Conflict(module_alias(module), instance_a, instance_b))
        return self._take()

    # The network

    def link_up(self, now: int) -> list[Event]:
        """It can be reached: declare what there is."""
        self._up = True
        self._events += self._own.changes()
        self._review_refused(now)
        return self._take()

    def link_down(self, now: int) -> list[Event]:
        """Nobody can be seen; who is still there appears again. So do we: after everything else of our session."""
        self._up = False
        self._events += self._own.take_back()
        for key in list(self._tokens):
            self._remove_token(now, key)
        self._refused.clear()
        self._census.clear()  # firmware that gateways told of
        return self._take()

    def leave(self, now: int) -> list[Event]:
        """Nothing is said after it: our tokens go with our session."""
        self._up = False
        self._refused.clear()
        return self._take()

    def next_deadline(self) -> int | None:
        """When to call `poll` (monotonic ns); a time in the past means at once."""
        if self._up and self._own.pending:
            return 0
        due = (self._census.next_deadline(), self._refused.next_deadline(), self._freshen_at)
        return min((each for each in due if each is not None), default=None)

    def poll(self, now: int) -> list[Event]:
        """Declare what changed here; what lives is as good as just heard."""
        if self._up:
            self._events += self._own.changes()
        if self._freshen_at is not None and self._freshen_at <= now:
            self._freshen(now)
        if self._refused.due(now, self._free):
            self._events.append(QueryTokens())
        self._census.poll(now)
        return self._take()

    def receive(self, now: int, data: bytes, source: PeerAddress = None) -> list[Event]:
        """A management message of the session `source`. Never raises for bad bytes: they are counted."""
        try:
            message = management.decode(data)
        except UnknownType:
            self.counts["unknown type"] += 1
        except DecodeError:
            self.counts["undecodable"] += 1
        else:
            self._heard(now, message, source)
        return self._take()

    def appeared(self, now: int, key: str) -> list[Event]:
        """A token is there."""
        token = None if key in self._tokens else self._decoded(key)
        if token is None or token.session == self._instance:
            return self._take()
        if len(self._tokens) >= TOKENS:
            return self.refused(now)
        self._tokens[key] = token
        if self._freshen_at is None:
            self._freshen_at = now + _FRESHEN
        if isinstance(token, ModuleToken):
            self._census.module_appeared(now, key, token)
        else:
            self._census.endpoint_appeared(token)
            if not token.hops:  # behind a gateway: its own tokens say what it passes on
                self._matching.appeared(now, key, token)
        return self._take()

    def disappeared(self, now: int, key: str) -> list[Event]:
        """A token is not there any more."""
        if key in self._tokens:
            self._remove_token(now, key)
        else:
            self._refused.went()
        self._review_refused(now)
        return self._take()

    def refused(self, now: int) -> list[Event]:
        """There was no room for a token."""
        self.counts["too many tokens"] += 1
        return self.missed(now, 1)

    def missed(self, now: int, count: int) -> list[Event]:
        """So many tokens may be there that were not told of; they are asked for when there is room for them."""
        self._refused.add(count)
        self._review_refused(now)
        return self._take()

    def looked(self, now: int, *, complete: bool) -> list[Event]:
        """All answers to `QueryTokens` have come, or, if not `complete`, some of them."""
        self._refused.answered(complete=complete)
        self._review_refused(now)
        return self._take()

    # Topics

    def _enter(self, topic: str, role: int, own: DeclaredTopic) -> list[Event]:
        if self._own.own(topic, role) != own:
            self._own.enter(topic, role, own)
            self._matching.changed(topic, role)
        return self._take()

    def _remove(self, topic: str, role: int) -> list[Event]:
        self._own.remove(topic, role)
        self._matching.changed(topic, role)
        return self._take()

    @property
    def _free(self) -> int:
        return TOKENS - len(self._tokens)

    def _review_refused(self, now: int) -> None:
        if self._up:
            self._refused.review(now, self._free)

    def _remove_token(self, now: int, key: str) -> None:
        token = self._tokens.pop(key, None)
        if isinstance(token, ModuleToken):
            self._census.module_disappeared(now, key, token)
        elif token is not None:
            self._census.endpoint_disappeared(token)
            if not token.hops:
                self._matching.disappeared(key, token)
        if not self._tokens:
            self._freshen_at = None

    def _freshen(self, now: int) -> None:
        self._freshen_at = now + _FRESHEN
        self._matching.freshen(now)
        self._census.freshen(now)

    # Messages

    def _heard(self, now: int, message: management.Management, source: PeerAddress) -> None:
        match message:
            case management.Stop(self._module) | management.Reboot(self._module) | management.Bootload(self._module):
                self._events.append(CommandReceived(command_of(message)))
            case management.Conflict(self._module, a, b) if self._instance in (a, b):
                self._events.append(NameConflict(self._module, a, b))
            case management.Denied(gateway, module, order, reason) if order in COMMAND_OF_TYPE:
                self._events.append(CommandDenied(gateway, COMMAND_OF_TYPE[order], module, reason))
            case management.Name():
                self._aliases.receive(message)
            case management.Alive(name, flags):
                name = self._aliases.name_of(name)
                self._census.firmware(ModuleInfo(name, flags, now, hops=1, source=source))

    def _say(self, message: management.Management, *, urgent: bool = False) -> None:
        if self._up:
            self._events.append(Send(management.encode(message), urgent))

    def _decoded(self, key: str) -> liveliness.Token | None:
        try:
            return liveliness.decode(key)
        except UnknownType:
            self.counts["unknown type"] += 1
        except DecodeError:
            self.counts["undecodable"] += 1
        return None

    def _take(self) -> list[Event]:
        events = self._events[:]
        self._events.clear()
        return events
