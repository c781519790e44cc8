"""A running network as the source of pages."""

from typing import Any

from r2p.modules.module import Module
from r2p.monitoring.monitor import NetworkMonitor
from r2p.monitoring.snapshot import NetworkSnapshot
from r2p.version import __version__
from r2p.web.client import WebClient
from r2p.web.dash import protocol
from r2p.web.dash.source import DashSource, SourceSession


class LiveSource(DashSource):
    """The network of an open module, as its monitor sees it."""

    def __init__(
        self, module: Module, monitor: NetworkMonitor, *, allow_publish: bool = False, allow_control: bool = False
    ) -> None:
        self.module = module
        self.monitor = monitor
        self.allow_publish = allow_publish
        self.allow_control = allow_control

    def hello(self) -> dict[str, Any]:
        return {
            "op": "hello",
            "version": __version__,
            "title": self.monitor.snapshot.network,
            "recording": False,
            "publish": self.allow_publish,
            "control": self.allow_control,
        }

    def session(self, client: WebClient) -> SourceSession:
        return _LiveSession(self, client)


class _LiveSession(SourceSession):
    def __init__(self, source: LiveSource, client: WebClient) -> None:
        self._source = source
        self._client = client
        self._first = True

    async def snapshots(self) -> NetworkSnapshot:
        if self._first:
            self._first = False
            return self._source.monitor.snapshot
        return await self._source.monitor.changed()

    async def answer(self, request: protocol.DashRequest) -> object:
        raise self.refuse(request, "not here yet")

    async def close(self) -> None:
        pass
