"""The bench's own tools: what is kept of a run, and how two commits compare."""

from pathlib import Path

import pytest

from benchmarks import __main__ as bench
from benchmarks import history, machine
from benchmarks.history import History, compare
from benchmarks.table import Row


def _run(name: str, folder: Path, *measured: str) -> None:
    kept = History(name, folder)
    kept.begin(machine.describe())
    for index, text in enumerate(measured):
        kept.add(Row(f"row {index}", text, "", "", None))


def test_two_commits_side_by_side(tmp_path: Path) -> None:
    for text in ("900 k/s, 0 lost", "100 k/s, 0 lost", "500 k/s, 0 lost"):
        _run("a", tmp_path, text, "80 us, 1 us", "works")
    _run("b", tmp_path, "1.00 M/s, 0 lost", "0.12 ms", "works", "new")
    assert list(compare(History("a", tmp_path), History("b", tmp_path))) == [
        ("row 0", "500 k/s, 0 lost", "1.00 M/s, 0 lost", "2.00x"),
        ("row 1", "80 us, 1 us", "0.12 ms", "1.50x"),
        ("row 2", "works", "works", ""),
    ]
    assert (History("a", tmp_path).runs, history.known(tmp_path)) == (3, ["a", "b"])


def test_units_that_differ_have_no_ratio(tmp_path: Path) -> None:
    _run("a", tmp_path, "10 k/s", "0 us")
    _run("b", tmp_path, "10 us", "1 us")
    assert [row[-1] for row in compare(History("a", tmp_path), History("b", tmp_path))] == ["", ""]


def test_a_run_is_printed_and_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(bench, "History", lambda name: History(name, tmp_path))
    bench.run(iter([Row("a row", "1 us", "2 us", "3 us", True)]))
    printed = capsys.readouterr().out
    assert "load" in printed.splitlines()[0]
    assert "| a row" in printed
    (name,) = history.known(tmp_path)
    assert History(name, tmp_path).measured() == {"a row": ["1 us"]}


def test_unknown_names_are_refused(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("sys.argv", ["benchmarks", "delivry"])
    with pytest.raises(SystemExit):
        bench.main()
    assert "'delivry' is not a benchmark" in capsys.readouterr().err


def test_a_commit_without_measurements_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["benchmarks", "--compare", "none", "never"])
    with pytest.raises(SystemExit, match="nothing was measured at none"):
        bench.main()


def test_every_benchmark_has_rows() -> None:
    for name in bench.ALL:
        assert (Path(bench.__file__).with_name(f"{name}.py")).is_file(), name
