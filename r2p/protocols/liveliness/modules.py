"""The modules on a network with liveliness tokens, and their nodes, worked out from the tokens."""

from collections import Counter

import msgspec

from r2p.codecs.liveliness import ModuleToken, SoftwareToken, TopicToken
from r2p.protocols.discovery.directory import FOR_EVER, TABLE_MAX, EndpointInfo, EndpointKey, decrement
from r2p.protocols.discovery.events import ModuleChanged, ModuleGone, ModuleInfo, NameConflict, Outbox
from r2p.units import SECOND

_CONFLICT_AFTER = 3 * SECOND // 2
"""Ns for which two modules must share a name: the token of a hanging one may live for a second."""


class ModuleRegistry:
    """The other modules on the network of module `module`, run `instance`. Changes go to `outbox`. It keeps TABLE_MAX
    modules; of others only the name, to show them when there is room.
    """

    def __init__(self, module: str, instance: int, outbox: Outbox, counts: Counter[str]) -> None:
        self.modules: dict[str, ModuleInfo] = {}
        self.endpoints: dict[EndpointKey, EndpointInfo] = {}
        self.generation = 0
        self._module = module
        self._instance = instance
        self._outbox = outbox
        self._counts = counts
        self._tokens: dict[str, dict[str, ModuleToken]] = {}  # by name and key
        self._software: dict[int, dict[str, SoftwareToken]] = {}  # by instance and key
        self._more_tokens: Counter[EndpointKey] = Counter()
        """How many tokens more than one declare an endpoint, of those that several do."""
        self._names: dict[int, str] = {}  # by instance
        self._endpoints_of: dict[int, dict[EndpointKey, None]] = {}  # by instance
        self._conflict_at: dict[str, int] = {}  # names with several modules, and when that is reported
        self._without_room: dict[str, None] = {}
        """Names with tokens that are not among the modules."""

    # Tokens

    def module_appeared(self, now: int, key: str, token: ModuleToken) -> None:
        self._tokens.setdefault(token.name, {})[key] = token
        self._update(now, token.name)

    def module_disappeared(self, now: int, key: str, token: ModuleToken) -> None:
        named = self._tokens[token.name]
        del named[key]
        if not named:
            del self._tokens[token.name]
        self._update(now, token.name)

    def software_appeared(self, now: int, key: str, token: SoftwareToken) -> None:
        self._software.setdefault(token.instance, {})[key] = token
        self._update_software(now, token.instance)

    def software_disappeared(self, now: int, key: str, token: SoftwareToken) -> None:
        tokens = self._software[token.instance]
        del tokens[key]
        if not tokens:
            del self._software[token.instance]
        self._update_software(now, token.instance)

    def endpoint_appeared(self, token: TopicToken) -> None:
        key = _endpoint_key(token)
        if key is None or token.instance == self._instance:
            return
        if key in self.endpoints:
            self._more_tokens[key] += 1
        else:
            self._endpoints_of.setdefault(key[0], {})[key] = None
        name = self._names.get(key[0], "")
        self.endpoints[key] = EndpointInfo(name, *key, token.publisher_class)
        self.generation += 1

    def endpoint_disappeared(self, token: TopicToken) -> None:
        """Remove the token's endpoint, unless another token declares it as well, such as after a change of class."""
        key = _endpoint_key(token)
        if key is None or key not in self.endpoints:
            return
        if key in self._more_tokens:
            decrement(self._more_tokens, key)
        else:
            del self.endpoints[key]
            self._forget_endpoint(key)
            self.generation += 1

    # Without tokens

    def add_firmware(self, info: ModuleInfo) -> None:
        """Enter a module without a token of its own, which a gateway announces."""
        if info.name != self._module and info.name not in self._tokens:
            self._keep(self.modules.get(info.name), info)

    def mark_heard(self, now: int) -> None:
        """Mark everything with a token as heard now."""
        for name in self._tokens:
            info = self.modules.get(name)
            if info is not None and info.r2p:
                self.modules[name] = msgspec.structs.replace(info, last_heard=now)

    def clear(self) -> None:
        """Forget the modules without a token."""
        for info in list(self.modules.values()):
            self._remove(info)

    # Deadlines

    def next_deadline(self) -> int | None:
        """Return when to call `poll` (monotonic ns); a time in the past means at once."""
        if self._without_room and len(self.modules) < TABLE_MAX:
            return 0
        return min(self._conflict_at.values(), default=None)

    def poll(self, now: int) -> None:
        """Show modules with room now, and report two modules that have shared a name for long enough."""
        while self._without_room and len(self.modules) < TABLE_MAX:
            self._update(now, next(iter(self._without_room)))
        for name in [name for name, due in self._conflict_at.items() if due <= now]:
            del self._conflict_at[name]
            instances = [each.instance for each in self._tokens.get(name, {}).values()]
            if name == self._module:
                instances.insert(0, self._instance)
            one, other, *_ = dict.fromkeys(instances)
            self._outbox.emit(NameConflict(name, one, other))

    def _update(self, now: int, name: str) -> None:
        """Make the nearest and latest of a name's tokens the module, as they have changed."""
        tokens = [each for each in self._tokens.get(name, {}).values() if each.instance != self._instance]
        before = self.modules.get(name)
        self._without_room.pop(name, None)
        if not tokens:
            self._conflict_at.pop(name, None)
            if before is not None:
                self._remove(before)
            return
        nearest = min(reversed(tokens), key=lambda each: each.hops)
        self._keep(before, self._info(nearest, now))
        own = {self._instance} if name == self._module else set()
        if len({each.instance for each in tokens} | own) > 1:
            self._conflict_at.setdefault(name, now + _CONFLICT_AFTER)
        else:
            self._conflict_at.pop(name, None)

    def _update_software(self, now: int, instance: int) -> None:
        """The versions of a module have changed; those of one without a token of its own wait for that."""
        name = self._names.get(instance)
        if name in self._tokens:
            self._update(now, name)

    def _info(self, token: ModuleToken, now: int) -> ModuleInfo:
        info = _info(token, now)
        found = self._software.get(token.instance, {}) if token.instance is not None else {}
        software = next(iter(found.values()), None)
        if software is None:
            return info
        return msgspec.structs.replace(info, wire=software.wire, release=software.release)

    def _keep(self, before: ModuleInfo | None, info: ModuleInfo) -> None:
        if before is None and len(self.modules) >= TABLE_MAX:
            self._counts["modules forgotten"] += 1
            if info.name in self._tokens:  # firmware is announced again, a token is not
                self._without_room[info.name] = None
            return
        self.modules[info.name] = info
        if before is not None and before.instance is not None and before.instance != info.instance:
            self._names.pop(before.instance, None)
        if info.instance is not None:
            self._names[info.instance] = info.name
        if before is None or before.differs(info):
            self.generation += 1
            self._outbox.emit(ModuleChanged(info))
        for key in () if info.instance is None else self._endpoints_of.get(info.instance, ()):
            endpoint = self.endpoints[key]
            if endpoint.module != info.name:
                self.endpoints[key] = msgspec.structs.replace(endpoint, module=info.name)

    def _forget_endpoint(self, key: EndpointKey) -> None:
        siblings = self._endpoints_of[key[0]]
        del siblings[key]
        if not siblings:
            del self._endpoints_of[key[0]]

    def _remove(self, info: ModuleInfo) -> None:
        del self.modules[info.name]
        if info.instance is not None:
            self._names.pop(info.instance, None)
        self.generation += 1
        self._outbox.emit(ModuleGone(info))


def _info(token: ModuleToken, now: int) -> ModuleInfo:
    lease = FOR_EVER if token.instance is not None else 0
    return ModuleInfo(token.name, token.flags, now, token.instance, token.observer, lease, token.hops, token.session)


def _endpoint_key(token: TopicToken) -> EndpointKey | None:
    if not token.node or token.instance is None:
        return None
    return token.instance, token.node, token.topic, token.role
