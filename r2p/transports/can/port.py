"""The port: the interface of a CAN controller to RTCAN, and the common part of ports to real interfaces.

    EngineDriver  --transmit, withdraw, filters-->  CanPort  <-->  simulated bus, SocketCAN, python-can
                  <--frames, confirmations, state--

A port moves frames and reports when each one was on the bus; it knows nothing of cycles, laxities or topics. All
instants are ns of the port's own clock `now()`, which is the module's monotonic clock, except where a simulated node
has a clock that drifts.

Real interfaces queue frames and confirm them late, so each has mailboxes in software in front of it (`TxMailboxes`).
"""

import abc
import asyncio
from collections.abc import Callable
from typing import Generic, Protocol, TypeVar

import msgspec

from r2p.clock import ExactAlarm, clock_of
from r2p.codecs.can_bits import Frame, OtherFrame, WireFrame
from r2p.protocols.can_orders import Mailbox, Outcome, Transmit, Withdraw
from r2p.transports.stats import RETRY_AFTER_ERROR
from r2p.units import NEVER

RETRY_INTERVAL = 500_000
"""Ns until the next try when the driver's queue is full, some four frames: no interface reports free room."""


class CanPortListener(Protocol):
    """The calls of a port, in the event loop, also from within `transmit` and `withdraw`. None of these raises."""

    def on_frame(self, frame: Frame, stamp: int) -> None:
        """Handle a frame of another node. `stamp` is the end of the frame plus `receive_latency`."""

    def on_other_frame(self, frame: OtherFrame, stamp: int) -> None:
        """Handle a frame that RTCAN does not use. Called only while there are no filters."""

    def on_confirmed(self, mailbox: Mailbox, outcome: Outcome, at: int) -> None:
        """Note that the frame in this mailbox is done, and the mailbox empty. `at` is the frame's end if it was SENT.

        Called exactly once for each `transmit` while the port is up; `on_down` ends all of them without a call.
        """

    def on_up(self) -> None:
        """Begin to use the bus."""

    def on_down(self, reason: str) -> None:
        """Stop using the bus: interface down or gone, or bus-off. No frame in a mailbox is sent later."""

    def on_waiting(self, reason: str) -> None:
        """Report that the bus can't be used yet. The port goes on trying."""

    def on_fault(self, kind: str) -> None:
        """Count a fault of the bus by its kind, such as what an error frame reports."""

    def internal_error(self, error: Exception) -> None:
        """Count and log an exception in the handling of a frame or a timer. The port goes on with the next one."""


class FrameTap(Protocol):
    """An observer of a real interface, which gets every frame as it was on the bus. None of its calls raises."""

    def on_frames(self, frames: list[WireFrame], utc_offset: int) -> None:
        """Handle a batch, own and error frames included. `utc_offset`: ns from their stamps to UTC."""

    def on_lost(self, count: int, reason: str) -> None:
        """Count frames that were on the bus and can't be handed out."""


class PortAlarm(Protocol):
    """One timer that can be moved."""

    def set(self, deadline: int | None) -> None:
        """Go off once at this instant of the port's clock (ns), at once if it has passed; None switches it off."""

    def close(self) -> None:
        """Never go off again."""


class CanPort(abc.ABC):
    """One CAN interface."""

    one_shot: bool = False
    """True if a frame that loses arbitration comes back (LOST), to be tried again with a fresh laxity."""
    transmit_latency: int = 0
    """Ns from the hand-over of a frame to its start, typically. Frames are handed over that much before their instant.
    """
    receive_latency: int = 0
    """Ns from the end of a frame to its stamp, typically."""
    coarse: bool = False
    """True if the port can't hit an instant to a few us. Then all but hard real-time gets runs of free slots."""

    listen_only: bool = False
    """True if nothing is to be sent, no acknowledge either; set before `run`. Most ports can't do without it."""

    def __init__(self, name: str) -> None:
        self.name = name
        """The name as in the URL, without the scheme and options: `can0`."""

    @abc.abstractmethod
    async def run(self, listener: CanPortListener, opened: Callable[[], object]) -> None:
        """Keep the interface open until cancelled, then close it.

        Calls `opened()` as soon as the port works, or waits for its interface. Raises TransportError for permanent
        faults, and before `opened()` also for an interface that does not exist.
        """

    @abc.abstractmethod
    def transmit(self, order: Transmit) -> None:
        """Put the frame into its empty mailbox. It is to start between the order's two instants (see `Engine`, 3)."""

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
        """Translate an instant of the port's clock to the module's monotonic clock."""
        return instant

    def alarm(self, callback: Callable[[], object]) -> PortAlarm:
        """Return a timer on the port's clock: never early, and as exact as the system allows."""
        return ExactAlarm(asyncio.get_running_loop(), callback)


