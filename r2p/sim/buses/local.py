"""Attachments to buses of this process: to one of an event loop of the program, or to one in a thread of its own.

A bus that no event loop of the program has runs in a daemon thread, which ends with its last attachment. Frames go
through two queues: programs put theirs into that of a `BusDriver`, which runs in the bus's loop and puts what it
receives into the other one. So no lock is held while a program waits, and one wake-up serves many frames.
"""

from __future__ import annotations

import asyncio
import atexit
import concurrent.futures
import contextlib
import os
import queue
import selectors
import socket
import threading
import weakref
from typing import TYPE_CHECKING, Any, Final, TypeVar

from r2p.clock import SystemClock
from r2p.codecs.can_bits import FRAME_MAX, IDENTIFIER_BITS, Frame, check_frame
from r2p.errors import Closed, Error, TransportError
from r2p.log_lines import get_logger
from r2p.sim.buses.attachment import (
    BITRATE,
    TX_QUEUE,
    AttachmentOptions,
    BusAttachment,
    BusFilter,
    BusFrame,
    check_filters,
    deadline_of,
)
from r2p.sim.buses.driver import BusDriver, bus_clock
from r2p.sim.can import ControllerState
from r2p.sim.loop import VirtualLoop
from r2p.sim.transport import SimCan, can_bus, forget_bus, running_buses
from r2p.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from r2p.codecs.can_bits import AnyFrame

logger = get_logger("r2p.buses")

T = TypeVar("T")

_ANSWER_S: Final = 5.0  # for the loop that runs the bus, if that is a loop of the program
_STALLED_S: Final = 1.0  # without a frame that leaves a full queue, until a sender that would wait forever gives up
_LOW_WATER: Final = TX_QUEUE - 16  # frames in the queue when senders that wait go on: one wake-up for many frames
_SELECT_MAX: Final = 1024  # descriptors that select() has
_CLOSED: Final = "closed"
_FORKED: Final = "this process was forked from the one that opened the bus: open buses after the fork"
_clock: Final = SystemClock()


