"""The types of services of other nodes. The master does not know them: each server is asked once, as `rosservice` does.

A server answers the header of a probe with its own one. Servers are asked one after the other, and the graph is
reported again when all are known. One that does not answer is asked again RETRY_S later, while it is in the graph.
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
        self._types: dict[RosPeerServer, RosService | None] = {}
        """The types by server; None while one is asked for, or to be asked."""
        self._asking: asyncio.Task[None] | None = None
        self._retry: asyncio.TimerHandle | None = None

    def complete(self, graph: RosGraph) -> RosGraph:
        """Return the graph with the types that are known, and ask for the others."""
        for gone in self._types.keys() - graph.servers:
            del self._types[gone]
        for server in graph.servers - self._types.keys():
            self._types[server] = _OF_EACH_NODE.get(server.service.rpartition("/")[2])
        if self._asking is None and self._retry is None and None in self._types.values():
            self._asking = asyncio.get_running_loop().create_task(self._ask())
        return msgspec.structs.replace(graph, servers=frozenset(map(self._typed, graph.servers)))

    def close(self) -> None:
        """Ask no more."""
        if self._asking is not None:
            self._asking.cancel()
        if self._retry is not None:
            self._retry.cancel()

    def _typed(self, server: RosPeerServer) -> RosPeerServer:
        kind = self._types[server]
        if kind is None:
            return server
        return msgspec.structs.replace(server, type=kind.name, checksum=kind.checksum)

    async def _ask(self) -> None:
        answered = False
        for server in [server for server, kind in self._types.items() if kind is None]:
            try:
                async with asyncio.timeout(PROBE_S):
                    kind = await self._probe(server.service)
            except (NoServer, ServiceError, TimeoutError):
                self._context.lost["probe of a service unanswered"] += 1
            else:
                if server in self._types:  # else it is gone meanwhile
                    self._types[server] = kind
                    answered = True
        self._asking = None
        if None in self._types.values():
            self._retry = asyncio.get_running_loop().call_later(RETRY_S, self._ask_again)
        if answered:
            self._changed()

    def _ask_again(self) -> None:
        self._retry = None
        self._changed()
