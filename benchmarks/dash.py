"""The server of `r2p dash`: processor time for pages that plot 20 fields at 1 kHz, without a browser."""

import asyncio
import contextlib
import json
import os
import re
import struct
import subprocess
import time
from collections.abc import AsyncIterator, Iterator
from multiprocessing.connection import Connection
from pathlib import Path

from websockets.asyncio.client import ClientConnection, connect

import r2p
from benchmarks.loops import run_on
from benchmarks.processes import process
from benchmarks.start import COMMAND
from benchmarks.table import Row, p50_p99
from r2p.transports.tcp import TcpListenTransport
from r2p.transports.url import parse

FIELDS = 20
RATE = 1000.0  # messages a second of each topic
SECONDS = 10.0
SETTLED = 2.0  # seconds until all plots get points
GOAL = 0.3  # of a core

_HEAD = struct.Struct("<BBHI")


class Five(r2p.Message):
    """40 bytes, of fields that are plotted."""

    a: r2p.f64 = 0.0
    b: r2p.f64 = 0.0
    c: r2p.f64 = 0.0
    d: r2p.f64 = 0.0
    e: r2p.f64 = 0.0


def robot(pipe: Connection, topics: int) -> None:
    """Publish topics at 1 kHz until the process is ended."""
    run_on("uvloop", _publish(pipe, topics))


async def _publish(pipe: Connection, topics: int) -> None:
    transport = TcpListenTransport(parse("tcp-listen:127.0.0.1:0"))

    async def waves(node: r2p.Node) -> None:
        publishers = [node.advertise(f"wave{number}", Five) for number in range(topics)]
        began, sent = time.perf_counter(), 0
        async for _ in node.every(1 / RATE):
            due = int((time.perf_counter() - began) * RATE)  # what a late tick has skipped, too
            for number in range(sent, due):
                value = number % 1000 / 1000
                for publisher in publishers:
                    publisher.publish_nowait(Five(value, -value, value * value, 1 - value, 0.5))
            sent = due

    async with r2p.Module("ROBOT", via=[transport], watchdog=False) as module:
        module.start(waves)
        pipe.send(transport.port)
        await module.wait()


@contextlib.contextmanager
def dash(via: str) -> Iterator[tuple[int, str]]:
    """`r2p dash` as users start it; its process and the address of its page."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    command = [COMMAND, "dash", "--port", "0", "--via", via]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment) as child:
        try:
            assert child.stderr is not None
            yield child.pid, next(found[0] for line in child.stderr if (found := re.search(r"http://\S+", line)))
        finally:
            child.terminate()


def processor_time(pid: int) -> float:
    """Seconds of processor time that a process has taken."""
    user, system = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


class _Page:
    """A page that plots and only counts: values, and how old the newest one of each message is."""

    def __init__(self, socket: ClientConnection) -> None:
        self.values = 0
        self.ages: list[float] = []
        self.dropped = 0
        self._socket = socket

    async def plot(self, topics: int) -> None:
        """Plot all fields, each topic in a plot of its own. Raises RuntimeError if one is refused."""
        await self._until_known(topics)
        for number in range(topics):
            names = [f"wave{number}.{field}" for field in "abcde"[: FIELDS // topics]]
            await self._socket.send(json.dumps({"op": "plot", "id": number, "stream": number, "fields": names}))

    async def _until_known(self, topics: int) -> None:
        known: set[str] = set()
        while len(known) < topics:
            news = json.loads(await self._socket.recv())
            known |= {name for name in news.get("changed", {}).get("topics", ()) if name.startswith("wave")}

    async def count(self) -> None:
        """Count until the server closes."""
        async for data in self._socket:
            if isinstance(data, bytes):
                _, columns, _, count = _HEAD.unpack_from(data)
                self.values += columns * count
                self.ages.append(time.time() - struct.unpack_from("<d", data, _HEAD.size + 8 * (count - 1))[0])
            elif "error" in (news := json.loads(data)):
                raise RuntimeError(news["error"])
            elif news.get("op") == "dropped":
                self.dropped = sum(news["streams"].values())


@contextlib.asynccontextmanager
async def _pages(url: str, topics: int, count: int) -> AsyncIterator[list[_Page]]:
    """Pages that plot all fields."""
    address = url.replace("http:", "ws:").partition("#")[0] + "dash"
    async with contextlib.AsyncExitStack() as stack:
        tasks = await stack.enter_async_context(asyncio.TaskGroup())
        pages = []
        for _ in range(count):
            page = _Page(await stack.enter_async_context(connect(address, proxy=None, max_size=None)))
            await page.plot(topics)
            pages.append(page)
        counting = [tasks.create_task(page.count()) for page in pages]
        await asyncio.sleep(SETTLED)
        yield pages
        for task in counting:
            task.cancel()


async def _measure(pid: int, url: str, topics: int, count: int) -> tuple[float, float, list[float], int]:
    """Return the server's share of a core, the values a second of each page, their ages, and how many were dropped."""
    async with _pages(url, topics, count) as pages:
        for page in pages:
            page.values, page.ages = 0, []
        before, began = processor_time(pid), time.perf_counter()
        await asyncio.sleep(SECONDS)
        seconds = time.perf_counter() - began
        share = (processor_time(pid) - before) / seconds
        values = min(page.values for page in pages) / seconds
        return share, values, [age for page in pages for age in page.ages], sum(page.dropped for page in pages)


def rows() -> Iterator[Row]:
    for topics, count in ((4, 1), (4, 5), (20, 1)):
        with process(robot, topics) as pipe, dash(f"tcp:127.0.0.1:{pipe.recv()}") as (pid, url):
            share, values, ages, dropped = run_on("uvloop", _measure(pid, url, topics, count))
        what = f"{FIELDS} fields of {topics} topics at 1 kHz, {count} page{'s' if count > 1 else ''}"
        goal, reached = ("30 % of a core", share <= GOAL) if count == 1 else ("", None)
        yield Row(f"{what}: processor time", f"{share:.0%} of a core", "", goal, reached)
        p50, p99 = p50_p99(ages, 1e-3)
        arrived = f"{values / (FIELDS * RATE):.1%}, {dropped} dropped"
        yield Row("values that arrive; their age, p50, p99", f"{arrived}; {p50:.0f}, {p99:.0f} ms", "", "", None)
