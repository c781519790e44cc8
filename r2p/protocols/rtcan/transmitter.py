"""The node's frames on their way out: three mailboxes, in the slots of the cycle or, without a cycle, at once.

In a reserved slot only its owner sends. In a free one the message of the least laxity is tried, chosen anew in every
slot. A frame starts only if it ends in its slot: a late one stays in the queue (PROTOCOL.md 6).

`Mailboxes` holds the port's frames, and settles their messages; `SlotTransmitter` decides on the next frame. Whether
the node may send at all is decided by `Engine._update_mode`.
"""

import enum
from collections.abc import Callable

import msgspec

from r2p.codecs import can_bits, rtcan
from r2p.codecs.can_bits import INTERMISSION
from r2p.codecs.management import Network
from r2p.codecs.rtcan import FRAME_MAX, LAXITY_SHIFT, Frame
from r2p.protocols.can_orders import Mailbox, Outcome, Transmit, Withdraw
from r2p.protocols.rtcan.cycle import HOLDOVER, NO_SLOT, CycleState
from r2p.protocols.rtcan.events import Due, EngineContext, Fate
from r2p.protocols.rtcan.leases import PeriodicMessage, SlotPlan
from r2p.protocols.rtcan.queue import LaxityQueue, QueuedMessage
from r2p.units import LONG_AGO, NEVER

_ERRORS = 8  # bus errors after which a message is given up
_PAUSE = 500_000  # ns after a bus error, before the same topic is tried again
_PAUSE_SPREAD = 8_000_000  # ns; two nodes that collided would else collide again
_MANAGEMENT_MAX = 128  # management messages that wait
_CONFIRMED = 10  # cycles in a row with the own slots in the mask, after which one without them is doubted
_CLOSE = 5  # bits between the hand-over and the last moment: then stuff bits are counted
# Python 3.11 is slow to find a member of an enum.
_HRT, _SRT, _NRT = Mailbox
_SENT, _UNKNOWN, _LOST, _ERROR = Outcome.SENT, Outcome.UNKNOWN, Outcome.LOST, Outcome.ERROR
_ALL_SENT = Fate.SENT
_LEADING = CycleState.LEADING


class Mode(enum.Enum):
    """The node's permission to use the bus."""

    SILENT = "silent"
    FREE = "without slots"
    SLOTTED = "in slots"


_SILENT, _FREE, _SLOTTED = Mode


class FirstSync(msgspec.Struct, frozen=True):
    """The sync frame that makes a node the master, planned for the instant `start` as that of cycle `counter`.

    `done(now, outcome, at)` gets its outcome, and the time of that.
    """

    frame: Frame
    start: int
    counter: int
    done: Callable[[int, Outcome, int], None]


class NoMessage(enum.Enum):
    """Marks in a mailbox for frames that belong to no message."""

    SYNC = "sync"
    DISCARDED = "its message was discarded"


_SYNC, _DISCARDED = NoMessage
Item = QueuedMessage | PeriodicMessage | FirstSync | NoMessage


