"""The tables and pictures of docs/time-and-failures.md, from the results of `failures` and `synchronisation`."""

from __future__ import annotations

import re
import statistics
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import msgspec

from benchmarks.thesis.svg import COLOURS, Plot

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from benchmarks.failures import FailureOutcome, FailureRow
    from benchmarks.synchronisation import ErrorFigures, SyncOutcome

_DOCS = Path(__file__).parents[1] / "docs"
PAGE = _DOCS / "time-and-failures.md"
ASSETS = _DOCS / "assets" / "time"
_MARKED = re.compile(r"(<!-- table: ([\w.-]+) -->\n).*?(<!-- end of table -->)", re.DOTALL)
_USUAL = {"arbitration lost", "late_to_slot", "missed"}  # of a bus without any fault, or the sum of others
_SHOWN = 5  # counters of a case

Tables = dict[str, list[str]]
Result = TypeVar("Result")


def show(tables: Tables) -> None:
    """Print tables."""
    for name, lines in tables.items():
        print(f"{name}:", "", *lines, "", sep="\n")


def filled(text: str, tables: Tables) -> str:
    """Return the page with these tables in place of those of the same names."""

    def table(found: re.Match[str]) -> str:
        return found[1] + "\n".join(["", *tables[found[2]], "", ""]) + found[3] if found[2] in tables else found[0]

    return _MARKED.sub(table, text)


def load(name: str, type: type[Result]) -> list[Result]:
    """Load results that are beside the page."""
    return msgspec.json.decode((ASSETS / f"{name}.json").read_bytes(), type=list[type])  # type: ignore[valid-type]


def write_failures(rows: Sequence[FailureRow]) -> None:
    """Write results, tables and picture."""
    _write("failures", rows, failure_tables(rows))
    draw_failures(rows, ASSETS)


def write_synchronisation(outcomes: Sequence[SyncOutcome]) -> None:
    """Write results, tables and picture."""
    _write("synchronisation", outcomes, sync_tables(outcomes))
    draw_synchronisation(outcomes, ASSETS)


def _write(name: str, results: Sequence[object], tables: Tables) -> None:
    ASSETS.mkdir(parents=True, exist_ok=True)
    (ASSETS / f"{name}.json").write_bytes(msgspec.json.format(msgspec.json.encode(results), indent=1) + b"\n")
    PAGE.write_text(filled(PAGE.read_text(), tables))


def _row(*cells: object) -> str:
    return f"| {' | '.join(str(cell) for cell in cells)} |"


def _head(*cells: str) -> Iterator[str]:
    yield _row(*cells)
    yield f"| --- |{' ---: |' * (len(cells) - 1)}"


# Failures


def failure_tables(rows: Sequence[FailureRow]) -> Tables:
    """Return the tables by name."""
    return {"failures": list(_lost(rows)), "recovery": list(_recovery(rows)), "seen": list(_seen(rows))}


def _lost(rows: Sequence[FailureRow]) -> Iterator[str]:
    kinds = ("slots lost", "values lost", "without HRT ms", "without values ms", "without sync ms")
    yield from _head("fault", *(f"{kind}: {which}" for kind in kinds for which in ("median", "worst")))
    for each in rows:
        runs = each.runs
        yield _row(
            each.text,
            *_pair([run.slots_lost for run in runs]),
            *_pair([run.values_lost for run in runs]),
            *_pair([run.without_hrt for run in runs]),
            *_pair([run.without_values for run in runs]),
            *_pair([run.sync_gap for run in runs]),
        )


def _pair(values: Sequence[float]) -> tuple[str, str]:
    return f"{statistics.median(values):.0f}", f"{max(values):.0f}"


def _recovery(rows: Sequence[FailureRow]) -> Iterator[str]:
    yield from _head(
        "fault", "others have slots", "the same ones", "own slots back ms: median", "worst", "own are the same"
    )
    for each in rows:
        count = len(each.runs)
        back = [run.own_back for run in each.runs]
        known = [time for time in back if time is not None]
        own = _pair(known) if known and len(known) == count else ("-", "-" if not each.broken else "not in 3 s")
        yield _row(
            each.text,
            f"{sum(run.slotted for run in each.runs)} of {count}",
            f"{sum(run.kept for run in each.runs)} of {count}",
            *own,
            f"{sum(run.own_same for run in each.runs)} of {count}" if each.broken else "-",
        )


def _seen(rows: Sequence[FailureRow]) -> Iterator[str]:
    yield from _head("fault", "counters of the others", "events of the others", "events of the module itself")
    for each in rows:
        counts = _most([run.counts for run in each.runs])
        yield _row(
            each.text,
            ", ".join(f"`{kind}` {count:.0f}" for kind, count in counts if kind not in _USUAL) or "none",
            _listed([run.notices for run in each.runs]),
            _listed([run.own_notices for run in each.runs]) if each.broken else "-",
        )


