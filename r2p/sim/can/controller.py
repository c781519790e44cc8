"""One node's CAN controller, as its software sees it: mailboxes to send from, callbacks for what happens, a clock."""

from __future__ import annotations

import random
from typing import TYPE_CHECKING, Any, Final, Protocol

import msgspec

from r2p.codecs.rtcan import FRAME_MAX
from r2p.errors import MessageError
from r2p.sim.can.node import NEVER, ControllerState, ErrorKind, LocalAlarm, LocalClock

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from r2p.codecs.rtcan import Frame
    from r2p.sim.can.node import CanNode
    from r2p.sim.can.timeline import Timeline, TimelineTimer


class BusWire(Protocol):
    """What a controller needs of its bus."""

    timeline: Timeline
    bit: int

    def contend(self, request: Request) -> bool:
        """Try this frame as soon as the bus is free. False: it is not, or this frame would come too late."""
        ...

    def trying(self, request: Request) -> bool:
        """Whether the start of this frame has begun, and who wins is still open."""
        ...

    def withdrawn(self) -> None:
        """A frame is not to be sent any more."""

    def reconsider(self) -> None:
        """Other frames than before may concern a controller."""

    def left(self, controller: CanController) -> None:
        """A controller takes no part any more: no power, or bus-off."""

    def joined(self, controller: CanController) -> None:
        """A controller takes part again."""

    def recover(self, controller: CanController) -> None:
        """A controller wants to leave bus-off."""


