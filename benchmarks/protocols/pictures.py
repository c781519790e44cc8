"""The pictures of docs/comparison.md, from the results of the study."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from benchmarks.protocols.study import ERROR_RATES
from benchmarks.thesis.svg import Plot

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from benchmarks.protocols.study import StudyResults

_STYLES = {
    "plain CAN, RM": ("#616161", "5 3"),
    "plain CAN, DM": ("#616161", ""),
    "EDF in the identifier": ("#8e24aa", ""),
    "FTT-CAN": ("#2e7d32", ""),
    "TTCAN": ("#3f51b5", ""),
    "TTCAN in software": ("#3f51b5", "5 3"),
    "CANopen": ("#00838f", ""),
    "Cyphal": ("#795548", ""),
    "DroneCAN": ("#795548", "5 3"),
    "RTCAN": ("#e65100", ""),
}
_FLOOR = 0.01  # percent: where none are missed


def draw(results: StudyResults, directory: Path) -> None:
    """Draw all pictures."""
    directory.mkdir(parents=True, exist_ok=True)
    _misses(results, directory / "misses.svg")
    known = [(each.protocol, results.figures(each.protocol, "thesis-80")) for each in results.protocols]
    of_thesis = [(name, figures) for name, figures in known if figures is not None]
    _bars(
        [(name, 1.0, figures.jitter_fast) for name, figures in of_thesis],
        directory / "jitter.svg",
        "Thesis 4.4, events 80 %: worst jitter of the 1 ms messages, us",
        (1, 1000),
    )
    _bars(
        [(name, (figures.median or 100) / 1000, figures.worst / 1000) for name, figures in of_thesis],
        directory / "responses.svg",
        "Thesis 4.4, events 80 %: response of events, from the median to the worst, ms",
        (0.1, 10_000),
    )
    _bars(
        [(each.protocol, *_missed_by_errors(results, each.protocol)) for each in results.protocols],
        directory / "errors.svg",
        "Periodic messages that bit errors of 1e-4 take, from the least to the most of all sets, %",
        (0.01, 10),
    )


def _missed_by_errors(results: StudyResults, protocol: str) -> tuple[float, float]:
    """Return the least and the most percent that a set misses more than without errors."""
    shares = []
    for name in results.protocols[0].plan.sets:
        without, with_errors = (results.figures(protocol, name, rate) for rate in (0.0, ERROR_RATES[-1]))
        if without is not None and with_errors is not None:
            before, after = (each.periodic_missed / each.periodic for each in (without, with_errors))
            shares.append(100 * max(0.0, after - before))
    return min(shares), max(shares)


def _misses(results: StudyResults, path: Path) -> None:
    loads = results.protocols[0].plan.loads
    labels = ("load of the random sets, in 11-bit frames, %", "missed deadlines, %")
    left, right = loads[0] - 2, 100
    low, high = math.log10(_FLOOR), 2.0
    plot = Plot("Missed deadlines by load", (left, right), (low, high), labels=labels, legend=0.02, size=(720, 420))
    marks = (_FLOOR, 0.1, 1, 10, 100)
    plot.ticks(
        [(load, str(load)) for load in loads],
        [(math.log10(each), "none" if each == _FLOOR else f"{each:g}") for each in marks],
    )
    for each in results.protocols:
        colour, dash = _STYLES[each.protocol]
        points = []
        for load in loads:
            figures = results.figures(each.protocol, f"random-{load}")
            if figures is not None:
                missed = figures.periodic_missed + figures.sporadic_missed
                percent = 100 * missed / (figures.periodic + figures.sporadic)
                points.append((load, math.log10(max(percent, _FLOOR))))
        plot.line(points, colour, dash=dash, dots=True)
        plot.name(each.protocol, colour, dash=dash)
    plot.write(path)


def _bars(rows: Sequence[tuple[str, float, float]], path: Path, title: str, limits: tuple[float, float]) -> None:
    """A bar for each protocol, from one value to another on a logarithmic scale."""
    low, high = math.log10(limits[0]), math.log10(limits[1])
    span = (low - 0.32 * (high - low), high)
    plot = Plot(title, span, (0, len(rows)), size=(720, 60 + 26 * len(rows)))
    plot.ticks([(power, f"{10.0**power:g}") for power in _powers(low, high)])
    for place, (name, begin, end) in enumerate(reversed(rows)):
        colour, _ = _STYLES[name]
        left = min(max(math.log10(max(begin, limits[0])), low), high)
        right = min(max(math.log10(max(end, limits[0])), left + 0.01), high)
        plot.box((left, right), (place + 0.2, place + 0.8), colour)
        plot.note(low - 0.01 * (high - low), place + 0.38, name, anchor="end")
        plot.note(
            min(right + 0.01 * (high - low), high - 0.1), place + 0.38, f"{end:.0f}" if end >= 100 else f"{end:.3g}"
        )
    plot.write(path)


def _powers(low: float, high: float) -> Sequence[int]:
    return range(math.ceil(low), math.floor(high) + 1)
