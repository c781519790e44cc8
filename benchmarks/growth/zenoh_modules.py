"""Modules over zenoh in ten processes, and one router: until all see all, `r2p topic list`, and the cost at rest."""

import asyncio
import subprocess
import sys
import time
from contextlib import AsyncExitStack
from multiprocessing.connection import Connection

import zenoh

import r2p
from benchmarks.growth.curve import Curve
from benchmarks.growth.fleet import Fleet, fleet, ready, serve_usage
from benchmarks.loops import run_on
from benchmarks.processes import process
from benchmarks.zenoh import bare_config, connect, port_of_session
from r2p.msg import Led
from r2p.names import LOG

SIZES = (20, 50, 100)
PROCESSES, TOPICS = 10, 10
AT_REST_AFTER, AT_REST = 11.0, 10.0  # s: by then each module has queried all tokens once more (PROTOCOL.md 10)
LIMIT = 60.0  # s
TOPIC_LIST = (sys.executable, "-c", "from r2p.tools.main import main; main()", "topic", "list", "--via")


def run_router(pipe: Connection) -> None:
    """Run a bare router, as zenohd is one; send its port, and answer questions for its processor time."""
    with zenoh.open(bare_config("router", "listen", 0, shm=False)) as session:
        pipe.send(port_of_session(session))
        run_on("asyncio", serve_usage(pipe))


def list_topics(port: int) -> tuple[float, int]:
    """Return the duration of `r2p topic list` in s, and how many topics it shows."""
    began = time.perf_counter()
    listed = subprocess.run([*TOPIC_LIST, connect(port)], capture_output=True, check=True)
    return time.perf_counter() - began, sum(b"/topic" in line for line in listed.stdout.splitlines())


def knows(module: r2p.Module, modules: int, topics: int) -> bool:
    """Return whether a module with one link knows so many others and their topics, besides the log.

    Cheaper than to copy the views.
    """
    (link,) = module.links
    known = link.discovery.topics
    return len(link.discovery.modules) >= modules and len(known) - (LOG in known) >= topics


async def _publish(node: r2p.Node) -> None:
    for number in range(TOPICS):
        node.advertise(f"{node.module.lower()}/topic{number}", Led)
    await asyncio.get_running_loop().create_future()


async def _modules(pipe: Connection, port: int, first: int, count: int, total: int) -> None:
    began = time.perf_counter()
    async with AsyncExitStack() as stack:
        modules = [r2p.Module(f"MODULE{first + each}", via=connect(port), watchdog=False) for each in range(count)]
        for module in modules:
            await stack.enter_async_context(module)
            module.start(_publish)
        others, end = (total - 1, (total - 1) * TOPICS), began + LIMIT
        while time.perf_counter() < end and not all(knows(module, *others) for module in modules):  # noqa: ASYNC110
            await asyncio.sleep(0.02)
        pipe.send(time.perf_counter() - began)
        await serve_usage(pipe)


def _run_modules(pipe: Connection, port: int, first: int, count: int, total: int) -> None:
    """Run `count` of `total` modules; send how long it took until they see all."""
    ready(pipe)
    run_on("uvloop", _modules(pipe, port, first, count, total))


def measure(modules: int) -> tuple[float, float, float]:
    """Return s until all modules see all, s of `r2p topic list`, and the share of a core at rest."""
    with process(run_router) as router:
        port, each = router.recv(), modules // PROCESSES
        with fleet(_run_modules, [(port, number * each, each, modules) for number in range(PROCESSES)]) as workers:
            workers.begin()
            seen = max(workers.results())
            time.sleep(AT_REST_AFTER)
            share = Fleet([router, *workers.pipes]).share(AT_REST)
            listed, found = list_topics(port)
            if found != modules * TOPICS:
                raise AssertionError(f"r2p topic list shows {found} of {modules * TOPICS} topics")
            return seen, listed, share


def curves() -> list[Curve]:
    """Measure."""
    found = [
        Curve("zenoh: until all modules see all", "modules with 10 topics each", "s", goal=3.0),
        Curve("zenoh: r2p topic list", "modules with 10 topics each", "s", goal=2.0),
        Curve("zenoh: all processes at rest", "modules with 10 topics each", "% of a core", goal=10.0),
    ]
    for modules in SIZES:
        seen, listed, share = measure(modules)
        for curve, value in zip(found, (seen, listed, 100 * share), strict=True):
            curve.points.append((modules, value))
    return found
