"""Recording: messages of one link to the disk, against `mcap` itself; and what a recorder costs another subscriber."""

import asyncio
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from statistics import median
from typing import Any

from mcap.writer import Writer

import r2p
from benchmarks import zenoh
from benchmarks.loops import run_on
from benchmarks.network import MESSAGE, Eight
from benchmarks.processes import process
from benchmarks.table import Row, percentile, rate
from r2p.recording.bag import Bag
from r2p.recording.format import CDR, PROFILE
from r2p.recording.recorder import Recorder
from r2p.ros.cdr import cdr
from r2p.ros.ros2_schemas import ROS2MSG, schema_of
from r2p.tools.bag.record import lower_priority
from r2p.transports.tcp import TcpListenTransport
from r2p.transports.url import parse

MESSAGES = 300_000
OFFERED = 110_000  # messages a second of a publisher that does not send as fast as it can
BURST = 0.001  # seconds
SETTLED = 0.2  # seconds without another message: there are no more on the way

TOPICS = 50
PERIOD = 0.001  # seconds between two messages of a topic
SECONDS = 3.0  # of each run
PAIRS = 5  # of runs with and without a recorder


class Sent(r2p.Message):
    """32 bytes: when it was published (ns of the monotonic clock), and others."""

    at: r2p.i64 = 0
    values: tuple[r2p.f64, r2p.f64, r2p.f64] = (0.0, 0.0, 0.0)


# One link to the disk


async def _record(pipe: Connection, link: str, path: Path) -> None:
    """Record until a message says that no more is sent; then say how long it took until all was on the disk."""
    transport = TcpListenTransport(parse("tcp-listen:127.0.0.1:0"))
    via: Any = zenoh.LISTEN if link == "zenoh" else [transport]
    async with r2p.Module("RECORDER", via=via, watchdog=False) as module:
        recorder = Recorder(module, path, ["numbers"], types={"numbers": Eight})
        async with recorder:
            pipe.send(zenoh.port_of(module) if link == "zenoh" else transport.port)
            began = last = await _changed(recorder, 60.0)
            asked = asyncio.create_task(asyncio.to_thread(pipe.recv))
            while (changed := await _changed(recorder, SETTLED)) or not asked.done():
                last = changed or last
            closing = time.perf_counter()
    pipe.send(last - began + time.perf_counter() - closing)


async def _changed(recorder: Recorder, timeout: float) -> float:
    """Return when more was received; 0 if that takes longer."""
    before = recorder.counts()["numbers"].messages
    until = time.perf_counter() + timeout
    while (now := time.perf_counter()) < until:
        if recorder.counts()["numbers"].messages > before:
            return now
        await asyncio.sleep(0.002)
    return 0.0


async def _send(link: str, pipe: Connection, offered: float) -> float:
    """Publish all messages, so many a second (0: as fast as the link takes them), and return what the recorder says."""
    port, seconds = pipe.recv(), 0.0
    via = zenoh.connect(port) if link == "zenoh" else f"tcp:127.0.0.1:{port}"

    async def publish(node: r2p.Node) -> None:
        nonlocal seconds
        publisher = node.advertise("numbers", Eight)
        await publisher.wait_subscriber()
        began = time.perf_counter()
        for number in range(MESSAGES):
            await publisher.publish(MESSAGE)
            if offered and not number % int(offered * BURST):
                await asyncio.sleep(max(0.0, began + number / offered - time.perf_counter()))
        pipe.send("all sent")
        seconds = await asyncio.to_thread(pipe.recv)  # before that, the link would go with what is on the way

    async with r2p.Module("CLIENT", via=via, watchdog=False) as module:
        module.start(publish)
        await module.wait()
    return seconds


def _process(pipe: Connection, main: Callable[..., object], *args: object) -> None:
    run_on("uvloop", main(pipe, *args))  # type: ignore[arg-type]


def _recorded(link: str, offered: float, folder: Path) -> tuple[float, int]:
    """Return the messages a second that got to the disk, and how many did not."""
    path = folder / f"{link}-{offered}.mcap"
    with process(_process, _record, link, path) as pipe:
        seconds = run_on("uvloop", _send(link, pipe, offered))
    with Bag(path) as bag:
        count = bag.topics["numbers"]
    return count / seconds, MESSAGES - count


