"""How far apart the samples of Robocom are, by the exact clock of the simulation: a table of docs/robots/robocom.md.

    python -m benchmarks.robocom_alignment

`--seconds`: of samples, in virtual time.
"""

import argparse
import asyncio
import functools
import statistics
from collections import defaultdict
from collections.abc import Callable, Sequence

import msgspec

import r2p
import r2p.sim
from r2p.clock import clock_of
from r2p.msg import StampedEncoder
from r2p.sim.robots.robocom import nodes
from r2p.sim.robots.robocom.robot import MOTORS, InterruptLatency, Robocom

_BUS = "sim:robocom-alignment"
_SETTLED = 5.0  # s that the clocks of the modules get to know the time of the network

Take = Callable[[int], object]


class AlignmentRow(msgspec.Struct, frozen=True):
    """Differences of instants that should be one, in us: their mean, and the largest."""

    what: str
    mean: float
    most: float

    def __str__(self) -> str:
        return f"{self.what:44} {self.mean:8.1f} {self.most:8.1f}"


async def alignment(
    interrupts: InterruptLatency = InterruptLatency(),  # noqa: B008 - a frozen value
    seconds: float = 10.0,
    seed: int = 1,
) -> list[AlignmentRow]:
    """Let Robocom's modules sample for some seconds, and return how far apart their samples are.

    The first three rows are of samples in the interrupt of the sync, the fourth is of ticks by network time, the last
    one how much later than that the messages of an encoder arrive at a PC on the bus, which would stamp them then.
    """
    clock = clock_of()
    taken: dict[str, dict[str, dict[int, int]]] = defaultdict(lambda: defaultdict(dict))
    arrived: list[int] = []

    def take(way: str, module: str, time: int) -> None:
        taken[way][module][time] = clock.monotonic()

    async with Robocom(_BUS, seed=seed, interrupts=interrupts) as robot, r2p.Module("PC1", via=_BUS) as pc:
        await robot.ready()
        await asyncio.sleep(_SETTLED)
        for name in (*MOTORS, "IMU1"):
            for way, program in (("sync", _at_syncs), ("tick", _by_network_time)):
                board = robot.modules[name]
                board.start(functools.partial(program, take=functools.partial(take, way, name)), name=way)
        pc.start(functools.partial(_arrivals, took=arrived), name="arrivals")
        await asyncio.sleep(seconds)
    left, right, imu = (taken["sync"][name] for name in (*MOTORS, "IMU1"))
    return [
        _row("left and right encoder", _apart(left, right)),
        _row("encoders and IMU", _apart(left, imu)),
        _row("sample and its stamp", _off_line(left)),
        _row("left and right, ticks by network time", _apart(taken["tick"][MOTORS[0]], taken["tick"][MOTORS[1]])),
        _row("sample and its arrival at the PC", arrived),
    ]


async def _at_syncs(node: r2p.Node, take: Take) -> None:
    node.on_sync(lambda sync: take(sync.time))
    while True:
        await node.spin()


async def _by_network_time(node: r2p.Node, take: Take) -> None:
    async for tick in node.every(nodes.PERIOD, clock="network"):
        take(tick.time)


async def _arrivals(node: r2p.Node, took: list[int]) -> None:
    """Note how long after its sample a message of an encoder arrives."""
    async for encoder in node.subscribe(nodes.ENCODERS[0], StampedEncoder):
        now = node.network_time()
        if now is not None:
            took.append(now - encoder.timestamp.ns)


def _apart(one: dict[int, int], other: dict[int, int]) -> list[int]:
    """Return how far apart the samples of one time are, ns."""
    return [abs(one[time] - other[time]) for time in one if time in other]


def _off_line(taken: dict[int, int]) -> list[float]:
    """Return how far samples are off a straight line through stamps and true instants, ns.

    Its slope is the drift of the master's crystal, by which the time of the network goes; its offset is when it began.
    """
    late = [at - time for time, at in taken.items()]
    slope, offset = statistics.linear_regression(list(taken), late)
    return [abs(each - offset - slope * time) for time, each in zip(taken, late, strict=True)]


def _row(what: str, apart: Sequence[float]) -> AlignmentRow:
    return AlignmentRow(what, statistics.fmean(apart) / 1000, max(apart) / 1000)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.robocom_alignment", description=__doc__)
    parser.add_argument("--seconds", type=float, default=10.0)
    seconds = parser.parse_args().seconds
    print(f"{'us':44} {'mean':>8} {'most':>8}")
    for row in r2p.sim.run(functools.partial(alignment, seconds=seconds)):
        print(row)


if __name__ == "__main__":
    main()
