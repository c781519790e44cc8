"""`r2p sim`: an emulated robot on a simulated RTCAN bus, which other programs reach through its gateway.

The command is here. `simulation` runs the robot (`r2p demo` does, too), and `screen` shows its figures; both are
imported when they are needed, as `r2p --help` must be fast.
"""

import importlib.util
from typing import Annotated, Literal

import typer

from r2p.tools.options import Quiet, Verbose, Via, seconds
from r2p.tools.session import UsageError, check_urls, execute

DEBUG = "tcp-listen:0"
"""The debug line, on the loopback interface, at a free port."""
ZENOH = "zenoh:?listen=tcp/127.0.0.1:0&scouting=off"
"""On the loopback interface, too, and without scouting: two robots on one computer stay separate."""

_FAST = 60.0  # seconds


def command(
    robot: Annotated[Literal["triskar2"], typer.Argument(help="The omnidirectional robot of the thesis.")] = "triskar2",
    fast: Annotated[
        bool, typer.Option("--fast", help="As fast as possible, in virtual time; other programs can't connect.")
    ] = False,
    duration: Annotated[
        float | None,
        typer.Option(
            "--duration", parser=seconds, metavar="TIME", help="How long; default: until Ctrl-C; --fast: 60 s."
        ),
    ] = None,
    seed: Annotated[int, typer.Option(metavar="N", help="Seed of all random numbers.")] = 0,
    square: Annotated[
        bool, typer.Option("--square", help="Let a PC drive it along squares; implied by --fast.")
    ] = False,
    bus: Annotated[bool, typer.Option("--bus", help="At the end, report how much each node sent on the bus.")] = False,
    allow_control: Annotated[
        bool, typer.Option("--allow-control", help="Let the gateway accept REBOOT and BOOTLOAD from IP links.")
    ] = False,
    via: Via = None,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Run an emulated robot: modules, motors, a body that moves, and a gateway for other programs.

    The gateway opens the links of --via; by default the debug line on TCP, and zenoh, for this computer only.
    """

    async def main() -> None:
        from r2p.tools.simulator.simulation import SimulationOptions, simulate

        if fast and via:
            raise UsageError("--fast runs in virtual time, so other programs can't connect: leave out --via or --fast")
        check_urls(via or [])
        options = SimulationOptions(
            duration=duration or (_FAST if fast else None),
            seed=seed,
            outside=() if fast else tuple(via or default_links()),
            laps=float("inf") if square or fast else 0,
            fast=fast,
            bus=bus,
            allow_control=allow_control,
        )
        await simulate(options)

    def virtually(_main: object) -> None:
        from r2p import sim

        sim.run(main, seed=seed)

    execute(main, verbose=verbose, quiet=quiet + 2, run=virtually if fast else None)


def default_links() -> list[str]:
    """Return the links that the gateway opens by default: zenoh only if it is installed."""
    return [DEBUG, *([ZENOH] if importlib.util.find_spec("zenoh") else [])]
