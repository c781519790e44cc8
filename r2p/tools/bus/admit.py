"""`r2p bus admit`: check offline, with the master's calendar, whether periodic messages get slots of their own."""

import re
from pathlib import Path
from typing import Annotated, Any

import msgspec
import typer

import r2p
from r2p.bus import Calendar, Refusal, Reservation, Timing, occupied, timing
from r2p.codecs import rtcan
from r2p.tools.bus import picture
from r2p.tools.bus.picture import Cell
from r2p.tools.options import Format, hertz, seconds
from r2p.tools.output import Output, Record
from r2p.tools.session import execute
from r2p.units import SECOND

_MESSAGE = re.compile(r"(?P<name>[^:@]+):(?P<size>\d+)@(?P<rate>.+)")
_CYCLE = 0.010  # s, as in the thesis
_SHORTEST, _LONGEST = 1e-9, 1e9  # s; representable in ns, and above it surely a typing error

Messages = Annotated[
    list[str],
    typer.Argument(metavar="NAME:BYTES@RATE...", show_default=False, help="imu:18@200Hz or imu:18@5ms, in this order."),
]
Slots = Annotated[int, typer.Option("--slots", min=2, max=rtcan.SLOTS_MAX, metavar="N", help="Slots per cycle.")]
CycleTime = Annotated[
    float | None,
    typer.Option("--cycle", parser=seconds, metavar="TIME", help="Nominal length of the cycle; default: 10ms."),
]
BitRate = Annotated[int, typer.Option("--bitrate", min=10_000, metavar="BIT/S", help="Bit rate of the bus.")]
Svg = Annotated[Path | None, typer.Option("--svg", metavar="FILE", help="Also draw the cycle into this file.")]


class Wanted(msgspec.Struct, frozen=True):
    """A planned periodic message: size in bytes, period in ns."""

    name: str
    size: int
    interval: int


def admit(
    messages: Messages,
    *,
    slots: Slots = 60,
    cycle: CycleTime = None,
    bitrate: BitRate = 1_000_000,
    svg: Svg = None,
    format: Format = None,
) -> None:
    """Check whether periodic messages fit on a bus, in which slots, and what is left. Opens and sends nothing.

    Messages are admitted in this order, as the master does it; a period is rounded down to one compatible with the
    others. The exit code is 1 if one is refused.
    """
    wanted = [parse(each) for each in messages]
    timing = grid(slots, cycle, bitrate)
    execute(lambda: _print(wanted, timing, svg, Output(format)))


def grid(slots: int, cycle: float | None, bitrate: int) -> Timing:
    """Return the slots of a cycle (s). Raises BadParameter if a frame does not fit into a slot."""
    if cycle is not None and cycle > _LONGEST:
        raise typer.BadParameter(f"a cycle of {cycle:g} s is too long")
    try:
        return timing(slots, round((cycle or _CYCLE) * SECOND), bitrate)
    except ValueError as error:
        raise typer.BadParameter(f"{error}: fewer --slots, a longer --cycle, or a higher --bitrate") from error


def parse(text: str) -> Wanted:
    """Parse `NAME:BYTES@RATE`; the rate is `200Hz`, or a period such as `5ms`."""
    match = _MESSAGE.fullmatch(text)
    if match is None:
        raise typer.BadParameter(f"{text!r}: write NAME:BYTES@RATE, as in imu:18@200Hz or imu:18@5ms")
    size = int(match["size"])
    if not 1 <= size <= rtcan.PAYLOAD_MAX:
        raise typer.BadParameter(f"{text!r}: an RTCAN message has 1 to {rtcan.PAYLOAD_MAX} bytes")
    period = _period(match["rate"])
    if not _SHORTEST <= period <= _LONGEST:
        raise typer.BadParameter(f"{text!r}: a period of {period:g} s is out of range")
    return Wanted(match["name"], size, round(period * SECOND))


