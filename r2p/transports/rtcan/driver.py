"""The one loop that drives an RTCAN engine: feed it an event, act on what it returns, re-arm one timer.

    CanPort  --frames, confirmations, state-->  Engine  --Transmit, Withdraw-->   CanPort
    timer    ------------poll---------------->          --messages, events--->    DriverOwner
             <-----------next_deadline--------

Consequences of an action come after the actions before it: a port may confirm from within `transmit`, and the owner may
publish from within `act`. Both end in `carry_out`, which then only queues.

A `Monitor` may watch: it gets every frame on the bus, this node's own ones as they are confirmed. `UtcEstimator`
translates the engine's network time to UTC.
"""

import asyncio
import math
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, Protocol

from r2p.clock import clock_of
from r2p.codecs.rtcan import Frame, OtherFrame
from r2p.messages import ClockOffset
from r2p.protocols.can_orders import Mailbox, Outcome, Transmit, Withdraw
from r2p.protocols.rtcan.engine import Engine
from r2p.protocols.rtcan.events import Action
from r2p.protocols.rtcan.monitor import Monitor
from r2p.transports.can.port import CanPort
from r2p.transports.stats import RETRY_AFTER_ERROR

_MEASURE_INTERVAL = 100_000_000  # ns between two measurements of UTC: clocks 100 ppm apart drift by 10 us meanwhile
_MEASUREMENTS = 32  # that count: those of the last 3 s
_READING = 10_000  # ns by which network time may be off here: interrupts by 3 us at either end, and drift in a cycle
_BIAS = 2_000  # ns of that which more measurements do not average out: clocks 200 ppm apart, always late in a cycle
_RATE_MAX = 2e-4  # by which UTC and the master's clock differ, while there is only one measurement


class DriverOwner(Protocol):
    """The receiver of an engine's messages and events: a link, or a node of a benchmark."""

    def act(self, action: Action) -> None:
        """Handle a message or an event: any action but `Transmit` and `Withdraw`."""

    def bus_up(self) -> None:
        """Note that the engine has started: `Ready` will follow."""

    def bus_down(self, reason: str) -> None:
        """Note that the engine has stopped. What it discards follows."""

    def bus_waits(self, reason: str) -> None:
        """Report that the port can't be used yet."""

    def bus_fault(self, kind: str) -> None:
        """Count a fault of the bus by its kind."""

    def internal_error(self, error: Exception) -> None:
        """Count and log an exception in the handling of a frame or an action. The next one follows."""


class EngineDriver:
    """Drives `engine` on `port`, as the port's `CanPortListener`.

    Its owner calls the engine as well, and passes the returned actions to `carry_out`.
    """

    def __init__(self, engine: Engine, port: CanPort, owner: DriverOwner) -> None:
        self.engine = engine
        self.port = port
        self.now = port.now
        """The clock of the engine and of all its instants (ns)."""
        self.clock = clock_of()
        """The module's clock."""
        self.internal_error = owner.internal_error
        self._owner = owner
        self._port_actions: dict[type, Callable[[Any], object]] = {Transmit: port.transmit, Withdraw: port.withdraw}
        self._timer = port.alarm(self._poll)
        self._actions: deque[Action] = deque()
        self._acting = False
        self._monitor: Monitor | None = None
        self._watched: dict[Mailbox, Frame] = {}  # this node's frames in mailboxes, while there is a monitor
        self._pending: Callable[[], object] = lambda: engine.waiting
        self._drained: asyncio.Future[None] | None = None

    # Feed: events of the port (as its `CanPortListener`) and of the timer. `on_frame`, `on_confirmed` and `_poll` run
    # for every frame on the bus, so the three steps are written out in each of them.

    def on_frame(self, frame: Frame, stamp: int) -> None:
        try:
            actions = self.engine.receive(self.now(), frame, stamp)
            if actions or self._drained is not None:
                self.carry_out(actions)
            else:  # most frames
                self._timer.set(self.engine.next_deadline())
            if self._monitor is not None:
                self._monitor.frame(frame, stamp - self.port.receive_latency)
        except Exception as error:  # noqa: BLE001 - counted and logged; the next frame follows
            self._failed(error)

    def on_confirmed(self, mailbox: Mailbox, outcome: Outcome, at: int) -> None:
        try:
            if self._monitor is not None:  # first: the engine may put the next frame into this mailbox
                self._count_own(self._monitor, mailbox, outcome, at)
            self.carry_out(self.engine.confirm(self.now(), mailbox, outcome, at))
        except Exception as error:  # noqa: BLE001 - counted and logged; the next confirmation follows
            self._failed(error)

    def _poll(self) -> None:
        try:
            self.carry_out(self.engine.poll(self.now()))
        except Exception as error:  # noqa: BLE001 - counted and logged
            self._failed(error)

    def on_up(self) -> None:
        try:
            self.update_filters()
            self.carry_out(self.engine.start(self.now()))
            self._owner.bus_up()
        except Exception as error:  # noqa: BLE001 - counted and logged
            self._failed(error)

    def on_down(self, reason: str) -> None:
        try:
            discarded = self.engine.stop(self.now())
            self._owner.bus_down(reason)  # first: publishers are to learn that the link is down before what they lose
            self.carry_out(discarded)
        except Exception as error:  # noqa: BLE001 - counted and logged
            self._failed(error)

    def on_waiting(self, reason: str) -> None:
        self._owner.bus_waits(reason)

    def on_fault(self, kind: str) -> None:
        if self._monitor is not None:
            self._monitor.fault(kind)
        self._owner.bus_fault(kind)

    def on_other_frame(self, frame: OtherFrame, stamp: int) -> None:
        if self._monitor is not None:  # to RTCAN it is of no concern
            self._monitor.other(frame, stamp - self.port.receive_latency)

    # Act, and re-arm the timer

    def carry_out(self, actions: Sequence[Action]) -> None:
        """Carry out the actions of the engine, then re-arm the timer for its next deadline."""
        if actions:
            self._actions.extend(actions)
            if self._acting:
                return  # the call further up the stack acts on these, too
            self._act()
        self._timer.set(self.engine.next_deadline())
        if self._drained is not None and not self._pending() and not self._drained.done():
            self._drained.set_result(None)

    def _act(self) -> None:
        actions, port_actions, act = self._actions, self._port_actions, self._owner.act
        self._acting = True
        try:
            while actions:
                action = actions.popleft()
                try:
                    port_actions.get(type(action), act)(action)
                except Exception as error:  # noqa: BLE001 - counted and logged; the next action follows
                    self.internal_error(error)
        finally:
            self._acting = False

    def _failed(self, error: Exception) -> None:
        """Go on after an exception of the engine, but not at once if it can't get past a passed deadline."""
        self.internal_error(error)
        deadline = self.engine.next_deadline()
        self._timer.set(None if deadline is None else max(deadline, self.now() + RETRY_AFTER_ERROR))

    # For the owner

    def update_filters(self) -> None:
        """Pass the engine's new filters to the port; none while a monitor watches."""
        self.port.set_filters(self.engine.filters() if self._monitor is None else None)

    def watch(self, monitor: Monitor | None) -> None:
        """Set the monitor that counts what is on the bus; None removes it."""
        self._monitor = monitor
        self._watched.clear()
        self._port_actions[Transmit] = self.port.transmit if monitor is None else self._transmit_watched
        self.update_filters()

    def _transmit_watched(self, order: Transmit) -> None:
        self._watched[order.mailbox] = order.frame
        self.port.transmit(order)

    def _count_own(self, monitor: Monitor, mailbox: Mailbox, outcome: Outcome, at: int) -> None:
        frame = self._watched.pop(mailbox, None)
        if frame is not None and outcome is Outcome.SENT:
            monitor.frame(frame, at)

    async def drain(self, timeout: float, pending: Callable[[], object] | None = None) -> None:
        """Wait until nothing is `pending` (default: in the engine's send queues), at most `timeout` seconds."""
        self._pending = pending or (lambda: self.engine.waiting)
        if self._pending():
            self._drained = asyncio.get_running_loop().create_future()
            await asyncio.wait([self._drained], timeout=timeout)

    def close(self) -> None:
        """Stop the engine and the timer."""
        self.carry_out(self.engine.stop(self.now()))
        self._timer.close()


