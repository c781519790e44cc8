"""Modules and nodes of one side, told on the other: what has changed at once, the rest again and again.

Whoever is new on a link, or asks, gets all of it at once. r2p modules are passed on with one hop more, and taken back
when they are gone. Of firmware only what it says itself is passed on, so that its age can be seen everywhere; it does
not answer, so whoever asks is told of what was heard lately.

`_facts` is what each link has told, by key; where something has changed on a link, only that is looked at, and told on
the others. Links on which much comes and goes are looked at ROUNDS times a second. What is told again is spread over
more time the more there is of it.
"""

from collections import deque
from collections.abc import Callable, Iterable

import msgspec

from r2p.bridge.forwarding import MOST_HOPS
from r2p.bridge.options import Policy
from r2p.bridge.port import BridgePort
from r2p.clock import Alarm
from r2p.codecs import management
from r2p.codecs.management import ROLE_GONE, ROLE_PUBLISHES
from r2p.log_lines import get_logger
from r2p.names import module_alias
from r2p.protocols.discovery.announcer import Relayed
from r2p.protocols.discovery.directory import EndpointInfo
from r2p.protocols.discovery.events import ModuleInfo
from r2p.runtime.topic import TopicSpace
from r2p.transports.stats import RETRY_AFTER_ERROR, count_internal_error

ROUNDS = 5
"""Looks at what has changed in a second, at most."""

_SECOND = 1_000_000_000
_REFRESH = 1_500_000_000
_REFRESH_MOST = 20_000_000_000  # ns; a HELLO is believed for 65 s at most
_REPEATED = 4_000  # messages a second that only repeat what was told before
_SLICE = 250  # facts that are told again at once
_SLICE_APART = 20_000_000  # ns between two of them
_REST = 10  # times as long as a look took before the next one
_SOON = 2_000_000  # ns; so that what comes together is looked at together
_APART = 200_000_000  # ns between two answers on one link
_LATELY = 2_000_000_000  # ns; of firmware that was heard since
_Key = tuple[object, ...]


class _ModuleFact(msgspec.Struct, frozen=True):
    """A module as a link tells it, by its name on the robot; `foreign`: it is not the robot's."""

    name: str
    foreign: bool
    info: ModuleInfo

    @property
    def rank(self) -> tuple[bool, int]:
        """Of several links the one with the lowest rank tells the truth."""
        return self.foreign, self.info.hops


class _NodeFact(msgspec.Struct, frozen=True):
    """A publisher or subscriber as a link tells it; `topic` is its name on the robot."""

    topic: str
    info: EndpointInfo
    rank: tuple[bool, int] = (False, 0)


_Fact = _ModuleFact | _NodeFact


class _Announced(msgspec.Struct, frozen=True):
    """What was passed on of a fact, and when the module was heard."""

    messages: tuple[Relayed, ...]
    heard: int


