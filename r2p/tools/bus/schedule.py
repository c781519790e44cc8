"""`r2p bus schedule`: the slots of the cycle, and who really uses them."""

from typing import Annotated

import typer

from r2p.bus import BusMonitor, BusSlot
from r2p.tools.bus import picture
from r2p.tools.bus.admit import Svg
from r2p.tools.bus.load import listen
from r2p.tools.bus.picture import Cell
from r2p.tools.output import Output
from r2p.tools.session import Format, Quiet, TimedOut, Verbose, Via, execute

_UNUSED = "reserved, and not used: nobody subscribes, or the owner is gone"
_PATIENCE = 3.0  # s without a sync

Cycles = Annotated[int, typer.Option("--cycles", "-n", min=1, metavar="N", help="Watch so many cycles.")]


def schedule(
    cycles: Cycles = 100,
    svg: Svg = None,
    format: Format = None,
    via: Via = None,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Draw the slots of a CAN bus: who owns which, what is free, and what was reserved and not used. Sends nothing."""

    async def main() -> None:
        output = Output(format)
        async with listen(via) as bus:
            if not await bus.cycles(cycles, timeout=_PATIENCE):
                raise TimedOut(
                    f"no sync frames for {_PATIENCE:g} s: no RTCAN master on this bus, so it has no slots "
                    "(firmware of 2014 works without them)"
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
    """The slot map as a picture's cells."""
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
    """The slot map for programs; numbers of cycles."""
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
    """Who used it most: in longer periods than a cycle several may share one."""
    return max(slot.owners, key=lambda owner: slot.owners[owner], default="")