class Mailboxes:
    """The port's frames: `boxes` has for each mailbox the owner of the frame in it."""

    def __init__(self, context: EngineContext, queue: LaxityQueue) -> None:
        self.boxes: list[Item | None] = [None, None, None]
        self.idle = True
        """True if the port has no frame of the queue."""
        self._context = context
        self._counts = context.counts
        self._actions = context.actions
        self._report = context.report
        self._queue = queue
        self._held = NEVER  # when a topic that had a bus error may be tried again

    @property
    def due(self) -> int:
        """Return when to call `fill`, if nothing else calls for it."""
        return min(self._queue.next_expiry, self._held)

    def put(self, item: Item, frame: Frame, mailbox: Mailbox, first: int, last: int) -> None:
        """Hand over a frame, to start between two instants."""
        self.boxes[mailbox] = item
        self.idle = self.idle and mailbox is _HRT
        self._actions.append(Transmit(frame, mailbox, first, last))

    def put_queued(self, message: QueuedMessage, frame: Frame, first: int, last: int) -> None:
        """Hand over a frame of the queue."""
        self.put(message, frame, _NRT if frame.id >> LAXITY_SHIFT == rtcan.NRT else _SRT, first, last)

    def empty(self, mailbox: Mailbox) -> Item | None:
        """Empty a mailbox whose frame is done; return the frame's owner."""
        boxes = self.boxes
        item, boxes[mailbox] = boxes[mailbox], None
        self.idle = boxes[_SRT] is None and boxes[_NRT] is None
        return item

    def reset(self) -> None:
        """Forget all frames, as the port has lost them."""
        self.boxes = [None, None, None]
        self.idle = True

    def fill(self, now: int) -> None:
        """Hand over one frame of each class, without slots."""
        if self._held <= now:
            self._held = NEVER
        if not self._queue.size:
            return
        self.expire(now)
        # A non real-time frame that loses arbitration must not keep a real-time one waiting: each has its mailbox.
        if self.boxes[_SRT] is None:
            message = self._queue.best(now, nrt=False)
            if message is not None:
                self.put_queued(message, self._queue.next_frame(message, now), now, message.expiry)
        if self.boxes[_NRT] is None:
            message = self._queue.best_nrt(now)
            if message is not None:
                self.put_queued(message, self._queue.next_frame(message, now), now, NEVER)

    def withdraw(self) -> None:
        """Take back all frames that have not started."""
        for mailbox in Mailbox:
            item = self.boxes[mailbox]
            if item is not None:
                self._actions.append(Withdraw(mailbox))
            if isinstance(item, QueuedMessage):
                item.recalled = True

    def discard(self) -> list[QueuedMessage]:
        """Empty the queue; return its messages."""
        for mailbox in _SRT, _NRT:
            if self.boxes[mailbox] is not None:
                self.boxes[mailbox] = _DISCARDED
        return self._queue.clear()

    def expire(self, now: int) -> None:
        """Drop overdue messages."""
        for message in self._queue.expire(now):
            self._report(message.handle, Fate.OVERDUE, missed=True, at=now)

    def confirm(self, now: int, message: QueuedMessage, outcome: Outcome, at: int, *, slotted: bool) -> None:
        """Settle a message by the outcome of one of its frames."""
        if outcome is _SENT or outcome is _UNKNOWN:  # not again if unknown: receivers would count a repeat, or a gap
            message.unknown = message.unknown or outcome is _UNKNOWN
            if self._queue.frame_sent(message):
                fate = Fate.UNKNOWN if message.unknown else _ALL_SENT
                self._report(message.handle, fate, missed=at > message.deadline, at=at)
        elif outcome is _ERROR:
            self._failed(now, message, at)
        else:
            if outcome is _LOST:
                self._counts["arbitration lost"] += 1
            elif slotted and not message.recalled:
                self._counts["late_to_slot"] += 1
            message.recalled = False
            self._queue.put_back(message)  # with a fresh laxity at the next try

    def _failed(self, now: int, message: QueuedMessage, at: int) -> None:
        self._counts["bus errors"] += 1
        message.errors += 1
        if message.errors > _ERRORS:
            self._queue.remove(message)
            self._report(message.handle, Fate.FAILED, missed=message.deadline != NEVER, at=at)
            return
        hold = now + _PAUSE + self._context.draw(_PAUSE_SPREAD)
        self._held = hold if self._held == NEVER else max(self._held, hold)
        self._queue.put_back(message, hold)


