"""The port to SocketCAN: Linux's CAN interfaces.

One socket does it all, without python-can, whose bus object lacks batches of frames, the flag that marks own frames,
stamps in ns, error frames, and a priority for each frame. The priority is the socket's at the moment of the hand-over,
so one socket serves three classes, and its receive queue keeps the order of others' frames and of confirmations.

r2p never configures an interface: it waits until the interface can be used, and reports the command for that.
"""

import contextlib
import errno
import os
import socket
from collections.abc import Callable

from r2p.clock import Backoff, clock_of, random_of
from r2p.codecs.can_bits import Frame, OtherFrame, WireFrame
from r2p.errors import TransportError
from r2p.protocols.can_orders import Mailbox, Outcome
from r2p.transports.can import netlink, rawsocket
from r2p.transports.can.port import CanPortListener, FrameTap, InterfacePort, OpenInterface, PortAlarm
from r2p.transports.can.rawsocket import RawSocket
from r2p.units import SECOND

PRIORITIES = {Mailbox.HRT: 6, Mailbox.SRT: 0, Mailbox.NRT: 2}
"""SO_PRIORITY of each class: the first, second and third band of the queue that CAN interfaces have (pfifo_fast)."""

CONFIRM_TIMEOUT_NS = SECOND
"""Ns until a confirmation is given up: a frame may wait for a busy bus, and for an acknowledge."""

CONFIRM_TIMEOUT_ONE_SHOT_NS = 20_000_000
"""The same for a controller that tries once: only the way to the controller and back takes time."""

_MASK = socket.CAN_EFF_MASK
_BATCHES_MAX = 16  # more than the socket's receive queue holds
_TAP_BUFFER = 8 << 20  # bytes of the queue for an observer of all frames: a second of a saturated bus
_TAP_BATCHES_MAX = 512  # ... and more than that holds
_CHECK_MAX_S = 2.0  # between checks of an interface that is not there; changes are noticed earlier


class SocketCanPort(InterfacePort["_SocketCanBus"]):
    """The interface `name`, such as "can0"."""

    transmit_latency = 100_000  # ns: the event loop, the kernel's queue, and the driver
    receive_latency = 50_000  # ns: the kernel stamps in its interrupt, not the event loop
    coarse = True

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self._monotonic = clock_of().monotonic

    def now(self) -> int:
        """The instant at which the current batch was read: the clock is read once for each batch."""
        bus = self._bus
        return self._monotonic() if bus is None or bus.read_at is None else bus.read_at

    async def run(self, listener: CanPortListener, opened: Callable[[], object]) -> None:
        if not netlink.has_socketcan():
            raise TransportError(f"rtcan:{self.name}: this system has no SocketCAN (sudo modprobe can_raw)")
        if netlink.find_interface(self.name) is None:
            raise TransportError(f"rtcan:{self.name}: no CAN interface has this name; r2p doctor lists those there are")
        opened()
        backoff = Backoff(random_of(), longest=_CHECK_MAX_S)
        async with netlink.InterfaceWatch() as watch:
            while True:
                if await self._serve(listener):
                    backoff.reset()
                await watch.wait(backoff.delay())

    def alarm(self, callback: Callable[[], object]) -> PortAlarm:
        """A timer that reads waiting frames before it goes off: no time-out may outrun a frame in the kernel."""

        def read_and_call() -> None:
            if self._bus is not None:
                self._bus.read_all()
            callback()

        return super().alarm(read_and_call)

    async def _serve(self, listener: CanPortListener) -> bool:
        """Use the interface until it is gone. Return False if it can't be used now."""
        bus = self._open(listener)
        if isinstance(bus, str):
            listener.on_waiting(bus)
            return False
        bus.start()
        try:
            reason = await self._use(bus, listener)
        finally:
            bus.close()
        listener.on_down(reason)
        return True

    def _open(self, listener: CanPortListener) -> "_SocketCanBus | str":
        """Open the interface, or return why it can't be used now, and what to do."""
        try:
            interface = netlink.find_interface(self.name)
            if interface is None:
                return f"{self.name} is not there: plug it in (ip link)"
            if interface.problem:
                return interface.problem
            # Read each time: the interface may have been configured anew while it was down.
            self.one_shot = interface.one_shot
            if self.tap is not None:
                return _SocketCanBus(RawSocket(self.name, _TAP_BUFFER), listener, tap=self.tap)
            return _SocketCanBus(RawSocket(self.name), listener, one_shot=interface.one_shot)
        except OSError as error:
            return f"{self.name}: {_reason(error)}"


