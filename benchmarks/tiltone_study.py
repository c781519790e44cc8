"""What a network costs tiltOne: tilt, torque and age of its motors' input, over RTCAN, zenoh and TCP, in virtual time.

    python -m benchmarks.tiltone_study [--seeds 3] [--duration 2] [--loads 0 60 ...] [--jobs 1] [--figures DIRECTORY]

The output is Markdown: what docs/robots/tiltone-study.md shows is a run of this with its defaults, and each run prints
the same. `benchmarks.tiltone.delays` recorded the delays of zenoh and TCP.
"""

import argparse
import logging
import math
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import msgspec

from benchmarks.thesis.svg import COLOURS, Plot
from benchmarks.tiltone import delays
from benchmarks.tiltone.runs import PLANTS, Outcome, Scenario, one
from r2p.sim.robots.shared_nodes import Traffic

LOADS = (0, 60, 90, 95)
"""Percent of the slots that nobody reserved."""
CONSTANT = (0, 10, 15, 20, 40, 60, 80)
"""Delays of all messages, ms."""
CLASSES: tuple[Traffic, ...] = ("hrt", "srt", "nrt")
STATES = ("quiet", "busy")

_TINY = 0.01  # the lower end of logarithmic axes, deg


class Row(msgspec.Struct, frozen=True):
    """A scenario's outcomes, one for each seed."""

    scenario: Scenario
    outcomes: list[Outcome]

    @property
    def tilts(self) -> list[float]:
        """Root mean squares of the tilt, deg; without those of robots that fell."""
        return sorted(each.tilt for each in self.outcomes if not math.isnan(each.tilt))

    @property
    def tilt(self) -> float:
        """Mean over the seeds, deg; NaN if one of the robots fell."""
        return sum(each.tilt for each in self.outcomes) / len(self.outcomes)

    @property
    def torque(self) -> float:
        """Mean over the seeds, Nm."""
        return sum(each.torque for each in self.outcomes) / len(self.outcomes)

    def ages(self) -> tuple[float, float, float]:
        """Return mean, 99th percentile and maximum of the age of the input, ms."""
        ages = sorted(age for each in self.outcomes for age in each.ages)
        return sum(ages) / len(ages) / 1000, ages[math.ceil(0.99 * len(ages)) - 1] / 1000, ages[-1] / 1000

    def cells(self) -> str:
        """Return tilt and torque as cells of a table."""
        fell = len(self.outcomes) - len(self.tilts)
        if fell:
            return f"{fell} of {len(self.outcomes)} fell | "
        low, high = self.tilts[0], self.tilts[-1]
        return f"{_digits(self.tilt)} ({_digits(low)} to {_digits(high)}) | {_digits(self.torque)}"


class Study:
    """Runs scenarios, each with all seeds."""

    def __init__(self, pool: ProcessPoolExecutor, seeds: int, duration: float) -> None:
        self._pool = pool
        self._seeds = range(1, seeds + 1)
        self._duration = duration

    def rows(self, scenarios: Sequence[Scenario]) -> list[Row]:
        """Return what comes of them, in this order."""
        runs = [
            msgspec.structs.replace(scenario, seed=seed, duration=self._duration)
            for scenario in scenarios
            for seed in self._seeds
        ]
        outcomes = list(self._pool.map(one, runs))
        count = len(self._seeds)
        return [
            Row(scenario, outcomes[index * count : (index + 1) * count]) for index, scenario in enumerate(scenarios)
        ]


def networks(plant: str, loads: Sequence[int]) -> list[Scenario]:
    """Return the scenarios of a table: no network at all, the bus by class and load, and the recorded links."""
    bus = [Scenario(plant=plant, traffic=traffic, load=load / 100) for traffic in CLASSES for load in loads]
    links = [
        Scenario(plant=plant, network=f"{transport} {state}", traffic="nrt")
        for transport in delays.LISTEN
        for state in STATES
    ]
    return [Scenario(plant=plant, network="memory", traffic="nrt"), *bus, *links]


def table(rows: Sequence[Row]) -> Iterator[str]:
    """All networks of one plant."""
    yield "| network | slots used % | tilt RMS deg | torque RMS Nm | age mean ms | p99 | max |"
    yield "| --- | ---: | ---: | ---: | ---: | ---: | ---: |"
    for row in rows:
        ages = " | ".join(f"{each:.1f}" for each in row.ages())
        used = sum(each.load for each in row.outcomes) / len(row.outcomes)
        yield f"| {_name(row.scenario)} | {f'{used:.0%}'[:-1] if used else ''} | {row.cells()} | {ages} |"


