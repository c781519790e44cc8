"""The files of a recording, as the thread that writes them sees them: limits, splitting, a full disk, snapshots."""

import contextlib
import errno
import os
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import BinaryIO, Final

import msgspec

from r2p.clock import Clock
from r2p.errors import Error
from r2p.log_lines import get_logger
from r2p.recording.entries import BagEntry, EntryWriter
from r2p.recording.format import META_PREFIX
from r2p.recording.mcap_writer import McapWriter, PackedChunk
from r2p.recording.writer import BagWriter
from r2p.units import MILLISECOND, SECOND

logger = get_logger("r2p.recording")

_CHUNK_EVERY: Final = 500 * MILLISECOND  # ns after which messages go to the operating system, full chunk or not
_SYNC_EVERY: Final = SECOND  # ns after which they have to be on the disk
_FULL: Final = frozenset((errno.ENOSPC, errno.EDQUOT, errno.EFBIG))
_RING_MAX: Final = 1 << 30  # bytes in memory for a snapshot, unless max_size says otherwise
_GB: Final = 1_000_000_000
_FILES_OF_TOTAL: Final = 10  # files that share max_total, where nothing else says when a file ends


class RecordingOptions(msgspec.Struct, frozen=True, kw_only=True):
    """Options for the files of a recording. Sizes are in bytes, times in seconds; 0 turns a limit off.

    The recording ends at `max_size` or `max_duration`; with `split`, another file begins there. `max_total` is for all
    files: the oldest are deleted, and so they are when the disk is full. With less than `min_free` on the disk the
    recording ends. With `snapshot`, that many seconds are kept in memory, of which they may take `max_size`, and
    written when asked for. `queue_bytes` is the memory for what waits for a slow disk. Raises ValueError for options
    that don't go together.
    """

    max_size: int = 0
    max_duration: float = 0.0
    split: bool = False
    snapshot: float = 0.0
    min_free: int = 0
    max_total: int = 0
    queue_bytes: int = 64 << 20

    def __post_init__(self) -> None:
        if self.max_total and not self.split:
            raise ValueError("max_total deletes the oldest files of a recording: it needs split")
        if self.split and not (self.max_size or self.max_duration or self.max_total):
            raise ValueError("split needs a max_size or max_duration for each file, or a max_total for all")
        if self.snapshot and (self.split or self.max_duration):
            raise ValueError("snapshot writes a file when asked for: max_duration and split don't go with it")

    @property
    def file_size(self) -> int:
        """The bytes of one file; 0: no limit."""
        share = self.max_total // _FILES_OF_TOTAL if not self.max_duration else 0
        return self.max_size or share


def open_new(path: Path) -> BinaryIO:
    """Create a file. Raises FileExistsError, or another OSError."""
    return path.open("xb+", buffering=0)


class BackgroundSync:
    """Brings what was written to the disk, in a thread of its own: an SD card may take seconds for it."""

    def __init__(self, *, enabled: bool) -> None:
        self._enabled = enabled
        self._thread: threading.Thread | None = None
        self._error: OSError | None = None

    def start(self, file: BinaryIO) -> None:
        """Begin with a file, unless the last time still goes on. Raises the OSError of the last time."""
        if not self._enabled or (self._thread is not None and self._thread.is_alive()):
            return
        self.join()
        self._thread = threading.Thread(target=self._run, args=(file.fileno(),), name="r2p-sync", daemon=True)
        self._thread.start()

    def join(self) -> None:
        """Wait for the running synchronisation, and raise its OSError, if any."""
        if self._thread is not None:
            self._thread.join()
        self._thread = None
        error, self._error = self._error, None
        if error is not None:
            raise error

    def _run(self, descriptor: int) -> None:
        try:
            os.fdatasync(descriptor)
        except OSError as error:
            self._error = error


