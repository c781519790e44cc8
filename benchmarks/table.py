"""What the benchmarks print: one row a figure, with its baseline, its goal, and whether it reaches that."""

from collections.abc import Callable, Iterable, Sequence
from statistics import median
from typing import NamedTuple


class Row(NamedTuple):
    """One figure. `baseline` names what ran beside it; `reached` is None where there is no goal."""

    what: str
    measured: str
    baseline: str
    goal: str
    reached: bool | None


def show(rows: Iterable[Row]) -> None:
    """Print each row as soon as it is there."""
    widths = (56, 24, 46, 26)
    print(line(("what", "measured", "baseline in the same run", "goal"), widths), "reached")
    print(line(tuple("-" * width for width in widths), widths), "-------")
    for row in rows:
        verdict = {True: "yes", False: "NO", None: ""}[row.reached]
        print(line((row.what, row.measured, row.baseline, row.goal), widths), verdict, flush=True)


def line(cells: Sequence[str], widths: Sequence[int]) -> str:
    """A row of a table."""
    return "| " + " | ".join(cell.ljust(width) for cell, width in zip(cells, widths, strict=True)) + " |"


def rate(value: float) -> str:
    """Messages a second, for people."""
    return f"{value / 1e6:.2f} M/s" if value >= 1e6 else f"{value / 1e3:.0f} k/s"


def typical(runs: int, measure: Callable[[], float]) -> float:
    """The median of some runs."""
    return median(measure() for _ in range(runs))


def percentile(values: Sequence[float], percent: float) -> float:
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(len(ordered) * percent / 100))]


def p50_p99(values: Sequence[float], unit: float = 1e-6) -> tuple[float, float]:
    """Median and 99th percentile, in units of `unit` seconds."""
    return percentile(values, 50) / unit, percentile(values, 99) / unit
