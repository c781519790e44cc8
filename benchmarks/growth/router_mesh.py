"""zenoh routers in a line, whose last one is killed: s until a subscriber there has every message once again.

    publisher - router - router - ... - router - subscriber

The subscriber's configuration names the last two routers, so it has a way left. Messages of the time in between may be
lost; what is measured ends with the message from which on each comes exactly once.
"""

import asyncio
import contextlib
import json
import tempfile
import time
from multiprocessing.connection import Connection
from pathlib import Path

import zenoh

import r2p
from benchmarks.growth.curve import Curve
from benchmarks.loops import run_on
from benchmarks.processes import process
from benchmarks.zenoh import bare_config, connect, port_of_session
from r2p.transports.zenoh.config import LEASE_MS

SIZES = (3, 4, 6)
RATE = 100.0  # Hz
BEFORE, AFTER = 2.0, 5.0  # s for which messages are looked at

_CLIENT = '{mode: "client", connect: {endpoints: ENDPOINTS}, scouting: {multicast: {enabled: false}}}'


class Sent(r2p.Message):
    """The number of a message, and when it was sent (monotonic ns)."""

    number: r2p.u64 = 0
    at: r2p.u64 = 0


def _router(pipe: Connection, before: int | None) -> None:
    """Run a router that is connected to the port of the one before."""
    config = bare_config("router", "listen", 0, shm=False)
    config.insert_json5("transport/link/tx/lease", json.dumps(LEASE_MS))
    if before is not None:
        config.insert_json5("connect/endpoints", json.dumps([f"tcp/127.0.0.1:{before}"]))
    with zenoh.open(config) as session:
        pipe.send(port_of_session(session))
        pipe.recv()


def _publish(pipe: Connection, port: int) -> None:
    async def publish(node: r2p.Node) -> None:
        publisher, number = node.advertise("numbers", Sent), 0
        async for _ in node.every(1 / RATE):
            number += 1
            await publisher.publish(Sent(number=number, at=time.monotonic_ns()))

    async def main() -> None:
        async with r2p.Module("PUBLISHER", via=connect(port), watchdog=False) as module:
            module.start(publish)
            await asyncio.to_thread(pipe.recv)

    run_on("uvloop", main())


async def _subscribe(ports: list[int], killed: contextlib.ExitStack) -> list[Sent]:
    """Return the messages that came since the router was killed."""
    came: list[Sent] = []

    async def subscribe(node: r2p.Node) -> None:
        async for message in node.subscribe("numbers", Sent, queue=1000):
            came.append(message)

    endpoints = json.dumps([f"tcp/127.0.0.1:{port}" for port in ports])
    with tempfile.TemporaryDirectory() as folder:
        config = Path(folder) / "client.json5"
        config.write_text(_CLIENT.replace("ENDPOINTS", endpoints))
        async with r2p.Module("SUBSCRIBER", via=f"zenoh:?config={config}&network=bench", watchdog=False) as module:
            module.start(subscribe)
            while len(came) < BEFORE * RATE:  # noqa: ASYNC110 - there is no event
                await asyncio.sleep(0.02)
            before = len(came)
            await asyncio.to_thread(killed.close)
            await asyncio.sleep(AFTER)
            return came[before - 1 :]


def until_each_once(came: list[Sent]) -> float:
    """Return s from the first message, before the router was killed, until the one from which on each came once."""
    start = max((at for at in range(1, len(came)) if came[at].number != came[at - 1].number + 1), default=0)
    return (came[start].at - came[0].at) / 1e9


def measure(routers: int) -> float:
    """Return s until each message comes once again."""
    with contextlib.ExitStack() as stack:
        ports: list[int] = []
        for _ in range(routers - 1):
            ports.append(stack.enter_context(process(_router, ports[-1] if ports else None)).recv())
        killed = stack.enter_context(contextlib.ExitStack())
        ports.append(killed.enter_context(process(_router, ports[-1])).recv())
        stack.enter_context(process(_publish, ports[0]))
        came = run_on("uvloop", _subscribe([ports[-1], ports[-2]], killed))
        if len(came) < RATE:
            raise AssertionError(f"only {len(came)} messages came after a router was killed")
        return until_each_once(came)


def curves() -> list[Curve]:
    """Measure."""
    return [
        Curve(
            "zenoh routers in a line, the last one killed: each message once again",
            "routers",
            "s",
            [(routers, measure(routers)) for routers in SIZES],
            goal=2.0,
        )
    ]