class DirectoryRelay:
    """What each link has been told of the modules on the others; `name` and `instance` are the gateway's own.

    `repeating` is called whenever something is told again.
    """

    def __init__(
        self,
        name: str,
        instance: int,
        ports: dict[str, BridgePort],
        space: TopicSpace,
        policy: Policy,
        repeating: Callable[[], object],
    ) -> None:
        self._name = name
        self._instance = instance
        self._ports = ports
        self._clock = space.clock
        self._policy = policy
        self._repeating = repeating
        self._facts: dict[str, dict[_Key, _Fact]] = {}
        """By link, then by key."""
        self._sources: dict[_Key, dict[str, _Fact]] = {}
        """The same by key, then by link."""
        self._told: dict[str, dict[_Key, _Announced]] = {}
        self._alarm = Alarm(space.loop, self._due, background=True)
        self._dirty: set[str] = set()
        self._joined: set[str] = set()
        """Links in the tree, which know all."""
        self._behind: set[str] = set()
        """Links that had to wait until the gateways agree, and lack what has changed meanwhile."""
        self._asked: set[str] = set()
        self._met: dict[str, set[int]] = {}
        self._answered_at: dict[str, int] = {}
        self._refresh_at: dict[str, int] = {}
        self._again: dict[str, deque[_Key]] = {}
        """What is to be told again, by link."""
        self._answering: set[str] = set()
        """The links where that is an answer."""
        self._rounds: deque[int] = deque(maxlen=ROUNDS)
        self._next_round_at = 0
        self._repeated_at = 0

    def asked(self, port: BridgePort) -> None:
        """Somebody on the link wants to know everything."""
        self._asked.add(port.name)
        self._set_alarm(self._clock.monotonic())

    def changed(self, port: BridgePort) -> None:
        """A module or a node came or went there, or the link has another place in the tree."""
        self._dirty.add(port.name)
        self._set_alarm(self._clock.monotonic())

    def forget(self, port: BridgePort) -> None:
        """The link is gone."""
        for known in (self._told, self._met, self._answered_at, self._refresh_at, self._again):
            known.pop(port.name, None)
        self._asked.discard(port.name)
        self._behind.discard(port.name)
        self._joined.discard(port.name)
        self._answering.discard(port.name)
        self.changed(port)

    def close(self) -> None:
        self._alarm.close()

    # When

    def _set_alarm(self, now: int) -> None:
        dues = [now + _REFRESH, *self._refresh_at.values()]
        if self._dirty:
            dues.append(max(now + _SOON, self._next_round_at))
        if self._behind:
            dues.append(now + _APART)
        if self._again:
            dues.append(now + _SLICE_APART)
        dues += [max(now + _SOON, self._answered_at.get(name, -_APART) + _APART) for name in self._asked]
        self._alarm.set(min(dues))

    def _due(self) -> None:
        now = self._clock.monotonic()
        try:
            self._do_due(now)
        except Exception as error:  # noqa: BLE001 - counted and logged
            count_internal_error((port.link.stats.lost for port in self._ports.values()), error)
            self._alarm.set(now + RETRY_AFTER_ERROR)
        else:
            self._set_alarm(now)

    def _do_due(self, now: int) -> None:
        late = any(self._is_open(port, now) for port in self._ports.values() if port.name in self._behind)
        if (self._dirty or late) and now >= self._next_round_at:
            self._rounds.append(now)
            self._look(now)
            took = self._clock.monotonic() - now
            fifth = self._rounds[0] + _SECOND if len(self._rounds) == ROUNDS else 0
            self._next_round_at = max(fifth, now + _REST * took)
        period = self._period()
        for port in list(self._ports.values()):
            if port.link.up and self._is_open(port, now):
                port.link.stats.lost.guard(self._repeat, port, now, period)
            else:
                self._put_off(port, now)
        if now >= self._repeated_at + _REFRESH:
            self._repeated_at = now
            self._repeating()

    def _repeat(self, port: BridgePort, now: int, period: int) -> None:
        """Tell a link again what it asks for, or has not been told for a while."""
        self._meet(port)
        if port.name in self._asked and now >= self._answered_at.get(port.name, -_APART) + _APART:
            self._asked.discard(port.name)
            self._answered_at[port.name] = now
            self._answering.add(port.name)
            self._again[port.name] = deque(self._told.get(port.name, ()))
        if now >= self._refresh_at.setdefault(port.name, now + period):
            self._refresh_at[port.name] = now + period
            self._again.setdefault(port.name, deque(self._told.get(port.name, ())))
        if port.name in self._again:
            self._tell_again(port, now)

    def _put_off(self, port: BridgePort, now: int) -> None:
        """It can't be told anything now: look again soon."""
        for when, gap in ((self._refresh_at, _APART), (self._answered_at, 0)):
            if port.name in when or port.name in self._asked:
                when[port.name] = max(when.get(port.name, 0), now + gap)

    def _period(self) -> int:
        """The time (ns) in which everything is told again."""
        count = len(self._sources) * max(len(self._ports) - 1, 1)
        return min(max(_REFRESH, count * _SECOND // _REPEATED), _REFRESH_MOST)

    def _meet(self, port: BridgePort) -> None:
        """See whether somebody is new there, who is to be told everything."""
        if port.name in self._met and port.name not in self._facts:
            return
        here = {info.instance for info in port.link.discovery.modules.values() if info.instance and not info.hops}
        if not here <= self._met.get(port.name, set()):
            self._asked.add(port.name)
        self._met[port.name] = here

    def _is_open(self, port: BridgePort, now: int) -> bool:
        """Whether it has not to wait until the gateways agree."""
        return not port.in_tree or now < port.place.until

    def modules(self) -> dict[str, str]:
        """The modules by their name on the robot, with the link where each is foreign ("": it is the robot's)."""
        return {
            name: self.foreign(name) for kind, name, *_ in self._sources if kind == "module" and isinstance(name, str)
        }

    def foreign(self, name: str) -> str:
        """The link where the module of this name is foreign; "": it is the robot's, or not known."""
        facts = self._sources.get(("module", name))
        if facts is None:
            return ""
        link = min(facts, key=lambda each: facts[each].rank)
        return link if facts[link].rank[0] else ""

    # What is there

    def _look(self, now: int) -> None:
        """See what has changed on the links, and tell it on the others."""
        dirty, behind = self._dirty | self._behind, self._behind
        self._dirty, self._behind = set(), set()
        changed: dict[_Key, None] = {}
        again = [port for port in self._ports.values() if port.name in behind]
        for name in dirty:
            port = self._ports.get(name)
            if port is not None and port.link.up and not self._is_open(port, now):
                self._behind.add(name)  # what it has told holds until the gateways agree
                continue
            try:
                self._collect(name, port, changed)
            except Exception as error:  # noqa: BLE001 - counted and logged; it is read anew, and the next link follows
                count_internal_error((each.link.stats.lost for each in self._ports.values()), error)
                self._dirty.add(name)
                continue
            if port is not None and port.link.up and port.in_tree != (name in self._joined):
                again.append(port)  # it has just joined the tree, or left it
                self._joined ^= {name}
        for port in self._ports.values():
            if port.link.up and self._is_open(port, now):
                keys: Iterable[_Key] = [*self._sources, *self._told.get(port.name, ())] if port in again else changed
                for key in list(dict.fromkeys(keys)):
                    port.link.stats.lost.guard(self._tell, port, key)
            elif port.link.up:
                self._behind.add(port.name)

    def _collect(self, name: str, port: BridgePort | None, changed: dict[_Key, None]) -> None:
        """Read what a link tells now."""
        before = self._facts.pop(name, {})
        facts = {} if port is None or not port.link.up or not port.in_tree else self._facts_of(port)
        for key in before.keys() - facts.keys():
            changed[key] = None
            self._sources[key].pop(name)
            if not self._sources[key]:
                del self._sources[key]
        for key, fact in facts.items():
            if not _is_same(before.get(key), fact):
                changed[key] = None
            self._sources.setdefault(key, {})[name] = fact
        if facts:
            self._facts[name] = facts

    def _facts_of(self, port: BridgePort) -> dict[_Key, _Fact]:
        facts: dict[_Key, _Fact] = {}
        hidden: set[int | None] = set()
        for info in port.link.discovery.modules.values():
            meant = self._policy.module_meant(info.name, port.name)
            if meant is None:
                hidden.add(info.instance)
            elif meant[0] != self._name:  # of our name: our last start, of which others still tell
                facts["module", meant[0]] = _ModuleFact(*meant, info)
        for endpoint in port.link.discovery.endpoints.values():
            topic = self._policy.to_canonical(endpoint.topic, port.name)
            if topic is not None and endpoint.instance != self._instance and endpoint.instance not in hidden:
                facts["endpoint", endpoint.instance, endpoint.node, topic, endpoint.role] = _NodeFact(topic, endpoint)
        return facts

    # What is told

    def _tell_again(self, port: BridgePort, now: int) -> None:
        """Tell a link a part of everything again: what lives, and of firmware what was heard since, or as an answer
        what was heard lately.
        """
        keys, told = self._again[port.name], self._told.setdefault(port.name, {})
        answers = port.name in self._answering
        for key in [keys.popleft() for _ in range(min(len(keys), _SLICE))]:
            before = told.get(key)
            new = None if before is None else self._tell(port, key)
            if before is None or new is None or new.messages != before.messages:
                continue  # it has just been told
            told[key] = new
            for message in new.messages:
                is_alive = isinstance(message, management.Alive)
                if not is_alive or new.heard > before.heard or (answers and now < new.heard + _LATELY):
                    self._say(port, message)
        if not keys:
            del self._again[port.name]
            self._answering.discard(port.name)

    def _tell(self, port: BridgePort, key: _Key) -> _Announced | None:
        """Tell a link what has changed of a fact; gives back what it should know."""
        told = self._told.setdefault(port.name, {})
        before = told.get(key)
        new = self._news(port, key) if port.in_tree else None
        if new is not None:
            for message in new.messages:
                if before is None or message not in before.messages:
                    self._say(port, message)
        if before is not None:
            kept = {_subject(message) for message in new.messages} if new is not None else set()
            for message in before.messages:
                gone = _gone(message)
                if gone is not None and _subject(message) not in kept:
                    self._say(port, gone)
        if new is None:
            told.pop(key, None)
        elif before is None or new.messages != before.messages:
            told[key] = new
        return new

    def _say(self, port: BridgePort, message: Relayed) -> None:
        port.link.stats.lost.guard(port.link.relay, message)

    def _news(self, port: BridgePort, key: _Key) -> _Announced | None:
        """What this link should know of a fact."""
        sources = self._sources.get(key, {})
        names = [name for name in sources if name != port.name]
        if not names:
            return None
        name = min(names, key=lambda each: sources[each].rank)
        fact = sources[name]
        if isinstance(fact, _ModuleFact):
            return self._module_news(fact, self._ports[name], port)
        return self._node_news(fact, self._ports[name], port)

    def _module_news(self, module: _ModuleFact, source: BridgePort, port: BridgePort) -> _Announced | None:
        info = source.link.discovery.modules.get(module.info.name, module.info)  # as it was heard last
        called = self._policy.module_called(module.name, port.name, foreign=module.foreign)
        if called is None or info.hops + 1 > MOST_HOPS:
            return None
        known = port.link.discovery.modules.get(called)
        if known is not None and known.instance == info.instance:
            return None  # it is on both links
        messages: list[Relayed] = []
        if info.r2p and info.instance is not None:
            flags = management.HELLO_TOOL if info.observer else 0
            lease = min(max(info.lease, 3 * self._period()) // 1_000_000, 0xFFFF)
            messages.append(management.Hello(called, info.instance, flags, info.hops + 1, lease))
        if not info.observer:
            messages.append(management.Alive(called, info.flags))
        return _Announced(tuple(messages), info.last_heard)

    def _node_news(self, node: _NodeFact, source: BridgePort, port: BridgePort) -> _Announced | None:
        info = node.info
        publishes = info.role == ROLE_PUBLISHES
        ways = (source, port) if publishes else (port, source)
        called = self._policy.to_link_name(node.topic, port.name)
        if not self._policy.allows(node.topic, ways[0].name, ways[1].name) or len(called) > port.link.max_name:
            return None
        if (info.instance, info.node, called, info.role) in port.link.discovery.endpoints:
            return None  # it is on both links, and uses both
        return _Announced((management.Endpoint(info.role, info.instance, info.node, called, info.publisher_class),), 0)


def _is_same(before: _Fact | None, now: _Fact) -> bool:
    """Whether a fact is as it was, but for when it was heard."""
    if isinstance(before, _ModuleFact) and isinstance(now, _ModuleFact):
        return before == msgspec.structs.replace(
            now, info=msgspec.structs.replace(now.info, last_heard=before.info.last_heard)
        )
    return before == now


def _subject(message: Relayed) -> object:
    """Whom a message tells of."""
    match message:
        case management.Hello(_, instance):
            return instance
        case management.Endpoint(role, instance, node, topic):
            return role & ~ROLE_GONE, instance, node, topic
    return None


def _gone(message: Relayed) -> Relayed | None:
    match message:
        case management.Hello():
            return msgspec.structs.replace(message, flags=message.flags | management.HELLO_LEAVING)
        case management.Endpoint():
            return msgspec.structs.replace(message, role=message.role | ROLE_GONE)
    return None


# What modules are called on each link of a gateway with a prefix, so that an order reaches exactly one module.


logger = get_logger("r2p.bridge")


class ModuleNames:
    """`names` gives the modules that are known, with the link where each is foreign ("": it is the robot's), and
    `foreign` that link for one of them.
    """

    def __init__(self, policy: Policy, names: Callable[[], dict[str, str]], foreign: Callable[[str], str]) -> None:
        self._policy = policy
        self._names = names
        self._foreign = foreign
        self._doubted: set[str] = set()

    def meant(self, wire: str, link: str) -> str | None:
        """The module on the robot that an order on this link names; None: none of the robot's, or it is not clear."""
        prefix = self._policy.prefix(link)
        if not prefix:
            return wire
        found = [name for name, foreign in self._names().items() if not foreign and module_alias(prefix + name) == wire]
        if len(found) > 1:
            self._doubt(wire, prefix, found)
            return None
        if found:
            return found[0]
        return wire.removeprefix(prefix) if wire.startswith(prefix) else None

    def wire(self, name: str, link: str) -> str | None:
        """What an order for this module names on a link; None: it has no business there."""
        called = self.called(name, link)
        return None if called is None else module_alias(called)

    def called(self, name: str, link: str) -> str | None:
        """What the module is called on a link."""
        foreign = self._foreign(name)
        if foreign:
            return name if link == foreign or not self._policy.prefix(link) else None
        return self._policy.prefix(link) + name

    def same(self, name: str, link: str, other: str) -> str | None:
        """What a module that has this name on one link is called on another one; None: it is to be told from all that
        are there.
        """
        meant = self._policy.module_meant(name, link)
        return None if meant is None or meant[1] else self._policy.module_called(meant[0], other, foreign=False)

    def _doubt(self, wire: str, prefix: str, found: list[str]) -> None:
        if wire not in self._doubted and len(self._doubted) < _DOUBTED:
            self._doubted.add(wire)
            names = " and ".join(prefix + each for each in sorted(found))
            logger.error("%s have the same alias %s: orders reach neither; rename one", names, wire)


_DOUBTED = 100
"""Aliases of which it is logged that they mean two modules, at most."""
