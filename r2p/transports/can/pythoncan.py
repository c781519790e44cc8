"""RTCAN's port to the interfaces of python-can: adapters with a driver of their own, slcan, virtual, udp_multicast ...

python-can may block, wherever it is called. So a thread of ours opens, sends and closes, and python-can's Notifier
reads in another; the event loop gets what came in batches. What an interface needs besides its channel and the bit rate
stands in python-can's own configuration file.
"""

import asyncio
import concurrent.futures
import importlib
import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

from r2p.clock import Backoff, ExactAlarm, clock_of, random_of
from r2p.codecs.rtcan import Frame, OtherFrame
from r2p.errors import TransportError
from r2p.protocols.rtcan.events import Mailbox, Outcome, Transmit, Withdraw
from r2p.transports.can.port import CanPortListener, InterfacePort, PortAlarm
from r2p.transports.can.tx_slots import TxSlots
from r2p.transports.stats import RETRY_AFTER_ERROR

if TYPE_CHECKING:
    import can

ON_REQUEST = frozenset({"kvaser", "neovi", "nixnet", "pcan", "vector", "virtual"})
"""Interfaces that show own frames, once they are on the bus, to who asks for them."""

ALWAYS = frozenset({"udp_multicast"})
"""Interfaces that show them in any case. Of all others a frame counts as sent when the driver has it."""

PATIENCE = 1_000_000_000
"""Ns until a confirmation is given up."""

QUEUE = 4096
"""Frames that wait for the event loop at most."""

_BATCH = 64  # frames that one turn of the loop takes
_SEND_TIMEOUT = 0.5  # seconds
_READ_TIMEOUT = 0.1  # seconds; closing takes as long
_OLDEST = 10.0  # seconds; a stamp that seems older is by another clock than the computer's
_SECOND = 1_000_000_000
_LONGEST_WAIT = 2.0  # seconds between attempts to open it
_LATENCY = 300_000  # ns that two changes of thread take, about


class PythonCanPort(InterfacePort["_PythonCanBus"]):
    """The interface `interface`, such as "slcan", on `channel`, such as "/dev/ttyACM0", at `bitrate` bit/s."""

    transmit_latency = _LATENCY
    receive_latency = _LATENCY
    coarse = True

    def __init__(self, interface: str, channel: str, bitrate: int) -> None:
        """Raises TransportError when python-can is not installed, or does not know the interface."""
        super().__init__(f"{interface}:{channel}")
        self._can = _library()
        if interface not in self._can.VALID_INTERFACES:
            known = ", ".join(sorted(self._can.VALID_INTERFACES))
            raise TransportError(f"rtcan:{self.name}: python-can has no interface {interface!r}; it knows: {known}")
        self._interface = interface
        self._channel = channel
        self._bitrate = bitrate

    async def run(self, user: CanPortListener, opened: Callable[[], object]) -> None:
        backoff = Backoff(random_of(), longest=_LONGEST_WAIT)
        while True:
            if await self._use(user, opened):
                backoff.reset()
            await asyncio.sleep(backoff.delay())

    def alarm(self, callback: Callable[[], object]) -> PortAlarm:
        return ExactAlarm(asyncio.get_running_loop(), callback)

    async def _use(self, user: CanPortListener, opened: Callable[[], object]) -> bool:
        """Use the interface until it fails; False if it can't be had."""
        bus = _PythonCanBus(self._can, user, echo=self._interface in ON_REQUEST | ALWAYS)
        try:
            problem = await self._open(bus)
            opened()
            if problem:
                user.waits(problem)
                return False
            bus.set_filters(self._filters)
            self._bus = bus
            user.up()
            reason = await bus.ended
        finally:
            self._bus = None
            await bus.aclose()
        user.down(reason)
        return True

    async def _open(self, bus: "_PythonCanBus") -> str:
        """Why it can't be had at the moment. Raises TransportError when it never can."""
        try:
            await bus.open(self._make)
        except _NEVER as error:
            raise TransportError(f"rtcan:{self.name}: {_explain(error)}") from error
        except (self._can.CanError, OSError) as error:
            return _explain(error)
        return ""

    def _make(self) -> "can.BusABC":
        options: dict[str, Any] = {"receive_own_messages": True} if self._interface in ON_REQUEST else {}
        bus: can.BusABC = self._can.Bus(
            interface=self._interface, channel=self._channel, bitrate=self._bitrate, **options
        )
        return bus


_NEVER = (NotImplementedError, ValueError, TypeError)
"""What drivers of python-can raise for what waiting does not mend: they are not installed, or there can't be such a
channel or bit rate. Other errors may pass, such as those of an adapter that is not plugged in."""