class UtcEstimator:
    """Estimates the offset of UTC, by the module's clock, from the network's time.

    Each measurement is off by an unknown delay, and the two clocks drift: so the estimate is a line through the last
    measurements, half an interval ahead. Its possible error is what a line through so few measurements can be off, or
    what they are off it. Another master has another drift, so with it a new line begins.
    """

    def __init__(self, driver: EngineDriver) -> None:
        self._driver = driver
        self._measured: deque[tuple[int, int]] = deque(maxlen=_MEASUREMENTS)  # network time, offset
        self._measured_at = -_MEASURE_INTERVAL
        self._master: tuple[int | None, int | None] = None, None  # epoch, and id8
        self._offset: ClockOffset | None = None

    def offset(self, now: int) -> ClockOffset | None:
        """Return the estimate at this instant of the engine's clock (ns); None without network time."""
        master = self._driver.engine.network.epoch, self._driver.engine.network.master
        if now - self._measured_at >= _MEASURE_INTERVAL or master != self._master:
            self._measured_at = now
            self._measure(master)
        return self._offset

    def _measure(self, master: tuple[int | None, int | None]) -> None:
        epoch, network_time = master[0], self._driver.engine.network_time(self._driver.now())
        if master != self._master or network_time is None:
            self._master = master
            self._measured.clear()
        if network_time is None or epoch is None:
            self._offset = None
            return
        self._measured.append((network_time, self._driver.clock.now() - network_time))
        offset, error = _extrapolate(self._measured, network_time + _MEASURE_INTERVAL // 2)
        self._offset = ClockOffset(epoch, offset, error)


def _extrapolate(measured: Sequence[tuple[int, int]], time: int) -> tuple[int, int]:
    """Return the offset at this time by the line of least squares, and how far off it may be (both ns)."""
    at, first = measured[-1]
    points = [(each - at, offset - first) for each, offset in measured]  # small numbers, which floats have exactly
    middle, mean = (sum(values) / len(points) for values in zip(*points, strict=True))
    spread = sum((each - middle) ** 2 for each, _ in points)
    if not spread:
        return first, math.ceil(_READING + _BIAS + _RATE_MAX * _MEASURE_INTERVAL)
    slope = sum((each - middle) * (offset - mean) for each, offset in points) / spread
    widest = max(abs(offset - mean - slope * (each - middle)) for each, offset in points)
    ahead = time - at - middle
    # Independent errors add up as their squares do.
    uncertain = _BIAS + _READING * math.sqrt(1 / len(points) + ahead**2 / spread)
    error = max(widest, uncertain) + abs(slope) * _MEASURE_INTERVAL / 2
    return first + round(mean + slope * ahead), math.ceil(error)
