"""Small recordings for tests: of LEDs, each third with a deadline and so a companion."""

from collections.abc import Sequence
from pathlib import Path

import r2p
from r2p.msg import Led
from r2p.recording.bag import Bag
from r2p.recording.format import LATCHED
from r2p.recording.samples import SampleWriter
from r2p.recording.writer import BagWriter

T0 = 1_700_000_000_000_000_000
MS = 1_000_000
Samples = list[tuple[str, r2p.Sample, type[r2p.Message] | None, int]]
Plain = list[tuple[str, r2p.Sample, int]]


def led(number: int, *, deadline: int = 0, source: str = "IMU") -> r2p.Sample:
    stamp = T0 + number * MS
    return r2p.Sample(
        Led(number % 8, 1).encode(), r2p.Source(source, "leds", "tcp"), stamp, deadline and stamp + deadline, number
    )


def leds(count: int, first: int = 1, *, source: str = "IMU") -> Samples:
    """They are received 1 ms after their stamp."""
    numbers = range(first, first + count)
    return [("leds", led(i, deadline=0 if i % 3 else 20 * MS, source=source), Led, T0 + (i + 1) * MS) for i in numbers]


def write(
    path: Path,
    samples: Samples,
    *,
    chunk_size: int = 200,
    finish: bool = True,
    settings: bytes = b"via = []",
    latched: Sequence[str] = (),
) -> Path:
    with path.open("wb") as file:
        writer = BagWriter(file, chunk_size=chunk_size)
        add = SampleWriter(writer)
        for topic, sample, cls, log_time in samples:
            add.write(topic, sample, cls, log_time)
        writer.attach("r2p.toml", "text/plain", settings, T0)
        writer.add_metadata("robot", {"name": "carrot"})
        if latched:
            writer.add_metadata(LATCHED, dict.fromkeys(latched, "yes"))
        if finish:
            writer.finish()
        else:
            writer.end_chunk()
    return path


def damage(path: Path, number: int = 0) -> Path:
    """Overwrite 16 bytes in the middle of a chunk."""
    with Bag(path) as bag:
        chunk = bag.files[0].summary.chunks[number]
    with path.open("r+b") as file:
        file.seek(chunk.offset + chunk.length - 20)
        file.write(bytes(16))
    return path


def plain(bag: Bag, start: int | None = None, end: int | None = None) -> Plain:
    return [(each.topic, each.sample, each.log_time) for each in bag.records(start=start, end=end)]


def read(path: Path) -> Plain:
    with Bag(path) as bag:
        return plain(bag)


def of(samples: Samples) -> Plain:
    return [(topic, sample, log_time) for topic, sample, _, log_time in samples]
