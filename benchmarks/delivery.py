"""Delivery inside one module: publisher to subscriber tasks."""

import asyncio
import statistics
import time
from collections.abc import Iterator

import r2p
from benchmarks.loops import run_on
from benchmarks.table import Row, p50_p99, rate, typical


class Pair(r2p.Message):
    """8 bytes."""

    a: r2p.u32 = 0
    b: r2p.f32 = 0.0


MESSAGE = Pair(a=1, b=2.0)
RUNS = 5


async def throughput(messages: int, subscribers: int, *, each: bool) -> float:
    """Messages a second from one publisher to `subscribers` nodes; `each`: yielding after each message."""

    async def consume(node: r2p.Node) -> None:
        left = messages
        async for _ in node.subscribe("pairs", Pair, queue=64):
            left -= 1
            if not left:
                return

    async with r2p.Module("BENCH", via=[], watchdog=False) as module:
        for index in range(subscribers):
            module.start(consume, name=f"sub{index}")
        await asyncio.sleep(0)
        took = 0.0

        async def produce(node: r2p.Node) -> None:
            nonlocal took
            publisher = node.advertise("pairs", Pair)
            started = time.perf_counter()
            for _ in range(messages):
                await publisher.publish(MESSAGE)
                if each:
                    await asyncio.sleep(0)
            took = started

        module.start(produce)
        await module.wait()
        return messages / (time.perf_counter() - took)


async def queue_throughput(messages: int) -> float:
    """The same through an asyncio.Queue, without types."""
    queue: asyncio.Queue[int] = asyncio.Queue(64)

    async def consume() -> None:
        for _ in range(messages):
            await queue.get()

    consumer = asyncio.create_task(consume())
    started = time.perf_counter()
    for number in range(messages):
        await queue.put(number)
    await consumer
    return messages / (time.perf_counter() - started)


async def queue_yielding(messages: int) -> float:
    """The same, with a yield after each message: what asyncio alone takes for a message."""
    queue: asyncio.Queue[Pair] = asyncio.Queue(64)

    async def consume() -> None:
        for _ in range(messages):
            await queue.get()

    consumer = asyncio.create_task(consume())
    started = time.perf_counter()
    for _ in range(messages):
        await queue.put(MESSAGE)
        await asyncio.sleep(0)
    await consumer
    return messages / (time.perf_counter() - started)


async def future_yielding(messages: int) -> float:
    """A bare future for each message, with a yield after it: the least that waking another task takes."""
    loop = asyncio.get_running_loop()
    waiter: asyncio.Future[Pair] = loop.create_future()

    async def consume() -> None:
        nonlocal waiter
        for _ in range(messages):
            await waiter
            waiter = loop.create_future()

    consumer = asyncio.create_task(consume())
    await asyncio.sleep(0)
    started = time.perf_counter()
    for _ in range(messages):
        while waiter.done():  # noqa: ASYNC110  # a yield and nothing else is what is measured
            await asyncio.sleep(0)  # nothing else than a yield is what is measured
        waiter.set_result(MESSAGE)
        await asyncio.sleep(0)
    await consumer
    return messages / (time.perf_counter() - started)


async def cyphal_throughput(messages: int) -> float:
    """pycyphal 1.x's loopback transport: send and receive 8 bytes."""
    from pycyphal.transport import (
        InputSessionSpecifier,
        MessageDataSpecifier,
        OutputSessionSpecifier,
        PayloadMetadata,
        Priority,
        Timestamp,
        Transfer,
    )
    from pycyphal.transport.loopback import LoopbackTransport

    transport = LoopbackTransport(1)
    subject, metadata = MessageDataSpecifier(1000), PayloadMetadata(1024)
    output = transport.get_output_session(OutputSessionSpecifier(subject, None), metadata)
    arriving = transport.get_input_session(InputSessionSpecifier(subject, None), metadata)
    loop = asyncio.get_running_loop()
    payload = [memoryview(bytes(8))]
    started = time.perf_counter()
    for number in range(messages):
        transfer = Transfer(Timestamp.now(), Priority.NOMINAL, number, payload)
        await output.send(transfer, loop.time() + 1)
        await arriving.receive(loop.time() + 1)
    took = time.perf_counter() - started
    transport.close()
    return messages / took