class SlotTransmitter:
    """Fills the mailboxes from the queue, the plan of the cycle, and with syncs. `due` says when to call `poll`.

    `next_cycle(now)` is called when a cycle is over.
    """

    def __init__(self, context: EngineContext, next_cycle: Callable[[int], None]) -> None:
        settings, cycle = context.settings, context.cycle
        self.mode = _SILENT
        self.due = NEVER
        self.queue = LaxityQueue(settings.capacity, _MANAGEMENT_MAX)
        self.plan = SlotPlan(context.timing)
        self.mailboxes = Mailboxes(context, self.queue)
        self._next_cycle = next_cycle
        self._cycle = cycle
        self._context = context
        self._slots, self._slot, self._bit = cycle.timing.slots, cycle.timing.slot, cycle.timing.bit
        self._actions = context.actions
        self._counts = context.counts
        self._report = context.report
        self._latency = settings.transmit_latency
        self._coarse = settings.coarse
        self._done = 0  # the last slot whose part of the plan is done
        self._tried = 0  # the last slot in which nothing more can be tried
        self._end = 0  # of the cycle; for a slave when a sync that begins the next one can no longer come
        self._sync = Frame(0, b"")
        self._confirmed = 0  # cycles in a row whose mask had the own slots
        self._doubted = 0
        # A try now would be too late for the slots before `now + ahead`; a coarse port may still try in that one.
        self._ahead = self._latency - (self._slot if self._coarse else self._bit)
        self._close = _CLOSE * self._bit
        self._longest = [(can_bits.frame_bits_max(n) + INTERMISSION) * self._bit for n in range(FRAME_MAX + 1)]  # ns

    # Messages

    def withdraw_network(self, id8: int) -> None:
        """Drop a NETWORK message in the queue, because it is out of date."""
        message = rtcan.message_id(rtcan.MANAGEMENT, id8)
        self.queue.withdraw(message, lambda each: each.subject is Network)

    def forget(self, periodic: PeriodicMessage) -> None:
        """Stop sending a periodic message that has ended."""
        self.plan.invalidate()
        if self.mailboxes.boxes[_HRT] is periodic:  # it may be on the bus: the port still has to confirm it
            self.mailboxes.boxes[_HRT] = _DISCARDED

    def fill(self, now: int, periodic: PeriodicMessage, payload: bytes | None) -> None:
        """Send the data of a periodic message that owns slots; None: nothing this time."""
        slot = periodic.waiting
        periodic.restart(payload)
        if slot is not None and payload is not None:
            current = self._cycle.slot_at(now + self._latency)
            self._send_periodic(now, periodic, 0, slot - self._cycle.number_of(0), current)

    def abandon(self, now: int, periodic: PeriodicMessage, reason: str) -> None:
        """Give up the current occurrence of a periodic message."""
        periodic.restart()
        self._counts["hrt " + reason] += 1
        self._report(periodic.handle, Fate.ABANDONED, missed=True, at=now)

    def send_sync(self, now: int, frame: Frame) -> None:
        """Begin the cycle with this sync frame."""
        start = self._cycle.reference
        last = start + self._slot - self._longest[FRAME_MAX]  # a sync beyond slot 0 would hit a slot of another node
        if now + self._latency > last or self.mailboxes.boxes[_HRT] is not None:
            self._counts["syncs not sent"] += 1
            return
        self._sync = frame
        self.mailboxes.put(_SYNC, frame, _HRT, start, last)

    def send_first_sync(self, first: FirstSync) -> bool:
        """Send a new master's first sync, which may be late because no slots exist yet. Return False if it can't."""
        if self.mailboxes.boxes[_HRT] is not None:
            return False
        self.mailboxes.put(first, first.frame, _HRT, first.start, NEVER)
        return True

    # The mode, the cycle and time

    def set_mode(self, now: int, mode: Mode) -> None:
        """Use the bus in this way from now on."""
        if mode is self.mode:
            return
        if mode is _SILENT or self.mode is _FREE:
            self.mailboxes.withdraw()  # what was handed over without slots may start in a slot of another node
        self.mode = mode
        self.reschedule(now)

    def begin_cycle(self, now: int) -> None:
        """Begin the plan of a cycle, which has started at `Cycle.reference`."""
        self._done = self._tried = 0
        self.plan.begin_cycle(self._cycle.counter)
        if self.plan.own:
            self._check_mask(now, self.plan.own)
        self.realign(now)

    def realign(self, now: int) -> None:
        """Reckon with another `Cycle.reference` than before; the cycle is the same."""
        cycle = self._cycle
        self._end = cycle.end if cycle.state is _LEADING else cycle.reference + (self._slots + 1) * self._slot
        self._schedule(now)

    def reschedule(self, now: int) -> None:
        """Work out again what is due, as there may be something new to send."""
        if self.mode is _FREE:
            self.mailboxes.fill(now)
            self.due = self.mailboxes.due
        elif self.mode is _SLOTTED or self._cycle.running:
            self._schedule(now)
        else:
            self.due = NEVER

    def reset(self) -> None:
        """Forget all frames, as the bus is gone."""
        self.mailboxes.reset()
        self.due = NEVER

    def poll(self, now: int) -> None:
        """Do what is due: a slot, or the next cycle."""
        while self.due <= now:
            if self.mode is _FREE:
                self.reschedule(now)
                return
            current = self._cycle.slot_at(now + self._latency)
            if now + self._latency >= self._end:
                self._run(now, self._slots, current)  # slot 0 of the next cycle may ask for data ahead
                self._next_cycle(now)
                if not self._cycle.running:  # a node that is silent stays so: nothing else has moved `due`
                    self.reschedule(now)
            else:
                self._run(now, current, current)
                self._schedule(now)

    def confirm(self, now: int, mailbox: Mailbox, outcome: Outcome, at: int) -> None:
        """Note the outcome of the frame in this mailbox, and its time."""
        item = self.mailboxes.empty(mailbox)
        if isinstance(item, QueuedMessage):
            self.mailboxes.confirm(now, item, outcome, at, slotted=self.mode is _SLOTTED)
            if self.mode is not _SLOTTED:
                self.reschedule(now)
            elif self.queue.size:
                self._schedule(now)
        elif isinstance(item, PeriodicMessage):
            self._confirm_periodic(now, item, outcome, at)
        elif item is _SYNC:
            self._confirm_sync(now, outcome, at)
        elif isinstance(item, FirstSync):
            item.done(now, outcome, at)
        elif item is _DISCARDED:
            self.reschedule(now)
        else:
            self._counts["confirmed without need"] += 1

    def _confirm_sync(self, now: int, outcome: Outcome, at: int) -> None:
        sent = outcome is _SENT
        if not sent:
            self._counts["syncs not sent"] += 1
        if self._cycle.state is _LEADING:
            of_this_cycle = self._cycle.on_sync_sent(self._sync, at) if sent else True
            if self._context.report_syncs and of_this_cycle:
                self._context.report_sync(self._sync, at if sent else 0)
            if sent:
                self._schedule(now)

    # Slots

    def _check_mask(self, now: int, own: int) -> None:
        """Doubt a mask without own slots of the last ones: it is more likely forged than true.

        A cycle with such a mask counts as one without a sync, of which there may be three. One more is reported.
        """
        mask = self._cycle.mask
        if mask is None:
            return
        if not own & ~mask:
            self._confirmed, self._doubted = min(self._confirmed + 1, _CONFIRMED), 0
        elif self._confirmed == _CONFIRMED and self._doubted < HOLDOVER:
            self._doubted += 1
            self._counts["masks doubted"] += 1
            self._cycle.doubt()
        else:
            if self._confirmed == _CONFIRMED:
                self._context.sync_check.on_unreserved(now, self._doubted + 1)
            self._confirmed = 0

    def _schedule(self, now: int) -> None:
        """Set `due` to the next slot with something to do, or a free one to send in, or to the next cycle.

        Runs after each frame and in each slot that is used: locals, and no helper functions.
        """
        cycle = self._cycle
        slot = self.plan.next[self._done]
        if self.queue.size and self.mailboxes.idle and self.mode is _SLOTTED:
            over = cycle.slot_at(now + self._ahead)
            if over < self._tried:
                over = self._tried
            if over < self._slots and cycle.next_free[over] < slot:
                slot = cycle.next_free[over]
        at = cycle.reference + slot * self._slot
        if at > self._end:
            at = self._end
        self.due = at - self._latency

    def _run(self, now: int, upto: int, current: int) -> None:
        """Carry out the plan of all slots up to one; it is slot `current` now."""
        plan = self.plan
        slot = plan.next[self._done] if self.mode is _SLOTTED else NO_SLOT
        self._done = upto
        while slot <= upto:
            for periodic, lead in plan.fills.get(slot, ()):
                if periodic.active:
                    self._ask_for_data(now, periodic, slot + lead)
            if slot in plan.sends:
                periodic, fragment, asks = plan.sends[slot]
                if periodic.active:
                    self._periodic_slot(now, periodic, fragment, asks, slot, current)
            slot = plan.next[slot]
        if not self._coarse:
            self._tried = upto
        if self.queue.size and current == upto and self.mode is _SLOTTED:
            self._try(now, current)

    def _try(self, now: int, slot: int) -> None:
        """Try the message of the least laxity, if this slot is free."""
        if slot not in self._cycle.free or not self.mailboxes.idle:
            return
        self.mailboxes.expire(now)  # nothing overdue may use the slot
        message = self.queue.best(now)
        if message is None:
            self._tried = slot
            return
        frame = self.queue.next_frame(message, now)
        end = slot + 1
        # A port that can't hit a slot may start late: in the free slots after this one that does no harm.
        while self._coarse and end in self._cycle.free:
            end += 1
        start = self._cycle.reference + slot * self._slot
        last = self._latest_start(now, frame, start + (end - slot) * self._slot)
        if now + self._latency > last:
            self._counts["late_to_slot"] += 1
            self.queue.put_back(message)
            self._tried = slot
            return
        self.mailboxes.put_queued(message, frame, start, last)

    def _latest_start(self, now: int, frame: Frame, end: int) -> int:
        """Return the last start at which the frame surely ends in its slot, which ends at `end`."""
        last = end - self._longest[len(frame.data)]
        close = last - now - self._latency < self._close
        return self._exact_latest_start(frame, end) if close else last

    def _exact_latest_start(self, frame: Frame, end: int) -> int:
        """Return the same as above, to the stuff bit. Expensive, except for a repeated frame."""
        bits = can_bits.frame_bits(frame.id, frame.data) + INTERMISSION
        return end - bits * self._bit

    # Periodic messages

    def _ask_for_data(self, now: int, periodic: PeriodicMessage, slot: int) -> None:
        if periodic.restart():
            self.abandon(now, periodic, "not sent in time")
        for message in self.queue.withdraw(periodic.message):  # from the time before it had slots
            self._report(message.handle, Fate.REPLACED, missed=False, at=now)
        self._actions.append(Due(periodic.high, self._cycle.start_of(slot), True))

    def _periodic_slot(
        self, now: int, periodic: PeriodicMessage, fragment: int, asks: bool, slot: int, current: int
    ) -> None:
        if self.queue.holds(periodic.message):  # from the time before it had slots: the frames of the two would mix
            self._counts["slots without data"] += fragment == 0
        elif asks:
            self._ask_for_data(now, periodic, slot)
            periodic.waiting = self._cycle.number_of(slot)
        elif periodic.payload is not None and periodic.sent == fragment:
            self._send_periodic(now, periodic, fragment, slot, current)
        elif periodic.payload is not None:
            self.abandon(now, periodic, "fragment not confirmed in time")
        elif fragment == 0:
            self._counts["slots without data"] += 1

    def _send_periodic(self, now: int, periodic: PeriodicMessage, fragment: int, slot: int, current: int) -> None:
        payload, mask = periodic.payload, self._cycle.mask
        assert payload is not None
        at = fragment * FRAME_MAX
        identifier = rtcan.encode_identifier(rtcan.HRT, periodic.message, periodic.frames - 1 - fragment)
        frame = Frame(identifier, payload[at : at + FRAME_MAX])
        start = self._cycle.reference + slot * self._slot
        # To the stuff bit, as there is no other slot for it; a passed slot is missed.
        last = self._exact_latest_start(frame, start + self._slot) if slot == current else LONG_AGO
        if mask is not None and not mask >> slot & 1:
            self.abandon(now, periodic, "not in the mask")
        elif self.mailboxes.boxes[_HRT] is not None:
            self.abandon(now, periodic, "mailbox full")
        elif now + self._latency > last:
            self._counts["late_to_slot"] += 1
            self.abandon(now, periodic, "too late for the slot")
        else:
            self.mailboxes.put(periodic, frame, _HRT, start, last)

    def _confirm_periodic(self, now: int, periodic: PeriodicMessage, outcome: Outcome, at: int) -> None:
        if periodic.payload is None:
            return  # abandoned meanwhile
        if outcome is not _SENT and outcome is not _UNKNOWN:
            self.abandon(now, periodic, outcome.value)
            return
        periodic.unknown = periodic.unknown or outcome is _UNKNOWN
        periodic.sent += 1
        if periodic.sent == periodic.frames:
            fate = Fate.UNKNOWN if periodic.unknown else _ALL_SENT
            periodic.restart()
            self._report(periodic.handle, fate, missed=False, at=at)
