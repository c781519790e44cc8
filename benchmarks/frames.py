"""CAN frames into a recording: as fast as they can be written, and from vcan in a user-mode Linux kernel."""

import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from mcap.writer import CompressionType, Writer

from benchmarks.socketcan import BUSY, measured_inside
from benchmarks.table import Row, rate, typical
from r2p.codecs.can_bits import EXTENDED, LOCAL, WireFrame
from r2p.recording.bag import Bag
from r2p.recording.entries import EntryWriter
from r2p.recording.frame_reader import BusReader
from r2p.recording.frames import BusInfo, FrameEntry
from r2p.recording.writer import CHUNK_SIZE, BagWriter
from tests.uml import packages

BATCH = 64
BATCHES = 1500
RUNS = 3

_BUS = BusInfo("can0", "rtcan:can0")
_UTC = 1_700_000_000_000_000_000


def rows() -> Iterator[Row]:
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "frames.mcap"
        ours = typical(RUNS, lambda: written(path))
        with Bag(path) as bag:
            size, read = path.stat().st_size, typical(RUNS, lambda: frames_read(bag))
            payload = next(record.data for record in bag.raw())
        bare = typical(RUNS, lambda: bare_writer(path, payload))
    count = BATCH * BATCHES
    yield Row(
        f"CAN frames to disk, {size / count:.0f} bytes each",
        rate(ours),
        f"bare mcap Writer {rate(bare)}: {ours / bare:.2f}x",
        f"10x a full bus: {rate(10 * BUSY)}",
        ours >= 10 * BUSY,
    )
    yield Row("CAN frames read from a recording", rate(read), "", "", None)
    tools = packages.find()
    if isinstance(tools, str):
        print(f"vcan is left out: {tools}", file=sys.stderr)
        return
    yield from from_vcan(tools)


def batches() -> list[FrameEntry]:
    frames: list[list[WireFrame]] = [
        [
            (EXTENDED | (number * BATCH + at) % 4096 << 7, (number * BATCH + at).to_bytes(8, "little"), LOCAL, at)
            for at in range(BATCH)
        ]
        for number in range(BATCHES)
    ]
    return [FrameEntry(_BUS, each, _UTC + i * BATCH * 130_000) for i, each in enumerate(frames)]


def written(path: Path) -> float:
    """Frames a second that the thread of a recorder writes."""
    entries = batches()
    began = time.perf_counter()
    with path.open("wb") as file:
        writer = BagWriter(file)
        out = EntryWriter(writer)
        for each in entries:
            out.write(each)
        writer.finish()
    return BATCH * BATCHES / (time.perf_counter() - began)


def bare_writer(path: Path, payload: bytes) -> float:
    """Frames a second of mcap's own writer, whose bytes are made already."""
    began = time.perf_counter()
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=CHUNK_SIZE, compression=CompressionType.ZSTD)
        writer.start()
        schema = writer.register_schema("can_msgs/msg/Frame", "ros2msg", b"")
        channel = writer.register_channel("/can0/frames", "cdr", schema)
        for number in range(BATCH * BATCHES):
            writer.add_message(channel, _UTC + number, payload, _UTC + number, number)
        writer.finish()
    return BATCH * BATCHES / (time.perf_counter() - began)


def frames_read(bag: Bag) -> float:
    began = time.perf_counter()
    count = sum(1 for _ in BusReader(bag).read())
    return count / (time.perf_counter() - began)


def from_vcan(tools: packages.Tools) -> Iterator[Row]:
    found = measured_inside(tools, "benchmarks.frames_inside")
    sent, recorded, lost = found["sent"], found["recorded"], found["lost"]
    yield Row(
        f"r2p bag record --frames, cangen -g 0, {found['seconds']:.0f} s (in UML)",
        f"{rate(recorded / found['seconds'])}, {recorded / sent:.1%} of them",
        f"{sent:.0f} sent, {recorded:.0f} recorded, {lost:.0f} counted as lost",
        "all, or each loss counted",
        recorded + lost == sent,
    )
