"""Being the master: the first sync frame of all, then one at the start of every cycle.

The first one may start when the bus lets it, and the cycle begins where it did: as long as there are no slots the bus
may be full, and a sync that had to hit an instant would not get through for a while; others would take over as well.
One that leaves half a cycle late or more has a count that is over: from there on it is another network, of a new epoch,
as its time would be behind for good.
"""

from collections.abc import Callable

from r2p.codecs import rtcan
from r2p.protocols.rtcan.cycle import HOLDOVER, Cycle
from r2p.protocols.rtcan.events import Outcome
from r2p.protocols.rtcan.leases import Grants
from r2p.protocols.rtcan.post import FirstSync
from r2p.protocols.rtcan.sending import Sender

_COLLECTING = 3  # cycles
_TRIES = 4  # of the first sync: it may meet another one. Who is alone gets no acknowledge, and leads all the same


class Reign:
    """The master's part of one node. `crowned(now, inherits)`: it leads from now on; `again(now)`: call `found` later.

    A master of a network that was there before collects leases for three cycles before it grants anything new.
    """

    def __init__(
        self,
        cycle: Cycle,
        sender: Sender,
        grants: Grants,
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
