"""Bytes from one process to another and back, by r2p and by others: one interface for benchmarks of sizes and rates.

Each way is a `Way`: a coroutine that opens it in this process, and gives publish functions and callbacks by topic. What
works in threads of its own is called from the event loop's thread and calls back in its own thread, so it pays no hop:
bare callbacks are what a program without asyncio gets of it.
"""

import asyncio
import contextlib
import functools
import os
import struct
import threading
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Annotated, Any, NamedTuple, TypeVar

import zenoh

import r2p
from benchmarks.loops import run_on
from benchmarks.processes import process
from benchmarks.zenoh import LISTEN, bare_client, bare_listener, connect, port_of
from r2p.transports.tcp import TcpListenTransport
from r2p.transports.url import parse

LARGEST = 4 << 20
QUIET = 0.3
"""Seconds without another message after which a stream counts as over."""

LOST_AFTER = 1.0
"""Seconds after which a round trip without an answer is lost."""

_STAMP = struct.Struct("<Q")

Send = Callable[[bytes], Awaitable[object] | None]
Receive = Callable[[bytes], Awaitable[object] | None]
"""What it gives is waited for where there is an event loop."""


@functools.cache
def block(largest: int) -> type[r2p.Message]:
    """The type of bytes of any size up to `largest`."""
    data = Annotated[bytes, r2p.Max(largest)]
    return type("Block", (r2p.Message,), {"__annotations__": {"data": data}, "data": b"", "__module__": __name__})


class Open(NamedTuple):
    """One end: where others connect, how to make a publish function, and how to subscribe."""

    address: int
    advertise: Callable[[str], Coroutine[Any, Any, Send]]
    subscribe: Callable[[str, Receive], Awaitable[object]]


class Way(NamedTuple):
    """A name, and how to open one end: with None it listens, otherwise it connects to that address."""

    name: str
    open: Callable[[int | None, int], contextlib.AbstractAsyncContextManager[Open]]
    loop: str = "uvloop"


# r2p


def _r2p(kind: str) -> Callable[[int | None, int], contextlib.AbstractAsyncContextManager[Open]]:
    @contextlib.asynccontextmanager
    async def opened(port: int | None, largest: int) -> AsyncIterator[Open]:
        listening = TcpListenTransport(parse("tcp-listen:127.0.0.1:0"))
        if kind == "tcp":
            via: Any = listening if port is None else f"tcp:127.0.0.1:{port}"
        else:
            via = LISTEN if port is None else connect(port)
        module = r2p.Module("SERVER" if port is None else "CLIENT", via=[via], watchdog=False)
        async with module:
            node = module.start(_hold)
            yield Open(
                port_of(module) if port is None else 0,
                _advertiser(node, block(largest)),
                _subscriber(node, block(largest)),
            )

    return opened


async def _hold(_: r2p.Node) -> None:
    await asyncio.Event().wait()


def _advertiser(node: r2p.Node, kind: type[Any]) -> Callable[[str], Coroutine[Any, Any, Send]]:
    async def advertise(topic: str) -> Send:
        publisher = node.advertise(topic, kind)
        await publisher.wait_subscriber()
        return lambda data: publisher.publish(kind(data))

    return advertise


def _subscriber(node: r2p.Node, kind: type[Any]) -> Callable[[str, Receive], Awaitable[object]]:
    async def subscribe(topic: str, receive: Receive) -> None:
        subscriber = node.subscribe(topic, kind, queue=64)

        async def deliver() -> None:
            async for message in subscriber:
                sent = receive(message.data)
                if sent is not None:
                    await sent

        _keep(asyncio.create_task(deliver()))

    return subscribe


_kept: set[object] = set()


def _keep(what: object) -> None:
    """Hold what only this process's end lets go."""
    _kept.add(what)


# Peers


@contextlib.asynccontextmanager
async def _zenoh(port: int | None, _largest: int) -> AsyncIterator[Open]:
    """zenoh-python with callbacks in its own thread."""
    with contextlib.ExitStack() as stack:
        address = 0
        if port is None:
            session, address = stack.enter_context(bare_listener(shm=False))
        else:
            session = stack.enter_context(bare_client(port, shm=False))

        async def advertise(topic: str) -> Send:
            publisher = session.declare_publisher(topic, congestion_control=zenoh.CongestionControl.BLOCK)
            while not publisher.matching_status:  # noqa: ASYNC110  # it has no event
                await asyncio.sleep(0.01)
            return publisher.put

        async def subscribe(topic: str, receive: Receive) -> None:
            _keep(session.declare_subscriber(topic, lambda sample: receive(sample.payload.to_bytes())))

        yield Open(address, advertise, subscribe)


