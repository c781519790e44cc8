"""An attachment to a bus that another process serves: a connection, and a thread that reads it.

`send` writes to the connection in its own thread, so a frame waits for nothing; the server returns how many frames have
left the queue. Received events stay as records until a program takes them.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import threading
import weakref
from collections import deque
from typing import TYPE_CHECKING, Final

import msgspec

from r2p.clock import SystemClock
from r2p.codecs.can_bits import check_frame
from r2p.errors import Closed, DecodeError, Error, TransportError
from r2p.log_lines import get_logger
from r2p.sim.buses import rendezvous, wire
from r2p.sim.buses.attachment import TX_QUEUE, BusAttachment, BusClock, BusFrame, check_filters, deadline_of
from r2p.sim.can import ControllerState
from r2p.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from r2p.codecs.can_bits import Frame, OtherFrame
    from r2p.sim.buses.attachment import AttachmentOptions, BusFilter
    from r2p.sim.buses.rendezvous import ServedBus

logger = get_logger("r2p.buses")

_ANSWER_TIMEOUT: Final = 5.0  # seconds for the server's greeting
_CLOSE_TIMEOUT: Final = 5.0  # ... and for the thread to end
_STALLED: Final = SECOND
"""Ns in which no frame leaves a full queue, until a sender that would wait forever gives up."""
_BUFFER: Final = 1 << 16  # bytes read at once


def connect(channel: str, options: AttachmentOptions) -> ServedAttachment | None:
    """Attach to the bus of that name in another process. Return None if no program serves one.

    Raises TransportError if the server refuses, as for another bit rate, or does not answer.
    """
    served = rendezvous.find(channel)
    if served is None:
        return None
    if served.pid == os.getpid() and _in_loop():
        raise TransportError(f"the bus {channel} is served by this program, whose event loop would wait for itself")
    try:
        connection = socket.create_connection(("127.0.0.1", served.port), _ANSWER_TIMEOUT)
    except ConnectionRefusedError:
        return None  # the server was killed
    try:
        description = _greet(connection, served, options)
    except BaseException:
        connection.close()
        raise
    if description is None:
        connection.close()
        return None
    connection.settimeout(None)
    return ServedAttachment(connection, served, description, options)


def not_served(channel: str) -> TransportError:
    """Return the error for a bus that no program serves."""
    return TransportError(
        f"no program serves the bus {channel}: start it with r2p bus serve {channel}, or r2p sim ROBOT --bus {channel}"
    )


def _in_loop() -> bool:
    try:
        asyncio.get_running_loop()
    except RuntimeError:
        return False
    return True


def _greet(connection: socket.socket, served: ServedBus, options: AttachmentOptions) -> wire.BusDescription | None:
    """Exchange greetings. Return None if a stranger listens at the port of a server that was killed."""
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    own, expected = served.secret[: wire.PROOF_SIZE], served.secret[wire.PROOF_SIZE :]
    silent = f"process {served.pid}, which serves the bus {served.name}, does not answer: end it"
    try:
        connection.sendall(wire.encode_greeting(own, msgspec.json.encode(options)))
        head = wire.decode_greeting(_read(connection, wire.GREETING_SIZE))
        body = _read(connection, head.size)
    except DecodeError:
        return None
    except (OSError, EOFError) as error:
        raise TransportError(silent) from error
    if head.proof == expected:
        return msgspec.json.decode(body, type=wire.BusDescription)
    if any(head.proof):
        return None
    raise TransportError(body.decode(errors="replace"))


def _read(connection: socket.socket, size: int) -> bytes:
    """Return exactly so many bytes. Raises EOFError."""
    data = b""
    while len(data) < size:
        more = connection.recv(size - len(data))
        if not more:
            raise EOFError
        data += more
    return data


class ServedAttachment(BusAttachment):
    """A controller at the bus of another process."""

    def __init__(
        self,
        connection: socket.socket,
        served: ServedBus,
        description: wire.BusDescription,
        options: AttachmentOptions,
    ) -> None:
        self.bitrate = description.bitrate
        self.node = description.node
        """The name of this attachment's node on the bus."""
        self.clock = BusClock(description.now, description.since, description.speed)
        self.description = f"{served.name}: a bus of process {served.pid}, {self.bitrate} bit/s"
        self._name, self._pid = served.name, served.pid
        self._connection = connection
        self._listen_only = options.listen_only
        self._lock = threading.Lock()
        self._changed = threading.Condition(self._lock)  # a new status, or the end
        self._arrived = threading.Condition(self._lock)  # events, or the end
        self._events: deque[wire.EventRecord] = deque()
        self._events_max = options.rx_queue
        self._status = wire.Status(0, 0, ControllerState.ACTIVE, 0, 0)
        self._sent = 0
        self._dropped = 0
        self._warned = False
        self._end: Callable[[], Error] | None = None  # what calls raise from now on
        self._signal: int | None = None  # an eventfd, for `fileno`
        self._signalled = False
        self._thread = threading.Thread(target=self._run, name=f"r2p bus {served.name}", daemon=True)
        self._thread.start()
        _attachments.add(self)

    # Sending

    def send(self, frame: Frame | OtherFrame, timeout: float | None = None) -> None:
        check_frame(frame)  # the server would end the connection
        message = wire.encode_message(wire.MessageType.SEND, wire.encode_frames([frame]))
        with self._lock:
            self._check()
            if self._listen_only:
                raise TransportError(f"{self.description}: this node only listens: open the bus without listen_only")
            if self._status.state is ControllerState.BUS_OFF:
                raise TransportError(
                    f"{self.description}: bus off, after too many errors: restart the controller first"
                )
            if self._waiting() >= TX_QUEUE:
                self._wait_for_room(timeout)
            self._sent += 1
            self._write(message)

    def _waiting(self) -> int:
        """Return how many frames wait for the wire."""
        return self._sent - self._status.done

    def _wait_for_room(self, timeout: float | None) -> None:
        """Wait until the queue has room; called with the lock. Raises TimeoutError."""
        deadline = deadline_of(timeout)
        goes_on = True
        while goes_on and self._waiting() >= TX_QUEUE:
            done = self._status.done
            in_time = _wait(self._changed, _clock.monotonic() + _STALLED if deadline is None else deadline)
            goes_on = in_time or (deadline is None and done != self._status.done)
            self._check()
        if self._waiting() >= TX_QUEUE:
            why = ": the first one fails again and again" if self._status.tx_errors else ""
            raise TimeoutError(f"{self.description}: the queue of {TX_QUEUE} frames is full{why}")

    def flush(self) -> None:
        self._order(wire.MessageType.FLUSH)

    def restart(self) -> None:
        self._order(wire.MessageType.RESTART)

    def set_filters(self, filters: Sequence[BusFilter]) -> None:
        self._order(wire.MessageType.FILTERS, wire.encode_filters(check_filters(filters)))

    def _order(self, kind: wire.MessageType, body: bytes = b"") -> None:
        with self._lock:
            self._check()
            self._write(wire.encode_message(kind, body))

    def _write(self, message: bytes) -> None:
        # Under the lock, so that messages of two threads do not mix. It does not wait: the window is small.
        try:
            self._connection.sendall(message)
        except OSError:
            self._finish(self._gone)
            raise self._gone() from None

    # Receiving

    def receive(self, timeout: float | None = None) -> BusFrame | None:
        if self._events and self._signal is None:  # without the lock: it costs more than all the rest
            try:
                return wire.decode_event(self._events.popleft())
            except IndexError:  # another thread was faster
                pass
        deadline = deadline_of(timeout)
        with self._lock:
            while not self._events:
                self._check()
                if not _wait(self._arrived, deadline):
                    return None
            record = self._events.popleft()
            self._show()
        return wire.decode_event(record)

    @property
    def lost(self) -> int:
        return self._dropped + self._status.lost

    @property
    def state(self) -> ControllerState:
        return self._status.state

    @property
    def error_counters(self) -> tuple[int, int]:
        return self._status.tx_errors, self._status.rx_errors

    def fileno(self) -> int:
        with self._lock:
            self._check()
            if self._signal is None:
                self._signal = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
                self._show()
            return self._signal

    def _show(self) -> None:
        """Let `fileno` be readable if there is something for `receive`: an event, or the end of the server."""
        wanted = bool(self._events) or self._end not in (None, self._closed)
        if self._signal is None or wanted == self._signalled:
            return
        self._signalled = wanted
        if wanted:
            os.eventfd_write(self._signal, 1)
        else:
            os.eventfd_read(self._signal)

    # The end

    def close(self) -> None:
        with self._lock:
            self._events.clear()
            self._finish(self._closed)
        if threading.current_thread() is not self._thread:
            self._thread.join(_CLOSE_TIMEOUT)

    def __del__(self) -> None:
        if self._signal is not None:
            os.close(self._signal)

    def _closed(self) -> Error:
        return Closed(f"the attachment to {self._name} was closed")

    def _gone(self) -> Error:
        return TransportError(
            f"the program that served the bus {self._name} has ended (process {self._pid}): start it again, as with "
            f"r2p bus serve {self._name}, and open the bus anew"
        )

    def fork(self) -> None:
        """End this copy of an attachment, in a process that was forked: the thread exists in the other one only."""
        self._lock = threading.Lock()
        self._changed, self._arrived = threading.Condition(self._lock), threading.Condition(self._lock)
        self._end = self._forked
        self._events.clear()
        if (descriptor := self._connection.detach()) >= 0:  # the connection has not ended
            os.close(descriptor)  # without an end for the other process
        if self._signal is not None:
            os.close(self._signal)
            self._signal = None

    def _forked(self) -> Error:
        return TransportError(
            f"{self.description}: this process was forked from the one that opened the bus: open buses after the fork"
        )

    def _check(self) -> None:
        if self._end is not None:
            raise self._end()

    def _finish(self, end: Callable[[], Error]) -> None:
        """Let all calls raise this error, once the events that have arrived are read."""
        if self._end is None or end == self._closed:
            self._end = end
        with contextlib.suppress(OSError):  # the server was faster
            self._connection.shutdown(socket.SHUT_RDWR)  # wakes the thread
        self._changed.notify_all()
        self._arrived.notify_all()
        self._show()

    # In the thread

    def _run(self) -> None:
        try:
            with self._connection, self._connection.makefile("rb", buffering=_BUFFER) as stream:
                while len(head := stream.read(wire.HEAD_SIZE)) == wire.HEAD_SIZE:
                    kind, size = wire.decode_head(head)
                    body = stream.read(size)
                    if len(body) < size:
                        break
                    if kind == wire.MessageType.EVENTS:
                        self._take(body)
        except (OSError, DecodeError):
            pass
        with self._lock:
            self._finish(self._gone)

    def _take(self, body: bytes) -> None:
        """Note the status and the events of a message, and wake those that wait for them."""
        status = wire.decode_status(body)
        with self._lock:
            if self._end is not None:
                return
            events, self._status = self._events, status
            events.extend(wire.event_records(body))
            excess = len(events) - self._events_max
            if excess > 0:
                self._dropped += excess
                for _ in range(excess):
                    events.popleft()
            self._changed.notify_all()
            if events:
                self._arrived.notify_all()
            self._show()
        if self.lost and not self._warned:
            self._warned = True
            logger.warning("%s: this program reads frames too late, and loses the oldest ones", self._name)


_clock: Final = SystemClock()
_attachments: weakref.WeakSet[ServedAttachment] = weakref.WeakSet()


def _after_fork() -> None:
    for attachment in list(_attachments):
        attachment.fork()


os.register_at_fork(after_in_child=_after_fork)


def _wait(condition: threading.Condition, deadline: int | None) -> bool:
    """Wait for a condition; return False after the deadline (ns)."""
    if deadline is None:
        return condition.wait()
    left = (deadline - _clock.monotonic()) / SECOND
    return left > 0 and condition.wait(min(left, threading.TIMEOUT_MAX))
