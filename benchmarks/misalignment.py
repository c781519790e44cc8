"""How far apart modules sample what they call one instant: at the sync, and at ticks by network time.

    python -m benchmarks.misalignment --modules 2 --modules 20 --seconds 60

Modules on the simulated bus, in virtual time: their clocks are off by up to 100 ppm either way, and each interrupt is
served after 4 us, plus or minus a jitter, uniformly distributed. The instants are those of true time, which no module
knows. Thesis 8.2.2 says of its encoders: stamps of 1 us resolution, accurate to +-3 us; it has no measured figure.
"""

from __future__ import annotations

import argparse
import asyncio
import random
import statistics
from contextlib import AsyncExitStack

import msgspec

import r2p
import r2p.sim
from r2p.clock import clock_of

LATENCY = 4_000
"""Ns until an interrupt is served, typically."""
PPM = 100.0
"""By which clocks are off, at most."""
PERIOD = 0.01
"""Seconds between two ticks."""
_SETTLED = 5.0  # s: the network has started, and the modules know their drift
_NS_PER_US = 1000

Instants = dict[tuple[int, int], int]
"""True instants (ns) by the epoch and network time for which they were meant."""


class Spread(msgspec.Struct, frozen=True):
    """The largest true time between two modules (us), over all instants that all modules have."""

    count: int
    mean: float
    most_of_99: float
    largest: float


def measure(modules: int, jitter: int, seconds: float, seed: int = 1) -> tuple[Spread, Spread]:
    """Return how far apart `modules` modules are at syncs, and at ticks; `jitter` is in ns."""
    syncs: list[Instants] = []
    ticks: list[Instants] = []
    r2p.sim.run(lambda: _run(modules, jitter, seconds, syncs, ticks), seed=seed)
    return _spread(syncs), _spread(ticks)


async def _run(modules: int, jitter: int, seconds: float, syncs: list[Instants], ticks: list[Instants]) -> None:
    numbers = random.Random(modules)
    async with AsyncExitStack() as stack:
        for number in range(modules):
            drift, offset = numbers.uniform(-PPM, PPM), numbers.uniform(0.0, 1.0)
            via = f"sim:lab,drift={drift},offset={offset}s,latency={LATENCY}ns,jitter={jitter}ns"
            module = await stack.enter_async_context(r2p.Module(f"M{number}", via=via))
            syncs.append({})
            ticks.append({})
            module.start(_sample, syncs[-1], ticks[-1])
        await asyncio.sleep(_SETTLED)
        for each in (*syncs, *ticks):
            each.clear()
        await asyncio.sleep(seconds)


async def _sample(node: r2p.Node, syncs: Instants, ticks: Instants) -> None:
    true = clock_of()

    def latch(sync: r2p.Sync) -> None:
        syncs[sync.epoch, sync.time] = true.monotonic()

    node.on_sync(latch)
    async for tick in node.every(PERIOD, clock="network"):
        ticks[tick.epoch, tick.time] = true.monotonic()


def _spread(instants: list[Instants]) -> Spread:
    common = set.intersection(*(set(each) for each in instants))
    apart = sorted(max(each[at] for each in instants) - min(each[at] for each in instants) for at in common)
    in_us = [each / _NS_PER_US for each in apart]
    return Spread(len(in_us), statistics.mean(in_us), in_us[len(in_us) * 99 // 100], in_us[-1])


def main() -> None:
    """Print a table in Markdown."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.misalignment", description=__doc__)
    parser.add_argument("--modules", type=int, action="append", help="how many; may be repeated")
    parser.add_argument("--jitter", type=float, action="append", help="us either way; may be repeated")
    parser.add_argument("--seconds", type=float, default=60.0, help="of virtual time")
    options = parser.parse_args()
    head = "modules", "jitter us", "syncs: mean us", "99% us", "largest us", "ticks: mean us", "99% us", "largest us"
    print(f"| {' | '.join(head)} |\n|{' ---: |' * len(head)}")
    for jitter in options.jitter or (0.5, 1.0, 3.0):
        for modules in options.modules or (2, 3, 5, 10, 20):
            found = measure(modules, round(jitter * _NS_PER_US), options.seconds)
            cells = [f"{value:.2f}" for each in found for value in (each.mean, each.most_of_99, each.largest)]
            print(f"| {modules} | ±{jitter:g} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