@contextlib.asynccontextmanager
async def _lcm(port: int | None, _largest: int) -> AsyncIterator[Open]:
    """LCM over UDP multicast that stays on this computer, and a thread that handles."""
    import lcm

    group = (os.getpid() if port is None else port) % 20_000 + 20_000
    node, ended = lcm.LCM(f"udpm://239.255.76.67:{group}?ttl=0"), threading.Event()

    def handle() -> None:
        while not ended.is_set():
            node.handle_timeout(100)

    async def advertise(topic: str) -> Send:
        await asyncio.sleep(QUIET)  # it has no discovery
        return lambda data: node.publish(topic, data)

    async def subscribe(topic: str, receive: Receive) -> None:
        def arrived(_channel: str, data: bytes) -> None:
            receive(data)

        node.subscribe(topic, arrived).set_queue_capacity(0)

    thread = threading.Thread(target=handle, daemon=True)
    thread.start()
    yield Open(group, advertise, subscribe)
    ended.set()


@contextlib.asynccontextmanager
async def _cyclonedds(port: int | None, _largest: int) -> AsyncIterator[Open]:
    """Cyclone DDS: reliable, all kept, on the loopback interface, with a listener."""
    from cyclonedds.core import Listener, Policy, Qos
    from cyclonedds.domain import Domain, DomainParticipant
    from cyclonedds.pub import DataWriter
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic
    from cyclonedds.util import duration

    number = (os.getpid() if port is None else port) % 200
    interface = '<NetworkInterface name="lo" multicast="true"/>'
    text = f"<CycloneDDS><Domain><General><Interfaces>{interface}</Interfaces></General></Domain></CycloneDDS>"
    domain = Domain(number, text)
    participant = DomainParticipant(number)
    qos = Qos(Policy.Reliability.Reliable(duration(seconds=10)), Policy.History.KeepAll)
    kind = _dds_type()

    def topic_of(name: str) -> Any:
        return Topic(participant, name, kind, qos=qos)

    async def advertise(topic: str) -> Send:
        writer = DataWriter(participant, topic_of(topic), qos=qos)
        while not writer.get_matched_subscriptions():  # noqa: ASYNC110  # it has no event
            await asyncio.sleep(0.01)
        return lambda data: writer.write(kind(data))

    async def subscribe(topic: str, receive: Receive) -> None:
        class Arrived(Listener):
            def on_data_available(self, reader: Any) -> None:
                for each in reader.take(100):
                    if each.sample_info.valid_data:  # not that the other end has left
                        receive(bytes(each.data))  # it gives a list

        _keep(DataReader(participant, topic_of(topic), qos=qos, listener=Arrived()))  # type: ignore[no-untyped-call]

    yield Open(number, advertise, subscribe)
    del domain


def _dds_type() -> Any:
    from cyclonedds.idl import IdlStruct
    from cyclonedds.idl.types import sequence, uint8

    @dataclass
    class Octets(IdlStruct, typename="Octets"):
        data: sequence[uint8]  # type: ignore[type-arg]  # it is not typed so

    return Octets


@contextlib.asynccontextmanager
async def _pycyphal2(port: int | None, _largest: int) -> AsyncIterator[Open]:
    """pycyphal 2 over UDP multicast on the loopback interface, best effort as it is by default."""
    from pycyphal2 import Instant, Node
    from pycyphal2.udp import UDPTransport

    node = Node.new(UDPTransport.new_loopback(), "server" if port is None else "client")

    async def advertise(topic: str) -> Send:
        publisher = node.advertise(topic)
        await asyncio.sleep(1.0)  # it says nothing of subscribers
        return lambda data: publisher(Instant.now() + 1.0, data)

    async def subscribe(topic: str, receive: Receive) -> None:
        subscriber = node.subscribe(topic)

        async def deliver() -> None:
            async for arrival in subscriber:
                sent = receive(bytes(arrival.message))
                if sent is not None:
                    await sent

        _keep(asyncio.create_task(deliver()))

    yield Open(0, advertise, subscribe)


WAYS = {
    way.name: way
    for way in (
        Way("r2p over TCP", _r2p("tcp")),
        Way("r2p over zenoh", _r2p("zenoh")),
        Way("zenoh-python", _zenoh),
        Way("LCM", _lcm),
        Way("cyclonedds", _cyclonedds),
        Way("pycyphal2", _pycyphal2, "asyncio"),
    )
}


# The other end


class Count(NamedTuple):
    """How many messages came since the last reset, seconds from the first to the last, and latencies (s) if wanted."""

    messages: int = 0
    seconds: float = 0.0
    latencies: tuple[float, ...] = ()


