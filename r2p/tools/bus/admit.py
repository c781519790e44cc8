"""`r2p bus admit`: would these periodic messages get slots of their own? The master's calendar answers, offline."""

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
from r2p.tools.output import Output, Record
from r2p.tools.session import Format, execute, seconds
from r2p.tools.topic.watching import hertz

_MESSAGE = re.compile(r"(?P<name>[^:@]+):(?P<size>\d+)@(?P<rate>.+)")
_SECOND = 1_000_000_000
_CYCLE = 0.010  # s, as in the thesis
_SHORTEST, _LONGEST = 1e-9, 1e9  # s; what is counted in ns, and is no slip of the finger

Messages = Annotated[
    list[str],
    typer.Argument(metavar="NAME:BYTES@RATE...", show_default=False, help="imu:18@200Hz, or imu:18@5ms; in order."),
]
Slots = Annotated[int, typer.Option("--slots", min=2, max=rtcan.SLOTS_MAX, metavar="N", help="Slots in a cycle.")]
CycleTime = Annotated[
    float | None,
    typer.Option("--cycle", parser=seconds, metavar="TIME", help="Nominal length of a cycle; default: 10ms."),
]
BitRate = Annotated[int, typer.Option("--bitrate", min=10_000, metavar="BIT/S")]
Svg = Annotated[Path | None, typer.Option("--svg", metavar="FILE", help="Draw the cycle into a file.")]


class Wanted(msgspec.Struct, frozen=True):
    """A periodic message that somebody plans: bytes, period in ns."""

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
    """Tell whether periodic messages fit on a bus, in which slots, and what is left. Nothing is opened or sent.

    Messages are admitted in the order given, as the master would; a period is rounded down to one that goes with the
    others. Exits 1 when one is refused.
    """

    wanted = [parse(each) for each in messages]
    timing = grid(slots, cycle, bitrate)
    execute(lambda: _tell(wanted, timing, svg, Output(format)))


def grid(slots: int, cycle: float | None, bitrate: int) -> Timing:
    """The slots of a cycle (s). Raises BadParameter when no frame fits in."""
    if cycle is not None and cycle > _LONGEST:
        raise typer.BadParameter(f"a cycle of {cycle:g} s")
    try:
        return timing(slots, round((cycle or _CYCLE) * _SECOND), bitrate)
    except ValueError as error:
        raise typer.BadParameter(f"{error}: fewer --slots, a longer --cycle, or a higher --bitrate") from error


def parse(text: str) -> Wanted:
    """`NAME:BYTES@RATE`; the rate is `200Hz` or a period: `5ms`."""
    match = _MESSAGE.fullmatch(text)
    if match is None:
        raise typer.BadParameter(f"{text!r}: write NAME:BYTES@RATE, as in imu:18@200Hz or imu:18@5ms")
    size = int(match["size"])
    if not 1 <= size <= rtcan.PAYLOAD_MAX:
        raise typer.BadParameter(f"{text!r}: RTCAN carries 1 to {rtcan.PAYLOAD_MAX} bytes in a message")
    period = _period(match["rate"])
    if not _SHORTEST <= period <= _LONGEST:
        raise typer.BadParameter(f"{text!r}: a period of {period:g} s")
    return Wanted(match["name"], size, round(period * _SECOND))


def _period(text: str) -> float:
    """Seconds, of a rate or a period. A number alone could be either."""
    lower = text.lower()
    if lower.endswith("khz"):
        return 1e-3 / hertz(lower.removesuffix("khz"))
    if lower.endswith("hz"):
        return 1 / hertz(lower.removesuffix("hz"))
    if not lower.endswith("s"):
        raise typer.BadParameter(f"{text!r}: write a rate as in 200Hz, or a period as in 5ms")
    return seconds(text)


async def _tell(wanted: list[Wanted], grid: Timing, drawing: Path | None, output: Output) -> None:
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
        raise r2p.Error(f"{refused} of {len(wanted)} messages get no slots{_hint(wanted, grid)}")


def admit_all(calendar: Calendar, wanted: list[Wanted], grid: Timing) -> list[Reservation | Refusal]:
    """Admit them in order; message ids are their places."""
    return [
        calendar.admit(i, each.interval // grid.slot, rtcan.fragment_count(each.size), round_down=True)
        for i, each in enumerate(wanted)
    ]


def _hint(wanted: list[Wanted], grid: Timing) -> str:
    """Another order may do: the shortest periods first."""
    ordered = sorted(wanted, key=lambda each: each.interval)
    results = admit_all(Calendar(grid.slots), ordered, grid)
    if any(isinstance(result, Refusal) for result in results):
        return ""
    return "; all of them do in this order: " + " ".join(each.name for each in ordered)


def _row(wanted: Wanted, result: Reservation | Refusal, grid: Timing) -> Record:
    row: dict[str, Any] = {
        "name": wanted.name,
        "bytes": wanted.size,
        "slots": rtcan.fragment_count(wanted.size),
        "wanted_hz": round(_SECOND / wanted.interval, 3),
        "hz": None,
        "period": None,
        "phase": None,
        "in_cycle": None,
        "refused": None,
    }
    if isinstance(result, Refusal):
        return row | {"refused": result.text}
    return row | {
        "hz": round(_SECOND / (result.period * grid.slot), 3),
        "period": result.period,
        "phase": result.phase,
        "in_cycle": result.fragments * max(1, grid.slots // result.period),
    }


def cells_of(calendar: Calendar, wanted: list[Wanted], grid: Timing) -> list[Cell]:
    """The slots of a cycle; one that is used in some cycles only says so."""
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
    """What is reserved and what is left, on average over all cycles."""
    taken = 1 + sum(each.fragments * grid.slots / each.period for each in calendar)
    left = grid.slots - taken
    frames = left / grid.cycle * _SECOND
    return (
        f"{taken:g} of {grid.slots} slots reserved (the sync's included), {left:g} left for events and the rest: "
        f"{frames:.0f} frames/s, {frames * 64 / 1000:.1f} kbit/s of data"
    )