class _SocketCanBus(OpenInterface):
    """An interface while it is up."""

    def __init__(
        self, sock: RawSocket, listener: CanPortListener, *, one_shot: bool = False, tap: FrameTap | None = None
    ) -> None:
        # A one-shot controller reports a failure by an error frame, which names no frame: so one at a time.
        super().__init__(
            listener,
            latency=SocketCanPort.transmit_latency,
            confirm_timeout=CONFIRM_TIMEOUT_ONE_SHOT_NS if one_shot else CONFIRM_TIMEOUT_NS,
            one_at_a_time=one_shot,
        )
        self.read_at: int | None = None
        """The instant at which the current batch was read; None outside of batches."""
        self._socket = sock
        self._one_shot = one_shot
        self._dropped = 0
        self._tap = tap

    def start(self) -> None:
        self._loop.add_reader(self._socket.fileno(), self._read_batch)

    def close(self) -> None:
        self._loop.remove_reader(self._socket.fileno())
        if self._tap is not None:
            self._read_last(self._tap)
        self._socket.close()
        self._timer.close()
        self._mailboxes.clear()

    def set_filters(self, filters: list[tuple[int, int]] | None) -> None:
        try:
            self._socket.set_filters(filters)
        except OSError as error:
            self._end(_reason(error))

    def read_all(self) -> None:
        """Read all waiting frames, but not without end."""
        for _ in range(_BATCHES_MAX):
            if self._read_batch() < rawsocket.BATCH:
                return

    def _send(self, frame: Frame, mailbox: Mailbox) -> bool:
        if self.ended.done():
            return False
        try:
            return self._socket.send(frame, PRIORITIES[mailbox])
        except OSError as error:
            self._end(_reason(error))
            return False

    def _read_batch(self) -> int:
        """Read a batch and hand it out. Return the number of frames."""
        if self.ended.done():
            return 0
        try:
            frames = self._socket.receive()
        except OSError as error:
            self._end(_reason(error))
            return 0
        self.read_at = self._clock.monotonic()
        try:
            if self._tap is None:
                self._hand_out(frames)
            else:
                self._hand_to_tap(frames, self._tap)
        finally:
            self.read_at = None
        self._arm()
        return len(frames)

    def _hand_out(self, frames: list[WireFrame]) -> None:
        # Runs for every frame on the bus: names are local to save look-ups, and the most frequent kind comes first.
        received, mask, own = self._listener.on_frame, _MASK, rawsocket.OWN
        flags_of_id, data_frame = rawsocket.FLAGS, rawsocket.DATA
        for identifier, data, flags, stamp in frames:
            kind = identifier & flags_of_id
            try:
                if kind == data_frame and not flags & own:
                    received(Frame(identifier & mask, data), stamp)
                elif kind == data_frame:
                    self._own_frame(identifier & mask, data, stamp)
                elif kind & rawsocket.ERROR:
                    self._error_frame(identifier & mask, data)
                else:
                    self._other_frame(identifier, data, stamp)
            except Exception as error:  # noqa: BLE001 - counted and logged; the next frame follows
                self._listener.internal_error(error)
        while self._dropped < self._socket.dropped:
            self._dropped += 1
            self._listener.on_fault("receive queue full")

    def _hand_to_tap(self, frames: list[WireFrame], tap: FrameTap) -> None:
        try:
            tap.on_frames(frames, self._socket.utc_offset)
        except Exception as error:  # noqa: BLE001 - counted and logged; the next batch follows
            self._listener.internal_error(error)
        self._report_dropped(self._socket.dropped, tap)

    def _report_dropped(self, dropped: int, tap: FrameTap) -> None:
        if dropped > self._dropped:
            tap.on_lost(dropped - self._dropped, "receive queue full")
            self._dropped = dropped

    def _read_last(self, tap: FrameTap) -> None:
        """Read the frames that wait, and count those that were dropped behind the last of them."""
        with contextlib.suppress(OSError):  # the interface is gone: nothing waits
            for _ in range(_TAP_BATCHES_MAX):
                if not (frames := self._socket.receive()):
                    break
                self._hand_to_tap(frames, tap)
        self._report_dropped(self._socket.count_dropped(), tap)

    def _own_frame(self, identifier: int, data: bytes, stamp: int) -> None:
        if not self._mailboxes.seen(identifier, data, stamp, self._clock.monotonic()):
            self._listener.on_fault("confirmed too late")  # it was given up as UNKNOWN, and is not sent again

    def _other_frame(self, identifier: int, data: bytes, stamp: int) -> None:
        extended, remote = bool(identifier & rawsocket.DATA), bool(identifier & socket.CAN_RTR_FLAG)
        number = identifier & (_MASK if extended else socket.CAN_SFF_MASK)
        frame = OtherFrame(number, b"", extended, len(data)) if remote else OtherFrame(number, data)
        self._listener.on_other_frame(frame, stamp)

    def _error_frame(self, identifier: int, data: bytes) -> None:
        report = rawsocket.decode_error(identifier, data)
        for kind in report.kinds:
            self._listener.on_fault(kind)
        if report.bus_off:
            self._end("bus-off: too many errors, most often a wrong bit rate or a cable")
        elif self._one_shot and (report.arbitration_lost or report.destroyed):
            for mailbox in self._mailboxes.handed_over:  # one at most
                outcome = Outcome.LOST if report.arbitration_lost else Outcome.ERROR
                self._mailboxes.failed(mailbox, outcome, self._clock.monotonic())

    def _end(self, reason: str) -> None:
        if not self.ended.done():
            self._loop.remove_reader(self._socket.fileno())
        super()._end(reason)


_REASONS = {
    errno.ENETDOWN: "the interface is down",
    errno.ENXIO: "the interface is gone",
    errno.ENODEV: "the interface is gone",
}


def _reason(error: OSError) -> str:
    code = error.errno or 0
    return _REASONS.get(code) or os.strerror(code)
