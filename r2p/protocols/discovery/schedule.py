"""When to say what again: a ring of everything worth repeating, one step at a time, never faster than the link's rate.

New things go first (`_fresh`), then join the ring. A wish to hear everything again only raises the number of ring
places to visit without waiting (`_eager`) to a full round: fifty wishes at once cost one round. What only describes
leaves the ring after its first repetition for one that turns more slowly (`_seldom`), until somebody is new.
"""

from collections import OrderedDict
from enum import Enum, auto
from typing import Generic, TypeVar

import msgspec

from r2p.protocols.discovery.events import PeerAddress
from r2p.protocols.timers import KeyedTimers

_SECOND = 1_000_000_000
_STEP = _SECOND // 2
_ROUND = 3 * _SECOND // 2
SELDOM = 4
"""Rounds in which what only describes is repeated once."""
_PRESENCE_APART = _SECOND // 10
_PRESENCE_SHARE = 8
"""Message times between two presences at least: on a slow line they would leave no room for anything else."""
_QUIET_MOST = _SECOND
"""A step that waits for a quiet line goes out this late at the latest."""
_MOST = 2
"""Messages of one item at most: an announcement and the type before it."""
_SHARED = _SECOND // 50
_AT_ONCE = 3
_NEWCOMER = _SECOND // 20
"""Ns for each module on the link between two full repetitions for modules that are new: with those that start meanwhile
they share one, so that the start of n modules costs each a few repetitions, not n."""
_TOOL = _SECOND // 5
"""Ns between two full repetitions for a tool, which shows what it hears to a user."""
_PRESENCE_EACH = _SECOND // 100
"""Ns for each module on the link between two presences at least."""


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
    RELAY = auto()


class Item(msgspec.Struct, frozen=True):
    """One thing to announce: again and again, or `once`. What is to be said is looked up when its turn comes."""

    kind: Kind
    key: tuple[str | int, ...] = ()
    once: bool = False


