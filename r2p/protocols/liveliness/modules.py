"""Who lives on a network with liveliness tokens: the modules and their nodes, worked out from the tokens there are."""

from collections import Counter

import msgspec

from r2p.codecs.liveliness import ModuleToken, TopicToken
from r2p.protocols.discovery.directory import FOR_EVER, MOST, EndpointInfo, EndpointKey
from r2p.protocols.discovery.events import Event, ModuleChanged, ModuleGone, ModuleInfo, NameConflict

_NAMESAKE = 1_500_000_000
"""Ns for which two modules of one name must be there: the token of one that has hung may live for a second."""


class ModuleRegistry:
    """The others on the network of module `module`, run `instance`. What has changed is added to `events`."""

    def __init__(self, module: str, instance: int, events: list[Event], counts: Counter[str]) -> None:
        self.modules: dict[str, ModuleInfo] = {}
        self.endpoints: dict[EndpointKey, EndpointInfo] = {}
        self.generation = 0
        self._module = module
        self._instance = instance
        self._events = events
        self._counts = counts
        self._named: dict[str, dict[str, ModuleToken]] = {}
        self._told: Counter[EndpointKey] = Counter()
        self._names: dict[int, str] = {}  # by instance
        self._endpoints_of: dict[int, dict[EndpointKey, None]] = {}  # by instance
        self._suspected: dict[str, int] = {}
        self._hidden: dict[str, None] = {}  # names with tokens for which there is no room among the modules

    # Tokens

    def module_appeared(self, now: int, key: str, token: ModuleToken) -> None:
        self._named.setdefault(token.name, {})[key] = token
        self._review(now, token.name)

    def module_disappeared(self, now: int, key: str, token: ModuleToken) -> None:
        named = self._named[token.name]
        del named[key]
        if not named:
            del self._named[token.name]
        self._review(now, token.name)

    def endpoint_appeared(self, token: TopicToken) -> None:
        key = _endpoint_key(token)
        if key is None or token.instance == self._instance:
            return
        self._told[key] += 1
        self._endpoints_of.setdefault(key[0], {})[key] = None
        name = self._names.get(key[0], "")
        self.endpoints[key] = EndpointInfo(name, *key, token.publisher_class)
        self.generation += 1

    def endpoint_disappeared(self, token: TopicToken) -> None:
        """Unless another token tells of it, as when its class has changed."""
        key = _endpoint_key(token)
        if key is not None and key in self._told:
            self._told[key] -= 1
            if not self._told[key]:
                del self._told[key], self.endpoints[key]
                self._forget_endpoint(key)
                self.generation += 1

    # What else is heard

    def firmware(self, info: ModuleInfo) -> None:
        """A gateway tells of a module that has no token of its own."""
        if info.name != self._module and info.name not in self._named:
            self._keep(self.modules.get(info.name), info)

    def freshen(self, now: int) -> None:
        """What has a token lives."""
        for name in self._named:
            info = self.modules.get(name)
            if info is not None and info.r2p:
                self.modules[name] = msgspec.structs.replace(info, last_heard=now)

    def clear(self) -> None:
        """Forget those whom no token told of."""
        for info in list(self.modules.values()):
            self._gone(info)

    # Namesakes

    def next_deadline(self) -> int | None:
        """When to call `poll` (monotonic ns); a time in the past means at once."""
        if self._hidden and len(self.modules) < MOST:
            return 0
        return min(self._suspected.values(), default=None)

    def poll(self, now: int) -> None:
        """Tell of modules that have room now, and of those that have carried one name for long enough."""
        while self._hidden and len(self.modules) < MOST:
            self._review(now, next(iter(self._hidden)))
        for name in [name for name, due in self._suspected.items() if due <= now]:
            del self._suspected[name]
            instances = [each.instance for each in self._named.get(name, {}).values()]
            if name == self._module:
                instances.insert(0, self._instance)
            one, other, *_ = dict.fromkeys(instances)
            self._events.append(NameConflict(name, one, other))

    def _review(self, now: int, name: str) -> None:
        """The tokens of a name have changed: the nearest and latest of them is the module."""
        tokens = [each for each in self._named.get(name, {}).values() if each.instance != self._instance]
        before = self.modules.get(name)
        self._hidden.pop(name, None)
        if not tokens:
            self._suspected.pop(name, None)
            if before is not None:
                self._gone(before)
            return
        self._keep(before, _info(min(reversed(tokens), key=lambda each: each.hops), now))
        own = {self._instance} if name == self._module else set()
        if len({each.instance for each in tokens} | own) > 1:
            self._suspected.setdefault(name, now + _NAMESAKE)
        else:
            self._suspected.pop(name, None)

    def _keep(self, before: ModuleInfo | None, info: ModuleInfo) -> None:
        if before is None and len(self.modules) >= MOST:
            self._counts["modules forgotten"] += 1
            if info.name in self._named:  # no token tells of it again
                self._hidden[info.name] = None
            return
        self.modules[info.name] = info
        if before is not None and before.instance is not None and before.instance != info.instance:
            self._names.pop(before.instance, None)
        if info.instance is not None:
            self._names[info.instance] = info.name
        if before is None or msgspec.structs.replace(before, last_heard=info.last_heard) != info:
            self.generation += 1
            self._events.append(ModuleChanged(info))
        for key in () if info.instance is None else self._endpoints_of.get(info.instance, ()):
            endpoint = self.endpoints[key]
            if endpoint.module != info.name:
                self.endpoints[key] = msgspec.structs.replace(endpoint, module=info.name)

    def _forget_endpoint(self, key: EndpointKey) -> None:
        siblings = self._endpoints_of[key[0]]
        del siblings[key]
        if not siblings:
            del self._endpoints_of[key[0]]

    def _gone(self, info: ModuleInfo) -> None:
        del self.modules[info.name]
        if info.instance is not None:
            self._names.pop(info.instance, None)
        self.generation += 1
        self._events.append(ModuleGone(info))


def _info(token: ModuleToken, now: int) -> ModuleInfo:
    lease = FOR_EVER if token.instance is not None else 0
    return ModuleInfo(token.name, token.flags, now, token.instance, token.observer, lease, token.hops, token.session)


def _endpoint_key(token: TopicToken) -> EndpointKey | None:
    if not token.node or token.instance is None:
        return None
    return token.instance, token.node, token.topic, token.role
