"""How far network time and its translation to UTC are off, and how far they are said to be off.

    python -m benchmarks.synchronisation          # prints the tables of docs/time-and-failures.md
    python -m benchmarks.synchronisation --write  # and writes them there, with the picture and results

Modules on the exact simulated bus, in virtual time, whose clocks drift; interrupts are served after 4 us plus or minus
a jitter, uniformly distributed. The truth is the clock of the master that is in office, or that was the last one, and
the clock of the simulation is UTC. No module knows either.
"""

from __future__ import annotations

import argparse
import asyncio
import functools
import logging
import random
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING

import msgspec

import r2p
from benchmarks import time_page
from r2p import sim
from r2p.protocols.rtcan.master import Role
from r2p.sim.transport import SimPort
from r2p.transports.rtcan.link import RtcanLink
from r2p.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Sequence

    from r2p.sim.transport import SimCan

LATENCY = 4_000
SEEDS = (1, 2, 3)
SECONDS = 6.0
"""Of each run, from the first network time on."""
_STEP = 0.004  # s between two looks at all clocks, in the mean
_REPORT = 0.025  # s between two messages that are translated
_OFFICE = 2.0  # s after which the master is killed, where it changes
_AWAY = 1.0  # s that it is off then
_BULK = 0.0005  # s between two messages that load the bus: 2000 a second, and the bus has 6000 slots
_LAN = "memory:lan?delay=0.003"


class SyncCase(msgspec.Struct, frozen=True):
    """A network: drift is up to `ppm` either way, `jitter` in ns, `loss` the share of lost frames."""

    text: str
    nodes: int = 5
    ppm: float = 100.0
    jitter: int = 3_000
    loss: float = 0.0
    changes: bool = False
    loaded: bool = False

    def bound(self, since: int) -> int:
        """Return how far network time can be off by the documented rule, `since` ns after the last sync."""
        return 2 * self.jitter + 1 + round(2e-6 * self.ppm * since)


class ErrorFigures(msgspec.Struct, frozen=True):
    """True and claimed errors of samples, in us."""

    samples: int
    median: float
    most_of_99: float
    largest: float
    claimed_median: float
    claimed_largest: float
    broken: int
    """Samples whose true error is larger than the claimed one."""
    worst_excess: float
    """... and by how much at most."""


class SyncOutcome(msgspec.Struct, frozen=True):
    """What was found of one case, in all its runs."""

    case: SyncCase
    network_time: ErrorFigures
    utc: ErrorFigures
    unknown: float
    """Share of the samples in which a module had no network time."""
    masters: int
    """Changes of the master."""


class TrueTime:
    """Network time by the master's clock, at instants of true time."""

    def __init__(self) -> None:
        self.changes = 0
        self.master: str | None = None
        self._last: tuple[int, int, float] | None = None  # true time, network time, rate

    def update(self, now: int, links: dict[str, RtcanLink]) -> None:
        """Look which module is the master."""
        masters = [name for name, link in links.items() if link.engine.election.role is Role.MASTER]
        time = links[masters[0]].network_time() if len(masters) == 1 else None
        if time is None:
            return
        port = links[masters[0]].driver.port
        assert isinstance(port, SimPort)
        if masters[0] != self.master:
            self.changes += self.master is not None
            self.master = masters[0]
        self._last = now, time, 1.0 + port.controller.node.drift_ppm * 1e-6

    def at(self, now: int) -> int | None:
        """Return network time at an instant; while there is no master, the last one's clock counts."""
        if self._last is None:
            return None
        at, time, rate = self._last
        return time + round((now - at) * rate)


