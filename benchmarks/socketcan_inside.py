"""Inside the user-mode kernel: `python -m benchmarks.socketcan_inside FILE` writes frames a second as JSON.

Bursts go into the socket's queue while the loop is blocked; the time to drain it is measured.
"""

import asyncio
import json
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Awaitable, Callable
from pathlib import Path

import r2p
from benchmarks.loops import run_on
from benchmarks.table import typical
from r2p.codecs import management

NAME = "vcan0"
BURST = 200
BURSTS = 25
RUNS = 3

_FRAME = struct.Struct("=IB3x8s")
_LAXITY = 30 << 23
_MESSAGE = 0x1707


class Eight(r2p.Message):
    """8 bytes."""

    number: r2p.u32 = 0
    value: r2p.f32 = 0.0


_DATA = Eight(number=7, value=1.5).encode()


def raw() -> socket.socket:
    sock = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    sock.setblocking(False)
    sock.bind((NAME,))
    return sock


def send(sock: socket.socket, message: int, data: bytes) -> None:
    parts = [data[at : at + 8] for at in range(0, len(data), 8)]
    for left, part in zip(reversed(range(len(parts))), parts, strict=True):
        identifier = socket.CAN_EFF_FLAG | _LAXITY | message << 7 | left
        sock.send(_FRAME.pack(identifier, len(part), part))


async def bursts(sender: socket.socket, arrived: Callable[[int], Awaitable[object]]) -> float:
    """Frames a second; `arrived(count)` waits until `count` have arrived in total."""
    spent = 0.0
    for burst in range(1, BURSTS + 1):
        for _ in range(BURST):
            send(sender, _MESSAGE, _DATA)
        began = time.perf_counter()
        await arrived(burst * BURST)
        spent += time.perf_counter() - began
    return BURST * BURSTS / spent


class Counter:
    """Counts, and wakes up waiters for a count."""

    def __init__(self) -> None:
        self.count = 0
        self._wanted = 0
        self._reached = asyncio.Event()

    def add(self, count: int = 1) -> None:
        self.count += count
        if self.count >= self._wanted:
            self._reached.set()

    async def reached(self, count: int) -> None:
        self._wanted = count
        if self.count < count:
            self._reached.clear()
            await self._reached.wait()


async def bare() -> float:
    """A loop that drains the socket, and decodes frames."""
    counter, loop = Counter(), asyncio.get_running_loop()
    with raw() as sock, raw() as sender:

        def drain() -> None:
            count_read = 0
            try:
                for _ in range(64):
                    _FRAME.unpack(sock.recv(16))
                    count_read += 1
            except BlockingIOError:
                pass
            counter.add(count_read)

        loop.add_reader(sock, drain)
        result = await bursts(sender, counter.reached)
        loop.remove_reader(sock)
    return result


async def notifier() -> float:
    """python-can, as its manual shows it."""
    import can

    counter = Counter()
    loop = asyncio.get_running_loop()
    with (
        can.Bus(interface="socketcan", channel=NAME) as bus,
        can.Notifier(bus, [lambda _: counter.add()], loop=loop),
        raw() as sender,
    ):
        return await bursts(sender, counter.reached)


async def ours() -> float:
    counter = Counter()

    async def consume(node: r2p.Node) -> None:
        async for _ in node.subscribe("eight", Eight, queue=2 * BURST):
            counter.add()

    with raw() as peer:
        async with r2p.Module("PC", via=f"rtcan:{NAME},profile=firmware-2014", watchdog=False) as module:
            module.start(consume)
            await publish(peer)
            while not subscribed():  # noqa: ASYNC110 - the kernel does not notify
                await asyncio.sleep(0.001)
            result = await bursts(peer, counter.reached)
            await module.stop()
    return result


async def publish(peer: socket.socket) -> None:
    """Be a firmware module with the topic, until it has a subscriber."""
    params = _MESSAGE.to_bytes(2, "little").ljust(10, b"\0")
    size = len(_DATA)
    await wait_for(peer, management.Alive)
    send(peer, 0, management.encode(management.Advertise("eight", size)))
    await wait_for(peer, management.SubscribeRequest)
    send(peer, 0, management.encode(management.SubscribeResponse("eight", size, 5, params)))


def subscribed() -> bool:
    """Whether the kernel passes the topic's frames to anybody."""
    return f"{_MESSAGE << 7:07x}" in Path("/proc/net/can/rcvlist_fil").read_text(encoding="ascii").lower()


async def wait_for(peer: socket.socket, kind: type) -> None:
    """Wait for a management message."""
    loop, parts = asyncio.get_running_loop(), b""
    while True:
        identifier, length, data = _FRAME.unpack(await loop.sock_recv(peer, 16))
        parts += data[:length]
        if not identifier & 0x7F:
            if isinstance(management.decode(parts), kind):
                return
            parts = b""


def main(file: str) -> None:
    subprocess.run(("ip", "link", "add", "dev", NAME, "up", "type", "vcan"), check=True)
    results = {
        "bare": typical(RUNS, lambda: run_on("asyncio", bare())),
        "notifier": typical(RUNS, lambda: run_on("asyncio", notifier())),
        "asyncio": typical(RUNS, lambda: run_on("asyncio", ours())),
        "uvloop": typical(RUNS, lambda: run_on("uvloop", ours())),
    }
    Path(file).write_text(json.dumps(results), encoding="ascii")


if __name__ == "__main__":
    main(sys.argv[1])
