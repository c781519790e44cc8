"""The study of network time on short runs: no claim is broken; and the page shows what its results say."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from benchmarks import time_page
from benchmarks.synchronisation import CASES, SyncCase, SyncOutcome, simulate

if TYPE_CHECKING:
    from pathlib import Path


@pytest.mark.parametrize(
    "case",
    [
        SyncCase("first measurements"),
        SyncCase("masters killed", changes=True),
        SyncCase("lost", nodes=3, loss=0.1),
    ],
    ids=lambda case: case.text,
)
def test_no_error_is_larger_than_claimed(case: SyncCase) -> None:
    outcome = simulate(case, [1], 4.0)
    assert outcome.network_time.samples > 1_000
    assert outcome.utc.samples > 70
    assert outcome.network_time.broken == outcome.utc.broken == 0
    assert (outcome.masters > 0) == case.changes


def test_a_run_comes_out_again() -> None:
    case = SyncCase("again", nodes=3, loss=0.05)
    assert simulate(case, [1], 1.5) == simulate(case, [1], 1.5)


def test_the_page_has_the_results_of_the_present_cases(tmp_path: Path) -> None:
    outcomes, text = time_page.load("synchronisation", SyncOutcome), time_page.PAGE.read_text()
    assert [each.case for each in outcomes] == list(CASES)
    assert not any(each.network_time.broken or each.utc.broken for each in outcomes)
    assert time_page.filled(text, time_page.sync_tables(outcomes)) == text
    time_page.draw_synchronisation(outcomes, tmp_path)
    assert (tmp_path / "synchronisation.svg").read_text() == (time_page.ASSETS / "synchronisation.svg").read_text()
