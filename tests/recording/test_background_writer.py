"""What a recording costs when the disk is full, slow or gone, and where its files begin and end."""

import asyncio
import errno
import functools
import io
import itertools
import os
import random
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, BinaryIO, ClassVar

import pytest

import r2p
import r2p.sim
from r2p.clock import clock_of
from r2p.msg import Led
from r2p.recording.background_writer import BackgroundWriter
from r2p.recording.bag import Bag
from r2p.recording.entries import AttachmentEntry, BagEntry, EntryWriter, MessageEntry, MetadataEntry, SampleEntry
from r2p.recording.recording_files import RecordingOptions
from r2p.recording.recovery import recover
from tests.recording.checker import check

SECOND = 1_000_000_000


def led(number: int) -> SampleEntry:
    """A message of the topic leds, received now, which can't be compressed."""
    noise = random.Random(number).randbytes(200)
    source = r2p.Source("IMU", "led", "tcp")
    return SampleEntry("leds", r2p.Sample(noise, source, 1_000, sequence=number), None, clock_of().now())


def leds(count: int, first: int = 1) -> list[BagEntry]:
    return [led(number) for number in range(first, first + count)]


def sequences(*paths: Path) -> list[int]:
    """The numbers of the messages in some files, each of which is right in each byte."""
    return [message.sequence for path in paths for message in check(path)]


class Reports(list[str]):
    """What the user reads."""

    def __call__(self, text: str) -> None:
        self.append(text)


def open_disk(
    path: Path, *, opened: Callable[[Path], BinaryIO] | None = None, **options: float
) -> tuple[BackgroundWriter, Reports]:
    reports = Reports()
    more = {} if opened is None else {"opened": opened}
    return BackgroundWriter(path, RecordingOptions(**options), clock_of(), reports, **more), reports  # type: ignore[arg-type]


# What is in a file


@pytest.mark.anyio
async def test_entries_of_all_kinds_are_in_a_file_that_is_right(tmp_path: Path) -> None:
    path = tmp_path / "all.mcap"
    disk, reports = open_disk(path)
    disk.put([AttachmentEntry("r2p.toml", "application/toml", b"a = 1\n", 5), MetadataEntry("robot", {"name": "Bob"})])
    disk.put([MessageEntry("/r2p/leds", Led(1, 2), 7, metadata={"link": "can0"}), *leds(3_000)])
    await disk.close()
    assert sequences(path) == [1, *range(1, 3_001)]
    assert (disk.lost, disk.stopped, disk.paths, reports) == ({}, "", [path], [])
    assert disk.bytes_written == path.stat().st_size


def test_under_virtual_time_the_same_run_writes_the_same_bytes(tmp_path: Path) -> None:
    async def main(path: Path) -> None:
        disk, _ = open_disk(path)
        await record(disk, 100)
        await disk.close()

    paths = [tmp_path / "a.mcap", tmp_path / "b.mcap"]
    for path in paths:
        r2p.sim.run(functools.partial(main, path))
    assert paths[0].read_bytes() == paths[1].read_bytes()
    assert sequences(*paths) == [*range(1, 101), *range(1, 101)]


@pytest.mark.virtual_time
async def test_after_half_a_second_a_message_is_in_the_file(tmp_path: Path) -> None:
    path = tmp_path / "killed.mcap"
    disk, _ = open_disk(path)
    disk.put(leds(1))
    await asyncio.sleep(0.5)
    disk.put(leds(1, 2))
    await asyncio.sleep(0.49)
    disk.put(leds(1, 3))
    recover(path, tmp_path / "new.mcap")  # as it is now on the disk
    assert sequences(tmp_path / "new.mcap") == [1, 2]
    await disk.close()


class BadEntry(BagEntry):
    """An entry that raises."""

    @property
    def lost_as(self) -> str:
        return "bad"

    def write(self, out: EntryWriter) -> None:
        raise r2p.MessageError("out of range")


@pytest.mark.virtual_time
async def test_an_entry_that_can_not_be_written_is_counted_and_costs_no_other(tmp_path: Path) -> None:
    disk, reports = open_disk(tmp_path / "bad.mcap")
    disk.put([led(1), BadEntry(), led(2), BadEntry(), led(3)])
    await disk.close()
    assert sequences(*disk.paths) == [1, 2, 3]
    assert disk.lost == {"bad": 2}
    assert reports == ["a message of bad can't be recorded: out of range; more of them are only counted"]


# Slow disks


class SlowFile(io.FileIO):
    """A file whose writes wait while the gate is shut."""

    gate: ClassVar[threading.Event]

    def write(self, data: Any) -> int:
        self.gate.wait()
        return super().write(data)


