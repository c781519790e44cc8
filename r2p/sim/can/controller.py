"""The CAN controller of a node: mailboxes, callbacks, error counters, and a clock.

`CanController` is the interface to the node's software; `BusWire` is the bus as the controller sees it. Instants inside
are true time; the stamps that callbacks get are those of the node's clock.
"""

from __future__ import annotations

import random
from typing import TYPE_CHECKING, Any, Final, Protocol

import msgspec

from r2p.codecs.can_bits import FRAME_MAX, IDENTIFIER_BITS, Frame, arbitration_field, check_frame, wire_identifier
from r2p.sim.can.interrupts import Interrupts, Reception, ignore
from r2p.sim.can.records import ControllerState, ErrorKind
from r2p.sim.can.timeline import LocalAlarm, LocalClock
from r2p.units import NEVER

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from r2p.codecs.can_bits import AnyFrame, OtherFrame
    from r2p.sim.can.records import BusError, CanNode
    from r2p.sim.can.timeline import Timeline, TimelineTimer

_BABBLE: Final = -1
"""The mailbox of the frame that a babbling node sends over and over."""

RECESSIVE_BITS: Final = 11
"""Recessive bits in a row after which a controller takes the bus for idle."""

# Limits of the error counters (ISO 11898-1, fault confinement)
_PASSIVE_ABOVE: Final = 127
_BUS_OFF_ABOVE: Final = 255  # of the transmit counter only
_AFTER_GOOD_FRAME: Final = 119  # a receive counter above 127 goes back to 119 to 127: here to the lowest


class BusWire(Protocol):
    """The bus as its controllers see it; a protocol, because the bus is a layer above and makes them."""

    timeline: Timeline
    bit: int

    def contend(self, request: TransmitRequest) -> bool:
        """Send this frame as soon as the bus is free. False: the bus is busy, or the frame would start too late."""

    def is_starting(self, request: TransmitRequest) -> bool:
        """Return whether the start bit of this frame has begun, and arbitration is still open."""

    def replan(self) -> None:
        """Plan the next frame anew: one has left its mailbox."""

    def forget_filters(self) -> None:
        """Forget which controllers are concerned by which frames."""

    def disconnect(self, controller: CanController) -> None:
        """Leave this controller out from now on: it has no power, or is in bus-off."""

    def connect(self, controller: CanController) -> None:
        """Let this controller send and receive again."""

    def recover(self, controller: CanController) -> None:
        """Let this controller leave bus-off after enough recessive bits."""

    def cut(self, controller: CanController) -> BusWire:
        """Leave this controller out, and return a wire that has it alone, with what it is sending."""

    def mend(self, controller: CanController, alone: BusWire) -> None:
        """Take a controller back from such a wire."""

    def leave(self, controller: CanController) -> bool:
        """Forget this controller and what it wants to send. Return whether it is on its way out of bus-off."""


