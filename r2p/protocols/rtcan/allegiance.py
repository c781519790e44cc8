"""Whose syncs are those that a slave follows? A sync frame does not say; NETWORK, which comes once a second, does.

So it is told by what fits: the grid and the count of before, a counter that is near ours, the length of a cycle. Of two
masters the lesser one yields at once: if the syncs go on after a better one has spoken, they are the better one's.
"""

import msgspec

from r2p.codecs import management
from r2p.protocols.rtcan.cycle import Cycle
from r2p.protocols.rtcan.events import LONG_AGO

FORGOTTEN = 3_000_000_000
"""A master that is not heard for so long is none (ns)."""
_UNKNOWN_MASTER = 1_200_000_000  # a master that sends no NETWORK for so long is firmware
_NEAR = 4  # cycles that a NETWORK may be late, or the last one be a guess
_YIELDED = 3  # cycles after which a lesser master's syncs are over


class Allegiance:
    """What is known about the master of the cycle that a node follows."""

    def __init__(self, cycle: Cycle) -> None:
        self._cycle = cycle
        self._heard = LONG_AGO
        self._rank = (0, 0)
        self._latest: tuple[int, management.Network] | None = None
        self._rival: tuple[int, management.Network] | None = None
        self._since = 0

    def told(self, now: int, told: management.Network, master: int | None, epoch: int | None) -> bool:
        """A master says who it is; ours so far is this one. Says whether it is ours."""
        self._latest = now, told
        rank = told.priority, told.id8
        if self._is_another(now, told, master, epoch):
            if rank > self._rank:
                self._rival = self._latest
            return False
        self._heard, self._rank = now, rank
        return True

    def matches(self, told: management.Network) -> bool:
        """Whether a network has our slots."""
        timing = self._cycle.timing
        return (told.slots, told.slot) == (timing.slots, timing.slot)

    def started(self, now: int) -> management.Network | None:
        """A cycle has started: what its master last said, if it is the one that spoke last, by its count."""
        self._since = now
        self._rival = None
        return self._recall(now, self._latest)

    def goes_on(self, now: int) -> management.Network | None:
        """One more sync: what its master said, if it is another one than ours."""
        rival = self._rival
        if rival is None or now < rival[0] + _YIELDED * self._cycle.timing.cycle:
            return None
        self._rival = None
        return self._recall(now, rival)

    def foreign(self) -> None:
        """A sync is off our grid: there is another master, but ours has not become it."""
        self._rival = None

    def believed(self, now: int) -> bool | None:
        """Whether a master that sends no NETWORK has our cycle, by its length; None: not known yet."""
        measured = self._cycle.measured()
        if now < self._since + _UNKNOWN_MASTER or measured is None:
            return None
        ours = self._cycle.timing.cycle
        length, error = measured
        return abs(length - ours) <= ours // 1000 + error

    def forget(self, master: int | None) -> None:
        """This master's syncs are over."""
        self._rival = None
        if self._latest is not None and self._latest[1].id8 == master:
            self._latest = None

    def _is_another(self, now: int, told: management.Network, master: int | None, epoch: int | None) -> bool:
        """Whether the syncs that we follow are those of another master; one of the two will yield."""
        if not self._cycle.running or master is None or now > self._heard + FORGOTTEN:
            return False
        if (told.id8, told.epoch) == (master, epoch):
            return False
        same_grid = told.epoch == epoch and -_NEAR <= told.cycle - self._cycle.counter <= _NEAR
        return not (same_grid and (told.priority, told.id8) > self._rank)

    def _recall(self, now: int, heard: tuple[int, management.Network] | None) -> management.Network | None:
        """What a master said, as it would say it now, if it can be the master of this cycle."""
        if heard is None or now > heard[0] + FORGOTTEN:
            return None
        at, told = heard
        counter = told.cycle + (now - at) // self._cycle.timing.cycle
        near = (self._cycle.counter - counter + _NEAR) & 0xFF <= 2 * _NEAR
        if not near or not self.matches(told):
            return None
        self._heard, self._rank = at, (told.priority, told.id8)
        return msgspec.structs.replace(told, cycle=counter)