class CanController:
    """Made by `CanBus.attach`. Set the callbacks that you need; stamps are those of this node's clock, in ns."""

    def __init__(self, bus: BusWire, node: CanNode, seed: int) -> None:
        self.name = node.name
        self.node = node
        self.clock = LocalClock(bus.timeline, node.offset, node.drift_ppm)
        self.missed = 0  # frames that the software lost (`CanNode.loss`, `lose_next`)
        self.on_receive: Callable[[Frame, int], object] = ignore
        """A frame of another node has arrived."""
        self.on_sent: Callable[[Frame, int], object] = ignore
        """A frame that was requested here has been acknowledged."""
        self.on_lost: Callable[[Frame, int], object] = ignore
        """One-shot: a frame has lost arbitration, and leaves its mailbox now."""
        self.on_error: Callable[[Frame, ErrorKind, int], object] = ignore
        """A frame has left its mailbox because of an error: one-shot, or bus-off."""
        self.on_late: Callable[[Frame, int], object] = ignore
        """A frame has not started by its `not_after`, and left its mailbox: nobody has seen it."""
        self.on_state: Callable[[ControllerState, int], object] = ignore
        """`state` has changed."""
        self.numbers = random.Random(f"{seed}/{node.name}")
        self.mailboxes = ControllerMailboxes(self._guard)  # for the bus, as is the next one
        self.confinement = Confinement(self._changed)
        self._transmit_delay = node.transmit.drawer(self.numbers)
        self._ahead = node.transmit.nominal
        self._interrupts = Interrupts(bus.timeline, self.clock, node.receive.drawer(self.numbers))
        self._bus = bus
        self._timeline = bus.timeline
        self._source = bus.timeline.source
        self._filters: Sequence[tuple[int, int]] = ()
        self._lose_next = 0
        self._mad: Frame | None = None

    @property
    def state(self) -> ControllerState:
        """Whether it takes part, and how far it trusts itself."""
        return self.confinement.state

    @property
    def live(self) -> bool:
        """Whether it takes part: neither down nor in bus-off."""
        return self.confinement.live

    # What software does

    def request(
        self, frame: Frame, mailbox: int = 0, *, not_before: int | None = None, not_after: int | None = None
    ) -> bool:
        """Send this frame. False: this mailbox still holds one, or the controller is down or in bus-off.

        The two instants are those of this node's clock, in ns. `not_before`: software hands the frame over ahead of
        it, by the nominal latency; so the start of frame is as exact as the latency. `not_after`: a frame that has not
        started by then is aborted, and `on_late` is told.

        Raises IndexError for a mailbox that the controller does not have, and `MessageError` for what is no frame.
        """
        if not 0 <= mailbox < self.node.mailboxes:
            raise IndexError(f"{self.name} has {self.node.mailboxes} mailboxes: there is no mailbox {mailbox}")
        if mailbox in self.mailboxes.requests or not self.confinement.live:
            return False
        given, clock = self._source.elapsed, self.clock
        if not_before is not None:
            ahead = clock.true(not_before) - self._ahead
            if ahead > given:
                given = ahead
        last = NEVER if not_after is None else clock.true(not_after + 1) - 1
        self._put(Request(self, frame, mailbox, given + self._transmit_delay(), last))
        return True

    def abort(self, mailbox: int = 0) -> bool:
        """Withdraw the frame of this mailbox. False: its start of frame has begun, or there is none."""
        request = self.mailboxes.requests.get(mailbox)
        return request is not None and self._withdraw(request)

    def pending(self, mailbox: int = 0) -> Frame | None:
        """The frame in this mailbox."""
        request = self.mailboxes.requests.get(mailbox)
        return request.frame if request else None

    @property
    def filters(self) -> Sequence[tuple[int, int]]:
        """(identifier, mask): only frames with `id & mask == identifier` of one are received; none: all are."""
        return self._filters

    @filters.setter
    def filters(self, filters: Sequence[tuple[int, int]]) -> None:
        self._filters = filters
        self._bus.reconsider()

    def call_at(self, local: int, callback: Callable[..., object], *args: Any) -> TimelineTimer:
        """Call it when this node's clock shows `local` ns: a timer interrupt, without latency."""
        return self._timeline.timer(self.clock.true(local), callback, *args)

    def alarm(self, callback: Callable[[], object]) -> LocalAlarm:
        """A timer of this node that can be moved, by its clock."""
        return LocalAlarm(self._timeline, self.clock, callback)

    def restart(self) -> None:
        """Leave bus-off, after 128 times 11 recessive bits: for `CanNode(recovery=False)`."""
        if self.state is ControllerState.BUS_OFF:
            self._bus.recover(self)

    # What happens to nodes

    def babble(self, frame: Frame | None) -> None:
        """Go mad: send this frame over and over, whatever happens. None: be well again."""
        self._mad = frame
        self.mailboxes.requests.pop(BABBLE, None)
        self._bus.withdrawn()
        self._babble()

    def lose_next(self, count: int = 1) -> None:
        """The software loses the next frames that it should receive."""
        self._lose_next += count

    def power_off(self) -> None:
        """Die, in the middle of a frame if need be. Nothing is called back; the mailboxes are lost."""
        if self.state is ControllerState.DOWN:
            return
        self.confinement.enter(ControllerState.DOWN)
        self._mad = None
        self._interrupts.forget()
        self.mailboxes.clear()
        self._bus.left(self)

    def power_on(self) -> None:
        """Come back, as new: sends nothing before it has seen 11 recessive bits."""
        if self.state is ControllerState.DOWN:
            self.mailboxes.not_before = self._timeline.now() + RECESSIVE * self._bus.bit
            self.restarted()

    # What the bus tells it

    def concerned(self, identifier: int) -> bool:
        """Whether a good frame of another node matters here: it may be wanted, or make up for an error."""
        return self.confinement.receive > 0 or self._wants(identifier)

    def arrived(self, frame: Frame, end: int) -> None:
        """A good frame of another node ended, which concerns this one."""
        if self.confinement.receive:
            self.confinement.received()
            self._bus.reconsider()
            if not self._wants(frame.id):
                return
        if self._lose_next:
            self._lose_next -= 1
            self.missed += 1
        elif self.node.loss and self.numbers.random() < self.node.loss:
            self.missed += 1
        else:
            self._interrupts.tell(end, self.on_receive, frame)

    def sent(self, request: Request, end: int) -> None:
        """This request's frame got through."""
        if self.confinement.transmit:
            self.confinement.transmitted()
        if self.mailboxes.remove(request):
            self._interrupts.tell(end, self.on_sent, request.frame)

    def outdone(self, request: Request, at: int) -> None:
        """This request's frame loses arbitration, at this instant."""
        request.held = at
        if self.node.one_shot and request.mailbox != BABBLE:
            request.ready = NEVER
            self._interrupts.tell(at, self._lost, request)
        elif request.last < NEVER:
            self._guard(request)

    def failed(self, request: Request, kind: ErrorKind, at: int) -> None:
        """This request's frame was destroyed: an error frame begins."""
        alone = kind is ErrorKind.ACK and self.confinement.passive
        if not alone:  # or a lone node would go to bus-off
            self.confinement.failed(transmit=8)
        if self.node.one_shot and self.mailboxes.remove(request):
            self._interrupts.tell(at, self.on_error, request.frame, kind)

    def disturbed(self, count: int) -> None:
        """A frame that this node was receiving was destroyed."""
        self.confinement.failed(receive=count)
        self._bus.reconsider()

    def restarted(self) -> None:
        """It takes part again, with its error counters at 0."""
        self.confinement.restart()
        self._bus.joined(self)
        self._babble()

    # Inside

    def _put(self, request: Request) -> None:
        frame = request.frame
        if frame.id >> 29 or len(frame.data) > FRAME_MAX:
            raise MessageError(f"identifier {frame.id:#x} with {len(frame.data)} bytes: no frame has room")
        self.mailboxes.requests[request.mailbox] = request
        if not self._bus.contend(request) and request.last < NEVER:
            self._guard(request)

    def _wants(self, identifier: int) -> bool:
        return not self._filters or any(identifier & mask == value for value, mask in self._filters)

    def _guard(self, request: Request) -> None:
        """Abort it at its last instant, if it still waits by then: its software is told, and only then looks."""
        if not request.guarded and request.ready < NEVER:
            request.guarded = True
            self._interrupts.look(max(request.last, request.held, self._timeline.now()), self._late, request)

    def _changed(self, state: ControllerState) -> None:
        if state is ControllerState.DOWN:
            return
        now = self._timeline.now()
        given_up = self.mailboxes.clear() if state is ControllerState.BUS_OFF else ()
        self._interrupts.tell(now, self.on_state, state)
        for frame in given_up:
            self._interrupts.tell(now, self.on_error, frame, ErrorKind.BUS_OFF)
        if state is ControllerState.BUS_OFF:
            self._bus.left(self)
            if self.node.recovery:
                self._bus.recover(self)

    def _withdraw(self, request: Request) -> bool:
        """Empty its mailbox, unless it is on the wire or about to be."""
        if self._timeline.now() < request.held or self._bus.trying(request) or not self.mailboxes.remove(request):
            return False
        self._bus.withdrawn()
        return True

    def _lost(self, request: Request, stamp: int) -> None:
        if self.mailboxes.remove(request):  # only now: one event less for each loss, and software can't know before
            self.on_lost(request.frame, stamp)

    def _late(self, request: Request, stamp: int) -> None:
        request.guarded = False  # if it has started, and is not sent, this comes again
        if self._withdraw(request):
            self.on_late(request.frame, stamp)

    def _babble(self) -> None:
        if self._mad and self.live:
            self._put(Request(self, self._mad, BABBLE, self._timeline.now(), NEVER))


