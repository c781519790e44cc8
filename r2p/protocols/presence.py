"""Discovery on a network that tells by itself who lives: zenoh's liveliness tokens (PROTOCOL.md 10).

The same door as `Discovery`, and the same events; but nothing is repeated, asked for, or leased. What this module has
becomes tokens (`Declare`, `Undeclare`); the tokens of the others come in with `appeared` and `disappeared`, also those
that were there before. What has no place in a token travels as a management message on the network's control key: the
orders, CONFLICT, and what gateways have to say of firmware.
"""

from collections import Counter
from collections.abc import Callable

import msgspec

from r2p.codecs import UnknownType, liveliness, management
from r2p.codecs.liveliness import ModuleToken, TopicToken
from r2p.codecs.management import ANY_TYPE, NO_PARAMS, ROLE_PUBLISHES, ROLE_SUBSCRIBES
from r2p.errors import DecodeError
from r2p.protocols.announcer import Relayed
from r2p.protocols.declarations import Declarations, Own
from r2p.protocols.demand import Demand
from r2p.protocols.directory import FOR_EVER, MOST, EndpointInfo, EndpointKey, TopicInfo
from r2p.protocols.events import (
    Command,
    Event,
    ModuleChanged,
    ModuleGone,
    ModuleInfo,
    NameConflict,
    Obey,
    Send,
    Shape,
    Source,
)
from r2p.protocols.matching import Matching

TOKENS = 4 * MOST
"""Tokens of others that are kept at most."""

_SECOND = 1_000_000_000
_FRESHEN = _SECOND // 2
"""How often what lives is marked as heard (ns)."""
_NAMESAKE = 1_500_000_000
"""Ns for which two modules of one name must be there: the token of one that has hung may live for a second."""

_ORDERS: dict[Command, Callable[[str], management.Management]] = {
    Command.STOP: management.Stop,
    Command.REBOOT: management.Reboot,
    Command.BOOTLOAD: management.Bootload,
}


