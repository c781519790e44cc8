"""A gateway from debug lines to zenoh, with subscribers that come and go: its processor time, and what it adds.

Firmware on one TCP connection sends N topics at 100 Hz. Each of 20 modules on zenoh subscribes to a part of them, goes
after some seconds, and comes again. All messages have the number and the instant at which they were sent.

What the gateway adds is seen by a bare zenoh subscriber. It takes one of the topics, and another one that the firmware
sends through a bare relay between the same two links, at the same time on the same busy machine.
"""

import asyncio
import socket
import struct
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import cast

import zenoh

import r2p
from benchmarks.growth.curve import Curve
from benchmarks.growth.fleet import Fleet, serve_usage
from benchmarks.growth.router_mesh import Sent
from benchmarks.growth.zenoh_modules import run_router
from benchmarks.loops import run_on
from benchmarks.processes import process
from benchmarks.table import percentile
from benchmarks.zenoh import bare_client, connect
from r2p.codecs import debug, management
from r2p.transports.tcp import TcpListenTransport
from r2p.transports.url import parse

SIZES = (20, 40, 100)  # topics
RATE = 100.0  # Hz
SUBSCRIBERS = 20
STAYS, AWAY = 4.0, 0.5  # s
SETTLED, MEASURED = 4.0, 15.0  # s
_NUMBER_AT = struct.Struct("<QQ")
_RELAYED = "bench/relayed"


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


async def _firmware(port: int, relay_port: int, topics: int) -> None:
    loop = asyncio.get_running_loop()
    _, firmware = await loop.create_connection(lambda: _Firmware(topics), "127.0.0.1", port)
    _, relayed = await loop.create_connection(lambda: _Firmware(1), "127.0.0.1", relay_port)
    began, count = loop.time(), 0
    while True:
        if count % topics == 0:
            relayed.send(*relayed.names)
        if count % int(RATE * topics) == 0:  # each second
            firmware.say(management.Alive("ROBOT"))
            for name in firmware.names:
                firmware.say(management.Advertise(name.decode(), _NUMBER_AT.size))
        firmware.send(firmware.names[count % topics])
        count += 1
        pause = began + count / (RATE * topics) - loop.time()
        if pause > 0 or count % 16 == 0:
            await asyncio.sleep(max(pause, 0))


def _run_firmware(pipe: Connection, port: int, relay_port: int, topics: int) -> None:
    run_on("uvloop", _firmware(port, relay_port, topics))


class _Relay(asyncio.Protocol):
    """The two links and nothing else: what a line carries is put into zenoh."""

    def __init__(self, put: Callable[[bytes], object]) -> None:
        self._reader = debug.Reader()
        self._put = put

    def data_received(self, data: bytes) -> None:
        for line in self._reader.feed(data):
            self._put(line.data)


async def _relay(pipe: Connection, port: int) -> None:
    with bare_client(port) as session:
        publisher = session.declare_publisher(_RELAYED)
        server = await asyncio.get_running_loop().create_server(lambda: _Relay(publisher.put), "127.0.0.1", 0)
        pipe.send(server.sockets[0].getsockname()[1])
        await asyncio.to_thread(pipe.recv)


def _run_relay(pipe: Connection, port: int) -> None:
    run_on("uvloop", _relay(pipe, port))


def _run_watcher(pipe: Connection, port: int) -> None:
    """Take one topic of the gateway and that of the relay; send the p99 of the delays of both, in s."""
    delays: tuple[list[float], list[float]] = [], []

    def arrived(sample: zenoh.Sample) -> None:
        now, data = time.monotonic_ns(), sample.payload.to_bytes()
        several = delays[str(sample.key_expr) == _RELAYED]
        several += [(now - at) / 1e9 for _, at in _NUMBER_AT.iter_unpack(data)]

    with bare_client(port) as session:
        declared = [session.declare_subscriber(key, arrived) for key in ("r2p/bench/topic/topic0", _RELAYED)]
        pipe.recv()
        for each in delays:
            each.clear()
        pipe.recv()
        pipe.send([percentile(each, 99) for each in delays])
        del declared


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


def measure(topics: int) -> tuple[float, float, float, float, float]:
    """Return the gateway's share of a core, the share of messages that were lost, and the p99 of delays in s: to those
    that come and go, to a bare subscriber, and to that from the bare relay.
    """
    with process(run_router) as router:
        zenoh_port = router.recv()
        with (
            process(_run_gateway, zenoh_port) as gateway,
            process(_run_relay, zenoh_port) as relay,
            process(_run_watcher, zenoh_port) as watcher,
            process(_run_firmware, gateway.recv(), relay.recv(), topics),
            process(_run_subscribers, zenoh_port, topics) as subscribers,
        ):
            time.sleep(SETTLED + STAYS + AWAY)
            subscribers.send("begin")
            subscribers.recv()
            watcher.send("begin")
            share = Fleet([gateway]).share(MEASURED)
            watcher.send("end")
            through, relayed = watcher.recv()
            subscribers.send("end")
            received, lost, delay = subscribers.recv()
            return share, lost / max(received, 1), delay, through, relayed


def curves() -> list[Curve]:
    """Measure."""
    n_is = "topics at 100 Hz, 20 subscribers that come and go"
    found = [
        Curve("gateway: its processor time", n_is, "% of a core", goal=50.0),
        Curve("gateway: messages lost", n_is, "of a million", goal=0.0),
        Curve("gateway: from the robot to a subscriber that comes and goes, p99", n_is, "ms"),
        Curve("gateway: from the robot to a bare subscriber, p99", n_is, "ms"),
        Curve("a bare relay in its place, p99", n_is, "ms"),
        Curve("what the gateway adds to the relay, p99", n_is, "ms", goal=2.0),
    ]
    for topics in SIZES:
        share, lost, delay, through, relayed = measure(topics)
        values = 100 * share, 1e6 * lost, 1e3 * delay, 1e3 * through, 1e3 * relayed, 1e3 * (through - relayed)
        for curve, value in zip(found, values, strict=True):
            curve.points.append((topics, value))
    return found
