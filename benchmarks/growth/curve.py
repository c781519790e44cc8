"""A figure over N, and how it grows."""

import math
from collections.abc import Sequence

import msgspec


class Curve(msgspec.Struct):
    """One figure, measured for several N. `goal` holds for the largest of them."""

    name: str
    n_is: str
    """What N counts, in the plural."""
    unit: str
    points: list[tuple[int, float]] = msgspec.field(default_factory=list)
    goal: float | None = None

    @property
    def exponent(self) -> float | None:
        """Return b of the fit value = a * N ** b; None where there are fewer than two points."""
        return exponent(self.points)


def exponent(points: Sequence[tuple[float, float]]) -> float | None:
    """Return the slope of the line of least squares through the logarithms; None without two different N."""
    logs = [(math.log(n), math.log(value)) for n, value in points if n > 0 and value > 0]
    if len({x for x, _ in logs}) < 2:
        return None
    mean_x = math.fsum(x for x, _ in logs) / len(logs)
    mean_y = math.fsum(y for _, y in logs) / len(logs)
    spread = math.fsum((x - mean_x) ** 2 for x, _ in logs)
    return math.fsum((x - mean_x) * (y - mean_y) for x, y in logs) / spread
