"""Modules and nodes of one link, announced on the others: changes at once, the rest again and again.

A peer that is new on a link, or asks, gets all of it at once. r2p modules are passed on with one hop more, and taken
back when they are gone. Of firmware only what it sends itself is passed on, so that its age can be seen everywhere; it
does not answer, so a peer that asks gets what was heard lately.

`_facts` is what is known on each link, by key; where something has changed on a link, only that is compared, and
announced on the others. Links on which much comes and goes are looked at ROUNDS times a second. What is repeated is
spread over more time the more there is of it.
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
from r2p.protocols.discovery.announcer import Relayed
from r2p.protocols.discovery.directory import EndpointInfo
from r2p.protocols.discovery.events import ModuleInfo
from r2p.runtime.topic import TopicSpace
from r2p.transports.stats import RETRY_AFTER_ERROR, count_internal_error

ROUNDS = 5
"""Looks at what has changed in a second, at most."""

_SECOND = 1_000_000_000
_REPEAT = 1_500_000_000  # ns in which everything is repeated, if there is little of it
_REPEAT_MOST = 20_000_000_000  # ns; a HELLO is believed for 65 s at most
_REPEATED = 4_000  # messages a second that only repeat what is known
_SLICE = 250  # facts that are repeated at once
_SLICE_APART = 20_000_000  # ns between two of them
_REST = 10  # times as long as a look took before the next one: on a slow computer it must not take all the time
_SOON = 2_000_000  # ns; so that what comes together is looked at together
_APART = 200_000_000  # ns between two answers on one link
_LATELY = 2_000_000_000  # ns; an answer contains the firmware that was heard since
_Key = tuple[object, ...]


class _ModuleFact(msgspec.Struct, frozen=True):
    """A module as it is known on a link, by its canonical name; `foreign`: it is not the robot's."""

    name: str
    foreign: bool
    info: ModuleInfo

    @property
    def rank(self) -> tuple[bool, int]:
        """Of several links the one with the lowest rank is believed."""
        return self.foreign, self.info.hops


class _NodeFact(msgspec.Struct, frozen=True):
    """A publisher or subscriber as it is known on a link; `topic` is the canonical name."""

    topic: str
    info: EndpointInfo
    rank: tuple[bool, int] = (False, 0)


_Fact = _ModuleFact | _NodeFact


class _Announced(msgspec.Struct, frozen=True):
    """What was passed on of a fact, and when the module was heard."""

    messages: tuple[Relayed, ...]
    heard_at: int


