"""Where was the robot? An extended Kalman filter joins encoders, gyroscope and GPS of a recording of Robocom.

All of them are stamped in the time of the robot's bus: sort by stamp, and go through, from the first known pose on.
In two terminals:
r2p sim robocom --drive --via tcp-listen:2323
r2p bag record -a -o drive.mcap --max-duration 60s --via tcp:127.0.0.1:2323; python fusion.py drive.mcap
"""

import itertools
import math
import operator
import sys
from collections.abc import Sequence
from typing import Any

import r2p
from r2p.msg import StampedEncoder, StampedGPS, StampedIMURaw9, StampedPose3
from r2p.sim.physics.gps import GeoOrigin
from r2p.sim.robots.robocom.nodes import BODY, MOTOR

COUNT = math.radians(8.75e-3)  # rad/s of one count of the gyroscope
SLIP = 0.003  # of a way, m per root of m
SPIN = 0.0075  # noise of a reading of the gyroscope, rad/s
TURN = 0.015  # how far it and the turn of the wheels may differ, as one is an instant and the other an interval, rad/s
FIX = 3.0  # m for each coordinate of a fix: its error is smaller, but five fixes a second have almost the same
START = (0.01, 0.01, 0.003, 0.02, 0.01)  # sigmas: it is known where the robot starts; m, m, rad, rad/s, rad/m
METRES = BODY.wheel_radius / MOTOR.ticks_per_radian  # of a tick
X, Y = (1, 0, 0, 0, 0), (0, 1, 0, 0, 0)


class Filter:
    """The state: x, y, heading, bias of the gyroscope, and how far wheels of unequal size seem to turn it per metre."""

    def __init__(self, start: StampedPose3) -> None:
        self.s = [start.x, start.y, start.w, 0.0, 0.0]
        self.p = [[sigma**2 if row == column else 0.0 for column in range(5)] for row, sigma in enumerate(START)]

    def move(self, way: float, turned: float, rate: float, dt: float) -> None:
        """Go on by the way of the wheels (m) and the gyroscope's rate (rad/s); compare it with their turn (rad)."""
        x, y, w, bias, unequal = self.s
        turn = (rate - bias) * dt
        cos, sin = math.cos(w + turn / 2), math.sin(w + turn / 2)
        self.s = [x + way * cos, y + way * sin, w + turn, bias, unequal]
        f = [[float(row == column) for column in range(5)] for row in range(5)]
        f[0][2], f[1][2], f[2][3] = -way * sin, way * cos, -dt
        f[0][3], f[1][3] = way * sin * dt / 2, -way * cos * dt / 2
        fp = [[dot(row, column) for column in self.p] for row in f]  # p is symmetric
        self.p = [[dot(row, other) for other in f] for row in fp]
        slip = SLIP**2 * abs(way)
        for each, more in enumerate((slip * cos * cos, slip * sin * sin, (SPIN * dt) ** 2)):
            self.p[each][each] += more
        self.correct((0, 0, 0, 1, -way / dt), rate - turned / dt, TURN)

    def correct(self, h: Sequence[float], measured: float, sigma: float) -> None:
        """Correct by a measurement: a sum of states with these factors."""
        ph = [dot(row, h) for row in self.p]
        gain = [each / (dot(h, ph) + sigma**2) for each in ph]
        error = measured - dot(h, self.s)
        self.s = [s + k * error for s, k in zip(self.s, gain, strict=True)]
        self.p = [[p - k * each for p, each in zip(row, ph, strict=True)] for row, k in zip(self.p, gain, strict=True)]


def dot(a: Sequence[float], b: Sequence[float]) -> float:
    return math.fsum(map(operator.mul, a, b))


def read(path: str) -> list[tuple[int, r2p.Message, str]]:
    """Return all measurements by the instants at which they were taken (ns)."""
    topics: dict[str, Any] = {
        "imu_raw": StampedIMURaw9,
        "encoder_left": StampedEncoder,
        "encoder_right": StampedEncoder,
    }
    topics |= {"gps": StampedGPS, "truth": StampedPose3}
    with r2p.Bag(path) as bag:
        found = [
            (s.message.timestamp.ns, s.message, topic) for topic in topics for s in bag.samples(topic, topics[topic])
        ]
    return sorted(found, key=lambda each: each[0])


def fuse(path: str) -> dict[str, float]:
    """Return the RMS error of each estimate of the position, m. Truth is what the simulation knows."""
    ticks = {"encoder_left": 0.0, "encoder_right": 0.0}
    rate = last = 0.0
    before, seen, fix, origin = 0, set(), (0.0, 0.0), GeoOrigin()
    measured = list(itertools.dropwhile(lambda each: each[2] != "truth", read(path)))
    start: Any = measured[0][1]
    fused, alone = Filter(start), Filter(start)  # the second one never sees a fix
    x, y, w = fused.s[:3]
    errors: dict[str, list[float]] = {"encoders": [], "encoders and gyroscope": [], "GPS": [], "all three": []}
    for at, message, topic in measured:
        if isinstance(message, StampedIMURaw9):
            rate = message.gyro_z * COUNT
        elif isinstance(message, StampedEncoder):
            ticks[topic] += message.delta
            seen.add(topic)
        elif isinstance(message, StampedGPS) and message.fix:
            fix = origin.local(message.latitude, message.longitude)
            fused.correct(X, fix[0], FIX)
            fused.correct(Y, fix[1], FIX)
        elif isinstance(message, StampedPose3):
            for name, (px, py) in zip(errors, ((x, y), alone.s[:2], fix, fused.s[:2]), strict=True):
                errors[name].append(math.hypot(px - message.x, py - message.y))
        if len(seen) == 2:
            left, right = (each * METRES for each in ticks.values())
            way, turned = (left + right) / 2, (right - left) / BODY.track
            x, y, w = x + way * math.cos(w + turned / 2), y + way * math.sin(w + turned / 2), w + turned
            if before:
                for each in (fused, alone):
                    each.move(way, turned, (last + rate) / 2, (at - before) / 1e9)
            before, last, seen, ticks = at, rate, set(), dict.fromkeys(ticks, 0.0)
    return {name: math.sqrt(sum(e * e for e in each) / len(each)) for name, each in errors.items()}


if __name__ == "__main__":
    try:
        for name, error in fuse(*sys.argv[1:2] or sys.exit(__doc__)).items():
            print(f"{name:24} {error:6.3f} m")
    except r2p.BagError as reason:
        sys.exit(str(reason))
