"""The port: what RTCAN needs of a CAN controller, and what the ports to real interfaces share.

    EngineDriver  --transmit, withdraw, filters-->  CanPort  <-->  simulated bus, SocketCAN, python-can
                  <--frames, confirmations, state--

A port moves frames and reports when each one was on the bus; it knows nothing of cycles, laxities or topics. All
instants are ns of the port's own clock `now()`, which is the module's monotonic clock, except where a simulated node
has a clock that drifts.
"""

import abc
import asyncio
from collections.abc import Callable
from typing import Generic, Protocol, TypeVar

from r2p.clock import ExactAlarm, clock_of
from r2p.codecs.rtcan import Frame, OtherFrame
from r2p.protocols.rtcan.events import Mailbox, Outcome, Transmit, Withdraw
from r2p.transports.can.tx_mailboxes import TxMailboxes
from r2p.transports.stats import RETRY_AFTER_ERROR


class CanPortListener(Protocol):
    """What a port calls, in the event loop, also from within `transmit` and `withdraw`. None of these raises."""

    def received(self, frame: Frame, stamp: int) -> None:
        """A frame of another node came in. `stamp` is the end of the frame plus `receive_latency`."""

    def other(self, frame: OtherFrame, stamp: int) -> None:
        """A frame that RTCAN does not use was on the bus. Called only while there are no filters."""

    def confirmed(self, mailbox: Mailbox, outcome: Outcome, at: int) -> None:
        """The frame in this mailbox is done, and the mailbox is empty. `at` is the frame's end if it was SENT.

        Called exactly once for each `transmit` while the port is up; `down` ends all of them without a call.
        """

    def up(self) -> None:
        """The bus can be used."""

    def down(self, reason: str) -> None:
        """The bus can no longer be used: interface down or gone, or bus-off. All mailboxes are empty, and none of
        their frames is sent later.
        """

    def waits(self, reason: str) -> None:
        """The bus can't be used yet. The port goes on trying."""

    def fault(self, kind: str) -> None:
        """Something went wrong on the bus, such as an error frame. Faults are counted by kind."""

    def internal_error(self, error: Exception) -> None:
        """The handling of a frame or of a timer raised: count and log it. The port goes on with the next one."""


class PortAlarm(Protocol):
    """One timer that can be moved."""

    def set(self, deadline: int | None) -> None:
        """Go off once at this instant of the port's clock (ns), at once if it is over. None: do not go off."""

    def close(self) -> None:
        """Never go off again."""


class CanPort(abc.ABC):
    """One CAN interface."""

    one_shot: bool = False
    """Whether a frame that loses arbitration comes back (LOST), to be tried again with a fresh laxity."""
    transmit_latency: int = 0
    """Ns from the hand-over of a frame to its start, typically. Frames are handed over that much before their instant.
    """
    receive_latency: int = 0
    """Ns from the end of a frame to its stamp, typically."""
    coarse: bool = False
    """Whether it can't hit an instant to a few us. Then what is not hard real-time gets runs of free slots."""

    def __init__(self, name: str) -> None:
        self.name = name
        """As in the URL, without the scheme and options: `can0`."""

    @abc.abstractmethod
    async def run(self, listener: CanPortListener, opened: Callable[[], object]) -> None:
        """Keep the interface open until cancelled, then close it.

        Calls `opened()` once it works, or waits for the interface to work. Raises TransportError for what waiting can't
        mend, and before `opened()` also for an interface that does not exist.
        """

    @abc.abstractmethod
    def transmit(self, order: Transmit) -> None:
        """Put the frame into its empty mailbox, to start between the order's two instants (see `Engine`, 3)."""

    @abc.abstractmethod
    def withdraw(self, order: Withdraw) -> None:
        """Take the frame back if it has not started. It is confirmed like every frame: LATE if it was never sent."""

    @abc.abstractmethod
    def set_filters(self, filters: list[tuple[int, int]] | None) -> None:
        """Deliver only frames with `id & mask == identifier` of one of these (identifier, mask).

        None: deliver all frames, including those that RTCAN does not use.
        """

    def now(self) -> int:
        """The port's clock."""
        return clock_of().monotonic()

    def monotonic(self, instant: int) -> int:
        """An instant of the port's clock, by the module's monotonic clock."""
        return instant

    def alarm(self, callback: Callable[[], object]) -> PortAlarm:
        """A timer on the port's clock: never early, and as exact as the system allows."""
        return ExactAlarm(asyncio.get_running_loop(), callback)


class OpenInterface(abc.ABC):
    """A real interface while it can be used. `ended` gets the reason when it no longer can."""

    def __init__(
        self, listener: CanPortListener, *, latency: int, confirm_timeout: int, one_at_a_time: bool = False
    ) -> None:
        """`latency`, `confirm_timeout` (both ns) and `one_at_a_time` are those of `TxMailboxes`."""
        self._loop = asyncio.get_running_loop()
        self.ended: asyncio.Future[str] = self._loop.create_future()
        self._clock = clock_of(self._loop)
        self._listener = listener
        self._mailboxes = TxMailboxes(
            self._send,
            listener.confirmed,
            latency=latency,
            confirm_timeout=confirm_timeout,
            one_at_a_time=one_at_a_time,
        )
        self._timer = ExactAlarm(self._loop, self._poll)

    def transmit(self, order: Transmit) -> None:
        """As `CanPort.transmit`."""
        self._mailboxes.put(self._clock.monotonic(), order)
        self._arm()

    def withdraw(self, order: Withdraw) -> None:
        """As `CanPort.withdraw`."""
        self._mailboxes.withdraw(self._clock.monotonic(), order.mailbox)
        self._arm()

    @abc.abstractmethod
    def set_filters(self, filters: list[tuple[int, int]] | None) -> None:
        """As `CanPort.set_filters`."""

    @abc.abstractmethod
    def _send(self, frame: Frame, mailbox: Mailbox) -> bool:
        """Hand a frame to the driver. False if the driver has no room."""

    def _poll(self) -> None:
        now = self._clock.monotonic()
        try:
            self._mailboxes.poll(now)
        except Exception as error:  # noqa: BLE001 - counted and logged
            self._listener.internal_error(error)
            self._timer.set(now + RETRY_AFTER_ERROR)  # not at once: the deadline that raised is still the next one
        else:
            self._arm()

    def _arm(self) -> None:
        if not self.ended.done():
            self._timer.set(self._mailboxes.next_deadline())

    def _end(self, reason: str) -> None:
        if not self.ended.done():
            self._mailboxes.clear()
            self.ended.set_result(reason)


B = TypeVar("B", bound=OpenInterface)


class InterfacePort(CanPort, Generic[B]):
    """A port whose interface comes and goes: `_bus` is None while it can't be used, and what is sent then is lost."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self._filters: list[tuple[int, int]] | None = [(0, 0)]
        self._bus: B | None = None

    def transmit(self, order: Transmit) -> None:
        if self._bus is not None:
            self._bus.transmit(order)

    def withdraw(self, order: Withdraw) -> None:
        if self._bus is not None:
            self._bus.withdraw(order)

    def set_filters(self, filters: list[tuple[int, int]] | None) -> None:
        self._filters = filters
        if self._bus is not None:
            self._bus.set_filters(filters)