class _PythonCanBus:
    """An open interface. The methods that start with `_in_` run in the thread of ours, or of the Notifier."""

    def __init__(self, library: Any, user: CanPortListener, *, echo: bool) -> None:
        loop = asyncio.get_running_loop()
        self.ended: asyncio.Future[str] = loop.create_future()
        self._can = library
        self._user = user
        self._echo = echo
        self._loop = loop
        self._clock = clock_of(loop)
        self._thread = concurrent.futures.ThreadPoolExecutor(1, "python-can")
        self._bus: can.BusABC | None = None
        self._notifier: can.Notifier | None = None
        self._closed = threading.Event()
        self._waiting: deque[tuple[can.Message, int]] = deque()
        self._called = False
        self._dropped = 0
        self._reported = 0
        self._alarm = ExactAlarm(loop, self._poll)
        self._mailboxes = TxSlots(self._send, user.confirmed, latency=_LATENCY, patience=PATIENCE)

    async def open(self, make: Callable[[], "can.BusABC"]) -> None:
        """Raises what python-can raises."""
        await self._loop.run_in_executor(self._thread, self._in_open, make)

    async def aclose(self) -> None:
        """Wait until it is closed, also when it is just being opened."""
        self._closed.set()
        self._alarm.close()
        self._mailboxes.clear()
        self.ended.cancel()
        try:
            await self._loop.run_in_executor(self._thread, self._in_close)
        except (self._can.CanError, OSError):
            pass  # it is gone: nothing to close
        finally:
            self._thread.shutdown(wait=False)

    def transmit(self, order: Transmit) -> None:
        self._mailboxes.put(self._clock.monotonic(), order)
        self._arm()

    def withdraw(self, order: Withdraw) -> None:
        self._mailboxes.withdraw(self._clock.monotonic(), order.mailbox)
        self._arm()

    def set_filters(self, filters: list[tuple[int, int]] | None) -> None:
        assert self._bus is not None
        wanted: Any = filters and [
            {"can_id": identifier, "can_mask": mask, "extended": True} for identifier, mask in filters
        ]
        self._do(partial(self._bus.set_filters, wanted), lambda error: self._failed(error) if error else None)

    # In the event loop

    def _send(self, frame: Frame, mailbox: Mailbox) -> bool:
        if self._bus is None or self.ended.done():
            return False
        message = self._can.Message(arbitration_id=frame.id, data=frame.data, is_extended_id=True)
        self._do(partial(self._bus.send, message, _SEND_TIMEOUT), partial(self._handed, frame, mailbox))
        return True

    def _handed(self, frame: Frame, mailbox: Mailbox, error: BaseException | None) -> None:
        """The driver has a frame, or not."""
        now = self._clock.monotonic()
        if isinstance(error, self._can.CanTimeoutError):
            self._mailboxes.failed(mailbox, Outcome.UNKNOWN, now)
        elif error is not None:
            self._failed(error)
        elif not self._echo:
            self._mailboxes.seen(frame.id, frame.data, now, now)
        self._arm()

    def _drain(self) -> None:
        """Take what the Notifier's thread has put there."""
        self._called = False
        now, utc = self._clock.monotonic(), time.time()
        for _ in range(min(len(self._waiting), _BATCH)):
            message, arrived = self._waiting.popleft()
            age = utc - message.timestamp
            try:
                self._receive(message, now - round(age * _SECOND) if 0.0 <= age < _OLDEST else arrived)
            except Exception as error:  # noqa: BLE001 - counted and logged; the next frame follows
                self._user.internal_error(error)
        while self._reported < self._dropped:
            self._reported += 1
            self._user.fault("receive queue full")
        if self._waiting:
            self._call()
        self._arm()

    def _receive(self, message: "can.Message", stamp: int) -> None:
        if message.is_error_frame:
            self._user.fault("bus error")
        elif message.is_fd:
            return
        elif message.is_remote_frame or not message.is_extended_id:
            remote = message.dlc if message.is_remote_frame else None
            frame = OtherFrame(message.arbitration_id, bytes(message.data), message.is_extended_id, remote)
            if message.is_rx:
                self._user.other(frame, stamp)
        else:
            data = bytes(message.data)
            own = self._echo and self._mailboxes.seen(message.arbitration_id, data, stamp, self._clock.monotonic())
            if not own and message.is_rx:
                self._user.received(Frame(message.arbitration_id, data), stamp)

    def _poll(self) -> None:
        now = self._clock.monotonic()
        try:
            self._mailboxes.poll(now)
        except Exception as error:  # noqa: BLE001 - counted and logged
            self._user.internal_error(error)
            self._alarm.set(now + RETRY_AFTER_ERROR)
        else:
            self._arm()

    def _arm(self) -> None:
        if not self._closed.is_set():
            self._alarm.set(self._mailboxes.next_deadline())

    def _do(self, action: Callable[[], object], then: Callable[[BaseException | None], object]) -> None:
        """Have the thread do something, and hear what became of it."""
        future = self._loop.run_in_executor(self._thread, action)
        future.add_done_callback(lambda done: None if done.cancelled() else then(done.exception()))

    def _failed(self, error: BaseException) -> None:
        if not self.ended.done():
            self._mailboxes.clear()
            self.ended.set_result(_explain(error))

    # In other threads

    def _in_open(self, make: Callable[[], "can.BusABC"]) -> None:
        self._bus = make()
        self._notifier = self._can.Notifier(self._bus, [self], _READ_TIMEOUT)

    def _in_close(self) -> None:
        if self._notifier is not None:
            self._notifier.stop()
        if self._bus is not None:
            self._bus.shutdown()

    def __call__(self, message: "can.Message") -> None:
        """The Notifier has a frame."""
        if len(self._waiting) < QUEUE:
            self._waiting.append((message, self._clock.monotonic()))
        else:
            self._dropped += 1
        if not self._called:
            self._call()

    def on_error(self, error: Exception) -> None:
        """The Notifier can't read. It would try again at once, for ever: hold it until it is told to stop."""
        if not self._closed.is_set():
            self._loop.call_soon_threadsafe(self._failed, error)
            self._closed.wait()

    def _call(self) -> None:
        self._called = True
        self._loop.call_soon_threadsafe(self._drain)


def _library() -> Any:
    try:
        library = importlib.import_module("can")
    except ImportError as error:
        raise TransportError("this CAN interface needs python-can: pip install 'r2p[can]'") from error
    logger = logging.getLogger("can")
    if logger.level == logging.NOTSET:  # else the user wants it otherwise
        logger.setLevel(logging.ERROR)  # it warns of each attempt that failed; we tell what is wrong, and once
    return library


def _explain(error: BaseException) -> str:
    text, cause = str(error) or type(error).__name__, error.__cause__
    return text if cause is None or str(cause) in text else f"{text} ({cause})"
