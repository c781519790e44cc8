"""The system matrix of TTCAN: who may send when in which basic cycle (ISO 11898-4), built for a set of messages.

A basic cycle begins with the reference message. A message whose period is shorter than it has several columns at equal
distances; one with a longer period has a cell of a column in every 2**k-th basic cycle, with k up to 6. What a column
leaves free, in time and in cells, are windows that all contend for.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import msgspec

from benchmarks.protocols.message_sets import longest_bits
from r2p.codecs.can_bits import FRAME_MAX
from r2p.units import SECOND

if TYPE_CHECKING:
    from benchmarks.protocols.message_sets import MessageSet, SetMessage

CYCLES = 64
"""Basic cycles in a matrix at most."""


class TimeWindow(msgspec.Struct, frozen=True):
    """A part of a basic cycle, in ns from its reference; in every `repeat`-th basic cycle from `phase` on."""

    start: int
    width: int
    repeat: int
    phase: int

    @property
    def end(self) -> int:
        return self.start + self.width

    def in_cycle(self, count: int) -> bool:
        """Return whether the basic cycle `count` has it."""
        return count % self.repeat == self.phase


class SystemMatrix:
    """The windows of a set: `exclusive` by message, `open` by basic cycle, as (start, end) in ns.

    `guard`: ns that a window is longer than its longest frame. Messages that have no place are `unplaced`.
    """

    def __init__(self, messages: MessageSet, reference: int, guard: int) -> None:
        self.set = messages
        self._bit = SECOND // messages.bitrate
        self._guard = guard
        self._reference = reference
        self.exclusive: dict[str, list[TimeWindow]] = {}
        self.unplaced: list[SetMessage] = []
        self.basic = self._best_basic_cycle()
        self._columns: list[tuple[int, int, list[int]]] = []  # start, width, the taken cells
        for message in self._ordered():
            if not self._place(message):
                self.unplaced.append(message)
        self.open = [self._gaps(count) for count in range(CYCLES)]

    def period(self, name: str) -> int:
        """Return the period that a message has in the matrix."""
        windows = self.exclusive[name]
        return self.basic * windows[0].repeat // len(windows)

    def width(self, message: SetMessage) -> int:
        """Return the length of a window for this message, of all its frames."""
        sizes = [min(FRAME_MAX, message.size - done) for done in range(0, message.size, FRAME_MAX)]
        return sum(longest_bits(each) * self._bit + self._guard for each in sizes)

    def _periodic(self) -> list[SetMessage]:
        return [each for each in self.set.messages if not each.sporadic]

    def _ordered(self) -> list[SetMessage]:
        """Those with several columns first, then the longest; of equal ones those with the shortest period."""
        return sorted(
            self._periodic(), key=lambda each: (-columns_of(each, self.basic), -each.size, each.period, each.name)
        )

    def _best_basic_cycle(self) -> int:
        """Return the multiple of the shortest period in which the messages need the least of the bus."""
        shortest = min(each.period for each in self._periodic())
        candidates = [shortest * factor for factor in range(1, 17)]
        return min(candidates, key=lambda basic: (round(self._share(basic), 6), basic))

    def _share(self, basic: int) -> float:
        used = sum(
            self.width(each) * columns_of(each, basic) / basic / repeat_of(each, basic) for each in self._periodic()
        )
        return used + self._reference / basic

    def _place(self, message: SetMessage) -> bool:
        columns, repeat = columns_of(message, self.basic), repeat_of(message, self.basic)
        width = self.width(message)
        if columns == 1:
            for start, wide, cells in self._columns:
                phase = next((p for p in range(repeat) if not any(cells[p::repeat])), None)
                if wide >= width and phase is not None:
                    self._take(message, [(start, wide, cells)], repeat, phase)
                    return True
        starts = self._free_starts(width, columns)
        if starts is None:
            return False
        added = [(start, width, [0] * CYCLES) for start in starts]
        self._columns += added
        self._take(message, added, repeat, 0)
        return True

    def _take(self, message: SetMessage, columns: list[tuple[int, int, list[int]]], repeat: int, phase: int) -> None:
        for _, _, cells in columns:
            cells[phase::repeat] = [1] * len(cells[phase::repeat])
        self.exclusive[message.name] = [TimeWindow(start, width, repeat, phase) for start, width, _ in columns]

    def _free_starts(self, width: int, count: int) -> list[int] | None:
        """Return where so many equidistant columns fit into the basic cycle, as early as possible."""
        busy = sorted([(0, self._reference), *((start, start + wide) for start, wide, _ in self._columns)])
        distance = self.basic // count
        for offset in sorted({end % distance for _, end in busy}):
            starts = [offset + number * distance for number in range(count)]
            if all(self._fits(start, start + width, busy) for start in starts):
                return starts
        return None

    def _fits(self, start: int, end: int, busy: list[tuple[int, int]]) -> bool:
        return end <= self.basic and all(end <= begin or start >= until for begin, until in busy)

    def _gaps(self, count: int) -> list[tuple[int, int]]:
        taken = [(0, self._reference), (self.basic, self.basic)]
        for windows in self.exclusive.values():
            taken += [(each.start, each.end) for each in windows if each.in_cycle(count)]
        return [(end, start) for (_, end), (start, _) in pairwise(sorted(taken)) if start > end]


def columns_of(message: SetMessage, basic: int) -> int:
    """Return how many columns a message has: more than one if its period is shorter than the basic cycle."""
    return max(1, -(-basic // message.period))


def repeat_of(message: SetMessage, basic: int) -> int:
    """Return the power of two of basic cycles after which a message comes again, 1 to 64."""
    repeat = 1
    while repeat < CYCLES and 2 * repeat * basic <= message.period:
        repeat *= 2
    return repeat