def constant(study: Study) -> Iterator[str]:
    """The same delay for each message, for all plants."""
    plants = {
        plant: study.rows(
            [Scenario(plant=plant, network="memory", traffic="nrt", delay=delay / 1000) for delay in CONSTANT]
        )
        for plant in PLANTS
    }
    yield "| delay ms |" + "".join(f" {plant}: tilt RMS deg | torque RMS Nm |" for plant in plants)
    yield "| ---: |" + " ---: | ---: |" * len(plants)
    for index, delay in enumerate(CONSTANT):
        yield f"| {delay} | " + " | ".join(rows[index].cells() for rows in plants.values()) + " |"


def report(study: Study, loads: Sequence[int], directory: Path | None) -> Iterator[str]:
    """All tables, and the figures."""
    results = {}
    for plant in PLANTS:
        results[plant] = study.rows(networks(plant, loads))
        yield f"{plant}:\n"
        yield from table(results[plant])
        yield ""
    yield "The same delay for each message:\n"
    yield from constant(study)
    if directory is not None:
        directory.mkdir(parents=True, exist_ok=True)
        draw_ages(results["geared"], directory / "ages.svg")
        draw_tilts(results, directory / "tilts.svg")


def draw_ages(rows: Sequence[Row], path: Path) -> None:
    """The age of the input against the load, on a logarithmic scale."""
    labels = ("load of the unreserved slots, %", "age of the motors' input, ms")
    plot = Plot(
        "tiltOne: age of the input at the motors' control steps", (0, 100), (0.5, 2.5), labels=labels, legend=0.1
    )
    plot.ticks([(load, str(load)) for load in range(0, 101, 20)], [(math.log10(age), str(age)) for age in _MARKS])
    for traffic, colour in zip(CLASSES, COLOURS, strict=False):
        chosen = [row for row in rows if row.scenario.network == "bus" and row.scenario.traffic == traffic]
        for number, (name, dash) in enumerate((("mean", ""), ("p99", "5 3"), ("max", "1 3"))):
            points = [(100 * row.scenario.load, math.log10(row.ages()[number])) for row in chosen]
            plot.line(points, colour, dash=dash, dots=True)
            plot.name(f"{traffic.upper()}, {name}", colour, dash=dash)
    plot.write(path)


_MARKS = (5, 10, 20, 50, 100, 200)


def draw_tilts(results: dict[str, list[Row]], path: Path) -> None:
    """The tilt against the load, on a logarithmic scale."""
    labels = ("load of the unreserved slots, %", "RMS of the tilt, deg")
    plot = Plot("Tilt over RTCAN, mean over the seeds", (0, 100), (-2, math.log10(1.2)), labels=labels, legend=0.1)
    marks = (_TINY, 0.02, 0.05, 0.1, 0.2, 0.5, 1)
    plot.ticks([(load, str(load)) for load in range(0, 101, 20)], [(math.log10(each), f"{each:g}") for each in marks])
    for (plant, rows), colour in zip(results.items(), COLOURS, strict=False):
        for traffic, dash in zip(CLASSES, ("", "5 3", "1 3"), strict=True):
            chosen = [row for row in rows if row.scenario.network == "bus" and row.scenario.traffic == traffic]
            points = [(100 * row.scenario.load, math.log10(row.tilt)) for row in chosen if not math.isnan(row.tilt)]
            plot.line(points, colour, dash=dash, dots=True)
            plot.name(f"{plant}, {traffic.upper()}", colour, dash=dash)
    plot.write(path)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description="What a network costs a robot that balances, in virtual time")
    parser.add_argument("--seeds", type=int, default=3, help="how many runs of each scenario")
    parser.add_argument("--duration", type=float, default=2.0, help="measured seconds of each run")
    parser.add_argument("--loads", type=int, nargs="+", default=LOADS, help="in percent of the unreserved slots")
    parser.add_argument("--jobs", type=int, default=1, help="runs at the same time")
    parser.add_argument("--figures", type=Path, help="a directory to write the figures to")
    options = parser.parse_args(arguments)
    with ProcessPoolExecutor(options.jobs, initializer=_quiet) as pool:
        for line in report(Study(pool, options.seeds, options.duration), options.loads, options.figures):
            print(line, flush=True)


def _quiet() -> None:
    """Log nothing: a full bus makes modules complain."""
    logging.disable(logging.CRITICAL)


def _name(scenario: Scenario) -> str:
    if scenario.network == "bus":
        return f"{scenario.traffic.upper()}, {scenario.load:.0%}"
    return "none: no delay" if scenario.network == "memory" else scenario.network.replace(" ", ", ")


def _digits(value: float) -> str:
    """Return three digits at least, as far as they are before the point."""
    return f"{value:.4f}" if value < 0.1 else f"{value:.3f}" if value < 1 else f"{value:.2f}"


if __name__ == "__main__":
    main()
