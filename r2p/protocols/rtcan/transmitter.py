"""What goes out, and when: the node's three mailboxes, in the slots of the cycle or, without a cycle, at once.

In a reserved slot only its owner sends. In a free one the message of the least laxity is tried, chosen anew in every
slot. Nothing starts unless it ends in its slot: what comes too late stays in the queue (PROTOCOL.md 6).
"""

import enum
from collections import Counter
from collections.abc import Callable, Hashable

import msgspec

from r2p.codecs import management, rtcan
from r2p.codecs.rtcan import FRAME_MAX, INTERMISSION, Frame
from r2p.protocols.rtcan.cycle import HOLDOVER, NO_SLOT, Cycle, CycleState
from r2p.protocols.rtcan.events import LONG_AGO, NEVER, Action, Done, Due, Fate, Mailbox, Outcome, Transmit, Withdraw
from r2p.protocols.rtcan.plan import PeriodicMessage, SlotPlan
from r2p.protocols.rtcan.queue import LaxityQueue, QueuedMessage

# The node's three mailboxes, and what becomes of the messages that pass through them.


_ERRORS = 8
"""Bus errors after which a message is given up."""


class CyclicSync(msgspec.Struct, frozen=True):
    """Stands for the sync frame in its mailbox."""


class FirstSync(msgspec.Struct, frozen=True):
    """Stands for the sync frame that makes a node the master: who is to be told what became of it, and when."""

    done: Callable[[int, Outcome, int], None]


class Gone(msgspec.Struct, frozen=True):
    """Stands for a frame whose message was discarded."""


_HRT, _SRT, _NRT = Mailbox  # Python 3.11 takes its time to find a member of an enum
_SENT, _UNKNOWN, _LOST, _ERROR = Outcome.SENT, Outcome.UNKNOWN, Outcome.LOST, Outcome.ERROR
_ALL_SENT = Fate.SENT
SYNC = CyclicSync()
GONE = Gone()
Item = QueuedMessage | PeriodicMessage | CyclicSync | FirstSync | Gone


class Mailboxes:
    """What is with the port: `boxes` has for each mailbox the owner of the frame in it.

    `pause()` gives ns to wait after a bus error; `due` is when to call `fill` on its own account.
    """

    def __init__(self, queue: LaxityQueue, out: list[Action], counts: Counter[str], pause: Callable[[], int]) -> None:
        self.boxes: list[Item | None] = [None, None, None]
        self.idle = True
        """Whether no frame of the queue is with the port."""
        self._queue = queue
        self._out = out
        self._counts = counts
        self._pause = pause
        self._held = NEVER

    @property
    def due(self) -> int:
        return min(self._queue.next_expiry, self._held)

    def put(self, item: Item, frame: Frame, mailbox: Mailbox, first: int, last: int) -> None:
        """Hand over a frame, to start between two instants."""
        self.boxes[mailbox] = item
        self.idle = self.idle and mailbox is _HRT
        self._out.append(Transmit(frame, mailbox, first, last))

    def take(self, mailbox: Mailbox) -> Item | None:
        """The port has done with the frame in this mailbox: empty it, and return whose it was."""
        boxes = self.boxes
        item, boxes[mailbox] = boxes[mailbox], None
        self.idle = boxes[_SRT] is None and boxes[_NRT] is None
        return item

    def reset(self) -> None:
        """The port has lost all frames."""
        self.boxes = [None, None, None]
        self.idle = True

    def hand_over(self, message: QueuedMessage, frame: Frame, first: int, last: int) -> None:
        """Hand over a frame of the queue."""
        self.put(message, frame, _NRT if frame.id >> 23 == rtcan.NRT else _SRT, first, last)

    def fill(self, now: int) -> None:
        """Without slots: hand over one frame of each class."""
        if self._held <= now:
            self._held = NEVER
        if not len(self._queue):
            return
        self.expire(now)
        if self.boxes[_SRT] is None:
            message = self._queue.best(now, nrt=False)
            if message is not None:
                self.hand_over(message, self._queue.take(message, now), now, message.expiry)
        if self.boxes[_NRT] is None:
            message = self._queue.best_nrt(now)
            if message is not None:
                self.hand_over(message, self._queue.take(message, now), now, NEVER)

    def withdraw(self) -> None:
        """Take back what has not started."""
        for mailbox in Mailbox:
            item = self.boxes[mailbox]
            if item is not None:
                self._out.append(Withdraw(mailbox))
            if isinstance(item, QueuedMessage):
                item.recalled = True

    def discard(self) -> list[QueuedMessage]:
        """Forget everything that waits; it comes back."""
        for mailbox in _SRT, _NRT:
            if self.boxes[mailbox] is not None:
                self.boxes[mailbox] = GONE
        return self._queue.clear()

    def expire(self, now: int) -> None:
        """Drop what is overdue."""
        for message in self._queue.expire(now):
            self.report(message.handle, Fate.OVERDUE, missed=True, at=now)

    def confirm(self, now: int, message: QueuedMessage, outcome: Outcome, at: int, *, slotted: bool) -> None:
        """The port says what became of a frame of the queue."""
        if outcome is _SENT or outcome is _UNKNOWN:
            message.unknown = message.unknown or outcome is _UNKNOWN
            if self._queue.sent(message):
                fate = Fate.UNKNOWN if message.unknown else _ALL_SENT
                self.report(message.handle, fate, missed=at > message.deadline, at=at)
        elif outcome is _ERROR:
            self._failed(now, message, at)
        else:
            if outcome is _LOST:
                self._counts["arbitration lost"] += 1
            elif slotted and not message.recalled:
                self._counts["late_to_slot"] += 1
            message.recalled = False
            self._queue.put_back(message)

    def report(self, handle: Hashable, fate: Fate, *, missed: bool, at: int) -> None:
        """A message is through, or given up."""
        if missed:
            self._counts["missed"] += 1
        if handle is not None:
            self._out.append(Done(handle, fate, missed, at))

    def _failed(self, now: int, message: QueuedMessage, at: int) -> None:
        self._counts["bus errors"] += 1
        message.errors += 1
        if message.errors > _ERRORS:
            self._queue.give_up(message)
            self.report(message.handle, Fate.FAILED, missed=message.deadline != NEVER, at=at)
            return
        hold = now + self._pause()
        self._held = hold if self._held == NEVER else max(self._held, hold)
        self._queue.put_back(message, hold)


