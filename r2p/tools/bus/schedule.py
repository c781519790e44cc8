"""`r2p bus schedule`: the slots of the cycle, and which nodes use them."""

from typing import Annotated

import typer

from r2p.bus import BusMonitor, BusSlot
from r2p.tools.bus import picture
from r2p.tools.bus.admit import Svg
from r2p.tools.bus.load import listen
from r2p.tools.bus.picture import Cell
from r2p.tools.options import Format, Quiet, Verbose, Via
from r2p.tools.output import Output
from r2p.tools.session import TimedOut, execute

_UNUSED = "reserved but not used: no subscriber, or the owner is gone"
_SYNC_TIMEOUT = 3.0  # s

Cycles = Annotated[int, typer.Option("--cycles", "-n", min=1, metavar="N", help="Watch N cycles.")]


def schedule(
    cycles: Cycles = 100,
    svg: Svg = None,
    format: Format = None,
    via: Via = None,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Draw the slots of a CAN bus: owners, free slots, and slots that were reserved but not used. Sends nothing."""

    async def main() -> None:
        output = Output(format)
        async with listen(via) as bus:
            if not await bus.cycles(cycles, timeout=_SYNC_TIMEOUT):
                raise TimedOut(
                    f"no sync frames for {_SYNC_TIMEOUT:g} s: no RTCAN master on this bus, so it has no slots "
                    "(the firmware of 2014 has none)"
                )
            cells = cells_of(bus)
            grid = bus.timing
            title = f"{grid.slots} slots of {grid.slot / 1000:g} us, over {bus.slot_cycles} cycles"
            if output.format == "text":
                lines = [title, "", picture.text(cells), "", *picture.legend(cells, {})]
                await output.remark("\n".join(lines))
            else:
                await output.table(rows(bus), ["slot", "owner", "reserved", "used", "missed", "shared"])
            if svg is not None:
                picture.save(svg, cells, title, {})

    execute(main, verbose=verbose, quiet=quiet)


def cells_of(bus: BusMonitor) -> list[Cell]:
    """Return the slots as cells of a picture."""
    return [
        Cell(
            _owner(slot) or (_UNUSED if slot.reserved else ""),
            slot.missed,
            slot.shared,
            f"{', '.join(slot.owners) or 'free'}: {slot.used} of {slot.reserved} used, {slot.shared} events",
        )
        for slot in bus.slots
    ]


def rows(bus: BusMonitor) -> list[dict[str, object]]:
    """Return the slots as records; the numbers count cycles."""
    return [
        {
            "slot": index,
            "owner": _owner(slot) or None,
            "reserved": slot.reserved,
            "used": slot.used,
            "missed": slot.missed,
            "shared": slot.shared,
        }
        for index, slot in enumerate(bus.slots)
    ]


def _owner(slot: BusSlot) -> str:
    """Return the owner that used a slot most: with periods longer than a cycle, several can share one."""
    return max(slot.owners, key=lambda owner: slot.owners[owner], default="")
