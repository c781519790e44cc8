"""`r2p demo`: r2p at work on one computer, with modules that are emulated and links that are real.

`r2p demo line` starts two emulated modules with the firmware of 2014, IMU1 on a TCP connection and MOTOR1 on a pseudo
terminal, as on a serial cable, and a module PC1 that talks to both over the debug line.
"""

from typing import Annotated, Literal

import typer

from r2p.tools.session import Quiet, Verbose, execute, seconds

_DURATION = 10.0  # seconds


def command(
    what: Annotated[
        Literal["line"], typer.Argument(help="line: the debug line, on TCP and on a serial port.")
    ] = "line",
    duration: Annotated[
        float | None, typer.Option("--duration", parser=seconds, metavar="TIME", help="How long; default: 10 (s).")
    ] = None,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Show r2p at work, without hardware: live for ten seconds, then a summary."""

    async def main() -> None:
        from r2p.tools._demo.robot import Robot
        from r2p.tools._demo.screen import Screen

        screen = Screen()
        async with Robot() as robot:
            screen.introduce(robot)
            await screen.watch(robot, duration or _DURATION)
            await robot.finish()
        screen.conclude(robot)

    execute(main, verbose=verbose, quiet=quiet + 1)
