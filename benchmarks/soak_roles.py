"""The processes of the soak: a robot, a gateway, a PC, short-lived subscribers, and a hostile client.

Each answers `report` on its pipe with its counters, and ends with its pipe. The robot and the short-lived subscribers
accept `stop` before that.
"""

import asyncio
import logging
import os
import random
import socket
import struct
import time
from collections import Counter
from collections.abc import Callable, Coroutine
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any

import r2p
from benchmarks.loops import run_on
from r2p.codecs import debug, management
from r2p.testing.network import node_in
from r2p.transports.tcp import TcpListenTransport
from r2p.transports.url import parse

TOPIC = "soak"
LIFE = 0.2
"""Seconds that a short-lived subscriber exists."""
AT_ONCE = 2
"""Lives at one time: a subscriber of a lasting module, and one of a module that joins and leaves with it."""

_LISTEN = "zenoh:?mode=router&listen=tcp/127.0.0.1:0&scouting=off&network=soak"
_QUEUE = 4096
_TICK = 0.01  # s


class Numbered(r2p.Message):
    """32 bytes; gaps in the numbers are losses."""

    number: r2p.u64 = 0
    rest: tuple[r2p.u64, r2p.u64, r2p.u64] = (0, 0, 0)


class Account:
    """Counts what one subscriber received, and the numbers it missed between its first and its last message."""

    def __init__(self) -> None:
        self.received = 0
        self.missing = 0
        self.disorder = 0
        self.last = 0

    def add(self, number: int) -> None:
        self.received += 1
        if self.last:
            self.missing += max(0, number - self.last - 1)
            self.disorder += number <= self.last
        self.last = number


def losses(module: r2p.Module) -> dict[str, int]:
    """Return the losses of all links of a module, by reason."""
    return dict(sum((each.losses for each in module.links), Counter[str]()))


def connect(port: int) -> str:
    """Return the URL for subscribers."""
    return f"zenoh:tcp/127.0.0.1:{port}?scouting=off&network=soak"


async def _asked(pipe: Connection) -> Any:
    """Wait for a request of the parent; EOFError when that has ended."""
    return await asyncio.to_thread(pipe.recv)


def quietly(target: Callable[..., Coroutine[Any, Any, None]], *args: Any) -> None:
    """Run the main of a process without its log, which would have hundreds of lines a second."""
    logging.disable()
    run_on("uvloop", target(*args))


# The gateway


def gateway(pipe: Connection) -> None:
    quietly(_gateway, pipe)


async def _gateway(pipe: Connection) -> None:
    lines = TcpListenTransport(parse("tcp-listen:127.0.0.1:0"))
    async with r2p.Module("GW", via=[lines, _LISTEN], bridge=True, watchdog=False) as module:
        (port,) = (int(address.rpartition(":")[2]) for url, address in module.addresses if url.startswith("zenoh"))
        pipe.send((os.getpid(), lines.port, port))
        with suppress(EOFError):
            while await _asked(pipe) == "report":
                pipe.send(_forwarded(module))


def _forwarded(module: r2p.Module) -> dict[str, Any]:
    statistics = module.gateway_statistics()
    routes = [each for each in statistics.routes if each.topic == TOPIC]
    return {
        "links": {each.name: (each.stats.sent, each.stats.received, dict(each.losses)) for each in module.links},
        "routes": [
            (each.source, each.target, each.forwarded, sum(each.dropped.values()), each.dropped) for each in routes
        ],
        "ports": {each.link: sum(each.dropped.values()) for each in statistics.ports},
    }


# The robot


def robot(pipe: Connection, port: int, rate: float) -> None:
    quietly(_robot, pipe, port, rate)


async def _robot(pipe: Connection, port: int, rate: float) -> None:
    """Publish `rate` messages per second, 0: as fast as possible."""
    going = asyncio.Event()
    going.set()
    publisher: r2p.Publisher[Numbered] | None = None

    async def publish(node: r2p.Node) -> None:
        nonlocal publisher
        publisher = node.advertise(TOPIC, Numbered)
        await publisher.wait_subscriber()
        ticks, each = aiter(node.every(_TICK)), max(1, round(rate * _TICK))
        while going.is_set():
            for _ in range(each):
                await publisher.publish(Numbered(publisher.sent + 1))
            if rate:
                await anext(ticks)

    async with r2p.Module("ROBOT", via=f"tcp:127.0.0.1:{port}", watchdog=False) as module:
        module.start(publish)
        pipe.send(os.getpid())
        with suppress(EOFError):
            while (asked := await _asked(pipe)) != "end":
                if asked == "stop":
                    going.clear()
                assert publisher is not None
                (link,) = module.links
                pipe.send(
                    {
                        "published": publisher.sent,
                        "missed": publisher.missed,
                        "sent": link.stats.sent,
                        "ups": link.stats.ups,
                        "losses": dict(link.losses),
                    }
                )


# The PC


def pc(pipe: Connection, port: int) -> None:
    quietly(_pc, pipe, port)


async def _pc(pipe: Connection, port: int) -> None:
    account = Account()
    subscriber: r2p.Subscriber[Numbered] | None = None

    async def count(node: r2p.Node) -> None:
        nonlocal subscriber
        subscriber = node.subscribe(TOPIC, Numbered, queue=_QUEUE)
        async for message in subscriber:
            account.add(message.number)

    async with r2p.Module("PC", via=connect(port), watchdog=False) as module:
        module.start(count)
        pipe.send(os.getpid())
        with suppress(EOFError):
            while await _asked(pipe) == "report":
                assert subscriber is not None
                (link,) = module.links
                pipe.send(
                    {
                        "received": account.received,
                        "missing": account.missing,
                        "disorder": account.disorder,
                        "first": account.last - account.received - account.missing + 1,
                        "link": link.stats.received,
                        "ups": link.stats.ups,
                        "losses": dict(link.losses),
                        "queue": subscriber.lost + subscriber.stale + subscriber.undecodable + len(subscriber.queue),
                        "lost": subscriber.lost,
                    }
                )


