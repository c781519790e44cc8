"""The names on one link whose messages have short fields: the alias of each long name, and the name behind each alias.

All translation is here. The other parts of discovery, and everything above, know names only; `Outbox` calls `to_wire`
with each message that is sent, and `Discovery` calls `from_wire` with each one that is received. Names that fit their
fields pass unchanged.

An alias depends on the name alone, so a module knows those of its own names, and a received one proves itself: a
LONG_NAME can't rename anything but the one alias that follows from its name. An alias that was chosen has no such
proof, so only modules that have chosen it themselves believe it. If two long names have one alias, neither is believed:
a topic of this module with such a name is not carried by the link. A short name stays what it is, whatever is claimed;
that it is also an alias is reported, and both topics go on, as who uses an alias as a name most likely means its topic.
"""

import re
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import msgspec

from r2p.codecs import management
from r2p.codecs.management import KIND_NODE, KIND_TOPIC
from r2p.names import (
    CARRIED_MAX,
    MODULE_PATH_MAX,
    NODE,
    NODE_FIELD,
    NODE_MAX,
    TOPIC,
    TOPIC_FIELD,
    chosen_alias,
    fits_field,
    module_alias,
    node_alias,
    topic_alias,
)
from r2p.protocols.discovery.events import AliasConflict, AliasesDiffer, AliasEvent, AliasFreed
from r2p.protocols.timers import KeyedTimers
from r2p.units import SECOND

NAMES_MAX = 16_384
"""Names of others that are remembered, unless the link's URL says otherwise; the one that was learnt first is forgotten
for the next one.
"""

_UNFINISHED_MAX = 256
"""Incomplete names, of which some parts were received."""
_RIVAL_LEASE = 60 * SECOND
"""Ns for which another name of an alias counts: names are repeated in a third of that, also on slow links."""
_RIVALS_MAX = 256
"""Aliases with two names that are remembered."""

_VALID = {
    KIND_TOPIC: (re.compile(TOPIC), CARRIED_MAX, TOPIC_FIELD),
    KIND_NODE: (re.compile(NODE), NODE_MAX, NODE_FIELD),
}
"""Pattern, longest name, and the width of its field."""

_Key = tuple[int, str]
"""KIND_... and an alias."""
M = TypeVar("M", bound=msgspec.Struct)

_TOPICS = (("topic", KIND_TOPIC),)
_FIELDS: dict[type, tuple[tuple[str, int], ...]] = {
    management.Advertise: _TOPICS,
    management.SubscribeRequest: _TOPICS,
    management.SubscribeResponse: _TOPICS,
    management.TypeInfo: _TOPICS,
    management.Unsubscribe: _TOPICS,
    management.Endpoint: (*_TOPICS, ("node", KIND_NODE)),
}
"""The names of topics and nodes in messages, by field."""
_MODULE_FIELDS: dict[type, tuple[str, ...]] = {
    management.Hello: ("module",),
    management.Alive: ("module",),
    management.Stop: ("module",),
    management.Reboot: ("module",),
    management.Bootload: ("module",),
    management.Conflict: ("module",),
    management.Denied: ("gateway", "module"),
}


class Renamed(msgspec.Struct, frozen=True):
    """A change of the name under which an object is known: from its alias to the name behind it, or back."""

    kind: int
    old: str
    new: str


