"""Who is the master: the highest (priority, id8) of those that say they could be (PROTOCOL.md 6, thesis 4.3.3).

Every claim of an id8 carries a priority. Who knows no master announces itself and waits for a while; then it takes
over if it has heard of nobody better, or else later, the later the more were better: one of those may have died. Till
the new master has sent its first sync, nobody sends anything but management.
Priority 0 never takes over: such a node (a PC by default) would hold the cycle worse than none, and a better one that
comes later does not take it away.
"""

import enum
from collections.abc import Callable

from r2p.codecs import rtcan
from r2p.protocols.rtcan.cycle import HOLDOVER, Cycle
from r2p.protocols.rtcan.events import Outcome
from r2p.protocols.rtcan.leases import SlotGrants
from r2p.protocols.rtcan.transmitter import FirstSync, SlotTransmitter
from r2p.protocols.timers import KeyedTimers

FRESH = 1_500_000_000
"""A candidate counts for this long after it announced itself (ns)."""


class Role(enum.Enum):
    """What the node is to the network."""

    NONE = "no master"
    ELECTING = "electing"
    SLAVE = "slave"
    MASTER = "master"


class Election:
    """The election of one node with this `priority`; `window` is how long announcements are waited for (ns)."""

    def __init__(self, priority: int, window: int, timers: KeyedTimers) -> None:
        self.role = Role.NONE
        self._priority = priority
        self._window = window
        self._timers = timers
        self._candidates: dict[int, tuple[int, int]] = {}
        self._patience = 0

    def heard(self, now: int, id8: int, priority: int) -> None:
        """A node announced itself."""
        if priority:
            self._candidates[id8] = priority, now
        else:
            self._candidates.pop(id8, None)

    def begin(self, now: int, *, forget: bool) -> None:
        """There is no master: collect candidates. `forget`: those of before may be dead."""
        if forget:
            self._candidates.clear()
        self.role = Role.ELECTING
        self._patience = 0
        self._timers.set("election", now + self._window)

    def decide(self, now: int, id8: int) -> bool:
        """The time is over. Says whether to take over."""
        better = self._better(now, id8)
        if better > self._patience:
            self._timers.set("election", now + (better - self._patience) * self._window)
            self._patience = better
            return False
        if not self._priority:
            self.role = Role.NONE
        return bool(self._priority)

    def again(self, at: int) -> None:
        """Taking over did not work: try it once more then."""
        self._timers.set("election", at)

    def end(self, role: Role) -> None:
        """Somebody is the master."""
        self.role = role
        self._timers.clear("election")

    def beats(self, id8: int, priority: int, other: int) -> bool:
        """Whether we, with this id8, are the better master than `other`."""
        return (self._priority, id8) > (priority, other)

    def _better(self, now: int, id8: int) -> int:
        """How many candidates are better."""
        mine = (self._priority, id8)
        return sum((priority, other) > mine for other, (priority, at) in self._candidates.items() if now < at + FRESH)


# Being the master: the first sync frame of all, then one at the start of every cycle.


_COLLECTING = 3  # cycles
_TRIES = 4  # of the first sync: it may meet another one. Who is alone gets no acknowledge, and leads all the same


class MasterRole:
    """The master's part of one node. `crowned(now, inherits)`: it leads from now on; `again(now)`: call `found` later.

    A master of a network that was there before collects leases for three cycles before it grants anything new.
    """

    def __init__(
        self,
        cycle: Cycle,
        sender: SlotTransmitter,
        grants: SlotGrants,
        crowned: Callable[[int, bool], None],
        again: Callable[[int], None],
    ) -> None:
        self._cycle = cycle
        self._sender = sender
        self._grants = grants
        self._crowned = crowned
        self._again = again
        self._first: tuple[rtcan.Frame, int, int, int] | None = None  # the first sync on its way: start, count, mask
        self._tries = 0
        self._collecting = 0
        self._inherits = False

    def found(self, now: int, *, inherits: bool) -> None:
        """Send the first sync. What was before goes on if it `inherits`: the grid, the count, the leases."""
        self._grants.clear()
        self._inherits = self._cycle.anchored = inherits
        self._collecting = _COLLECTING if inherits else 0
        self._grants.collecting = inherits
        start, counter = self._cycle.upcoming(now)
        mask = self._grants.calendar.mask(counter)
        frame = rtcan.encode_sync(counter, mask)
        if self._sender.found(FirstSync(self._sent), frame, start):
            self._first = frame, start, counter, mask
        else:
            self._again(now)

    def cancel(self) -> None:
        """It is not to be. A first sync that waits is withdrawn, as all frames are when the mode changes."""
        self._tries = 0
        self._first = None

    def turn(self, now: int) -> bool:
        """The next cycle begins. False: that should have been long ago."""
        if now > self._cycle.reference + (HOLDOVER + 2) * self._cycle.timing.cycle:
            return False
        if self._collecting:
            self._collecting -= 1
            self._grants.collecting = self._collecting > 0
        frame = self._cycle.advance(self._grants.calendar.mask(self._cycle.counter + 1))
        self._sender.turned(now)
        self._sender.sync(now, frame)
        return True

    def end(self) -> None:
        """Somebody else may lead from now on."""
        self._cycle.stop()
        self._grants.clear()

    def _sent(self, now: int, outcome: Outcome, at: int) -> None:
        """What became of the first sync."""
        if self._first is None:
            return
        frame, planned, counter, mask = self._first
        self._first = None
        if outcome is Outcome.SENT:
            start = at - rtcan.frame_bits(frame.id, frame.data) * self._cycle.timing.bit
            if self._inherits and not self._cycle.late(max(0, start - planned)):
                self._inherits = self._grants.collecting = False
                self._collecting = 0
            self._lead(now, start, counter, mask)
        elif outcome is not Outcome.UNKNOWN and self._tries < _TRIES:
            self._tries += 1
            self._again(now)
        else:  # nobody knows of it; the next one is on the grid
            start, counter = self._cycle.upcoming(now)
            self._lead(now, start - self._cycle.timing.cycle, counter - 1, None)

    def _lead(self, now: int, start: int, counter: int, mask: int | None) -> None:
        self._tries = 0
        self._cycle.lead(start, counter, mask, anew=not self._inherits)
        self._crowned(now, self._inherits)
        self._sender.turned(now)