# Short-lived subscribers


class Lives:
    """The counters of all short-lived subscribers."""

    def __init__(self) -> None:
        self.lives = 0
        self.silent = 0
        """Lives without a message."""
        self.received = 0
        self.missing = 0
        """Messages between first and last of a life that it neither received nor counted: lost on the way to it."""
        self.disorder = 0
        self.worst = ""
        self._most = 0

    def add(self, account: Account, counted: int, lost: dict[str, int]) -> None:
        self.lives += 1
        self.silent += not account.received
        self.received += account.received
        self.disorder += account.disorder
        missing = max(0, account.missing - counted)  # a link counts, too, what was lost before the first message
        self.missing += missing
        if missing > self._most:
            self._most = missing
            self.worst = f"{account.missing} missing, {counted} counted, {lost}"


def churn(pipe: Connection, port: int) -> None:
    quietly(_churn, pipe, port)


async def _churn(pipe: Connection, port: int) -> None:
    """Run modules, and subscribers of one module, that exist for LIFE."""
    lives = Lives()
    async with r2p.Module("CHURN", via=connect(port), watchdog=False) as module, node_in(module) as node:
        pipe.send(os.getpid())
        tasks = [
            asyncio.create_task(_subscribers(node, module, lives)),
            asyncio.create_task(_modules(connect(port), lives)),
        ]
        with suppress(EOFError):
            while (asked := await _asked(pipe)) != "end":
                if asked == "stop":
                    for task in tasks:
                        task.cancel()
                    await asyncio.wait(tasks)
                pipe.send(vars(lives))


async def _subscribers(node: r2p.Node, module: r2p.Module, lives: Lives) -> None:
    while True:
        before = losses(module)
        account, lost = await _live(node)
        grown = {reason: count - before.get(reason, 0) for reason, count in losses(module).items()}
        lives.add(account, lost + sum(grown.values()), grown)


async def _modules(url: str, lives: Lives) -> None:
    while True:
        async with r2p.Module("GUEST", via=url, watchdog=False) as module, node_in(module) as node:
            account, lost = await _live(node)
            grown = losses(module)
            lives.add(account, lost + sum(grown.values()), grown)


async def _live(node: r2p.Node) -> tuple[Account, int]:
    """Run one subscriber; return what it received, and what it lost itself."""
    account = Account()
    async with node.subscribe(TOPIC, Numbered, queue=_QUEUE) as subscriber:
        with suppress(TimeoutError):
            async with asyncio.timeout(LIFE):
                async for message in subscriber:
                    account.add(message.number)
        return account, subscriber.lost


# The hostile client


def hostile(pipe: Connection, port: int, seed: int) -> None:
    """Send garbage, half lines and floods of management messages, and reconnect, until the pipe ends."""
    pipe.send(os.getpid())
    rng = random.Random(seed)
    connections = 0
    with suppress(EOFError):
        while True:
            if pipe.poll():
                pipe.recv()
                pipe.send(connections)
            connections += 1
            with suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=1.0) as connection:
                for _ in range(rng.randrange(1, 20)):
                    connection.sendall(rng.choice(_ATTACKS)(rng))
                    time.sleep(0.005)
                if rng.random() < 0.3:  # a reset instead of an end
                    connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))


def _line(message: management.Management) -> bytes:
    return debug.encode(b"R2P", management.encode(message), 0)


def _name(rng: random.Random) -> str:
    return f"t{rng.randrange(500)}"


def _garbage(rng: random.Random) -> bytes:
    return rng.randbytes(rng.randrange(1, 2000))


def _half_a_line(rng: random.Random) -> bytes:
    line = debug.encode(TOPIC.encode(), rng.randbytes(32), 0)
    return line[: rng.randrange(1, len(line))]


def _broken_line(rng: random.Random) -> bytes:
    line = bytearray(debug.encode(TOPIC.encode(), rng.randbytes(32), 0))
    line[rng.randrange(len(line))] ^= 1 << rng.randrange(7)
    return bytes(line)


def _flood(rng: random.Random) -> bytes:
    return b"".join(_line(_random_message(rng)) for _ in range(rng.randrange(1, 50)))


def _random_message(rng: random.Random) -> management.Management:
    name = _name(rng)
    return rng.choice(
        (
            management.Alive(f"M{rng.randrange(50)}"),
            management.Hello(f"M{rng.randrange(50)}", rng.getrandbits(32), 0, 0, rng.randrange(65536)),
            management.Advertise(name, rng.randrange(256)),
            management.SubscribeRequest(name, rng.randrange(256), rng.randrange(1, 256)),
            management.SubscribeResponse(name, rng.randrange(256)),
            management.Stop("GW"),
            management.Bridge(rng.getrandbits(32), 1, rng.getrandbits(16), 1, 1, bytes(12)),
        )
    )


def _wants_and_does_not_read(_: random.Random) -> bytes:
    return _line(management.SubscribeRequest(TOPIC, 32, 5))


_ATTACKS = (_garbage, _half_a_line, _broken_line, _flood, _flood, _wants_and_does_not_read)
