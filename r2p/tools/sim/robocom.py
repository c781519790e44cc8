"""Robocom on the screen: its wheels, inertial sensors and GPS, and a map with the fixes."""

import functools
import math
from collections import deque
from typing import Unpack

import msgspec
from rich.text import Text

import r2p
from r2p.clock import clock_of
from r2p.msg import Odometry, StampedGPS, StampedOdometry
from r2p.sim.physics.inertial import GRAVITY
from r2p.sim.physics.world import Point, Triple, World
from r2p.sim.robots.base import RobotOptions
from r2p.sim.robots.figures import OdometryCheck, OdometryFigures, WheelFigures, wheel_figures
from r2p.sim.robots.robocom.nodes import eight
from r2p.sim.robots.robocom.robot import MOTORS, Robocom
from r2p.tools.sim.display import PICTURE_HEIGHT, PICTURE_WIDTH, RobotDisplay, drive_lines, drive_summary
from r2p.tools.sim.world_map import WorldMap, coloured
from r2p.units import SECOND

_SPEED, _RADIUS = 0.6, 1.5  # the eight: m/s and m; one takes 31 s
_FIXES = 60  # the last ones on the map
_MARK_EVERY = 5  # fixes: one a second
_SILENT = 1.0  # s


class GpsFigures(msgspec.Struct, frozen=True):
    """The last message of the GPS: how good the fix is, how far off (m), and how old (s)."""

    satellites: int
    fix: int
    off: float
    age: float


class RobocomFigures(msgspec.Struct, frozen=True):
    """The robot at a time."""

    pose: Triple
    path: float
    odometry: OdometryFigures | None
    wheels: list[WheelFigures]
    inertial: tuple[float, float]
    """Rate of turn (deg/s) and acceleration forward (m/s^2), as measured."""
    gps: GpsFigures | None
    fixes: list[Point]
    """The last positions of the GPS, m."""
    battery: tuple[float, float, float]
    """V, A, and 0 to 1."""
    off_max: float = 0.0
    """The largest distance of an odometry from the true position so far, m."""
    gps_off: float = 0.0
    """That of the fixes, as root of the mean square, m."""


class RobocomDisplay(RobotDisplay[RobocomFigures]):
    """Robocom outdoors, along a figure of eight. It publishes its true pose, for programs to compare with."""

    robot_class = Robocom
    robot: Robocom

    def __init__(self, via: str, *, seed: int, **options: Unpack[RobotOptions]) -> None:
        """Make the robot."""
        self.robot = Robocom(via, seed=seed, truth=True, **options)
        self._odometry = OdometryCheck(lambda: self.robot.pose)
        self._map = WorldMap(World(), PICTURE_WIDTH, PICTURE_HEIGHT)
        self._clock = clock_of()
        self._gps: GpsFigures | None = None
        self._gps_at = 0
        self._fixes: deque[Point] = deque(maxlen=_FIXES)
        self._count, self._squares = 0, 0.0

    def watch(self, pc: r2p.Module) -> None:
        pc.start(self._watch, name="watch")

    async def _watch(self, node: r2p.Node) -> None:
        """Compare odometry and fixes with the true pose."""

        def odometry(message: StampedOdometry) -> None:
            self._odometry.received(Odometry(message.pose, message.velocity))

        node.subscribe("odometry", StampedOdometry, odometry, queue=1, lossy=True)
        node.subscribe("gps", StampedGPS, self._fix, queue=4, lossy=True)
        while True:
            await node.spin()

    def _fix(self, fix: StampedGPS) -> None:
        self._gps_at = self._clock.monotonic()
        x, y = self.robot.hardware.receiver.origin.local(fix.latitude, fix.longitude)
        off = math.dist((x, y), self.robot.pose[:2]) if fix.fix else 0.0
        self._gps = GpsFigures(fix.satellites, fix.fix, off, 0.0)
        if fix.fix:
            if self._count % _MARK_EVERY == 0:
                self._fixes.append((x, y))
            self._count += 1
            self._squares += off * off

    def drive(self, pc: r2p.Module, *, rounds: float) -> None:
        pc.start(functools.partial(eight, speed=_SPEED, radius=_RADIUS, rounds=rounds), name="eight")

    def read(self) -> RobocomFigures:
        robot, hardware = self.robot, self.robot.hardware
        battery, unit = hardware.battery, hardware.unit
        age = (self._clock.monotonic() - self._gps_at) / SECOND
        return RobocomFigures(
            robot.pose,
            hardware.body.path,
            self._odometry.last,
            [wheel_figures(robot, name, drive) for name, drive in zip(MOTORS, hardware.drives, strict=True)],
            (unit.gyroscope.values[2] / 1000, unit.accelerometer.values[0] / 1000 * GRAVITY),
            self._gps and msgspec.structs.replace(self._gps, age=age),
            list(self._fixes),
            (battery.voltage, battery.current, battery.charge),
            self._odometry.off_max,
            math.sqrt(self._squares / self._count) if self._count else 0.0,
        )

    def state(self, body: RobocomFigures) -> list[str]:
        turn, ahead = body.inertial
        volts, amperes, charge = body.battery
        return [
            *drive_lines(body.pose, body.odometry, body.wheels),
            f"IMU       turn {turn:z6.1f} deg/s  ahead {ahead:z5.2f} m/s^2",
            f"GPS       {_gps_state(body.gps)}",
            f"battery   {volts:.1f} V  {amperes:.1f} A  {charge:.0%}",
        ]

    def picture(self, body: RobocomFigures) -> Text:
        return coloured(self._map.draw(body.pose, body.fixes))

    def progress(self, body: RobocomFigures) -> str:
        return f"{body.path:.2f} m driven"

    def line(self, body: RobocomFigures) -> str:
        x, y, w = body.pose
        off = "no fix" if body.gps is None or not body.gps.fix else f"off {body.gps.off:.2f} m"
        return f"at {x:z5.2f} {y:z5.2f} m {math.degrees(w):z4.0f} deg  GPS {off}"

    def summary(self, body: RobocomFigures) -> list[str]:
        lines = drive_summary(body.path, body.pose, body.odometry, body.off_max)
        if body.gps_off:
            lines.append(f"GPS: off by {body.gps_off:.2f} m (root of the mean square)")
        return lines

    def hints(self, url: str, *, driven: bool) -> list[str]:
        record = f"bag record -a -o drive.mcap --via {url}"
        return [record] if driven else [f"topic pub velocity x=0.3 -r 20 --via {url}", record]


def _gps_state(gps: GpsFigures | None) -> str:
    if gps is None:
        return "nothing yet"
    if gps.age > _SILENT:
        return f"silent for {gps.age:.0f} s"
    if not gps.fix:
        return "no fix"
    return f"{gps.satellites} satellites  off by {gps.off:.2f} m"
