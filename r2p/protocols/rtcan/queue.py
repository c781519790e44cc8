"""The queue of outgoing soft and non real-time messages: the least laxity goes first (PROTOCOL.md 6, thesis 4.3.5).

Messages of one topic wait in a FIFO of their own, and only the first one of each FIFO competes: so no two messages of
a topic ever interleave. A FIFO is as urgent as the most urgent message in it. The FIFOs are sorted by deadline; those
that have the same laxity at this moment (whole ms) are next to each other, and the oldest of them goes first.

Laxity is computed anew at every try: `next_frame` changes no order, only `frame_sent` does.

Management has a `floor`, the least laxity that it has while it is overdue. That of discovery is `DISCOVERY`, behind
everything else that is overdue: else twenty modules that have too much to say would fill all free slots, and those with
low ids would keep the leases of the others out. That of requests for slots is `REQUEST`, between these two: else the
requests of nodes with low ids would keep back the answers of a master with a high one.
"""

from bisect import bisect_left, insort
from collections import deque
from collections.abc import Callable, Hashable, Iterator

import msgspec

from r2p.codecs import rtcan
from r2p.codecs.rtcan import FIRST_MARK, FRAME_MAX, LAXITY_SHIFT, MESSAGE_SHIFT, NRT, SRT_MAX, SRT_MIN, Frame
from r2p.units import LONG_AGO, MILLISECOND, NEVER, SECOND

REQUEST = rtcan.SRT_MIN + 1
PRESENCE = rtcan.SRT_MIN + 2
DISCOVERY = rtcan.SRT_MIN + 3
"""The least laxities of requests for slots, of presences and of other discovery, until they are `_STARVED`."""
_STARVED = (
    2 * SECOND
)  # ns overdue, less than a lease; then events that are overdue and not dropped have had the bus for long enough

_FIRST = 1 << 62  # more than any count of messages: taken off the order of management, which goes before the others


class QueuedMessage(msgspec.Struct, eq=False):
    """A waiting message. `deadline` NEVER: non real-time. `drop`: given up when overdue, unless it has started.

    Once its first frame is sent it is always finished: firmware of 2014 loses the next message as well when the end of
    one is missing. `recalled`: its frame was withdrawn, as the node uses the bus in another way from now on. `floor`:
    its least laxity while it is overdue, unless it is `starved`. `subject`: what it is about; a later one about the
    same makes it needless. `marked`: so is its first frame, as frames of management without its zeros are.
    """

    message: int
    payload: bytes
    deadline: int = NEVER
    drop: bool = True
    handle: Hashable = None
    order: int = 0
    frames: int = 0
    sent: int = 0
    errors: int = 0
    unknown: bool = False
    recalled: bool = False
    floor: int = SRT_MIN
    starved: bool = False
    subject: Hashable = None
    marked: bool = False

    @property
    def expiry(self) -> int:
        """Return when the message is given up."""
        return NEVER if self.sent or not self.drop else self.deadline


class _MessageFifo(msgspec.Struct, eq=False):
    """The messages of one topic. `busy`: the port has a frame of the first one; `held`: no try before this instant.
    `deadline`, `order`, `expiry` and `floor` are the least of its messages.
    """

    waiting: deque[QueuedMessage]
    deadline: int = NEVER
    order: int = 0
    expiry: int = NEVER
    busy: bool = False
    held: int = LONG_AGO
    floor: int = SRT_MIN

    def laxity(self, now: int) -> int:
        """Return the laxity of its next frame."""
        if self.deadline == NEVER:
            return NRT
        left = self.deadline - now
        return rtcan.srt_laxity(left if self.waiting[0].starved else max(left, self.floor * MILLISECOND))


