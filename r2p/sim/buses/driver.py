"""A node on a simulated bus for a program outside of its event loop: a controller, and the queue of its driver.

All methods run in the bus's loop. `local` uses it for programs of this process, `server` for those of other ones.
"""

from collections import deque
from collections.abc import Callable, Sequence

from r2p.clock import SystemClock
from r2p.codecs.can_bits import AnyFrame
from r2p.sim.buses.attachment import AttachmentOptions, BusClock, BusFilter, BusFrame
from r2p.sim.can import BusError, CanController, CanNode, ControllerState, ErrorKind
from r2p.sim.can.interrupts import ignore
from r2p.sim.clocks import PacedClock
from r2p.sim.transport import PluggedNode, SimCan
from r2p.units import SECOND

LINGER = SECOND
"""Ns for which a node stays on the bus to send its queue, after its program has left."""

_computer = SystemClock()


class BusDriver(PluggedNode):
    """Sends the frames of its `queue` in their order, one at a time, and hands events to `deliver`.

    `on_room` is called after each frame that has left the queue. As with Linux's drivers, the controller has one
    mailbox: so a program's frames keep their order, whatever their identifiers.
    """

    def __init__(
        self,
        shared: SimCan,
        options: AttachmentOptions,
        deliver: Callable[[BusFrame], object],
        on_room: Callable[[], object] = ignore,
    ) -> None:
        self.shared = shared
        self.queue: deque[AnyFrame] = deque()
        """Frames to be sent; the first one stays here until it has been sent. Other threads may append."""
        self._deliver = deliver
        self._on_room = on_room
        self._own = options.own
        self._states = options.states
        self._filters: tuple[BusFilter, ...] = options.filters
        self.sending = False
        """Whether the controller holds the first frame of the queue. If so, `pump` is not needed for those after it."""
        self._leaving = self._closed = False
        self.controller = shared.plug_in(self, node_of(options, shared.free_name(options.name)))
        self._set_callbacks(self.controller, options)
        if not shared.powered:
            self.controller.power_off()

    @property
    def state(self) -> ControllerState:
        """The state of the controller."""
        return self.controller.state

    @property
    def error_counters(self) -> tuple[int, int]:
        """The transmit and receive error counters."""
        return self.controller.transmit_errors, self.controller.receive_errors

    def pump(self) -> None:
        """Send what has been put into the queue."""
        self.shared.bus.timeline.catch_up()
        self._next()

    def set_filters(self, filters: Sequence[BusFilter]) -> None:
        """Deliver only frames that pass one of these filters; without filters, all."""
        self._filters = tuple(filters)

    def flush(self) -> None:
        """Empty the queue, but for a frame whose start of frame has begun."""
        self.shared.bus.timeline.catch_up()
        self.sending = self.sending and not self.controller.abort()
        waiting = [self.queue.popleft() for _ in range(len(self.queue))]  # not clear(): other threads append meanwhile
        self.queue.extendleft(waiting[: self.sending])
        self._next()
        self._on_room()

    def restart(self) -> None:
        """Leave bus-off, after 128 times 11 recessive bits."""
        self.shared.bus.timeline.catch_up()
        self.controller.restart()

    def power_off(self) -> None:
        if self.controller.state is ControllerState.DOWN:
            return
        self.controller.power_off()
        self.sending = False
        self._change(ControllerState.DOWN, self.controller.clock.monotonic())

    def power_on(self) -> None:
        self.controller.power_on()

    def leave(self) -> None:
        """Stop delivering frames, and leave the bus once the queue has been sent, or after a second."""
        timeline = self.shared.bus.timeline
        timeline.catch_up()
        self._deliver = self._on_room = ignore
        if self.queue and self.controller.live:
            self._leaving = True
            self._next()
            timeline.at(timeline.now() + LINGER, self.close)
        else:
            self.close()

    def close(self) -> None:
        """Leave the bus now, as if the power was cut."""
        if self._closed:
            return
        self._closed = True
        self.shared.bus.timeline.catch_up()
        self.shared.remove(self.controller)
        self.queue.clear()

    # From the controller

    def _set_callbacks(self, controller: CanController, options: AttachmentOptions) -> None:
        controller.on_receive = controller.on_other = self._received
        controller.on_sent = self._sent
        controller.on_error = self._given_up
        controller.on_lost = self._lost
        controller.on_state = self._change
        if options.errors:
            controller.on_bus_error = self._seen

    def _received(self, frame: AnyFrame, stamp: int) -> None:
        if not self._filters or any(each.passes(frame) for each in self._filters):
            self._deliver(BusFrame(frame, stamp, self.shared.utc(stamp)))

    def _sent(self, frame: AnyFrame, stamp: int) -> None:
        self._leave()
        if self._own and (not self._filters or any(each.passes(frame) for each in self._filters)):
            self._deliver(BusFrame(frame, stamp, self.shared.utc(stamp), own=True))

    def _given_up(self, _frame: AnyFrame, kind: ErrorKind, _stamp: int) -> None:
        if kind is ErrorKind.BUS_OFF:
            self.sending = False  # the frame stays in the queue
        else:
            self._leave()

    def _lost(self, _frame: AnyFrame, _stamp: int) -> None:
        self._leave()

    def _leave(self) -> None:
        """Remove the first frame of the queue, and send the next one."""
        if self.queue:
            self.queue.popleft()
        self.sending = False
        self._next()
        self._on_room()
        if self._leaving and not self.queue:
            self.close()

    def _next(self) -> None:
        if self.queue and not self.sending:
            self.sending = self.controller.request(self.queue[0])

    def _change(self, state: ControllerState, stamp: int) -> None:
        if self._states:
            tx, rx = self.error_counters
            self._deliver(BusFrame(None, stamp, self.shared.utc(stamp), state=state, tx_errors=tx, rx_errors=rx))
        self._next()

    def _seen(self, error: BusError, stamp: int) -> None:
        tx, rx = self.error_counters
        utc = self.shared.utc(stamp)
        self._deliver(BusFrame(None, stamp, utc, error.sending, error.kind, error.field, tx_errors=tx, rx_errors=rx))


def bus_clock(shared: SimCan) -> BusClock:
    """Return the clock of a bus; under virtual time it is right now only."""
    clock = shared.bus.timeline.clock
    now, since = clock.monotonic(), _computer.monotonic()
    if not clock.virtual:
        since = now  # it is the computer's, so both are the same to the nanosecond
    return BusClock(now, since, clock.speed if isinstance(clock, PacedClock) else 1.0)


def node_of(options: AttachmentOptions, name: str) -> CanNode:
    """Return the settings of the node for an attachment."""
    return CanNode(
        name,
        one_shot=options.one_shot,
        mailboxes=1,
        offset=options.offset,
        drift_ppm=options.drift_ppm,
        loss=options.loss,
        recovery=options.recovery,
        listen_only=options.listen_only,
    )
