"""What `r2p sim` knows of each robot: how to make it, how to drive it for a demonstration, and what to show of it."""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable
from typing import ClassVar, Generic, TypeVar, Unpack

from rich.text import Text

import r2p
from r2p.sim.physics.world import Triple
from r2p.sim.robots.base import EmulatedRobot, RobotOptions
from r2p.sim.robots.figures import OdometryFigures, WheelFigures

B = TypeVar("B")

STATE_WIDTH = 48
"""Columns of the state, at most."""
PICTURE_WIDTH, PICTURE_HEIGHT = 28, 9
"""Columns and lines of the picture beside it."""
WHEELS = "motors     wanted     speed (rad/s)    current"
"""The head of wheels."""


class RobotDisplay(ABC, Generic[B]):
    """One run of a robot. `B` is what its figures have beside topics and bus.

    All texts are drawn from figures alone, so that they can be looked at without a run.
    """

    robot_class: ClassVar[type[EmulatedRobot]]
    robot: EmulatedRobot

    @abstractmethod
    def __init__(self, via: str, *, seed: int, **options: Unpack[RobotOptions]) -> None:
        """Make the robot, with its world."""

    @abstractmethod
    def watch(self, pc: r2p.Module) -> None:
        """Start nodes that watch the robot, on a PC outside of it."""

    @abstractmethod
    def drive(self, pc: r2p.Module, *, rounds: float) -> None:
        """Start nodes that drive the robot, on that PC: `rounds` times what there is to see, which may be infinite."""

    @abstractmethod
    def read(self) -> B:
        """Return the figures of the robot now."""

    @abstractmethod
    def state(self, body: B) -> list[str]:
        """Return about seven lines of at most 48 columns, each with a label in the first ten."""

    @abstractmethod
    def picture(self, body: B) -> Text:
        """Return nine lines of 28 columns."""

    @abstractmethod
    def progress(self, body: B) -> str:
        """Return a few words for the title."""

    @abstractmethod
    def line(self, body: B) -> str:
        """Return the figures in at most 60 columns, for output that is not a terminal."""

    @abstractmethod
    def summary(self, body: B) -> list[str]:
        """Return how it ended: how far, and where; then what else counts. Each line has at most 80 columns."""

    @abstractmethod
    def hints(self, url: str, *, driven: bool) -> list[str]:
        """Return arguments for `r2p` to try in another terminal, if the robot is not driven also to drive it."""


# Lines about what several robots have


def drive_lines(pose: Triple, odometry: OdometryFigures | None, wheels: Iterable[WheelFigures]) -> list[str]:
    """Return lines about where a robot on wheels is, where it believes to be, and what its wheels do."""
    # Position and odometry of one instant, so that they can be compared: in 0.1 s the robot drives 5 cm.
    x, y, w = odometry.truth if odometry and odometry.fresh else pose
    return [
        f"position  x {x:z6.2f}  y {y:z6.2f} m  heading {math.degrees(w):z4.0f} deg",
        odometry_line(odometry),
        WHEELS,
        *(wheel_line(wheel) for wheel in wheels),
    ]


def drive_summary(path: float, pose: Triple, odometry: OdometryFigures | None, off_max: float) -> list[str]:
    """Return lines about how far a robot on wheels drove, where it is (m), and how good its odometry was."""
    x, y, _ = pose
    lines = [f"{path:.2f} m driven; the robot is at x {x:.3f}, y {y:.3f} m"]
    return lines if odometry is None else [*lines, odometry_accuracy(odometry, off_max)]


def odometry_line(odometry: OdometryFigures | None) -> str:
    """Return a line about the last odometry, and how far it is off."""
    if odometry is None:
        return "odometry  nothing yet"
    note = f"off by {odometry.off * 1000:.0f} mm" if odometry.fresh else f"{odometry.age:.1f} s ago"
    return f"odometry  x {odometry.pose.x:z6.2f}  y {odometry.pose.y:z6.2f} m  {note}"


def odometry_accuracy(odometry: OdometryFigures, off_max: float, why: str = "no two wheels have the same size") -> str:
    """Return a line about the odometry. On a square its errors cancel out: the one at the end says little."""
    now, most = round(odometry.off * 1000), round(off_max * 1000)
    if not most:
        return "odometry: exact to the millimetre"
    before = f", earlier by {most} mm" if most > now else ""
    return f"odometry: off by {now} mm{before}: {why}"


def wheel_line(wheel: WheelFigures) -> str:
    """Return a line about a wheel, in the columns of `WHEELS`."""
    if not wheel.on:
        return f"{wheel.name}    switched off"
    wanted = "stopped" if wheel.setpoint is None else f"{wheel.setpoint:z7.2f}"
    return f"{wheel.name}    {wanted:>7}   {wheel.speed:z7.2f}          {wheel.current:z6.2f} A"
