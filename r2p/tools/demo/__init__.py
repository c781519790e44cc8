"""`r2p demo`: r2p at work on one computer, with hardware that is emulated and links that are real.

`r2p demo` shows a whole robot, Triskar2: seven modules on a simulated RTCAN bus, and a PC that drives it along a square
through the robot's gateway. `r2p demo line` starts two modules with the firmware of 2014, IMU1 on a TCP connection and
MOTOR1 on a pseudo terminal, as on a serial cable, and a module PC1 that talks to both over the debug line.
"""

from typing import Annotated, Literal

import typer

from r2p.tools.options import Quiet, Verbose, seconds
from r2p.tools.session import execute

_ROBOT, _LINE = 20.0, 10.0  # seconds


def command(
    what: Annotated[
        Literal["robot", "line"],
        typer.Argument(help="robot: on a simulated CAN bus; line: the debug line, on TCP and on a serial port."),
    ] = "robot",
    duration: Annotated[
        float | None,
        typer.Option("--duration", parser=seconds, metavar="TIME", help="How long; default: robot 20, line 10 (s)."),
    ] = None,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Show r2p at work, without hardware: live for some seconds, then a summary."""

    async def line() -> None:
        from r2p.tools.demo.robot import Robot
        from r2p.tools.demo.screen import DemoScreen

        screen = DemoScreen()
        async with Robot() as robot:
            screen.introduce(robot)
            await screen.watch(robot, duration or _LINE)
            await robot.finish()
        screen.conclude(robot)

    async def robot() -> None:
        from r2p.tools.simulator import outside
        from r2p.tools.simulator.simulation import Play, play, program

        await play(Play(duration=duration or _ROBOT, outside=tuple(outside()), laps=1))
        typer.echo(_NEXT.format(r2p=program()))

    execute(robot if what == "robot" else line, verbose=verbose, quiet=quiet + 2)


_NEXT = """
Try next, in two terminals: the same robot, which waits for you, and the keys
  {r2p} sim triskar2 --via tcp-listen:2323
  {r2p} run examples/teleop.py:keys --via tcp:127.0.0.1:2323
Or: {r2p} demo line, and on a robot of yours: {r2p} doctor"""
