"""A gateway in a process of its own, between a robot's debug line and a PC: how much passes, types unknown."""

import asyncio
import multiprocessing
import socket
import time
from collections.abc import Iterator
from multiprocessing.connection import Connection

import r2p
from benchmarks.loops import run_on
from benchmarks.network import Eight
from benchmarks.table import Row, rate
from r2p.codecs import debug, management
from r2p.transports.tcp import TcpListenTransport
from r2p.transports.url import parse

MESSAGES = 200_192
BURST = 256

_REQUEST = 0x22


async def _gateway(pipe: Connection, out: str) -> None:
    """The process in the middle: says where it listens, and at the end how busy it was."""
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


def _robot(port: int, go: Connection) -> None:
    """Firmware: offers a topic, answers who wants it, then sends lines as fast as they are taken."""
    line = debug.encode(b"eight", bytes(32), 0)
    with socket.create_connection(("127.0.0.1", port)) as connection:

        def say(message: management.Management) -> None:
            connection.sendall(debug.encode(b"R2P", management.encode(message), 0))

        say(management.Alive("ROBOT"))
        say(management.Advertise("eight", 32))
        reader = debug.Reader()
        while not any(each.data[-1] == _REQUEST for each in reader.feed(connection.recv(65536))):
            pass
        say(management.SubscribeResponse("eight", 32))
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
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    gateway = context.Process(target=_gateway_process, args=(there, out), daemon=True)
    gateway.start()
    robot_port, pc_port = here.recv()
    go, gone = context.Pipe()
    robot = context.Process(target=_robot, args=(robot_port, gone), daemon=True)
    robot.start()
    try:
        here.send(None)
        before = here.recv()
        received, seconds = run_on("uvloop", _count(out if pc_port is None else f"tcp:127.0.0.1:{pc_port}", go))
        here.send(None)
        return received / max(seconds, 1e-9), MESSAGES - received, (here.recv() - before) / MESSAGES
    finally:
        for process in (robot, gateway):
            process.terminate()
            process.join()


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
