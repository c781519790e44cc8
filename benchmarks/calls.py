"""Calls of a service: in a module against bare asyncio queues, between processes against two topics there and back."""

import asyncio
import time
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection

import r2p
from benchmarks import zenoh
from benchmarks.loops import run_on
from benchmarks.processes import process
from benchmarks.table import Row, p50_p99, rate, typical
from r2p.transports.tcp import TcpListenTransport
from r2p.transports.url import parse

CALLS = 40_000
ROUNDS = 4_000
RUNS = 5
Trips = tuple[list[float], list[float]]
"""Seconds: calls, and messages there and back on two topics."""


class Turn(r2p.Service):
    """8 bytes there, 8 bytes back."""

    class Request(r2p.Message):
        a: r2p.u32 = 0
        b: r2p.f32 = 0.0

    class Response(r2p.Message):
        a: r2p.u32 = 0
        b: r2p.f32 = 0.0


REQUEST, RESPONSE = Turn.Request(a=1, b=2.0), Turn.Response(a=1, b=2.0)


async def answer(_request: Turn.Request) -> Turn.Response:
    """A handler without work of its own."""
    return RESPONSE


async def local_calls(calls: int) -> float:
    """Calls a second from one node of a module to another one."""
    took = 0.0

    async def serve(node: r2p.Node) -> None:
        node.serve("turn", Turn, answer)
        await node.spin()

    async def ask(node: r2p.Node) -> None:
        nonlocal took
        client = node.client("turn", Turn)
        await client.ready()
        started = time.perf_counter()
        for _ in range(calls):
            await client.call(REQUEST)
        took = time.perf_counter() - started
        await module.nodes["serve"].stop()

    async with r2p.Module("BENCH", via=[], watchdog=False) as module:
        module.start(serve)
        module.start(ask)
        await module.wait()
    return calls / took


async def queue_trips(trips: int) -> float:
    """The bare task and back: two hand-overs through queues of asyncio, without types, errors and time-outs."""
    there: asyncio.Queue[int] = asyncio.Queue()
    back: asyncio.Queue[int] = asyncio.Queue()

    async def serve() -> None:
        while True:
            await back.put(await there.get())

    server = asyncio.create_task(serve())
    started = time.perf_counter()
    for number in range(trips):
        await there.put(number)
        await back.get()
    took = time.perf_counter() - started
    server.cancel()
    return trips / took


# Two processes


async def _serve(module: r2p.Module, pipe: Connection, opened: Callable[[], object]) -> None:
    async def echo(node: r2p.Node) -> None:
        node.serve("turn", Turn, answer)
        back = node.advertise("pong", Turn.Response)
        async for _ in node.subscribe("ping", Turn.Request):
            await back.publish(RESPONSE)

    async with module:
        module.start(echo)
        pipe.send(opened())
        await module.wait()


async def _drive(module: r2p.Module) -> Trips:
    """Calls and messages in turns, so that both meet the same machine."""
    called: list[float] = []
    published: list[float] = []

    async def run(node: r2p.Node) -> None:
        client = node.client("turn", Turn)
        pings, pongs = node.advertise("ping", Turn.Request), node.subscribe("pong", Turn.Response)
        await client.ready()
        await pings.wait_subscriber()
        await pongs.wait_publisher()
        for _ in range(ROUNDS):
            at = time.perf_counter()
            await client.call(REQUEST)
            called.append(time.perf_counter() - at)
            at = time.perf_counter()
            await pings.publish(REQUEST)
            await pongs.fetch()
            published.append(time.perf_counter() - at)

    async with module:
        module.start(run)
        await module.wait()
    return called, published


def _serve_tcp(pipe: Connection) -> None:
    transport = TcpListenTransport(parse("tcp-listen:127.0.0.1:0"))
    run_on("uvloop", _serve(r2p.Module("SERVER", via=[transport], watchdog=False), pipe, lambda: transport.port))


def _serve_zenoh(pipe: Connection) -> None:
    module = r2p.Module("SERVER", via=zenoh.LISTEN, watchdog=False)
    run_on("uvloop", _serve(module, pipe, lambda: zenoh.port_of(module)))


def _between(serve: Callable[[Connection], None], url: Callable[[int], str]) -> Trips:
    with process(serve) as server:
        via = url(server.recv())
        return run_on("uvloop", _drive(r2p.Module("CLIENT", via=via, watchdog=False)))


def rows() -> Iterator[Row]:
    ours = typical(RUNS, lambda: run_on("uvloop", local_calls(CALLS)))
    bare = typical(RUNS, lambda: run_on("uvloop", queue_trips(CALLS)))
    yield Row(
        "call within a module (uvloop)",
        rate(ours),
        f"two bare hand-overs through asyncio queues {rate(bare)}: {bare / ours:.1f}x the time",
        "20 k/s, within 3x",
        ours >= 20e3 and bare <= 3 * ours,
    )
    for name, serve, url in (("TCP", _serve_tcp, "tcp:127.0.0.1:{}".format), ("zenoh", _serve_zenoh, zenoh.connect)):
        called, published = _between(serve, url)
        (median, worst), (topic_median, topic_worst) = p50_p99(called), p50_p99(published)
        yield Row(
            f"call over {name}, p50, p99 (uvloop)",
            f"{median:.0f} us, {worst:.0f} us",
            f"a topic there and back {topic_median:.0f} us, {topic_worst:.0f} us: {median / topic_median:.2f}x",
            "p50 within 1.3x",
            median <= 1.3 * topic_median,
        )
