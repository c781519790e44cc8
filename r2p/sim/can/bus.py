"""The wire between the controllers: arbitration, frames, and errors.

The bus is either free or busy. As soon as a controller wants to send, the bus knows the start of the next frame; within
one bit time others may join. At the end of that bit the arbitration is decided, and with it everything up to the end of
the frame, which is the next event. So a frame is two events here, and one for each node that receives it.
"""

from __future__ import annotations

import random
from typing import TYPE_CHECKING, Final

import msgspec

from r2p.codecs.can_bits import (
    ARBITRATION_FIELDS,
    INTERMISSION,
    TAIL,
    Frame,
    OtherFrame,
    bits_until_lost,
    field_at,
    frame_bits,
    other_frame_bits,
    wire_bits,
    wire_identifier,
)
from r2p.sim.can.controller import RECESSIVE_BITS, BusWire, CanController
from r2p.sim.can.error_frames import (
    DELIMITER,
    FLAG,
    Disturbance,
    ErrorFrame,
    bits_until_noticed,
    error_frame_bits,
    first_difference,
    flip,
)
from r2p.sim.can.interrupts import Reception, ignore
from r2p.sim.can.participants import Listeners, Recovery
from r2p.sim.can.records import ArbitrationLoss, BusError, CanNode, ControllerState, ErrorKind, FrameRecord, Statistics
from r2p.sim.can.timeline import Timeline
from r2p.units import NEVER, SECOND

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable, Sequence

    from r2p.codecs.can_bits import AnyFrame
    from r2p.sim.can.controller import ControllerMailboxes, TransmitRequest

_SUSPEND: Final = 8  # bits that an error passive sender waits longer before its next frame
_BITS_AFTER_ACK: Final = TAIL - 2  # bits that follow the acknowledge slot
_BITS_AFTER_ACK_DELIMITER: Final = TAIL - 3  # by then, receivers have compared the CRC


class _Transfer(msgspec.Struct, eq=False):
    """A frame on the wire: its senders, its receivers, and whether an error frame will end it.

    `receivers` acknowledge it; `silent` ones only listen.
    """

    frame: AnyFrame
    requests: list[TransmitRequest]
    names: tuple[str, ...]
    receivers: Sequence[CanController]
    silent: Sequence[CanController]
    start: int
    bits: int
    destroyed: bool = False

    @property
    def owners(self) -> list[CanController]:
        return [request.owner for request in self.requests]


