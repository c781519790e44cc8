"""The election of the master, and what a master does: it sends the sync frames (PROTOCOL.md 6, thesis 4.3.3).

The master is the highest (priority, id8) of those that say they could be. Every claim of an id8 carries a priority. A
node that knows no master sends its claim and waits for a while; then it is elected if it knows of no better candidate,
or else later, the later the more are better: one of those may have died. Until the new master has sent its first sync,
nodes send nothing but management.
Priority 0 is never elected: such a node (a PC by default) would keep the cycle worse than no master, and a better node
that comes later does not depose a master that is there.
"""

import enum
from collections.abc import Callable

from r2p.codecs import rtcan
from r2p.protocols.rtcan.context import EngineContext
from r2p.protocols.rtcan.cycle import HOLDOVER
from r2p.protocols.rtcan.events import Outcome
from r2p.protocols.rtcan.leases import SlotGrants
from r2p.protocols.rtcan.transmitter import FirstSync, SlotTransmitter

FRESH = 1_500_000_000
"""A candidate counts for this long after its claim (ns)."""
_WINDOW = 3  # cycles in which claims are collected
_COLLECTING = 3  # cycles in which a new master only renews what the last one granted
# Attempts after the first one to send the first sync, which may collide. A node alone gets no acknowledge: it leads all
# the same.
_RETRIES = 4


class Role(enum.Enum):
    """What the node is to the network."""

    NONE = "no master"
    ELECTING = "electing"
    SLAVE = "slave"
    MASTER = "master"


class Election:
    """The role of one node, and the candidates that it knows."""

    def __init__(self, context: EngineContext) -> None:
        self.role = Role.NONE
        self._priority = context.settings.priority
        self._window = _WINDOW * context.timing.cycle
        self._timers = context.timers
        self._candidates: dict[int, tuple[int, int]] = {}  # by id8: priority, and when it sent its claim
        self._waited_for = 0  # better candidates that had their time to be elected

    def on_claim(self, now: int, id8: int, priority: int) -> None:
        """A node sent its claim."""
        if priority:
            self._candidates[id8] = priority, now
        else:
            self._candidates.pop(id8, None)

    def begin(self, now: int, *, forget: bool) -> None:
        """Start an election: collect candidates. `forget` those known so far, which may be dead."""
        if forget:
            self._candidates.clear()
        self.role = Role.ELECTING
        self._waited_for = 0
        self._timers.set("election", now + self._window)

    def decide(self, now: int, id8: int) -> bool:
        """End the collection window; return whether this node is elected."""
        better = self._better(now, id8)
        if better > self._waited_for:
            self._timers.set("election", now + (better - self._waited_for) * self._window)
            self._waited_for = better
            return False
        if not self._priority:
            self.role = Role.NONE
        return bool(self._priority)

    def retry(self, at: int) -> None:
        """The first sync did not get through: decide again then."""
        self._timers.set("election", at)

    def end(self, role: Role) -> None:
        """The election is over, with this role."""
        self.role = role
        self._timers.clear("election")

    def beats(self, id8: int, priority: int, other: int) -> bool:
        """Whether this node, with this id8, is the better master than `other`."""
        return (self._priority, id8) > (priority, other)

    def _better(self, now: int, id8: int) -> int:
        """How many candidates are better."""
        mine = (self._priority, id8)
        return sum((priority, other) > mine for other, (priority, at) in self._candidates.items() if now < at + FRESH)


class MasterRole:
    """The master's part of one node: the first sync of all, then one at the start of every cycle.

    `on_elected(now, inherits)`: this node is the master from now on; `retry(now)`: call `start_network` later. A master
    that inherits a network renews leases for three cycles before it grants anything new.
    """

    def __init__(
        self,
        context: EngineContext,
        transmitter: SlotTransmitter,
        grants: SlotGrants,
        on_elected: Callable[[int, bool], None],
        retry: Callable[[int], None],
    ) -> None:
        self._cycle = context.cycle
        self._transmitter = transmitter
        self._grants = grants
        self._on_elected = on_elected
        self._retry = retry
        self._first: tuple[rtcan.Frame, int, int, int] | None = None  # the first sync with the port: start, count, mask
        self._retries = 0
        self._collecting = 0
        self._inherits = False

    def start_network(self, now: int, *, inherits: bool) -> None:
        """Send the first sync. If it `inherits`, the network of before goes on: the grid, the count, the leases."""
        self._grants.clear()
        self._inherits = self._cycle.anchored = inherits
        self._collecting = _COLLECTING if inherits else 0
        self._grants.collecting = inherits
        start, counter = self._cycle.upcoming(now)
        mask = self._grants.calendar.mask(counter)
        frame = rtcan.encode_sync(counter, mask)
        if self._transmitter.send_first_sync(FirstSync(self._first_confirmed), frame, start):
            self._first = frame, start, counter, mask
        else:
            self._retry(now)

    def cancel(self) -> None:
        """Abandon the attempt to become master.

        A first sync that waits is withdrawn, as all frames are when the mode changes.
        """
        self._retries = 0
        self._first = None

    def begin_cycle(self, now: int) -> bool:
        """Begin the next cycle with a sync. False: this node stood still too long to stay master."""
        if now > self._cycle.reference + (HOLDOVER + 2) * self._cycle.timing.cycle:
            return False
        if self._collecting:
            self._collecting -= 1
            self._grants.collecting = self._collecting > 0
        frame = self._cycle.advance(self._grants.calendar.mask(self._cycle.counter + 1))
        self._transmitter.begin_cycle(now)
        self._transmitter.send_sync(now, frame)
        return True

    def step_down(self) -> None:
        """Give up the role."""
        self._cycle.stop()
        self._grants.clear()

    def _first_confirmed(self, now: int, outcome: Outcome, at: int) -> None:
        """Lead, or try again, by what became of the first sync."""
        if self._first is None:
            return
        frame, planned, counter, mask = self._first
        self._first = None
        if outcome is Outcome.SENT:
            start = at - rtcan.frame_bits(frame.id, frame.data) * self._cycle.timing.bit
            if self._inherits and not self._cycle.delay(max(0, start - planned)):
                self._inherits = self._grants.collecting = False
                self._collecting = 0
            self._lead(now, start, counter, mask)
        elif outcome is not Outcome.UNKNOWN and self._retries < _RETRIES:
            self._retries += 1
            self._retry(now)
        else:  # it may not have been on the bus; the next one is on the grid
            start, counter = self._cycle.upcoming(now)
            self._lead(now, start - self._cycle.timing.cycle, counter - 1, None)

    def _lead(self, now: int, start: int, counter: int, mask: int | None) -> None:
        self._retries = 0
        self._cycle.lead(start, counter, mask, anew=not self._inherits)
        self._on_elected(now, self._inherits)
        self._transmitter.begin_cycle(now)
