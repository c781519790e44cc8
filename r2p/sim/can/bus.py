"""The wire between the controllers: who sends next, for how long, and what becomes of it.

The bus is free, or busy. While it is free it knows the start of the next frame, as soon as somebody wants to send: then
the window of one bit time runs in which others may join. At its end arbitration is decided, and with it everything up
to the end of the frame; that is the next event. So a frame is two events here, and one for each node that hears of it.
"""

from __future__ import annotations

import random
from typing import TYPE_CHECKING, Final

import msgspec

from r2p.codecs.rtcan import INTERMISSION, TAIL, bits_until_lost, frame_bits, wire_bits
from r2p.sim.can.controller import CanController, Recovery
from r2p.sim.can.faults import bits_until_noticed, error_frame_bits, first_difference, flip
from r2p.sim.can.node import NEVER, CanNode, ControllerState, ErrorKind, FrameRecord
from r2p.sim.can.statistics import Statistics
from r2p.sim.can.timeline import Timeline

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable, Sequence

    from r2p.codecs.rtcan import Frame
    from r2p.sim.can.controller import ControllerMailboxes, Request

_SECOND: Final = 1_000_000_000
_SUSPEND: Final = 8  # bits that an error passive sender waits longer
_AFTER_ACK: Final = TAIL - 2  # bits that follow the acknowledge


class _Transfer(msgspec.Struct, eq=False):
    """A frame on the wire: its senders, who receives it, and whether an error frame will end it."""

    frame: Frame
    requests: list[Request]
    names: tuple[str, ...]
    heard_by: Sequence[CanController]
    start: int
    bits: int
    doomed: bool = False

    @property
    def owners(self) -> list[CanController]:
        return [request.owner for request in self.requests]


