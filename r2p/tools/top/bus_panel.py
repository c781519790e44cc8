"""The load of a bus against what is reserved on it, and the map of its slots."""

from rich.text import Text

from r2p.log_lines import printable
from r2p.monitoring.snapshot import BusFigures
from r2p.tools.bus.slots import SLOT_LETTERS
from r2p.tools.top import drawing
from r2p.tools.top.text_lines import TextLines

_SLOTS_MAX = 256  # of a cycle; RTCAN has at most 63
_HIGH = 0.8  # of the slots that are free, in use: above it events wait long
_COLOURS = ("cyan", "green", "yellow", "magenta", "blue", "red")
_UNUSED = "reserved and not used"


class BusPanel(TextLines):
    """One bus."""

    def show_bus(self, bus: BusFigures | None, which: str) -> None:
        """Show a bus, or that none has been heard of yet. `which` says which one it is if there are several."""
        if bus is None:
            self.show("no figures of a bus yet: they come from bus_load and bus_slots, of an r2p module on a CAN bus")
        else:
            self.show(*bus_lines(bus, which, self.size.width or 80))


def bus_lines(bus: BusFigures, which: str, width: int) -> list[Text]:
    """Return the load, the slots, and what their letters mean."""
    lines = [_head(bus, which), _load(bus, width)]
    owners = slot_owners(bus)
    if not owners:
        return [*lines, Text("the slots are not known yet", style="dim")]
    letters = slot_letters(owners)
    return [*lines, *_map(owners, letters, width), _legend(letters)]


def slot_owners(bus: BusFigures) -> list[str | None]:
    """Return the owner of each slot: None of a free one."""
    owners: list[str | None] = [None] * min(bus.slots_in_cycle or 0, _SLOTS_MAX)
    for each in bus.slots:
        for slot in each.slots:
            if 0 <= slot < len(owners):
                owners[slot] = "sync" if slot == 0 else f"{each.module}: {each.topic}" if each.topic else _UNUSED
    return owners


def slot_letters(owners: list[str | None]) -> dict[str, str]:
    """Return the letter of each owner, in order of appearance; "S" is the sync's, and "_" is used by none."""
    letters: dict[str, str] = {}
    free = iter(SLOT_LETTERS)
    for owner in owners:
        if owner is not None and owner not in letters:
            special = {"sync": "S", _UNUSED: "_"}.get(owner)
            letters[owner] = special or next(free, SLOT_LETTERS[-1])
    return letters


def _head(bus: BusFigures, which: str) -> Text:
    text = Text(printable(bus.name), style="bold").append(printable(f"{which}  master {bus.master or drawing.UNKNOWN}"))
    text.stylize("not bold", len(bus.name))
    text.append(f"  {drawing.number(bus.frames)} frames/s  errors ")
    text.append(drawing.count(bus.errors), style="bold red" if bus.errors else "")
    if bus.slots_in_cycle and bus.cycle:
        text.append(f"  {bus.slots_in_cycle} slots in {drawing.milliseconds(bus.cycle)} ms")
    return text


def _load(bus: BusFigures, width: int) -> Text:
    after = (
        f" {drawing.percent(bus.share)} % used  {drawing.percent(bus.reserved)} % reserved  "
        f"{drawing.percent(bus.free_used)} % of the rest"
    )
    text = Text(drawing.bar(bus.share, bus.reserved, max(8, min(40, width - len(after)))), style="green")
    return text.append(after, style="bold red" if (bus.free_used or 0) > _HIGH else "default")


def _map(owners: list[str | None], letters: dict[str, str], width: int) -> list[Text]:
    """Return lines of slots, each with the number of its first one; whole tens in a line."""
    per_line = max(10, (width - 5) // 20 * 10)
    lines = []
    for start in range(0, len(owners), per_line):
        line = Text().append(f"{start:3}  ", style="dim")
        for owner in owners[start : start + per_line]:
            line.append("." if owner is None else letters[owner], style=_style(owner, letters)).append(" ")
        lines.append(line)
    return lines


def _style(owner: str | None, letters: dict[str, str]) -> str:
    if owner is None:
        return "dim"
    letter = letters[owner]
    return "bold" if letter not in SLOT_LETTERS else f"bold {_COLOURS[SLOT_LETTERS.index(letter) % len(_COLOURS)]}"


def _legend(letters: dict[str, str]) -> Text:
    text = Text("     ")
    for owner, letter in letters.items():
        text.append(letter, style=_style(owner, letters)).append(printable(f" {owner.rpartition(': ')[2]}  "))
    return text.append(". free", style="dim")
