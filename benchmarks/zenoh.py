"""Two processes over zenoh on loopback, TCP, against bare zenoh callbacks; and `r2p topic list` on a large network."""

import asyncio
import json
import multiprocessing
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import AsyncExitStack
from multiprocessing.connection import Connection

import zenoh

import r2p
from benchmarks import ends
from benchmarks.ends import Result
from benchmarks.loops import run_on
from benchmarks.table import Row, p50_p99, rate

MESSAGES = 300_000
ROUNDS = 5_000
MODULES = 50
TOPICS = 10  # of each module
SETTLED = 2.0  # seconds after which all of them know each other


class Sixteen(r2p.Message):
    """64 bytes."""

    values: tuple[
        r2p.f32, r2p.f32, r2p.f32, r2p.f32, r2p.f32, r2p.f32, r2p.f32, r2p.f32,
        r2p.f32, r2p.f32, r2p.f32, r2p.f32, r2p.f32, r2p.f32, r2p.f32, r2p.f32,
    ] = (0.0,) * 16  # fmt: skip


MESSAGE = Sixteen(values=tuple(map(float, range(16))))  # type: ignore[arg-type]  # sixteen of them
LOAD = ends.Load(MESSAGE, MESSAGES, ROUNDS)


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port: int = probe.getsockname()[1]
        return port


def url(port: int, *, listens: bool) -> str:
    if listens:
        return f"zenoh:?mode=peer&listen=tcp/127.0.0.1:{port}&scouting=off&network=bench"
    return f"zenoh:tcp/127.0.0.1:{port}?scouting=off&network=bench"


# r2p at both ends


def _serve_r2p(port: int, pipe: Connection) -> None:
    module = r2p.Module("SERVER", via=url(port, listens=True), watchdog=False)
    run_on("uvloop", ends.serve(module, LOAD, pipe, lambda: "ready"))


def _drive_r2p(port: int, pipe: Connection) -> Result:
    module = r2p.Module("CLIENT", via=url(port, listens=False), watchdog=False)
    return run_on("uvloop", ends.drive(module, LOAD, pipe))


# bare zenoh at both ends


def config(port: int, *, listens: bool) -> zenoh.Config:
    config = zenoh.Config()
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("mode", '"peer"' if listens else '"client"')
    key = "listen/endpoints" if listens else "connect/endpoints"
    config.insert_json5(key, json.dumps([f"tcp/127.0.0.1:{port}"]))
    return config


def _serve_bare(port: int, pipe: Connection) -> None:
    """Counts in a callback, and echoes in another one."""
    session = zenoh.open(config(port, listens=True))
    done = threading.Event()
    count, started = 0, 0.0
    pong = session.declare_publisher("bench/pong")

    def arrived(_: zenoh.Sample) -> None:
        nonlocal count, started
        count += 1
        if count == 1:
            started = time.perf_counter()
        elif count == MESSAGES:
            pipe.send((count, 0, time.perf_counter() - started))
            done.set()

    numbers = session.declare_subscriber("bench/numbers", arrived)
    ping = session.declare_subscriber("bench/ping", lambda sample: pong.put(sample.payload))
    pipe.send("ready")
    done.wait()
    pipe.recv()
    del numbers, ping


def _drive_bare(port: int, pipe: Connection) -> Result:
    session = zenoh.open(config(port, listens=False))
    block = zenoh.CongestionControl.BLOCK
    numbers = session.declare_publisher("bench/numbers", congestion_control=block)
    ping = session.declare_publisher("bench/ping")
    came = threading.Event()
    answers = session.declare_subscriber("bench/pong", lambda _: came.set())
    while not (numbers.matching_status and ping.matching_status):
        time.sleep(0.01)
    data = MESSAGE.encode()
    for _ in range(MESSAGES):
        numbers.put(data)
    received, lost, seconds = pipe.recv()
    trips = []
    for _ in range(ROUNDS):
        at = time.perf_counter()
        ping.put(data)
        came.wait()
        came.clear()
        trips.append(time.perf_counter() - at)
    pipe.send("end")
    del answers
    return received / seconds, lost, trips


def _both(*, bare: bool) -> Result:
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    port = free_port()
    server = context.Process(target=_serve_bare if bare else _serve_r2p, args=(port, there), daemon=True)
    server.start()
    try:
        here.recv()
        return _drive_bare(port, here) if bare else _drive_r2p(port, here)
    finally:
        server.terminate()
        server.join()


# A large network


def _populate(port: int, pipe: Connection) -> None:
    """50 modules that publish 10 topics each, and a router."""

    async def publish(node: r2p.Node, number: int) -> None:
        for topic in range(TOPICS):
            node.advertise(f"m{number}_{topic}", Sixteen)
        await asyncio.get_running_loop().create_future()

    async def main() -> None:
        router = f"zenoh:?mode=router&listen=tcp/127.0.0.1:{port}&scouting=off&network=bench"
        async with AsyncExitStack() as stack:
            await stack.enter_async_context(r2p.Module("ROUTER", via=router, watchdog=False))
            for number in range(MODULES):
                module = r2p.Module(f"M{number}", via=url(port, listens=False), watchdog=False)
                await stack.enter_async_context(module)
                module.start(publish, number, name="many")
            await asyncio.sleep(SETTLED)
            pipe.send("ready")
            await asyncio.to_thread(pipe.recv)

    run_on("uvloop", main())


def _list_topics() -> tuple[float, int]:
    """Seconds that `r2p topic list` takes, and the topics that it finds."""
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    port = free_port()
    network = context.Process(target=_populate, args=(port, there), daemon=True)
    network.start()
    try:
        here.recv()
        command = [sys.executable, "-c", "from r2p.tools.main import main; main()", "topic", "list"]
        started = time.perf_counter()
        listed = subprocess.run([*command, "--via", url(port, listens=False)], capture_output=True, check=True)
        return time.perf_counter() - started, sum(b'"m' in line for line in listed.stdout.splitlines())
    finally:
        network.terminate()
        network.join()


def rows() -> Iterator[Row]:
    bare, _, bare_trips = _both(bare=True)
    ours, lost, trips = _both(bare=False)
    yield Row(
        "two processes over zenoh, typed, 64 bytes, into `async for`",
        f"{rate(ours)}, {lost} lost",
        f"bare callback that counts {rate(bare)}: {ours / bare:.2f}x",
        "250 k/s and 0.25x, none lost",
        ours >= 250e3 and ours >= 0.25 * bare and not lost,
    )
    (median, worst), (bare_median, bare_worst) = p50_p99(trips), p50_p99(bare_trips)
    yield Row(
        "round trip over zenoh, typed, 64 bytes, p50, p99",
        f"{median:.0f} us, {worst:.0f} us",
        f"bare callbacks {bare_median:.0f} us, {bare_worst:.0f} us: {median / bare_median:.2f}x",
        "p50 within 1.5x",
        median <= 1.5 * bare_median,
    )
    seconds, found = _list_topics()
    yield Row(
        "r2p topic list on 50 modules, 500 topics",
        f"{seconds:.2f} s, {found} found",
        "",
        "1 s, all",
        seconds < 1.0 and found == MODULES * TOPICS,
    )