def _period(text: str) -> float:
    """Return the period in seconds of a rate or a period; a number without a unit is ambiguous."""
    lower = text.lower()
    if lower.endswith("khz"):
        return 1e-3 / hertz(lower.removesuffix("khz"))
    if lower.endswith("hz"):
        return 1 / hertz(lower.removesuffix("hz"))
    if not lower.endswith("s"):
        raise typer.BadParameter(f"{text!r}: write a rate as in 200Hz, or a period as in 5ms")
    return seconds(text)


async def _print(wanted: list[Wanted], grid: Timing, drawing: Path | None, output: Output) -> None:
    calendar = Calendar(grid.slots)
    results = admit_all(calendar, wanted, grid)
    rows = [_row(each, result, grid) for each, result in zip(wanted, results, strict=True)]
    await output.table(rows, ["name", "bytes", "slots", "wanted_hz", "hz", "period", "phase", "in_cycle", "refused"])
    cells = cells_of(calendar, wanted, grid)
    refused = sum(isinstance(result, Refusal) for result in results)
    await output.remark("\n".join(["", picture.text(cells), "", *picture.legend(cells, {}), summary(calendar, grid)]))
    if drawing is not None:
        picture.save(drawing, cells, f"{grid.slots} slots of {grid.slot / 1000:g} us", {})
    if refused:
        raise r2p.Error(f"{refused} of {len(wanted)} messages do not fit{_hint(wanted, grid)}")


def admit_all(calendar: Calendar, wanted: list[Wanted], grid: Timing) -> list[Reservation | Refusal]:
    """Admit the messages in order; message ids are their indices."""
    return [
        calendar.admit(i, each.interval // grid.slot, rtcan.fragment_count(each.size), round_down=True)
        for i, each in enumerate(wanted)
    ]


def _hint(wanted: list[Wanted], grid: Timing) -> str:
    """Suggest another order if all messages fit with the shortest periods first."""
    ordered = sorted(wanted, key=lambda each: each.interval)
    results = admit_all(Calendar(grid.slots), ordered, grid)
    if any(isinstance(result, Refusal) for result in results):
        return ""
    return "; all of them fit in this order: " + " ".join(each.name for each in ordered)


def _row(wanted: Wanted, result: Reservation | Refusal, grid: Timing) -> Record:
    row: dict[str, Any] = {
        "name": wanted.name,
        "bytes": wanted.size,
        "slots": rtcan.fragment_count(wanted.size),
        "wanted_hz": round(SECOND / wanted.interval, 3),
        "hz": None,
        "period": None,
        "phase": None,
        "in_cycle": None,
        "refused": None,
    }
    if isinstance(result, Refusal):
        return row | {"refused": result.text}
    return row | {
        "hz": round(SECOND / (result.period * grid.slot), 3),
        "period": result.period,
        "phase": result.phase,
        "in_cycle": result.fragments * max(1, grid.slots // result.period),
    }


def cells_of(calendar: Calendar, wanted: list[Wanted], grid: Timing) -> list[Cell]:
    """Return the slots of a cycle; a slot that is used only in some cycles has a note."""
    cells = [Cell("sync")] + [Cell()] * (grid.slots - 1)
    for each in calendar:
        start = each.phase - each.phase % grid.slots
        mask = occupied(each, start, grid.slots)
        every = max(1, each.period // grid.slots)
        note = wanted[each.message].name + (f", every {every} cycles" if every > 1 else "")
        for slot in range(grid.slots):
            if mask >> slot & 1:
                cells[slot] = Cell(wanted[each.message].name, note=note)
    return cells


def summary(calendar: Calendar, grid: Timing) -> str:
    """Return a line about what is reserved and what is left, on average over all cycles."""
    reserved = 1 + sum(each.fragments * grid.slots / each.period for each in calendar)
    left = grid.slots - reserved
    frames = left / grid.cycle * SECOND
    return (
        f"{reserved:g} of {grid.slots} slots reserved (including the sync), {left:g} left for other traffic: "
        f"{frames:.0f} frames/s, {frames * 64 / 1000:.1f} kbit/s of data"
    )
