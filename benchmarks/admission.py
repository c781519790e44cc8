"""How many sets of periodic messages the master's calendar admits, of those that fit at some phases (thesis 4.3.4).

Each set has six messages of one slot, of random periods, beside the sync of a cycle of 60 slots. They ask for slots one
after another, at just these periods, as they do online: the calendar knows nothing of the next one. An exhaustive
search over all phases says which sets are possible at all.
"""

import math
import random
from collections.abc import Iterator, Sequence
from statistics import mean

from benchmarks.table import Row
from r2p.protocols.rtcan.calendar import Calendar, PeriodRule, Refusal

SLOTS = 60
"""In a cycle, as in the thesis."""
PERIODS = (6, 8, 12, 18, 24, 30, 36, 48, 60, 90, 120)
"""In slots of 166 us: 1 to 20 ms."""
SEEDS = range(400)
_MESSAGES = 6
_GOAL = 0.95


def drawn(seed: int) -> list[int]:
    """Return the periods of one set, in the order in which they ask."""
    numbers = random.Random(seed)
    return [numbers.choice(PERIODS) for _ in range(_MESSAGES)]


def possible(periods: Sequence[int], slots: int = SLOTS) -> bool:
    """Return whether there are phases at which no two of these messages, nor one and the sync, ever meet."""
    return _extend(sorted(periods), [(slots, 0)])


def _extend(left: Sequence[int], placed: list[tuple[int, int]]) -> bool:
    """Place what is left at each phase in turn. Of two equal periods, the second one gets the greater phase."""
    if not left:
        return True
    period, (last, phase) = left[0], placed[-1]
    first = phase + 1 if last == period and len(placed) > 1 else 0
    for phase in range(first, period):
        if all((phase - other) % math.gcd(period, each) for each, other in placed):
            placed.append((period, phase))
            if _extend(left[1:], placed):
                return True
            placed.pop()
    return False


def admitted(periods: Sequence[int], rule: PeriodRule, *, round_down: bool = False) -> float | None:
    """Return the slots of a cycle that a set takes on average, without the sync; None if a message is refused."""
    calendar = Calendar(SLOTS, rule)
    for message, period in enumerate(periods):
        if isinstance(calendar.admit(message, period, round_down=round_down), Refusal):
            return None
    return sum(each.fragments * SLOTS / each.period for each in calendar)


def rows(seeds: Sequence[int] = SEEDS) -> Iterator[Row]:
    """How many sets each rule admits, and the slots that they take."""
    sets = [each for each in map(drawn, seeds) if possible(each)]
    everything = mean(sum(SLOTS / period for period in each) for each in sets)
    of_all = f"{len(sets)} of {len(seeds)} sets are possible, {everything:.1f} slots each"
    for rule, round_down, goal in (
        (PeriodRule.COMMON_FACTORS, False, _GOAL),
        (PeriodRule.HARMONIC, False, None),
        (PeriodRule.HARMONIC, True, None),
        (PeriodRule.COMMON_FACTORS, True, None),
    ):
        taken = [slots for each in sets if (slots := admitted(each, rule, round_down=round_down)) is not None]
        what = f"{rule.value}, {'periods rounded down' if round_down else 'at the asked periods'}: sets admitted"
        share = len(taken) / len(sets)
        measured = f"{len(taken)} ({share:.1%})" + (f"; {mean(taken):.1f} slots each" if taken else "")
        asked = f"at least {goal:.0%}" if goal else ""
        yield Row(what, measured, of_all, asked, None if goal is None else share >= goal)
