"""`r2p demo`: r2p at work on one computer, with emulated hardware and real links.

`r2p demo` shows a whole robot, Triskar2: seven modules on a simulated RTCAN bus, and a PC that drives it along a square
through the robot's gateway (`r2p.tools.simulator`). `r2p demo line` starts two modules with the firmware of 2014, IMU1
on a TCP connection and MOTOR1 on a pseudo terminal, as on a serial cable, and a module PC1 that talks to both over the
debug line (`robot`); `screen` shows what they do.
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
        typer.Option(
            "--duration", parser=seconds, metavar="TIME", help="How long; default: 20 s (robot), 10 s (line)."
        ),
    ] = None,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Show r2p at work, without hardware: live for a few seconds, then a summary."""

    async def line() -> None:
        from r2p.tools.demo.robot import Robot
        from r2p.tools.demo.screen import DemoScreen

        screen = DemoScreen()
        async with Robot() as robot:
            screen.print_introduction(robot)
            await screen.watch(robot, duration or _LINE)
            await robot.finish()
        screen.print_summary(robot)

    async def robot() -> None:
        from r2p.tools.simulator import default_links
        from r2p.tools.simulator.simulation import SimulationOptions, program, simulate

        await simulate(SimulationOptions(duration=duration or _ROBOT, outside=tuple(default_links()), laps=1))
        typer.echo(_NEXT.format(r2p=program()))

    execute(robot if what == "robot" else line, verbose=verbose, quiet=quiet + 2)


_NEXT = """
Try next, in two terminals: the same robot, and a program that drives it by keys
  {r2p} sim triskar2 --via tcp-listen:2323
  {r2p} run examples/teleop.py:keys --via tcp:127.0.0.1:2323
Or: {r2p} demo line, and with your own robot: {r2p} doctor"""
