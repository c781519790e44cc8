"""One node's CAN controller, as its software sees it: mailboxes to send from, callbacks for what happens, a clock."""

from __future__ import annotations

import random
from typing import TYPE_CHECKING, Any, Final, Protocol

from r2p.codecs.rtcan import FRAME_MAX
from r2p.errors import MessageError
from r2p.sim.can.node import ErrorKind, LocalClock, State
from r2p.sim.can.recovery import RECESSIVE

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from r2p.codecs.rtcan import Frame
    from r2p.sim.can.node import CanNode
    from r2p.sim.can.timeline import Timeline, Timer

_PASSIVE: Final = 127
_OFF: Final = 255
_RECEIVED_WELL: Final = 119  # what the receive error counter goes back to from above 127
_NEVER: Final = 1 << 63
_BABBLE: Final = -1  # the mailbox of a node that has gone mad


class Request:
    """A frame in a mailbox. `ready`: from when on the controller tries it; `held`: until when it is on the wire."""

    __slots__ = ("frame", "held", "mailbox", "owner", "ready")

    def __init__(self, owner: CanController, frame: Frame, mailbox: int, ready: int) -> None:
        self.owner = owner
        self.frame = frame
        self.mailbox = mailbox
        self.ready = ready
        self.held = 0


class Wire(Protocol):
    """What a controller needs of its bus."""

    timeline: Timeline
    bit: int

    def contend(self, request: Request) -> None:
        """Try this frame as soon as the bus is free."""

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
        self.filters: Sequence[tuple[int, int]] = ()
        """(identifier, mask): only frames with `id & mask == identifier` of one are received; none: all are."""
        self.on_receive: Callable[[Frame, int], object] = _ignore
        """A frame of another node has arrived."""
        self.on_sent: Callable[[Frame, int], object] = _ignore
        """A frame that was requested here has been acknowledged."""
        self.on_lost: Callable[[Frame, int], object] = _ignore
        """One-shot: a frame has lost arbitration, and leaves its mailbox now."""
        self.on_error: Callable[[Frame, ErrorKind, int], object] = _ignore
        """A frame has left its mailbox because of an error: one-shot, or bus-off."""
        self.on_state: Callable[[State, int], object] = _ignore
        """`state` has changed."""
        self.numbers = random.Random(f"{seed}/{node.name}")
        self.not_before = 0  # for the bus: no start of frame here earlier than this
        self._transmit_delay = node.transmit.drawer(self.numbers)
        self._receive_delay = node.receive.drawer(self.numbers)
        self._bus = bus
        self._timeline = bus.timeline
        self._boxes: dict[int, Request] = {}
        self._lose_next = 0
        self._mad: Frame | None = None
        self._life = 0  # counts deaths: what it was about to hear is not heard any more
        self._heard = 0  # when its software hears the last thing so far: it hears them in order

    # What software does

    def request(self, frame: Frame, mailbox: int = 0) -> bool:
        """Send this frame. False: this mailbox still holds one, or the controller is down or in bus-off.

        Raises IndexError for a mailbox that the controller does not have, and `MessageError` for what is no frame.
        """
        if not 0 <= mailbox < self.node.mailboxes:
            raise IndexError(f"{self.name} has {self.node.mailboxes} mailboxes: there is no mailbox {mailbox}")
        if mailbox in self._boxes or not self.live:
            return False
        self._put(frame, mailbox, self._transmit_delay())
        return True

    def abort(self, mailbox: int = 0) -> bool:
        """Withdraw the frame of this mailbox. False: its start of frame has begun, or there is none."""
        request = self._boxes.get(mailbox)
        if request is None or self._timeline.now() < request.held or self._bus.trying(request):
            return False
        del self._boxes[mailbox]
        self._bus.withdrawn()
        return True

    def pending(self, mailbox: int = 0) -> Frame | None:
        """The frame in this mailbox."""
        request = self._boxes.get(mailbox)
        return request.frame if request else None

    def call_at(self, local: int, callback: Callable[..., object], *args: Any) -> Timer:
        """Call it when this node's clock shows `local` ns: a timer interrupt, without latency."""
        return self._timeline.timer(self.clock.true(local), callback, *args)

    def restart(self) -> None:
        """Leave bus-off, after 128 times 11 recessive bits: for `CanNode(recovery=False)`."""
        if self.state is State.BUS_OFF:
            self._bus.recover(self)

    # What happens to nodes

    def babble(self, frame: Frame | None) -> None:
        """Go mad: send this frame over and over, whatever happens. None: be well again."""
        self._mad = frame
        self._boxes.pop(_BABBLE, None)
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
        self._boxes.clear()
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
        rank = (end, 0)
        for request in self._boxes.values():
            begins = request.ready
            if begins < not_before:
                begins = not_before
            if (begins, request.frame.id) < rank:
                rank = begins, request.frame.id
                chosen = request
        return chosen

    def first(self, free: int) -> int | None:
        """When this controller wants to start a frame, given when the bus is free. None: not at all."""
        if not self._boxes:
            return None
        ready = min([request.ready for request in self._boxes.values()])
        return None if ready == _NEVER else max(ready, free, self.not_before)

    def arrived(self, frame: Frame, end: int) -> None:
        """A good frame of another node ended."""
        if self.receive_errors:
            self._count(receive=-1 if self.receive_errors <= _PASSIVE else _RECEIVED_WELL - self.receive_errors)
        if self.filters and not any(frame.id & mask == wanted for wanted, mask in self.filters):
            return
        if self._lose_next:
            self._lose_next -= 1
            self.missed += 1
        elif self.node.loss and self.numbers.random() < self.node.loss:
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
            request.ready = _NEVER
            self._tell(at, self._lost, request)

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

    def _put(self, frame: Frame, mailbox: int, delay: int) -> None:
        if frame.id >> 29 or len(frame.data) > FRAME_MAX:
            raise MessageError(f"identifier {frame.id:#x} with {len(frame.data)} bytes: no frame has room")
        self._boxes[mailbox] = request = Request(self, frame, mailbox, self._timeline.now() + delay)
        self._bus.contend(request)

    def _free(self, request: Request) -> bool:
        """Empty its mailbox. False if it is no longer there; a babbling node never ends."""
        if request.mailbox == _BABBLE or self._boxes.get(request.mailbox) is not request:
            return False
        del self._boxes[request.mailbox]
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
        given_up = [request.frame for request in self._boxes.values() if request.mailbox != _BABBLE]
        self._boxes.clear()
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

    def _babble(self) -> None:
        if self._mad and self.live:
            self._put(self._mad, _BABBLE, 0)

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