class TokenBucket:
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
        self.pace(rate, burst, quiet)
        self._fresh: OrderedDict[Item, None] = OrderedDict()
        self._ring: OrderedDict[Item, None] = OrderedDict()
        self._seldom: OrderedDict[Item, None] = OrderedDict()
        self._relayed: OrderedDict[Item, None] = OrderedDict()
        self._relay_next = True
        self._count = 0
        self._eager = 0
        self._lap = 0  # turns in the ring until all has been said once more
        self._owed = 0  # turns to the slow ring, in parts of one
        self._step_at = 0
        self._presence_at = 0
        self._presence_sent = -_SECOND
        self._repeated_at = -_ROUND
        self._repeat_at: int | None = None
        self._tool_waits = False
        self._traffic_at = -_SECOND

    def pace(self, rate: float, burst: int, quiet: int) -> None:
        """Go at another rate from now on."""
        self._bucket = TokenBucket(rate, max(burst, _MOST))
        self._quiet = quiet

    def add(self, item: Item) -> None:
        """Announce it as soon as the rate allows, and unless `once` for ever. What waits for its turn keeps it."""
        if item in self._fresh:
            return
        self.drop(item)
        self._fresh[item] = None
        self._count += not item.once

    def relay(self, item: Item) -> None:
        """Announce once what is another's: in turn with what is our own. What waits for its turn keeps it."""
        self._relayed[item] = None

    def drop(self, item: Item) -> None:
        """Announce it no more."""
        for items in (self._fresh, self._ring, self._seldom):
            if item in items:
                del items[item]
                self._count -= not item.once

    def start(self, now: int) -> None:
        """The link is up: introduce yourself, then everything."""
        self.stop()
        self._fresh[Item(Kind.QUERY, once=True)] = None
        self._hurry()
        self._step_at = now + self._interval
        self._presence_at = now + self._presence_period

    def stop(self) -> None:
        """Nothing is due any more; what was to be said once is forgotten."""
        self._ring.update((item, None) for item in self._fresh if not item.once)
        self._fresh.clear()
        self._relayed.clear()
        self._eager = 0
        self._repeated_at, self._repeat_at, self._tool_waits = -_ROUND, None, False

    def repeat(self, now: int, modules: int = 1, *, tool: bool = False) -> None:
        """One of `modules` on the link is new, or a `tool` asks: say everything once more, presence first."""
        apart = max(_PRESENCE_APART, _PRESENCE_SHARE * self._bucket.gap, modules * _PRESENCE_EACH)
        self._presence_at = min(self._presence_at, max(now, self._presence_sent + apart))
        apart = modules * _NEWCOMER
        at = self._repeated_at + min(apart, _TOOL if tool else _ROUND)
        if at <= now:
            self._repeat(now)
        elif apart >= _ROUND and not tool:
            self._include_seldom()  # the next round is soon enough
        elif not self._tool_waits:
            self._repeat_at, self._tool_waits = at, tool

    def traffic(self, now: int) -> None:
        """A management message passed by."""
        self._traffic_at = now

    def due(self) -> int:
        """When there is something to announce (ns)."""
        return max(0 if self._fresh or self._relayed else self._turn_at(), self._bucket.ready_at(_MOST))

    def pop(self, now: int) -> Item | None:
        """What to announce now, if anything; say with `sent` what it cost."""
        if self.due() > now:
            return None
        if self._repeat_at is not None and self._repeat_at <= now:
            self._repeat(now)
            if self.due() > now:
                return None
        if self._fresh:
            item, _ = self._fresh.popitem(last=False)
            if not item.once:
                self._ring[item] = None
                self._lap = max(self._lap, len(self._ring))
            return item
        if self._relayed and (self._relay_next or self._turn_at() > now):
            self._relay_next = False
            return self._relayed.popitem(last=False)[0]
        self._relay_next = True
        self._step_at = now + self._interval
        if self._presence_at <= now or not (self._ring or self._seldom):
            self._presence_sent, self._presence_at = now, now + self._presence_period
            return Item(Kind.PRESENCE, once=True)
        return self._repetition()

    def sent(self, now: int, count: int) -> None:
        self._bucket.take(now, count)
        self._traffic_at = now

    @property
    def round_time(self) -> int:
        """How long it takes to repeat everything (ns)."""
        slot = max(self._interval, _MOST * self._bucket.gap, self._quiet)
        return max(_ROUND, (self._places + 1) * slot)

    @property
    def relay_time(self) -> int:
        """How long it takes until all that is relayed has had its turn (ns)."""
        return 2 * _MOST * self._bucket.gap * len(self._relayed)

    @property
    def _places(self) -> int:
        """Of what is repeated, how much has its turn in one round."""
        return self._count - len(self._seldom) * (SELDOM - 1) // SELDOM

    @property
    def _interval(self) -> int:
        return min(_STEP, _ROUND // (self._places + 1))

    @property
    def _presence_period(self) -> int:
        return max(min(_ROUND, _STEP * (self._places + 1)), _PRESENCE_SHARE * self._bucket.gap)

    def _repeat(self, now: int) -> None:
        self._repeated_at, self._repeat_at, self._tool_waits = now, None, False
        self._hurry()

    def _hurry(self) -> None:
        """Say everything without waiting, and once more in the next round: an answer may be lost."""
        self._include_seldom()
        self._eager, self._lap = self._count, 2 * self._count

    def _include_seldom(self) -> None:
        """The next round says everything."""
        self._ring.update(self._seldom)
        self._seldom.clear()
        self._lap = max(self._lap, self._count)

    def _repetition(self) -> Item:
        """What is next in the ring; so often that all have a turn in `SELDOM` rounds, what is next in the slow one."""
        ring, seldom = self._ring, self._seldom
        share = SELDOM * len(ring) + len(seldom)
        self._owed += len(seldom)
        if seldom and self._owed >= share:
            self._owed %= share
            return _turned(seldom)
        item = _turned(ring)
        self._eager -= self._eager > 0
        self._lap -= 1
        if self._lap == 0:
            self._slow_down()
        return item

    def _slow_down(self) -> None:
        """All has been said twice: what only describes may take its time."""
        for item in [item for item in self._ring if item.kind is Kind.ENDPOINT]:
            del self._ring[item]
            self._seldom[item] = None

    def _turn_at(self) -> int:
        self._eager = min(self._eager, self._count)
        turn = 0 if self._eager else min(self._step_at, self._presence_at)
        if self._repeat_at is not None:
            turn = min(turn, self._repeat_at)
        return max(turn, min(self._traffic_at + self._quiet, self._step_at + _QUIET_MOST))


def _turned(ring: OrderedDict[Item, None]) -> Item:
    """What is next there; it comes last now."""
    item = next(iter(ring))
    ring.move_to_end(item)
    return item


_Asked = tuple[int, str]
M = TypeVar("M")


class SharedAnswers(Generic[M]):
    """Which answers to r2p modules may go at once, and which have to wait for others who ask the same.

    Everybody on a link hears an answer, so it serves all who have asked before it. Of each (role and topic) the first
    few go at once; then, while many modules start, one for each `_SHARED` and module: else each of n modules would
    answer each of n others, and each of those answers would be answered. Timers have keys that begin with "answer".
    """

    def __init__(self, timers: KeyedTimers) -> None:
        self._timers = timers
        self._full_at: dict[_Asked, int] = {}
        self._waiting: dict[_Asked, dict[PeerAddress, M]] = {}

    def waits(self, now: int, key: _Asked, source: PeerAddress, message: M, modules: int) -> bool:
        """Whether the answer to this message waits for its timer; `modules` are known on the link."""
        waiting = self._waiting.get(key)
        if waiting is not None:
            waiting[source] = message
            return True
        gap = _SHARED * modules
        ready = self._full_at.get(key, 0) - (_AT_ONCE - 1) * gap
        if ready <= now:
            self._count(now, key, gap)
            return False
        self._waiting[key] = {source: message}
        self._timers.set(("answer", *key), ready)
        return True

    def take(self, now: int, key: _Asked, modules: int) -> list[tuple[PeerAddress, M]]:
        """Its time has come: who is to be answered, and what each said last."""
        self._count(now, key, _SHARED * modules)
        return list(self._waiting.pop(key, {}).items())

    def drop(self, source: PeerAddress, key: _Asked | None = None) -> None:
        """This peer is not to be answered any more, about one thing or about all."""
        for waiting in self._waiting.values() if key is None else [self._waiting.get(key, {})]:
            waiting.pop(source, None)

    def forget(self, key: _Asked) -> None:
        """The topic is not ours any more."""
        self._full_at.pop(key, None)
        self._waiting.pop(key, None)
        self._timers.clear(("answer", *key))

    def clear(self) -> None:
        """Nobody can be answered."""
        for key in self._full_at.keys() | self._waiting.keys():
            self.forget(key)

    def _count(self, now: int, key: _Asked, gap: int) -> None:
        self._full_at[key] = max(self._full_at.get(key, 0), now) + gap
