"""The pace of playing: when each record of a recording is due, with a rate, pauses and single steps.

A `Pacer` maps instants of the recording (UTC, ns) to those of `Clock.monotonic()`. A `PacedStream` reads records ahead,
in a thread, and plays each at its instant, with an exact alarm. Streams that play at the same time, such as messages
and CAN frames, share one pacer, so they pause and step together:

    pacer = Pacer(loop, rate=2.0)
    messages, frames = PacedStream(pacer, play_message, size), PacedStream(pacer, play_frame, size)
    await messages.open(items)              # until the first ones are read
    await frames.open(others)
    pacer.begin(start)
    await asyncio.gather(messages.run(), frames.run())

Under virtual time there is no thread, so each run is the same.
"""

import abc
import asyncio
import contextlib
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Final, Generic, TypeVar

from r2p.clock import ExactAlarm, clock_of
from r2p.errors import MessageError
from r2p.units import MILLISECOND

T = TypeVar("T")

SLOWEST: Final = 0.001
FASTEST: Final = 10_000.0
"""The limits of the rate, times the speed of the recording."""

_LATE_MAX: Final = 100 * MILLISECOND  # ns that playing makes up for; after a longer stop all that follows is put off
_UTC_ERROR_MAX: Final = 5 * MILLISECOND
_PER_TURN: Final = 64  # records that are played in one turn of the event loop
_BATCH: Final = 32  # records that are read at once: 0.3 ms, for which the loop may wait
_BATCH_BYTES: Final = 1 << 20
_AHEAD: Final = 256  # batches that are read ahead, at most
_AHEAD_BYTES: Final = 32 << 20
_NEAR: Final = 8  # batches ahead, from which on reading lets the loop run in between
_REST: Final = 0.002  # s between two batches then
_SWITCH: Final = 0.0002  # s after which a thread that reads is interrupted; Python's default is 5 ms
_JOIN: Final = 1.0  # s to wait for a thread that may wait for the disk


def check_rate(rate: float) -> float:
    """Return a valid rate. Raises MessageError."""
    if not SLOWEST <= rate <= FASTEST:
        raise MessageError(f"the rate is {SLOWEST:g} to {FASTEST:g} times the recording's speed, not {rate!r}")
    return rate


class Pacer:
    """The position in a recording while it is played. Raises MessageError for a rate that is out of range."""

    def __init__(self, loop: asyncio.AbstractEventLoop, *, rate: float = 1.0) -> None:
        self.put_off = 0
        """Ns by which playing is behind its own time, as the program or the disk stood still."""
        self._clock = clock_of(loop)
        self._rate = check_rate(rate)
        self._paused = False
        self._recorded = 0
        self._monotonic = self._clock.monotonic()
        self._utc = self._clock.now()
        self._streams: list[PacedStream[Any]] = []

    @property
    def rate(self) -> float:
        """How many times as fast as it was recorded. Raises MessageError when it is set to what is out of range."""
        return self._rate

    @rate.setter
    def rate(self, rate: float) -> None:
        position = self.position
        self._rate = check_rate(rate)
        self.begin(position)

    @property
    def paused(self) -> bool:
        return self._paused

    @property
    def position(self) -> int:
        """The instant of the recording that is played now (UTC, ns)."""
        if self._paused:
            return self._recorded
        return self._recorded + round((self._clock.monotonic() - self._monotonic) * self._rate)

    def begin(self, recorded: int) -> None:
        """Go to this instant of the recording; what streams have read ahead stays, and is played when it is due."""
        self._recorded, self._monotonic, self._utc = recorded, self._clock.monotonic(), self._clock.now()
        self._rearm()

    def pause(self) -> None:
        """Stop between two records."""
        self._recorded, self._paused = self.position, True

    def resume(self) -> None:
        """Go on after a pause."""
        if self._paused:
            self._paused = False
            self.begin(self._recorded)

    def step(self) -> None:
        """Pause, and play the next record of all streams."""
        self.pause()
        waiting = [(time, i) for i, each in enumerate(self._streams) if (time := each.next_time) is not None]
        if waiting:
            time, i = min(waiting)
            self._recorded = max(time, self._recorded)
            self._streams[i].play_next()

    def instant(self, recorded: int) -> int | None:
        """Return when an instant of the recording is due (monotonic ns); None while playing is paused."""
        if self._paused:
            return None
        return self._monotonic + round((recorded - self._recorded) / self._rate)

    def utc(self, recorded: int) -> int:
        """Return the time at which an instant of the recording is played (UTC, ns); what is played late has no delay.

        So stamps have the distances that they had, whatever the delays of this computer are.
        """
        now, due = self._clock.now(), self.instant(recorded)
        if due is None:
            return now
        error = now - (self._clock.monotonic() - due) - (self._utc + due - self._monotonic)
        if abs(error) > _UTC_ERROR_MAX:
            self._utc += error  # UTC was set
        return self._utc + due - self._monotonic

    def behind(self, late: int) -> None:
        """Note that a record is late by so many ns; after a stop all that follows is put off, and not played at once.

        So a robot does not get the commands of a minute in one moment.
        """
        if late > _LATE_MAX:
            self.put_off += late
            self._monotonic += late
            self._utc += late
            self._rearm()

    def add(self, stream: "PacedStream[Any]") -> None:
        self._streams.append(stream)

    def remove(self, stream: "PacedStream[Any]") -> None:
        self._streams.remove(stream)

    def _rearm(self) -> None:
        for stream in self._streams:
            stream.rearm()


