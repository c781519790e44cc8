"""Modules of one process on a memory network, with ten topics and two subscriptions each: their start, and at rest."""

import asyncio
import time
from contextlib import AsyncExitStack
from multiprocessing.connection import Connection

import r2p
from benchmarks.growth.curve import Curve
from benchmarks.growth.zenoh_modules import knows
from benchmarks.loops import run_on
from benchmarks.processes import process
from r2p.msg import Led

SIZES = (20, 50, 100, 200)
TOPICS, SUBSCRIBED = 10, (1, 7)
"""Topics of each module, and the modules after it of which it subscribes to one topic."""
SETTLED, AT_REST = 30.0, 60.0  # s: all is calm after the slowest round, of 30 s; twice that shows all of what they say
LIMIT = 120.0  # s


async def _work(node: r2p.Node, number: int, modules: int) -> None:
    for topic in range(TOPICS):
        node.advertise(f"m{number}/t{topic}", Led)
    for after in SUBSCRIBED:
        node.subscribe(f"m{(number + after) % modules}/t0", Led)
    await asyncio.get_running_loop().create_future()


async def _modules(pipe: Connection, modules: int) -> None:
    began, used = time.perf_counter(), time.process_time()
    async with AsyncExitStack() as stack:
        started = [r2p.Module(f"M{number}", via="memory:growth", watchdog=False) for number in range(modules)]
        for number, module in enumerate(started):
            await stack.enter_async_context(module)
            module.start(_work, number, modules)
        all_known = (modules - 1, (modules - 1) * TOPICS)
        while not all(knows(module, *all_known) for module in started):
            if time.perf_counter() > began + LIMIT:
                raise TimeoutError(f"of {modules} modules not all know all")
            await asyncio.sleep(0.1)
        pipe.send(time.process_time() - used)
        await asyncio.sleep(SETTLED)
        began, used = time.perf_counter(), time.process_time()
        await asyncio.sleep(AT_REST)
        pipe.send((time.process_time() - used) / (time.perf_counter() - began))


def _run(pipe: Connection, modules: int) -> None:
    run_on("uvloop", _modules(pipe, modules))


def curves() -> list[Curve]:
    """Measure."""
    start = Curve("memory: processor time until all modules know all", "modules with 10 topics each", "s", goal=10.0)
    rest = Curve("memory: all modules at rest", "modules with 10 topics each", "% of a core", goal=10.0)
    for modules in SIZES:
        with process(_run, modules) as pipe:
            start.points.append((modules, pipe.recv()))
            rest.points.append((modules, 100 * pipe.recv()))
    return [start, rest]
