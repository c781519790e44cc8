"""The id8 of this node, claimed with a random number (PROTOCOL.md 9).

The node listens first, to learn the ids in use and the kind of network; then it claims one, and may use it if no other
node objects. Of two claims the lower number wins. A node that owns its id8 yields only to the second better claim: a
real rival repeats its claim when this node answers, a broken one does not. A node that uses this id8 without ever
claiming it is firmware, which can't yield: so this node does. After yielding it listens again.
"""

import enum
from collections.abc import Callable

from r2p.codecs.management import CLAIM_FIXED, Claim
from r2p.protocols.rtcan.events import EngineContext, IdConflict
from r2p.units import LONG_AGO, SECOND

# All in ns.
OBJECTION = 250_000_000
"""Time in which others may object to a claim."""
REPEAT = 3_000_000_000
"""Time between two claims."""
_YIELDS = SECOND  # a node that has claimed this id8 with a higher number has this long to yield
_APART = 100_000_000  # between two claims of this node
_INSISTING = 4_000_000_000  # a node that has a better claim repeats it within this: REPEAT, and room for a full bus
_FIRMWARE = 500_000_000  # a node that uses this id8 for so long after the claim, without one of its own, is firmware
_NOTICE = SECOND  # between two `IdConflict`
_SPREAD = 50_000_000  # nodes that are switched on together don't claim together


class Stage(enum.Enum):
    """The node's progress towards an id8."""

    LISTENING = "listening"
    CLAIMING = "claiming"
    OWNING = "owning"


class NodeId:
    """The id8 of a node, by its settings: fixed, or any free one.

    `send_claim(now)` sends a claim of this node; `on_stage(now)` is called when the stage changes.
    """

    def __init__(
        self, context: EngineContext, send_claim: Callable[[int], None], on_stage: Callable[[int], None]
    ) -> None:
        settings = context.settings
        self.stage = Stage.LISTENING
        self.fixed = settings.id8 is not None
        self.id8 = settings.id8 or 0
        self.number = settings.number >> 8 if self.fixed else settings.number | 1 << 63
        """The number in the claims: lower for fixed ids, so that a node that can't take another id8 wins."""
        self._context = context
        self._timers = context.timers
        self._send_claim = send_claim
        self._on_stage = on_stage
        self._taken: set[int] = set()
        self._claimed_at = LONG_AGO
        self._noticed_at = LONG_AGO
        self._rival_claimed_at = LONG_AGO
        self._suspected_at: int | None = None  # the first frame with this id8 of a node that does not claim it
        self._disputed_at = LONG_AGO  # the last claim of this id8 with a lower number
        self._waiting = False  # for a fixed id8 that is taken; its `IdConflict` is out

    @property
    def flags(self) -> int:
        return CLAIM_FIXED if self.fixed else 0

    def start(self, now: int) -> None:
        """Listen for the id8 in use."""
        self._suspected_at = None
        self._taken.clear()
        self.stop(now)
        self._timers.set("listened", now + self._context.settings.listen + self._context.draw(_SPREAD))

    def stop(self, now: int) -> None:
        """Give up the id8."""
        self.stage = Stage.LISTENING
        self._timers.clear("listened")
        self._timers.clear("claim")
        self._on_stage(now)

    def mark_taken(self, id8: int) -> None:
        """Note that a node uses this id8."""
        self._taken.add(id8)

    def on_listened(self, now: int) -> None:
        """Claim an id8, now that the time to listen is over; if a fixed one is taken, listen on."""
        if self.fixed and self.id8 in self._taken:
            if not self._waiting:
                self._waiting = True
                self._notice(now, yielded=True)
            self.start(now)
            return
        self._waiting = False
        if not self.fixed:
            free = [id8 for id8 in range(1, 255) if id8 not in self._taken] or list(range(1, 255))
            if self.id8 not in free:  # else it is the one that this node had before
                self.id8 = free[self._context.draw(len(free))]
        self.stage = Stage.CLAIMING
        self._on_stage(now)
        self.claim(now)
        self._timers.set("claim", now + OBJECTION)

    def on_claim_timer(self, now: int) -> None:
        """Own the id8, as no other node objected; or repeat the claim."""
        if self.stage is Stage.CLAIMING:
            self.stage = Stage.OWNING
            self._on_stage(now)
        self._timers.set("claim", now + REPEAT)
        self.claim(now)

    def claim(self, now: int, *, at_once: bool = False) -> None:
        """Send this node's claim; not more often than every 100 ms unless `at_once`."""
        if self.stage is not Stage.LISTENING and (at_once or now >= self._claimed_at + _APART):
            self._claimed_at = now
            self._send_claim(now)

    def on_claim(self, now: int, claim: Claim) -> None:
        """Answer the claim of another node if it is for this node's id8: insist or yield."""
        self._taken.add(claim.id8)
        if claim.id8 != self.id8 or self.stage is Stage.LISTENING:
            return
        self._rival_claimed_at = now
        self._suspected_at = None
        if claim.number >= self.number:
            self._notice(now, yielded=False)
            self.claim(now)
        elif self.stage is not Stage.OWNING or now < self._disputed_at + _INSISTING:
            self._yield(now)
        else:  # a single better claim that is not repeated may be a broken node's
            self._disputed_at = now
            self._notice(now, yielded=False)
            self.claim(now, at_once=True)
            self._timers.set("claim", now + _APART + _SPREAD)  # the answer to this one may come at once

    def duplicate_id_seen(self, now: int) -> None:
        """Handle a frame with this node's id8 that another node sent."""
        if self.stage is Stage.LISTENING:
            return
        self._context.counts["frames with our id8"] += 1
        if now < self._rival_claimed_at + _YIELDS:
            return  # it has claimed, so it will yield
        self._notice(now, yielded=False)
        if self._suspected_at is None or now > self._suspected_at + 2 * _YIELDS:
            self._suspected_at = now
            self.claim(now)
        elif now >= self._suspected_at + _FIRMWARE:
            self._yield(now)

    def _yield(self, now: int) -> None:
        self._noticed_at = self._disputed_at = LONG_AGO
        self._notice(now, yielded=True)
        self._waiting = self.fixed
        taken = self.id8
        self.start(now)
        self._taken.add(taken)

    def _notice(self, now: int, *, yielded: bool) -> None:
        if now >= self._noticed_at + _NOTICE:
            self._noticed_at = now
            self._context.actions.append(IdConflict(self.id8, yielded))
