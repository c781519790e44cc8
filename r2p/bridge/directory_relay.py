"""Modules and nodes of one link, announced on the others: changes at once, the rest again and again.

A peer that is new on a link, or asks, gets all of it at once. r2p modules are passed on with one hop more, and taken
back when they are gone. Of firmware only what it sends itself is passed on, so that its age can be seen everywhere; it
does not answer, so a peer that asks gets what was heard lately.

`facts` are what is known on each link, by key; where something has changed on a link, only that is compared, and
announced on the others. Links on which much comes and goes are looked at ROUNDS times a second. What is repeated is
spread over more time the more there is of it.
"""

from collections import deque
from collections.abc import Callable, Iterable

import msgspec

from r2p.bridge.forwarding import HOPS_MAX, BridgePort
from r2p.bridge.options import Policy
from r2p.clock import Alarm
from r2p.codecs import management
from r2p.codecs.management import ROLE_GONE, ROLE_PUBLISHES
from r2p.names import module_alias
from r2p.protocols.discovery.announcer import Relayed
from r2p.protocols.discovery.directory import EndpointInfo
from r2p.protocols.discovery.events import ModuleInfo
from r2p.runtime.topic import TopicSpace
from r2p.transports.stats import RETRY_AFTER_ERROR, count_internal_error
from r2p.units import LONG_AGO, MILLISECOND, SECOND

ROUNDS = 5
"""Rounds of looking for changes in a second, at most."""

_REPEAT = 3 * SECOND // 2  # ns in which everything is repeated, if there is little of it
_REPEAT_MAX = 20 * SECOND  # ns; a HELLO is believed for 65 s at most
_REPEATED = 4_000  # messages a second that only repeat what is known
_SLICE = 250  # facts that are repeated at once
_SLICE_APART = 20 * MILLISECOND  # ns between two of them
_REST = 10  # times as long as a look took before the next one: on a slow computer it must not take all the time
_SOON = 2 * MILLISECOND  # ns; so that simultaneous changes are handled together
_APART = 200 * MILLISECOND  # ns between two answers on one link at least
_LATELY = 2 * SECOND  # ns; an answer contains the firmware that was heard since
_Key = tuple[object, ...]


class _ModuleFact(msgspec.Struct, frozen=True):
    """A module as it is known on a link, by its canonical name; `foreign`: it is not the robot's. The time of its last
    message is left out, as it always changes.
    """

    name: str
    foreign: bool
    info: ModuleInfo

    @property
    def rank(self) -> tuple[bool, int]:
        """Return the link's rank: of several links, the lowest is believed."""
        return self.foreign, self.info.hops


class _NodeFact(msgspec.Struct, frozen=True):
    """A publisher or subscriber as it is known on a link; `topic` is the canonical name."""

    topic: str
    info: EndpointInfo
    rank: tuple[bool, int] = (False, 0)


_Fact = _ModuleFact | _NodeFact


class _Announced(msgspec.Struct, frozen=True):
    """The part of a fact that was passed on, and when the module was heard."""

    messages: tuple[Relayed, ...]
    heard_at: int


class _LinkDirectory(msgspec.Struct, eq=False):
    """Facts known and announced on one link; instants in monotonic ns, None before the first.

    `dirty`: the facts may have changed. `joined`: it is in the tree, and knows all. `behind`: it has to wait until the
    gateways agree, and lacks what has changed meanwhile. `met` are the instances there that have got everything, or
    will. `asked`: a peer wants everything; `to_repeat` are the keys of what is yet to be repeated, to answer that if it
    is `answering`.
    """

    facts: dict[_Key, _Fact] = {}
    announced: dict[_Key, _Announced] = {}
    dirty: bool = False
    joined: bool = False
    behind: bool = False
    met: set[int] | None = None
    asked: bool = False
    answered_at: int = LONG_AGO
    repeat_at: int | None = None
    to_repeat: deque[_Key] | None = None
    answering: bool = False


