"""A page without a browser and without a socket, for tests under virtual time."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
from typing import TYPE_CHECKING, Any, cast

from websockets.exceptions import ConnectionClosedOK
from websockets.frames import Close

from r2p.monitoring.monitor import NetworkMonitor
from r2p.monitoring.topic_types import TypeFinder
from r2p.web.client import WebClient
from r2p.web.dash.live import LiveSource
from r2p.web.dash.session import endpoint

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from websockets.asyncio.server import ServerConnection

    import r2p
    from r2p.web.dash.source import DashSource


class FakeConnection:
    """The connection of a client that reads all, or nothing while `reads` is cleared."""

    subprotocol = None

    def __init__(self) -> None:
        self.sent: list[str | bytes] = []
        self.messages: list[dict[str, Any]] = []
        """What was sent as JSON."""
        self.closed: tuple[int, str] | None = None
        self.reads = asyncio.Event()
        self.reads.set()
        self._inbox: asyncio.Queue[str | bytes | None] = asyncio.Queue()

    async def send(self, message: str | bytes) -> None:
        await self.reads.wait()
        if self.closed is not None:
            raise ConnectionClosedOK(Close(1000, ""), None)
        self.sent.append(message)
        if isinstance(message, str) and message.startswith("{"):
            self.messages.append(json.loads(message))

    async def close(self, code: int, reason: str) -> None:
        self.closed = code, reason
        self.leave()

    def receive(self, message: str | bytes) -> None:
        """Have the server receive a message."""
        self._inbox.put_nowait(message)

    def leave(self) -> None:
        """Have the server see the end of the connection."""
        self._inbox.put_nowait(None)

    async def __aiter__(self) -> AsyncIterator[str | bytes]:
        while (message := await self._inbox.get()) is not None:
            yield message


class FakePage:
    """A page: its requests, and what it gets."""

    def __init__(self, connection: FakeConnection, client: WebClient) -> None:
        self.connection = connection
        self.client = client
        self._numbers = itertools.count(1)

    @property
    def messages(self) -> list[dict[str, Any]]:
        """What has come as JSON."""
        return self.connection.messages

    @property
    def points(self) -> list[bytes]:
        """What has come as bytes."""
        return [each for each in self.connection.sent if isinstance(each, bytes)]

    def news(self, op: str) -> list[dict[str, Any]]:
        """The news of one kind."""
        return [each for each in self.messages if each.get("op") == op]

    def begin(self, op: str, **values: Any) -> int:
        """Send a request; return its number."""
        number = next(self._numbers)
        self.connection.receive(json.dumps({"op": op, "id": number, **values}))
        return number

    async def ask(self, op: str, **values: Any) -> dict[str, Any]:
        """Send a request, and wait for its answer."""
        number = self.begin(op, **values)
        async with asyncio.timeout(60):
            while True:
                found = [each for each in self.messages if each.get("id") == number]
                if found:
                    return found[0]
                await asyncio.sleep(0.01)

    async def result(self, op: str, **values: Any) -> Any:
        answer = await self.ask(op, **values)
        assert "error" not in answer, answer
        return answer["result"]

    async def error(self, op: str, **values: Any) -> str:
        answer = await self.ask(op, **values)
        assert "error" in answer, answer
        return str(answer["error"])


@contextlib.asynccontextmanager
async def open_page(source: DashSource) -> AsyncIterator[FakePage]:
    """A page of a source; at its end it leaves, and what it asked for has to end."""
    connection = FakeConnection()
    async with WebClient(cast("ServerConnection", connection)) as client:
        serving = asyncio.create_task(_coroutine(endpoint(source).handle(client)))
        try:
            yield FakePage(connection, client)
        finally:
            connection.reads.set()
            connection.leave()
            await serving


async def _coroutine(handling: Any) -> None:
    await handling


@contextlib.asynccontextmanager
async def live(module: r2p.Module, *, publish: bool = False, control: bool = False) -> AsyncIterator[LiveSource]:
    """The network of a module as a source of pages."""
    async with (
        NetworkMonitor(module) as monitor,
        LiveSource(module, monitor, TypeFinder(module), allow_publish=publish, allow_control=control) as source,
    ):
        yield source
