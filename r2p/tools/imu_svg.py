"""A calibration on a cube as SVG: what the accelerometer read in each position before and after it, and what is left.

Six targets, one for each position, have its pole of the unit sphere in their middle, as one looks at it from outside.
Below them are the 18 residuals of the fit, which are too small to be seen there.
"""

import math
from collections.abc import Iterator, Sequence

from r2p.tools.calibration import SIDES, CubePosition, ImuCalibration, Vector

_WIDTH, _HEIGHT, _MARGIN = 720, 390, 16  # px
_COLUMN = (_WIDTH - 2 * _MARGIN) / len(SIDES)  # px, of each position
_RADIUS, _MIDDLE = 46, 84  # px: of a target, and where its centre is
_ZERO, _LONGEST = 270, 62  # px: where residuals begin, and the longest bar
_AXES = "xyz"
_STYLE = """
    text { font: 12px system-ui, -apple-system, 'Segoe UI', Roboto, sans-serif; fill: #333b47; text-anchor: middle }
    .note { font-size: 11px; fill: #5f6977 }
    .left { text-anchor: start }
    .ring, .zero { fill: none; stroke: #76808e; stroke-opacity: .5 }
    .sigma { fill: #76808e; fill-opacity: .12 }
    .way { stroke: #b45309; stroke-dasharray: 3 3 }
    .before { fill: none; stroke: #b45309; stroke-width: 2 }
    .after, .bar { fill: #4f46e5 }
    @media (prefers-color-scheme: dark) {
      text { fill: #d7dce5 }
      .note { fill: #a5afbd }
      .way, .before { stroke: #fbbf77 }
      .after, .bar { fill: #a5b4fc }
    }"""


def draw(positions: Sequence[CubePosition], result: ImuCalibration) -> str:
    """Return the picture of a calibration from these positions."""
    by_side = {each.side: each for each in positions}
    errors = {
        side: (_error(by_side[side].acc, side), _error(result.correct(by_side[side].acc), side)) for side in SIDES
    }
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img">',
        "  <title>An accelerometer on a cube, before and after its calibration</title>",
        f"  <style>{_STYLE}\n  </style>",
        *(f"  {each}" for each in [*_targets(errors), *_residuals(result), *_legend()]),
        "</svg>",
    ]
    return "\n".join(lines) + "\n"


def _error(acc: Vector, side: str) -> Vector:
    """Return how far a reading (mg) is from the pole of its side."""
    x, y, z = (value - 1000 * part for value, part in zip(acc, SIDES[side], strict=True))
    return x, y, z


def _across(side: str) -> tuple[int, int]:
    """Return the axes that point to the right and up where one looks at a pole from outside."""
    up = _AXES.index(side[-1])
    right, above = (up + 1) % 3, (up + 2) % 3
    return (above, right) if side.startswith("-") else (right, above)


def _targets(errors: dict[str, tuple[Vector, Vector]]) -> Iterator[str]:
    """Draw each pole with the two readings, all at the same scale."""
    most = max(math.hypot(*(error[axis] for axis in _across(side))) for side, pair in errors.items() for error in pair)
    limit = _rounded_up(most)
    for side, middle in _columns():
        right, above = _across(side)
        yield _text("", middle, 20, f"{side} up")
        yield from (_circle("ring", middle, _MIDDLE, radius) for radius in (_RADIUS, _RADIUS / 2))
        before, after = (
            (middle + error[right] / limit * _RADIUS, _MIDDLE - error[above] / limit * _RADIUS)
            for error in errors[side]
        )
        yield f'<path class="way" d="M{before[0]:.1f} {before[1]:.1f} L{after[0]:.1f} {after[1]:.1f}"/>'
        yield _circle("before", *before, 4)
        yield _circle("after", *after, 3)
        yield _text("note", middle + _RADIUS + 6, _MIDDLE + 4, _AXES[right])
        yield _text("note", middle, _MIDDLE - _RADIUS - 3, _AXES[above])
        along = [error[_AXES.index(side[-1])] * (-1 if side.startswith("-") else 1) for error in errors[side]]
        yield _text("note", middle, _MIDDLE + _RADIUS + 20, f"{1000 + along[0]:.0f} → {1000 + along[1]:.1f} mg")
    yield _text("note left", _MARGIN, _MIDDLE + _RADIUS + 40, f"rings of {limit / 2:g} and {limit:g} mg")


def _residuals(result: ImuCalibration) -> Iterator[str]:
    """Draw a bar for each residual; the band is one sigma."""
    limit = _rounded_up(max(abs(each) for residual in result.residuals.values() for each in residual))
    sigma = min(result.sigma / limit, 1.0) * _LONGEST
    wide = _WIDTH - 2 * _MARGIN
    yield _text("note left", _MARGIN, _ZERO - _LONGEST - 12, f"what is left, to {limit:g} mg; the band is one sigma")
    yield f'<rect class="sigma" x="{_MARGIN}" y="{_ZERO - sigma:.1f}" width="{wide}" height="{2 * sigma:.1f}"/>'
    yield f'<path class="zero" d="M{_MARGIN} {_ZERO} h{wide}"/>'
    for side, middle in _columns():
        for number, (axis, value) in enumerate(zip(_AXES, result.residuals[side], strict=True)):
            x, height = middle + (number - 1) * 26, abs(value) / limit * _LONGEST
            top = _ZERO - height if value > 0 else _ZERO
            yield (
                f'<rect class="bar" x="{x - 7:.1f}" y="{top:.1f}" width="14" height="{height:.1f}">'
                f"<title>{side} up, {axis}: {value:z.2f} mg</title></rect>"
            )
            yield _text("note", x, _ZERO + _LONGEST + 14, axis)


def _legend() -> Iterator[str]:
    y = _HEIGHT - 14
    yield _circle("before", _MARGIN + 6, y - 4, 4)
    yield _text("note left", _MARGIN + 16, y, "as it reads")
    yield _circle("after", _MARGIN + 106, y - 4, 3)
    yield _text("note left", _MARGIN + 116, y, "calibrated")


def _columns() -> Iterator[tuple[str, float]]:
    """Return each side with the middle of its column."""
    return ((side, _MARGIN + (number + 0.5) * _COLUMN) for number, side in enumerate(SIDES))


def _rounded_up(value: float) -> float:
    """Return the next of 1, 2 or 5 times a power of ten."""
    power = 10 ** math.floor(math.log10(max(value, 1e-3)))
    return float(next(each * power for each in (1, 2, 5, 10) if each * power >= value))


def _circle(style: str, x: float, y: float, radius: float) -> str:
    return f'<circle class="{style}" cx="{x:.1f}" cy="{y:.1f}" r="{radius:g}"/>'


def _text(style: str, x: float, y: float, text: str) -> str:
    named = f' class="{style}"' if style else ""
    return f'<text{named} x="{x:.1f}" y="{y:.1f}">{text}</text>'
