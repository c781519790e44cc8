"""`r2p sim`: an emulated robot on a simulated RTCAN bus, open to the outside as a real one is through its gateway."""

import importlib.util
from typing import Annotated, Literal

import typer

from r2p.tools.options import Quiet, Verbose, Via, seconds
from r2p.tools.session import UsageError, check_urls, execute

DEBUG = "tcp-listen:0"
"""The debug line, on the loopback interface, at a port that is free."""
ZENOH = "zenoh:?listen=tcp/127.0.0.1:0&scouting=off"
"""On the loopback interface, too. It looks for nobody: two robots on one computer are two."""

_FAST = 60.0  # seconds


def command(
    robot: Annotated[Literal["triskar2"], typer.Argument(help="The omnidirectional robot of the thesis.")] = "triskar2",
    fast: Annotated[
        bool, typer.Option("--fast", help="As fast as possible, in virtual time; nobody can look on meanwhile.")
    ] = False,
    duration: Annotated[
        float | None,
        typer.Option("--duration", parser=seconds, metavar="TIME", help="How long; else until Ctrl-C; --fast: 60 (s)."),
    ] = None,
    seed: Annotated[int, typer.Option(metavar="N", help="Of all that is random; the same seed, the same robot.")] = 0,
    square: Annotated[
        bool, typer.Option("--square", help="Let a PC drive it along squares; --fast does so anyway.")
    ] = False,
    bus: Annotated[bool, typer.Option("--bus", help="Tell at the end who sent how much on the bus.")] = False,
    allow_control: Annotated[
        bool, typer.Option("--allow-control", help="Let the gateway take REBOOT and BOOTLOAD from IP links.")
    ] = False,
    via: Via = None,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Run an emulated robot: modules, motors, a body that moves, and a gateway for other programs.

    With --via the gateway opens these links, else the debug line on TCP and zenoh, on this computer only.
    """

    async def main() -> None:
        from r2p.tools.simulator.simulation import Play, play

        if fast and via:
            raise UsageError("--fast runs in virtual time, which nobody outside shares: leave out --via, or --fast")
        check_urls(via or [])
        wish = Play(
            duration=duration or (_FAST if fast else None),
            seed=seed,
            outside=() if fast else tuple(via or outside()),
            laps=float("inf") if square or fast else 0,
            fast=fast,
            bus=bus,
            allow_control=allow_control,
        )
        await play(wish)

    def virtually(_main: object) -> None:
        from r2p import sim

        sim.run(main, seed=seed)

    execute(main, verbose=verbose, quiet=quiet + 2, run=virtually if fast else None)


def outside() -> list[str]:
    """Where a robot is open by default: as far as this installation goes."""
    return [DEBUG, *([ZENOH] if importlib.util.find_spec("zenoh") else [])]
