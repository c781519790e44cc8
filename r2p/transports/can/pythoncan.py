"""The port to the interfaces of python-can: adapters with a driver of their own, slcan, virtual, udp_multicast ...

Any call of python-can may block. So one thread of this module opens, sends and closes, python-can's Notifier reads in
another, and the event loop gets frames in batches. Further settings of an interface than channel and bit rate stand in
python-can's own configuration file.
"""

import asyncio
import concurrent.futures
import errno
import importlib
import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

from r2p.clock import Backoff, random_of
from r2p.codecs.can_bits import ERROR, EXTENDED, FRAME_MAX, IDENTIFIER_MASK, LOCAL, REMOTE, Frame, OtherFrame, WireFrame
from r2p.errors import TransportError
from r2p.protocols.can_orders import Mailbox, Outcome
from r2p.transports.can.port import CanPortListener, FrameTap, InterfacePort, OpenInterface
from r2p.units import SECOND

if TYPE_CHECKING:
    import can

ECHO_ON_REQUEST = frozenset({"kvaser", "neovi", "nixnet", "pcan", "r2psim", "vector", "virtual"})
"""Interfaces that return own frames, once they are on the bus, if asked to."""

ECHO_ALWAYS = frozenset({"udp_multicast"})
"""Interfaces that return own frames in any case. On all others a frame counts as sent when the driver has it."""

CONFIRM_TIMEOUT_NS = SECOND
"""Ns until a confirmation is given up."""

QUEUE_MAX = 4096
"""Frames that wait for the event loop, at most: half a second of a saturated bus of 1 Mbit/s."""

_BATCH = 64  # frames that one turn of the event loop handles: other tasks wait for so long
_SEND_TIMEOUT_S = 0.5  # for a driver that waits for room in its queue
_READ_TIMEOUT_S = 0.1  # closing takes as long
_STAMP_AGE_MAX_S = 10.0  # a stamp that seems older is by another clock than the computer's
_RETRY_MAX_S = 2.0  # between attempts to open the interface
_LATENCY = 300_000  # ns that two changes of thread take, about


class PythonCanPort(InterfacePort["_PythonCanBus"]):
    """The interface `interface`, such as "slcan", on `channel`, such as "/dev/ttyACM0", at `bitrate` bit/s."""

    transmit_latency = _LATENCY
    receive_latency = _LATENCY
    coarse = True

    def __init__(self, interface: str, channel: str, bitrate: int) -> None:
        """Raises TransportError if python-can is not installed, or does not know the interface."""
        super().__init__(f"{interface}:{channel}")
        self._can = library()
        if interface not in self._can.VALID_INTERFACES:
            known = ", ".join(sorted(self._can.VALID_INTERFACES))
            raise TransportError(f"rtcan:{self.name}: python-can has no interface {interface!r}; it knows: {known}")
        self._interface = interface
        self._channel = channel
        self._bitrate = bitrate

    async def run(self, listener: CanPortListener, opened: Callable[[], object]) -> None:
        backoff = Backoff(random_of(), longest=_RETRY_MAX_S)
        while True:
            if await self._serve(listener, opened):
                backoff.reset()
            await asyncio.sleep(backoff.delay())

    async def _serve(self, listener: CanPortListener, opened: Callable[[], object]) -> bool:
        """Use the interface until it fails. Return False if it can't be opened now."""
        echo = self._interface in ECHO_ON_REQUEST | ECHO_ALWAYS
        bus = _PythonCanBus(self._can, listener, echo=echo, tap=self.tap)
        try:
            problem = await self._open(bus)
            opened()
            if problem:
                listener.on_waiting(problem)
                return False
            reason = await self._use(bus, listener)
        finally:
            await bus.aclose()
        listener.on_down(reason)
        return True

    async def _open(self, bus: "_PythonCanBus") -> str:
        """Open the interface. Return why it can't be opened now; raise TransportError if it never can."""
        try:
            await bus.open(self._make)
        except _PERMANENT_ERRORS as error:
            raise TransportError(f"rtcan:{self.name}: {_explain(error)}") from error
        except (self._can.CanError, OSError) as error:
            return _explain_opening(self._channel, error)
        except Exception as error:  # python-can's own, where the library of the driver is missing: kvaser's NameError
            reason = f"the driver of {self._interface} does not work here: is it installed? ({_explain(error)})"
            raise TransportError(f"rtcan:{self.name}: {reason}") from error
        return ""

    def _make(self) -> "can.BusABC":
        options: dict[str, Any] = {"interface": self._interface, "channel": self._channel, "bitrate": self._bitrate}
        if self._interface in ECHO_ON_REQUEST:
            options["receive_own_messages"] = True
        bus: can.BusABC = self._can.Bus(**options)
        return bus


