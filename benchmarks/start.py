"""What it costs to be there: start-up time, and memory (thesis table 5.1)."""

import asyncio
import os
import subprocess
import sys
import time
import tracemalloc
from collections.abc import Callable, Iterator
from pathlib import Path

import r2p
from benchmarks.delivery import MESSAGE, Pair
from benchmarks.loops import run_on
from benchmarks.table import Row, typical

TOPICS = 10_000
COMMAND = str(Path(sys.executable).with_name("r2p"))


def seconds(*command: str) -> float:
    """Seconds from start to end of a process when its modules are compiled (as those of an installed package)."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}

    def once() -> float:
        started = time.perf_counter()
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, env=environment)
        return time.perf_counter() - started

    once()
    return typical(9, once)


async def bytes_of(count: int, make: Callable[[r2p.Node, int], object]) -> float:
    """Bytes of memory of one thing that `make(node, index)` makes."""

    async def measure(node: r2p.Node) -> None:
        make(node, 0)
        before = tracemalloc.get_traced_memory()[0]
        for index in range(1, count + 1):
            make(node, index)
        used.append((tracemalloc.get_traced_memory()[0] - before) / count)

    used: list[float] = []
    tracemalloc.start()
    try:
        async with r2p.Module("BENCH", via=[], watchdog=False) as module:
            module.start(measure)
            await module.wait()
    finally:
        tracemalloc.stop()
    return used[0]


async def node_bytes(count: int) -> float:
    """Bytes of memory of one node that waits."""

    async def idle(node: r2p.Node) -> None:
        await asyncio.Event().wait()

    tracemalloc.start()
    try:
        async with r2p.Module("BENCH", via=[], watchdog=False) as module:
            module.start(idle, name="n")
            before = tracemalloc.get_traced_memory()[0]
            for index in range(count):
                module.start(idle, name=f"n{index}")
            await asyncio.sleep(0)
            return (tracemalloc.get_traced_memory()[0] - before) / count
    finally:
        tracemalloc.stop()


async def many_topics() -> float:
    """Messages a second round-robin over 10 000 topics of one module, each with a subscriber."""
    received, took = 0, 0.0

    def count(_: Pair) -> None:
        nonlocal received
        received += 1

    async def both(node: r2p.Node) -> None:
        nonlocal took
        publishers = [node.advertise(f"t{index}", Pair) for index in range(TOPICS)]
        for index in range(TOPICS):
            node.subscribe(f"t{index}", Pair, count)
        started = time.perf_counter()
        for publisher in publishers:
            publisher.publish_nowait(MESSAGE)
        while received < TOPICS:
            await node.spin()
        took = time.perf_counter() - started

    async with r2p.Module("BENCH", via=[], watchdog=False) as module:
        module.start(both)
        await module.wait()
    return TOPICS / took


def rows() -> Iterator[Row]:
    bare = seconds(sys.executable, "-c", "import asyncio")
    imported = seconds(sys.executable, "-c", "import r2p")
    used = seconds(sys.executable, "-c", "import r2p; r2p.run, r2p.Node")  # imported when they are used first
    helped = seconds(COMMAND, "--help")
    python = f"import asyncio {bare * 1e3:.0f} ms"
    yield Row("import r2p", f"{imported * 1e3:.0f} ms", python, "1.45 x asyncio", imported <= 1.45 * bare)
    yield Row("import r2p; r2p.run", f"{used * 1e3:.0f} ms", python, "", None)
    yield Row("r2p --help", f"{helped * 1e3:.0f} ms", python, "300 ms", helped <= 0.3)
    node = run_on("asyncio", node_bytes(500))
    publisher = run_on("asyncio", bytes_of(1000, lambda node, _: node.advertise("t", Pair)))
    subscriber = run_on("asyncio", bytes_of(1000, lambda node, _: node.subscribe("t", Pair)))
    topic = run_on("asyncio", bytes_of(1000, lambda node, index: node.advertise(f"t{index}", Pair))) - publisher
    for what, size, firmware in (
        ("a node", node, ""),
        ("a topic", topic, ""),
        ("a publisher", publisher, ""),
        ("a subscriber", subscriber, "firmware: 48 bytes"),
    ):
        yield Row(f"memory of {what}", f"{size:.0f} bytes", firmware, "", None)
    ours = run_on("uvloop", many_topics())
    yield Row("10 000 topics in one module", f"{ours / 1e3:.0f} k msg/s", "", "works", True)