class PacedStream(Generic[T]):
    """Plays records, each at its instant. `play(time, record)` is called in the event loop, in order.

    Records are given with their times in the recording (UTC, ns), oldest first; one that is older than the one before
    is played directly after it. `size` returns the bytes of a record, as those that are read ahead have a limit.
    """

    def __init__(self, pacer: Pacer, play: Callable[[int, T], object], size: Callable[[T], int]) -> None:
        self.played = 0
        """Records that were played."""
        self._pacer = pacer
        self._play = play
        self._size = size
        self._loop = asyncio.get_running_loop()
        self._clock = clock_of(self._loop)
        self._alarm = ExactAlarm(self._loop, self._play_due)
        self._reader: _RecordReader[T] | None = None
        self._batch: deque[tuple[int, T]] = deque()
        self._over: asyncio.Future[None] | None = None
        self._open = False

    async def open(self, records: Iterable[tuple[int, T]]) -> None:
        """Begin to read, and wait until the first records are there. Raises what reading raises."""
        self.close()
        kind = _InlineReader if self._clock.virtual else _ThreadReader
        self._reader = kind(iter(records), self._size, self._loop, self._more)
        self._open = True
        self._pacer.add(self)
        try:
            await self._reader.first()
        except BaseException:
            self.close()
            raise

    async def run(self) -> None:
        """Play all records from now on; then close. Raises what reading or playing raises."""
        self._over = self._loop.create_future()
        try:
            self._play_due()
            await self._over
        finally:
            self.close()

    def close(self) -> None:
        """Stop playing and reading."""
        if self._open:
            self._open = False
            self._pacer.remove(self)
            self._alarm.close()
            if self._reader is not None:
                self._reader.close()
            self._batch.clear()

    # For the pacer

    @property
    def next_time(self) -> int | None:
        """The time of the next record; None before it is read, and at the end."""
        return self._batch[0][0] if self._refill() else None

    def play_next(self) -> None:
        """Play the next record now."""
        time, record = self._batch.popleft()
        self.played += 1
        if self._guarded(time, record) and not self._refill():
            self._end_if_done()

    def rearm(self) -> None:
        """Follow a change of the pace."""
        if self._over is not None:
            self._alarm.set(self._clock.monotonic())

    # Playing

    def _play_due(self) -> None:
        for _ in range(_PER_TURN):
            if not self._open or not self._refill():
                self._end_if_done()
                return
            time, record = self._batch[0]
            due = self._pacer.instant(time)
            if due is None:
                return
            late = self._clock.monotonic() - due
            if late < 0:
                self._alarm.set(due)
                return
            self._pacer.behind(late)
            self._batch.popleft()
            self.played += 1
            if not self._guarded(time, record):
                return
        self._loop.call_soon(self._play_due)  # others run in between

    def _guarded(self, time: int, record: T) -> bool:
        """Play a record; an error ends `run`."""
        try:
            self._play(time, record)
        except Exception as error:  # noqa: BLE001 - raised by `run`
            self._finish(error)
            return False
        return True

    def _refill(self) -> bool:
        """Return whether a record is left to play."""
        if not self._batch and self._reader is not None:
            self._batch = self._reader.take()
        return bool(self._batch)

    def _more(self) -> None:
        """Go on, as records have been read, or were the last ones."""
        if self._over is not None and self._open:
            self._play_due()

    def _end_if_done(self) -> None:
        if self._open and not self._batch and self._reader is not None and self._reader.ended:
            self._finish(self._reader.error)

    def _finish(self, error: BaseException | None) -> None:
        if self._over is not None and not self._over.done():
            if error is None:
                self._over.set_result(None)
            else:
                self._over.set_exception(error)


# Reading ahead