def _bare(folder: Path) -> float:
    """Return the messages a second of `mcap` itself, with the same bytes."""
    schema, data = schema_of(Eight), cdr(Eight).encode(MESSAGE)
    with (folder / "bare.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start(PROFILE)
        number = writer.register_schema(schema.name, ROS2MSG, schema.text.encode())
        channel = writer.register_channel("/numbers", CDR, number)
        began = time.perf_counter()
        for sequence in range(MESSAGES):
            now = time.time_ns()
            writer.add_message(channel, now, data, now, sequence)
        writer.finish()
    return MESSAGES / (time.perf_counter() - began)


# What a recorder costs another subscriber


async def _publish(pipe: Connection) -> None:
    """Publish on all topics, each at 1 kHz, to two others."""
    module = r2p.Module("ROBOT", via=zenoh.LISTEN, watchdog=False)

    async def publish(node: r2p.Node) -> None:
        publishers = [node.advertise(f"topic{number}", Sent) for number in range(TOPICS)]
        began, turn = time.perf_counter(), 0
        while True:
            for publisher in publishers:
                await publisher.publish(Sent(time.monotonic_ns()))
            turn += 1
            await asyncio.sleep(max(0.0, began + turn * PERIOD - time.perf_counter()))

    async with module:
        pipe.send(zenoh.port_of(module))
        module.start(publish)
        await module.wait()


async def _second(pipe: Connection, port: int, path: Path | None) -> None:
    """Record all topics, or without a file, only receive them."""
    names = [f"topic{number}" for number in range(TOPICS)]
    async with r2p.Module("SECOND", via=zenoh.connect(port), watchdog=False) as module:
        if path is not None:
            lower_priority()  # as `r2p bag record`
            async with Recorder(module, path, names, types=dict.fromkeys(names, Sent)):
                pipe.send("ready")
                await asyncio.to_thread(pipe.recv)
            return

        async def receive(node: r2p.Node, name: str) -> None:
            async for _ in node.subscribe(name, Sent, queue=64, lossy=True):
                pass

        for name in names:
            module.start(receive, name, name=name)
        pipe.send("ready")
        await asyncio.to_thread(pipe.recv)


async def _latencies(port: int) -> list[float]:
    """Return the seconds that messages of one topic take."""
    found: list[float] = []
    until = time.perf_counter() + SECONDS

    async def receive(node: r2p.Node) -> None:
        async for message in node.subscribe("topic7", Sent):
            found.append((time.monotonic_ns() - message.at) / 1e9)
            if time.perf_counter() > until:
                return

    async with r2p.Module("FIRST", via=zenoh.connect(port), watchdog=False) as module:
        module.start(receive)
        await module.wait()
    return found


@contextmanager
def _robot() -> Iterator[int]:
    with process(_process, _publish) as pipe:
        yield pipe.recv()


def _p99(path: Path | None) -> float:
    with _robot() as port, process(_process, _second, port, path) as second:
        second.recv()
        found = run_on("uvloop", _latencies(port))
        second.send("end")
    return percentile(found[len(found) // 4 :], 99)


def rows() -> Iterator[Row]:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        bare = _bare(folder)
        for link in ("TCP", "zenoh"):
            ours, _ = _recorded(link, 0, folder)
            paced, lost = _recorded(link, OFFERED, folder)
            yield Row(
                f"{link} link to disk, 32 bytes: at full speed, {rate(OFFERED)} offered",
                f"{rate(ours)}, {rate(paced)}, {lost} lost",
                f"bare mcap writer {rate(bare)}: {bare / ours:.2f}x",
                "within 2.5x; 100 k/s, 0 lost",
                bare <= 2.5 * ours and paced >= 100e3 and not lost,
            )
        pairs = [(_p99(folder / f"{number}.mcap"), _p99(None)) for number in range(PAIRS)]
        with_recorder, without = (median(each) * 1e3 for each in zip(*pairs, strict=True))
        yield Row(
            f"another subscriber's p99 beside a recorder of {TOPICS} topics",
            f"{with_recorder:.2f} ms",
            f"beside a bare subscriber of them {without:.2f} ms",
            "within 0.2 ms",
            with_recorder - without < 0.2,
        )
