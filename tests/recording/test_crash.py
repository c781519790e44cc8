"""What a recording of a real process has when the process is killed, or its file may not grow."""

import subprocess
import sys
from pathlib import Path
from textwrap import dedent

import pytest

from r2p.recording.recovery import recover
from tests.recording.checker import check

pytestmark = pytest.mark.processes

RECORDER = """
    import asyncio, random, resource, sys
    import r2p
    from r2p.clock import clock_of
    from r2p.recording.background_writer import BackgroundWriter
    from r2p.recording.recording_files import RecordingOptions
    from r2p.recording.entries import SampleEntry

    async def main(path, limit):
        if limit:
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
        disk = BackgroundWriter(path, RecordingOptions(), clock_of(), lambda text: print(text, flush=True))
        number = 0
        while not disk.stopped:
            entries = []
            for number in range(number + 1, number + 101):
                sample = r2p.Sample(random.Random(number).randbytes(300), r2p.Source("IMU"), 1, sequence=number)
                entries.append(SampleEntry("noise", sample, None, clock_of().now()))
            disk.put(entries)
            print(number, clock_of().now(), flush=True)
            await asyncio.sleep(0.01)
        await disk.close()
        print("lost", number, disk.lost["noise"], flush=True)

    asyncio.run(main(sys.argv[1], int(sys.argv[2])))
"""


def start(path: Path, limit: int = 0, *prefix: str) -> subprocess.Popen[str]:
    """Start a process that records until it is killed; it prints the last number, and when it was received."""
    command = [*prefix, sys.executable, "-c", dedent(RECORDER), str(path), str(limit)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def test_a_process_that_is_killed_loses_at_most_what_came_after_the_last_chunk(tmp_path: Path) -> None:
    path, whole = tmp_path / "killed.mcap", tmp_path / "whole.mcap"
    grown: list[tuple[int, int]] = [(0, 0)]  # the size of the file, and what had been received by then
    with start(path) as process:
        assert process.stdout is not None
        while len(grown) < 5:
            last = int(process.stdout.readline().split()[1])
            if (size := path.stat().st_size) > grown[-1][0]:
                grown.append((size, last))
        process.kill()
    report = recover(path, whole)
    messages = check(whole)
    assert [message.sequence for message in messages] == list(range(1, len(messages) + 1))
    assert messages[-1].log_time >= grown[-2][1]
    assert (report.damaged, report.complete) == (0, False)


def of_last_line(process: subprocess.Popen[str]) -> tuple[list[str], int, int]:
    """What the process printed, how many messages it handed over, and how many of them are lost."""
    *lines, end = process.communicate(timeout=60)[0].splitlines()
    word, given, lost = end.split()
    assert word == "lost"
    return [line for line in lines if not line[0].isdigit()], int(given), int(lost)


def test_a_file_that_may_not_grow_ends_as_a_whole_file(tmp_path: Path) -> None:
    path = tmp_path / "limited.mcap"
    lines, given, lost = of_last_line(start(path, 300_000))
    messages = check(path)
    assert [message.sequence for message in messages] == list(range(1, given - lost + 1))
    assert 200_000 < path.stat().st_size <= 300_000
    assert lines[-1].startswith("the recording ended: the file has the largest size that its file system")


def test_a_file_system_that_is_full_keeps_a_whole_file(tmp_path: Path) -> None:
    mount = ["unshare", "--user", "--map-root-user", "--mount", "sh", "-c"]
    script = 'mount -t tmpfs -o size=400k r2p "$0" && shift && "$@"; cp "$0"/* "$0".after'
    small = tmp_path / "small"
    small.mkdir()
    if subprocess.run([*mount, 'mount -t tmpfs -o size=400k r2p "$0"', small], capture_output=True).returncode:
        pytest.skip("no tmpfs can be mounted here: user namespaces are switched off")
    lines, given, lost = of_last_line(start(small / "full.mcap", 0, *mount, script, str(small), "--"))
    after = small.with_suffix(".after")
    assert [message.sequence for message in check(after)] == list(range(1, given - lost + 1))
    assert 250_000 < after.stat().st_size <= 400 << 10
    assert lines[-1].startswith("the recording ended: the disk is full; the last ")
