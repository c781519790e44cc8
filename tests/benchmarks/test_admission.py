"""`python -m benchmarks admission` on a part of its sets."""

from __future__ import annotations

from itertools import product

import pytest

from benchmarks import admission
from r2p.protocols.rtcan.calendar import PeriodRule


def test_a_slice_reaches_the_goal() -> None:
    common, harmonic, *_ = admission.rows(range(60))
    assert common.reached
    assert harmonic.measured == "0 (0.0%)"


@pytest.mark.parametrize("periods", [(2, 3), (2, 4, 4), (4, 4, 4), (4, 4, 4, 8), (6, 8), (6, 3, 6, 6), (6, 4, 4)])
def test_the_exhaustive_search_finds_what_trying_all_phases_finds(periods: tuple[int, ...]) -> None:
    """With a cycle of 4 slots, slot by slot."""
    end = 4 * 48
    found = False
    for phases in product(*map(range, periods)):
        used = list(range(0, end, 4))
        for period, phase in zip(periods, phases, strict=True):
            used += range(phase, end, period)
        found |= len(used) == len(set(used))
    assert admission.possible(periods, 4) == found


def test_rounded_down_sets_take_more_slots() -> None:
    periods = [90, 48]
    exact = admission.admitted(periods, PeriodRule.COMMON_FACTORS)
    rounded = admission.admitted(periods, PeriodRule.HARMONIC, round_down=True)
    assert exact == pytest.approx(60 / 90 + 60 / 48)
    assert rounded == 60 / 60 + 60 / 30
