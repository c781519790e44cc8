"""How exactly a recording is played: when a subscriber in the same process has each message of 1 kHz."""

import asyncio
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import r2p
from benchmarks.loops import FACTORIES, run_on
from benchmarks.table import Row, p50_p99
from r2p.msg import Odometry
from r2p.recording.bag import Bag
from r2p.recording.player import Player
from r2p.recording.samples import SampleWriter
from r2p.recording.writer import BagWriter
from r2p.runtime.immediate import ImmediateSubscriber
from r2p.runtime.node import Node

PERIOD = 1_000_000  # ns
MESSAGES = 5_000
GOAL = 1e-3
_START = 1_700_000_000_000_000_000


def write(path: Path) -> None:
    """Write messages of 1 kHz."""
    with path.open("wb") as file:
        writer = BagWriter(file)
        samples = SampleWriter(writer)
        for i in range(MESSAGES):
            at = _START + i * PERIOD
            sample = r2p.Sample(Odometry().encode(), r2p.Source("ROBOT", "odo", "tcp"), at, sequence=i + 1)
            samples.write("odometry", sample, Odometry, at)
        writer.finish()


async def errors(path: Path) -> list[float]:
    """Seconds by which each message of a recording is off its place among the others."""
    arrived: list[int] = []
    async with r2p.Module("BENCH", via=[], watchdog=False) as module:
        node = Node("listen", module.space)
        sink = ImmediateSubscriber(module.space, node, lambda _: arrived.append(time.monotonic_ns()))
        sink.open("odometry", None)
        with Bag(path) as bag:
            async with Player(module, bag) as player:
                await player.run()
        sink.close()
        node.close()
    assert len(arrived) == MESSAGES
    return _errors(arrived)


async def sleep_errors() -> list[float]:
    """The same of a loop that sleeps until its next absolute instant."""
    loop = asyncio.get_running_loop()
    called: list[int] = []
    start = loop.time()
    for number in range(MESSAGES):
        await asyncio.sleep(start + number * PERIOD / 1e9 - loop.time())
        called.append(time.monotonic_ns())
    return _errors(called)


def _errors(called: list[int]) -> list[float]:
    spans = sorted(at - i * PERIOD for i, at in enumerate(called))
    middle = spans[len(spans) // 2]
    return [abs(each - middle) / 1e9 for each in spans]


def rows() -> Iterator[Row]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "played.mcap"
        write(path)
        for loop in FACTORIES:
            bare, bare_worst = p50_p99(run_on(loop, sleep_errors()))
            median, worst = p50_p99(run_on(loop, errors(path)))
            yield Row(
                f"recording of 1 kHz played, error of the spacing p50, p99 ({loop})",
                f"{median:.0f}, {worst:.0f} us",
                f"asyncio.sleep in a loop: {bare:.0f}, {bare_worst:.0f} us",
                f"p99 < {GOAL * 1e6:.0f} us",
                worst < GOAL * 1e6,
            )
