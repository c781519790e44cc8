"""The election of the master, and the master's sync frames (PROTOCOL.md 6, thesis 4.3.3).

The master is the candidate with the highest (priority, id8). Every claim of an id8 carries a priority. A node that
knows no master sends its claim and waits for a while; then it is elected if it knows of no better candidate, or else
later, as those may have died: the later, the more there are. Until the new master has sent its first sync, nodes send
nothing but management. Priority 0 is never elected: such a node (a PC by default) would keep the cycle worse than no
master, and a better node that joins later does not depose a present master.
"""

import enum
from collections.abc import Callable

from r2p.codecs.can_bits import start_of_frame
from r2p.codecs.rtcan import decode_sync
from r2p.protocols.can_orders import Outcome
from r2p.protocols.rtcan.cycle import HOLDOVER
from r2p.protocols.rtcan.events import EngineContext
from r2p.protocols.rtcan.leases import SlotGrants
from r2p.protocols.rtcan.transmitter import FirstSync, SlotTransmitter

FRESH = 1_500_000_000
"""A candidate counts for this long after its claim (ns)."""
_WINDOW = 3  # cycles in which claims are collected
_COLLECTING = 3  # cycles in which a new master only renews what the last one granted
# Attempts after the first one to send the first sync, which may collide. A node alone gets no acknowledge, and leads
# nevertheless.
_RETRIES = 4
_RETRY_PAUSE_MAX = 20_000_000  # ns, drawn at random: two nodes that collided would else collide again


class Role(enum.Enum):
    """The node's part in the network."""

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
        """Note the claim of a node."""
        if priority:
            self._candidates[id8] = priority, now
        else:
            self._candidates.pop(id8, None)

    def begin(self, now: int, *, forget: bool) -> None:
        """Start an election: collect candidates. `forget`: drop those known so far, which may be dead."""
        if forget:
            self._candidates.clear()
        self.role = Role.ELECTING
        self._waited_for = 0
        self._timers.set("election", now + self._window)

    def decide(self, now: int, id8: int) -> bool:
        """End the collection window; return whether this node is elected."""
        mine = (self._priority, id8)
        known = [(priority, other) for other, (priority, at) in self._candidates.items() if now < at + FRESH]
        better = sum(candidate > mine for candidate in known)
        if better > self._waited_for:
            self._timers.set("election", now + (better - self._waited_for) * self._window)
            self._waited_for = better
            return False
        if not self._priority:
            self.role = Role.NONE
        return bool(self._priority)

    def end(self, role: Role) -> None:
        """End the election with this role."""
        self.role = role
        self._timers.clear("election")

    def beats(self, id8: int, priority: int, other: int) -> bool:
        """Return whether this node, with this id8, is a better master than `other`."""
        return (self._priority, id8) > (priority, other)


class MasterRole:
    """The master's part of one node: the first sync of all, then one at the start of every cycle.

    `on_elected(now, inherits)`: this node is the master from now on. A master that inherits a network renews leases for
    three cycles before it grants anything new.
    """

    def __init__(
        self,
        context: EngineContext,
        transmitter: SlotTransmitter,
        grants: SlotGrants,
        on_elected: Callable[[int, bool], None],
    ) -> None:
        self._context = context
        self._cycle = context.cycle
        self._transmitter = transmitter
        self._grants = grants
        self._on_elected = on_elected
        self._first: FirstSync | None = None  # with the port
        self._retries = 0
        self._collecting = 0
        self._inherits = False

    def start_network(self, now: int, *, inherits: bool) -> None:
        """Send the first sync. With `inherits`, the previous network goes on: its grid, count and leases."""
        self._grants.clear()
        self._set_inherits(inherits)
        frame, start, counter = self._cycle.first_sync(now, self._grants.calendar.mask, inherits=inherits)
        first = FirstSync(frame, start, counter, self._first_confirmed)
        if self._transmitter.send_first_sync(first):
            self._first = first
        else:
            self._retry(now)

    def cancel(self) -> None:
        """Abandon the attempt to become master.

        A first sync that waits is withdrawn, as all frames are when the mode changes.
        """
        self._retries = 0
        self._first = None

    def begin_cycle(self, now: int) -> bool:
        """Begin the next cycle with a sync; return False if this node stood still too long to stay master."""
        # Slaves lose the cycle after HOLDOVER + 1 cycles without a sync, and then collect claims for _WINDOW cycles: a
        # sync within one cycle of that still comes before another master's.
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
        self._grants.clear()  # their owners ask the next master for the same slots

    def _set_inherits(self, inherits: bool) -> None:
        self._inherits = self._grants.collecting = inherits
        self._collecting = _COLLECTING if inherits else 0

    def _retry(self, now: int) -> None:
        """Repeat the election a bit later: try the first sync again unless another node was first."""
        self._context.timers.set("election", now + self._context.draw(_RETRY_PAUSE_MAX))

    def _first_confirmed(self, now: int, outcome: Outcome, at: int) -> None:
        """Lead, or try again, depending on the outcome of the first sync."""
        first, self._first = self._first, None
        if first is None:  # cancelled meanwhile
            return
        if outcome is Outcome.SENT:
            start = start_of_frame(first.frame, at, self._cycle.timing.bit)
            if self._inherits and not self._cycle.delay(max(0, start - first.start)):
                self._set_inherits(False)
            self._lead(now, start, first.counter, decode_sync(first.frame).mask)
            if self._context.report_syncs:
                self._context.report_sync(first.frame, at)
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
