"""`r2p imu`: calibrate the inertial sensors of a robot on a cube."""

import asyncio
import contextlib
import csv
import sys
from collections.abc import Awaitable, Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import typer

import r2p
from r2p.msg import IMURaw9
from r2p.sim.physics.inertial import AccelerometerRange, GyroscopeRange
from r2p.tools import imu_svg
from r2p.tools.calibration import SIDES, CubePosition, ImuCalibration, ImuReading, positions_in, still
from r2p.tools.calibration import calibrate as fit
from r2p.tools.completion import complete_topic
from r2p.tools.options import time_option
from r2p.tools.output import notify
from r2p.tools.param.targets import find
from r2p.tools.session import Session, TimedOut, UsageError, command, group

_AVERAGED = 2.0  # seconds, of each position
_SILENT = 3.0  # seconds without a sample
_BAR = 20  # characters of the longest residual
_NODE = "sensors"
_AXES = ("x", "y", "z")
_COLUMNS = [f"{of}_{axis}" for of in ("acc", "gyro") for axis in _AXES]
_RANGES = {"acc_range": AccelerometerRange, "gyro_range": GyroscopeRange}

Ask = Callable[[str], Awaitable[None]]
"""Asks for a position, and returns when it is there."""

app = group("Calibrate inertial sensors.")


class ImuRanges(NamedTuple):
    """The ranges of an IMU, which say what a count of it is; by default those that firmware starts with."""

    acc_range: str = "2g"
    gyro_range: str = "250dps"

    def reading(self, counts: Sequence[int]) -> ImuReading:
        """Return a sample in mg and mdps: the counts of the accelerometer, then those of the gyroscope."""
        mg, mdps = AccelerometerRange[self.acc_range].value[1], GyroscopeRange[self.gyro_range].value[1]
        one, two, three, four, five, six = counts
        return ImuReading((one * mg, two * mg, three * mg), (four * mdps, five * mdps, six * mdps))


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
    plot: Annotated[
        Path | None, typer.Option(metavar="FILE.svg", help="Draw the readings before and after, and what is left.")
    ] = None,
    acc_range: Annotated[
        Literal["2g", "4g", "8g", "16g"] | None,
        typer.Option(help="Range of the accelerometer; default: what the module says."),
    ] = None,
    gyro_range: Annotated[
        Literal["250dps", "500dps", "2000dps"] | None,
        typer.Option(help="Range of the gyroscope; default: what the module says."),
    ] = None,
) -> None:
    """Calibrate accelerometer and gyroscope on a cube.

    There are six positions: each side of the sensors is up once. At a terminal it asks for each of them. What moved is
    refused, and so is a position that is missing, or there twice.
    """
    counts = [] if source is None else _read(source)
    options = {"acc_range": acc_range, "gyro_range": gyro_range}
    known: dict[str, str] = {name: value for name, value in options.items() if value is not None}
    ranges = await _ranges(session, topic if source is None else None, write, known)
    try:
        if source is not None:
            positions = positions_in([ranges.reading(each) for each in counts])
        else:
            positions = await guided(session.node, topic, seconds or _AVERAGED, _at_terminal, ranges)
        result = fit(positions)
    except ValueError as error:
        raise r2p.Error(str(error)) from error
    for line in report(result):
        typer.echo(line)
    if plot is not None:
        _save(plot, imu_svg.draw(positions, result))
    if write is not None:
        await session.module.network.set_parameters(write, parameters(result))
        notify(f"{write}: 3 parameters of {_NODE} set; r2p param save {write} keeps them")


async def _ranges(session: Session, topic: str | None, write: str | None, known: dict[str, str]) -> ImuRanges:
    """Return the ranges: the `known` ones, else those of the module to write to, or of the one with the topic.

    Reports what is assumed. Raises TimedOut and r2p.Error if the module to write to has no such node: after six
    positions it would be late for that.
    """
    found: dict[str, str] = {}
    why = "no module to ask"
    if write is not None:
        found, why = await _ranges_of(session, write), f"{write} does not have it"
    elif topic is not None and len(known) < len(_RANGES):
        try:
            module = await _publisher(session, topic)
            found, why = await _ranges_of(session, module), f"{module} does not have it"
        except (r2p.Error, TimedOut) as error:
            why = str(error)
    ranges = ImuRanges(**found | known)
    for name, value in ranges._asdict().items():
        if name not in found | known:
            notify(f"{name} is unknown, {value} assumed ({why}): give --{name.replace('_', '-')}")
    return ranges


async def _publisher(session: Session, topic: str) -> str:
    """Return the module that publishes a topic. Raises r2p.Error if that is not exactly one."""
    await session.settle()
    view = session.module.network.topics().get(topic)
    modules = sorted({each.module for each in view.publishers}) if view is not None else []
    if len(modules) != 1:
        raise r2p.Error(f"{', '.join(modules) or 'no known module'} publishes {topic}")
    return modules[0]


async def _ranges_of(session: Session, module: str) -> dict[str, str]:
    """Return the ranges that a module has as parameters. Raises as `find`, and r2p.Error for one of another sensor."""
    ranges: dict[str, str] = {}
    for info in await find(session, f"{module}/{_NODE}"):
        if info.name in _RANGES:
            ranges[info.name] = str(info.value)
            if info.value not in _RANGES[info.name].__members__:
                usual = ", ".join(_RANGES[info.name].__members__)
                usual = ", ".join(_RANGES[info.name].__members__)
                raise r2p.Error(f"{info.full_name} is {info.value}, but only {usual} are known")
    return ranges


async def guided(node: r2p.Node, topic: str, seconds: float, ask: Ask, ranges: ImuRanges) -> list[CubePosition]:
    """Ask for each position, and measure it. Raises TimedOut without samples."""
    positions = []
    for side in SIDES:
        while True:
            await ask(f"put it with {side} up")
            counts = await _counts(node, topic, seconds)
            try:
                position = still([ranges.reading(each) for each in counts])
                if position.side == side:
                    break
                notify(f"{position.side} is up, not {side}")
            except ValueError as error:
                notify(str(error))
        positions.append(position)
        notify(f"{side} is up: {position.count} samples")
    return positions


async def _counts(node: r2p.Node, topic: str, seconds: float) -> list[list[int]]:
    """Return the counts that arrive in so many seconds from the first one on. Raises TimedOut without any."""
    with contextlib.closing(node.subscribe(topic, IMURaw9)) as samples:
        counts: list[list[int]] = []
        end: int | None = None
        while end is None or node.now() < end:
            sample = await samples.fetch(_SILENT)
            if sample is None:
                raise TimedOut(f"nothing on {topic} for {_SILENT:g} s: is the IMU module on?")
            end = end or node.now() + round(seconds * 1e9)
            counts.append([getattr(sample, name) for name in _COLUMNS])
        return counts


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


def _read(path: Path) -> list[list[int]]:
    """Return the counts in a file. Raises UsageError if it has none."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            return [[int(row[name]) for name in _COLUMNS] for row in csv.DictReader(file)]
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}") from error
    except (KeyError, TypeError, ValueError) as error:
        raise UsageError(
            f"{path} has no columns {_COLUMNS[0]} to {_COLUMNS[-1]} with counts: make it with "
            "r2p topic echo imu_raw --format csv"
        ) from error


def _save(path: Path, picture: str) -> None:
    try:
        path.write_text(picture, encoding="utf-8")
    except OSError as error:
        raise r2p.Error(f"{path}: {error.strerror}") from error


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
