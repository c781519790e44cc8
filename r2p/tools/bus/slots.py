"""`r2p bus schedule` and `admit`: the slots of a cycle, as a bus uses them, and as its master would give them.

`admit` works offline, with the master's calendar. Both draw the cycle, as text and as SVG: each owner gets a letter,
followed by `!` if it missed the slot in some cycles; `+` is a free slot that events use.
"""

import math
import re
import string
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any
from xml.sax.saxutils import escape

import msgspec
import typer

import r2p
from r2p.bus import (
    BusMonitor,
    BusSlot,
    Calendar,
    PeriodRule,
    Refusal,
    Reservation,
    Timing,
    asked_exactly,
    owners_kept,
    timing,
)
from r2p.codecs import rtcan
from r2p.tools.options import Format, hertz, seconds, time_option
from r2p.tools.output import Output, Record
from r2p.tools.session import TimedOut, execute
from r2p.units import SECOND

_UNUSED = "reserved but not used: no subscriber, or the owner is gone"
_SYNC_TIMEOUT = 3.0  # s

_MESSAGE = re.compile(r"(?P<name>[^:@]+):(?P<size>\d+)@(?P<rate>.+)")
_RATE = re.compile(r"([-+.0-9e]*)(k?)hz")
_CYCLE = 0.010  # s, as in the thesis
_SHORTEST, _LONGEST = 1e-9, 1e9  # s; representable in ns, and above it surely a typing error

_ROW = 20  # slots in a line of text
_SIDE = 26  # pixels of a slot in the SVG
SLOT_LETTERS = string.ascii_uppercase.replace("S", "") + string.ascii_lowercase + string.digits
"""The letters of the owners of slots, in order; S is the sync's."""
_COLOURS = ("#4e79a7", "#f28e2b", "#59a14f", "#b07aa1", "#76b7b2", "#edc948", "#9c755f", "#ff9da7")
_SYNC, _FREE, _EVENTS, _MISSED = "#555555", "#76808e26", "#4e79a766", "#d62728"  # free ones let a dark page through
_STYLE = "<style>.label { fill: #333 } @media (prefers-color-scheme: dark) { .label { fill: #ddd } }</style>"
_KEY = "     S  sync    .  free    +  free, used by events    !  missed in some cycles"

Svg = Annotated[Path | None, typer.Option("--svg", metavar="FILE", help="Also draw the cycle into this file.")]


class Cell(msgspec.Struct, frozen=True):
    """One slot. `owner` is "" for a free one, "sync" for the master's; `missed` and `shared` count cycles."""

    owner: str = ""
    missed: int = 0
    shared: int = 0
    note: str = ""


# The slots of a bus


async def schedule(
    bus: BusMonitor,
    *,
    cycles: Annotated[int, typer.Option("--cycles", "-n", min=1, metavar="N", help="Watch N cycles.")] = 100,
    svg: Svg = None,
    format: Format = None,
) -> None:
    """Draw the slots of a CAN bus.

    It shows their owners, the free ones, and those that were reserved but not used. It sends nothing.
    """
    output = Output(format)
    if not await bus.cycles(cycles, timeout=_SYNC_TIMEOUT):
        raise TimedOut(
            f"no sync frames for {_SYNC_TIMEOUT:g} s: no RTCAN master on this bus, so it has no slots "
            "(the firmware of 2014 has none)"
        )
    await show(bus.slots, bus.timing, bus.slot_cycles, output, svg)


async def show(slots: list[BusSlot], timing: Timing, cycles: int, output: Output, svg: Path | None) -> None:
    """Print the use of the slots over so many cycles, and draw it into a file if there is one."""
    cells = cells_of(slots)
    title = f"{_describe(timing)}, over {cycles} cycles"
    if output.format == "text":
        await output.remark("\n".join([title, "", *drawing(cells)]))
    else:
        await output.table(rows(slots), ["slot", "owner", "reserved", "used", "missed", "shared"])
    if svg is not None:
        save(svg, cells, title)


def _describe(grid: Timing) -> str:
    return f"{grid.slots} slots of {grid.slot / 1000:g} us"


def cells_of(slots: list[BusSlot]) -> list[Cell]:
    """Return the slots of a bus for a drawing."""
    return [
        Cell(
            _owner(slot) or (_UNUSED if slot.reserved else ""),
            slot.missed,
            slot.shared,
            f"{', '.join(slot.owners) or 'free'}: {slot.used} of {slot.reserved} used, {slot.shared} events",
        )
        for slot in slots
    ]


def rows(slots: list[BusSlot]) -> list[dict[str, object]]:
    """Return the slots of a bus as records; the numbers count cycles."""
    return [
        {
            "slot": index,
            "owner": _owner(slot) or None,
            "reserved": slot.reserved,
            "used": slot.used,
            "missed": slot.missed,
            "shared": slot.shared,
        }
        for index, slot in enumerate(slots)
    ]