class CanBus:
    """A CAN 2.0B bus with extended identifiers.

    `timeline` is true time. `statistics` counts from the start. `observers` get a `FrameRecord` of each frame and of
    each attempt at one, at its end.
    """

    def __init__(
        self, loop: asyncio.AbstractEventLoop, *, bitrate: int = 1_000_000, noise: float = 0.0, seed: int = 0
    ) -> None:
        """`bitrate` in bit/s; a bit must take whole ns, else ValueError. `noise`: the share of frames with a bit error.

        Each node has random numbers of its own, which follow from `seed` and its name.
        """
        bit, rest = divmod(_SECOND, bitrate)
        if rest:
            raise ValueError(f"{bitrate} bit/s: a bit does not take whole nanoseconds")
        self.timeline = Timeline(loop)
        self.bit = bit
        self.noise = noise
        self.statistics = Statistics(bit, self.timeline.now())
        self.observers: list[Callable[[FrameRecord], object]] = []
        self._seed = seed
        self._numbers = random.Random(f"{seed}")
        self._names: set[str] = set()
        self._listeners = Listeners()
        self._noisy = False  # whether a node has noise of its own
        self._disturb: list[int] = []
        self._free = 0  # from when on a frame may start
        self._contenders: dict[ControllerMailboxes, None] = {}  # may have something to send; nobody else has
        self._start: int | None = None  # when the next one does
        self._plan = 0  # the number of that plan: it can change until the window is over
        self._transfer: _Transfer | None = None
        self._busy = False
        self._recovery = Recovery(self.timeline, bit)

    def attach(self, node: CanNode) -> CanController:
        """Connect a node, with power on. Raises ValueError when the name is taken."""
        if node.name in self._names:
            raise ValueError(f"there is a node {node.name} on this bus already")
        self._names.add(node.name)
        controller = CanController(self, node, self._seed)
        self.joined(controller)
        self._noisy = self._noisy or node.noise > 0
        return controller

    def disturb_next(self, bit: int) -> None:
        """Give the next frame a bit error at this bit, counted from 1; those stuffed in count."""
        self._disturb.append(bit)

    def load(self) -> float:
        """The share of the time that the bus was occupied, since the start or `reset_statistics`."""
        return self.statistics.load(self.timeline.now())

    def reset_statistics(self) -> None:
        """Count from now on."""
        self.statistics = Statistics(self.bit, self.timeline.now())

    def close(self) -> None:
        """Nothing happens any more."""
        self.timeline.close()

    # What controllers say (`controller.Wire`)

    def contend(self, request: Request) -> bool:
        """Try this frame as soon as the bus is free. False: it is not, or this frame would come too late."""
        boxes = request.owner.mailboxes
        self._contenders[boxes] = None
        if self._busy:
            return False
        start = self._free
        if start < request.ready:
            start = request.ready
        if start < boxes.not_before:
            start = boxes.not_before
        if start > request.last:
            return False
        if self._start is None or start < self._start:
            self._plan_start(start)
        return True

    def trying(self, request: Request) -> bool:
        """Whether the start of this frame has begun, and who wins is still open."""
        start = self._start
        if start is None or self.timeline.now() < max(start, request.ready):
            return False
        return request.owner.mailboxes.choose(start, start + self.bit) is request

    def withdrawn(self) -> None:
        """A frame is not to be sent any more."""
        if not self._busy:
            self._plan_anew()

    def left(self, controller: CanController) -> None:
        """A controller takes no part any more: no power, or bus-off."""
        self._listeners.leave(controller)
        if controller.state is ControllerState.DOWN:
            self._recovery.forget(controller)
        if self._transfer:
            self._torn(self._transfer, controller)
        self.withdrawn()

    def joined(self, controller: CanController) -> None:
        """A controller takes part again."""
        self._listeners.join(controller)

    def reconsider(self) -> None:
        """Other frames than before may concern a controller."""
        self._listeners.reconsider()

    def recover(self, controller: CanController) -> None:
        """A controller wants to leave bus-off."""
        self._recovery.begin(controller, max(self.timeline.now(), self._free))

    # The start of a frame

    def _plan_start(self, start: int) -> None:
        self._start = start
        self._plan += 1
        self.timeline.at(start + self.bit, self._arbitrate, self._plan)

    def _plan_anew(self) -> None:
        self._start = None
        self._plan += 1
        free, start = self._free, NEVER
        for boxes in list(self._contenders):
            if not boxes.requests:
                del self._contenders[boxes]
            elif (first := boxes.first(free)) < start:
                start = first
        if start < NEVER:
            self._plan_start(start)

    def _arbitrate(self, plan: int) -> None:
        start = self._start
        if plan != self._plan or start is None:
            return
        self._start = None
        self._busy = True
        if self._recovery.left:
            self._recovery.busy(start)
        tries = self._tries(start, start + self.bit)
        if len(tries) > 1:
            tries = self._winners(tries, start)
            if any(request.frame != tries[0].frame for request in tries):
                self._collide(tries, start)
                return
        self._send(tries, start)

    def _tries(self, start: int, end: int) -> list[Request]:
        """What takes part; `end` is one bit after the start of frame."""
        tries = []
        for boxes in self._contenders:
            request = boxes.choose(start, end)
            if request is not None:
                tries.append(request)
            if request is None or len(boxes.requests) > 1:
                boxes.passed(request)
        return tries

    def _winners(self, tries: list[Request], start: int) -> list[Request]:
        """Arbitration: the lowest identifier wins; the others lose where they differ from it."""
        lowest = min([request.frame.id for request in tries])
        for request in tries:
            if request.frame.id != lowest:
                self._lose(request, lowest, start)
        return [request for request in tries if request.frame.id == lowest]

    def _lose(self, request: Request, winner: int, start: int) -> None:
        self.statistics.add_lost(request.owner.name, request.frame.id)
        request.owner.outdone(request, start + bits_until_lost(winner, request.frame.id) * self.bit)

    # A frame

    def _send(self, requests: list[Request], start: int, deaf: Sequence[CanController] = ()) -> None:
        """Put this frame on the wire, of one sender, or of several that send the same."""
        self._transfer = transfer = self._transfer_of(requests, start, deaf)
        end = start + transfer.bits * self.bit
        for request in requests:
            request.held = end
        if (self.noise or self._noisy or self._disturb) and self._hit(transfer):
            return
        if transfer.heard_by:
            self.timeline.at(end, self._finish, transfer, end)
        else:
            self._destroy(transfer, wire_bits(transfer.frame)[:-_AFTER_ACK], ErrorKind.ACK, transfer.owners)

    def _transfer_of(self, requests: list[Request], start: int, deaf: Sequence[CanController]) -> _Transfer:
        frame, owner = requests[0].frame, requests[0].owner
        if len(requests) == 1 and not deaf:
            names, heard_by = self._listeners.audience[owner]
        else:
            owners = [request.owner for request in requests]
            names = tuple([owner.name for owner in owners])
            heard_by = [node for node in self._listeners.live if node not in owners and node not in deaf]
        return _Transfer(frame, requests, names, heard_by, start, frame_bits(frame.id, frame.data))

    def _finish(self, transfer: _Transfer, end: int) -> None:
        if transfer.doomed:
            return
        frame = transfer.frame
        for request in transfer.requests:
            request.owner.sent(request, end)
        for node in self._listeners.concerned[frame.id]:
            if node in transfer.heard_by:
                node.arrived(frame, end)
        self._over(transfer, transfer.bits, None, end)

    def _over(self, transfer: _Transfer, bits: int, error: ErrorKind | None, end: int) -> None:
        record = FrameRecord(transfer.start, end, transfer.frame, transfer.names, bits, error)
        self.statistics.add(record)
        self._transfer = None
        self._busy = False
        self._free = end + INTERMISSION * self.bit
        for request in transfer.requests:
            if request.owner.confinement.passive:
                request.owner.mailboxes.not_before = self._free + _SUSPEND * self.bit
        if self._recovery.left:
            self._recovery.free(self._free)
        self._plan_anew()
        for observer in self.observers:
            observer(record)

    # What goes wrong

    def _hit(self, transfer: _Transfer) -> bool:
        """Let noise hit this frame, perhaps. True: it is destroyed."""
        if self._disturb or self._numbers.random() < self.noise:
            bit = self._disturb.pop(0) if self._disturb else self._numbers.randrange(1, transfer.bits + 1)
            bus = flip(wire_bits(transfer.frame), min(bit, transfer.bits))
            self._destroy(transfer, bus, ErrorKind.BIT, transfer.owners)
            return True
        for node in list(transfer.heard_by):
            if node.node.noise and node.numbers.random() < node.node.noise:
                node.disturbed(8)
                if node.state is ControllerState.ACTIVE:
                    bit = node.numbers.randrange(1, transfer.bits + 1)
                    self._destroy(transfer, wire_bits(transfer.frame)[:bit], ErrorKind.BIT, [node])
                    return True
                transfer.heard_by = [each for each in transfer.heard_by if each is not node]
        return False

    def _collide(self, requests: list[Request], start: int, deaf: Sequence[CanController] = ()) -> None:
        """Several senders of one identifier: at the first other bit those that send a recessive one see an error."""
        wires = [wire_bits(request.frame) for request in requests]
        bit = first_difference(wires)
        hit = [request for request, wire in zip(requests, wires, strict=True) if wire[bit - 1] == "1"]
        if any(request.owner.state is ControllerState.ACTIVE for request in hit):
            self._transfer = transfer = self._transfer_of(requests, start, deaf)
            self._destroy(transfer, flip(wire_bits(hit[0].frame), bit), ErrorKind.BIT, [r.owner for r in hit])
            return
        at = start + bit * self.bit
        for request in hit:  # error passive: they leave the bus to the others, who do not notice
            request.held = at
            self.timeline.at(at, request.owner.failed, request, ErrorKind.BIT, at)
        rest = [request for request in requests if request not in hit]
        deaf = [*deaf, *(request.owner for request in hit)]
        if any(request.frame != rest[0].frame for request in rest):
            self._collide(rest, start, deaf)
        else:
            self._send(rest, start, deaf)

    def _destroy(self, transfer: _Transfer, bus: str, kind: ErrorKind, by: Sequence[CanController]) -> None:
        """After these bits on the bus these nodes know of an error, and say so."""
        transfer.doomed = True
        detected = transfer.start + len(bus) * self.bit
        active = any(node.state is ControllerState.ACTIVE for node in by)
        others = any(n.state is ControllerState.ACTIVE for n in (*transfer.owners, *transfer.heard_by) if n not in by)
        bits = len(bus) + error_frame_bits(bus, wire_bits(transfer.frame), active=active, others=others)
        end = transfer.start + bits * self.bit
        for request in transfer.requests:
            request.held = end
        self.timeline.at(detected, self._failed, transfer, kind)
        self.timeline.at(end, self._over, transfer, bits, kind, end)

    def _failed(self, transfer: _Transfer, kind: ErrorKind) -> None:
        now = self.timeline.now()
        for request in list(transfer.requests):
            request.owner.failed(request, kind, now)
        for node in transfer.heard_by:
            node.disturbed(1)

    def _torn(self, transfer: _Transfer, controller: CanController) -> None:
        """A node has died while this frame is on the wire."""
        sent = -((transfer.start - self.timeline.now()) // self.bit)
        before = len(transfer.requests)
        transfer.requests = [request for request in transfer.requests if request.owner is not controller]
        transfer.heard_by = [node for node in transfer.heard_by if node is not controller]
        if transfer.doomed:
            return
        wire = wire_bits(transfer.frame)
        if before and not transfer.requests and sent < transfer.bits - TAIL:
            bus = wire[:sent]
            bus += "1" * bits_until_noticed(bus, wire, "1")
            self._destroy(transfer, bus, ErrorKind.STUFF, transfer.heard_by)
        elif transfer.requests and not transfer.heard_by and sent < transfer.bits - _AFTER_ACK:
            self._destroy(transfer, wire[:-_AFTER_ACK], ErrorKind.ACK, transfer.owners)


# Who takes part in a bus, who hears whom, and whom a frame matters to: needed for each frame, and seldom changed.


_REMEMBERED: Final = 4096  # identifiers of which it is known whom they concern


class Listeners:
    """The controllers with power that are not in bus-off, in the order in which they came.

    `audience[controller]`: its name, and all that hear what it sends alone. `concerned[identifier]`: to whom a good
    frame with this identifier matters.
    """

    def __init__(self) -> None:
        self.live: list[CanController] = []
        self.audience = _Audience(self.live)
        self.concerned = _Concerned(self.live)

    def join(self, controller: CanController) -> None:
        """It takes part from now on."""
        self.live.append(controller)
        self.audience.clear()
        self.concerned.clear()

    def leave(self, controller: CanController) -> None:
        """It takes no part any more, if it did."""
        if controller in self.live:
            self.live.remove(controller)
            self.audience.clear()
            self.concerned.clear()

    def reconsider(self) -> None:
        """Other frames than before may concern a controller."""
        self.concerned.clear()


class _Audience(dict["CanController", tuple[tuple[str, ...], list["CanController"]]]):
    """Worked out at the first question."""

    def __init__(self, live: list[CanController]) -> None:
        super().__init__()
        self._live = live

    def __missing__(self, owner: CanController) -> tuple[tuple[str, ...], list[CanController]]:
        audience = self[owner] = (owner.name,), [each for each in self._live if each is not owner]
        return audience


class _Concerned(dict[int, list["CanController"]]):
    """Worked out at the first question."""

    def __init__(self, live: list[CanController]) -> None:
        super().__init__()
        self._live = live

    def __missing__(self, identifier: int) -> list[CanController]:
        if len(self) >= _REMEMBERED:
            self.clear()
        concerned = self[identifier] = [each for each in self._live if each.concerned(identifier)]
        return concerned
