"""The log of the network, for the pages that show it: subscribed to only while one of them does."""

import asyncio
import logging
from collections import deque
from collections.abc import Callable, Iterable
from typing import Any

from r2p.monitoring.log import LogEntry, LogFollower
from r2p.web.client import WebClient
from r2p.web.dash import protocol
from r2p.web.dash.source import log_level

PERIOD = 0.1
"""Seconds for which records are collected."""
WAITING_MAX = 1000
"""Records that wait for these; more of them are dropped, the oldest first."""


class PageLog:
    """The log as one page follows it: from a level on, and in batches."""

    def __init__(self, client: WebClient) -> None:
        self.level = logging.INFO
        self._client = client
        self._waiting: deque[LogEntry] = deque(maxlen=WAITING_MAX)
        self._dropped = 0
        self._cleared = False
        self._timer: asyncio.TimerHandle | None = None

    def add(self, entry: LogEntry) -> None:
        """Send a record with the next batch, if it has the level."""
        if entry.level < self.level:
            return
        self._dropped += len(self._waiting) == WAITING_MAX
        self._waiting.append(entry)
        if self._timer is None:
            self._timer = asyncio.get_running_loop().call_later(PERIOD, self._send)

    def begin(self, level: int, records: Iterable[LogEntry]) -> None:
        """Begin anew, from a level on, with these records."""
        self.level = level
        self._cleared = True
        self._waiting.clear()
        for entry in records:
            self.add(entry)

    def close(self) -> None:
        """Stop sending."""
        if self._timer is not None:
            self._timer.cancel()

    def _send(self) -> None:
        self._timer = None
        records = [record(each) for each in self._waiting]
        self._waiting.clear()
        news = {"op": "log", "records": records, "dropped": self._dropped}
        if self._cleared:
            news["cleared"] = True
        if self._client.send_newest(protocol.encode(news).decode(), "log"):
            self._cleared = False
        else:
            self._dropped += len(records)


def record(entry: LogEntry) -> dict[str, Any]:
    """Return a record as pages have it."""
    return {
        "time": entry.stamp,
        "level": entry.level,
        "module": entry.module,
        "node": entry.node,
        "text": entry.text,
    }


class LogFeed:
    """Follows the log of the network while there are pages that show it."""

    def __init__(self, follow: Callable[[], LogFollower]) -> None:
        self._follow = follow
        self._follower: LogFollower | None = None
        self._pages: list[PageLog] = []

    async def add(self, page: PageLog, level: str) -> None:
        """Send a page the newest records that are known, and then each one. Raises WebError for an unknown level."""
        least = log_level(level)
        if page not in self._pages:
            self._pages.append(page)
        if self._follower is None:
            self._follower = self._follow()
            self._follower.listeners.append(self._add_record)
            await self._follower.__aenter__()
        page.begin(least, self._follower.records)

    async def remove(self, page: PageLog) -> None:
        """Stop sending a page records; the subscription ends with the last page."""
        page.close()
        if page in self._pages:
            self._pages.remove(page)
        if not self._pages:
            await self.close()

    async def close(self) -> None:
        """End the subscription."""
        follower, self._follower = self._follower, None
        if follower is not None:
            await follower.__aexit__(None, None, None)

    def _add_record(self, entry: LogEntry) -> None:
        for page in self._pages:
            page.add(entry)
