"""`r2p imu`: calibrate the inertial sensors of a robot on a cube."""

import asyncio
import contextlib
import csv
import sys
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

import r2p
from r2p.msg import IMURaw9
from r2p.tools.calibration import SIDES, CubePosition, ImuCalibration, ImuReading, positions_in, still
from r2p.tools.calibration import calibrate as fit
from r2p.tools.completion import complete_topic
from r2p.tools.options import time_option
from r2p.tools.output import notify
from r2p.tools.session import Session, TimedOut, UsageError, command, group

_MG, _MDPS = 1.0, 8.75  # of a count, in the ranges that firmware starts with
_AVERAGED = 2.0  # seconds, of each position
_SILENT = 3.0  # seconds without a sample
_BAR = 20  # characters of the longest residual
_NODE = "sensors"
_AXES = ("x", "y", "z")

Ask = Callable[[str], Awaitable[None]]
"""Asks for a position, and returns when it is there."""

app = group("Calibrate inertial sensors.")


def _check(_settings: object, given: Mapping[str, Any]) -> None:
    """Raise UsageError before any link is opened."""
    if given["source"] is None and not sys.stdin.isatty():
        raise UsageError("it asks for each position: run it at a terminal, or give --from FILE")


def _joins(given: Mapping[str, Any]) -> bool:
    return given["source"] is None or given["write"] is not None


async def calibrate(
    session: Session,
    topic: Annotated[str, typer.Argument(metavar="TOPIC", autocompletion=complete_topic)] = "imu_raw",
    *,
    source: Annotated[
        Path | None, typer.Option("--from", metavar="FILE", help="A recording: CSV, as r2p topic echo prints it.")
    ] = None,
    seconds: Annotated[float | None, time_option("--for", "How long to average each position; default: 2 s.")] = None,
    write: Annotated[
        str | None, typer.Option(metavar="MODULE", help="Set the parameters of this module's node sensors.")
    ] = None,
) -> None:
    """Calibrate accelerometer and gyroscope on a cube.

    There are six positions: each side of the sensors is up once. At a terminal it asks for each of them. What moved is
    refused, and so is a position that is missing, or there twice. It counts in the ranges 2g and 250dps.
    """
    try:
        if source is not None:
            positions = positions_in(_read(source))
        else:
            positions = await guided(session.node, topic, seconds or _AVERAGED, _at_terminal)
        result = fit(positions)
    except ValueError as error:
        raise r2p.Error(str(error)) from error
    for line in report(result):
        typer.echo(line)
    if write is not None:
        await session.module.network.set_parameters(write, parameters(result))
        notify(f"{write}: 3 parameters of {_NODE} set; r2p param save {write} keeps them")


async def guided(node: r2p.Node, topic: str, seconds: float, ask: Ask) -> list[CubePosition]:
    """Ask for each position, and measure it. Raises TimedOut without samples."""
    positions = []
    for side in SIDES:
        while True:
            await ask(f"put it with {side} up")
            try:
                position = still(await _readings(node, topic, seconds))
                if position.side == side:
                    break
                notify(f"{position.side} is up, not {side}")
            except ValueError as error:
                notify(str(error))
        positions.append(position)
        notify(f"{side} is up: {position.count} samples")
    return positions


async def _readings(node: r2p.Node, topic: str, seconds: float) -> list[ImuReading]:
    """Return what arrives on a topic within so many seconds from the first sample on. Raises TimedOut without any."""
    with contextlib.closing(node.subscribe(topic, IMURaw9)) as samples:
        readings: list[ImuReading] = []
        end: int | None = None
        while end is None or node.now() < end:
            sample = await samples.fetch(_SILENT)
            if sample is None:
                raise TimedOut(f"nothing on {topic} for {_SILENT:g} s: is the IMU module on?")
            end = end or node.now() + round(seconds * 1e9)
            readings.append(_reading(*(getattr(sample, f"{of}_{axis}") for of in ("acc", "gyro") for axis in _AXES)))
        return readings


async def _at_terminal(text: str) -> None:
    """Wait for the Enter key."""
    notify(f"{text}, and press Enter")
    ready = asyncio.Event()
    loop, stdin = asyncio.get_running_loop(), sys.stdin.fileno()
    loop.add_reader(stdin, ready.set)
    try:
        await ready.wait()
        sys.stdin.readline()
    finally:
        loop.remove_reader(stdin)


def _read(path: Path) -> list[ImuReading]:
    """Return the readings in a file. Raises UsageError if it has none."""
    names = [f"{of}_{axis}" for of in ("acc", "gyro") for axis in _AXES]
    try:
        with path.open(newline="", encoding="utf-8") as file:
            return [_reading(*(int(row[name]) for name in names)) for row in csv.DictReader(file)]
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}") from error
    except (KeyError, TypeError, ValueError) as error:
        raise UsageError(
            f"{path} has no columns {names[0]} to {names[-1]} with counts: make it with "
            "r2p topic echo imu_raw --format csv"
        ) from error


def _reading(*counts: int) -> ImuReading:
    one, two, three, four, five, six = counts
    return ImuReading((one * _MG, two * _MG, three * _MG), (four * _MDPS, five * _MDPS, six * _MDPS))


def parameters(result: ImuCalibration) -> dict[tuple[str, str], object]:
    """Return the parameters of an IMU module, by node and name, rounded to what the data say."""
    return {
        (_NODE, "acc_offset"): tuple(round(each, 3) for each in result.acc_offset),
        (_NODE, "acc_scale"): tuple(round(each, 6) for each in result.acc_scale),
        (_NODE, "gyro_offset"): tuple(round(each, 1) for each in result.gyro_offset),
    }


def report(result: ImuCalibration) -> list[str]:
    """Return what was found, how sure it is, and a plot of what is left."""
    lines = [
        "acc_offset   " + _row(result.acc_offset, 8, 2) + f"  mg    +-{result.offset_error:.2f}",
        *(f"{'' if row else 'acc_scale':13}" + _row(result.acc_scale[row : row + 3], 8, 4) for row in (0, 3, 6)),
        "gyro_offset  " + _row(result.gyro_offset, 8, 1) + "  mdps",
        "",
        f"left in each position, mg: rms {result.sigma:.2f}, of 18 equations with 12 unknowns",
    ]
    most = max(abs(each) for residual in result.residuals.values() for each in residual) or 1.0
    for side, residual in result.residuals.items():
        for axis, value in zip(_AXES, residual, strict=True):
            bar = "#" * round(abs(value) / most * _BAR)
            left, right = (bar, "") if value < 0 else ("", bar)
            lines.append(f"{side:>2} up  {axis} {value:z7.2f}  {left:>{_BAR}}|{right}".rstrip())
    return lines


def _row(values: tuple[float, ...], width: int, digits: int) -> str:
    return " ".join(f"{each:z{width}.{digits}f}" for each in values)


command(app, "calibrate", check=_check, joins=_joins)(calibrate)
