"""The queue of outgoing soft and non real-time messages: the least laxity goes first (PROTOCOL.md 6, thesis 4.3.5).

Messages of one topic wait in one lane, in order, and only the first one of a lane competes: so no two messages of a
topic ever interleave. A lane is as urgent as the most urgent message in it. The lanes are sorted by deadline; those
that have the same laxity at this moment (whole ms) are next to each other, and among them the first come is served.

Laxity is computed anew at every try: `take` moves nothing, only `sent` does.
"""

from bisect import bisect_left, insort
from collections import deque
from collections.abc import Callable, Hashable, Iterator

import msgspec

from r2p.codecs import rtcan
from r2p.codecs.rtcan import FRAME_MAX, NRT, SRT_MAX, Frame
from r2p.protocols.rtcan.events import LONG_AGO, NEVER

_MILLISECOND = 1_000_000
_FIRST = 1 << 62  # more than any count


class QueuedMessage(msgspec.Struct, eq=False):
    """A message on its way. `deadline` NEVER: non real-time. `drop`: given up when overdue, unless it has started.

    Once its first frame is out it is always finished: a receiver of 2014 loses the next message as well when the end of
    one is missing. `recalled`: its frame was asked back from the port, as the bus is used in another way from now on.
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

    @property
    def expiry(self) -> int:
        """When it is given up."""
        return NEVER if self.sent or not self.drop else self.deadline


class _MessageFifo(msgspec.Struct, eq=False):
    """The messages of one topic. `busy`: a frame of the first one is with the port; `held`: no try before then."""

    waiting: deque[QueuedMessage]
    deadline: int = NEVER
    order: int = 0
    expiry: int = NEVER
    busy: bool = False
    held: int = LONG_AGO


class LaxityQueue:
    """At most `capacity` messages, and `depth` of them of one topic."""

    def __init__(self, capacity: int = 256, depth: int = 64) -> None:
        self.only: int | None = None
        """While this is set, only the topic with this message id may send."""
        self._capacity = capacity
        self._depth = depth
        self._lanes: dict[int, _MessageFifo] = {}
        self._sorted: list[tuple[int, int, _MessageFifo]] = []
        self.size = 0
        """Messages that wait."""
        self._count = 0
        self._expiry = NEVER

    def __len__(self) -> int:
        return self.size

    @property
    def full(self) -> bool:
        return self.size >= self._capacity

    def put(self, message: QueuedMessage, *, urgent: bool = False, management: bool = False) -> bool:
        """Queue it; `urgent` before what of its topic has not started and may wait longer. False: there is no room.

        `management` has room of its own, and goes before others of the same laxity, as it does on the bus: else events
        that are overdue but not dropped would stop leases and discovery. Raises `MessageError` for what RTCAN can't
        carry.
        """
        message.frames = rtcan.fragment_count(len(message.payload))
        lane = self._lanes.get(message.message)
        if (self.size >= self._capacity and not management) or (lane is not None and len(lane.waiting) >= self._depth):
            return False
        self._count += 1
        message.order = self._count - (_FIRST if management else 0)
        if lane is None:
            lane = self._lanes[message.message] = _MessageFifo(deque((message,)))
            self._enter(lane)
        elif urgent:
            self._leave(lane)
            lane.deadline = min(lane.deadline, message.deadline)
            lane.waiting.insert(self._place(lane, message.deadline), message)
            self._enter(lane)
        else:
            self._append(lane, message)
        self.size += 1
        return True

    def expire(self, now: int) -> list[QueuedMessage]:
        """Remove and return what is overdue and to be dropped; what is with the port stays."""
        if now < self._expiry:
            return []
        dropped = []
        for lane in [lane for lane in self._lanes.values() if lane.expiry <= now]:
            first = lane.waiting[0] if lane.busy else None
            gone = [each for each in lane.waiting if each.expiry <= now and each is not first]
            if gone:
                dropped += gone
                self._remove(lane, gone)
        self._expiry = min((lane.expiry for lane in self._lanes.values() if not lane.busy), default=NEVER)
        return dropped

    @property
    def next_expiry(self) -> int:
        """When to call `expire` at the latest; may be early."""
        return self._expiry if self.size else NEVER

    def best(self, now: int, *, nrt: bool = True) -> QueuedMessage | None:
        """The message to try now. `nrt=False`: among those that are not non real-time."""
        if self.only is not None:
            lane = self._lanes.get(self.only)
            return lane.waiting[0] if lane is not None and not lane.busy and lane.held <= now else None
        chosen: tuple[int, int, _MessageFifo] | None = None
        limit: int | None = None
        for entry in self._sorted:
            lane = entry[2]
            if lane.busy or lane.held > now:
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
        return chosen[2].waiting[0]

    def best_nrt(self, now: int) -> QueuedMessage | None:
        """The non real-time message to try now."""
        if self.only is not None:
            return None
        for entry in self._sorted[bisect_left(self._sorted, (NEVER,)) :]:
            if not entry[2].busy and entry[2].held <= now:
                return entry[2].waiting[0]
        return None

    def take(self, message: QueuedMessage, now: int) -> Frame:
        """Its next frame, with the laxity of this moment. Its topic has nothing else to try until `put_back`."""
        lane = self._lanes[message.message]
        lane.busy = True
        laxity = NRT if lane.deadline == NEVER else rtcan.srt_laxity(lane.deadline - now)
        at = message.sent * FRAME_MAX
        identifier = laxity << 23 | message.message << 7 | message.frames - 1 - message.sent
        return Frame(identifier, message.payload[at : at + FRAME_MAX])

    def put_back(self, message: QueuedMessage, hold: int = LONG_AGO) -> None:
        """The frame was not sent: the topic competes again, from the instant `hold` on."""
        lane = self._lanes[message.message]
        lane.busy = False
        lane.held = hold
        if lane.expiry < self._expiry:
            self._expiry = lane.expiry

    def sent(self, message: QueuedMessage) -> bool:
        """The frame was sent. Says whether it was the last one: then the message is out of the queue."""
        lane = self._lanes[message.message]
        lane.busy = False
        message.sent += 1
        if message.sent == message.frames:
            self._remove(lane, [message])
            return True
        if message.sent == 1 and message.drop:  # from now on it is not given up any more
            lane.expiry = min((each.expiry for each in lane.waiting), default=NEVER)
        self._expiry = min(self._expiry, lane.expiry)
        return False

    def give_up(self, message: QueuedMessage) -> None:
        """Remove a message, whose frame is no longer with the port."""
        lane = self._lanes[message.message]
        if message is lane.waiting[0]:
            lane.busy = False
        self._remove(lane, [message])

    def withdraw(self, message: int, which: Callable[[QueuedMessage], bool] = lambda each: True) -> list[QueuedMessage]:
        """Remove and return what waits of a topic, all or these of it, but for a message that has started."""
        lane = self._lanes.get(message)
        if lane is None:
            return []
        first = lane.waiting[0] if lane.busy else None
        gone = [each for each in lane.waiting if not each.sent and each is not first and which(each)]
        if gone:
            self._remove(lane, gone)
        return gone

    def waits(self, message: int) -> bool:
        """Whether there is anything of this topic."""
        return message in self._lanes

    def messages(self) -> Iterator[QueuedMessage]:
        """All of them, topic by topic."""
        for lane in self._lanes.values():
            yield from lane.waiting

    def clear(self) -> list[QueuedMessage]:
        """Remove and return everything."""
        gone = list(self.messages())
        self._lanes.clear()
        self._sorted.clear()
        self.size = 0
        self._expiry = NEVER
        return gone

    def _remove(self, lane: _MessageFifo, gone: list[QueuedMessage]) -> None:
        self._leave(lane)
        for message in gone:
            lane.waiting.remove(message)
        self.size -= len(gone)
        if lane.waiting:
            self._enter(lane)
        else:
            del self._lanes[gone[0].message]

    def _leave(self, lane: _MessageFifo) -> None:
        del self._sorted[bisect_left(self._sorted, (lane.deadline, lane.order))]

    def _append(self, lane: _MessageFifo, message: QueuedMessage) -> None:
        """Put it behind the others: the lane may become more urgent by that."""
        lane.waiting.append(message)
        if message.deadline < lane.deadline:
            self._leave(lane)
            lane.deadline = message.deadline
            insort(self._sorted, (lane.deadline, lane.order, lane))
        if message.expiry < lane.expiry:
            lane.expiry = message.expiry
            self._expiry = min(self._expiry, lane.expiry)

    def _place(self, lane: _MessageFifo, deadline: int) -> int:
        """Where a message with this deadline goes; not into one that has started."""
        started = lane.busy or lane.waiting[0].sent > 0
        later = (place for place, each in enumerate(lane.waiting) if each.deadline > deadline and place >= started)
        return next(later, len(lane.waiting))

    def _enter(self, lane: _MessageFifo) -> None:
        """Sort it in, as urgent as its most urgent message."""
        waiting = lane.waiting
        first = waiting[0]
        lane.order = first.order
        if len(waiting) == 1:
            lane.deadline, lane.expiry = first.deadline, first.expiry
        elif lane.deadline < NEVER:  # else all are non real-time; there may be many
            lane.deadline = min(each.deadline for each in waiting)
            lane.expiry = min(each.expiry for each in waiting)
        if lane.expiry < self._expiry:
            self._expiry = lane.expiry
        insort(self._sorted, (lane.deadline, lane.order, lane))


def _same_laxity_until(deadline: int, now: int) -> int:
    """Deadlines from this one up to, not including, the result have the same laxity now."""
    if deadline == NEVER:
        return NEVER
    laxity = rtcan.srt_laxity(deadline - now)
    return NEVER if laxity == SRT_MAX else now + (laxity + 1) * _MILLISECOND
