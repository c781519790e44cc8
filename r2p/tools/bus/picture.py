"""The slots of a cycle as a picture: as text for a terminal, and as SVG.

Each owner gets a letter. A cell is the letter and a mark: `!` missed in some cycles, `+` free and used by events.
"""

import string
from collections.abc import Iterable
from pathlib import Path
from xml.sax.saxutils import escape

import msgspec

from r2p import Error

_ROW = 20  # slots in a line of text
_SIDE = 26  # pixels of a slot in the SVG
_LETTERS = string.ascii_uppercase.replace("S", "") + string.ascii_lowercase + string.digits
_COLOURS = ("#4e79a7", "#f28e2b", "#59a14f", "#b07aa1", "#76b7b2", "#edc948", "#9c755f", "#ff9da7")
_SYNC, _FREE, _EVENTS, _MISSED = "#444444", "#f4f4f4", "#cfe3f5", "#d62728"


class Cell(msgspec.Struct, frozen=True):
    """One slot. `owner` is "" for a free one, "sync" for the master's; `missed` and `shared` count cycles."""

    owner: str = ""
    missed: int = 0
    shared: int = 0
    note: str = ""


def letters(cells: Iterable[Cell]) -> dict[str, str]:
    """Return the letter of each owner, in order of appearance; all beyond the last letter share that."""
    owners = dict.fromkeys(cell.owner for cell in cells if cell.owner not in {"", "sync"})
    return {owner: _LETTERS[min(i, len(_LETTERS) - 1)] for i, owner in enumerate(owners)}


def text(cells: list[Cell]) -> str:
    """Return lines of 20 slots, each with the number of its first slot."""
    names = letters(cells)
    rows = []
    for start in range(0, len(cells), _ROW):
        row = (_glyph(cell, names) for cell in cells[start : start + _ROW])
        rows.append(f"{start:3}  {' '.join(row)}".rstrip())
    return "\n".join(rows)


def legend(cells: Iterable[Cell], more: dict[str, str]) -> list[str]:
    """Return lines that explain the letters; `more` has longer names of owners."""
    lines = [f"     {letter}  {more.get(owner, owner)}" for owner, letter in letters(cells).items()]
    return [*lines, "     S  sync    .  free    +  free, used by events    !  missed in some cycles"]


def save(file: Path, cells: list[Cell], title: str, legend: dict[str, str]) -> None:
    """Write the drawing into a file. Raises Error if that fails."""
    try:
        file.write_text(svg(cells, title, legend), encoding="utf-8")
    except OSError as error:
        raise Error(f"can't write {file}: {error.strerror}") from error


def svg(cells: list[Cell], title: str, legend: dict[str, str]) -> str:
    """Return the picture as an SVG document; `legend` has longer names of owners."""
    names = letters(cells)
    top, width = 40, _ROW * _SIDE + 40
    rows = -(-len(cells) // _ROW)
    below = top + rows * (_SIDE + 6) + 24
    height = below + 20 * (len(names) + 1)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" font-family="sans-serif">',
        f'<rect width="{width}" height="{height}" fill="white"/>',
        f'<text x="20" y="24">{escape(title)}</text>',
    ]
    for i, cell in enumerate(cells):
        parts.append(_box(i, cell, 20 + i % _ROW * _SIDE, top + i // _ROW * (_SIDE + 6), names))
    for i, (owner, letter) in enumerate(names.items()):
        y = below + 20 * i
        parts.append(f'<rect x="20" y="{y - 11}" width="14" height="14" fill="{_colour(letter)}"/>')
        parts.append(f'<text x="42" y="{y}" font-size="12">{letter}  {escape(legend.get(owner, owner))}</text>')
    return "\n".join([*parts, "</svg>\n"])


def _glyph(cell: Cell, names: dict[str, str]) -> str:
    if cell.owner == "sync":
        return "S "
    if cell.owner:
        return names[cell.owner] + ("!" if cell.missed else " ")
    return "+ " if cell.shared else ". "


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
    return _COLOURS[_LETTERS.index(letter) % len(_COLOURS)]