class CanBus(BusWire):
    """A CAN 2.0 bus: identifiers of 11 and of 29 bits, data and remote frames.

    `timeline` is true time. `statistics` counts from the start. `observers` are called with a `FrameRecord` at the end
    of each frame and of each attempt that failed, `loss_observers` with an `ArbitrationLoss` at the start of the frame
    that has won.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        *,
        bitrate: int = 1_000_000,
        noise: float = 0.0,
        seed: int = 0,
        timeline: Timeline | None = None,
    ) -> None:
        """`bitrate` in bit/s, such that a bit takes whole ns. `noise`: the share of frames with a bit error.

        Each node has its own random numbers, which follow from `seed` and its name. `timeline`: that of another bus, so
        that their events are in order.
        """
        bit, rest = divmod(SECOND, bitrate)
        if rest:
            raise ValueError(f"at {bitrate} bit/s a bit does not take whole nanoseconds")
        self.timeline = timeline or Timeline(loop)
        self.bit = bit
        self.noise = noise
        self.bit_error_rate = 0.0
        """The share of bits that are inverted; a longer frame is more often hit. It adds to `noise`."""
        self.statistics = Statistics(bit, self.timeline.now())
        self.observers: list[Callable[[FrameRecord], object]] = []
        self.loss_observers: list[Callable[[ArbitrationLoss], object]] = []
        self._loop = loop
        self._seed = seed
        self._numbers = random.Random(f"{seed}")
        self._names: set[str] = set()
        self._listeners = Listeners()
        self._noisy = False  # whether a node has noise of its own
        self._disturbances: list[Disturbance] = []
        self._stuck_until = 0  # the bus is dominant up to this instant, whatever is sent
        self._free = 0  # from when on a frame may start
        self._contenders: dict[ControllerMailboxes, None] = {}  # all that may have something to send, in order
        self._start: int | None = None  # of the next frame
        self._plan = 0  # the number of that start: an event of an earlier plan does nothing
        self._transfer: _Transfer | None = None
        self._busy = False
        self._recovery = Recovery(self.timeline, bit)

    def attach(self, node: CanNode) -> CanController:
        """Connect a node, with its power on. Raises ValueError if its name is in use."""
        if node.name in self._names:
            raise ValueError(f"there is already a node {node.name} on this bus: give this one another name")
        self._names.add(node.name)
        controller = CanController(self, node, self._seed)
        self.connect(controller)
        self._noisy = self._noisy or node.noise > 0
        return controller

    def detach(self, controller: CanController) -> None:
        """Disconnect a node for good, as if its power was cut. Another one may have its name."""
        controller.power_off()
        self._names.discard(controller.name)

    def disturb_next(
        self, bit: int | None = None, count: int = 1, *, identifier: int | None = None, sender: str | None = None
    ) -> None:
        """Destroy the next `count` frames with a bit error; each attempt to send counts, also that of a frame again.

        `bit` is the bit that is inverted, counted from 1 with stuff bits, or the last bit of a frame that is shorter;
        None draws one for each frame, from the seed. With `identifier` (with flags: see `wire_identifier`) or `sender`,
        only frames with that identifier or of that node count. Several calls wait for their frames side by side; for a
        frame that more than one waits for, the first counts.
        """
        if count > 0:
            self._disturbances.append(Disturbance(bit, count, identifier, sender))

    def short(self, duration: int) -> None:
        """Hold the bus dominant for `duration` ns from now on, as a short circuit of its wires does.

        A frame on the wire is destroyed at the first recessive bit of its sender; within the arbitration field, it
        loses. A free bus looks like the start of a frame, which breaks the rules after six bits: that is recorded as a
        failed attempt without senders, of the frame that the bits would begin. All controllers count errors as long as
        the bus is dominant: who was sending goes to bus-off, the others become error passive.
        """
        self._stuck_until = max(self._stuck_until, self.timeline.now() + duration)
        if self._transfer is None:
            self._dominate()
        elif not self._transfer.destroyed:
            self._short(self._transfer)
        # otherwise an error frame is on the wire, and lasts longer

    def load(self) -> float:
        """Return the share of the time that the bus was occupied since the start or `reset_statistics`."""
        return self.statistics.load(self.timeline.now())

    def reset_statistics(self) -> None:
        """Start to count anew."""
        self.statistics = Statistics(self.bit, self.timeline.now())

    def close(self) -> None:
        """Drop all events, so that nothing further happens on this bus."""
        self.timeline.close()

    # For controllers: `BusWire` says what these do

    def contend(self, request: TransmitRequest) -> bool:
        mailboxes = request.owner.mailboxes
        self._contenders[mailboxes] = None
        if self._busy:
            return False
        start = self._free  # comparisons instead of max(), which takes longer: this runs for each frame
        if start < request.ready:
            start = request.ready
        if start < mailboxes.not_before:
            start = mailboxes.not_before
        if start > request.last_start:
            return False
        if self._start is None or start < self._start:
            self._plan_start(start)
        return True

    def is_starting(self, request: TransmitRequest) -> bool:
        start = self._start
        if start is None or self.timeline.now() < max(start, request.ready):
            return False
        return request.owner.mailboxes.choose(start, start + self.bit) is request

    def replan(self) -> None:
        if not self._busy:
            self._plan_anew()

    def disconnect(self, controller: CanController) -> None:
        self._listeners.leave(controller)
        if controller.state is ControllerState.DOWN:
            self._recovery.forget(controller)
        if self._transfer:
            self._node_died(self._transfer, controller)
        self.replan()

    def connect(self, controller: CanController) -> None:
        self._listeners.join(controller)

    def cut(self, controller: CanController) -> BusWire:
        alone = CanBus(self._loop, bitrate=SECOND // self.bit, timeline=self.timeline)
        transfer, now = self._transfer, self.timeline.now()
        sending, start, free = None, 0, max(now, self._free)
        if transfer and not transfer.destroyed:
            left = transfer.bits + (transfer.start - now) // self.bit  # bits of the frame that are not on the wire yet
            end, start = transfer.start + transfer.bits * self.bit, transfer.start
            sent = next((each for each in transfer.requests if each.owner is controller), None)
            if sent and left > _BITS_AFTER_ACK:
                sending = sent
            elif sent:
                free = end + INTERMISSION * self.bit
                controller.complete(sent, end)  # acknowledged: its frame will be complete
            elif controller in transfer.receivers and left > TAIL:
                controller.disturb(1)  # silence in the middle of a frame: a stuff error
        if self.leave(controller):
            alone.recover(controller)
        alone.carry(controller, free, sending, start)
        return alone

    def carry(
        self, controller: CanController, free: int, sending: TransmitRequest | None = None, start: int = 0
    ) -> None:
        """Let this controller take part from `free` on, or go on to send a frame that began at `start`."""
        self._free = free
        self._contenders[controller.mailboxes] = None
        if controller.live:
            self.connect(controller)
        if sending:
            self._busy = True
            self._send([sending], start)
        self.replan()

    def mend(self, controller: CanController, alone: BusWire) -> None:
        now = self.timeline.now()
        recovering = alone.leave(controller)
        controller.mailboxes.not_before = now + RECESSIVE_BITS * self.bit
        for request in controller.mailboxes.requests.values():
            request.busy_until = now
        self.carry(controller, self._free)
        if recovering:
            self.recover(controller)

    def leave(self, controller: CanController) -> bool:
        recovering = self._recovery.forget(controller)
        self._contenders.pop(controller.mailboxes, None)
        self.disconnect(controller)
        return recovering

    def forget_filters(self) -> None:
        self._listeners.concerned.clear()

    def recover(self, controller: CanController) -> None:
        now = self.timeline.now()
        self._recovery.begin(controller, max(now, self._free))
        if self._stuck_until > now:
            self._recovery.busy(now)

    # The start of a frame

    def _plan_start(self, start: int) -> None:
        self._start = start
        self._plan += 1
        self.timeline.at(start + self.bit, self._arbitrate, self._plan)

    def _plan_anew(self) -> None:
        self._start = None
        self._plan += 1
        free, start = self._free, NEVER
        for mailboxes in list(self._contenders):
            if not mailboxes.requests:
                del self._contenders[mailboxes]
            elif (first := mailboxes.first(free)) < start:
                start = first
        if start < NEVER:
            self._plan_start(start)

    def _arbitrate(self, plan: int) -> None:
        start = self._start
        if plan != self._plan or start is None:
            return
        self._start = None
        self._busy = True
        if self._recovery.remaining:
            self._recovery.busy(start)
        contestants = self._contestants(start, start + self.bit)
        if len(contestants) > 1:
            contestants = self._winners(contestants, start)
            if any(request.frame != contestants[0].frame for request in contestants):
                self._collide(contestants, start)
                return
        self._send(contestants, start)

    def _contestants(self, start: int, end: int) -> list[TransmitRequest]:
        """Return one frame of each controller that takes part; `end` is one bit after the start of frame."""
        contestants = []
        for mailboxes in self._contenders:
            request = mailboxes.choose(start, end)
            if request is not None:
                contestants.append(request)
            if request is None or len(mailboxes.requests) > 1:  # some frame of this controller goes on waiting
                mailboxes.watch_others(request)
        return contestants

    def _winners(self, contestants: list[TransmitRequest], start: int) -> list[TransmitRequest]:
        """Return the frames with the lowest identifier; the others lose at the bit where they differ from it."""
        lowest = min([request.rank or request.find_rank() for request in contestants])
        for request in contestants:
            if request.rank != lowest:
                at = start + bits_until_lost(lowest, request.rank) * self.bit
                self.statistics.add_lost(request.owner.name, request.frame)
                for observer in self.loss_observers:
                    observer(ArbitrationLoss(start, at, request.frame, request.owner.name))
                request.owner.lose_arbitration(request, at)
        return [request for request in contestants if request.rank == lowest]

    # A frame

    def _send(self, requests: list[TransmitRequest], start: int, excluded: Sequence[CanController] = ()) -> None:
        """Put a frame on the wire, of one sender or of several that send the same."""
        self._transfer = transfer = self._transfer_of(requests, start, excluded)
        end = start + transfer.bits * self.bit
        for request in requests:
            request.busy_until = end
        if (self.noise or self.bit_error_rate or self._noisy or self._disturbances) and self._hit(transfer):
            return
        if transfer.receivers:
            self.timeline.at(end, self._finish, transfer, end)
        else:
            self._destroy(transfer, wire_bits(transfer.frame)[:-_BITS_AFTER_ACK], ErrorKind.ACK, transfer.owners)

    def _transfer_of(self, requests: list[TransmitRequest], start: int, excluded: Sequence[CanController]) -> _Transfer:
        frame, owner = requests[0].frame, requests[0].owner
        if len(requests) == 1 and not excluded:
            names, receivers, silent = self._listeners.audience[owner]
        else:
            owners = [request.owner for request in requests]
            names = tuple([owner.name for owner in owners])
            receivers = [node for node in self._listeners.live if node not in owners and node not in excluded]
            silent = self._listeners.silent.copy()
        bits = frame_bits(frame.id, frame.data) if frame.__class__ is Frame else other_frame_bits(frame)
        return _Transfer(frame, requests, names, receivers, silent, start, bits)

    def _finish(self, transfer: _Transfer, end: int) -> None:
        if transfer.destroyed:
            return
        frame, receivers, silent = transfer.frame, transfer.receivers, transfer.silent
        for request in transfer.requests:
            request.owner.complete(request, end)
        reception = Reception(self.timeline, frame, end)
        for node in self._listeners.concerned[frame.id if frame.__class__ is Frame else ~wire_identifier(frame)]:
            if node in receivers or (silent and node in silent):
                node.receive(reception)
        self._over(transfer, transfer.bits, None, end)

    def _over(self, transfer: _Transfer, bits: int, error: ErrorKind | None, end: int) -> None:
        if error is not None and self._stuck_until > end - DELIMITER * self.bit:
            self._extend(transfer, error, end - DELIMITER * self.bit)
            return
        record = FrameRecord(transfer.start, end, transfer.frame, transfer.names, bits, error)
        self.statistics.add(record)
        self._transfer = None
        self._busy = False
        self._free = end + INTERMISSION * self.bit
        for request in transfer.requests:
            if request.owner.confinement.passive:
                request.owner.mailboxes.not_before = self._free + _SUSPEND * self.bit
        if self._recovery.remaining:
            self._recovery.free(self._free)
        self._plan_anew()
        for observer in self.observers:  # last: an observer may request the next frame
            observer(record)

    # Errors

    def _hit(self, transfer: _Transfer) -> bool:
        """Decide whether noise hits this frame. True: the frame is destroyed."""
        disturbed, bit = self._disturbed(transfer)
        if disturbed or self._numbers.random() < self._risk(transfer.bits):
            bit = bit or self._numbers.randrange(1, transfer.bits + 1)
            bus = flip(wire_bits(transfer.frame), min(bit, transfer.bits))
            self._destroy(transfer, bus, ErrorKind.BIT, transfer.owners)
            return True
        for node in (*transfer.receivers, *transfer.silent):
            if node.node.noise and node.numbers.random() < node.node.noise:
                if not node.node.listen_only:
                    node.disturb(8)
                if node.state is ControllerState.ACTIVE and not node.node.listen_only:
                    bit = node.numbers.randrange(1, transfer.bits + 1)
                    self._destroy(transfer, wire_bits(transfer.frame)[:bit], ErrorKind.BIT, [node])
                    return True
                self._leave_out(transfer, node)
                at = transfer.start + (transfer.bits - _BITS_AFTER_ACK_DELIMITER) * self.bit
                self.timeline.at(at, self._crc_failed, transfer, node, at)
        return False

    def _risk(self, bits: int) -> float:
        """Return the chance that a frame of so many bits is hit."""
        rate = self.bit_error_rate
        return 1.0 - (1.0 - self.noise) * (1.0 - rate) ** bits if rate else self.noise

    def _crc_failed(self, transfer: _Transfer, node: CanController, at: int) -> None:
        """Let a receiver see alone that the frame was wrong, without an effect on the others."""
        if not transfer.destroyed:
            bit = (at - transfer.start) // self.bit
            node.see_error(BusError(ErrorKind.CRC, bit, field_at(transfer.frame, bit), sending=False), at)

    def _leave_out(self, transfer: _Transfer, node: CanController) -> None:
        transfer.receivers = [each for each in transfer.receivers if each is not node]
        transfer.silent = [each for each in transfer.silent if each is not node]

    def _disturbed(self, transfer: _Transfer) -> tuple[bool, int | None]:
        """Return whether a disturbance waits for this frame, and its bit."""
        for each in self._disturbances:
            if each.hits(transfer.frame, transfer.names):
                each.count -= 1
                if not each.count:
                    self._disturbances.remove(each)
                return True, each.bit
        return False, None

    def _collide(self, requests: list[TransmitRequest], start: int, excluded: Sequence[CanController] = ()) -> None:
        """Let senders of one identifier collide: at the first bit that differs, those that send a 1 see an error."""
        wires = [wire_bits(request.frame) for request in requests]
        bit = first_difference(wires)
        hit = [request for request, wire in zip(requests, wires, strict=True) if wire[bit - 1] == "1"]
        if any(request.owner.state is ControllerState.ACTIVE for request in hit):
            self._transfer = transfer = self._transfer_of(requests, start, excluded)
            self._destroy(transfer, flip(wire_bits(hit[0].frame), bit), ErrorKind.BIT, [r.owner for r in hit])
            return
        at = start + bit * self.bit
        for request in hit:  # error passive: their error flag is invisible, so the others go on
            request.busy_until = at
            self.timeline.at(at, self._give_up, request, bit, at)
        rest = [request for request in requests if request not in hit]
        excluded = [*excluded, *(request.owner for request in hit)]
        if any(request.frame != rest[0].frame for request in rest):
            self._collide(rest, start, excluded)
        else:
            self._send(rest, start, excluded)

    def _give_up(self, request: TransmitRequest, bit: int, at: int) -> None:
        """Let an error passive sender fail alone, while others go on."""
        request.owner.fail(request, ErrorKind.BIT, at)
        request.owner.see_error(BusError(ErrorKind.BIT, bit, field_at(request.frame, bit), sending=True), at)

    def _destroy(self, transfer: _Transfer, bus: str, kind: ErrorKind, by: Sequence[CanController]) -> None:
        """Destroy a frame: after these bits on the bus, the nodes `by` have detected an error and send error flags."""
        transfer.destroyed = True
        detected = transfer.start + len(bus) * self.bit
        active = any(node.state is ControllerState.ACTIVE for node in by)
        others = any(n.state is ControllerState.ACTIVE for n in (*transfer.owners, *transfer.receivers) if n not in by)
        bits = len(bus) + error_frame_bits(bus, wire_bits(transfer.frame), active=active, others=others)
        end = transfer.start + bits * self.bit
        for request in transfer.requests:
            request.busy_until = end
        error = ErrorFrame(kind, bus, by, "0" if active else "1")
        if kind is ErrorKind.ACK and not active and transfer.silent:
            self.timeline.at(transfer.start + transfer.bits * self.bit, self._overhear, transfer)
            error.unseen = True
        self.timeline.at(detected, self._failed, transfer, error)
        self.timeline.at(end, self._over, transfer, bits, kind, end)

    def _overhear(self, transfer: _Transfer) -> None:
        """Deliver an unacknowledged frame to controllers that only listen: they do not see the error flag."""
        reception = Reception(self.timeline, transfer.frame, self.timeline.now())
        for node in transfer.silent:
            if node.concerned(wire_identifier(transfer.frame)):
                node.receive(reception)

    def _failed(self, transfer: _Transfer, error: ErrorFrame) -> None:
        now = self.timeline.now()
        sent = {request.owner: request.frame for request in transfer.requests}
        receivers = transfer.receivers
        for request in list(transfer.requests):
            request.owner.fail(request, error.kind, now)
        for node in receivers:
            node.disturb(1)
        silent = () if error.unseen else transfer.silent
        for node in (*sent, *receivers, *silent):
            if node.on_bus_error is not ignore:
                self._show_error(transfer, error, node, sent.get(node))

    def _show_error(self, transfer: _Transfer, error: ErrorFrame, node: CanController, sent: AnyFrame | None) -> None:
        """Tell a controller of an error frame. If it has not detected the error itself, the error flag is one to it."""
        wire, bit, kind = wire_bits(transfer.frame), len(error.bus), error.kind
        if node not in error.by and sent and error.flag == "0":  # it sees a dominant bit where it sends a recessive one
            bit, kind = wire_bits(sent).index("1", bit) + 1, ErrorKind.BIT
        elif node not in error.by:
            bit += bits_until_noticed(error.bus, wire, error.flag)
            kind = ErrorKind.FORM if bit > len(wire) - TAIL else ErrorKind.STUFF
        seen = BusError(kind, bit, field_at(transfer.frame, bit), sending=sent is not None)
        node.see_error(seen, transfer.start + bit * self.bit)

    # A bus that is stuck at dominant

    def _dominate(self) -> None:
        """Let the dominant level of a free bus look like the start of a frame."""
        now = self.timeline.now()
        self._start = None
        self._plan += 1
        self._busy = True
        if self._recovery.remaining:
            self._recovery.busy(now)
        dominant = -((now - self._stuck_until) // self.bit)  # bits, rounded up
        bus = "0" * FLAG if dominant >= FLAG else "0" * dominant + "1" * FLAG
        receivers, silent = self._listeners.live.copy(), self._listeners.silent.copy()
        self._transfer = transfer = _Transfer(OtherFrame(0), [], (), receivers, silent, now, len(bus))
        self._destroy(transfer, bus, ErrorKind.STUFF, receivers)

    def _short(self, transfer: _Transfer) -> None:
        """Let the dominant level destroy the frame on the wire, if it lasts until a recessive bit."""
        frame, wire = transfer.frame, wire_bits(transfer.frame)
        first = (self.timeline.now() - transfer.start) // self.bit + 1  # the bit that is on the wire now
        acknowledge = len(wire) - _BITS_AFTER_ACK
        bit = next((n for n in range(first, len(wire) + 1) if wire[n - 1] == "1" and n != acknowledge), None)
        if bit is None:
            self.timeline.at(transfer.start + transfer.bits * self.bit, self._still_stuck)
        elif transfer.start + bit * self.bit <= self._stuck_until:
            bus = wire[: bit - 1] + "0"
            if field_at(frame, bit) not in ARBITRATION_FIELDS:
                self._destroy(transfer, bus, ErrorKind.BIT, transfer.owners)
                return
            for request in transfer.requests:
                self.statistics.add_lost(request.owner.name, frame)
                request.owner.lose_arbitration(request, transfer.start + bit * self.bit)
            transfer.receivers = [*transfer.receivers, *transfer.owners]
            transfer.requests = []
            bus += "0" * bits_until_noticed(bus, wire, "0")
            self._destroy(transfer, bus, ErrorKind.STUFF, transfer.receivers)

    def _still_stuck(self) -> None:
        if self._transfer is None and self._stuck_until > self.timeline.now():
            self._dominate()

    def _extend(self, transfer: _Transfer, error: ErrorKind, flags_end: int) -> None:
        """Extend an error frame until the bus is recessive again."""
        bits = -((transfer.start - self._stuck_until) // self.bit) + DELIMITER
        end = transfer.start + bits * self.bit
        self.timeline.at(end, self._over, transfer, bits, error, end)
        owners = transfer.owners
        for node in self._listeners.live.copy():
            if node not in owners:  # a dominant bit right after its error flag
                node.disturb(8)
        self.timeline.at(flags_end + DELIMITER * self.bit, self._count_stuck, owners)

    def _count_stuck(self, owners: list[CanController]) -> None:
        """Count 8 more dominant bits after the error flags, as long as that changes a state."""
        now, live = self.timeline.now(), self._listeners.live.copy()
        if now > self._stuck_until:
            return
        for node in live:
            if node in owners:
                node.confinement.count(transmit=8)
            elif not node.confinement.passive:
                node.disturb(8)
        if any(node in owners or not node.confinement.passive for node in self._listeners.live):
            self.timeline.at(now + DELIMITER * self.bit, self._count_stuck, owners)

    def _node_died(self, transfer: _Transfer, controller: CanController) -> None:
        """Leave a controller out of the frame that is on the wire."""
        sent = -((transfer.start - self.timeline.now()) // self.bit)  # bits so far, rounded up
        before = len(transfer.requests)
        transfer.requests = [request for request in transfer.requests if request.owner is not controller]
        self._leave_out(transfer, controller)
        if transfer.destroyed:
            return
        wire = wire_bits(transfer.frame)
        if before and not transfer.requests and sent < transfer.bits - TAIL:
            bus = wire[:sent]
            bus += "1" * bits_until_noticed(bus, wire, "1")
            self._destroy(transfer, bus, ErrorKind.STUFF, transfer.receivers)
        elif transfer.requests and not transfer.receivers and sent < transfer.bits - _BITS_AFTER_ACK:
            self._destroy(transfer, wire[:-_BITS_AFTER_ACK], ErrorKind.ACK, transfer.owners)
