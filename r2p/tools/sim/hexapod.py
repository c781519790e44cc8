"""The hexapod on the screen: its joints and feet, where it is and where it believes to be, and a top view."""

import functools
import math
from typing import Unpack

import msgspec
from rich.text import Text

import r2p
from r2p.sim.physics.world import Triple
from r2p.sim.robots.base import RobotOptions
from r2p.sim.robots.figures import OdometryCheck, OdometryFigures
from r2p.sim.robots.hexapod import nodes
from r2p.sim.robots.hexapod.robot import MOTORS, Hexapod
from r2p.tools.sim.display import PICTURE_HEIGHT, PICTURE_WIDTH, RobotDisplay, odometry_accuracy, odometry_line

_COLUMN, _ROW = 0.025, 0.065  # m in each column and line of the picture
_MIDDLE, _WAIST = PICTURE_WIDTH // 2, PICTURE_HEIGHT // 2


class LegFigures(msgspec.Struct, frozen=True):
    """A leg: angles of its joints from home (rad; None: the module is off), its foot, and whether that stands."""

    angles: tuple[float | None, float | None, float | None]
    foot: Triple
    stands: bool


class HexapodFigures(msgspec.Struct, frozen=True):
    """The robot at a time."""

    pose: Triple
    path: float
    height: float
    lies: bool
    odometry: OdometryFigures | None
    legs: list[LegFigures]
    battery: tuple[float, float, float]
    """V, A, and 0 to 1."""
    off_max: float = 0.0
    """The largest distance of an odometry from the true position so far, m."""


class HexapodDisplay(RobotDisplay[HexapodFigures]):
    """The hexapod on a floor without an end."""

    robot_class = Hexapod
    robot: Hexapod

    def __init__(self, via: str, *, seed: int, **options: Unpack[RobotOptions]) -> None:
        """Make the robot."""
        self.robot = Hexapod(via, seed=seed, **options)
        self._odometry = OdometryCheck(lambda: self.robot.pose)

    def watch(self, pc: r2p.Module) -> None:
        pc.start(self._odometry.watch, name="watch")

    def drive(self, pc: r2p.Module, *, rounds: float) -> None:
        pc.start(functools.partial(nodes.walker, rounds=rounds), name="walker")

    def read(self) -> HexapodFigures:
        robot, body, battery = self.robot, self.robot.hardware.body, self.robot.hardware.battery
        angles = [
            joint.motor.angle if name in robot.modules else None
            for name, joint in zip(MOTORS, body.joints, strict=True)
        ]
        legs = [
            LegFigures((angles[3 * leg], angles[3 * leg + 1], angles[3 * leg + 2]), foot, stands)
            for leg, (foot, stands) in enumerate(zip(body.feet, body.standing, strict=True))
        ]
        last = self._odometry.last
        return HexapodFigures(
            robot.pose,
            body.path,
            body.height,
            body.lies,
            last,
            legs,
            (battery.voltage, battery.current, battery.charge),
            self._odometry.off_max,
        )

    def state(self, body: HexapodFigures) -> list[str]:
        x, y, w = body.odometry.truth if body.odometry and body.odometry.fresh else body.pose
        volts, amperes, charge = body.battery
        return [
            f"position  x {x:z6.2f}  y {y:z6.2f} m  heading {math.degrees(w):z4.0f} deg",
            odometry_line(body.odometry),
            *(_leg_line(name, leg) for name, leg in zip(nodes.LEGS, body.legs, strict=True)),
            f"battery   {volts:.1f} V  {amperes:.1f} A  {charge:.0%}  height {body.height * 1000:.0f} mm",
        ]

    def picture(self, body: HexapodFigures) -> Text:
        text = Text(top_view(body), style="bold yellow")
        text.highlight_regex(r"\.", "not bold dim default")
        text.highlight_regex(r"O", "bold green")
        text.highlight_regex(r"o", "bold cyan")
        return text

    def progress(self, body: HexapodFigures) -> str:
        return f"{body.path:.2f} m walked"

    def line(self, body: HexapodFigures) -> str:
        x, y, w = body.pose
        feet = "".join("O" if leg.stands else "o" for leg in body.legs)
        return f"at {x:z5.2f} {y:z5.2f} m {math.degrees(w):z4.0f} deg  feet {feet}"

    def summary(self, body: HexapodFigures) -> list[str]:
        x, y, _ = body.pose
        lines = [f"{body.path:.2f} m walked; the robot is at x {x:.3f}, y {y:.3f} m"]
        if body.odometry is not None:
            lines.append(odometry_accuracy(body.odometry, body.off_max, why="feet slip"))
        return lines

    def hints(self, url: str, *, driven: bool) -> list[str]:
        return [] if driven else [f"topic pub velocity x=0.1 -r 20 --type Velocity3 --via {url}"]


def _leg_line(name: str, leg: LegFigures) -> str:
    hip, shoulder, knee = ("  off" if angle is None else f"{math.degrees(angle):z5.1f}" for angle in leg.angles)
    return f"{name.upper()}  hip {hip}  shoulder {shoulder} knee {knee}  {'stands' if leg.stands else 'swings'}"


def top_view(body: HexapodFigures) -> str:
    """Return the robot from above, its front at the top: O for a foot that stands, o for one that swings."""
    cells = [[" "] * PICTURE_WIDTH for _ in range(PICTURE_HEIGHT)]
    for (x, y, _), leg in zip(nodes.BODY.hips, body.legs, strict=True):
        foot_x, foot_y, _ = leg.foot
        for part in range(1, 8):
            _draw(cells, x + (foot_x - x) * part / 8, y + (foot_y - y) * part / 8, ".")
        _draw(cells, foot_x, foot_y, "O" if leg.stands else "o")
    for row in range(_WAIST - 2, _WAIST + 3):
        cells[row][_MIDDLE - 3 : _MIDDLE + 4] = "|     |"
    cells[_WAIST - 3][_MIDDLE - 3 : _MIDDLE + 4] = "/--^--\\"
    cells[_WAIST + 3][_MIDDLE - 3 : _MIDDLE + 4] = "\\-----/"
    return "\n".join("".join(row) for row in cells)


def _draw(cells: list[list[str]], x: float, y: float, sign: str) -> None:
    row, column = _WAIST - round(x / _ROW), _MIDDLE - round(y / _COLUMN)
    if 0 <= row < PICTURE_HEIGHT and 0 <= column < PICTURE_WIDTH:
        cells[row][column] = sign
