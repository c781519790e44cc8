"""The types of services of other nodes. The master does not know them: each server is asked once, as `rosservice` does.

A server answers the header of a probe with its own one. Each is asked as soon as it is in the graph, so that one that
hangs, or was killed and stays with the master, keeps no other waiting. One that does not answer is asked again RETRY_S
later, while it is in the graph.
"""

import asyncio
from collections.abc import Awaitable, Callable

import msgspec

from r2p.errors import NoServer, ServiceError
from r2p.ros.middleware import RosGraph, RosPeerServer, RosService
from r2p.ros.ros1.connections import Ros1Context

PROBE_S = 2.0
"""Seconds for the answer of a server."""

RETRY_S = 10.0
"""Seconds until a server is asked again that has not answered."""

AT_ONCE = 16
"""Servers that are asked at a time."""

_OF_EACH_NODE = {
    "get_loggers": RosService("roscpp/GetLoggers", "32e97e85527d4678a8f9279894bb64b0"),
    "set_logger_level": RosService("roscpp/SetLoggerLevel", "51da076440d78ca1684d36c868df61ea"),
}
"""The services that each node has, by the ends of their names: these are not asked for."""

Probe = Callable[[str], Awaitable[RosService]]
"""Asks the server of a service. Raises NoServer, ServiceError, or TimeoutError."""


class ServiceProbes:
    """Fills the types of services into graphs. `changed` is called when there is a new one."""

    def __init__(self, context: Ros1Context, probe: Probe, changed: Callable[[], None]) -> None:
        self._context = context
        self._probe = probe
        self._changed = changed
        self._types: dict[RosPeerServer, RosService] = {}
        self._asking: dict[RosPeerServer, asyncio.Task[None]] = {}
        self._turns = asyncio.Semaphore(AT_ONCE)

    def complete(self, graph: RosGraph) -> RosGraph:
        """Return the graph with the types that are known, and ask for the others."""
        for gone in self._types.keys() - graph.servers:
            del self._types[gone]
        for gone in self._asking.keys() - graph.servers:
            self._asking.pop(gone).cancel()
        for server in graph.servers - self._types.keys() - self._asking.keys():
            kind = _OF_EACH_NODE.get(server.service.rpartition("/")[2])
            if kind is not None:
                self._types[server] = kind
            else:
                self._asking[server] = asyncio.get_running_loop().create_task(self._ask(server))
        return msgspec.structs.replace(graph, servers=frozenset(map(self._typed, graph.servers)))

    def close(self) -> None:
        """Ask no more."""
        for task in self._asking.values():
            task.cancel()
        self._asking.clear()

    def _typed(self, server: RosPeerServer) -> RosPeerServer:
        kind = self._types.get(server)
        if kind is None:
            return server
        return msgspec.structs.replace(server, type=kind.name, checksum=kind.checksum)

    async def _ask(self, server: RosPeerServer) -> None:
        while (kind := await self._answer(server.service)) is None:  # noqa: ASYNC110 - only the server knows
            await asyncio.sleep(RETRY_S)
        self._types[server] = kind
        del self._asking[server]
        self._changed()

    async def _answer(self, service: str) -> RosService | None:
        """Return the type that the server of a service says; None, and counted, if it says none."""
        async with self._turns:
            try:
                async with asyncio.timeout(PROBE_S):
                    return await self._probe(service)
            except (NoServer, ServiceError, TimeoutError):
                self._context.lost["probe of a service unanswered"] += 1
                return None
