"""Images of 1 MB between two processes over zenoh on loopback, and a topic of 1 kHz beside them, against bare zenoh."""

import asyncio
import threading
import time
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from statistics import median
from typing import Any

import zenoh

import r2p
from benchmarks.loops import run_on
from benchmarks.processes import process
from benchmarks.table import Row, p50_p99
from benchmarks.zenoh import LISTEN, bare_client, bare_listener, connect, port_of
from r2p.msg import Image

IMAGE_BYTES = 1_000_000
IMAGES = 1_000
TICKS = 5_000  # of 1 ms
IMAGE_PERIOD = 0.1  # seconds
WARM_UP = 1_000  # ticks that do not count
RUNS = 3  # of each, in turns: neighbours on the computer disturb one run or the other

DATA = bytes(range(250)) * (IMAGE_BYTES // 250)


class Tick(r2p.Message):
    """When it was sent, by a clock that all processes share."""

    sent_ns: r2p.u64


IMAGE = Image(width=1000, height=1000, encoding="mono8", step=1000, data=r2p.Array(DATA))
Times = list[float]


def _tick() -> Tick:
    return Tick(time.perf_counter_ns())


# r2p at both ends


def _receive_r2p(pipe: Connection, shm: str, ticks: bool) -> None:
    module = r2p.Module("SERVER", via=f"{LISTEN}&shm={shm}", watchdog=False)

    async def count(node: r2p.Node) -> None:
        images, started = 0, 0.0
        async for image in node.subscribe("images", Image):
            started = started or time.perf_counter()
            images += len(image.data) == IMAGE_BYTES
            if images == IMAGES:
                pipe.send(IMAGES / (time.perf_counter() - started))

    async def listen(node: r2p.Node) -> None:
        late: Times = []
        async for tick in node.subscribe("ticks", Tick):
            late.append((time.perf_counter_ns() - tick.sent_ns) / 1e9)
            if len(late) == TICKS:
                pipe.send(late[WARM_UP:])

    async def main() -> None:
        async with module:
            module.start(count)
            if ticks:
                module.start(listen)
            pipe.send(port_of(module))
            await module.wait()

    run_on("uvloop", main())


def _send_r2p(port: int, pipe: Connection, shm: str, ticks: bool) -> object:
    """Return what the other end measured."""
    module = r2p.Module("CLIENT", via=f"{connect(port)}&shm={shm}", watchdog=False)

    async def images(node: r2p.Node) -> None:
        publisher = node.advertise("images", Image)
        await publisher.wait_subscriber()
        if ticks:
            async for _ in node.every(IMAGE_PERIOD):
                await publisher.publish(IMAGE)
        for _ in range(IMAGES):
            await publisher.publish(IMAGE)

    async def tick(node: r2p.Node) -> None:
        publisher = node.advertise("ticks", Tick, r2p.Sporadic(deadline=0.1))
        await publisher.wait_subscriber()
        async for _ in node.every(0.001):
            await publisher.publish(_tick())

    async def main() -> object:
        async with module:
            module.start(images)
            if ticks:
                module.start(tick)
            return await asyncio.to_thread(pipe.recv)

    return run_on("uvloop", main())


# bare zenoh at both ends


def _receive_bare(pipe: Connection, shm: str, _ticks: bool) -> None:
    with bare_listener(shm=shm == "on") as (session, port):
        images, started = 0, 0.0
        late: Times = []

        def image(sample: zenoh.Sample) -> None:
            nonlocal images, started
            started = started or time.perf_counter()
            images += len(sample.payload.to_bytes()) == IMAGE_BYTES
            if images == IMAGES:
                pipe.send(IMAGES / (time.perf_counter() - started))

        def tick(sample: zenoh.Sample) -> None:
            late.append((time.perf_counter_ns() - Tick.decode(sample.payload.to_bytes()).sent_ns) / 1e9)
            if len(late) == TICKS:
                pipe.send(late[WARM_UP:])

        subscribers = session.declare_subscriber("bench/images", image), session.declare_subscriber("bench/ticks", tick)
        pipe.send(port)
        threading.Event().wait()
        del subscribers


def _send_bare(port: int, pipe: Connection, shm: str, ticks: bool) -> object:
    """Images with the congestion control that loses none, and ticks with the settings that r2p has for them."""
    session = bare_client(port, shm=shm == "on")
    images = session.declare_publisher("bench/images", congestion_control=zenoh.CongestionControl.BLOCK)
    events = session.declare_publisher("bench/ticks", priority=zenoh.Priority.INTERACTIVE_HIGH, express=True)
    while not (images.matching_status and events.matching_status):
        time.sleep(0.01)
    ended = threading.Event()
    if ticks:
        for period, put in ((IMAGE_PERIOD, lambda: images.put(DATA)), (0.001, lambda: events.put(_tick().encode()))):
            threading.Thread(target=_every, args=(period, put, ended), daemon=True).start()
    else:
        for _ in range(IMAGES):
            images.put(DATA)
    measured = pipe.recv()
    ended.set()
    return measured


def _every(period: float, put: Callable[[], object], ended: threading.Event) -> None:
    due = time.perf_counter()
    while not ended.is_set():
        put()
        due += period
        time.sleep(max(0.0, due - time.perf_counter()))


def _measure(shm: str, *, bare: bool, ticks: bool) -> Any:
    with process(_receive_bare if bare else _receive_r2p, shm, ticks) as receiver:
        return (_send_bare if bare else _send_r2p)(receiver.recv(), receiver, shm, ticks)


def _rate(shm: str) -> tuple[float, float]:
    """Images a second, of r2p and of bare zenoh."""
    runs = [[_measure(shm, bare=bare, ticks=False) for bare in (False, True)] for _ in range(RUNS)]
    return median(ours for ours, _ in runs), median(bare for _, bare in runs)


def _latency(shm: str) -> list[tuple[float, float]]:
    """Median and 99th percentile of r2p and of bare zenoh, in us: the medians of some runs."""
    runs = [[p50_p99(_measure(shm, bare=bare, ticks=True)) for bare in (False, True)] for _ in range(RUNS)]
    return [(median(run[end][0] for run in runs), median(run[end][1] for run in runs)) for end in (0, 1)]


def rows() -> Iterator[Row]:
    for shm in ("off", "on"):
        ours, bare = _rate(shm)
        yield Row(
            f"images of 1 MB over zenoh, shm={shm}",
            f"{ours:.0f}/s",
            f"bare zenoh with to_bytes {bare:.0f}/s: {ours / bare:.2f}x",
            "0.5x",
            ours >= 0.5 * bare,
        )
    for shm in ("off", "on"):
        (p50, p99), (bare_p50, bare_p99) = _latency(shm)
        yield Row(
            f"1 kHz of events beside 10 images of 1 MB a second, shm={shm}",
            f"{p50:.0f} us, p99 {p99:.0f} us",
            f"bare zenoh {bare_p50:.0f} us, p99 {bare_p99:.0f} us: {p99 / bare_p99:.2f}x",
            "p99 within 1.5x",
            p99 <= 1.5 * bare_p99,
        )
