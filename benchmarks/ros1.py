"""ROS 1 on loopback, 60 bytes: r2p and rospy, each publishing to each, and round trips beside a bare echo."""

import asyncio
import contextlib
import functools
import subprocess
import tempfile
import time
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Annotated

import r2p
from benchmarks import ends
from benchmarks.ends import Result
from benchmarks.loops import run_on
from benchmarks.processes import process
from benchmarks.table import Row, p50_p99, rate, typical
from tests.ros.ros1 import packages
from tests.ros.ros1.programs import Ros1, RospyPeer

MESSAGES = 50_000
ROUNDS = 5_000
RUNS = 3
KIND = "std_msgs/String"


class Text(r2p.Message, name=KIND):
    """60 bytes, of which 4 are the length."""

    data: Annotated[str, r2p.Max(1000)] = "x" * 56


MESSAGE = Text()
LOAD = ends.Load(MESSAGE, MESSAGES, ROUNDS)
BYTES = 4 + 60  # with the length before each message


def rows() -> Iterator[Row]:
    usr = packages.find()
    if isinstance(usr, str):
        yield Row("ROS 1", "skipped", usr, "", None)
        return
    with tempfile.TemporaryDirectory() as home, contextlib.closing(Ros1(usr, Path(home))) as ros1:
        with ros1.peer("one") as one, ros1.peer("two") as two:
            theirs = typical(RUNS, lambda: run_on("uvloop", _rospy_to_rospy(one, two)))
            to_rospy = typical(RUNS, lambda: run_on("uvloop", _to_rospy(ros1, one)))
            from_rospy = typical(RUNS, lambda: run_on("uvloop", _from_rospy(ros1, one)))
        ours, lost, trips = _both(ros1)
        yield _throughput("TCPROS into async for, from r2p", ours, lost, "into a rospy callback", to_rospy)
        yield _throughput("TCPROS out of publish(), to r2p", ours, lost, "out of rospy's publish()", from_rospy)
        yield Row("rospy to rospy, 60 bytes", rate(theirs), f"r2p to r2p {ours / theirs:.1f}x", "", None)
        yield _round_trip(trips, _bare_trips(), _rospy_trips(ros1))


def _throughput(what: str, ours: float, lost: int, baseline: str, theirs: float) -> Row:
    text = f"{baseline} {rate(theirs)}: {ours / theirs:.1f}x"
    return Row(f"{what}, 60 bytes", f"{rate(ours)}, {lost} lost", text, "1x", ours >= theirs and not lost)


def _round_trip(ours: list[float], bare: list[float], rospy: list[float]) -> Row:
    (median, worst), (echo, _), (theirs, _) = p50_p99(ours), p50_p99(bare), p50_p99(rospy)
    return Row(
        "round trip over TCPROS, typed, 60 bytes, p50, p99",
        f"{median:.0f} us, {worst:.0f} us",
        f"bare echo, uvloop {echo:.0f} us: {median / echo:.2f}x, rospy {theirs:.0f} us",
        "p50 within 1.3x",
        median <= 1.3 * echo,
    )


# r2p to r2p, two processes


def _both(ros1: Ros1) -> Result:
    with process(_server_process, ros1.uri) as server:
        server.recv()
        return run_on("uvloop", ends.drive(_module("CLIENT", ros1.uri), LOAD, server))


def _server_process(pipe: Connection, uri: str) -> None:
    run_on("uvloop", ends.serve(_module("SERVER", uri), LOAD, pipe, lambda: uri))


def _module(name: str, uri: str) -> r2p.Module:
    return r2p.Module(name, via=f"ros1:{uri},host=127.0.0.1", watchdog=False)


# r2p and rospy


async def _to_rospy(ros1: Ros1, peer: RospyPeer) -> float:
    """Messages a second that rospy gets of r2p."""
    await peer.do("subscribe", topic="/to_rospy", type=KIND, count_only=True)
    took = 0.0

    async def publish(node: r2p.Node) -> None:
        nonlocal took
        publisher = node.advertise("to_rospy", Text)
        await publisher.wait_subscriber()
        began = time.perf_counter()
        for _ in range(MESSAGES):
            await publisher.publish(MESSAGE)
        await peer.do("counted", topic="/to_rospy", count=MESSAGES)
        took = time.perf_counter() - began

    async with _module("OUT", ros1.uri) as module:
        module.start(publish)
        await module.wait()
    await peer.do("unsubscribe", topic="/to_rospy")
    return MESSAGES / took


async def _from_rospy(ros1: Ros1, peer: RospyPeer) -> float:
    """Messages a second that r2p gets of rospy, whose publish() waits for the socket: else it loses messages."""
    await peer.do("advertise", topic="/from_rospy", type=KIND, queue=None)
    took = 0.0

    async def receive(node: r2p.Node) -> None:
        nonlocal took
        subscriber = node.subscribe("from_rospy", Text, queue=64)
        await peer.do("connected", topic="/from_rospy")
        publishing = peer.begin("publish", topic="/from_rospy", fields={"data": MESSAGE.data}, count=MESSAGES)
        left, began = MESSAGES, 0.0
        async for _ in subscriber:
            began = began or time.perf_counter()
            left -= 1
            if not left:
                break
        took = time.perf_counter() - began
        await asyncio.wrap_future(publishing)

    async with _module("IN", ros1.uri) as module:
        module.start(receive)
        await module.wait()
    await peer.do("unadvertise", topic="/from_rospy")
    return MESSAGES / took


async def _rospy_to_rospy(one: RospyPeer, two: RospyPeer) -> float:
    await two.do("subscribe", topic="/rospy", type=KIND, count_only=True)
    await one.do("advertise", topic="/rospy", type=KIND, queue=None)
    await one.do("connected", topic="/rospy")
    began = time.perf_counter()
    publishing = one.begin("publish", topic="/rospy", fields={"data": MESSAGE.data}, count=MESSAGES)
    await two.do("counted", topic="/rospy", count=MESSAGES)
    took = time.perf_counter() - began
    await asyncio.wrap_future(publishing)
    await one.do("unadvertise", topic="/rospy")
    await two.do("unsubscribe", topic="/rospy")
    return MESSAGES / took


# Round trips


def _rospy_trips(ros1: Ros1) -> list[float]:
    run = functools.partial(subprocess.Popen, env=ros1.environment, stdout=subprocess.PIPE, text=True)
    script = str(Path(__file__).with_name("rospy_ends.py"))
    with run([packages.PYTHON, script, "echo"], stdin=subprocess.PIPE) as echo:
        assert echo.stdout
        echo.stdout.readline()
        with run([packages.PYTHON, script, "ping", str(ROUNDS)]) as ping:
            assert ping.stdout
            trips = [float(line) for line in ping.stdout]
        echo.kill()
    return trips


def _bare_trips() -> list[float]:
    with process(_bare_process) as server:
        return run_on("uvloop", _bare_ping(server.recv()))


def _bare_process(pipe: Connection) -> None:
    run_on("uvloop", _bare_echo(pipe))


async def _bare_echo(pipe: Connection) -> None:
    async def handle(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(asyncio.IncompleteReadError):
            while True:
                writer.write(await reader.readexactly(BYTES))

    server = await asyncio.start_server(handle, "127.0.0.1", 0)
    pipe.send(server.sockets[0].getsockname()[1])
    await server.serve_forever()


async def _bare_ping(port: int) -> list[float]:
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    data, trips = bytes(BYTES), []
    for _ in range(ROUNDS):
        at = time.perf_counter()
        writer.write(data)
        await reader.readexactly(BYTES)
        trips.append(time.perf_counter() - at)
    writer.close()
    return trips
