"""What a recording costs when the disk is full, slow or gone, and where files begin and end."""

from pathlib import Path

import pytest

import r2p
from r2p.clock import clock_of
from r2p.msg import Led
from r2p.recording.disk import Disk, RecordingOptions
from r2p.recording.entries import AttachmentEntry, Entry, MessageEntry, MetadataEntry, SampleEntry
from tests.recording.checker import check

pytestmark = pytest.mark.anyio

SECOND = 1_000_000_000


def led(number: int) -> SampleEntry:
    """A message of the topic leds, one millisecond after the one before."""
    sample = r2p.Sample(Led(number % 256, 1).encode(), r2p.Source("IMU", "led", "tcp"), 1_000, sequence=number)
    return SampleEntry("leds", sample, Led, SECOND + number * 1_000_000)


def leds(count: int, first: int = 1) -> list[Entry]:
    return [led(number) for number in range(first, first + count)]


def open_disk(path: Path, **options: object) -> Disk:
    return Disk(path, RecordingOptions(**options), clock_of(), pytest.fail)  # type: ignore[arg-type]


async def test_entries_of_all_kinds_are_in_a_file_that_is_right(tmp_path: Path) -> None:
    path = tmp_path / "all.mcap"
    disk = open_disk(path)
    disk.put([AttachmentEntry("r2p.toml", "application/toml", b"a = 1\n", 5), MetadataEntry("robot", {"name": "Bob"})])
    disk.put([MessageEntry("/r2p/leds", Led(1, 2), 7, metadata={"link": "can0"}), *leds(20_000)])
    await disk.close()
    messages = check(path)
    assert [message.sequence for message in messages] == [1, *range(1, 20_001)]
    assert (disk.lost, disk.stopped, disk.paths) == ({}, "", [path])
    assert disk.bytes_written == path.stat().st_size
