"""The study of failures on single runs: what must be so whatever the seed; and the page shows what its results say."""

from __future__ import annotations

from typing import TYPE_CHECKING

from benchmarks import failures, time_page
from benchmarks.failures import CASES, SEEDS, FailureRow, simulate

if TYPE_CHECKING:
    from pathlib import Path


def test_a_module_that_loses_power_costs_the_others_nothing_and_gets_its_slots_back() -> None:
    found = simulate("owner", 1)
    assert (found.slots_lost, found.values_lost) == (0, 0)
    assert found.kept
    assert found.own_same
    assert found == next(each.runs[0] for each in time_page.load("failures", FailureRow) if each.name == "owner")


def test_the_gap_that_is_open_at_the_end_counts_and_one_that_began_before_the_fault_does() -> None:
    assert failures._gaps([5, 10, 40], 20, 100) == [30, 60]
    assert failures._missing([30, 60], 10) == 2 + 5
    assert failures._missing([10, 10], 10) == 0


def test_the_page_has_the_results_of_the_present_cases(tmp_path: Path) -> None:
    rows, text = time_page.load("failures", FailureRow), time_page.PAGE.read_text()
    assert [(each.name, each.text, tuple(each.broken)) for each in rows] == [
        (each.name, each.text, each.broken) for each in CASES
    ]
    assert all(len(each.runs) == len(SEEDS) for each in rows)
    assert time_page.filled(text, time_page.failure_tables(rows)) == text
    time_page.draw_failures(rows, tmp_path)
    assert (tmp_path / "failures.svg").read_text() == (time_page.ASSETS / "failures.svg").read_text()


def test_whatever_fails_the_others_have_slots_again_after_three_seconds() -> None:
    rows = time_page.load("failures", FailureRow)
    assert all(run.slotted for each in rows for run in each.runs)


def test_foreign_syncs_are_reported_where_a_node_forges_them_and_nowhere_else() -> None:
    rows = time_page.load("failures", FailureRow)
    reported = {each.name: [run.notices.get("foreign syncs", 0) for run in each.runs] for each in rows}
    forging = {"sync-off-grid", "sync-wrong-count", "sync-early", "sync-late"}
    assert {name for name, counts in reported.items() if all(counts)} == forging
    assert {name for name, counts in reported.items() if any(counts)} == forging
