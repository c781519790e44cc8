"""Opens a zenoh session for a module, and keeps it: zenoh itself reconnects, and this module explains why it can't."""

import asyncio
import importlib
from collections.abc import Callable
from typing import TYPE_CHECKING

from r2p.clock import Backoff
from r2p.errors import TransportError
from r2p.transports.link import Hub, Transport
from r2p.transports.zenoh.config import (
    ZenohOptions,
    build_config,
    choose_network,
    connection_settings,
    default_network,
    list_networks,
    open_endpoints,
    use_any_port,
)
from r2p.transports.zenoh.diagnose import NOT_ADMITTED, diagnose_connection, diagnose_listening, find_wrong_server

if TYPE_CHECKING:
    import zenoh

    from r2p.transports.zenoh.link import ZenohLink
    from r2p.transports.zenoh.session import ZenohSession

_SCOUTING_S = 0.5  # seconds in which peers find each other
_SCOUTING_TRIES = 5  # checks in that time
_BACKOFF_MAX_S = 0.5  # seconds between two attempts to open a session
_DIAGNOSE_EVERY_S = 1.0  # seconds between two checks whether a link that is down should be explained

_ALONE_S = 3.0  # seconds without another module until it looks for other networks; twice as long each further time
_ALONE_TOOL_S = 0.3  # the same for a tool, whose user waits
_ALONE_MAX_S = 60.0  # and at most

_RESTRICT = "zenoh:?listen=tcp/127.0.0.1:7447 restricts it to this one, docs/how-to/zenoh.md has TLS and passwords"
"""Advice about a port that is open to all."""


class ZenohTransport(Transport):
    """`zenoh:[ENDPOINT]`."""

    def __init__(self, options: ZenohOptions) -> None:
        self._options = options

    async def run(self, hub: Hub, opened: Callable[[], object]) -> None:
        try:  # in a thread: loading zenoh takes longer than a loop should be blocked
            await asyncio.to_thread(importlib.import_module, "r2p.transports.zenoh.link")
            from r2p.transports.zenoh.link import ZenohLink
        except ImportError as error:
            if (error.name or "").partition(".")[0] != "zenoh":
                raise
            raise self._options.error("zenoh is missing: pip install 'r2p[zenoh]'") from error
        options = self._options
        config = build_config(options)
        connects = bool(connection_settings(config).endpoints)
        link = ZenohLink(options.name, hub, connects=connects, batching=options.batching, tokens_max=options.tokens)
        link.use_key(options.key)
        hub.attach(link)
        session = None
        try:
            session = await self._open(config, link, Backoff(hub.random, longest=_BACKOFF_MAX_S), opened)
            network = await self._network(session, hub)
            link.use(session, f"r2p/{network}")
            await self._report_addresses(session, link, hub, open_endpoints(config))
            opened()
            async with asyncio.TaskGroup() as tasks:  # neither ends but by being cancelled
                tasks.create_task(self._explain(config, link))
                tasks.create_task(self._look_for_others(session, link, hub, network))
        finally:
            link.close()
            hub.detach(link)
            if session is not None:
                await asyncio.shield(session.close())

    async def _open(
        self, config: "zenoh.Config", link: "ZenohLink", backoff: Backoff, opened: Callable[[], object]
    ) -> "ZenohSession":
        from r2p.transports.zenoh.session import Unreachable, open_session

        while True:
            if wrong := await find_wrong_server(connection_settings(config)):
                opened()
                link.unreachable(wrong)
                await asyncio.sleep(backoff.delay())
                continue
            try:
                return await open_session(config, link.stats.lost.internal_error)
            except TransportError as error:
                if use_any_port(config, self._options):
                    continue
                reason = await asyncio.to_thread(diagnose_listening, connection_settings(config))
                raise self._options.error(reason or str(error)) from error
            except Unreachable:
                opened()
                link.unreachable(await diagnose_connection(connection_settings(config)))
                await asyncio.sleep(backoff.delay())

    async def _network(self, session: "ZenohSession", hub: Hub) -> str:
        """Return the network's name. A tool looks for one; a robot's program must not depend on the first one."""
        if self._options.network is not None or not hub.observer:
            return self._options.network or default_network()
        found: set[str] = set()
        for _ in range(_SCOUTING_TRIES):
            found = await session.find_networks(tools=True)
            if found:
                break
            await asyncio.sleep(_SCOUTING_S / _SCOUTING_TRIES)
        try:
            return choose_network(found)
        except ValueError as error:
            raise self._options.error(str(error)) from error

    async def _report_addresses(self, session: "ZenohSession", link: "ZenohLink", hub: Hub, exposed: list[str]) -> None:
        """Report where the session accepts connections; unless for a tool, warn if that needs no authentication."""
        addresses = await session.listening_endpoints() if self._options.listen is not None or exposed else []
        if self._options.listen is not None:
            for address in addresses:
                hub.listening(self._options.name, address)
        if exposed and addresses and not hub.observer:
            ports = ", ".join(sorted({each.rpartition(":")[2] for each in addresses}))
            text = f"accepts connections from other computers at port {ports} without authentication: "
            hub.link_notice(link, "open to all", f"{text}{_RESTRICT}", trouble=True)

    async def _explain(self, config: "zenoh.Config", link: "ZenohLink") -> None:
        """Report the reason whenever the link is down; never returns."""
        reason = ""
        while True:
            await link.down.wait()
            await asyncio.sleep(_DIAGNOSE_EVERY_S)
            if link.up:
                continue
            try:
                before, reason = reason, await diagnose_connection(connection_settings(config))
            except Exception as error:  # noqa: BLE001 - counted and logged; the next check follows
                link.stats.lost.internal_error(error)
                continue
            if NOT_ADMITTED in reason and reason != before:
                continue  # zenoh may be about to try again
            if not link.up:
                link.unreachable(reason)

    async def _look_for_others(self, session: "ZenohSession", link: "ZenohLink", hub: Hub, network: str) -> None:
        """Report once which other networks have modules, unless there is another module on this one."""
        pause = _ALONE_TOOL_S if hub.observer else _ALONE_S
        while True:
            await asyncio.sleep(pause)
            others = await self._other_networks(session, link, network)
            if _has_peers(link):
                return
            if others:
                text = f"no other module is on the network {network}, but there are modules on {list_networks(others)}"
                text += f": is ?network={others[0]} meant?"
                # A program without a log handler shows warnings only; a tool shows both.
                hub.link_notice(link, "elsewhere", text, trouble=not hub.observer)
                return
            pause = min(2 * pause, _ALONE_MAX_S)

    async def _other_networks(self, session: "ZenohSession", link: "ZenohLink", network: str) -> list[str]:
        try:
            return sorted(await session.find_networks(tools=False) - {network}) if link.up else []
        except Exception as error:  # noqa: BLE001 - counted and logged; the next check follows
            link.stats.lost.internal_error(error)
            return []


def _has_peers(link: "ZenohLink") -> bool:
    """Return whether the link has other modules than tools."""
    known = link.discovery
    publish = any(topic.advertised_at is not None for topic in known.topics.values())
    return publish or any(not module.observer for module in known.modules.values())
