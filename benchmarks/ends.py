"""Both ends of a link, r2p and in two processes: one counts a stream and echoes, the other one sends and measures."""

import asyncio
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Generic, NamedTuple, TypeVar

import r2p

M = TypeVar("M", bound=r2p.Message)

Result = tuple[float, int, list[float]]
"""Messages a second, messages lost, round trips in seconds."""


class Load(NamedTuple, Generic[M]):
    """What is sent: `message` so many times, then so many times there and back."""

    message: M
    messages: int
    rounds: int


async def serve(module: r2p.Module, load: Load[M], pipe: Connection, opened: Callable[[], object]) -> None:
    """Says what `opened` gives when it is there; then how many came of the stream, and how long it took."""
    kind = type(load.message)

    async def count(node: r2p.Node) -> None:
        left, started = load.messages, 0.0
        subscriber = node.subscribe("numbers", kind, queue=64)
        async for _ in subscriber:
            started = started or time.perf_counter()
            left -= 1
            if not left:
                break
        pipe.send((load.messages - left, subscriber.lost, time.perf_counter() - started))

    async def echo(node: r2p.Node) -> None:
        back, pings = node.advertise("pong", kind), node.subscribe("ping", kind)
        await back.wait_subscriber()
        async for message in pings:
            await back.publish(message)

    async with module:
        module.start(count)
        module.start(echo)
        pipe.send(opened())
        await module.wait()


async def drive(module: r2p.Module, load: Load[M], pipe: Connection) -> Result:
    """Stream, then ping."""
    trips: list[float] = []
    result = (0.0, 0)
    kind = type(load.message)

    async def run(node: r2p.Node) -> None:
        nonlocal result
        publisher = node.advertise("numbers", kind)
        await publisher.wait_subscriber()
        for _ in range(load.messages):
            await publisher.publish(load.message)
        received, lost, seconds = await asyncio.to_thread(pipe.recv)
        result = (received / seconds, load.messages - received + lost)
        await ping(node)

    async def ping(node: r2p.Node) -> None:
        publisher, answers = node.advertise("ping", kind), node.subscribe("pong", kind)
        await publisher.wait_subscriber()
        await answers.wait_publisher()
        for _ in range(load.rounds):
            at = time.perf_counter()
            await publisher.publish(load.message)
            await answers.fetch()
            trips.append(time.perf_counter() - at)

    async with module:
        module.start(run)
        await module.wait()
    return (*result, trips)
