"""Delays of messages over real links, recorded once, and replayed in a memory network.

    python -m benchmarks.tiltone.delays

records `delays_zenoh.json` and `delays_tcp.json`: two processes of this computer, one link of loopback, messages of the
size of an effort at its rate, their times in one direction. That takes two minutes. "quiet" is the computer as it was,
"busy" has four processes that only count for each core, so that all of them compete for it.
"""

import asyncio
import contextlib
import multiprocessing
import os
import random
import sys
import time
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import NoReturn

import msgspec

import r2p
from benchmarks.processes import process
from r2p.msg import Effort2
from r2p.transports.memory import MemoryNetwork

COUNT = 2500
"""Messages in each recording."""
PERIOD = 0.01
"""Seconds from one to the next."""
LISTEN = {
    "zenoh": "zenoh:?mode=peer&listen=tcp/127.0.0.1:0&scouting=off&network=delays",
    "tcp": "tcp-listen:127.0.0.1:0",
}
CONNECT = {"zenoh": "zenoh:tcp/127.0.0.1:{}?scouting=off&network=delays", "tcp": "tcp:127.0.0.1:{}"}
SPINNERS = 4
"""Processes for each core that keep a busy computer busy."""

_SETTLED = 100  # messages before the first one that counts
_REST = 2.0  # s, after which what is not there is lost
_FOLDER = Path(__file__).parent
_US = 1_000_000


class Recording(msgspec.Struct, frozen=True):
    """The delays of messages that were sent one after the other."""

    load_average: float
    """Of the computer at the end: how many processes wanted a core in the last minute, with those of others."""
    delays: list[int | None]
    """us; None: lost."""


class Recordings(msgspec.Struct, frozen=True):
    """What was recorded of one kind of link."""

    transport: str
    python: str
    cores: int
    period: float
    """s."""
    quiet: Recording
    busy: Recording

    def of(self, state: str) -> Recording:
        """Return that of a quiet or a busy computer."""
        return self.busy if state == "busy" else self.quiet


def load(transport: str) -> Recordings:
    """Return what was recorded of "zenoh" or "tcp"."""
    return msgspec.json.decode((_FOLDER / f"delays_{transport}.json").read_bytes(), type=Recordings)


async def replay(recording: Recording, period: float, network: MemoryNetwork, numbers: random.Random) -> NoReturn:
    """Let a network delay and lose messages as it was recorded, from a random point on, and in that order.

    So a computer that stood still does so for all messages at once.
    """
    at = numbers.randrange(len(recording.delays))
    while True:
        delay = recording.delays[at]
        network.loss = float(delay is None)
        network.delay = (delay or 0) / _US
        at = (at + 1) % len(recording.delays)
        await asyncio.sleep(period)


def _now() -> int:
    """The clock that the processes of a computer share, us."""
    return time.monotonic_ns() // 1000


def _receive(pipe: Connection, transport: str) -> None:
    """Note the delays; in a process of its own."""
    delays: list[int | None] = [None] * COUNT

    async def note(node: r2p.Node) -> None:
        async for message in node.subscribe("effort", Effort2, queue=COUNT):
            number = message.value[0]
            if number >= 0:
                delays[number] = _now() % (1 << 32) - message.measured

    async def main() -> None:
        async with r2p.Module("RECEIVER", via=LISTEN[transport], watchdog=False) as module:
            module.start(note)
            ((_, address),) = module.addresses
            pipe.send(int(address.rpartition(":")[2]))
            await asyncio.to_thread(pipe.recv)
            pipe.send(delays)

    asyncio.run(main())


async def _send(transport: str, port: int) -> None:
    async def run(node: r2p.Node) -> None:
        publisher = node.advertise("effort", Effort2)
        await publisher.wait_subscriber()
        number = -_SETTLED
        async for _ in node.every(PERIOD):
            publisher.publish_nowait(Effort2((number, 0), _now() % (1 << 32)))
            number += 1
            if number == COUNT:
                return

    async with r2p.Module("SENDER", via=CONNECT[transport].format(port), watchdog=False) as module:
        module.start(run)
        await module.wait()
        await asyncio.sleep(_REST)


def _spin() -> None:
    while True:
        pass


@contextlib.contextmanager
def _spinning(count: int) -> Iterator[None]:
    """Keep the cores busy."""
    spinners = [multiprocessing.get_context("spawn").Process(target=_spin, daemon=True) for _ in range(count)]
    for each in spinners:
        each.start()
    try:
        yield
    finally:
        for each in spinners:
            each.terminate()
            each.join()


def record(transport: str, spinners: int = 0) -> Recording:
    """Record the delays of a link beside so many processes that only count."""
    with _spinning(spinners), process(_receive, transport) as pipe:
        asyncio.run(_send(transport, pipe.recv()))
        pipe.send(None)
        return Recording(round(os.getloadavg()[0], 1), pipe.recv())


def main() -> None:
    cores = os.cpu_count() or 1
    python = ".".join(map(str, sys.version_info[:2]))
    for transport in LISTEN:
        quiet, busy = record(transport), record(transport, SPINNERS * cores)
        recordings = Recordings(transport, python, cores, PERIOD, quiet, busy)
        (_FOLDER / f"delays_{transport}.json").write_bytes(msgspec.json.encode(recordings) + b"\n")


if __name__ == "__main__":
    main()
