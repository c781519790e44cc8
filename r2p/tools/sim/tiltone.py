"""tiltOne on the screen: how it leans and how it is to lean, its speed, and a side view; and hands that help it up."""

import asyncio
import functools
import math
from typing import Unpack

import msgspec
from rich.text import Text

import r2p
from r2p.msg import Float32, Tilt, Velocity3
from r2p.sim.robots.base import RobotOptions
from r2p.sim.robots.figures import OdometryCheck, OdometryFigures, WheelFigures
from r2p.sim.robots.shared_nodes import COMMANDS, FRESH, Latest
from r2p.sim.robots.tiltone.robot import MOTORS, TiltOne
from r2p.tools.sim.display import (
    PICTURE_HEIGHT,
    PICTURE_WIDTH,
    RobotDisplay,
    odometry_accuracy,
    odometry_line,
)

_STAND, _AHEAD, _CURVE, _SHOVED, _REST = 3.0, 5.0, 4.0, 4.0, 4.0  # s of the demonstration's parts
_SPEED, _TURN = 0.5, 0.6  # m/s and rad/s
_SHOVE = -10.0  # Ns, from ahead
_LYING = 3.0  # s that it lies on the floor before it is set upright
_SHOWN = 1.0  # s for which a shove is in the picture
_UPRIGHT = math.radians(10)  # up to this tilt a robot whose motors stopped is not called falling
_LOOK = 0.1  # s between two looks at whether it fell

_MAGNIFIED = 4  # times that it leans as far in the picture
_COLUMN = 0.05  # m of floor in each column
_MARK = 0.5  # m from mark to mark
_AXLE = PICTURE_WIDTH // 2  # column
_SPOKES = "|/-\\"


class TiltOneFigures(msgspec.Struct, frozen=True):
    """The robot at a time: angles in rad, speeds in m/s and rad/s."""

    status: str
    tilt: float
    wanted_tilt: float | None
    speed: float
    turn: float
    command: Velocity3 | None
    odometry: OdometryFigures | None
    wheels: list[WheelFigures]
    """With setpoints in V or Nm."""
    unit: str
    battery: tuple[float, float, float]
    """V, A, and 0 to 1."""
    age: float
    """Mean age of the motors' inputs, s."""
    path: float
    travelled: float
    """Forward, by the wheels, m."""
    shoved: float = 0.0
    """Ns, in the last second."""
    falls: int = 0
    worst: float = 0.0
    """The largest tilt so far, while it balanced."""
    off_max: float = 0.0
    """The largest distance of an odometry from the true position so far, m."""


