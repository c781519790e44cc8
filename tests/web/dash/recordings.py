"""Recordings for tests of the page: what a recorder would have seen of a small robot, and of a program of ROS."""

from __future__ import annotations

import contextlib
import math
from typing import TYPE_CHECKING, Annotated

from mcap.writer import CompressionType, IndexType, Writer

import r2p
from r2p.modules.statistics import ModuleStatistics, NodeStatistics, PublisherStatistics
from r2p.recording.entries import BagEntry, EntryWriter, MessageEntry, SampleEntry
from r2p.recording.messages import (
    EVENTS,
    LOGS,
    PARAMETERS,
    SIGNALS,
    SLOTS,
    STATISTICS,
    LogRecord,
    ParameterValue,
    RecordedEvent,
    RecordedSignal,
    SlotOwner,
    SlotTable,
)
from r2p.recording.writer import BagWriter
from r2p.runtime.sample import PublisherClass
from r2p.web.dash.recorded.source import RecordedSource
from tests.web.rig import FakePage, open_page

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterable
    from pathlib import Path

T0 = 1_700_000_000_000_000_000
S = 1_000_000_000
SECONDS = 20
PEAK = 123.0
"""The value of one message."""
GAP = (8, 12)
"""Seconds between which there is no odometry."""


class Wheels(r2p.Message, name="test_msgs/Wheels"):
    left: r2p.f32 = 0.0
    right: r2p.f64 = 0.0
    names: Annotated[tuple[r2p.u16, ...], r2p.Max(4)] = ()


def wheels(number: int) -> SampleEntry:
    """A message each 10 ms; one has a peak, and some are late."""
    time = T0 + number * S // 100
    value = PEAK if number == 777 else math.sin(number / 100)
    message = Wheels(left=value, right=-value, names=(number,) * (number % 3))
    due = time + 5_000_000 if number % 100 else time - 1_000_000
    source = r2p.Source("ROBOT", "drive", "tcp")
    sample = r2p.Sample(
        message.encode(), source, time, due, number + 1, PublisherClass.NON_REAL_TIME
    )  # by a link that has no classes
    return SampleEntry("wheels", sample, Wheels, time)


def observed(second: int) -> list[BagEntry]:
    """What a recorder sees besides, in a second."""
    at = T0 + second * S
    counted = PublisherStatistics("wheels", "drive", 3, 100 * second, second, 0)
    statistics = ModuleStatistics(
        uptime=5.0 + second, cpu=1.0 + second / 4, nodes=(NodeStatistics("drive", running=True),), publishers=(counted,)
    )
    name = "ROBOT/drive"
    found: list[BagEntry] = [
        MessageEntry(f"{STATISTICS}/ROBOT", statistics, at),
        MessageEntry(LOGS, LogRecord(level=20, name=name, msg=f"second {second}"), at),
    ]
    if second == 0:
        running = RecordedEvent(kind="module found", module="ROBOT", link="tcp", text="running, r2p, 1.2")
        found.append(MessageEntry(EVENTS, running, at))
    if second % 10 == 0:
        owners = (SlotOwner("wheels", "ROBOT", (1 + second // 10,)),)
        found.append(MessageEntry(SLOTS, SlotTable("rtcan:can0", 0.01, 8, "ROBOT", owners), at))
        value = ParameterValue("ROBOT", "drive", "gain", "float", f"{second / 10:.1f}", second / 10, "1/s", "run time")
        found.append(MessageEntry(PARAMETERS, value, at))
    if second == 5:
        missed = RecordedSignal(
            kind="missed", source="statistics", topic="wheels", module="ROBOT", node="drive", count=3
        )
        found += [
            MessageEntry(SIGNALS, missed, at),
            MessageEntry(LOGS, LogRecord(level=30, name=name, msg="battery low"), at),
        ]
    if second == 15:
        found.append(MessageEntry(EVENTS, RecordedEvent(kind="module gone", module="ROBOT"), at))
    return found


def entries() -> Iterable[BagEntry]:
    for second in range(SECONDS):
        yield from observed(second)
        if not GAP[0] <= second < GAP[1]:
            yield from (wheels(100 * second + i) for i in range(100))


def drive(path: Path, *, finish: bool = True, chunk_size: int = 8000) -> Path:
    """Write the recording of the robot."""
    with path.open("wb") as file:
        writer = BagWriter(file, chunk_size=chunk_size)
        add = EntryWriter(writer)
        for each in entries():
            add.write(each)
        if finish:
            writer.finish()
        else:
            writer.end_chunk()
    return path


DEFINITION = b"float64 temperature\nfloat64[3] axis\nstring name\n"


def foreign(
    path: Path, *, times: Iterable[int] = range(T0, T0 + S, S // 10), topics: Iterable[str] = ("/temp",)
) -> Path:
    """Write a recording as another program does: without indexes of messages, in LZ4, of a type of its own."""
    cdr = b"\0\1\0\0" + b"\0\0\0\0\0\0\xf0\x3f" * 4 + b"\2\0\0\0a\0"
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.LZ4, chunk_size=500, index_types=IndexType.CHUNK)
        writer.start("ros2", "other")
        schema = writer.register_schema("their_msgs/msg/Reading", "ros2msg", DEFINITION)
        channels = [writer.register_channel(topic, "cdr", schema) for topic in topics]
        for time in times:
            for channel in channels:
                writer.add_message(channel, time, cdr, time)
        writer.finish()
    return path


@contextlib.asynccontextmanager
async def shown(*paths: Path) -> AsyncIterator[tuple[FakePage, RecordedSource]]:
    """A page that shows a recording, once it has the first figures."""
    async with RecordedSource(paths) as source, open_page(source) as page:
        while not page.news("state"):
            await page.ask("timeline")
        yield page, source
