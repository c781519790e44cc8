"""When to say what again: a ring of everything worth repeating, one step at a time, never faster than the link's rate.

New things go first (`_fresh`), then join the ring. A wish to hear everything again only raises the number of ring
places to visit without waiting (`_eager`) to a full round: fifty wishes at once cost one round.
"""

import heapq
from collections import deque
from collections.abc import Hashable, Iterator
from enum import Enum, auto

import msgspec

_SECOND = 1_000_000_000
_STEP = _SECOND // 2
_ROUND = 3 * _SECOND // 2
_PRESENCE_APART = _SECOND // 10
_PRESENCE_SHARE = 8
"""Message times between two presences at least: on a slow line they would leave no room for anything else."""
_QUIET_MOST = _SECOND
"""A step that waits for a quiet line goes out this late at the latest."""
_MOST = 2
"""Messages of one item at most: an announcement and the type before it."""


class Kind(Enum):
    """What an item of the schedule announces."""

    PRESENCE = auto()
    QUERY = auto()
    PUBLISHER = auto()
    SUBSCRIBER = auto()
    ENDPOINT = auto()
    ENDPOINT_GONE = auto()
    UNSUBSCRIBE = auto()
    CONFLICT = auto()


class Item(msgspec.Struct, eq=False):
    """One thing to announce: again and again, or `once`. Not alive: withdrawn, forgotten when its turn comes."""

    kind: Kind
    key: tuple[str | int, ...] = ()
    once: bool = False
    alive: bool = True


class Bucket:
    """A token bucket in integer ns: in any span of t seconds at most `burst + rate * t` messages."""

    def __init__(self, rate: float, burst: int) -> None:
        self.gap = max(1, round(_SECOND / rate))
        self._slack = burst * self.gap
        self._full_at = 0

    def ready_at(self, count: int) -> int:
        """When `count` messages may go."""
        return self._full_at + count * self.gap - self._slack

    def take(self, now: int, count: int) -> None:
        self._full_at = max(self._full_at, now) + count * self.gap


class Schedule:
    """What to announce next, and when. Each call costs the same, however much there is to repeat."""

    def __init__(self, rate: float, burst: int, quiet: int) -> None:
        self._bucket = Bucket(rate, max(burst, _MOST))
        self._quiet = quiet
        self._fresh: deque[Item] = deque()
        self._ring: deque[Item] = deque()
        self._count = 0
        self._eager = 0
        self._step_at = 0
        self._presence_at = 0
        self._presence_sent = -_SECOND
        self._traffic_at = -_SECOND

    def add(self, item: Item) -> None:
        """Announce it as soon as the rate allows, and unless `once` for ever."""
        self._fresh.append(item)
        self._count += not item.once

    def drop(self, item: Item) -> None:
        item.alive = False
        self._count -= not item.once

    def start(self, now: int) -> None:
        """The link is up: introduce yourself, then everything."""
        self.stop()
        self._fresh.append(Item(Kind.QUERY, once=True))
        self._eager = self._count
        self._step_at = now + self._interval
        self._presence_at = now + self._presence_period

    def stop(self) -> None:
        """Nothing is due any more; what was to be said once is forgotten."""
        self._ring.extend(item for item in self._fresh if item.alive and not item.once)
        self._fresh.clear()
        self._eager = 0

    def repeat(self, now: int) -> None:
        """Somebody is new: say everything once more, presence first."""
        apart = max(_PRESENCE_APART, _PRESENCE_SHARE * self._bucket.gap)
        self._presence_at = min(self._presence_at, max(now, self._presence_sent + apart))
        self._eager = self._count

    def traffic(self, now: int) -> None:
        """A management message passed by."""
        self._traffic_at = now

    def due(self) -> int:
        """When there is something to announce (ns)."""
        _drop_dead(self._fresh)
        return max(0 if self._fresh else self._turn_at(), self._bucket.ready_at(_MOST))

    def pop(self, now: int) -> Item | None:
        """What to announce now, if anything; say with `sent` what it cost."""
        if self.due() > now:
            return None
        if self._fresh:
            item = self._fresh.popleft()
            if not item.once:
                self._ring.append(item)
            return item
        self._step_at = now + self._interval
        _drop_dead(self._ring)
        if self._presence_at <= now or not self._ring:
            self._presence_sent, self._presence_at = now, now + self._presence_period
            return Item(Kind.PRESENCE, once=True)
        self._eager -= self._eager > 0
        self._ring.rotate(-1)
        return self._ring[-1]

    def sent(self, now: int, count: int) -> None:
        self._bucket.take(now, count)
        self._traffic_at = now

    @property
    def round_time(self) -> int:
        """How long it takes to repeat everything (ns)."""
        slot = max(self._interval, _MOST * self._bucket.gap, self._quiet)
        return max(_ROUND, (self._count + 1) * slot)

    @property
    def _interval(self) -> int:
        return min(_STEP, _ROUND // (self._count + 1))

    @property
    def _presence_period(self) -> int:
        return max(min(_ROUND, _STEP * (self._count + 1)), _PRESENCE_SHARE * self._bucket.gap)

    def _turn_at(self) -> int:
        self._eager = min(self._eager, self._count)
        turn = 0 if self._eager else min(self._step_at, self._presence_at)
        return max(turn, min(self._traffic_at + self._quiet, self._step_at + _QUIET_MOST))


class Timers:
    """Keys that run out. Setting a key later costs nothing: its place in the heap is corrected when it comes up."""

    def __init__(self) -> None:
        self._due: dict[Hashable, int] = {}
        self._heap: list[tuple[int, int, Hashable]] = []
        self._pushed = 0

    def __contains__(self, key: Hashable) -> bool:
        return key in self._due

    def set(self, key: Hashable, due: int) -> None:
        """The key runs out at `due` (ns), earlier or later than before."""
        before = self._due.get(key)
        self._due[key] = due
        if before is None or due < before:
            self._push(key, due)

    def clear(self, key: Hashable) -> None:
        self._due.pop(key, None)

    def next(self) -> int | None:
        """When the next key runs out."""
        while self._heap:
            at, _, key = self._heap[0]
            due = self._due.get(key)
            if due == at:
                return at
            heapq.heappop(self._heap)
            if due is not None and due > at:
                self._push(key, due)
        return None

    def pop(self, now: int) -> Iterator[Hashable]:
        """The keys that have run out; each is cleared."""
        while (due := self.next()) is not None and due <= now:
            key = heapq.heappop(self._heap)[2]
            del self._due[key]
            yield key

    def _push(self, key: Hashable, due: int) -> None:
        if len(self._heap) > 2 * len(self._due) + 64:  # keys that come and go: their old places would pile up
            self._heap = [(at, n, each) for n, (each, at) in enumerate(self._due.items())]
            heapq.heapify(self._heap)
            self._pushed = len(self._heap)
            return
        self._pushed += 1
        heapq.heappush(self._heap, (due, self._pushed, key))


def _drop_dead(items: deque[Item]) -> None:
    while items and not items[0].alive:
        items.popleft()
