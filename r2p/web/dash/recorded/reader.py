"""Reads a recording in a thread of its own, a step at a time, so that many tasks take turns."""

import asyncio
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

from r2p.errors import BagError
from r2p.recording.bag import Bag
from r2p.recording.channels import BagChannel
from r2p.recording.mcap_reader import ChunkRef, MessageRecord
from r2p.recording.message_index import chunk_times, indexed

T = TypeVar("T")

_KEPT_BYTES = 32 << 20  # of messages, and of times, of the chunks that were read last
_OF_RECORD = 200  # bytes of a message besides its data
_OF_TIME = 40  # bytes of a time in a list


class RecordingReader:
    """Opens a bag while its block is open, and runs functions that read it, one after the other, in a thread.

    A task that reads many chunks asks for each of them by itself, so that others take their turn.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        self.paths = paths
        self.damaged: set[tuple[int, int]] = set()
        """Chunks that could not be read: by file and offset."""
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="r2p recording")
        self._waiting = 0
        self._idle = asyncio.Event()
        self._idle.set()
        self._cache = ChunkCache()

    async def __aenter__(self) -> Self:
        """Begin to open the files; `opened` is when that is done."""
        self.opened: asyncio.Task[Bag] = asyncio.create_task(self.run(lambda: Bag(self.paths)), name="open recording")
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the files, after the step that is being done."""
        await asyncio.wait([self.opened])
        if not self.opened.cancelled() and self.opened.exception() is None:
            self._thread.submit(self.opened.result().close)
        self._thread.shutdown(wait=False, cancel_futures=False)

    async def bag(self) -> Bag:
        """Wait until the recording is open. Raises BagError."""
        return await asyncio.shield(self.opened)

    async def run(self, step: Callable[[], T]) -> T:
        """Run a function in the thread, after those that wait, and return its result."""
        with self.ahead():
            return await asyncio.get_running_loop().run_in_executor(self._thread, step)

    @contextmanager
    def ahead(self) -> Iterator[None]:
        """Hold back work of lower priority during the block, also between two steps."""
        self._waiting += 1
        self._idle.clear()
        try:
            yield
        finally:
            self._waiting -= 1
            if not self._waiting:
                self._idle.set()

    async def run_behind(self, step: Callable[[], T]) -> T:
        """Run a function in the thread at low priority, in turn with other background work."""
        await self._idle.wait()
        return await asyncio.get_running_loop().run_in_executor(self._thread, step)

    # In the thread

    def records(self, bag: Bag, number: int, chunk: ChunkRef, channels: frozenset[int]) -> list[MessageRecord]:
        """Return the messages of some channels in a chunk, in the order of time; of a damaged chunk none."""

        def read() -> tuple[list[MessageRecord], int]:
            found = indexed(bag.files[number], chunk, channels)
            return found, sum([_OF_RECORD + len(each[4]) for each in found])

        return self._cache.get((number, chunk.offset, channels), lambda: self._unless_damaged(number, chunk, read))

    def times(self, bag: Bag, number: int, chunk: ChunkRef) -> dict[int, list[int]]:
        """Return the log times of the messages in a chunk by channel, each in order."""

        def read() -> tuple[dict[int, list[int]], int]:
            found = {channel: sorted(each) for channel, each in chunk_times(bag.files[number], chunk).items()}
            return found, sum([_OF_TIME * len(each) for each in found.values()])

        return self._cache.get((number, chunk.offset, None), read)

    def _unless_damaged(
        self, number: int, chunk: ChunkRef, read: Callable[[], tuple[list[MessageRecord], int]]
    ) -> tuple[list[MessageRecord], int]:
        try:
            return read()
        except BagError:
            self.damaged.add((number, chunk.offset))
            return [], 0


class ChunkCache:
    """What was read of chunks last, up to a number of bytes."""

    def __init__(self, limit: int = _KEPT_BYTES) -> None:
        self._limit = limit
        self._bytes = 0
        self._kept: OrderedDict[object, tuple[Any, int]] = OrderedDict()

    def get(self, key: object, read: Callable[[], tuple[T, int]]) -> T:
        """Return what is kept under a key, or read it, which returns it with its bytes."""
        known = self._kept.get(key)
        if known is not None:
            self._kept.move_to_end(key)
            kept: T = known[0]
            return kept
        found, size = read()
        size += _OF_RECORD
        if size > self._limit // 2:
            return found
        self._kept[key] = found, size
        self._bytes += size
        while self._bytes > self._limit:
            _, (_, freed) = self._kept.popitem(last=False)
            self._bytes -= freed
        return found


class ChunkTable:
    """All chunks of a bag that have messages of some channels, in the order of their first messages.

    Chunks may overlap, those of several files, and of some programs: `reach` has the latest end so far, so that all
    chunks with messages after an instant are found without a look at those before it.
    """

    def __init__(self, bag: Bag, wanted: Callable[[BagChannel], bool]) -> None:
        self.ids = [frozenset(key for key, each in file.channels.items() if wanted(each)) for file in bag.files]
        self.chunks: list[tuple[int, ChunkRef]] = sorted(
            (
                (number, chunk)
                for number, file in enumerate(bag.files)
                for chunk in file.summary.chunks
                if self.ids[number] and chunk.may_have(self.ids[number])
            ),
            key=lambda each: (each[1].start, each[0], each[1].offset),
        )
        self._starts = [chunk.start for _, chunk in self.chunks]
        self._reach: list[int] = []
        for _, chunk in self.chunks:
            self._reach.append(max(chunk.end, self._reach[-1] if self._reach else 0))

    def between(self, start: int, end: int) -> list[tuple[int, ChunkRef]]:
        """Return the chunks that may have messages from `start` to `end` (ns, both included), in order."""
        return [each for each in reversed(list(self.back_from(end, start))) if each[1].end >= start]

    def back_from(self, end: int, start: int = 0) -> Iterator[tuple[int, ChunkRef]]:
        """Yield the chunks that begin at `end` or before, the last one first, as far as they may reach `start`."""
        for i in range(bisect_right(self._starts, end) - 1, -1, -1):
            if self._reach[i] < start:
                return
            yield self.chunks[i]
