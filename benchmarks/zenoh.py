"""Two processes over zenoh on loopback, TCP, against bare zenoh callbacks; and `r2p topic list` on a large network."""

import asyncio
import json
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import AsyncExitStack, contextmanager
from multiprocessing.connection import Connection

import zenoh

import r2p
from benchmarks import ends
from benchmarks.ends import Result
from benchmarks.loops import run_on
from benchmarks.processes import process
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


LISTEN = "zenoh:?mode=peer&listen=tcp/127.0.0.1:0&scouting=off&network=bench"


def connect(port: int) -> str:
    """The URL of a client."""
    return f"zenoh:tcp/127.0.0.1:{port}?scouting=off&network=bench"


def port_of(module: r2p.Module) -> int:
    """The port where it accepts connections."""
    ((_, address),) = module.addresses
    return int(address.rpartition(":")[2])


# r2p at both ends


def _serve_r2p(pipe: Connection) -> None:
    module = r2p.Module("SERVER", via=LISTEN, watchdog=False)
    run_on("uvloop", ends.serve(module, LOAD, pipe, lambda: port_of(module)))


def _drive_r2p(port: int, pipe: Connection) -> Result:
    module = r2p.Module("CLIENT", via=connect(port), watchdog=False)
    return run_on("uvloop", ends.drive(module, LOAD, pipe))


# bare zenoh at both ends


@contextmanager
def bare_listener(*, shm: bool = True) -> Iterator[tuple[zenoh.Session, int]]:
    """A session, and the port where it accepts connections."""
    with zenoh.open(bare_config("peer", "listen", 0, shm=shm)) as session:
        yield session, port_of_session(session)


def port_of_session(session: zenoh.Session) -> int:
    """The port where a session with an admin space accepts connections."""
    answers = [each.ok for each in session.get(f"@/{session.zid()}/*") if each.ok is not None]
    (locator,) = [each for answer in answers for each in json.loads(answer.payload.to_bytes()).get("locators", [])]
    return int(locator.rpartition(":")[2])


def bare_client(port: int, *, shm: bool = True) -> zenoh.Session:
    """A session that connects to that port."""
    return zenoh.open(bare_config("client", "connect", port, shm=shm))


def bare_config(mode: str, way: str, port: int, *, shm: bool) -> zenoh.Config:
    config = zenoh.Config()
    config.insert_json5("transport/shared_memory/enabled", json.dumps(shm))
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("adminspace/enabled", "true")  # it is asked where it listens
    config.insert_json5("mode", json.dumps(mode))
    config.insert_json5(f"{way}/endpoints", json.dumps([f"tcp/127.0.0.1:{port}"]))
    return config


def _serve_bare(pipe: Connection) -> None:
    """Counts in a callback, and echoes in another one."""
    with bare_listener() as (session, port):
        _count_and_echo(session, port, pipe)


def _count_and_echo(session: zenoh.Session, port: int, pipe: Connection) -> None:
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
    pipe.send(port)
    done.wait()
    pipe.recv()
    del numbers, ping


def _drive_bare(port: int, pipe: Connection) -> Result:
    session = bare_client(port)
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
    with process(_serve_bare if bare else _serve_r2p) as server:
        drive = _drive_bare if bare else _drive_r2p
        return drive(server.recv(), server)


# A large network


def _populate(pipe: Connection) -> None:
    """50 modules that publish 10 topics each, and a router."""

    async def publish(node: r2p.Node, number: int) -> None:
        for topic in range(TOPICS):
            node.advertise(f"m{number}_{topic}", Sixteen)
        await asyncio.get_running_loop().create_future()

    async def main() -> None:
        router = r2p.Module("ROUTER", via=LISTEN.replace("peer", "router"), watchdog=False)
        async with AsyncExitStack() as stack:
            await stack.enter_async_context(router)
            for number in range(MODULES):
                module = r2p.Module(f"M{number}", via=connect(port_of(router)), watchdog=False)
                await stack.enter_async_context(module)
                module.start(publish, number, name="many")
            await asyncio.sleep(SETTLED)
            pipe.send(port_of(router))
            await asyncio.to_thread(pipe.recv)

    run_on("uvloop", main())


def _list_topics() -> tuple[float, int]:
    """Duration of `r2p topic list` in seconds, and the topics that it finds."""
    with process(_populate) as network:
        via = connect(network.recv())
        command = [sys.executable, "-c", "from r2p.tools.main import main; main()", "topic", "list", "--via", via]
        started = time.perf_counter()
        listed = subprocess.run(command, capture_output=True, check=True)
        return time.perf_counter() - started, sum(b'"m' in line for line in listed.stdout.splitlines())


def rows() -> Iterator[Row]:
    bare, _, bare_trips = _both(bare=True)
    ours, lost, trips = _both(bare=False)
    yield Row(
        "two processes over zenoh, typed, 64 bytes, into `async for`",
        f"{rate(ours)}, {lost} lost",
        f"bare callback that counts {rate(bare)}: {ours / bare:.2f}x",
        "250 k/s and 0.35x, none lost",
        ours >= 250e3 and ours >= 0.35 * bare and not lost,
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
