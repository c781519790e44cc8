"""RTCAN's port to SocketCAN: Linux's CAN interfaces.

One socket does it all, without python-can, whose bus object would only be in the way of what is needed here: batches of
frames, the flag that marks our own ones, stamps in ns, error frames, and a priority for each frame. The priority is the
socket's when a frame is handed over, so one socket serves three classes, and its queue keeps the order of what others
sent and what became of ours.

r2p never configures an interface: it waits until it can be used, and says what would make it so.
"""

import asyncio
import errno
import os
import socket
from collections.abc import Callable

from r2p.clock import Backoff, ExactAlarm, clock_of, random_of
from r2p.codecs.rtcan import Frame, OtherFrame
from r2p.errors import TransportError
from r2p.protocols.rtcan.events import Mailbox, Outcome, Transmit, Withdraw
from r2p.transports.can import errorframes, rawsocket
from r2p.transports.can import netlink as interface
from r2p.transports.can.port import CanPortListener, InterfacePort, PortAlarm
from r2p.transports.can.rawsocket import RawSocket
from r2p.transports.can.tx_slots import TxSlots
from r2p.transports.stats import RETRY_AFTER_ERROR

PRIORITIES = {Mailbox.HRT: 6, Mailbox.SRT: 0, Mailbox.NRT: 2}
"""SO_PRIORITY of each class: the first, second and third band of the queue that CAN interfaces have (pfifo_fast)."""

PATIENCE = 1_000_000_000
"""Ns until a confirmation is given up: a frame may wait for a busy bus, and for an acknowledge."""

PATIENCE_ONE_SHOT = 20_000_000
"""The same for a controller that tries once: nothing but the way to it and back takes time."""

_MASK = socket.CAN_EFF_MASK
_BATCHES = 16  # more than the socket's queue holds
_LONGEST_WAIT = 2.0  # seconds between looks at an interface that is not there; changes are noticed before


class SocketCanPort(InterfacePort["_SocketCanBus"]):
    """The interface `name`, such as "can0"."""

    transmit_latency = 100_000
    receive_latency = 50_000
    coarse = True

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self._monotonic = clock_of().monotonic

    def now(self) -> int:
        """While a batch of frames is handed out, the instant when it was read."""
        bus = self._bus
        return self._monotonic() if bus is None or bus.reading is None else bus.reading

    async def run(self, user: CanPortListener, opened: Callable[[], object]) -> None:
        if not interface.socketcan():
            raise TransportError(f"rtcan:{self.name}: this system has no SocketCAN (sudo modprobe can_raw)")
        if interface.look(self.name) is None:
            raise TransportError(f"rtcan:{self.name}: no CAN interface has this name; r2p doctor lists those there are")
        opened()
        backoff = Backoff(random_of(), longest=_LONGEST_WAIT)
        async with interface.InterfaceWatch() as watch:
            while True:
                if await self._use(user):
                    backoff.reset()
                await watch.wait(backoff.delay())

    def alarm(self, callback: Callable[[], object]) -> PortAlarm:
        """Before it goes off, what has come in is taken: no time-out may outrun a frame that waits in the kernel."""

        def ring() -> None:
            if self._bus is not None:
                self._bus.catch_up()
            callback()

        return ExactAlarm(asyncio.get_running_loop(), ring)

    async def _use(self, user: CanPortListener) -> bool:
        """Use the interface until it is gone; False if it can't be had."""
        try:
            there = self._look()
            bus = _SocketCanBus(RawSocket(self.name), user, one_shot=there.one_shot)
        except _Unusable as error:
            user.waits(str(error))
            return False
        except OSError as error:
            user.waits(f"{self.name}: {_reason(error)}")
            return False
        self.one_shot = there.one_shot
        self.bit_rate = there.bitrate or 0
        bus.set_filters(self._filters)
        self._bus = bus
        try:
            bus.start()
            user.up()
            reason = await bus.ended
        finally:
            self._bus = None
            bus.close()
        user.down(reason)
        return True

    def _look(self) -> interface.Interface:
        there = interface.look(self.name)
        if there is None:
            raise _Unusable(f"{self.name} is not there: plug it in (ip link)")
        if there.trouble:
            raise _Unusable(there.trouble)
        return there


class _Unusable(Exception):
    """The interface can't be used now; the text says why, and what to do."""