class DirectoryRelay:
    """Announces on each link of the gateway `instance` what is known of modules and nodes on the others.

    `repeating` is called whenever something is repeated.
    """

    def __init__(
        self,
        instance: int,
        ports: dict[str, BridgePort],
        space: TopicSpace,
        policy: Policy,
        repeating: Callable[[], object],
    ) -> None:
        self._name = space.module
        self._instance = instance
        self._ports = ports
        self._clock = space.clock
        self._policy = policy
        self._repeating = repeating
        self._facts: dict[str, dict[_Key, _Fact]] = {}
        """By link, then by key."""
        self._sources: dict[_Key, dict[str, _Fact]] = {}
        """The same by key, then by link."""
        self._announced: dict[str, dict[_Key, _Announced]] = {}
        """What each link knows from this gateway."""
        self._alarm = Alarm(space.loop, self._poll, background=True)
        self._dirty: set[str] = set()
        self._joined: set[str] = set()
        """Links in the tree, which know all."""
        self._behind: set[str] = set()
        """Links that have to wait until the gateways agree, and lack what has changed meanwhile."""
        self._asked: set[str] = set()
        self._met: dict[str, set[int]] = {}
        """Instances that have got everything, by link."""
        self._answered_at: dict[str, int] = {}
        self._repeat_at: dict[str, int] = {}
        self._to_repeat: dict[str, deque[_Key]] = {}
        """What is yet to be repeated, by link."""
        self._answering: set[str] = set()
        """The links where that is an answer."""
        self._rounds: deque[int] = deque(maxlen=ROUNDS)
        self._next_round_at = 0
        self._repeated_at = 0

    def query(self, port: BridgePort) -> None:
        """A peer on the link wants to know everything."""
        self._asked.add(port.name)
        self._set_alarm(self._clock.monotonic())

    def changed(self, port: BridgePort) -> None:
        """A module or a node came or went there, or the link has another place in the tree."""
        self._dirty.add(port.name)
        self._set_alarm(self._clock.monotonic())

    def forget(self, port: BridgePort) -> None:
        """The link is gone."""
        for known in (self._announced, self._met, self._answered_at, self._repeat_at, self._to_repeat):
            known.pop(port.name, None)
        for links in (self._asked, self._behind, self._joined, self._answering):
            links.discard(port.name)
        self.changed(port)

    def close(self) -> None:
        """The gateway ends."""
        self._alarm.close()

    def own_modules(self) -> list[str]:
        """The canonical names of the robot's modules that are known."""
        names = (name for kind, name, *_ in self._sources if kind == "module")
        return [name for name in names if isinstance(name, str) and not self.foreign_link(name)]

    def foreign_link(self, name: str) -> str:
        """The link where the module of this name is foreign; "": it is the robot's, or not known."""
        facts = self._sources.get(("module", name))
        if facts is None:
            return ""
        link = min(facts, key=lambda each: facts[each].rank)
        return link if facts[link].rank[0] else ""

    # When

    def _set_alarm(self, now: int) -> None:
        dues = [now + _REPEAT, *self._repeat_at.values()]
        if self._dirty:
            dues.append(max(now + _SOON, self._next_round_at))
        if self._behind:
            dues.append(now + _APART)
        if self._to_repeat:
            dues.append(now + _SLICE_APART)
        dues += [max(now + _SOON, self._answered_at.get(name, -_APART) + _APART) for name in self._asked]
        self._alarm.set(min(dues))

    def _poll(self) -> None:
        now = self._clock.monotonic()
        try:
            self._do_due(now)
        except Exception as error:  # noqa: BLE001 - counted and logged
            count_internal_error((port.link.stats.lost for port in self._ports.values()), error)
            self._alarm.set(now + RETRY_AFTER_ERROR)
        else:
            self._set_alarm(now)

    def _do_due(self, now: int) -> None:
        may_catch_up = any(self._is_open(port, now) for port in self._ports.values() if port.name in self._behind)
        if (self._dirty or may_catch_up) and now >= self._next_round_at:
            self._rounds.append(now)
            self._look(now)
            took = self._clock.monotonic() - now
            oldest = self._rounds[0] + _SECOND if len(self._rounds) == ROUNDS else 0
            self._next_round_at = max(oldest, now + _REST * took)
        period = self._period()
        for port in list(self._ports.values()):
            if port.link.up and self._is_open(port, now):
                port.link.stats.lost.guard(self._repeat, port, now, period)
            else:
                self._put_off(port, now)
        if now >= self._repeated_at + _REPEAT:
            self._repeated_at = now
            self._repeating()

    def _repeat(self, port: BridgePort, now: int, period: int) -> None:
        """Repeat on a link what a peer asks for, or what was not announced for a while."""
        self._meet(port)
        if port.name in self._asked and now >= self._answered_at.get(port.name, -_APART) + _APART:
            self._asked.discard(port.name)
            self._answered_at[port.name] = now
            self._answering.add(port.name)
            self._to_repeat[port.name] = deque(self._announced.get(port.name, ()))
        if now >= self._repeat_at.setdefault(port.name, now + period):
            self._repeat_at[port.name] = now + period
            self._to_repeat.setdefault(port.name, deque(self._announced.get(port.name, ())))
        if port.name in self._to_repeat:
            self._repeat_slice(port, now)

    def _put_off(self, port: BridgePort, now: int) -> None:
        """Nothing can be announced there now: look again soon."""
        for when, gap in ((self._repeat_at, _APART), (self._answered_at, 0)):
            if port.name in when or port.name in self._asked:
                when[port.name] = max(when.get(port.name, 0), now + gap)

    def _period(self) -> int:
        """The time (ns) in which everything is repeated."""
        count = len(self._sources) * max(len(self._ports) - 1, 1)
        return min(max(_REPEAT, count * _SECOND // _REPEATED), _REPEAT_MOST)

    def _meet(self, port: BridgePort) -> None:
        """See whether a peer is new there, which is to get everything."""
        if port.name in self._met and port.name not in self._facts:
            return
        here = {info.instance for info in port.link.discovery.modules.values() if info.instance and not info.hops}
        if not here <= self._met.get(port.name, set()):
            self._asked.add(port.name)
        self._met[port.name] = here

    def _is_open(self, port: BridgePort, now: int) -> bool:
        """Whether it need not wait until the gateways agree."""
        return not port.in_tree or now < port.tree_port.forwards_until

    # What is there

    def _look(self, now: int) -> None:
        """See what has changed on the links, and announce it on the others."""
        dirty, behind = self._dirty | self._behind, self._behind
        self._dirty, self._behind = set(), set()
        changed: dict[_Key, None] = {}
        catch_up = [port for port in self._ports.values() if port.name in behind]
        for name in dirty:
            port = self._ports.get(name)
            if port is not None and port.link.up and not self._is_open(port, now):
                self._behind.add(name)  # what is known there holds until the gateways agree
                continue
            try:
                self._collect(name, port, changed)
            except Exception as error:  # noqa: BLE001 - counted and logged; it is read anew, and the next link follows
                count_internal_error((each.link.stats.lost for each in self._ports.values()), error)
                self._dirty.add(name)
                continue
            if port is not None and port.link.up and port.in_tree != (name in self._joined):
                catch_up.append(port)  # it has just joined the tree, or left it
                self._joined ^= {name}
        for port in self._ports.values():
            if port.link.up and self._is_open(port, now):
                announced = self._announced.get(port.name, ())
                keys: Iterable[_Key] = [*self._sources, *announced] if port in catch_up else changed
                for key in list(dict.fromkeys(keys)):
                    port.link.stats.lost.guard(self._announce, port, key)
            elif port.link.up:
                self._behind.add(port.name)

    def _collect(self, name: str, port: BridgePort | None, changed: dict[_Key, None]) -> None:
        """Read what is known on a link now, and enter the keys of what has changed."""
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
            module = self._policy.module_to_canonical(info.name, port.name)
            if module is None:
                hidden.add(info.instance)
            elif module[0] != self._name:  # of our name: our last start, which others still announce
                facts["module", module[0]] = _ModuleFact(*module, info)
        for endpoint in port.link.discovery.endpoints.values():
            topic = self._policy.to_canonical(endpoint.topic, port.name)
            if topic is not None and endpoint.instance != self._instance and endpoint.instance not in hidden:
                facts["endpoint", endpoint.instance, endpoint.node, topic, endpoint.role] = _NodeFact(topic, endpoint)
        return facts

    # What is announced

    def _repeat_slice(self, port: BridgePort, now: int) -> None:
        """Repeat a part of everything: what lives, and of firmware what was heard since, or as an answer lately."""
        keys, announced = self._to_repeat[port.name], self._announced.setdefault(port.name, {})
        answers = port.name in self._answering
        for key in [keys.popleft() for _ in range(min(len(keys), _SLICE))]:
            before = announced.get(key)
            new = None if before is None else self._announce(port, key)
            if before is None or new is None or new.messages != before.messages:
                continue  # it has just been announced
            announced[key] = new
            for message in new.messages:
                is_alive = isinstance(message, management.Alive)
                if not is_alive or new.heard_at > before.heard_at or (answers and now < new.heard_at + _LATELY):
                    self._send(port, message)
        if not keys:
            del self._to_repeat[port.name]
            self._answering.discard(port.name)

    def _announce(self, port: BridgePort, key: _Key) -> _Announced | None:
        """Announce on a link what has changed of a fact; gives back what is known there from now on."""
        announced = self._announced.setdefault(port.name, {})
        before = announced.get(key)
        new = self._desired(port, key) if port.in_tree else None
        if new is not None:
            for message in new.messages:
                if before is None or message not in before.messages:
                    self._send(port, message)
        if before is not None:
            kept = {_subject(message) for message in new.messages} if new is not None else set()
            for message in before.messages:
                gone = _withdrawal(message)
                if gone is not None and _subject(message) not in kept:
                    self._send(port, gone)
        if new is None:
            announced.pop(key, None)
        elif before is None or new.messages != before.messages:
            announced[key] = new
        return new

    def _send(self, port: BridgePort, message: Relayed) -> None:
        port.link.stats.lost.guard(port.link.relay, message)

    def _desired(self, port: BridgePort, key: _Key) -> _Announced | None:
        """What is to be known of a fact on this link; None: nothing."""
        sources = self._sources.get(key, {})
        names = [name for name in sources if name != port.name]
        if not names:
            return None
        name = min(names, key=lambda each: sources[each].rank)
        fact = sources[name]
        if isinstance(fact, _ModuleFact):
            return self._desired_module(fact, self._ports[name], port)
        return self._desired_node(fact, self._ports[name], port)

    def _desired_module(self, module: _ModuleFact, source: BridgePort, port: BridgePort) -> _Announced | None:
        info = source.link.discovery.modules.get(module.info.name, module.info)  # as it was heard last
        link_name = self._policy.module_to_link_name(module.name, port.name, foreign=module.foreign)
        if link_name is None or info.hops + 1 > MOST_HOPS:
            return None
        known = port.link.discovery.modules.get(link_name)
        if known is not None and known.instance == info.instance:
            return None  # it is on both links
        messages: list[Relayed] = []
        if info.r2p and info.instance is not None:
            flags = management.HELLO_TOOL if info.observer else 0
            lease = min(max(info.lease, 3 * self._period()) // 1_000_000, 0xFFFF)
            messages.append(management.Hello(link_name, info.instance, flags, info.hops + 1, lease))
        if not info.observer:
            messages.append(management.Alive(link_name, info.flags))
        return _Announced(tuple(messages), info.last_heard)

    def _desired_node(self, node: _NodeFact, source: BridgePort, port: BridgePort) -> _Announced | None:
        info = node.info
        publisher, subscriber = (source, port) if info.role == ROLE_PUBLISHES else (port, source)
        link_name = self._policy.to_link_name(node.topic, port.name)
        if not self._policy.allows(node.topic, publisher.name, subscriber.name) or len(link_name) > port.link.max_name:
            return None
        if (info.instance, info.node, link_name, info.role) in port.link.discovery.endpoints:
            return None  # it is on both links, and uses both
        endpoint = management.Endpoint(info.role, info.instance, info.node, link_name, info.publisher_class)
        return _Announced((endpoint,), 0)


def _is_same(before: _Fact | None, now: _Fact) -> bool:
    """Whether a fact is as it was, but for when it was heard."""
    if isinstance(before, _ModuleFact) and isinstance(now, _ModuleFact):
        info = msgspec.structs.replace(now.info, last_heard=before.info.last_heard)
        return before == msgspec.structs.replace(now, info=info)
    return before == now


def _subject(message: Relayed) -> object:
    """What a message is about."""
    match message:
        case management.Hello(_, instance):
            return instance
        case management.Endpoint(role, instance, node, topic):
            return role & ~ROLE_GONE, instance, node, topic
    return None


def _withdrawal(message: Relayed) -> Relayed | None:
    """The message that takes this one back; None: it just gets old."""
    match message:
        case management.Hello():
            return msgspec.structs.replace(message, flags=message.flags | management.HELLO_LEAVING)
        case management.Endpoint():
            return msgspec.structs.replace(message, role=message.role | ROLE_GONE)
    return None
