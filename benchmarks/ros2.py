"""Two processes over ROS 2's way with zenoh, against r2p's own way with it, without batching: both through a router."""

import asyncio
import contextlib
import os
import random
import subprocess
import tempfile
import time
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import NamedTuple

import zenoh

import r2p
from benchmarks.loops import run_on
from benchmarks.processes import process
from benchmarks.table import Row, p50_p99, rate
from benchmarks.zenoh import MESSAGE, Sixteen, port_of_session
from r2p.ros.std_srvs import SetBool
from tests.ros.rclpy import install

MESSAGES = 100_000
ROUNDS = 3_000
CALLS = 1_000
_RCLPY = Path(__file__).with_name("rclpy_ends.py")
RUNS = 5
LOST_AFTER = 1.0  # seconds until a round trip counts as lost
SETTLED = 0.3  # seconds in which messages arrive that are on the way
OURS, ROS = "zenoh:tcp/127.0.0.1:{}?scouting=off&network=bench&batching=off", "ros2:tcp/127.0.0.1:{}"


class Count(r2p.Message):
    """How many messages came, and in which time (s)."""

    messages: r2p.u32 = 0
    seconds: r2p.f64 = 0.0


def route(pipe: Connection) -> None:
    """zenohd's own code, in the library."""
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", '["tcp/127.0.0.1:0"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("adminspace/enabled", "true")  # it is asked where it listens
    with zenoh.open(config) as session:
        pipe.send(port_of_session(session))
        pipe.recv()


def _serve(pipe: Connection, via: str) -> None:
    module = r2p.Module("SERVER", via=via, watchdog=False)

    async def main() -> None:
        async with module:
            for each in (_count, _echo, _switch):
                module.start(each)
            pipe.send("ready")
            await module.wait()

    run_on("uvloop", main())


async def _count(node: r2p.Node) -> None:
    """Count messages, and say how many there were when asked: ROS 2 may lose some."""
    numbers, ends = node.subscribe("numbers", Sixteen, queue=64), node.subscribe("end", Count)
    counts = node.advertise("count", Count)
    received, started, last = 0, 0.0, 0.0

    async def receive() -> None:
        nonlocal received, started, last
        async for _ in numbers:
            last = time.perf_counter()
            started = started or last
            received += 1

    task = asyncio.create_task(receive())
    async for _ in ends:
        await counts.publish(Count(messages=received, seconds=last - started))
    task.cancel()


async def _echo(node: r2p.Node) -> None:
    back, pings = node.advertise("pong", Sixteen), node.subscribe("ping", Sixteen)
    async for message in pings:
        await back.publish(message)


async def _switch(node: r2p.Node) -> None:
    async def handle(request: SetBool.Request) -> SetBool.Response:
        return SetBool.Response(success=request.data)

    node.serve("switch", SetBool, handle)
    while await node.spin():
        pass


class Measured(NamedTuple):
    """Messages a second and lost, round trips in seconds, and calls a second."""

    rate: float
    lost: int
    trips: list[float]
    calls: float


def _drive(via: str) -> Measured:
    module = r2p.Module("CLIENT", via=via, watchdog=False)
    found = Measured(0.0, 0, [], 0.0)

    async def run(node: r2p.Node) -> None:
        nonlocal found
        received = await _stream(node)
        lost = MESSAGES - received.messages
        found = Measured(received.messages / received.seconds, lost, await _ping(node), await _call(node))

    async def main() -> None:
        async with module:
            module.start(run)
            await module.wait()

    run_on("uvloop", main())
    return found


async def _stream(node: r2p.Node) -> Count:
    numbers, ends = node.advertise("numbers", Sixteen), node.advertise("end", Count)
    counts = node.subscribe("count", Count)
    for each in (numbers, ends):
        await each.wait_subscriber()
    await counts.wait_publisher()
    for _ in range(MESSAGES):
        await numbers.publish(MESSAGE)
    before = Count()
    while True:  # until no more arrive
        await asyncio.sleep(SETTLED)
        await ends.publish(Count())
        count = await counts.fetch()
        if count.messages == before.messages:
            return count
        before = count


async def _ping(node: r2p.Node) -> list[float]:
    publisher, answers = node.advertise("ping", Sixteen), node.subscribe("pong", Sixteen)
    await publisher.wait_subscriber()
    await answers.wait_publisher()
    trips = []
    for _ in range(ROUNDS):
        at = time.perf_counter()
        await publisher.publish(MESSAGE)
        with contextlib.suppress(TimeoutError):  # ROS 2 may lose one
            await answers.fetch(LOST_AFTER)
            trips.append(time.perf_counter() - at)
    return trips


async def _call(node: r2p.Node) -> float:
    """Calls a second, one after the other."""
    client = node.client("switch", SetBool)
    await client.ready()
    began = time.perf_counter()
    for _ in range(CALLS):
        await client.call(SetBool.Request(data=True))
    return CALLS / (time.perf_counter() - began)


def _measure(port: int, via: str) -> Measured:
    with process(_serve, via.format(port)) as server:
        server.recv()
        return _drive(via.format(port))


def rows() -> Iterator[Row]:
    with process(route) as router:
        port = router.recv()
        pairs = [(_measure(port, ROS), _measure(port, OURS)) for _ in range(RUNS)]
    # The run in the middle: on two cores, much depends on which of three processes runs when.
    ros, ours = sorted(pairs, key=lambda pair: pair[0].rate / pair[1].rate)[RUNS // 2]
    yield Row(
        "two processes over ROS 2 by zenoh, typed, 64 bytes, into `async for`",
        f"{rate(ros.rate)}, {ros.lost / MESSAGES:.0%} lost",  # nothing makes a publisher wait in ROS 2
        f"zenoh: without batching {rate(ours.rate)}: {ros.rate / ours.rate:.2f}x",
        "1/1.3 of it",
        ros.rate * 1.3 >= ours.rate,
    )
    (median, worst), (our_median, our_worst) = p50_p99(ros.trips), p50_p99(ours.trips)
    yield Row(
        "round trip over ROS 2 by zenoh, typed, 64 bytes, p50, p99",
        f"{median:.0f} us, {worst:.0f} us",
        f"zenoh: {our_median:.0f} us, {our_worst:.0f} us: {median / our_median:.2f}x",
        "p50 within 1.3x",
        median <= 1.3 * our_median,
    )
    theirs = _rclpy_calls()
    yield Row(
        "calls over ROS 2 by zenoh, one after the other",
        f"{ros.calls:.0f}/s",
        f"zenoh: {ours.calls:.0f}/s; rclpy over Fast DDS {f'{theirs:.0f}/s' if theirs else 'is not here'}",
        "2x rclpy",
        ros.calls >= 2 * theirs if theirs else None,
    )


def _rclpy_calls() -> float:
    """Calls a second between two processes of rclpy, which need no router; 0 without it."""
    python = install.find()
    if isinstance(python, str):
        return 0.0
    domain = str(random.SystemRandom().randrange(1, 200))
    with tempfile.TemporaryDirectory() as folder:
        environ = {**os.environ, "ROS_DOMAIN_ID": domain, "ROS_LOCALHOST_ONLY": "1", "ROS_LOG_DIR": folder}
        server = subprocess.Popen(
            [python, _RCLPY, "serve"], env=environ, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
        )
        try:
            assert server.stdout is not None
            server.stdout.readline()
            called = subprocess.run(
                [python, _RCLPY, "call", str(CALLS)], env=environ, capture_output=True, check=True, timeout=60
            )
        finally:
            server.terminate()
            server.communicate()
        return float(called.stdout)