class RecordingFiles:
    """The files of a recording. All methods wait for the disk.

    `entries` writes into chunks in memory, which `write` and `tick` bring to the disk. `stopped` says why there is
    nothing more to write; `lost` counts by topic what had been accepted and is not in a file.
    """

    def __init__(
        self,
        path: Path,
        options: RecordingOptions,
        clock: Clock,
        report: Callable[[str], None],
        opened: Callable[[Path], BinaryIO] = open_new,
    ) -> None:
        """Create the first file; for snapshots, only try whether that can be done.

        Raises OSError, and Error if too little of the disk is free.
        """
        self.path = path
        self.paths: list[Path] = []
        self.stopped = ""
        self.lost: Counter[str] = Counter()
        self.recorded: Counter[str] = Counter()
        """The messages by topic in finished files, those included that were deleted."""
        self.finished_bytes = 0
        self.writer = BagWriter()
        self.entries = EntryWriter(self.writer)
        self._options = options
        self._clock = clock
        self._report = report
        self._opened = opened
        self._number = 0
        self._sizes: dict[Path, int] = {}  # of finished files
        self._ring: deque[PackedChunk] = deque()
        self._ring_size = 0
        self._syncing = BackgroundSync(enabled=not clock.virtual)
        self._failed = False
        self._began = clock.monotonic()
        self._chunk_due, self._sync_due = self._began + _CHUNK_EVERY, self._began + _SYNC_EVERY
        self._raw: BinaryIO | None = None
        self._file: McapWriter | None = None
        if (free := self._free()) < options.min_free:
            raise Error(f"{path} has only {_size(free)} of disk: {_size(options.min_free)} are to stay free (min_free)")
        if options.snapshot:
            self._try_to_create()
        else:
            self._open()

    @property
    def bytes_written(self) -> int:
        """Bytes in all files, those included that were deleted."""
        file = self._file  # once: another thread asks
        return self.finished_bytes + (0 if file is None else file.size)

    # Entries

    def write(self, entries: Iterable[BagEntry]) -> None:
        """Write entries into chunks, and full chunks into the file."""
        if self.stopped:
            self._refuse(entries)
            return
        for entry in entries:
            try:
                entry.write(self.entries)
            except Exception as error:  # noqa: BLE001 - one bad entry costs no other
                self._refuse([entry], error)
        self._write_out()

    def _refuse(self, entries: Iterable[BagEntry], error: Exception | None = None) -> None:
        """Count entries that are not recorded; not those behind a limit that the user set."""
        if self.stopped and not self._failed:
            return
        for entry in entries:
            if error is not None and entry.lost_as not in self.lost:
                self._report(f"a message of {entry.lost_as} can't be recorded: {error}; more of them are only counted")
                logger.debug("a message of %s can't be recorded", entry.lost_as, exc_info=error)
            self.lost[entry.lost_as] += entry.count

    def tick(self) -> None:
        """End the chunk every half second, and see to it that it is on the disk every second. Call it often."""
        now = self._clock.monotonic()
        if now >= self._chunk_due:
            self._chunk_due = now + _CHUNK_EVERY
            self.writer.end_chunk()
            self._write_out()
        if now >= self._sync_due:
            self._sync_due = now + _SYNC_EVERY
            self._sync()
        limit = self._options.max_duration
        if limit and not self.stopped and now - self._began >= limit * SECOND:
            self.writer.end_chunk()
            self._write_out()
            self._limit_reached(f"max_duration ({limit:g} s)")

    def _sync(self) -> None:
        if self._raw is None:
            return
        try:
            self._syncing.start(self._raw)
            self._check_free()
        except OSError as error:
            self._on_error(error)

    def _check_there(self) -> None:
        """Go on in another file, or end the recording, if another program has deleted the file, or cut it off."""
        raw, file = self._raw, self._file
        if raw is None or file is None:
            return
        path, found = self.paths[-1], os.fstat(raw.fileno())
        if not found.st_nlink:
            named = [(self._name_of(channel), count) for channel, count in file.counts.items()]
            total = sum(count for name, count in named if not name.startswith(META_PREFIX))
            why = f"another program has deleted {path} with {total} messages"
        elif found.st_size < file.size:
            why = f"another program has cut {path} off: try `r2p bag recover`"
        else:
            return
        before = Counter(self.recorded)
        if self._options.split:
            self._report(f"{why}; the recording goes on in the next file")
            self._next_file()
        else:
            self.fail(why)
        if not found.st_nlink:
            self._forget(path, self.recorded - before)

    def _forget(self, path: Path, messages: Counter[str]) -> None:
        """Count the messages of a file that is gone as lost."""
        self.recorded -= messages
        self.lost.update({name: count for name, count in messages.items() if not name.startswith(META_PREFIX)})
        self.paths.remove(path)
        self._sizes.pop(path, None)

    def _check_free(self) -> None:
        while self._options.min_free and self._free() < self._options.min_free:
            if not self._delete_oldest():
                self.fail(f"less than {_size(self._options.min_free)} are free on the disk (min_free)")
                return

    # Out to the disk

    def _write_out(self) -> None:
        if self._options.snapshot:
            self._keep()
            return
        ready = self.writer.ready
        if ready:
            self._check_there()
        while ready and self._file is not None:
            item = ready[0]
            if isinstance(item, PackedChunk) and self._over(item):
                self._limit_reached(f"max_size ({_size(self._options.file_size)})")
                continue
            try:
                self._file.write(item)
            except OSError as error:
                self._on_error(error)
                continue
            ready.popleft()
        self._check_total()

    def _over(self, chunk: PackedChunk) -> bool:
        file, limit = self._file, self._options.file_size
        assert file is not None
        return (
            bool(limit)
            and file.has_messages
            and file.size + chunk.size + file.summary_size + chunk.summary_size > limit
        )

    def _limit_reached(self, limit: str) -> None:
        if self._options.split and not self.stopped:
            self._next_file()
        elif not self.stopped:
            self.stopped = f"{limit} is reached"
            self.writer.ready.clear()
            self._finish_file()
            self._report(f"the recording ended: {self.stopped}")

    def _next_file(self) -> None:
        """Finish this file, and go on in another one, which begins with the channels, metadata and attachments."""
        self._finish_file()
        while self._file is None and not self.stopped:
            try:
                self._open()
            except OSError as error:
                self._on_error(error)

    def _open(self) -> None:
        """Create the next file. Raises OSError, and leaves no file behind then."""
        path, raw = self._create()
        try:
            file = McapWriter(raw)
        except OSError:
            _discard(raw, path)
            raise
        _sync_directory(path.parent)
        self.paths.append(path)
        self._began = self._clock.monotonic()
        self._raw, self._file = raw, file
        waiting = [item for item in self.writer.ready if isinstance(item, PackedChunk)]
        self.writer.ready.clear()
        self.writer.ready.extend((*self.writer.registered, *waiting))

    def _create(self) -> tuple[Path, BinaryIO]:
        while True:
            path = self._next_path()
            try:
                return path, self._opened(path)
            except FileExistsError:
                first = self._number == 1 and not self._options.snapshot
                if first or not self._numbered:  # others take the next number that is free
                    raise

    def _try_to_create(self) -> None:
        """Create the next file, and delete it again. Raises OSError."""
        number = self._number
        path, raw = self._create()
        _discard(raw, path)
        self._number = number

    @property
    def _numbered(self) -> bool:
        return self._options.split or bool(self._options.snapshot)

    def _next_path(self) -> Path:
        self._number += 1
        return self.path.with_stem(f"{self.path.stem}-{self._number:04}") if self._numbered else self.path

    def _finish_file(self) -> None:
        """Write the summary, in place of the last chunks if the disk has no room for it."""
        raw, file = self._raw, self._file
        self._raw = self._file = None
        if raw is None or file is None:
            return
        try:
            self._finish_with_room(file)
            self._syncing.join()
            self._sync_file(raw)
        except OSError as error:
            self._report(f"{self.paths[-1]} may not be whole ({error.strerror}): try `r2p bag recover`")
        finally:
            self._close(raw, file)

    def _sync_file(self, raw: BinaryIO) -> None:
        if not self._clock.virtual:
            os.fdatasync(raw.fileno())

    def _close(self, raw: BinaryIO, file: McapWriter) -> None:
        with contextlib.suppress(OSError):
            self._syncing.join()
        with contextlib.suppress(OSError):
            raw.close()
        for channel, count in file.counts.items():
            self.recorded[self._name_of(channel)] += count
        self.finished_bytes += file.size
        self._sizes[self.paths[-1]] = file.size

    def _finish_with_room(self, file: McapWriter) -> None:
        while True:
            try:
                file.finish()
                return
            except OSError as error:
                if error.errno not in _FULL or not file.has_messages:
                    raise
            if self._delete_oldest():
                continue
            self._give_up(file.drop_last_chunk())

    def _give_up(self, chunk: PackedChunk | None) -> None:
        """Move a chunk that made room for the end of its file to the next file; without one its messages are lost."""
        if chunk is None:
            return
        if self._options.split and not self.stopped:
            self.writer.ready.appendleft(chunk)
            return
        count = self._count_lost(chunk)
        self._report(f"the disk is full: the last {count} messages made room for the end of the file")

    # What goes wrong

    def _on_error(self, error: OSError) -> None:
        """Make room, or go on in another file; otherwise the recording ends."""
        if error.errno == errno.EFBIG and self._options.split and self._file is not None and self._file.has_messages:
            self._next_file()
        elif error.errno not in _FULL or not self._delete_oldest():
            hint = "" if self._options.split or error.errno != errno.EFBIG else "; split goes on in another one"
            self.fail(_reason(error) + hint)

    def _delete_oldest(self) -> bool:
        if not self._options.max_total or len(self.paths) < 2:
            return False
        path = self.paths[0]
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            logger.debug("can't delete %s", path, exc_info=error)
            return False
        self.paths.remove(path)
        self._sizes.pop(path, None)
        return True

    def _check_total(self) -> None:
        limit, file = self._options.max_total, self._file
        if limit and file is not None:
            while sum(self._sizes.values()) + file.size + file.summary_size > limit and self._delete_oldest():
                pass

    def fail(self, why: str) -> None:
        """End the recording after an error of the disk, with a complete file."""
        self.stopped, self._failed = why, True
        self.writer.end_chunk()
        lost = sum(self._count_lost(item) for item in self.writer.ready if isinstance(item, PackedChunk))
        self.writer.ready.clear()
        self._finish_file()
        self._report(f"the recording ended: {why}" + (f"; the last {lost} messages are lost" if lost else ""))

    def _count_lost(self, chunk: PackedChunk) -> int:
        """Count the messages of a chunk that is in no file, and return how many they are."""
        total = 0
        for channel, part in chunk.channels.items():
            if not (name := self._name_of(channel)).startswith(META_PREFIX):
                self.lost[name] += part.count
                total += part.count
        return total

    def _name_of(self, channel: int) -> str:
        """Return the name under which the messages of a channel are counted: that of their topic, if they have one."""
        about = self.writer.channels[channel]
        return about.topic if about.topic.startswith(META_PREFIX) else about.metadata.get("topic", about.topic)

    def _free(self) -> int:
        found = os.statvfs(self.path.parent)
        return found.f_bavail * found.f_frsize

    # Snapshots

    def _keep(self) -> None:
        """Keep the chunks of the last seconds in memory."""
        chunks = [item for item in self.writer.ready if isinstance(item, PackedChunk)]
        self.writer.ready.clear()
        self._ring.extend(chunks)
        self._ring_size += sum(chunk.size for chunk in chunks)
        if self._ring:
            oldest = self._ring[-1].end - round(self._options.snapshot * SECOND)
            limit = self._options.max_size or _RING_MAX
            while len(self._ring) > 1 and (self._ring[0].end < oldest or self._ring_size > limit):
                self._ring_size -= self._ring.popleft().size

    def snapshot(self) -> Path:
        """Write the messages in memory into a new file. Raises OSError, and leaves no file behind then."""
        self.writer.end_chunk()
        self._keep()
        self._open()
        self.writer.ready.clear()
        raw, file, path = self._raw, self._file, self.paths[-1]
        self._raw = self._file = None
        assert raw is not None
        assert file is not None
        try:
            self._fill(file)
            self._sync_file(raw)
        except OSError:
            self.paths.pop()
            _discard(raw, path)
            raise
        self._close(raw, file)
        return path

    def _fill(self, file: McapWriter) -> None:
        for record in self.writer.registered:
            file.write(record)
        for chunk in self._ring:
            file.write(chunk)
        file.finish()

    def finish(self) -> None:
        """Write what is left, and end the file."""
        self.writer.end_chunk()
        self._write_out()
        self._finish_file()


def _discard(raw: BinaryIO, path: Path) -> None:
    """Close and delete a file that could not be written."""
    for step in (raw.close, path.unlink):
        with contextlib.suppress(OSError):
            step()


def _sync_directory(path: Path) -> None:
    """Let the name of a new file survive a loss of power."""
    with contextlib.suppress(OSError):
        directory = os.open(path, os.O_RDONLY)
        try:
            os.fsync(directory)
        finally:
            os.close(directory)


def _size(count: int) -> str:
    return f"{count / 1e9:.1f} GB" if count >= _GB else f"{count / 1e6:.4g} MB"


def _reason(error: OSError) -> str:
    if error.errno == errno.EFBIG:
        return "the file has the largest size that its file system, or a limit of this process, allows"
    return "the disk is full" if error.errno in _FULL else f"the disk failed: {error.strerror or error}"
