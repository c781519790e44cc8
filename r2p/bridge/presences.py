"""Modules and nodes of one side, told on the other: what has changed at once, the rest again and again.

Whoever is new on a link, or asks, gets all of it at once. r2p modules are passed on with one hop more, and taken back
when they are gone. Of firmware only what it says itself is passed on, so that its age can be seen everywhere; it does
not answer, so whoever asks is told of what was heard lately.
"""

from collections.abc import Callable

import msgspec

from r2p.bridge.options import Policy
from r2p.bridge.port import BridgePort
from r2p.bridge.relay import MOST_HOPS
from r2p.clock import Alarm
from r2p.codecs import management
from r2p.codecs.management import ROLE_GONE, ROLE_PUBLISHES
from r2p.protocols.announcer import Relayed
from r2p.protocols.events import ModuleInfo
from r2p.topic import TopicSpace

_REFRESH = 1_500_000_000
_SOON = 2_000_000  # ns; so that what comes together is looked at together
_APART = 200_000_000  # ns between two answers on one link
_LATELY = 2_000_000_000  # ns; of firmware that was heard since
_Key = tuple[object, ...]


class _Told(msgspec.Struct, frozen=True):
    """What was passed on, and when it was heard."""

    message: Relayed
    heard: int
    hops: int


class Presences:
    """What each link has been told of the modules on the others; `name` and `instance` are the gateway's own.

    `repeating` is called whenever everything is told again.
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
        self._told: dict[int, dict[_Key, _Told]] = {}
        self._alarm = Alarm(space.loop, self._due, background=True)
        self._refresh_at = 0
        self._met: dict[int, set[int]] = {}
        self._asked: set[int] = set()
        self._answered_at: dict[int, int] = {}

    def asked(self, port: BridgePort) -> None:
        """Somebody on the link wants to know everything."""
        self._asked.add(port.number)
        self.changed()

    def changed(self) -> None:
        """A module or a node came or went, or a link."""
        self._alarm.set(self._clock.monotonic() + _SOON)

    def forget(self, port: BridgePort) -> None:
        """The link is gone."""
        for known in (self._told, self._met, self._answered_at):
            known.pop(port.number, None)
        self._asked.discard(port.number)
        self.changed()

    def close(self) -> None:
        self._alarm.close()

    def _due(self) -> None:
        now = self._clock.monotonic()
        refresh = now >= self._refresh_at
        if refresh:
            self._refresh_at = now + _REFRESH
            self._repeating()
        ports = [port for port in self._ports.values() if port.link.up]
        for port in ports:
            port.link.stats.lost.guard(self._tell, port, ports, now, refresh=refresh)
        waits = any(port.number in self._asked for port in ports)
        self._alarm.set(min(self._refresh_at, now + _APART) if waits else self._refresh_at)

    def _answers(self, port: BridgePort, now: int) -> bool:
        """Whether the link is to be told everything, for it was asked for or somebody is new there."""
        here = {info.instance for info in port.link.discovery.modules.values() if info.instance and not info.hops}
        if not here <= self._met.get(port.number, set()):
            self._asked.add(port.number)
        self._met[port.number] = here
        if port.number not in self._asked or now < self._answered_at.get(port.number, -_APART) + _APART:
            return False
        self._asked.discard(port.number)
        self._answered_at[port.number] = now
        return True

    def _tell(self, port: BridgePort, ports: list[BridgePort], now: int, *, refresh: bool) -> None:
        told = self._told.setdefault(port.number, {})
        if port.in_tree and now >= port.place.until:
            return  # it has to wait until the gateways agree
        answers = self._answers(port, now)
        news = self._news(port, ports, now) if port.in_tree else {}
        for key, new in news.items():
            before = told.get(key)
            again = refresh and before is not None and (new.heard > before.heard or not _is_alive(new.message))
            again |= answers and (now < new.heard + _LATELY or not _is_alive(new.message))
            if before is None or before.message != new.message or again:
                told[key] = new
                port.link.stats.lost.guard(port.link.relay, new.message)
        for key in [key for key in told if key not in news]:
            gone = _gone(told.pop(key).message)
            if gone is not None:
                port.link.stats.lost.guard(port.link.relay, gone)

    def _news(self, port: BridgePort, ports: list[BridgePort], now: int) -> dict[_Key, _Told]:
        """What this link should know."""
        news: dict[_Key, _Told] = {}
        for other in ports:
            if other is port or not other.in_tree:
                continue
            if now >= other.place.until:
                return dict(self._told[port.number])
            for info in list(other.link.discovery.modules.values()):
                self._add_module(news, info, port)
            for key, endpoint in list(other.link.discovery.endpoints.items()):
                topic = self._passing(endpoint.topic, endpoint.role, other, port)
                if topic is None or endpoint.instance == self._instance:
                    continue
                there = (endpoint.instance, endpoint.node, topic, endpoint.role)
                if there not in port.link.discovery.endpoints:  # else it is on both links, and uses both
                    message = management.Endpoint(
                        endpoint.role, endpoint.instance, endpoint.node, topic, endpoint.publisher_class
                    )
                    news["endpoint", *key] = _Told(message, now, 0)
        return news

    def _add_module(self, news: dict[_Key, _Told], info: ModuleInfo, port: BridgePort) -> None:
        known = port.link.discovery.modules.get(info.name)
        hops = info.hops + 1
        if hops > MOST_HOPS or info.name == self._name:
            return  # of our name: our last start, of which others still tell
        if known is not None and known.instance == info.instance:
            return  # it is on both links
        alive = ("alive", info.name)
        if alive in news and news[alive].hops <= hops:
            return
        if info.r2p and info.instance is not None:
            flags = management.HELLO_TOOL if info.observer else 0
            lease = min(info.lease // 1_000_000, 0xFFFF)
            hello = management.Hello(info.name, info.instance, flags, hops, lease)
            news["hello", info.name] = _Told(hello, info.last_heard, hops)
        if not info.observer:
            news[alive] = _Told(management.Alive(info.name, info.flags), info.last_heard, hops)

    def _passing(self, name: str, role: int, source: BridgePort, target: BridgePort) -> str | None:
        """What a node's topic is called on another link; None where its messages may not pass."""
        topic = self._policy.meant(name, source.name)
        ways = (source, target) if role == ROLE_PUBLISHES else (target, source)
        if topic is None or not self._policy.allows(topic, ways[0].name, ways[1].name):
            return None
        called = self._policy.called(topic, target.name)
        return called if len(called) <= target.link.longest_name else None


def _is_alive(message: Relayed) -> bool:
    return isinstance(message, management.Alive)


def _gone(message: Relayed) -> Relayed | None:
    match message:
        case management.Hello():
            return msgspec.structs.replace(message, flags=message.flags | management.HELLO_LEAVING)
        case management.Endpoint():
            return msgspec.structs.replace(message, role=message.role | ROLE_GONE)
    return None
