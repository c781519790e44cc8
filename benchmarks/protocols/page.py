"""The tables of docs/comparison.md, from the results of the study, as Markdown."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from benchmarks.protocols.cases import FAULTS
from benchmarks.protocols.message_sets import named_set
from benchmarks.protocols.study import ERROR_RATES, SYNCLESS, StudyResults

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from benchmarks.protocols.cases import CaseFigures

_DOCS = Path(__file__).parents[2] / "docs"
ASSETS = _DOCS / "assets" / "comparison"
PAGE = _DOCS / "comparison.md"
RESULTS = ASSETS / "results.json"
_WITH_RESPONSES = "thesis-80"
_SEPARATOR = " / "
_MARKED = re.compile(r"(<!-- table: ([\w.-]+) -->\n).*?(<!-- end of table -->)", re.DOTALL)


def load_results() -> StudyResults:
    """Load the results that are beside the page."""
    return msgspec.json.decode(RESULTS.read_bytes(), type=StudyResults)


def write(results: StudyResults) -> None:
    """Write the results, and the tables into the page."""
    ASSETS.mkdir(parents=True, exist_ok=True)
    RESULTS.write_bytes(msgspec.json.format(msgspec.json.encode(results), indent=1) + b"\n")
    PAGE.write_text(filled(PAGE.read_text(), results))


def filled(text: str, results: StudyResults) -> str:
    """Return the page with these tables. Raises KeyError for a table that there is none of."""
    made = tables(results)
    return _MARKED.sub(lambda found: found[1] + "\n".join(["", *made[found[2]], "", ""]) + found[3], text)


def tables(results: StudyResults) -> dict[str, list[str]]:
    """Return all tables by name."""
    made = {"sets": list(_sets(results))}
    for name in _names(results):
        made[name] = list(_columns(results, name))
    if _WITH_RESPONSES in _names(results):
        made["errors-thesis"] = list(_errors_of_thesis(results))
    made["errors-periodic"] = list(_errors(results, sporadic=False))
    made["errors-events"] = list(_errors(results, sporadic=True))
    made["errors-loads"] = list(_loads(results, _missed, ERROR_RATES[-1]))
    made["loads"] = list(_loads(results, _missed))
    made["loads-events"] = list(_loads(results, lambda figures: _ms(figures.worst or None)))
    made["faults-babble"] = list(_faults(results, FAULTS[:2]))
    made["faults-master"] = list(_faults(results, FAULTS[2:]))
    made["added"] = list(_added(results))
    return {name: lines for name, lines in made.items() if len(lines) > 2}


def _names(results: StudyResults) -> list[str]:
    return list(results.protocols[0].plan.sets) if results.protocols else []


def _sets(results: StudyResults) -> Iterator[str]:
    yield from _head(
        "set",
        "kbit/s",
        "nodes",
        "periodic",
        "sporadic",
        "shortest period ms",
        "load %",
        "measured s",
        "periodic values",
        "events",
        "with errors s",
    )
    plan = results.protocols[0].plan
    for name in _names(results):
        messages = named_set(name)
        periodic = [each for each in messages.messages if not each.sporadic]
        judged = results.figures(results.protocols[0].protocol, name)
        assert judged is not None
        yield _row(
            name,
            f"{messages.bitrate // 1000}",
            f"{len(messages.nodes)}",
            f"{len(periodic)}",
            f"{len(messages.messages) - len(periodic)}",
            f"{min(each.period for each in periodic) / 1e6:g}",
            f"{100 * messages.load:.1f}",
            f"{plan.sets[name]:g}",
            f"{judged.periodic}",
            f"{judged.sporadic}",
            f"{plan.with_errors[name]:g}",
        )


def _columns(results: StudyResults, name: str) -> Iterator[str]:
    rows = list(_rows(results, name))
    events = any(figures.sporadic for _, figures in rows)
    unplaced = any(figures.unplaced for _, figures in rows)
    head = ["protocol", "sync %", "bus busy %", "jitter, fastest us", "jitter, any us", "periodic missed %"]
    head += ["without a slot"] if unplaced else []
    head += ["events: median ms", "99.9 % ms", "worst ms", "events missed %"] if events else []
    yield from _head(*head)
    for protocol, figures in rows:
        cells = [
            protocol,
            f"{100 * figures.sync:.1f}" if protocol not in SYNCLESS or figures.sync else "-",
            f"{100 * figures.busy:.1f}",
            f"{figures.jitter_fast:.0f}",
            f"{figures.jitter:.0f}",
            _share(figures.periodic_missed, figures.periodic),
        ]
        if unplaced:
            cells.append(f"{figures.unplaced}" if figures.unplaced else "")
        if events:
            cells += [_ms(figures.median), _ms(figures.p999), _ms(figures.worst or None)]
            cells.append(_share(figures.sporadic_missed, figures.sporadic))
        yield _row(*cells)


def _errors_of_thesis(results: StudyResults) -> Iterator[str]:
    """What else errors change on the thesis's network, where there are events enough."""
    kinds = ("events 99.9 % ms", "events worst ms", "jitter us")
    yield from _head("protocol", *(f"{kind}: {_rate(rate)}" for kind in kinds for rate in ERROR_RATES))
    for each in results.protocols:
        figures = [results.figures(each.protocol, _WITH_RESPONSES, rate) for rate in ERROR_RATES]
        known = [one for one in figures if one is not None]
        yield _row(
            each.protocol,
            *(_ms(one.p999) for one in known),
            *(_ms(one.worst or None) for one in known),
            *(f"{one.jitter:.0f}" for one in known),
        )