class ErrorSamples:
    """Pairs of a true and a claimed error (ns)."""

    def __init__(self) -> None:
        self.pairs: list[tuple[int, int]] = []

    def figures(self) -> ErrorFigures:
        """Return quantiles."""
        true, claimed = (sorted(each) for each in zip(*self.pairs, strict=True))
        over = [error - claim for error, claim in self.pairs if error > claim]
        count = len(true)
        return ErrorFigures(
            count,
            true[count // 2] / 1000,
            true[count * 99 // 100] / 1000,
            true[-1] / 1000,
            claimed[count // 2] / 1000,
            claimed[-1] / 1000,
            len(over),
            max(over, default=0) / 1000,
        )


class SyncNetwork:
    """The modules of one run, and what was sampled."""

    def __init__(self, can: SimCan, case: SyncCase, seed: int) -> None:
        self.can = can
        self.case = case
        self.numbers = random.Random(f"synchronisation/{seed}/{case.text}")
        self.modules: dict[str, r2p.Module] = {}
        self.true = TrueTime()
        self.times = ErrorSamples()
        self.utc = ErrorSamples()
        self.unknown = 0
        self.sent: list[tuple[int, int]] = []
        """True UTC and true network time of each message."""

    @property
    def now(self) -> int:
        return self.can.bus.timeline.now()

    @property
    def links(self) -> dict[str, RtcanLink]:
        found = ((name, link) for name, module in self.modules.items() for link in module.links)
        return {name: link for name, link in found if isinstance(link, RtcanLink)}

    def sample(self) -> None:
        """Compare all modules' network time with the truth."""
        self.true.update(self.now, self.links)
        true = self.true.at(self.now)
        for name, link in self.links.items():
            time, cycle = link.network_time(), link.engine.cycle
            if time is None or true is None:
                self.unknown += self.can.port(name).controller.live
            elif name != self.true.master:
                since = link.driver.now() - cycle.reference + cycle.missed * cycle.timing.cycle
                self.times.pairs.append((abs(time - true), self.case.bound(since)))

    async def report(self, node: r2p.Node) -> None:
        """Publish the numbers of instants, whose network time is noted here."""
        publisher = node.advertise("instants", r2p.Timestamp, r2p.Sporadic(deadline=0.05))
        async for _ in node.every(_REPORT):
            self.true.update(self.now, self.links)
            true = self.true.at(self.now)
            if true is not None:
                self.sent.append((node.now(), true))
                await publisher.publish(r2p.Timestamp.from_ns(len(self.sent) - 1))

    async def translate(self, node: r2p.Node) -> None:
        """On the PC: compare the translation of each message with the truth."""
        async for found in node.subscribe("instants", r2p.Timestamp, queue=100).samples():
            if found.clock is not None:
                utc, time = self.sent[found.message.ns]
                self.utc.pairs.append((abs(found.clock.utc(time) - utc), found.clock.error))

    async def fill(self, node: r2p.Node) -> None:
        """Use a third of the slots."""
        publisher = node.advertise("bulk", r2p.Timestamp)
        async for _ in node.every(_BULK):
            await publisher.publish(r2p.Timestamp.from_ns(0))

    async def ignore(self, node: r2p.Node) -> None:
        """Subscribe to that."""
        async for _ in node.subscribe("bulk", r2p.Timestamp):
            pass


def simulate(case: SyncCase, seeds: Sequence[int] = SEEDS, seconds: float = SECONDS) -> SyncOutcome:
    """Run a case with these seeds."""
    runs = [sim.run(functools.partial(_simulate, case, seed, seconds), seed=seed) for seed in seeds]
    times, utc = ErrorSamples(), ErrorSamples()
    for each in runs:
        times.pairs += each.times.pairs
        utc.pairs += each.utc.pairs
    unknown = sum(each.unknown for each in runs)
    share = unknown / (unknown + len(times.pairs))
    return SyncOutcome(case, times.figures(), utc.figures(), share, sum(each.true.changes for each in runs))


async def _simulate(case: SyncCase, seed: int, seconds: float) -> SyncNetwork:
    net = SyncNetwork(sim.can_bus("sync", seed=seed), case, seed)
    async with AsyncExitStack() as stack:
        gateway = await stack.enter_async_context(r2p.Module("GW", via=[_via(net, 0), _LAN], bridge=True))
        net.modules["GW"] = gateway
        for number in range(1, case.nodes):
            name = f"M{number}"
            net.modules[name] = await stack.enter_async_context(r2p.Module(name, via=_via(net, number), watchdog=False))
        pc = await stack.enter_async_context(r2p.Module("PC", via=_LAN))
        net.modules["M1"].start(net.report)
        pc.start(net.translate)
        if case.loaded:
            net.modules["M1"].start(net.fill)
            net.modules["GW"].start(net.ignore)
        await _run(net, seconds)
    return net


def _via(net: SyncNetwork, number: int) -> str:
    """Return the URL of a module; the gateway, of the least priority, and M1 are not killed."""
    case, numbers = net.case, net.numbers
    drift, offset = numbers.uniform(-case.ppm, case.ppm), numbers.uniform(0.0, 1.0)
    url = f"sim:sync,drift={drift},offset={offset}s,latency={LATENCY}ns,jitter={case.jitter}ns"
    return f"{url},priority={min(200, 1 + number)}" + (f",loss={case.loss}" if case.loss else "")


async def _run(net: SyncNetwork, seconds: float) -> None:
    while net.true.at(net.now) is None:
        await asyncio.sleep(_STEP)
        net.true.update(net.now, net.links)
    end = net.now + round(seconds * SECOND)
    killer = asyncio.create_task(_kill_masters(net)) if net.case.changes else None
    while net.now < end:
        await asyncio.sleep(net.numbers.uniform(0.0, 2 * _STEP))
        net.sample()
    if killer is not None:
        killer.cancel()


async def _kill_masters(net: SyncNetwork) -> None:
    """Cut the power of the master, again and again, and restore it."""
    while True:
        await asyncio.sleep(_OFFICE - _AWAY + net.numbers.random() * 0.1)
        name = net.true.master
        if name in (None, "GW", "M1"):
            continue
        net.can.port(name).power_off()
        await asyncio.sleep(_AWAY)
        net.can.port(name).power_on()


CASES = (
    *(SyncCase(f"{nodes} nodes", nodes=nodes) for nodes in (2, 3, 5, 10, 20)),
    SyncCase("clocks alike", ppm=0.0),
    SyncCase("±20 ppm", ppm=20.0),
    SyncCase("no jitter", jitter=0),
    SyncCase("jitter ±1 µs", jitter=1_000),
    SyncCase("10 % of frames lost", loss=0.1),
    SyncCase("30 % of frames lost", loss=0.3),
    SyncCase("2000 messages a second", loaded=True),
    SyncCase("masters killed", changes=True),
    SyncCase("masters killed, 10 % lost, 2000 messages", changes=True, loss=0.1, loaded=True),
)
"""Where nothing else is said: 5 nodes, up to 100 ppm either way, jitter of 3 us either way."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the tables in Markdown, and write the page if asked to."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.synchronisation", description=__doc__)
    parser.add_argument("--seeds", type=int, default=len(SEEDS), help="how many runs of each")
    parser.add_argument("--write", action="store_true", help="write the results, the tables and the picture")
    options = parser.parse_args(arguments)
    logging.disable()
    outcomes = [simulate(case, SEEDS[: options.seeds]) for case in CASES]
    time_page.show(time_page.sync_tables(outcomes))
    if options.write:
        time_page.write_synchronisation(outcomes)


if __name__ == "__main__":
    main()
