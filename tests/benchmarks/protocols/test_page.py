"""docs/comparison.md shows what its results say, and the results can be had again."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import pytest

from benchmarks.protocols import page, pictures
from benchmarks.protocols.cases import PROTOCOLS, merge, simulate
from benchmarks.protocols.study import FULL, cases_of

if TYPE_CHECKING:
    from pathlib import Path


def test_the_tables_of_the_page_are_those_of_the_results() -> None:
    text = page.PAGE.read_text()
    results = page.load_results()
    assert page.filled(text, results) == text
    assert set(re.findall(r"<!-- table: ([\w.-]+) -->", text)) == set(page.tables(results))


def test_the_results_have_all_protocols_of_the_present_plan() -> None:
    results = page.load_results()
    assert [each.protocol for each in results.protocols] == list(PROTOCOLS)
    assert all(each.plan == FULL for each in results.protocols)


def test_the_pictures_are_those_of_the_results(tmp_path: Path) -> None:
    pictures.draw(page.load_results(), tmp_path)
    drawn = {each.name: each.read_text() for each in tmp_path.iterdir()}
    assert drawn == {each.name: each.read_text() for each in page.ASSETS.glob("*.svg")}


@pytest.mark.parametrize(
    ("protocol", "messages", "bit_error_rate"),
    [
        ("plain CAN, DM", "hyundai", 0.0),
        ("TTCAN", "vw", 1e-5),
        ("CANopen", "broster", 1e-4),
        ("EDF in the identifier", "random-20", 1e-4),
    ],
)
def test_a_row_of_the_results_comes_out_again(protocol: str, messages: str, bit_error_rate: float) -> None:
    """A failure means that the bus or a policy has changed: run `python -m benchmarks.protocols --write` anew."""
    wanted = messages, bit_error_rate, ""
    cases = next(
        cases
        for cases in cases_of(protocol, FULL)
        if (cases[0].messages, cases[0].bit_error_rate, cases[0].fault) == wanted
    )
    figures = merge([simulate(case) for case in cases])
    assert figures == page.load_results().figures(protocol, messages, bit_error_rate)


def test_the_page_says_what_discovery_takes() -> None:
    found = page.load_results().discovery
    assert found is not None
    text = page.PAGE.read_text().replace("\n  ", " ")
    assert f"use {found.bus:.1%} of the bus for management".replace("%", " %") in text
    assert f"{found.free_slots:.0%} of the free slots".replace("%", " %") in text