# transmitter


_SURE = 10  # cycles
_CLOSE = 5  # bits between the hand-over and the last moment


class Mode(enum.Enum):
    """How the node may use the bus."""

    SILENT = "silent"
    FREE = "without slots"
    SLOTTED = "in slots"


_FREE, _SLOTTED = Mode.FREE, Mode.SLOTTED  # Python 3.11 takes its time to find a member of an enum
_LEADING = CycleState.LEADING
_HRT = Mailbox.HRT
_SENT, _UNKNOWN = Outcome.SENT, Outcome.UNKNOWN


class SlotTransmitter:
    """Fills the mailboxes. `due` says when to call `poll`.

    `latency`: ns from handing over a frame to its start. `coarse`: slots in a row that are free count as one, for
    ports that can't hit a slot. `turn(now)` is called when a cycle is over.
    """

    def __init__(
        self,
        cycle: Cycle,
        queue: LaxityQueue,
        agenda: SlotPlan,
        post: Mailboxes,
        out: list[Action],
        counts: Counter[str],
        turn: Callable[[int], None],
        *,
        latency: int = 0,
        coarse: bool = False,
    ) -> None:
        self.mode = Mode.SILENT
        self.due = NEVER
        self._cycle = cycle
        self._slots, self._slot, self._bit = cycle.timing.slots, cycle.timing.slot, cycle.timing.bit
        self._queue = queue
        self._agenda = agenda
        self._post = post
        self._out = out
        self._counts = counts
        self._turn = turn
        self._latency = latency
        self._coarse = coarse
        self._periodics: list[PeriodicMessage] = []
        self._done = 0
        self._tried = 0  # the last slot in which nothing more can be tried
        self._end = 0  # of the cycle: for a slave when no sync can come any more that would begin the next one
        self._sync = Frame(0, b"")
        self._confirmed = 0  # cycles in a row whose mask had our slots
        self._doubted = 0
        bit = self._bit
        # A try now would come too late for the slots before `now + ahead`; a coarse port may still try in that one.
        self._ahead = latency - (self._slot if coarse else bit)
        self._close = _CLOSE * bit
        self._longest = [(rtcan.frame_bits_max(size) + INTERMISSION) * bit for size in range(FRAME_MAX + 1)]  # ns

    # What the engine tells

    def add(self, periodic: PeriodicMessage) -> None:
        """There is one more periodic message."""
        self._periodics.append(periodic)

    def withdraw_management(self, id8: int, kind: int) -> None:
        """Management of this type that waits is not true any more."""
        self._queue.withdraw(
            rtcan.message_id(rtcan.MANAGEMENT, id8), lambda each: management.type_of(each.payload) == kind
        )

    def remove(self, periodic: PeriodicMessage) -> None:
        """There is one less."""
        self._periodics.remove(periodic)
        self._agenda.changed()
        if self._post.boxes[_HRT] is periodic:
            self._post.boxes[_HRT] = GONE

    def enter(self, now: int, mode: Mode) -> None:
        """Use the bus in another way from now on."""
        if mode is self.mode:
            return
        if mode is Mode.SILENT or self.mode is _FREE:
            self._post.withdraw()
        self.mode = mode
        self.reschedule(now)

    def turned(self, now: int) -> None:
        """A cycle has begun, at `Cycle.reference`; nothing of it is done yet."""
        self._done = self._tried = 0
        self._agenda.turn(self._cycle.counter, self._periodics)
        if self._agenda.own:
            self._check_mask(self._agenda.own)
        self.aligned(now)

    def aligned(self, now: int) -> None:
        """`Cycle.reference` is another instant than before; the cycle is the same."""
        cycle = self._cycle
        self._end = cycle.end if cycle.state is _LEADING else cycle.reference + (self._slots + 1) * self._slot
        self._plan(now)

    def reschedule(self, now: int) -> None:
        """There may be something new to send."""
        if self.mode is _FREE:
            self._post.fill(now)
            self.due = self._post.due
        elif self.mode is _SLOTTED or self._cycle.running:
            self._plan(now)
        else:
            self.due = NEVER

    def sync(self, now: int, frame: Frame) -> None:
        """The cycle begins with this sync frame."""
        start = self._cycle.reference
        last = start + self._slot - self._longest[FRAME_MAX]
        if now + self._latency > last or self._post.boxes[_HRT] is not None:
            self._counts["syncs not sent"] += 1
            return
        self._sync = frame
        self._post.put(SYNC, frame, _HRT, start, last)

    def found(self, first: FirstSync, frame: Frame, start: int) -> bool:
        """The first sync of a master. There are no slots yet: it may come late. False: an old frame is in the way."""
        if self._post.boxes[_HRT] is not None:
            return False
        self._post.put(first, frame, _HRT, start, NEVER)
        return True

    def fill(self, now: int, periodic: PeriodicMessage, payload: bytes | None) -> None:
        """The data of a periodic message that owns slots; None: nothing this time."""
        slot = periodic.waiting
        periodic.restart(payload)
        if slot is not None and payload is not None:
            current = self._cycle.slot_at(now + self._latency)
            self._send_periodic(now, periodic, 0, slot - self._cycle.number_of(0), current)

    def reset(self) -> None:
        """The bus is gone, and all frames with it."""
        self._post.reset()
        self.due = NEVER

    def poll(self, now: int) -> None:
        """The time has come for a slot, or for the next cycle."""
        while self.due <= now:
            if self.mode is _FREE:
                self.reschedule(now)
                return
            current = self._cycle.slot_at(now + self._latency)
            if now + self._latency >= self._end:
                self._run(now, self._slots, current)
                self._turn(now)
                if not self._cycle.running:  # a node that is silent stays so: nothing else has moved `due`
                    self.reschedule(now)
            else:
                self._run(now, current, current)
                self._plan(now)

    def confirm(self, now: int, mailbox: Mailbox, outcome: Outcome, at: int) -> None:
        """The port says what became of the frame in this mailbox, and when it was over."""
        item = self._post.take(mailbox)
        if isinstance(item, QueuedMessage):
            self._post.confirm(now, item, outcome, at, slotted=self.mode is _SLOTTED)
            if self.mode is not _SLOTTED:
                self.reschedule(now)
            elif self._queue.size:
                self._plan(now)
        elif isinstance(item, PeriodicMessage):
            self._confirm_periodic(now, item, outcome, at)
        elif item is SYNC:
            if outcome is _SENT:
                if self._cycle.state is _LEADING:
                    self._cycle.left(self._sync, at)
                    self._plan(now)
            else:
                self._counts["syncs not sent"] += 1
        elif isinstance(item, FirstSync):
            item.done(now, outcome, at)
        elif item is GONE:
            self.reschedule(now)
        else:
            self._counts["confirmed without need"] += 1

    # Slots

    def _check_mask(self, own: int) -> None:
        """A mask without slots that we own, which the last ones had, is rather forged than true.

        Then this cycle is like one without a sync, of which there may be three.
        """
        mask = self._cycle.mask
        if mask is None:
            return
        if not own & ~mask:
            self._confirmed, self._doubted = min(self._confirmed + 1, _SURE), 0
        elif self._confirmed == _SURE and self._doubted < HOLDOVER:
            self._doubted += 1
            self._counts["masks doubted"] += 1
            self._cycle.doubt()
        else:
            self._confirmed = 0

    def _plan(self, now: int) -> None:
        """Wake up for the next slot where there is something to do, or to send something, or for the next cycle."""
        cycle = self._cycle
        slot = self._agenda.next[self._done]
        if self._queue.size and self._post.idle and self.mode is _SLOTTED:
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
        """Do what is to be done in the slots up to one; it is slot `current` now."""
        agenda = self._agenda
        slot = agenda.next[self._done] if self.mode is _SLOTTED else NO_SLOT
        self._done = upto
        while slot <= upto:
            for periodic, lead in agenda.fills.get(slot, ()):
                if periodic.active:
                    self._ask(now, periodic, slot + lead)
            if slot in agenda.sends:
                periodic, fragment, asks = agenda.sends[slot]
                if periodic.active:
                    self._periodic_slot(now, periodic, fragment, asks, slot, current)
            slot = agenda.next[slot]
        if not self._coarse:
            self._tried = upto
        if self._queue.size and current == upto and self.mode is _SLOTTED:
            self._try(now, current)

    def _try(self, now: int, slot: int) -> None:
        """In a free slot: try the message of the least laxity."""
        if slot not in self._cycle.free or not self._post.idle:
            return
        self._post.expire(now)
        message = self._queue.best(now)
        if message is None:
            self._tried = slot
            return
        frame = self._queue.take(message, now)
        end = slot + 1
        while self._coarse and end in self._cycle.free:
            end += 1
        start = self._cycle.reference + slot * self._slot
        last = self._latest_start(now, frame, start + (end - slot) * self._slot)
        if now + self._latency > last:
            self._counts["late_to_slot"] += 1
            self._queue.put_back(message)
            self._tried = slot
            return
        self._post.hand_over(message, frame, start, last)

    def _latest_start(self, now: int, frame: Frame, end: int) -> int:
        """The last instant at which the frame surely ends in its slot. `end` is when that is over."""
        last = end - self._longest[len(frame.data)]
        close = last - now - self._latency < self._close
        return self._exact_latest_start(frame, end) if close else last

    def _exact_latest_start(self, frame: Frame, end: int) -> int:
        """As above, to the stuff bit. That is not cheap, unless the same frame is seen again."""
        bits = rtcan.frame_bits(frame.id, frame.data) + INTERMISSION
        return end - bits * self._bit

    # Periodic messages

    def _ask(self, now: int, periodic: PeriodicMessage, slot: int) -> None:
        if periodic.restart():
            self.abandon(now, periodic, "not sent in time")
        for message in self._queue.withdraw(periodic.message):  # from the time before it had slots
            self._post.report(message.handle, Fate.REPLACED, missed=False, at=now)
        self._out.append(Due(periodic.high, self._cycle.start_of(slot), True))

    def _periodic_slot(
        self, now: int, periodic: PeriodicMessage, fragment: int, asks: bool, slot: int, current: int
    ) -> None:
        if self._queue.waits(periodic.message):  # its frames and ours would mix
            self._counts["slots without data"] += fragment == 0
        elif asks:
            self._ask(now, periodic, slot)
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
        frame = Frame(periodic.message << 7 | periodic.fragments - 1 - fragment, payload[at : at + FRAME_MAX])
        start = self._cycle.reference + slot * self._slot
        last = self._exact_latest_start(frame, start + self._slot) if slot == current else LONG_AGO
        if mask is not None and not mask >> slot & 1:
            self.abandon(now, periodic, "not in the mask")
        elif self._post.boxes[_HRT] is not None:
            self.abandon(now, periodic, "mailbox full")
        elif now + self._latency > last:
            self._counts["late_to_slot"] += 1
            self.abandon(now, periodic, "too late for the slot")
        else:
            self._post.put(periodic, frame, _HRT, start, last)

    def abandon(self, now: int, periodic: PeriodicMessage, reason: str) -> None:
        """What waits of a periodic message will not be sent."""
        periodic.restart()
        self._counts["hrt " + reason] += 1
        self._post.report(periodic.handle, Fate.ABANDONED, missed=True, at=now)

    def _confirm_periodic(self, now: int, periodic: PeriodicMessage, outcome: Outcome, at: int) -> None:
        if periodic.payload is None:
            return  # abandoned meanwhile
        if outcome is not _SENT and outcome is not _UNKNOWN:
            self.abandon(now, periodic, outcome.value)
            return
        periodic.unknown = periodic.unknown or outcome is _UNKNOWN
        periodic.sent += 1
        if periodic.sent == periodic.fragments:
            fate = Fate.UNKNOWN if periodic.unknown else _ALL_SENT
            periodic.restart()
            self._post.report(periodic.handle, fate, missed=False, at=at)