class LocalAttachment(BusAttachment):
    """An attachment to a bus of this process. `release` is called when it is closed."""

    def __init__(
        self,
        channel: str,
        shared: SimCan,
        options: AttachmentOptions,
        where: str,
        release: Callable[[], object] | None = None,
    ) -> None:
        """Raises TransportError if the bus has another bit rate."""
        if options.bitrate not in (None, shared.bitrate):
            raise TransportError(
                f"the bus {channel} has {shared.bitrate} bit/s, not {options.bitrate}: ask for the same, or for none"
            )
        self.bitrate = shared.bitrate
        self.description = f"{channel}: {where}, {self.bitrate} bit/s"
        self._loop = shared.loop
        self._still = isinstance(self._loop, VirtualLoop) and not self._loop.clock.paced
        self._listen_only = options.listen_only
        self._release = release
        self._ended: str | None = None  # why nothing works any more
        self._events: queue.SimpleQueue[BusFrame | None] = queue.SimpleQueue()  # None: nothing more comes
        self._rx_queue = options.rx_queue
        self._lost = 0
        self._ready: _Readiness | None = None
        self._room = threading.Condition()
        self._senders = 0  # threads that wait for room
        self._left = 0  # times that a frame has left the queue
        self._pumping = False  # whether the loop is going to look at the queue
        self._thread = 0  # that of the loop
        self._guard: asyncio.Task[None] | None = None
        self._driver = self._call(self._start, shared, options)
        _attachments.add(self)

    # In any thread

    def send(self, frame: AnyFrame, timeout: float | None = None) -> None:
        self._check()
        if self._listen_only:
            raise TransportError(f"{self.description}: this node only listens: open the bus without listen_only")
        if frame.__class__ is not Frame or frame.id >> IDENTIFIER_BITS or len(frame.data) > FRAME_MAX:
            check_frame(frame)
        driver = self._driver
        if driver.state is ControllerState.BUS_OFF:
            raise TransportError(f"{self.description}: bus off, after too many errors: restart the controller first")
        with self._room:
            if len(driver.queue) >= TX_QUEUE:
                self._wait_for_room(driver, timeout)
            driver.queue.append(frame)
            if self._pumping or driver.sending:  # in this order: what the driver has not seen, it is told of
                return
            if threading.get_ident() != self._thread:
                self._pumping = True
                self._soon(self._pump)
                return
        driver.pump()

    def receive(self, timeout: float | None = None) -> BusFrame | None:
        if self._ended == _CLOSED:
            self._check()
        try:
            if timeout == 0 or self._still or threading.get_ident() == self._thread:
                event = self._receive_now(timeout)
            elif timeout is None:
                event = self._events.get()
            else:
                event = self._events.get(True, min(max(0.0, timeout), threading.TIMEOUT_MAX))
        except queue.Empty:
            event, found = None, False
        else:
            found = True
        if self._ready is not None:
            self._ready.clear_if(self._events.empty)
        if event is None:
            if found:
                self._events.put(None)  # for other threads
            self._check()
        return event

    def set_filters(self, filters: Sequence[BusFilter]) -> None:
        self._order(self._driver.set_filters, check_filters(filters))

    @property
    def state(self) -> ControllerState:
        return self._driver.state if self._ended is None else ControllerState.DOWN

    @property
    def error_counters(self) -> tuple[int, int]:
        return self._driver.error_counters

    @property
    def lost(self) -> int:
        return self._lost

    def flush(self) -> None:
        self._order(self._driver.flush)

    def restart(self) -> None:
        self._order(self._driver.restart)

    def here(self) -> asyncio.AbstractEventLoop | None:
        return self._loop if self._runs_here() else None

    def fileno(self) -> int:
        self._check()
        with self._room:
            if self._ready is None:
                self._ready = _Readiness()
                if not self._events.empty():
                    self._ready.set()
        return self._ready.fileno()

    def close(self) -> None:
        with self._room:
            if self._ended is not None:
                if self._ready is not None:  # the loop has ended before
                    self._ready.close()
                return
            self._ended = _CLOSED
        _attachments.discard(self)
        with contextlib.suppress(TransportError):  # the loop has ended
            try:
                self._call(self._stop)
            except TransportError:  # it does not answer: when it goes on, the node leaves
                self._soon(self._stop)
        self._end(_CLOSED)
        if self._ready is not None:
            self._ready.close()
        if self._release is not None:
            self._release()

    def fork(self) -> None:
        """End this copy of an attachment, in a process that was forked."""
        self._ended = _FORKED
        self._room = threading.Condition()
        self._events = queue.SimpleQueue()
        self._release = self._ready = None  # that would read from the other process's descriptor

    def _check(self) -> None:
        if self._ended is not None:
            kind = Closed if self._ended == _CLOSED else TransportError
            raise kind(f"{self.description}: {self._ended}")

    def _receive_now(self, timeout: float | None) -> BusFrame | None:
        try:
            return self._events.get_nowait()
        except queue.Empty:
            if timeout == 0 or self._ended is not None:
                raise
            way = "use can.Notifier(bus, listeners, loop=loop), such as with can.AsyncBufferedReader, or recv(0)"
            if self._still:
                raise Error(f"{self.description}: virtual time stands still while recv() waits: {way}") from None
            raise Error(f"{self.description}: while recv() waits here, the bus stands still, too: {way}") from None

    def _wait_for_room(self, driver: BusDriver, timeout: float | None) -> None:
        """Wait until the queue has room; called with the condition's lock. Raises TimeoutError."""
        waits = timeout != 0 and not self._still and threading.get_ident() != self._thread
        deadline = deadline_of(timeout)
        stalls = 0
        self._senders += 1
        try:
            while waits and len(driver.queue) >= TX_QUEUE:
                left = self._left
                rest = _STALLED_S / 2 if deadline is None else (deadline - _clock.monotonic()) / SECOND
                woken = rest > 0 and self._room.wait(rest)
                stalls = 0 if left != self._left else stalls + 1  # one is also what a process finds that was stopped
                waits = woken or (deadline is None and stalls < 2)
                self._check()
        finally:
            self._senders -= 1
        if len(driver.queue) >= TX_QUEUE:
            raise TimeoutError(f"{self.description}: the queue of {TX_QUEUE} frames is full{self._why_full(driver)}")

    def _why_full(self, driver: BusDriver) -> str:
        if driver.state is ControllerState.DOWN:
            return ": this node has no power"
        if errors := driver.error_counters[0]:
            return (
                f": the first one fails again and again, {errors} transmit errors: is there a node that acknowledges?"
            )
        if self._still or threading.get_ident() == self._thread:
            return ": await asyncio.sleep(...) between frames, as the bus needs time to send them"
        return ""

    def _order(self, function: Callable[..., object], *args: Any) -> None:
        self._check()
        self._call(function, *args)

    def _call(self, function: Callable[..., T], *args: Any) -> T:
        """Call this in the bus's loop and return its result.

        Raises TransportError if the loop has ended, or does not answer: then it is not called later, either.
        """
        if self._runs_here() or self._rests_here():
            return function(*args)
        answer: concurrent.futures.Future[T] = concurrent.futures.Future()
        self._soon(_answer, answer, function, args)
        try:
            return answer.result(_ANSWER_S)
        except concurrent.futures.TimeoutError:
            if not answer.cancel():
                return answer.result()  # it has just begun
            raise TransportError(f"{self.description}: its event loop does not answer: something blocks it") from None

    def _runs_here(self) -> bool:
        try:
            return asyncio.get_running_loop() is self._loop
        except RuntimeError:
            return False

    def _rests_here(self) -> bool:
        """Return whether the loop is paused between two runs in this thread, as after `run_until_complete`."""
        return threading.get_ident() == self._thread and not self._loop.is_running() and not self._loop.is_closed()

    def _soon(self, function: Callable[..., object], *args: Any) -> None:
        try:
            self._loop.call_soon_threadsafe(function, *args)
        except RuntimeError:
            self._end("the event loop that ran it has ended")
            self._check()

    # In the bus's loop

    def _start(self, shared: SimCan, options: AttachmentOptions) -> BusDriver:
        self._thread = threading.get_ident()
        if self._release is None:  # a loop of the program
            self._guard = self._loop.create_task(self._watch(), name="bus guard")
        self.clock = bus_clock(shared)
        return BusDriver(shared, options, self._deliver, self._frame_left)

    def _stop(self) -> None:
        self._driver.leave()
        if self._guard is not None:
            self._guard.cancel()

    async def _watch(self) -> None:
        """End with the loop, whose tasks are cancelled in the end."""
        try:
            await asyncio.get_running_loop().create_future()
        finally:
            if self._ended is None:
                self._driver.close()
                self._end("the event loop that ran it has ended")

    def _pump(self) -> None:
        self._pumping = False
        if self._ended is None:
            self._driver.pump()

    def _deliver(self, event: BusFrame) -> None:
        events = self._events
        if events.qsize() >= self._rx_queue:
            self._drop_oldest()
        events.put(event)
        if self._ready is not None:
            self._ready.set()
            if self._still:
                self._loop.call_soon(_nothing)  # the bus runs ahead of the loop: not beyond this instant

    def _drop_oldest(self) -> None:
        try:
            self._events.get_nowait()
        except queue.Empty:
            return
        self._lost += 1
        if self._lost == 1:
            what = f"{self._rx_queue} frames wait, and the oldest ones are dropped: receive them sooner"
            logger.warning("%s: %s", self.description, what)

    def _frame_left(self) -> None:
        self._left += 1
        if self._senders and len(self._driver.queue) <= _LOW_WATER:
            with self._room:
                self._room.notify_all()

    def _end(self, why: str) -> None:
        """Wake all that wait, in any thread: nothing works from now on."""
        self._ended = self._ended or why
        self._events.put(None)
        with self._room:
            self._room.notify_all()
        if self._ready is not None:
            self._ready.set()


