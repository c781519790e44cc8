"""Opens a zenoh session for a module, and keeps it: zenoh itself reconnects, and we say why it can't."""

import asyncio
import importlib
from collections.abc import Callable
from typing import TYPE_CHECKING

from r2p.backoff import Backoff
from r2p.errors import TransportError
from r2p.transports.link import Hub, Transport
from r2p.transports.zenoh.options import Options, chosen, default_network
from r2p.transports.zenoh.trouble import NOT_US, why

if TYPE_CHECKING:
    import zenoh

    from r2p.transports.zenoh.link import ZenohLink
    from r2p.transports.zenoh.session import Session

_SCOUTING = 0.5
"""Seconds in which peers find each other."""

_LOOKS = 5

_LOOK = 1.0
"""Seconds between two looks whether a link that is down should be explained."""


class ZenohTransport(Transport):
    """`zenoh:[ENDPOINT]`."""

    def __init__(self, options: Options) -> None:
        self._options = options

    async def run(self, hub: Hub, opened: Callable[[], object]) -> None:
        try:  # in a thread: loading zenoh takes longer than a loop should be blocked
            await asyncio.to_thread(importlib.import_module, "r2p.transports.zenoh.link")
            from r2p.transports.zenoh.config import config_of, way_of
            from r2p.transports.zenoh.link import ZenohLink
        except ImportError as error:
            raise TransportError(f"{self._options.name}: zenoh is missing: pip install 'r2p[zenoh]'") from error
        options = self._options
        config = config_of(options)
        connects = bool(way_of(config).endpoints)
        link = ZenohLink(options.name, hub, connects=connects)
        hub.attach(link)
        session = None
        try:
            session = await self._open(config, link, Backoff(hub.random, longest=0.5), opened)
            link.use(session, f"r2p/{await self._network(session, hub)}")
            await self._tell_addresses(session, hub)
            opened()
            await self._watch(config, link)
        finally:
            link.close()
            hub.detach(link)
            if session is not None:
                await asyncio.shield(session.close())

    async def _open(
        self, config: "zenoh.Config", link: "ZenohLink", backoff: Backoff, opened: Callable[[], object]
    ) -> "Session":
        from r2p.transports.zenoh.config import way_of
        from r2p.transports.zenoh.session import Unreachable, open_session

        while True:
            try:
                return await open_session(config)
            except TransportError as error:
                raise TransportError(f"{self._options.name}: {error}") from error
            except Unreachable:
                opened()
                link.unreachable(await why(way_of(config)))
                await asyncio.sleep(backoff.delay())

    async def _network(self, session: "Session", hub: Hub) -> str:
        """Its name. A tool looks which there are; a robot's program must not depend on who came first."""
        if self._options.network is not None or not hub.observer:
            return self._options.network or default_network()
        found: set[str] = set()
        for _ in range(_LOOKS):
            found = await session.networks()
            if found:
                break
            await asyncio.sleep(_SCOUTING / _LOOKS)
        return chosen(found, self._options.name)

    async def _tell_addresses(self, session: "Session", hub: Hub) -> None:
        if self._options.listen is not None:
            for address in await session.listening():
                hub.listening(self._options.name, address)

    async def _watch(self, config: "zenoh.Config", link: "ZenohLink") -> None:
        """For ever: say what is wrong while the link is down."""
        from r2p.transports.zenoh.config import way_of

        reason = ""
        while True:
            await asyncio.sleep(_LOOK)
            if not link.up:
                before, reason = reason, await why(way_of(config))
                if NOT_US in reason and reason != before:
                    continue  # zenoh may be about to try again
                if not link.up:
                    link.unreachable(reason)
