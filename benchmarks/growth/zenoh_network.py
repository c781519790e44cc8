"""A large zenoh network as one ordinary module sees it: tokens of many modules, which one other process declares."""

import asyncio
import resource
import time
from multiprocessing.connection import Connection

import r2p
from benchmarks.growth.curve import Curve
from benchmarks.growth.fleet import ready
from benchmarks.growth.zenoh_modules import TOPICS, knows, list_topics, run_router
from benchmarks.loops import run_on
from benchmarks.processes import process
from benchmarks.zenoh import bare_client, connect
from r2p.codecs import liveliness
from r2p.codecs.management import ROLE_PUBLISHES
from r2p.messages import layout
from r2p.msg import Led
from r2p.protocols.discovery.events import Declare
from r2p.protocols.liveliness.session import LivelinessDiscovery

SIZES = (100, 300, 1000)
LIMIT = 60.0  # s
PERIOD = 0.005  # s, of what shows how long the loop was blocked


def keys(modules: int) -> list[str]:
    """Return the keys that so many modules declare, each with a node that publishes 10 topics."""
    known = layout(Led)
    found = []
    for number in range(modules):
        one = LivelinessDiscovery(f"MODULE{number}", number + 1)
        events = one.link_up(0)
        for topic in range(TOPICS):
            name = f"module{number}/topic{topic}"
            events += one.advertise(0, name, known.size, known.fingerprint)
            events += one.add_endpoint(0, "publisher", name, ROLE_PUBLISHES, 1)
        events += one.poll(0)
        found += [liveliness.token_key(event.key) for event in events if isinstance(event, Declare)]
    return found


def _declare(pipe: Connection, port: int, modules: int) -> None:
    with bare_client(port, shm=False) as session:
        live = session.liveliness()
        tokens = [live.declare_token(f"r2p/bench/{key}") for key in keys(modules)]
        pipe.send(len(tokens))
        pipe.recv()
        del tokens


class _Watch:
    """The longest time for which the event loop was blocked, in s."""

    def __init__(self) -> None:
        self.longest = 0.0
        self._last = time.perf_counter()
        self._again()

    def _again(self) -> None:
        self._timer = asyncio.get_running_loop().call_later(PERIOD, self._tick)

    def _tick(self) -> None:
        now = time.perf_counter()
        self.longest, self._last = max(self.longest, now - self._last - PERIOD), now
        self._again()

    def close(self) -> None:
        self._timer.cancel()


async def _join(port: int, modules: int) -> tuple[float, float]:
    """Return s until the module knows all, and s for which its loop was blocked at most."""
    began = time.perf_counter()
    async with r2p.Module("JOINS", via=connect(port), watchdog=False) as module:
        watch = _Watch()
        while not knows(module, modules, modules * TOPICS) and time.perf_counter() < began + LIMIT:  # noqa: ASYNC110
            await asyncio.sleep(0.02)
        seconds = time.perf_counter() - began
        await asyncio.sleep(2.0)  # what follows may block, too
        watch.close()
    return seconds, watch.longest


def _module(pipe: Connection, port: int, modules: int) -> None:
    ready(pipe)
    seconds, blocked = run_on("uvloop", _join(port, modules))
    pipe.send((seconds, blocked, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024))
    pipe.recv()


def measure(modules: int) -> tuple[float, float, float, float]:
    """Return s to join, s of the blocked loop, MB of resident memory, and s of `r2p topic list`."""
    with process(run_router) as router:
        port = router.recv()
        with process(_declare, port, modules) as declares:
            declares.recv()
            with process(_module, port, modules) as module:
                module.recv()
                module.send("begin")
                joined: tuple[float, float, float] = module.recv()
                listed, found = list_topics(port)  # while it is there: the router takes long to forget who has left
            if found != modules * TOPICS:
                raise AssertionError(f"r2p topic list shows {found} of {modules * TOPICS} topics")
            return *joined, listed


def curves() -> list[Curve]:
    """Measure."""
    n_is = "other modules with 10 topics each"
    found = [
        Curve("zenoh: one module joins a network", n_is, "s", goal=5.0),
        Curve("zenoh: its loop is blocked, at most", n_is, "ms", goal=50.0),
        Curve("zenoh: its resident memory", n_is, "MB", goal=100.0),
        Curve("zenoh: r2p topic list there", n_is, "s", goal=5.0),
    ]
    for modules in SIZES:
        joined, blocked, memory, listed = measure(modules)
        for curve, value in zip(found, (joined, 1e3 * blocked, memory, listed), strict=True):
            curve.points.append((modules, value))
    return found
