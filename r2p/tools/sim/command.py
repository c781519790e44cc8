"""`r2p sim`: an emulated robot on a simulated RTCAN bus, which other programs reach through its gateway."""

import functools
import importlib
import math
from collections.abc import Iterable
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from r2p.sim.modules.boards import ParameterOptions
from r2p.sim.robots.base import EmulatedRobot
from r2p.tools.bus.serving import checked
from r2p.tools.config import did_you_mean
from r2p.tools.options import Params, ParamsFile, Quiet, Verbose, Via, time_option
from r2p.tools.session import UsageError, check_urls, execute, run_virtually, settings
from r2p.tools.sim.parameters import parameter_sources
from r2p.tools.sim.run import default_links, simulate

if TYPE_CHECKING:
    from r2p.tools.sim.display import RobotDisplay

_FAST = 60.0  # seconds

_Name = Literal["triskar2", "robocom", "tiltone", "hexapod"]
_DISPLAYS: dict[_Name, str] = {
    "triskar2": "Triskar2Display",
    "robocom": "RobocomDisplay",
    "tiltone": "TiltOneDisplay",
    "hexapod": "HexapodDisplay",
}
"""The display of each robot, in a module with its name."""
_ROBOTS = "Of the thesis: triskar2, on omni wheels; robocom, for fusion; tiltone, which balances. Also: hexapod."


def _complete_extra(ctx: typer.Context, incomplete: str) -> list[str]:
    """Return the extra modules of the robot that begin so, without those that are on the line."""
    given = ctx.params.get("extras") or ()
    return [
        name
        for name in display_of(ctx.params["robot"]).robot_class.extras
        if name not in given and name.startswith(incomplete)
    ]


_Speed = Annotated[
    float | None,
    typer.Option(metavar="N", min=0.1, max=100.0, help="N times as fast as real time; ROS nodes follow its /clock."),
]
_Drive = Annotated[bool, typer.Option("--drive", help="Let a PC drive it, to look at it; implied by --fast.")]
_Fast = Annotated[
    bool, typer.Option("--fast", help="As fast as possible, in virtual time; other programs can't connect.")
]
_With = Annotated[
    list[str] | None,
    typer.Option(
        "--with",
        metavar="MODULE",
        autocompletion=_complete_extra,
        help="Start this extra module, too (repeatable): IMU1, IO1 or PROX3 of triskar2.",
    ),
]
_Param = Annotated[
    list[str] | None,
    typer.Option(metavar="[MODULE/]NODE.NAME=VALUE", help="Start with this value of a parameter (repeatable)."),
]
_Bus = Annotated[
    str | None, typer.Option("--bus", metavar="NAME", help="Let other programs join the robot's bus by this name.")
]
_BusReport = Annotated[bool, typer.Option("--bus-report", help="At the end, report what each node sent on the bus.")]


def command(
    robot: Annotated[_Name, typer.Argument(metavar="ROBOT", help=_ROBOTS)] = "triskar2",
    fast: _Fast = False,
    speed: _Speed = None,
    duration: Annotated[
        float | None, time_option("--duration", "How long; default: until Ctrl-C; --fast: 60 s.")
    ] = None,
    seed: Annotated[int, typer.Option(metavar="N", help="Seed of all random numbers.")] = 0,
    drive: _Drive = False,
    extras: _With = None,
    bus: _Bus = None,
    bus_report: _BusReport = False,
    allow_control: Annotated[
        bool, typer.Option("--allow-control", help="Let the gateway accept REBOOT, BOOTLOAD and changes from IP links.")
    ] = False,
    params_file: ParamsFile = None,
    params: Params = None,
    param: _Param = None,
    via: Via = None,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Run an emulated robot: modules, motors, a body that moves, and a gateway for other programs.

    The gateway opens the links of --via; by default the debug line on TCP, and zenoh, for this computer only.
    """

    async def main() -> None:
        if fast:
            _check_fast(speed, {"--via": via, "--bus": bus})
        check_urls(via or [])
        chosen = settings()
        display = display_of(robot)
        modules = started_modules(display.robot_class, extras or ())
        sources = parameter_sources(chosen, modules, params or (), param or ())
        parameters = ParameterOptions(params=sources, params_file=params_file or chosen.params_file)
        await simulate(
            display,
            duration=duration or (_FAST if fast else None),
            seed=seed,
            modules=modules,
            outside=() if fast else tuple(via or default_links()),
            rounds=math.inf if drive or fast else 0,
            fast=fast,
            bus=checked(bus) if bus else None,
            bus_report=bus_report,
            allow_control=allow_control,
            parameters=parameters,
        )

    virtually = functools.partial(run_virtually, seed=seed, speed=None if fast else speed)
    # Only errors are logged: any other line would tear the display apart.
    endless = duration is None and not fast
    execute(
        main,
        verbose=verbose,
        quiet=quiet + 2,
        endless=endless,
        run=virtually if fast or speed is not None else None,
    )


def started_modules(robot: type[EmulatedRobot], extras: Iterable[str]) -> list[str]:
    """Return the modules that start: all but the extras that are not named. Raises UsageError."""
    chosen = set(extras)
    for name in chosen:
        if name not in robot.names:
            hint = did_you_mean(name, robot.extras, "extra modules") if robot.extras else "it has no extra modules"
            raise UsageError(f"--with {name}: {robot.title} has no module {name}; {hint}")
    return [name for name in robot.names if name not in robot.extras or name in chosen]


def _check_fast(speed: float | None, open_to_others: dict[str, object]) -> None:
    """Raise UsageError for options that make no sense in virtual time."""
    if speed is not None:
        raise UsageError("--fast is as fast as possible: leave out either --fast or --speed")
    for option, value in open_to_others.items():
        if value:
            raise UsageError(
                f"--fast runs in virtual time, so other programs can't connect: leave out {option} or --fast"
            )


def display_of(robot: _Name) -> "type[RobotDisplay[Any]]":
    """Import the display of a robot."""
    display: type[RobotDisplay[Any]] = getattr(importlib.import_module(f"r2p.tools.sim.{robot}"), _DISPLAYS[robot])
    return display
