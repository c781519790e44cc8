"""One client of a WebSocket: what waits for it is bounded, and it never keeps others waiting."""

import asyncio
from collections import Counter, deque
from collections.abc import AsyncIterator
from types import TracebackType
from typing import Self

from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

QUEUE_BYTES = 4 << 20
"""Bytes that wait for a slow client; beyond that its oldest droppable messages are lost, and counted."""


class WebClient:
    """A connected client. `send` never waits; iterating yields its messages until it leaves."""

    def __init__(self, connection: ServerConnection) -> None:
        self.dropped: Counter[str] = Counter()
        """Messages that this client was too slow for, by their stream."""
        self.subprotocol = connection.subprotocol
        self._connection = connection
        self._queue: deque[tuple[str | bytes, str | None]] = deque()
        self._bytes = 0
        self._wake = asyncio.Event()

    async def __aenter__(self) -> Self:
        self._writer = asyncio.create_task(self._write())
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._writer.cancel()
        await asyncio.wait([self._writer])

    async def __aiter__(self) -> AsyncIterator[str | bytes]:
        try:
            async for message in self._connection:
                yield message
        except ConnectionClosed:
            return

    def send(self, message: str | bytes, stream: str | None = None) -> bool:
        """Send a message, without waiting; return False if older ones had to be dropped for it.

        A message of a `stream` may be dropped for newer ones when the client is too slow. One without a stream is
        never dropped: a client that does not read these is disconnected.
        """
        self._queue.append((message, stream))
        self._bytes += len(message)
        self._wake.set()
        if self._bytes <= QUEUE_BYTES:
            return True
        self._drop()
        return False

    def close(self, code: int = 1000, reason: str = "") -> None:
        """Disconnect the client, with a reason of at most 123 bytes."""
        self._closing = asyncio.create_task(self._connection.close(code, reason))

    def _drop(self) -> None:
        """Drop the oldest messages of streams, until the rest fits."""
        kept: deque[tuple[str | bytes, str | None]] = deque()
        while self._queue and self._bytes > QUEUE_BYTES:
            message, stream = self._queue.popleft()
            if stream is None:
                kept.append((message, stream))
            else:
                self._bytes -= len(message)
                self.dropped[stream] += 1
        self._queue.extendleft(reversed(kept))
        if self._bytes > QUEUE_BYTES:
            self._queue.clear()
            self._bytes = 0
            self.close(1008, "too slow: what it asked for does not fit the queue")

    async def _write(self) -> None:
        try:
            while True:
                self._wake.clear()
                while self._queue:
                    message, _ = self._queue.popleft()
                    self._bytes -= len(message)
                    await self._connection.send(message)
                await self._wake.wait()
        except ConnectionClosed:
            return