class _Readiness:
    """A descriptor that is readable while it is set, for event loops."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._set = False
        self._closed = False
        self._reader, self._writer = socket.socketpair()
        self._reader.setblocking(False)

    def fileno(self) -> int:
        return self._reader.fileno()

    def set(self) -> None:
        """Make it readable."""
        if self._set:
            return  # a reader that is about to clear it looks at its queue once more after that
        with self._lock:
            if not self._closed and not self._set:
                self._set = True
                self._writer.send(b"\0")

    def clear_if(self, empty: Callable[[], bool]) -> None:
        """Make it unreadable if there is nothing to read."""
        if self._set and empty():
            with self._lock:
                if not self._closed and self._set and empty():  # type: ignore[redundant-expr] # by another thread
                    self._reader.recv(1)
                    self._set = False
            if not empty():  # what came meanwhile found it set
                self.set()

    def close(self) -> None:
        """Make it unreadable for good."""
        with self._lock:
            self._closed = True
            if self._set:
                self._reader.recv(1)
                self._set = False

    def __del__(self) -> None:
        self._reader.close()
        self._writer.close()


class BusThread:
    """A bus of this process that no event loop of the program has: a daemon thread runs it."""

    def __init__(self, channel: str, options: AttachmentOptions) -> None:
        self.channel = channel
        self.users = 0
        self.shared: SimCan
        self._started = threading.Event()
        self._loop = _exact_loop()
        self._thread = threading.Thread(target=self._run, args=(options,), name=f"r2psim {channel}", daemon=True)
        self._thread.start()
        self._started.wait()

    def stop(self) -> None:
        """End the thread, and wait for it."""
        self._loop.call_soon_threadsafe(self._loop.stop)
        if self._thread is not threading.current_thread():
            self._thread.join()

    def _run(self, options: AttachmentOptions) -> None:
        asyncio.set_event_loop(self._loop)
        self._loop.call_soon(self._open, options)
        self._loop.run_forever()
        self._loop.close()

    def _open(self, options: AttachmentOptions) -> None:
        try:
            given = {"bitrate": options.bitrate or BITRATE, "noise": options.noise, "seed": options.seed}
            self.shared = can_bus(self.channel, hosted=True, **given)
        finally:
            self._started.set()


def _exact_loop() -> asyncio.AbstractEventLoop:
    """Return an event loop whose timers are not a millisecond late: select() has microseconds, epoll does not."""
    selector = selectors.SelectSelector()
    loop = asyncio.SelectorEventLoop(selector)
    if all(key.fd < _SELECT_MAX for key in selector.get_map().values()):
        return loop
    loop.close()
    return asyncio.SelectorEventLoop()


_lock = threading.RLock()
_threads: dict[str, BusThread] = {}
_attachments: weakref.WeakSet[LocalAttachment] = weakref.WeakSet()


def attach_here(channel: str, options: AttachmentOptions) -> LocalAttachment | None:
    """Attach to a bus of an event loop: of this thread's, which makes it under virtual time, or of another thread's.

    None: there is no such bus. Raises TransportError if several event loops have one of this name.
    """
    try:
        loop = asyncio.get_running_loop()
    except RuntimeError:
        loop = None
    if isinstance(loop, VirtualLoop):
        given = {"bitrate": options.bitrate or BITRATE, "noise": options.noise, "seed": options.seed}
        return LocalAttachment(channel, can_bus(channel, **given), options, "under virtual time")
    found = [shared for name, shared in running_buses() if name == channel and not shared.hosted]
    if len(found) > 1:
        found = [shared for shared in found if shared.loop is loop]
        if not found:
            raise TransportError(f"several event loops of this program have a bus {channel}: give them other names")
    return LocalAttachment(channel, found[0], options, "a bus of an event loop of this process") if found else None


def attach_to_thread(channel: str, options: AttachmentOptions) -> LocalAttachment:
    """Attach to a bus in a thread of its own, which is started if this is its first attachment."""
    with _lock:
        thread = _threads.get(channel)
        if thread is None:
            thread = _threads[channel] = BusThread(channel, options)
        thread.users += 1

    def release() -> None:
        with _lock:
            thread.users -= 1
            last = thread.users == 0
            if last:
                _threads.pop(channel, None)
                forget_bus(thread.shared)  # now: nobody attaches to a loop that is about to end
        if last:
            thread.stop()

    try:
        return LocalAttachment(channel, thread.shared, options, "a bus of this process", release)
    except BaseException:
        release()
        raise


def local_channels() -> list[str]:
    """Return the names of the buses that `attach_here` and `attach_to_thread` find now."""
    return sorted({name for name, _ in running_buses()})


def _answer(answer: concurrent.futures.Future[T], function: Callable[..., T], args: tuple[Any, ...]) -> None:
    if not answer.set_running_or_notify_cancel():
        return
    try:
        answer.set_result(function(*args))
    except BaseException as error:  # noqa: BLE001 - raised where it was asked for
        answer.set_exception(error)


def _nothing() -> None:
    """Do nothing."""


def _close_all() -> None:
    for attachment in list(_attachments):
        attachment.close()


def _after_fork() -> None:
    global _lock
    _lock = threading.RLock()
    _threads.clear()
    for attachment in list(_attachments):
        attachment.fork()


atexit.register(_close_all)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)
