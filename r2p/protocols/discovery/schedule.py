"""The schedule of announcements: a ring of everything to repeat, step by step, never faster than the link's rate.

New items go first (`_fresh`), after a presence that is overdue, then join the ring. A request for everything only
raises the number of steps that don't wait (`_eager`) to one full turn, so that fifty requests at once cost one turn.
Items that only describe, endpoints and names, leave the ring after two turns for one that turns more slowly (`_slow`),
until a module is new. Where many modules of r2p are on a link (`set_crowd`), topics do so, too, unless they wait for an
answer, and the more modules there are, the more slowly the slow ring turns: what all say together stays the same.
"""

from collections import OrderedDict
from enum import Enum, auto
from typing import TYPE_CHECKING

import msgspec

from r2p.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Callable

_STEP = SECOND // 2
"""Ns between two steps, at most, when there is little to repeat."""
_ROUND = 3 * SECOND // 2
"""Ns in which the ring turns once, if the rate allows. The shortest lease is three turns, so two may be lost."""
SLOW_ROUNDS = 4
"""Turns of the ring in which the slow ring turns once."""
CROWD = 5
"""Other modules on the link from which on topics are repeated in the slow ring, if all of them know that."""
CROWD_ROUNDS = 14
"""The most turns of the ring in which the slow ring turns once, reached with as many modules."""
_LOSSLESS_ROUNDS = CROWD_ROUNDS * 3 // 2
"""The same on networks that lose nothing, where newcomers are answered one by one: less than topics last there."""
_TOGETHER = 16
"""The most items that one step repeats on such networks."""
_ROUND_MODULES, _ROUND_MAX = 30, 10
"""For each so many modules, a round takes as long as another one, up to so many."""
_LOSSLESS_ROUND_MODULES, _LOSSLESS_ROUND_MAX = 10, 20
"""The same on networks that lose nothing: two rounds fit into the longest lease."""
_PRESENCE_INTERVAL = SECOND // 10
"""Ns between two presences (HELLO and ALIVE), at least, however many modules ask."""
_PRESENCE_EACH = SECOND // 100
"""The same, for each module on the link."""
_PRESENCE_SHARE = 8
"""The same in message times: on a slow line, presences would leave no room for anything else."""
_PRESENCE_HELD = SECOND // 2
"""Ns for which a presence waits at most while all is held back."""
_TURNS = 2
"""How often everything is announced before it is repeated slowly: an answer may be lost."""
_QUIET_MAX = SECOND
"""Ns that a step waits at most for a line to be quiet."""
_ITEM_MESSAGES = 2
"""Messages of one item at most: an announcement, and the type before it."""
_NEWCOMER_EACH = SECOND // 20
"""Ns for each module on the link between two full repetitions for new modules. Those that start meanwhile share one, so
that the start of n modules costs each a few repetitions, not n."""
_NEWCOMER_MAX = 10 * SECOND
"""The same, at most."""
_TOOL_INTERVAL = SECOND // 5
"""Ns between two full repetitions for a tool, whose user is waiting."""


class ItemKind(Enum):
    """The subject of an item of the schedule."""

    PRESENCE = auto()
    QUERY = auto()
    PUBLISHER = auto()
    SUBSCRIBER = auto()
    ENDPOINT = auto()
    ENDPOINT_GONE = auto()
    LONG_NAME = auto()
    UNSUBSCRIBE = auto()
    CONFLICT = auto()
    RELAY = auto()


_DESCRIBING = (ItemKind.ENDPOINT, ItemKind.LONG_NAME)


class Item(msgspec.Struct, frozen=True):
    """One item to announce: again and again, or `once`. The message is made in its turn."""

    kind: ItemKind
    key: tuple[str | int, ...] = ()
    once: bool = False


class TokenBucket:
    """A token bucket in integer ns: in any span of t seconds at most `burst + rate * t` messages."""

    def __init__(self, rate: float, burst: int) -> None:
        self.gap = max(1, round(SECOND / rate))
        self._slack = burst * self.gap
        self._full_at = 0

    def ready_at(self, count: int) -> int:
        """Return when `count` messages may go (ns)."""
        return self._full_at + count * self.gap - self._slack

    def changed(self, rate: float, burst: int) -> "TokenBucket":
        """Return one of another rate and burst that owes what this one does."""
        bucket = TokenBucket(rate, burst)
        bucket._full_at = self._full_at
        return bucket

    def spend(self, now: int, count: int) -> None:
        self._full_at = max(self._full_at, now) + count * self.gap