class Presence:
    """Who is there, on a network with liveliness tokens.

    Every method takes `now` (monotonic ns) and gives back what to do, in order; call `poll` at `next_deadline()`.
    `counts` is the counter to use, where its owner wants to see it grow.
    """

    def __init__(
        self, module: str, instance: int, *, observer: bool = False, counts: Counter[str] | None = None
    ) -> None:
        self.counts: Counter[str] = Counter() if counts is None else counts
        """What came in and was dropped, by reason."""
        self.modules: dict[str, ModuleInfo] = {}
        """The other modules by name; one of our own name is another module that has it too."""
        self.endpoints: dict[EndpointKey, EndpointInfo] = {}
        """The publishers and subscribers of remote nodes, by instance, node, topic and role."""
        self.generation = 0
        """Another number means that `modules` or `endpoints` have changed in more than when they were heard."""
        self._module = module
        self._instance = instance
        self._up = False
        self._events: list[Event] = []
        self._own = Declarations(module, instance, observer=observer)
        self._matching = Matching(self._own, self._events)
        self._tokens: dict[str, liveliness.Token] = {}
        self._named: dict[str, dict[str, ModuleToken]] = {}
        self._told: Counter[EndpointKey] = Counter()
        self._freshen_at: int | None = None
        self._suspected: dict[str, int] = {}

    @property
    def flags(self) -> int:
        """Our own flags, as in ALIVE."""
        return self._own.flags

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
        return self._enter(topic, ROLE_PUBLISHES, Own(Shape(size, fingerprint)))

    def withdraw(self, now: int, topic: str) -> list[Event]:
        """The module does not publish this topic any more: whoever joined has left."""
        return self._remove(topic, ROLE_PUBLISHES)

    def subscribe(
        self, now: int, topic: str, size: int = 0, queue: int = 16, fingerprint: bytes = ANY_TYPE
    ) -> list[Event]:
        """The module subscribes this topic. Size 0 and no fingerprint: whatever its type is.

        `queue`: how many messages may be on the way to it; 0: as many as come, it would rather lose some.
        """
        return self._enter(topic, ROLE_SUBSCRIBES, Own(Shape(size, fingerprint), queue))

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
                self._own.relay(("module", name), None if flags & management.HELLO_LEAVING else token)
            case management.Alive(name, flags):
                known = self._own.relayed(("module", name))
                if isinstance(known, ModuleToken):
                    self._own.relay(("module", name), msgspec.structs.replace(known, flags=flags))
                else:
                    self._say(message)
            case management.Endpoint(role, instance, node, topic, publisher_class):
                key = (instance, node, topic, role & ~management.ROLE_GONE)
                endpoint = TopicToken(self._instance, key[3], topic, instance, node, publisher_class, hops=1)
                self._own.relay(key, None if role & management.ROLE_GONE else endpoint)
        return self._take()

    # What a person or the shell wants

    def command(self, now: int, command: Command, module: str) -> list[Event]:
        """Order a module to stop, reboot or enter its loader."""
        self._say(_ORDERS[command](module), urgent=True)
        return self._take()

    def query(self, now: int) -> list[Event]:
        """Nobody has to be asked: what r2p modules have is known."""
        return self._take()

    def conflict(self, now: int, module: str, instance_a: int, instance_b: int) -> list[Event]:
        """Tell two modules, which don't see each other, that they carry one name."""
        self._say(management.Conflict(module, instance_a, instance_b))
        return self._take()

    # The network

    def link_up(self, now: int) -> list[Event]:
        """It can be reached: declare what there is."""
        self._up = True
        self._events += self._own.changes()
        return self._take()

    def link_down(self, now: int) -> list[Event]:
        """Nobody can be seen; who is still there appears again. So do we: after everything else of our session."""
        self._up = False
        self._events += self._own.take_back()
        for key in list(self._tokens):
            self._remove_token(now, key)
        for info in list(self.modules.values()):
            self._gone(info)  # firmware that gateways told of
        return self._take()

    def leave(self, now: int) -> list[Event]:
        """Nothing is said after it: our tokens go with our session."""
        self._up = False
        return self._take()

    def next_deadline(self) -> int | None:
        """When to call `poll` (monotonic ns); a time in the past means at once."""
        if self._up and self._own.pending:
            return 0
        due = list(self._suspected.values())
        if self._freshen_at is not None:
            due.append(self._freshen_at)
        return min(due, default=None)

    def poll(self, now: int) -> list[Event]:
        """Declare what changed here; what lives is as good as just heard."""
        if self._up:
            self._events += self._own.changes()
        if self._freshen_at is not None and self._freshen_at <= now:
            self._freshen(now)
        for name in [name for name, due in self._suspected.items() if due <= now]:
            del self._suspected[name]
            self._tell_namesakes(name)
        return self._take()

    def receive(self, now: int, data: bytes, source: Source = None) -> list[Event]:
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
            self.counts["too many tokens"] += 1
            return self._take()
        self._tokens[key] = token
        if self._freshen_at is None:
            self._freshen_at = now + _FRESHEN
        if isinstance(token, ModuleToken):
            self._named.setdefault(token.name, {})[key] = token
            self._review_module(now, token.name)
        else:
            self._enter_endpoint(token)
            if not token.hops:  # behind a gateway: its own tokens say what it passes on
                self._matching.appeared(now, key, token)
        return self._take()

    def disappeared(self, now: int, key: str) -> list[Event]:
        """A token is not there any more."""
        self._remove_token(now, key)
        return self._take()

    # Topics

    def _enter(self, topic: str, role: int, own: Own) -> list[Event]:
        if self._own.own(topic, role) != own:
            self._own.enter(topic, role, own)
            self._matching.changed(topic, role)
        return self._take()

    def _remove(self, topic: str, role: int) -> list[Event]:
        self._own.remove(topic, role)
        self._matching.changed(topic, role)
        return self._take()

    def _enter_endpoint(self, token: TopicToken) -> None:
        key = _endpoint_key(token)
        if key is None or token.instance == self._instance:
            return
        self._told[key] += 1
        name = next((each.name for each in self.modules.values() if each.instance == token.instance), "")
        self.endpoints[key] = EndpointInfo(name, *key, token.publisher_class)
        self.generation += 1

    def _remove_token(self, now: int, key: str) -> None:
        token = self._tokens.pop(key, None)
        if isinstance(token, ModuleToken):
            named = self._named[token.name]
            del named[key]
            if not named:
                del self._named[token.name]
            self._review_module(now, token.name)
        elif token is not None:
            self._remove_endpoint(token)
            if not token.hops:
                self._matching.disappeared(key, token)
        if not self._tokens:
            self._freshen_at = None

    def _remove_endpoint(self, token: TopicToken) -> None:
        """Unless another token tells of it, as when its class has changed."""
        key = _endpoint_key(token)
        if key is not None and key in self._told:
            self._told[key] -= 1
            if not self._told[key]:
                del self._told[key], self.endpoints[key]
                self.generation += 1

    # Modules

    def _review_module(self, now: int, name: str) -> None:
        """The tokens of a name have changed: the nearest and latest of them is the module."""
        tokens = [each for each in self._named.get(name, {}).values() if each.instance != self._instance]
        before = self.modules.get(name)
        if not tokens:
            self._suspected.pop(name, None)
            if before is not None:
                self._gone(before)
            return
        nearest = min(reversed(tokens), key=lambda each: each.hops)
        info = ModuleInfo(
            name,
            nearest.flags,
            now,
            nearest.instance,
            nearest.observer,
            FOR_EVER if nearest.instance is not None else 0,
            nearest.hops,
            nearest.session,
        )
        self._keep(before, info)
        own = {self._instance} if name == self._module else set()
        if len({each.instance for each in tokens} | own) > 1:
            self._suspected.setdefault(name, now + _NAMESAKE)
        else:
            self._suspected.pop(name, None)

    def _keep(self, before: ModuleInfo | None, info: ModuleInfo) -> None:
        if before is None and len(self.modules) >= MOST:
            self.counts["modules forgotten"] += 1
            return
        self.modules[info.name] = info
        if before is None or msgspec.structs.replace(before, last_heard=info.last_heard) != info:
            self.generation += 1
            self._events.append(ModuleChanged(info))
        for key, endpoint in self.endpoints.items():
            if endpoint.instance == info.instance and endpoint.module != info.name:
                self.endpoints[key] = msgspec.structs.replace(endpoint, module=info.name)

    def _gone(self, info: ModuleInfo) -> None:
        del self.modules[info.name]
        self.generation += 1
        self._events.append(ModuleGone(info))

    def _tell_namesakes(self, name: str) -> None:
        instances = [each.instance for each in self._named.get(name, {}).values()]
        if name == self._module:
            instances.insert(0, self._instance)
        one, other, *_ = dict.fromkeys(instances)
        self._events.append(NameConflict(name, one, other))

    def _freshen(self, now: int) -> None:
        self._freshen_at = now + _FRESHEN
        self._matching.freshen(now)
        for name in self._named:
            info = self.modules.get(name)
            if info is not None and info.r2p:
                self.modules[name] = msgspec.structs.replace(info, last_heard=now)

    # Messages

    def _heard(self, now: int, message: management.Management, source: Source) -> None:
        match message:
            case management.Stop(self._module):
                self._events.append(Obey(Command.STOP))
            case management.Reboot(self._module):
                self._events.append(Obey(Command.REBOOT))
            case management.Bootload(self._module):
                self._events.append(Obey(Command.BOOTLOAD))
            case management.Conflict(self._module, a, b) if self._instance in (a, b):
                self._events.append(NameConflict(self._module, a, b))
            case management.Alive(name, flags) if name != self._module and name not in self._named:
                self._keep(self.modules.get(name), ModuleInfo(name, flags, now, hops=1, source=source))

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


def _endpoint_key(token: TopicToken) -> EndpointKey | None:
    if not token.node or token.instance is None:
        return None
    return token.instance, token.node, token.topic, token.role
