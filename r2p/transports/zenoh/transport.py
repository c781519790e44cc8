"""Opens a zenoh session for a module, and keeps it: zenoh itself reconnects, and we say why it can't."""

import asyncio
import importlib
from collections.abc import Callable
from typing import TYPE_CHECKING

from r2p.clock import Backoff
from r2p.errors import TransportError
from r2p.transports.link import Hub, Transport
from r2p.transports.zenoh.config import ZenohOptions, chosen, default_network, listed
from r2p.transports.zenoh.diagnose import NOT_US, why, why_not_listening

if TYPE_CHECKING:
    import zenoh

    from r2p.transports.zenoh.link import ZenohLink
    from r2p.transports.zenoh.session import ZenohSession

_SCOUTING = 0.5
"""Seconds in which peers find each other."""

_LOOKS = 5

_LOOK = 1.0
"""Seconds between two looks whether a link that is down should be explained."""

_ALONE = 3.0
"""Seconds without anybody else after which a module looks whether they are on other networks; then ever more rarely."""

_RESTRICT = "zenoh:?listen=tcp/127.0.0.1:7447 keeps to this one, docs/how-to/zenoh.md has TLS and passwords"
"""What to do about a port that is open to all."""

_TOOL_ALONE = 0.3
_RARELY = 60.0


class ZenohTransport(Transport):
    """`zenoh:[ENDPOINT]`."""

    def __init__(self, options: ZenohOptions) -> None:
        self._options = options

    async def run(self, hub: Hub, opened: Callable[[], object]) -> None:
        try:  # in a thread: loading zenoh takes longer than a loop should be blocked
            await asyncio.to_thread(importlib.import_module, "r2p.transports.zenoh.link")
            from r2p.transports.zenoh.config import config_of, open_to_all, way_of
            from r2p.transports.zenoh.link import ZenohLink
        except ImportError as error:
            if (error.name or "").partition(".")[0] != "zenoh":
                raise
            raise self._options.error("zenoh is missing: pip install 'r2p[zenoh]'") from error
        options = self._options
        config = config_of(options)
        connects = bool(way_of(config).endpoints)
        link = ZenohLink(options.name, hub, connects=connects, batching=options.batching)
        hub.attach(link)
        session = None
        try:
            session = await self._open(config, link, Backoff(hub.random, longest=0.5), opened)
            network = await self._network(session, hub)
            link.use(session, f"r2p/{network}")
            await self._tell_addresses(session, link, hub, open_to_all(config))
            opened()
            async with asyncio.TaskGroup() as tasks:  # neither ends but by being cancelled
                tasks.create_task(self._watch(config, link))
                tasks.create_task(self._look_around(session, link, hub, network))
        finally:
            link.close()
            hub.detach(link)
            if session is not None:
                await asyncio.shield(session.close())

    async def _open(
        self, config: "zenoh.Config", link: "ZenohLink", backoff: Backoff, opened: Callable[[], object]
    ) -> "ZenohSession":
        from r2p.transports.zenoh.config import take_any_port, way_of
        from r2p.transports.zenoh.session import Unreachable, open_session

        while True:
            try:
                return await open_session(config)
            except TransportError as error:
                if take_any_port(config, self._options):
                    continue
                reason = await asyncio.to_thread(why_not_listening, way_of(config))
                raise self._options.error(reason or str(error)) from error
            except Unreachable:
                opened()
                link.unreachable(await why(way_of(config)))
                await asyncio.sleep(backoff.delay())

    async def _network(self, session: "ZenohSession", hub: Hub) -> str:
        """Its name. A tool looks which there are; a robot's program must not depend on who came first."""
        if self._options.network is not None or not hub.observer:
            return self._options.network or default_network()
        found: set[str] = set()
        for _ in range(_LOOKS):
            found = await session.networks(tools=True)
            if found:
                break
            await asyncio.sleep(_SCOUTING / _LOOKS)
        try:
            return chosen(found)
        except ValueError as error:
            raise self._options.error(str(error)) from error

    async def _tell_addresses(self, session: "ZenohSession", link: "ZenohLink", hub: Hub, exposed: list[str]) -> None:
        """Where it takes connections. That it does not ask of whom is no news for the user of a tool."""
        addresses = await session.listening() if self._options.listen is not None or exposed else []
        if self._options.listen is not None:
            for address in addresses:
                hub.listening(self._options.name, address)
        if exposed and addresses and not hub.observer:
            ports = ", ".join(sorted({each.rpartition(":")[2] for each in addresses}))
            text = f"takes connections of other computers at port {ports}, and does not ask who they are: "
            hub.link_notice(link, "open to all", f"{text}{_RESTRICT}", trouble=True)

    async def _watch(self, config: "zenoh.Config", link: "ZenohLink") -> None:
        """For ever: say what is wrong while the link is down."""
        from r2p.transports.zenoh.config import way_of

        reason = ""
        while True:
            await asyncio.sleep(_LOOK)
            if link.up:
                continue
            try:
                before, reason = reason, await why(way_of(config))
            except Exception as error:  # noqa: BLE001 - counted and logged; the next look follows
                link.stats.lost.internal_error(error)
                continue
            if NOT_US in reason and reason != before:
                continue  # zenoh may be about to try again
            if not link.up:
                link.unreachable(reason)

    async def _look_around(self, session: "ZenohSession", link: "ZenohLink", hub: Hub, network: str) -> None:
        """Until somebody else is on the network: say once on which networks there are others."""
        pause = _TOOL_ALONE if hub.observer else _ALONE
        while True:
            await asyncio.sleep(pause)
            others = await self._others(session, link, network)
            if _has_company(link):
                return
            if others:
                text = f"nobody else is on the network {network}, but there are modules on {listed(others)}"
                text += f": is ?network={others[0]} meant?"
                # A program without a log handler shows warnings only; a tool shows both.
                hub.link_notice(link, "elsewhere", text, trouble=not hub.observer)
                return
            pause = min(2 * pause, _RARELY)

    async def _others(self, session: "ZenohSession", link: "ZenohLink", network: str) -> list[str]:
        try:
            return sorted(await session.networks(tools=False) - {network}) if link.up else []
        except Exception as error:  # noqa: BLE001 - counted and logged; the next look follows
            link.stats.lost.internal_error(error)
            return []


def _has_company(link: "ZenohLink") -> bool:
    """Whether anybody is there but tools that look."""
    known = link.discovery
    publish = any(topic.advertised_at is not None for topic in known.topics.values())
    return publish or any(not module.observer for module in known.modules.values())
