"""Recordings that are there: what is in 1 GB of messages of 1 kB, and 10 seconds of it as a new file."""

import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

from benchmarks.start import COMMAND, seconds
from benchmarks.table import Row
from r2p.recording.format import ChannelInfo
from r2p.recording.writer import BagWriter
from r2p.units import SECOND

SIZE = 1_000_000_000
"""Bytes of the recording: of random ones, which do not get smaller when they are compressed."""
MESSAGE = 1000
RATE = 1000
"""Messages a second."""
START = 1_700_000_000 * SECOND


def write(path: Path) -> None:
    """Write the recording: ten topics without a type."""
    infos = [ChannelInfo(f"topic{i}", "ROBOT", f"node{i}", link="tcp") for i in range(10)]
    pool = os.urandom(1 << 20)
    with path.open("wb") as file:
        writer = BagWriter(file)
        channels = [writer.add_channel(f"/{info.topic}", "r2p", info.metadata) for info in infos]
        for i in range(SIZE // MESSAGE):
            time, at = START + i * SECOND // RATE, i * 7919 % (len(pool) - MESSAGE)
            head = i.to_bytes(8, "little")
            writer.add(channels[i % len(channels)], time, time, i + 1, head + pool[at : at + MESSAGE - len(head)])
        writer.finish()


def rows() -> Iterator[Row]:
    """`r2p bag info` and `r2p bag cut` of a large recording, each with the start of its process."""
    with tempfile.TemporaryDirectory() as folder:
        path, out = Path(folder, "large.mcap"), Path(folder, "cut.mcap")
        write(path)
        size = f"{path.stat().st_size / 1e9:.2f} GB"
        start = seconds(COMMAND, "bag", "--help")
        found = seconds(COMMAND, "bag", "info", str(path))
        baseline = f"r2p bag --help: {start:.2f} s"
        yield Row(f"r2p bag info of {size} of messages of 1 kB", f"{found:.2f} s", baseline, "0.5 s", found <= 0.5)
        cut = seconds("sh", "-c", f"rm -f {out}; {COMMAND} bag cut {path} --start 500 --end 510 -o {out}")
        yield Row(f"r2p bag cut of 10 s out of {size}", f"{cut:.2f} s", baseline, "2 s", cut <= 2.0)
