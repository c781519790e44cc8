"""Foxglove's protocol: what a server takes of a core for 10 topics at 1 kHz, beside foxglove-sdk's for the same.

Three processes: a robot publishes over TCP, a server passes it on to a client in this process, which counts.
"""

import asyncio
import json
import logging
import struct
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager
from multiprocessing.connection import Connection
from typing import Any

import foxglove
from foxglove import Channel, Context, Schema
from websockets.asyncio.client import connect
from websockets.typing import Subprotocol

import r2p
from benchmarks.loops import run_on
from benchmarks.processes import process
from benchmarks.table import Row
from r2p.ros.ros2_schemas import ROS2MSG, schema_of
from r2p.ros.transcoding import transcoder
from r2p.runtime.immediate import ImmediateSubscriber
from r2p.runtime.sample import Sample
from r2p.transports.tcp import TcpListenTransport
from r2p.transports.url import parse
from r2p.web.foxglove.server import FoxgloveServer
from r2p.web.server import WebOptions, WebServer

TOPICS = 10
PERIOD = 0.001  # seconds between two messages of a topic
SECONDS = 5.0
SETTLED = 1.0  # seconds before the measurement
SHARE_MAX = 0.4

_HEAD = struct.Struct("<BIQ4xQ")


class Counted(r2p.Message):
    """40 bytes: a number, and others."""

    number: r2p.u64 = 0
    values: tuple[r2p.f64, r2p.f64, r2p.f64, r2p.f64] = (0.0, 0.0, 0.0, 0.0)


def _names() -> list[str]:
    return [f"topic{number}" for number in range(TOPICS)]


async def _publish(pipe: Connection) -> None:
    transport = TcpListenTransport(parse("tcp-listen:127.0.0.1:0"))

    async def publish(node: r2p.Node) -> None:
        publishers = [node.advertise(name, Counted) for name in _names()]
        began, turn = time.perf_counter(), 0
        while True:
            turn += 1
            for publisher in publishers:
                await publisher.publish(Counted(turn))
            await asyncio.sleep(max(0.0, began + turn * PERIOD - time.perf_counter()))

    async with r2p.Module("ROBOT", via=[transport], watchdog=False) as module:
        pipe.send(transport.port)
        module.start(publish)
        await module.wait()


@asynccontextmanager
async def _r2p_server(module: r2p.Module) -> AsyncIterator[int]:
    async with FoxgloveServer(module) as server, WebServer(WebOptions(), {"/": server.endpoint}) as web:
        yield web.address[1]


@asynccontextmanager
async def _sdk_server(module: r2p.Module) -> AsyncIterator[int]:
    """foxglove-sdk with the same source: it has the messages as this module receives them."""
    context = Context()
    schema, to_cdr = schema_of(Counted), transcoder(Counted).to_cdr
    kind = Schema(name=schema.name, encoding=ROS2MSG, data=schema.text.encode())
    node = module.start(_idle)

    def passed_on(channel: Channel) -> Callable[[Sample], None]:
        return lambda sample: channel.log(to_cdr(sample.data)[0])

    for name in _names():
        channel = Channel(f"/{name}", schema=kind, message_encoding="cdr", context=context)
        ImmediateSubscriber(module.space, node, passed_on(channel), lossy=True).open(name, None)
    server = foxglove.start_server(port=0, context=context)
    try:
        yield server.port
    finally:
        server.stop()


async def _idle(node: r2p.Node) -> None:
    await asyncio.get_running_loop().create_future()


async def _serve(pipe: Connection, port: int, make: Callable[[r2p.Module], Any]) -> None:
    """The server's process: says where it listens, and then, asked twice, how busy it was."""
    async with (
        r2p.Module("SERVER", via=f"tcp:127.0.0.1:{port}", observer=True, watchdog=False) as module,
        make(module) as listens,
    ):
        pipe.send(listens)
        for _ in range(2):
            await asyncio.to_thread(pipe.recv)
            pipe.send((time.process_time(), time.perf_counter()))
        await asyncio.to_thread(pipe.recv)


def _process(pipe: Connection, main: Callable[..., Any], *args: object) -> None:
    logging.disable()
    run_on("uvloop", main(pipe, *args))


async def _count(port: int, server: Connection) -> tuple[float, int, int]:
    """Return the server's share of a core, the messages that were received meanwhile, and those that were not."""
    received = lost = 0
    last: dict[int, int] = {}
    wanted = {f"/{name}" for name in _names()}

    async def read(client: Any) -> None:
        nonlocal received, lost
        async for message in client:
            if isinstance(message, str):
                text = json.loads(message)
                channels = [each["id"] for each in text.get("channels", ()) if each["topic"] in wanted]
                subscriptions = [{"id": each, "channelId": each} for each in channels]
                await client.send(json.dumps({"op": "subscribe", "subscriptions": subscriptions}))
                continue
            _, subscription, _, number = _HEAD.unpack_from(message)
            before = last.get(subscription, number - 1)
            last[subscription] = number
            received += 1
            lost += number - before - 1

    url = f"ws://127.0.0.1:{port}"
    async with connect(url, subprotocols=[Subprotocol("foxglove.sdk.v1")], compression=None, max_size=None) as client:
        reading = asyncio.create_task(read(client))
        while len(last) < TOPICS:  # noqa: ASYNC110 - nothing is measured yet
            await asyncio.sleep(0.05)
        await asyncio.sleep(SETTLED)
        server.send("begin")
        busy, began = await asyncio.to_thread(server.recv)
        received = lost = 0
        await asyncio.sleep(SECONDS)
        server.send("end")
        busy_then, ended = await asyncio.to_thread(server.recv)
        counts = received, lost
        reading.cancel()
        return (busy_then - busy) / (ended - began), *counts


def _measured(make: Callable[[r2p.Module], Any]) -> tuple[float, int, int]:
    with process(_process, _publish) as robot, process(_process, _serve, robot.recv(), make) as server:
        return run_on("uvloop", _count(server.recv(), server))


def rows() -> Iterator[Row]:
    share, received, lost = _measured(_r2p_server)
    sdk_share, sdk_received, sdk_lost = _measured(_sdk_server)
    yield Row(
        f"Foxglove client, {TOPICS} topics at {1 / PERIOD / 1e3:g} kHz, 40 bytes",
        f"{share:.0%} of a core, {received / SECONDS / 1e3:.1f} k/s, {lost} lost",
        f"foxglove-sdk {sdk_share:.0%}, {sdk_received / SECONDS / 1e3:.1f} k/s, {sdk_lost} lost",
        f"under {SHARE_MAX:.0%}, 0 lost",
        share < SHARE_MAX and not lost,
    )