class _RecordReader(abc.ABC, Generic[T]):
    """Reads batches of records. `more` is called in the loop when there are records again, or the last one was read."""

    def __init__(
        self,
        records: Iterator[tuple[int, T]],
        size: Callable[[T], int],
        loop: asyncio.AbstractEventLoop,
        more: Callable[[], None],
    ) -> None:
        self.ended = False
        """True when all records have been taken, or reading has failed."""
        self.error: Exception | None = None
        self._records = records
        self._size = size
        self._loop = loop
        self._on_more = more

    def read_batch(self) -> tuple[deque[tuple[int, T]], int]:
        """Read some records; return them with their bytes. Those before an error come first."""
        batch: deque[tuple[int, T]] = deque()
        size = 0
        if self.error is None:
            try:
                for record in self._records:
                    batch.append(record)
                    size += self._size(record[1])
                    if len(batch) >= _BATCH or size >= _BATCH_BYTES:
                        break
            except Exception as error:  # noqa: BLE001 - raised by `first` or `run`
                self.error = error
        return batch, size

    @abc.abstractmethod
    async def first(self) -> None:
        """Wait until the first records are read. Raises the error of the reader if it fails before the first one."""

    @abc.abstractmethod
    def take(self) -> deque[tuple[int, T]]:
        """Return the next records; an empty list while they are being read, and at the end."""

    def close(self) -> None:
        """Stop reading."""


class _InlineReader(_RecordReader[T]):
    """Reads when records are asked for: virtual time stands still meanwhile."""

    _first: deque[tuple[int, T]] | None = None

    async def first(self) -> None:
        self._first = self.take()
        if self.error is not None and not self._first:
            raise self.error

    def take(self) -> deque[tuple[int, T]]:
        batch, self._first = self._first, None
        if not batch:
            batch, _ = self.read_batch()
        self.ended = not batch
        return batch


class _ThreadReader(_RecordReader[T]):
    """Reads in a thread, at most so far ahead; when it is far enough, in small pieces, so the loop never waits long."""

    def __init__(
        self,
        records: Iterator[tuple[int, T]],
        size: Callable[[T], int],
        loop: asyncio.AbstractEventLoop,
        more: Callable[[], None],
    ) -> None:
        super().__init__(records, size, loop, more)
        self._ready: deque[tuple[deque[tuple[int, T]], int]] = deque()
        self._bytes = 0
        self._room = threading.Condition()
        self._stopped = threading.Event()
        self._starved = True  # the loop waits for records
        self._all_read = False
        self._began = asyncio.Event()
        self._thread = threading.Thread(target=self._read, name="r2p-bag-reader", daemon=True)
        _interrupt_often(1)
        self._thread.start()

    async def first(self) -> None:
        await self._began.wait()
        if self.error is not None and not self._ready:
            raise self.error

    def take(self) -> deque[tuple[int, T]]:
        with self._room:
            if not self._ready:
                self._starved, self.ended = not self._all_read, self._all_read
                return deque()
            batch, size = self._ready.popleft()
            self._bytes -= size
            self._room.notify()
            return batch

    def close(self) -> None:
        if not self._stopped.is_set():
            self._stopped.set()
            with self._room:
                self._room.notify()
            self._thread.join(_JOIN)
            _interrupt_often(-1)

    # In the thread

    def _read(self) -> None:
        batch, size = self.read_batch()
        while batch and not self._stopped.is_set():
            self._put(batch, size)
            batch, size = self.read_batch()
        with self._room:
            self._all_read = True
        self._announce()

    def _put(self, batch: deque[tuple[int, T]], size: int) -> None:
        with self._room:
            self._room.wait_for(self._has_room)
            self._ready.append((batch, size))
            self._bytes += size
            starved, self._starved = self._starved, False
            rest = len(self._ready) > _NEAR
        if starved:
            self._announce()
        if rest:
            self._stopped.wait(_REST)

    def _has_room(self) -> bool:
        full = len(self._ready) >= _AHEAD or self._bytes >= _AHEAD_BYTES
        return self._stopped.is_set() or not (full and self._ready)

    def _announce(self) -> None:
        with contextlib.suppress(RuntimeError):  # the loop is closed
            self._loop.call_soon_threadsafe(self._announced)

    def _announced(self) -> None:
        self._began.set()
        self._on_more()


_readers = 0
_interval = 0.0


def _interrupt_often(change: int) -> None:
    """Let threads that run Python code be interrupted often while there are readers, or the loop waits 5 ms for them.

    The setting is that of the whole process.
    """
    global _readers, _interval
    if not _readers:
        _interval = sys.getswitchinterval()
    _readers += change
    sys.setswitchinterval(min(_interval, _SWITCH) if _readers else _interval)