@pytest.mark.anyio
async def test_a_slow_disk_costs_messages_that_are_counted_and_never_waited_for(tmp_path: Path) -> None:
    SlowFile.gate = threading.Event()
    SlowFile.gate.set()
    limit = 100_000
    disk, reports = open_disk(
        tmp_path / "slow.mcap",
        opened=lambda path: SlowFile(path, "xb+"),
        queue_bytes=limit,
    )
    SlowFile.gate.clear()
    given = 0
    while disk.lost.get("leds", 0) < 500:
        disk.put(leds(50, given + 1))
        given += 50
        await asyncio.sleep(0)
        assert disk.queued_bytes <= limit
    disk.put([MessageEntry("/r2p/recorder", Led(), 1)])  # what the recorder says of it is kept
    assert reports == ["the disk is too slow: messages are dropped, and counted by topic"]
    SlowFile.gate.set()
    while disk.queued_bytes:  # noqa: ASYNC110 - of another thread
        await asyncio.sleep(0)
    disk.put(leds(1, given + 1))
    await disk.close()
    assert len(sequences(*disk.paths)) == given + 2 - disk.lost["leds"]
    assert reports[1] == f"the disk keeps up again; {disk.lost['leds']} messages were dropped so far"
    assert list(disk.lost) == ["leds"]


# Full disks


class Quota:
    """A folder in which files may have so many bytes together."""

    def __init__(self, size: int, error: int = errno.ENOSPC) -> None:
        self.size = size
        self.error = error
        self.folder: Path | None = None

    def open(self, path: Path) -> BinaryIO:
        self.folder = path.parent
        file = QuotaFile(path, "xb+")
        file.quota = self
        return file

    @property
    def free(self) -> int:
        assert self.folder is not None
        return self.size - sum(path.stat().st_size for path in self.folder.iterdir())


class QuotaFile(io.FileIO):
    """A file that takes as many bytes as there is room for, and then none."""

    quota: Quota

    def write(self, data: Any) -> int:
        free = self.quota.free
        if free <= 0:
            if self.quota.error == errno.EIO:
                self.quota.size = 0  # it is gone
            raise OSError(self.quota.error, os.strerror(self.quota.error))
        return super().write(memoryview(data)[:free])


async def record(disk: BackgroundWriter, count: int, each: int = 10) -> None:
    for first in range(1, count, each):
        disk.put(leds(each, first))
        await asyncio.sleep(0.1)


@pytest.mark.virtual_time
@pytest.mark.parametrize("size", range(40_000, 90_000, 3_333))
async def test_a_full_disk_ends_the_recording_with_a_file_that_is_right(size: int, tmp_path: Path) -> None:
    disk, reports = open_disk(tmp_path / "full.mcap", opened=Quota(size).open)
    await record(disk, 1_000)
    found = sequences(*disk.paths)
    assert found == list(range(1, len(found) + 1))
    assert 232 * len(found) > size - 2 * 15_000  # the chunk that did not fit, and one for the end of the file
    assert disk.lost == {"leds": 1_000 - len(found)}
    assert disk.stopped == "the disk is full"
    assert reports[-1].startswith("the recording ended: the disk is full")
    await disk.close()
    assert sequences(*disk.paths) == found


@pytest.mark.virtual_time
async def test_a_file_that_another_program_deletes_or_cuts_off_is_noticed(tmp_path: Path) -> None:
    disk, reports = open_disk(tmp_path / "a.mcap")
    await record(disk, 100)
    disk.paths[0].unlink()
    await record(disk, 200)
    await disk.close()
    assert [each.partition(" with ")[0] for each in reports] == [
        f"the recording ended: another program has deleted {tmp_path / 'a.mcap'}"
    ]
    assert (disk.paths, disk.recorded, disk.lost) == ([], {}, {"leds": 300})
    disk, reports = open_disk(tmp_path / "b.mcap", split=True, max_size=1 << 30)
    await record(disk, 100)
    os.truncate(disk.paths[0], 5_000)
    await record(disk, 100)
    disk.paths[1].unlink()
    await record(disk, 100)
    await disk.close()
    first, third = disk.paths
    assert [each.partition(" off:")[0].partition(" with ")[0] for each in reports] == [
        f"another program has cut {first}",
        f"another program has deleted {tmp_path / 'b-0002.mcap'}",
    ]
    assert all(each.endswith("; the recording goes on in the next file") for each in reports)
    assert len(sequences(third)) + disk.recorded["leds"] + disk.lost["leds"] > 300
    assert disk.recorded["leds"] + disk.lost["leds"] == 300