class TiltOneDisplay(RobotDisplay[TiltOneFigures]):
    """tiltOne on a floor without an end. A message of `shove` hits it."""

    robot_class = TiltOne
    robot: TiltOne

    def __init__(self, via: str, *, seed: int, **options: Unpack[RobotOptions]) -> None:
        """Make the robot."""
        self.robot = TiltOne(via, seed=seed, **options)
        self._odometry = OdometryCheck(lambda: self.robot.pose)
        self._wanted: Latest[Tilt] | None = None
        self._command: Latest[Velocity3] | None = None
        self._shoved, self._shoved_at = 0.0, -math.inf
        self._falls, self._worst = 0, 0.0

    def watch(self, pc: r2p.Module) -> None:
        pc.start(self._odometry.watch, name="watch")
        pc.start(self._look, name="look")
        pc.start(self._help, name="hands")

    def drive(self, pc: r2p.Module, *, rounds: float) -> None:
        pc.start(functools.partial(self._demonstrate, rounds=rounds), name="rider")

    def read(self) -> TiltOneFigures:
        robot, hardware = self.robot, self.robot.hardware
        body, battery = hardware.body, hardware.battery
        recent = self._time() - self._shoved_at < _SHOWN
        wanted = self._wanted.message if self._wanted else None
        wheels = zip(MOTORS, hardware.drives, strict=True)
        return TiltOneFigures(
            self._status(),
            body.tilt,
            None if wanted is None else wanted.angle,
            body.velocity,
            body.turn_rate,
            self._command.message if self._command else None,
            self._odometry.last,
            [
                WheelFigures(name, name in robot.modules, drive.setpoint, drive.motor.speed, drive.motor.current)
                for name, drive in wheels
            ],
            hardware.spec.unit,
            (battery.voltage, battery.current, battery.charge),
            robot.ages.mean,
            body.path,
            (hardware.motors[0].angle + hardware.motors[1].angle) / 2 * body.spec.wheel_radius,
            self._shoved if recent else 0.0,
            self._falls,
            self._worst,
            self._odometry.off_max,
        )

    def state(self, body: TiltOneFigures) -> list[str]:
        volts, amperes, charge = body.battery
        wanted = "" if body.wanted_tilt is None else f"wanted {math.degrees(body.wanted_tilt):z5.2f}"
        speed, turn = ("", "") if body.command is None else (f"{body.command.x:z5.2f}", f"{body.command.w:z5.2f}")
        return [
            f"tilt      {math.degrees(body.tilt):z6.2f} deg    {wanted:12}  {body.status}",
            f"speed     {body.speed:z6.2f} m/s    wanted {speed or '    none'}",
            f"turn      {body.turn:z6.2f} rad/s  wanted {turn or '    none'}",
            odometry_line(body.odometry),
            *(_wheel_line(wheel, body.unit) for wheel in body.wheels),
            f"battery   {volts:6.1f} V  {amperes:z5.1f} A  {charge:4.0%}  delay {body.age * 1000:.1f} ms",
        ]

    def picture(self, body: TiltOneFigures) -> Text:
        return _coloured(side_view(body))

    def progress(self, body: TiltOneFigures) -> str:
        return f"{body.path:.2f} m driven"

    def line(self, body: TiltOneFigures) -> str:
        tilt = math.degrees(body.tilt)
        return f"{body.status:9} {tilt:z6.2f} deg  {body.speed:z5.2f} m/s  {body.turn:z5.2f} rad/s"

    def summary(self, body: TiltOneFigures) -> list[str]:
        falls = f"fell {body.falls} time{'' if body.falls == 1 else 's'}" if body.falls else "it never fell"
        lines = [
            f"{body.path:.2f} m driven; {falls}; leant by up to {math.degrees(body.worst):.1f} deg",
            f"from a tilt to the motors' efforts: {body.age * 1000:.1f} ms on average",
        ]
        if body.odometry is not None:
            lines.append(odometry_accuracy(body.odometry, body.off_max, why="it leans"))
        return lines

    def hints(self, url: str, *, driven: bool) -> list[str]:
        shove = f"topic pub shove data=8 --type Float32 --via {url}"
        return [shove] if driven else [f"topic pub velocity x=0.3 w=0.2 -r 20 --via {url}", shove]

    def _status(self) -> str:
        body, drives = self.robot.hardware.body, self.robot.hardware.drives
        if body.held:
            return "held"
        if body.fallen:
            return "fallen"
        if all(drive.setpoint for drive in drives):
            return "balancing"
        return "falling" if abs(body.tilt) > _UPRIGHT else "stopped"  # by a brake, as when an effort was late

    def _time(self) -> float:
        plant = self.robot.plant
        return plant.steps * plant.dt

    def _shove(self, impulse: float) -> None:
        self._shoved, self._shoved_at = impulse, self._time()
        self.robot.shove(impulse)

    async def _look(self, node: r2p.Node) -> None:
        """Receive the commands of its velocity and of its tilt, and shoves."""
        self._wanted = Latest(node, "tilt_setpoint", Tilt, fresh=FRESH)
        self._command = Latest(node, "velocity", Velocity3, fresh=FRESH)
        node.subscribe("shove", Float32, lambda shove: self._shove(shove.data))
        while True:
            await node.spin()

    async def _help(self, _node: r2p.Node) -> None:
        """Let the robot go when it is ready, and set it upright when it has fallen."""
        await self.robot.release()
        body = self.robot.hardware.body
        while True:
            await asyncio.sleep(_LOOK)
            if body.fallen:
                self._falls += 1
                await asyncio.sleep(_LYING)
                await self.robot.set_upright()
            if self._status() == "balancing":
                self._worst = max(self._worst, abs(body.tilt))

    async def _demonstrate(self, node: r2p.Node, rounds: float) -> None:
        """Stand, drive, turn, get a shove from ahead, drive on, and stop."""
        commands = node.advertise("velocity", Velocity3, r2p.Sporadic(deadline=COMMANDS))
        start, shoves, now = node.now(), 0, Velocity3()
        length = _STAND + _AHEAD + _CURVE + _SHOVED + _REST
        async for _ in node.every(COMMANDS):
            done, within = divmod((node.now() - start) / 1e9, length)
            now = velocity_at(within) if done < rounds else Velocity3()
            if done < rounds and shoves <= done and within >= _STAND + _AHEAD + _CURVE:
                shoves += 1
                self._shove(_SHOVE)
            await commands.publish(now)