_PERMANENT_ERRORS = (NotImplementedError, ValueError, TypeError)
"""Errors after which waiting does not help: the driver is not installed, or there is no such channel or bit rate. All
others may pass, such as those of an adapter that is not plugged in.
"""


class _PythonCanBus(OpenInterface):
    """An open interface. All methods run in the event loop but the last ones, which run in other threads."""

    def __init__(self, library: Any, listener: CanPortListener, *, echo: bool, tap: FrameTap | None = None) -> None:
        super().__init__(listener, latency=_LATENCY, confirm_timeout=CONFIRM_TIMEOUT_NS)
        self._can = library
        self._echo = echo
        self._tap = tap
        self._thread = concurrent.futures.ThreadPoolExecutor(1, "python-can")
        self._bus: can.BusABC | None = None
        self._notifier: can.Notifier | None = None
        self._closed = threading.Event()
        self._queue: deque[tuple[can.Message, int]] = deque()  # frames read, each with the instant when it was read
        self._scheduled = False  # whether the event loop is going to handle a batch
        self._dropped = 0
        self._reported = 0

    async def open(self, make: Callable[[], "can.BusABC"]) -> None:
        """Open the interface. Raises the exceptions of python-can."""
        await self._loop.run_in_executor(self._thread, self._open_in_thread, make)

    async def aclose(self) -> None:
        """Close the interface and wait until it is closed, also while it is being opened."""
        self._closed.set()
        self._timer.close()
        self._mailboxes.clear()
        self.ended.cancel()
        try:
            await self._loop.run_in_executor(self._thread, self._close_in_thread)
        except (self._can.CanError, OSError):
            pass  # the adapter is gone: there is nothing to close
        finally:
            self._thread.shutdown(wait=False)
        while self._tap is not None and self._queue:
            self._hand_to_tap(self._tap)

    def set_filters(self, filters: list[tuple[int, int]] | None) -> None:
        assert self._bus is not None
        wanted: Any = filters and [
            {"can_id": identifier, "can_mask": mask, "extended": True} for identifier, mask in filters
        ]
        self._call_in_thread(
            partial(self._bus.set_filters, wanted), lambda error: self._failed(error) if error else None
        )

    def _send(self, frame: Frame, mailbox: Mailbox) -> bool:
        if self._bus is None or self.ended.done():
            return False
        message = self._can.Message(arbitration_id=frame.id, data=frame.data, is_extended_id=True)
        send = partial(self._bus.send, message, _SEND_TIMEOUT_S)
        self._call_in_thread(send, partial(self._handed_over, frame, mailbox))
        return True

    def _handed_over(self, frame: Frame, mailbox: Mailbox, error: BaseException | None) -> None:
        """Confirm a frame that the driver has accepted, unless it returns own frames; `error` is its exception."""
        now = self._clock.monotonic()
        if isinstance(error, self._can.CanTimeoutError):  # the driver may still send it
            self._mailboxes.failed(mailbox, Outcome.UNKNOWN, now)
        elif error is not None:
            self._failed(error)
        elif not self._echo:
            self._mailboxes.seen(frame.id, frame.data, now, now)
        self._arm()

    def _handle_batch(self) -> None:
        """Handle frames that the Notifier's thread has read."""
        self._scheduled = False  # first: a frame that is read from here on schedules the next batch
        if self._tap is not None:
            self._hand_to_tap(self._tap)
        else:
            self._hand_out()
        if self._queue:
            self._schedule_batch()
        self._arm()

    def _hand_to_tap(self, tap: FrameTap) -> None:
        offset = time.time_ns() - self._clock.monotonic()
        frames: list[WireFrame] = []
        for _ in range(min(len(self._queue), _BATCH)):
            message, read_at = self._queue.popleft()
            if message.is_fd:
                tap.on_lost(1, "CAN FD")
            else:
                frames.append(wire_frame(message, _stamp(message, read_at + offset) - offset))
        try:
            tap.on_frames(frames, offset)
        except Exception as error:  # noqa: BLE001 - counted and logged; the next batch follows
            self._listener.internal_error(error)
        if self._reported < self._dropped:
            lost, self._reported = self._dropped - self._reported, self._dropped
            tap.on_lost(lost, "receive queue full")

    def _hand_out(self) -> None:
        now, utc = self._clock.monotonic(), time.time()
        for _ in range(min(len(self._queue), _BATCH)):
            message, read_at = self._queue.popleft()
            age = utc - message.timestamp  # python-can stamps in UTC, but some adapters from when they were plugged in
            try:
                self._receive(message, now - round(age * SECOND) if 0.0 <= age < _STAMP_AGE_MAX_S else read_at)
            except Exception as error:  # noqa: BLE001 - counted and logged; the next frame follows
                self._listener.internal_error(error)
        while self._reported < self._dropped:
            self._reported += 1
            self._listener.on_fault("receive queue full")

    def _receive(self, message: "can.Message", stamp: int) -> None:
        if message.is_error_frame:
            self._listener.on_fault("bus error")
        elif message.is_fd:
            return
        elif message.is_remote_frame or not message.is_extended_id:
            remote = message.dlc if message.is_remote_frame else None
            frame = OtherFrame(message.arbitration_id, bytes(message.data), message.is_extended_id, remote)
            if message.is_rx:
                self._listener.on_other_frame(frame, stamp)
        else:
            data = bytes(message.data)
            # udp_multicast does not mark own frames: they are known by their content.
            own = self._echo and self._mailboxes.seen(message.arbitration_id, data, stamp, self._clock.monotonic())
            if not own and message.is_rx:
                self._listener.on_frame(Frame(message.arbitration_id, data), stamp)

    def _call_in_thread(self, action: Callable[[], object], finished: Callable[[BaseException | None], object]) -> None:
        """Call `action` in the thread, then `finished` in the event loop with its exception, if any."""
        future = self._loop.run_in_executor(self._thread, action)
        future.add_done_callback(lambda done: None if done.cancelled() else finished(done.exception()))

    def _failed(self, error: BaseException) -> None:
        self._end(_explain(error))

    # In the other threads

    def _open_in_thread(self, make: Callable[[], "can.BusABC"]) -> None:
        self._bus = make()
        self._notifier = self._can.Notifier(self._bus, [self], _READ_TIMEOUT_S)

    def _close_in_thread(self) -> None:
        if self._notifier is not None:
            self._notifier.stop()
        if self._bus is not None:
            self._bus.shutdown()

    def __call__(self, message: "can.Message") -> None:
        """Put a frame that the Notifier has read into the queue."""
        if len(self._queue) < QUEUE_MAX:
            self._queue.append((message, self._clock.monotonic()))
        else:
            self._dropped += 1
        if not self._scheduled:
            self._schedule_batch()

    def on_error(self, error: Exception) -> None:
        """End: the Notifier can't read. It would try again at once, without end: block it until it is stopped."""
        if not self._closed.is_set():
            self._loop.call_soon_threadsafe(self._failed, error)
            self._closed.wait()

    def _schedule_batch(self) -> None:
        self._scheduled = True
        self._loop.call_soon_threadsafe(self._handle_batch)