@pytest.mark.virtual_time
async def test_a_disk_that_fails_leaves_a_file_to_recover(tmp_path: Path) -> None:
    path = tmp_path / "gone.mcap"
    disk, reports = open_disk(path, opened=Quota(50_000, errno.EIO).open)
    await record(disk, 1_000)
    await disk.close()
    assert reports == [
        f"{path} may not be whole (Input/output error): try `r2p bag recover`",
        f"the recording ended: the disk failed: Input/output error; the last {disk_lost(reports)} messages are lost",
    ]
    report = recover(path, tmp_path / "new.mcap")
    assert disk.lost == {"leds": 1_000 - report.messages}


def disk_lost(reports: Reports) -> int:
    return int(reports[-1].split("; the last ")[1].split()[0])


@pytest.mark.virtual_time
async def test_with_a_total_the_oldest_files_make_room(tmp_path: Path) -> None:
    disk, reports = open_disk(tmp_path / "ring.mcap", opened=Quota(150_000).open, split=True, max_total=1_000_000)
    disk.put([AttachmentEntry("r2p.toml", "application/toml", b"a = 1\n", 5)])
    await record(disk, 2_000)
    await disk.close()
    found = sequences(*disk.paths)
    assert found == list(range(found[0], 2_001)) == found
    assert (disk.stopped, disk.lost, reports) == ("", {}, [])
    assert sorted(tmp_path.iterdir()) == disk.paths  # noqa: ASYNC240
    assert disk.paths[0] != tmp_path / "ring-0001.mcap"


@pytest.mark.virtual_time
async def test_max_total_is_kept(tmp_path: Path) -> None:
    disk, _ = open_disk(tmp_path / "ring.mcap", split=True, max_total=200_000)
    await record(disk, 2_000)
    await disk.close()
    found = sequences(*disk.paths)
    assert found == list(range(found[0], 2_001))
    assert 150_000 < sum(path.stat().st_size for path in disk.paths) <= 200_000


@pytest.mark.virtual_time
async def test_where_no_old_file_can_be_deleted_a_full_disk_ends_the_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: Path, *, missing_ok: bool = False) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    monkeypatch.setattr(Path, "unlink", refuse)
    disk, reports = open_disk(tmp_path / "ring.mcap", opened=Quota(150_000).open, split=True, max_total=1_000_000)
    await record(disk, 1_000)
    await disk.close()
    assert reports[-1].startswith("the recording ended: the disk is full")
    assert len(sequences(*disk.paths)) == 1_000 - disk.lost["leds"]


@pytest.mark.virtual_time
async def test_a_file_at_the_limit_of_its_file_system_is_followed_by_another(tmp_path: Path) -> None:
    class FileLimit(Quota):
        @property
        def free(self) -> int:
            return self.size - max(tmp_path.iterdir()).stat().st_size

    limit = FileLimit(60_000, errno.EFBIG)
    disk, reports = open_disk(tmp_path / "fat.mcap", opened=limit.open, split=True, max_size=1 << 32)
    await record(disk, 1_000)
    await disk.close()
    assert sequences(*disk.paths) == list(range(1, 1_001))
    assert len(disk.paths) > 3
    assert (disk.lost, disk.stopped, reports) == ({}, "", [])


@pytest.mark.virtual_time
async def test_a_disk_that_fills_up_ends_the_recording_before_it_is_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    free = itertools.count(2_050, -10)  # thousands of bytes, once a second
    monkeypatch.setattr(os, "statvfs", lambda _: SimpleNamespace(f_bavail=next(free), f_frsize=1_000))
    disk, reports = open_disk(tmp_path / "free.mcap", min_free=2_000_000)
    await record(disk, 1_000)
    assert disk.stopped == "less than 2 MB are free on the disk (min_free)"
    assert reports == [f"the recording ended: {disk.stopped}"]
    found = sequences(*disk.paths)
    assert disk.lost == {"leds": 1_000 - len(found)}
    with pytest.raises(r2p.Error, match=r"only 1\.98 MB of disk: 2 MB are to stay free"):
        open_disk(tmp_path / "more.mcap", min_free=2_000_000)


# Limits


