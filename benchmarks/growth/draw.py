"""Draws how the cost grows, from a file of results: `python -m benchmarks.growth.draw docs/assets/growth.json`."""

import math
import sys
from pathlib import Path

import msgspec

from benchmarks.growth.curve import Curve
from benchmarks.thesis.svg import COLOURS, Plot

SIZE = (860, 460)
_DASHES = ("", "6 3", "2 3")
_LEAST = 0.01  # of the goal


def read(path: Path) -> list[Curve]:
    """Return the curves in a file that `python -m benchmarks.growth --json` has written."""
    parts = msgspec.json.decode(path.read_bytes(), type=dict[str, list[Curve]])
    return [curve for curves in parts.values() for curve in curves]


def draw(curves: list[Curve]) -> Plot:
    """Draw the curves that have a goal, as a share of it, over N: both axes are logarithmic."""
    shown = [each for each in curves if each.goal and any(value > 0 for _, value in each.points)]
    last = max(n for each in shown for n, _ in each.points)
    labels = "N: modules, clients, topics or routers", "share of the goal"
    plot = Plot("What grows, and with which power of N", (0.0, 5.2), (-2.0, 0.6), labels=labels, size=SIZE, legend=0.6)
    plot.ticks(
        [(math.log10(n), f"{n}") for n in (1, 10, 100, 1000) if n <= 10 * last],
        [(math.log10(share), f"{share:g}") for share in (0.01, 0.1, 1.0)],
    )
    for number, curve in enumerate(shown):
        colour, dash = COLOURS[number % len(COLOURS)], _DASHES[number // len(COLOURS) % len(_DASHES)]
        assert curve.goal is not None
        points = [(math.log10(n), math.log10(max(value / curve.goal, _LEAST))) for n, value in curve.points]
        plot.line(points, colour, dash=dash, dots=True)
        power = "" if curve.exponent is None else f", N^{curve.exponent:.2f}"
        plot.name(f"{curve.name}{power}", colour, dash=dash)
    return plot


def main() -> None:
    """Draw the picture beside the file that is named."""
    path = Path(sys.argv[1])
    draw(read(path)).write(path.with_suffix(".svg"))


if __name__ == "__main__":
    main()