async def latencies(messages: int) -> list[float]:
    """Seconds from publish() to the subscriber's next line."""
    durations: list[float] = []
    at = 0.0

    async def consume(node: r2p.Node) -> None:
        async for _ in node.subscribe("pairs", Pair):
            durations.append(time.perf_counter() - at)
            if len(durations) == messages:
                return

    async def produce(node: r2p.Node) -> None:
        nonlocal at
        publisher = node.advertise("pairs", Pair)
        await publisher.wait_subscriber()
        for _ in range(messages):
            await asyncio.sleep(0)
            await asyncio.sleep(0)
            at = time.perf_counter()
            await publisher.publish(MESSAGE)
            await asyncio.sleep(0)

    async with r2p.Module("BENCH", via=[], watchdog=False) as module:
        module.start(consume)
        module.start(produce)
        await module.wait()
    return durations


async def wake_latencies(messages: int) -> list[float]:
    """Seconds from setting a future to the next line of the task that waits for it: the loop's own time."""
    loop = asyncio.get_running_loop()
    durations: list[float] = []
    waiter: asyncio.Future[None] = loop.create_future()
    at = 0.0

    async def wait() -> None:
        nonlocal waiter
        for _ in range(messages):
            await waiter
            durations.append(time.perf_counter() - at)
            waiter = loop.create_future()

    task = asyncio.create_task(wait())
    while len(durations) < messages:
        await asyncio.sleep(0)
        at = time.perf_counter()
        waiter.set_result(None)
        await asyncio.sleep(0)
    await task
    return durations


async def _one(messages: int) -> float:
    """Messages a second to one subscriber, yielding each."""
    return await throughput(messages, 1, each=True)


def rows() -> Iterator[Row]:
    cyphal = typical(3, lambda: run_on("asyncio", cyphal_throughput(20_000)))
    for loop, goal in (("asyncio", 200e3), ("uvloop", 350e3)):
        # in turn: what else runs on the machine changes
        turns = [[run_on(loop, each(100_000)) for each in (_one, queue_yielding, future_yielding)] for _ in range(RUNS)]
        ours, queue, future = (statistics.median(each) for each in zip(*turns, strict=True))
        against_queue = statistics.median(each[0] / each[1] for each in turns)
        yield Row(
            f"publish to one subscriber beside asyncio alone, yielding each ({loop})",
            rate(ours),
            f"asyncio.Queue, untyped {rate(queue)}: {against_queue:.2f}x; future {rate(future)}: {ours / future:.2f}x",
            "0.95x of the Queue",
            against_queue >= 0.95,
        )
        yield Row(
            f"publish to one subscriber, yielding each ({loop})",
            rate(ours),
            f"pycyphal loopback {rate(cyphal)}: {ours / cyphal:.1f}x",
            f"{rate(goal)}, 4x",
            ours >= goal and ours >= 4 * cyphal,
        )
    queue = typical(RUNS, lambda: run_on("uvloop", queue_throughput(200_000)))
    ours = typical(RUNS, lambda: run_on("uvloop", throughput(400_000, 1, each=False)))
    yield Row(
        "the same, yielding every 16 messages (uvloop)",
        rate(ours),
        f"asyncio.Queue, untyped {rate(queue)}: {ours / queue:.1f}x",
        "1.00 M/s",
        ours >= 1e6,
    )
    ours = 20 * typical(RUNS, lambda: run_on("uvloop", throughput(40_000, 20, each=False)))
    yield Row("20 subscribers, yielding every 16: deliveries (uvloop)", rate(ours), "", "3.00 M/s", ours >= 3e6)
    median, worst = p50_p99(run_on("uvloop", latencies(50_000)))
    bare, bare_worst = p50_p99(run_on("uvloop", wake_latencies(50_000)))
    yield Row(
        "publish to the subscriber's next line, p50, p99 (uvloop)",
        f"{median:.1f} us, {worst:.1f} us",
        f"bare future {bare:.1f} us, {bare_worst:.1f} us",
        "5 us, 20 us",
        median <= 5 and worst <= 20,
    )
