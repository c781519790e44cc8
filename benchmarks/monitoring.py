"""The share of a core that the monitor behind `r2p top` and `r2p dash` takes with 1 000 topics, over zenoh."""

import asyncio
import time
from collections.abc import Iterator
from contextlib import AsyncExitStack
from multiprocessing.connection import Connection

import r2p
from benchmarks import zenoh
from benchmarks.loops import run_on
from benchmarks.processes import process
from benchmarks.table import Row
from r2p.monitoring.monitor import NetworkMonitor
from r2p.msg import Led
from r2p.transports.zenoh import config

MODULES, TOPICS = 20, 50  # of each module
PERIOD = 1.0  # s, of each topic and of the monitor
SETTLING, SECONDS = 8.0, 15.0
_LEASE_MS = 20_000
GOAL = 0.03  # of a core: that leaves room for a screen within the 5 % of `r2p top`


async def _publish(node: r2p.Node) -> None:
    """Publish all topics of a module, one after the other, and subscribe to as many of its own."""
    module = node.module.lower()
    publishers = [node.advertise(f"{module}/topic{number}", Led) for number in range(TOPICS)]
    for publisher in publishers:
        node.subscribe(publisher.topic, Led, queue=1, lossy=True)
    async for _ in node.every(PERIOD / TOPICS):
        await publishers[0].publish(Led())
        publishers.append(publishers.pop(0))


async def _robot(pipe: Connection) -> None:
    """Run a router, and the modules: each begins when the one before it has announced its topics.

    All at once they keep a core busy for longer than the second after which zenoh takes a silent session for gone, and
    then they connect and announce anew, again and again.
    """
    async with AsyncExitStack() as stack:
        router = r2p.Module("ROUTER", via=zenoh.LISTEN.replace("peer", "router"), watchdog=False)
        port = zenoh.port_of(await stack.enter_async_context(router))
        for number in range(MODULES):
            module = r2p.Module(f"MODULE{number}", via=zenoh.connect(port), watchdog=False)
            (await stack.enter_async_context(module)).start(_publish)
            while not _knows(router, module.name):  # noqa: ASYNC110 - there is no event
                await asyncio.sleep(0.05)
        pipe.send(port)
        await asyncio.get_running_loop().create_future()


def _knows(router: r2p.Module, module: str) -> bool:
    """Return whether a module knows all topics of another one, with the nodes that publish them."""
    published = router.network.nodes().get((module, "_publish"), ([], []))[0]
    return len(published) >= TOPICS


def run_robot(pipe: Connection) -> None:
    """Run 20 modules with 50 topics each, and send the port of their router.

    All of them are in one process, which stands still for more than r2p's lease of 1 s when the machine is busy. Then
    20 sessions would lose their connections, and each would announce all it has to all others, which takes so long that
    they lose them again.
    """
    config._NEEDED["transport/link/tx/lease"] = _LEASE_MS  # noqa: SLF001 - users have no need of it
    run_on("uvloop", _robot(pipe))


async def _shares(pipe: Connection) -> tuple[float, float, int, int]:
    """Return the share of a core without a monitor and with one, its topics, and those whose rate it knows."""
    async with r2p.Module("PC", via=zenoh.connect(pipe.recv()), observer=True, watchdog=False) as module:
        while len(module.network.topics()) < MODULES * TOPICS:  # noqa: ASYNC110 - there is no event
            await asyncio.sleep(0.1)
        await asyncio.sleep(SETTLING)
        bare = await _share()
        async with NetworkMonitor(module, period=PERIOD) as monitor:
            await asyncio.sleep(SETTLING)
            watched = await _share()
            topics = monitor.snapshot.topics
            return bare, watched, len(topics), sum(each.rate is not None for each in topics)


async def _share() -> float:
    began, used = time.perf_counter(), time.process_time()
    await asyncio.sleep(SECONDS)
    return (time.process_time() - used) / (time.perf_counter() - began)


def rows() -> Iterator[Row]:
    with process(run_robot) as pipe:
        bare, watched, topics, known = run_on("asyncio", _shares(pipe))
    yield Row(
        f"a monitor of {topics} topics once a second, {known} rates known",
        f"{watched:.1%} of a core",
        f"the same module without it: {bare:.1%}",
        f"{GOAL:.0%} of a core",
        watched <= GOAL and known >= MODULES * TOPICS,
    )
