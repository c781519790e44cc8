"""Where a page gets what it shows: a running network, or a recording."""

from abc import ABC, abstractmethod
from collections import Counter
from typing import Any

from r2p.errors import WebError
from r2p.monitoring.snapshot import NetworkSnapshot
from r2p.web.client import WebClient
from r2p.web.dash import protocol


class DashSource(ABC):
    """What all pages of one process share. A `SourceSession` of it serves one page."""

    def __init__(self) -> None:
        self.refused: Counter[str] = Counter()
        """Requests of pages that were refused, by reason."""

    @abstractmethod
    def hello(self) -> dict[str, Any]:
        """Return the first news: {"op": "hello", "version", "title", "recording": bool, "publish": bool, ...}."""

    @abstractmethod
    def session(self, client: WebClient) -> "SourceSession":
        """Return what serves one page."""


class SourceSession(ABC):
    """Serves one page, an asynchronous context manager. Its methods raise Error and TimeoutError as answers."""

    @abstractmethod
    async def snapshots(self) -> NetworkSnapshot:
        """Wait until figures have changed, and return them; at once the first time."""

    @abstractmethod
    async def answer(self, request: protocol.DashRequest) -> object:
        """Do what the page asks, and return the result."""

    def refuse(self, request: protocol.DashRequest, why: str) -> WebError:
        """Return the error for a request that this source can't do."""
        return WebError(f"{request.__struct_config__.tag}: {why}")

    @abstractmethod
    async def close(self) -> None:
        """End all that the page has asked for."""