class Schedule:
    """Chooses the next announcement and its time. Each call costs the same, however much there is to repeat."""

    def __init__(self, rate: float, burst: int, quiet: int) -> None:
        self._bucket = TokenBucket(rate, max(burst, _ITEM_MESSAGES))
        self._quiet = quiet
        self._fresh: OrderedDict[Item, None] = OrderedDict()
        self._ring: OrderedDict[Item, None] = OrderedDict()
        self._slow: OrderedDict[Item, None] = OrderedDict()
        self._relayed: OrderedDict[Item, None] = OrderedDict()
        self._relay_next = True
        self._count = 0  # items that are repeated, in any of the three
        self._eager = 0  # steps that don't wait
        self._lap = 0  # steps until the ring has turned as often as it must before endpoints become slow
        self._owed = 0  # steps owed to the slow ring, in parts of one
        self._step_at = 0
        self._presence_at = 0
        self._presence_sent = -SECOND
        self._repeated_at = -_ROUND
        self._repeat_at: int | None = None
        self._tool_waits = False
        self._traffic_at = -SECOND
        self._held = -SECOND
        self._crowd = 0
        self._rounds = SLOW_ROUNDS
        self.is_settled: Callable[[Item], bool] = lambda item: True
        """Whether a topic waits for no answer; called for those of a crowd."""
        self.revision = 0
        """A number that changes with what has been announced."""
        self._lossless = False
        self._burst = 0  # further steps of the present ones together

    def hold(self, until: int) -> None:
        """Let nothing go before this instant (ns), but for presences that are overdue."""
        self._held = until

    def set_pace(self, rate: float, burst: int, quiet: int) -> None:
        """Change the rate, the burst and the quiet time (ns)."""
        self._bucket = self._bucket.changed(rate, max(burst, _ITEM_MESSAGES))
        self._quiet = quiet

    def set_lossless(self, *, lossless: bool) -> bool:
        """Set whether everything sent arrives and newcomers are answered one by one; return whether that is a change.

        Everything is announced anew: leases that were short are long from now on, and those that had no end have one.
        """
        if self._lossless == lossless:
            return False
        self._lossless = lossless
        self._presence_at = min(self._presence_at, self._presence_sent + _ROUND)
        self._hurry()
        return True

    @property
    def _turns(self) -> int:
        """How often everything is announced before it is repeated slowly."""
        return 1 if self._lossless else _TURNS

    def set_crowd(self, modules: int) -> None:
        """Repeat topics slowly, as so many modules of r2p are on the link; 0: as usual."""
        begins = modules > 0 and not self._crowd
        if self._crowd and not modules:
            self._include_slow()
        self._crowd = modules
        rounds = min(max(SLOW_ROUNDS, modules), CROWD_ROUNDS) if modules else SLOW_ROUNDS
        self._rounds = _LOSSLESS_ROUNDS if self._lossless and modules else rounds
        if begins:
            self._begin_crowd()
        if self._lossless and modules:
            self._presence_at = self._presence_sent + self._presence_period

    def _begin_crowd(self) -> None:
        """Begin to repeat topics slowly: after one more step, or at once where nothing is lost and all is announced."""
        if not self._lossless:
            self._lap = max(self._lap, 1)
        elif self._eager:
            self._lap = self._eager
        else:
            self._slow_down()
            self._step_at += self._interval

    def quicken(self, item: Item) -> None:
        """Repeat an item in the fast ring, if it is in the slow one, until it is settled."""
        if item in self._slow:
            del self._slow[item]
            self._ring[item] = None
            self._lap = max(self._lap, self._turns * len(self._ring))

    def add(self, item: Item) -> None:
        """Announce an item as soon as the rate allows, and unless `once` for ever. A waiting one keeps its turn."""
        if item in self._fresh:
            return
        self.drop(item)  # it is announced now, so its place in a ring would announce it twice
        self._fresh[item] = None
        self._count += not item.once
        self.revision += 1

    def relay(self, item: Item) -> None:
        """Announce another module's item once, in turn with this module's own. A waiting one keeps its turn."""
        self._relayed[item] = None

    def drop(self, item: Item) -> None:
        """Stop announcing an item."""
        for items in (self._fresh, self._ring, self._slow):
            if item in items:
                del items[item]
                self._count -= not item.once
                self.revision += 1

    def start(self, now: int) -> None:
        """Begin, now that the link is up: first with a query, then with everything."""
        self.stop()
        self._fresh[Item(ItemKind.QUERY, once=True)] = None
        self._hurry()
        self._step_at = now + self._interval
        self._presence_at = now + self._presence_period
        if self._lossless:
            self._presence_sent = now  # the query shows that the module is there

    def stop(self) -> None:
        """Wait for the next `start`. Items to announce once are forgotten."""
        # Fresh items to repeat are not lost: the next start announces the whole ring.
        self._ring.update((item, None) for item in self._fresh if not item.once)
        self._fresh.clear()
        self._relayed.clear()
        self._eager = self._burst = 0
        self._repeated_at, self._repeat_at, self._tool_waits = -_ROUND, None, False

    def repeat(self, now: int, modules: int = 1, *, tool: bool = False) -> None:
        """Announce everything once more, presence first, as one of `modules` on the link is new, or a `tool` asks."""
        apart = max(_PRESENCE_INTERVAL, _PRESENCE_SHARE * self._bucket.gap, modules * _PRESENCE_EACH)
        self._presence_at = min(self._presence_at, max(now, self._presence_sent + apart))
        apart = modules * _NEWCOMER_EACH
        at = self._repeated_at + min(apart, _TOOL_INTERVAL if tool else _NEWCOMER_MAX)
        if at <= now:
            self._repeat(now)
        elif not self._tool_waits:  # a time that suits a tool is the earlier one, so it stays
            self._repeat_at, self._tool_waits = at, tool

    def traffic(self, now: int) -> None:
        """Note that a management message was on the link."""
        self._traffic_at = now

    def due(self) -> int:
        """Return when to call `pop` (ns)."""
        # The cost of an item is known only when its messages are made: there must be room for the most possible.
        at = turn = self._bucket.ready_at(_ITEM_MESSAGES)
        if not (self._fresh or self._relayed) and (other := self._turn_at()) > turn:
            turn = other
        if self._held <= turn:  # no `max`: this is called for each message that is received
            return turn
        return min(self._held, max(at, self._presence_at + _PRESENCE_HELD))

    def pop(self, now: int) -> Item | None:
        """Return the item to announce now, if any; `sent` takes its cost."""
        if self.due() > now:
            return None
        if self._repeat_at is not None and self._repeat_at <= now:
            self._repeat(now)
            if self.due() > now:
                return None
        if self._held > now:
            return self._presence(now)
        if self._fresh and now - self._presence_at < _ROUND:  # a thousand new topics outlast the lease of the module
            item, _ = self._fresh.popitem(last=False)
            if not item.once:
                self._announced(item)
            return item
        # In turn, so that neither this module nor those of other links starve.
        if self._relayed and (self._relay_next or self._turn_at() > now):
            self._relay_next = False
            return self._relayed.popitem(last=False)[0]
        self._relay_next = True
        presence = self._presence_at <= now or not (self._ring or self._slow)
        # In a crowd steps are rarer than presences, which must not put them off.
        if not (presence and self._crowd and (self._ring or self._slow)):
            self._step_at = now + self._interval
        if presence:
            return self._presence(now)
        return self._repetition(now)

    def announced(self) -> list[Item]:
        """Return what is repeated, but for items that still wait for their first turn; names come first."""
        there = [*self._slow, *list(self._ring)[self._eager :]]
        return sorted(there, key=lambda item: item.kind is not ItemKind.LONG_NAME)

    def __contains__(self, item: Item) -> bool:
        return item in self._slow or item in self._ring or item in self._fresh

    def sent(self, now: int, count: int) -> None:
        self._bucket.spend(now, count)
        self._traffic_at = now

    @property
    def round_time(self) -> int:
        """Ns to repeat everything."""
        if self._crowd:
            return max(self._presence_period, _ITEM_MESSAGES * self._bucket.gap * (self._places + 1))
        slot = max(self._interval, _ITEM_MESSAGES * self._bucket.gap, self._quiet)
        return max(_ROUND, (self._places + 1) * slot)

    @property
    def relay_time(self) -> int:
        """Ns until all items that wait to be relayed have had their turn."""
        return 2 * _ITEM_MESSAGES * self._bucket.gap * len(self._relayed)

    @property
    def _places(self) -> int:
        """Steps in one turn of the ring: each of its items, and a share of the slow ones."""
        return self._count - len(self._slow) * (self._rounds - 1) // self._rounds

    @property
    def _interval(self) -> int:
        if not self._crowd:
            return min(_STEP, _ROUND // (self._places + 1))
        share = self._rounds * (self._count - len(self._slow)) + len(self._slow)
        return self._together * self._crowd_round * self._rounds // max(1, share)

    @property
    def _together(self) -> int:
        """The number of items that one step repeats: more than one if none of them awaits an answer."""
        return max(1, min(_TOGETHER, len(self._slow))) if self._lossless and not self._ring else 1

    @property
    def _presence_period(self) -> int:
        period = min(_ROUND, _STEP * (self._places + 1))
        if self._crowd:
            period = self._crowd_round
        return max(period, _PRESENCE_SHARE * self._bucket.gap)

    @property
    def _crowd_round(self) -> int:
        """Ns in which a module of a crowd repeats its presence, and what it says in every round."""
        each, most = _ROUND_MODULES, _ROUND_MAX
        if self._lossless:
            each, most = _LOSSLESS_ROUND_MODULES, _LOSSLESS_ROUND_MAX
        return _ROUND * min(max(1, self._crowd // each), most)

    def _repeat(self, now: int) -> None:
        self._repeated_at, self._repeat_at, self._tool_waits = now, None, False
        self._hurry()

    def _hurry(self) -> None:
        """Announce everything without waiting, and once more in the next turn if an answer may be lost."""
        self._include_slow()
        self.revision += 1
        self._eager, self._lap = self._count, self._turns * self._count

    def _include_slow(self) -> None:
        """Announce everything in the next turn, first the names behind aliases, as all others travel as these."""
        names = [item for item in self._slow if item.kind is ItemKind.LONG_NAME]
        self._ring.update(self._slow)
        self._slow.clear()
        for item in reversed(names):
            self._ring.move_to_end(item, last=False)
        self._lap = max(self._lap, self._count)

    def _presence(self, now: int) -> Item:
        self._presence_sent, self._presence_at = now, now + self._presence_period
        return Item(ItemKind.PRESENCE, once=True)

    def _repetition(self, now: int) -> Item:
        """The next item of the ring, or of the slow ring so often that it turns once in `_rounds`."""
        ring, slow = self._ring, self._slow
        if not self._eager:
            self._burst = (self._burst or self._together) - 1
        share = self._rounds * len(ring) + len(slow)
        self._owed += len(slow)  # of `share` steps, len(slow) go to the slow ring
        if slow and self._owed >= share:
            self._owed %= share
            return _next(slow)
        item = _next(ring)
        if self._eager:
            self._eager -= 1
            self.revision += 1
        self._lap -= 1
        if self._lap == 0:
            self._slow_down()
            if self._lossless:
                self._step_at = now + self._interval  # what the fast ring had is not repeated at its pace
        return item

    def _announced(self, item: Item) -> None:
        """Enter a new item into a ring, as it is announced for the first time."""
        self.revision += 1
        if self._lossless and self._is_slow(item):
            self._slow[item] = None
        else:
            self._ring[item] = None
            self._lap = max(self._lap, len(self._ring))

    def _is_slow(self, item: Item) -> bool:
        return item.kind in _DESCRIBING or (self._crowd > 0 and self.is_settled(item))

    def _slow_down(self) -> None:
        """Move endpoints and names to the slow ring, as everything was announced; in a crowd also topics."""
        for item in [item for item in self._ring if self._is_slow(item)]:
            del self._ring[item]
            self._slow[item] = None
        if self._crowd:
            self._lap = len(self._ring)  # then those that wait for an answer are looked at once more

    def _turn_at(self) -> int:
        if self._eager > self._count:
            self._eager = self._count
        turn = self._presence_at
        if self._eager or self._burst:
            turn = 0
        elif self._step_at < turn:
            turn = self._step_at
        if self._repeat_at is not None and self._repeat_at < turn:
            turn = self._repeat_at
        quiet_at, latest = self._traffic_at + self._quiet, self._step_at + _QUIET_MAX
        if latest < quiet_at:
            quiet_at = latest
        if turn > quiet_at:
            return turn
        return quiet_at


def _next(ring: OrderedDict[Item, None]) -> Item:
    """The next item of a ring, which becomes its last one."""
    item = next(iter(ring))
    ring.move_to_end(item)
    return item
