"""Serves one page: its files, the answers to its requests, and the figures that have changed.

A page that does not read gets fewer states, never wrong ones: the next state is made when the last one is on its way,
of all that has changed since. One that asks for too much waits, or is refused; nothing that it does keeps other pages
waiting.
"""

import asyncio
import contextlib
from collections.abc import Iterable, Iterator
from importlib.resources import files
from importlib.resources.abc import Traversable
from itertools import islice
from typing import Any

import msgspec

from r2p.errors import Error
from r2p.log_lines import get_logger
from r2p.monitoring.snapshot import Figures, NetworkSnapshot
from r2p.web.client import WebClient
from r2p.web.dash import protocol
from r2p.web.dash.source import DashSource, SourceSession
from r2p.web.server import WebEndpoint, WebFile

PATH = "/dash"

REQUESTS_MAX = 32
"""Requests of one page that are worked on at the same time; more are refused."""
REQUEST_RATE = 200.0
"""Requests of one page per second, in the long run; beyond that it waits."""

REQUEST_BYTES = 4 << 20
"""Bytes of the requests of one page per second, in the long run."""

_TABLES = ("modules", "topics", "services", "links", "buses")
_BURST = 1.0  # seconds of requests at these rates that do not wait, as when a page opens
_ROWS = 500  # of one message with figures
_DROPPED_PERIOD = 1.0  # seconds between two reports of what a page was too slow for
_ERROR_MAX = 1000  # characters of an error

_MEDIA_TYPES = {
    ".css": "text/css; charset=utf-8",
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}

logger = get_logger("r2p.web")

_Table = dict[str, Figures]
_Tables = dict[str, _Table]


def endpoint(source: DashSource) -> WebEndpoint:
    """Return what serves pages from a source."""
    states = StateEncoder()

    async def handle(client: WebClient) -> None:
        client.send(protocol.encode(source.hello()).decode())
        session = source.session(client)
        page = _Page(source, session, client)
        try:
            async with asyncio.TaskGroup() as tasks:
                news = [tasks.create_task(_send_states(session, client, states)), tasks.create_task(_report(client))]
                await page.serve(tasks)
                for task in news:
                    task.cancel()
        finally:
            await session.close()

    return WebEndpoint(handle)


class _Page:
    """The requests of one page."""

    def __init__(self, source: DashSource, session: SourceSession, client: WebClient) -> None:
        self._source = source
        self._session = session
        self._client = client
        self._running: set[asyncio.Task[None]] = set()

    async def serve(self, tasks: asyncio.TaskGroup) -> None:
        """Answer requests until the page leaves; then end those that are worked on."""
        loop = asyncio.get_running_loop()
        paid_until = 0.0
        async for message in self._client:
            cost = 1 / REQUEST_RATE + len(message) / REQUEST_BYTES
            paid_until = max(paid_until, loop.time() - _BURST) + cost
            if paid_until > loop.time():
                await asyncio.sleep(paid_until - loop.time())
            if len(self._running) >= REQUESTS_MAX:  # most are answered as soon as they run
                await asyncio.sleep(0)
                await asyncio.sleep(0)  # and no longer counted a turn later
            self._begin(tasks, message)
        for task in self._running:
            task.cancel()

    def _begin(self, tasks: asyncio.TaskGroup, message: str | bytes) -> None:
        try:
            request = protocol.decode(message)
        except (msgspec.DecodeError, UnicodeDecodeError) as error:
            self._refuse(None, "malformed request", str(error))
            return
        if len(self._running) >= REQUESTS_MAX:
            self._refuse(request.id, "too many requests", f"{REQUESTS_MAX} requests are not answered yet: try again")
            return
        task = tasks.create_task(self._answer(request))
        self._running.add(task)
        task.add_done_callback(self._running.discard)

    async def _answer(self, request: protocol.DashRequest) -> None:
        try:
            data = protocol.encode({"id": request.id, "result": await self._session.answer(request)}).decode()
        except (Error, TimeoutError) as error:
            self._send_error(request.id, str(error))
        except Exception:
            logger.exception("internal error: the page's request %r", type(request).__name__)
            self._send_error(request.id, "internal error: see the log of r2p dash")
        else:
            self._client.send(data)

    def _refuse(self, number: int | None, reason: str, text: str) -> None:
        self._source.refused[reason] += 1
        self._send_error(number, text)

    def _send_error(self, number: int | None, text: str) -> None:
        self._client.send(protocol.encode({"id": number, "error": text[:_ERROR_MAX]}).decode())


