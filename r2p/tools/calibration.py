"""Calibration of inertial sensors on a cube: the accelerometer's offset, scale and axes, and the gyroscope's offset.

    positions = [still(samples) for samples in ...]     # six: each side of the cube up, once
    result = calibrate(positions)
    result.acc_offset, result.acc_scale                 # what the parameters of an IMU module have

Gravity is known: 1 g along the side that is up. With the unit vector u of that side, an accelerometer reads S u + b:
the matrix S has the scale of each axis and where it points, b its offset. Six positions are 18 equations for these 12
numbers, so the method of least squares also says how well they fit.
"""

import math
import statistics
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import msgspec

Vector = tuple[float, float, float]
Matrix = tuple[float, float, float, float, float, float, float, float, float]

SIDES: dict[str, Vector] = {
    "x": (1.0, 0.0, 0.0),
    "-x": (-1.0, 0.0, 0.0),
    "y": (0.0, 1.0, 0.0),
    "-y": (0.0, -1.0, 0.0),
    "z": (0.0, 0.0, 1.0),
    "-z": (0.0, 0.0, -1.0),
}
"""The positions by the side that is up, and that side as a unit vector in the sensor's frame."""

ENOUGH = 20
"""Samples of a position, at least."""

_SHAKING = 20.0  # mg, one sigma: noise of the sensor is a sixth of that
_TURNING = 5000.0  # mdps, one sigma
_DRIFT = 10.0  # mg between the first and the second half
_GRAVITY = 700.0, 1300.0  # mg: what a still sensor reads, uncalibrated
_UPRIGHT = math.cos(math.radians(20))
_UNKNOWNS = 4  # for each axis: three of its row of S, and its offset


class ImuReading(NamedTuple):
    """One sample of the sensors."""

    acc: Vector
    """mg."""
    gyro: Vector
    """mdps."""


class CubePosition(msgspec.Struct, frozen=True):
    """The mean of the samples while a side was up."""

    side: str
    acc: Vector
    """mg."""
    gyro: Vector
    """mdps."""
    count: int
    """Samples."""


class ImuCalibration(msgspec.Struct, frozen=True):
    """What corrects the sensors: `acc_scale`, a matrix row by row, times (the reading - `acc_offset`)."""

    acc_offset: Vector
    """mg."""
    acc_scale: Matrix
    gyro_offset: Vector
    """mdps."""
    residuals: dict[str, Vector]
    """What is left in each position between the readings and the fit, mg."""
    sigma: float
    """Of one mean in one position, one sigma, mg, from the residuals; 18 equations - 12 unknowns leave 6."""

    def correct(self, acc: Vector) -> Vector:
        """Return a corrected reading of the accelerometer, mg."""
        x, y, z = (value - offset for value, offset in zip(acc, self.acc_offset, strict=True))
        m = self.acc_scale
        return m[0] * x + m[1] * y + m[2] * z, m[3] * x + m[4] * y + m[5] * z, m[6] * x + m[7] * y + m[8] * z

    @property
    def offset_error(self) -> float:
        """Of `acc_offset`, one sigma, mg."""
        return self.sigma / math.sqrt(len(SIDES))

    @property
    def scale_error(self) -> float:
        """Of the numbers of `acc_scale`, one sigma."""
        return self.sigma / 1000 / math.sqrt(2)


def still(readings: Sequence[ImuReading]) -> CubePosition:
    """Return the mean of readings at rest. Raises ValueError if it was not at rest, or stood on no side."""
    if len(readings) < ENOUGH:
        raise ValueError(f"{len(readings)} samples are too few: {ENOUGH} are the least")
    acc, gyro = _means(each.acc for each in readings), _means(each.gyro for each in readings)
    half = len(readings) // 2
    begin, end = (_means(each.acc for each in part) for part in (readings[:half], readings[half:]))
    shaking = max(statistics.stdev(each.acc[axis] for each in readings) for axis in range(3))
    turning = max(statistics.stdev(each.gyro[axis] for each in readings) for axis in range(3))
    drift = max(abs(one - other) for one, other in zip(begin, end, strict=True))
    if shaking > _SHAKING or turning > _TURNING or drift > _DRIFT:
        raise ValueError(
            f"it moved: the acceleration varied by {max(shaking, drift):.0f} mg, {_SHAKING:.0f} are the most"
        )
    return CubePosition(side_up(acc), acc, gyro, len(readings))