class CanController:
    """A controller, made by `CanBus.attach`. Set the callbacks you need; stamps are of this node's clock, in ns."""

    def __init__(self, bus: BusWire, node: CanNode, seed: int) -> None:
        self.name = node.name
        self.node = node
        self.clock = LocalClock(bus.timeline, node.offset, node.drift_ppm)
        self.missed = 0  # frames that the software lost (`CanNode.loss`, `lose_next`)
        self.on_receive: Callable[[Frame, int], object] = ignore
        """A data frame of another node with a 29-bit identifier has been received."""
        self.on_other: Callable[[OtherFrame, int], object] = ignore
        """A frame of another node has been received that has an 11-bit identifier, or is a remote frame."""
        self.on_sent: Callable[[AnyFrame, int], object] = ignore
        """A frame of this node has been acknowledged."""
        self.on_lost: Callable[[AnyFrame, int], object] = ignore
        """In one-shot mode: a frame has lost arbitration, and leaves its mailbox now."""
        self.on_error: Callable[[AnyFrame, ErrorKind, int], object] = ignore
        """A frame has left its mailbox because of an error, in one-shot mode, or because of bus-off."""
        self.on_late: Callable[[AnyFrame, int], object] = ignore
        """A frame has not started by its `not_after`, and has left its mailbox without being sent."""
        self.on_state: Callable[[ControllerState, int], object] = ignore
        """`state` has changed."""
        self.on_bus_error: Callable[[BusError, int], object] = ignore
        """An error frame has begun on the bus, of a frame that this controller was sending or receiving.

        The error counters have counted it.
        """
        self.numbers = random.Random(f"{seed}/{node.name}")
        self.mailboxes = ControllerMailboxes(self._watch)  # for the bus, as is `confinement`
        self.confinement = Confinement(self._changed)
        self._transmit_delay = node.transmit.sampler(self.numbers)
        self._ahead = node.transmit.nominal
        self._interrupts = Interrupts(bus.timeline, self.clock, node.receive, self.numbers)
        self._bus = self._whole = bus  # not the same while its wire is cut
        self._timeline = bus.timeline
        self._source = bus.timeline.source
        self._filters: Sequence[tuple[int, int]] = ()
        self._lose_next = 0
        self._babbled: AnyFrame | None = None
        self._mailbox_count = 0 if node.listen_only else node.mailboxes

    @property
    def state(self) -> ControllerState:
        """The error state, or DOWN."""
        return self.confinement.state

    @property
    def live(self) -> bool:
        """Return whether the controller sends and receives: it is neither down nor in bus-off."""
        return self.confinement.live

    @property
    def transmit_errors(self) -> int:
        """The transmit error counter: over 127 the controller is error passive, over 255 in bus-off."""
        return self.confinement.transmit

    @property
    def receive_errors(self) -> int:
        """The receive error counter: over 127 the controller is error passive."""
        return self.confinement.receive

    # For the node's software

    def request(
        self, frame: AnyFrame, mailbox: int = 0, *, not_before: int | None = None, not_after: int | None = None
    ) -> bool:
        """Send this frame. False: the mailbox still holds one, or the controller is down or in bus-off.

        The two instants are of this node's clock, in ns. `not_before`: the software hands the frame over earlier by the
        nominal latency, so the start of frame is as exact as the jitter. `not_after`: a frame that has not started by
        then is aborted, and `on_late` is called.

        Raises IndexError for a mailbox that the controller does not have (one that only listens has none), and
        `MessageError` for an invalid frame.
        """
        if not 0 <= mailbox < self._mailbox_count:
            self._refuse(mailbox)
        if mailbox in self.mailboxes.requests or not self.confinement.live:
            return False
        given, clock = self._source.elapsed, self.clock
        if not_before is not None:
            ahead = clock.true(not_before) - self._ahead
            if ahead > given:
                given = ahead
        last = NEVER if not_after is None else clock.true(not_after + 1) - 1
        ready = given + (self._transmit_delay() if self._transmit_delay else self._ahead)
        self._put(TransmitRequest(self, frame, mailbox, ready, last))
        return True

    def abort(self, mailbox: int = 0) -> bool:
        """Remove the frame of this mailbox. False: its start of frame has begun, or the mailbox is empty."""
        request = self.mailboxes.requests.get(mailbox)
        return request is not None and self._withdraw(request)

    def pending(self, mailbox: int = 0) -> AnyFrame | None:
        """Return the frame in this mailbox."""
        request = self.mailboxes.requests.get(mailbox)
        return request.frame if request else None

    @property
    def filters(self) -> Sequence[tuple[int, int]]:
        """Pairs (identifier, mask): frames with `id & mask == identifier` for one of them are received; empty: all.

        `id` is the `wire_identifier` of a frame: with the flags `EXTENDED` (29 bits) and `REMOTE`, which a mask without
        them leaves open. The callbacks matter, too: frames for a callback that is not set are dropped at no cost.
        """
        return self._filters

    @filters.setter
    def filters(self, filters: Sequence[tuple[int, int]]) -> None:
        self._filters = filters
        self._bus.forget_filters()

    def call_at(self, local: int, callback: Callable[..., object], *args: Any) -> TimelineTimer:
        """Call `callback(*args)` when this node's clock shows `local` ns: a timer interrupt, without latency."""
        return self._timeline.timer(self.clock.true(local), callback, *args)

    def alarm(self, callback: Callable[[], object]) -> LocalAlarm:
        """Return a movable timer on this node's clock."""
        return LocalAlarm(self._timeline, self.clock, callback)

    def restart(self) -> None:
        """Leave bus-off after 128 times 11 recessive bits: for `CanNode(recovery=False)`."""
        if self.state is ControllerState.BUS_OFF:
            self._bus.recover(self)

    # Faults of the node

    def babble(self, frame: AnyFrame | None) -> None:
        """Send this frame over and over, as a babbling idiot does; None stops it.

        Raises IndexError for a controller that only listens.
        """
        if self.node.listen_only:
            self._refuse(_BABBLE)
        self._babbled = frame
        self.mailboxes.requests.pop(_BABBLE, None)
        self._bus.replan()
        self._babble()

    def lose_next(self, count: int = 1) -> None:
        """Let the software lose the next frames that it should receive."""
        self._lose_next += count

    def power_off(self) -> None:
        """Cut the power, also in the middle of a frame. No callback is called; the mailboxes are lost."""
        if self.state is ControllerState.DOWN:
            return
        self.confinement.enter(ControllerState.DOWN)
        self._babbled = None
        self._interrupts.discard()
        self.mailboxes.clear()
        self._bus.disconnect(self)

    def power_on(self) -> None:
        """Restore the power: it starts as new, and sends nothing before it has seen 11 recessive bits."""
        if self.state is ControllerState.DOWN:
            self.mailboxes.not_before = self._timeline.now() + RECESSIVE_BITS * self._bus.bit
            self.rejoin()

    def cut_wire(self) -> None:
        """Cut the wire to this node, also in the middle of a frame, until `mend_wire`.

        It hears nothing, and no other node hears it. It can't know: what it sends is not acknowledged, so it becomes
        error passive and tries for ever. Statistics and observers of the bus have nothing of that.
        """
        if self._bus is self._whole:
            self._bus = self._whole.cut(self)

    def mend_wire(self) -> None:
        """Mend the wire to this node: it takes part after 11 recessive bits, with its error counters as they are."""
        if self._bus is not self._whole:
            alone, self._bus = self._bus, self._whole
            self._whole.mend(self, alone)

    # For the bus

    def concerned(self, identifier: int) -> bool:
        """Return whether a good frame of another node matters: it passes the filters, or decrements the error count."""
        return self.confinement.receive > 0 or self._is_wanted(identifier)

    def receive(self, reception: Reception) -> None:
        """Receive a good frame of another node that concerns this one."""
        if self.confinement.receive:
            reception.part()  # the interrupt for a new error state comes first
            self.confinement.count_received()
            self._bus.forget_filters()
            if not self._is_wanted(wire_identifier(reception.frame)):
                return
        if self._lose_next:
            self._lose_next -= 1
            self.missed += 1
        elif self.node.loss and self.numbers.random() < self.node.loss:
            self.missed += 1
        else:
            handler = self.on_receive if reception.frame.__class__ is Frame else self.on_other
            if handler is not ignore:
                reception.add(self._interrupts, handler)

    def complete(self, request: TransmitRequest, end: int) -> None:
        """Complete this request: its frame was acknowledged."""
        if self.confinement.transmit:
            self.confinement.count(transmit=-1)
        if self.mailboxes.remove(request):
            self._interrupts.deliver(end, self.on_sent, request.frame)

    def lose_arbitration(self, request: TransmitRequest, at: int) -> None:
        """Note that the frame of this request loses arbitration, at this instant."""
        request.busy_until = at
        if self.node.one_shot and request.mailbox != _BABBLE:
            request.ready = NEVER
            self._interrupts.deliver(at, self._lost, request)
        elif request.last_start < NEVER:
            self._watch(request)

    def fail(self, request: TransmitRequest, kind: ErrorKind, at: int) -> None:
        """Note that the frame of this request was destroyed: an error frame begins."""
        # The standard's exception: a node that is alone on the bus stays error passive, and never goes to bus-off.
        alone = kind is ErrorKind.ACK and self.confinement.passive
        if not alone:
            self.confinement.count(transmit=8)
        if self.node.one_shot and self.mailboxes.remove(request):
            self._interrupts.deliver(at, self.on_error, request.frame, kind)

    def disturb(self, count: int) -> None:
        """Note that a frame that this node was receiving was destroyed."""
        self.confinement.count(receive=count)
        self._bus.forget_filters()

    def see_error(self, error: BusError, at: int) -> None:
        """Tell the software of an error frame."""
        self._interrupts.deliver(at, self.on_bus_error, error)

    def rejoin(self) -> None:
        """Start again with the error counters at 0."""
        self.confinement.restart()
        self._bus.connect(self)
        self._babble()

    # Inside

    def _put(self, request: TransmitRequest) -> None:
        frame = request.frame
        if frame.__class__ is not Frame or frame.id >> IDENTIFIER_BITS or len(frame.data) > FRAME_MAX:
            check_frame(frame)
        self.mailboxes.requests[request.mailbox] = request
        if not self._bus.contend(request) and request.last_start < NEVER:
            self._watch(request)

    def _is_wanted(self, identifier: int) -> bool:
        return not self._filters or any(identifier & mask == value for value, mask in self._filters)

    def _watch(self, request: TransmitRequest) -> None:
        """Abort the frame after its last start, if it still waits then."""
        # One event for each frame at most, and none for a frame that starts at once: most have a last start.
        if not request.watched and request.ready < NEVER:
            request.watched = True
            self._interrupts.check_at(
                max(request.last_start, request.busy_until, self._timeline.now()), self._late, request
            )

    def _changed(self, state: ControllerState) -> None:
        if state is ControllerState.DOWN:
            return
        now = self._timeline.now()
        lost = self.mailboxes.clear() if state is ControllerState.BUS_OFF else ()
        self._interrupts.deliver(now, self.on_state, state)
        for frame in lost:
            self._interrupts.deliver(now, self.on_error, frame, ErrorKind.BUS_OFF)
        if state is ControllerState.BUS_OFF:
            self._bus.disconnect(self)
            if self.node.recovery:
                self._bus.recover(self)

    def _withdraw(self, request: TransmitRequest) -> bool:
        """Empty the mailbox, unless the frame is on the wire or about to be."""
        if (
            self._timeline.now() < request.busy_until
            or self._bus.is_starting(request)
            or not self.mailboxes.remove(request)
        ):
            return False
        self._bus.replan()
        return True

    def _lost(self, request: TransmitRequest, stamp: int) -> None:
        if self.mailboxes.remove(request):  # only now: one event less for each loss, and software can't tell
            self.on_lost(request.frame, stamp)

    def _late(self, request: TransmitRequest, stamp: int) -> None:
        request.watched = False  # a frame that has started and is not sent in the end is watched again
        if self._withdraw(request):
            self.on_late(request.frame, stamp)

    def _babble(self) -> None:
        if self._babbled and self.live:
            self._put(TransmitRequest(self, self._babbled, _BABBLE, self._timeline.now(), NEVER))

    def _refuse(self, mailbox: int) -> None:
        if self.node.listen_only:
            raise IndexError(f"{self.name} only listens: it has no mailbox to send from")
        raise IndexError(f"{self.name} has mailboxes 0 to {self._mailbox_count - 1}, not {mailbox}")