async def _report(client: WebClient) -> None:
    """Report what the page was too slow for, when there is more of it."""
    reported = 0
    while True:
        await asyncio.sleep(_DROPPED_PERIOD)
        if client.dropped.total() > reported:
            reported = client.dropped.total()
            await client.room()
            client.send(protocol.encode({"op": "dropped", "streams": dict(client.dropped)}).decode())


# Figures


class StateEncoder:
    """Makes states for all pages: pages that have seen the same one before get the same message, made once."""

    def __init__(self) -> None:
        self._snapshot: NetworkSnapshot | None = None
        self._tables: _Tables = {}
        self._made: tuple[_Tables, list[str]] | None = None

    def tables(self, snapshot: NetworkSnapshot) -> _Tables:
        """Return the rows of a snapshot by table and key."""
        if snapshot is not self._snapshot:
            self._snapshot, self._made = snapshot, None
            self._tables = {table: keyed(getattr(snapshot, table)) for table in _TABLES}
        return self._tables

    def messages(self, before: _Tables, snapshot: NetworkSnapshot) -> list[str]:
        """Return the messages for a page that has seen `before`."""
        now = self.tables(snapshot)
        if self._made is None or self._made[0] is not before:
            self._made = before, [protocol.encode(each).decode() for each in differences(snapshot, before, now)]
        return self._made[1]


_NOTHING: _Tables = {table: {} for table in _TABLES}


async def _send_states(session: SourceSession, client: WebClient, states: StateEncoder) -> None:
    before = _NOTHING
    with contextlib.suppress(Error):  # the network was closed
        while True:
            snapshot = await session.snapshots()
            for message in states.messages(before, snapshot):
                await client.room()
                client.send(message)
            before = states.tables(snapshot)


def differences(snapshot: NetworkSnapshot, before: _Tables, now: _Tables) -> Iterator[dict[str, Any]]:
    """Yield states that lead from one set of figures to another one, of at most 500 rows each; at least one."""
    head = {"op": "state", "time": snapshot.time, "network": snapshot.network}
    gone = {table: sorted(before[table].keys() - rows.keys()) for table, rows in now.items()}
    news: dict[str, Any] = head | {"changed": {}, "gone": {table: keys for table, keys in gone.items() if keys}}
    left = _ROWS
    for table, rows in now.items():
        changed = _changed(before[table], rows)
        while part := dict(islice(changed, left)):
            news["changed"][table] = part
            left -= len(part)
            if not left:
                yield news
                news, left = head | {"changed": {}, "gone": {}}, _ROWS
    if left < _ROWS or news["gone"] or before is _NOTHING:
        yield news


def _changed(before: _Table, now: _Table) -> Iterator[tuple[str, Figures]]:
    for key, row in now.items():
        old = before.get(key)
        if old is not row and old != row:
            yield key, row


def keyed(rows: Iterable[Any]) -> _Table:
    """Return the rows of a table by their key; of links the module is a part of it."""
    return {f"{row.module} {row.name}" if hasattr(row, "module") else row.name: row for row in rows}


def page() -> dict[str, WebFile]:
    """Read the files of the page from the package; return them by path."""
    return dict(_files_in(files("r2p.web").joinpath("page"), ""))


def _files_in(folder: Traversable, path: str) -> list[tuple[str, WebFile]]:
    found: list[tuple[str, WebFile]] = []
    for each in folder.iterdir():
        name = f"{path}/{each.name}"
        suffix = name[name.rfind(".") :]
        if each.is_dir():
            found += _files_in(each, name)
        elif suffix in _MEDIA_TYPES:
            found.append((name, WebFile(_MEDIA_TYPES[suffix], each.read_bytes())))
    return found
