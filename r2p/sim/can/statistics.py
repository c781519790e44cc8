"""Counters of what a bus carried, by message and by node. They count `FrameRecord`s, so they fit any bus."""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING

from r2p.codecs.rtcan import INTERMISSION, message_of

if TYPE_CHECKING:
    from r2p.sim.can.node import FrameRecord


class Count:
    """Frames that were sent, with their bits (stuff bits included, intermission not), and what was not sent."""

    __slots__ = ("bits", "error_bits", "errors", "frames", "lost")

    def __init__(self) -> None:
        self.frames = 0
        self.bits = 0
        self.errors = 0  # attempts that ended with an error frame
        self.error_bits = 0  # ... and the bits they took, error frame included
        self.lost = 0  # arbitrations lost

    def add(self, other: Count) -> None:
        """Add the numbers of another counter."""
        for name in self.__slots__:
            setattr(self, name, getattr(self, name) + getattr(other, name))

    @property
    def occupied(self) -> int:
        """Bit times in which the bus was not free: all bits, with the intermission that follows."""
        return self.bits + self.error_bits + INTERMISSION * (self.frames + self.errors)


class Statistics:
    """Totals, and counts by message id and by node. A frame that several nodes sent as one counts for each of them."""

    def __init__(self, bit: int, since: int) -> None:
        """`bit`: the length of a bit in ns. `since`: the instant from which the load counts, in ns."""
        self.since = since
        self._bit = bit
        self._counts: defaultdict[tuple[int, tuple[str, ...]], Count] = defaultdict(Count)  # by message id and senders

    @property
    def total(self) -> Count:
        total = Count()
        for count in self._counts.values():
            total.add(count)
        return total

    @property
    def by_message(self) -> dict[int, Count]:
        counts: defaultdict[int, Count] = defaultdict(Count)
        for (message, _), count in self._counts.items():
            counts[message].add(count)
        return dict(counts)

    @property
    def by_node(self) -> dict[str, Count]:
        counts: defaultdict[str, Count] = defaultdict(Count)
        for (_, senders), count in self._counts.items():
            for name in senders:
                counts[name].add(count)
        return dict(counts)

    def add(self, record: FrameRecord) -> None:
        """Count a frame or a failed attempt."""
        count = self._counts[message_of(record.frame.id), record.senders]
        if record.error is None:
            count.frames += 1
            count.bits += record.bits
        else:
            count.errors += 1
            count.error_bits += record.bits

    def add_lost(self, name: str, identifier: int) -> None:
        """Count an arbitration that this node lost with this identifier."""
        self._counts[message_of(identifier), (name,)].lost += 1

    def load(self, now: int) -> float:
        """Return the share of the time up to `now` (ns) in which the bus was occupied: 1.0 is saturated."""
        elapsed = now - self.since
        return self.total.occupied * self._bit / elapsed if elapsed > 0 else 0.0