class DirectoryRelay:
    """Announces on each link of the gateway `instance` the modules and nodes that are known on its others.

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
        self._links: dict[str, _LinkDirectory] = {}
        self._sources: dict[_Key, dict[str, _Fact]] = {}
        """All facts by key, then by link."""
        self._by_alias: dict[str, dict[str, None]] = {}
        """The canonical names of modules that travel as an alias, by alias."""
        self._alarm = Alarm(space.loop, self._poll, background=True)
        self._rounds: deque[int] = deque(maxlen=ROUNDS)
        self._next_round_at = 0
        self._repeated_at = 0

    def query(self, port: BridgePort) -> None:
        """Announce everything on the link, as a peer there asks for it."""
        self._link(port).asked = True
        self._set_alarm(self._clock.monotonic())

    def changed(self, port: BridgePort) -> None:
        """Check a link after a change of its modules or nodes, or of its place in the tree."""
        link = self._link(port)
        if not link.dirty:  # else the alarm is set: many changes at once must not cost as many looks at all links
            link.dirty = True
            self._set_alarm(self._clock.monotonic())

    def forget(self, port: BridgePort) -> None:
        """Forget what was announced on a link that is down or gone; its facts go when it is looked at next."""
        self._links[port.name] = _LinkDirectory(self._link(port).facts, dirty=True)
        self._set_alarm(self._clock.monotonic())

    def close(self) -> None:
        """Stop, as the gateway ends."""
        self._alarm.close()

    def _link(self, port: BridgePort) -> _LinkDirectory:
        link = self._links.get(port.name)
        if link is None:
            link = self._links[port.name] = _LinkDirectory()
        return link

    def own_modules(self) -> list[str]:
        """The canonical names of the robot's known modules."""
        names = (name for kind, name, *_ in self._sources if kind == "module")
        return [name for name in names if isinstance(name, str) and not self.foreign_link(name)]

    def foreign_link(self, name: str) -> str:
        """Return the link where the module of this name is foreign; "": it is the robot's, or unknown."""
        facts = self._sources.get(("module", name))
        if facts is None:
            return ""
        link = min(facts, key=lambda each: facts[each].rank)
        return link if facts[link].rank[0] else ""

    def modules_behind(self, alias: str) -> list[str]:
        """Return the canonical names of known modules that have this alias, and are longer."""
        return list(self._by_alias.get(alias, ()))

    # When

    def _set_alarm(self, now: int) -> None:
        due = now + _REPEAT
        for link in self._links.values():
            if link.repeat_at is not None:
                due = min(due, link.repeat_at)
            if link.dirty:
                due = min(due, max(now + _SOON, self._next_round_at))
            if link.behind:
                due = min(due, now + _APART)
            if link.to_repeat is not None:
                due = min(due, now + _SLICE_APART)
            if link.asked:
                due = min(due, max(now + _SOON, link.answered_at + _APART))
        self._alarm.set(due)

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
        is_dirty = any(each.dirty for each in self._links.values())
        may_catch_up = any(self._link(port).behind and self._is_open(port, now) for port in self._ports.values())
        if (is_dirty or may_catch_up) and now >= self._next_round_at:
            self._rounds.append(now)
            self._look(now)
            took = self._clock.monotonic() - now
            oldest = self._rounds[0] + SECOND if len(self._rounds) == ROUNDS else 0
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
        """Repeat announcements on a link, because a peer asks for them, or after a while."""
        self._meet(port)
        link = self._link(port)
        if link.asked and now >= link.answered_at + _APART:
            link.asked, link.answering, link.answered_at = False, True, now
            self._begin_repetition(link, now)
        if link.repeat_at is None or now >= link.repeat_at:
            if link.repeat_at is not None and link.to_repeat is None:
                self._begin_repetition(link, now)
            link.repeat_at = now + period
        if link.to_repeat is not None:
            self._repeat_slice(port, link, link.to_repeat, now)

    def _begin_repetition(self, link: _LinkDirectory, now: int) -> None:
        link.to_repeat = deque(link.announced)
        for port in self._ports.values():
            port.link.discovery.refresh_ages(now)

    def _put_off(self, port: BridgePort, now: int) -> None:
        """Look again soon, because that link can't announce now."""
        link = self._link(port)
        if link.repeat_at is not None or link.asked:
            link.repeat_at = max(link.repeat_at or 0, now + _APART)
        if link.answered_at > LONG_AGO or link.asked:
            link.answered_at = now

    def _period(self) -> int:
        """The time (ns) in which everything is repeated."""
        count = len(self._sources) * max(len(self._ports) - 1, 1)
        return min(max(_REPEAT, count * SECOND // _REPEATED), _REPEAT_MAX)

    def _meet(self, port: BridgePort) -> None:
        """Check for a new peer on the link, which is to get everything."""
        link = self._link(port)
        if link.met is not None and not link.facts:
            return
        here = {info.instance for info in port.link.discovery.modules.values() if info.instance and not info.hops}
        if not here <= (link.met or set()):
            link.asked = True
        link.met = here

    def _is_open(self, port: BridgePort, now: int) -> bool:
        """Return whether the relay need not wait until the gateways agree."""
        return not port.in_tree or now < port.tree_port.forwards_until

    # What is known

    def _look(self, now: int) -> None:
        """Find changes on the links, and announce them on the others."""
        catch_up = {name for name, link in self._links.items() if link.behind}
        changed: dict[_Key, None] = {}
        for name, link in list(self._links.items()):
            if link.dirty or link.behind:
                link.dirty = link.behind = False
                try:
                    if self._look_at(name, link, now, changed):
                        catch_up.add(name)
                except Exception as error:  # noqa: BLE001 - counted and logged; it is read anew, after the next link
                    count_internal_error((each.link.stats.lost for each in self._ports.values()), error)
                    link.dirty = True
        for port in self._ports.values():
            link = self._link(port)
            if port.link.up and self._is_open(port, now):
                keys: Iterable[_Key] = [*self._sources, *link.announced] if port.name in catch_up else changed
                for key in list(dict.fromkeys(keys)):
                    port.link.stats.lost.guard(self._announce, port, key)
            elif port.link.up:
                link.behind = True

    def _look_at(self, name: str, link: _LinkDirectory, now: int, changed: dict[_Key, None]) -> bool:
        """Find changes on a link; return True if it has just joined the tree, or left it."""
        port = self._ports.get(name)
        if port is not None and port.link.up and not self._is_open(port, now):
            link.behind = True  # what is known there holds until the gateways agree
            return False
        self._collect(name, link, port, changed)
        if port is None:
            del self._links[name]
        if port is None or not port.link.up or port.in_tree == link.joined:
            return False
        link.joined = port.in_tree
        return True

    def _collect(self, name: str, link: _LinkDirectory, port: BridgePort | None, changed: dict[_Key, None]) -> None:
        """Read the present facts of a link, and enter the keys of changes."""
        before = link.facts
        link.facts = {} if port is None or not port.link.up or not port.in_tree else self._facts_of(port)
        for key in before.keys() - link.facts.keys():
            changed[key] = None
            self._sources[key].pop(name)
            if not self._sources[key]:
                del self._sources[key]
                self._index_alias(key, known=False)
        for key, fact in link.facts.items():
            if before.get(key) != fact:
                changed[key] = None
            if key not in self._sources:
                self._sources[key] = {}
                self._index_alias(key, known=True)
            self._sources[key][name] = fact

    def _index_alias(self, key: _Key, *, known: bool) -> None:
        """Enter the alias of a module that is known now, or remove it."""
        kind, name, *_ = key
        if kind != "module" or not isinstance(name, str) or (alias := module_alias(name)) == name:
            return
        if known:
            self._by_alias.setdefault(alias, {})[name] = None
        else:
            names = self._by_alias[alias]
            del names[name]
            if not names:
                del self._by_alias[alias]

    def _facts_of(self, port: BridgePort) -> dict[_Key, _Fact]:
        facts: dict[_Key, _Fact] = {}
        hidden: set[int | None] = set()
        for info in port.link.discovery.modules.values():
            module = self._policy.module_to_canonical(info.name, port.name)
            if module is None:
                hidden.add(info.instance)
            elif module[0] != self._name:  # else it is this module's last start, which others still announce
                facts["module", module[0]] = _ModuleFact(*module, msgspec.structs.replace(info, last_heard=0))
        for endpoint in port.link.discovery.endpoints.values():
            topic = self._policy.to_canonical(endpoint.topic, port.name)
            if topic is not None and endpoint.instance != self._instance and endpoint.instance not in hidden:
                facts["endpoint", endpoint.instance, endpoint.node, topic, endpoint.role] = _NodeFact(topic, endpoint)
        return facts

    # What is announced

    def _repeat_slice(self, port: BridgePort, link: _LinkDirectory, keys: deque[_Key], now: int) -> None:
        """Repeat a part of everything: what lives, and of firmware what was heard since, or as an answer lately."""
        for key in [keys.popleft() for _ in range(min(len(keys), _SLICE))]:
            before = link.announced.get(key)
            new = None if before is None else self._announce(port, key)
            if before is None or new is None or new.messages != before.messages:
                continue  # it has just been announced
            link.announced[key] = new
            for message in new.messages:
                is_alive = isinstance(message, management.Alive)
                was_heard = new.heard_at > before.heard_at or (link.answering and now < new.heard_at + _LATELY)
                if not is_alive or was_heard:
                    self._send(port, message)
        if not keys:
            link.to_repeat, link.answering = None, False

    def _announce(self, port: BridgePort, key: _Key) -> _Announced | None:
        """Announce the change of a fact on a link; return the fact as known there from now on."""
        announced = self._link(port).announced
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
        """Return the part of a fact that others on this link are to know, if any."""
        sources = self._sources.get(key, {})
        # A link that is gone keeps its facts here until it is looked at, which may come after a repetition.
        names = [name for name in sources if name != port.name and name in self._ports]
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
        if link_name is None or info.hops + 1 > HOPS_MAX:
            return None
        known = port.link.discovery.modules.get(link_name)
        if known is not None and known.instance == info.instance:
            return None  # it is on both links
        messages: list[Relayed] = []
        if info.r2p and info.instance is not None:
            flags = management.HELLO_TOOL if info.observer else 0
            lease = min(max(info.lease, 3 * self._period()) // MILLISECOND, management.LEASE_MS_MAX)
            hello = management.Hello(link_name, info.instance, flags, info.hops + 1, lease, info.wire, info.release)
            messages.append(hello)
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


def _subject(message: Relayed) -> object:
    """Return the subject of a message."""
    match message:
        case management.Hello(_, instance):
            return instance
        case management.Endpoint(role, instance, node, topic):
            return role & ~ROLE_GONE, instance, node, topic
    return None


def _withdrawal(message: Relayed) -> Relayed | None:
    """Return the message that revokes this one; None for one that just gets old."""
    match message:
        case management.Hello():
            return msgspec.structs.replace(message, flags=message.flags | management.HELLO_LEAVING)
        case management.Endpoint():
            return msgspec.structs.replace(message, role=message.role | ROLE_GONE)
    return None