# What a controller has to send: its mailboxes, and which of their frames it tries.


BABBLE: Final = -1
"""The mailbox of a node that has gone mad."""


class Request(msgspec.Struct, eq=False):
    """A frame in a mailbox of the controller `owner`.

    `ready`: from when on the controller tries it; `last`: until when it may start; `held`: until when it is on the
    wire. `guarded`: it will be aborted at `last`, unless it is on the wire.
    """

    owner: CanController
    frame: Frame
    mailbox: int
    ready: int
    last: int
    held: int = 0
    guarded: bool = False


class ControllerMailboxes:
    """One frame in each. `guard` is told of those that may have to be aborted at their last instant."""

    def __init__(self, guard: Callable[[Request], None]) -> None:
        self.requests: dict[int, Request] = {}
        """By mailbox."""
        self.not_before = 0
        """No start of frame here earlier than this."""
        self._guard = guard

    def choose(self, start: int, end: int) -> Request | None:
        """The frame that this controller tries when a start of frame comes at `start`; `end` is one bit later.

        Of those ready by then the one with the lowest identifier, else the first that gets ready before `end`.
        """
        chosen = None
        if start < self.not_before:
            start = self.not_before
        for request in self.requests.values():
            begins = request.ready
            if begins < start:
                begins = start
            if begins > request.last:
                continue
            if begins < end or (begins == end and chosen is not None and request.frame.id < chosen.frame.id):
                chosen, end = request, begins
        return chosen

    def first(self, free: int) -> int:
        """When this controller wants to start a frame, given when the bus is free. NEVER: not at all."""
        earliest = NEVER
        if free < self.not_before:
            free = self.not_before
        for request in self.requests.values():
            begins = request.ready
            if begins < free:
                begins = free
            if begins > request.last:
                self._guard(request)
            elif begins < earliest:
                earliest = begins
        return earliest

    def passed(self, chosen: Request | None) -> None:
        """A frame has started, and of these at most this one takes part: watch the others' last instants."""
        for request in self.requests.values():
            if request.last < NEVER and request is not chosen:
                self._guard(request)

    def clear(self) -> list[Frame]:
        """Empty all; these were the frames."""
        frames = [request.frame for mailbox, request in self.requests.items() if mailbox != BABBLE]
        self.requests.clear()
        return frames

    def remove(self, request: Request) -> bool:
        """Empty its mailbox. False if it is no longer there; a babbling node never ends."""
        mailbox = request.mailbox
        if mailbox == BABBLE or self.requests.get(mailbox) is not request:
            return False
        del self.requests[mailbox]
        return True


# Out of bus-off: a controller comes back once it has seen 128 times 11 recessive bits in a row.


RECESSIVE: Final = 11
_TIMES: Final = 128


