"""Figures 4.12, 4.13 and 4.14 of the thesis from our runs, and the sweep over the load of events."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from benchmarks.thesis.network import HRT, MS, NODES, SRT
from benchmarks.thesis.summary import LATENCY_BIN, Spread, Summary
from benchmarks.thesis.svg import COLOURS, Plot
from benchmarks.thesis.tables import CLAIMED, EVENTS

_US = 1000


def calendar(summary: Summary, path: Path) -> None:
    """Figure 4.12: whose slot is which, in one cycle."""
    title = "One cycle: slots by owner (free ones are white)"
    plot = Plot(title, (0, 60), (0, 4), labels=("slot", ""), size=(900, 190))
    rows = {"sync": 3.0, **{name: 2.0 - number for number, name in enumerate(NODES)}}
    plot.ticks([(slot + 0.5, str(slot)) for slot in range(0, 60, 6)])
    for name, row in rows.items():
        plot.note(-0.6, row + 0.35, name if name == "sync" else f"node {name}", anchor="end")
    plot.box((0, 1), (3.1, 3.9), "#555")
    colours = {message.name: COLOURS[number] for number, message in enumerate(HRT)}
    for slot, (node, message) in sorted(summary.owners.items()):
        plot.box((slot, slot + 1), (rows[node] + 0.1, rows[node] + 0.9), colours[message], message)
    plot.write(path)


def jitter(summary: Summary, still: Summary, path: Path) -> None:
    """Figure 4.13: how far each start of frame is off the master's grid."""
    spreads = {f"node {name}": summary.errors[name] for name in NODES}
    exact = Spread(summary.errors[NODES[0]].width)
    for name in NODES:
        exact.merge(still.errors[name])
    highest = max(_share(spread) for spread in spreads.values())
    labels = ("start of frame less start of slot, us", "% of frames in 0.25 us")
    title = "Hard real-time: start of frame against the master's grid"
    plot = Plot(title, (-10, 10), (0, highest * 1.1), labels=labels)
    plot.ticks([(us, f"{us:+d}") for us in range(-9, 10, 3)], [(each, f"{each:g}") for each in _scale(highest * 1.1)])
    for (name, spread), colour in zip(spreads.items(), COLOURS, strict=False):
        plot.steps(_bins(spread, _US), spread.width / _US, colour)
        plot.name(name if name != f"node {NODES[0]}" else f"{name} (master)", colour)
    worst = max(abs(exact.least), abs(exact.most)) / _US
    plot.note(-9.8, highest, f"without jitter: at most {worst:.2f} us off")
    plot.write(path)


def latencies(summary: Summary, path: Path) -> None:
    """Figure 4.14: the latency of events."""
    spreads = {f"S_{kind.name}": summary.kinds[kind.name].latency for kind in SRT}
    highest = max(_share(spread) for spread in spreads.values())
    labels = ("from the event to the end of its last frame, ms", "% of events in 0.5 ms")
    plot = Plot("Soft real-time: latency", (0, 52), (0, highest * 1.05), labels=labels)
    plot.ticks([(ms, str(ms)) for ms in range(0, 55, 5)], [(each, f"{each:g}") for each in _scale(highest)])
    for (name, spread), colour in zip(spreads.items(), COLOURS, strict=False):
        plot.steps([each for each in _bins(spread, MS) if each[0] < 52], LATENCY_BIN / MS, colour)
        plot.name(name, colour)
    plot.write(path)


def sweep(series: Mapping[str, Sequence[tuple[float, Summary]]], claimed: float, misses: Path, delays: Path) -> None:
    """Misses and mean latencies over the load; `claimed` is the load that the thesis names."""
    loads = [load * 100 for load, _ in next(iter(series.values()))]
    across = (min(loads), max(loads))
    labels = ("events, % of the free slots", "% missed")
    plot = Plot("Soft real-time: missed deadlines", across, (0, 40), labels=labels, size=(720, 340), legend=0.05)
    _sweep(plot, series, claimed, [(each, str(each)) for each in range(0, 45, 10)], missed=True)
    plot.write(misses)
    labels = ("events, % of the free slots", "mean latency, ms")
    plot = Plot("Soft real-time: mean latency", across, (0, 60), labels=labels, size=(720, 340), legend=0.05)
    _sweep(plot, series, claimed, [(each, str(each)) for each in range(0, 65, 10)], missed=False)
    plot.write(delays)


def _sweep(
    plot: Plot,
    series: Mapping[str, Sequence[tuple[float, Summary]]],
    claimed: float,
    marks: Sequence[tuple[float, str]],
    *,
    missed: bool,
) -> None:
    top = marks[-1][0]
    points = next(iter(series.values()))
    plot.ticks([(load * 100, f"{load:.0%}"[:-1]) for load, _ in points if round(load * 100) % 10 == 0], marks)
    plot.line([(claimed * 100, 0), (claimed * 100, top)], "#999", dash="2 4")
    plot.note(claimed * 100 - 0.5, top * 0.98, f"{CLAIMED / 1e3:g} kbit/s", anchor="end")
    for number, kind in enumerate(SRT):
        for (name, summaries), dash in zip(series.items(), ("", "6 4"), strict=True):
            values = []
            for load, summary in summaries:
                ours = summary.kinds[kind.name]
                value = ours.ratio * 100 if missed else ours.latency.mean / MS
                values.append((load * 100, min(value, top)))
            plot.line(values, COLOURS[number], dash=dash, dots=True)
            plot.name(f"S_{kind.name}, {name}", COLOURS[number], dash=dash)
        _, ratio, latency = EVENTS[kind.name]
        value = ratio * 100 if missed else latency
        plot.line([(points[0][0] * 100, value), (points[-1][0] * 100, value)], COLOURS[number], dash="1 3")
    plot.name("the thesis", "#555", dash="1 3")


def _share(spread: Spread) -> float:
    """Of the fullest bin, in percent."""
    return max(spread.bins.values()) * 100 / spread.count


def _bins(spread: Spread, unit: int) -> list[tuple[float, float]]:
    """All bins from the first to the last: (left end in units, percent)."""
    span = range(min(spread.bins), max(spread.bins) + 1)
    return [(number * spread.width / unit, spread.bins[number] * 100 / spread.count) for number in span]


def _scale(highest: float) -> list[float]:
    """A few round values up to this one."""
    step = next(each for each in (0.5, 1, 2, 5, 10, 20, 50) if highest / each <= 6)
    return [step * number for number in range(int(highest / step) + 1)]
