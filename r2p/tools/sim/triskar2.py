"""Triskar2 on the screen: its wheels, where it is and where it believes to be, and a map."""

import functools
import math
from typing import Unpack

import msgspec
from rich.text import Text

import r2p
from r2p.sim.physics.world import Triple, World, box
from r2p.sim.robots.base import RobotOptions
from r2p.sim.robots.emulated import MOTORS, Triskar2
from r2p.sim.robots.figures import OdometryCheck, OdometryFigures, WheelFigures, wheel_figures
from r2p.sim.robots.triskar2 import square
from r2p.tools.sim.display import PICTURE_HEIGHT, PICTURE_WIDTH, RobotDisplay, drive_lines, drive_summary
from r2p.tools.sim.world_map import WorldMap, coloured

_SIDE, _SPEED, _WAIT = 2.0, 0.5, 1.0  # the square: m, m/s, and seconds until it starts; one lap takes 18 s


class Triskar2Figures(msgspec.Struct, frozen=True):
    """The robot at a time."""

    pose: Triple
    path: float
    odometry: OdometryFigures | None
    wheels: list[WheelFigures]
    battery: tuple[float, float, float]
    """V, A, and 0 to 1."""
    off_max: float = 0.0
    """The largest distance of an odometry from the true position so far, m."""
    attitude: Triple | None = None
    """Of the inertial sensors, if they are on: roll, pitch and yaw, rad."""
    leds: str = ""
    """Of the input/output module, if it is on."""


class Triskar2Display(RobotDisplay[Triskar2Figures]):
    """Triskar2 in a room, along a square."""

    robot_class = Triskar2
    robot: Triskar2

    def __init__(self, via: str, *, seed: int, **options: Unpack[RobotOptions]) -> None:
        """Make the robot, in a room."""
        world = World(box(_SIDE / 2, _SIDE / 2, 3.8, 3.8))
        self.robot = Triskar2(via, seed=seed, world=world, **options)
        self._odometry = OdometryCheck(lambda: self.robot.pose)
        self._map = WorldMap(world, PICTURE_WIDTH, PICTURE_HEIGHT)

    def watch(self, pc: r2p.Module) -> None:
        pc.start(self._odometry.watch, name="watch")

    def drive(self, pc: r2p.Module, *, rounds: float) -> None:
        pc.start(functools.partial(square, side=_SIDE, speed=_SPEED, laps=rounds, wait=_WAIT), name="square")

    def read(self) -> Triskar2Figures:
        robot, hardware = self.robot, self.robot.hardware
        battery = hardware.battery
        return Triskar2Figures(
            robot.pose,
            hardware.body.path,
            self._odometry.last,
            [wheel_figures(robot, name, drive) for name, drive in zip(MOTORS, hardware.drives, strict=True)],
            (battery.voltage, battery.current, battery.charge),
            self._odometry.off_max,
            hardware.inertial.attitude.angles if "IMU1" in robot.modules else None,
            "".join(".*"[on] for on in hardware.pins.digital) if "IO1" in robot.modules else "",
        )

    def state(self, body: Triskar2Figures) -> list[str]:
        volts, amperes, charge = body.battery
        return [
            *drive_lines(body.pose, body.odometry, body.wheels),
            f"battery   {volts:.1f} V  {amperes:.1f} A  {charge:.0%}",
            *([] if body.attitude is None else [_attitude_line(*body.attitude)]),
            *([f"leds      {body.leds}"] if body.leds else []),
        ]

    def picture(self, body: Triskar2Figures) -> Text:
        return coloured(self._map.draw(body.pose))

    def progress(self, body: Triskar2Figures) -> str:
        return f"{body.path:.2f} m driven"

    def line(self, body: Triskar2Figures) -> str:
        x, y, w = body.pose
        speeds = " ".join(f"{wheel.speed:z6.2f}" for wheel in body.wheels)
        return f"at {x:z5.2f} {y:z5.2f} m {math.degrees(w):z4.0f} deg  wheels {speeds}"

    def summary(self, body: Triskar2Figures) -> list[str]:
        return drive_summary(body.path, body.pose, body.odometry, body.off_max)

    def hints(self, url: str, *, driven: bool) -> list[str]:
        return [] if driven else [f"topic pub velocity_cmd x=0.2 -r 20 --via {url}"]


def _attitude_line(roll: float, pitch: float, yaw: float) -> str:
    """Return a line about what the inertial sensors say."""
    angles = "  ".join(
        f"{name} {math.degrees(angle):z4.0f}" for name, angle in (("roll", roll), ("pitch", pitch), ("yaw", yaw))
    )
    return f"imu       {angles} deg"
