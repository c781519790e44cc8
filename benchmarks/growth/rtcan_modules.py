"""Modules on a simulated RTCAN bus: until all have their slots and know all topics, and the management afterwards.

All times are of the bus, under virtual time: the same each time. A bus has 254 topics at most: those of 25 modules.
"""

import asyncio
from contextlib import AsyncExitStack

import r2p
from benchmarks.growth.curve import Curve
from benchmarks.growth.zenoh_modules import knows
from benchmarks.twenty_modules import Traffic
from r2p import sim
from r2p.msg import Led
from r2p.transports.rtcan.link import RtcanLink

SIZES = (5, 10, 20)
TOPICS, SUBSCRIBED = 10, (1, 7)
"""Topics of each module, and the modules after it of which it subscribes to the topic that has slots."""
PERIOD = 0.04  # s
SETTLED, AT_REST = 10.0, 30.0  # s


async def _work(node: r2p.Node, number: int, modules: int) -> None:
    for topic in range(TOPICS):
        publisher_class = r2p.NonRealTime() if topic else r2p.Periodic(PERIOD, Led)
        node.advertise(f"m{number}/t{topic}", Led, publisher_class)
    for after in SUBSCRIBED:
        node.subscribe(f"m{(number + after) % modules}/t0", Led, lossy=True)
    while True:
        await node.spin()


async def _measure(modules: int) -> tuple[float, float]:
    """Return the seconds until all is known, and the share of management on the bus afterwards."""
    can = sim.can_bus("growth", seed=1)
    traffic = Traffic(can)
    time = asyncio.get_running_loop().time
    async with AsyncExitStack() as stack:
        began, started = time(), []
        for number in range(modules):
            module = await stack.enter_async_context(r2p.Module(f"M{number}", via="sim:growth", watchdog=False))
            module.start(_work, number, modules)
            started.append(module)
        links = [link for module in started for link in module.links if isinstance(link, RtcanLink)]
        all_known = (modules - 1, (modules - 1) * TOPICS)
        while not (_granted(links) == modules and all(knows(module, *all_known) for module in started)):  # noqa: ASYNC110
            await asyncio.sleep(0.01)
        known = time() - began
        await asyncio.sleep(SETTLED)
        traffic.reset()
        await asyncio.sleep(AT_REST)
        return known, traffic.bits["management"] / AT_REST / can.bitrate


def _granted(links: list[RtcanLink]) -> int:
    return sum(bool(topic.period) for link in links for topic in link.slots.values())


def curves() -> list[Curve]:
    """Measure."""
    start = Curve("RTCAN: until all have slots and know all", "modules with 10 topics each", "s of the bus", goal=5.0)
    rest = Curve("RTCAN: management at rest", "modules with 10 topics each", "% of the bus", goal=3.0)
    for modules in SIZES:
        known, share = sim.run(lambda: _measure(modules), seed=1)  # noqa: B023
        start.points.append((modules, known))
        rest.points.append((modules, 100 * share))
    return [start, rest]
