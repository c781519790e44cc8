"""How tight the bounds of `r2p bus analyze` are: the slowest response that was simulated, as a share of the bound.

    python -m benchmarks.analysis            # some minutes
    python -m benchmarks.analysis --quick    # one set for each load

Random sets of messages by fixed seeds, on the bus that is exact to the bit, under virtual time: the same command prints
the same table. A share above 1 would be a bound that does not hold.
"""

from __future__ import annotations

import argparse
import random
import statistics
from typing import TYPE_CHECKING, Final

import msgspec

from benchmarks.analysis.sets import Compared, compare_rtcan, plain_set
from benchmarks.analysis.simulated import Arrival, plain_responses
from r2p.analysis import response_bounds
from r2p.codecs.can_bits import frame_bits
from r2p.units import MILLISECOND

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from r2p.analysis import BusMessage

PLAIN_LOADS: Final = (0.3, 0.5, 0.7, 0.9)
RTCAN_LOADS: Final = (0.2, 0.4, 0.6)
SETS: Final = 8
"""Sets for each load."""

_KNOWN: Final = "plain CAN, the worst instant, lengths of frames known (`bits`)"
_LONGEST: Final = "the same, with as many stuff bits as there can be"
_EVENTS: Final = "events on RTCAN, arrivals at random or together, for 0.3 s"
_BIT: Final = 2000  # ns: 500 kbit/s
_MESSAGES: Final = 4, 8  # of a set of plain CAN, at least and at most
_INSTANT: Final = 20 * MILLISECOND  # when all arrive at once
_RTCAN_DURATION: Final = 300 * MILLISECOND


class Tightness(msgspec.Struct, frozen=True):
    """The slowest simulated responses as shares of their bounds, and how many bounds prove a message in time."""

    what: str
    load: float
    messages: int
    shares: tuple[float, ...]
    proved: int

    def __str__(self) -> str:
        figures = min(self.shares), statistics.median(self.shares), max(self.shares)
        proved = str(self.proved) if self.what is _EVENTS else ""
        cells = (self.what, f"{self.load:.0%}", str(self.messages), *(f"{each:.2f}" for each in figures), proved)
        return f"| {' | '.join(cells)} |"


def rows(sets: int = SETS) -> Iterator[Tightness]:
    """Yield the rows of the table."""
    for what, exact in ((_KNOWN, True), (_LONGEST, False)):
        for load in PLAIN_LOADS:
            yield _row(what, load, [plain_worst(random.Random(seed), load, exact=exact) for seed in range(sets)])
    for load in RTCAN_LOADS:
        found = [compare_rtcan(random.Random(seed), load=load, duration=_RTCAN_DURATION) for seed in range(sets)]
        yield _row(_EVENTS, load, found)


def _row(what: str, load: float, sets: Sequence[Sequence[Compared]]) -> Tightness:
    messages = [each for compared in sets for each in compared]
    shares = tuple(each.slowest / each.bound for each in messages if each.bound)
    proved = sum(each.bound is not None and each.bound <= (each.message.deadline or 0) for each in messages)
    return Tightness(what, load, len(messages), shares, proved)


def plain_worst(numbers: random.Random, load: float, *, exact: bool) -> list[Compared]:
    """Return each message of a random set at its worst instant: all of more priority come at once, behind one of less.

    `exact`: the lengths of the frames are known to the analysis.
    """
    messages = plain_set(numbers, numbers.randint(*_MESSAGES))
    data = {each.name: numbers.choice((bytes(each.size), numbers.randbytes(each.size))) for each in messages}
    known = [msgspec.structs.replace(each, bits=_bits(each, data[each.name])) for each in messages]
    scale = sum(each.load(_BIT) for each in known) / load
    known = [msgspec.structs.replace(each, period=round((each.period or 0) * scale)) for each in known]
    messages = known if exact else [msgspec.structs.replace(each, bits=None) for each in known]
    bounds = {each.message.name: each.bound for each in response_bounds(messages, _BIT)}
    ordered = sorted(known, key=lambda each: each.rank)
    found = []
    for index, message in enumerate(ordered):
        responses = plain_responses(ordered, _BIT, _worst_instant(ordered, index), data)[message.name]
        found.append(Compared(messages[known.index(message)], bounds[message.name], max(responses), len(responses)))
    return found


def _bits(message: BusMessage, data: bytes) -> int:
    return frame_bits(message.id, data, extended=message.extended)


def _worst_instant(ordered: Sequence[BusMessage], index: int) -> dict[str, list[Arrival]]:
    """Return when instances come: those of the first messages as close together as they can, from one instant on."""
    rivals = ordered[: index + 1]
    until = _INSTANT + 20 * max(each.period or 0 for each in rivals)
    plan = {each.name: _closest(each, until) for each in rivals}
    behind = max(ordered[index + 1 :], key=lambda each: each.longest, default=None)
    if behind is not None:
        plan[behind.name] = [Arrival(_INSTANT - _BIT, _INSTANT - _BIT)]
    return plan


def _closest(message: BusMessage, until: int) -> list[Arrival]:
    """Return instances of which the first one has all of the jitter, and the others none."""
    assert message.period is not None
    first = _INSTANT - message.jitter
    return [Arrival(due, max(due, _INSTANT)) for due in range(first, until, message.period)]


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.analysis", description=__doc__)
    parser.add_argument("--sets", type=int, default=SETS, help=f"random sets for each load (default: {SETS})")
    parser.add_argument("--quick", action="store_true", help="one set for each load")
    arguments = parser.parse_args()
    print("| messages | load | sets' messages | least | median | most | proved in time |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for row in rows(1 if arguments.quick else arguments.sets):
        print(row, flush=True)
