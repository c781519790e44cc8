"""The pictures of docs/comparison.md, from the results of the study."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from benchmarks.thesis.svg import Plot

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from benchmarks.protocols.cases import CaseFigures
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
    _bars(
        results,
        directory / "jitter.svg",
        "Thesis 4.4, events 80 %: worst jitter of the 1 ms messages, us",
        (1, 1000),
        lambda figures: (1.0, figures.jitter_fast),
    )
    _bars(
        results,
        directory / "responses.svg",
        "Thesis 4.4, events 80 %: response of events, from the median to the worst, ms",
        (0.1, 1000),
        lambda figures: ((figures.median or 100) / 1000, figures.worst / 1000),
    )


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


def _bars(
    results: StudyResults,
    path: Path,
    title: str,
    limits: tuple[float, float],
    value: Callable[[CaseFigures], tuple[float, float]],
) -> None:
    """A bar for each protocol, from one value to another on a logarithmic scale."""
    rows = [(each.protocol, results.figures(each.protocol, "thesis-80")) for each in results.protocols]
    known = [(name, figures) for name, figures in rows if figures is not None]
    low, high = math.log10(limits[0]), math.log10(limits[1])
    span = (low - 0.32 * (high - low), high)
    plot = Plot(title, span, (0, len(known)), size=(720, 60 + 26 * len(known)))
    plot.ticks([(power, f"{10.0**power:g}") for power in _powers(low, high)])
    for place, (name, figures) in enumerate(reversed(known)):
        begin, end = value(figures)
        colour, _ = _STYLES[name]
        left = min(max(math.log10(begin), low), high)
        right = min(max(math.log10(max(end, limits[0])), left + 0.01), high)
        plot.box((left, right), (place + 0.2, place + 0.8), colour)
        plot.note(low - 0.01 * (high - low), place + 0.38, name, anchor="end")
        plot.note(min(right + 0.01, high - 0.1), place + 0.38, f"{end:.3g}")
    plot.write(path)


def _powers(low: float, high: float) -> Sequence[int]:
    return range(math.ceil(low), math.floor(high) + 1)
