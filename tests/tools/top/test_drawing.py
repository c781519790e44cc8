"""Numbers, bars and sparklines in few characters."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from r2p.tools.top import drawing


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "-"),
        (math.nan, "-"),
        (0.0, "0.00"),
        (0.254, "0.25"),
        (9.996, "10.0"),
        (200.0, "200.0"),
        (999.96, "1.00k"),
        (1234.0, "1.23k"),
        (999_600.0, "1.00M"),
        (-2500.0, "-2.50k"),
    ],
)
def test_a_number_has_three_digits_or_so(value: float | None, text: str) -> None:
    assert drawing.number(value) == text


@given(st.floats(-1e14, 1e14))
def test_a_number_is_short_and_right(value: float) -> None:
    text = drawing.number(value)
    factor = {"k": 1e3, "M": 1e6, "G": 1e9, "T": 1e12}.get(text[-1], 1.0)
    assert len(text) <= 6
    assert float(text.rstrip("kMGT")) * factor == pytest.approx(value, rel=0.01, abs=0.006)


@given(st.text(), st.integers(1, 40))
def test_a_name_keeps_its_ends(name: str, width: int) -> None:
    short = drawing.shortened(name, width)
    assert len(short) == min(len(name), width)
    assert len(name) <= width or width < 4 or (short[0], short[-1]) == (name[0], name[-1])


@pytest.mark.parametrize(
    ("values", "line"),
    [
        ([], ""),
        ([1.0, 1.0], "▁▁"),
        ([0.0, 1.0, 2.0, 7.0], "▁▂▃█"),
        ([math.nan, 0.0, 1.0], " ▁█"),
        ([math.inf], " "),
        ([-1.7e308, 0.0, 1.7e308], "▁▅█"),
    ],
)
def test_a_sparkline_is_between_its_smallest_and_its_largest_value(values: list[float], line: str) -> None:
    assert drawing.sparkline(values, 8) == line


@given(st.lists(st.floats(), max_size=30), st.integers(0, 20))
def test_a_sparkline_takes_any_values(values: list[float], width: int) -> None:
    assert len(drawing.sparkline(values, width)) == min(len(values), width)


@given(st.none() | st.floats(), st.none() | st.floats(), st.integers(0, 50))
def test_a_bar_is_as_wide_as_asked(used: float | None, reserved: float | None, width: int) -> None:
    assert len(drawing.bar(used, reserved, width)) == width


def test_a_bar_shows_what_is_used_and_what_is_reserved() -> None:
    assert drawing.bar(0.2, 0.5, 10) == "██▒▒▒·····"