def side_up(acc: Vector) -> str:
    """Return the side that is up, by a reading at rest (mg). Raises ValueError if none is, or it is not gravity."""
    length = math.hypot(*acc)
    if not _GRAVITY[0] <= length <= _GRAVITY[1]:
        raise ValueError(f"it reads {length:.0f} mg at rest, not about 1000: check the range of the accelerometer")
    side, share = max(((side, _dot(acc, up) / length) for side, up in SIDES.items()), key=lambda each: each[1])
    if share < _UPRIGHT:
        tilt = math.degrees(math.acos(share))
        raise ValueError(f"no side is up: {side}, the nearest, is {tilt:.0f} degrees off; use a cube on a level table")
    return side


def positions_in(readings: Sequence[ImuReading], window: int = ENOUGH) -> list[CubePosition]:
    """Return the positions in a recording, in their order: what is between two of them moves, and is left out."""
    found: list[list[ImuReading]] = []
    last: str | None = None
    for start in range(0, len(readings) - window + 1, window):
        part = readings[start : start + window]
        try:
            side = still(part).side
        except ValueError:
            last = None
            continue
        if side != last:
            found.append([])
        found[-1].extend(part)
        last = side
    return [still(each) for each in found]


def calibrate(positions: Iterable[CubePosition]) -> ImuCalibration:
    """Fit what corrects the sensors. Raises ValueError unless each of the six positions is there once."""
    by_side: dict[str, CubePosition] = {}
    for each in positions:
        if each.side in by_side:
            raise ValueError(f"{each.side} was up twice: hold each of the six positions once")
        by_side[each.side] = each
    missing = [side for side in SIDES if side not in by_side]
    if missing:
        raise ValueError(f"positions are missing: with {', '.join(missing)} up")
    design = [(*SIDES[side], 1.0) for side in by_side]
    rows = [least_squares(design, [each.acc[axis] for each in by_side.values()]) for axis in range(3)]
    residuals = {side: _residual(each.acc, rows, SIDES[side]) for side, each in by_side.items()}
    freedom = 3 * (len(by_side) - _UNKNOWNS)
    sigma = math.sqrt(sum(part**2 for each in residuals.values() for part in each) / freedom)
    offset = (rows[0][3], rows[1][3], rows[2][3])
    scale = _inverse([[part / 1000 for part in row[:3]] for row in rows])
    gyro = _means(each.gyro for each in by_side.values())
    return ImuCalibration(offset, scale, gyro, residuals, sigma)


def least_squares(design: Sequence[Sequence[float]], values: Sequence[float]) -> list[float]:
    """Return the x for which `design` times x is nearest to `values`. Raises ValueError if there are several."""
    columns = list(zip(*design, strict=True))
    normal = [[_dot(one, other) for other in columns] for one in columns]
    return solve(normal, [_dot(column, values) for column in columns])


def solve(matrix: Sequence[Sequence[float]], values: Sequence[float]) -> list[float]:
    """Return the solution of linear equations, by elimination with pivots. Raises ValueError if there is not one."""
    rows = [[*row, value] for row, value in zip(matrix, values, strict=True)]
    size = len(rows)
    for column in range(size):
        pivot = max(range(column, size), key=lambda row: abs(rows[row][column]))
        rows[column], rows[pivot] = rows[pivot], rows[column]
        if abs(rows[column][column]) < 1e-12:
            raise ValueError("the equations do not determine all unknowns")
        for row in range(size):
            if row != column:
                factor = rows[row][column] / rows[column][column]
                rows[row] = [one - factor * other for one, other in zip(rows[row], rows[column], strict=True)]
    return [rows[each][size] / rows[each][each] for each in range(size)]


def _inverse(matrix: Sequence[Sequence[float]]) -> Matrix:
    x, y, z = (solve(matrix, unit) for unit in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))
    return x[0], y[0], z[0], x[1], y[1], z[1], x[2], y[2], z[2]


def _residual(acc: Vector, rows: Sequence[Sequence[float]], up: Vector) -> Vector:
    x, y, z = (value - _dot(row, (*up, 1.0)) for value, row in zip(acc, rows, strict=True))
    return x, y, z


def _means(vectors: Iterable[Vector]) -> Vector:
    x, y, z = (statistics.fmean(axis) for axis in zip(*vectors, strict=True))
    return x, y, z


def _dot(one: Sequence[float], other: Sequence[float]) -> float:
    return sum(a * b for a, b in zip(one, other, strict=True))