class OpenInterface(abc.ABC):
    """A real interface while it can be used; `ended` gets the reason when it no longer can."""

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
            listener.on_confirmed,
            latency=latency,
            confirm_timeout=confirm_timeout,
            one_at_a_time=one_at_a_time,
        )
        self._timer = ExactAlarm(self._loop, self._poll)

    def transmit(self, order: Transmit) -> None:
        self._mailboxes.put(self._clock.monotonic(), order)
        self._arm()

    def withdraw(self, order: Withdraw) -> None:
        self._mailboxes.withdraw(self._clock.monotonic(), order.mailbox)
        self._arm()

    @abc.abstractmethod
    def set_filters(self, filters: list[tuple[int, int]] | None) -> None:
        """As `CanPort.set_filters`."""

    @abc.abstractmethod
    def _send(self, frame: Frame, mailbox: Mailbox) -> bool:
        """Hand a frame to the driver. Return False if the driver has no room."""

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
    """A port whose interface may disappear and come back. While it is away, `_bus` is None and frames are lost."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.tap: FrameTap | None = None
        """Gets all frames in place of the listener, which then only hears of the interface; set before `run`."""
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

    async def _use(self, bus: B, listener: CanPortListener) -> str:
        """Use an open interface until its end. Return the reason for the end."""
        bus.set_filters(self._filters)
        self._bus = bus
        try:
            listener.on_up()
            return await bus.ended
        finally:
            self._bus = None


# Mailboxes in software


class _PendingFrame(msgspec.Struct, eq=False):
    """A frame in a mailbox."""

    order: Transmit
    due: int  # when to hand it over; once it is handed over, when to give up its confirmation
    latest: int  # when it is too late to hand it over
    handed_over: bool = False


class TxMailboxes:
    """Three mailboxes in front of a driver's queue: one outstanding frame per class. No I/O, no clock.

        put -> waits (for its instant, for the driver, for its turn) -> handed over -> confirmed
                                   |                                         |
                                 LATE                                     UNKNOWN, when no confirmation comes

    A frame that waits can be withdrawn; one that was handed over can't, and is never handed over twice.

    `send(frame, mailbox)` hands a frame over, and returns False without room. `confirm(mailbox, outcome, at)`
    is called once for each frame. `latency`: ns from the hand-over to the start of frame. `confirm_timeout`: ns until a
    confirmation is given up. `one_at_a_time`: hand over only one frame at a time, so that an error frame, which names
    no frame, must be about that one.
    """

    def __init__(
        self,
        send: Callable[[Frame, Mailbox], bool],
        confirm: Callable[[Mailbox, Outcome, int], object],
        *,
        latency: int,
        confirm_timeout: int,
        one_at_a_time: bool = False,
    ) -> None:
        self._send = send
        self._confirm = confirm
        self._latency = latency
        self._confirm_timeout = confirm_timeout
        self._one_at_a_time = one_at_a_time
        self._frames: dict[Mailbox, _PendingFrame] = {}

    @property
    def handed_over(self) -> list[Mailbox]:
        """The mailboxes whose frame was handed over."""
        return [mailbox for mailbox, pending in self._frames.items() if pending.handed_over]

    def put(self, now: int, order: Transmit) -> None:
        """Put a frame into an empty mailbox.

        A frame that is too late already is confirmed by `poll`: the engine would answer a confirmation from here with
        the next frame, which is too late as well, and so on without end.
        """
        due = order.not_before - self._latency
        latest = order.not_after - self._latency if order.not_after < NEVER else NEVER
        pending = self._frames[order.mailbox] = _PendingFrame(order, due, latest)
        if now <= latest:
            self._offer(now, order.mailbox, pending)

    def withdraw(self, now: int, mailbox: Mailbox) -> None:
        """Take a frame back, unless it was handed over."""
        pending = self._frames.get(mailbox)
        if pending is not None and not pending.handed_over:
            self._end(mailbox, Outcome.LATE, now)

    def seen(self, identifier: int, data: bytes, at: int, now: int) -> bool:
        """Confirm an own frame that was on the bus. Return False if it was not handed over here."""
        for mailbox, pending in self._frames.items():
            frame = pending.order.frame
            if pending.handed_over and frame.id == identifier and frame.data == data:
                self._end(mailbox, Outcome.SENT, at)
                self.poll(now)
                return True
        return False

    def failed(self, mailbox: Mailbox, outcome: Outcome, now: int) -> None:
        """Confirm that the frame that was handed over was not sent."""
        if mailbox in self._frames:
            self._end(mailbox, outcome, now)
            self.poll(now)

    def clear(self) -> None:
        """Drop all frames without confirming them: the bus is gone."""
        self._frames.clear()

    def next_deadline(self) -> int | None:
        """The instant at which to call `poll`."""
        blocked = self._one_at_a_time and bool(self.handed_over)
        due = min((self._due(each, blocked=blocked) for each in self._frames.values()), default=NEVER)
        return due if due < NEVER else None

    def poll(self, now: int) -> None:
        """Hand over due frames, the most urgent class first; give up late ones."""
        for mailbox in Mailbox:  # in the order of urgency
            pending = self._frames.get(mailbox)
            if pending is None:
                continue
            if pending.handed_over:
                if pending.due <= now:
                    self._end(mailbox, Outcome.UNKNOWN, now)
            elif pending.latest < now:
                self._end(mailbox, Outcome.LATE, now)
            else:
                self._offer(now, mailbox, pending)

    def _offer(self, now: int, mailbox: Mailbox, pending: _PendingFrame) -> None:
        if pending.due > now or (self._one_at_a_time and self.handed_over):
            return
        if self._send(pending.order.frame, mailbox):
            pending.handed_over = True
            pending.due = now + self._confirm_timeout
        else:
            pending.due = now + RETRY_INTERVAL

    def _due(self, pending: _PendingFrame, *, blocked: bool) -> int:
        if pending.handed_over:
            return pending.due
        too_late = pending.latest + 1  # a frame that waits for its turn behind another one can only become too late
        return too_late if blocked else min(pending.due, too_late)

    def _end(self, mailbox: Mailbox, outcome: Outcome, at: int) -> None:
        # The mailbox is empty before its listener learns of it: the listener may put the next frame there at once.
        del self._frames[mailbox]
        self._confirm(mailbox, outcome, at)
