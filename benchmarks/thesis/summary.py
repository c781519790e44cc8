"""What is kept of a scenario, over all seeds: enough for the tables and figures, small however long the runs were."""

import math
from collections import Counter
from collections.abc import Iterable

import msgspec

from benchmarks.thesis.network import MS, SRT, Outcome

ERROR_BIN = 250  # ns
LATENCY_BIN = MS // 2


class Spread(msgspec.Struct):
    """How values are spread; `bins` counts them by value // `width`."""

    width: int
    count: int = 0
    total: int = 0
    squares: int = 0
    least: int = 1 << 62
    most: int = -(1 << 62)
    bins: Counter[int] = msgspec.field(default_factory=Counter)

    def add(self, values: Iterable[int]) -> None:
        """Count these."""
        values = list(values)
        if not values:
            return
        self.count += len(values)
        self.total += sum(values)
        self.squares += sum(value * value for value in values)
        self.least = min(self.least, *values)
        self.most = max(self.most, *values)
        self.bins.update(value // self.width for value in values)

    def merge(self, other: "Spread") -> None:
        """Count what another one has counted."""
        self.count += other.count
        self.total += other.total
        self.squares += other.squares
        self.least, self.most = min(self.least, other.least), max(self.most, other.most)
        self.bins.update(other.bins)

    @property
    def mean(self) -> float:
        return self.total / self.count if self.count else float("nan")

    @property
    def deviation(self) -> float:
        """The standard deviation."""
        if not self.count:
            return float("nan")
        return math.sqrt(self.squares * self.count - self.total * self.total) / self.count


class Kind(msgspec.Struct):
    """Events of one kind."""

    count: int = 0
    missed: int = 0
    latency: Spread = msgspec.field(default_factory=lambda: Spread(LATENCY_BIN))

    @property
    def ratio(self) -> float:
        """The share that missed its deadline."""
        return self.missed / self.count if self.count else float("nan")


class Summary(msgspec.Struct):
    """One scenario with several seeds.

    `periods` is by message: the time from one frame to the next, in ns; `errors` by node: the start of frame against
    the master's grid; `hrt_missed`: occurrences without a frame in their slot; `busy`: the share of time in which the
    bus was occupied; `throughput`: payload carried, in bit/s; `owners`: to whom a slot belongs.
    """

    periods: dict[str, Spread] = {}
    errors: dict[str, Spread] = {}
    hrt_missed: int = 0
    kinds: dict[str, Kind] = {}
    busy: float = 0.0
    throughput: float = 0.0
    simulated: float = 0.0
    seeds: int = 0
    owners: dict[int, tuple[str, str]] = {}

    def merge(self, other: "Summary") -> None:
        """Add another one's seeds."""
        for mine, more in ((self.periods, other.periods), (self.errors, other.errors)):
            for name, spread in more.items():
                mine.setdefault(name, Spread(spread.width)).merge(spread)
        for name, kind in other.kinds.items():
            into = self.kinds.setdefault(name, Kind())
            into.count += kind.count
            into.missed += kind.missed
            into.latency.merge(kind.latency)
        seeds = self.seeds + other.seeds
        self.busy = (self.busy * self.seeds + other.busy * other.seeds) / seeds
        self.throughput = (self.throughput * self.seeds + other.throughput * other.seeds) / seeds
        self.hrt_missed += other.hrt_missed
        self.simulated += other.simulated
        self.seeds = seeds
        self.owners = self.owners or other.owners

    @property
    def event_traffic(self) -> float:
        """Events that were to be sent, in bit/s of payload."""
        return sum(8 * kind.size * self.kinds[kind.name].count for kind in SRT) / self.simulated


def summarise(outcome: Outcome) -> Summary:
    """Of one seed."""
    duration = outcome.scenario.duration
    summary = Summary(
        busy=outcome.busy,
        throughput=outcome.payload / duration,
        simulated=duration,
        seeds=1,
        owners=outcome.owners,
        hrt_missed=outcome.strays,
    )
    for (node, message), track in outcome.hrt.items():
        summary.periods.setdefault(message, Spread(ERROR_BIN)).add(track.periods)
        summary.errors.setdefault(node, Spread(ERROR_BIN)).add(track.errors)
        summary.hrt_missed += track.missed(outcome.scenario)
    for name, events in outcome.srt.items():
        kind = summary.kinds[name] = Kind(events.count, events.missed)
        kind.latency.add(events.latencies)
    return summary
