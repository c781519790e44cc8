"""The page on performance gets its tables and curves from what was measured."""

import json
from pathlib import Path

import pytest

from benchmarks import performance_page
from benchmarks.history import History
from benchmarks.table import Row

PAGE = """before
<!-- figures: robots -->
old
<!-- end of figures -->
between
<!-- figures: others -->
<!-- end of figures -->
after
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(performance_page, "FOLDER", tmp_path)
    monkeypatch.setattr(performance_page, "PAGE", tmp_path / "page.md")
    monkeypatch.setattr(performance_page, "ASSETS", tmp_path / "assets")
    monkeypatch.setattr(performance_page, "History", lambda name: History(name, tmp_path))
    (tmp_path / "page.md").write_text(PAGE)
    return tmp_path


def test_tables_curves_and_raw_data(folder: Path) -> None:
    history = History("abc", folder)
    history.begin({"processor": "one", "python": "3.11", "load": "0.10"})
    history.add(Row("sierra_nevada, one process", "6 %", "rclpy 44 %", "", True))
    history.add(Row("sierra_nevada, one process", "5 %", "rclpy 43 %", "", True))
    for size, ours in ((8, "1.00 M/s; 100 us"), (64, "0 k/s; 1000 us")):
        history.add(Row(f"zenoh, {size} bytes: both", ours, "zenoh-python 10 k/s: 0.10x; 10 us: 10.00x", "", None))
    performance_page.main("abc")
    page = (folder / "page.md").read_text()
    assert "| sierra_nevada, one process | 5 % | rclpy 43 % |" in page
    assert "old" not in page
    assert "6 %" not in page
    assert page.startswith("before\n")
    assert page.endswith("after\n")
    assert len(json.loads((folder / "assets" / "others.json").read_text())["rows"]) == 2
    assert (folder / "assets" / "stream.svg").read_text().count("<circle") == 3  # what did not move has no logarithm
    assert (folder / "assets" / "trip.svg").read_text().count("<circle") == 4
    performance_page.main("abc")
    assert (folder / "page.md").read_text() == page


def test_the_real_page_has_the_marks() -> None:
    page = performance_page.PAGE.read_text()
    for name in performance_page.SECTIONS:
        assert "| new |" in performance_page.fill(page, name, "| new |")


def test_a_page_without_marks_and_a_commit_without_figures(folder: Path) -> None:
    with pytest.raises(ValueError, match="figures: robots"):
        performance_page.fill("", "robots", "")
    with pytest.raises(SystemExit, match="nothing was measured at none"):
        performance_page.main("none")
