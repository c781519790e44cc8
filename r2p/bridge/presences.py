"""Modules and nodes of one side, told on the other: what has changed at once, the rest again and again.

r2p modules are passed on with one hop more, and taken back when they are gone. Of firmware only what it says itself is
passed on, so that its age can be seen everywhere.
"""

from typing import TYPE_CHECKING

import msgspec

from r2p.bridge.options import Policy
from r2p.bridge.port import BridgePort
from r2p.bridge.relay import MOST_HOPS
from r2p.clock import Alarm, Clock
from r2p.codecs import management
from r2p.codecs.management import ROLE_GONE, ROLE_PUBLISHES
from r2p.protocols.announcer import Relayed
from r2p.protocols.events import ModuleInfo

if TYPE_CHECKING:
    import asyncio

    from r2p.bridge.bridge import Bridge

_REFRESH = 1_500_000_000
_SOON = 2_000_000  # ns; so that what comes together is looked at together
_Key = tuple[object, ...]


class _Told(msgspec.Struct, frozen=True):
    """What was passed on, and when it was heard."""

    message: Relayed
    heard: int
    hops: int


class Presences:
    """What each link has been told of the modules on the others."""

    def __init__(self, bridge: "Bridge", loop: "asyncio.AbstractEventLoop", clock: Clock, policy: Policy) -> None:
        self._bridge = bridge
        self._clock = clock
        self._policy = policy
        self._told: dict[int, dict[_Key, _Told]] = {}
        self._alarm = Alarm(loop, self._due)
        self._refresh_at = 0

    def changed(self) -> None:
        """A module or a node came or went, or a link."""
        self._alarm.set(self._clock.monotonic() + _SOON)

    def forget(self, port: BridgePort) -> None:
        """The link is gone."""
        self._told.pop(port.number, None)
        self.changed()

    def close(self) -> None:
        self._alarm.close()

    def _due(self) -> None:
        now = self._clock.monotonic()
        refresh = now >= self._refresh_at
        if refresh:
            self._refresh_at = now + _REFRESH
        ports = [port for port in self._bridge.ports.values() if port.link.up]
        for port in ports:
            self._tell(port, ports, now, refresh=refresh)
        if refresh:
            self._bridge.relays.retyped()
        self._alarm.set(self._refresh_at)

    def _tell(self, port: BridgePort, ports: list[BridgePort], now: int, *, refresh: bool) -> None:
        told = self._told.setdefault(port.number, {})
        if port.in_tree and now >= port.place.until:
            return  # it has to wait until the gateways agree
        news = self._news(port, ports, now) if port.in_tree else {}
        for key, new in news.items():
            before = told.get(key)
            again = refresh and before is not None and (new.heard > before.heard or not _is_alive(new.message))
            if before is None or before.message != new.message or again:
                port.link.relay(new.message)
                told[key] = new
        for key in [key for key in told if key not in news]:
            gone = _gone(told.pop(key).message)
            if gone is not None:
                port.link.relay(gone)

    def _news(self, port: BridgePort, ports: list[BridgePort], now: int) -> dict[_Key, _Told]:
        """What this link should know."""
        news: dict[_Key, _Told] = {}
        instances = {info.instance for info in port.link.discovery.modules.values() if info.r2p}
        for other in ports:
            if other is port or not other.in_tree:
                continue
            if now >= other.place.until:
                return dict(self._told[port.number])
            for info in list(other.link.discovery.modules.values()):
                self._add_module(news, info, port)
            for key, endpoint in list(other.link.discovery.endpoints.items()):
                topic = self._passing(endpoint.topic, endpoint.role, other, port)
                if topic is not None and endpoint.instance not in instances | {self._bridge.instance}:
                    message = management.Endpoint(
                        endpoint.role, endpoint.instance, endpoint.node, topic, endpoint.publisher_class
                    )
                    news["endpoint", *key] = _Told(message, now, 0)
        return news

    def _add_module(self, news: dict[_Key, _Told], info: ModuleInfo, port: BridgePort) -> None:
        known = port.link.discovery.modules.get(info.name)
        hops = info.hops + 1
        if hops > MOST_HOPS or info.name == self._bridge.name:
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
