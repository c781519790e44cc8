"""Who this node is on the bus: its id8, claimed with a random number (PROTOCOL.md 9).

The node listens first, to learn which ids are taken and how the network works; then it claims one, and may use it when
nobody objected. Of two claims the lower number wins; a node that owns its id8 yields to the second one, as a node that
has the better claim answers when ours is repeated. A node that uses our id8 without ever claiming it is firmware,
which can't yield: so we do. Who yielded listens again.
"""

import enum
from collections import Counter
from collections.abc import Callable

from r2p.codecs.management import CLAIM_FIXED, Claim
from r2p.protocols.rtcan.events import LONG_AGO, Action, IdConflict
from r2p.protocols.timers import KeyedTimers

OBJECTION = 250_000_000
"""How long others may object to a claim (ns)."""
REPEAT = 3_000_000_000
"""Claims are repeated this often (ns)."""
_YIELDS = 1_000_000_000  # who has claimed our id8 with a higher number has this long to yield
_APART = 100_000_000
_INSISTING = 4_000_000_000  # a node that has a better claim repeats it within this (ns)
_FIRMWARE = 500_000_000
"""Who uses our id8 for this long after our claim, without a claim of its own, is firmware."""
_NOTICE = 1_000_000_000
_SPREAD = 50_000_000


class Stage(enum.Enum):
    """How far the node is."""

    LISTENING = "listening"
    CLAIMING = "claiming"
    OWNING = "owning"


class Identity:
    """The id8 of a node. `wanted` None: any that is free. `number`: 64 random bits, from which all else follows.

    `announce(now)` sends our claim; `changed(now)` is called when the stage changes.
    """

    def __init__(
        self,
        wanted: int | None,
        number: int,
        listen: int,
        timers: KeyedTimers,
        out: list[Action],
        counts: Counter[str],
        announce: Callable[[int], None],
        changed: Callable[[int], None],
    ) -> None:
        self.stage = Stage.LISTENING
        self.fixed = wanted is not None
        self.id8 = wanted or 0
        self._number = number
        self.number = number >> 8 if self.fixed else number | 1 << 63
        """What our claims say: who can't take another id8 wins against who can."""
        self._listen = listen
        self._timers = timers
        self._out = out
        self._counts = counts
        self._announce = announce
        self._changed = changed
        self._taken: set[int] = set()
        self._draws = 0
        self._announced = LONG_AGO
        self._noticed = LONG_AGO
        self._claimed_by_other = LONG_AGO
        self._suspected: int | None = None
        self._disputed = LONG_AGO  # when somebody claimed our id8 with a lower number
        self._waiting = False  # for a fixed id8 that is taken, which has been told

    @property
    def flags(self) -> int:
        return CLAIM_FIXED if self.fixed else 0

    def draw(self, below: int) -> int:
        """The next random number below this one."""
        self._draws += 1
        return _mix(self._number + self._draws) % below

    def start(self, now: int) -> None:
        """Listen to what is going on."""
        self.stage = Stage.LISTENING
        self._suspected = None
        self._taken.clear()
        self._timers.clear("claim")
        self._timers.set("listened", now + self._listen + self.draw(_SPREAD))
        self._changed(now)

    def stop(self, now: int) -> None:
        """Be nobody."""
        self.stage = Stage.LISTENING
        self._timers.clear("listened")
        self._timers.clear("claim")
        self._changed(now)

    def seen(self, id8: int) -> None:
        """A frame of this node was heard."""
        self._taken.add(id8)

    def listened(self, now: int) -> None:
        """It is time to claim an id8; for a fixed one that is taken, to listen on."""
        if self.fixed and self.id8 in self._taken:
            if not self._waiting:
                self._waiting = True
                self._notice(now, yielded=True)
            self.start(now)
            return
        self._waiting = False
        if not self.fixed:
            free = [id8 for id8 in range(1, 255) if id8 not in self._taken] or list(range(1, 255))
            if self.id8 not in free:  # else it is the one that we had before
                self.id8 = free[self.draw(len(free))]
        self.stage = Stage.CLAIMING
        self._changed(now)
        self.announce(now)
        self._timers.set("claim", now + OBJECTION)

    def repeat(self, now: int) -> None:
        """Nobody objected; or it is time to claim again."""
        if self.stage is Stage.CLAIMING:
            self.stage = Stage.OWNING
            self._changed(now)
        self._timers.set("claim", now + REPEAT)
        self.announce(now)

    def announce(self, now: int, *, again: bool = False) -> None:
        """Claim our id8; not more often than every 100 ms unless `again`."""
        if self.stage is not Stage.LISTENING and (again or now >= self._announced + _APART):
            self._announced = now
            self._announce(now)

    def claimed(self, now: int, claim: Claim) -> None:
        """Somebody claims an id8."""
        self._taken.add(claim.id8)
        if claim.id8 != self.id8 or self.stage is Stage.LISTENING:
            return
        self._claimed_by_other = now
        self._suspected = None
        if claim.number < self.number and self._insists(now):
            self._yield(now)
        elif claim.number < self.number:
            self._disputed = now
            self._notice(now, yielded=False)
            self.announce(now, again=True)
            self._timers.set("claim", now + _APART + _SPREAD)  # an answer to this one may come at once
        else:
            self._notice(now, yielded=False)
            self.announce(now)

    def duplicate_id_seen(self, now: int) -> None:
        """A frame with our id8 came in that we did not send."""
        if self.stage is Stage.LISTENING:
            return
        self._counts["frames with our id8"] += 1
        if now < self._claimed_by_other + _YIELDS:
            return  # it has claimed, so it will yield
        self._notice(now, yielded=False)
        if self._suspected is None or now > self._suspected + 2 * _YIELDS:
            self._suspected = now
            self.announce(now)
        elif now >= self._suspected + _FIRMWARE:
            self._yield(now)

    def _insists(self, now: int) -> bool:
        """Whether a better claim than ours ends it: one alone, which nobody stands up for, may be of a broken node."""
        return self.stage is not Stage.OWNING or now < self._disputed + _INSISTING

    def _yield(self, now: int) -> None:
        self._noticed = self._disputed = LONG_AGO
        self._notice(now, yielded=True)
        self._waiting = self.fixed
        taken = self.id8
        self.start(now)
        self._taken.add(taken)

    def _notice(self, now: int, *, yielded: bool) -> None:
        if now >= self._noticed + _NOTICE:
            self._noticed = now
            self._out.append(IdConflict(self.id8, yielded))


def _mix(number: int) -> int:
    """Splitmix64: numbers that look random, from numbers in a row."""
    number = (number * 0x9E3779B97F4A7C15) & 0xFFFFFFFFFFFFFFFF
    number = ((number ^ number >> 30) * 0xBF58476D1CE4E5B9) & 0xFFFFFFFFFFFFFFFF
    number = ((number ^ number >> 27) * 0x94D049BB133111EB) & 0xFFFFFFFFFFFFFFFF
    return number ^ number >> 31
