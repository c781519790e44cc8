"""Attitude from inertial sensors: a non-linear complementary filter (Mahony, Hamel and Pflimlin 2008; thesis 7.4.2).

The gyroscope is right at once and wrong in the long run, gravity and the earth's magnetic field are the other way
round. So the gyroscope turns the attitude, and the two directions pull it, slowly, to where they are seen, and take
the gyroscope's bias away on the way.
"""

import math

from r2p.sim.physics.inertial import Vector

Quaternion = tuple[float, float, float, float]


class ComplementaryFilter:
    """The filter; `quaternion` turns vectors of the body into the world's (x north, y west, z up)."""

    def __init__(self, *, gain: float = 1.0, bias_gain: float = 0.2) -> None:
        """`gain` (1/s): how fast the directions win; `bias_gain` (1/s^2): how fast the bias is learnt."""
        self.quaternion: Quaternion = (1.0, 0.0, 0.0, 0.0)
        self.bias: Vector = (0.0, 0.0, 0.0)
        """Of the gyroscope, rad/s."""
        self._gain = gain
        self._bias_gain = bias_gain

    def step(self, gyro: Vector, acc: Vector, mag: Vector, dt: float) -> None:
        """Move on by `dt` seconds. `gyro` in rad/s; `acc` (up, at rest) and `mag` in any unit."""
        pull = self._pull(_unit(acc), _unit(mag))
        x, y, z = (bias - self._bias_gain * error * dt for bias, error in zip(self.bias, pull, strict=True))
        self.bias = (x, y, z)
        rates = [rate - bias + self._gain * error for rate, bias, error in zip(gyro, self.bias, pull, strict=True)]
        self.quaternion = _turned(self.quaternion, (rates[0], rates[1], rates[2]), dt)

    @property
    def angles(self) -> Vector:
        """Roll, pitch and yaw, rad."""
        w, x, y, z = self.quaternion
        roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
        return roll, pitch, math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))

    def _pull(self, up: Vector, field: Vector) -> Vector:
        """The rotation (rad, in the body) from where the directions should be seen to where they are."""
        ex, ey, ez = _cross(up, to_body(self.quaternion, (0.0, 0.0, 1.0)))
        x, y, _ = to_world(self.quaternion, field)
        heading = -math.atan2(y, x)  # only the field's horizontal part counts: roll and pitch are gravity's
        hx, hy, hz = to_body(self.quaternion, (0.0, 0.0, heading))
        return ex + hx, ey + hy, ez + hz


def to_world(q: Quaternion, v: Vector) -> Vector:
    """A vector of the body, as the world sees it."""
    w, x, y, z = q
    tx, ty, tz = 2 * (y * v[2] - z * v[1]), 2 * (z * v[0] - x * v[2]), 2 * (x * v[1] - y * v[0])
    return v[0] + w * tx + y * tz - z * ty, v[1] + w * ty + z * tx - x * tz, v[2] + w * tz + x * ty - y * tx


def to_body(q: Quaternion, v: Vector) -> Vector:
    """A vector of the world, as the body sees it."""
    w, x, y, z = q
    return to_world((w, -x, -y, -z), v)


def _turned(q: Quaternion, rates: Vector, dt: float) -> Quaternion:
    w, x, y, z = q
    a, b, c = (rate * dt / 2 for rate in rates)
    turned = (
        w - a * x - b * y - c * z,
        x + a * w + c * y - b * z,
        y + b * w - c * x + a * z,
        z + c * w + b * x - a * y,
    )
    length = math.sqrt(sum(part * part for part in turned))
    w, x, y, z = (part / length for part in turned)
    return w, x, y, z


def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _unit(v: Vector) -> Vector:
    length = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]) or 1.0
    return v[0] / length, v[1] / length, v[2] / length
