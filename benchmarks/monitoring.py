"""The share of a core that the monitor behind `r2p top` and `r2p dash` takes with 1 000 topics, over TCP."""

import asyncio
import time
from collections.abc import Iterator
from multiprocessing.connection import Connection

import r2p
from benchmarks.loops import run_on
from benchmarks.processes import process
from benchmarks.table import Row
from r2p.monitoring.monitor import NetworkMonitor
from r2p.msg import Led
from r2p.transports.tcp import TcpListenTransport
from r2p.transports.url import parse

MODULES, TOPICS = 20, 50  # of each module
PERIOD = 1.0  # s, of each topic and of the monitor
SETTLING, SECONDS = 8.0, 20.0
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


async def _robot(port: int) -> None:
    async with asyncio.TaskGroup() as tasks:
        for number in range(MODULES):
            tasks.create_task(_module(f"MODULE{number}", port))


async def _module(name: str, port: int) -> None:
    async with r2p.Module(name, via=f"tcp:127.0.0.1:{port}", watchdog=False) as module:
        module.start(_publish)
        await module.wait()


def _process(pipe: Connection) -> None:
    run_on("uvloop", _robot(pipe.recv()))


async def _shares(pipe: Connection) -> tuple[float, float, int, int]:
    """Return the share of a core without a monitor and with one, its topics, and those whose rate it knows."""
    transport = TcpListenTransport(parse("tcp-listen:127.0.0.1:0"))
    async with r2p.Module("PC", via=transport, observer=True, watchdog=False) as module:
        pipe.send(transport.port)
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
    with process(_process) as pipe:
        bare, watched, topics, known = run_on("asyncio", _shares(pipe))
    yield Row(
        f"a monitor of {topics} topics once a second, {known} rates known",
        f"{watched:.1%} of a core",
        f"the same module without it: {bare:.1%}",
        f"{GOAL:.0%} of a core",
        watched <= GOAL and known >= MODULES * TOPICS,
    )
