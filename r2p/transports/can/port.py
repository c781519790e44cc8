"""What RTCAN needs of a CAN interface: the seam between the protocol and what carries its frames.

    RtcanLink  ->  Shell (one Engine)  ->  CanPort  ->  simulated bus, SocketCAN, python-can

A port moves frames and tells when it did; it knows nothing of slots, laxity or topics. All instants are ns of the
port's own clock `now()`, which is the module's monotonic clock, except where a simulated node has a clock that drifts.
"""

import abc
import asyncio
from collections.abc import Callable
from typing import Generic, Protocol, TypeVar

from r2p.clock import ExactAlarm, clock_of
from r2p.codecs.rtcan import Frame, OtherFrame
from r2p.protocols.rtcan.events import Mailbox, Outcome, Transmit, Withdraw


class CanPortListener(Protocol):
    """What a port calls, in the event loop; also from within `transmit` and `withdraw`. None of these raises."""

    def received(self, frame: Frame, stamp: int) -> None:
        """A frame of another node came in; `stamp`: the end of the frame plus `receive_latency`."""

    def other(self, frame: OtherFrame, stamp: int) -> None:
        """A frame that RTCAN does not use was on the bus; only where there are no filters."""

    def confirmed(self, mailbox: Mailbox, outcome: Outcome, at: int) -> None:
        """What became of the frame in this mailbox, which is empty now, and when: for SENT, the frame's end.

        Exactly once for each `transmit`, while the port is up; `down` ends all of them without.
        """

    def up(self) -> None:
        """The bus can be used."""

    def down(self, reason: str) -> None:
        """It can't any more: interface down or gone, bus-off. Mailboxes are empty; no frame of theirs is sent later."""

    def waits(self, reason: str) -> None:
        """It can't be used yet; the port goes on trying."""

    def fault(self, kind: str) -> None:
        """Something went wrong on the bus, such as an error frame: counted by kind."""

    def internal_error(self, error: Exception) -> None:
        """The handling of a frame or of a timer raised: counted, logged; the port goes on with the next one."""


class PortAlarm(Protocol):
    """One timer that can be moved."""

    def set(self, deadline: int | None) -> None:
        """Go off once at this instant of the port's clock (ns), at once if it is over; None: not at all."""

    def close(self) -> None:
        """Never go off again."""


class CanPort(abc.ABC):
    """One CAN interface."""

    one_shot: bool = False
    """A frame that loses arbitration comes back (LOST), to be tried again with a fresh laxity."""
    transmit_latency: int = 0
    """Ns from the hand-over of a frame to its start, typically; it is handed over that much before its instant."""
    receive_latency: int = 0
    """Ns from the end of a frame to its stamp, typically."""
    coarse: bool = False
    """It can't hit an instant to a few us, so it gets runs of free slots for what is not hard real-time."""

    def __init__(self, name: str) -> None:
        self.name = name
        """As in the URL, without the scheme and options: `can0`."""

    @abc.abstractmethod
    async def run(self, user: CanPortListener, opened: Callable[[], object]) -> None:
        """Keep the interface open until cancelled; then close it.

        Calls `opened()` once it works, or works on its way by itself. Raises TransportError for what waiting can't
        mend, and before `opened()` also for an interface that does not exist.
        """

    @abc.abstractmethod
    def transmit(self, order: Transmit) -> None:
        """Put the frame into its mailbox, which is empty, to start between the order's two instants (Engine, 3)."""

    @abc.abstractmethod
    def withdraw(self, order: Withdraw) -> None:
        """Take it back if it has not started; it is confirmed as every frame is: LATE if nobody has seen it."""

    @abc.abstractmethod
    def set_filters(self, filters: list[tuple[int, int]] | None) -> None:
        """Only frames with `id & mask == identifier` of one of these (identifier, mask) are needed.

        None: all frames are, those too that RTCAN does not use.
        """

    def now(self) -> int:
        """The port's clock."""
        return clock_of().monotonic()

    def monotonic(self, instant: int) -> int:
        """An instant of the port's clock, by the module's monotonic clock."""
        return instant

    def alarm(self, callback: Callable[[], object]) -> PortAlarm:
        """A timer on the port's clock; never early. As exact as the system allows."""
        return ExactAlarm(asyncio.get_running_loop(), callback)


class OpenInterface(Protocol):
    """An interface while it can be used."""

    def transmit(self, order: Transmit) -> None:
        """As `CanPort.transmit`."""

    def withdraw(self, order: Withdraw) -> None:
        """As `CanPort.withdraw`."""

    def set_filters(self, filters: list[tuple[int, int]] | None) -> None:
        """As `CanPort.set_filters`."""


B = TypeVar("B", bound=OpenInterface)


class InterfacePort(CanPort, Generic[B]):
    """A port whose interface comes and goes: `_bus`, None while it can't be used. What is sent then is lost."""

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