class Confinement:
    """The two error counters of a controller, and the state that follows from them.

    `on_change` is called with each new state.
    """

    def __init__(self, on_change: Callable[[ControllerState], object]) -> None:
        self.state = ControllerState.ACTIVE
        self.live = True
        """True if the controller sends and receives: it is neither down nor in bus-off."""
        self.passive = False
        self.transmit = 0
        self.receive = 0
        self._on_change = on_change

    def count_received(self) -> None:
        """Count a frame that was received without an error."""
        self.count(receive=-1 if self.receive <= _PASSIVE_ABOVE else _AFTER_GOOD_FRAME - self.receive)

    def restart(self) -> None:
        self.transmit = self.receive = 0
        self.enter(ControllerState.ACTIVE)

    def enter(self, state: ControllerState) -> None:
        if state is not self.state:
            self.state = state
            self.live = state is ControllerState.ACTIVE or state is ControllerState.PASSIVE
            self.passive = state is ControllerState.PASSIVE
            self._on_change(state)

    def count(self, *, transmit: int = 0, receive: int = 0) -> None:
        """Add to the counters: -1 for a frame without an error, more for one that was destroyed."""
        self.transmit = max(0, self.transmit + transmit)
        self.receive = max(0, self.receive + receive)
        if self.transmit > _BUS_OFF_ABOVE:
            self.enter(ControllerState.BUS_OFF)
        else:
            passive = max(self.transmit, self.receive) > _PASSIVE_ABOVE
            self.enter(ControllerState.PASSIVE if passive else ControllerState.ACTIVE)


