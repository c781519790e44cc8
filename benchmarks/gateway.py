"""A gateway between a robot and a PC: its throughput from a debug line, and the latency of a message from CAN."""

import asyncio
import contextlib
import itertools
import math
import socket
import statistics
import struct
import threading
import time
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection

import zenoh

import r2p
from benchmarks.loops import run_on
from benchmarks.network import Eight
from benchmarks.processes import process
from benchmarks.ros2 import route
from benchmarks.table import Row, p50_p99, rate
from benchmarks.zenoh import LISTEN, bare_client, bare_listener, connect, port_of
from r2p.clock import Ticker
from r2p.codecs import debug, management, rtcan
from r2p.codecs.rtcan import Frame
from r2p.sim.can import CanBus, CanNode
from r2p.sim.transport import SimCan
from r2p.transports.tcp import TcpListenTransport
from r2p.transports.url import parse

MESSAGES = 200_192
BURST = 256

PACED = 2000
RUNS = 3
PERIOD = 1_000_000  # ns
DEADLINE = 0.008  # s: before management, which has 10 ms

_STAMP = struct.Struct("<Q")


class Sent(r2p.Message):
    """8 bytes: one frame."""

    at: r2p.u64 = 0


# Throughput


async def _gateway(pipe: Connection, out: str) -> None:
    """The gateway's process: reports where it listens, and at the end how busy it was."""
    robot = TcpListenTransport(parse("tcp-listen:127.0.0.1:0"))
    pc = TcpListenTransport(parse("tcp-listen:127.0.0.1:0")) if out == "tcp" else out
    async with r2p.Module("GW", via=[robot, pc], bridge=True, watchdog=False):
        pipe.send((robot.port, pc.port if isinstance(pc, TcpListenTransport) else None))
        for _ in range(2):  # asked before and after
            await asyncio.to_thread(pipe.recv)
            pipe.send(time.process_time())
        await asyncio.to_thread(pipe.recv)


def _gateway_process(pipe: Connection, out: str) -> None:
    run_on("uvloop", _gateway(pipe, out))


