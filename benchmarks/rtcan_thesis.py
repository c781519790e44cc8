"""The thesis's benchmark of RTCAN (section 4.4) in virtual time, its tables and figures.

    python -m benchmarks.rtcan_thesis [--seeds 10] [--duration 60] [--loads 0 60 ...] [--sweep 60] [--jobs 1] \
        [--figures DIRECTORY]

Three nodes and a listener on a simulated bus of 1 Mbit/s, cycles of 60 slots of 166 us, one-shot controllers. The
output is Markdown: what docs/rtcan-benchmark.md shows is a run of this with its defaults.
"""

import argparse
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from benchmarks.thesis import figures, schedulers, tables
from benchmarks.thesis.network import BITS_EACH, NODES, SLOTS_EACH, TIMING, Scenario, simulated
from benchmarks.thesis.summary import Summary, summarise

LOADS = (0, 60, 70, 80, 90, 95, 100, 110, 120, 130)
"""Percent of the free slots."""
AT = 0.95
"""The load of the tables."""
CLAIMED = tables.CLAIMED / BITS_EACH * SLOTS_EACH / Scenario().free
"""The load that the thesis names, as a share of the free slots."""


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description="The thesis's benchmark of RTCAN, in virtual time")
    parser.add_argument("--seeds", type=int, default=10, help="how many runs of each scenario")
    parser.add_argument("--duration", type=float, default=60.0, help="simulated seconds of each run")
    parser.add_argument(
        "--loads", type=int, nargs="+", default=LOADS, help="of the sweep, in percent of the free slots"
    )
    parser.add_argument(
        "--sweep", type=float, help="simulated seconds of runs with other loads than that of the tables"
    )
    parser.add_argument("--jobs", type=int, default=1, help="runs at the same time")
    parser.add_argument("--figures", type=Path, help="a directory to write the figures to")
    options = parser.parse_args(arguments)
    began = time.perf_counter()
    with ProcessPoolExecutor(options.jobs) as pool:
        runs = Runs(pool, options.seeds, options.duration, options.sweep or options.duration)
        loads = {load / 100 for load in options.loads} | {AT, CLAIMED}
        for line in report(runs, sorted(loads), options.figures):
            print(line, flush=True)
    took = time.perf_counter() - began
    print(f"\n{runs.simulated:.0f} s of the network were simulated in {took:.0f} s.")


class Runs:
    """Runs scenarios, each with all seeds and only once."""

    def __init__(self, pool: ProcessPoolExecutor, seeds: int, duration: float, sweep: float) -> None:
        self.seeds = seeds
        self.duration = duration
        self.sweep = sweep
        self.simulated = 0.0
        self._pool = pool

    def of(self, *, load: float, drop: bool = True, jitter: int = 3_000) -> Summary:
        """What came of it, over all seeds."""
        duration = self.duration if load == AT else self.sweep
        scenarios = [
            Scenario(seed=seed, duration=duration, load=load, drop=drop, jitter=jitter)
            for seed in range(1, self.seeds + 1)
        ]
        total = Summary()
        for summary in self._pool.map(one, scenarios):
            total.merge(summary)
        self.simulated += total.simulated
        return total


def one(scenario: Scenario) -> Summary:
    """One run."""
    return summarise(simulated(scenario))


def report(runs: Runs, loads: Sequence[float], directory: Path | None) -> Iterator[str]:
    """All tables, and the figures."""
    times = f"{runs.duration:g} s each, of other loads than {AT:.0%} {runs.sweep:g} s"
    yield f"{runs.seeds} seeds, {times}; {len(NODES)} nodes, {TIMING.slots} slots of 166 us\n"
    dropping = {load: runs.of(load=load) for load in loads}
    keeping = {load: runs.of(load=load, drop=False) for load in loads if load}
    still = runs.of(load=AT, jitter=0)
    yield f"Table 4.2, events at {AT:.0%} of the free slots, overdue ones dropped:\n"
    yield from tables.periods(dropping[AT], still)
    yield "\nTable 4.3:\n"
    columns = [
        (f"{AT:.0%}, dropped", dropping[AT]),
        (f"{AT:.0%}, none dropped", keeping[AT]),
        (f"{CLAIMED:.0%}, dropped", dropping[CLAIMED]),
        (f"{AT:.0%}, dropped, no jitter", still),
    ]
    yield from tables.events(columns)
    yield "\nThe overdue are dropped:\n"
    yield from tables.sweep(list(dropping.items()))
    yield "\nNothing is dropped:\n"
    yield from tables.sweep(list(keeping.items()))
    if directory is not None:
        directory.mkdir(parents=True, exist_ok=True)
        draw(dropping, keeping, still, directory)


def draw(dropping: dict[float, Summary], keeping: dict[float, Summary], still: Summary, directory: Path) -> None:
    """All figures; the summaries are by load."""
    schedulers.draw(directory / "figure-4-11.svg")
    figures.calendar(dropping[AT], directory / "figure-4-12.svg")
    figures.jitter(dropping[AT], still, directory / "figure-4-13.svg")
    figures.latencies(dropping[AT], directory / "figure-4-14.svg")
    series = {
        "dropped": [point for point in dropping.items() if point[0]],
        "none dropped": list(keeping.items()),
    }
    figures.sweep(series, CLAIMED, directory / "misses.svg", directory / "latencies.svg")


if __name__ == "__main__":
    main()