def _most(found: Sequence[dict[str, int]]) -> list[tuple[str, float]]:
    """Return the most frequent kinds that are not usual, with their medians."""
    kinds = {kind for each in found for kind in each} - _USUAL
    medians = Counter({kind: statistics.median(each.get(kind, 0) for each in found) for kind in sorted(kinds)})
    return [(kind, count) for kind, count in medians.most_common(_SHOWN) if count]


def _listed(found: Sequence[dict[str, int]]) -> str:
    return ", ".join(f"`{kind}` {count:.0f}" for kind, count in _most(found)) or "none"


def draw_failures(rows: Sequence[FailureRow], folder: Path) -> None:
    """Draw how long topics of the others had no slots and no values, at worst."""
    longest = max(_worst(each.runs, "without_hrt") for each in rows)
    top = 200.0 * (int(longest / 200) + 1)
    plot = Plot(
        "Longest time of a topic of the others, worst of ten runs",
        (0, len(rows)),
        (0, top),
        labels=("fault, in the order of the tables", "ms"),
        size=(860, 340),
        legend=0.02,
    )
    step = 400 if top > 1000 else 100
    plot.ticks(
        [
            (number + 0.5, each.name.replace("babble", "babb.").replace("sync", "s."))
            for number, each in enumerate(rows)
        ],
        [(value, str(value)) for value in range(0, int(top) + 1, step)],
    )
    for number, each in enumerate(rows):
        for place, field in enumerate(("without_hrt", "without_values")):
            left = number + 0.15 + 0.35 * place
            plot.box((left, left + 0.35), (0, _worst(each.runs, field)), COLOURS[place])
    plot.name("without messages in slots", COLOURS[0])
    plot.name("without values at the subscriber", COLOURS[1])
    plot.write(folder / "failures.svg")


def _worst(runs: Sequence[FailureOutcome], field: str) -> float:
    return max(float(getattr(each, field)) for each in runs)


# Synchronisation


def sync_tables(outcomes: Sequence[SyncOutcome]) -> Tables:
    """Return the tables by name."""
    times = [(each, each.network_time) for each in outcomes]
    return {
        "network-time": list(_errors(times, "bound", unknown=True)),
        "utc": list(_errors([(each, each.utc) for each in outcomes], "claimed", unknown=False)),
    }


def _errors(found: Sequence[tuple[SyncOutcome, ErrorFigures]], claim: str, *, unknown: bool) -> Iterator[str]:
    last = ("unknown %",) if unknown else ()
    yield from _head(
        "network", "samples", "median µs", "99 % µs", "largest µs", f"{claim}: median µs", "largest µs", "broken", *last
    )
    for outcome, figures in found:
        values = (figures.median, figures.most_of_99, figures.largest, figures.claimed_median, figures.claimed_largest)
        yield _row(
            outcome.case.text,
            figures.samples,
            *(f"{value:.1f}" for value in values),
            figures.broken,
            *([f"{100 * outcome.unknown:.1f}"] if unknown else []),
        )


def draw_synchronisation(outcomes: Sequence[SyncOutcome], folder: Path) -> None:
    """Draw true and claimed errors of the translation to UTC, and of network time."""
    top = 10.0 * (int(max(each.utc.claimed_largest for each in outcomes) / 10) + 3)  # with room for the legend
    plot = Plot(
        "Errors by network, in the order of the tables",
        (0, len(outcomes)),
        (0, top),
        labels=("network", "µs"),
        size=(760, 320),
        legend=0.55,
    )
    plot.ticks(
        [(number + 0.5, str(number + 1)) for number in range(len(outcomes))],
        [(value, str(value)) for value in range(0, int(top) + 1, 10)],
    )
    lines = (
        ("UTC: largest claimed error", COLOURS[3], "4 3", [each.utc.claimed_largest for each in outcomes]),
        ("UTC: largest true error", COLOURS[3], "", [each.utc.largest for each in outcomes]),
        ("network time: largest bound", COLOURS[0], "4 3", [each.network_time.claimed_largest for each in outcomes]),
        ("network time: largest true error", COLOURS[0], "", [each.network_time.largest for each in outcomes]),
    )
    for text, colour, dash, values in lines:
        plot.line([(number + 0.5, value) for number, value in enumerate(values)], colour, dash=dash, dots=True)
        plot.name(text, colour, dash=dash)
    plot.write(folder / "synchronisation.svg")