class _SocketCanBus:
    """An interface that is up, until it is not."""

    def __init__(self, sock: RawSocket, user: CanPortListener, *, one_shot: bool) -> None:
        loop = asyncio.get_running_loop()
        self.ended: asyncio.Future[str] = loop.create_future()
        self._loop = loop
        self._clock = clock_of(loop)
        self._socket = sock
        self._user = user
        self._one_shot = one_shot
        self.reading: int | None = None
        """When the batch was read that is being handed out."""
        self._dropped = 0
        self._mailboxes = TxSlots(
            self._send,
            user.confirmed,
            latency=SocketCanPort.transmit_latency,
            patience=PATIENCE_ONE_SHOT if one_shot else PATIENCE,
            singly=one_shot,
        )
        self._alarm = ExactAlarm(loop, self._poll)

    def start(self) -> None:
        """Read from now on."""
        self._loop.add_reader(self._socket.fileno(), self._readable)

    def close(self) -> None:
        self._loop.remove_reader(self._socket.fileno())
        self._socket.close()
        self._alarm.close()
        self._mailboxes.clear()

    def transmit(self, order: Transmit) -> None:
        self._mailboxes.put(self._clock.monotonic(), order)
        self._arm()

    def withdraw(self, order: Withdraw) -> None:
        self._mailboxes.withdraw(self._clock.monotonic(), order.mailbox)
        self._arm()

    def set_filters(self, filters: list[tuple[int, int]] | None) -> None:
        try:
            self._socket.set_filters(filters)
        except OSError as error:
            self._end(_reason(error))

    def _send(self, frame: Frame, mailbox: Mailbox) -> bool:
        if self.ended.done():
            return False
        try:
            return self._socket.send(frame, PRIORITIES[mailbox])
        except OSError as error:
            self._end(_reason(error))
            return False

    def catch_up(self) -> None:
        """Take all that is there, within reason."""
        for _ in range(_BATCHES):
            if self._readable() < rawsocket.BATCH:
                return

    def _readable(self) -> int:
        """Take a batch; says how many frames it was."""
        if self.ended.done():
            return 0
        try:
            arrived = self._socket.receive()
        except OSError as error:
            self._end(_reason(error))
            return 0
        self.reading = self._clock.monotonic()
        try:
            self._hand_out(arrived)
        finally:
            self.reading = None
        self._arm()
        return len(arrived)

    def _hand_out(self, arrived: list[rawsocket.Arrived]) -> None:
        received, flags_of, plain, mask, own = (
            self._user.received,
            rawsocket.FLAGS,
            rawsocket.DATA,
            _MASK,
            rawsocket.OWN,
        )
        for identifier, data, flags, stamp in arrived:
            kind = identifier & flags_of
            try:
                if kind == plain and not flags & own:
                    received(Frame(identifier & mask, data), stamp)
                elif kind == plain:
                    self._own(identifier & mask, data, stamp)
                elif kind & rawsocket.ERROR:
                    self._error(identifier & mask, data)
                else:
                    self._other(identifier, data, stamp)
            except Exception as error:  # noqa: BLE001 - counted and logged; the next frame follows
                self._user.internal_error(error)
        while self._dropped < self._socket.dropped:
            self._dropped += 1
            self._user.fault("receive queue full")

    def _own(self, identifier: int, data: bytes, stamp: int) -> None:
        if not self._mailboxes.seen(identifier, data, stamp, self._clock.monotonic()):
            self._user.fault("confirmed too late")

    def _other(self, identifier: int, data: bytes, stamp: int) -> None:
        extended, remote = bool(identifier & rawsocket.DATA), bool(identifier & socket.CAN_RTR_FLAG)
        number = identifier & (_MASK if extended else socket.CAN_SFF_MASK)
        frame = OtherFrame(number, b"", extended, len(data)) if remote else OtherFrame(number, data)
        self._user.other(frame, stamp)

    def _error(self, identifier: int, data: bytes) -> None:
        report = errorframes.decode(identifier, data)
        for kind in report.kinds:
            self._user.fault(kind)
        if report.bus_off:
            self._end("bus-off: too many errors, most often a wrong bit rate or a cable")
        elif self._one_shot and (report.lost or report.destroyed):
            for mailbox in self._mailboxes.handed:  # one at most
                outcome = Outcome.LOST if report.lost else Outcome.ERROR
                self._mailboxes.failed(mailbox, outcome, self._clock.monotonic())

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
        if not self.ended.done():
            self._alarm.set(self._mailboxes.next_deadline())

    def _end(self, reason: str) -> None:
        if not self.ended.done():
            self._loop.remove_reader(self._socket.fileno())
            self._mailboxes.clear()
            self.ended.set_result(reason)


_REASONS = {
    errno.ENETDOWN: "the interface is down",
    errno.ENXIO: "the interface is gone",
    errno.ENODEV: "the interface is gone",
}


def _reason(error: OSError) -> str:
    code = error.errno or 0
    return _REASONS.get(code) or os.strerror(code)
