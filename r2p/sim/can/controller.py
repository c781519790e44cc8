"""One node's CAN controller, as its software sees it: mailboxes to send from, callbacks for what happens, a clock."""

from __future__ import annotations

import random
from typing import TYPE_CHECKING, Any, Final, Protocol

from r2p.codecs.rtcan import FRAME_MAX
from r2p.errors import MessageError
from r2p.sim.can.node import NEVER, ErrorKind, LocalAlarm, LocalClock, State
from r2p.sim.can.recovery import RECESSIVE

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from r2p.codecs.rtcan import Frame
    from r2p.sim.can.node import CanNode
    from r2p.sim.can.timeline import Timeline, Timer

_PASSIVE: Final = 127
_OFF: Final = 255
_RECEIVED_WELL: Final = 119  # what the receive error counter goes back to from above 127
_REMEMBERED: Final = 4096  # identifiers of which it is known whether the filters let them through
_BABBLE: Final = -1  # the mailbox of a node that has gone mad


class Request:
    """A frame in a mailbox.

    `ready`: from when on the controller tries it; `last`: until when it may start; `held`: until when it is on the
    wire. `guarded`: it will be aborted at `last`, unless it is on the wire.
    """

    __slots__ = ("frame", "guarded", "held", "last", "mailbox", "owner", "ready")

    def __init__(self, owner: CanController, frame: Frame, mailbox: int, ready: int, last: int) -> None:
        self.owner = owner
        self.frame = frame
        self.mailbox = mailbox
        self.ready = ready
        self.last = last
        self.held = 0
        self.guarded = False


class Wire(Protocol):
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

    def left(self, controller: CanController) -> None:
        """A controller takes no part any more: no power, or bus-off."""

    def joined(self, controller: CanController) -> None:
        """A controller takes part again."""

    def recover(self, controller: CanController) -> None:
        """A controller wants to leave bus-off."""


