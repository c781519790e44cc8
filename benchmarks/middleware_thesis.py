"""The thesis's benchmarks of the middleware (section 5.4): its tables 5.1 and 5.4, and figure 5.3.

    python -m benchmarks.middleware_thesis [--messages 1000] [--burst 100000] [--figure FILE]

One publisher and many subscribers in one module, on uvloop; remote subscribers are modules on a simulated CAN bus of
1 Mbit/s. What the wire takes is exact, under virtual time; what Python takes is measured. The output is Markdown.
"""

import argparse
import asyncio
import gc
import logging
import time
import tracemalloc
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import r2p
from benchmarks.delivery import MESSAGE, Pair
from benchmarks.loops import run_on
from benchmarks.table import percentile
from benchmarks.thesis.svg import COLOURS, Plot
from r2p import sim

LOW = (0, 2, 5, 20)
"""Low-priority subscribers in table 5.4."""
PERIOD = 0.01  # s
LEAD = 0.0001  # s before its slot at which a message is asked for; the engine has it one slot (166 us) ahead
SLOW = (0.1, 1.0)  # s that low-priority subscribers take for a message: half of them the one, half the other
READY = (1, 2, 3, 5, 10, 15, 20)
"""Subscribers in figure 5.3."""
MADE = 200
"""Objects of a kind whose memory is measured."""
BUS_SECONDS = 0.5

THESIS_MEMORY = {"node": 36, "topic": 56, "publisher": 16, "subscriber": 48}  # bytes, table 5.1
THESIS_LATENCY = {0: (6.6, 114.6), 2: (7.4, 117.4), 5: (10.2, 120.2), 20: (23.5, 133.5)}  # us, table 5.4
THESIS_JITTER = {0: (0.5, 3.2), 2: (2.1, 4.8), 5: (4.2, 6.1), 20: (16.2, 18.9)}  # us, table 5.4
THESIS_MOST = 86.6  # thousand messages a second, section 5.4.2
THESIS_BUS = 384  # kbit/s of payload, section 5.4.2


class Latency(NamedTuple):
    """What a subscriber waited, in us."""

    p50: float
    p1: float
    p99: float

    @property
    def jitter(self) -> float:
        """Half of the range that 98 % of the messages are in."""
        return (self.p99 - self.p1) / 2


def latency(seconds: Sequence[float]) -> Latency:
    return Latency(*(percentile(seconds, percent) * 1e6 for percent in (50, 1, 99)))


async def local(messages: int, low: int) -> list[float]:
    """Seconds to a high-priority subscriber of a 100 Hz topic, beside `low` slow ones in the same module."""
    async with r2p.Module("BENCH", via=[], watchdog=False) as module:
        return await _delivered(module, module, messages, low, time.perf_counter)


async def remote(messages: int, low: int, now: Callable[[], float]) -> list[float]:
    """The same to a subscriber in another module on a simulated bus; the topic has a slot in each period.

    From the instant at which the slot asks for the message, `lead` before its frame starts, to the subscriber's next
    line.
    """
    async with (
        r2p.Module("PC1", via="sim:bench", watchdog=False) as publishing,
        r2p.Module("PC2", via="sim:bench", watchdog=False) as subscribing,
    ):
        return await _delivered(publishing, subscribing, messages, low, now)


async def _delivered(
    publishing: r2p.Module, subscribing: r2p.Module, messages: int, low: int, now: Callable[[], float]
) -> list[float]:
    at = 0.0
    durations: list[float] = []
    ended = asyncio.Event()

    def fill() -> Pair:
        nonlocal at
        at = now()
        return MESSAGE

    async def high(node: r2p.Node) -> None:
        async for _ in node.subscribe("pairs", Pair):
            durations.append(now() - at)
            if len(durations) == messages:
                ended.set()

    async def slow(node: r2p.Node, seconds: float) -> None:
        async for _ in node.subscribe("pairs", Pair, queue=5, lossy=True):
            await asyncio.sleep(seconds)

    async def produce(node: r2p.Node) -> None:
        await node.advertise("pairs", Pair, r2p.Periodic(period=PERIOD, fill=fill, lead=LEAD)).ready()
        await asyncio.Event().wait()

    subscribing.start(high, priority=10)
    for index in range(low):
        publishing.start(slow, SLOW[index % 2], name=f"slow{index}")
    publishing.start(produce)
    await ended.wait()
    return durations


