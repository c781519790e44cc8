"""One client of a WebSocket: what waits for it is bounded, and it never keeps others waiting."""

import asyncio
import sys
from collections import Counter, deque
from collections.abc import AsyncIterator
from types import TracebackType
from typing import NamedTuple, Self

from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

QUEUE_BYTES = 4 << 20
"""Bytes of streams that wait for a slow client; beyond that the oldest messages of streams are lost, and counted."""
ANSWERS_BYTES = 16 << 20
"""Bytes of other messages that wait for a client; with more it is disconnected, as it does not read its answers."""

_ROOM = 1 << 16  # bytes that wait for a client beyond which it has no room for more
_MESSAGE_BYTES = 128  # of memory that a waiting message takes besides its data


class _WaitingMessage(NamedTuple):
    """A message in a queue. `number` is its place among all messages, `size` the memory that it takes (bytes)."""

    number: int
    message: str | bytes
    stream: str | None
    amount: int
    size: int


class WebClient:
    """A connected client. `send` never waits; iterating yields its messages until it leaves."""

    def __init__(self, connection: ServerConnection) -> None:
        self.dropped: Counter[str] = Counter()
        """What this client was too slow for, by stream."""
        self.subprotocol = connection.subprotocol
        self._connection = connection
        self._queue: deque[_WaitingMessage] = deque()
        """Messages without a stream."""
        self._streams: deque[_WaitingMessage] = deque()
        """Those of streams, in a queue of their own: dropping the oldest one must not take longer behind answers."""
        self._count = 0
        self._bytes = 0  # of streams
        self._answers = 0  # bytes of messages without a stream
        self._waiting: Counter[str] = Counter()
        """Messages in the queue, by stream."""
        self._wake = asyncio.Event()
        self._has_room = asyncio.Event()
        self._has_room.set()
        self._closing: asyncio.Task[None] | None = None
        self._left = False

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
        if self._closing is not None or self._left:
            return False
        size = sys.getsizeof(message) + _MESSAGE_BYTES  # a text with one emoji has four bytes for each character
        self._count += 1
        waiting = _WaitingMessage(self._count, message, stream, amount, size)
        self._wake.set()
        if self._bytes + self._answers + size > _ROOM:
            self._has_room.clear()
        if stream is None:
            self._queue.append(waiting)
            self._answers += size
            if self._answers > ANSWERS_BYTES:
                self._give_up()
            return True
        self._streams.append(waiting)
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
        self._streams.clear()
        self._waiting.clear()
        self._bytes = self._answers = 0
        self.close(1008, "too slow: what it asked for does not fit the queue")

    def _drop(self) -> None:
        """Drop the oldest messages of streams, until the rest fits."""
        while self._streams and self._bytes > QUEUE_BYTES:
            oldest = self._streams.popleft()
            self._forget(oldest)
            if oldest.stream is not None:
                self.dropped[oldest.stream] += oldest.amount

    def _next(self) -> _WaitingMessage | None:
        """Take the message that has waited longest."""
        if self._streams and not (self._queue and self._queue[0].number < self._streams[0].number):
            return self._streams.popleft()
        return self._queue.popleft() if self._queue else None

    def _forget(self, entry: _WaitingMessage) -> None:
        """Subtract a message from those that wait."""
        if entry.stream is None:
            self._answers -= entry.size
            return
        self._bytes -= entry.size
        self._waiting[entry.stream] -= 1
        if not self._waiting[entry.stream]:
            del self._waiting[entry.stream]

    async def _write(self) -> None:
        try:
            while True:
                self._wake.clear()
                while (entry := self._next()) is not None:
                    self._forget(entry)
                    await self._connection.send(entry.message)
                    if self._bytes + self._answers <= _ROOM:
                        self._has_room.set()
                await self._wake.wait()
        except ConnectionClosed:
            return
        finally:
            self._left = True
            self._has_room.set()