def _owner(slot: BusSlot) -> str:
    """Return the owner that used a slot most: with periods longer than a cycle, several can share one."""
    return max(slot.owners, key=lambda owner: slot.owners[owner], default="")


# The slots that a plan gets


class Wanted(msgspec.Struct, frozen=True):
    """A planned periodic message: size in bytes, period in ns."""

    name: str
    size: int
    interval: int


def admit(
    messages: Annotated[
        list[str],
        typer.Argument(
            metavar="NAME:BYTES@RATE", show_default=False, help="imu:18@200Hz or imu:18@5ms, in this order."
        ),
    ],
    *,
    slots: Annotated[
        int, typer.Option("--slots", min=2, max=rtcan.SLOTS_MAX, metavar="N", help="Slots per cycle.")
    ] = 60,
    cycle: Annotated[float | None, time_option("--cycle", "Nominal length of the cycle; default: 10ms.")] = None,
    bitrate: Annotated[
        int, typer.Option("--bitrate", min=10_000, metavar="BIT/S", help="Bit rate of the bus.")
    ] = 1_000_000,
    periods: Annotated[
        PeriodRule, typer.Option("--periods", help="harmonic: as the calendar of firmware does it.")
    ] = PeriodRule.COMMON_FACTORS,
    svg: Svg = None,
    format: Format = None,
) -> None:
    """Check whether periodic messages fit on a bus.

    It shows in which slots, and what is left. It opens no bus.

    Messages are admitted in this order, as the master does it. A period that is a whole number of slots is kept if
    possible; else it is rounded down to one that divides the cycle, or is a multiple of it. The exit code is 1 if one
    is refused.
    """
    plan = [parse(each) for each in messages]
    timing = grid(slots, cycle, bitrate)
    calendar = Calendar(timing.slots, periods)
    execute(lambda: _print(plan, calendar, timing, svg, Output(format)))


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
    if rate := _RATE.fullmatch(lower):
        return 1 / hertz(rate[1]) / (1000 if rate[2] else 1)
    if not lower.endswith("s"):
        raise typer.BadParameter(f"{text!r}: write a rate as in 200Hz, or a period as in 5ms")
    return seconds(text)


async def _print(plan: list[Wanted], calendar: Calendar, grid: Timing, svg: Path | None, output: Output) -> None:
    results = admit_all(calendar, plan, grid)
    rows = [_row(each, result, grid) for each, result in zip(plan, results, strict=True)]
    await output.table(rows, ["name", "bytes", "slots", "wanted_hz", "hz", "period", "phase", "in_cycle", "refused"])
    cells = planned_cells(calendar, plan, grid)
    await output.remark("\n".join(["", *drawing(cells), summary(calendar, grid)]))
    if svg is not None:
        save(svg, cells, _describe(grid))
    if refused := sum(isinstance(result, Refusal) for result in results):
        raise r2p.Error(f"{refused} of {len(plan)} messages do not fit{_hint(plan, calendar.rule, grid)}")


def admit_all(calendar: Calendar, plan: list[Wanted], grid: Timing) -> list[Reservation | Refusal]:
    """Admit the messages in order, as their owners ask for slots; message ids are their indices."""
    results = []
    for i, each in enumerate(plan):
        period, fragments = each.interval // grid.slot, rtcan.fragment_count(each.size)
        exactly = asked_exactly(each.interval, grid.slot, grid.slots)
        result = calendar.admit(i, period, fragments, round_down=not exactly)
        if isinstance(result, Refusal) and exactly:
            result = calendar.admit(i, period, fragments, round_down=True)
        results.append(result)
    return results


def _hint(plan: list[Wanted], rule: PeriodRule, grid: Timing) -> str:
    """Suggest another order if all messages fit with the shortest periods first."""
    ordered = sorted(plan, key=lambda each: each.interval)
    if any(isinstance(result, Refusal) for result in admit_all(Calendar(grid.slots, rule), ordered, grid)):
        return ""
    return "; all of them fit in this order: " + " ".join(each.name for each in ordered)


