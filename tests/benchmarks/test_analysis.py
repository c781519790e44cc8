"""How tight the bounds are: a slice of the table, and what must be so of each row."""

from __future__ import annotations

import random

import pytest

from benchmarks.analysis.tightness import plain_worst, rows


@pytest.mark.parametrize("load", [0.3, 0.9])
def test_the_worst_instant_of_plain_can_reaches_the_bound(load: float) -> None:
    known = plain_worst(random.Random(3), load, exact=True)
    longest = plain_worst(random.Random(3), load, exact=False)
    assert len(known) == len(longest) >= 4
    for each in known:
        assert each.bound is not None
        assert 0.95 * each.bound <= each.slowest <= each.bound
    assert all(each.bound is None or each.slowest <= each.bound for each in longest)
    assert [each.slowest for each in known] == [each.slowest for each in longest]


def test_a_quick_table_has_a_row_for_each_load_and_no_share_above_1() -> None:
    found = list(rows(1))
    assert [each.load for each in found] == [0.3, 0.5, 0.7, 0.9] * 2 + [0.2, 0.4, 0.6]
    assert all(0 < share <= 1 for each in found for share in each.shares)
    assert all(each.messages for each in found)
    assert str(found[0]).startswith("| plain CAN, the worst instant, lengths of frames known (`bits`) | 30% | ")