class LaxityQueue:
    """At most `capacity` messages, and `depth` of them of one topic."""

    def __init__(self, capacity: int = 256, depth: int = 64) -> None:
        self.only: int | None = None
        """Message id of the only topic that may send, or None: all may."""
        self._capacity = capacity
        self._depth = depth
        self._fifos: dict[int, _MessageFifo] = {}  # by message id
        self._sorted: list[tuple[int, int, _MessageFifo]] = []  # by deadline and order
        self.starved_apart = MILLISECOND
        """Ns between two messages of discovery that are starved: those of all nodes together must not stop leases."""
        self._starved_from = LONG_AGO
        self._eased: _MessageFifo | None = None  # the FIFO of this node's management, while all of it has a floor
        self.size = 0
        """The number of waiting messages."""
        self._count = 0
        self._expiry = NEVER  # not later than the first message to drop, so that `expire` seldom looks at all FIFOs

    def put(self, message: QueuedMessage, *, urgent: bool = False, management: bool = False) -> bool:
        """Queue a message; `urgent`: before those of its topic that have not started and may wait longer; and there
        is room for as many more of these. False: full.

        `management` does not count for the capacity, and goes before others of the same laxity, as on the bus: else
        events that are overdue but not dropped would stop leases and discovery. Raises `MessageError` for payloads that
        RTCAN can't carry.
        """
        message.frames = rtcan.fragment_count(len(message.payload))
        fifo = self._fifos.get(message.message)
        # `depth`: one topic alone must not fill the queue.
        full = fifo is not None and len(fifo.waiting) >= self._depth * (2 if urgent else 1)
        if full or (self.size >= self._capacity and not management):
            return False
        self._count += 1
        message.order = self._count - (_FIRST if management else 0)
        if fifo is None:
            fifo = self._fifos[message.message] = _MessageFifo(deque((message,)))
            self._enter(fifo)
        elif urgent:
            self._leave(fifo)
            fifo.deadline = min(fifo.deadline, message.deadline)
            fifo.waiting.insert(self._place(fifo, message), message)
            self._enter(fifo)
        else:
            self._append(fifo, message)
        self.size += 1
        return True

    def expire(self, now: int) -> list[QueuedMessage]:
        """Remove and return overdue messages that are to be dropped; one whose frame is with the port stays."""
        if now < self._expiry:
            return []
        dropped: list[QueuedMessage] = []
        for fifo in [fifo for fifo in self._fifos.values() if fifo.expiry <= now]:
            first = fifo.waiting[0] if fifo.busy else None
            gone = [each for each in fifo.waiting if each.expiry <= now and each is not first]
            if gone:
                dropped += gone
                self._drop(fifo, gone)
        self._expiry = min((fifo.expiry for fifo in self._fifos.values() if not fifo.busy), default=NEVER)
        return dropped

    @property
    def next_expiry(self) -> int:
        """Return when to call `expire` at the latest; may be early."""
        return self._expiry if self.size else NEVER

    def best(self, now: int, *, nrt: bool = True) -> QueuedMessage | None:
        """Return the message to try now. `nrt=False`: only a real-time one."""
        if self.only is not None:
            fifo = self._fifos.get(self.only)
            return fifo.waiting[0] if fifo is not None and not fifo.busy and fifo.held <= now else None
        best, eased = self._best(now, nrt=nrt), self._eased
        if eased is None or eased.busy or eased.held > now:
            return None if best is None else best.waiting[0]
        if eased.deadline < now - _STARVED and self._starved_from <= now:
            self._starved_from = now + self.starved_apart
            eased.waiting[0].starved = True
        return best.waiting[0] if best is not None and best.laxity(now) < eased.laxity(now) else eased.waiting[0]

    def _best(self, now: int, *, nrt: bool) -> _MessageFifo | None:
        """Return the FIFO to try now, without the eased one."""
        # The first FIFO may not be the best: among those of the same laxity the oldest goes first.
        chosen: tuple[int, int, _MessageFifo] | None = None
        limit: int | None = None
        for entry in self._sorted:
            fifo = entry[2]
            if fifo.busy or fifo is self._eased or fifo.held > now:
                continue
            if chosen is None:
                chosen = entry
                continue
            if limit is None:
                limit = _same_laxity_until(chosen[0], now)
            if entry[0] >= limit:
                break
            if entry[1] < chosen[1]:
                chosen = entry
        if chosen is None or (chosen[0] == NEVER and not nrt):
            return None
        return chosen[2]

    def best_nrt(self, now: int) -> QueuedMessage | None:
        """Return the non real-time message to try now."""
        if self.only is not None:
            return None
        for entry in self._sorted[bisect_left(self._sorted, (NEVER,)) :]:
            if not entry[2].busy and entry[2].held <= now:
                return entry[2].waiting[0]
        return None

    def next_frame(self, message: QueuedMessage, now: int) -> Frame:
        """Return a message's next frame, with its present laxity. The topic competes again once it is sent or back."""
        fifo = self._fifos[message.message]
        fifo.busy = True
        laxity = fifo.laxity(now)
        at = message.sent * FRAME_MAX
        # `encode_identifier` inlined: it would repeat the checks of the message for each frame.
        identifier = laxity << LAXITY_SHIFT | message.message << MESSAGE_SHIFT | message.frames - 1 - message.sent
        if message.marked and not message.sent:
            identifier |= FIRST_MARK
        return Frame(identifier, message.payload[at : at + FRAME_MAX])

    def put_back(self, message: QueuedMessage, hold: int = LONG_AGO) -> None:
        """Let the topic of a frame that was not sent compete again, from the instant `hold` on."""
        fifo = self._fifos[message.message]
        fifo.busy = False
        fifo.held = hold
        if fifo.expiry < self._expiry:
            self._expiry = fifo.expiry

    def frame_sent(self, message: QueuedMessage) -> bool:
        """Count a frame as sent; return whether it was the last one, which takes the message out of the queue."""
        fifo = self._fifos[message.message]
        fifo.busy = False
        message.sent += 1
        if message.sent == message.frames:
            self._drop(fifo, [message])
            return True
        if message.sent == 1 and message.drop:  # from now on it is no longer given up
            fifo.expiry = min((each.expiry for each in fifo.waiting), default=NEVER)
        self._expiry = min(self._expiry, fifo.expiry)
        return False

    def remove(self, message: QueuedMessage) -> None:
        """Give up a message without a frame at the port."""
        fifo = self._fifos[message.message]
        if message is fifo.waiting[0]:
            fifo.busy = False
        self._drop(fifo, [message])

    def withdraw(self, message: int, which: Callable[[QueuedMessage], bool] = lambda each: True) -> list[QueuedMessage]:
        """Remove and return messages of a topic, all or some, but not one that has started."""
        fifo = self._fifos.get(message)
        if fifo is None:
            return []
        first = fifo.waiting[0] if fifo.busy else None  # its frame may be on the bus
        gone = [each for each in fifo.waiting if not each.sent and each is not first and which(each)]
        if gone:
            self._drop(fifo, gone)
        return gone

    def count(self, message: int) -> int:
        """Return the number of waiting messages of this topic."""
        fifo = self._fifos.get(message)
        return 0 if fifo is None else len(fifo.waiting)

    def holds(self, message: int) -> bool:
        """Return whether messages of this topic are waiting."""
        return message in self._fifos

    def repeats(self, message: int, payload: bytes) -> bool:
        """Return whether a message of these bytes waits already, and has not started."""
        fifo = self._fifos.get(message)
        return fifo is not None and any(each.payload == payload and not each.sent for each in fifo.waiting)

    def messages(self) -> Iterator[QueuedMessage]:
        """Yield all messages, topic by topic."""
        for fifo in self._fifos.values():
            yield from fifo.waiting

    def clear(self) -> list[QueuedMessage]:
        """Remove and return everything."""
        gone = list(self.messages())
        self._fifos.clear()
        self._sorted.clear()
        self._eased = None
        self.size = 0
        self._expiry = NEVER
        return gone

    def _drop(self, fifo: _MessageFifo, gone: list[QueuedMessage]) -> None:
        self._leave(fifo)
        for message in gone:
            fifo.waiting.remove(message)
        self.size -= len(gone)
        if fifo.waiting:
            self._enter(fifo)
        else:
            del self._fifos[gone[0].message]

    def _leave(self, fifo: _MessageFifo) -> None:
        del self._sorted[bisect_left(self._sorted, (fifo.deadline, fifo.order))]
        if fifo is self._eased:
            self._eased = None

    def _append(self, fifo: _MessageFifo, message: QueuedMessage) -> None:
        """Append a message, which may make the FIFO more urgent."""
        fifo.waiting.append(message)
        if message.deadline < fifo.deadline:
            self._leave(fifo)
            fifo.deadline = message.deadline
            insort(self._sorted, (fifo.deadline, fifo.order, fifo))
        self._set_floor(fifo, min(fifo.floor, message.floor))
        if message.expiry < fifo.expiry:
            fifo.expiry = message.expiry
            self._expiry = min(self._expiry, fifo.expiry)

    def _place(self, fifo: _MessageFifo, message: QueuedMessage) -> int:
        """Return the index for an urgent message: before those that may wait longer, but not one that has started."""
        started = fifo.busy or fifo.waiting[0].sent > 0
        urgency = message.floor, message.deadline
        places = enumerate(fifo.waiting)
        later = (place for place, each in places if (each.floor, each.deadline) > urgency and place >= started)
        return next(later, len(fifo.waiting))

    def _enter(self, fifo: _MessageFifo) -> None:
        """Sort a FIFO in, as urgent as its most urgent message. To sort it anew: `_leave`, changes, `_enter`."""
        waiting = fifo.waiting
        first = waiting[0]
        fifo.order = first.order
        if len(waiting) == 1:
            fifo.deadline, fifo.expiry = first.deadline, first.expiry
        elif fifo.deadline < NEVER:  # else all are non real-time, and there may be many: don't look at each
            fifo.deadline = min(each.deadline for each in waiting)
            fifo.expiry = min(each.expiry for each in waiting)
        if fifo.expiry < self._expiry:
            self._expiry = fifo.expiry
        insort(self._sorted, (fifo.deadline, fifo.order, fifo))
        self._set_floor(fifo, min(each.floor for each in waiting) if first.floor > SRT_MIN else SRT_MIN)

    def _set_floor(self, fifo: _MessageFifo, floor: int) -> None:
        """Set the least laxity of a FIFO; with one it competes apart from the others, which are sorted by deadline."""
        fifo.floor = floor
        if floor > SRT_MIN:
            self._eased = fifo
        elif fifo is self._eased:
            self._eased = None


def _same_laxity_until(deadline: int, now: int) -> int:
    """Deadlines from this one up to, not including, the result have the same laxity now."""
    if deadline == NEVER:
        return NEVER
    laxity = rtcan.srt_laxity(deadline - now)
    return NEVER if laxity == SRT_MAX else now + (laxity + 1) * MILLISECOND
