"""Where a page gets what it shows: a running network, or a recording; and what a page may ask of both."""

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Collection
from typing import Any

from r2p.errors import WebError
from r2p.monitoring.snapshot import NetworkSnapshot
from r2p.web.client import WebClient
from r2p.web.dash import protocol

PLOTS_MAX = 64
"""Plots of one page."""
FIELDS_MAX = 64
"""Fields of one plot."""
WATCHES_MAX = 64
"""Topics that one page watches."""

_LEVELS = {"DEBUG": 10, "INFO": 20, "WARNING": 30, "ERROR": 40, "FATAL": 50}
_HEX_MAX = 256  # bytes that are shown of a message of unknown type


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


def check_plot(request: protocol.Plot, plots: Collection[int]) -> None:
    """Raise WebError for a plot that a page with these streams can't have."""
    if not 0 <= request.stream <= protocol.STREAM_MAX:
        raise WebError(f"the number of a stream is 0 to {protocol.STREAM_MAX}, not {request.stream}")
    if not 1 <= len(request.fields) <= FIELDS_MAX:
        raise WebError(f"a plot has 1 to {FIELDS_MAX} fields, not {len(request.fields)}")
    if request.stream not in plots and len(plots) >= PLOTS_MAX:
        raise WebError(f"a page has at most {PLOTS_MAX} plots: remove one")


def check_watches(watched: Collection[str]) -> None:
    """Raise WebError if a page that watches these topics can't watch another one."""
    if len(watched) >= WATCHES_MAX:
        raise WebError(f"a page watches at most {WATCHES_MAX} topics: close one")


def log_level(name: str) -> int:
    """Return a level of the log as a number. Raises WebError for an unknown one."""
    if name not in _LEVELS:
        raise WebError(f"{name[:20]!r} is not a level of the log: write one of {', '.join(_LEVELS)}")
    return _LEVELS[name]


def raw_fields(data: bytes) -> dict[str, Any]:
    """Return the fields that stand for those of a message of unknown type: its first bytes in hex."""
    return {"data": data[:_HEX_MAX].hex() + ("..." if len(data) > _HEX_MAX else "")}