class Burst(NamedTuple):
    """What one publisher reached whose subscribers are always ready."""

    rate: float
    """Messages a second."""
    latency: Latency


async def burst(messages: int, subscribers: int) -> Burst:
    """Publish as fast as all subscribers take it, as for figure 5.3."""
    durations: list[float] = []
    at = began = 0.0
    arrived = asyncio.Event()
    left = 0

    async def consume(node: r2p.Node) -> None:
        nonlocal left
        async for _ in node.subscribe("pairs", Pair):
            durations.append(time.perf_counter() - at)
            left -= 1
            if not left:
                arrived.set()

    async def produce(node: r2p.Node) -> None:
        nonlocal at, began, left
        publisher = node.advertise("pairs", Pair)
        began = time.perf_counter()
        for _ in range(messages):
            left = subscribers
            arrived.clear()
            at = time.perf_counter()
            await publisher.publish(MESSAGE)
            await arrived.wait()
        ended.set()

    ended = asyncio.Event()
    async with r2p.Module("BENCH", via=[], watchdog=False) as module:
        for index in range(subscribers):
            module.start(consume, name=f"sub{index}")
        await asyncio.sleep(0)
        module.start(produce)
        await ended.wait()
        rate = messages / (time.perf_counter() - began)
    return Burst(rate, latency(durations))


async def on_the_bus() -> float:
    """kbit/s of payload from one publisher that never pauses to a subscriber on the bus, under virtual time."""
    count = 0

    async def consume(node: r2p.Node) -> None:
        nonlocal count
        async for _ in node.subscribe("pairs", Pair):
            count += 1

    async def produce(node: r2p.Node) -> None:
        publisher = node.advertise("pairs", Pair)
        await publisher.wait_subscriber()
        started.set()
        while not ended:  # without a subscriber nothing would make it wait, and virtual time would stand still
            await publisher.publish(MESSAGE)

    started, ended = asyncio.Event(), False
    async with r2p.Module("PC1", via="sim:bench") as left, r2p.Module("PC2", via="sim:bench") as right:
        right.start(consume)
        left.start(produce)
        await started.wait()
        await asyncio.sleep(1)
        before = count
        await asyncio.sleep(BUS_SECONDS)
        ended = True
        return (count - before) * 64 / BUS_SECONDS / 1000


async def memory() -> dict[str, float]:
    """Bytes that one more node, topic, publisher and subscriber takes, as Python's allocator counts them."""

    async def idle(node: r2p.Node) -> None:
        nodes.append(node)
        await asyncio.Event().wait()

    def grown(make: Callable[[int], Any]) -> float:
        kept = []
        gc.collect()
        before = tracemalloc.get_traced_memory()[0]
        for number in range(MADE):
            kept.append(make(number))
        gc.collect()
        held.append(kept)
        return (tracemalloc.get_traced_memory()[0] - before) / MADE

    nodes: list[r2p.Node] = []
    held: list[Any] = []
    async with r2p.Module("BENCH", via=[], watchdog=False) as module:
        module.start(idle)
        await asyncio.sleep(0)
        tracemalloc.start()
        (node,) = nodes
        first = grown(lambda number: node.advertise(f"topic{number}", Pair))
        publisher = grown(lambda number: node.advertise(f"topic{number}", Pair))
        subscriber = grown(lambda number: node.subscribe(f"topic{number}", Pair, queue=5))
        gc.collect()
        before = tracemalloc.get_traced_memory()[0]
        for number in range(MADE):
            module.start(idle, name=f"node{number}")
        await asyncio.sleep(0)
        started = (tracemalloc.get_traced_memory()[0] - before) / MADE
        tracemalloc.stop()
    return {"node": started, "topic": first - publisher, "publisher": publisher, "subscriber": subscriber}