def _row(wanted: Wanted, result: Reservation | Refusal, grid: Timing) -> Record:
    row: dict[str, Any] = {
        "name": wanted.name,
        "bytes": wanted.size,
        "slots": rtcan.fragment_count(wanted.size),
        "wanted_hz": round(SECOND / wanted.interval, 3),
    }
    if isinstance(result, Refusal):
        return row | {"hz": None, "period": None, "phase": None, "in_cycle": None, "refused": result.text}
    return row | {
        "hz": round(SECOND / (result.period * grid.slot), 3),
        "period": result.period,
        "phase": result.phase,
        "in_cycle": result.fragments * -(-grid.slots // result.period),  # at most
        "refused": None,
    }


def planned_cells(calendar: Calendar, plan: list[Wanted], grid: Timing) -> list[Cell]:
    """Return the slots of a calendar for a drawing. The note of a slot says who has it in how many of the cycles."""
    shares: list[list[tuple[int, str]]] = [[] for _ in range(grid.slots)]
    for each in calendar:
        factor = math.gcd(each.period, grid.slots)
        every = each.period // factor
        for slot in range(grid.slots):
            if (slot - each.phase) % factor < each.fragments:
                shares[slot].append((every, plan[each.message].name))
    return [Cell("sync"), *map(_planned_cell, shares[1:])]


def _planned_cell(shares: list[tuple[int, str]]) -> Cell:
    """Return a slot that its owners have each so many cycles; it is drawn as that of the most frequent one."""
    if not shares:
        return Cell()
    notes = (name + (f", every {every} cycles" if every > 1 else "") for every, name in shares)
    return Cell(min(shares)[1], note="; ".join(notes))


def summary(calendar: Calendar, grid: Timing) -> str:
    """Return a line about what is reserved and what is left, on average over all cycles."""
    reserved = 1 + sum(each.fragments * grid.slots / each.period for each in calendar)
    left = grid.slots - reserved
    frames = left / grid.cycle * SECOND
    text = (
        f"{reserved:g} of {grid.slots} slots reserved (including the sync), {left:g} left for other traffic:\n"
        f"{frames:.0f} frames/s, {frames * 64 / 1000:.1f} kbit/s of data"
    )
    if (owners := owners_kept(frames)) < len(list(calendar)):
        text += f"; they keep the slots of {owners} modules, and the master refuses those of more"
    return text


# The drawing


def drawing(cells: list[Cell]) -> list[str]:
    """Return lines of 20 slots, each with the number of its first slot, and lines that explain the letters."""
    names = _letters(cells)
    lines = []
    for start in range(0, len(cells), _ROW):
        row = (_glyph(cell, names) for cell in cells[start : start + _ROW])
        lines.append(f"{start:3}  {' '.join(row)}".rstrip())
    return [*lines, "", *(f"     {letter}  {owner}" for owner, letter in names.items()), _KEY]


def _letters(cells: Iterable[Cell]) -> dict[str, str]:
    """Return the letter of each owner, in order of appearance; all beyond the last letter share that."""
    owners = dict.fromkeys(cell.owner for cell in cells if cell.owner not in {"", "sync"})
    return {owner: SLOT_LETTERS[min(i, len(SLOT_LETTERS) - 1)] for i, owner in enumerate(owners)}


def _glyph(cell: Cell, names: dict[str, str]) -> str:
    if cell.owner == "sync":
        return "S "
    if cell.owner:
        return names[cell.owner] + ("!" if cell.missed else " ")
    return "+ " if cell.shared else ". "


def save(file: Path, cells: list[Cell], title: str) -> None:
    """Write the drawing into a file. Raises Error if that fails."""
    try:
        file.write_text(svg_of(cells, title), encoding="utf-8")
    except OSError as error:
        raise r2p.Error(f"can't write {file}: {error.strerror}") from error


def svg_of(cells: list[Cell], title: str) -> str:
    """Return the drawing as an SVG document."""
    names = _letters(cells)
    top, width = 40, _ROW * _SIDE + 40
    below = top + -(-len(cells) // _ROW) * (_SIDE + 6) + 24
    height = below + 20 * (len(names) + 1)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" font-family="sans-serif">',
        _STYLE,
        f'<text class="label" x="20" y="24">{escape(title)}</text>',
    ]
    for i, cell in enumerate(cells):
        parts.append(_box(i, cell, 20 + i % _ROW * _SIDE, top + i // _ROW * (_SIDE + 6), names))
    for i, (owner, letter) in enumerate(names.items()):
        y = below + 20 * i
        parts.append(f'<rect x="20" y="{y - 11}" width="14" height="14" fill="{_colour(letter)}"/>')
        parts.append(f'<text class="label" x="42" y="{y}" font-size="12">{letter}  {escape(owner)}</text>')
    return "\n".join([*parts, "</svg>\n"])


def _box(index: int, cell: Cell, x: int, y: int, names: dict[str, str]) -> str:
    letter = "S" if cell.owner == "sync" else names.get(cell.owner, "")
    fill = _SYNC if cell.owner == "sync" else _colour(letter) if letter else _EVENTS if cell.shared else _FREE
    edge = f'stroke="{_MISSED}" stroke-width="3"' if cell.missed else 'stroke="#999999"'
    note = f"slot {index}: {cell.note or cell.owner or 'free'}"
    return (
        f'<g><title>{escape(note)}</title><rect x="{x}" y="{y}" width="{_SIDE - 3}" height="{_SIDE - 3}" '
        f'fill="{fill}" {edge}/><text x="{x + 7}" y="{y + 16}" font-size="12" fill="white">{letter}</text></g>'
    )


def _colour(letter: str) -> str:
    return _COLOURS[SLOT_LETTERS.index(letter) % len(_COLOURS)]