def wire_frame(message: "can.Message", stamp: int) -> WireFrame:
    """Return a message of python-can as a frame; not one of CAN FD."""
    flags = EXTENDED * message.is_extended_id | REMOTE * message.is_remote_frame
    data = bytes(message.dlc) if message.is_remote_frame else bytes(message.data[:FRAME_MAX])
    if message.is_error_frame:
        flags, data = ERROR, data.ljust(FRAME_MAX, b"\0")
    return message.arbitration_id & IDENTIFIER_MASK | flags, data, 0 if message.is_rx else LOCAL, stamp


def _stamp(message: "can.Message", read_at: int) -> int:
    """Return the driver's stamp, or that of reading if it is by another clock (ns, UTC)."""
    stamp = round(message.timestamp * SECOND)
    return stamp if 0 <= read_at - stamp < _STAMP_AGE_MAX_S * SECOND else read_at


def library() -> Any:
    """Return python-can, which is loaded only where it is used. Raises TransportError if it is not installed."""
    try:
        library = importlib.import_module("can")
    except ImportError as error:
        raise TransportError("this CAN interface needs python-can: pip install 'r2p[can]'") from error
    logger = logging.getLogger("can")
    if logger.level == logging.NOTSET:  # else the program has chosen a level
        logger.setLevel(logging.ERROR)  # python-can warns at each attempt that failed; r2p reports the reason once
    return library


def _explain_opening(channel: str, error: Exception) -> str:
    """Return why a channel can't be opened, and what to do if it is a serial port, such as an slcan adapter's."""
    device = channel.partition("@")[0]  # slcan: DEVICE@BAUD
    cause = error.__cause__ if isinstance(error.__cause__, OSError) else error
    match getattr(cause, "errno", None) if device.startswith("/dev/") else None:
        case errno.ENOENT:
            return f"{device} is not there: plug it in (ls /dev/serial/by-id)"
        case errno.EACCES:
            return f"{device}: permission denied; add yourself to its group: sudo usermod -aG dialout $USER"
        case _:
            return _explain(error)


def _explain(error: BaseException) -> str:
    text, cause = str(error) or type(error).__name__, error.__cause__
    text = text if cause is None or str(cause) in text else f"{text} ({cause})"
    return text.removesuffix(".")