@pytest.mark.virtual_time
async def test_max_size_is_kept_and_with_split_nothing_is_lost_between_files(tmp_path: Path) -> None:
    limit = 60_000
    disk, reports = open_disk(tmp_path / "one.mcap", max_size=limit)
    await record(disk, 1_000)
    assert disk.stopped == "max_size (0.06 MB) is reached"
    assert reports == ["the recording ended: max_size (0.06 MB) is reached"]
    assert disk.lost == {}
    many, _ = open_disk(tmp_path / "many.mcap", max_size=limit, split=True)
    many.put([AttachmentEntry("r2p.toml", "application/toml", b"a = 1\n", 5), MetadataEntry("robot", {"name": "Bob"})])
    await record(many, 1_000)
    await many.close()
    assert sequences(*many.paths) == list(range(1, 1_001))
    assert [path.name for path in many.paths[:2]] == ["many-0001.mcap", "many-0002.mcap"]
    for path in [*disk.paths, *many.paths[:-1]]:
        assert limit * 0.6 < path.stat().st_size <= limit
    assert [path.read_bytes().count(b"r2p.toml") for path in many.paths] == [2] * len(many.paths)  # and its index


@pytest.mark.virtual_time
async def test_max_duration_ends_a_file(tmp_path: Path) -> None:
    disk, _ = open_disk(tmp_path / "one.mcap", max_duration=1.0)
    await record(disk, 1_000)
    assert disk.stopped == "max_duration (1 s) is reached"
    assert len(sequences(*disk.paths)) == 11 * 10
    many, _ = open_disk(tmp_path / "many.mcap", max_duration=0.5, split=True)
    await record(many, 200)
    await many.close()
    assert len(many.paths) == 4
    assert sequences(*many.paths) == list(range(1, 201))


@pytest.mark.virtual_time
async def test_an_existing_file_is_never_overwritten(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_text("mine")
    (tmp_path / "b-0002.mcap").write_text("mine")
    with pytest.raises(FileExistsError):
        open_disk(tmp_path / "a.mcap")
    disk, _ = open_disk(tmp_path / "b.mcap", split=True, max_duration=0.5)
    await record(disk, 100)
    await disk.close()
    assert [path.name for path in disk.paths[:2]] == ["b-0001.mcap", "b-0003.mcap"]
    assert (tmp_path / "a.mcap").read_text() == (tmp_path / "b-0002.mcap").read_text() == "mine"


@pytest.mark.parametrize(
    "options",
    [{"max_total": 1}, {"split": True}, {"snapshot": 1.0, "split": True, "max_size": 1}],
)
def test_options_that_do_not_go_together_are_refused(options: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="split"):
        RecordingOptions(**options)  # type: ignore[arg-type]


# Snapshots


@pytest.mark.virtual_time
async def test_a_snapshot_has_the_last_seconds_and_all_that_describes_them(tmp_path: Path) -> None:
    disk, _ = open_disk(tmp_path / "crash.mcap", snapshot=2.0)
    disk.put([AttachmentEntry("r2p.toml", "application/toml", b"a = 1\n", 5)])
    await record(disk, 1_000)
    first = await disk.snapshot()
    await record(disk, 100)
    second = await disk.snapshot()
    await disk.close()
    with pytest.raises(r2p.Closed, match=r"crash\.mcap has ended"):
        await disk.snapshot()
    assert disk.paths == [first, second] == [tmp_path / "crash-0001.mcap", tmp_path / "crash-0002.mcap"]
    found = sequences(first)
    assert found == list(range(found[0], 1_001))
    assert 20 * 10 <= len(found) <= 26 * 10
    assert sequences(second)[-100:] == list(range(1, 101))
    with Bag(first) as bag:
        assert next(iter(bag.records(["leds"]))).topic == "leds"
    assert b"r2p.toml" in first.read_bytes()


@pytest.mark.virtual_time
async def test_a_snapshot_for_which_the_disk_has_no_room_leaves_no_file(tmp_path: Path) -> None:
    quota = Quota(20_000)
    disk, _ = open_disk(tmp_path / "crash.mcap", snapshot=60.0, max_size=50_000, opened=quota.open)
    await record(disk, 1_000)
    with pytest.raises(OSError, match="No space"):
        await disk.snapshot()
    assert (list(tmp_path.iterdir()), disk.paths) == ([], [])  # noqa: ASYNC240
    quota.size = 100_000
    assert (await disk.snapshot()).stat().st_size < 60_000  # max_size bounds the memory
    await disk.close()


@pytest.fixture(autouse=True)
def _no_lost_threads() -> Iterator[None]:
    before = Counter(thread.name for thread in threading.enumerate())
    yield
    for thread in threading.enumerate():
        if thread.name == "r2p-disk":
            thread.join(10)
    assert Counter(thread.name for thread in threading.enumerate())["r2p-disk"] <= before["r2p-disk"]
