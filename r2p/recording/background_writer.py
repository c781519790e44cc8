"""The thread that writes a recording, and the queue in front of it.

The event loop never waits: what does not fit into the queue, as the disk is too slow, is dropped and counted by topic.
Under virtual time there is no thread, and entries are written at once, so the same run writes the same bytes.
"""

import asyncio
import contextlib
import os
import queue
import threading
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO, Final, TypeVar

from r2p.clock import Clock
from r2p.errors import Closed
from r2p.log_lines import get_logger
from r2p.recording.entries import BagEntry
from r2p.recording.recording_files import RecordingFiles, RecordingOptions, open_new

R = TypeVar("R")

logger = get_logger("r2p.recording")

_LOOK_EVERY: Final = 0.1  # s that the thread waits for entries, at the most
_END_REPORT: Final = 5  # s
_SLICE: Final = 64  # entries, some 0.2 ms, after which the thread lets the event loop go on
_PAUSE: Final = 100e-6  # s for that: released for less, the interpreter's lock comes straight back
_HURRY: Final = 16  # the part of the queue's limit, 1/16, from which on there are no pauses


class BackgroundWriter:
    """Writes the entries of a recording into its files."""

    def __init__(
        self,
        path: str | os.PathLike[str],
        options: RecordingOptions,
        clock: Clock,
        report: Callable[[str], None],
        *,
        opened: Callable[[Path], BinaryIO] = open_new,
    ) -> None:
        """Create the file and start the thread, within an event loop. `report` takes lines for the user, in the loop.

        Raises OSError if the file can't be made, FileExistsError among them: no file is ever overwritten; and Error if
        too little of the disk is free.
        """
        self._report = report
        self._loop = asyncio.get_running_loop()
        self._virtual = clock.virtual
        self._limit = options.queue_bytes
        self._dropped: Counter[str] = Counter()
        self._dropping = self._closed = False
        self._put_bytes = self._done_bytes = 0  # each is written by one thread only
        self._jobs: queue.SimpleQueue[tuple[list[BagEntry], int] | Callable[[], bool]] = queue.SimpleQueue()
        self._pause = threading.Lock()
        self._pause.acquire()  # for ever: to wait for it is to release the interpreter's lock
        self._files = RecordingFiles(Path(path), options, clock, self._notify, opened)
        if not self._virtual:
            threading.Thread(target=self._run, name="r2p-disk", daemon=True).start()

    @property
    def paths(self) -> list[Path]:
        """The files of the recording, oldest first, without those that were deleted to make room."""
        return list(self._files.paths)

    @property
    def bytes_written(self) -> int:
        """Bytes in files, those included that were deleted."""
        return self._files.bytes_written

    @property
    def stopped(self) -> str:
        """Why the recording ended by itself, such as a full disk; empty if it goes on."""
        return self._files.stopped

    @property
    def lost(self) -> dict[str, int]:
        """The messages by topic that were handed over and are in no file."""
        lost = Counter(self._dropped)
        lost.update(dict(self._files.lost))  # a copy: the thread counts while this iterates
        return dict(lost)

    @property
    def recorded(self) -> dict[str, int]:
        """The messages by topic in all files, once they are closed."""
        return dict(self._files.recorded)

    @property
    def queued_bytes(self) -> int:
        """Memory of what waits for the disk."""
        return self._put_bytes - self._done_bytes

    def put(self, entries: list[BagEntry]) -> None:
        """Take over a list of entries without waiting. Entries that do not fit the queue are dropped and counted.

        Does nothing after `close`.
        """
        if self._closed:
            return
        if self._virtual:
            self._write(entries)
            return
        size = sum([entry.nbytes for entry in entries])
        if self._dropping and self.queued_bytes < self._limit // 2:
            self._dropping = False
            self._report(f"the disk keeps up again; {self._dropped.total()} messages were dropped so far")
        if self.queued_bytes + size > self._limit:
            entries, size = self._fitting(entries)
        self._put_bytes += size
        self._jobs.put((entries, size))

    def _fitting(self, entries: list[BagEntry]) -> tuple[list[BagEntry], int]:
        """Return the entries that fit the queue, and their size; count the others."""
        room = self._limit - self.queued_bytes
        fitting, size = [], 0
        for entry in entries:
            if size + entry.nbytes <= room + self._limit * entry.urgent:
                fitting.append(entry)
                size += entry.nbytes
            else:
                self._dropped[entry.lost_as] += entry.count
                if not self._dropping:
                    self._dropping = True
                    self._report("the disk is too slow: messages are dropped, and counted by topic")
        return fitting, size

    async def snapshot(self) -> Path:
        """Write a snapshot, and return its file. Raises OSError; Closed after `close`."""
        if self._closed:
            raise Closed(f"the recording {self._files.path} has ended: there is nothing more to write of it")
        return await self._call(self._files.snapshot)

    async def close(self) -> None:
        """Write what waits, and end the file; every few seconds that it takes, say so."""
        if self._closed:
            return
        self._closed = True
        ending = asyncio.ensure_future(self._call(self._files.finish, last=True))
        while not (await asyncio.wait((ending,), timeout=_END_REPORT))[0]:
            self._report(f"the disk is slow: {self.queued_bytes / 1e6:.1f} MB are still to be written")
        await ending

    async def _call(self, function: Callable[[], R], *, last: bool = False) -> R:
        """Call a function in the thread, after all that was put before."""
        if self._virtual:
            return function()
        future: asyncio.Future[R] = self._loop.create_future()

        def job() -> bool:
            try:
                self._in_loop(_resolve, future, function(), None)
            except Exception as error:  # noqa: BLE001 - for the caller
                self._in_loop(_resolve, future, None, error)
            return last

        self._jobs.put(job)
        return await future

    # In the thread

    def _run(self) -> None:
        while True:
            try:
                job = self._jobs.get(timeout=_LOOK_EVERY)
            except queue.Empty:
                self._write([])
                continue
            if callable(job):
                if job():
                    return
                continue
            entries, size = job
            for start in range(0, len(entries), _SLICE):
                self._write(entries[start : start + _SLICE])
                if self.queued_bytes < self._limit // _HURRY:
                    self._pause.acquire(timeout=_PAUSE)
            self._done_bytes += size

    def _write(self, entries: list[BagEntry]) -> None:
        try:
            self._files.write(entries)
            self._files.tick()
        except Exception as error:
            logger.exception("internal error in the thread that writes the recording")
            with contextlib.suppress(Exception):  # whatever comes, the thread goes on, until `close`
                self._files.fail(f"internal error: {error!r}")

    def _notify(self, text: str) -> None:
        if self._virtual:
            self._report(text)
        else:
            self._in_loop(self._report, text)

    def _in_loop(self, function: Callable[..., object], *arguments: object) -> None:
        try:
            self._loop.call_soon_threadsafe(function, *arguments)
        except RuntimeError:  # the loop is closed
            logger.debug("the event loop ended before the recording")


def _resolve(future: "asyncio.Future[R]", result: R, error: Exception | None) -> None:
    if future.done():
        return
    if error is not None:
        future.set_exception(error)
    else:
        future.set_result(result)
