"""ROS 1 on loopback, 60 bytes: r2p and rospy, each publishing to each, and round trips beside a bare echo."""

import asyncio
import contextlib
import functools
import subprocess
import tempfile
import time
from collections.abc import AsyncIterator, Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from statistics import median
from typing import Annotated

import r2p
from benchmarks import ends
from benchmarks.ends import Result
from benchmarks.loops import run_on
from benchmarks.processes import process
from benchmarks.table import Row, p50_p99, rate
from r2p.ros.middleware import RosArrival, RosEndpoint, RosType
from r2p.ros.ros1.environment import RosAddress
from r2p.ros.ros1.middleware import Ros1Middleware
from tests.ros.ros1 import packages
from tests.ros.ros1.programs import Ros1, RospyPeer
from tests.ros.ros1.recorder import Recorder

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
            runs = [_throughputs(ros1, one, two) for _ in range(RUNS)]
        into, out, theirs = (median(each) for each in zip(*runs, strict=True))
        ours, lost, trips = _both(ros1)
        yield _throughput("from rospy into async for", into, theirs)
        yield _throughput("from publish() into rospy", out, theirs)
        text = f"rospy to rospy {rate(theirs)}: {ours / theirs:.1f}x"
        yield Row("from publish() into async for, 60 bytes", f"{rate(ours)}, {lost} lost", text, "none lost", not lost)
        yield from _round_trips(trips, _plain_trips(ros1), _bare_trips(), _rospy_trips(ros1))


def _throughputs(ros1: Ros1, one: RospyPeer, two: RospyPeer) -> tuple[float, float, float]:
    """Messages a second from rospy, to rospy, and between two rospy nodes; right after each other."""
    return (
        run_on("uvloop", _from_rospy(ros1, one)),
        run_on("uvloop", _to_rospy(ros1, one)),
        run_on("uvloop", _rospy_to_rospy(one, two)),
    )


def _throughput(what: str, ours: float, theirs: float) -> Row:
    text = f"rospy to rospy {rate(theirs)}: {ours / theirs:.1f}x"
    return Row(f"{what}, 60 bytes", rate(ours), text, "1x", ours >= theirs)


def _round_trips(typed: list[float], plain: list[float], bare: list[float], rospy: list[float]) -> Iterator[Row]:
    (typical, worst), (echo, _), (theirs, _) = p50_p99(plain), p50_p99(bare), p50_p99(rospy)
    yield Row(
        "round trip over TCPROS, 60 bytes, p50, p99",
        f"{typical:.0f} us, {worst:.0f} us",
        f"bare echo, uvloop {echo:.0f} us: {typical / echo:.2f}x",
        "p50 within 1.3x",
        typical <= 1.3 * echo,
    )
    typical, worst = p50_p99(typed)
    yield Row(
        "... typed, between nodes of two modules",
        f"{typical:.0f} us, {worst:.0f} us",
        f"{typical / echo:.2f}x; between rospy's nodes {theirs:.0f} us",
        "p50 below rospy's",
        typical <= theirs,
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


class _Echo(Recorder):
    """Sends each message back, or waits for it."""

    def __init__(self, middleware: Ros1Middleware, to: str) -> None:
        super().__init__()
        self.joined = asyncio.Event()
        self.came: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._middleware = middleware
        self._to = to

    def received(self, messages: list[RosArrival]) -> None:
        for each in messages:
            if self._to:
                self._middleware.publish("/echo", self._to, each.data, 0)
            elif not self.came.done():
                self.came.set_result(None)

    def subscriber_joined(self, topic: str) -> None:
        self.joined.set()


def _plain_trips(ros1: Ros1) -> list[float]:
    """Round trips of TCPROS alone, from one middleware to another one and back."""
    with process(_echo_process, ros1.uri) as server:
        server.recv()
        return run_on("uvloop", _plain_ping(ros1.uri))


def _echo_process(pipe: Connection, uri: str) -> None:
    async def main() -> None:
        async with _middleware(uri, "/echo", "/plain_ping", "/plain_pong", echoes=True):
            pipe.send("ready")
            await asyncio.get_running_loop().create_future()

    run_on("uvloop", main())


async def _plain_ping(uri: str) -> list[float]:
    trips = []
    async with _middleware(uri, "/ping", "/plain_pong", "/plain_ping", echoes=False) as (middleware, user):
        await user.joined.wait()
        while not user.came.done():  # until both ways are connected
            middleware.publish("/ping", "/plain_ping", bytes(60), 0)
            await asyncio.sleep(0.05)
        for _ in range(ROUNDS):
            user.came = asyncio.get_running_loop().create_future()
            at = time.perf_counter()
            middleware.publish("/ping", "/plain_ping", bytes(60), 0)
            await user.came
            trips.append(time.perf_counter() - at)
    return trips


@contextlib.asynccontextmanager
async def _middleware(
    uri: str, node: str, takes: str, gives: str, *, echoes: bool
) -> AsyncIterator[tuple[Ros1Middleware, _Echo]]:
    kind = RosType(KIND, "992ce8a1687cec8c8bd883ec73ca41d1")
    middleware = Ros1Middleware(RosAddress(uri, "127.0.0.1", "127.0.0.1"))
    middleware.add_node(node)
    middleware.advertise(RosEndpoint(node, gives, kind))
    middleware.subscribe(RosEndpoint(node, takes, kind))
    user = _Echo(middleware, gives if echoes else "")
    running = asyncio.ensure_future(middleware.run(user, lambda: None))
    try:
        yield middleware, user
    finally:
        running.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await running


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