class Recovery:
    """The controllers that wait for it."""

    def __init__(self, timeline: Timeline, bit: int) -> None:
        self._timeline = timeline
        self._sequence = RECESSIVE * bit  # ns
        self.left: dict[CanController, int] = {}  # how many times more; without any, `busy` and `free` need no call
        self._since: dict[CanController, int] = {}  # from when on the bus was idle
        self._idle = 0  # counts the times that the bus became free or busy: a timer of another time does nothing

    def begin(self, controller: CanController, since: int) -> None:
        """This one counts from now, or from `since`, when the bus becomes idle."""
        if not self.left:
            self._idle += 1  # `busy` and `free` were not called: timers from before mean nothing
        self.left[controller] = _TIMES
        self._since[controller] = since
        self._wait(controller)

    def forget(self, controller: CanController) -> None:
        """This one has died."""
        self.left.pop(controller, None)

    def busy(self, start: int) -> None:
        """A frame starts on the idle bus."""
        self._idle += 1
        for controller in self.left:
            self.left[controller] -= max(0, start - self._since[controller]) // self._sequence

    def free(self, since: int) -> None:
        """A frame or an error frame is over, and so will its intermission be at `since`."""
        self._idle += 1
        for controller in self.left:
            if self._since[controller] < since:
                self.left[controller] -= 1
            self._since[controller] = max(since, self._since[controller])
            self._wait(controller)

    def _wait(self, controller: CanController) -> None:
        when = self._since[controller] + max(0, self.left[controller]) * self._sequence
        self._timeline.at(when, self._check, controller, self._idle)

    def _check(self, controller: CanController, idle: int) -> None:
        if idle == self._idle and self.left.pop(controller, None) is not None:
            controller.restarted()


# Fault confinement: a controller counts errors, and with more of them takes less and less part.


_PASSIVE: Final = 127
_OFF: Final = 255
_RECEIVED_WELL: Final = 119  # what the receive error counter goes back to from above 127


class Confinement:
    """The two error counters of a controller, and the state that follows from them; `changed` is told of a new one."""

    def __init__(self, changed: Callable[[ControllerState], object]) -> None:
        self.state = ControllerState.ACTIVE
        self.live = True
        """Whether the controller takes part: neither down nor in bus-off."""
        self.passive = False
        self.transmit = 0
        self.receive = 0
        self._changed = changed

    def transmitted(self) -> None:
        """A frame got through."""
        self._count(self.transmit - 1, self.receive)

    def received(self) -> None:
        """A good frame came in."""
        self._count(self.transmit, self.receive - 1 if self.receive <= _PASSIVE else _RECEIVED_WELL)

    def failed(self, *, transmit: int = 0, receive: int = 0) -> None:
        """A frame was destroyed, while it was sent or received: add this to the counters."""
        self._count(self.transmit + transmit, self.receive + receive)

    def restart(self) -> None:
        """Begin anew, without errors."""
        self.transmit = self.receive = 0
        self.enter(ControllerState.ACTIVE)

    def enter(self, state: ControllerState) -> None:
        """Be in this state from now on."""
        if state is not self.state:
            self.state = state
            self.live = state is ControllerState.ACTIVE or state is ControllerState.PASSIVE
            self.passive = state is ControllerState.PASSIVE
            self._changed(state)

    def _count(self, transmit: int, receive: int) -> None:
        self.transmit = max(0, transmit)
        self.receive = max(0, receive)
        if self.transmit > _OFF:
            self.enter(ControllerState.BUS_OFF)
        else:
            self.enter(
                ControllerState.PASSIVE if max(self.transmit, self.receive) > _PASSIVE else ControllerState.ACTIVE
            )


# How a node's software hears of things: a little late, in the order in which they happened, never after its death.


class Interrupts:
    """Calls the software's handlers, each with the instant that the node's clock shows as its last argument.

    `delay()` gives ns from an instant to when its interrupt is served.
    """

    def __init__(self, timeline: Timeline, clock: LocalClock, delay: Callable[[], int]) -> None:
        self._timeline = timeline
        self._clock = clock
        self._delay = delay
        self._life = 0  # counts deaths: what it was about to hear is not heard any more
        self._heard = 0  # when its software hears the last thing so far

    def tell(self, when: int, handler: Callable[..., object], *args: Any) -> None:
        """Something happens at `when`, on the bus."""
        if handler is ignore:
            return
        heard = when + self._delay()
        if heard < self._heard:
            heard = self._heard
        self._heard = heard
        self._timeline.at(heard, self._serve, heard, self._life, handler, args)

    def look(self, when: int, handler: Callable[..., object], *args: Any) -> None:
        """Something may have to be done at `when`; it keeps nothing else waiting."""
        at = when + self._delay()
        self._timeline.at(at, self._serve, at, self._life, handler, args)

    def forget(self) -> None:
        """The node has died."""
        self._life += 1

    def _serve(self, at: int, life: int, handler: Callable[..., object], args: tuple[Any, ...]) -> None:
        if life == self._life:
            handler(*args, self._clock.local(at))


def ignore(*_args: object) -> None:
    """The handler of software that does not care."""
