"""Senders of frames of any kind, as they are: for recordings that are played, not for RTCAN.

A sender takes frames in order and never waits: what the interface does not take at once waits in a queue of a limited
length. Nothing is changed, tried twice, or held back for a slot.
"""

import abc
import asyncio
import concurrent.futures
import contextlib
import errno
import os
import socket
import struct
from collections import Counter, deque
from functools import partial
from typing import Any, Generic, TypeVar

from r2p.codecs.can_bits import ERROR, EXTENDED, FRAME_MAX, IDENTIFIER_MASK, REMOTE, WireFrame
from r2p.errors import TransportError
from r2p.transports.can import netlink, pythoncan

F = TypeVar("F")

QUEUE_MAX = 8192
"""Frames that wait for the interface, at most: a second of a saturated bus."""

_RETRY_S = 0.0005  # seconds until the next try when the driver's queue is full: some four frames
_TIMEOUT_S = 0.5  # of one call of python-can
_CLOSE_S = 2.0  # for the frames that wait at the end
_FRAME = struct.Struct("=IB3x8s")  # struct can_frame
_QUEUE_FULL = (errno.ENOBUFS, errno.EAGAIN)


class FrameSender(abc.ABC):
    """Sends frames to one bus."""

    def __init__(self) -> None:
        self.sent = 0
        """Frames that the interface has taken."""
        self.refused: Counter[str] = Counter()
        """Frames that were not sent, by reason."""

    def accepts(self, frame: WireFrame, waiting: int) -> bool:
        """Return whether a frame can be sent while so many wait; count it if not."""
        if frame[0] & ERROR:
            self.refused["error frames can't be sent"] += 1
        elif waiting >= QUEUE_MAX:
            self.refused["the interface is too slow"] += 1
        else:
            return True
        return False

    @abc.abstractmethod
    def send(self, frame: WireFrame) -> None:
        """Send a frame; its stamp means nothing here. Raises TransportError when the interface is gone."""

    @abc.abstractmethod
    async def aclose(self) -> None:
        """Wait until the frames so far are sent, but not for ever, and close the interface."""


async def open_sender(interface: str, channel: str, bitrate: int) -> FrameSender:
    """Return a sender on SocketCAN (`interface` "socketcan"), or on an interface of python-can.

    Raises TransportError if it can't be used now.
    """
    if interface == "socketcan":
        return SocketCanSender(channel)
    sender = PythonCanSender(interface, channel, bitrate)
    await sender.open()
    return sender


class QueuedSender(FrameSender, Generic[F]):
    """A sender with a queue of its own: frames as its interface takes them."""

    def __init__(self) -> None:
        super().__init__()
        self._waiting: deque[F] = deque()
        self._empty = asyncio.Event()
        self._empty.set()

    async def _drain(self, reason: str) -> None:
        """Wait until the queue is empty, but not for ever; what is left then is refused for this reason."""
        try:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(_CLOSE_S):
                    await self._empty.wait()
        finally:
            if self._waiting:
                self.refused[reason] += len(self._waiting)


class SocketCanSender(QueuedSender[bytes]):
    """Sends to an interface of Linux."""

    def __init__(self, name: str) -> None:
        """Open the interface `name`. Raises TransportError if it does not exist or is down."""
        super().__init__()
        found = netlink.find_interface(name) if netlink.has_socketcan() else None
        if found is None or found.problem:
            why = "no CAN interface has this name; r2p doctor lists those there are" if found is None else found.problem
            raise TransportError(f"rtcan:{name}: {why}")
        self._name = name
        self._loop = asyncio.get_running_loop()
        self._timer: asyncio.TimerHandle | None = None
        self._error: OSError | None = None
        self._socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW | socket.SOCK_NONBLOCK, socket.CAN_RAW)
        try:
            self._socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, b"")  # receive nothing
            self._socket.bind((name,))
        except OSError as error:
            self._socket.close()
            raise TransportError(f"rtcan:{name}: {os.strerror(error.errno or 0)}") from error

    def send(self, frame: WireFrame) -> None:
        if self.accepts(frame, len(self._waiting)):
            self._waiting.append(_FRAME.pack(frame[0], min(len(frame[1]), FRAME_MAX), frame[1]))
            if self._timer is None:
                self._flush()
        if self._error is not None:
            raise TransportError(f"rtcan:{self._name}: {os.strerror(self._error.errno or 0)}") from self._error

    def _flush(self) -> None:
        self._timer = None
        try:
            while self._waiting:
                self._socket.send(self._waiting[0])
                self._waiting.popleft()
                self.sent += 1
        except OSError as error:
            if error.errno in _QUEUE_FULL:
                self._empty.clear()
                self._timer = self._loop.call_later(_RETRY_S, self._flush)
            else:
                self._error = error
                self._empty.set()
        else:
            self._empty.set()

    async def aclose(self) -> None:
        try:
            await self._drain("the interface did not take them")
        finally:
            if self._timer is not None:
                self._timer.cancel()
            self._socket.close()


class PythonCanSender(FrameSender):
    """Sends to an interface of python-can, in a thread."""

    def __init__(self, interface: str, channel: str, bitrate: int) -> None:
        """Raises TransportError if python-can is not installed. Call `open` next."""
        super().__init__()
        self._name = f"{interface}:{channel}"
        self._can: Any = pythoncan.library()
        self._waiting = 0
        self._error: Exception | None = None
        self._loop = asyncio.get_running_loop()
        self._make = partial(self._can.Bus, interface=interface, channel=channel, bitrate=bitrate)
        self._bus: Any = None
        self._thread = concurrent.futures.ThreadPoolExecutor(1, "python-can")

    async def open(self) -> None:
        """Open the interface. Raises TransportError."""
        try:
            self._bus = await self._loop.run_in_executor(self._thread, self._make)
        except Exception as error:  # what drivers raise has no common class
            self._thread.shutdown(wait=False)
            raise TransportError(f"rtcan:{self._name}: {error}") from error

    def send(self, frame: WireFrame) -> None:
        if self._error is not None:
            raise TransportError(f"rtcan:{self._name}: {self._error}") from self._error
        assert self._bus is not None
        if self.accepts(frame, self._waiting):
            self._waiting += 1
            future = self._loop.run_in_executor(self._thread, self._bus.send, self._message(frame), _TIMEOUT_S)
            future.add_done_callback(self._done)

    def _message(self, frame: WireFrame) -> Any:
        identifier, data, _, _ = frame
        remote = bool(identifier & REMOTE)
        return self._can.Message(
            arbitration_id=identifier & IDENTIFIER_MASK,
            is_extended_id=bool(identifier & EXTENDED),
            is_remote_frame=remote,
            dlc=min(len(data), FRAME_MAX),
            data=None if remote else data,
        )

    def _done(self, future: "asyncio.Future[None]") -> None:
        self._waiting -= 1
        if future.cancelled():
            return
        error = future.exception()
        if error is None:
            self.sent += 1
        elif isinstance(error, self._can.CanTimeoutError):
            self.refused["the interface did not take them"] += 1
        elif isinstance(error, Exception):
            self._error = error
            self.refused["the interface failed"] += 1

    async def aclose(self) -> None:
        assert self._bus is not None
        try:
            await self._loop.run_in_executor(self._thread, self._bus.shutdown)  # after all frames
        finally:
            self._thread.shutdown(wait=False)
