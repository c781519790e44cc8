"""Two processes, 64 bytes: r2p beside others, in turn; a stream as fast as it is taken, and there and back."""

from collections.abc import Iterator
from statistics import median
from typing import NamedTuple

from benchmarks.byte_links import WAYS, Client, Count, measure
from benchmarks.table import Row, p50_p99, rate

SIZE = 64
SECONDS = 1.0
ROUNDS = 2_000
RUNS = 3


class Figures(NamedTuple):
    """Of one run: messages a second that arrive, the share of those sent that is lost, and round trips (s)."""

    rate: float
    lost: float
    trips: list[float]


async def both(client: Client) -> Figures:
    """Stream, then ping."""
    sent, count = await client.stream(SIZE, SECONDS)
    return Figures(rate_of(count), 1 - count.messages / sent, await client.ping(SIZE, ROUNDS))


def rate_of(count: Count) -> float:
    """Messages a second."""
    return (count.messages - 1) / count.seconds if count.seconds else 0.0


def rows() -> Iterator[Row]:
    turns = [{name: measure(name, both, SIZE) for name in WAYS} for _ in range(RUNS)]
    ours = _middle([turn["r2p over zenoh"] for turn in turns])
    tcp = _middle([turn["r2p over TCP"] for turn in turns])
    for name in WAYS:
        each = _middle([turn[name] for turn in turns])
        p50, p99 = p50_p99(each.trips) if each.trips else (0.0, 0.0)
        yield Row(
            f"two processes, {SIZE} bytes: {name}",
            f"{rate(each.rate)}, {each.lost:.1%} lost; {p50:.0f} us, {p99:.0f} us there and back",
            "" if name.startswith("r2p") else f"r2p over TCP {_times(tcp, each)}; over zenoh {_times(ours, each)}",
            "",
            None,
        )


def _middle(runs: list[Figures]) -> Figures:
    """Medians: on two cores, much depends on where the kernel puts both ends."""
    return Figures(
        median(run.rate for run in runs),
        median(run.lost for run in runs),
        [trip for run in runs for trip in run.trips],
    )


def _times(ours: Figures, theirs: Figures) -> str:
    trips = f"{median(ours.trips) / median(theirs.trips):.2f}x" if ours.trips and theirs.trips else "-"
    return f"{ours.rate / max(theirs.rate, 1):.2f}x the rate, {trips} the time"