def _robot(go: Connection, port: int) -> None:
    """Firmware: advertises a topic, answers its subscriber, then sends lines as fast as possible."""
    line = debug.encode(b"eight", bytes(32), 0)
    with socket.create_connection(("127.0.0.1", port)) as connection:

        def send(message: management.Management) -> None:
            connection.sendall(debug.encode(b"R2P", management.encode(message), 0))

        send(management.Alive("ROBOT"))
        send(management.Advertise("eight", 32))
        reader = debug.Reader()
        request = management.ManagementType.SUBSCRIBE_REQUEST
        while not any(each.data[-1] == request for each in reader.feed(connection.recv(65536))):
            pass
        send(management.SubscribeResponse("eight", 32))
        go.recv()
        for _ in range(MESSAGES // BURST):
            connection.sendall(line * BURST)
        go.recv()


async def _count(via: str, started: Connection) -> tuple[int, float]:
    """The PC: how many came, and in how many seconds."""
    result = (0, 0.0)

    async def count(node: r2p.Node) -> None:
        nonlocal result
        subscriber = node.subscribe("eight", Eight, queue=4096)
        await subscriber.wait_publisher()
        await asyncio.sleep(1.0)
        started.send(None)
        received, began, last = 0, 0.0, 0.0
        while received < MESSAGES:
            try:
                await subscriber.fetch(timeout=3.0)
            except TimeoutError:
                break
            last = time.perf_counter()
            began = began or last
            received += 1
        result = (received, last - began)

    async with r2p.Module("PC", via=via, watchdog=False) as module:
        module.start(count)
        await module.wait()
    return result


def _through(out: str) -> tuple[float, int, float]:
    """Messages a second, how many were lost, and seconds of processor time that the gateway took for one."""
    with process(_gateway_process, out) as gateway:
        robot_port, pc_port = gateway.recv()
        with process(_robot, robot_port) as robot:
            gateway.send(None)
            before = gateway.recv()
            received, seconds = run_on("uvloop", _count(out if pc_port is None else f"tcp:127.0.0.1:{pc_port}", robot))
            gateway.send(None)
            return received / max(seconds, 1e-9), MESSAGES - received, (gateway.recv() - before) / MESSAGES


# Latency: each message carries the instant at which it was sent, by the monotonic clock of both processes


async def _tick(send: Callable[[bytes], object]) -> None:
    """Call it with the instant, 1000 times a second."""
    loop, over, left = asyncio.get_running_loop(), asyncio.Event(), PACED

    def due(*_: int) -> None:
        nonlocal left
        left -= 1
        if left >= 0:
            send(_STAMP.pack(time.monotonic_ns()))
        else:
            over.set()

    ticker = Ticker(loop, PERIOD, due)
    ticker.start()
    await over.wait()
    ticker.close()


def _bare_links(pipe: Connection) -> None:
    """The two links and nothing else: what a CAN controller receives is put into zenoh."""

    async def main() -> None:
        bus = CanBus(asyncio.get_running_loop())
        robot, gateway = bus.attach(CanNode("ROBOT")), bus.attach(CanNode("GW"))
        gateway.on_receive = lambda frame, _: publisher.put(frame.data)
        identifier = rtcan.encode_identifier(10, rtcan.message_id(rtcan.FIRST_TOPIC, 20))
        mailboxes = itertools.cycle(range(3))
        await _tick(lambda data: robot.request(Frame(identifier, data), next(mailboxes)))
        await asyncio.to_thread(pipe.recv)

    with bare_client(pipe.recv()) as session:
        pipe.recv()
        publisher = session.declare_publisher("bench/sent", express=True)
        while not publisher.matching_status:
            time.sleep(0.01)
        run_on("precise", main())


def _robot_and_gateway(pipe: Connection) -> None:
    """The same by r2p: a robot's module on a simulated bus, and a gateway to the link whose URL is sent first."""

    async def publish(node: r2p.Node) -> None:
        publisher = node.advertise("sent", Sent, r2p.Sporadic(deadline=DEADLINE, late="send"))
        await publisher.wait_subscriber()
        await asyncio.to_thread(pipe.recv)
        await _tick(lambda data: publisher.publish_nowait(Sent(at=_STAMP.unpack(data)[0])))
        await asyncio.to_thread(pipe.recv)

    async def main() -> None:
        bus = SimCan()
        async with (
            r2p.Module("GW", via=[bus.transport(), pipe.recv()], bridge=True, watchdog=False),
            r2p.Module("ROBOT", via=[bus.transport()], watchdog=False) as robot,
        ):
            robot.start(publish)
            await robot.wait()

    run_on("precise", main())


def _bare_pc(robot: Connection) -> list[float]:
    with bare_listener() as (session, port):
        return _receive_bare(robot, session, port)


def _bare_pc_behind(port: int) -> Callable[[Connection], list[float]]:
    """Return the same with a router in between, as ROS 2 has one."""

    def receive(robot: Connection) -> list[float]:
        with bare_client(port) as session:
            return _receive_bare(robot, session, port)

    return receive


def _receive_bare(robot: Connection, session: zenoh.Session, port: int) -> list[float]:
    delays: list[float] = []
    over = threading.Event()

    def arrived(sample: zenoh.Sample) -> None:
        delays.append((time.monotonic_ns() - _STAMP.unpack(sample.payload.to_bytes())[0]) / 1e9)
        if len(delays) == PACED:
            over.set()

    session.declare_subscriber("bench/sent", arrived)
    robot.send(port)
    robot.send(None)
    over.wait(2 * PACED * PERIOD / 1e9)
    return delays


def _pc(robot: Connection) -> list[float]:
    return _receive(robot, LISTEN, lambda module: connect(port_of(module)))


def _receive(robot: Connection, via: str, back: Callable[[r2p.Module], str]) -> list[float]:
    """Receive by a link what the robot sends, whose gateway gets the URL that `back` returns."""
    delays: list[float] = []

    async def receive(node: r2p.Node) -> None:
        subscriber = node.subscribe("sent", Sent, queue=64)
        await subscriber.wait_publisher()
        await asyncio.sleep(2.5)  # the gateway has found that there is no other one
        robot.send(None)
        with contextlib.suppress(TimeoutError):
            while len(delays) < PACED:
                message = await subscriber.fetch(timeout=3.0)
                delays.append((time.monotonic_ns() - message.at) / 1e9)

    async def main() -> None:
        async with r2p.Module("PC", via=via, watchdog=False) as module:
            robot.send(back(module))
            module.start(receive)
            await module.wait()

    run_on("uvloop", main())
    return delays


def _ros_pc(port: int) -> Callable[[Connection], list[float]]:
    via = f"ros2:tcp/127.0.0.1:{port}"
    return lambda robot: _receive(robot, via, lambda _: via)


def _delays(robot: Callable[[Connection], None], pc: Callable[[Connection], list[float]]) -> list[float]:
    """Seconds from the robot to the PC, of each message."""
    with process(robot) as pipe:
        return pc(pipe)


def rows() -> Iterator[Row]:
    for name, out in (("TCP", "tcp"), ("zenoh", "zenoh:?network=r2pbench")):
        throughput, lost, cost = _through(out)
        yield Row(
            f"gateway, debug TCP to {name}, 32 bytes, types unknown",
            f"{rate(throughput)}, {lost} lost",
            f"{cost * 1e6:.1f} us of the gateway's processor each",
            "60 k/s, none lost" if name == "zenoh" else "",
            throughput >= 60e3 and not lost if name == "zenoh" else None,
        )
    yield _latency("zenoh", "0.3 ms, 1 ms, none lost", (0.3, 1.0), _bare_pc, _pc)
    with process(route) as router:
        port = router.recv()
        yield _latency("ROS 2", "0.5 ms, none lost", (0.5, math.inf), _bare_pc_behind(port), _ros_pc(port))


def _latency(
    name: str,
    target: str,
    most: tuple[float, float],
    bare_pc: Callable[[Connection], list[float]],
    pc: Callable[[Connection], list[float]],
) -> Row:
    """Measure what a gateway adds from CAN to a link: `most` ms, p50 and p99."""
    runs = [(_delays(_bare_links, bare_pc), _delays(_robot_and_gateway, pc)) for _ in range(RUNS)]
    bare = [p50_p99(each, 1e-3) for each, _ in runs]
    added = [
        tuple(r2p_ms - bare_ms for r2p_ms, bare_ms in zip(p50_p99(ours, 1e-3), alone, strict=True))
        for (_, ours), alone in zip(runs, bare, strict=True)
    ]
    median, worst = (statistics.median(each) for each in zip(*added, strict=True))
    bare_median, bare_worst = (statistics.median(each) for each in zip(*bare, strict=True))
    lost = sum(PACED - len(ours) for _, ours in runs)
    return Row(
        f"1 kHz from CAN by gateway and {name}: r2p adds, p50, p99",
        f"{median:.2f} ms, {worst:.2f} ms, {lost} lost",
        f"the two links alone {bare_median:.2f} ms, {bare_worst:.2f} ms",
        target,
        median <= most[0] and worst <= most[1] and not lost,
    )
