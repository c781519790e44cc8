"""Serves one page: answers its requests, and sends it the figures that have changed."""

import asyncio
from collections.abc import Iterable
from typing import Any

import msgspec

from r2p.errors import Error
from r2p.monitoring.snapshot import Figures, NetworkSnapshot
from r2p.web.client import WebClient
from r2p.web.dash import protocol
from r2p.web.dash.source import DashSource, SourceSession
from r2p.web.server import WebEndpoint

PATH = "/dash"

_TABLES = ("modules", "topics", "services", "links", "buses")


def endpoint(source: DashSource) -> WebEndpoint:
    """Return what serves pages from a source."""

    async def handle(client: WebClient) -> None:
        client.send(protocol.encode(source.hello()).decode())
        session = source.session(client)
        try:
            async with asyncio.TaskGroup() as tasks:
                news = tasks.create_task(_send_states(session, client))
                async for message in client:
                    tasks.create_task(_answer(session, client, message))
                news.cancel()
        finally:
            await session.close()

    return WebEndpoint(handle)


async def _answer(session: SourceSession, client: WebClient, message: str | bytes) -> None:
    try:
        request = protocol.decode(message)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        client.send(protocol.encode({"id": None, "error": str(error)}).decode())
        return
    answer: dict[str, Any] = {"id": request.id}
    try:
        answer["result"] = await session.answer(request)
    except (Error, TimeoutError) as error:
        answer["error"] = str(error)
    client.send(protocol.encode(answer).decode())


async def _send_states(session: SourceSession, client: WebClient) -> None:
    before: dict[str, dict[str, Figures]] = {table: {} for table in _TABLES}
    while True:
        snapshot = await session.snapshots()
        now = {table: _keyed(getattr(snapshot, table)) for table in _TABLES}
        client.send(protocol.encode(_difference(snapshot, before, now)).decode(), "state")
        before = now


def _difference(
    snapshot: NetworkSnapshot, before: dict[str, dict[str, Figures]], now: dict[str, dict[str, Figures]]
) -> dict[str, Any]:
    changed = {
        table: {key: row for key, row in rows.items() if before[table].get(key) != row} for table, rows in now.items()
    }
    gone = {table: sorted(before[table].keys() - rows.keys()) for table, rows in now.items()}
    return {
        "op": "state",
        "time": snapshot.time,
        "network": snapshot.network,
        "changed": {table: rows for table, rows in changed.items() if rows},
        "gone": {table: keys for table, keys in gone.items() if keys},
    }


def _keyed(rows: Iterable[Any]) -> dict[str, Figures]:
    """Return the rows of a table by their key; of links the module is a part of it."""
    return {f"{row.module} {row.name}" if hasattr(row, "module") else row.name: row for row in rows}