class LinkNames:
    """The names of topics and nodes on one link, and their aliases. `chosen` has the aliases of r2p.toml, by topic.

    Timers have the keys ("alias", KIND_..., alias). `emit` reports events for the link.
    """

    def __init__(self, chosen: Mapping[str, str] | None = None, timers: KeyedTimers | None = None) -> None:
        self.emit: Callable[[AliasEvent], None] = lambda _event: None
        self.counts: Counter[str] = Counter()
        """Counts of what was dropped, by reason."""
        self.most = NAMES_MAX
        """Names that are remembered."""
        self._renames: list[Renamed] = []
        self._chosen = chosen or {}
        self._timers = KeyedTimers() if timers is None else timers
        self._own: dict[_Key, str] = {}
        """The name of this module that has an alias; a short name is its own."""
        self._long: set[_Key] = set()
        """The aliases among those of `_own`: of names that are longer."""
        self._waiting: dict[_Key, dict[str, None]] = {}
        """Other names of this module with that alias, which the link does not carry."""
        self._learnt: dict[_Key, str] = {}
        self._rivals: dict[_Key, str] = {}
        """The other name of an alias with two."""
        self._parts: dict[_Key | tuple[int, int, int], dict[int, str]] = {}

    # Translation

    @property
    def has_aliases(self) -> bool:
        """Whether names in received messages may be aliases of longer ones."""
        return bool(self._long or self._learnt)

    def to_wire(self, message: M) -> M:
        """Return a message with the alias of each name that is too long for its field."""
        cls = type(message)
        changes: dict[str, Any] = {}
        for field, kind in _FIELDS.get(cls, ()):
            name: str = getattr(message, field)
            if len(name) > (TOPIC_FIELD if kind == KIND_TOPIC else NODE_FIELD):
                changes[field] = self.alias(kind, name)
        for field in _MODULE_FIELDS.get(cls, ()):
            name = getattr(message, field)
            if (alias := module_alias(name)) != name:
                changes[field] = alias
        if not changes:
            return message
        if isinstance(message, management.Hello):
            changes["flags"] = message.flags | management.HELLO_ALIAS
        return msgspec.structs.replace(message, **changes)

    def from_wire(self, message: M) -> M:
        """Return a message with the names of topics and nodes behind known aliases."""
        if not self.has_aliases:  # on most links: then each message costs no more than this
            return message
        changes: dict[str, Any] = {}
        for field, kind in _FIELDS.get(type(message), ()):
            alias: str = getattr(message, field)
            if (name := self.name(kind, alias)) != alias:
                changes[field] = name
        return msgspec.structs.replace(message, **changes) if changes else message

    def alias(self, kind: int, name: str) -> str:
        """Return what travels for a name: the name itself, or its alias."""
        return chosen_alias(name, self._chosen) if kind == KIND_TOPIC else node_alias(name)

    def name(self, kind: int, alias: str) -> str:
        """Return the name behind an alias; the alias itself if it is a name, or its name is not known for certain."""
        key = kind, alias
        own = self._own.get(key)
        if own is not None:
            return own
        return alias if key in self._rivals else self._learnt.get(key, alias)

    def text(self, kind: int, name: str) -> str:
        """Return the text of the LONG_NAME that announces a name of this module."""
        alias = self.alias(kind, name)
        default = topic_alias(name) if kind == KIND_TOPIC else node_alias(name)
        return name if alias == default else f"{alias}={name}"

    # This module's names

    def claim(self, kind: int, name: str) -> None:
        """Use a name on this link. A short name always gets its place, of two others the first one."""
        key = kind, self.alias(kind, name)
        owner = self._own.get(key)
        if owner == name:
            return
        if owner is None or name == key[1]:
            self._give(key, name)
            loser, winner = owner, name
        else:
            loser, winner = name, owner
        if loser is not None and loser not in self._waiting.get(key, {}):
            self._waiting.setdefault(key, {})[loser] = None
            self.emit(AliasConflict(*key, winner, loser, loser if kind == KIND_TOPIC else ""))

    def release(self, kind: int, name: str) -> None:
        """Stop using a name, whose alias another one may have then."""
        key = kind, self.alias(kind, name)
        self._drop_waiting(key, name)
        if self._own.get(key) != name:
            return
        del self._own[key]
        self._long.discard(key)
        heir = next(iter(self._waiting.get(key, ())), None)
        if heir is not None:
            self._give(key, heir)
            self.emit(AliasFreed(heir))

    def owns(self, topic: str) -> bool:
        """Return whether this module uses the topic, and no other topic of its own has the alias."""
        return self._own.get((KIND_TOPIC, self.alias(KIND_TOPIC, topic))) == topic

    def rival(self, topic: str) -> str:
        """Return another name with the alias of this topic, which the link can't carry then; empty without one."""
        key = KIND_TOPIC, self.alias(KIND_TOPIC, topic)
        owner = self._own.get(key, topic)
        if owner != topic:
            return owner
        rival = self._rivals.get(key, "")
        return "" if key[1] in (topic, rival) else rival

    def topics(self, alias: str) -> set[str]:
        """Return the names of topics that are known to have this alias, or to be it; of several none is believed."""
        key = KIND_TOPIC, alias
        known = {self._own.get(key, ""), self._learnt.get(key, ""), self._rivals.get(key, "")}
        return (known | self._waiting.get(key, {}).keys()) - {""}

    def _give(self, key: _Key, name: str) -> None:
        """Give an alias to a name of this module."""
        self._own[key] = name
        if name == key[1]:
            self._long.discard(key)
        else:
            self._long.add(key)
        self._drop_waiting(key, name)

    def _drop_waiting(self, key: _Key, name: str) -> None:
        waiting = self._waiting.get(key, {})
        waiting.pop(name, None)
        if not waiting:
            self._waiting.pop(key, None)

    # Names of others

    def receive(self, now: int, message: management.LongName) -> str:
        """Read a part of a name. Return a short topic of this module that is the alias of another name: it has to be
        announced, so that both modules learn of each other; else an empty string.
        """
        if message.kind not in _VALID:
            self.counts["unknown type"] += 1
            return ""
        text = self._assemble(message)
        if text is None:
            return ""
        alias, chosen, name = text.rpartition("=")
        pattern, longest, field = _VALID[message.kind]
        valid = len(name) <= longest and pattern.fullmatch(name) is not None
        valid = valid and management.long_name_number(text) == message.number
        if not valid or (chosen and not (message.kind == KIND_TOPIC and fits_field(alias) and len(name) > field)):
            self.counts["impossible name"] += 1
            return ""
        if not chosen:
            alias = topic_alias(name) if message.kind == KIND_TOPIC else node_alias(name)
        return self._heard(now, (message.kind, alias), name, chosen=bool(chosen))

    def expired(self, kind: int, alias: str) -> None:
        """Forget that an alias has a second name, which was not announced for a while."""
        key = kind, alias
        self._rivals.pop(key, None)
        self._learnt.pop(key, None)
        if kind == KIND_TOPIC and key in self._own:
            self.emit(AliasFreed(self._own[key]))

    def pop_renames(self) -> list[Renamed]:
        """Return the changes for what is known of others, since the last call."""
        renames, self._renames = self._renames, []
        return renames

    def _assemble(self, message: management.LongName) -> str | None:
        """Enter a part of a text; return the text if it is complete."""
        number, last = management.split_part(message.part)
        key = message.kind, message.number, last
        parts = self._parts.setdefault(key, {})
        parts[number] = message.piece
        if not set(range(last + 1)) <= parts.keys():
            _bound(self._parts, _UNFINISHED_MAX)
            return None
        del self._parts[key]
        return "".join(parts[each] for each in range(last + 1))

    def _heard(self, now: int, key: _Key, name: str, *, chosen: bool) -> str:
        """Handle a valid name of another module."""
        kind, alias = key
        own, ours = self._own.get(key), self.alias(kind, name)
        if own == name:
            if name != alias and not chosen and key not in self._learnt:  # it is also theirs, once this module ends it
                self._learn(now, key, name)
            return ""
        if own == alias:  # a short name of this module's own stays what it is
            self._contest(now, key, own, name)
            return own if kind == KIND_TOPIC else ""
        if own is not None:
            self._contest(now, key, own, name, refused=own if kind == KIND_TOPIC and name != alias else "")
        elif ours != alias and self._own.get((kind, ours)) == name:
            self.emit(AliasesDiffer(name, ours, alias))
        elif not chosen:
            self._learn(now, key, name)
        return ""

    def _learn(self, now: int, key: _Key, name: str) -> None:
        kind, alias = key
        known = self._learnt.get(key)
        if known is None:
            self._learnt[key] = name
            _bound(self._learnt, self.most, self.counts)
            self._rename(kind, alias, name)
        elif known == name:
            return
        elif alias in (known, name):  # one of them is a short name, which stays what it is
            self._learnt[key] = alias
            self._rename(kind, known, alias)
            self._contest(now, key, alias, known if name == alias else name)
        else:
            self._rename(kind, known, alias)
            self._contest(now, key, known, name)

    def _rename(self, kind: int, old: str, new: str) -> None:
        if old != new:
            self._renames.append(Renamed(kind, old, new))

    def _contest(self, now: int, key: _Key, name: str, rival: str, *, refused: str = "") -> None:
        """Note that an alias has two names, and report it once."""
        is_new = key not in self._rivals
        if is_new and len(self._rivals) >= _RIVALS_MAX:
            oldest = next(iter(self._rivals))
            self._timers.clear(("alias", *oldest))
            self.expired(*oldest)
        if is_new or (refused and self._rivals[key] == key[1]):  # a second long name is worse than a short one
            self._rivals[key] = rival
            self.emit(AliasConflict(*key, name, rival, refused))
        self._timers.set(("alias", *key), now + _RIVAL_LEASE)


