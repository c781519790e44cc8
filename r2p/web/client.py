"""One client of a WebSocket: what waits for it is bounded, and it never keeps others waiting."""

import asyncio
from collections import Counter, deque
from collections.abc import AsyncIterator
from types import TracebackType
from typing import Self

from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

QUEUE_BYTES = 4 << 20
"""Bytes of streams that wait for a slow client; beyond that the oldest messages of streams are lost, and counted."""
ANSWERS_BYTES = 16 << 20
"""Bytes of other messages that wait for a client; with more it is disconnected, as it does not read its answers."""

_ROOM = 1 << 16  # bytes that wait for a client beyond which it has no room for more
_MESSAGE_BYTES = 128  # of memory that a waiting message takes besides its data


class WebClient:
    """A connected client. `send` never waits; iterating yields its messages until it leaves."""

    def __init__(self, connection: ServerConnection) -> None:
        self.dropped: Counter[str] = Counter()
        """What this client was too slow for, by stream."""
        self.subprotocol = connection.subprotocol
        self._connection = connection
        self._queue: deque[tuple[str | bytes, str | None, int]] = deque()
        self._bytes = 0  # of streams
        self._answers = 0  # bytes of messages without a stream
        self._waiting: Counter[str] = Counter()
        """Messages in the queue, by stream."""
        self._wake = asyncio.Event()
        self._has_room = asyncio.Event()
        self._has_room.set()
        self._closing: asyncio.Task[None] | None = None

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

    def send(self, message: str | bytes, stream: str | None = None, *, amount: int = 1) -> bool:
        """Send a message, without waiting; return False if older ones had to be dropped for it.

        A message of a `stream` may be dropped for newer ones when the client is too slow, which counts as `amount`. One
        without a stream is never dropped: a client that does not read these is disconnected.
        """
        if self._closing is not None:
            return False
        size = len(message) + _MESSAGE_BYTES
        self._queue.append((message, stream, amount))
        self._wake.set()
        if self._bytes + self._answers + size > _ROOM:
            self._has_room.clear()
        if stream is None:
            self._answers += size
            if self._answers > ANSWERS_BYTES:
                self._give_up()
            return True
        self._bytes += size
        self._waiting[stream] += 1
        if self._bytes <= QUEUE_BYTES:
            return True
        self._drop()
        return False

    def send_newest(self, message: str | bytes, stream: str) -> bool:
        """Send a message of a stream of which only the newest counts: dropped while an older one still waits."""
        if self._waiting[stream]:
            self.dropped[stream] += 1
            return False
        return self.send(message, stream)

    async def room(self) -> None:
        """Wait until little waits for the client, or it has left."""
        await self._has_room.wait()

    def close(self, code: int = 1000, reason: str = "") -> None:
        """Disconnect the client, with a reason of at most 123 bytes."""
        if self._closing is None:
            self._closing = asyncio.create_task(self._connection.close(code, reason))

    def _give_up(self) -> None:
        self._queue.clear()
        self._waiting.clear()
        self._bytes = self._answers = 0
        self.close(1008, "too slow: what it asked for does not fit the queue")

    def _drop(self) -> None:
        """Drop the oldest messages of streams, until the rest fits."""
        kept: deque[tuple[str | bytes, str | None, int]] = deque()
        while self._queue and self._bytes > QUEUE_BYTES:
            entry = self._queue.popleft()
            message, stream, amount = entry
            if stream is None:
                kept.append(entry)
            else:
                self._forget(message, stream)
                self.dropped[stream] += amount
        self._queue.extendleft(reversed(kept))

    def _forget(self, message: str | bytes, stream: str | None) -> None:
        """Count a message no longer as waiting."""
        size = len(message) + _MESSAGE_BYTES
        if stream is None:
            self._answers -= size
            return
        self._bytes -= size
        self._waiting[stream] -= 1
        if not self._waiting[stream]:
            del self._waiting[stream]

    async def _write(self) -> None:
        try:
            while True:
                self._wake.clear()
                while self._queue:
                    message, stream, _ = self._queue.popleft()
                    self._forget(message, stream)
                    await self._connection.send(message)
                    if self._bytes + self._answers <= _ROOM:
                        self._has_room.set()
                await self._wake.wait()
        except ConnectionClosed:
            return
        finally:
            self._has_room.set()
