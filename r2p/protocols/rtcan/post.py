"""The node's three mailboxes, and what becomes of the messages that pass through them.

What is not sent goes back to the queue: that is how a one-shot controller gives every try a fresh laxity.
"""

from collections import Counter
from collections.abc import Callable, Hashable

import msgspec

from r2p.codecs import rtcan
from r2p.codecs.rtcan import Frame
from r2p.protocols.rtcan.events import NEVER, Action, Done, Fate, Mailbox, Outcome, Transmit, Withdraw
from r2p.protocols.rtcan.laxity import LaxityQueue, Outgoing
from r2p.protocols.rtcan.periodic import Periodic

_ERRORS = 8
"""Bus errors after which a message is given up."""


class Sync(msgspec.Struct, frozen=True):
    """Stands for the sync frame in its mailbox."""


class FirstSync(msgspec.Struct, frozen=True):
    """Stands for the sync frame that makes a node the master: who is to be told what became of it, and when."""

    done: Callable[[int, Outcome, int], None]


class Gone(msgspec.Struct, frozen=True):
    """Stands for a frame whose message was discarded."""


_HRT, _SRT, _NRT = Mailbox  # Python 3.11 takes its time to find a member of an enum
_SENT, _UNKNOWN, _LOST, _ERROR = Outcome.SENT, Outcome.UNKNOWN, Outcome.LOST, Outcome.ERROR
_ALL_SENT = Fate.SENT
SYNC = Sync()
GONE = Gone()
Item = Outgoing | Periodic | Sync | FirstSync | Gone


class Post:
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

    def hand_over(self, message: Outgoing, frame: Frame, first: int, last: int) -> None:
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
            if isinstance(item, Outgoing):
                item.recalled = True

    def discard(self) -> list[Outgoing]:
        """Forget everything that waits; it comes back."""
        for mailbox in _SRT, _NRT:
            if self.boxes[mailbox] is not None:
                self.boxes[mailbox] = GONE
        return self._queue.clear()

    def expire(self, now: int) -> None:
        """Drop what is overdue."""
        for message in self._queue.expire(now):
            self.report(message.handle, Fate.OVERDUE, missed=True, at=now)

    def confirm(self, now: int, message: Outgoing, outcome: Outcome, at: int, *, slotted: bool) -> None:
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

    def _failed(self, now: int, message: Outgoing, at: int) -> None:
        self._counts["bus errors"] += 1
        message.errors += 1
        if message.errors > _ERRORS:
            self._queue.give_up(message)
            self.report(message.handle, Fate.FAILED, missed=message.deadline != NEVER, at=at)
            return
        hold = now + self._pause()
        self._held = hold if self._held == NEVER else max(self._held, hold)
        self._queue.put_back(message, hold)