class CanController:
    """Made by `CanBus.attach`. Set the callbacks that you need; stamps are those of this node's clock, in ns."""

    def __init__(self, bus: Wire, node: CanNode, seed: int) -> None:
        self.name = node.name
        self.node = node
        self.clock = LocalClock(bus.timeline, node.offset, node.drift_ppm)
        self.state = State.ACTIVE
        self.transmit_errors = 0  # the controller's two counters
        self.receive_errors = 0
        self.missed = 0  # frames that the software lost (`CanNode.loss`, `lose_next`)
        self.on_receive: Callable[[Frame, int], object] = _ignore
        """A frame of another node has arrived."""
        self.on_sent: Callable[[Frame, int], object] = _ignore
        """A frame that was requested here has been acknowledged."""
        self.on_lost: Callable[[Frame, int], object] = _ignore
        """One-shot: a frame has lost arbitration, and leaves its mailbox now."""
        self.on_error: Callable[[Frame, ErrorKind, int], object] = _ignore
        """A frame has left its mailbox because of an error: one-shot, or bus-off."""
        self.on_late: Callable[[Frame, int], object] = _ignore
        """A frame has not started by its `not_after`, and left its mailbox: nobody has seen it."""
        self.on_state: Callable[[State, int], object] = _ignore
        """`state` has changed."""
        self.numbers = random.Random(f"{seed}/{node.name}")
        self.boxes: dict[int, Request] = {}  # for the bus, as is the next one
        self.not_before = 0  # no start of frame here earlier than this
        self._ahead = node.transmit.nominal
        self._mailboxes = node.mailboxes
        self._transmit_delay = node.transmit.drawer(self.numbers)
        self._receive_delay = node.receive.drawer(self.numbers)
        self._bus = bus
        self._timeline = bus.timeline
        self._filters: Sequence[tuple[int, int]] = ()
        self._wanted: dict[int, bool] = {}
        self._loss = node.loss
        self._lose_next = 0
        self._mad: Frame | None = None
        self._life = 0  # counts deaths: what it was about to hear is not heard any more
        self._heard = 0  # when its software hears the last thing so far: it hears them in order

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
        if not 0 <= mailbox < self._mailboxes:
            raise IndexError(f"{self.name} has {self._mailboxes} mailboxes: there is no mailbox {mailbox}")
        if mailbox in self.boxes or self.state is State.BUS_OFF or self.state is State.DOWN:
            return False
        given = self._timeline.now()
        if not_before is not None:
            ahead = self.clock.true(not_before) - self._ahead
            if ahead > given:
                given = ahead
        last = NEVER if not_after is None else self.clock.true(not_after + 1) - 1
        self._put(frame, mailbox, given + self._transmit_delay(), last)
        return True

    def abort(self, mailbox: int = 0) -> bool:
        """Withdraw the frame of this mailbox. False: its start of frame has begun, or there is none."""
        request = self.boxes.get(mailbox)
        if request is None or self._timeline.now() < request.held or self._bus.trying(request):
            return False
        del self.boxes[mailbox]
        self._bus.withdrawn()
        return True

    def pending(self, mailbox: int = 0) -> Frame | None:
        """The frame in this mailbox."""
        request = self.boxes.get(mailbox)
        return request.frame if request else None

    @property
    def filters(self) -> Sequence[tuple[int, int]]:
        """(identifier, mask): only frames with `id & mask == identifier` of one are received; none: all are."""
        return self._filters

    @filters.setter
    def filters(self, filters: Sequence[tuple[int, int]]) -> None:
        self._filters = filters
        self._wanted.clear()

    def call_at(self, local: int, callback: Callable[..., object], *args: Any) -> Timer:
        """Call it when this node's clock shows `local` ns: a timer interrupt, without latency."""
        return self._timeline.timer(self.clock.true(local), callback, *args)

    def alarm(self, callback: Callable[[], object]) -> LocalAlarm:
        """A timer of this node that can be moved, by its clock."""
        return LocalAlarm(self._timeline, self.clock, callback)

    def restart(self) -> None:
        """Leave bus-off, after 128 times 11 recessive bits: for `CanNode(recovery=False)`."""
        if self.state is State.BUS_OFF:
            self._bus.recover(self)

    # What happens to nodes

    def babble(self, frame: Frame | None) -> None:
        """Go mad: send this frame over and over, whatever happens. None: be well again."""
        self._mad = frame
        self.boxes.pop(_BABBLE, None)
        self._bus.withdrawn()
        self._babble()

    def lose_next(self, count: int = 1) -> None:
        """The software loses the next frames that it should receive."""
        self._lose_next += count

    def power_off(self) -> None:
        """Die, in the middle of a frame if need be. Nothing is called back; the mailboxes are lost."""
        if self.state is State.DOWN:
            return
        self.state = State.DOWN
        self._mad = None
        self._life += 1
        self.boxes.clear()
        self._bus.left(self)

    def power_on(self) -> None:
        """Come back, as new: sends nothing before it has seen 11 recessive bits."""
        if self.state is State.DOWN:
            self.not_before = self._timeline.now() + RECESSIVE * self._bus.bit
            self.restarted()

    @property
    def live(self) -> bool:
        """Whether it takes part: neither down nor in bus-off."""
        return self.state is State.ACTIVE or self.state is State.PASSIVE

    # What the bus tells it

    def choose(self, start: int, end: int) -> Request | None:
        """The frame that this controller tries when a start of frame comes at `start`; `end` is one bit later.

        Of those ready by then the one with the lowest identifier, else the first that gets ready before `end`.
        """
        chosen = None
        not_before = max(start, self.not_before)
        for request in self.boxes.values():
            begins = request.ready
            if begins < not_before:
                begins = not_before
            if begins > request.last:
                continue
            if begins < end or (begins == end and chosen is not None and request.frame.id < chosen.frame.id):
                chosen, end = request, begins
        return chosen

    def first(self, free: int) -> int:
        """When this controller wants to start a frame, given when the bus is free. NEVER: not at all."""
        earliest = NEVER
        not_before = max(free, self.not_before)
        for request in self.boxes.values():
            begins = request.ready
            if begins < not_before:
                begins = not_before
            if begins > request.last:
                self._guard(request)
            elif begins < earliest:
                earliest = begins
        return earliest

    def passed(self, chosen: Request | None) -> None:
        """A frame has started, and of this controller at most this one takes part: watch the others' last instants."""
        for request in self.boxes.values():
            if request.last < NEVER and request is not chosen:
                self._guard(request)

    def arrived(self, frame: Frame, end: int) -> None:
        """A good frame of another node ended."""
        if self.receive_errors:
            self._count(receive=-1 if self.receive_errors <= _PASSIVE else _RECEIVED_WELL - self.receive_errors)
        if self._filters:
            wanted = self._wanted.get(frame.id)
            if wanted is False or (wanted is None and not self._passes(frame.id)):
                return
        if self._lose_next:
            self._lose_next -= 1
            self.missed += 1
        elif self._loss and self.numbers.random() < self._loss:
            self.missed += 1
        else:
            self._tell(end, self.on_receive, frame)

    def sent(self, request: Request, end: int) -> None:
        """This request's frame got through."""
        if self.transmit_errors:
            self._count(transmit=-1)
        if self._free(request):
            self._tell(end, self.on_sent, request.frame)

    def outdone(self, request: Request, at: int) -> None:
        """This request's frame loses arbitration, at this instant."""
        request.held = at
        if self.node.one_shot and request.mailbox != _BABBLE:
            request.ready = NEVER
            self._tell(at, self._lost, request)
        elif request.last < NEVER:
            self._guard(request)

    def failed(self, request: Request, kind: ErrorKind, at: int) -> None:
        """This request's frame was destroyed: an error frame begins."""
        alone = kind is ErrorKind.ACK and self.state is State.PASSIVE
        if not alone:  # or a lone node would go to bus-off
            self._count(transmit=8)
        if self.node.one_shot and self._free(request):
            self._tell(at, self.on_error, request.frame, kind)

    def disturbed(self, count: int) -> None:
        """A frame that this node was receiving was destroyed."""
        self._count(receive=count)

    def restarted(self) -> None:
        """It takes part again, with its error counters at 0."""
        self.transmit_errors = self.receive_errors = 0
        self._enter(State.ACTIVE)
        self._bus.joined(self)
        self._babble()

    # Inside

    def _put(self, frame: Frame, mailbox: int, ready: int, last: int = NEVER) -> None:
        if frame.id >> 29 or len(frame.data) > FRAME_MAX:
            raise MessageError(f"identifier {frame.id:#x} with {len(frame.data)} bytes: no frame has room")
        self.boxes[mailbox] = request = Request(self, frame, mailbox, ready, last)
        if not self._bus.contend(request) and last < NEVER:
            self._guard(request)

    def _passes(self, identifier: int) -> bool:
        """Whether the filters let it through."""
        if len(self._wanted) >= _REMEMBERED:
            self._wanted.clear()
        self._wanted[identifier] = wanted = any(identifier & mask == value for value, mask in self._filters)
        return wanted

    def _guard(self, request: Request) -> None:
        """Abort it at its last instant, if it still waits by then: its software is told, and only then looks."""
        if not request.guarded and request.ready < NEVER:
            request.guarded = True
            heard = max(request.last, request.held, self._timeline.now()) + self._receive_delay()
            self._timeline.at(heard, self._hear, heard, self._life, self._late, (request,))

    def _free(self, request: Request) -> bool:
        """Empty its mailbox. False if it is no longer there; a babbling node never ends."""
        if request.mailbox == _BABBLE or self.boxes.get(request.mailbox) is not request:
            return False
        del self.boxes[request.mailbox]
        return True

    def _count(self, transmit: int = 0, receive: int = 0) -> None:
        self.transmit_errors = max(0, self.transmit_errors + transmit)
        self.receive_errors = max(0, self.receive_errors + receive)
        if self.transmit_errors > _OFF:
            self._off()
        elif max(self.transmit_errors, self.receive_errors) > _PASSIVE:
            self._enter(State.PASSIVE)
        else:
            self._enter(State.ACTIVE)

    def _off(self) -> None:
        now = self._timeline.now()
        given_up = [request.frame for request in self.boxes.values() if request.mailbox != _BABBLE]
        self.boxes.clear()
        self._enter(State.BUS_OFF)
        for frame in given_up:
            self._tell(now, self.on_error, frame, ErrorKind.BUS_OFF)
        self._bus.left(self)
        if self.node.recovery:
            self._bus.recover(self)

    def _enter(self, state: State) -> None:
        if state is not self.state:
            self.state = state
            self._tell(self._timeline.now(), self.on_state, state)

    def _lost(self, request: Request, stamp: int) -> None:
        if self._free(request):  # only now: one event less for each loss, and software can't know before
            self.on_lost(request.frame, stamp)

    def _late(self, request: Request, stamp: int) -> None:
        request.guarded = False  # if it has started, and is not sent, this comes again
        if self._timeline.now() < request.held or self._bus.trying(request) or not self._free(request):
            return
        self._bus.withdrawn()
        self.on_late(request.frame, stamp)

    def _babble(self) -> None:
        if self._mad and self.live:
            self._put(self._mad, _BABBLE, self._timeline.now())

    def _tell(self, when: int, callback: Callable[..., object], *args: Any) -> None:
        if callback is _ignore:
            return
        heard = when + self._receive_delay()
        if heard < self._heard:
            heard = self._heard
        self._heard = heard
        self._timeline.at(heard, self._hear, heard, self._life, callback, args)

    def _hear(self, at: int, life: int, callback: Callable[..., object], args: tuple[Any, ...]) -> None:
        if life == self._life:
            callback(*args, self.clock.local(at))


def _ignore(*_args: object) -> None:
    pass