class ModuleAliases:
    """The names of modules that are too long for a message: an alias travels, which NAME explains."""

    def __init__(self, module: str, counts: Counter[str]) -> None:
        """`module` is the name of this module; `counts` get what was dropped."""
        self.most = NAMES_MAX
        """Names that are remembered."""
        self._counts = counts
        self._module = module
        self._alias = module_alias(module)
        self._names: dict[str, str] = {}
        self._others: dict[str, str] = {}
        """The last other name of each alias with two."""
        self._parts: dict[str, dict[int, str]] = {}

    def name_of(self, alias: str) -> str:
        """Return the name; the alias itself if it is a name, or its name is unknown."""
        return self._module if alias == self._alias else self._names.get(alias, alias)

    def receive(self, message: management.Name) -> str | None:
        """Read a part of a name; return the name if it is complete now, and not known yet.

        It is not entered if the alias has another name: see `other_name`.
        """
        parts = self._parts.setdefault(message.alias, {})
        number, last = management.split_part(message.part)
        parts[number] = message.piece
        if not set(range(last + 1)) <= parts.keys():
            _bound(self._parts, _UNFINISHED_MAX)
            return None
        del self._parts[message.alias]
        name = "".join(parts[each] for each in range(last + 1))
        if len(name) > MODULE_PATH_MAX or module_alias(name) != message.alias:
            return None
        known = self.name_of(message.alias)
        if known == message.alias != self._alias:
            self._names[message.alias] = name
            _bound(self._names, self.most, self._counts)
        elif known != name:
            self._others[message.alias] = name
            _bound(self._others, _RIVALS_MAX)
        return None if known == name else name

    def other_name(self, name: str) -> str:
        """Return another name that has the same alias; empty without one."""
        alias = module_alias(name)
        known = self.name_of(alias)
        return self._others.get(alias, "") if known in (name, alias) else known


def _bound(table: dict[Any, Any], most: int, counts: Counter[str] | None = None) -> None:
    while len(table) > most:
        del table[next(iter(table))]
        if counts is not None:
            counts["names forgotten"] += 1
