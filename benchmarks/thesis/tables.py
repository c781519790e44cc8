"""Tables 4.2 and 4.3 of the thesis with its values beside ours, and the sweep over the load of events, as Markdown."""

from collections.abc import Iterator, Sequence

from benchmarks.thesis.network import HRT, MS, SRT
from benchmarks.thesis.summary import Summary

PERIODS = {"A": (61136, 995.9, 0.86), "B": (12427, 4979.4, 0.93), "C": (6213, 9958.8, 1.05)}
"""Table 4.2 of the thesis: messages, mean period and its standard deviation in us."""
EVENTS = {"A": (4121, 0.0160, 4.33), "B": (1594, 0.0552, 5.13), "C": (784, 0.0521, 14.94)}
"""Table 4.3 of the thesis: messages, the share that missed its deadline, mean latency in ms."""
CLAIMED = 150_900
"""Bit/s of events in the thesis."""
THROUGHPUT = 378_000
"""The capacity in bit/s according to the thesis."""


def periods(summary: Summary, still: Summary) -> Iterator[str]:
    """Table 4.2; `still` is the run without jitter."""
    head = ("message", "thesis: period us", "deviation us", "ours: messages", "period us", "deviation us")
    yield from _head(*head, "furthest off us", "no jitter: furthest off us")
    for message in HRT:
        ours, exact = summary.periods[message.name], still.periods[message.name]
        _, mean, deviation = PERIODS[message.name]
        nominal = message.period * 166_000
        off, off_exact = (max(each.most - nominal, nominal - each.least) / 1e3 for each in (ours, exact))
        yield _row(
            f"H_{message.name}",
            f"{mean}",
            f"{deviation}",
            f"{ours.count}",
            f"{ours.mean / 1e3:.2f}",
            f"{ours.deviation / 1e3:.2f}",
            f"{off:.2f}",
            f"{off_exact:.2f}",
        )


def events(columns: Sequence[tuple[str, Summary]]) -> Iterator[str]:
    """Table 4.3, with a pair of columns for each summary."""
    yield from _head("message", *(f"{name}: missed, latency ms" for name in ("thesis", *(name for name, _ in columns))))
    for kind in SRT:
        _, ratio, latency = EVENTS[kind.name]
        cells = [f"{ratio:.2%}, {latency:.2f}"]
        for _, summary in columns:
            ours = summary.kinds[kind.name]
            cells.append(f"{ours.ratio:.2%}, {ours.latency.mean / MS:.2f}")
        yield _row(f"S_{kind.name}", *cells)


def sweep(points: Sequence[tuple[float, Summary]]) -> Iterator[str]:
    """One line for each load: misses and mean latencies, and what hard real-time noticed of it."""
    names = [f"S_{kind.name}" for kind in SRT]
    head = ("load", "events kbit/s", *(f"{name} missed" for name in names), *(f"{name} ms" for name in names))
    yield from _head(*head, "bus busy", "HRT missed", "start off, us")
    for load, summary in points:
        cells = [f"{load:.0%}", f"{summary.event_traffic / 1e3:.1f}"]
        kinds = [summary.kinds[kind.name] for kind in SRT]
        cells += [f"{kind.ratio:.2%}" if kind.count else "-" for kind in kinds]
        cells += [f"{kind.latency.mean / MS:.2f}" if kind.count else "-" for kind in kinds]
        least = min(each.least for each in summary.errors.values()) / 1e3
        most = max(each.most for each in summary.errors.values()) / 1e3
        yield _row(*cells, f"{summary.busy:.1%}", f"{summary.hrt_missed}", f"{least:+.2f} to {most:+.2f}")


def _head(*cells: str) -> Iterator[str]:
    yield _row(*cells)
    yield _row("---", *("---:" for _ in cells[1:]))


def _row(*cells: str) -> str:
    return "| " + " | ".join(cells) + " |"