class TransmitRequest(msgspec.Struct, eq=False):
    """A frame in a mailbox of the controller `owner`.

    All instants are true time, in ns: the controller tries to send it from `ready` on; it starts by `last_start` or
    not at all; it is on the wire until `busy_until`. `watched`: an event at `last_start` will abort it if it waits.
    `rank` is the arbitration field of the frame, once `find_rank` has found it: the lowest wins.
    """

    owner: CanController
    frame: AnyFrame
    mailbox: int
    ready: int
    last_start: int
    busy_until: int = 0
    watched: bool = False
    rank: int = 0

    def find_rank(self) -> int:
        """Find and return the rank. Few frames need one: most are alone, or the only one of their controller."""
        self.rank = rank = arbitration_field(self.frame)
        return rank


class ControllerMailboxes:
    """The mailboxes of a controller, one frame in each, and the choice which of them is sent.

    `watch` is called with frames that may have to be aborted at their last start.
    """

    def __init__(self, watch: Callable[[TransmitRequest], None]) -> None:
        self.requests: dict[int, TransmitRequest] = {}
        """The frames, by mailbox."""
        self.not_before = 0
        """The controller starts no frame before this instant."""
        self._watch = watch

    def choose(self, start: int, end: int) -> TransmitRequest | None:
        """Return the frame that takes part in an arbitration from `start` on; `end` is one bit later.

        Of the frames ready by then it is the one that beats the others, otherwise the first to be ready by `end`: a
        controller that is ready within the first bit still joins.
        """
        chosen = None
        if start < self.not_before:
            start = self.not_before
        for request in self.requests.values():
            begins = request.ready
            if begins < start:
                begins = start
            if begins > request.last_start:
                continue
            if begins < end or (begins == end and chosen is not None and request.find_rank() < chosen.find_rank()):
                chosen, end = request, begins
        return chosen

    def first(self, free: int) -> int:
        """Return when this controller wants to start a frame, given when the bus is free. NEVER: not at all."""
        earliest = NEVER
        if free < self.not_before:
            free = self.not_before
        for request in self.requests.values():
            begins = request.ready
            if begins < free:
                begins = free
            if begins > request.last_start:
                self._watch(request)
            elif begins < earliest:
                earliest = begins
        return earliest

    def watch_others(self, chosen: TransmitRequest | None) -> None:
        """Watch all frames but `chosen`: another frame has started, and they may become too late."""
        for request in self.requests.values():
            if request.last_start < NEVER and request is not chosen:
                self._watch(request)

    def clear(self) -> list[AnyFrame]:
        """Empty all mailboxes and return the frames."""
        frames = [request.frame for mailbox, request in self.requests.items() if mailbox != _BABBLE]
        self.requests.clear()
        return frames

    def remove(self, request: TransmitRequest) -> bool:
        """Remove a request from its mailbox.

        Return False if it is no longer there, or if the node babbles, and so sends it again.
        """
        mailbox = request.mailbox
        if mailbox == _BABBLE or self.requests.get(mailbox) is not request:
            return False
        del self.requests[mailbox]
        return True
