"""Clients of one `tcp-listen:`, real r2p modules that subscribe to two topics at 10 Hz each: the cost of the server."""

import asyncio
import time
from collections.abc import Callable
from multiprocessing.connection import Connection

import r2p
from benchmarks.growth.curve import Curve
from benchmarks.growth.fleet import Fleet, fleet, ready, serve_usage
from benchmarks.loops import run_on
from benchmarks.processes import process
from r2p.msg import Led
from r2p.transports.tcp import TcpListenTransport
from r2p.transports.url import parse

SIZES = (64, 256, 1000)
CLIENT_PROCESSES = 4
RATE = 10.0  # Hz, of each topic
SETTLED, MEASURED = 5.0, 20.0  # s
LIMIT = 60.0  # s until all clients receive


async def _publish(node: r2p.Node) -> None:
    publishers = [node.advertise(topic, Led) for topic in ("left", "right")]
    async for _ in node.every(1 / RATE):
        for publisher in publishers:
            await publisher.publish(Led())


async def _server(pipe: Connection, clients: int) -> None:
    listens = TcpListenTransport(parse(f"tcp-listen:127.0.0.1:0,max_clients={clients + 8}"))
    async with r2p.Module("SERVER", via=listens, watchdog=False) as module:
        module.start(_publish)
        pipe.send(listens.port)
        await serve_usage(pipe)


def _run_server(pipe: Connection, clients: int) -> None:
    run_on("uvloop", _server(pipe, clients))


class _Client:
    """Counts what a module receives of both topics."""

    def __init__(self) -> None:
        self.received = {"left": 0, "right": 0}

    async def subscribe(self, node: r2p.Node) -> None:
        for topic in self.received:
            node.subscribe(topic, Led, callback=self._count(topic))
        while True:
            await node.spin()

    def _count(self, topic: str) -> Callable[[Led], None]:
        def count(_: Led) -> None:
            self.received[topic] += 1

        return count

    async def run(self, name: str, port: int) -> None:
        """Run the module for ever."""
        async with r2p.Module(name, via=f"tcp:127.0.0.1:{port}", watchdog=False) as module:
            module.start(self.subscribe)
            await asyncio.get_running_loop().create_future()


async def _clients(pipe: Connection, port: int, first: int, count: int) -> None:
    began, clients = time.perf_counter(), [_Client() for _ in range(count)]
    async with asyncio.TaskGroup() as tasks:
        for number, client in enumerate(clients):
            tasks.create_task(client.run(f"CLIENT{first + number}", port))
        while not all(all(each.received.values()) for each in clients):
            if time.perf_counter() > began + LIMIT:
                missing = sum(not all(each.received.values()) for each in clients)
                raise TimeoutError(f"{missing} of {count} clients do not receive both topics")
            await asyncio.sleep(0.1)
        pipe.send(time.perf_counter() - began)
        while True:
            await asyncio.to_thread(pipe.recv)
            pipe.send(sum(sum(each.received.values()) for each in clients))


def _run_clients(pipe: Connection, port: int, first: int, count: int) -> None:
    ready(pipe)
    run_on("uvloop", _clients(pipe, port, first, count))


def measure(clients: int) -> tuple[float, float, float]:
    """Return the server's share of a core, s until all clients receive, and the part of the messages that came."""
    with process(_run_server, clients) as server:
        port, each = server.recv(), clients // CLIENT_PROCESSES
        starts = [(port, number * each, each) for number in range(CLIENT_PROCESSES)]
        with fleet(_run_clients, starts) as workers:
            workers.begin()
            started = max(workers.results())
            time.sleep(SETTLED)
            before, began = _received(workers), time.perf_counter()
            share = Fleet([server]).share(MEASURED)
            seconds = time.perf_counter() - began
            return share, started, (_received(workers) - before) / (clients * 2 * RATE * seconds)


def _received(workers: Fleet) -> float:
    for pipe in workers.pipes:
        pipe.send("received")
    return sum(workers.results())


def curves() -> list[Curve]:
    """Measure."""
    found = [
        Curve("tcp-listen: the server's processor time", "clients with 2 topics at 10 Hz", "% of a core", goal=60.0),
        Curve("tcp-listen: until all receive", "clients with 2 topics at 10 Hz", "s"),
        Curve("tcp-listen: messages that come", "clients with 2 topics at 10 Hz", "%"),
    ]
    for clients in SIZES:
        share, started, came = measure(clients)
        for curve, value in zip(found, (100 * share, started, 100 * came), strict=True):
            curve.points.append((clients, value))
    return found