class _Counter:
    """Counts messages; `paced` ones begin with the instant of sending."""

    def __init__(self) -> None:
        self.reset("stream")

    def reset(self, mode: str) -> None:
        self._messages, self._first, self._last = 0, 0.0, 0.0
        self._latencies: list[float] = []
        self._paced = mode == "paced"

    def receive(self, data: bytes) -> None:
        self._last = time.perf_counter()
        if not self._messages:
            self._first = self._last
        self._messages += 1
        if self._paced:
            self._latencies.append((time.monotonic_ns() - _STAMP.unpack_from(data)[0]) / 1e9)

    def count(self) -> Count:
        return Count(self._messages, self._last - self._first, tuple(self._latencies))


def serve(pipe: Connection, name: str, largest: int) -> None:
    """The process that counts `counted`, and sends `there` `back`, until the pipe is closed."""

    async def main() -> None:
        async with WAYS[name].open(None, largest) as end:
            counter = _Counter()
            pipe.send(end.address)
            await end.subscribe("counted", counter.receive)
            await _echo(end)
            with contextlib.suppress(EOFError):
                while True:
                    asked = await asyncio.to_thread(pipe.recv)
                    if asked != "count":
                        counter.reset(asked)
                    pipe.send(counter.count())

    run_on(WAYS[name].loop, main())


async def _echo(end: Open) -> None:
    """Begin to send back as soon as there is a subscriber: what comes before that is dropped."""
    advertising = asyncio.create_task(end.advertise("back"))

    def echo(data: bytes) -> Awaitable[object] | None:
        return advertising.result()(data) if advertising.done() else None

    await end.subscribe("there", echo)


# This end


class Client:
    """The end that sends and measures."""

    def __init__(self, pipe: Connection, count: Send, ping: Send) -> None:
        self._pipe, self._count, self._ping = pipe, count, ping
        self._came, self._came_in_thread = asyncio.Event(), threading.Event()

    def answered(self, _: bytes) -> None:
        """Take what came back, in whichever thread."""
        if threading.current_thread() is threading.main_thread():
            self._came.set()
        else:
            self._came_in_thread.set()

    async def stream(self, size: int, seconds: float) -> tuple[int, Count]:
        """Send as many as are taken in that time, and wait until no more arrive: how many were sent, and came."""
        data, sent_by = bytes(size), 0
        self._ask("stream")
        until = time.perf_counter() + seconds
        while time.perf_counter() < until:
            sent_by += 1
            sent = self._count(data)
            if sent is not None:
                await sent
        return sent_by, await self._settled()

    async def pace(self, size: int, rate: float, seconds: float) -> Count:
        """Send at that rate, for so long: a sender that can't keep up sends less."""
        padding, sent_by, began = bytes(size - _STAMP.size), 0, time.perf_counter()
        self._ask("paced")
        while (now := time.perf_counter() - began) < seconds:
            if (ahead := sent_by / rate - now) > 0:
                await asyncio.sleep(ahead)
            sent_by += 1
            sent = self._count(_STAMP.pack(time.monotonic_ns()) + padding)
            if sent is not None:
                await sent
        return await self._settled()

    async def _settled(self) -> Count:
        before = Count()
        while True:
            await asyncio.sleep(QUIET)
            count: Count = self._ask("count")
            if count.messages == before.messages:
                return count
            before = count

    def _ask(self, what: str) -> Any:
        self._pipe.send(what)
        return self._pipe.recv()

    async def ping(self, size: int, rounds: int, limit: float = 20.0) -> list[float]:
        """Seconds of round trips, one after the other; fewer where one is lost or `limit` seconds are over."""
        data, trips = bytes(size), list[float]()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(limit):
                for _ in range(rounds):
                    self._came.clear()
                    at = time.perf_counter()
                    await self._there_and_back(data)
                    trips.append(time.perf_counter() - at)
        return trips

    async def _there_and_back(self, data: bytes) -> None:
        sent = self._ping(data)
        if sent is not None:
            await sent
            await self._came.wait()
            return
        if not self._came_in_thread.wait(LOST_AFTER):  # blocks the loop, in which nothing else runs
            raise TimeoutError
        self._came_in_thread.clear()


T = TypeVar("T")


def measure(name: str, use: Callable[[Client], Coroutine[Any, Any, T]], largest: int = LARGEST) -> T:
    """What `use` gives with a client, and a server in a process of its own; `largest`: bytes of a message."""

    async def main(port: int, pipe: Connection) -> T:
        async with WAYS[name].open(port, largest) as end:
            came: list[Client] = []
            await end.subscribe("back", lambda data: came[0].answered(data) if came else None)
            client = Client(pipe, await end.advertise("counted"), await end.advertise("there"))
            came.append(client)
            await _answers(client)
            return await use(client)

    with process(serve, name, largest) as server:
        return run_on(WAYS[name].loop, main(server.recv(), server))


async def _answers(client: Client) -> None:
    """Wait until the way back is there."""
    while not await client.ping(64, 1, LOST_AFTER):
        pass