def velocity_at(time: float) -> Velocity3:
    """Return the command at a time of a round, s."""
    driving = _AHEAD + _CURVE + _SHOVED
    turning = _STAND + _AHEAD <= time < _STAND + _AHEAD + _CURVE
    return Velocity3(x=_SPEED if _STAND <= time < _STAND + driving else 0.0, w=_TURN if turning else 0.0)


def side_view(body: TiltOneFigures) -> str:
    """Return the robot from its right side, leaning four times as far as it does, and marks in the floor."""
    cells = [[" "] * PICTURE_WIDTH for _ in range(PICTURE_HEIGHT)]
    floor = PICTURE_HEIGHT - 1
    marks = {round((mark * _MARK - body.travelled % _MARK) / _COLUMN) for mark in range(-3, 5)}
    cells[floor] = ["+" if column - _AXLE in marks else "-" for column in range(PICTURE_WIDTH)]
    if body.wanted_tilt is not None:
        _draw_frame(cells, body.wanted_tilt, ".", ".")
    _draw_frame(cells, body.tilt, "", "O")
    angle = body.travelled / 0.25  # rad of a wheel of tiltOne
    cells[floor - 1][_AXLE - 1 : _AXLE + 2] = "(" + _SPOKES[round(angle / (math.pi / 4)) % 4] + ")"
    if body.shoved:
        arrow, column = ("==>", 0) if body.shoved > 0 else ("<==", PICTURE_WIDTH - 3)
        cells[1][column : column + 3] = arrow
    return "\n".join("".join(row) for row in cells)


def _draw_frame(cells: list[list[str]], tilt: float, sign: str, head: str) -> None:
    """Draw the frame from the axle up, a character being twice as high as wide."""
    angle = max(-1.4, min(1.4, _MAGNIFIED * tilt))
    up, across = (PICTURE_HEIGHT - 2) * math.cos(angle), 2 * (PICTURE_HEIGHT - 2) * math.sin(angle)
    slope = across / up  # columns in each row
    drawn = sign or ("|" if abs(slope) < 0.5 else "_" if abs(slope) > 4 else "/" if slope > 0 else "\\")
    count = round(max(up, abs(across)))
    for step in range(1, count + 1):
        row, column = PICTURE_HEIGHT - 2 - round(up * step / count), _AXLE + round(across * step / count)
        if 0 <= column < PICTURE_WIDTH:
            cells[row][column] = head if step == count else drawn


def _coloured(drawing: str) -> Text:
    text = Text(drawing, style="bold yellow")
    text.highlight_regex(r"[-+]{9,}", "not bold green")
    text.highlight_regex(r"\.", "not bold dim default")
    text.highlight_regex(r"==>|<==", "bold red")
    return text


def _wheel_line(wheel: WheelFigures, unit: str) -> str:
    if not wheel.on:
        return f"{wheel.name}    switched off"
    effort = "stopped" if wheel.setpoint is None else f"{wheel.setpoint:z6.2f} {unit}"
    return f"{wheel.name}    {effort:9}  {wheel.speed:z6.2f} rad/s {wheel.current:z6.2f} A"