def report(messages: int, number: int, figure: Path | None) -> Iterator[str]:
    yield "Table 5.1, bytes:\n"
    yield "| component | thesis (C++) | r2p (Python) |"
    yield "| --- | ---: | ---: |"
    for name, size in run_on("uvloop", memory()).items():
        yield f"| {name} | {THESIS_MEMORY[name]} | {size:.0f} |"
    yield f"\nTable 5.4, latency and jitter in us, {messages} messages each:\n"
    columns = ("low-priority subscribers", "thesis, local", "ours", "thesis, remote", "slot and frame alone", "ours")
    yield "| " + " | ".join(columns) + " |"
    yield "| ---: | ---: | ---: | ---: | ---: | ---: |"
    for low in LOW:
        here = latency(run_on("uvloop", local(messages, low)))
        wire = latency(sim.run(lambda low=low: remote(min(messages, 200), low, _virtual)))  # type: ignore[misc]
        there = latency(run_on("precise", remote(messages, low, time.perf_counter)))
        theirs = [f"{us:g} ±{jitter:g}" for us, jitter in zip(THESIS_LATENCY[low], THESIS_JITTER[low], strict=True)]
        cells = [theirs[0], _shown(here), theirs[1], _shown(wire), _shown(there)]
        yield f"| {low} | " + " | ".join(cells) + " |"
    yield f"\nFigure 5.3, {number} deliveries each (the thesis: {THESIS_MOST:g} k/s at most):\n"
    yield "| subscribers | messages, k/s | deliveries, k/s | p50 us | p99 us |"
    yield "| ---: | ---: | ---: | ---: | ---: |"
    bursts = {count: run_on("uvloop", burst(number // count, count)) for count in READY}
    for count, each in bursts.items():
        rate = each.rate / 1e3
        yield f"| {count} | {rate:.1f} | {rate * count:.0f} | {each.latency.p50:.1f} | {each.latency.p99:.1f} |"
    bus = sim.run(on_the_bus)
    yield f"\nPayload on the bus from one publisher that never pauses: {bus:.0f} kbit/s (the thesis: {THESIS_BUS})."
    if figure is not None:
        draw(bursts, figure)


def draw(bursts: dict[int, Burst], path: Path) -> None:
    """Figure 5.3: throughput and latency by number of subscribers."""
    most = max(each.rate for each in bursts.values()) / 1e3
    plot = Plot(
        "One publisher whose subscribers are always ready", (0, 21), (0, most * 1.15), labels=("subscribers", "")
    )
    step = 10 ** (len(str(int(most))) - 1)
    plot.ticks([(count, str(count)) for count in READY], [(y, f"{y:g}") for y in range(0, int(most * 1.15), step)])
    plot.line([(count, each.rate / 1e3) for count, each in bursts.items()], COLOURS[0], dots=True)
    plot.line([(count, each.latency.p50) for count, each in bursts.items()], COLOURS[1], dots=True)
    plot.name("thousand messages a second", COLOURS[0])
    plot.name("latency p50, us", COLOURS[1])
    plot.write(path)


def _shown(each: Latency) -> str:
    return f"{each.p50:.1f} ±{each.jitter:.1f}"


def _virtual() -> float:
    return asyncio.get_running_loop().time()


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description="The thesis's benchmarks of the middleware (section 5.4)")
    parser.add_argument("--messages", type=int, default=1000, help="of each row of table 5.4, 100 a second")
    parser.add_argument("--burst", type=int, default=100_000, help="deliveries of each point of figure 5.3")
    parser.add_argument("--figure", type=Path, help="a file for figure 5.3")
    options = parser.parse_args(arguments)
    logging.disable()
    for line in report(options.messages, options.burst, options.figure):
        print(line, flush=True)


if __name__ == "__main__":
    main()