def _errors(results: StudyResults, *, sporadic: bool) -> Iterator[str]:
    """What is missed with errors at each rate, by set, periodic messages or events."""
    names = [
        name for name in _names(results) if not sporadic or any(each.sporadic for each in named_set(name).messages)
    ]
    yield from _head("protocol", *names)
    for each in results.protocols:
        cells = []
        for name in names:
            figures = [results.figures(each.protocol, name, rate) for rate in ERROR_RATES]
            shares = [
                _share(one.sporadic_missed, one.sporadic) if sporadic else _share(one.periodic_missed, one.periodic)
                for one in figures
                if one is not None
            ]
            cells.append(_SEPARATOR.join(shares) if any(share != "0" for share in shares) else "0")
        yield _row(each.protocol, *cells)


def _loads(results: StudyResults, cell: Callable[[CaseFigures], str], bit_error_rate: float = 0.0) -> Iterator[str]:
    loads = results.protocols[0].plan.loads
    yield from _head("protocol", *(f"{load} %" for load in loads))
    for each in results.protocols:
        figures = [results.figures(each.protocol, f"random-{load}", bit_error_rate) for load in loads]
        yield _row(each.protocol, *("" if one is None else cell(one) for one in figures))


def _missed(figures: CaseFigures) -> str:
    return _share(figures.periodic_missed + figures.sporadic_missed, figures.periodic + figures.sporadic)


def _faults(results: StudyResults, faults: Sequence[str]) -> Iterator[str]:
    kinds = ("periodic missed %", "events missed %", "longest silence ms")
    yield from _head("protocol", *(f"{fault}: {kind}" for fault in faults for kind in kinds))
    for each in results.protocols:
        cells: list[str] = []
        for fault in faults:
            figures = results.figures(each.protocol, "thesis-80", 0.0, fault)
            if figures is not None:
                cells.append(_share(figures.periodic_missed, figures.periodic))
                cells.append(_share(figures.sporadic_missed, figures.sporadic))
                cells.append(f"{figures.silence / 1000:.1f}")
        if cells:
            yield _row(each.protocol, *cells)


def _added(results: StudyResults) -> Iterator[str]:
    yield from _head("protocol", "messages with new settings: thesis-80", "nodes", "sae", "nodes", "measured online")
    for each in results.protocols:
        cells = [f"{number}" for name in each.added for number in (each.added[name].messages, each.added[name].nodes)]
        measured = [added for added in each.added.values() if added.milliseconds]
        online = "; ".join(f"{added.milliseconds:.1f} ms, {added.frames} frames" for added in measured)
        yield _row(each.protocol, *cells, online)


def _rows(results: StudyResults, name: str) -> Iterator[tuple[str, CaseFigures]]:
    for each in results.protocols:
        figures = results.figures(each.protocol, name)
        if figures is not None:
            yield each.protocol, figures


def _rate(rate: float) -> str:
    return f"{rate:.0e}".replace("e-0", "e-") if rate else "no errors"


def _share(part: int, of: int) -> str:
    """Return a share in percent: 0 is none at all."""
    if not of:
        return "-"
    if not part:
        return "0"
    percent = 100 * part / of
    return f"{percent:.0f}" if percent >= 10 else f"{percent:.1f}" if percent >= 1 else f"{percent:.2g}"


def _ms(value: float | None) -> str:
    return "-" if value is None else f"{value / 1000:.2f}"


def _head(*cells: str) -> Iterator[str]:
    yield _row(*cells)
    yield _row("---", *("---:" for _ in cells[1:]))


def _row(*cells: Sequence[str] | str) -> str:
    return "| " + " | ".join(str(each) for each in cells) + " |"
