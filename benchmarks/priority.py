"""What unimportant nodes cost an important one (thesis 5.4)."""

import asyncio
import socket
import time
from collections.abc import Iterator

import r2p
from benchmarks.delivery import MESSAGE, Pair
from benchmarks.loops import run_on
from benchmarks.table import Row, p50_p99
from r2p.codecs import debug
from r2p.transports.tcp import TcpListenTransport
from r2p.transports.url import parse

STEP = 40e-6
"""Seconds of CPU that a low-priority node needs per message."""

LOW = 20


async def beside_slow_ones(messages: int, low: int) -> list[float]:
    """Latencies of the high-priority subscriber of a 1 kHz topic, beside `low` slow ones with full queues."""
    durations: list[float] = []
    at = 0.0

    async def high(node: r2p.Node) -> None:
        async for _ in node.subscribe("pairs", Pair):
            durations.append(time.perf_counter() - at)

    async def slow(node: r2p.Node, seconds: float) -> None:
        async for _ in node.subscribe("pairs", Pair, queue=5, lossy=True):
            await asyncio.sleep(seconds)

    async def produce(node: r2p.Node) -> None:
        nonlocal at
        publisher = node.advertise("pairs", Pair)
        async for _ in node.every(0.001):
            at = time.perf_counter()
            await publisher.publish(MESSAGE)
            if publisher.sent == messages:
                ended.set()
                return

    ended = asyncio.Event()
    async with r2p.Module("BENCH", via=[], watchdog=False) as module:
        module.start(high, priority=10)
        for index in range(low):
            module.start(slow, 0.1 if index % 2 else 0.2, name=f"slow{index}")
        module.start(produce)
        await ended.wait()
    return durations


def burn() -> None:
    until = time.perf_counter() + STEP
    while time.perf_counter() < until:
        pass


async def beside_busy_ones(messages: int) -> list[float]:
    """Latencies from bytes in the socket to the line of the high-priority node, beside LOW busy low-priority ones."""
    durations: list[float] = []
    handled = asyncio.Event()
    at = 0.0

    async def high(node: r2p.Node) -> None:
        async for _ in node.subscribe("high", Pair):
            durations.append(time.perf_counter() - at)
            handled.set()

    async def busy(node: r2p.Node) -> None:
        async for _ in node.subscribe("low", Pair, lossy=True):
            burn()

    transport = TcpListenTransport(parse("tcp-listen:127.0.0.1:0"))
    async with r2p.Module("BENCH", via=[transport], watchdog=False) as module:
        module.start(high, priority=10)
        for index in range(LOW):
            module.start(busy, name=f"busy{index}")
        await asyncio.sleep(0)
        with socket.create_connection(("127.0.0.1", transport.port or 0)) as line:
            line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            payload = r2p.layout(Pair).encode(MESSAGE)
            for topic in ("high", "low"):
                line.sendall(_response(topic, len(payload)))
            await asyncio.sleep(0.1)
            low, high_line = debug.encode(b"low", payload, 0), debug.encode(b"high", payload, 0)
            for _ in range(messages):
                handled.clear()
                line.sendall(low)
                await asyncio.sleep(STEP * 5)
                at = time.perf_counter()
                line.sendall(high_line)
                await handled.wait()
                await asyncio.sleep(STEP * LOW * 1.5)
    return durations


def _response(topic: str, size: int) -> bytes:
    from r2p.codecs import management

    response = management.SubscribeResponse(topic, size, 0, management.NO_PARAMS)
    return debug.encode(b"R2P", management.encode(response), 0)


def rows() -> Iterator[Row]:
    alone, alone_worst = p50_p99(run_on("uvloop", beside_slow_ones(3000, 0)))
    median, worst = p50_p99(run_on("uvloop", beside_slow_ones(3000, LOW)))
    yield Row(
        "high priority beside 20 slow full queues, p50, p99",
        f"{median:.0f} us, {worst:.0f} us",
        f"without them {alone:.0f} us, {alone_worst:.0f} us: {worst / alone_worst:.1f}x",
        "p99 within 2x",
        worst <= 2 * alone_worst,
    )
    median, worst = p50_p99(run_on("uvloop", beside_busy_ones(500)))
    step = STEP * 1e6
    yield Row(
        "high priority beside 20 busy nodes, socket to line, p50, p99",
        f"{median:.0f} us, {worst:.0f} us",
        f"one handler step {step:.0f} us: {worst / step:.1f} steps",
        "p99 under 4 steps",
        worst < 4 * step,
    )
