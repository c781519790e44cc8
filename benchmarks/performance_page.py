"""Put what was measured at a commit into docs/performance.md: tables, curves and raw data of the sections about others.

`python -m benchmarks irobot arrays payloads peers`, then `python -m benchmarks.performance_page COMMIT`.
"""

import json
import math
import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from benchmarks.history import FOLDER, History
from benchmarks.thesis.svg import COLOURS, Plot

DOCS = Path(__file__).parents[1] / "docs"
PAGE, ASSETS = DOCS / "performance.md", DOCS / "assets" / "performance"

SECTIONS = {"robots": r"(sierra_nevada|made_up), ", "others": r"(Array|zenoh, \d+ bytes|two processes, 64 bytes: )"}
"""Rows of each section, by how their names begin; `<!-- figures: NAME -->` begins it on the page."""

_CURVE = re.compile(r"([\d.]+) (M|k)/s(?::[^;]*)?; (\d+) us")
_SIZE = re.compile(r"zenoh, (\d+) bytes")
_SCALE = {"M": 1e6, "k": 1e3}

Rows = list[dict[str, Any]]


def rows_of(runs: Sequence[dict[str, Any]], pattern: str) -> Rows:
    """The last measurement of each row whose name begins so."""
    found = {
        (row["what"], row["baseline"].split(" ")[0]): row
        for run in runs
        for row in run["rows"]
        if re.match(pattern, row["what"])
    }
    return list(found.values())


def table(rows: Rows) -> str:
    """Markdown."""
    lines = ["| what | measured | in the same run |", "| --- | --- | --- |"]
    lines += [f"| {row['what']} | {row['measured']} | {row['baseline']} |" for row in rows]
    return "\n".join(lines)


def fill(page: str, name: str, text: str) -> str:
    """Replace what is between a section's two marks. Raises ValueError for a page without them."""
    begin, end = f"<!-- figures: {name} -->\n", "<!-- end of figures -->"
    head, mark, rest = page.partition(begin)
    _, closing, tail = rest.partition(end)
    if not mark or not closing:
        raise ValueError(f"the page has no {begin.strip()} with {end}")
    return f"{head}{begin}\n{text}\n\n{end}{tail}"


def curves(rows: Rows) -> Iterator[tuple[str, str, Plot]]:
    """The streams and the round trips by size, on logarithmic scales: r2p beside zenoh-python."""
    points = [(math.log10(int(found[1])), row) for row in rows if (found := _SIZE.match(row["what"]))]
    for index, (name, title) in enumerate((("stream", "Messages a second"), ("trip", "There and back, p50 (us)"))):
        lines = {
            peer: [(size, value) for size, row in points if (value := _value(row[field], index)) is not None]
            for peer, field in (("r2p over zenoh", "measured"), ("zenoh-python", "baseline"))
        }
        if any(lines.values()):
            yield name, f"{title}, by bytes of the payload", _plot(title, lines)


def _value(text: str, index: int) -> float | None:
    """The logarithm of the rate (0) or of the round trip (1) in a row's text; None for what did not move at all."""
    found = _CURVE.search(text)
    if found is None:
        return None
    value = float(found[1]) * _SCALE[found[2]] if index == 0 else float(found[3])
    return math.log10(value) if value else None


def _plot(title: str, lines: dict[str, list[tuple[float, float]]]) -> Plot:
    values = [value for line in lines.values() for _, value in line]
    low, high = math.floor(min(values)), math.ceil(max(values))
    plot = Plot(title, (0.5, 6.5), (low, high), labels=("bytes", ""), legend=0.7)
    ticks = [(float(power), f"{10**power:,}".replace(",", " ")) for power in range(7)]
    plot.ticks(ticks[1:], [(float(power), f"{10**power:,}".replace(",", " ")) for power in range(low, high + 1)])
    for (peer, line), colour in zip(lines.items(), COLOURS, strict=False):
        plot.line(line, colour, dots=True)
        plot.name(peer, colour)
    return plot


def main(commit: str) -> None:
    if not History(commit).runs:
        raise SystemExit(f"nothing was measured at {commit}: run python -m benchmarks irobot arrays payloads peers")
    runs = json.loads((FOLDER / f"{commit}.json").read_text())
    ASSETS.mkdir(exist_ok=True)
    page, state = PAGE.read_text(), runs[-1]["machine"]
    measured = f"Measured at {commit}: {state['processor']}, Python {state['python']}, load {state['load']}."
    drawn = list(curves(rows_of(runs, SECTIONS["others"])))
    pictures = "\n".join(f"![{title}](assets/performance/{name}.svg)" for name, title, _ in drawn)
    for name, pattern in SECTIONS.items():
        if rows := rows_of(runs, pattern):
            text = f"{measured}\n\n{table(rows)}"
            page = fill(page, name, f"{text}\n\n{pictures}" if drawn and name == "others" else text)
            (ASSETS / f"{name}.json").write_text(json.dumps({"machine": state, "rows": rows}, indent=1) + "\n")
    for name, _, plot in drawn:
        plot.write(ASSETS / f"{name}.svg")
    PAGE.write_text(page)


if __name__ == "__main__":
    main(sys.argv[1])
