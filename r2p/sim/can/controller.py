"""One node's CAN controller, as its software sees it: mailboxes to send from, callbacks for what happens, a clock."""

from __future__ import annotations

import random
from typing import TYPE_CHECKING, Any, Protocol

from r2p.codecs.rtcan import FRAME_MAX
from r2p.errors import MessageError
from r2p.sim.can.confinement import Confinement
from r2p.sim.can.interrupts import Interrupts, ignore
from r2p.sim.can.mailboxes import BABBLE, Mailboxes, Request
from r2p.sim.can.node import NEVER, ErrorKind, LocalAlarm, LocalClock, State
from r2p.sim.can.recovery import RECESSIVE

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from r2p.codecs.rtcan import Frame
    from r2p.sim.can.node import CanNode
    from r2p.sim.can.timeline import Timeline, Timer


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

    def __init__(self, bus: Wire, node: CanNode, seed: int) -> None:
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
        self.on_state: Callable[[State, int], object] = ignore
        """`state` has changed."""
        self.numbers = random.Random(f"{seed}/{node.name}")
        self.mailboxes = Mailboxes(self._guard)  # for the bus, as is the next one
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
    def state(self) -> State:
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
        self.mailboxes.requests.pop(BABBLE, None)
        self._bus.withdrawn()
        self._babble()

    def lose_next(self, count: int = 1) -> None:
        """The software loses the next frames that it should receive."""
        self._lose_next += count

    def power_off(self) -> None:
        """Die, in the middle of a frame if need be. Nothing is called back; the mailboxes are lost."""
        if self.state is State.DOWN:
            return
        self.confinement.enter(State.DOWN)
        self._mad = None
        self._interrupts.forget()
        self.mailboxes.clear()
        self._bus.left(self)

    def power_on(self) -> None:
        """Come back, as new: sends nothing before it has seen 11 recessive bits."""
        if self.state is State.DOWN:
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

    def _changed(self, state: State) -> None:
        if state is State.DOWN:
            return
        now = self._timeline.now()
        given_up = self.mailboxes.clear() if state is State.BUS_OFF else ()
        self._interrupts.tell(now, self.on_state, state)
        for frame in given_up:
            self._interrupts.tell(now, self.on_error, frame, ErrorKind.BUS_OFF)
        if state is State.BUS_OFF:
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
