"""A gateway from debug lines to zenoh, with subscribers that come and go: its processor time, and what it adds.

Firmware on one TCP connection sends N topics at 100 Hz. Each of 20 modules on zenoh subscribes to a part of them, goes
after some seconds, and comes again. All messages have the number and the instant at which they were sent.
"""

import asyncio
import socket
import struct
import time
from multiprocessing.connection import Connection
from typing import cast

import r2p
from benchmarks.growth.curve import Curve
from benchmarks.growth.fleet import Fleet, serve_usage
from benchmarks.growth.router_mesh import Sent
from benchmarks.growth.zenoh_modules import run_router
from benchmarks.loops import run_on
from benchmarks.processes import process
from benchmarks.table import percentile
from benchmarks.zenoh import connect
from r2p.codecs import debug, management
from r2p.transports.tcp import TcpListenTransport
from r2p.transports.url import parse

SIZES = (20, 40, 100)  # topics
RATE = 100.0  # Hz
SUBSCRIBERS = 20
STAYS, AWAY = 4.0, 0.5  # s
SETTLED, MEASURED = 4.0, 15.0  # s
_NUMBER_AT = struct.Struct("<QQ")


async def _gateway(pipe: Connection, port: int) -> None:
    listens = TcpListenTransport(parse("tcp-listen:127.0.0.1:0"))
    async with r2p.Module("GW", via=[listens, connect(port)], bridge=True, watchdog=False):
        pipe.send(listens.port)
        await serve_usage(pipe)


def _run_gateway(pipe: Connection, port: int) -> None:
    run_on("uvloop", _gateway(pipe, port))


class _Firmware(asyncio.Protocol):
    """Advertises topics, answers their subscribers, and sends the topics in turn."""

    def __init__(self, topics: int) -> None:
        self.names = [f"topic{number}".encode() for number in range(topics)]
        self._reader = debug.Reader()
        self._numbers = dict.fromkeys(self.names, 0)
        self._transport: asyncio.Transport | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.Transport", transport)
        transport.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def data_received(self, data: bytes) -> None:
        for line in self._reader.feed(data):
            if line.topic == b"R2P" and line.data[-1] == management.ManagementType.SUBSCRIBE_REQUEST:
                request = management.decode(line.data)
                assert isinstance(request, management.SubscribeRequest)
                self.say(management.SubscribeResponse(request.topic, _NUMBER_AT.size))

    def say(self, message: management.Management) -> None:
        assert self._transport is not None
        self._transport.write(debug.encode(b"R2P", management.encode(message), 0))

    def send(self, name: bytes) -> None:
        assert self._transport is not None
        self._numbers[name] += 1
        self._transport.write(debug.encode(name, _NUMBER_AT.pack(self._numbers[name], time.monotonic_ns()), 0))


async def _firmware(port: int, topics: int) -> None:
    loop = asyncio.get_running_loop()
    _, firmware = await loop.create_connection(lambda: _Firmware(topics), "127.0.0.1", port)
    began, count = loop.time(), 0
    while True:
        if count % int(RATE * topics) == 0:  # each second
            firmware.say(management.Alive("ROBOT"))
            for name in firmware.names:
                firmware.say(management.Advertise(name.decode(), _NUMBER_AT.size))
        firmware.send(firmware.names[count % topics])
        count += 1
        pause = began + count / (RATE * topics) - loop.time()
        if pause > 0 or count % 16 == 0:
            await asyncio.sleep(max(pause, 0))


def _run_firmware(pipe: Connection, port: int, topics: int) -> None:
    run_on("uvloop", _firmware(port, topics))


class _Counts:
    """What the subscribers have received: delays in s, and messages that are missing in between."""

    def __init__(self) -> None:
        self.delays: list[float] = []
        self.received = self.lost = 0

    async def count(self, node: r2p.Node, topic: str) -> None:
        last = 0
        async for message in node.subscribe(topic, Sent, queue=1000):
            self.delays.append((time.monotonic_ns() - message.at) / 1e9)
            self.received += 1
            self.lost += message.number - last - 1 if last else 0
            last = message.number


async def _come_and_go(number: int, port: int, topics: list[str], counts: _Counts) -> None:
    await asyncio.sleep(number * (STAYS + AWAY) / SUBSCRIBERS)
    while True:
        async with r2p.Module(f"PC{number}", via=connect(port), watchdog=False) as module:
            for each, topic in enumerate(topics):
                module.start(counts.count, topic, name=f"counts{each}")
            await asyncio.sleep(STAYS)
        await asyncio.sleep(AWAY)


async def _subscribers(pipe: Connection, port: int, topics: int) -> None:
    counts, each = _Counts(), topics // SUBSCRIBERS
    async with asyncio.TaskGroup() as tasks:
        for number in range(SUBSCRIBERS):
            names = [f"topic{number * each + place}" for place in range(each)]
            tasks.create_task(_come_and_go(number, port, names, counts))
        while True:
            await asyncio.to_thread(pipe.recv)
            pipe.send((counts.received, counts.lost, percentile(counts.delays or [0.0], 99)))
            counts.received, counts.lost = 0, 0
            counts.delays.clear()


def _run_subscribers(pipe: Connection, port: int, topics: int) -> None:
    run_on("uvloop", _subscribers(pipe, port, topics))


def measure(topics: int) -> tuple[float, int, int, float]:
    """Return the gateway's share of a core, the messages that came and that were lost, and the p99 of delays in s."""
    with process(run_router) as router:
        zenoh_port = router.recv()
        with (
            process(_run_gateway, zenoh_port) as gateway,
            process(_run_firmware, gateway.recv(), topics),
            process(_run_subscribers, zenoh_port, topics) as subscribers,
        ):
            time.sleep(SETTLED + STAYS + AWAY)
            subscribers.send("begin")
            subscribers.recv()
            share = Fleet([gateway]).share(MEASURED)
            subscribers.send("end")
            received, lost, delay = subscribers.recv()
            return share, received, lost, delay


def curves() -> list[Curve]:
    """Measure."""
    n_is = "topics at 100 Hz, 20 subscribers that come and go"
    found = [
        Curve("gateway: its processor time", n_is, "% of a core", goal=50.0),
        Curve("gateway: from the robot to the subscriber, p99", n_is, "ms"),
        Curve("gateway: messages lost", n_is, "of a million", goal=0.0),
    ]
    for topics in SIZES:
        share, received, lost, delay = measure(topics)
        values = 100 * share, 1e3 * delay, 1e6 * lost / max(received, 1)
        for curve, value in zip(found, values, strict=True):
            curve.points.append((topics, value))
    return found
