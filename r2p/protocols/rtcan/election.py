"""Who is the master: the highest (priority, id8) of those that say they could be (PROTOCOL.md 6, thesis 4.3.3).

Every claim of an id8 carries a priority. Who knows no master announces itself and waits for a while; then it takes
over if it has heard of nobody better, or else later, the later the more were better: one of those may have died. Till
the new master has sent its first sync, nobody sends anything but management.
Priority 0 never takes over: such a node (a PC by default) would hold the cycle worse than none, and a better one that
comes later does not take it away.
"""

import enum

from r2p.protocols.schedule import Timers

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

    def __init__(self, priority: int, window: int, timers: Timers) -> None:
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
